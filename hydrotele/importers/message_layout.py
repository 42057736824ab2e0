"""Decode numbers of messages by their paths, such as `position[boom_joint]` or `header.stamp.sec`.

Messages of ROS have no field names: a definition states the sequence of fields. A message whose strings
and arrays have the same lengths as those of an earlier one has its numbers at the same places. These
places are found once, and the numbers of all such messages are read as arrays.

An element of an array has an index or a name: the text in the field `name` of the element itself, or in
an array of texts `name`, `names` or `joint_names` of the same length in the same or an enclosing message.
"""

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from hydrotele.importers.bag_files import Topic, import_library

NAME_FIELDS = ("name", "names", "joint_names", "key", "label", "Name")
MAX_LISTED_ELEMENTS = 64  # elements of longer arrays, such as images, are not listed as paths
_MAX_LAYOUTS = 32  # layouts of messages of one size that are remembered
_ELEMENT = re.compile(r"(?P<array>.*)\[(?P<element>[^\[\]]*)\]", re.DOTALL)
_DTYPES: Mapping[str, str] = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


class Decoder(Protocol):
    """Decoder of the messages of one topic."""

    def list_paths(self, data: bytes) -> list[str]:
        """Return the paths of all numbers in a message."""
        ...

    def decode(self, messages: Sequence[bytes], paths: Sequence[str]) -> np.ndarray:
        """Return the numbers (n, k) at k paths in n messages as float64, NaN where a message has none."""
        ...


class UndecodableTopic(Exception):
    """The messages of a topic cannot be decoded; the text gives the reason."""


def make_decoder(topic: Topic) -> Decoder:
    """Return the decoder of the messages of a topic.

    Raises:
        UndecodableTopic: the encoding or the type is unknown.
    """
    if topic.encoding in ("cdr", "ros1"):
        return RosDecoder(topic)
    if topic.encoding == "json":
        return ObjectDecoder(json.loads)
    if topic.encoding == "protobuf":
        return ObjectDecoder(_protobuf_parser(topic))
    raise UndecodableTopic(f"the encoding {topic.encoding!r} is not known")


class _Array(NamedTuple):
    """Place of an array of numbers: offset [bytes], dtype, number of elements, and their names or ()."""

    offset: int
    dtype: str
    count: int
    names: tuple[str, ...] = ()


class _Layout(NamedTuple):
    """Places of the numbers in messages of one shape.

    Attributes:
        numbers: path -> (offset [bytes], dtype).
        arrays: path -> place of an array.
        shape: indices of the bytes that determine the places: lengths and names.
    """

    numbers: dict[str, tuple[int, str]]
    arrays: dict[str, _Array]
    shape: np.ndarray

    def find(self, path: str) -> tuple[int, str] | None:
        """Return (offset, dtype) of the number at a path, None without one."""
        if path in self.numbers:
            return self.numbers[path]
        match = _ELEMENT.fullmatch(path)
        if not match or (array := self.arrays.get(match["array"])) is None:
            return None
        element = match["element"]
        place = array.names.index(element) if element in array.names else int(element) if element.isdecimal() else -1
        if not 0 <= place < array.count:
            return None
        return array.offset + place * np.dtype(array.dtype).itemsize, array.dtype

    def list_paths(self) -> list[str]:
        """Return all paths in the order of the message, without the elements of long arrays."""
        listed = [(offset, path) for path, (offset, _) in self.numbers.items()]
        for path, array in self.arrays.items():
            if array.count <= MAX_LISTED_ELEMENTS:
                names = array.names or tuple(map(str, range(array.count)))
                listed += [(array.offset + k, f"{path}[{name}]") for k, name in enumerate(names)]
        return [path for _, path in sorted(listed)]


class RosDecoder:
    """Decoder of ROS 1 messages and of ROS 2 messages in CDR."""

    def __init__(self, topic: Topic) -> None:
        """Read the definition of the type in the file, or that of the ROS distributions without one.

        Raises:
            UndecodableTopic: the definition is missing or invalid.
        """
        self.type = _normalise_type(topic.type)
        self.aligned = topic.encoding == "cdr"
        self.fields = _read_definitions(topic)
        if self.type not in self.fields:
            raise UndecodableTopic(f"the file contains no definition of its type {topic.type}")
        self._layouts: dict[int, list[tuple[np.ndarray, _Layout]]] = {}  # by size of the message

    def list_paths(self, data: bytes) -> list[str]:
        """Return the paths of all numbers in a message."""
        return _Walker(self, data).walk().list_paths()

    def decode(self, messages: Sequence[bytes], paths: Sequence[str]) -> np.ndarray:
        """Return the numbers (n, k) at k paths in n messages, NaN where a message has none or is damaged."""
        result = np.full((len(messages), len(paths)), np.nan)
        sizes = np.array([len(data) for data in messages])
        for size in np.unique(sizes):
            places = np.flatnonzero(sizes == size)
            content = np.frombuffer(b"".join(messages[int(k)] for k in places), np.uint8).reshape(len(places), size)
            self._decode_equal_sizes(content, places, paths, result)
        return result

    def _decode_equal_sizes(self, content, places, paths: Sequence[str], result: np.ndarray) -> None:
        """Decode messages (m, size) of equal size into the rows `places` (m,) of the result."""
        left = np.ones(len(places), dtype=bool)
        known = self._layouts.setdefault(content.shape[1], [])
        del known[:-_MAX_LAYOUTS]
        for layout in known:
            self._read_columns(layout, content, places, paths, result, left)
        while left.any():
            first = int(np.argmax(left))
            try:
                made = _Walker(self, content[first].tobytes()).walk()
            except (struct.error, UndecodableTopic):
                left[first] = False  # a damaged message
                continue
            known.append((content[first, made.shape], made))
            self._read_columns(known[-1], content, places, paths, result, left)

    def _read_columns(self, layout, content, places, paths: Sequence[str], result: np.ndarray, left) -> None:
        """Read the messages of one layout, of those in `left` (m,), and remove them from it."""
        shape, places_of_numbers = layout
        rows = np.flatnonzero(left & (content[:, places_of_numbers.shape] == shape).all(axis=1))
        left[rows] = False
        for column, path in enumerate(paths):
            if len(rows) and (found := places_of_numbers.find(path)):
                offset, dtype = found
                part = np.ascontiguousarray(content[rows, offset : offset + np.dtype(dtype).itemsize])
                result[places[rows], column] = part.view(dtype)[:, 0]


class _Walker:
    """Reader of one message that notes the places of its numbers."""

    def __init__(self, decoder: RosDecoder, data: bytes) -> None:
        self.fields, self.type, self.data = decoder.fields, decoder.type, data
        self.aligned, self.start, self.order = decoder.aligned, 0, "<"
        if self.aligned:  # the first four bytes state the order of bytes
            self.start, self.order = 4, "<" if data[1:2] in (b"\x01", b"\x03") else ">"
        self.at = self.start
        self.numbers: dict[str, tuple[int, str]] = {}
        self.arrays: dict[str, _Array] = {}
        self.labelled: set[str] = set()  # paths of the elements that have a name
        self.shape: list[int] = []

    def walk(self) -> _Layout:
        """Return the layout of the message.

        Raises:
            struct.error: the message is shorter than its definition states.
            UndecodableTopic: the message contains a type of field that is not supported.
        """
        self._walk_fields(self.type, "", ())
        if self.at > len(self.data):
            raise struct.error("the message is too short")
        return _Layout(self.numbers, self.arrays, np.array(self.shape, dtype=int))

    def _walk_fields(self, kind: str, prefix: str, names: tuple[str, ...]) -> None:
        if kind not in self.fields:
            raise UndecodableTopic(f"the file contains no definition of the type {kind}")
        for name, description in self.fields[kind]:
            found = self._walk_field(description, f"{prefix}{name}", names)
            if name in NAME_FIELDS and found:
                names = found

    def _walk_field(self, description, path: str, names: tuple[str, ...]) -> tuple[str, ...]:
        """Note the places of a field; return the texts of an array of texts, () for other fields."""
        node, content = description
        if node.name == "NAME":
            self._walk_fields(content, f"{path}.", names)
            return ()
        if node.name == "BASE":
            if content[0] == "string":
                self._read_text(False)
            else:
                dtype = self._dtype(content[0])
                self._align(dtype)
                self.numbers[path] = self.at, dtype
                self.at += np.dtype(dtype).itemsize
            return ()
        element, count = content
        if node.name == "SEQUENCE":
            count = self._read_length()
        if element[0].name == "BASE" and element[1][0] != "string":
            dtype = self._dtype(element[1][0])
            if count:
                self._align(dtype)
            self.arrays[path] = _Array(self.at, dtype, count, names if _are_names(names, count) else ())
            self.at += count * np.dtype(dtype).itemsize
            return ()
        if count > len(self.data):
            raise struct.error("the message is too short")
        if element[0].name == "BASE":
            is_name = path.rpartition(".")[2] in NAME_FIELDS
            return tuple(self._read_text(is_name) for _ in range(count))
        for place in range(count):
            self._walk_element(element[1], path, place, names[place] if _are_names(names, count) else "")
        return ()

    def _walk_element(self, kind: str, path: str, place: int, label: str) -> None:
        """Note the places of an element of an array of messages, and name it by its own field `name`."""
        before = set(self.numbers), set(self.arrays)
        prefix = f"{path}[{place}]."
        for name, description in self.fields.get(kind, ()):
            if description[0].name == "BASE" and description[1][0] == "string" and name in NAME_FIELDS:
                label = self._read_text(True) or label
            else:
                self._walk_field(description, f"{prefix}{name}", ())
        if kind not in self.fields:
            raise UndecodableTopic(f"the file contains no definition of the type {kind}")
        if label and f"{path}[{label}]" not in self.labelled:
            self.labelled.add(f"{path}[{label}]")
            own: dict[str, Any]
            for own, old in ((self.numbers, before[0]), (self.arrays, before[1])):
                for known in [key for key in own if key not in old]:
                    own[f"{path}[{label}].{known.removeprefix(prefix)}"] = own.pop(known)

    def _dtype(self, name: str) -> str:
        if name not in _DTYPES:
            raise UndecodableTopic(f"it contains a field of type {name}")
        return self.order + _DTYPES[name]

    def _align(self, dtype: str) -> None:
        if self.aligned:
            size = np.dtype(dtype).itemsize
            self.at += -(self.at - self.start) % size

    def _read_length(self) -> int:
        self._align("u4")
        length = struct.unpack_from(f"{self.order}I", self.data, self.at)[0]
        self.shape += range(self.at, self.at + 4)
        self.at += 4
        return length

    def _read_text(self, is_name: bool) -> str:
        length = self._read_length()
        content = self.data[self.at : self.at + length]
        if len(content) < length:
            raise struct.error("the message is too short")
        if is_name:
            self.shape += range(self.at, self.at + length)
        self.at += length
        return content.rstrip(b"\0").decode(errors="replace") if is_name else ""


def _are_names(names: Sequence[str], count: int) -> bool:
    """Return whether texts name the `count` elements of an array: their number is the same, and no two are equal."""
    return len(names) == count == len(set(names)) and all(names)


def _normalise_type(name: str) -> str:
    """Return the name of a type with `msg` in its middle, as in ROS 2."""
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}" if package else name


def _read_definitions(topic: Topic) -> Mapping[str, Sequence[tuple[str, Any]]]:
    """Return the fields of all types that a topic needs: type -> (name, description as in `rosbags`)."""
    typesys = import_library("rosbags.typesys")
    text = topic.definition.decode(errors="replace")
    if not text.strip():
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if topic.encoding == "ros1" else typesys.Stores.LATEST)
        return {name: fields for name, (_, fields) in store.fielddefs.items()}
    try:
        if topic.definition_format == "ros2idl":
            types = typesys.get_types_from_idl(text)
        else:
            types = typesys.get_types_from_msg(text, _normalise_type(topic.type))
    except Exception as error:  # the parser has several error types
        raise UndecodableTopic(f"the definition of its type {topic.type} is invalid ({str(error)[:80]})") from None
    store = typesys.get_typestore(typesys.Stores.EMPTY)  # the built-in types Time and Duration
    return {name: fields for name, (_, fields) in {**store.fielddefs, **types}.items()}


class ObjectDecoder:
    """Decoder of messages that contain their field names, such as JSON."""

    def __init__(self, parse: Callable[[bytes], Any]) -> None:
        """Store the function that returns a message as nested dicts and lists."""
        self.parse = parse

    def list_paths(self, data: bytes) -> list[str]:
        """Return the paths of all numbers in a message."""
        return list(dict(flatten(self.parse(data))))

    def decode(self, messages: Sequence[bytes], paths: Sequence[str]) -> np.ndarray:
        """Return the numbers (n, k) at k paths in n messages, NaN where a message has none or is damaged."""
        result = np.full((len(messages), len(paths)), np.nan)
        for row, data in enumerate(messages):
            try:
                found = self.parse(data)
            except (ValueError, RecursionError):
                continue
            numbers = dict(flatten(found))
            for column, path in enumerate(paths):
                if (value := numbers.get(path)) is None:
                    value = _find_in_object(found, path)
                if value is not None:
                    result[row, column] = value
        return result


def flatten(value: Any, prefix: str = "", names: tuple[str, ...] = ()) -> Iterator[tuple[str, float]]:
    """Yield (path, number) of all numbers in nested dicts and lists, without the elements of long lists.

    >>> dict(flatten({"name": ["boom", "arm"], "position": [0.5, 1.0]}))
    {'position[boom]': 0.5, 'position[arm]': 1.0}
    """
    if isinstance(value, bool | int | float):
        yield prefix, float(value)
    elif isinstance(value, dict):
        for key in NAME_FIELDS:
            if isinstance(found := value.get(key), list) and all(isinstance(item, str) for item in found):
                names = tuple(found)
        for key, item in value.items():
            yield from flatten(item, f"{prefix}.{key}" if prefix else str(key), names)
    elif isinstance(value, list) and len(value) <= MAX_LISTED_ELEMENTS:
        used: set[str] = set()
        for place, item in enumerate(value):
            label = names[place] if _are_names(names, len(value)) else str(place)
            if isinstance(item, dict):
                label = next((item[key] for key in NAME_FIELDS if isinstance(item.get(key), str)), "") or label
            label = str(place) if label in used else label
            used.add(label)
            yield from flatten(item, f"{prefix}[{label}]")


def _find_in_object(value: Any, path: str) -> float | None:
    """Return the number at a path with indices of elements, None without one."""
    for word in re.findall(r"[^.\[\]]+", path):
        if isinstance(value, dict):
            value = value.get(word)
        elif isinstance(value, list) and word.isdecimal() and int(word) < len(value):
            value = value[int(word)]
        else:
            return None
    return float(value) if isinstance(value, bool | int | float) else None


def _protobuf_parser(topic: Topic) -> Callable[[bytes], Any]:
    """Return a function that parses messages of protobuf to nested dicts.

    Raises:
        UndecodableTopic: the definition in the file is invalid.
    """
    descriptors = import_library("google.protobuf.descriptor_pb2")
    pools = import_library("google.protobuf.descriptor_pool")
    factory = import_library("google.protobuf.message_factory")
    try:
        files = descriptors.FileDescriptorSet.FromString(topic.definition)
        pool = pools.DescriptorPool()
        for file in _sort_by_dependency(files.file):
            pool.Add(file)
        kind = factory.GetMessageClass(pool.FindMessageTypeByName(topic.type))
    except Exception as error:  # the library has several error types
        raise UndecodableTopic(f"the definition of its type {topic.type} is invalid ({str(error)[:80]})") from None

    def parse(data: bytes) -> Any:
        try:
            return _message_to_dict(kind.FromString(data))
        except Exception as error:  # google.protobuf.message.DecodeError is no ValueError
            raise ValueError(str(error)) from None

    return parse


def _sort_by_dependency(files: Sequence[Any]) -> list[Any]:
    left, done = list(files), []
    while left:
        names = {file.name for file in left}
        ready = [file for file in left if not names & set(file.dependency)] or left[:1]
        done += ready
        left = [file for file in left if file not in ready]
    return done


def _message_to_dict(message: Any) -> dict[str, Any]:
    result = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.type == field.TYPE_MESSAGE:
            if hasattr(value, "DESCRIPTOR"):
                result[field.name] = _message_to_dict(value) if message.HasField(field.name) else None
            elif hasattr(value, "items"):
                result[field.name] = {str(k): v for k, v in value.items() if isinstance(v, bool | int | float)}
            else:
                result[field.name] = [_message_to_dict(item) for item in value]
        elif isinstance(value, bool | int | float | str):
            result[field.name] = value
        elif not isinstance(value, bytes):
            result[field.name] = list(value)
    return result


def find_stamp_paths(paths: Sequence[str]) -> tuple[str, str] | None:
    """Return the paths of seconds and nanoseconds of the time at which a message was measured; None without one.

    It is the time `stamp` of a ROS header, or else a time `stamp` or `timestamp` of the message itself.

    >>> find_stamp_paths(["header.stamp.sec", "header.stamp.nanosec", "position[0]"])
    ('header.stamp.sec', 'header.stamp.nanosec')
    """
    present = set(paths)
    for stamp in ("header.stamp", "stamp", "timestamp"):
        for seconds, nanoseconds in (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec"), ("seconds", "nanos")):
            if {f"{stamp}.{seconds}", f"{stamp}.{nanoseconds}"} <= present:
                return f"{stamp}.{seconds}", f"{stamp}.{nanoseconds}"
    return None


def normalise_path(path: str) -> str:
    """Return a path behind the name of a topic in the form of this module.

    Paths with slashes, as PlotJuggler writes them, are accepted: `/boom_joint/position` is
    `position[boom_joint]` of a message with names, otherwise `boom_joint.position`.

    >>> normalise_path(".position[boom_joint]"), normalise_path("/header/stamp/sec")
    ('position[boom_joint]', 'header.stamp.sec')
    """
    head, bracket, rest = path.partition("[")
    return head.strip("./").replace("/", ".") + bracket + rest


def match_path(path: str, listed: Sequence[str]) -> str:
    """Return the listed path that a path in another notation means, or the path itself.

    >>> match_path("boom_joint.position", ["position[boom_joint]", "velocity[boom_joint]"])
    'position[boom_joint]'
    """
    words = path.split(".")
    if path not in listed and len(words) >= 2:
        for other in (f"{words[-1]}[{'.'.join(words[:-1])}]", f"{'.'.join(words[:-1])}[{words[-1]}]"):
            if other in listed:
                return other
    return path

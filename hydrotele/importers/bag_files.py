"""Read the messages of ROS bags and MCAP files in the order of the file, without decoding them.

Accepted are ROS 1 bags (`.bag`), ROS 2 bags (`.db3` and `.mcap`, alone or as a folder, also compressed)
and plain MCAP files. Files are read from start to end, so that of a damaged file the part before the
damage is kept. Messages of other than the requested topics are counted but not copied.
"""

import bz2
import sqlite3
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.files import open_regular

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
_COMPRESSED_SUFFIXES = tuple(f"{suffix}.zstd" for suffix in BAG_SUFFIXES[1:])
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_MAX_RECORD_BYTES = 2**31  # a record that states a larger size is damaged
_MAX_FILE_BYTES = 2**50  # a jump by a larger size leaves every file
_MAX_STAMP = 2**63  # [ns] larger times are damaged


class Topic(NamedTuple):
    """Name of a topic, and how its messages are encoded.

    Attributes:
        name: name, such as `/joint_states`.
        type: type of its messages, such as `sensor_msgs/msg/JointState`.
        encoding: encoding of a message: `cdr`, `ros1`, `json` or `protobuf`; others cannot be decoded.
        definition: definition of the type in the file, empty without one.
        definition_format: `ros1msg`, `ros2msg`, `ros2idl`, `protobuf`, or another one.
    """

    name: str
    type: str
    encoding: str
    definition: bytes
    definition_format: str


class Message(NamedTuple):
    """Topic of a message, time at which it was received [ns], and its content."""

    topic: Topic
    received: int
    data: bytes


class _Damage(Exception):
    """A file ends too early or contains bytes that are no record."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its name, or a folder of a ROS 2 bag."""
    return _is_bag_file(path) or (path.is_dir() and bool(_files_of_folder(path)))


def _is_bag_file(path: Path) -> bool:
    return path.name.lower().endswith((*BAG_SUFFIXES, *_COMPRESSED_SUFFIXES)) and not path.is_dir()


def _files_of_folder(path: Path) -> list[Path]:
    """Return the files of a folder that holds one ROS 2 bag, in recorded order: `name_0`, `name_1`, `name_10`."""
    files = [file for file in path.iterdir() if _is_bag_file(file)]
    return sorted(files, key=lambda file: (len(file.name), file.name))


class Bag:
    """Reader of the messages of a bag; after reading it holds what was found.

    Attributes:
        topics: topics by name.
        counts: number of messages by topic, also of topics that were not requested.
        notes: one sentence per damaged part.
    """

    def __init__(self, path: Path) -> None:
        """Find the files of the bag, without reading them.

        Raises:
            InputError: the path is not a bag.
        """
        self.path = path
        self.files = _files_of_folder(path) if path.is_dir() else [path]
        if not path.exists() or not self.files or not all(map(_is_bag_file, self.files)):
            raise InputError(path, f"is not a bag: give a file that ends in {', '.join(BAG_SUFFIXES)}, or its folder")
        self.topics: dict[str, Topic] = {}
        self.counts: Counter[str] = Counter()
        self.notes: list[str] = []

    def messages(self, is_wanted: Callable[[Topic], bool]) -> Iterator[Message]:
        """Yield the messages of the requested topics.

        Raises:
            InputError: a file is not of the format that its name states, or a library is missing.
        """
        for file in self.files:
            with tempfile.TemporaryDirectory(prefix="hydrotele_") as folder:
                yield from self._read_file(_decompress_file(file, Path(folder)), file, is_wanted)

    def _read_file(self, path: Path, named: Path, is_wanted: Callable[[Topic], bool]) -> Iterator[Message]:
        kind = path.suffix.lower()
        read = {".bag": _read_ros1, ".db3": _read_sqlite, ".mcap": _read_mcap}[kind]
        topics: dict[int, tuple[Topic, bool]] = {}

        def add(number: int, topic: Topic) -> bool:
            if number not in topics:
                self.topics.setdefault(topic.name, topic)
                topics[number] = topic, is_wanted(topic)
            return topics[number][1]

        try:
            for number, received, data in read(path, add):
                if number not in topics:
                    raise _Damage("a message belongs to no topic")
                topic, wanted = topics[number]
                self.counts[topic.name] += 1
                if wanted:
                    content = bytes(data)
                    if topic.encoding == "cdr" and content[:4] == _ZSTD_MAGIC:
                        content = _decompress(content, "zstd stream", 0)
                    yield Message(topic, received, content)
        except _Damage as damage:
            if not topics:
                raise InputError(named, f"{damage}; nothing can be read from it: copy it again") from None
            self.notes.append(
                f"{named}: {damage}; the {sum(self.counts.values())} messages before the damage were read."
            )


def _decompress_file(path: Path, folder: Path) -> Path:
    """Return an uncompressed copy, in a temporary folder, of a file that ends in `.zstd`; other files unchanged."""
    if path.suffix.lower() != ".zstd":
        return path
    target = folder / path.stem
    with open_regular(path) as file, open(target, "wb") as copy:
        zstandard = import_library("zstandard")
        try:
            zstandard.ZstdDecompressor().copy_stream(file, copy)
        except zstandard.ZstdError:
            pass  # the damage is reported where the copy ends
    return target


def import_library(name: str):
    """Import a library of the optional extra `import`.

    Raises:
        InputError: it is not installed; the message gives the command that installs it.
    """
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        library = name.partition(".")[0]
        raise InputError("import", f"needs the library {library}: pip install 'hydrotele[import]'") from None


_Add = Callable[[int, Topic], bool]
_Records = Iterator[tuple[int, int, bytes | memoryview]]


def _read_exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size) if size <= _MAX_RECORD_BYTES else b""
    if len(data) < size:
        raise _Damage("the file is truncated or damaged")
    return data


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """Return the content of a compressed chunk of `size` bytes.

    Raises:
        _Damage: the chunk cannot be decompressed.
    """
    try:
        if compression == "lz4":
            return import_library("lz4.frame").decompress(data)
        if compression == "zstd":
            return import_library("zstandard").ZstdDecompressor().decompress(data, max_output_size=size)
        if compression == "zstd stream":  # a single message, which does not state its size
            return import_library("zstandard").ZstdDecompressor().decompressobj().decompress(data)
        if compression == "bz2":
            return bz2.decompress(data)
    except InputError:
        raise
    except Exception as error:  # each library has other error types
        raise _Damage(f"a compressed chunk is damaged ({str(error)[:80]})") from None
    if compression in ("", "none"):
        return data
    raise _Damage(f"a chunk has the unknown compression {compression!r}")


# MCAP, https://mcap.dev/spec

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 3, 4, 5, 6, 15
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_RECORD_HEAD = struct.Struct("<BQ")


def _read_mcap(path: Path, add: _Add) -> _Records:
    """Yield (channel number, log time [ns], data) of the messages of an MCAP file."""
    schemas: dict[int, tuple[str, str, bytes]] = {}
    with open_regular(path) as file:
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise InputError(path, "is not an MCAP file, or its start is damaged: copy it again")
        while True:
            code, size = _RECORD_HEAD.unpack(_read_exactly(file, _RECORD_HEAD.size))
            if code == _DATA_END:
                return
            if code not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                file.seek(min(size, _MAX_FILE_BYTES), 1)
                continue
            data = _read_exactly(file, size)
            if code == _CHUNK:
                data = _open_mcap_chunk(data)
                yield from _read_mcap_records(data, schemas, add)
            else:
                yield from _read_mcap_records(_RECORD_HEAD.pack(code, size) + data, schemas, add)


def _open_mcap_chunk(data: bytes) -> bytes:
    try:
        size, checksum = struct.unpack_from("<QI", data, 16)
        compression, at = _read_text(data, 28)
        records = _decompress(data[at + 8 :], compression, size)
    except (struct.error, UnicodeDecodeError):
        raise _Damage("a chunk is damaged") from None
    if len(records) != size or (checksum and zlib.crc32(records) != checksum):
        raise _Damage("the checksum of a chunk is wrong")
    return records


def _read_mcap_records(data: bytes, schemas: dict[int, tuple[str, str, bytes]], add: _Add) -> _Records:
    at, view, unpack = 0, memoryview(data), _RECORD_HEAD.unpack_from
    try:
        while at < len(data):
            code, size = unpack(data, at)
            at += _RECORD_HEAD.size
            if code == _MESSAGE:
                channel, _, received, _ = _MESSAGE_HEAD.unpack_from(data, at)
                if received >= _MAX_STAMP:
                    raise _Damage("a record is damaged")
                yield channel, received, view[at + _MESSAGE_HEAD.size : at + size]
            elif code == _SCHEMA:
                name, place = _read_text(data, at + 2)
                encoding, place = _read_text(data, place)
                length = struct.unpack_from("<I", data, place)[0]
                schemas[struct.unpack_from("<H", data, at)[0]] = name, encoding, data[place + 4 : place + 4 + length]
            elif code == _CHANNEL:
                number, schema = struct.unpack_from("<HH", data, at)
                topic, place = _read_text(data, at + 4)
                encoding, _ = _read_text(data, place)
                name, form, definition = schemas.get(schema, ("", "", b""))
                add(number, Topic(topic, name, encoding, definition, form))
            at += size
    except (struct.error, UnicodeDecodeError, KeyError):
        raise _Damage("a record is damaged") from None


def _read_text(data: bytes, at: int) -> tuple[str, int]:
    """Return a text with its length in front, and the place behind it."""
    size = struct.unpack_from("<I", data, at)[0]
    return data[at + 4 : at + 4 + size].decode(), at + 4 + size


# ROS 1 bags, https://wiki.ros.org/Bags/Format/2.0

_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CONNECTION = 2, 5, 7


def _read_ros1(path: Path, add: _Add) -> _Records:
    """Yield (connection number, time [ns], data) of the messages of a ROS 1 bag."""
    with open_regular(path) as file:
        if file.read(len(_ROS1_MAGIC)) != _ROS1_MAGIC:
            raise InputError(path, "is not a ROS 1 bag of version 2.0, or its start is damaged: copy it again")
        index_place = 0  # the recorder writes it when it closes the bag
        while head := file.read(4):
            if len(head) < 4:
                raise _Damage("the file is truncated")
            header = _parse_ros1_header(_read_exactly(file, struct.unpack("<I", head)[0]))
            size = struct.unpack("<I", _read_exactly(file, 4))[0]
            code = _ros1_code(header)
            if code not in (_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CONNECTION):
                index_place = index_place or int.from_bytes(header.get("index_pos", b""), "little")
                file.seek(size, 1)
                continue
            data = _read_exactly(file, size)
            if code == _ROS1_CHUNK:
                if "size" not in header or "compression" not in header:
                    raise _Damage("a chunk is damaged")
                size = struct.unpack("<I", header["size"])[0]
                data = _decompress(data, header["compression"].decode(errors="replace"), size)
                yield from _read_ros1_records(data, add)
            else:
                yield from _read_ros1_record(header, data, add)
        if not 0 < index_place <= path.stat().st_size or file.tell() > path.stat().st_size:
            raise _Damage("the file is truncated, or its recorder did not close it")


def _read_ros1_records(data: bytes, add: _Add) -> _Records:
    at, view = 0, memoryview(data)
    try:
        while at < len(data):
            size = struct.unpack_from("<I", data, at)[0]
            header = _parse_ros1_header(data[at + 4 : at + 4 + size])
            at += 4 + size
            size = struct.unpack_from("<I", data, at)[0]
            yield from _read_ros1_record(header, view[at + 4 : at + 4 + size], add)
            at += 4 + size
    except struct.error:
        raise _Damage("a chunk is damaged") from None


def _read_ros1_record(header: dict[str, bytes], data: bytes | memoryview, add: _Add) -> _Records:
    try:
        code = _ros1_code(header)
        if code == _ROS1_MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", header["time"])
            yield struct.unpack("<I", header["conn"])[0], seconds * 10**9 + nanoseconds, data
        elif code == _ROS1_CONNECTION:
            known = _parse_ros1_header(bytes(data))
            name, kind = header["topic"].decode(), known["type"].decode()
            definition = known["message_definition"]
            add(struct.unpack("<I", header["conn"])[0], Topic(name, kind, "ros1", definition, "ros1msg"))
    except (struct.error, KeyError, UnicodeDecodeError):
        raise _Damage("a record is damaged") from None


def _parse_ros1_header(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    try:
        while at < len(data):
            size = struct.unpack_from("<I", data, at)[0]
            name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
            if not equals or at + 4 + size > len(data):
                raise _Damage("a record is damaged")
            fields[name.decode()] = value
            at += 4 + size
    except (struct.error, UnicodeDecodeError):
        raise _Damage("a record is damaged") from None
    return fields


def _ros1_code(header: dict[str, bytes]) -> int:
    if not header.get("op"):
        raise _Damage("a record is damaged")
    return header["op"][0]


# ROS 2 bags in SQLite

_TOPIC_QUERY = "SELECT id, name, type, serialization_format FROM topics"
_DEFINITION_QUERY = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
_MESSAGE_QUERY = "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({}) THEN data END FROM messages NOT INDEXED"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def _read_sqlite(path: Path, add: _Add) -> _Records:
    """Yield (topic number, time [ns], data) of the messages of a SQLite file of a ROS 2 bag."""
    with open_regular(path) as file:
        if file.read(16) != b"SQLite format 3\0":
            raise InputError(path, "is not a SQLite file, or its start is damaged: copy it again")
    unfinished = path.with_name(path.name + "-wal").exists()  # of a recorder that was killed
    mode = "mode=ro" if unfinished else "immutable=1"
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
    try:
        connection.execute("PRAGMA writable_schema=ON")  # reads the part of a truncated file that is there
        definitions = {}
        try:
            for name, form, text in connection.execute(_DEFINITION_QUERY):
                definitions[name] = (text or "").encode(), form
        except sqlite3.OperationalError:
            pass  # bags before ROS 2 Iron have no definitions
        wanted = []
        for number, name, kind, encoding in connection.execute(_TOPIC_QUERY).fetchall():
            if add(number, Topic(name, kind, encoding, *definitions.get(kind, (b"", "")))):
                wanted.append(number)
        query = _MESSAGE_QUERY.format(", ".join(map(str, wanted)))
        for number, received, data in connection.execute(query):
            yield number, received, data or b""
    except sqlite3.DatabaseError as error:
        raise _Damage(f"the file is truncated or damaged ({error})") from None
    finally:
        connection.close()

"""Read YAML files into validated, immutable models, with errors that name file, line and key.

A key may have its unit as a suffix (`angle_deg`, `area_head_in2`, `relief_pressure_bar`). Values
are converted to SI here and nowhere else.
"""

import difflib
import math
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypeVar

import pydantic
import yaml

from hydrotele.core.errors import InputError
from hydrotele.core.files import describe_excess, get_limit, read_text
from hydrotele.core.units import KEY_SUFFIXES, si_unit_and_factor

MAX_MAGNITUDE = 1.0e20  # largest magnitude of a number in SI; keeps products of a few numbers finite
Number = Annotated[float, pydantic.Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
Vector = tuple[Number, Number, Number]
PositiveFloat = Annotated[float, pydantic.Field(gt=0, le=MAX_MAGNITUDE)]
NonNegativeFloat = Annotated[float, pydantic.Field(ge=0, le=MAX_MAGNITUDE)]
Name = Annotated[str, pydantic.Field(pattern=r"^[a-z][a-z0-9_]*$")]

ANGULAR_FREQUENCY_KEYS = ("bandwidth",)  # in rad/s: the suffix `_hz` multiplies them by 2 pi


def scale_numbers(value: Any, factor: float) -> Any:
    """Multiply a number, or every number of nested lists, by a factor; keep booleans and None.

    Raises:
        ValueError: the value is text, which cannot have a unit.
    """
    if isinstance(value, str):
        raise ValueError(f"{value!r} is text, not a number")
    if isinstance(value, list):
        return [scale_numbers(item, factor) for item in value]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    try:
        return value * factor
    except OverflowError:  # an integer beyond any float
        return math.inf


def split_unit(key: str) -> tuple[str, float | None]:
    """Split a key into its name without unit suffix and the factor that converts its values to SI.

    Without a unit suffix, the name is the whole key and the factor is None. The suffix `_hz` of an
    angular frequency, such as `bandwidth_hz`, has the factor 2 pi.

    >>> split_unit("accuracy_mm")
    ('accuracy', 0.001)
    """
    for suffix, unit in KEY_SUFFIXES.items():
        if key.endswith(suffix):
            stem = key.removesuffix(suffix)
            turns = suffix == "_hz" and stem in ANGULAR_FREQUENCY_KEYS
            return stem, 2.0 * math.pi if turns else si_unit_and_factor(unit)[1]
    return key, None


def suggest_valid_name(name: object, valid, renamed: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a hint for an error message: the closest valid name, if any, and all valid names.

    For a former name, a key of `renamed`, the hint is the present name.
    """
    if isinstance(name, str) and name in renamed:
        return f"it is now called {renamed[name]!r}"
    names = sorted(map(str, valid))
    close = difflib.get_close_matches(str(name), names, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}valid: {', '.join(names) or '(none)'}"


def describe_unknown_key(key: str, valid, renamed: Mapping[str, str]) -> str:
    """Return the error message for an unknown key.

    Args:
        key: the key, which may have a unit suffix.
        valid: the valid keys.
        renamed: former key -> present key, both without unit suffix.

    >>> describe_unknown_key("kerf_mm", ["cut_height"], {"kerf": "cut_height"})
    "unknown key 'kerf_mm': it is now called 'cut_height_mm'"
    """
    for former in (key, split_unit(key)[0]):
        if former in renamed:
            return f"unknown key {key!r}: it is now called {renamed[former] + key.removeprefix(former)!r}"
    return f"unknown key {key!r}; {suggest_valid_name(key, valid)}"


class StrictModel(pydantic.BaseModel):
    """Base class of all data read from YAML: immutable, finite, in SI units, no unknown keys.

    `renamed` maps former keys to present ones, both without unit suffix. A former key is refused
    with a message that names the present one.
    """

    renamed: ClassVar[dict[str, str]] = {}

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _convert_units_and_refuse_unknown_keys(cls, data):
        """Convert the values of keys with a unit suffix to SI, and rename these keys to the field names.

        Data other than a dict are returned unchanged.

        Raises:
            ValueError: a key is unknown, or a field is given twice.
        """
        if not isinstance(data, dict):
            return data
        fields = cls.model_fields
        result: dict[str, Any] = {}
        for key, value in data.items():
            name, factor = split_unit(str(key))
            if key in fields:
                name = key
            elif factor is not None and name in fields:
                value = scale_numbers(value, factor)
            else:
                raise ValueError(describe_unknown_key(str(key), fields, cls.renamed))
            if name in result:
                raise ValueError(f"{name!r} is given twice, as {key!r} and with another unit")
            result[name] = value
        return result


_BASE_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml: ten times as fast


class _Loader(_BASE_LOADER):
    """SafeLoader that reads 28.0e6 as a number, as YAML 1.2 does, and rejects repeated keys."""

    def __init__(self, stream):
        super().__init__(stream)
        self.deep_construct = True  # rejects an alias inside its own anchor

    def construct_mapping(self, node, deep=False):
        """Construct a mapping; raise an error for a repeated key."""
        seen = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                continue  # SafeLoader itself rejects it and names the line
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} occurs twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+$"),
    list("-+0123456789"),
)


def _load_yaml(text: str) -> tuple[Any, Any]:
    """Parse a YAML text of limited size and return its root node and its value."""
    _check_size(text)
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        return node, (loader.construct_document(node) if node else None)
    finally:
        loader.dispose()


def _check_size(text: str) -> None:
    """Reject YAML that is nested too deeply or has too many values after alias expansion.

    The check reads the parser's events one by one and builds no objects, because libyaml's composer
    limits neither depth nor size.
    """
    opened: list[tuple[str | None, int]] = []  # anchors of open nodes, number of values before them
    sizes: dict[str, int] = {}
    values, most_values, most_depth = 0, get_limit("FILE_VALUES"), get_limit("FILE_DEPTH")
    for event in yaml.parse(text, Loader=_BASE_LOADER):
        anchor = getattr(event, "anchor", None)
        if isinstance(event, yaml.AliasEvent):
            values += sizes.get(str(anchor), 1)
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            if anchor:
                sizes[anchor] = 1
        elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            opened.append((anchor, values))
            values += 1
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            anchor, before = opened.pop()
            if anchor:
                sizes[anchor] = values - before
        if values > most_values or len(opened) > most_depth:
            said = describe_excess("FILE_DEPTH", len(opened)) or describe_excess("FILE_VALUES", values)
            raise yaml.MarkedYAMLError(problem=f"it has {said}", problem_mark=event.start_mark)


def _key_lines(root) -> dict[tuple, int]:
    """Return {key path: line number from 1} of every key and list item below a YAML node.

    A key path is a tuple of keys and list indices; the node itself has the path (). The keys of a
    node that aliases repeat are recorded at its first occurrence only.
    """
    lines: dict[tuple, int] = {(): root.start_mark.line + 1}
    opened: set = set()
    waiting: list[tuple[Any, tuple]] = [(root, ())]
    for node, path in waiting:  # the list grows during iteration
        if node in opened:
            continue
        opened.add(node)
        children: list[tuple] = []
        if isinstance(node, yaml.MappingNode):
            children = [(str(key.value), key, value) for key, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            children = [(index, value, value) for index, value in enumerate(node.value)]
        for name, marked, child in children:
            lines[(*path, name)] = marked.start_mark.line + 1
            waiting.append((child, (*path, name)))
    return lines


# PyYAML's constructors raise these for a value that does not match its explicit tag.
_SCALAR_ERRORS = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)


def read_yaml(path: str | Path) -> tuple[dict, dict[tuple, int]]:
    """Read a YAML mapping together with the line of every key.

    Args:
        path: the file.

    Returns:
        (data, {key path: line number from 1}); a key path is a tuple of keys and list indices.

    Raises:
        InputError: the file is missing, not YAML, or not a mapping.
    """
    path = Path(path)
    text = read_text(path)
    try:
        node, data = _load_yaml(text)
    except (yaml.YAMLError, RecursionError, *_SCALAR_ERRORS) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        nested = isinstance(error, RecursionError)
        untold = "it is nested too deeply" if nested else "a value does not match its !!tag"
        problem = getattr(error, "problem", None) or str(error if error.args[1:] else untold)
        raise InputError(f"{path}{line}", f"is not valid YAML: {problem}") from None
    if not isinstance(data, dict) or node is None:
        raise InputError(str(path), "must be a mapping of keys to values")
    return data, _key_lines(node)


def parse_yaml_value(text: str) -> Any:
    """Parse a YAML text, such as the value of a command-line option, by the rules for files.

    Raises:
        yaml.YAMLError: the text is not valid YAML.
    """
    return _load_yaml(text)[1]


Model = TypeVar("Model", bound=StrictModel)


def validate_data(model: type[Model], data: dict, source: str, lines: dict[tuple, int]) -> Model:
    """Validate data against a subclass of `StrictModel`.

    Args:
        model: the class.
        data: the data, as returned by `read_yaml`.
        source: file name for error messages.
        lines: {key path: line}, as returned by `read_yaml`; may be empty.

    Returns:
        The validated instance.

    Raises:
        InputError: the data are not valid. The message names the file, the line of the first
            problem, and the key path and reason of up to five problems.
    """
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        problems = []
        first_line = None
        for item in error.errors():
            path = tuple(item["loc"])
            line = next((lines[path[:k]] for k in range(len(path), -1, -1) if path[:k] in lines), 0)
            first_line = first_line or line
            message = item["msg"].removeprefix("Value error, ")
            problems.append(f"{'.'.join(map(str, path)) or '(top)'}: {message}")
        where = f"{source}:{first_line}" if first_line else source
        raise InputError(where, "; ".join(problems[:5])) from None


def replace_at_path(model: Model, path: str, value: Any, validate: bool = True) -> Model:
    """Return a copy of a model with the value at a dotted path replaced.

    Args:
        model: the model; it may contain models, mappings and tuples, also nested.
        path: field names, keys of mappings and indices of tuples, joined by dots.
        value: the new value, in SI units.
        validate: check the new value and everything that depends on it.

    Returns:
        The changed copy.

    Raises:
        InputError: the path does not exist (the message lists the valid ones), or the value is not valid.
    """
    try:
        return _replace_in_node(model, path.split("."), "", value, validate)
    except pydantic.ValidationError as error:
        reasons = [item["msg"].removeprefix("Value error, ") for item in error.errors()]
        raise InputError(path, f"cannot be {value!r}: {'; '.join(dict.fromkeys(reasons))}") from None


def _replace_in_node(node: Any, words: list[str], parent: str, value: Any, validate: bool) -> Any:
    """Return a copy of a node of nested data with one value inside it replaced.

    Args:
        node: model, mapping or tuple.
        words: path of the value from the node, split at its dots.
        parent: path of the node, for messages.
        value: the new value.
        validate: check the new value.

    Raises:
        InputError: the path does not exist.
    """
    if not words:
        return value
    children = _children_of_node(node)
    paths = {name: f"{parent}.{name}" if parent else name for name in children}
    # The longest name counts, because a key such as `angle.boom` can contain dots.
    count = next((k for k in range(len(words), 0, -1) if ".".join(words[:k]) in children), 0)
    if not count:
        if not children:
            raise InputError(f"{parent}.{'.'.join(words)}", f"{parent} is {node!r} and has no parts: replace {parent}")
        wrong = f"{parent}.{words[0]}" if parent else words[0]
        raise InputError(wrong, f"does not exist; {suggest_valid_name(wrong, paths.values())}")
    name = ".".join(words[:count])
    child = _replace_in_node(children[name], words[count:], paths[name], value, validate)
    if isinstance(node, dict):
        return {**node, name: child}
    if isinstance(node, tuple):
        return (*node[: int(name)], child, *node[int(name) + 1 :])
    if not validate:
        return node.model_copy(update={name: child})
    given = {field: getattr(node, field) for field in node.model_fields_set}
    return type(node).model_validate({**given, name: child})


def _children_of_node(node: Any) -> dict[str, Any]:
    if isinstance(node, pydantic.BaseModel):
        return {name: getattr(node, name) for name in type(node).model_fields}
    if isinstance(node, tuple):
        return {str(place): item for place, item in enumerate(node)}
    return node if isinstance(node, dict) else {}

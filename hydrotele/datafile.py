"""YAML files into validated frozen facts: units in key names, errors that name file, line and key.

A key may carry its unit as a suffix (`angle_deg`, `area_head_in2`, `relief_pressure_bar`); it is
converted to SI here, at the boundary, and nowhere else.
"""

import difflib
import math
import re
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml

from hydrotele.errors import InputError

PSI = 6894.757293168361  # Pa, exact pound-force and inch

UNIT_SUFFIXES = {
    "_deg": math.pi / 180.0,
    "_mm": 1.0e-3,
    "_in2": 0.0254**2,
    "_psi": PSI,
    "_bar": 1.0e5,
    "_hz": 2.0 * math.pi,
    "_l_min": 1.0e-3 / 60.0,
    "_ms": 1.0e-3,
}
"""Suffix of a key -> factor to SI."""


def to_si(value: Any, factor: float) -> Any:
    """Multiply a number, or every number of nested lists, by a factor; leave the rest alone."""
    if isinstance(value, list):
        return [to_si(item, factor) for item in value]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    return value * factor


def suggest(name: str, valid) -> str:
    """A sentence with the closest valid name, if there is one, and all valid names."""
    close = difflib.get_close_matches(str(name), list(valid), n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}valid: {', '.join(sorted(valid)) or '(none)'}"


class Facts(pydantic.BaseModel):
    """Base of everything read from YAML: frozen, finite, SI, no unknown keys."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _convert_units_and_refuse_unknown_keys(cls, data):
        if not isinstance(data, dict):
            return data
        fields = cls.model_fields
        result: dict[str, Any] = {}
        for key, value in data.items():
            key = str(key)
            suffix = next((s for s in UNIT_SUFFIXES if key.endswith(s)), "")
            stem = key.removesuffix(suffix)
            if key in fields:
                name = key
            elif suffix and stem in fields:
                name, value = stem, to_si(value, UNIT_SUFFIXES[suffix])
            else:
                raise ValueError(f"unknown key {key!r}; {suggest(key, fields)}")
            if name in result:
                raise ValueError(f"{name!r} is given twice, as {key!r} and another unit")
            result[name] = value
        return result


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 28.0e6 as a number, as YAML 1.2 does, and refuses repeated keys."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+$"),
    list("-+0123456789"),
)


def _key_lines(node, path=(), lines=None) -> dict[tuple, int]:
    lines = {} if lines is None else lines
    lines[path] = node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            _key_lines(value, (*path, key.value), lines)
            lines[(*path, key.value)] = key.start_mark.line + 1
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _key_lines(value, (*path, index), lines)
    return lines


def read_yaml(path: str | Path) -> tuple[dict, dict[tuple, int]]:
    """Read a YAML mapping together with the line of every key.

    Args:
        path: the file.

    Returns:
        (data, key path -> line number from 1).

    Raises:
        InputError: the file is missing, not YAML, or not a mapping.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        node = yaml.compose(text, Loader=_Loader)
        data = yaml.load(text, Loader=_Loader)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), f"cannot be read: {error}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise InputError(f"{path}{line}", f"is not valid YAML: {problem}") from None
    if not isinstance(data, dict) or node is None:
        raise InputError(str(path), "must be a mapping of keys to values")
    return data, _key_lines(node)


Model = TypeVar("Model", bound=Facts)


def parse(model: type[Model], data: dict, source: str, lines: dict[tuple, int]) -> Model:
    """Validate data against a Facts class.

    Args:
        model: the class.
        data: what was read.
        source: file name for messages.
        lines: key path -> line, as from `read_yaml`; may be empty.

    Returns:
        The validated instance.

    Raises:
        InputError: names file, line, key path and what is allowed.
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

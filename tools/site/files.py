"""Pages that list every key of the files that hydrotele reads, from the classes that validate them."""

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import BaseModel

from hydrotele.calibrate.hybrid_measurement import MeasurementSpec
from hydrotele.calibrate.scara_calibration import ScaraSpec
from hydrotele.core.datafile import ANGULAR_FREQUENCY_KEYS, MAX_MAGNITUDE
from hydrotele.core.units import KEY_SUFFIXES
from hydrotele.identify.mechanism import ColumnMapping
from hydrotele.kinematics.hybrid_robot import HybridSpec
from hydrotele.kinematics.serial_robot_files import _RobotSpec
from hydrotele.machine.joystick import Joystick
from hydrotele.machine.log_columns import _LogColumnsFile
from hydrotele.machine.machine import Machine
from hydrotele.run.devices import Script
from hydrotele.run.sweep_file import Sweep
from hydrotele.scenario.scenario import Scenario
from hydrotele.teleop.case_file import TeleopCaseFile
from hydrotele.teleop.operator_parameters import Operator, OperatorFile


class FileKind(NamedTuple):
    """A kind of file: the class of its content, its title, its content in a few words, and what it is for.

    `set_by_program` are the keys of the class that a file does not have.
    """

    model: type[BaseModel]
    title: str
    content: str
    purpose: str
    set_by_program: tuple[str, ...] = ()


MODELS: dict[str, type[BaseModel]] = {
    "machine_yaml": Machine,
    "scenario_yaml": Scenario,
    "sweep_yaml": Sweep,
    "teleop_case_yaml": TeleopCaseFile,
    "joystick_yaml": Joystick,
    "operator_yaml": OperatorFile,
    "log_columns_yaml": _LogColumnsFile,
    "columns_yaml": ColumnMapping,
    "device_script_yaml": Script,
    "robot_yaml": _RobotSpec,
    "hybrid_yaml": HybridSpec,
    "measurement_yaml": MeasurementSpec,
    "scara_yaml": ScaraSpec,
}
"""Kind of file -> class of its content."""
TEXTS: dict[str, dict[str, Any]] = yaml.safe_load(Path(__file__).with_name("files.yaml").read_text(encoding="utf-8"))
FILE_KINDS = {name: FileKind(model=model, **TEXTS["files"][name]) for name, model in MODELS.items()}
KEYS: dict[str, dict[str, str]] = TEXTS["keys"]
"""Class name -> key -> its meaning with the unit, where no docstring has it; `any` holds keys of every class."""

SECTION_TEXTS: dict[str, str] = TEXTS["sections"]
"""Class name -> text above its table, which replaces that of the docstring."""

SENTENCE = re.compile(r"(?<=[.:])\s+(?=[A-Z`])")
ATTRIBUTE = re.compile(r"^ {4}(?P<key>\w+): (?P<text>.*(?:\n {8}.*)*)", re.M)
MORE_DOCSTRINGS = {"OperatorSettings": "\n\n" + inspect.cleandoc(Operator.__doc__ or "").partition("\n\n")[2]}
"""Class name -> text that also describes its keys."""
ITEM = re.compile(r"- (?P<names>`\w+`(?:, `\w+`)*)(?P<unit> \[[^\]]*\](?: or \[[^\]]*\])?)?: (?P<text>.*)")
UNIT = r"\[(?P<unit>[^\]\s,][^\],]*)\](?:\s+or\s+\[(?P<other>[^\],]+)\])?"
STATED_UNIT = re.compile(rf"\s*{UNIT.replace('?P<unit>', '').replace('?P<other>', '')}")
NOT_UNITS = ("unit", "low", "values", "mean", "x", "command_unit")


class Key(NamedTuple):
    """One key of a section: its name, unit, type, default, valid values and description (Markdown)."""

    name: str
    unit: str
    type: str
    default: str
    values: str
    description: str


class Section(NamedTuple):
    """A mapping inside a file: class name, key paths, text and keys."""

    name: str
    paths: tuple[str, ...]
    text: str
    keys: tuple[Key, ...]


def read_sections(kind: FileKind) -> list[Section]:
    """Return the sections of a kind of file, outermost first."""
    schema = kind.model.model_json_schema()
    definitions = {**schema.get("$defs", {}), kind.model.__name__: schema}
    paths: dict[str, list[str]] = {kind.model.__name__: [""]}
    waiting = [kind.model.__name__]
    for name in waiting:  # the list grows during the loop
        for key, facts in definitions[name].get("properties", {}).items():
            if name == kind.model.__name__ and key in kind.set_by_program:
                continue
            for path, inner in _find_sections(facts, key):
                if inner == name:
                    continue
                full = f"{paths[name][0]}.{path}" if paths[name][0] else path
                if inner not in paths:
                    paths[inner] = []
                    waiting.append(inner)
                if full not in paths[inner]:
                    paths[inner].append(full)
    skipped = {kind.model.__name__: kind.set_by_program}
    return [_make_section(name, definitions[name], tuple(paths[name]), skipped.get(name, ())) for name in waiting]


def _find_sections(facts: dict[str, Any], path: str) -> Iterator[tuple[str, str]]:
    """Yield (key path, class name) of every class that the value of a key may have."""
    if "$ref" in facts:
        yield path, facts["$ref"].rpartition("/")[2]
    for option in (*facts.get("anyOf", ()), *facts.get("oneOf", ()), *facts.get("allOf", ())):
        yield from _find_sections(option, path)
    if inner := _find_entry(facts):
        yield from _find_sections(inner, f"{path}.NAME")
    if isinstance(facts.get("items"), dict):
        yield from _find_sections(facts["items"], f"{path}[]")
    for option in facts.get("prefixItems", ()):
        yield from _find_sections(option, f"{path}[]")


def _find_entry(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of the entries of a mapping; empty for other values."""
    for entry in (facts.get("additionalProperties"), *facts.get("patternProperties", {}).values()):
        if isinstance(entry, dict):
            return entry
    return {}


def _make_section(name: str, schema: dict[str, Any], paths: tuple[str, ...], skipped: tuple[str, ...]) -> Section:
    text = schema.get("description", "").partition("\nExamples:")[0].strip()
    properties = {key: facts for key, facts in schema.get("properties", {}).items() if key not in skipped}
    itemised = tuple(properties.keys() - KEYS.get(name, {}).keys())
    described, prose = split_docstring(text + MORE_DOCSTRINGS.get(name, ""), (*properties, *skipped), itemised)
    for key, entry in (KEYS.get("any", {}) | KEYS.get(name, {})).items():
        if key in properties and (key not in described or key in KEYS.get(name, {})):
            described[key] = entry
    prose = SECTION_TEXTS.get(name, prose).strip()
    required = schema.get("required", ())
    keys = tuple(
        Key(
            key,
            find_unit(key, described.get(key, ""), text) if _is_numeric(facts) else "",
            _describe_type(facts),
            "" if key in required else _describe_default(facts),
            _describe_values(facts),
            described.get(key, ""),
        )
        for key, facts in properties.items()
    )
    return Section(name, paths, prose, keys)


def split_docstring(text: str, keys: tuple[str, ...], itemised: tuple[str, ...]) -> tuple[dict[str, str], str]:
    """Split a docstring into the meaning of each key, and the remaining text.

    A key is described by its line below `Attributes:`, by its item of a list, or by the sentences that name it in
    backticks and those that follow in the paragraph. The summary is part of the remaining text. `itemised` are the keys
    that items of lists may describe.
    """
    summary, _, rest = text.partition("\n\n")
    described: dict[str, str] = {}
    prose = [" ".join(summary.split())]
    rest, _, attributes = rest.partition("Attributes:\n")
    for match in ATTRIBUTE.finditer(attributes):
        if match["key"] in keys:
            described[match["key"]] = " ".join(match["text"].split())
    for block in re.split(r"\n\s*\n|\n(?=- )", rest):
        words = " ".join(block.split())
        if item := ITEM.fullmatch(words):
            names = [name for name in re.findall(r"`(\w+)`", item["names"]) if name in itemised]
            described |= {name: f"{item['unit'] or ''} {item['text']}".strip() for name in names}
            if names:
                continue
        if words.startswith("- "):
            prose.append(words)
            continue
        mentioned: list[str] = []
        for sentence in filter(None, SENTENCE.split(words)):
            mentioned = [key for key in keys if re.search(rf"`{key}[`:]", sentence)] or mentioned
            for key in mentioned:
                described[key] = f"{described[key]} {sentence}" if key in described else sentence
            if not mentioned:
                prose.append(sentence)
    return described, _join_prose(prose)


def _join_prose(parts: list[str]) -> str:
    """Return sentences and items of lists as Markdown."""
    text = parts[0]
    for before, part in zip(parts, parts[1:], strict=False):
        is_item, was_item = part.startswith("- "), before.startswith("- ")
        text += ("\n\n" if is_item != was_item else "\n") + part
    return text


def find_unit(key: str, meaning: str, text: str) -> str:
    """Return the unit in the meaning of a key, or that behind its name in a docstring; empty without one.

    Several names can share one unit: "`air_head` and `air_rod` [m^3]".
    """
    more = r"(?:(?:,| and|, and)\s+`\w+`)*"
    match = None if f"`{key}`" in meaning else re.search(UNIT, meaning)
    match = match or re.search(rf"`?\b{key}\b`?{more}\s+{UNIT}", " ".join(f"{meaning} {text}".split()))
    if not match or match["unit"] in NOT_UNITS:
        return ""
    return " or ".join(u for u in (match["unit"], match["other"]) if u)


def _title(name: str) -> str:
    """Return the heading of the section of a class."""
    return name.lstrip("_")


def _is_numeric(facts: dict[str, Any]) -> bool:
    text = json.dumps(facts)
    return '"number"' in text


def _describe_type(facts: dict[str, Any]) -> str:
    if "$ref" in facts:
        name = facts["$ref"].rpartition("/")[2]
        return f"[{_title(name)}](#{_title(name).lower()})"
    options = facts.get("anyOf") or facts.get("oneOf") or facts.get("allOf")
    if options:
        names = [_describe_type(option) for option in options if option.get("type") != "null"]
        return " or ".join(dict.fromkeys(names))
    if "const" in facts or "enum" in facts:
        return "choice"
    kind = facts.get("type")
    if kind == "object":
        inner = _find_entry(facts)
        return f"mapping of names to {_describe_type(inner)}" if inner else "mapping"
    if kind == "array":
        if "prefixItems" in facts:
            kinds = [_describe_type(item) for item in facts["prefixItems"]]
            return f"{len(kinds)} {kinds[0]}s" if len(set(kinds)) == 1 else f"list of {', '.join(kinds)}"
        return f"list of {_describe_type(facts.get('items', {}))}"
    names = {"number": "number", "integer": "integer", "boolean": "true or false", "string": "text"}
    return names.get(kind or "", "any value")


def _describe_default(facts: dict[str, Any]) -> str:
    default = facts.get("default")
    if default in (None, [], {}, ""):
        return "none"
    if isinstance(default, float):
        return f"`{default:g}`"
    if isinstance(default, dict):  # the defaults of its keys
        return "none"
    return f"`{json.dumps(default)}`"


def _describe_values(facts: dict[str, Any]) -> str:
    """Return the valid values of a key: choices or limits, empty without any."""
    alternatives = []
    for option in (facts, *facts.get("anyOf", ()), *facts.get("oneOf", ())):
        parts = [f"`{choice}`" for choice in option.get("enum", ())]
        if "const" in option:
            parts.append(f"`{json.dumps(option['const'])}`")
        for name, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤")):
            if name in option and abs(option[name]) < MAX_MAGNITUDE:
                parts.append(f"{sign} {option[name]:g}")
        if "prefixItems" not in option:
            limits = (("minItems", "at least"), ("maxItems", "at most"))
            if option.get("minItems", 0) > 1 and option["minItems"] == option.get("maxItems"):
                limits = (("minItems", "exactly"),)
            for name, words in limits:
                if name in option:
                    parts.append(f"{words} {option[name]} {'entry' if option[name] == 1 else 'entries'}")
        items = option.get("items") or next(iter(option.get("prefixItems", ())), None) or _find_entry(option)
        if items and (inner := _describe_values(items)):
            parts.append(inner if inner.startswith("each ") else f"each {inner}")
        if parts:
            alternatives.append(", ".join(parts))
    return " or ".join(dict.fromkeys(alternatives))


def format_page(kind: FileKind) -> str:
    """Return the page of a kind of file."""
    suffixes = ", ".join(f"`{suffix}`" for suffix in KEY_SUFFIXES)
    parts = [
        f"# {kind.title}",
        kind.purpose.strip(),
        f"Values are in SI units and angles in radians. A key may have a unit as a suffix instead ({suffixes}), such as"
        f" `relief_pressure_bar: 280`; for `{ANGULAR_FREQUENCY_KEYS[0]}` the suffix `_hz` stands for 2π rad/s.",
        "Each row of a table is a key. The column *value* states its type, its unit in brackets, valid values and the"
        " default. Keys without **required** may be omitted. A link leads to the table of the keys inside this value."
        " In the path of a key, `NAME` is a name that you choose, such as that of an axis, and `[]`"
        " stands for an entry of a list.",
    ]
    for section in read_sections(kind):
        outermost = section.paths == ("",)
        parts.append(f"## {'Keys of the file' if outermost else _title(section.name)}")
        if not outermost:
            shown = [f"`{path}`" for path in section.paths[:4]]
            parts.append(f"Value of {', '.join(shown)}{' and others' if len(section.paths) > 4 else ''}.")
        parts.append(section.text)
        rows = ["| key | value | meaning |", "| --- | --- | --- |"]
        for key in section.keys:
            meaning = key.description
            if key.unit and f"`{key.name}`" not in meaning:  # the column of values has the unit
                meaning = STATED_UNIT.sub("", meaning, count=1)
            rows.append(f"| `{key.name}` | {format_value(key)} | {escape(meaning)} |")
        parts.append("\n".join(rows))
    return "\n\n".join(part for part in parts if part) + "\n"


def format_value(key: Key) -> str:
    """Return type, unit, valid values and default of a key as the text of a table cell."""
    unit = f" [{key.unit.replace(' or ', '] or [')}]" if key.unit else ""
    kind = key.values if key.type == "choice" else f"{key.type}{unit}{f', {key.values}' if key.values else ''}"
    default = "" if key.default in ("none", "") else f"; default {key.default}"
    return escape(f"{kind}{default}{'' if key.default else '; **required**'}")


def escape(text: str) -> str:
    """Return a text for a cell of a Markdown table."""
    return text.replace("|", "\\|").strip()


def list_pages() -> dict[str, str]:
    """Return {path of the page: its text} of all kinds of files."""
    return {f"files/{name}.md": format_page(kind).replace("](../", "](../../") for name, kind in FILE_KINDS.items()}

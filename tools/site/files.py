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
    """A kind of file: its title, the class of its content, and what it is for.

    `set_by_program` are the keys of the class that a file does not have.
    """

    title: str
    model: type[BaseModel]
    purpose: str
    set_by_program: tuple[str, ...] = ()


FILE_KINDS = {
    "machine_yaml": FileKind(
        "machine.yaml",
        Machine,
        "`machine.yaml` in the folder of a machine describes its links, drives, pumps and sensors. [Your machine and your logs]"
        "(../bring_your_own.md) shows how to write one; `hydrotele validate FOLDER` checks it.\n\n"
        "A file has two keys that the table below does not list. `extends: {machine: NAME, tool: NAME}` starts from another machine:"
        " the file then contains only the differences. `tools` maps names of tools to sections (`links`, `axes`, `home`, ...) that are"
        " added when the tool is mounted; `tool` is the tool that is mounted by default.",
        ("folder", "removed_bodies"),
    ),
    "scenario_yaml": FileKind(
        "scenario.yaml",
        Scenario,
        "A scenario file describes one simulated run. `hydrotele run FILE.yaml` simulates it; `--set KEY=VALUE` replaces a value."
        " [Simulate](../simulate.md) shows examples.",
        ("folder",),
    ),
    "sweep_yaml": FileKind(
        "Sweep files",
        Sweep,
        "`hydrotele sweep FILE.yaml` runs variations of one scenario. [Simulate](../simulate.md) shows examples.",
    ),
    "teleop_case_yaml": FileKind(
        "Teleoperation cases",
        TeleopCaseFile,
        "`hydrotele analyse teleop FILE.yaml` analyses a linear teleoperator that such a file describes."
        " [Teleoperate](../teleoperate.md) explains the analysis.",
    ),
    "joystick_yaml": FileKind(
        "joystick.yaml",
        Joystick,
        "A joystick file describes a magnetically levitated joystick: workspace, coils, sensing and gains. A teleoperated scenario"
        " names it in `pilot.joystick`.",
        ("folder",),
    ),
    "operator_yaml": FileKind(
        "Operator files",
        OperatorFile,
        "Parameters of the simulated operator. `hydrotele identify-operator` writes such a file, and a scenario names it in"
        " `pilot.perception.file`.",
    ),
    "log_columns_yaml": FileKind(
        "log_columns.yaml",
        _LogColumnsFile,
        "The file maps columns of foreign logs, or fields of messages, to channels. It lies in the folder of the logs or is given with"
        " `hydrotele import --mapping FILE`; a machine file may have the same key. [Logs](../logs.md) describes the formats.\n\n"
        "An entry is a text (`angle.boom`, `-command.boom` for the opposite sign, `angle.boom [deg]` with the unit, `none` to skip the"
        " column) or a mapping with the keys below. The value of the channel is `sign * scale * (column - minus) + offset`.",
    ),
    "columns_yaml": FileKind(
        "columns.yaml",
        ColumnMapping,
        "The file maps log columns to joints and drives of an MJCF mechanism, for `hydrotele gap --mjcf` and `hydrotele identify --mjcf`."
        " [Any mechanism](../any_mechanism.md) shows an example.",
    ),
    "device_script_yaml": FileKind(
        "Device scripts",
        Script,
        "`hydrotele drive --device scripted:FILE.yaml` moves the joystick as the file states, without a person.",
    ),
    "robot_yaml": FileKind(
        "robot.yaml",
        _RobotSpec,
        "The nominal geometry of a serial robot for `hydrotele calibrate mukca`. [Calibrate](../calibration.md) shows an example.",
    ),
    "hybrid_yaml": FileKind(
        "Serial-parallel robots",
        HybridSpec,
        "The geometry of a serial-parallel robot for `hydrotele calibrate hybrid`. [Calibrating a serial-parallel robot]"
        "(../hybrid_calibration.md) shows an example.",
    ),
    "measurement_yaml": FileKind(
        "measurement.yaml",
        MeasurementSpec,
        "What was measured in a calibration of a serial-parallel robot, for `hydrotele calibrate hybrid`.",
    ),
    "scara_yaml": FileKind(
        "SCARA robots",
        ScaraSpec,
        "The nominal geometry of a SCARA robot for `hydrotele calibrate scara`.",
    ),
}

SENTENCE = re.compile(r"(?<=[.:])\s+(?=[A-Z`])")
ATTRIBUTE = re.compile(r"^ {4}(?P<key>\w+): (?P<text>.*(?:\n {8}.*)*)", re.M)
KEYS: dict[str, dict[str, str]] = yaml.safe_load(Path(__file__).with_name("keys.yaml").read_text(encoding="utf-8"))
"""Class name -> key -> meaning with its unit, for keys that no docstring describes; `any` holds those of every class."""
MORE_DOCSTRINGS = {"OperatorSettings": "\n\n" + inspect.cleandoc(Operator.__doc__ or "").partition("\n\n")[2]}
"""Class name -> text that also describes its keys."""
UNIT = r"\[(?P<unit>[^\]\s,][^\],]*)\](?:\s+or\s+\[(?P<other>[^\],]+)\])?"
STATED_UNIT = re.compile(rf"\s*{UNIT.replace('?P<unit>', '').replace('?P<other>', '')}")
NOT_UNITS = ("low", "values", "mean", "x", "command_unit")


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
    text = schema.get("description", "").strip()
    properties = {key: facts for key, facts in schema.get("properties", {}).items() if key not in skipped}
    described, prose = split_docstring(text + MORE_DOCSTRINGS.get(name, ""), tuple(properties))
    for key, entry in (KEYS.get("any", {}) | KEYS.get(name, {})).items():
        if key in properties and (key not in described or key in KEYS.get(name, {})):
            described[key] = entry
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


def split_docstring(text: str, keys: tuple[str, ...]) -> tuple[dict[str, str], str]:
    """Split a docstring into the meaning of each key, and the remaining text.

    A key is described by its line below `Attributes:`, by its item of a list, or by the sentences that name it in
    backticks. The summary is part of the remaining text.
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
        names, colon, meaning = words.removeprefix("- ").partition(":")
        if words.startswith("- ") and colon and any(f"`{key}`" in names for key in keys):
            for key in keys:
                if f"`{key}`" in names:
                    unit = re.search(r"\[.*", names)
                    described.setdefault(key, f"{unit[0] + ' ' if unit else ''}{meaning.strip()}")
            continue
        if words.startswith("- "):
            prose.append("\n" + words)
            continue
        for sentence in filter(None, SENTENCE.split(words)):
            mentioned = [key for key in keys if re.search(rf"`{key}[`:]", sentence)]
            for key in mentioned:
                described[key] = f"{described[key]} {sentence}" if key in described else sentence
            if not mentioned:
                prose.append(sentence)
    return described, "\n".join(prose)


def find_unit(key: str, meaning: str, text: str) -> str:
    """Return the unit that the meaning of a key contains, or that a docstring states behind its name; empty without one.

    Several names can share one unit: "`air_head` and `air_rod` [m^3]".
    """
    more = r"(?:(?:,| and|, and)\s+`\w+`)*"
    match = None if f"`{key}`" in meaning else re.search(UNIT, meaning)
    match = match or re.search(rf"`?\b{key}\b`?{more}\s+{UNIT}", " ".join(f"{meaning} {text}".split()))
    if not match or match["unit"] in NOT_UNITS:
        return ""
    return " or ".join(u for u in (match["unit"], match["other"]) if u)


def _is_numeric(facts: dict[str, Any]) -> bool:
    text = json.dumps(facts)
    return '"number"' in text


def _describe_type(facts: dict[str, Any]) -> str:
    if "$ref" in facts:
        name = facts["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
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
    if isinstance(default, dict) and default:
        return "its defaults"
    return f"`{json.dumps(default)}`"


def _describe_values(facts: dict[str, Any]) -> str:
    """Return the valid values of a key: choices or limits, empty without any."""
    parts = []
    for option in (facts, *facts.get("anyOf", ()), *facts.get("oneOf", ())):
        if "const" in option:
            parts.append(f"`{json.dumps(option['const'])}`")
        parts += [f"`{json.dumps(value)}`".replace('"', "") for value in option.get("enum", ())]
        limits = []
        for name, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤")):
            if name in option and abs(option[name]) < MAX_MAGNITUDE:
                limits.append(f"{sign} {option[name]:g}")
        if limits:
            parts.append(", ".join(limits))
        for name, words in (("minItems", "at least"), ("maxItems", "at most")):
            if name in option and "prefixItems" not in option:
                parts.append(f"{words} {option[name]} entries")
        item = option.get("items") or _find_entry(option)
        if item and (inner := _describe_values(item)):
            parts.append(f"each {inner}")
        firsts = option.get("prefixItems", ())
        if firsts and (inner := _describe_values(firsts[0])):
            parts.append(f"each {inner}")
    return " or ".join(dict.fromkeys(parts))


def format_page(kind: FileKind) -> str:
    """Return the page of a kind of file."""
    suffixes = ", ".join(f"`{suffix}`" for suffix in KEY_SUFFIXES)
    parts = [
        f"# {kind.title}",
        kind.purpose,
        f"Values are in SI units and angles in radians. A key may have a unit as a suffix instead ({suffixes}), such as"
        f" `relief_pressure_bar: 280`; for `{ANGULAR_FREQUENCY_KEYS[0]}` the suffix `_hz` stands for 2π rad/s.",
    ]
    for section in read_sections(kind):
        outermost = section.paths == ("",)
        parts.append(f"## {'Keys of the file' if outermost else section.name}")
        if not outermost:
            shown = [f"`{path}`" for path in section.paths[:4]]
            parts.append(f"At {', '.join(shown)}{' and others' if len(section.paths) > 4 else ''}.")
        parts.append(section.text)
        rows = ["| key | value | meaning |", "| --- | --- | --- |"]
        for key in section.keys:
            meaning = key.description if f"`{key.name}`" in key.description else STATED_UNIT.sub("", key.description)
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

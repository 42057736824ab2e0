"""Propose a mapping of the columns of a recording to channels, from names, units and ranges of values.

Each proposed line has a confidence: the mean of three parts, for the axis, the kind of channel and the
unit. A part is 1 if the name or the file states it, and 0.5 if it is estimated. Columns that are not
recognised, and those whose channel another column has with a higher confidence, are written as comments.
"""

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.units import UNITS, canonical_unit, si_unit_and_factor
from hydrotele.importers.readers import read_recording
from hydrotele.importers.recordings import Recording
from hydrotele.machine.log_channels import allowed_channel_units, parse_channel
from hydrotele.machine.machine import Machine

AXIS_NAMES: Mapping[str, tuple[str, ...]] = {
    "swing": ("swing", "slew", "slewing", "turret", "house", "rotation", "upper", "upperstructure", "cab"),
    "boom": ("boom", "lift", "ausleger"),
    "stick": ("stick", "arm", "dipper", "jib", "stiel"),
    "bucket": ("bucket", "bkt", "tool", "loeffel"),
    "tilt": ("tilt",),
    "head": ("head",),
}
"""Axis -> words that mean it; words of a machine's own axis names have precedence."""

_KIND_WORDS: tuple[tuple[str, frozenset[str]], ...] = (
    (
        "command",
        frozenset({"command", "cmd", "commands", "joystick", "js", "lever", "valve", "input", "control", "pilot"}),
    ),
    ("pressure", frozenset({"pressure", "press", "p", "druck", "fluid"})),
    ("length", frozenset({"length", "stroke", "extension", "piston", "cylinder", "cyl", "len"})),
    ("velocity", frozenset({"velocity", "vel", "speed", "rate"})),
    ("torque", frozenset({"effort", "torque"})),
    ("force", frozenset({"force"})),
    ("angle", frozenset({"angle", "position", "pos", "ang", "joint", "theta", "q", "winkel", "encoder", "resolver"})),
)
_SUPPLY_WORDS = frozenset({"supply", "pump", "system", "main", "versorgung", "pumpe"})
_HEAD_WORDS = frozenset({"head", "bottom", "bore", "cap", "base", "piston", "a", "large", "kolben", "blind"})
_ROD_WORDS = frozenset({"rod", "ring", "annulus", "b", "small", "stange"})
_OPPOSITE_WORDS = (("up", "down"), ("raise", "lower"), ("in", "out"), ("retract", "extend"), ("left", "right"),
                   ("curl", "dump"), ("close", "open"), ("a", "b"), ("pos", "neg"), ("plus", "minus"),
                   ("1", "2"))  # fmt: skip
_UNIT_WORDS: Mapping[str, str] = {
    **{unit.lower(): unit for unit in UNITS if unit.isalpha()}, "degree": "deg", "degrees": "deg", "percent": "%",
    "pct": "%", "rad": "rad", "pa": "Pa", "v": "V", "volt": "V", "ma": "mA",
}  # fmt: skip
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")


class Proposal(NamedTuple):
    """Proposed entry of a mapping.

    Attributes:
        column: column of the recording.
        channel: proposed channel, None if the column is not recognised.
        unit: proposed unit, None if the file states it or it is SI.
        minus: column to subtract, None without one.
        confidence: 0 to 1.
        reason: reason for the confidence, and range of the values.
    """

    column: str
    channel: str | None
    unit: str | None
    minus: str | None
    confidence: float
    reason: str


def propose_mapping(path: Path, machine: Machine | None = None) -> list[Proposal]:
    """Propose an entry for each column of a recording; `machine` gives the names of the axes.

    Raises:
        InputError: the recording cannot be read.
    """
    recording = read_recording(path, None, {})
    proposals = [_propose(*column, machine) for column in _list_columns(recording)]
    return _resolve_conflicts(_pair_one_sided_columns(proposals))


def format_mapping(proposals: Sequence[Proposal], source: str) -> str:
    """Return proposals as a YAML file with the key `log_columns` and the confidence of each line as a comment."""
    lines = [f"# Proposed mapping for {source}. Check each line; the number is its confidence, 0 to 1.", "log_columns:"]
    recognised = [p for p in proposals if p.channel and p.confidence > 0.0]
    for proposal in recognised:
        entry = {"channel": proposal.channel, "unit": proposal.unit, "minus": proposal.minus}
        stated = ", ".join(f"{key}: {_quote(str(value))}" for key, value in entry.items() if value)
        lines.append(f"  {_quote(proposal.column)}: {{{stated}}}  # {proposal.confidence:.2f} {proposal.reason}")
    if not recognised:
        lines[-1] += " {}"
    for proposal in proposals:
        if proposal not in recognised:
            lines.append(f"  # {_quote(proposal.column)}: {proposal.channel or 'none'}  # {proposal.reason}")
    return "\n".join(lines) + "\n"


def _quote(text: str) -> str:
    return text if re.fullmatch(r"[A-Za-z/][\w./]*", text) else json.dumps(text, ensure_ascii=False)


def _list_columns(recording: Recording) -> Iterator[tuple[str, str, str | None, float, float]]:
    """Yield (column, type of its messages, unit, minimum, maximum) of the columns of a recording."""
    for group in recording.groups:
        for name, values in group.columns.items():
            known = values[np.isfinite(values)]
            if len(known):
                yield name, group.type, group.units.get(name), float(known.min()), float(known.max())


def _split_words(text: str) -> list[str]:
    return [word.lower() for word in _WORD.findall(text.replace("_", " "))]


def _propose(column: str, kind: str, unit: str | None, low: float, high: float, machine: Machine | None) -> Proposal:
    span = f"range {low:.4g} .. {high:.4g}"
    try:
        channel = parse_channel(column).name
        return Proposal(column, channel, None, None, 1.0, f"is named like a channel, {span}")
    except ValueError:
        words = _split_words(column)
    if "truth" in words:
        return Proposal(column, None, None, None, 0.0, f"is not measured, {span}")
    found, sure_kind = _find_kind(words, kind, unit)
    axis, sure_axis = _find_axis(words, machine)
    if not found or (not axis and found != "pressure_supply"):
        missing = "kind of channel" if not found else "axis"
        return Proposal(column, None, None, None, 0.0, f"{missing} not recognised, {span}")
    if found == "angle" and machine and axis in machine.axes:
        found = machine.position_kind(axis)
    pump = next((name for name in (machine.supplies if machine else ()) if name in words), "")
    channel = f"{found}.{pump if found == 'pressure_supply' else axis}".removesuffix(".")
    stated, sure_unit, why = _find_unit(channel, words, kind, unit, low, high)
    parts = [sure_kind, sure_unit] if found == "pressure_supply" else [sure_axis, sure_kind, sure_unit]
    estimated = [name for name, sure in (("axis", sure_axis), ("kind", sure_kind)) if 0.0 < sure < 1.0]
    reason = ", ".join([*(f"{name} estimated" for name in estimated), why, span])
    return Proposal(column, channel, stated, None, sum(parts) / len(parts), reason)


def _find_kind(words: Sequence[str], kind: str, unit: str | None) -> tuple[str | None, float]:
    """Return the kind of channel that a column means, and 1 if its words state it, 0.5 if it is estimated.

    Args:
        words: words of the name.
        kind: type of the messages, empty without one.
        unit: unit that the file states, None without one.
    """
    present = set(words)
    units = {si_unit_and_factor(text)[0] for text in (*(_UNIT_WORDS.get(word, "") for word in words), unit or "")}
    if kind.endswith("FluidPressure") or "Pa" in units:
        present.add("pressure")
    guess = "angle" if "rad" in units else "command" if unit == "%" else None
    found = next((name for name, known in _KIND_WORDS if known & present), guess)
    if found == "command" and "pressure" in present and "pilot" not in present:
        found = "pressure"
    if found != "pressure":
        unsure = found in ("angle", "command") and not {"angle", "position", "command", "cmd"} & present
        return found, 0.5 if unsure else 1.0
    if present & (_SUPPLY_WORDS - {"main"}):
        return "pressure_supply", 1.0
    for side, known in (("pressure_rod", _ROD_WORDS), ("pressure_head", _HEAD_WORDS)):
        if known & present:
            return side, 1.0 if len(max(known & present, key=len)) > 1 else 0.5
    return ("pressure_supply", 0.5) if present & _SUPPLY_WORDS else (None, 0.0)


def _find_axis(words: Sequence[str], machine: Machine | None) -> tuple[str, float]:
    """Return the axis that the words of a column mean ("" if none), and 1 if they state it, 0.5 if it is estimated."""
    names = list(machine.axes) if machine else list(AXIS_NAMES)
    joints = {name: machine.axes[name].joint for name in names} if machine else {}
    text = "_".join(words)
    for name in sorted(names, key=len, reverse=True):
        if re.search(rf"(^|_)({re.escape(name)}|{re.escape(joints.get(name, name))})(_|$)", text):
            return name, 1.0
    for name in names:
        own = {*_split_words(name), *_split_words(joints.get(name, ""))}
        alike = {word for known in AXIS_NAMES.values() if own & set(known) for word in known}
        if alike & set(words):
            return name, 1.0
    for word in words:
        if len(word) > 3 and (near := difflib.get_close_matches(word, names, n=1, cutoff=0.8)):
            return near[0], 0.5
    if machine and len(names) == 1:
        return names[0], 0.5
    return "", 0.0


def _find_unit(
    channel: str, words: Sequence[str], kind: str, unit: str | None, low: float, high: float
) -> tuple[str | None, float, str]:
    """Return (unit to state, 1 if it is stated or 0.5 if the range suggests it, reason)."""
    allowed, size = allowed_channel_units(channel), max(abs(low), abs(high))
    if unit and si_unit_and_factor(unit)[0] in allowed:
        return None, 1.0, "unit stated by the file"
    for word in reversed(words):
        if (named := _UNIT_WORDS.get(word)) and si_unit_and_factor(named)[0] in (*allowed, "A"):
            return canonical_unit(named), 1.0, "unit in the name"
    if kind.startswith("sensor_msgs/") and (allowed[0] != "rad" or size <= 4 * np.pi):
        return None, 1.0, "SI by the type of the messages"
    if "Pa" in allowed:
        likely = "Pa" if size > 2e4 else "psi" if size > 1e3 else "bar" if size > 60.0 else "MPa"
        return likely, 0.5, "unit estimated from the range"
    if allowed[0] == "rad":
        return ("deg" if size > 4 * np.pi else "rad"), 0.5, "unit estimated from the range"
    if allowed[0] == "m":
        return ("mm" if size > 10.0 else "m"), 0.5, "unit estimated from the range"
    if channel.startswith("command."):
        likely = "1" if size <= 1.001 else "mA" if low >= 3.5 and high <= 21.0 else "V" if size <= 10.0 else "%"
        return likely, 0.5, "unit estimated from the range"
    return None, 0.5, "unit taken as SI"


def _pair_one_sided_columns(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Join two commands of one axis whose names differ in words for opposite directions, such as up and down."""
    result = list(proposals)
    for first in proposals:
        for second in proposals:
            if first.channel != second.channel or not (first.channel or "").startswith("command."):
                continue
            one, two = _split_words(first.column), _split_words(second.column)
            differing = [(a, b) for a, b in zip(one, two, strict=False) if a != b]
            if len(one) == len(two) and len(differing) == 1 and differing[0] in _OPPOSITE_WORDS:
                result.remove(second)
                joined = first._replace(minus=second.column, confidence=min(first.confidence, 0.5))
                result[result.index(first)] = joined._replace(reason=f"sign estimated, {first.reason}")
    return result


def _resolve_conflicts(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Set the confidence of a proposal to 0 if another one has the same channel and a confidence as high."""
    best: dict[str, Proposal] = {}
    for proposal in proposals:
        if proposal.channel and (
            proposal.channel not in best or proposal.confidence > best[proposal.channel].confidence
        ):
            best[proposal.channel] = proposal
    return [
        p if p.channel is None or best[p.channel] is p
        else p._replace(confidence=0.0, reason=f"{best[p.channel].column} may be the same channel, {p.reason}")
        for p in proposals
    ]  # fmt: skip

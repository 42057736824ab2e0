"""Channel names, their units and their shapes.

A channel is `kind.axis` (`angle.boom`) or a bare `kind` (`time`, `pressure_supply`); what only a
simulator can know starts with `truth.` (`truth.flow_head.boom`). Axis names are free lower-case
identifiers. Every channel holds one float64 per row: shape (n,), in a SI unit that its kind allows.
"""

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

_AXIS = re.compile(r"[a-z][a-z0-9_]*")
_TRUTH = "truth."


class Kind(NamedTuple):
    """What a channel of one kind holds.

    Attributes:
        units: allowed SI units, the usual one first.
        description: what it means.
        axes: "free" for `kind.axis` with any axis name, "xyz" for `kind.x`, `.y` and `.z`, "none"
            for a bare name.
    """

    units: tuple[str, ...]
    description: str
    axes: str = "free"


class Channel(NamedTuple):
    """A parsed channel name; `axis` is "" for a bare channel."""

    kind: str
    axis: str
    truth: bool

    @property
    def name(self) -> str:
        """The name as it stands in a log."""
        return channel_name(self.kind, self.axis, truth=self.truth)


MEASURED: Mapping[str, Kind] = {
    "time": Kind(("s",), "time of the row", "none"),
    "command": Kind(("1", "V", "N"), "valve command in [-1, 1], drive voltage or force"),
    "valid": Kind(("1",), "1 where the row may be used, 0 in contact or where it may not", "none"),
    "reference": Kind(("rad", "m"), "what the controller was asked for"),
    "handle": Kind(("m", "rad"), "displacement of the joystick's handle"),
    "hand_force": Kind(("N", "N m"), "estimated force of the hand on the handle"),
    "handle_force": Kind(("N", "N m"), "force of the coils on the handle, weight taken off"),
    "handle_stiffness": Kind(("N/m", "N m/rad"), "stiffness of the joystick's axis"),
    "coil_current": Kind(("A",), "current of a coil of the joystick"),
    "tip_force": Kind(("N", "N m"), "estimated force of the environment on the tip"),
    "tip_pose": Kind(("m", "rad"), "pose of the tip from the measured joints"),
    "tip_reference": Kind(("m", "rad"), "pose of the tip that was asked for"),
    "angle": Kind(("rad",), "joint angle, not wrapped"),
    "position": Kind(("m",), "displacement of a prismatic joint"),
    "length": Kind(("m",), "piston displacement of a cylinder"),
    "velocity": Kind(("rad/s", "m/s"), "joint velocity"),
    "torque": Kind(("N m",), "joint torque"),
    "force": Kind(("N",), "force along a prismatic joint"),
    "pressure_head": Kind(("Pa",), "head side chamber, or port A of a motor"),
    "pressure_rod": Kind(("Pa",), "rod side chamber, or port B of a motor"),
    "pressure_supply": Kind(("Pa",), "pump or supply pressure", "none"),
    "speed": Kind(("rad/s",), "speed of a pump, with the sign of the side that it feeds"),
    "speed_reference": Kind(("rad/s",), "pump speed that the controller was asked for"),
    "current": Kind(("A", "1"), "motor current, or the count of a converter without calibration"),
}

TRUTH: Mapping[str, Kind] = {
    **{k: MEASURED[k] for k in ("angle", "position", "length", "velocity", "torque")},
    **{k: MEASURED[k] for k in ("pressure_head", "pressure_rod", "pressure_supply")},
    "acceleration": Kind(("rad/s^2", "m/s^2"), "joint acceleration"),
    "speed": MEASURED["speed"],
    "pressure_load": Kind(("Pa",), "pressure in the load cylinder of an axis"),
    "spool": Kind(("1",), "spool position over its stroke"),
    "spool_rate": Kind(("1/s",), "spool speed over the spool's stroke"),
    "bristle": Kind(("1",), "part of a drive's breakaway force that friction holds it with"),
    "delivery": Kind(("1",), "part of its largest flow that the pump is set to", "none"),
    "added_delivery": Kind(("1",), "part of its largest flow that terms add to a pump's", "none"),
    "memory": Kind(("1",), "what a term remembers: played variable over half width, or 0 to 1"),
    "flow_head": Kind(("m^3/s",), "valve flow into the head side chamber"),
    "flow_rod": Kind(("m^3/s",), "valve flow into the rod side chamber"),
    "flow_supply": Kind(("m^3/s",), "pump flow", "none"),
    "force": Kind(("N", "N m"), "piston force or motor torque after friction"),
    "piston_velocity": Kind(("m/s",), "velocity of the piston in its tube"),
    "contact_force": Kind(("N",), "contact force on the tool, base frame", "xyz"),
    "object_contact": Kind(("N",), "contact force of a plate, tree, stump or log on the machine"),
    "tip": Kind(("m",), "position of the tool tip, base frame", "xyz"),
}


class Limits(NamedTuple):
    """Bounds on a channel's largest magnitude over a run, and the unit that lies behind others."""

    smallest: float
    largest: float
    looks_like: str


# SI unit -> (limits where the file states the unit, limits where it states none).
_LIMITS: Mapping[str, tuple[Limits, Limits]] = {
    unit: (Limits(low, high, looks), Limits(low_unstated, high_unstated, looks))
    for unit, low, low_unstated, high, high_unstated, looks in (
        ("rad", 0.0, 0.0, 1.0e4, 4 * math.pi, "degrees"),
        ("rad/s", 0.0, 0.0, 100.0, 4 * math.pi, "degrees per second"),
        ("m", 0.0, 0.0, 50.0, 10.0, "millimetres"),
        ("m/s", 0.0, 0.0, 50.0, 10.0, "millimetres per second"),
        ("Pa", 1e4, 1e5, math.inf, math.inf, "bar, MPa, kPa or psi"),
    )
}
_NO_LIMITS = Limits(0.0, math.inf, "")
# Real loggers overshoot 1 by a float32 rounding or a few counts.
_COMMAND_LIMITS = Limits(0.0, 1.0 + 1e-3, "percent, counts or volts")


def magnitude_limits(name: str, unit: str, *, stated: bool = True) -> Limits:
    """Return what the largest magnitude of a channel [unit] must lie between, or the unit is wrong.

    The bounds are wide where the file states the unit, narrower where it does not.

    >>> magnitude_limits("angle.boom", "rad").looks_like
    'degrees'
    """
    if unit == "1" and name.startswith("command."):
        return _COMMAND_LIMITS
    if name.startswith(("speed.", "speed_reference.", "truth.speed.")):
        return _NO_LIMITS  # a pump turns faster than any joint
    return _LIMITS.get(unit, (_NO_LIMITS, _NO_LIMITS))[0 if stated else 1]


def channel_name(kind: str, axis: str = "", *, truth: bool = False) -> str:
    """Return the channel's name.

    >>> channel_name("flow_head", "boom", truth=True)
    'truth.flow_head.boom'
    """
    return (_TRUTH if truth else "") + (f"{kind}.{axis}" if axis else kind)


def channel_names(kind: str, axes: Iterable[str], *, truth: bool = False) -> tuple[str, ...]:
    """Return one name per axis, in the order of `axes`."""
    return tuple(channel_name(kind, axis, truth=truth) for axis in axes)


def valid_kinds() -> tuple[str, ...]:
    """Return every form that a channel name can take, such as `angle.<axis>`, measured first."""
    endings = {"free": ".<axis>", "xyz": ".x|y|z", "none": ""}
    measured = [kind + endings[spec.axes] for kind, spec in MEASURED.items()]
    return tuple(measured + [_TRUTH + kind + endings[spec.axes] for kind, spec in TRUTH.items()])


def parse_channel(name: str) -> Channel:
    """Split a channel name.

    >>> parse_channel("truth.force.boom")
    Channel(kind='force', axis='boom', truth=True)

    Raises:
        ValueError: the kind is unknown, or the axis is missing, superfluous or misspelt; the
            message gives the nearest valid names.
    """
    truth = name.startswith(_TRUTH)
    kind, dot, axis = name.removeprefix(_TRUTH).partition(".")
    spec = (TRUTH if truth else MEASURED).get(kind)
    if spec is None:
        raise ValueError(_unknown(name))
    if spec.axes == "none" and dot:
        raise ValueError(f"{kind} has no axis: write {channel_name(kind, truth=truth)}")
    if spec.axes == "free" and not _AXIS.fullmatch(axis):
        example = channel_name(kind, "boom", truth=truth)
        raise ValueError(f"{kind} needs an axis in lower case, such as {example}, got {name!r}")
    if spec.axes == "xyz" and axis not in ("x", "y", "z"):
        raise ValueError(f"{kind} has the components x, y and z, got {name!r}")
    return Channel(kind, axis, truth)


def allowed_units(name: str) -> tuple[str, ...]:
    """Return the SI units that the channel `name` may have, the usual one first.

    >>> allowed_units("reference.boom")
    ('rad', 'm')

    Raises:
        ValueError: as `parse_channel`.
    """
    channel = parse_channel(name)
    return (TRUTH if channel.truth else MEASURED)[channel.kind].units


def usual_unit(name: str, present: Iterable[str] = ()) -> str:
    """Return the unit to assume where a file states none.

    A kind that can be rotary or linear takes the linear unit where the log has a `position` of the
    same axis.

    >>> usual_unit("reference.slide", present=["position.slide"])
    'm'

    Raises:
        ValueError: as `parse_channel`.
    """
    units = allowed_units(name)
    position = channel_name("position", parse_channel(name).axis)
    linear = units[0].startswith("rad") and not {position, _TRUTH + position}.isdisjoint(present)
    return units[-1] if linear else units[0]


def close_matches(name: str, present: Iterable[str] = ()) -> list[str]:
    """Return up to three valid channel names near `name`, nearest first.

    `present` adds names that are known to be in use.

    >>> close_matches("angel.boom")[0]
    'angle.boom'
    """
    plain = re.sub(r"[^a-z0-9_.]+", "_", name.strip().lower())
    truth = plain.startswith(_TRUTH)
    kinds = TRUTH if truth else MEASURED
    words = [word for word in plain.removeprefix(_TRUTH).split(".") if _AXIS.fullmatch(word)]
    if len(words) == 2 and words[1] in kinds and words[0] not in kinds:  # boom.angle
        return [channel_name(words[1], words[0], truth=truth)]
    for kind in kinds:  # angle_boom
        if len(words) == 1 and kinds[kind].axes == "free" and words[0].startswith(kind + "_"):
            return [channel_name(kind, words[0].removeprefix(kind + "_"), truth=truth)]
    candidates = list(present)
    for kind, spec in kinds.items():
        axes = {"free": words or ["boom"], "xyz": ["x", "y", "z"], "none": [""]}[spec.axes]
        candidates += channel_names(kind, axes, truth=truth)
    return difflib.get_close_matches(plain, dict.fromkeys(candidates), n=3, cutoff=0.6)


def _unknown(name: str) -> str:
    near = close_matches(name)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    return f"unknown channel {name!r}; {hint}Valid: {', '.join(valid_kinds())}"

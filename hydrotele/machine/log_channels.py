"""Channel names of logs and their units.

A channel name is `kind.axis` (`angle.boom`) or a bare `kind` (`time`, `pressure_supply`). With
several pumps the pressure of each has its name (`pressure_supply.front`). Channels
that only a simulator knows start with `truth.` (`truth.flow_head.boom`). Axis names are arbitrary
lower-case identifiers. Every channel has one float64 per row, shape (n,), in a SI unit of its kind.
"""

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

_AXIS_PATTERN = re.compile(r"[a-z][a-z0-9_]*")
_TRUTH_PREFIX = "truth."
_TIME_NAME = re.compile(r"t|t_?s|time.*|.*_time|.*stamp.*|zeit.*|(seconds?|secs?)")  # names of time columns in loggers


class ChannelKind(NamedTuple):
    """Definition of one kind of channel.

    Attributes:
        units: allowed SI units, the usual one first.
        description: meaning of the values.
        axes: "free" for `kind.axis` with any axis name, "xyz" for `kind.x`, `.y` and `.z`, "none"
            for a bare name, "optional" for a bare name or `kind.pump` with the name of a pump.
    """

    units: tuple[str, ...]
    description: str
    axes: str = "free"


class Channel(NamedTuple):
    """A parsed channel name: `truth` is whether it starts with `truth.`, `axis` is "" without an axis."""

    kind: str
    axis: str
    truth: bool

    @property
    def name(self) -> str:
        """Name of the channel in a log."""
        return channel_name(self.kind, self.axis, truth=self.truth)


MEASURED_KINDS: Mapping[str, ChannelKind] = {
    "time": ChannelKind(("s",), "time of the row", "none"),
    "command": ChannelKind(("1", "V", "N"), "valve command in [-1, 1], drive voltage or force"),
    "valid": ChannelKind(
        ("1",), "1 if the row may be used; 0 where the tool is in contact or the row is masked", "none"
    ),
    "reference": ChannelKind(("rad", "m"), "position reference of the controller"),
    "handle": ChannelKind(("m", "rad"), "displacement of the joystick's handle"),
    "hand_force": ChannelKind(("N", "N m"), "estimated force of the hand on the handle"),
    "handle_force": ChannelKind(
        ("N", "N m"), "force of the coils on the handle, without the part that carries its weight"
    ),
    "handle_stiffness": ChannelKind(("N/m", "N m/rad"), "stiffness of the joystick's axis"),
    "coil_current": ChannelKind(("A",), "current of a coil of the joystick"),
    "tip_force": ChannelKind(("N", "N m"), "estimated force of the environment on the tip"),
    "tip_force_std": ChannelKind(("N", "N m"), "standard deviation of the estimated tip force"),
    "contact": ChannelKind(("1",), "probability of contact between tool and environment", "none"),
    "load": ChannelKind(("kg",), "estimated mass of the load on the tool", "none"),
    "load_std": ChannelKind(("kg",), "standard deviation of the estimated load", "none"),
    "tip_pose": ChannelKind(("m", "rad"), "pose of the tip from the measured joints"),
    "tip_reference": ChannelKind(("m", "rad"), "reference pose of the tip"),
    "angle": ChannelKind(("rad",), "joint angle, not wrapped"),
    "position": ChannelKind(("m",), "displacement of a prismatic joint"),
    "length": ChannelKind(("m",), "piston displacement of a cylinder"),
    "velocity": ChannelKind(("rad/s", "m/s"), "joint velocity"),
    "torque": ChannelKind(("N m",), "joint torque"),
    "force": ChannelKind(("N",), "force along a prismatic joint"),
    "pressure_head": ChannelKind(("Pa",), "head side chamber, or port A of a motor"),
    "pressure_rod": ChannelKind(("Pa",), "rod side chamber, or port B of a motor"),
    "pressure_supply": ChannelKind(("Pa",), "pump or supply pressure", "optional"),
    "pressure_ls": ChannelKind(("Pa",), "load-sensing pressure: the highest pressure of a fed chamber", "none"),
    "pilot_pressure_a": ChannelKind(("Pa",), "pilot pressure for positive commands of an axis"),
    "pilot_pressure_b": ChannelKind(("Pa",), "pilot pressure for negative commands of an axis"),
    "flow": ChannelKind(("m^3/s",), "measured flow into the head side or port A of an axis"),
    "oil_temperature": ChannelKind(("degC",), "temperature of the oil in the tank", "none"),
    "engine_speed": ChannelKind(("rad/s",), "speed of the engine that drives the pumps", "none"),
    **{f"gyro_{c}": ChannelKind(("rad/s",), f"angular rate about the {c} axis of a sensor") for c in "xyz"},
    **{f"accelerometer_{c}": ChannelKind(("m/s^2",), f"specific force along the {c} axis of a sensor") for c in "xyz"},
    "inclination": ChannelKind(("rad",), "angle of the x axis of a sensor above the horizontal"),
    "roll": ChannelKind(("rad",), "rotation of a sensor about its x axis, against gravity"),
    "pitch": ChannelKind(("rad",), "rotation of a sensor about its y axis, against gravity"),
    "speed": ChannelKind(("rad/s",), "speed of a pump, with the sign of the side that it feeds"),
    "speed_reference": ChannelKind(("rad/s",), "pump speed reference of the controller"),
    "current": ChannelKind(("A", "1"), "motor current, or uncalibrated converter counts"),
}

TRUTH_KINDS: Mapping[str, ChannelKind] = {
    **{k: MEASURED_KINDS[k] for k in ("angle", "position", "length", "velocity", "torque")},
    **{k: MEASURED_KINDS[k] for k in ("pressure_head", "pressure_rod", "pressure_supply")},
    "acceleration": ChannelKind(("rad/s^2", "m/s^2"), "joint acceleration"),
    "speed": MEASURED_KINDS["speed"],
    "pressure_load": ChannelKind(("Pa",), "pressure in the load cylinder of an axis"),
    "spool": ChannelKind(("1",), "spool position relative to its stroke"),
    "spool_rate": ChannelKind(("1/s",), "spool speed, in strokes per second"),
    "bristle": ChannelKind(("1",), "elastic force of dry friction (presliding) relative to the breakaway force"),
    "delivery": ChannelKind(("1",), "flow setting of the pump relative to its largest flow", "optional"),
    "added_delivery": ChannelKind(("1",), "pump flow that `terms` add, relative to the largest flow", "optional"),
    "memory": ChannelKind(
        ("1",), "internal state of a term: output of a backlash operator over its half width, or relay (0 off, 1 on)"
    ),
    "flow_head": ChannelKind(("m^3/s",), "valve flow into the head side chamber"),
    "flow_rod": ChannelKind(("m^3/s",), "valve flow into the rod side chamber"),
    "flow_supply": ChannelKind(("m^3/s",), "flow from a pump into its valves", "optional"),
    "force": ChannelKind(("N", "N m"), "piston force or motor torque after friction"),
    "piston_velocity": ChannelKind(("m/s",), "velocity of the piston in its tube"),
    "contact_force": ChannelKind(("N",), "contact force of ground and objects on the machine, world frame", "xyz"),
    "load": ChannelKind(("kg",), "mass of the soil in the bucket", "none"),
    "object_contact": ChannelKind(("N",), "contact force of a plate, tree, stump or log on the machine"),
    "tip": ChannelKind(("m",), "position of the arm's tip, world frame", "xyz"),
}


class MagnitudeLimits(NamedTuple):
    """Plausible range of a channel's maximum magnitude in a run, and the likely unit of values outside."""

    min_magnitude: float
    max_magnitude: float
    looks_like: str


# SI unit -> (limits if the file states the unit, limits if it states none)
_LIMITS_OF_UNIT: Mapping[str, tuple[MagnitudeLimits, MagnitudeLimits]] = {
    unit: (MagnitudeLimits(low, high, looks), MagnitudeLimits(low_unstated, high_unstated, looks))
    for unit, low, low_unstated, high, high_unstated, looks in (
        ("rad", 0.0, 0.0, 1.0e4, 4 * math.pi, "degrees"),
        ("rad/s", 0.0, 0.0, 100.0, 4 * math.pi, "degrees per second"),
        ("m", 0.0, 0.0, 50.0, 10.0, "millimetres"),
        ("m/s", 0.0, 0.0, 50.0, 10.0, "millimetres per second"),
        ("Pa", 1e4, 1e5, math.inf, math.inf, "bar, MPa, kPa or psi"),
    )
}
_NO_LIMITS = MagnitudeLimits(0.0, math.inf, "")
# Loggers may exceed 1 by float32 rounding or a few counts.
_COMMAND_LIMITS = MagnitudeLimits(0.0, 1.0 + 1e-3, "percent, counts or volts")


def plausible_magnitude_limits(name: str, unit: str, *, stated: bool = True) -> MagnitudeLimits:
    """Return the plausible range of a channel's maximum magnitude in a run [unit], to detect a wrong unit.

    The range is wider if the file states the unit (`stated`). It is unlimited for pump speeds and
    for units without a typical confusion.

    >>> plausible_magnitude_limits("angle.boom", "rad").looks_like
    'degrees'
    """
    if unit == "1" and name.startswith("command."):
        return _COMMAND_LIMITS
    if name.startswith(("speed.", "speed_reference.", "truth.speed.", "engine_speed", "pilot_pressure")):
        return _NO_LIMITS  # an engine turns faster than any joint; pilot pressures may stay at 0
    return _LIMITS_OF_UNIT.get(unit, (_NO_LIMITS, _NO_LIMITS))[0 if stated else 1]


def channel_name(kind: str, axis: str = "", *, truth: bool = False) -> str:
    """Return the name of a channel in logs; `truth` marks a channel that only a simulator knows.

    >>> channel_name("flow_head", "boom", truth=True)
    'truth.flow_head.boom'
    """
    return (_TRUTH_PREFIX if truth else "") + (f"{kind}.{axis}" if axis else kind)


def channel_names(kind: str, axes: Iterable[str], *, truth: bool = False) -> tuple[str, ...]:
    """Return the channel name of every axis, in the order of `axes`."""
    return tuple(channel_name(kind, axis, truth=truth) for axis in axes)


def valid_channel_patterns() -> tuple[str, ...]:
    """Return the forms of all valid channel names, such as `angle.<axis>`, measured channels first."""
    endings = {"free": ".<axis>", "xyz": ".x|y|z", "none": "", "optional": "[.<pump>]"}
    measured = [kind + endings[spec.axes] for kind, spec in MEASURED_KINDS.items()]
    return tuple(measured + [_TRUTH_PREFIX + kind + endings[spec.axes] for kind, spec in TRUTH_KINDS.items()])


def parse_channel(name: str) -> Channel:
    """Split a channel name into kind, axis and truth flag.

    >>> parse_channel("truth.force.boom")
    Channel(kind='force', axis='boom', truth=True)

    Raises:
        ValueError: the kind is unknown, or the axis is missing, superfluous or misspelt; the
            message suggests similar valid names.
    """
    truth = name.startswith(_TRUTH_PREFIX)
    kind, dot, axis = name.removeprefix(_TRUTH_PREFIX).partition(".")
    spec = (TRUTH_KINDS if truth else MEASURED_KINDS).get(kind)
    if spec is None:
        raise ValueError(_unknown_channel_message(name))
    if spec.axes == "none" and dot:
        raise ValueError(f"{kind} has no axis: write {channel_name(kind, truth=truth)}")
    if (spec.axes == "free" or (spec.axes == "optional" and dot)) and not _AXIS_PATTERN.fullmatch(axis):
        example = channel_name(kind, "boom", truth=truth)
        raise ValueError(f"{kind} needs an axis in lower case, such as {example}, got {name!r}")
    if spec.axes == "xyz" and axis not in ("x", "y", "z"):
        raise ValueError(f"{kind} has the components x, y and z, got {name!r}")
    return Channel(kind, axis, truth)


def allowed_channel_units(name: str) -> tuple[str, ...]:
    """Return the allowed SI units of the channel `name`, the usual one first.

    >>> allowed_channel_units("reference.boom")
    ('rad', 'm')

    Raises:
        ValueError: as `parse_channel`.
    """
    channel = parse_channel(name)
    return (TRUTH_KINDS if channel.truth else MEASURED_KINDS)[channel.kind].units


def default_channel_unit(name: str, present: Iterable[str] = ()) -> str:
    """Return the default SI unit of a channel for files that state none.

    If a kind can be rotary or linear, the unit is linear if `present`, the channel names of the
    log, contains a `position` channel of the same axis; otherwise it is rotary.

    >>> default_channel_unit("reference.slide", present=["position.slide"])
    'm'

    Raises:
        ValueError: as `parse_channel`.
    """
    units = allowed_channel_units(name)
    position = channel_name("position", parse_channel(name).axis)
    linear = units[0].startswith("rad") and not {position, _TRUTH_PREFIX + position}.isdisjoint(present)
    return units[-1] if linear else units[0]


def suggest_channel_names(name: str, present: Iterable[str] = ()) -> list[str]:
    """Return up to three valid channel names similar to `name`, most similar first.

    `present` are further names, such as those in the data, which may be suggested.

    >>> suggest_channel_names("angel.boom")[0]
    'angle.boom'
    """
    plain = re.sub(r"[^a-z0-9_.]+", "_", name.strip().lower())
    if _TIME_NAME.fullmatch(plain):
        return ["time"]
    truth = plain.startswith(_TRUTH_PREFIX)
    kinds = TRUTH_KINDS if truth else MEASURED_KINDS
    words = [word for word in plain.removeprefix(_TRUTH_PREFIX).split(".") if _AXIS_PATTERN.fullmatch(word)]
    if len(words) == 2 and words[1] in kinds and words[0] not in kinds:  # boom.angle
        return [channel_name(words[1], words[0], truth=truth)]
    for kind in kinds:  # angle_boom
        if len(words) == 1 and kinds[kind].axes == "free" and words[0].startswith(kind + "_"):
            return [channel_name(kind, words[0].removeprefix(kind + "_"), truth=truth)]
    candidates = list(present)
    for kind, spec in kinds.items():
        axes = {"free": words or ["boom"], "xyz": ["x", "y", "z"], "none": [""], "optional": ["", *words]}[spec.axes]
        candidates += channel_names(kind, axes, truth=truth)
    return difflib.get_close_matches(plain, dict.fromkeys(candidates), n=3, cutoff=0.6)


def _unknown_channel_message(name: str) -> str:
    near = suggest_channel_names(name)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    return f"unknown channel {name!r}; {hint}Valid: {', '.join(valid_channel_patterns())}"

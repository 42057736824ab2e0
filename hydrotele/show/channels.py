"""How a channel is shown: its unit, its title, its colour, and the plot that it belongs to."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.units import axis_unit
from hydrotele.logs.log import Log
from hydrotele.machine.signals import Channel, parse_channel

# SI unit -> the unit on a plot.
# Kind -> title of its plot, in the order in which signals travel.
TITLES: Mapping[str, str] = {
    "reference": "reference",
    "command": "command",
    "spool": "spool position",
    "spool_rate": "spool rate",
    "flow_head": "flow into head side",
    "flow_rod": "flow into rod side",
    "flow_supply": "pump flow",
    "delivery": "flow that the pump is set to",
    "added_delivery": "flow that terms add to the pump's",
    "memory": "what terms remember, in shares of their play or switch",
    "pressure_supply": "supply pressure",
    "pressure_head": "head side pressure",
    "pressure_rod": "rod side pressure",
    "force": "force",
    "torque": "torque",
    "bristle": "force of friction's bristles, of the breakaway force",
    "contact_force": "contact force",
    "object_contact": "contact force of an object",
    "length": "piston displacement",
    "piston_velocity": "piston velocity",
    "angle": "joint angle",
    "position": "joint position",
    "velocity": "joint velocity",
    "acceleration": "joint acceleration",
    "speed": "pump speed",
    "speed_reference": "pump speed that was asked for",
    "current": "motor current",
    "pressure_load": "load pressure",
    "valid": "rows that may be used",
    "tip": "tip position",
    "handle": "joystick's handle",
    "hand_force": "force of the hand",
    "handle_force": "force of the coils on the handle",
    "handle_stiffness": "joystick's stiffness",
    "coil_current": "coil current",
    "tip_reference": "pose that was asked for",
    "tip_pose": "measured pose of the tip",
    "tip_force": "force felt at the tip",
}
# Kinds whose lengths and forces are shown in m and N: a tip is far away, a hand is weak.
_PLAIN = ("tip", "tip_pose", "tip_reference", "hand_force", "handle_force")

# One hue per axis: distinct on dark and on white, and for the colour blind (after Okabe and Ito).
_HUES = (
    (86, 160, 233),
    (240, 150, 0),
    (0, 178, 130),
    (220, 95, 160),
    (225, 205, 60),
    (150, 120, 235),
    (225, 85, 60),
    (150, 160, 170),
)
_SUPPLY_HUE = (200, 205, 210)

# Bounds of a plot's span below which a difference is rounding or sensor noise [shown unit].
_SMALLEST_SPANS: Mapping[str, float] = {"deg": 0.5, "mm": 5.0, "MPa": 0.5}


class Trace(NamedTuple):
    """A channel as it is shown.

    Attributes:
        channel: its parsed name.
        unit: the unit on the plot.
        values: (n,) in that unit.
    """

    channel: Channel
    unit: str
    values: np.ndarray

    @property
    def name(self) -> str:
        """What a legend calls it: the axis, or the supply."""
        return self.channel.axis or "supply"


def shown(log: Log, name: str) -> Trace:
    """Return a channel of a log, scaled for a plot.

    Raises:
        InputError: the log has no such channel.
    """
    channel, values = parse_channel(name), log[name]
    if channel.kind in _PLAIN and log.units[name] != "rad":
        return Trace(channel, log.units[name], values)
    unit, factor = axis_unit(log.units[name])
    return Trace(channel, unit, values * factor)


def grouped(names: Iterable[str]) -> dict[str, list[str]]:
    """Sort channel names by kind, in the order in which signals travel.

    A truth channel stands in the group of its kind; it is left out where the same channel is there
    as measured.

    >>> grouped(["angle.boom", "truth.angle.boom", "command.boom", "truth.flow_head.boom"])
    {'command': ['command.boom'], 'flow_head': ['truth.flow_head.boom'], 'angle': ['angle.boom']}
    """
    names = list(names)
    groups: dict[str, list[str]] = {kind: [] for kind in TITLES}
    for name in names:
        if name.removeprefix("truth.") == name or name.removeprefix("truth.") not in names:
            groups.setdefault(parse_channel(name).kind, []).append(name)
    return {kind: members for kind, members in groups.items() if members}


def colours(logs: Sequence[Log]) -> dict[str, tuple[int, int, int]]:
    """Return one colour per axis of the logs, sRGB 0 .. 255; "" is that of a channel without axis.

    The measured axes come first, so that they keep their colours whatever else is recorded.
    """
    axes = [axis for log in logs for axis in log.axes]
    axes += [parse_channel(name).axis for log in logs for name in log.columns]
    axes = [axis for axis in dict.fromkeys(axes) if axis]
    palette = {axis: _HUES[i % len(_HUES)] for i, axis in enumerate(axes)}
    return {**palette, "": _SUPPLY_HUE}


def common_channels(first: Log, other: Log) -> list[str]:
    """Return the channels that both logs have in the same unit, in the order of the first."""
    return [name for name, unit in first.units.items() if other.units.get(name) == unit]


def difference(first: Log, other: Log, name: str) -> tuple[np.ndarray, Trace]:
    """Return `first - other` of a channel on the first log's clock, where both are recorded.

    The other log is interpolated linearly.

    Returns:
        (time (k,) [s], trace (k,)).

    Raises:
        InputError: the logs lack the channel or do not overlap in time.
    """
    inside = (first.time >= other.time[0]) & (first.time <= other.time[-1])
    if not inside.any():
        raise InputError(
            other.source,
            f"is recorded from {other.time[0]:.3f} to {other.time[-1]:.3f} s, {first.source} from"
            f" {first.time[0]:.3f} to {first.time[-1]:.3f} s: shift one of them to a common clock",
        )
    time = first.time[inside]
    ours, theirs = shown(first, name), shown(other, name)
    values = ours.values[inside] - np.interp(time, other.time, theirs.values)
    return time, ours._replace(values=values)


def padded_range(values: Iterable[np.ndarray], unit: str) -> tuple[float, float]:
    """Return the limits of a plot that shows all values with some room, never a blown-up noise.

    Args:
        values: arrays [unit].
        unit: the unit on the plot.

    Returns:
        (low, high) [unit].
    """
    values = [v for v in values if len(v)]
    low = min((float(v.min()) for v in values), default=0.0)
    high = max((float(v.max()) for v in values), default=0.0)
    lacking = _SMALLEST_SPANS.get(unit, 1e-3) - (high - low)
    room = max(0.05 * (high - low), 0.5 * lacking)
    return low - room, high + room

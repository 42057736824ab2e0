"""Define unit, title, colour and plot group of each log channel."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.units import plot_axis_unit
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import Channel, parse_channel

# {kind of channel: title of its plot}, in the order of the signal path.
TITLES: Mapping[str, str] = {
    "reference": "reference",
    "command": "command",
    "spool": "spool position",
    "spool_rate": "spool rate",
    "flow_head": "flow into head side",
    "flow_rod": "flow into rod side",
    "flow_supply": "pump flow",
    "delivery": "reference of the pump flow",
    "added_delivery": "pump flow added by terms",
    "memory": "internal state of terms, relative to the width of backlash or relay",
    "pressure_supply": "supply pressure",
    "pressure_head": "head side pressure",
    "pressure_rod": "rod side pressure",
    "force": "force",
    "torque": "torque",
    "bristle": "bristle friction force / breakaway force",
    "contact_force": "contact force",
    "object_contact": "contact force of an object",
    "length": "piston displacement",
    "piston_velocity": "piston velocity",
    "angle": "joint angle",
    "position": "joint position",
    "velocity": "joint velocity",
    "acceleration": "joint acceleration",
    "speed": "pump speed",
    "speed_reference": "pump speed reference",
    "current": "motor current",
    "pressure_load": "load pressure",
    "pressure_ls": "load-sensing pressure",
    "pilot_pressure_a": "pilot pressure, positive command",
    "pilot_pressure_b": "pilot pressure, negative command",
    "flow": "measured flow",
    "oil_temperature": "oil temperature",
    "engine_speed": "engine speed",
    **{f"gyro_{c}": f"angular rate about {c}" for c in "xyz"},
    **{f"accelerometer_{c}": f"specific force along {c}" for c in "xyz"},
    "inclination": "inclination",
    "roll": "roll",
    "pitch": "pitch",
    "valid": "valid rows",
    "tip": "tip position",
    "handle": "pose of the joystick handle",
    "hand_force": "force of the hand",
    "handle_force": "force of the coils on the handle",
    "handle_stiffness": "joystick stiffness",
    "coil_current": "coil current",
    "tip_reference": "reference pose of the tip",
    "tip_pose": "measured pose of the tip",
    "tip_force": "measured force at the tip",
    "tip_force_std": "standard deviation of the force at the tip",
    "contact": "probability of contact",
    "load": "load on the tool",
    "load_std": "standard deviation of the load on the tool",
}
# Kinds shown in m and N: tip positions are large, hand forces are small.
_UNSCALED_KINDS = ("tip", "tip_pose", "tip_reference", "hand_force", "handle_force")

# Colours of the axes, distinguishable on dark and white and by the colour-blind (Okabe and Ito).
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

# Minimum range of a plot [displayed unit]; smaller differences are rounding or sensor noise.
_MIN_PLOT_RANGES: Mapping[str, float] = {"deg": 0.5, "mm": 5.0, "MPa": 0.5}


class Trace(NamedTuple):
    """Channel in the unit of its plot.

    Attributes:
        channel: parsed name of the channel.
        unit: unit of the plot.
        values: (n,) values in that unit.
    """

    channel: Channel
    unit: str
    values: np.ndarray

    @property
    def legend_name(self) -> str:
        """Name in a legend: the axis, or `supply` for a channel without an axis."""
        return self.channel.axis or "supply"


def scale_channel_for_plot(log: Log, name: str) -> Trace:
    """Return a channel of a log, converted from SI to the unit of its plot, such as deg or mm.

    Raises:
        InputError: the log has no such channel.
    """
    channel, values = parse_channel(name), log[name]
    if channel.kind in _UNSCALED_KINDS and log.units[name] != "rad":
        return Trace(channel, log.units[name], values)
    unit, factor = plot_axis_unit(log.units[name])
    return Trace(channel, unit, values * factor)


def group_channels(names: Iterable[str]) -> dict[str, list[str]]:
    """Group channel names by kind (the part before the axis), ordered along the signal path.

    A channel of true values (`truth.`) is in the group of its kind. It is omitted if the same
    channel was measured.

    >>> group_channels(["angle.boom", "truth.angle.boom", "command.boom", "truth.flow_head.boom"])
    {'command': ['command.boom'], 'flow_head': ['truth.flow_head.boom'], 'angle': ['angle.boom']}
    """
    names = list(names)
    groups: dict[str, list[str]] = {kind: [] for kind in TITLES}
    for name in names:
        if name.removeprefix("truth.") == name or name.removeprefix("truth.") not in names:
            groups.setdefault(parse_channel(name).kind, []).append(name)
    return {kind: members for kind, members in groups.items() if members}


def assign_axis_colours(logs: Sequence[Log]) -> dict[str, tuple[int, int, int]]:
    """Assign a plot colour to each axis in the logs: {axis: sRGB 0 .. 255}.

    The key "" is for channels without an axis. The measured axes come first, so that their colours
    do not depend on other channels.
    """
    axes = [axis for log in logs for axis in log.axes]
    axes += [parse_channel(name).axis for log in logs for name in log.columns]
    axes = [axis for axis in dict.fromkeys(axes) if axis]
    palette = {axis: _HUES[i % len(_HUES)] for i, axis in enumerate(axes)}
    return {**palette, "": _SUPPLY_HUE}


def common_channels(first: Log, other: Log) -> list[str]:
    """Return the channels that exist in both logs with the same unit, in the order of the first."""
    return [name for name, unit in first.units.items() if other.units.get(name) == unit]


def compute_channel_difference(first: Log, other: Log, name: str) -> tuple[np.ndarray, Trace]:
    """Subtract a channel of two logs, `first - other`, at the times of the first log.

    The other log is interpolated linearly. Only the time interval common to both logs is used.

    Returns:
        (k times [s], difference at these times in the unit of its plot).

    Raises:
        InputError: a log does not have the channel, or the logs do not overlap in time.
    """
    inside = (first.time >= other.time[0]) & (first.time <= other.time[-1])
    if not inside.any():
        raise InputError(
            other.source,
            f"is recorded from {other.time[0]:.3f} to {other.time[-1]:.3f} s, {first.source} from"
            f" {first.time[0]:.3f} to {first.time[-1]:.3f} s: shift one of them to a common clock",
        )
    time = first.time[inside]
    ours, theirs = scale_channel_for_plot(first, name), scale_channel_for_plot(other, name)
    values = ours.values[inside] - np.interp(time, other.time, theirs.values)
    return time, ours._replace(values=values)


def padded_range(values: Iterable[np.ndarray], unit: str) -> tuple[float, float]:
    """Return limits of a plot axis that contain all values, with a margin of 5 % on both sides.

    The range has a minimum that depends on the unit, so that noise does not fill the plot.

    Args:
        values: arrays [unit]; NaN and infinity are ignored.
        unit: unit of the plot.

    Returns:
        (low, high) [unit].
    """
    values = [known for v in values if len(known := v[np.isfinite(v)])]
    low = min((float(v.min()) for v in values), default=0.0)
    high = max((float(v.max()) for v in values), default=0.0)
    lacking = _MIN_PLOT_RANGES.get(unit, 1e-3) - (high - low)
    room = max(0.05 * (high - low), 0.5 * lacking)
    return low - room, high + room

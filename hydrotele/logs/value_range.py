"""Readings that no machine in working order gives: beyond the sensor, spikes, another unit."""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import converter
from hydrotele.machine.sensors import Sensor

_ANGLE_PLAY = 0.35  # [rad] beyond a joint's range; zeros are set worse than ranges are known
_LENGTH_PLAY = 0.2  # of the stroke or the range, likewise
_VACUUM = -1.0e6  # [Pa] below it no sensor of absolute or gauge pressure reads
_PRESSURE_PLAY = 2.0  # times the highest relief pressure; ports overshoot their relief
_HARDEST = 500.0  # [rad/s^2] or [m/s^2]: end stops hit at full speed stay below it
_SPIKE = 20.0  # standard deviations of one reading
_NEAR_CLIP = 0.1  # [s] before and after a clipped row in which readings near the end are suspect
_WIDE = 3.46  # standard deviations of a random error, within which readings near an end are suspect


def limits(machine: Machine, channel: str) -> tuple[float, float]:
    """Readings between which a channel must be, generously.

    Args:
        machine: the machine.
        channel: channel name.

    Returns:
        (low, high) [channel's unit], infinite where the machine has no limit.
    """
    kind, _, axis = channel.partition(".")
    if kind.startswith("pressure"):
        if machine.supply is None:  # pumps of their own, without a stated limit
            return _VACUUM, math.inf
        reliefs = [a.valve.port_relief for a in machine.hydraulic_axes.values() if a.valve]
        return _VACUUM, _PRESSURE_PLAY * max(machine.supply.relief_pressure, *reliefs)
    if kind == "length":
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return -_LENGTH_PLAY * cylinder.stroke, (1 + _LENGTH_PLAY) * cylinder.stroke
    low, high = machine.joints[machine.axes[axis].joint].range or (-math.inf, math.inf)
    play = _ANGLE_PLAY if kind == "angle" else _LENGTH_PLAY * (high - low)
    return (low - play, high + play) if math.isfinite(high) else (low, high)


def check_range(machine: Machine, channel: str, reading: np.ndarray, where: str) -> None:
    """Refuse a channel that is out of the machine's reach most of the time.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        where: the file.

    Raises:
        InputError: names file and channel, what it reads, what the machine can do, and the unit
            that would explain it.
    """
    low, high = limits(machine, channel)
    values = reading[np.isfinite(reading)]
    if not len(values) or np.mean((values < low) | (values > high)) <= 0.5:
        return
    factors = {"degrees": math.pi / 180} if channel.startswith("angle") else {}
    if channel.startswith(("length", "position")):
        factors = {"millimetres": 1e-3, "inches": 0.0254}
    middle = np.median(values)
    unit = next((u for u, f in factors.items() if low <= f * middle <= high), None)
    cure = f"looks like {unit}, convert it" if unit else (
        "its zero, sign or unit is another one, or the log is of another machine")  # fmt: skip
    raise InputError(
        f"{where}, column {channel!r}",
        f"reads {values.min():.4g} .. {values.max():.4g}, the machine allows {low:.4g} .."
        f" {high:.4g}: {cure}",
    )


def clipped(sensor: Sensor, channel: str, reading: np.ndarray, period: float) -> np.ndarray:
    """Which readings stand at an end of the converter, or so near beside such that they may have.

    A sensor at its end cuts half of its noise off. Leaving out only the cut readings would keep
    those that the noise pushed inwards; near a cut reading, all within the noise of the end go.

    Args:
        sensor: the channel's sensor, with its span.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].

    Returns:
        (n,) bool.
    """
    step, low, high = converter(sensor, channel)
    at_end = np.zeros(len(reading), dtype=bool)
    if not math.isfinite(high):
        return at_end
    for distance in (reading - low, high - reading):
        cut = np.nan_to_num(distance, nan=math.inf) <= 0.25 * step
        if cut.any():
            rows = min(max(1, round(_NEAR_CLIP / period)), (len(cut) - 1) // 2)
            beside = np.convolve(cut, np.ones(2 * rows + 1), mode="same") > 0.5
            reach = (2 * sensor.accuracy or _WIDE * sensor.standard_deviation) + step
            near = np.nan_to_num(distance, nan=math.inf) <= reach
            at_end |= cut | (beside & near)
    return at_end


def spikes(
    machine: Machine, channel: str, reading: np.ndarray, period: float, noise: float
) -> np.ndarray:
    """Single readings that are physically impossible.

    Of pressures only those beyond `limits`: a pressure can jump by 10 MPa from row to row. Of
    positions also a reading that leaves its two neighbours, which agree with each other, farther
    than any acceleration could have moved it.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].
        noise: standard deviation of one reading [channel's unit]; NaN: taken from the readings.

    Returns:
        (n,) bool.
    """
    low, high = limits(machine, channel)
    with np.errstate(invalid="ignore"):
        bad = (reading < low) | (reading > high) | np.isinf(reading)
    if channel.startswith("pressure") or len(reading) < 3:
        return bad
    bend = reading[1:-1] - 0.5 * (reading[:-2] + reading[2:])
    apart = np.abs(reading[2:] - reading[:-2])
    if not math.isfinite(noise):  # bends of 0 are those of a coarse sensor between its steps
        bent = np.abs(bend[np.isfinite(bend) & (bend != 0.0)])
        noise = 1.2 * float(np.median(bent)) if len(bent) else 0.0
    allowed = max(_SPIKE * noise, 0.5 * _HARDEST * period**2)
    with np.errstate(invalid="ignore"):
        bad[1:-1] |= (np.abs(bend) > allowed) & (apart < 0.25 * np.abs(bend))
    return bad

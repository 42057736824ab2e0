"""Detection of implausible, saturated, frozen, repeated and duplicated readings, and of spikes.

A slow channel repeats its value between two updates. For example, a 1 kHz logger writes each value
of a pressure that arrives every 20 ms 20 times. If all 20 readings were used, one error would count
20 times, and the age of the value would appear as a delay between 0 and 20 ms.

A noisy sensor rarely gives the same value twice in a row. If its error is uniform in +-a and the
converter rounds to steps of q, the probability is at most q / 2a. If its error is normal with
standard deviation sigma, it is at most q / (sigma sqrt(2 pi)). A long repetition is then not
random. This applies only if the sensor is as noisy as its data sheet states. Otherwise repetitions
at rest are normal, and only the motion of other channels can prove that a sensor is frozen.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import Sensor, make_channel_converter

_ANGLE_TOLERANCE = 0.35  # [rad] tolerance beyond a joint's range; sensor zeros are often inaccurate
_LENGTH_TOLERANCE = 0.2  # tolerance as a fraction of the stroke or range, for the same reason
_MIN_PRESSURE_READING = -1.0e6  # [Pa] lower limit for readings of absolute or gauge pressure sensors
_MAX_PRESSURE_RATIO = 2.0  # limit as a multiple of the highest relief pressure; ports overshoot it
_MAX_ACCELERATION = 500.0  # [rad/s^2] or [m/s^2]: exceeds the acceleration at an end-stop impact
_SPIKE_NOISE_RATIO = 20.0  # standard deviations of one reading
_SATURATION_MARGIN_SECONDS = 0.1  # [s] before and after a saturated row in which nearby readings are removed
_SATURATION_MARGIN_STDS = 3.46  # standard deviations from the limit within which such readings are removed


def plausible_range(machine: Machine, channel: str) -> tuple[float, float]:
    """Return the range in which readings of a channel are plausible for a machine.

    The range follows from joint ranges, strokes and relief pressures, each with a tolerance.

    Args:
        machine: the machine.
        channel: channel name.

    Returns:
        (low, high) [channel's unit], infinite where the machine has no limit.
    """
    kind, _, axis = channel.partition(".")
    if kind.startswith("pressure"):
        if machine.supply is None:  # axes with individual pumps have no stated limit
            return _MIN_PRESSURE_READING, math.inf
        mains = [pump.relief_pressure for pump in machine.pumps.values()]
        reliefs = [a.valve.port_relief for a in machine.hydraulic_axes.values() if a.valve]
        return _MIN_PRESSURE_READING, _MAX_PRESSURE_RATIO * max(*mains, *reliefs)
    if kind == "velocity":
        return -math.inf, math.inf
    if kind == "length":
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return -_LENGTH_TOLERANCE * cylinder.stroke, (1 + _LENGTH_TOLERANCE) * cylinder.stroke
    low, high = machine.joints[machine.axes[axis].joint].range or (-math.inf, math.inf)
    play = _ANGLE_TOLERANCE if kind == "angle" else _LENGTH_TOLERANCE * (high - low)
    return (low - play, high + play) if math.isfinite(high) else (low, high)


def check_range(machine: Machine, channel: str, reading: np.ndarray, where: str) -> None:
    """Check that at least half of the readings of a channel are in the machine's `plausible_range`.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        where: file of the log, for the message.

    Raises:
        InputError: the channel is out of range; the message gives both ranges and, if one fits, the
            unit that the file probably has.
    """
    low, high = plausible_range(machine, channel)
    values = reading[np.isfinite(reading)]
    if not len(values) or np.mean((values < low) | (values > high)) <= 0.5:
        return
    factors = {"degrees": math.pi / 180} if channel.startswith("angle") else {}
    if channel.startswith(("length", "position")):
        factors = {"millimetres": 1e-3, "inches": 0.0254}
    middle = np.median(values)
    unit = next((u for u, f in factors.items() if low <= f * middle <= high), None)
    cure = f"looks like {unit}, convert it" if unit else (
        "check zero, sign and unit, and whether the log is from this machine")  # fmt: skip
    raise InputError(
        f"{where}, column {channel!r}",
        f"has values {values.min():.4g} .. {values.max():.4g}, the machine allows {low:.4g} .. {high:.4g}: {cure}",
    )


def find_saturated(sensor: Sensor, channel: str, reading: np.ndarray, period: float) -> np.ndarray:
    """Find readings at the limit of the sensor's span, and those close to it in time and value.

    While a sensor is saturated, noise moves some readings away from the limit. Keeping these would
    bias the channel. Therefore readings within 0.1 s of a saturated one are also found, if their
    distance from the limit is at most the range of the sensor's noise: twice its accuracy, or 3.46
    standard deviations, plus one converter step.

    Args:
        sensor: sensor of the channel, with its span.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].

    Returns:
        (n,) whether a reading is saturated or close to it.
    """
    step, low, high = make_channel_converter(sensor, channel)
    at_end = np.zeros(len(reading), dtype=bool)
    if not math.isfinite(high):
        return at_end
    for distance in (reading - low, high - reading):
        cut = np.nan_to_num(distance, nan=math.inf) <= 0.25 * step
        if cut.any():
            rows = min(max(1, round(_SATURATION_MARGIN_SECONDS / period)), (len(cut) - 1) // 2)
            beside = np.convolve(cut, np.ones(2 * rows + 1), mode="same") > 0.5
            reach = (2 * sensor.accuracy or _SATURATION_MARGIN_STDS * sensor.standard_deviation) + step
            near = np.nan_to_num(distance, nan=math.inf) <= reach
            at_end |= cut | (beside & near)
    return at_end


def find_spikes(machine: Machine, channel: str, reading: np.ndarray, period: float, noise: float) -> np.ndarray:
    """Find readings that are physically impossible: outside the plausible range, or single spikes.

    Pressures and rates are checked against `plausible_range` only, because they change by 10 MPa within a
    row. A position or length is also a spike if its two neighbours agree and it differs from their
    mean by more than 20 noise standard deviations and by more than any acceleration can explain.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].
        noise: noise standard deviation [channel's unit]; NaN to estimate it from the readings.

    Returns:
        (n,) whether a reading is impossible.
    """
    low, high = plausible_range(machine, channel)
    with np.errstate(invalid="ignore"):
        bad = (reading < low) | (reading > high) | np.isinf(reading)
    if channel.startswith(("pressure", "velocity")) or len(reading) < 3:
        return bad
    bend = reading[1:-1] - 0.5 * (reading[:-2] + reading[2:])
    apart = np.abs(reading[2:] - reading[:-2])
    if not math.isfinite(noise):  # second differences of 0 come from a coarse converter
        bent = np.abs(bend[np.isfinite(bend) & (bend != 0.0)])
        noise = 1.2 * float(np.median(bent)) if len(bent) else 0.0
    allowed = max(_SPIKE_NOISE_RATIO * noise, 0.5 * _MAX_ACCELERATION * period**2)
    with np.errstate(invalid="ignore"):
        bad[1:-1] |= (np.abs(bend) > allowed) & (apart < 0.25 * np.abs(bend))
    return bad


_MIN_CHANGES = 20  # minimum number of changes
_MIN_REGULAR_FRACTION = 0.9  # minimum fraction of values with the same duration or a multiple of it
_MAX_SINGLE_FRACTION = 0.01  # maximum fraction of values that last for one reading only
_MAX_ONE_STEP_FRACTION = 0.9  # larger fractions of one-step changes mean a slow motion of a coarse sensor
_ONE_STEP_RATIO = 1.05  # changes up to this multiple of the smallest one count as one step


def readings_per_update(reading: np.ndarray) -> float:
    """Return the number of logged readings per update of a channel; 1 if each is an update.

    A channel with a slower clock repeats each value for a fixed number of readings, or one more or
    less if the clocks drift. A sensor without noise also repeats values at rest or between two
    converter steps, but for irregular times, and then changes by one step.

    Args:
        reading: (n,) readings, NaN where missing.

    Returns:
        The mean number of readings per update, at least 1.

    >>> readings_per_update(np.repeat(np.random.default_rng(0).normal(size=50), 4))
    4.0
    """
    values = reading[np.isfinite(reading)]
    change = np.diff(values)
    lasted = np.diff(np.flatnonzero(change))
    if len(lasted) < _MIN_CHANGES or np.mean(lasted == 1) > _MAX_SINGLE_FRACTION:
        return 1.0
    size = np.abs(change[change != 0.0])
    if np.mean(size < _ONE_STEP_RATIO * size.min()) > _MAX_ONE_STEP_FRACTION:
        return 1.0
    usual = np.median(lasted)
    times = np.maximum(np.rint(lasted / usual), 1.0)
    once = times == 1.0
    regular = np.abs(lasted - times * usual) <= 1.0
    if min(regular.mean(), once.mean()) < _MIN_REGULAR_FRACTION:
        return 1.0
    return float(lasted[once & regular].mean())


def find_readings_without_update(reading: np.ndarray, per_update: float) -> np.ndarray:
    """Find readings that repeat the previous one only because a slow channel was not updated.

    If a value lasts longer than one update period, the readings at which an update is due count as
    updates with the same value, and are not found.

    Args:
        reading: (n,) readings, NaN where missing.
        per_update: number of readings per update, the result of `readings_per_update`.

    Returns:
        (n,) whether a reading is such a repetition.

    >>> find_readings_without_update(np.array([1.0, 1.0, 2.0, 2.0, 2.0, 2.0]), 2.0).tolist()
    [False, True, False, True, False, True]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    place = np.arange(len(rows))
    changed = np.append(True, np.diff(reading[rows]) != 0.0)[: len(rows)]
    since = place - np.maximum.accumulate(np.where(changed, place, 0))
    again = np.rint(np.rint(since / per_update) * per_update) == since
    lasts = np.append(np.flatnonzero(changed)[1:], len(rows))[np.cumsum(changed) - 1] - place
    fresh = changed | (again & (lasts >= np.floor(per_update)))
    old = np.zeros(len(reading), dtype=bool)
    old[rows] = ~fresh
    return old


_FALSE_ALARM_PROBABILITY = 1.0e-6  # false-alarm probability per data set
_MIN_FREEZE_SECONDS = 0.1  # [s] minimum duration of a freeze; shorter ones have no effect
_MIN_QUIET_FREEZE_SECONDS = 1.0  # [s] minimum duration of a freeze of a sensor without known noise
_MIN_NOISE_RATIO = 0.5  # fraction of the stated noise below which a sensor is quieter than stated
_NOISE_WINDOW_ROWS = 20  # rows per window of the noise estimate
_MIN_PARTNER_STEPS = 20.0  # converter steps that the motion of the other sensor must exceed
_MIN_PARTNER_PRESSURE_CHANGE = 2.0e6  # [Pa] minimum pressure change in the other chamber
_LARGE_COMMAND = 0.5  # fraction of the command limit that exceeds dead bands
_LARGE_COMMAND_SECONDS = 1.0  # [s] minimum time with such a command in each direction


class Interval(NamedTuple):
    """Rows first .. last - 1 of one run in which a channel repeats one value."""

    first: int
    last: int


def equal_reading_probability(sensor: Sensor, channel: str) -> float | None:
    """Return the largest probability that a noisy sensor gives the same reading twice in a row [1].

    It is the converter step times the largest probability density of the sensor's error. The result
    is None if the noise is unknown, or if the probability exceeds 0.5, so that equal readings of a
    constant value are normal.

    >>> equal_reading_probability(Sensor(accuracy=0.002, bits=12, span=1.024), "length.boom")
    0.0625
    """
    if sensor.error_rms == 0.0:
        return None
    width = 2.0 * sensor.accuracy or math.sqrt(2.0 * math.pi) * sensor.standard_deviation
    share = make_channel_converter(sensor, channel).step / width
    return max(share, 1.0e-9) if share <= 0.5 else None


def min_suspicious_repeat(probability: float, count: int) -> int:
    """Return the number of consecutive equal readings that is too improbable to be random.

    With this number, the probability of a random repetition anywhere in the data set is at most
    1e-6.

    Args:
        probability: probability that two consecutive readings are equal [1].
        count: number of readings in the data set.

    >>> min_suspicious_repeat(0.1, 90_000)
    12
    """
    return 1 + math.ceil(math.log(_FALSE_ALARM_PROBABILITY / max(count, 1)) / math.log(probability))


def find_constant_intervals(reading: np.ndarray, min_length: int) -> list[Interval]:
    """Find intervals with at least `min_length` equal consecutive readings; missing readings (NaN) are skipped.

    >>> find_constant_intervals(np.array([1.0, 2.0, 2.0, np.nan, 2.0, 3.0]), 3)
    [Interval(first=1, last=5)]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    if not len(rows):
        return []
    starts = np.flatnonzero(np.diff(reading[rows], prepend=np.nan) != 0.0)
    ends = np.append(starts[1:], len(rows))
    return [
        Interval(int(rows[a]), int(rows[b - 1]) + 1) for a, b in zip(starts, ends, strict=True) if b - a >= min_length
    ]


def are_repeats_at_extreme(reading: np.ndarray, intervals: Sequence[Interval]) -> bool:
    """Return whether repeated readings of a channel show that it is saturated rather than frozen.

    It is saturated if there are several intervals of repeated readings, all at the same value, and
    this value is the minimum or maximum of the run.

    >>> reading = np.array([1.0, 2.0, 2.0, 1.5, 2.0, 2.0, 1.0])
    >>> are_repeats_at_extreme(reading, find_constant_intervals(reading, 2))
    True

    Args:
        reading: (n,) readings of one run, NaN where missing.
        intervals: intervals of equal readings.
    """
    values = {float(np.nanmedian(reading[slice(*part)])) for part in intervals}
    ends = {float(np.nanmin(reading)), float(np.nanmax(reading))}
    return len(intervals) > 1 and len(values) == 1 and values <= ends


def estimate_noise(reading: np.ndarray) -> float:
    """Estimate the standard deviation of the noise of a channel [channel's unit].

    Second differences of the readings remove slow motion. Their standard deviation is computed in windows
    of 20 rows; the 10th percentile of all windows excludes those with fast motion. Windows of constant
    readings are excluded; the result is NaN if none remain.
    """
    values = reading[np.isfinite(reading)]
    bend = np.diff(values, 2)
    bend = bend[: len(bend) // _NOISE_WINDOW_ROWS * _NOISE_WINDOW_ROWS].reshape(-1, _NOISE_WINDOW_ROWS)
    moving = (bend != 0.0).any(axis=1)
    return float(np.percentile(bend[moving].std(axis=1), 10) / math.sqrt(6.0)) if any(moving) else (
        math.nan)  # fmt: skip


def is_noise_as_stated(sensor: Sensor, channel: str, noise_estimates: Sequence[float]) -> bool:
    """Return whether the measured noise of a sensor is at least half of the stated noise.

    Args:
        sensor: the sensor, with its stated noise.
        channel: channel name.
        noise_estimates: noise estimates of this channel and of others with an equal sensor, in order of
            preference; the first finite one is used [channel's unit].
    """
    stated = math.hypot(sensor.error_rms, make_channel_converter(sensor, channel).step / 12**0.5)
    known = [floor for floor in noise_estimates if math.isfinite(floor)]
    return bool(known) and known[0] >= _MIN_NOISE_RATIO * stated


def find_frozen_by_noise(reading: np.ndarray, probability: float, count: int, period: float) -> list[Interval]:
    """Find intervals of equal readings that are longer than the noise of the sensor allows, and than 0.1 s.

    Args:
        reading: (n,) readings of one run, NaN where missing.
        probability: probability that two consecutive readings are equal [1].
        count: number of readings in the whole data set.
        period: time between rows [s].
    """
    shortest = max(min_suspicious_repeat(probability, count), math.ceil(_MIN_FREEZE_SECONDS / period))
    return find_constant_intervals(reading, shortest)


def find_frozen_position(
    reading: np.ndarray, partner: np.ndarray | None, command: np.ndarray, others: np.ndarray,
    step: float, ranges: tuple[float, float], period: float,
) -> list[Interval]:  # fmt: skip
    """Find intervals of at least 1 s in which a position is constant although the axis must have moved.

    Motion is proved in one of two ways. First, the second position sensor of the axis (length or
    angle) changed by more than 5 % of its range and more than 20 resolution steps. Second, the
    command exceeded half its limit for 1 s in each direction, another axis moved by more than a
    tenth of its range, and the constant value is not at an end of the channel's range.

    Args:
        reading: (n,) positions, NaN where missing [channel's unit].
        partner: (n,) readings of the second position sensor of the axis, or None.
        command: (n,) command of the axis divided by its limit [1].
        others: (n, k) positions of k other axes.
        step: resolution of the sensor [channel's unit].
        ranges: range of the channel and of its partner over all runs, each in its unit; 0 for a
            channel that is constant in all runs.
        period: time between rows [s].
    """
    own, partners = ranges
    least = own * 0.02
    low, high = np.nanmin(reading), np.nanmax(reading)
    found = []
    for part in find_constant_intervals(reading, math.ceil(_MIN_QUIET_FREEZE_SECONDS / period)):
        rows = slice(*part)
        if partner is not None and partners > 0.0:
            moved = _robust_range(partner[rows]) / partners
            if moved > 0.05 and (own == 0.0 or moved * own > _MIN_PARTNER_STEPS * step):
                found.append(part)
                continue
        both = all(
            period * (sign * command[rows] > _LARGE_COMMAND).sum() >= _LARGE_COMMAND_SECONDS for sign in (1.0, -1.0)
        )
        value = np.nanmedian(reading[rows])
        at_end = own > 0.0 and (value - low < least or high - value < least)
        alive = any(_robust_range(other[rows]) > 0.1 * _robust_range(other) > 0.0 for other in others.T)
        if both and not at_end and alive:
            found.append(part)
    return found


def find_frozen_pressure(reading: np.ndarray, partner: np.ndarray, lowest: float, period: float) -> list[Interval]:
    """Find intervals of at least 1 s with constant pressure in one chamber while the other one's changes by 2 MPa.

    Intervals at a pressure of at most `lowest` are not found.

    Args:
        reading: (n,) pressures, NaN where missing [Pa].
        partner: (n,) pressures of the other chamber [Pa].
        lowest: pressure below which a make-up valve, which refills the chamber, may keep the
            pressure constant [Pa].
        period: time between rows [s].
    """
    return [
        part
        for part in find_constant_intervals(reading, math.ceil(_MIN_QUIET_FREEZE_SECONDS / period))
        if _robust_range(partner[slice(*part)]) > _MIN_PARTNER_PRESSURE_CHANGE
        and np.nanmedian(reading[slice(*part)]) > lowest
    ]


def _robust_range(values: np.ndarray) -> float:
    """Return the range between the 2nd and the 98th percentile, which ignores outliers."""
    values = values[np.isfinite(values)]
    return float(np.diff(np.percentile(values, [2, 98]))[0]) if len(values) else 0.0


def find_duplicated_rows(reading: np.ndarray, probability: Sequence[float | None], count: int) -> np.ndarray:
    """Find rows that repeat all readings of the previous row, although noise makes this improbable.

    The probability of such a repetition anywhere in the data set must be below 1e-6.

    Args:
        reading: (n, c) readings, NaN where missing.
        probability: per channel the probability that two consecutive readings are equal [1]; None
            to ignore a channel.
        count: number of readings in the whole data set.

    Returns:
        (n,) whether a row is such a duplicate.
    """
    noisy = [c for c, p in enumerate(probability) if p is not None]
    if not noisy:
        return np.zeros(len(reading), dtype=bool)
    logs = np.log([p for p in probability if p is not None])
    pairs = np.isfinite(reading[1:, noisy]) & np.isfinite(reading[:-1, noisy])
    equal = pairs & (reading[1:, noisy] == reading[:-1, noisy])
    improbable = (equal * logs).sum(axis=1) < math.log(_FALSE_ALARM_PROBABILITY / max(count, 1))
    return np.append(False, improbable & (equal == pairs).all(axis=1) & pairs.any(axis=1))

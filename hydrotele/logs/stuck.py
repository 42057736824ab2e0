"""Sensors that froze, and rows that a logger wrote twice.

A noisy sensor rarely reads the same value twice in a row: with a uniform error of +-a and a
converter step q, with probability q / 2a at most; with a normal one, whose density is at most
1 / (sigma sqrt(2 pi)), likewise. A long repeat is then impossible by chance. That
holds only for a sensor that is as noisy as stated; of one that is quieter, or whose noise is not
stated, repeats at rest are the rule, and only the motion of others can convict it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.machine.noise import converter
from hydrotele.machine.sensors import Sensor

_BY_CHANCE = 1.0e-6  # probability of convicting a sound sensor somewhere in a data set
_SHORTEST = 0.1  # [s] a freeze has to last; shorter ones harm nobody
_SHORTEST_QUIET = 1.0  # [s] the same without noise to judge by
_QUIET = 0.5  # of the stated noise: below it a sensor is quieter than stated
_WINDOW = 20  # rows in which the noise is looked at
_PARTNER_STEPS = 20.0  # converter steps (or noises) that a motion seen elsewhere must amount to
_PARTNER_PRESSURE = 2.0e6  # [Pa] by which the other chamber must change meanwhile
_STRONG = 0.5  # of the largest command, beyond dead bands
_STRONG_TIME = 1.0  # [s] of strong command in each direction


class Stretch(NamedTuple):
    """Rows first .. last - 1 of one run, in which a channel repeats one value."""

    first: int
    last: int


def repeat_probability(sensor: Sensor, channel: str) -> float | None:
    """Largest probability that two readings of one value are equal [1]; None if noise tells none.

    >>> repeat_probability(Sensor(accuracy=0.002, bits=12, span=1.024), "length.boom")
    0.0625
    """
    if sensor.error_rms == 0.0:
        return None
    width = 2.0 * sensor.accuracy or math.sqrt(2.0 * math.pi) * sensor.standard_deviation
    share = converter(sensor, channel).step / width
    return max(share, 1.0e-9) if share <= 0.5 else None


def longest_repeat(probability: float, count: int) -> int:
    """Equal readings in a row that do not happen by chance among `count` readings.

    >>> longest_repeat(0.1, 90_000)
    12
    """
    return 1 + math.ceil(math.log(_BY_CHANCE / max(count, 1)) / math.log(probability))


def repeats(reading: np.ndarray, shortest: int) -> list[Stretch]:
    """Stretches of at least `shortest` equal readings; missing ones in between count as equal.

    >>> repeats(np.array([1.0, 2.0, 2.0, np.nan, 2.0, 3.0]), 3)
    [Stretch(first=1, last=5)]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    if not len(rows):
        return []
    starts = np.flatnonzero(np.diff(reading[rows], prepend=np.nan) != 0.0)
    ends = np.append(starts[1:], len(rows))
    return [
        Stretch(int(rows[a]), int(rows[b - 1]) + 1)
        for a, b in zip(starts, ends, strict=True)
        if b - a >= shortest
    ]


def saturated(reading: np.ndarray, parts: Sequence[Stretch]) -> bool:
    """Whether a channel comes to rest at one value again and again, and never beyond it.

    >>> reading = np.array([1.0, 2.0, 2.0, 1.5, 2.0, 2.0, 1.0])
    >>> saturated(reading, repeats(reading, 2))
    True

    Args:
        reading: (n,) readings of one run, NaN where missing.
        parts: where it repeats one value.
    """
    values = {float(np.nanmedian(reading[slice(*part)])) for part in parts}
    ends = {float(np.nanmin(reading)), float(np.nanmax(reading))}
    return len(parts) > 1 and len(values) == 1 and values <= ends


def noise_floor(reading: np.ndarray) -> float:
    """Noise [channel's unit] where the channel is most at rest, NaN if it repeats all along.

    It is the 10th percentile, over windows of 20 rows that do not repeat throughout, of the
    standard deviation that second differences show.
    """
    values = reading[np.isfinite(reading)]
    bend = np.diff(values, 2)
    bend = bend[: len(bend) // _WINDOW * _WINDOW].reshape(-1, _WINDOW)
    moving = (bend != 0.0).any(axis=1)
    return float(np.percentile(bend[moving].std(axis=1), 10) / math.sqrt(6.0)) if any(moving) else (
        math.nan)  # fmt: skip


def as_noisy_as_stated(sensor: Sensor, channel: str, floors: Sequence[float]) -> bool:
    """Whether the sensor's stated noise shows in this channel or others with the same sensor.

    Args:
        sensor: the sensor.
        channel: channel name.
        floors: `noise_floor` of these channels, the best witnesses first; NaN tells nothing.
    """
    stated = math.hypot(sensor.error_rms, converter(sensor, channel).step / 12**0.5)
    known = [floor for floor in floors if math.isfinite(floor)]
    return bool(known) and known[0] >= _QUIET * stated


def frozen_by_noise(
    reading: np.ndarray, probability: float, count: int, period: float
) -> list[Stretch]:
    """Stretches that repeat longer than noise allows.

    Args:
        reading: (n,) readings of one run, NaN where missing.
        probability: of `repeat_probability`.
        count: readings in the whole data set.
        period: time between rows [s].
    """
    shortest = max(longest_repeat(probability, count), math.ceil(_SHORTEST / period))
    return repeats(reading, shortest)


def frozen_by_motion(
    reading: np.ndarray, partner: np.ndarray | None, command: np.ndarray, others: np.ndarray,
    step: float, ranges: tuple[float, float], period: float,
) -> list[Stretch]:  # fmt: skip
    """Stretches in which a position repeats one value while the axis must have moved.

    Either the partner (the length of an angle, the angle of a length) moved; or the axis was
    strongly commanded in both directions, others moved, and the value is no end of the range.

    Args:
        reading: (n,) positions, NaN where missing [channel's unit].
        partner: (n,) the other sensor of the same axis, or None.
        command: (n,) the axis' command over the largest one [1].
        others: (n, k) positions of other axes.
        step: what the sensor resolves [channel's unit].
        ranges: span of the channel and of its partner over all runs, each in its unit; a span of 0
            is that of a channel that repeats one value for ever.
        period: time between rows [s].
    """
    own, partners = ranges
    least = own * 0.02
    low, high = np.nanmin(reading), np.nanmax(reading)
    found = []
    for part in repeats(reading, math.ceil(_SHORTEST_QUIET / period)):
        rows = slice(*part)
        if partner is not None and partners > 0.0:
            moved = _span(partner[rows]) / partners
            if moved > 0.05 and (own == 0.0 or moved * own > _PARTNER_STEPS * step):
                found.append(part)
                continue
        both = all(
            period * (sign * command[rows] > _STRONG).sum() >= _STRONG_TIME for sign in (1.0, -1.0)
        )
        value = np.nanmedian(reading[rows])
        at_end = own > 0.0 and (value - low < least or high - value < least)
        alive = any(_span(other[rows]) > 0.1 * _span(other) > 0.0 for other in others.T)
        if both and not at_end and alive:
            found.append(part)
    return found


def frozen_chamber(
    reading: np.ndarray, partner: np.ndarray, lowest: float, period: float
) -> list[Stretch]:
    """Stretches in which one chamber repeats a pressure while the other one's changes much.

    Args:
        reading: (n,) pressures, NaN where missing [Pa].
        partner: (n,) pressures of the other chamber [Pa].
        lowest: pressure below which a starved chamber rests on its make-up valve [Pa].
        period: time between rows [s].
    """
    return [
        part
        for part in repeats(reading, math.ceil(_SHORTEST_QUIET / period))
        if _span(partner[slice(*part)]) > _PARTNER_PRESSURE
        and np.nanmedian(reading[slice(*part)]) > lowest
    ]


def _span(values: np.ndarray) -> float:
    """Range between the 2nd and the 98th percentile, so that single readings do not count."""
    values = values[np.isfinite(values)]
    return float(np.diff(np.percentile(values, [2, 98]))[0]) if len(values) else 0.0


def repeated_rows(
    reading: np.ndarray, probability: Sequence[float | None], count: int
) -> np.ndarray:
    """Rows in which every reading equals that of the row before, which noise forbids.

    Args:
        reading: (n, c) readings, NaN where missing.
        probability: per channel, of `repeat_probability`; None where repeats tell nothing.
        count: readings in the whole data set.

    Returns:
        (n,) bool.
    """
    noisy = [c for c, p in enumerate(probability) if p is not None]
    if not noisy:
        return np.zeros(len(reading), dtype=bool)
    logs = np.log([p for p in probability if p is not None])
    pairs = np.isfinite(reading[1:, noisy]) & np.isfinite(reading[:-1, noisy])
    equal = pairs & (reading[1:, noisy] == reading[:-1, noisy])
    improbable = (equal * logs).sum(axis=1) < math.log(_BY_CHANCE / max(count, 1))
    return np.append(False, improbable & (equal == pairs).all(axis=1) & pairs.any(axis=1))

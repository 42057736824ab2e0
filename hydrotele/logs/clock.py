"""Uniform clocks fitted to time stamps, and the offset between the clocks of two files [s].

The stamps may have jitter, drift or missing rows. The offset follows from commands that both files contain.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError

_MAX_REGULAR_JITTER = 0.01  # of a step: with less jitter each row is one tick, even with drift
_TRACKING_GAIN = 0.1  # fraction of a stamp's deviation by which the tracking clock is corrected
_MIN_NOTED_JITTER = 0.02  # of a step: smaller jitter is rounding
_MAX_ROUNDING_ERROR = 0.005  # of a step over a whole run: tolerance for rounding the period
_MAX_CLOCK_RMS = 0.22  # RMS of a step; stamps without any clock have 1 / sqrt(12) = 0.29
_MAX_SHARED_FRACTION = 0.01  # maximum fraction of rows that share their nearest tick with another row
_TICKS_PER_IRREGULAR_STEP = 5  # ticks per step for irregular rows, so that the time error is at most a tenth of a step
_MAX_STEP_DEVIATION = 0.5  # of a step: deviation up to which a step counts as regular
_MIN_REGULAR_FRACTION = 0.9  # minimum fraction of regular steps


class Clock(NamedTuple):
    """A uniform clock and the ticks of the rows of a log.

    Attributes:
        start: time of tick 0 [s].
        period: time between ticks [s].
        row: (n,) used rows of the log, increasing.
        tick: (n,) tick of each used row, increasing, starting at 0.
        hold: maximum number of ticks for which the command of a row is held; later ticks without a
            row count as missing.
    """

    start: float
    period: float
    row: np.ndarray
    tick: np.ndarray
    hold: int = 1


def fit_clock(time: np.ndarray, where: str) -> tuple[Clock, tuple[str, ...]]:
    """Fit a uniform clock to the time stamps of a log, and assign each row to a tick of the clock.

    The period is estimated by least squares, so that a slightly fast or slow clock loses no row.
    Each row is assigned to the nearest tick. If two rows have the same tick, the closer one is
    used. Some logs have no uniform clock, as those of a loop that sleeps between rows. For these
    the clock has five ticks per median step, so that rows keep their times approximately and some
    ticks have no row.

    Args:
        time: (n,) increasing time stamps [s].
        where: name of the log, for messages.

    Returns:
        (clock, notes on jitter and on removed rows).

    Raises:
        InputError: the steps are too irregular.

    >>> clock, notes = fit_clock(np.array([5.0, 5.1, 5.2, 5.5, 5.6]), "a log")
    >>> round(clock.period, 6), clock.tick.tolist(), notes
    (0.1, [0, 1, 2, 5, 6], ())
    """
    period = float(np.median(np.diff(time)))
    if np.abs(np.diff(time) / period - 1.0).max() < _MAX_REGULAR_JITTER:
        tick = np.arange(len(time))
    else:
        tick = _track_ticks(time, period)
    since_first = time - time[0]  # more exact than the time of a calendar clock
    period, start = np.polyfit(tick, since_first, 1)
    for _ in range(3):  # alternate between assigning ticks and fitting the line
        tick = np.rint((since_first - start) / period).astype(int)
        period, start = np.polyfit(tick, since_first, 1)
    period, start = float(period), float(start + time[0])
    off = (time - start) / period - tick
    shared = np.mean(np.diff(tick) == 0)
    if np.sqrt(np.mean(off**2)) > _MAX_CLOCK_RMS or shared > _MAX_SHARED_FRACTION:
        return _fit_irregular_clock(time, where)
    return _make_clock(time, tick, off, start, period, where)


def _fit_irregular_clock(time: np.ndarray, where: str) -> tuple[Clock, tuple[str, ...]]:
    step = np.diff(time)
    period = float(np.median(step))
    paced = np.abs(step / period - 1.0) <= _MAX_STEP_DEVIATION
    if paced.mean() < _MIN_REGULAR_FRACTION:
        raise InputError(
            where,
            f"the time stamps follow no clock: {100 * np.mean(~paced):.0f} % of the steps differ by"
            f" more than {100 * _MAX_STEP_DEVIATION:.0f} % from the median step of {period:.4g} s. Log or"
            " resample at a fixed rate",
        )
    fine = period / _TICKS_PER_IRREGULAR_STEP
    tick, row = np.unique(np.rint((time - time[0]) / fine).astype(int), return_index=True)
    scatter = 100 * float(np.std(step[paced] / period))
    notes = (
        f"{where}: the rows have no common clock, the standard deviation of their steps is"
        f" {scatter:.2g} %; each row is placed at its time on a clock of {1 / fine:.6g} Hz.",
    )
    if extra := len(time) - len(row):
        notes += (f"{where}: {extra} rows have the same tick as another row and were removed.",)
    return Clock(
        float(time[0]),
        fine,
        row,
        tick,
        int((1.0 + _MAX_STEP_DEVIATION) * _TICKS_PER_IRREGULAR_STEP) + 1,
    ), notes


def _make_clock(time, tick, off, start, period, where) -> tuple[Clock, tuple[str, ...]]:
    order = np.lexsort((np.abs(off), tick))
    _, first = np.unique(tick[order], return_index=True)
    row = np.sort(order[first])
    notes: tuple[str, ...] = ()
    if np.abs(off[row]).max() > _MIN_NOTED_JITTER:
        rms = 100 * float(np.sqrt(np.mean(off[row] ** 2)))
        notes += (
            f"{where}: the time stamps have a jitter of {rms:.2g} % of a step; every row was moved"
            f" to the nearest tick of {1 / period:.6g} Hz.",
        )
    if extra := len(time) - len(row):
        notes += (f"{where}: {extra} rows have the same tick as another row and were removed.",)
    if np.abs(off[row]).max() <= _MIN_NOTED_JITTER:
        start = float(time[row[0]])
    else:
        start += period * float(tick[row[0]])
    return Clock(start, _round_period(period, len(time)), row, tick[row] - tick[row[0]]), notes


def _track_ticks(time: np.ndarray, period: float) -> np.ndarray:
    """Return the tick (n,) of each time stamp (n,) [s], for stamps with jitter and a slightly wrong period.

    The function advances a predicted time by whole periods to each stamp, and corrects it by a
    tenth of the stamp's deviation. The first tick is 0.
    """
    tick = np.zeros(len(time), dtype=int)
    at = time[0]
    for row in range(1, len(time)):
        ahead = max(0, round((time[row] - at) / period))
        tick[row] = tick[row - 1] + ahead
        at += ahead * period
        at += _TRACKING_GAIN * (time[row] - at)
    return tick


def _round_period(period: float, rows: int) -> float:
    """Round a period [s] to a whole rate in Hz or a whole number of us.

    It is returned unchanged if rounding would shift the last of the rows by more than 0.5 % of a period.
    """
    for even in (1.0 / max(round(1.0 / period), 1), round(1e6 * period) * 1e-6):
        if abs(even - period) * rows < _MAX_ROUNDING_ERROR * period:
            return even
    return period


_MIN_OVERLAP_SECONDS = 5.0  # [s] minimum overlap of the two files
_MIN_CORRELATION = 0.95  # minimum correlation of two samplings of the same command signal
_COMMAND_TOLERANCE = 1.0e-6  # relative: tolerance for commands stored in single precision
_MIN_EQUAL_FRACTION = 0.99  # minimum fraction of equal rows if two files contain the same rows


def estimate_clock_offset(clock: Clock, command: np.ndarray, other: Clock, other_command: np.ndarray) -> float | None:
    """Estimate the offset between the clocks of two files from commands that both contain.

    The coarse offset maximises the correlation of the two command histories. If both files contain
    the same rows, their stamps give the exact offset. Otherwise the offset minimises the mean
    square difference of the linearly interpolated commands.

    Args:
        clock: reference clock (n rows).
        command: (n, k) commands at the rows of the reference clock.
        other: clock of the second file (m rows).
        other_command: (m, k) the same commands in the second file.

    Returns:
        The offset to add to the times of the second file [s]. None if it is not identifiable: the
        commands are constant, correlate by less than 0.95, or overlap for less than 5 s.
    """
    step = min(clock.period, other.period)
    a, b = _resample_zero_order_hold(clock, command, step), _resample_zero_order_hold(other, other_command, step)
    least = round(_MIN_OVERLAP_SECONDS / step)
    if min(len(a), len(b)) < least or not np.ptp(a, axis=0).any():
        return None
    alike, lags = _correlate_commands(a - a.mean(axis=0), b - a.mean(axis=0), least)
    best = alike.max()
    if not best >= _MIN_CORRELATION:
        return None
    near = np.flatnonzero(alike > best - 1.0e-6)
    stated = (other.start - clock.start) / step  # of equally good offsets use the smallest
    lag = int(lags[near[np.argmin(np.abs(lags[near] - stated))]])
    coarse = clock.start + lag * step - other.start
    exact = _offset_from_equal_rows(clock, command, other, other_command, coarse)
    return exact if exact is not None else _refine_offset(clock, command, other, other_command, coarse)


def _resample_zero_order_hold(clock: Clock, values: np.ndarray, step: float) -> np.ndarray:
    """Resample values (n, k) at the rows of a clock to a uniform step [s] by zero-order hold.

    Between two rows the result repeats the earlier one.
    """
    time = clock.tick * clock.period
    at = np.arange(round(time[-1] / step) + 1) * step
    return values[np.searchsorted(time, at + 1e-6 * step, side="right") - 1]


def _correlate_commands(a: np.ndarray, b: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalised correlation of two command histories for every shift between them.

    Args:
        a: (n, k) first history, at a uniform step.
        b: (m, k) second history, at the same step.
        least: smallest number of overlapping rows.

    Returns:
        (correlation of a[i + lag] and b[i], 0 where the overlap is too short; lags [steps]).
    """
    columns = range(a.shape[1])
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))
    from scipy.signal import correlate  # slow to import, and most runs have only one file

    product = sum(correlate(a[:, k], b[:, k], method="fft") for k in columns)
    power_a = sum(correlate(a[:, k] ** 2, ones_b, method="fft") for k in columns)
    power_b = sum(correlate(ones_a, b[:, k] ** 2, method="fft") for k in columns)
    overlap = np.rint(correlate(ones_a, ones_b, method="fft"))
    lags = np.arange(-(len(b) - 1), len(a))
    enough = overlap >= max(least, 0.5 * min(len(a), len(b)))
    power = np.sqrt(np.maximum(power_a * power_b, 0.0))
    enough &= power > 1e-6 * power.max()
    return np.where(enough, product / np.where(enough, power, 1.0), 0.0), lags


def _offset_from_equal_rows(clock: Clock, command, other: Clock, other_command, coarse: float) -> float | None:
    if abs(clock.period / other.period - 1.0) > 1e-3:
        return None
    size = np.abs(command).max()
    first = round((other.start + coarse - clock.start) / clock.period)
    for shift in (first, first - 1, first + 1):
        _, mine, theirs = np.intersect1d(clock.tick, other.tick + shift, return_indices=True)
        if not len(mine):
            continue
        equal = np.abs(command[mine] - other_command[theirs]).max(axis=1) <= _COMMAND_TOLERANCE * size
        if equal.mean() >= _MIN_EQUAL_FRACTION and np.ptp(command[mine], axis=0).any():
            own = clock.start + clock.tick[mine] * clock.period
            return float(np.median(own - (other.start + other.tick[theirs] * other.period)))
    return None


def _refine_offset(clock: Clock, command, other: Clock, other_command, coarse: float) -> float:
    own = clock.start + clock.tick * clock.period
    time = other.start + other.tick * other.period

    def mean_square_difference(offset: float) -> float:
        inside = (own >= time[0] + offset) & (own <= time[-1] + offset)
        return sum(
            float(np.mean((np.interp(own[inside], time + offset, theirs) - mine[inside]) ** 2))
            for mine, theirs in zip(command.T, other_command.T, strict=True)
        )

    width = 2.0 * max(clock.period, other.period)
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(mean_square_difference, bounds=(coarse - width, coarse + width), method="bounded",
                            options={"xatol": 1e-3 * clock.period})  # fmt: skip
    return float(found.x)  # type: ignore[union-attr]

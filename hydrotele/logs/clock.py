"""The clock of a log: stamps that jitter, wander or lack rows, as ticks of a uniform period."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError

_EVEN = 0.01  # of a step: stamps this even are one tick per row, whatever their drift
_GAIN = 0.1  # of a stamp's deviation that the tracking clock takes over
_NOTED = 0.02  # of a step: jitter below this is rounding
_LOST = 0.005  # of a step over a whole run, for a round period
_NO_CLOCK = 0.22  # RMS of a step; stamps without any clock have 1 / sqrt(12) = 0.29
_SHARED = 0.01  # of the rows may be nearest to a tick that another row has
_FINE = 5  # ticks per step where rows keep no common clock, so that they are off by a tenth at most
_PACE = 0.5  # of a step by which one may be longer or shorter
_PACED = 0.9  # of the steps must be so for a log that has a pace at least


class Clock(NamedTuple):
    """A uniform clock and where a log's rows stand on it.

    Attributes:
        start: time of tick 0 [s].
        period: time between ticks [s].
        row: (n,) rows of the log that are used, rising.
        tick: (n,) their ticks, rising, the first is 0.
        hold: ticks for which a row's command holds at most, if no other comes.
    """

    start: float
    period: float
    row: np.ndarray
    tick: np.ndarray
    hold: int = 1


def fit_clock(time: np.ndarray, where: str) -> tuple[Clock, tuple[str, ...]]:
    """Uniform clock behind time stamps.

    The period is that of the rows, by least squares, so that a clock that is a little fast or slow
    loses no row. Of two rows at one tick the nearer one is used. Stamps that only jitter about
    their ticks are taken for inexact stamps of exact rows; where the rows wander off any common
    clock, as those of a loop that sleeps between rows, the stamps are believed and stand on a clock
    five times as fast, with nothing on the ticks between.

    Args:
        time: (n,) rising [s].
        where: what the stamps belong to, for messages.

    Returns:
        (clock, notes on jitter and on rows left out).

    Raises:
        InputError: the stamps follow no clock.

    >>> clock, notes = fit_clock(np.array([5.0, 5.1, 5.2, 5.5, 5.6]), "a log")
    >>> round(clock.period, 6), clock.tick.tolist(), notes
    (0.1, [0, 1, 2, 5, 6], ())
    """
    period = float(np.median(np.diff(time)))
    if np.abs(np.diff(time) / period - 1.0).max() < _EVEN:
        tick = np.arange(len(time))
    else:
        tick = _tracked(time, period)
    period, start = np.polyfit(tick, time, 1)
    for _ in range(3):  # the ticks of a line through all stamps, no longer of the first one
        tick = np.rint((time - start) / period).astype(int)
        period, start = np.polyfit(tick, time, 1)
    period, start = float(period), float(start)
    off = (time - start) / period - tick
    shared = np.mean(np.diff(tick) == 0)
    if np.sqrt(np.mean(off**2)) > _NO_CLOCK or shared > _SHARED:
        return _wandering(time, where)
    return _clock(time, tick, off, start, period, where)


def _wandering(time: np.ndarray, where: str) -> tuple[Clock, tuple[str, ...]]:
    step = np.diff(time)
    period = float(np.median(step))
    paced = np.abs(step / period - 1.0) <= _PACE
    if paced.mean() < _PACED:
        raise InputError(
            where,
            f"the time stamps follow no clock: {100 * np.mean(~paced):.0f} % of the steps are more"
            f" than {100 * _PACE:.0f} % off the usual one of {period:.4g} s. Log, or resample, at a"
            " fixed rate",
        )
    fine = period / _FINE
    tick, row = np.unique(np.rint((time - time[0]) / fine).astype(int), return_index=True)
    scatter = 100 * float(np.std(step[paced] / period))
    notes = (
        f"{where}: the rows keep no common clock, their steps scatter by {scatter:.2g} %; each"
        f" stands at its own time on a clock of {1 / fine:.6g} Hz.",
    )
    if extra := len(time) - len(row):
        notes += (f"{where}: {extra} rows share a tick with another row and were left out.",)
    return Clock(float(time[0]), fine, row, tick, int((1.0 + _PACE) * _FINE) + 1), notes


def _clock(time, tick, off, start, period, where) -> tuple[Clock, tuple[str, ...]]:
    order = np.lexsort((np.abs(off), tick))
    _, first = np.unique(tick[order], return_index=True)
    row = np.sort(order[first])
    notes: tuple[str, ...] = ()
    if np.abs(off[row]).max() > _NOTED:
        rms = 100 * float(np.sqrt(np.mean(off[row] ** 2)))
        notes += (
            f"{where}: the time stamps jitter by {rms:.2g} % of a step; every row was put on the"
            f" nearest tick of {1 / period:.6g} Hz.",
        )
    if extra := len(time) - len(row):
        notes += (f"{where}: {extra} rows share a tick with another row and were left out.",)
    if np.abs(off[row]).max() <= _NOTED:
        start = float(time[row[0]])
    else:
        start += period * float(tick[row[0]])
    return Clock(start, _rounded(period, len(time)), row, tick[row] - tick[row[0]]), notes


def _tracked(time: np.ndarray, period: float) -> np.ndarray:
    """Ticks (n,) from a clock that follows the stamps row by row."""
    tick = np.zeros(len(time), dtype=int)
    at = time[0]
    for row in range(1, len(time)):
        ahead = max(0, round((time[row] - at) / period))
        tick[row] = tick[row - 1] + ahead
        at += ahead * period
        at += _GAIN * (time[row] - at)
    return tick


def _rounded(period: float, rows: int) -> float:
    """The period of a round rate [Hz], or round period [us], if it loses no time over the rows."""
    for even in (1.0 / max(round(1.0 / period), 1), round(1e6 * period) * 1e-6):
        if abs(even - period) * rows < _LOST * period:
            return even
    return period

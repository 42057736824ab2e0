"""Channels that are refreshed more slowly than they are logged: only fresh readings are readings.

A logger that runs at 1 kHz beside a bus that carries a pressure every 20 ms writes each value 20
times. Taken for 20 readings, their one error would count as noise of its own colour, and their age
as a delay that saws between none and 20 ms.
"""

import numpy as np

_LEAST = 20  # changes that must be seen
_REGULAR = 0.9  # of the values last equally long, or a whole number of times as long
_HURRIED = 0.01  # of the values may last for one reading only
_ONE_STEP = 0.9  # of the changes are one converter step where a coarse sensor moves slowly
_EQUAL = 1.05  # times the least change, up to which one is as large


def refreshed_every(reading: np.ndarray) -> float:
    """Logged readings from one fresh value of a channel to the next; 1 where each is fresh.

    A sensor without noise repeats, too, at rest or between two steps of its converter, but for as
    long as its motion has it, and then goes on by one step. One that is refreshed by a clock
    repeats for a fixed number of readings, one more or less where the clocks run apart.

    Args:
        reading: (n,) readings, NaN where missing.

    Returns:
        The mean number of readings, at least 1.

    >>> refreshed_every(np.repeat(np.random.default_rng(0).normal(size=50), 4))
    4.0
    """
    values = reading[np.isfinite(reading)]
    change = np.diff(values)
    lasted = np.diff(np.flatnonzero(change))
    if len(lasted) < _LEAST or np.mean(lasted == 1) > _HURRIED:
        return 1.0
    size = np.abs(change[change != 0.0])
    if np.mean(size < _EQUAL * size.min()) > _ONE_STEP:
        return 1.0
    usual = np.median(lasted)
    times = np.maximum(np.rint(lasted / usual), 1.0)
    once = times == 1.0
    regular = np.abs(lasted - times * usual) <= 1.0
    if min(regular.mean(), once.mean()) < _REGULAR:
        return 1.0
    return float(lasted[once & regular].mean())


def stale(reading: np.ndarray, every: float) -> np.ndarray:
    """Which readings only repeat the one before because no fresh one has come.

    A value that stays for longer than it takes to refresh it was refreshed and was the same.

    Args:
        reading: (n,) readings, NaN where missing.
        every: readings from one fresh one to the next.

    Returns:
        (n,) bool.

    >>> stale(np.array([1.0, 1.0, 2.0, 2.0, 2.0, 2.0]), 2.0).tolist()
    [False, True, False, True, False, True]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    place = np.arange(len(rows))
    changed = np.append(True, np.diff(reading[rows]) != 0.0)[: len(rows)]
    since = place - np.maximum.accumulate(np.where(changed, place, 0))
    again = np.rint(np.rint(since / every) * every) == since
    lasts = np.append(np.flatnonzero(changed)[1:], len(rows))[np.cumsum(changed) - 1] - place
    fresh = changed | (again & (lasts >= np.floor(every)))
    old = np.zeros(len(reading), dtype=bool)
    old[rows] = ~fresh
    return old

"""Packets of a network: delays that change from one to the next, ages when they are used."""

import csv
import math
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError


def ages_of(delays: np.ndarray) -> np.ndarray:
    """Ages of the newest packets that have arrived; those that were overtaken are dropped.

    Args:
        delays: (n,) of the packets sent in periods 0 .. n - 1, in whole periods; below 0 lost.

    Returns:
        (n,) ages in periods; the number of the period itself, plus 1, before any has arrived.

    >>> ages_of(np.array([2, 0, 3, 1, 0])).tolist()  # the first and the third are overtaken
    [1, 0, 1, 2, 0]
    """
    delays = np.asarray(delays)
    count = len(delays)
    newest = np.full(count, -1)
    sent = np.arange(count)
    arrival = sent + delays
    there = (delays >= 0) & (arrival < count)
    np.maximum.at(newest, arrival[there], sent[there])
    return sent - np.maximum.accumulate(newest)


def arrivals(delays: np.ndarray) -> np.ndarray:
    """When newer packets arrive than the one in use.

    Args:
        delays: (n,) as of `ages_of`.

    Returns:
        (n,) age in periods of the packet that arrives, -1 where none arrives that is newer. Before
        the first one it is the longest delay, as of a line that carries zeros.

    >>> arrivals(np.array([2, 0, 3, 1, 0])).tolist()
    [3, 0, -1, -1, 0]
    """
    delays = np.asarray(delays)
    ages, ticks = ages_of(delays), np.arange(len(delays))
    newest = ticks - ages
    fresh = np.diff(newest, prepend=-1) > 0
    return np.where(newest < 0, max(int(delays.max()), 0), np.where(fresh, ages, -1))


def in_periods(delays: np.ndarray, period: float) -> np.ndarray:
    """Delays [s] as whole periods, -1 for lost packets (NaN)."""
    rounded = np.where(np.isnan(delays), -1.0, np.round(np.nan_to_num(delays) / period))
    return rounded.astype(int)


def load_delays(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Measured delays of a network.

    Args:
        path: CSV file with the columns `forward` and `back` [s], one row for every packet in the
            order in which they were sent; an empty cell is a packet that was lost.

    Returns:
        ((n,), (n,)) delays forward and back [s], NaN where lost.

    Raises:
        InputError: the file cannot be read, a column is missing, a cell is no delay.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read: {error}") from None
    if not rows:
        raise InputError(path, "has no rows; give one for every packet")
    found = []
    for name in ("forward", "back"):
        if name not in rows[0]:
            have = ", ".join(map(str, rows[0]))
            raise InputError(path, f"has no column {name!r}; it has {have}; delays are in seconds")
        found.append(np.array([_delay(path, k + 2, name, row[name]) for k, row in enumerate(rows)]))
    return found[0], found[1]


def _delay(path: str | Path, line: int, name: str, cell: str | None) -> float:
    if cell is None or not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 10.0:
        message = f"line {line}, {name}: {cell!r} is no delay from 0 to 10 s; leave lost ones empty"
        raise InputError(path, message)
    return value

"""Delays of network packets [s] from a file, and the ages of the packets that are in use [control periods].

The age is the number of periods since the packet that a side uses was sent.
"""

import csv
import math
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError


def compute_packet_ages(delays: np.ndarray) -> np.ndarray:
    """Return for every period the age of the newest packet that has arrived so far.

    The age is the number of periods since the packet was sent. A packet that arrives after a
    later-sent one is dropped.

    Args:
        delays: (n,) delays, in whole periods, of the packets sent in periods 0 .. n - 1; negative if
            lost.

    Returns:
        (n,) ages in periods. Before the first arrival the age is the number of the period plus 1.

    >>> compute_packet_ages(np.array([2, 0, 3, 1, 0])).tolist()  # the first and the third are overtaken
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


def compute_ages_on_arrival(delays: np.ndarray) -> np.ndarray:
    """Return for every period the age of the arriving packet, if it is newer than the one in use.

    The age is the number of periods since the packet was sent.

    Args:
        delays: (n,) delays, in whole periods, of the packets sent in periods 0 .. n - 1; negative if
            lost.

    Returns:
        (n,) age in periods of the arriving packet, -1 if no newer packet arrives. Until the first
        arrival, but not beyond the longest delay, it is the longest delay, as if packets had been sent
        before the first period.

    >>> compute_ages_on_arrival(np.array([2, 0, 3, 1, 0])).tolist()
    [3, 0, -1, -1, 0]
    >>> compute_ages_on_arrival(np.array([-1, -1, -1, 1, 1])).tolist()  # the packet of period 1 is lost
    [1, -1, -1, -1, 1]
    """
    delays = np.asarray(delays)
    ages, ticks = compute_packet_ages(delays), np.arange(len(delays))
    newest = ticks - ages
    fresh = np.diff(newest, prepend=-1) > 0
    longest = max(int(delays.max()), 0)
    before_start = (newest < 0) & (ticks < longest)
    return np.where(before_start, longest, np.where((newest >= 0) & fresh, ages, -1))


def delays_to_periods(delays: np.ndarray, period: float) -> np.ndarray:
    """Round packet delays [s] to whole periods; NaN, a lost packet, becomes -1."""
    rounded = np.where(np.isnan(delays), -1.0, np.round(np.nan_to_num(delays) / period))
    return rounded.astype(int)


def load_packet_delays(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the measured delays of network packets in both directions from a CSV file.

    Args:
        path: CSV file with the columns `forward` and `back` [s], one row for every packet in the
            order of sending; an empty cell is a lost packet.

    Returns:
        ((n,), (n,)) delays forward and back [s], NaN for lost packets.

    Raises:
        InputError: the file cannot be read, a column is missing, or a cell is not a valid delay.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read: {error}") from None
    if not rows:
        raise InputError(path, "has no rows; give one row per packet")
    found = []
    for name in ("forward", "back"):
        if name not in rows[0]:
            have = ", ".join(map(str, rows[0]))
            raise InputError(path, f"has no column {name!r}; columns: {have}; delays are in s")
        found.append(np.array([_parse_delay(path, k + 2, name, row[name]) for k, row in enumerate(rows)]))
    return found[0], found[1]


def _parse_delay(path: str | Path, line: int, name: str, cell: str | None) -> float:
    if cell is None or not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 10.0:
        message = f"line {line}, {name}: {cell!r} is not a delay (0 to 10 s, empty if lost)"
        raise InputError(path, message)
    return value

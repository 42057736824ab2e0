"""Runs logged faster than a hydraulic machine moves, averaged to a rate that filters can cross."""

import math

import numpy as np

from hydrotele.logs.rows import Rows

FASTEST = 1000.0  # [Hz] oil and valves are slow above some 300 Hz, and filters step at 1 ms
_SLACK = 0.1  # of a row: 1.05 kHz passes for 1 kHz


def averaged(rows: Rows, fastest: float = FASTEST) -> tuple[Rows, np.ndarray, int]:
    """A run at no more than a rate, each row the mean of several logged ones.

    Commands are means over the new row, which they are held for. Readings are means over the
    logged rows about the new row's time, as many before as after, so that nothing is shifted; a
    mean over a row damps what lies above half the new rate and would be seen at another frequency.
    Readings that repeat, as those of an encoder at rest, count once: their error is the same.

    Args:
        rows: the run.
        fastest: the rate [Hz].

    Returns:
        (the run, (c,) logged readings behind one of its readings, logged rows per row).
    """
    count = math.ceil(1.0 / (fastest * rows.period) - _SLACK)
    ones = np.ones(rows.reading.shape[1])
    if count < 2:
        return rows, ones, 1
    whole = len(rows.command) // count
    blocks = {
        name: getattr(rows, name)[: whole * count].reshape(whole, count, -1)
        for name in ("command", "known", "valid")
    }
    weights = np.ones(2 * (count // 2) + 1)
    if count % 2 == 0:
        weights[[0, -1]] = 0.5
    half = len(weights) // 2
    gap = np.full((half, rows.reading.shape[1]), np.nan)
    padded = np.concatenate([gap, rows.reading, gap])
    total, weight, square, unlike = np.zeros((4, whole, rows.reading.shape[1]))
    last = np.full(total.shape, np.nan)
    for shift, share in enumerate(weights):
        reading = padded[shift : shift + whole * count : count]
        there = np.isfinite(reading)
        total += share * np.where(there, reading, 0.0)
        weight += share * there
        square += share**2 * there
        unlike += there & (reading != last)
        last = np.where(there, reading, last)
    with np.errstate(invalid="ignore"):  # NaN where nothing was read
        reading, behind = total / weight, np.minimum(weight**2 / square, unlike)
    read = np.isfinite(behind).any(axis=0)
    ones[read] = np.nanmedian(behind[:, read], axis=0)
    return Rows(
        rows.start, rows.period * count, blocks["command"].mean(axis=1),
        blocks["known"].any(axis=(1, 2)), reading, blocks["valid"].all(axis=(1, 2)),
    ), ones, count  # fmt: skip

"""Detection of wild readings: single samples far outside their neighbours, such as transmission errors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.identify.record import IdentificationRecord

_NEIGHBOURS = 3  # rows on each side of a reading
_MIN_NOISE_RATIO = 8.0  # robust standard deviations of the noise: normal noise exceeds it in 1e-15 of all rows
_MIN_RANGE_FRACTION = 0.5  # of the central 90 % of the signal: smaller jumps may be friction at a short reversal
_END_FACTOR = 4.0  # of the limit, for the first and last rows: a slope leaves their one-sided neighbours, too
_STD_OVER_MAD = 1.4826  # standard deviation over median absolute deviation of normal noise


def find_wild_readings(values: np.ndarray) -> np.ndarray:
    """Find readings that lie far outside their neighbours.

    The inner range of a reading's six neighbours is that without their largest and smallest value. A reading is
    wild if it lies outside by more than the width of this range, by more than eight standard deviations of the
    noise, and by more than half of the central 90 % range of the signal. At the first and last three rows it must
    be four times as far outside. Steps and smooth peaks are not wild. Up to two wild readings in a row are found.

    Args:
        values: (n,) readings, NaN where unknown.

    Returns:
        (n,) whether a reading is wild.

    >>> import numpy as np
    >>> signal = np.sin(0.1 * np.arange(100.0))
    >>> signal[40] = 30.0
    >>> np.flatnonzero(find_wild_readings(signal)).tolist()
    [40]
    """
    wild, known = np.zeros(len(values), bool), np.flatnonzero(np.isfinite(values))
    if len(known) <= 2 * _NEIGHBOURS + 1:
        return wild
    reading = values[known]
    width = 2 * _NEIGHBOURS + 1
    first = np.clip(np.arange(len(reading)) - _NEIGHBOURS, 0, len(reading) - width)  # near the ends, one-sided
    windows = np.lib.stride_tricks.sliding_window_view(reading, width)[first]
    is_own = np.arange(width) == (np.arange(len(reading)) - first)[:, None]
    others = np.sort(windows[~is_own].reshape(-1, width - 1), axis=1)
    low, high = others[:, 1], others[:, -2]  # a second wild reading among the neighbours does not widen the range
    outside = np.maximum(low - reading, reading - high)
    from_median = reading - np.median(windows, axis=1)
    noise = _STD_OVER_MAD * np.median(np.abs(from_median))
    least, most = np.quantile(reading, [0.05, 0.95])
    limit = np.maximum(high - low, max(_MIN_NOISE_RATIO * noise, _MIN_RANGE_FRACTION * (most - least)))
    is_at_end = first != np.arange(len(reading)) - _NEIGHBOURS
    wild[known] = outside > np.where(is_at_end, _END_FACTOR, 1.0) * limit
    return wild


def remove_wild_readings(
    record: IdentificationRecord, drives: Sequence[str]
) -> tuple[IdentificationRecord, tuple[str, ...]]:
    """Remove single readings far outside their neighbours from a record's forces and positions.

    Wild forces become unknown (NaN); wild positions are replaced by interpolation between their neighbours.

    Args:
        record: the record.
        drives: names of the drives of its forces.

    Returns:
        The corrected record, and one note per column with wild readings.
    """
    force, position, notes = record.force.copy(), record.position.copy(), []
    rows = np.arange(len(force))
    for table, names, what in ((force, drives, "force"), (position, record.axes, "position")):
        for k, name in enumerate(names):
            wild = find_wild_readings(table[:, k])
            if not wild.any():
                continue
            first = record.period * np.flatnonzero(wild)[0]
            notes.append(
                f"{record.name}: {wild.sum()} of {len(rows)} readings of the {what} of {name} lie far outside their"
                f" neighbours, the first at {first:.4g} s; left out."
            )
            table[wild, k] = np.nan
            if what == "position":
                known = np.isfinite(table[:, k])
                table[wild, k] = np.interp(rows[wild], rows[known], table[known, k])
    return (replace(record, force=force, position=position), tuple(notes)) if notes else (record, ())

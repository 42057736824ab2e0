"""Repair the time stamps of a log so that they increase.

The stamps may be out of order, repeat, be calendar time, or jump where the clock of the logger was set.
Each repair is reported in a note. At such a jump, the elapsed time is unknown. A pause of 2 s is
inserted there, at which every analysis splits the run.
"""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.logs.table import Table

CUT_SECONDS = 2.0  # [s] pause placed at a cut; twice the 1 s at which runs are split
_MAX_START_SECONDS = 1.0e6  # [s] 11 days: later stamps are calendar time, steps longer than it a set clock
_MIN_SORTED_STEP = 0.75  # of a step: sorting gives new steps of 1 for rows out of order, 0.5 to 0.67 for a set clock
_MAX_SORTED_STEP = 2.0  # of a step: longer ones join parts of the file that are in order each
_MAX_STEP = 1.0  # [s] longer than any sample period of a hydraulic machine
_MAX_DISCARDED_FRACTION = 0.5  # of the readings: more rows per stamp mean that the stamps are too coarse


def repair_time_stamps(table: Table, minimum_rows: int) -> tuple[Table, float, tuple[str, ...]]:
    """Return a table with increasing time stamps.

    Rows out of order are sorted, unless a clock that was set back is the more likely cause. Rows
    with the same stamp become one row with the last value of each column. Where the clock was set
    back, or forward by more than 11 days, a pause of at least 2 s is inserted: the later rows are
    shifted in time. If the first stamp is beyond 1e6 s (11 days), it is calendar time, and time is
    counted from it.

    Args:
        table: table in SI units with the column `time`, finite.
        minimum_rows: number of rows that the longest part between two jumps of the clock must have.

    Returns:
        (table, original stamp that corresponds to time 0 [s], notes).

    Raises:
        InputError: the stamps are too coarse for the rows or not in seconds, or the clock is set
            back too often.
    """
    table, notes = _sort_rows(table)
    table, note = _merge_equal_stamps(table)
    notes += note
    _check_step(table)
    table, note = _insert_pause_at_clock_jumps(table, minimum_rows)
    notes += note
    time = _time_column(table)
    if abs(origin := float(time[0])) <= _MAX_START_SECONDS:
        return table, 0.0, notes
    notes += (f"{table.source}: the time stamps begin at {origin:.10g} s; time is counted from there.",)
    return _replace_time(table, time - origin), origin, notes


def _time_column(table: Table) -> np.ndarray:
    return table.values[list(table.names).index("time")]


def _replace_time(table: Table, time: np.ndarray) -> Table:
    values = [time if name == "time" else v for name, v in zip(table.names, table.values, strict=True)]
    return table._replace(values=values)


def _select_rows(table: Table, rows: np.ndarray) -> Table:
    lines = None if table.lines is None else table.lines[rows]
    return table._replace(values=[values[rows] for values in table.values], lines=lines)


def _sort_rows(table: Table) -> tuple[Table, tuple[str, ...]]:
    """Return the table with its rows sorted by time, and notes.

    The rows are not sorted if their time steps would be irregular. The clock was then set back, and
    sorting would mix rows of different moments.
    """
    time = _time_column(table)
    step = np.diff(time)
    if not (step < 0.0).any():
        return table, ()
    order = np.argsort(time, kind="stable")
    moved = order != np.arange(len(time))
    period = float(np.median(np.abs(step[step != 0.0])))
    new_steps = np.diff(time[order])[np.diff(order) != 1]  # between rows that were no neighbours
    fitting = np.where(new_steps <= _MAX_SORTED_STEP * period, np.minimum(new_steps, period), 0.0)
    if fitting.mean() < _MIN_SORTED_STEP * period:
        return table, ()
    first = int(np.flatnonzero(step < 0.0)[0]) + 1
    note = f"{table.location('time', first)}: {moved.sum()} rows are not in the order of time; they were sorted."
    return _select_rows(table, order), (note,)


def _merge_equal_stamps(table: Table) -> tuple[Table, tuple[str, ...]]:
    """Return the table with consecutive rows of the same time stamp merged to one row, and notes.

    A merged row has the last number of each column; its `valid` is 0 if that of any merged row is.

    Raises InputError if more than half of the readings would be lost.
    """
    time = _time_column(table)
    repeats = np.diff(time) == 0.0
    if not repeats.any():
        return table, ()
    starts = np.append(0, np.flatnonzero(~repeats) + 1)
    ends = np.append(starts[1:], len(time))
    values, discarded, readings = [], 0, 0
    for name, column in zip(table.names, table.values, strict=True):
        known = np.isfinite(column)
        last = np.maximum.accumulate(np.where(known, np.arange(len(column)), -1))[ends - 1]
        merged = np.where(last >= starts, column[last], np.nan)
        if name == "valid":
            merged = np.fmin.reduceat(column, starts)
        elif name != "time":
            readings += int(known.sum())
            discarded += int(known.sum()) - int(np.isfinite(merged).sum())
        values.append(merged)
    if discarded > _MAX_DISCARDED_FRACTION * readings:
        message = (
            f"{len(time)} rows share {len(starts)} time stamps: the stamps are coarser than the rows. Log time"
            " with more digits"
        )
        raise InputError(table.location("time", int(np.flatnonzero(repeats)[0]) + 1), message)
    first = int(np.flatnonzero(repeats)[0]) + 1
    note = (
        f"{table.location('time', first)}: {len(time) - len(starts)} rows repeat the time stamp of the row before;"
        " of rows with the same stamp the last value of each column is used."
    )
    lines = None if table.lines is None else table.lines[starts]
    return table._replace(values=values, lines=lines), (note,)


def _check_step(table: Table) -> None:
    """Raise InputError if the median time step is at least 1 s, because the stamps are then probably not in seconds."""
    step = np.diff(_time_column(table))
    period = float(np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0
    if period >= _MAX_STEP:
        remedy = "looks like milliseconds or less, write seconds, or state the unit, as in 'time [ms]'"
        raise InputError(table.location("time", 1), f"increases by {period:g} per row: {remedy}")


def _insert_pause_at_clock_jumps(table: Table, minimum_rows: int) -> tuple[Table, tuple[str, ...]]:
    """Shift the rows after each jump of the clock in time, so that a pause of at least 2 s precedes them.

    A jump is a step back, or forward by more than 11 days.

    Returns:
        (table, notes).

    Raises:
        InputError: no part between jumps has `minimum_rows` rows.
    """
    time = _time_column(table)
    step = np.diff(time)
    set_clock = (step < 0.0) | (step > _MAX_START_SECONDS)
    if not set_clock.any():
        return table, ()
    cuts = np.flatnonzero(set_clock) + 1
    if np.diff(cuts, prepend=0, append=len(time)).max() < minimum_rows:
        message = (
            f"the clock is set back or forward {len(cuts)} times, so that no {minimum_rows} successive rows are in"
            " the order of time: log the time of a clock that is not set"
        )
        raise InputError(table.location("time", int(cuts[0])), message)
    period = float(np.median(step[~set_clock]))
    pause = math.ceil(CUT_SECONDS / period) * period
    moved = np.where(set_clock, pause - step, 0.0)
    notes = tuple(
        f"{table.location('time', int(row))}: the clock is set {'back' if step[row - 1] < 0.0 else 'forward'} by"
        f" {abs(step[row - 1] - period):.4g} s; the run is cut there, and the later rows"
        f" follow after a pause of {pause:.3g} s."
        for row in cuts[:3]
    )
    if len(cuts) > 3:
        notes += (f"{table.source}: the clock is set {len(cuts) - 3} more times; the run is cut there.",)
    return _replace_time(table, time + np.append(0.0, np.cumsum(moved))), notes

"""Put the rows of a run, from one or several log files, on one uniform clock.

`merge_run` merges the files, splits the run at long gaps and masked intervals, and marks unusable rows
(the column `valid`, or a mask file), for example those in contact. `average_rows` reduces the rate of runs
that are logged faster than a hydraulic machine moves.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.logs.clock import Clock, estimate_clock_offset, fit_clock
from hydrotele.logs.log import Log
from hydrotele.logs.masked_intervals import MaskedInterval, find_unmasked_rows
from hydrotele.logs.run_files import RunFiles

MAX_GAP_SECONDS = 1.0  # [s] longer gaps split a run, because the command history is unknown
MAX_MASK_SECONDS = 0.2  # [s] longer masked intervals split a run, because the state is unknown
_MAX_REFINEMENT = 5  # maximum number of ticks per row of the file with the commands
_SLOW_RATE = 20.0  # [Hz] below it a row is longer than the response time of a valve
_MAX_TIME_ERROR = 0.05  # of a row's period: tolerance for the time of a reading


class RunRows(NamedTuple):
    """A run on a uniform clock.

    Attributes:
        start: time of the first row [s].
        period: time between rows [s].
        command: (n, nu) commands, held until the next row.
        known: (n,) whether the command of the row was logged.
        reading: (n, c) readings, NaN where missing.
        valid: (n,) whether the row may be used; readings of other rows are NaN.
    """

    start: float
    period: float
    command: np.ndarray
    known: np.ndarray
    reading: np.ndarray
    valid: np.ndarray


def merge_run(
    run: RunFiles,
    axes: Sequence[str],
    channels: Sequence[str],
    masks: Sequence[MaskedInterval] = (),
) -> tuple[tuple[RunRows, ...], tuple[str, ...]]:
    """Merge the files of a run on one uniform clock, and split the run at gaps and masked intervals.

    The file with the most commands defines the clock. If other files have rows between its rows,
    the period is divided by up to five, so that every reading keeps its time. Readings are NaN at
    ticks for which the files have none.

    Args:
        run: the files of the run.
        axes: the nu axes.
        channels: the c channels.
        masks: masked intervals, in addition to the rows with `valid` 0 in the files.

    Returns:
        (pieces of the run, notes). The run is split at gaps of more than 1 s between rows and at
        masked intervals of more than 0.2 s. The masked intervals at which it is split belong to no
        piece.

    Raises:
        InputError: time stamps follow no clock.
    """
    commands = [f"command.{axis}" for axis in axes]
    logs = sorted(run.logs, key=lambda log: -sum(c in log for c in commands))
    found = [fit_clock(log.time, _log_label(run, log)) for log in logs]
    notes = [note for _, several in found for note in several]
    clocks = [found[0][0]]
    for log, (clock, _) in zip(logs[1:], found[1:], strict=True):
        offset, note = _determine_clock_offset(run, logs[0], clocks[0], log, clock, commands)
        clocks.append(clock._replace(start=clock.start + offset))
        notes += note
    period, fine, off = _common_period(clocks)
    if off > _MAX_TIME_ERROR * clocks[0].period:
        notes.append(f"{run.name}: the files have no common clock; the times of readings are wrong"
                     f" by up to {1e3 * off:.2g} ms.")  # fmt: skip
    ticks = [_common_ticks(clock, clocks[0].start, period) for clock in clocks]
    every = np.unique(np.concatenate(ticks))
    command = _place_on_ticks(logs, clocks, ticks, every, commands)
    commanded = np.isin(every, ticks[0])
    own = [place for place, name in enumerate(commands) if name in logs[0]]
    commanded &= np.isfinite(command[:, own]).all(axis=1)
    reading = _place_on_ticks(logs, clocks, ticks, every, channels)
    pieces = np.split(np.arange(len(every)), 1 + np.flatnonzero(
        np.diff(every) * period > MAX_GAP_SECONDS))  # fmt: skip
    if lost := [every[p[0]] - every[p[0] - 1] for p in pieces[1:]]:
        seconds = ", ".join(f"{n * period:.3g} s" for n in lost)
        notes.append(f"{run.name}: the time stamps have pauses of {seconds}; the run was split there.")
    fine *= clocks[0].hold
    rows = tuple(
        _make_uniform_rows(clocks[0].start, period, fine, every[p], command[p], commanded[p], reading[p])
        for p in pieces
    )
    notes += _note_nan_cells(run, logs, channels)
    if missing := sum(int((~r.known).sum()) for r in rows):
        share = 100 * missing / sum(len(r.known) for r in rows)
        notes.append(f"{run.name}: {missing} rows ({share:.2g} %) were not logged; their readings"
                     " are missing and their commands are held.")  # fmt: skip
    if (rate := 1.0 / clocks[0].period) < _SLOW_RATE:
        notes.append(f"{run.name}: is logged at {rate:.3g} Hz; commands are held between rows, and"
                     " delays and lags can be estimated to within one row only.")  # fmt: skip
    rows = tuple(_apply_masks(run, logs, clocks, piece, masks) for piece in rows)
    if masked := sum(float((~r.valid).sum()) * r.period for r in rows):
        rows = tuple(part for piece in rows for part in _split_at_masks(piece))
        notes.append(f"{run.name}: {masked:.3g} s are masked; their readings are not used, and the"
                     f" run was split at masks of more than {MAX_MASK_SECONDS:g} s.")  # fmt: skip
    return rows, tuple(notes)


def _apply_masks(run: RunFiles, logs, clocks, rows: RunRows, masks: Sequence[MaskedInterval]) -> RunRows:
    """Return merged rows with `valid` set to False and readings to NaN in masked rows.

    Masked are rows within a masked interval, and rows for which the column `valid` of a log is not
    1.

    Args:
        run: the files of the run.
        logs: logs of the run, the one with the commands first.
        clocks: clocks of the logs.
        rows: the merged rows.
        masks: masked intervals.
    """
    time = rows.start + rows.period * np.arange(len(rows.command))
    valid = find_unmasked_rows(masks, run.name, time + logs[0].origin)
    for log, clock in zip(logs, clocks, strict=True):
        if "valid" in log:
            stamps = clock.start + clock.period * clock.tick
            latest = np.searchsorted(stamps, time + 0.5 * rows.period, side="right") - 1
            valid &= (log["valid"][clock.row] == 1.0)[np.maximum(latest, 0)]
    reading = np.where(valid[:, None], rows.reading, np.nan)
    return rows._replace(valid=valid, reading=reading)


def _split_at_masks(rows: RunRows) -> list[RunRows]:
    """Split a run at masked intervals of more than 0.2 s, and return the parts before, between and after these."""
    edges = np.flatnonzero(np.diff(rows.valid, prepend=True, append=True))
    begin, end = edges[::2], edges[1::2]
    long = (end - begin) * rows.period > MAX_MASK_SECONDS
    starts = [0, *end[long].tolist()]
    ends = [*begin[long].tolist(), len(rows.valid)]
    return [slice_rows(rows, a, b) for a, b in zip(starts, ends, strict=True) if a < b]


def slice_rows(rows: RunRows, first: int, last: int) -> RunRows:
    """Return the rows first .. last - 1 of a run."""
    part = slice(int(first), int(last))
    return RunRows(
        rows.start + int(first) * rows.period, rows.period, rows.command[part], rows.known[part],
        rows.reading[part], rows.valid[part],
    )  # fmt: skip


def _note_nan_cells(run: RunFiles, logs: Sequence[Log], channels: Sequence[str]) -> list[str]:
    """Return a list with one note on a run that states its numbers of NaN or empty cells.

    The note names each command and each channel in `channels` that has such cells. The list is empty if no
    cell is missing.
    """
    counts = {
        name: int(np.isnan(log[name]).sum())
        for log in logs for name in log.columns
        if name in channels or name.startswith("command.")
    }  # fmt: skip
    said = ", ".join(f"{count} of {name}" for name, count in counts.items() if count)
    return [f"{run.name}: {said} are NaN or empty; they count as missing."] if said else []


def _log_label(run: RunFiles, log: Log) -> str:
    return run.name if len(run.logs) == 1 else log.name


def _determine_clock_offset(run: RunFiles, main: Log, clock: Clock, log: Log, other: Clock, commands):
    """Return the offset to add to the times of an additional file of a run [s], and notes.

    Args:
        run: the run.
        main: log with the commands, whose clock is the reference.
        clock: clock of that log.
        log: log of the additional file.
        other: clock of the additional file.
        commands: names of the command channels; those in both logs determine the offset.

    Returns:
        (offset, notes). If the commands do not determine the offset, it is 0. If the time stamps of
        both files do not overlap either, it makes both files begin at the same time.
    """
    both = [name for name in commands if name in main and name in log]
    named = f"{run.name}: {log.source}"
    offset = None
    if both:
        offset = estimate_clock_offset(
            clock, np.column_stack([main[c] for c in both])[clock.row],
            other, np.column_stack([log[c] for c in both])[other.row],
        )  # fmt: skip
    if offset is None and _are_disjoint(clock, other):
        return clock.start - other.start, [
            f"{named}: its time stamps do not overlap with those of {main.source}; both are taken to begin at the"
            " same time. An offset would appear as a common delay of all its channels."
        ]
    if offset is None:
        why = "its commands do not determine" if both else "it has no command to determine"
        return 0.0, [
            f"{named}: {why} its clock offset to {main.source}; 0 is assumed. An offset would"
            " appear as a common delay of all its channels."
        ]
    if abs(offset) <= _MAX_TIME_ERROR * clock.period:
        return offset, []
    return offset, [
        f"{named}: its clock was shifted by {offset:+.6g} s, which aligns its commands with those of {main.source}."
    ]


def _are_disjoint(clock: Clock, other: Clock) -> bool:
    ends = [c.start + c.period * float(c.tick[-1]) for c in (clock, other)]
    return ends[0] < other.start or ends[1] < clock.start


def _common_period(clocks: Sequence[Clock]) -> tuple[float, int, float]:
    """Find the period of a common clock with a tick for every row of several clocks.

    The period of the first clock is divided by 1 to 5. The first of these divisors is used with
    which the time errors are at most 5 % of that period, otherwise the divisor with the smallest
    error.

    Returns:
        (period [s], ticks per period of the first clock, largest time error of a row [s]).
    """
    tried = []
    for fine in range(1, _MAX_REFINEMENT + 1):
        period = clocks[0].period / fine
        off = 0.0
        for clock in clocks[1:]:
            ahead = (clock.start - clocks[0].start + clock.tick * clock.period) / period
            twice = (np.diff(np.rint(ahead)) == 0).any()
            off = max(off, np.abs(ahead - np.rint(ahead)).max() * period, twice * clock.period)
        tried.append((float(off), fine, period))
        if off <= _MAX_TIME_ERROR * clocks[0].period:
            break
    off, fine, period = min(tried)
    return period, fine, off


def _common_ticks(clock: Clock, start: float, period: float) -> np.ndarray:
    return np.rint((clock.start - start + clock.tick * clock.period) / period).astype(int)


def _place_on_ticks(logs, clocks, ticks, every, names) -> np.ndarray:
    """Return channels of all files as a table with one row per tick of the common clock.

    Args:
        logs: logs of the files.
        clocks: their clocks.
        ticks: common ticks of the rows of each log.
        every: (n,) all common ticks, increasing.
        names: the k channels.

    Returns:
        (n, k) values, NaN where missing; of several files with a channel the first is used.
    """
    values = np.full((len(every), len(names)), np.nan)
    for column, name in enumerate(names):
        holder = next((i for i, log in enumerate(logs) if name in log), None)
        if holder is not None:
            rows = np.searchsorted(every, ticks[holder])
            values[rows, column] = logs[holder][name][clocks[holder].row]
    return values


def _make_uniform_rows(start, period, fine, tick, command, commanded, reading) -> RunRows:
    """Return rows at every tick of a uniform clock from rows at some ticks.

    Args:
        start: time of tick 0 [s].
        period: time between ticks [s].
        fine: number of ticks for which the command of a row counts as known.
        tick: (m,) ticks of the rows, increasing.
        command: (m, nu) commands, NaN where missing; each is held until the next one.
        commanded: (m,) whether the commands of a row were logged.
        reading: (m, c) readings, NaN where missing.

    Returns:
        The rows from the first to the last tick. Readings at ticks without a row are NaN. Commands
        before the first logged one are equal to it.
    """
    n = int(tick[-1] - tick[0]) + 1
    place = tick - tick[0]
    full = np.full((n, reading.shape[1]), np.nan)
    full[place] = reading
    held = np.full((n, command.shape[1]), np.nan)
    held[place] = command
    for column in held.T:
        good = np.flatnonzero(np.isfinite(column))
        latest = np.searchsorted(good, np.arange(n), side="right") - 1
        column[:] = column[good[np.maximum(latest, 0)]] if len(good) else 0.0
    own = np.flatnonzero(commanded)
    age = np.full(n, n)
    if len(own):
        latest = np.searchsorted(place[own], np.arange(n), side="right") - 1
        age = np.where(latest >= 0, np.arange(n) - place[own][np.maximum(latest, 0)], n)
    first = start + float(tick[0]) * period
    return RunRows(first, period, held, age < fine, full, np.ones(n, dtype=bool))


MAX_RATE = 1000.0  # [Hz] hydraulic dynamics are below about 300 Hz, and filters step at 1 ms
_RATE_TOLERANCE = 0.1  # of a row: rates such as 1.05 kHz are not reduced


def average_rows(rows: RunRows, max_rate: float = MAX_RATE) -> tuple[RunRows, np.ndarray, int]:
    """Reduce the sample rate of a run by averaging a fixed number of logged rows into one row.

    Commands are means over the new row, for which they are held. Readings are means over the same
    number of logged rows before and after the time of the new row, so that they are not delayed;
    the mean reduces aliasing. Repeated readings, as of an encoder at rest, count once in the number
    of averaged readings, because they have the same error.

    Args:
        rows: the run.
        max_rate: maximum rate [Hz].

    Returns:
        (averaged run, readings per mean, rows per mean). Readings per mean (c,) is the effective
        number of independent logged readings in one mean of a channel, its median over the run.
        Rows per mean is the number of logged rows per new row; it is 1, and the run unchanged, if
        the rate is low enough.
    """
    count = math.ceil(1.0 / (max_rate * rows.period) - _RATE_TOLERANCE)
    ones = np.ones(rows.reading.shape[1])
    if count < 2:
        return rows, ones, 1
    whole = len(rows.command) // count
    blocks = {
        name: getattr(rows, name)[: whole * count].reshape(whole, count, -1) for name in ("command", "known", "valid")
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
    return RunRows(
        rows.start, rows.period * count, blocks["command"].mean(axis=1),
        blocks["known"].any(axis=(1, 2)), reading, blocks["valid"].all(axis=(1, 2)),
    ), ones, count  # fmt: skip

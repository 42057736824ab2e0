"""Put the rows of a run, from one or several log files, on one uniform clock.

`fit_clock` fits a uniform clock to time stamps with jitter, drift or missing rows. `estimate_clock_offset`
estimates the offset between the clocks of two files from commands that both contain. `merge_run`
merges the files, splits the run at long gaps and masked intervals, and marks unusable rows (the
column `valid`, or a mask file), for example those in contact. `average_rows` reduces the rate of runs
that are logged faster than a hydraulic machine moves.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.logs.files import RunFiles
from hydrotele.logs.log import Log

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
    """Fit a uniform clock to time stamps, and assign each row to a tick of the clock.

    The period is estimated by least squares, so that a slightly fast or slow clock loses no row.
    If two rows have the same tick, the closer one is used. Stamps with jitter about the ticks are
    assigned to the nearest tick. Rows without a common clock, as those of a loop that sleeps
    between rows, keep their stamps: the clock is then five times as fast, with empty ticks.

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
    """Return the ticks (n,) of time stamps (n,) [s], for irregular stamps and a slightly wrong period.

    The predicted time of the next row is corrected by a tenth of each stamp's deviation.
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
    """Estimate the offset to add to the times of a second file [s].

    The coarse offset maximises the correlation of the two command histories. If both files contain
    the same rows, their stamps give the exact offset. Otherwise the offset minimises the difference
    of the linearly interpolated commands.

    Args:
        clock: reference clock (n rows).
        command: (n, k) commands at the rows of the reference clock.
        other: clock of the second file (m rows).
        other_command: (m, k) the same commands in the second file.

    Returns:
        The offset [s], None if it is not identifiable: constant commands or different signals.
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


_MASK_HEADER = ("run", "begin", "end")


class MaskedInterval(NamedTuple):
    """Interval of a run whose readings are not used, from `begin` to `end` [s] of its time stamps.

    An empty run name means all runs.
    """

    run: str
    begin: float
    end: float


def read_mask(path: str | Path) -> tuple[MaskedInterval, ...]:
    """Read masked intervals from a CSV file with the columns `run,begin,end`, times in seconds.

    Args:
        path: the file; an empty run means all runs, an empty time the start or end of the run.

    Raises:
        InputError: the file does not exist, or a line is invalid; the message names the line.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    found, header = [], False
    for number, cells in enumerate(csv.reader(lines), start=1):
        cells = [cell.strip() for cell in cells]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if not header:
            header = True
            if tuple(cells) != _MASK_HEADER:
                raise InputError(f"{path}:{number}", "must be the header run,begin,end")
            continue
        try:
            run, begin, end = cells
            stretch = MaskedInterval(run, float(begin or -math.inf), float(end or math.inf))
        except ValueError:
            message = f"is {','.join(cells)!r}: write run,begin,end, such as dig_1,12.5,14.0"
            raise InputError(f"{path}:{number}", message) from None
        if not stretch.begin < stretch.end:
            raise InputError(f"{path}:{number}", f"ends at {stretch.end:g} s, before its start")
        found.append(stretch)
    if not found:
        raise InputError(path, "has no interval: write run,begin,end and one interval per line")
    return tuple(found)


def check_mask_runs(masks: Sequence[MaskedInterval], runs: Sequence[str]) -> None:
    """Check that the runs of all masked intervals exist.

    Raises:
        InputError: a run does not exist; the message lists the runs.
    """
    for mask in masks:
        if mask.run and mask.run not in runs:
            raise InputError(
                f"mask of run {mask.run!r}",
                f"the run does not exist; {suggest_valid_name(mask.run, runs)}",
            )


def find_unmasked_rows(masks: Sequence[MaskedInterval], run: str, time: np.ndarray) -> np.ndarray:
    """Return (n,) whether rows of a run at times (n,) [s] are outside all masked intervals.

    >>> find_unmasked_rows([MaskedInterval("", 1.0, 2.0)], "dig_1", np.array([0.5, 1.0, 1.5, 2.0])).tolist()
    [True, False, False, True]
    """
    valid = np.ones(len(time), dtype=bool)
    for mask in masks:
        if mask.run in ("", run):
            valid &= (time < mask.begin) | (time >= mask.end)
    return valid


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
    """Merge the files of a run on one clock and split it at gaps and masked intervals.

    The file with the commands defines the clock. If other files have rows between its rows, the
    clock is made up to five times finer, so that every reading keeps its time. Rows without a
    reading are NaN.

    Args:
        run: the files of the run.
        axes: the nu axes.
        channels: the c channels.
        masks: masked intervals, in addition to the `valid` columns of the files.

    Returns:
        (pieces of the run, notes). The run is split at gaps of more than 1 s and at masked
        intervals of more than 0.2 s.

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
    """Return the rows with readings set to NaN in masked intervals and where `valid` is not 1.

    Args:
        run: the files of the run.
        logs: their logs, the one with the commands first.
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
    """Split a run at masked intervals of more than 0.2 s and return the parts between them."""
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
    """Return a note on the number of NaN or empty cells per channel; an empty list without any."""
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
        The offset, 0 if it cannot be determined.
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
    """Find a common clock with a tick for every row of several clocks.

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
    """Return the columns of all files at the ticks of the common clock.

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
        (the averaged run; (c,) effective number of independent logged readings in one mean; number of
        logged rows per row, 1 if the rate is low enough).
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

"""The rows of one run, from one file or several, on one uniform clock; cut where rows lack long.

A file says with its column `valid` which rows may not be used, such as those in contact.

The offset between the clocks of two files of one run, from the commands that both logged.

Stretches of runs that may not be used: contact, maintenance, whatever the model leaves out.

The clock of a log: stamps that jitter, wander or lack rows, as ticks of a uniform period.

Runs logged faster than a hydraulic machine moves, averaged to a rate that filters can cross.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.logs.files import RunFiles
from hydrotele.logs.log import Log

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


_LEAST_OVERLAP = 5.0  # [s] that both must have in common
_ALIKE = 0.95  # correlation of commands that are the same signal, sampled twice
_EQUAL = 1.0e-6  # relative: commands that went through single precision are still the same numbers
_SAME = 0.99  # fraction of the rows that must be equal for the same rows in two files


def clock_offset(
    clock: Clock, command: np.ndarray, other: Clock, other_command: np.ndarray
) -> float | None:
    """What must be added to the times of the other file [s].

    The coarse offset is where the two command histories correlate best. If the files then hold the
    same rows, their stamps give it exactly; else it is where the commands, joined by straight
    lines, differ least.

    Args:
        clock: (n rows) the clock that counts.
        command: (n, k) commands of its rows.
        other: (m rows) the clock to be set.
        other_command: (m, k) the same commands in the other file.

    Returns:
        The offset [s], None where the commands do not tell (constant, or not the same signal).
    """
    step = min(clock.period, other.period)
    a, b = _held(clock, command, step), _held(other, other_command, step)
    least = round(_LEAST_OVERLAP / step)
    if min(len(a), len(b)) < least or not np.ptp(a, axis=0).any():
        return None
    alike, lags = _correlation(a - a.mean(axis=0), b - a.mean(axis=0), least)
    best = alike.max()
    if not best >= _ALIKE:
        return None
    near = np.flatnonzero(alike > best - 1.0e-6)
    stated = (other.start - clock.start) / step  # of several equal offsets the smallest counts
    lag = int(lags[near[np.argmin(np.abs(lags[near] - stated))]])
    coarse = clock.start + lag * step - other.start
    exact = _same_rows(clock, command, other, other_command, coarse)
    return exact if exact is not None else _refined(clock, command, other, other_command, coarse)


def _held(clock: Clock, values: np.ndarray, step: float) -> np.ndarray:
    """Values (n, k) on a uniform clock, each held until the next one."""
    time = clock.tick * clock.period
    at = np.arange(round(time[-1] / step) + 1) * step
    return values[np.searchsorted(time, at + 1e-6 * step, side="right") - 1]


def _correlation(a: np.ndarray, b: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of a[i + lag] and b[i] over their overlap, by lag; 0 for too short overlaps."""
    columns = range(a.shape[1])
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))
    from scipy.signal import correlate  # a second to import, and most logs are one file

    product = sum(correlate(a[:, k], b[:, k], method="fft") for k in columns)
    power_a = sum(correlate(a[:, k] ** 2, ones_b, method="fft") for k in columns)
    power_b = sum(correlate(ones_a, b[:, k] ** 2, method="fft") for k in columns)
    overlap = np.rint(correlate(ones_a, ones_b, method="fft"))
    lags = np.arange(-(len(b) - 1), len(a))
    enough = overlap >= max(least, 0.5 * min(len(a), len(b)))
    power = np.sqrt(np.maximum(power_a * power_b, 0.0))
    enough &= power > 1e-6 * power.max()
    return np.where(enough, product / np.where(enough, power, 1.0), 0.0), lags


def _same_rows(clock: Clock, command, other: Clock, other_command, coarse: float) -> float | None:
    if abs(clock.period / other.period - 1.0) > 1e-3:
        return None
    size = np.abs(command).max()
    first = round((other.start + coarse - clock.start) / clock.period)
    for shift in (first, first - 1, first + 1):
        _, mine, theirs = np.intersect1d(clock.tick, other.tick + shift, return_indices=True)
        if not len(mine):
            continue
        equal = np.abs(command[mine] - other_command[theirs]).max(axis=1) <= _EQUAL * size
        if equal.mean() >= _SAME and np.ptp(command[mine], axis=0).any():
            own = clock.start + clock.tick[mine] * clock.period
            return float(np.median(own - (other.start + other.tick[theirs] * other.period)))
    return None


def _refined(clock: Clock, command, other: Clock, other_command, coarse: float) -> float:
    own = clock.start + clock.tick * clock.period
    time = other.start + other.tick * other.period

    def difference(offset: float) -> float:
        inside = (own >= time[0] + offset) & (own <= time[-1] + offset)
        return sum(
            float(np.mean((np.interp(own[inside], time + offset, theirs) - mine[inside]) ** 2))
            for mine, theirs in zip(command.T, other_command.T, strict=True)
        )

    width = 2.0 * max(clock.period, other.period)
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(difference, bounds=(coarse - width, coarse + width), method="bounded",
                            options={"xatol": 1e-3 * clock.period})  # fmt: skip
    return float(found.x)  # type: ignore[union-attr]


_HEADER = ("run", "begin", "end")


class Masked(NamedTuple):
    """From begin to end [s] of a run's own time stamps; the run "" stands for every run."""

    run: str
    begin: float
    end: float


def read_mask(path: str | Path) -> tuple[Masked, ...]:
    """Stretches of a CSV file with the columns `run,begin,end`, times in seconds.

    Args:
        path: the file; an empty run means every run, an empty time the run's own start or end.

    Raises:
        InputError: the file is not there, or a line is no stretch; names the line.
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
            if tuple(cells) != _HEADER:
                raise InputError(f"{path}:{number}", "must begin with the header run,begin,end")
            continue
        try:
            run, begin, end = cells
            stretch = Masked(run, float(begin or -math.inf), float(end or math.inf))
        except ValueError:
            message = f"is {','.join(cells)!r}: write run,begin,end, such as dig_1,12.5,14.0"
            raise InputError(f"{path}:{number}", message) from None
        if not stretch.begin < stretch.end:
            raise InputError(f"{path}:{number}", f"ends at {stretch.end:g} s, before its beginning")
        found.append(stretch)
    if not found:
        raise InputError(path, "masks nothing: write run,begin,end and one stretch per line")
    return tuple(found)


def check_runs(masks: Sequence[Masked], runs: Sequence[str]) -> None:
    """Refuse stretches of runs that are not there.

    Raises:
        InputError: names the run and those that are there.
    """
    for mask in masks:
        if mask.run and mask.run not in runs:
            raise InputError(
                f"mask of run {mask.run!r}", f"is not there; {suggest(mask.run, runs)}"
            )


def unmasked(masks: Sequence[Masked], run: str, time: np.ndarray) -> np.ndarray:
    """Whether each row (n,) of a run, at its time (n,) [s], is outside all stretches.

    >>> unmasked([Masked("", 1.0, 2.0)], "dig_1", np.array([0.5, 1.0, 1.5, 2.0])).tolist()
    [True, False, False, True]
    """
    valid = np.ones(len(time), dtype=bool)
    for mask in masks:
        if mask.run in ("", run):
            valid &= (time < mask.begin) | (time >= mask.end)
    return valid


LONGEST_GAP = 1.0  # [s] without rows, after which the commands' history is lost and a run is cut
LONGEST_MASK = 0.2  # [s] masked, after which nobody knows the state and a run is cut
_FINEST = 5  # times as many ticks as the commands' file has rows
_SLOW = 20.0  # [Hz] below it a row lasts as long as a valve takes
_OFF = 0.05  # of a row's period that a reading may be off its tick


class Rows(NamedTuple):
    """A run on a uniform clock.

    Attributes:
        start: time of the first row [s].
        period: time between rows [s].
        command: (n, nu) commands, held from row to row.
        known: (n,) whether the command of the row was logged.
        reading: (n, c) readings, NaN where missing.
        valid: (n,) whether the row may be used; its readings are NaN where not.
    """

    start: float
    period: float
    command: np.ndarray
    known: np.ndarray
    reading: np.ndarray
    valid: np.ndarray


def run_rows(
    run: RunFiles, axes: Sequence[str], channels: Sequence[str], masks: Sequence[Masked] = ()
) -> tuple[tuple[Rows, ...], tuple[str, ...]]:
    """Put a run on one clock.

    The file that holds the commands gives the clock. Files of other rates, or whose rows fall
    between its rows, make the clock up to five times finer, so that every reading stands at its
    own time; rows in between have NaN.

    Args:
        run: its files.
        axes: the nu axes.
        channels: the c channels.
        masks: stretches that may not be used, besides what the files say.

    Returns:
        (its pieces, cut where more than a second lacks or more than 0.2 s are masked; notes).

    Raises:
        InputError: time stamps follow no clock.
    """
    commands = [f"command.{axis}" for axis in axes]
    logs = sorted(run.logs, key=lambda log: -sum(c in log for c in commands))
    found = [fit_clock(log.time, _name(run, log)) for log in logs]
    notes = [note for _, several in found for note in several]
    clocks = [found[0][0]]
    for log, (clock, _) in zip(logs[1:], found[1:], strict=True):
        offset, note = _offset(run, logs[0], clocks[0], log, clock, commands)
        clocks.append(clock._replace(start=clock.start + offset))
        notes += note
    period, fine, off = _common_period(clocks)
    if off > _OFF * clocks[0].period:
        notes.append(f"{run.name}: its files share no clock; readings are up to {1e3 * off:.2g} ms"
                     " off their time.")  # fmt: skip
    ticks = [_ticks(clock, clocks[0].start, period) for clock in clocks]
    every = np.unique(np.concatenate(ticks))
    command = _spread(logs, clocks, ticks, every, commands)
    commanded = np.isin(every, ticks[0])
    own = [place for place, name in enumerate(commands) if name in logs[0]]
    commanded &= np.isfinite(command[:, own]).all(axis=1)
    reading = _spread(logs, clocks, ticks, every, channels)
    pieces = np.split(np.arange(len(every)), 1 + np.flatnonzero(
        np.diff(every) * period > LONGEST_GAP))  # fmt: skip
    if lost := [every[p[0]] - every[p[0] - 1] for p in pieces[1:]]:
        seconds = ", ".join(f"{n * period:.3g} s" for n in lost)
        notes.append(f"{run.name}: nothing was logged for {seconds}; the run was cut there.")
    fine *= clocks[0].hold
    rows = tuple(
        _dense(clocks[0].start, period, fine, every[p], command[p], commanded[p], reading[p])
        for p in pieces
    )
    notes += _unread(run, logs, channels)
    if missing := sum(int((~r.known).sum()) for r in rows):
        share = 100 * missing / sum(len(r.known) for r in rows)
        notes.append(f"{run.name}: {missing} rows ({share:.2g} %) were not logged; they count as"
                     " missing and their commands as held.")  # fmt: skip
    if (rate := 1.0 / clocks[0].period) < _SLOW:
        notes.append(f"{run.name}: is logged at {rate:.3g} Hz; its commands count as held between"
                     " rows, and delays and lags are known to a row at best.")  # fmt: skip
    rows = tuple(_masked(run, logs, clocks, piece, masks) for piece in rows)
    if masked := sum(float((~r.valid).sum()) * r.period for r in rows):
        rows = tuple(part for piece in rows for part in _cut_masked(piece))
        notes.append(f"{run.name}: {masked:.3g} s are masked; their readings are not used, and the"
                     f" run was cut where that lasts more than {LONGEST_MASK:g} s.")  # fmt: skip
    return rows, tuple(notes)


def _masked(run: RunFiles, logs, clocks, rows: Rows, masks: Sequence[Masked]) -> Rows:
    """Rows with the readings of those that may not be used taken out."""
    time = rows.start + rows.period * np.arange(len(rows.command))
    valid = unmasked(masks, run.name, time)
    for log, clock in zip(logs, clocks, strict=True):
        if "valid" in log:
            stamps = clock.start + clock.period * clock.tick
            latest = np.searchsorted(stamps, time + 0.5 * rows.period, side="right") - 1
            valid &= (log["valid"][clock.row] == 1.0)[np.maximum(latest, 0)]
    reading = np.where(valid[:, None], rows.reading, np.nan)
    return rows._replace(valid=valid, reading=reading)


def _cut_masked(rows: Rows) -> list[Rows]:
    """Pieces of a run between its long masked stretches."""
    edges = np.flatnonzero(np.diff(rows.valid, prepend=True, append=True))
    begin, end = edges[::2], edges[1::2]
    long = (end - begin) * rows.period > LONGEST_MASK
    starts = [0, *end[long].tolist()]
    ends = [*begin[long].tolist(), len(rows.valid)]
    return [cut(rows, a, b) for a, b in zip(starts, ends, strict=True) if a < b]


def cut(rows: Rows, first: int, last: int) -> Rows:
    """Rows first .. last - 1 of a run, with their own start."""
    part = slice(int(first), int(last))
    return Rows(
        rows.start + int(first) * rows.period, rows.period, rows.command[part], rows.known[part],
        rows.reading[part], rows.valid[part],
    )  # fmt: skip


def _unread(run: RunFiles, logs: Sequence[Log], channels: Sequence[str]) -> list[str]:
    """Note on cells that hold no number."""
    counts = {
        name: int(np.isnan(log[name]).sum())
        for log in logs for name in log.columns
        if name in channels or name.startswith("command.")
    }  # fmt: skip
    said = ", ".join(f"{count} of {name}" for name, count in counts.items() if count)
    return [f"{run.name}: {said} are NaN or empty; they count as missing."] if said else []


def _name(run: RunFiles, log: Log) -> str:
    return run.name if len(run.logs) == 1 else log.name


def _offset(run: RunFiles, main: Log, clock: Clock, log: Log, other: Clock, commands):
    """Offset of the clock of a further file [s], and what to say about it."""
    both = [name for name in commands if name in main and name in log]
    named = f"{run.name}: {log.source}"
    offset = None
    if both:
        offset = clock_offset(
            clock, np.column_stack([main[c] for c in both])[clock.row],
            other, np.column_stack([log[c] for c in both])[other.row],
        )  # fmt: skip
    if offset is None:
        why = "its commands do not tell" if both else "it holds no command"
        return 0.0, [
            f"{named}: {why} how its clock stands to that of {main.source}, which was believed; an"
            " offset would show as one delay of all its channels."
        ]
    if abs(offset) <= _OFF * clock.period:
        return offset, []
    return offset, [
        f"{named}: its clock was set by {offset:+.6g} s, which brings its commands onto those of"
        f" {main.source}."
    ]


def _common_period(clocks: Sequence[Clock]) -> tuple[float, int, float]:
    """Longest period that has a tick for every row, the refinement, and the largest miss [s]."""
    tried = []
    for fine in range(1, _FINEST + 1):
        period = clocks[0].period / fine
        off = 0.0
        for clock in clocks[1:]:
            ahead = (clock.start - clocks[0].start + clock.tick * clock.period) / period
            twice = (np.diff(np.rint(ahead)) == 0).any()
            off = max(off, np.abs(ahead - np.rint(ahead)).max() * period, twice * clock.period)
        tried.append((float(off), fine, period))
        if off <= _OFF * clocks[0].period:
            break
    off, fine, period = min(tried)
    return period, fine, off


def _ticks(clock: Clock, start: float, period: float) -> np.ndarray:
    return np.rint((clock.start - start + clock.tick * clock.period) / period).astype(int)


def _spread(logs, clocks, ticks, every, names) -> np.ndarray:
    """Columns (n, k) of all files at the common ticks."""
    values = np.full((len(every), len(names)), np.nan)
    for column, name in enumerate(names):
        holder = next((i for i, log in enumerate(logs) if name in log), None)
        if holder is not None:
            rows = np.searchsorted(every, ticks[holder])
            values[rows, column] = logs[holder][name][clocks[holder].row]
    return values


def _dense(start, period, fine, tick, command, commanded, reading) -> Rows:
    """Rows at every tick; a command holds, and is known, until the next row of its file is due."""
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
    return Rows(first, period, held, age < fine, full, np.ones(n, dtype=bool))


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

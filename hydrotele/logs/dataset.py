"""Logs of one machine, made ready for learning: one clock, one set of channels, gaps marked.

What a data set measures: its channels, its sensors and their noise, and what nobody measured.

Which runs are fitted and which one judges; a single run is split in time.

The log behind a run of a data set: without what only a simulator knows, cut as the run was.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.logs.cleaning import check_range, remove_faults
from hydrotele.logs.files import RunFiles, check_commands, read_runs
from hydrotele.logs.log import Log
from hydrotele.logs.rows import Masked, Rows, averaged, check_runs, cut, read_mask, run_rows
from hydrotele.machine.machine import (
    IDEAL,
    Machine,
    SensorSet,
    channel_sensor,
    noise_rms,
    sensor_set,
)
from hydrotele.machine.signals import parse_channel

_MOVES = 10.0  # standard deviations of a reading that a motion must amount to
_UNSTATED = ("none", "", IDEAL)  # what logs with true values say of their sensors


def predicted(machine: Machine) -> tuple[str, ...]:
    """Every channel that the model predicts, in the order of a dataset."""
    order = actuator_order(machine)
    valves = [name for name in order if machine.axes[name].hydraulic]
    return (
        *(f"{machine.position_kind(name)}.{name}" for name in order),
        *(f"length.{name}" for name in order if machine.axes[name].cylinder),
        *(f"pressure_head.{name}" for name in valves),
        *(f"pressure_rod.{name}" for name in valves),
        *(("pressure_supply",) if machine.supply and valves else ()),
    )


def common_channels(files: Sequence[RunFiles], machine: Machine) -> tuple[str, ...]:
    """Channels that any run has and the model predicts.

    Raises:
        InputError: there is none; lists what the model predicts.
    """
    logs = [log for run in files for log in run.logs]
    found = tuple(c for c in predicted(machine) if any(c in log for log in logs))
    if not found:
        raise InputError(
            ", ".join(run.name for run in files) or "the data",
            f"holds nothing that the model of {machine.name} predicts; that would be"
            f" {', '.join(predicted(machine))}",
        )
    return found


def stated_sensors(
    files: Sequence[RunFiles], machine: Machine, name: str | None
) -> tuple[SensorSet | None, list[str]]:
    """The sensors of all logs, None if their noise is unknown, and notes.

    Raises:
        InputError: the machine has no such sensors, or the logs have different ones.
    """
    if name is not None:
        return sensor_set(machine, name), []
    stated = {log.metadata["sensors"]: log.source
              for run in files for log in run.logs if "sensors" in log.metadata}  # fmt: skip
    if len(stated) > 1:
        (a, first), (b, other) = list(stated.items())[:2]
        raise InputError(
            first, f"has the sensors {a!r}, {other} has {b!r}: name those that all logs have, or"
            " take logs of one kind",
        )  # fmt: skip
    said = next(iter(stated), None)
    if said in machine.sensors:
        return machine.sensors[said], []
    if said in _UNSTATED or not machine.sensors:
        return None, ["the logs state no sensors with a known accuracy; the noise is unknown."]
    first = next(iter(machine.sensors))
    if said is not None:
        return machine.sensors[first], [
            f"the logs have the sensors {said!r}, which {machine.name} has not; {first!r} was taken"
            " for them."
        ]
    return machine.sensors[first], []


def channel_noise(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Standard deviation of one reading [channel's unit], NaN without a stated accuracy."""
    if channel_sensor(machine, sensors, channel).error_rms == 0.0:
        return math.nan
    return noise_rms(machine, sensors, channel)


def unknown_columns(files: Sequence[RunFiles], machine: Machine) -> list[str]:
    """Notes on channels that no axis of the machine has, and on commands that were averaged."""
    valid = (*predicted(machine), *(f"command.{axis}" for axis in machine.axes))
    kinds = {name.partition(".")[0] for name in valid} | {"angle", "position"}
    notes = []
    for channel in dict.fromkeys(c for run in files for log in run.logs for c in log.columns):
        if channel not in valid and parse_channel(channel).kind in kinds:
            notes.append(f"{channel} is ignored: {machine.name} has no such channel;"
                         f" {suggest(channel, valid)}.")  # fmt: skip
    averaged = [r.name for r in files if r.logs[0].metadata.get("command", "held") != "held"]
    if averaged:
        notes.append(f"{', '.join(averaged)}: a row's command is a mean over the row, not held;"
                     " delays are known to a row at best.")  # fmt: skip
    return notes


def still_channels(
    runs: Mapping[str, Rows], channels: Sequence[str], noise: np.ndarray
) -> list[str]:
    """Notes on runs in which no position moves."""
    notes = []
    places = [c for c, name in enumerate(channels) if not name.startswith("pressure")]
    for name, rows in runs.items():
        good = [c for c in places if np.isfinite(rows.reading[:, c]).any()]
        spans = [np.nanmax(rows.reading[:, c]) - np.nanmin(rows.reading[:, c]) for c in good]
        if good and all(s <= _MOVES * np.nan_to_num(noise[c])
                        for s, c in zip(spans, good, strict=True)):  # fmt: skip
            notes.append(f"{name}: nothing moves; friction, inertia and timing cannot be seen.")
    return notes


def blind_axes(machine: Machine, axes: Sequence[str], channels: Sequence[str]) -> list[str]:
    """Notes on axes whose position nobody measured."""
    return [
        f"neither {machine.position_kind(axis)} nor length of {axis} is measured; what only its"
        " position shows cannot be told."
        for axis in axes
        if not {f"{machine.position_kind(axis)}.{axis}", f"length.{axis}"} & set(channels)
    ]


SHORTEST = 0.5  # [s] of a run: a fast servo's stroke, of which the unknown start takes a part
FEWEST = 50  # rows of a run
_SHORTEST_PIECE = 10.0  # [s] of a piece of a single run, if it is to be fitted in several
_PIECES = 3
_SHARE = 0.15, 0.6  # of a run that was cut, which a piece that judges the others should have
_FIT = 0.75  # of a single run
_QUIET = 0.1  # of the commands' changes: less of them in the last quarter judges nothing
_LEAST_FIT = 0.5  # of a single run
_HELD_OUT = ("test", "heldout", "validation")


class Part(NamedTuple):
    """A run, a piece of one, or a part of a split piece.

    Attributes:
        name: its own name.
        piece: name of the run or piece that it was split from; its own name if it was not.
        rows: its rows.
    """

    name: str
    piece: str
    rows: Rows


class Split(NamedTuple):
    """Runs to fit, and the run held out."""

    fit: tuple[Part, ...]
    heldout: Part


def seconds(rows: Rows) -> float:
    """Length of a run [s]."""
    return len(rows.command) * rows.period


def too_short(rows: Rows) -> str | None:
    """What a run lacks in length, as words; None if it is long enough."""
    if seconds(rows) >= SHORTEST - 1e-9 and len(rows.command) >= FEWEST:
        return None
    return (
        f"{seconds(rows):.3g} s long ({len(rows.command)} rows); {SHORTEST:g} s and {FEWEST} rows"
        " are needed"
    )


def split(
    runs: Mapping[str, Rows], origin: Mapping[str, str], heldout: str | None
) -> tuple[Split, tuple[str, ...]]:
    """Hold one run out: the one named, else the first of the runs `test*`, `heldout*`,
    `validation*`, else the last by name. A single run is fitted on its first three quarters, or
    less where the machine rests after them.

    Args:
        runs: name of run or of piece -> rows, at least one.
        origin: the same names -> the run as logged, of which it may be a piece.
        heldout: name of a run, or None.

    Returns:
        (split, notes on runs that are neither fitted nor held out).

    Raises:
        InputError: there is no such run, nothing is left to fit, or a single run is too short.
    """  # noqa: D205 - the rule is one sentence
    names = sorted(set(origin.values()))
    if heldout is not None and heldout not in names:
        raise InputError(f"held-out run {heldout!r}", f"is not there; {suggest(heldout, names)}")
    if len(runs) == 1:
        name, rows = next(iter(runs.items()))
        if heldout is not None:
            raise InputError(
                f"held-out run {heldout!r}",
                "is the only run: leave the name away to split it in time, or add a run to fit",
            )
        return _split_in_time(name, rows), ()
    marked = [name for name in names if name.lower().startswith(_HELD_OUT)]
    if marked == names:
        marked = []
    chosen = heldout or (marked or [_last_piece(runs) if len(names) == 1 else names[-1]])[0]
    pieces = [n for n in runs if chosen in (n, origin[n])]
    judge = max(pieces, key=lambda n: seconds(runs[n]))
    aside = set(marked if heldout is None else ()) | {chosen}
    fit = [n for n in runs if n != judge and not {n, origin[n]} & aside]
    unused = [n for n in runs if n not in fit and n != judge]
    notes = (
        (f"{', '.join(unused)}: neither fitted nor judged on; {judge} is held out.",)
        if unused else ()
    )  # fmt: skip
    if not fit:
        raise InputError(f"held-out run {chosen!r}", "leaves no run to fit: add one")
    parts = tuple(Part(n, n, runs[n]) for n in fit)
    return Split(parts, Part(judge, judge, runs[judge])), notes


def _last_piece(runs: Mapping[str, Rows]) -> str:
    """Of the pieces of one run the last that is neither a scrap nor nearly all; else the last."""
    total = sum(map(seconds, runs.values()))
    low, high = _SHARE
    fair = [name for name, rows in runs.items() if low * total <= seconds(rows) <= high * total]
    return (fair or list(runs))[-1]


def _split_in_time(name: str, rows: Rows) -> Split:
    total = seconds(rows)
    n = len(rows.command)
    least = max(SHORTEST, FEWEST * rows.period) / (1.0 - _FIT)
    if total < least - 1e-9:
        raise InputError(
            name,
            f"is the only run and {total:.3g} s long; its last quarter is held out, which asks for"
            f" {least:.3g} s or more: log longer, or a second run",
        )
    last = _fit_rows(rows)
    count = int(np.clip(last * rows.period // _SHORTEST_PIECE, 1, _PIECES))
    edges = np.linspace(0, last, count + 1).astype(int)
    fit = tuple(
        Part(f"{name}_{i + 1}", name, cut(rows, a, b))
        for i, (a, b) in enumerate(zip(edges, edges[1:], strict=False))
    )
    return Split(fit, Part(f"{name}_heldout", name, cut(rows, edges[-1], n)))


def _fit_rows(rows: Rows) -> int:
    """Rows of a single run to fit on: three quarters, or less where the machine rests after them.

    A model of a machine at rest is right whatever its numbers. Then a quarter of the commands'
    changes is held out, and half of the run at most.
    """
    n = len(rows.command)
    passed = np.cumsum(np.abs(np.diff(rows.command, axis=0, prepend=rows.command[:1])).sum(axis=1))
    if passed[-1] == 0.0 or passed[-1] - passed[round(_FIT * n) - 1] >= _QUIET * passed[-1]:
        return round(_FIT * n)
    return max(int(np.searchsorted(passed, _FIT * passed[-1])), round(_LEAST_FIT * n))


_SECRET = ("initial_state",)  # metadata that only a simulator can know


def measured_only(run: RunFiles) -> RunFiles:
    """The run without truth, in columns and in metadata."""
    logs = [
        dataclasses.replace(
            log.without_truth(),
            metadata={k: v for k, v in log.metadata.items() if k not in _SECRET},
        )
        for log in run.logs
    ]
    return run._replace(logs=tuple(logs))


def piece_log(
    logs: Sequence[Log], name: str, rows: Rows, axes: Sequence[str], channels: Sequence[str],
    as_logged: bool = True,
) -> Log:  # fmt: skip
    """Log of a run or of a piece of it.

    Args:
        logs: the files of the run.
        name: name of the run or piece.
        rows: its rows.
        axes: the nu axes.
        channels: the c channels.
        as_logged: whether the rows stand for what was logged; False for means and masked rows.

    Returns:
        Of one file its rows as logged, with time stamps and all columns; else a log on the common
        clock, with commands and channels, NaN where missing.
    """
    first = logs[0]
    if len(logs) == 1 and as_logged:
        after = rows.start + rows.period * (len(rows.command) - 0.5)
        inside = (first.time > rows.start - 0.5 * rows.period) & (first.time < after)
        if inside.all():
            return first
        columns = {c: values[inside] for c, values in first.columns.items()}
        return dataclasses.replace(first, time=first.time[inside], columns=columns)
    columns = {f"command.{axis}": v for axis, v in zip(axes, rows.command.T, strict=True)}
    columns |= dict(zip(channels, rows.reading.T, strict=True))
    known = {channel: unit for log in logs for channel, unit in log.units.items()}
    columns = {channel: values for channel, values in columns.items() if channel in known}
    time = rows.start + rows.period * np.arange(len(rows.command))
    units = {channel: known[channel] for channel in columns}
    return Log(time, columns, units, first.metadata, name)


_MOST_MISSING = 0.3  # of the rows of a run; beyond it the commands are not known well enough


@dataclass(frozen=True)
class RunData:
    """One run on a uniform clock, whose period may differ from that of other runs.

    Attributes:
        name: the run's name.
        start: time of the first row [s].
        period: time between rows [s].
        command: (n, nu) commands in actuator order, held from row to row [1], [V] or [N].
        command_known: (n,) whether the row was in the log and may be used; a missing row repeats
            the last command.
        reading: (n, c) sensor readings in the dataset's channels, NaN where missing [SI].
        log: the log as read, without truth; of a run that was averaged or is masked, its commands
            and channels as they stand here.
        valid: (n,) whether the model may be held against the row, False in contact and wherever
            the log or a mask says so; None means all rows.
        behind: (c,) logged readings of which one reading is the mean; None means one.
    """

    name: str
    start: float
    period: float
    command: np.ndarray
    command_known: np.ndarray
    reading: np.ndarray
    log: Log
    valid: np.ndarray | None = None
    behind: np.ndarray | None = None

    def part(self, first: int, last: int) -> "RunData":
        """Rows first .. last - 1, with their own start; the log stays that of the whole run."""
        rows = slice(first, last)
        return replace(
            self, start=self.start + first * self.period, command=self.command[rows],
            command_known=self.command_known[rows], reading=self.reading[rows],
            valid=None if self.valid is None else self.valid[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """Logs of one machine.

    Attributes:
        machine: the model.
        axes: the nu axes in actuator order.
        channels: the c measured channels that any run has and the model predicts.
        noise: (c,) standard deviation of one reading from the machine's sensors [SI]; NaN where
            the machine states no accuracy.
        fit: the runs to learn from.
        heldout: the run to judge on.
        notes: what was left out or mended, one sentence each.
        sensors: name of the machine's sensors, or None if their noise is unknown.
    """

    machine: Machine
    axes: tuple[str, ...]
    channels: tuple[str, ...]
    noise: np.ndarray
    fit: tuple[RunData, ...]
    heldout: RunData
    notes: tuple[str, ...]
    sensors: str | None = None

    def noise_of(self, run: RunData) -> np.ndarray:
        """Standard deviations (c,) of one reading of a run [SI], less where readings are means."""
        return self.noise if run.behind is None else self.noise / np.sqrt(run.behind)


def load_dataset(
    paths: str | Path | Sequence[str | Path],
    machine: Machine,
    sensors: str | None = None,
    heldout: str | None = None,
    aliases: Mapping[str, str] | None = None,
    *,
    force: bool = False,
    mask: str | Path | None = None,
) -> Dataset:
    """Read logs and put them in order; whatever is left out or mended leaves a note.

    The noise is that of the machine's sensors. A sensor without a stated accuracy has noise NaN,
    even if its converter's step is known: a fine converter says nothing of the noise before it.

    Args:
        paths: folder with logs, run folder, file, or several of them; see `files`.
        machine: the model.
        sensors: name of the machine's sensors, or `ideal` if unknown; else what the logs'
            metadata say, else the machine's first.
        heldout: name of the run to judge on; see `split`.
        aliases: the files' own column name -> channel, besides the machine's `log_columns`.
        force: accept logs whose metadata names another machine or tool.
        mask: file of stretches that may not be used, see `rows.read_mask`; a log may also say so
            itself, in a column `valid` or `mask`.

    Raises:
        InputError: a file is unusable, is of another machine, lacks a command, reads what the
            machine cannot do, or there is too little; says what to do.
    """
    several = [paths] if isinstance(paths, str | Path) else list(paths)
    names = {**machine.log_columns, **(aliases or {})}
    masks = () if mask is None else read_mask(mask)
    files = read_runs(several, machine, names, force)
    return make_dataset(files, machine, sensors, heldout, masks)


def make_dataset(
    files: Sequence[RunFiles],
    machine: Machine,
    sensors: str | None = None,
    heldout: str | None = None,
    masks: Sequence[Masked] = (),
) -> Dataset:
    """As `load_dataset`, of logs in memory; their readings may be NaN where missing.

    Args:
        files: the runs, sorted by name.
        machine: the model.
        sensors: as of `load_dataset`.
        heldout: as of `load_dataset`.
        masks: stretches that may not be used.

    Raises:
        InputError: as `load_dataset`.
    """
    files = [measured_only(run) for run in files]
    axes, channels = tuple(actuator_order(machine)), common_channels(files, machine)
    for run in files:
        check_commands(run, machine)
    check_runs(masks, [run.name for run in files])
    known, notes = stated_sensors(files, machine, sensors)
    noise = np.array([channel_noise(machine, known, channel) for channel in channels])
    runs, origin, said = _runs(files, machine, axes, channels, masks)
    mended, more = remove_faults(machine, known, axes, channels, noise, runs)
    notes += unknown_columns(files, machine) + said + list(more)
    notes += still_channels(mended, channels, noise)
    kept = np.array([any(np.isfinite(rows.reading[:, column]).any() for rows in mended.values())
                     for column in range(len(channels))])  # fmt: skip
    notes += [f"{c} has no good reading in any run; it was dropped."
              for c, keep in zip(channels, kept, strict=True) if not keep]  # fmt: skip
    if not kept.any():
        raise InputError(
            ", ".join(mended), "no reading of any channel is usable: look at the columns, their"
            f" units and sensors. {' '.join(notes)}",
        )  # fmt: skip
    channels = tuple(c for c, keep in zip(channels, kept, strict=True) if keep)
    notes += blind_axes(machine, axes, channels)
    whole, behind = {}, {}
    for name, rows in mended.items():
        # row by row in memory, as filters cross it: every other layout is compiled anew
        rows = rows._replace(reading=np.ascontiguousarray(rows.reading[:, kept]))
        whole[name], behind[name], count = averaged(rows)
        if count > 1:
            notes.append(f"{name}: is logged at {1 / rows.period:.6g} Hz; every {count} rows were"
                         f" averaged into one of {1 / whole[name].period:.6g} Hz.")  # fmt: skip
    parts, left = split(whole, origin, heldout)
    logs = {run.name: run.logs for run in files}
    made = {}
    for part in (*parts.fit, parts.heldout):
        rows = part.rows
        means = behind[part.piece] if (behind[part.piece] > 1.0).any() else None
        as_logged = means is None and bool(rows.valid.all())
        log = piece_log(logs[origin[part.piece]], part.name, rows, axes, channels, as_logged)
        made[part.name] = RunData(
            part.name, rows.start, rows.period, rows.command, rows.known & rows.valid,
            rows.reading, log, rows.valid, means,
        )  # fmt: skip
    judge = made.pop(parts.heldout.name)
    notes += left
    return Dataset(machine, axes, channels, noise[kept], tuple(made.values()), judge, tuple(notes),
                   next((n for n, s in machine.sensors.items() if s is known), None))  # fmt: skip


def _runs(
    files: Sequence[RunFiles], machine: Machine, axes: Sequence[str], channels: Sequence[str],
    masks: Sequence[Masked],
) -> tuple[dict[str, Rows], dict[str, str], list[str]]:  # fmt: skip
    """Runs and pieces of runs by name, the run each comes from, and notes."""
    runs, origin, notes = {}, {}, []
    for run in files:
        pieces, said = run_rows(run, axes, channels, masks)
        notes += said
        where = ", ".join(log.source for log in run.logs)
        for number, rows in enumerate(pieces, start=1):
            name = run.name if len(pieces) == 1 else f"{run.name}_part{number}"
            if (short := too_short(rows)) and len(pieces) == 1:
                raise InputError(where, f"is {short}: log longer, or leave it out")
            if short:
                notes.append(f"{name} is only {short}; it was left out.")
            elif np.mean(~rows.known) > _MOST_MISSING:
                raise InputError(
                    where, f"lacks {100 * np.mean(~rows.known):.0f} % of its rows, and with them"
                    f" the commands; {100 * _MOST_MISSING:.0f} % can be bridged: log every row",
                )  # fmt: skip
            else:
                for channel, reading in zip(channels, rows.reading.T, strict=True):
                    check_range(machine, channel, reading, where)
                runs[name], origin[name] = rows, run.name
    if not runs:
        message = (
            f"no run has {SHORTEST:g} s and {FEWEST} rows without a pause or a mask: log longer"
        )
        raise InputError("the data", message)
    return runs, origin, notes


_RATE, _PER_CYCLE = 100.0, 6.0  # Hz; rows per cycle of the fastest valve
_SHORT = 2.0  # s, of a run that is kept as it is
MOST_SECONDS = 150.0  # of all fitted runs together: four runs of a usual length


def busiest(data: Dataset, most: float = MOST_SECONDS) -> Dataset:
    """A dataset whose fit runs are no longer than a stated time together.

    Every run is cut to its share, the stretch in which the commands change most, and a note says
    which. The run that is held out stays whole.

    Args:
        data: the dataset.
        most: time of all fit runs [s].

    Returns:
        The dataset, or the given one if it is short enough.
    """
    total = sum(len(run.command) * run.period for run in data.fit)
    if total <= most:
        return data
    runs, notes = [], []
    for run in data.fit:
        rows = round(len(run.command) * most / total)
        cut = _stretch(run, _busiest_row(data, run, rows), rows)
        runs.append(cut)
        end = cut.start + rows * run.period
        notes.append(f"{run.name} is long: it is fitted from {cut.start:.0f} to {end:.0f} s only.")
    return dataclasses.replace(data, fit=tuple(runs), notes=(*data.notes, *notes))


def thinned(data: Dataset) -> Dataset:
    """A dataset at no higher rate than its machine's valves answer, each row a mean of several.

    From one millisecond to the next a model and its readings can hardly disagree; what says
    whether a machine has a mass, a friction or a leak takes longer than a valve's own lag.
    """
    bandwidths = [a.valve.bandwidth / (2.0 * np.pi) for a in data.machine.axes.values() if a.valve]
    rate = max(_RATE, _PER_CYCLE * max(bandwidths, default=0.0))

    def thin(run: RunData) -> RunData:
        if run.period * rate > 0.75 or len(run.command) * run.period < _SHORT:
            return run
        valid = np.ones(len(run.command), bool) if run.valid is None else run.valid
        rows, behind, _ = averaged(
            Rows(run.start, run.period, run.command, run.command_known, run.reading, valid), rate
        )
        behind = behind * (1.0 if run.behind is None else run.behind)
        return dataclasses.replace(
            run, period=rows.period, command=rows.command, command_known=rows.known,
            reading=rows.reading, valid=rows.valid, behind=behind,
        )  # fmt: skip

    fit = tuple(map(thin, data.fit))
    return dataclasses.replace(data, fit=fit, heldout=thin(data.heldout))


def busiest_rows(run: RunData, rows: int) -> slice:
    """The stretch of some rows of a run in which its commands change most; all if it is shorter."""
    if rows >= len(run.command):
        return slice(0, len(run.command))
    spread = np.std(run.command, axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    first = int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))
    return slice(first, first + rows)


def _busiest_row(data: Dataset, run: RunData, rows: int) -> int:
    spread = np.std(np.concatenate([r.command for r in data.fit]), axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    return int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))


def _stretch(run: RunData, first: int, rows: int) -> RunData:
    return run.part(first, first + rows)

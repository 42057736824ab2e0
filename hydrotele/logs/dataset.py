"""Data sets for identification: cleaned logs of one machine with fit runs and a held-out run.

`load_dataset` reads logs, resamples each run to a uniform clock, removes faulty readings, selects
the channels that the model predicts, and determines their noise. One run is held out for
validation; a single run is split in time. Channels `truth.*` and metadata that only a simulator
knows are removed.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.cleaning import remove_faults
from hydrotele.logs.faulty_readings import check_range
from hydrotele.logs.log import Log, find_logs, load_log
from hydrotele.logs.masked_intervals import MaskedInterval, check_mask_runs, read_mask
from hydrotele.logs.resampling import RunRows, average_rows, merge_run, slice_rows
from hydrotele.logs.run_files import RunFiles, check_commands, read_runs
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.log_columns import LogColumn
from hydrotele.machine.machine import (
    IDEAL_SENSORS,
    Machine,
    find_channel_sensor,
    get_sensor_set,
    rate_channels,
    reading_noise_rms,
)
from hydrotele.machine.oil import kinematic_viscosity
from hydrotele.machine.oil_temperature import with_oil_temperature
from hydrotele.machine.sensors import SensorSet

_MIN_MOTION_RATIO = 10.0  # noise standard deviations that a position range must exceed to count as motion
_NAMES_WITHOUT_ACCURACY = (
    "none",
    "",
    IDEAL_SENSORS,
)  # `sensors` metadata of logs without a known accuracy


def predicted_channels(machine: Machine) -> tuple[str, ...]:
    """Return the names of all channels that the model of a machine predicts, in the order of a dataset.

    They are the positions of the axes, cylinder lengths, chamber pressures, the supply pressure, and the joint rates
    that the machine's sensors measure.
    """
    order = actuator_order(machine)
    valves = [name for name in order if machine.axes[name].is_hydraulic]
    return (
        *(f"{machine.position_kind(name)}.{name}" for name in order),
        *(f"length.{name}" for name in order if machine.axes[name].cylinder),
        *(f"pressure_head.{name}" for name in valves),
        *(f"pressure_rod.{name}" for name in valves),
        *(machine.supply_channels if machine.supply and valves else ()),
        *rate_channels(machine),
    )


def channels_predicted_and_logged(files: Sequence[RunFiles], machine: Machine) -> tuple[str, ...]:
    """Return the channels that the model of a machine predicts and at least one run contains.

    Raises:
        InputError: there is no such channel; the message lists the predicted channels.
    """
    logs = [log for run in files for log in run.logs]
    found = tuple(c for c in predicted_channels(machine) if any(c in log for log in logs))
    if not found:
        raise InputError(
            ", ".join(run.name for run in files) or "the data",
            f"contains no channel that the model of {machine.name} predicts; these are"
            f" {', '.join(predicted_channels(machine))}",
        )
    return found


def determine_sensors(
    files: Sequence[RunFiles], machine: Machine, name: str | None
) -> tuple[SensorSet | None, list[str]]:
    """Return the sensor set of the machine with which logs were recorded, and notes.

    Args:
        files: the runs.
        machine: the machine, which defines one or several sets of sensors.
        name: name of the set. None for the set that the metadata of the logs name; if they name
            none, or one that the machine does not have, for the first set of the machine.

    Returns:
        (sensors, None if their noise is unknown; notes).

    Raises:
        InputError: the machine has no set `name`, or without `name` the logs name different sets.
    """
    if name is not None:
        return get_sensor_set(machine, name), []
    stated = {log.metadata["sensors"]: log.source
              for run in files for log in run.logs if "sensors" in log.metadata}  # fmt: skip
    if len(stated) > 1:
        (a, first), (b, other) = list(stated.items())[:2]
        raise InputError(
            first, f"has the sensors {a!r}, {other} has {b!r}: state the sensors with --sensors, or"
            " use logs with the same sensors",
        )  # fmt: skip
    said = next(iter(stated), None)
    if said in machine.sensors:
        return machine.sensors[said], []
    if said in _NAMES_WITHOUT_ACCURACY or not machine.sensors:
        return None, ["the logs state no sensors with a known accuracy; the noise is unknown."]
    first = next(iter(machine.sensors))
    if said is not None:
        return machine.sensors[first], [
            f"the logs name the sensors {said!r}, which {machine.name} does not have; {first!r} is used instead."
        ]
    return machine.sensors[first], []


def channel_noise(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Return the noise standard deviation of one reading [channel's unit], NaN if unknown."""
    if find_channel_sensor(machine, sensors, channel).error_rms == 0.0:
        return math.nan
    return reading_noise_rms(machine, sensors, channel)


def note_unknown_columns(files: Sequence[RunFiles], machine: Machine) -> list[str]:
    """Return a note for each logged channel that is ignored, because the machine has no such channel.

    The note suggests similar names. Channels of kinds that the model does not predict are not
    mentioned.
    """
    valid = (*predicted_channels(machine), *(f"command.{axis}" for axis in machine.axes))
    kinds = {name.partition(".")[0] for name in valid} | {"angle", "position"}
    notes = []
    for channel in dict.fromkeys(c for run in files for log in run.logs for c in log.columns):
        if channel not in valid and parse_channel(channel).kind in kinds:
            notes.append(f"{channel} is ignored: {machine.name} has no such channel;"
                         f" {suggest_valid_name(channel, valid)}.")  # fmt: skip
    return notes


def note_empty_columns(files: Sequence[RunFiles], channels: Sequence[str]) -> list[str]:
    """Return a note for each channel whose column exists but is empty in some runs, with these runs."""
    notes = []
    for channel in channels:
        empty = [r.name for r in files for log in r.logs if channel in log and np.isnan(log[channel]).all()]
        if empty:
            notes.append(f"{channel} is not used in {', '.join(empty)}: its column is empty.")
    return notes


def note_averaged_commands(files: Sequence[RunFiles]) -> list[str]:
    """Return a note on runs whose logged commands are means over a row instead of held values."""
    averaged = [r.name for r in files if r.logs[0].metadata.get("command", "held") != "held"]
    if not averaged:
        return []
    return [f"{', '.join(averaged)}: commands are means over each row, not held values;"
            " delays can be estimated to within one row only."]  # fmt: skip


def note_runs_without_motion(runs: Mapping[str, RunRows], channels: Sequence[str], noise: np.ndarray) -> list[str]:
    """Return a note for each run in which no position or length changes by more than ten noise standard deviations.

    `noise` (c,) holds the noise standard deviations of the channels; NaN counts as 0.
    """
    notes = []
    places = [c for c, name in enumerate(channels) if not name.startswith("pressure")]
    for name, rows in runs.items():
        good = [c for c in places if np.isfinite(rows.reading[:, c]).any()]
        spans = [np.nanmax(rows.reading[:, c]) - np.nanmin(rows.reading[:, c]) for c in good]
        if good and all(s <= _MIN_MOTION_RATIO * np.nan_to_num(noise[c])
                        for s, c in zip(spans, good, strict=True)):  # fmt: skip
            notes.append(f"{name}: nothing moves; friction, inertia and delays are not identifiable.")
    return notes


def note_unmeasured_axes(machine: Machine, axes: Sequence[str], channels: Sequence[str]) -> list[str]:
    """Return a note for each axis of which neither position nor cylinder length is measured."""
    return [
        f"neither {machine.position_kind(axis)} nor length of {axis} is measured; parameters that"
        " affect only its position are not identifiable."
        for axis in axes
        if not {f"{machine.position_kind(axis)}.{axis}", f"length.{axis}"} & set(channels)
    ]


MIN_RUN_SECONDS = 0.5  # [s] minimum run length: a stroke of a fast servo and the unknown initial state
MIN_RUN_ROWS = 50  # minimum number of rows of a run
_MIN_PIECE_SECONDS = 10.0  # [s] minimum length of a fit piece of a single run
_MAX_PIECES = 3  # maximum number of fit pieces of a single run
_HELD_OUT_FRACTIONS = 0.15, 0.6  # fraction of a divided run that the held-out piece should have
_FIT_FRACTION = 0.75  # fraction of a single run to fit
_MIN_HELD_OUT_CHANGE = 0.1  # minimum fraction of the command changes that the held-out part must contain
_MIN_HELD_OUT_COMMAND = 0.1  # of the RMS command of the fitted runs, below which an axis counts as resting
_MIN_FIT_FRACTION = 0.5  # minimum fraction of a single run to fit
_HELD_OUT_PREFIXES = ("test", "heldout", "validation")


class RunPart(NamedTuple):
    """A run, a piece of a run, or a part of a piece that was split in time.

    Attributes:
        name: name of the part.
        piece: name of the run or piece that was split; equal to `name` without a split.
        rows: rows of the part.
    """

    name: str
    piece: str
    rows: RunRows


class Split(NamedTuple):
    """Runs to which parameters are fitted, and the run that is held out for validation."""

    fit: tuple[RunPart, ...]
    heldout: RunPart


def run_duration(rows: RunRows) -> float:
    """Return the duration of a run [s]."""
    return len(rows.command) * rows.period


def describe_short_run(rows: RunRows) -> str | None:
    """Return why a run is too short, as text for a message; None if it is long enough."""
    if run_duration(rows) >= MIN_RUN_SECONDS - 1e-9 and len(rows.command) >= MIN_RUN_ROWS:
        return None
    return (
        f"{run_duration(rows):.3g} s long ({len(rows.command)} rows); {MIN_RUN_SECONDS:g} s and {MIN_RUN_ROWS} rows"
        " are needed"
    )


def split_runs(
    runs: Mapping[str, RunRows], origin: Mapping[str, str], heldout: str | None
) -> tuple[Split, tuple[str, ...]]:
    """Split runs into fit runs and one held-out run.

    The held-out run is `heldout`, otherwise the first run whose name begins with `test`, `heldout`
    or `validation` (unless all do), otherwise the last by name. Of a held-out run in several pieces
    only the longest piece is used. All other runs are fitted, but if `heldout` is None, further
    runs with such names are not used.

    If all pieces belong to one run, the held-out piece is the last one with 15 to 60 % of the total
    duration. If there is only one piece, its first three quarters are fitted, or less if the
    machine is at rest after them; the remaining rows are held out.

    Args:
        runs: name of run or piece -> rows, at least one.
        origin: the same names -> name of the logged run.
        heldout: name of the run to hold out, or None.

    Returns:
        (split, notes on runs that are neither fitted nor held out).

    Raises:
        InputError: the run `heldout` does not exist, no run remains to fit, or a single run is too
            short.
    """
    names = sorted(set(origin.values()))
    if heldout is not None and heldout not in names:
        raise InputError(f"held-out run {heldout!r}", f"does not exist; {suggest_valid_name(heldout, names)}")
    if len(runs) == 1:
        name, rows = next(iter(runs.items()))
        if heldout is not None:
            raise InputError(
                f"held-out run {heldout!r}",
                "is the only run: omit the name to split it in time, or add a run to fit",
            )
        return _split_in_time(name, rows), ()
    marked = [name for name in names if name.lower().startswith(_HELD_OUT_PREFIXES)]
    if marked == names:
        marked = []
    chosen = heldout or (marked or [_choose_heldout_piece(runs) if len(names) == 1 else names[-1]])[0]
    pieces = [n for n in runs if chosen in (n, origin[n])]
    judge = max(pieces, key=lambda n: run_duration(runs[n]))
    aside = set(marked if heldout is None else ()) | {chosen}
    fit = [n for n in runs if n != judge and not {n, origin[n]} & aside]
    unused = [n for n in runs if n not in fit and n != judge]
    notes = (
        (f"{', '.join(unused)}: not used, neither for the fit nor for validation; {judge} is held"
         " out.",)
        if unused else ()
    )  # fmt: skip
    if not fit:
        raise InputError(f"held-out run {chosen!r}", "leaves no run to fit: add one")
    parts = tuple(RunPart(n, n, runs[n]) for n in fit)
    return Split(parts, RunPart(judge, judge, runs[judge])), notes


def _choose_heldout_piece(runs: Mapping[str, RunRows]) -> str:
    """Return the name of the piece of a run to hold out for validation.

    It is the last piece with 15 to 60 % of the total duration; without one, the last piece.
    """
    total = sum(map(run_duration, runs.values()))
    low, high = _HELD_OUT_FRACTIONS
    fair = [name for name, rows in runs.items() if low * total <= run_duration(rows) <= high * total]
    return (fair or list(runs))[-1]


def _split_in_time(name: str, rows: RunRows) -> Split:
    total = run_duration(rows)
    n = len(rows.command)
    least = max(MIN_RUN_SECONDS, MIN_RUN_ROWS * rows.period) / (1.0 - _FIT_FRACTION)
    if total < least - 1e-9:
        raise InputError(
            name,
            f"is the only run and {total:.3g} s long; holding out its last quarter needs at least"
            f" {least:.3g} s: record a longer run or a second run",
        )
    last = _count_fit_rows(rows)
    count = int(np.clip(last * rows.period // _MIN_PIECE_SECONDS, 1, _MAX_PIECES))
    edges = np.linspace(0, last, count + 1).astype(int)
    fit = tuple(
        RunPart(f"{name}_{i + 1}", name, slice_rows(rows, a, b))
        for i, (a, b) in enumerate(zip(edges, edges[1:], strict=False))
    )
    return Split(fit, RunPart(f"{name}_heldout", name, slice_rows(rows, edges[-1], n)))


def _count_fit_rows(rows: RunRows) -> int:
    """Return how many rows at the beginning of a single run are fitted; the others are held out.

    These are three quarters of the rows. A machine at rest cannot validate a model: if less than
    10 % of the command changes are in the last quarter, the held-out part begins earlier. It then
    contains a quarter of the command changes, but at most half of the run.
    """
    n = len(rows.command)
    passed = np.cumsum(np.abs(np.diff(rows.command, axis=0, prepend=rows.command[:1])).sum(axis=1))
    if passed[-1] == 0.0 or passed[-1] - passed[round(_FIT_FRACTION * n) - 1] >= _MIN_HELD_OUT_CHANGE * passed[-1]:
        return round(_FIT_FRACTION * n)
    return max(int(np.searchsorted(passed, _FIT_FRACTION * passed[-1])), round(_MIN_FIT_FRACTION * n))


def describe_resting_axes(split: Split, axes: Sequence[str]) -> tuple[str, ...]:
    """Return a note on axes that the held-out run hardly commands, although the fitted runs do; or nothing.

    Args:
        split: the runs.
        axes: names of the nu axes.
    """

    def activity(parts: Sequence[RunPart]) -> np.ndarray:
        return np.sqrt(np.nanmean(np.concatenate([part.rows.command for part in parts]) ** 2, axis=0))

    fitted, held_out = activity(split.fit), activity([split.heldout])
    idle = [axis for axis, a, b in zip(axes, fitted, held_out, strict=True) if b < _MIN_HELD_OUT_COMMAND * a]
    if not idle:
        return ()
    return (
        f"{split.heldout.name} hardly moves {', '.join(idle)}, which the fitted runs move: it cannot confirm effects on"
        " these axes. Hold out a run that moves all axes.",
    )


_SIMULATOR_METADATA = ("initial_state",)  # metadata that only a simulator can know


def remove_truth(run: RunFiles) -> RunFiles:
    """Return the run without truth columns and without metadata that only a simulator knows."""
    logs = [
        dataclasses.replace(
            log.without_truth(),
            metadata={k: v for k, v in log.metadata.items() if k not in _SIMULATOR_METADATA},
        )
        for log in run.logs
    ]
    return run._replace(logs=tuple(logs))


def make_piece_log(
    logs: Sequence[Log], name: str, rows: RunRows, axes: Sequence[str], channels: Sequence[str],
    as_logged: bool = True,
) -> Log:  # fmt: skip
    """Return the log of a run or of a piece of a run.

    `rows` are on a uniform clock, to which `merge_runs` resamples the files of a run.

    Args:
        logs: the log files of the run.
        name: name of the run or piece.
        rows: rows of the run or piece.
        axes: the nu axes.
        channels: the c channels.
        as_logged: whether readings and commands of `rows` are the logged ones; False for averaged
            or masked rows.

    Returns:
        For a single file, the logged rows with their time stamps and all columns. Otherwise a log
        on the common clock with commands and channels, NaN where missing.
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


def make_complete_logs(files: Sequence[RunFiles], merged: "MergedRuns", machine: Machine) -> tuple[Log, ...]:
    """Return one log per run or piece, with a command in every row and all positions in the first row.

    Rows before the first one with all logged axis positions are removed. If no row or command of a
    single-file run is missing, its rows are returned as logged, with all columns. Otherwise they
    are on a uniform clock, with commands and predicted channels only.

    Args:
        files: the runs.
        merged: the result of `merge_runs` for them.
        machine: the machine.
    """
    axes, channels = tuple(actuator_order(machine)), channels_predicted_and_logged(files, machine)
    by_name, logs = {run.name: run for run in files}, []
    first = [channels.index(c) for axis in axes if (c := f"{machine.position_kind(axis)}.{axis}") in channels]
    for name, rows in merged.pieces.items():
        run = by_name[merged.origin[name]]
        begin = int(np.argmax(np.isfinite(rows.reading[:, first]).all(axis=1)))
        part = slice_rows(rows, begin, len(rows.command))
        whole = make_piece_log(run.logs, name, part, axes, channels)
        complete = len(whole) == len(part.command) and part.known.all() and np.isfinite(part.reading[0, first]).all()
        log = whole if complete else make_piece_log(run.logs, name, part, axes, channels, as_logged=False)
        if log.time[0] > run.logs[0].time[0]:  # metadata of the simulator belong to the first row
            log = remove_truth(RunFiles(name, (log,))).logs[0]
        logs.append(log if len(merged.pieces) == 1 else dataclasses.replace(log, source=name))
    return tuple(logs)


_MAX_MISSING_FRACTION = 0.3  # maximum fraction of missing rows; beyond it the commands are too uncertain


@dataclass(frozen=True)
class RunData:
    """One run on a uniform clock; the period may differ between runs.

    Attributes:
        name: name of the run.
        start: time of the first row [s].
        period: time between rows [s].
        command: (n, nu) commands in actuator order, held until the next row [1], [V] or [N].
        command_known: (n,) whether the command of the row was logged and the row may be used; a
            missing row repeats the last command.
        reading: (n, c) sensor readings of the channels of the dataset [SI], NaN where missing.
        log: the log without truth. For an averaged or masked run it has the commands and channels
            of this record.
        valid: (n,) whether the model applies to the row, False in contact and in masked rows; None
            means all rows.
        readings_per_mean: (c,) number of logged readings averaged into one reading; None means one.
    """

    name: str
    start: float
    period: float
    command: np.ndarray
    command_known: np.ndarray
    reading: np.ndarray
    log: Log
    valid: np.ndarray | None = None
    readings_per_mean: np.ndarray | None = None

    def select_rows(self, first: int, last: int) -> "RunData":
        """Return a copy of the run with the rows first .. last - 1; its log remains that of the whole run."""
        rows = slice(first, last)
        return replace(
            self, start=self.start + first * self.period, command=self.command[rows],
            command_known=self.command_known[rows], reading=self.reading[rows],
            valid=None if self.valid is None else self.valid[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """Measured runs of one machine, prepared for identification.

    Attributes:
        machine: the model.
        axes: the nu axes in actuator order.
        channels: the c predicted channels that at least one run contains.
        noise: (c,) noise standard deviation of one reading [SI], from the sensors of the machine;
            NaN where their accuracy is unknown.
        fit: runs to fit.
        heldout: run for validation.
        notes: one sentence per removed or repaired part of the data.
        unused_channels: one sentence per logged channel that is not used, in all or some runs.
        sensors: name of the sensors of the machine, or None if their noise is unknown.

    Examples:
        A single log is divided: the last part is held out. A log without a channel is accepted.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> overrides = {"duration": "4", "log_rate": "100", "control_rate": "100"}
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", overrides))
        >>> columns = {name: values for name, values in run.measured.columns.items() if name != "pressure_rod.slide"}
        >>> units = {name: run.measured.units[name] for name in columns}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ht.save_log(ht.Log(run.measured.time, columns, units), Path(folder, "run.parquet"))
        ...     data = ht.load_dataset(folder, ht.load_machine("rig"), sensors="laboratory")
        >>> data.channels
        ('position.slide', 'length.slide', 'pressure_head.slide', 'pressure_supply')
        >>> [(part.name, part.start, len(part.command)) for part in (*data.fit, data.heldout)]
        [('run_1', 0.0, 300), ('run_heldout', 3.0, 100)]
    """

    machine: Machine
    axes: tuple[str, ...]
    channels: tuple[str, ...]
    noise: np.ndarray
    fit: tuple[RunData, ...]
    heldout: RunData
    notes: tuple[str, ...]
    sensors: str | None = None
    unused_channels: tuple[str, ...] = ()

    def noise_of(self, run: RunData) -> np.ndarray:
        """Return the noise standard deviations (c,) of the readings in a run [SI].

        For a mean of N logged readings it is that of one reading divided by sqrt(N).
        """
        return self.noise if run.readings_per_mean is None else self.noise / np.sqrt(run.readings_per_mean)


def load_dataset(
    paths: str | Path | Sequence[str | Path],
    machine: Machine,
    sensors: str | None = None,
    heldout: str | None = None,
    aliases: Mapping[str, str | LogColumn] | None = None,
    *,
    force: bool = False,
    mask: str | Path | None = None,
) -> Dataset:
    """Read logs and prepare them for identification; the notes list all removed and repaired data.

    The noise is that of the sensors of the machine. A sensor without a stated accuracy has noise
    NaN, even if its converter step is known, because the noise may be larger than the step.

    Args:
        paths: folder with logs, run folder, file, or several of them; see `logs.run_files`.
        machine: the model.
        sensors: name of the sensors of the machine, or `ideal` if their noise is unknown. The
            default is the metadata of the logs, or else the first sensors of the machine.
        heldout: name of the run for validation; see `split_runs`.
        aliases: column name in the files -> channel, in addition to `log_columns` of the machine.
        force: accept logs whose metadata names another machine or tool.
        mask: file of masked intervals, see `masked_intervals.read_mask`. A log may also have a
            column `valid` or `mask`.

    Returns:
        The dataset: fit runs, held-out run, channels with their noise, and notes.

    Raises:
        InputError: a file is invalid, is from another machine, has no command of an axis or values
            outside the range of the machine, or the runs are too short.

    Examples:
        Of two runs, one is fitted and one is held out for validation.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "2", "log_rate": "100", "control_rate": "100", "seed": seed}
        ...         run = ht.run_scenario(ht.load_scenario("rig_steps", overrides))
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     data = ht.load_dataset(folder, ht.load_machine("rig"))
        >>> [run.name for run in data.fit], data.heldout.name
        (['run_1'], 'run_2')
        >>> data.sensors
        'laboratory'
        >>> for channel, noise in zip(data.channels[::2], data.noise[::2]):  # standard deviation of a reading
        ...     print(f"{channel} {noise:.1e}")
        position.slide 2.9e-05
        pressure_head.slide 2.9e+04
        pressure_supply 2.9e+04
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
    masks: Sequence[MaskedInterval] = (),
) -> Dataset:
    """Make a dataset for identification from logs in memory; their readings may be NaN where missing.

    Args:
        files: the runs, sorted by name.
        machine: the model.
        sensors: name of the sensors of the machine; None for those that the metadata name.
        heldout: name of the run for validation; None to choose one (`split_runs`).
        masks: time intervals whose readings are not used.

    Raises:
        InputError: the logs do not fit the machine, or the runs are too short.
    """
    files = [remove_truth(run) for run in files]
    for run in files:
        check_commands(run, machine)
    axes, channels = tuple(actuator_order(machine)), channels_predicted_and_logged(files, machine)
    check_mask_runs(masks, [run.name for run in files])
    known, notes = determine_sensors(files, machine, sensors)
    machine, warm = _set_logged_oil_temperature(files, machine)
    notes += warm
    noise = np.array([channel_noise(machine, known, channel) for channel in channels])
    merged = merge_runs(files, machine, masks)
    runs, short = _remove_short_runs(merged)
    mended, more, unused = remove_faults(machine, known, axes, channels, noise, runs)
    unused = (*note_unknown_columns(files, machine), *note_empty_columns(files, channels), *unused)
    notes += [*note_averaged_commands(files), *merged.notes, *short, *more, *unused]
    notes += note_runs_without_motion(mended, channels, noise)
    kept = np.array([any(np.isfinite(rows.reading[:, column]).any() for rows in mended.values())
                     for column in range(len(channels))])  # fmt: skip
    if not kept.any():
        raise InputError(
            ", ".join(mended), "no channel has a usable reading: check the columns, their units"
            f" and the sensors. {' '.join(notes)}",
        )  # fmt: skip
    channels = tuple(c for c, keep in zip(channels, kept, strict=True) if keep)
    notes += note_unmeasured_axes(machine, axes, channels)
    whole, behind = {}, {}
    for name, rows in mended.items():
        # C-contiguous: compiled filters would be recompiled for another memory layout
        rows = rows._replace(reading=np.ascontiguousarray(rows.reading[:, kept]))
        _thin_correlated_readings(rows, machine, known, channels)
        whole[name], behind[name], count = average_rows(rows)
        if count > 1:
            notes.append(f"{name}: is logged at {1 / rows.period:.6g} Hz; {count} rows each were"
                         f" averaged, giving {1 / whole[name].period:.6g} Hz.")  # fmt: skip
    parts, left = split_runs(whole, merged.origin, heldout)
    logs = {run.name: run.logs for run in files}
    made = {}
    for part in (*parts.fit, parts.heldout):
        rows = part.rows
        means = behind[part.piece] if (behind[part.piece] > 1.0).any() else None
        as_logged = means is None and bool(rows.valid.all())
        log = make_piece_log(logs[merged.origin[part.piece]], part.name, rows, axes, channels, as_logged)
        made[part.name] = RunData(
            part.name, rows.start, rows.period, rows.command, rows.known & rows.valid,
            rows.reading, log, rows.valid, means,
        )  # fmt: skip
    judge = made.pop(parts.heldout.name)
    notes += [*left, *describe_resting_axes(parts, axes)]
    return Dataset(machine, axes, channels, noise[kept], tuple(made.values()), judge, tuple(notes),
                   next((n for n, s in machine.sensors.items() if s is known), None), unused)  # fmt: skip


def exchange_heldout(data: Dataset) -> Dataset:
    """Hold out the last fitted run, and fit the run that was held out."""
    *fit, run = data.fit
    note = (
        f"{run.name} is held out in place of {data.heldout.name}, which alone shows an effect that the other runs do"
        " not contradict."
    )
    return dataclasses.replace(data, fit=(*fit, data.heldout), heldout=run, notes=(*data.notes, note))


def _thin_correlated_readings(rows: RunRows, machine: Machine, sensors: SensorSet | None, channels) -> None:
    """Remove readings in place, so that those of a sensor with correlated errors are a correlation time apart."""
    for c, channel in enumerate(channels):
        every = math.ceil(find_channel_sensor(machine, sensors, channel).correlation_time / rows.period)
        if every > 1:
            kept = rows.reading[::every, c].copy()
            rows.reading[:, c] = np.nan
            rows.reading[::every, c] = kept


def _set_logged_oil_temperature(files: Sequence[RunFiles], machine: Machine) -> tuple[Machine, list[str]]:
    """Return the machine at the median oil temperature of all runs, and notes; unchanged without oil or temperature."""
    medians = {run.name: float(np.nanmedian(log["oil_temperature"])) for run in files for log in run.logs
               if "oil_temperature" in log and np.isfinite(log["oil_temperature"]).any()}  # fmt: skip
    if machine.oil is None or not medians:
        return machine, []
    low, high = min(medians, key=medians.__getitem__), max(medians, key=medians.__getitem__)
    temperature = float(np.median(list(medians.values())))
    ratio = kinematic_viscosity(machine.oil, medians[low]) / kinematic_viscosity(machine.oil, medians[high])
    text = f"the oil temperature of all runs is set to {temperature:.1f} degC, the median of the logs."
    if ratio > 1.0:
        text += (f" It is {medians[low]:.1f} degC in {low} and {medians[high]:.1f} degC in {high}; viscous friction"
                 f" differs by the factor {ratio:.2f} between them.")  # fmt: skip
    return with_oil_temperature(machine, temperature), [text]


class MergedRuns(NamedTuple):
    """Runs on uniform clocks.

    Attributes:
        pieces: name of run or piece -> rows.
        origin: the same names -> name of the logged run.
        notes: repairs by the reader and by merging, one sentence each.
    """

    pieces: dict[str, RunRows]
    origin: dict[str, str]
    notes: tuple[str, ...]


def merge_runs(files: Sequence[RunFiles], machine: Machine, masks: Sequence[MaskedInterval] = ()) -> MergedRuns:
    """Resample runs to uniform clocks, and check that their channels and values fit a machine.

    All subcommands of the command-line program accept or refuse logs by this function. Some of them
    require more: a command channel of every axis, or a minimum duration.

    Args:
        files: the runs.
        machine: the machine.
        masks: time intervals whose readings are not used.

    Raises:
        InputError: no channel is one that the model predicts, the time stamps follow no clock, more
            than 30 % of the rows are missing, or most values of a channel are outside the range of
            the machine.
    """
    axes, channels = tuple(actuator_order(machine)), channels_predicted_and_logged(files, machine)
    pieces, origin, notes = {}, {}, []
    for run in files:
        parts, said = merge_run(run, axes, channels, masks)
        notes += [note for log in run.logs for note in log.notes]
        notes += said
        where = ", ".join(log.source for log in run.logs)
        for number, rows in enumerate(parts, start=1):
            if np.mean(~rows.known) > _MAX_MISSING_FRACTION and describe_short_run(rows) is None:
                raise InputError(
                    where, f"{100 * np.mean(~rows.known):.0f} % of the rows are missing, and with"
                    f" them the commands; at most {100 * _MAX_MISSING_FRACTION:.0f} % are allowed: log"
                    " every row",
                )  # fmt: skip
            for channel, reading in zip(channels, rows.reading.T, strict=True):
                check_range(machine, channel, reading, where)
            name = run.name if len(parts) == 1 else f"{run.name}_part{number}"
            pieces[name], origin[name] = rows, run.name
    return MergedRuns(pieces, origin, tuple(notes))


def merge_runs_without_machine(path: Path) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """Read the logs of a path and check that each fits a uniform clock, without a machine model.

    Returns:
        (logs as read, notes on repairs of the reader and of the clocks).

    Raises:
        InputError: a log is invalid, or its time stamps follow no clock.
    """
    logs, notes = [], []
    for name, file in find_logs(path):
        log = load_log(file)
        axes = [c.removeprefix("command.") for c in log.columns if c.startswith("command.")]
        channels = [c for c in log.columns if not c.startswith(("command.", "valid"))]
        notes += [*log.notes, *merge_run(RunFiles(name, (log,)), axes, channels)[1]]
        logs.append(log)
    return tuple(logs), tuple(notes)


def _remove_short_runs(merged: MergedRuns) -> tuple[dict[str, RunRows], list[str]]:
    """Return the runs and pieces that are long enough to identify parameters, and notes on the others.

    Raises:
        InputError: an undivided run is too short, or no run is long enough.
    """
    runs, notes = {}, []
    whole = [name for name, run in merged.origin.items() if name == run]
    for name, rows in merged.pieces.items():
        if (short := describe_short_run(rows)) is None:
            runs[name] = rows
        elif name in whole:
            raise InputError(name, f"is {short}: record a longer run, or remove this one")
        else:
            notes.append(f"{name} is only {short}; it was removed.")
    if not runs:
        message = (
            f"no run has {MIN_RUN_SECONDS:g} s and {MIN_RUN_ROWS} rows without a gap or a masked interval:"
            " record longer runs"
        )
        raise InputError("the data", message)
    return runs, notes

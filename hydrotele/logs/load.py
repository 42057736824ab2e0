"""Logs of one machine, made ready for learning: one clock, one set of channels, gaps marked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.logs import channel_facts
from hydrotele.logs.averaging import averaged
from hydrotele.logs.files import RunFiles, check_commands, read_runs
from hydrotele.logs.log import Log
from hydrotele.logs.mask import Masked, check_runs, read_mask
from hydrotele.logs.mend import mend
from hydrotele.logs.piece_log import measured_only, piece_log
from hydrotele.logs.rows import Rows, run_rows
from hydrotele.logs.split import FEWEST, SHORTEST, split, too_short
from hydrotele.logs.value_range import check_range
from hydrotele.machine.machine import Machine

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
        mask: file of stretches that may not be used, see `mask.read_mask`; a log may also say so
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
    axes, channels = tuple(actuator_order(machine)), channel_facts.channels(files, machine)
    for run in files:
        check_commands(run, machine)
    check_runs(masks, [run.name for run in files])
    known, notes = channel_facts.sensors(files, machine, sensors)
    noise = np.array([channel_facts.noise(machine, known, channel) for channel in channels])
    runs, origin, said = _runs(files, machine, axes, channels, masks)
    mended, more = mend(machine, known, axes, channels, noise, runs)
    notes += channel_facts.strangers(files, machine) + said + list(more)
    notes += channel_facts.still(mended, channels, noise)
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
    notes += channel_facts.blind_axes(machine, axes, channels)
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

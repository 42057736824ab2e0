"""Execute one run of a sweep in any process or computer, and keep the journal of finished runs.

User machine files are copied into the folder of the sweep, so that a later change of the originals
has no effect and other computers can receive them. A scenario refers to the copies, for example
`inputs/mine-0a1b2c3d/machine.yaml`. The journal has one line per finished run, written to disk
before the next run is counted. A killed process leaves at most one incomplete last line; the next
start removes it and repeats that run.
"""

import hashlib
import json
import math
import os
import tempfile
import threading
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.datafile import read_yaml, suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import parse_json, resolve_path
from hydrotele.core.output import atomic_file
from hydrotele.core.units import KEY_SUFFIXES
from hydrotele.machine.machine_file import find_machine_file, shipped_machines
from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, find_local_machine
from hydrotele.simulate.native import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed

Number = float | int | bool | None
Numbers = dict[str, tuple[Number, str]]

TIMINGS = ("wall_seconds", "realtime_factor")  # differ between runs of equal content
_IGNORED_KEYS = (*TIMINGS, "kind", "seed", "versions", "git_commit")
_UNIT_OF_SUFFIX = {"mm": "mm", "N": "N", "J": "J", "m": "m", "rad": "rad", "A": "A", "seconds": "s"}
_UNIT_OF_SCENARIO_KEY = {
    "duration": "s", "timestep": "s", "control_rate": "Hz", "log_rate": "Hz",
    "servo.position_gain": "1/s", "servo.lead": "s", "servo.load_time": "s",
    "servo.pressure_feedback": "1/s", "pilot.acceleration": "m/s2", "pilot.settle": "s",
    "pilot.channel.delay_forward": "s", "pilot.channel.delay_back": "s",
}  # fmt: skip

_COMMON_NUMBERS = (
    "simulated_seconds", "physics_steps", "max_pin_opening_mm", "max_contact_force_N",
    "balance.seconds", "balance.flow_balance", "balance.energy_balance",
)  # fmt: skip
_STATION_NUMBERS = (
    "handle_energy_J", "min_handle_energy_J", "max_handle_displacement_m",
    "max_handle_rotation_rad", "max_coil_current_A", "max_coil_heat",
    "periods_with_limited_currents", "max_tip_force_N", "tripped",
)  # fmt: skip
_TIP_COORDINATES = ("tip_r", "tip_z", "tip_attitude")


def flatten_summary(summary: dict[str, Any]) -> Numbers:
    """Return the numbers of a run's summary as dotted name -> (number, unit).

    Timings and versions, which differ between equal runs, are omitted.

    >>> flatten_summary({"scenario": "a", "tracking": {"boom": {"rms": 0.1, "unit": "rad"}}})
    {'tracking.boom.rms': (0.1, 'rad')}
    """
    kept = {key: value for key, value in summary.items() if key not in _IGNORED_KEYS}
    return dict(_iterate_summary_numbers(kept, "", None))


def _iterate_summary_numbers(part: dict[str, Any], above: str, unit: str | None):
    unit = part.get("unit", unit)
    for key, value in part.items():
        name = f"{above}{key}"
        value = value.item() if isinstance(value, np.generic) else value  # JSON needs plain types
        if isinstance(value, dict):
            yield from _iterate_summary_numbers(value, f"{name}.", unit)
        elif value is None or isinstance(value, (bool, int, float)):
            finite = value if value is None or math.isfinite(value) else None
            yield name, (finite, unit or _UNIT_OF_SUFFIX.get(key.rpartition("_")[2], "1"))


def key_unit(key: str) -> str | None:
    """Return the unit of a scenario key, from its suffix such as `_deg` or a table; None if unknown."""
    found = (unit for suffix, unit in KEY_SUFFIXES.items() if key.endswith(suffix))
    return next(found, None) or _UNIT_OF_SCENARIO_KEY.get(key)


def possible_number_names(axes: Iterable[str], teleoperated: bool) -> list[str]:
    """Return the names of all summary numbers that runs with these axes can contain."""
    tracked = [f"tracking.{name}.{size}" for name in (*axes, *_TIP_COORDINATES) for size in ("rms", "max")]
    station = [f"teleoperation.{name}" for name in _STATION_NUMBERS] if teleoperated else []
    return [*_COMMON_NUMBERS, *tracked, *station]


def check_figures(figures: Iterable[str], possible: list[str], where: str) -> None:
    """Check that every figure is the name of a summary number.

    Raises:
        InputError: a name is unknown; the message lists valid names.
    """
    for name in figures:
        if name not in possible:
            message = f"{name!r} is not a number in the summary of a run"
            raise InputError(where, f"{message}; {suggest_valid_name(name, possible)}")


OK, FAILED = "ok", "failed"
JOURNAL = "journal.jsonl"


class JournalEntry(NamedTuple):
    """Journal entry of a finished run.

    Attributes:
        run: run number.
        status: OK or FAILED.
        reason: reason of a failure, otherwise empty.
        numbers: numbers of the run's summary.
        notes: notes of the run's summary, joined.
        wall_seconds: computing time of the tick loop [s], None if the run failed.
    """

    run: int
    status: str
    reason: str = ""
    numbers: Numbers = {}
    notes: str = ""
    wall_seconds: float | None = None


def count_finished_runs(path: Path) -> int:
    """Return the number of finished runs in the journal file of a sweep; 0 if it does not exist."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    return len({line.partition(b",")[0] for line in lines})


class Journal:
    """The open file with one line per finished run of a sweep; only one process may open it at a time.

    Attributes:
        path: the file.
        entries: run number -> entry.
    """

    def __init__(self, path: Path) -> None:
        """Read the entries, remove incomplete lines and open the file for appending.

        Raises:
            InputError: the file cannot be read or written.
        """
        self.path, self.entries = path, {}
        try:
            content = path.read_bytes() if path.exists() else b""
            lines = content.split(b"\n")
            good = [line for line in lines[:-1] if self._parse_line(line)]
            if b"".join(line + b"\n" for line in good) != content:
                with atomic_file(path, ".jsonl") as part:
                    part.write_bytes(b"".join(line + b"\n" for line in good))
            self._file = open(path, "ab")
        except OSError as error:
            raise InputError(path, f"cannot be used: {error.strerror}") from None

    def _parse_line(self, line: bytes) -> bool:
        try:
            entry = JournalEntry(**parse_json(line))
            numbers = {name: (value, unit) for name, (value, unit) in entry.numbers.items()}
        except (ValueError, TypeError, AttributeError):
            return False
        self.entries[entry.run] = entry._replace(numbers=numbers)
        return True

    def add(self, entry: JournalEntry) -> None:
        """Append the entry of a run and flush it to disk.

        Raises:
            InputError: the entry cannot be written, for example because the disk is full.
        """
        text = json.dumps(entry._asdict(), allow_nan=False, ensure_ascii=False)
        try:
            self._file.write(text.encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise InputError(self.path, f"cannot be written: {error.strerror}") from None
        self.entries[entry.run] = entry

    def close(self) -> None:
        """Close the file; `add` has already written all entries to disk."""
        self._file.close()


INPUTS = "inputs"
Files = dict[str, bytes]


class CopiedMachine(NamedTuple):
    """A user machine, copied into the folder of a sweep.

    Attributes:
        name: path of the machine file in the sweep folder; the original path if the machine cannot
            be copied.
        files: path in the sweep folder -> content; empty if the machine cannot be copied.
    """

    name: str
    files: Files


class MachineCopies:
    """Copies of the machine files of a sweep that are not shipped with the package, each read once."""

    def __init__(self) -> None:
        """Start without machines."""
        self._known: dict[Path, CopiedMachine] = {}

    def with_copied_paths(self, scenario: Scenario) -> Scenario:
        """Return the scenario with its user machines replaced by the paths of their copies.

        The paths are relative to the sweep folder. Machines that are new are read.

        Raises:
            InputError: a machine file cannot be read.
        """
        changes: dict = {"folder": ""}
        if own := find_local_machine(scenario):
            changes["machine"] = self._copied_machine(own).name
        model = scenario.servo.force_model
        if model and model != "nominal" and model not in shipped_machines():
            name = self._copied_machine(Path(model)).name
            changes["servo"] = scenario.servo.model_copy(update={"force_model": name})
        return scenario.model_copy(update=changes)

    def files(self) -> Files:
        """Return path in the sweep folder -> content of the files of all machines read so far."""
        return {name: text for copied in self._known.values() for name, text in copied.files.items()}

    def files_of(self, scenario: Scenario) -> Files:
        """Return path in the sweep folder -> content of the machine files that one scenario uses.

        The scenario is a result of `with_copied_paths`.
        """
        names = {scenario.machine, scenario.servo.force_model}
        copied = [machine for machine in self._known.values() if machine.name in names]
        return {name: text for machine in copied for name, text in machine.files.items()}

    def check_sendable(self, where: str) -> None:
        """Check that all machines can be sent to other computers.

        Raises:
            InputError: a machine needs files in addition to its MJCF file.
        """
        for path, copied in self._known.items():
            if not copied.files:
                message = "needs files in addition to its MJCF, which cannot be sent; run without --dask"
                raise InputError(where, f"machine {path} {message}")

    def _copied_machine(self, path: Path) -> CopiedMachine:
        file = resolve_path(find_machine_file(path))
        if file not in self._known:
            self._known[file] = _copy_machine(file)
        return self._known[file]


def _copy_machine(file: Path) -> CopiedMachine:
    contents = {file.name: file.read_bytes()}
    mjcf = str(read_yaml(file)[0].get("mjcf") or "")
    if mjcf and (file.parent / mjcf).is_file():  # a resolved machine may name a shipped one
        text = (file.parent / mjcf).read_bytes()
        inside = not PurePosixPath(mjcf).is_absolute() and ".." not in PurePosixPath(mjcf).parts
        if not inside or b" file=" in text:
            return CopiedMachine(str(file), {})
        contents[mjcf] = text
    digest = hashlib.sha256(b"\0".join(part for pair in sorted(contents.items())
                                       for part in (pair[0].encode(), pair[1])))  # fmt: skip
    folder = f"{INPUTS}/{file.parent.name}-{digest.hexdigest()[:12]}"
    return CopiedMachine(f"{folder}/{file.name}", {f"{folder}/{name}": text for name, text in contents.items()})


def with_resolved_paths(scenario: Scenario, folder: Path) -> Scenario:
    """Return the scenario with its machine paths, which are relative to a sweep folder, in that folder.

    Args:
        scenario: a result of `MachineCopies.with_copied_paths`.
        folder: the folder that contains the copied machines.
    """
    changes: dict = {"folder": str(folder)}
    model = scenario.servo.force_model
    if model and model.startswith(f"{INPUTS}/"):
        servo = scenario.servo.model_copy(update={"force_model": str(folder / model)})
        changes["servo"] = servo
    return scenario.model_copy(update=changes)


def write_files(files: Files, folder: Path) -> None:
    """Write files (relative path -> content) under a folder, and create subfolders as needed."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)


WriteRun = Callable[[Run, Path, bool], Any]
_RUN_LOCK = threading.Lock()  # cluster workers may use threads, but MuJoCo callbacks are global


class RunTask(NamedTuple):
    """A run to execute.

    Attributes:
        run: run number.
        scenario: scenario whose machine paths are relative to `folder`.
        folder: folder that contains the user machines, None if `files` contains them.
        files: path -> content of the user machines.
        write_run_files: function that writes a run into a folder, as `cli.running.write_run`; None to keep no
            logs.
        scratch: folder for temporary files; None for that of the system.
    """

    run: int
    scenario: Scenario
    folder: str | None
    files: Files
    write_run_files: WriteRun | None
    scratch: str | None


class Outcome(NamedTuple):
    """Result of a run task.

    Attributes:
        entry: journal entry.
        versions: versions of the simulating software; empty if the run failed.
        files: file name -> content of the run folder; empty if no logs are kept.
    """

    entry: JournalEntry
    versions: dict[str, str]
    files: Files


def execute_task(task: RunTask) -> Outcome:
    """Execute one run of a sweep; a failure gives an outcome with its reason instead of an exception."""
    try:
        with _RUN_LOCK, tempfile.TemporaryDirectory(prefix="sweep_", dir=task.scratch) as scratch:
            return _execute_task(task, Path(scratch))
    except SimulationFailed as error:
        return failed_outcome(task.run, f"simulation failed: {error}")
    except InputError as error:
        return failed_outcome(task.run, str(error))
    except Exception as error:  # a failed run must not stop the other runs
        return failed_outcome(task.run, f"{type(error).__name__}: {error}")


def failed_outcome(run: int, reason: str) -> Outcome:
    """Return the outcome of a failed run, with the first line of the reason."""
    return Outcome(JournalEntry(run, FAILED, reason.strip().partition("\n")[0]), {}, {})


def _execute_task(task: RunTask, scratch: Path) -> Outcome:
    stop_profiling_clock()
    write_files(task.files, scratch)
    there = Path(task.folder) if task.folder else scratch
    result = run_scenario(with_resolved_paths(task.scenario, there))
    summary = result.summary
    entry = JournalEntry(
        task.run,
        OK,
        "",
        flatten_summary(summary),
        "; ".join(summary["notes"]),
        summary["wall_seconds"],
    )
    files: Files = {}
    if task.write_run_files:
        folder = scratch / "run"
        folder.mkdir()
        task.write_run_files(result, folder, False)
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    return Outcome(entry, summary["versions"], files)

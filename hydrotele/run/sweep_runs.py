"""One run of a sweep in whichever process or computer it is done, and the journal of finished runs.

The files of a sweep's own machines are copied into its folder, so that they can change or travel; a
scenario names them by their place there, as in `inputs/mine-0a1b2c3d/machine.yaml`. The journal has
a line for every finished run, on disk before the next one counts: a process that is killed leaves
at most half a line at the end, which the next start drops; that run is done again.
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

from hydrotele.core.datafile import read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import json_value
from hydrotele.core.output import replacing
from hydrotele.core.units import KEY_SUFFIXES
from hydrotele.machine.machine_file import machine_path, shipped_machines
from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, own_machine
from hydrotele.simulate.native import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed

Number = float | int | bool | None
Numbers = dict[str, tuple[Number, str]]

TIMINGS = ("wall_seconds", "realtime_factor")  # differ between runs of equal content
_LEFT_OUT = (*TIMINGS, "kind", "seed", "versions", "git_commit")
_ENDINGS = {"mm": "mm", "N": "N", "J": "J", "m": "m", "rad": "rad", "A": "A", "seconds": "s"}
_SCENARIO = {
    "duration": "s", "timestep": "s", "control_rate": "Hz", "log_rate": "Hz",
    "servo.position_gain": "1/s", "servo.lead": "s", "servo.load_time": "s",
    "servo.pressure_feedback": "1/s", "pilot.acceleration": "m/s2", "pilot.settle": "s",
    "pilot.channel.delay_forward": "s", "pilot.channel.delay_back": "s",
}  # fmt: skip

_EVERY = (
    "simulated_seconds", "physics_steps", "largest_pin_opening_mm", "largest_contact_force_N",
    "balance.seconds", "balance.flow_balance", "balance.energy_balance",
)  # fmt: skip
_STATION = (
    "handle_energy_J", "handle_least_energy_J", "largest_handle_displacement_m",
    "largest_handle_rotation_rad", "largest_coil_current_A", "largest_coil_heat",
    "periods_with_limited_currents", "largest_tip_force_N", "tripped",
)  # fmt: skip
_TIP = ("tip_r", "tip_z", "tip_attitude")


def numbers_of(summary: dict[str, Any]) -> Numbers:
    """Dotted name -> (number, unit) of a run's summary, but for timings and versions.

    >>> numbers_of({"scenario": "a", "tracking": {"boom": {"rms": 0.1, "unit": "rad"}}})
    {'tracking.boom.rms': (0.1, 'rad')}
    """
    kept = {key: value for key, value in summary.items() if key not in _LEFT_OUT}
    return dict(_flat(kept, "", None))


def _flat(part: dict[str, Any], above: str, unit: str | None):
    unit = part.get("unit", unit)
    for key, value in part.items():
        name = f"{above}{key}"
        value = value.item() if isinstance(value, np.generic) else value  # as the journal has it
        if isinstance(value, dict):
            yield from _flat(value, f"{name}.", unit)
        elif value is None or isinstance(value, (bool, int, float)):
            finite = value if value is None or math.isfinite(value) else None
            yield name, (finite, unit or _ENDINGS.get(key.rpartition("_")[2], "1"))


def key_unit(key: str) -> str | None:
    """Unit of a scenario's key as far as its name tells."""
    found = (unit for suffix, unit in KEY_SUFFIXES.items() if key.endswith(suffix))
    return next(found, None) or _SCENARIO.get(key)


def possible_results(axes: Iterable[str], teleoperated: bool) -> list[str]:
    """Names of all numbers that runs of machines with these axes can have."""
    tracked = [f"tracking.{name}.{size}" for name in (*axes, *_TIP) for size in ("rms", "max")]
    station = [f"teleoperation.{name}" for name in _STATION] if teleoperated else []
    return [*_EVERY, *tracked, *station]


def check_figures(figures: Iterable[str], possible: list[str], where: str) -> None:
    """Refuse figures that no run can have.

    Raises:
        InputError: the first one, with the valid names.
    """
    for name in figures:
        if name not in possible:
            raise InputError(where, f"{name!r} is no number of a run; {suggest(name, possible)}")


OK, FAILED = "ok", "failed"
JOURNAL = "journal.jsonl"


class Entry(NamedTuple):
    """What is kept of a run.

    Attributes:
        run: its number.
        status: OK or FAILED.
        reason: why it failed, else empty.
        numbers: of its summary.
        notes: of its summary, joined.
        wall_seconds: that its loop took [s], None where it failed.
    """

    run: int
    status: str
    reason: str = ""
    numbers: Numbers = {}
    notes: str = ""
    wall_seconds: float | None = None


def finished(path: Path) -> int:
    """Number of runs that a journal holds."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    return len({line.partition(b",")[0] for line in lines})


class Journal:
    """The open journal of a sweep; one process has it at a time."""

    def __init__(self, path: Path) -> None:
        """Read what is there, drop what is broken and open the file to append.

        Raises:
            InputError: it cannot be read or written.
        """
        self.path, self.entries = path, {}
        try:
            content = path.read_bytes() if path.exists() else b""
            lines = content.split(b"\n")
            good = [line for line in lines[:-1] if self._take(line)]
            if b"".join(line + b"\n" for line in good) != content:
                with replacing(path, ".jsonl") as part:
                    part.write_bytes(b"".join(line + b"\n" for line in good))
            self._file = open(path, "ab")
        except OSError as error:
            raise InputError(path, f"cannot be used: {error.strerror}") from None

    def _take(self, line: bytes) -> bool:
        try:
            entry = Entry(**json_value(line))
            numbers = {name: (value, unit) for name, (value, unit) in entry.numbers.items()}
        except (ValueError, TypeError, AttributeError):
            return False
        self.entries[entry.run] = entry._replace(numbers=numbers)
        return True

    def add(self, entry: Entry) -> None:
        """Write the entry of a run; it is on disk when this returns.

        Raises:
            InputError: the disk is full or the folder gone.
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
        """Close the file; all entries are on disk."""
        self._file.close()


INPUTS = "inputs"
Files = dict[str, bytes]


class Copied(NamedTuple):
    """A machine of the user's.

    Attributes:
        name: of its machine file in the sweep's folder; its own path where it cannot be copied.
        files: path in the sweep's folder -> content; empty where it cannot be copied.
    """

    name: str
    files: Files


class Inputs:
    """The machines of a sweep that are not shipped, each read once."""

    def __init__(self) -> None:
        """Begin with none."""
        self._known: dict[Path, Copied] = {}

    def named(self, scenario: Scenario) -> Scenario:
        """The scenario with its own machines named by their place in the sweep's folder.

        Raises:
            InputError: a machine's file cannot be read.
        """
        changes: dict = {"folder": ""}
        if own := own_machine(scenario):
            changes["machine"] = self._copied(own).name
        model = scenario.servo.force_model
        if model and model != "nominal" and model not in shipped_machines():
            name = self._copied(Path(model)).name
            changes["servo"] = scenario.servo.model_copy(update={"force_model": name})
        return scenario.model_copy(update=changes)

    def files(self) -> Files:
        """Path in the sweep's folder -> content, of all machines so far."""
        return {
            name: text for copied in self._known.values() for name, text in copied.files.items()
        }

    def files_of(self, scenario: Scenario) -> Files:
        """Those of the machines that one scenario of `named` names."""
        names = {scenario.machine, scenario.servo.force_model}
        copied = [machine for machine in self._known.values() if machine.name in names]
        return {name: text for machine in copied for name, text in machine.files.items()}

    def refuse_bound(self, where: str) -> None:
        """Refuse machines that other computers cannot be given.

        Raises:
            InputError: a machine needs further files.
        """
        for path, copied in self._known.items():
            if not copied.files:
                message = "needs files beside its MJCF, which cannot be sent; run it without --dask"
                raise InputError(where, f"machine {path} {message}")

    def _copied(self, path: Path) -> Copied:
        file = machine_path(path).resolve()
        if file not in self._known:
            self._known[file] = _copy(file)
        return self._known[file]


def _copy(file: Path) -> Copied:
    contents = {file.name: file.read_bytes()}
    mjcf = str(read_yaml(file)[0].get("mjcf") or "")
    if mjcf and (file.parent / mjcf).is_file():  # a resolved machine may name a shipped one
        text = (file.parent / mjcf).read_bytes()
        inside = not PurePosixPath(mjcf).is_absolute() and ".." not in PurePosixPath(mjcf).parts
        if not inside or b" file=" in text:
            return Copied(str(file), {})
        contents[mjcf] = text
    digest = hashlib.sha256(b"\0".join(part for pair in sorted(contents.items())
                                       for part in (pair[0].encode(), pair[1])))  # fmt: skip
    folder = f"{INPUTS}/{file.parent.name}-{digest.hexdigest()[:12]}"
    return Copied(
        f"{folder}/{file.name}", {f"{folder}/{name}": text for name, text in contents.items()}
    )


def placed(scenario: Scenario, folder: Path) -> Scenario:
    """A scenario of `Inputs.named` where its machines lie under a folder."""
    changes: dict = {"folder": str(folder)}
    model = scenario.servo.force_model
    if model and model.startswith(f"{INPUTS}/"):
        servo = scenario.servo.model_copy(update={"force_model": str(folder / model)})
        changes["servo"] = servo
    return scenario.model_copy(update=changes)


def unpack(files: Files, folder: Path) -> None:
    """Write files under a folder."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)


Keep = Callable[[Run, Path, bool], Any]
_ONE = threading.Lock()  # a worker of a cluster may have threads; runs share MuJoCo's callbacks


class RunTask(NamedTuple):
    """A run to do.

    Attributes:
        run: its number.
        scenario: of `Inputs.named`.
        folder: where the scenario's own machines lie, None where `files` brings them.
        files: path -> content of these machines.
        keep: writes a run into a folder, as `cli.running.write_run`; None to keep no logs.
        scratch: folder for that on the way; None for the system's.
    """

    run: int
    scenario: Scenario
    folder: str | None
    files: Files
    keep: Keep | None
    scratch: str | None


class Outcome(NamedTuple):
    """What comes back of a run.

    Attributes:
        entry: for the journal.
        versions: of what simulated; empty where it failed.
        files: name -> content of the run's folder, if it is to be kept.
    """

    entry: Entry
    versions: dict[str, str]
    files: Files


def perform(task: RunTask) -> Outcome:
    """Do a run. Never raises: a run that fails says why."""
    try:
        with _ONE, tempfile.TemporaryDirectory(prefix="sweep_", dir=task.scratch) as scratch:
            return _perform(task, Path(scratch))
    except SimulationFailed as error:
        return failed(task.run, f"simulation failed: {error}")
    except InputError as error:
        return failed(task.run, str(error))
    except Exception as error:  # one run's trouble is not the other runs'
        return failed(task.run, f"{type(error).__name__}: {error}")


def failed(run: int, reason: str) -> Outcome:
    """The outcome of a run that failed; of the reason the first line."""
    return Outcome(Entry(run, FAILED, reason.strip().partition("\n")[0]), {}, {})


def _perform(task: RunTask, scratch: Path) -> Outcome:
    stop_profiling_clock()
    unpack(task.files, scratch)
    there = Path(task.folder) if task.folder else scratch
    result = run_scenario(placed(task.scenario, there))
    summary = result.summary
    entry = Entry(
        task.run, OK, "", numbers_of(summary), "; ".join(summary["notes"]), summary["wall_seconds"]
    )
    files: Files = {}
    if task.keep:
        folder = scratch / "run"
        folder.mkdir()
        task.keep(result, folder, False)
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    return Outcome(entry, summary["versions"], files)

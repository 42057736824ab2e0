"""One run of a sweep, in whichever process or computer it is done.

The files of a sweep's own machines: copied into its folder, so that they can change or travel.

A scenario of a sweep names its own machines by their place in the sweep's folder, as in
`inputs/mine-0a1b2c3d/machine.yaml`; `placed` says where that folder is.
"""

import hashlib
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import machine_path, shipped_machines
from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, own_machine
from hydrotele.simulate.native import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed
from hydrotele.sweep.journal import FAILED, OK, Entry, numbers_of

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


class Task(NamedTuple):
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


def perform(task: Task) -> Outcome:
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


def _perform(task: Task, scratch: Path) -> Outcome:
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

"""One run of a sweep, in whichever process or computer it is done."""

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.native import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed
from hydrotele.sweep.inputs import Files, placed, unpack
from hydrotele.sweep.journal import FAILED, OK, Entry
from hydrotele.sweep.numbers import numbers_of

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

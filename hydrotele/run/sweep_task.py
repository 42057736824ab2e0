"""Execution of one run of a sweep, in any process or on any computer."""

import math
import tempfile
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.units import KEY_SUFFIXES
from hydrotele.run.machine_copies import Files, with_resolved_paths, write_files
from hydrotele.run.run import Run, run_scenario
from hydrotele.run.sweep_journal import FAILED, OK, JournalEntry, Numbers
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed

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

    Timings, seed, versions and other entries that do not belong to the results are omitted. A
    number that is not finite becomes None.

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
    """Return the unit of a scenario key, None if unknown; a suffix such as `_deg` or a table gives it."""
    found = (unit for suffix, unit in KEY_SUFFIXES.items() if key.endswith(suffix))
    return next(found, None) or _UNIT_OF_SCENARIO_KEY.get(key)


def possible_number_names(axes: Iterable[str], teleoperated: bool) -> list[str]:
    """Return the names of all summary numbers that runs with these axes can contain."""
    tracked = [f"tracking.{name}.{size}" for name in (*axes, *_TIP_COORDINATES) for size in ("rms", "max")]
    station = [f"teleoperation.{name}" for name in _STATION_NUMBERS] if teleoperated else []
    return [*_COMMON_NUMBERS, *tracked, *station]


def check_figures(figures: Iterable[str], possible: list[str], where: str) -> None:
    """Check that every figure is the name of a summary number.

    Args:
        figures: the names.
        possible: names of all summary numbers.
        where: location for the error message.

    Raises:
        InputError: a name is unknown; the message lists valid names.
    """
    for name in figures:
        if name not in possible:
            message = f"{name!r} is not a number in the summary of a run"
            raise InputError(where, f"{message}; {suggest_valid_name(name, possible)}")


WriteRun = Callable[[Run, Path, bool], Any]
_RUN_LOCK = threading.Lock()  # cluster workers may use threads, but MuJoCo callbacks are global


class RunTask(NamedTuple):
    """A run to execute.

    Attributes:
        run: run number.
        scenario: scenario whose machine paths are relative to `folder`.
        folder: folder that contains the user machines, None if `files` contains them.
        files: path -> content of the user machines.
        write_run_files: function that writes a run into a folder, as `cli.run_command.write_run`; None to keep no
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
    """Return the outcome of a failed run, with only the first line of the reason."""
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

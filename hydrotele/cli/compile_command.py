"""Implement `hydrotele compile`: fill the cache of compiled functions, using several processes.

Each job runs a short task that calls all compiled functions of one group of commands, with the
argument types that these commands use.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import typer

import hydrotele
from hydrotele.core.code_cache import CODE_VERSIONS
from hydrotele.core.compile_progress import SECONDS_BEFORE_BAR, ProgressLine, format_bar
from hydrotele.core.compiled import SHIPPED_FOLDER, cache_folder
from hydrotele.core.errors import InputError
from hydrotele.core.target_processor import processor_name

_POLL = 0.2  # s between two checks of the jobs


class Job(NamedTuple):
    """Work of one process.

    Attributes:
        name: name in the progress bar.
        run: function that executes the task.
        seconds: processor time with an empty cache [s]; it determines the order of the jobs and
            the estimate of the remaining time.
    """

    name: str
    run: Callable[[], None]
    seconds: float


def _compile_teleoperation() -> None:
    from hydrotele.run.tick_loop import compile_tick_loop

    compile_tick_loop()


def _compile_batch() -> None:
    from hydrotele.batch import Batch
    from hydrotele.machine.machine_file import load_machine

    for tool in ("none", "bucket"):
        Batch(load_machine("cat215", tool), 8, threads=1).step(None)


def _compile_runs() -> None:
    from hydrotele.machine.machine_file import load_machine
    from hydrotele.run.replay import replay_log
    from hydrotele.run.run import run_scenario
    from hydrotele.scenario.scenario import load_scenario

    run_scenario(load_scenario("dig"))  # all phases of the task
    run_scenario(load_scenario("press_stiffness", {"duration": "0.2"}))
    replay_log(run_scenario(load_scenario("excitation", {"duration": "0.2"})).measured, load_machine("cat215"))


def _compile_environments() -> None:
    import gymnasium

    from hydrotele.envs import TASK_NAMES

    for name in TASK_NAMES:
        env = gymnasium.make(f"hydrotele/{name}-v0")
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()


def _compile_laws() -> None:
    import hydrotele.effects  # noqa: F401, defines the laws
    from hydrotele.terms.law import LAWS
    from hydrotele.terms.table import law_index

    for name in LAWS:
        law_index(name)


def _compile_gap() -> None:
    from hydrotele.gap.find import find_gap
    from hydrotele.gap.initial_regressions import fit_robust
    from hydrotele.logs.dataset import load_dataset
    from hydrotele.logs.log import save_log
    from hydrotele.machine.machine_file import load_machine
    from hydrotele.run.run import run_scenario
    from hydrotele.scenario.scenario import load_scenario

    with tempfile.TemporaryDirectory() as folder:
        effect = "[{name: valve_deadband, location: stick, parameters: {deadband: 0.2}}]"  # so that one is found
        for k in range(2):
            scenario = load_scenario("excitation", {"duration": "5", "seed": str(k), "effects": effect})
            save_log(run_scenario(scenario).measured, Path(folder) / f"{k}.parquet")
        data = load_dataset(Path(folder), load_machine("cat215"))
        find_gap(data)
        find_gap(data, effects=("valve_gain",))
    fit_robust(np.arange(9.0), np.ones((9, 1)), np.array([-np.inf]))  # these logs are too short for it


def _compile_analyses() -> None:
    from hydrotele.teleop.case_file import load_teleop_case
    from hydrotele.teleop.simulation_check import run_sine_sweep
    from hydrotele.teleop.stiffness_switching import worst_switching_growth

    with tempfile.TemporaryDirectory() as folder:
        for line in (
            f"run excitation --set duration=20 --no-review --out {folder}/logs/1",
            f"run excitation --set duration=20 --set seed=1 --no-review --out {folder}/logs/2",
            f"identify --data {folder}/logs --hydraulics --out {folder}/identified",
            f"calibrate hybrid --simulate {folder}/robot --poses 25",
            f"calibrate hybrid --data {folder}/robot --out {folder}/calibrated",
            "analyse teleop press_direct --json",
        ):
            subprocess.run([sys.executable, "-P", "-m", "hydrotele", *line.split()], check=True)
    run_sine_sweep(load_teleop_case().to_axis(), "position_force", np.array([50.0]))
    worst_switching_growth(1.0, 0.0, 100.0, 400.0)


def _compile_haptics() -> None:
    from hydrotele.haptics.device import SimulatedDevice
    from hydrotele.haptics.link import HapticLink
    from hydrotele.machine.joystick import load_joystick
    from hydrotele.scenario.scenario import load_scenario
    from hydrotele.scenario.teleoperation import TeleopPilot
    from hydrotele.teleop.master import build_master

    SimulatedDevice(1.0e-3).read()
    pilot = load_scenario("press_stiffness").pilot
    assert isinstance(pilot, TeleopPilot)
    master = build_master(load_joystick(), pilot, ("r", "theta", "z", "attitude"))
    link, packet = HapticLink("127.0.0.1", 9), np.zeros((8, 4))
    try:
        link.start(*master, packet.shape)
        link.exchange(np.zeros(7), packet, 1.0, np.zeros(6))
        link.pose()
    finally:
        link.close()


JOBS = (
    Job("gap", _compile_gap, 140.0),
    Job("environments", _compile_environments, 95.0),
    Job("teleoperation", _compile_teleoperation, 65.0),
    Job("analyses", _compile_analyses, 30.0),
    Job("runs", _compile_runs, 15.0),
    Job("haptics", _compile_haptics, 10.0),
    Job("batches", _compile_batch, 10.0),
    Job("laws", _compile_laws, 5.0),
)


def run_job(name: str) -> None:
    """Run the compilation job of the given name in this process, which fills the cache."""
    next(job for job in JOBS if job.name == name).run()


def compile_all(processes: int | None = None) -> None:
    """Compile all numerical functions by running jobs in child processes, the longest first.

    A marker file in the cache folder records completion, so that a repeated call does nothing. A
    wheel with compiled code contains this file, too.

    Args:
        processes: number of parallel processes, default one per core.

    Raises:
        InputError: there is no usable cache folder, or a job failed.
    """
    folder, marker = cache_folder(), f"complete_{_hash_sources_and_versions()}"
    if any(place is not None and (place / marker).exists() for place in (SHIPPED_FOLDER, folder)):
        typer.echo("all functions are compiled already")
        return
    if folder is None:
        raise InputError("cache", "no folder is writable by you alone; set XDG_CACHE_HOME to such a folder")
    processes = processes or len(os.sched_getaffinity(0))
    began, line = time.monotonic(), ProgressLine()
    messages = tempfile.TemporaryDirectory()
    waiting = sorted(JOBS, key=lambda job: -job.seconds)
    running: dict[Job, tuple[float, subprocess.Popen]] = {}
    finished, spent, total = 0.0, 0.0, sum(job.seconds for job in JOBS)
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                job = waiting.pop(0)
                code = f"from hydrotele.cli.compile_command import run_job; run_job({job.name!r})"
                running[job] = time.monotonic(), start_python(code, Path(messages.name, job.name))
            time.sleep(_POLL)
            for job, (start, process) in [*running.items()]:
                if process.poll() is not None:
                    del running[job]
                    finished, spent = finished + job.seconds, spent + time.monotonic() - start
                    if process.returncode:
                        raise InputError(
                            f"compilation of {job.name}", read_last_error_line(process, Path(messages.name, job.name))
                        )
            scale = spent / finished if finished else 1.0  # time relative to `Job.seconds`
            begun = sum(min((time.monotonic() - start) / scale, job.seconds)
                        for job, (start, _) in running.items())  # fmt: skip
            left = (total - finished - begun) * scale / processes
            if running and time.monotonic() - began > SECONDS_BEFORE_BAR:
                names = ", ".join(job.name for job in running)
                line.show(format_bar(names, (finished + begun) / total, left))
    finally:
        line.clear()
        for _, process in running.values():
            process.kill()
            process.wait()
        messages.cleanup()
    for old in folder.glob("complete_*"):
        old.unlink()
    (folder / marker).touch()
    typer.echo(f"all functions are compiled ({time.monotonic() - began:.0f} s)")


def _hash_sources_and_versions() -> str:
    """Return a hash of `CODE_VERSIONS`, the name of the processor and all sources of the package.

    Equal hashes mean equal compiled code.
    """
    package = Path(hydrotele.__file__).parent
    text = hashlib.sha256(f"{CODE_VERSIONS} {processor_name()}".encode())
    for path in sorted(package.rglob("*.py")):
        text.update(path.read_bytes())
    return text.hexdigest()[:16]


def start_python(code: str, errors: Path) -> subprocess.Popen:
    """Start a Python process that executes some code; its standard error is written to the file `errors`.

    A pipe that is read only after the end would block a process with more than 64 KB of warnings.
    """
    with errors.open("wb") as file:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", code], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=file
        )


def read_last_error_line(process: subprocess.Popen, errors: Path) -> str:
    """Return the last line of the file `errors`, or the exit status of the finished process if it is empty."""
    lines = errors.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit status {process.returncode}"

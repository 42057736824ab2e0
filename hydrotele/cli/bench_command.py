"""Implement `hydrotele bench`: measure the speed of steps, scenarios, batches and start-up.

All times are measured by one process. The results can be saved and compared with earlier ones.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch

from hydrotele.batch.measure import CPU_COUNTS, CUDA_COUNTS, measure_batch
from hydrotele.cli.console import make_table, print_json, stderr_console, stdout_console
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_json
from hydrotele.core.output import atomic_file
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.mechanism import assemble_mjcf, mjcf_document
from hydrotele.simulate.plant import Plant, build_plant, rest_state

STEPS = 1000
SIMULATIONS = 256
TELEOPERATED_SCENARIOS = ("joystick_up", "press_stiffness", "feller_steps")
VALVE_COMMANDS = (0.2, 0.1, -0.1)
_SHORT_RUN_ARGUMENTS = ("run", "excitation", "--set", "duration=1.0", "--no-review")


def run_benchmarks(save: Path | None, compare: Path | None, quick: bool, as_json: bool) -> None:
    """Run the benchmarks, print the results, and save them or compare them with earlier ones on request.

    Args:
        save: file to write the results to, or None.
        compare: file with earlier results, or None; they are printed next to the new ones.
        quick: use fewer repetitions.
        as_json: print the new results as JSON only.

    Raises:
        InputError: the file to compare with cannot be read, or the file to save cannot be written, or
            both a comparison and JSON are requested.
    """
    if compare and as_json:
        message = "cannot be combined with --json, which prints the new results only: omit one of them"
        raise InputError("--compare", message)
    earlier = _read(compare) if compare else None
    if save and not save.parent.is_dir():
        raise InputError(save, f"cannot be written: {save.parent} is not a folder")
    figures = measure_speed(5 if quick else 25)
    if save:
        with atomic_file(save, ".json") as part:
            part.write_text(json.dumps(figures, indent=2) + "\n")
    if as_json:
        print_json(figures)
        return
    _print(figures, earlier)


def run_batch_benchmarks(device: str, machine: str, tool: str | None, quick: bool, as_json: bool) -> None:
    """Measure batches of the reduced model and print the results.

    Args:
        device: "cpu" or "cuda".
        machine: name or folder of the machine.
        tool: its tool; None for its own.
        quick: measure for 1 s instead of 5 s per size.
        as_json: print JSON only.

    Raises:
        InputError: the device is unknown, or numba-cuda is missing.
    """
    if device not in ("cpu", "cuda"):
        raise InputError("--device", f"must be cpu or cuda, not {device!r}")
    counts = CUDA_COUNTS if device == "cuda" else CPU_COUNTS
    figures = measure_batch(load_machine(machine, tool), device, counts, 1.0 if quick else 5.0)
    if as_json:
        print_json({"device": device, "machine": machine, "tool": tool, "sizes": figures})
        return
    names = {
        "machines": "machines", "steps_per_s": "1 ms steps/s", "steps_per_core_s": "per s of processor time",
        "first_step_s": "first step [s]", "bytes_per_machine": "bytes per machine", "failed": "not finite",
    }  # fmt: skip
    shown = [name for name in names if name in figures[0]]
    table = make_table(f"{machine} on {device}", *(names[name] for name in shown))
    for row in figures:
        table.add_row(*(f"{row[name]:,}" for name in shown))
    stdout_console.print(table)


def measure_speed(repeats: int) -> dict:
    """Measure simulation speed and start-up time; each time is the shortest of several repetitions.

    Args:
        repeats: number of repetitions of the batches. The two times per step use six times as many,
            scenarios half as many, and start-up times always three or two.

    Returns:
        mechanism_us, hydraulics_us: computing time of one step without and with hydraulics [us];
        hydraulics_to_mechanism_ratio: hydraulics_us over mechanism_us. The realtime factors are
        simulated time over computing time, for teleoperation by scenario. batch_steps_per_s: steps
        of all simulations per second, by thread count; batch_scaling: speed of two threads over
        that of one. help_s, run_s: duration of `--help` and of a run of 1 s in a new process [s].
    """
    stop_profiling_clock()
    stderr_console.print("mechanism with and without hydraulics ...", style="dim")
    plant = build_plant(load_machine("cat215", "none"))
    bare, full = measure_shortest_times(6 * repeats, [_make_mechanism_job(plant), _make_hydraulic_job(plant)])
    stderr_console.print("whole scenario ...", style="dim")
    factor = max(_measure_scenario_realtime_factor() for _ in range(max(2, repeats // 2)))
    stderr_console.print("teleoperation ...", style="dim")
    turns = max(2, repeats // 2)
    teleoperated = {
        name: round(max(_measure_teleop_realtime_factor(name) for _ in range(turns)), 1)
        for name in TELEOPERATED_SCENARIOS
    }
    stderr_console.print("batches ...", style="dim")
    one, two = measure_shortest_times(max(3, repeats), [_make_batch_job(plant, n) for n in (1, 2)])
    stderr_console.print("start-up ...", style="dim")
    steps = SIMULATIONS * STEPS / 5
    return {
        "mechanism_us": round(bare / STEPS * 1e6, 3),
        "hydraulics_us": round(full / STEPS * 1e6, 3),
        "hydraulics_to_mechanism_ratio": round(full / bare, 4),
        "scenario_realtime_factor": round(factor, 1),
        "teleoperation_realtime_factor": teleoperated,
        "batch_steps_per_s": {"1": round(steps / one), "2": round(steps / two)},
        "batch_scaling": round(one / two, 3),
        "help_s": round(min(_measure_command_duration("--help") for _ in range(3)), 3),
        "run_s": round(min(_measure_command_duration(*_SHORT_RUN_ARGUMENTS) for _ in range(2)), 3),
    }


def measure_shortest_times(repeats: int, jobs: list[Callable[[], float]]) -> list[float]:
    """Run jobs alternately and return the shortest time of each [s].

    Args:
        repeats: number of runs of each job.
        jobs: functions that measure and return their own duration [s].
    """
    best = [float("inf")] * len(jobs)
    for _ in range(repeats):
        best = [min(b, job()) for b, job in zip(best, jobs, strict=True)]
    return best


def _make_hydraulic_job(plant: Plant) -> Callable[[], float]:
    start = rest_state(plant)
    start.ctrl[:] = VALVE_COMMANDS
    return _make_step_job(plant.model, start)


def _make_mechanism_job(plant: Plant) -> Callable[[], float]:
    """Return a function that makes 1000 steps of the mechanism and returns their duration [s].

    The mechanism has neither hydraulics nor gravity.
    """
    root = assemble_mjcf(plant.machine, plant.model.opt.timestep, plant.ground, visuals=False)
    for actuator in root.find_all("actuator"):
        actuator.remove()
    model = mjcf_document(root).compile()
    model.opt.gravity[:] = 0.0
    start = rest_state(plant)
    start.qvel[plant.dof[0]] = 0.1
    return _make_step_job(model, start)


def _make_step_job(model: mujoco.MjModel, start: mujoco.MjData) -> Callable[[], float]:
    data = mujoco.MjData(model)

    def time_steps() -> float:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = start.qpos, start.qvel
        if model.nu:
            data.ctrl[:], data.act[:] = start.ctrl, start.act
        begin = time.perf_counter()
        mujoco.mj_step(model, data, nstep=STEPS)
        return time.perf_counter() - begin

    return time_steps


def _make_batch_job(plant: Plant, threads: int) -> Callable[[], float]:
    start = rest_state(plant)
    batch = Batch(plant.model, SIMULATIONS, nthread=threads)
    commands = np.random.default_rng(0).uniform(-0.3, 0.3, (SIMULATIONS, plant.model.nu))

    def time_batch_steps() -> float:
        batch.qpos[:], batch.qvel[:], batch.act[:] = start.qpos, start.qvel, start.act
        batch.ctrl[:] = commands
        begin = time.perf_counter()
        batch.step(nstep=STEPS // 5)
        return time.perf_counter() - begin

    return time_batch_steps


def _measure_scenario_realtime_factor() -> float:
    """Run the shipped scenario `excitation` and return its real-time factor (simulated over computing time).

    The run includes control, sensors and logging.
    """
    scenario = load_scenario("excitation")
    begin = time.perf_counter()
    run_scenario(scenario)
    return scenario.duration / (time.perf_counter() - begin)


def _measure_teleop_realtime_factor(name: str) -> float:
    """Run a teleoperated scenario and return its real-time factor (simulated over computing time).

    The run includes the models of the operator and of the communication channel.
    """
    return run_scenario(load_scenario(name)).summary["realtime_factor"]


def _measure_command_duration(*arguments: str) -> float:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hydrotele", *arguments]
        if arguments[0] == "run":
            command += ["--out", f"{folder}/run"]
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - begin


def _read(path: Path) -> dict:
    try:
        figures = read_json(path)
        if not isinstance(figures, dict) or "hydraulics_to_mechanism_ratio" not in figures:
            raise ValueError("it has no key 'hydraulics_to_mechanism_ratio'")
    except ValueError as error:
        raise InputError(path, f"is not a saved benchmark: {error}") from None
    return figures


def _flatten_results(figures: dict) -> dict[str, float]:
    flat = {}
    for key, value in figures.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{k}": v for k, v in value.items()}
        else:
            flat[key] = value
    return flat


def _print(figures: dict, earlier: dict | None) -> None:
    columns = ["quantity", "now", *(["earlier", "now / earlier"] if earlier else [])]
    title = "hydrotele bench (times, ratio: lower is better; factors, rates: higher is better)"
    rows = make_table(title, *columns)
    before = _flatten_results(earlier) if earlier else {}
    for key, value in _flatten_results(figures).items():
        cells = [key, f"{value:,}"]
        if earlier:
            old = before.get(key)
            cells += [f"{old:,}", f"{value / old:.3f}"] if old else ["-", "-"]
        rows.add_row(*cells)
    stdout_console.print(rows)

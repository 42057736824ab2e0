"""Implement `hydrotele run`, `sweep` and `demo`.

`run` simulates one scenario, `sweep` many variations of a scenario, and `demo` three scenarios
followed by a replay.
"""

import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import typer

from hydrotele.cli.console import (
    make_table,
    print_json,
    print_status_regularly,
    show_simulation_progress,
    stderr_console,
    stdout_console,
    write_json,
)
from hydrotele.cli.export_command import export_machine
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import save_machine
from hydrotele.run.policy import allow_policy
from hydrotele.run.run import Run, load_nominal_machine, run_scenario
from hydrotele.run.sweep import Progress, SweepResult, SweepSettings, run_sweep
from hydrotele.run.sweep_file import SweepFile, load_sweep
from hydrotele.run.sweep_journal import JOURNAL, JournalEntry, count_finished_runs
from hydrotele.run.sweep_table import choose_plotted_numbers, compute_statistics
from hydrotele.scenario.pilots import PolicyPilot
from hydrotele.scenario.scenario import Scenario, Servo, load_scenario, save_scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.show.sweep_report import Study, write_sweep_report
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock


class PolicyChoice(NamedTuple):
    """The policy that replaces the pilot of a scenario.

    Attributes:
        policy: file, `module:function`, `FILE.py:function`, or name of a plug-in.
        task: task whose observation and actions the policy has, None for those of the file or the program.
    """

    policy: str
    task: str | None


def run_to_folder(
    name: str, target: Path | None, overrides: dict[str, str], review: bool, as_json: bool,
    choice: PolicyChoice | None = None,
) -> Path:  # fmt: skip
    """Simulate a scenario, write the results to a folder and print a summary.

    The output folder is written completely or not at all.

    Args:
        name: scenario name or file.
        target: output folder, default `runs/<scenario>`.
        overrides: scenario overrides, {key path: YAML text}.
        review: whether to write the rerun recording.
        as_json: print the summary as JSON instead of a table.
        choice: policy that replaces the pilot of the scenario, None for that pilot.

    Returns:
        The output folder.

    Raises:
        InputError: scenario, policy, machine or target are not usable.
        SimulationFailed: the state of the simulation is no longer finite.
    """
    stop_profiling_clock()
    scenario = load_scenario(name, overrides)
    if choice:
        scenario = with_policy(scenario, choice)
    target = target or Path("runs", scenario.name)
    check_output_folder(target, "run")
    with show_simulation_progress(f"run {scenario.name}", quiet=as_json) as progress:
        result = run_scenario(scenario, progress)
    return write_and_print_run(result, target, review, as_json)


def write_and_print_run(result: Run, target: Path, review: bool, as_json: bool, hint: str = "") -> Path:
    """Write a run completely or not at all, print its summary and then where it is and a hint; return its folder."""
    with atomic_folder(target, "run") as folder:
        write_run(result, folder, review)
    if as_json:
        print_json({**result.summary, "folder": str(target)})
    else:
        print_summary(result.summary)
        stdout_console.print(f"written to [bold]{target}[/]{hint}")
    return target


TRAINING_FILE = "training.json"  # of `hydrotele train`, in the folder of the policy
_TASK_ID = re.compile(r"(?:hydrotele/)?(.+?)(?:-v\d+)?")


def with_policy(scenario: Scenario, choice: PolicyChoice) -> Scenario:
    """Return a scenario whose pilot is a policy; the motion of the former pilot is the reference to follow.

    The policy is allowed to run code. If the pilot is a policy already, its other keys are kept. Without a task,
    observation and actions are those that `hydrotele train` stored next to the policy.

    Raises:
        InputError: the task does not exist, or does not fit the machine of the scenario.
    """
    old, path = scenario.pilot, choice.policy
    place, colon, name = path.rpartition(":")
    if (file := Path(place if colon else name)).is_file():
        path = f"{file.resolve()}{colon}{name if colon else ''}"
    allow_policy(path)
    if isinstance(old, PolicyPilot):
        pilot = old.model_copy(update={"policy": path})
    else:
        pilot = PolicyPilot(kind="policy", policy=path, reference=None if isinstance(old, TeleopPilot) else old)
    task, options = choice.task, {}
    stored = Path(path).with_name(TRAINING_FILE)
    if task is None and stored.is_file() and Path(path).is_file():
        try:
            plan = json.loads(stored.read_text(encoding="utf-8"))["plan"]
            task, options = str(plan["task"]), {k: plan["options"][k] for k in _KEPT_OPTIONS if k in plan["options"]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(stored, f"is damaged ({error}); give --task TASK") from None
    if task is None:
        return scenario.model_copy(update={"pilot": pilot})
    from hydrotele.envs.episode_batch import make_task_setup
    from hydrotele.envs.task import Options
    from hydrotele.envs.task_catalogue import find_task

    found = _TASK_ID.fullmatch(task)
    machine = load_nominal_machine(scenario)
    setup = make_task_setup(find_task(found[1] if found else task), Options(variants=1, machine=machine, **options))
    pilot = pilot.model_copy(update={
        "observation": tuple(field.name for field in setup.fields), "axes": setup.axes, "action": setup.options.action,
        "rate": setup.options.control_rate, "pose_rates": tuple(setup.task.pose_rates),
    })  # fmt: skip
    servo = setup.task.servo if scenario.servo == Servo() else scenario.servo
    return scenario.model_copy(update={"pilot": pilot, "servo": servo})


_KEPT_OPTIONS = ("action", "control_rate")


def write_run(result: Run, folder: Path, review: bool = True) -> None:
    """Write logs, summary, scenario, machine, MJCF and recording of a run into a folder.

    `machine.yaml` describes the machine without the effects that the scenario adds, because a
    replay must not know them. `machine.xml` describes the simulated machine with the effects.
    """
    save_log(result.measured, folder / "measured.parquet")
    save_log(result.truth, folder / "truth.parquet")
    save_scenario(result.scenario, folder / "scenario.yaml")
    result.plant.document.save(folder / "machine.xml")
    save_machine(load_nominal_machine(result.scenario), folder / "machine.yaml")
    if review:
        from hydrotele.show.recording import write_recording

        stderr_console.print("writing review.rrd ...", style="dim")
        write_recording(folder / "review.rrd", {"truth": (result.plant.machine, result.truth)})
    write_json(folder / "summary.json", result.summary)


def print_summary(summary: dict[str, Any]) -> None:
    """Print the summary of a run as a table, followed by its notes."""
    rows = make_table(f"{summary['scenario']} ({summary['machine']}, tool {summary['tool']})", "", "")
    rows.show_header = False
    rows.add_row("simulated", f"{summary['simulated_seconds']:g} s")
    rows.add_row("real-time factor", f"{summary['realtime_factor']:.0f}")
    if summary["effects"]:
        rows.add_row("added effects", ", ".join(e["name"] for e in summary["effects"]))
    rows.add_row("largest pin opening", f"{summary['max_pin_opening_mm']:.4f} mm")
    rows.add_row("largest contact force", f"{summary['max_contact_force_N'] / 1e3:.1f} kN")
    if soil := summary.get("soil"):
        rows.add_row("soil in the bucket", f"{soil['carried_mass_kg']:.0f} kg")
        rows.add_row("depth of the trench", f"{soil['trench_depth_m']:.2f} m")
    for key, label in (("flow_balance", "flow balance"), ("energy_balance", "energy balance")):
        value = summary["balance"][key]
        rows.add_row(label, "-" if value is None else f"{value:.1e}")
    if station := summary.get("teleoperation"):
        gone, least = station["handle_energy_J"], station["min_handle_energy_J"]
        rows.add_row("energy into the handle", f"{gone:.2f} J, minimum {least:.2f} J")
    for name, error in summary["tracking"].items():
        unit, factor = ("mm", 1e3) if error["unit"] == "m" else ("deg", 57.29577951308232)
        rms, largest = error["rms"] * factor, error["max"] * factor
        rows.add_row(f"tracking error {name}", f"RMS {rms:.2f}, max {largest:.2f} {unit}")
    stdout_console.print(rows)
    for note in summary["notes"]:
        stdout_console.print(f"[yellow]note[/] {note}")


def run_demo(target: Path) -> None:
    """Simulate three scenarios, replay the log of one of them and draw the machine.

    Args:
        target: output folder.

    Raises:
        InputError: the folder cannot be written.
    """
    from hydrotele.cli.replay_command import replay_logs  # it imports scipy.signal, which runs do not need

    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(target, f"cannot be created: {error.strerror}") from None
    _print_demo_step(1, "the bucket moves straight up at 0.5 m/s (Zhu 1994, Fig. 6.45)")
    run_to_folder("zhu_up", target / "zhu_up", {}, True, False)
    _print_demo_step(2, "the bucket digs")
    run_to_folder("dig", target / "dig", {}, True, False)
    _print_demo_step(3, "all axes move together, measured with the sensors of Khoshzaban 1992")
    run_to_folder("excitation", target / "excitation", {}, True, False)
    _print_demo_step(4, "the model is simulated with the commands of that log: prediction errors")
    log = target / "excitation" / "measured.parquet"
    replay_logs([log], None, None, 1.0e-3, target / "replay", False)
    _print_demo_step(5, "a picture of the machine")
    try:
        export_machine("cat215", "bucket", None, target / "cat215.png", "overview")
    except InputError as error:
        stderr_console.print(f"[yellow]no picture[/] {error}")
    stdout_console.print(f"\n[bold green]done[/] All results are in [bold]{target}[/]. Show them by")
    stdout_console.print("  source .venv/bin/activate             (in a checkout, once per shell)")
    stdout_console.print(f"  hydrotele review {target}/dig             (rerun viewer)")
    stdout_console.print(f"  hydrotele review {target}/dig --serve     (web viewer)")
    stdout_console.print(f"The plot {target}/replay/measured.png compares log and replay.")


def _print_demo_step(step: int, text: str) -> None:
    stdout_console.print(f"\n[bold]{step}/5[/] {text}")


_FAILURE_STATUS = 3
_MAX_LISTED_FAILURES = 10


class SweepOptions(NamedTuple):
    """Options of `hydrotele sweep` except the sweep file and the output folder.

    Attributes:
        jobs: number of processes, None for one per core.
        dask: address or scheduler file of a dask cluster, None to run on this computer.
        fresh: discard earlier results in the output folder instead of continuing with the missing
            runs.
        retry_failed: repeat runs that failed earlier.
        strict: exit with status 3 if any run failed, not only if all failed.
        json: print JSON instead of text.
    """

    jobs: int | None
    dask: str | None
    fresh: bool
    retry_failed: bool
    strict: bool
    json: bool


def sweep_to_folder(name: str, target: Path | None, options: SweepOptions) -> None:
    """Run a sweep (many variations of a scenario), write its report and print the results.

    Args:
        name: sweep file, or name of a shipped sweep.
        target: output folder, default `runs/<name>`.
        options: options of the command.

    Raises:
        InputError: the file, one of its points, the folder or the cluster is not usable.
        typer.Exit: status 130 after an interruption; 3 if all runs failed, or any with `strict`.
    """
    file = load_sweep(name)
    target = target or Path("runs", file.name)
    how = SweepSettings(options.jobs, options.dask, options.fresh, options.retry_failed, write_run)
    try:
        with _show_sweep_progress(file.name, options.json) as progress:
            swept = run_sweep(file, target, how, progress)
    except (KeyboardInterrupt, SystemExit) as stop:
        done = count_finished_runs(target / JOURNAL)
        said = f"{done} of {file.sweep.runs} runs are finished and saved in {target}"
        message = f"stopped: {said}; repeat the command to continue"
        typer.echo(message, err=True)
        code = stop.code if isinstance(stop, SystemExit) else 130
        raise typer.Exit(code if isinstance(code, int) else 1) from None
    figures = list(file.sweep.figures) or choose_plotted_numbers(swept.table)
    study = _sweep_study(file, swept, figures)
    if not options.json:
        stderr_console.print("writing report.html ...", style="dim")
    write_sweep_report(study, target)
    _print_sweep(file, target, swept, figures, options.json)
    failed = len(swept.failed)
    if failed and (options.strict or failed == file.sweep.runs):
        raise typer.Exit(_FAILURE_STATUS)


def _sweep_study(file: SweepFile, swept: SweepResult, figures: list[str]) -> Study:
    """Return the data of the sweep report: result table, varied keys, results to show, failed runs.

    Args:
        file: the sweep.
        swept: result of the sweep.
        figures: names of the results to show.
    """
    sampled = tuple(file.sweep.sample.keys) if file.sweep.sample else ()
    logarithmic = [k for k in sampled if file.sweep.sample.keys[k].log_uniform]  # pyright: ignore - it has one
    return Study(
        file.name, file.sweep.description, file.sweep.scenario, swept.table.columns,
        swept.table.units, tuple(file.sweep.grid), sampled, tuple(logarithmic), tuple(figures),
        [(entry.run, entry.reason) for entry in swept.failed],
    )  # fmt: skip


def _print_sweep(file: SweepFile, target: Path, swept: SweepResult, figures: list[str], as_json: bool) -> None:
    found = compute_statistics(swept.table, figures)
    if as_json:
        print_json({
            "kind": "sweep", "name": file.name, "folder": str(target), "runs": file.sweep.runs,
            "runs_done": swept.n_executed, "failed": len(swept.failed),
            "failures": [{"run": e.run, "reason": e.reason, **_varied_values_of_run(swept, e)}
                         for e in swept.failed],
            "figures": found,
        })  # fmt: skip
        return
    title = f"{file.name}: {file.sweep.runs} runs"
    shown = make_table(title, "quantity", "unit", "minimum (run)", "median", "maximum (run)")
    shown.columns[0].overflow = "fold"
    for name, f in found.items():
        ends = (f"{f[end]:.4g} ({f[f'{end}_run']})" for end in ("min", "max"))
        shown.add_row(name, f["unit"], next(ends), f"{f['median']:.4g}", next(ends))
    if found:
        stdout_console.print(shown)
    elif len(swept.failed) < file.sweep.runs:
        stdout_console.print("all results of the runs are equal")
    if swept.failed:
        stdout_console.print(f"[red]{len(swept.failed)} of {file.sweep.runs} runs failed[/]")
    for entry in swept.failed[:_MAX_LISTED_FAILURES]:
        varied = ", ".join(
            f"{key} {_format_value(value)}" for key, value in _varied_values_of_run(swept, entry).items()
        )
        said = f"  run {entry.run} ({varied}): {entry.reason}"
        stdout_console.print(said, markup=False, soft_wrap=True)
    if len(swept.failed) > _MAX_LISTED_FAILURES:
        stdout_console.print(f"  and {len(swept.failed) - _MAX_LISTED_FAILURES} more, in column 'reason' of the table")
    if not swept.n_executed:
        stdout_console.print("all runs were finished already; --fresh repeats them")
    stdout_console.print(f"written to [bold]{target}[/]; open {target}/report.html", soft_wrap=True)


def _varied_values_of_run(swept: SweepResult, entry: JournalEntry) -> dict[str, Any]:
    columns = swept.table.columns
    return {key: columns[key][entry.run - 1] for key in (*swept.table.varied_keys, "seed")}


def _format_value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@contextlib.contextmanager
def _show_sweep_progress(name: str, quiet: bool) -> Iterator[Progress | None]:
    """Show a progress bar with the remaining time on stderr, or lines if stderr is not a terminal.

    Yields:
        A function of stage, finished, total and failed runs that updates the display; None if `quiet`.
    """
    if quiet:
        yield None
        return
    if not stderr_console.is_terminal:
        with print_status_regularly(f"sweep {name}") as tell:
            yield lambda stage, done, total, failed: tell(f"{stage}, {done} of {total} runs, {failed} failed")
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, TextColumn("{task.fields[failed]}"), console=stderr_console,
                  transient=True, speed_estimate_period=600.0) as bar:  # fmt: skip
        task = bar.add_task(f"check {name}", total=None, failed="")
        last = ["check"]

        def update(stage: str, done: int, total: int, failed: int) -> None:
            if stage != last[0]:  # earlier stages do not predict the remaining time
                last[0] = stage
                bar.reset(task, total=total, completed=done)
            said = f"[red]{failed} failed[/]" if failed else ""
            bar.update(task, description=f"{stage} {name}", completed=done, total=total,
                       failed=said)  # fmt: skip

        yield update

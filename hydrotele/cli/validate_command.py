"""Implement `hydrotele validate`: check files of machines, joysticks, scenarios and sweeps, and logs."""

from pathlib import Path
from typing import NamedTuple

import typer

from hydrotele.cli.console import print_json, print_notes, stdout_console
from hydrotele.core.datafile import read_yaml, suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.logs.log import LOG_SUFFIXES, MEASURED_STEM, find_logs
from hydrotele.machine.estimate_marks import EstimateGroup, find_estimates
from hydrotele.machine.joystick import JOYSTICK_FILE, load_joystick, shipped_joysticks
from hydrotele.machine.machine_file import MACHINE_FILE, find_machine_file, load_machine, shipped_machines


class LogMachine(NamedTuple):
    """Machine against which logs are checked.

    Attributes:
        name: name or folder of the machine, None to find it by the logs.
        tool: tool of the machine, None for that of the logs.
        force: accept logs whose metadata names another machine or tool.
    """

    name: str | None = None
    tool: str | None = None
    force: bool = False


def validate_files(paths: list[Path], as_json: bool, log_machine: LogMachine | None = None) -> None:
    """Check machines with all their tools, joysticks, scenarios, sweeps and logs.

    Args:
        paths: files, folders or shipped names to check.
        as_json: print JSON instead of text.
        log_machine: machine of the logs, None to find it by the logs.

    Raises:
        InputError: a file is not valid; it is raised after all files were checked.
    """
    checked: list[dict] = []
    wrong: list[InputError] = []
    for path in paths:
        try:
            notes: list[str] = []
            kind, said = _validate_file(path, log_machine or LogMachine(), notes)
            entry = {"file": str(path), "kind": kind, "valid": True, "contents": said}
            estimates = find_estimates(find_machine_file(path)) if kind == "machine" else []
            entry |= {"estimates": [key for group in estimates for _, key in group.keys]} if estimates else {}
            checked.append(entry | ({"notes": notes} if kind == "log" else {}))
            if not as_json:
                stdout_console.print(f"[green]valid[/] {kind} {path}: {said}", soft_wrap=True)
                print_notes(notes)
                _print_estimates(estimates)
        except InputError as error:
            checked.append({"file": str(path), "valid": False, "error": str(error)})
            wrong.append(error)
    if as_json:
        print_json(checked)
    for error in wrong[:-1]:
        typer.echo(f"error {error}", err=True)
    if wrong:
        raise wrong[-1]


def _print_estimates(groups: list[EstimateGroup]) -> None:
    """Print the marked values of a machine file in the order in which they should be replaced."""
    if not groups:
        return
    count = sum(len(group.keys) for group in groups)
    stdout_console.print(f"{count} lines are estimates; replace the values and remove the marks, in this order:")
    for number, (title, keys) in enumerate(groups, start=1):
        sections: dict[str, list[tuple[int, str]]] = {}
        for line, key in keys:
            section, _, last = key.rpartition(".")
            sections.setdefault(section, []).append((line, last))
        listed = "; ".join(
            f"{section}: {', '.join(last for _, last in found)} (line {found[0][0]})"
            for section, found in sections.items()
        )
        stdout_console.print(f"  {number}. {title}: {listed}", soft_wrap=True)


def _validate_file(path: Path, log_machine: LogMachine, notes: list[str]) -> tuple[str, str]:
    """Check a file, folder or shipped name; return its kind and a summary of its content as text.

    Args:
        path: file, folder or shipped name of a machine, joystick, scenario, sweep or log.
        log_machine: machine against which logs are checked.
        notes: notes on repairs of a log are appended.

    Raises:
        InputError: the file is not valid or does not exist.
    """
    if path.suffix.lower() in LOG_SUFFIXES or _is_log_folder(path):
        return "log", _check_logs(path, log_machine, notes)
    from hydrotele.scenario.scenario import load_scenario, shipped_scenarios

    name = str(path)
    if is_joystick(path):
        return "joystick", _check_joystick(path)
    if path.is_dir() or name in shipped_machines():
        return "machine", _check_machine(path)
    if name in shipped_scenarios() or (path.is_file() and "pilot" in read_yaml(path)[0]):
        return "scenario", _check_scenario(load_scenario(path))
    if name in _sweep_names() or (path.is_file() and "scenario" in read_yaml(path)[0]):
        return "sweep", _check_sweep(path)
    if path.is_file():
        return "machine", _check_machine(path)
    names = [*shipped_machines(), *shipped_joysticks(), *shipped_scenarios(), *_sweep_names()]
    message = (
        "does not exist"
        if path.parent != Path() or path.suffix
        else "is not a file, machine, joystick, scenario or sweep"
    )
    raise InputError(path, f"{message}; {suggest_valid_name(name, names)}")


def _is_log_folder(path: Path) -> bool:
    """Return whether a path is a run folder, or a folder with logs that is not a machine or joystick."""
    if not path.is_dir():
        return False
    if (path / "summary.json").is_file() or (path / f"{MEASURED_STEM}.parquet").is_file():
        return True
    if (path / MACHINE_FILE).is_file() or (path / JOYSTICK_FILE).is_file():
        return False
    try:
        return bool(find_logs(path))
    except InputError:
        return False


def _check_logs(path: Path, log_machine: LogMachine, notes: list[str]) -> str:
    """Check the logs at a path, against their machine if it is known; return a summary of their content.

    Args:
        path: log file, folder of logs or run folder.
        log_machine: machine against which the logs are checked, or how to find it.
        notes: notes on repairs of the logs are appended.

    Raises:
        InputError: a log is not usable.
    """
    from hydrotele.cli.input_logs import find_machine_and_tool_names, open_logs
    from hydrotele.logs.dataset import make_dataset, merge_runs_without_machine

    if find_machine_and_tool_names([path], log_machine.name)[0] is None:
        logs, said = merge_runs_without_machine(path)
        notes += said
        checked = "; not checked against a machine: give --machine"
    else:
        opened = open_logs([path], *log_machine)
        logs, checked = opened.logs, f"; checked against {opened.machine.name}"
        notes += opened.notes
        try:
            notes += (n for n in make_dataset(opened.runs, opened.machine).notes if n not in notes)
        except InputError as error:
            notes.append(f"gap, identify and compare need more than this path alone: {error}")
    first = f"{len(logs[0])} rows at {logs[0].rate:g} Hz, {len(logs[0].columns)} columns"
    return first + checked if len(logs) == 1 else f"{len(logs)} logs; {logs[0].name}: {first}{checked}"


def _sweep_names() -> list[str]:
    from hydrotele.run.sweep_file import shipped_sweeps

    return shipped_sweeps()


def _check_sweep(path: Path) -> str:
    from hydrotele.run.sweep_file import load_sweep
    from hydrotele.run.sweep_scenarios import check_points, read_base_scenario

    file = load_sweep(path)
    check_points(read_base_scenario(file))
    varied = ", ".join(file.sweep.varied_keys) or "seed"
    return f"{file.sweep.runs} runs of {file.sweep.scenario}, varied: {varied}"


def is_joystick(path: Path) -> bool:
    """Return whether a path is the name of a shipped joystick, or a folder or YAML file of a joystick.

    A YAML file describes a joystick if it has the key `flotor`.
    """
    if str(path) in shipped_joysticks() or (path / JOYSTICK_FILE).is_file():
        return True
    return path.suffix in (".yaml", ".yml") and path.is_file() and "flotor" in read_yaml(path)[0]


def _check_joystick(path: Path) -> str:
    import numpy as np

    from hydrotele.teleop.levitation import simulate_levitation

    joystick = load_joystick(path)
    flight = simulate_levitation(joystick, np.zeros((round(joystick.control_rate), 6)))
    far = np.abs(flight.pose[:, :3]).max()
    if far > 0.1 * joystick.workspace.translation:
        message = f"the flotor does not levitate stably: it moves by {1e3 * far:.1f} mm in 1 s"
        raise InputError(path, message)
    current, most = np.abs(flight.currents[-1]).max(), joystick.coils.max_current
    return f"levitates with {current:.2f} of {most:g} A; gains {', '.join(joystick.gains)}"


def _check_machine(path: Path) -> str:

    from hydrotele.kinematics.drive_linkage import axis_linkage, check_strokes
    from hydrotele.simulate.plant import build_plant, rest_state

    first = load_machine(path)
    for tool in first.tools:
        machine = load_machine(path, tool)
        plant = build_plant(machine)
        rest_state(plant)
        plant.document.compile()
        for axis in machine.axes:
            axis_linkage(machine, axis)
        check_strokes(machine)
    tools = "" if first.tools == ("none",) else f", tools {', '.join(first.tools)}"
    return f"axes {', '.join(first.axes)}{tools}; assembly and static equilibrium checked"


def _check_scenario(scenario) -> str:
    from hydrotele.run.run import prepare_run

    plan = prepare_run(scenario).plan
    notes_ = f"; {'; '.join(plan.notes)}" if plan.notes else ""
    return f"{scenario.duration:g} s of {scenario.machine}, {scenario.pilot.kind} pilot{notes_}"

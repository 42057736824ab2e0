"""Implement `hydrotele list`, `validate` and `export`.

`list` shows the available machines, scenarios and effects, `validate` checks files, and `export`
writes the MJCF or an image of a machine.
"""

from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import typer

from hydrotele.cli.console import print_json, print_notes, stderr_console, stdout_console
from hydrotele.core.datafile import read_yaml, suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.logs.log import LOG_SUFFIXES, MEASURED_STEM, find_logs
from hydrotele.machine.joystick import JOYSTICK_FILE, load_joystick, shipped_joysticks
from hydrotele.machine.machine_file import MACHINE_FILE, find_machine_file, load_machine, shipped_machines
from hydrotele.simulate.mechanism import Mjcf

_DESCRIPTIONS = ("description", "what")  # keys of the text that describes an item
_KINDS = ("machines", "joysticks", "scenarios", "sweeps", "effects", "environments")


def list_items(item_kind: str | None, as_json: bool) -> None:
    """Print the available machines, joysticks, scenarios, sweeps, effects or environments.

    Args:
        item_kind: kind of the items, such as `machines`; `all` for all kinds; None for a summary
            with the names of all kinds.
        as_json: print JSON instead of text; all kinds with all their data if `item_kind` is None.

    Raises:
        InputError: `item_kind` is not a valid kind.
    """
    if item_kind not in (None, *_KINDS, "all"):
        raise InputError(f"list {item_kind}", suggest_valid_name(item_kind, [*_KINDS, "all"]))
    wanted = (item_kind,) if item_kind in _KINDS else _KINDS
    tables = {
        "machines": _machine_rows, "joysticks": _joystick_rows, "scenarios": _scenario_rows,
        "sweeps": _sweep_rows, "effects": _effect_rows, "environments": _environment_rows,
    }  # fmt: skip
    if item_kind is None and not as_json:
        print(format_name_lists({kind: _item_names(kind) for kind in _KINDS}, stdout_console.width))
        return
    data = {kind: tables[kind]() for kind in wanted}
    if as_json:
        print_json(data[item_kind] if item_kind in _KINDS else data)
        return
    print("\n\n".join(format_items(kind, rows, stdout_console.width) for kind, rows in data.items()))


_MAX_SUMMARY_LINES = 30  # a summary fits a terminal window
_MIN_TEXT_WIDTH = 30  # characters next to the names; a narrower text starts below its name


def format_name_lists(names: dict[str, list[str]], width: int) -> str:
    """Format the names of all items of all kinds in at most 30 lines, without cutting a name.

    Args:
        names: kind of the items -> their names. If they need too many lines, the last names of the
            kind with most lines are replaced by their number.
        width: line length [characters].
    """
    shown = {kind: len(some) for kind, some in names.items()}

    def wrap_names(kind: str) -> list[str]:
        some, count = names[kind], shown[kind]
        left = [f"and {len(some) - count} more (hydrotele list {kind})"] if count < len(some) else []
        text = f"{kind} ({len(some)}): " + ", ".join([*some[:count], *left])
        return _wrap_text(text, width, "  ")

    hint = _wrap_text(
        "hydrotele list KIND describes the items of a kind, hydrotele list all those of all kinds.", width
    )
    lines = {kind: wrap_names(kind) for kind in names}
    while sum(map(len, lines.values())) + len(hint) > _MAX_SUMMARY_LINES:
        longest = max(lines, key=lambda kind: (len(lines[kind]), shown[kind]))
        if shown[longest] == 0:
            break
        shown[longest] -= 1
        lines[longest] = wrap_names(longest)
    return "\n".join([*(line for some in lines.values() for line in some), *hint])


def format_items(kind: str, rows: list[dict], width: int) -> str:
    """Format a list of items with their descriptions and properties; names are never cut or broken.

    Args:
        kind: kind of the items, the title.
        rows: data of each item, with the key `name`.
        width: line length [characters].
    """
    indent = min(max((len(row["name"]) for row in rows), default=0) + 4, max(4, width - _MIN_TEXT_WIDTH))
    blank = " " * indent
    lines = [f"{kind}:"]
    for row in rows:
        head = f"  {row['name']}"
        keys = sorted(row.keys() - {"name"}, key=lambda key: (key not in _DESCRIPTIONS, list(row).index(key)))
        texts = [_format_item_property(key, row[key]) for key in keys if row[key] not in ("", [], {})]
        texts = [line for text in texts for line in _wrap_text(text, width - indent, "  ")]
        if texts and len(head) + 2 <= indent:
            head = head.ljust(indent) + texts.pop(0)
        lines += [head, *(blank + line for line in texts)]
    return "\n".join(lines)


def _wrap_text(text: str, width: int, further_indent: str = "") -> list[str]:
    """Wrap a text at its spaces; a word that is longer than the line stays whole."""
    return wrap(text, max(width, 1), subsequent_indent=further_indent, break_long_words=False, break_on_hyphens=False)


def _format_item_property(name: str, value) -> str:
    """Format a property of an item as `name: value`, or a description as it is.

    Parameters of an effect are given as a dict, name -> unit and bounds, and become one text.
    """
    if isinstance(value, dict):
        value = ", ".join(f"{n} [{p['unit']}] {p['low']:.4g} .. {p['high']:.4g}" for n, p in value.items())
    text = ", ".join(value) if isinstance(value, list) else str(value)
    return text if name in _DESCRIPTIONS else f"{name}: {text}"


def _item_names(kind: str) -> list[str]:
    """Return the names of the items of a kind, without reading their files."""
    from hydrotele.effects import EFFECTS
    from hydrotele.envs.making import TASKS
    from hydrotele.run.sweep_facts import shipped_sweeps
    from hydrotele.scenario.scenario import shipped_scenarios

    names = {
        "machines": shipped_machines, "joysticks": shipped_joysticks, "scenarios": shipped_scenarios,
        "sweeps": shipped_sweeps, "effects": lambda: list(EFFECTS),
        "environments": lambda: [f"hydrotele/{task.name}-v0" for task in TASKS.values()],
    }  # fmt: skip
    return list(names[kind]())


def _machine_rows() -> list[dict]:
    rows = []
    for name in shipped_machines():
        data, _ = read_yaml(find_machine_file(name))
        tools = list(data.get("tools") or ["none"])
        axes = list(data.get("axes") or {})
        rows.append({"name": name, "axes": axes, "tools": tools, "description": data.get("description", "")})
    return rows


def _joystick_rows() -> list[dict]:
    found = map(load_joystick, shipped_joysticks())
    return [{"name": j.name, "gains": list(j.gains), "description": j.description} for j in found]


def _scenario_rows() -> list[dict]:
    from hydrotele.scenario.scenario import find_scenario, shipped_scenarios

    rows = []
    for name in shipped_scenarios():
        data, _ = read_yaml(find_scenario(name))
        keys = ("machine", "tool", "duration", "description")
        rows.append({"name": name, **{k: data.get(k, "") for k in keys}})
    return rows


def _sweep_rows() -> list[dict]:
    from hydrotele.run.sweep_facts import load_sweep, shipped_sweeps

    rows = []
    for name in shipped_sweeps():
        sweep = load_sweep(name).sweep
        facts = {"runs": sweep.runs, "scenario": sweep.scenario, "keys": list(sweep.varied_keys)}
        rows.append({"name": name, **facts, "description": sweep.description})
    return rows


def _effect_rows() -> list[dict]:
    """Return a row for each effect, with the components of a machine that it can change.

    The components are those of one machine: of the CAT 215 with bucket if it supports the effect,
    otherwise of the first shipped machine that does. The parameter ranges are those of the last
    component.
    """
    from hydrotele.effects import EFFECTS

    names = [n for n in shipped_machines() if n != "cat215"]
    machines = [load_machine("cat215", "bucket"), *map(load_machine, names)]
    rows = []
    for effect in EFFECTS.values():
        machine = next((m for m in machines if effect.locations(m)), machines[0])
        places = effect.locations(machine)
        numbers = effect.parameters(machine, places[-1]) if places else {}
        rows.append(
            {
                "name": effect.name,
                "description": effect.description,
                "machine": machine.name if places else "",
                "locations": list(places),
                "parameters": {
                    n: {
                        "unit": p.unit,
                        "low": p.lower_bound,
                        "high": p.upper_bound,
                        "optional": p.optional,
                    }
                    for n, p in numbers.items()
                },
            }
        )
    return rows


def _environment_rows() -> list[dict]:
    """Return a row for each gymnasium environment."""
    from hydrotele.envs.making import TASKS

    return [
        {
            "name": f"hydrotele/{task.name}-v0",
            "machine": f"{task.machine}, {task.tool or 'its first tool'}",
            "description": task.description,
            "reward": task.reward,
        }
        for task in TASKS.values()
    ]


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
            checked.append(entry | ({"notes": notes} if kind == "log" else {}))
            if not as_json:
                stdout_console.print(f"[green]valid[/] {kind} {path}: {said}", soft_wrap=True)
                print_notes(notes)
        except InputError as error:
            checked.append({"file": str(path), "valid": False, "error": str(error)})
            wrong.append(error)
    if as_json:
        print_json(checked)
    for error in wrong[:-1]:
        typer.echo(f"error {error}", err=True)
    if wrong:
        raise wrong[-1]


def _validate_file(path: Path, log_machine: LogMachine, notes: list[str]) -> tuple[str, str]:
    """Check a file, folder or shipped name; return its kind and a summary of its content.

    Notes on repairs of a log are appended to `notes`.

    Raises:
        InputError: the file is not valid or does not exist.
    """
    if path.suffix.lower() in LOG_SUFFIXES or _is_log_folder(path):
        return "log", _check_logs(path, log_machine, notes)
    from hydrotele.scenario.scenario import load_scenario, shipped_scenarios

    name = str(path)
    if _is_joystick(path):
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
    """Check the logs of a path, against their machine if it is known; return a summary of their content.

    Notes on repairs are appended to `notes`.
    """
    from hydrotele.cli.opening import find_machine_and_tool_names, open_logs
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
    from hydrotele.run.sweep_facts import shipped_sweeps

    return shipped_sweeps()


def _check_sweep(path: Path) -> str:
    from hydrotele.run.sweep_facts import check_points, load_sweep, read_base_scenario

    file = load_sweep(path)
    check_points(read_base_scenario(file))
    varied = ", ".join(file.sweep.varied_keys) or "seed"
    return f"{file.sweep.runs} runs of {file.sweep.scenario}, varied: {varied}"


def _is_joystick(path: Path) -> bool:
    """Return whether a name, folder or file describes a joystick."""
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

    from hydrotele.kinematics.from_machine import axis_linkage, check_strokes
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


def export_machine(name: str, tool: str | None, target: Path | None, picture: Path | None, camera: str) -> None:
    """Write the complete MJCF of a machine or joystick, or an image of it.

    Args:
        name: shipped name, file or folder of a machine or joystick.
        tool: tool of the machine, None for its first tool.
        target: MJCF file, None for standard output, or for no MJCF if there is a picture.
        picture: PNG file to write, or None.
        camera: camera of the image.

    Raises:
        InputError: the machine is not usable, or this computer cannot render images.
    """
    if _is_joystick(Path(name)):
        if tool:
            raise InputError("--tool", f"the joystick {name} has no tools")
        _export_joystick(name, target, picture, camera)
        return
    machine = load_machine(name, tool)
    if picture:
        from hydrotele.show.picture import render_machine

        render_machine(machine, picture, camera=camera)
        stderr_console.print(f"written to {picture}")
        if target is None:
            return
    from hydrotele.simulate.plant import build_plant

    _write(build_plant(machine).document, target)


def _export_joystick(name: str, target: Path | None, picture: Path | None, camera: str) -> None:
    import mujoco

    from hydrotele.simulate.joystick import compile_joystick, joystick_spec

    facts = load_joystick(name)
    spec = joystick_spec(facts, hand=False)
    model = compile_joystick(facts, spec)
    if picture:
        from hydrotele.show.picture import render_model

        render_model(model, mujoco.MjData(model), picture, camera)
        stderr_console.print(f"written to {picture}")
    if target or not picture:
        _write(Mjcf(name, spec.to_xml(), {}), target)


def _write(document: Mjcf, target: Path | None) -> None:
    from hydrotele.core.output import atomic_file

    if target:
        with atomic_file(target, ".xml") as part:
            document.save(part, target)
        stderr_console.print(f"written to {target}")
    elif document.assets:
        message = f"refers to {len(document.assets)} further files: give --out FILE.xml"
        raise InputError("the MJCF", message)
    else:
        print(document.text)

"""Implement `hydrotele list`: machines, joysticks, scenarios, sweeps, effects, environments and plug-ins."""

from textwrap import wrap

from hydrotele.cli.console import print_json, stdout_console
from hydrotele.core.datafile import read_yaml, suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.plugins import PLUGIN_GROUPS, find_plugins
from hydrotele.machine.joystick import load_joystick, shipped_joysticks
from hydrotele.machine.machine_file import find_machine_file, load_machine, shipped_machines

_DESCRIPTIONS = ("description", "what")  # keys of the text that describes an item
_KINDS = ("machines", "joysticks", "scenarios", "sweeps", "effects", "environments")
_PLUGINS = "plugins"  # a kind that is listed on request only: its items are among those of the other kinds


def list_items(item_kind: str | None, as_json: bool) -> None:
    """Print the available machines, joysticks, scenarios, sweeps, effects, environments or plug-ins.

    Args:
        item_kind: kind of the items, such as `machines`; `all` for all kinds; None for a summary
            with the names of all kinds.
        as_json: print JSON instead of text; all kinds with all their data if `item_kind` is None.

    Raises:
        InputError: `item_kind` is not a valid kind.
    """
    if item_kind not in (None, *_KINDS, _PLUGINS, "all"):
        raise InputError(f"list {item_kind}", suggest_valid_name(item_kind, [*_KINDS, _PLUGINS, "all"]))
    wanted = (item_kind,) if item_kind in (*_KINDS, _PLUGINS) else _KINDS
    tables = {
        "machines": _machine_rows, "joysticks": _joystick_rows, "scenarios": _scenario_rows,
        "sweeps": _sweep_rows, "effects": _effect_rows, "environments": _environment_rows, "plugins": _plugin_rows,
    }  # fmt: skip
    if item_kind is None and not as_json:
        print(format_name_lists({kind: _item_names(kind) for kind in _KINDS}, stdout_console.width))
        return
    data = {kind: tables[kind]() for kind in wanted}
    if as_json:
        print_json(data[item_kind] if item_kind in data else data)
        return
    print("\n\n".join(format_items(kind, rows, stdout_console.width) for kind, rows in data.items()))


_MAX_SUMMARY_LINES = 31  # a summary fits a terminal window
_MIN_TEXT_WIDTH = 30  # characters next to the names; a narrower text starts below its name


def format_name_lists(names: dict[str, list[str]], width: int) -> str:
    """Format the names of all items of all kinds in at most 31 lines, without cutting a name.

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
    lines = [f"{kind}:" if rows else f"{kind}: none"]
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
    """Return the lines of a text wrapped at its spaces; a word longer than a line stays whole.

    Args:
        text: the text.
        width: line length [characters].
        further_indent: text before all lines but the first.
    """
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
    from hydrotele.envs.task_catalogue import TASKS
    from hydrotele.run.sweep_file import shipped_sweeps
    from hydrotele.scenario.scenario import shipped_scenarios

    names = {
        "machines": shipped_machines, "joysticks": shipped_joysticks, "scenarios": shipped_scenarios,
        "sweeps": shipped_sweeps, "effects": lambda: list(EFFECTS),
        "environments": lambda: [f"hydrotele/{name}-v0" for name in [*TASKS, *find_plugins("hydrotele.tasks")]],
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
    from hydrotele.run.sweep_file import load_sweep, shipped_sweeps

    rows = []
    for name in shipped_sweeps():
        sweep = load_sweep(name).sweep
        facts = {"runs": sweep.runs, "scenario": sweep.scenario, "keys": list(sweep.varied_keys)}
        rows.append({"name": name, **facts, "description": sweep.description})
    return rows


def _effect_rows() -> list[dict]:
    """Return a row for each effect of the gap search, with the components of a machine that it can change.

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
    """Return a row for each gymnasium environment: name, machine with tool, description and reward."""
    from hydrotele.envs.task_catalogue import TASKS, find_task

    rows = []
    for name in [*TASKS, *find_plugins("hydrotele.tasks")]:
        try:
            task = find_task(name)
        except InputError as error:
            rows.append({"name": f"hydrotele/{name}-v0", "description": str(error)})
            continue
        tool = f"{task.machine}, {task.tool or 'its first tool'}"
        rows.append({"name": f"hydrotele/{name}-v0", "machine": tool, "description": task.description})
        rows[-1]["reward"] = task.reward
    return rows


def _plugin_rows() -> list[dict]:
    """Return a row for each plug-in of an installed package: name, group, package and object."""
    plugins = [(group, plugin) for group in PLUGIN_GROUPS for plugin in find_plugins(group).values()]
    return [
        {"name": plugin.name, "group": group, "package": plugin.package, "object": plugin.entry.value}
        for group, plugin in plugins
    ]

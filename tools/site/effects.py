"""One page per effect: equation, parameters, locations, source and a picture of its signature."""

import inspect

from hydrotele.core.units import display_unit
from hydrotele.effects import EFFECTS
from hydrotele.effects.effect import Effect, Parameter
from tools.site.effect_pictures import SETTINGS, choose_picture, load_scenario_machine

TITLES = {
    "force": "Force balance of a drive",
    "flow": "Flow balance of a chamber",
    "valve": "Valve and command",
    "supply": "Pump and relief valve",
    "geometry": "Geometry",
    "timing": "Timing",
    "sensor": "Sensors",
}


def format_page(effect: Effect) -> str:
    """Return the page of an effect."""
    setting, picture = SETTINGS[effect.name], choose_picture(effect.name)
    machine = load_scenario_machine(picture.scenario)
    parameters = effect.parameters(machine, picture.location)
    places = ", ".join(f"`{place}`" for place in effect.locations(machine))
    forms = [other.name for other in EFFECTS.values() if other.mechanism == effect.mechanism and other is not effect]
    rows = [f"| `{key}` | {p.unit} | {_numbers(key, p)} |" for key, p in parameters.items()]
    sizes = ", ".join(
        f"`{key}` {_show(parameters[key].nominal, p.unit, key)} → {_show(picture.values[key], p.unit, key)}"
        for key, p in parameters.items()
        if key in picture.values and picture.values[key] != p.nominal
    )
    given = ", ".join(f"{key}: {value:.4g}" for key, value in picture.values.items())
    parts = [
        f"# {effect.name}",
        f"{effect.description[0].upper()}{effect.description[1:]}.",
        f"$$\n{setting['equation']}\n$$",
        setting["symbols"],
        f"Locations on `{machine.name}`: {places}.",
        "" if not effect.mechanism or not forms else f"Other forms of this mechanism: {_links(forms)}.",
        "## Parameters",
        f"Values for the location `{picture.location}` of `{machine.name}`. The typical deviation is the standard"
        f" deviation of the prior in a"
        " gap search; smaller changes than the smallest relevant one are not reported.",
        "| parameter | unit | nominal | lowest | highest | typical deviation | smallest relevant change |\n"
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |\n" + "\n".join(rows),
        (inspect.getdoc(effect.parameters) or "").partition("\n\n")[2].replace("\n\n", "\n"),
        "## Signature",
        f"Both runs of `{picture.scenario}` have the same commands. With the effect: {sizes}.",
        f"![Signals with and without {effect.name}]({effect.name}.png)",
        "To add the effect to a run:",
        f"```bash\nhydrotele run {picture.scenario} --set 'effects=[{{name: "
        f"{effect.name}, location: {picture.location},"
        f" parameters: {{{given}}}}}]'\n```",
        f"Source: {setting['source']}.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _numbers(key: str, p: Parameter) -> str:
    numbers = (p.nominal, p.lower_bound, p.upper_bound, p.prior_std, p.min_relevant_change)
    return " | ".join(f"{number:.4g}" for number in numbers)


def _show(value: float, unit: str, key: str) -> str:
    shown, factor = display_unit(unit, value, key)
    return f"{factor * value:.4g}{'' if shown == '1' else f' {shown}'}"


def _links(names: list[str]) -> str:
    return ", ".join(f"[{name}]({name}.md)" for name in names)


def list_pages() -> dict[str, str]:
    """Return {path of the page: its text} of all effects, and of their index."""
    pages = {f"effects/{name}.md": format_page(effect) for name, effect in EFFECTS.items()}
    parts = [
        "# Effects",
        "An effect is a physical property that a machine has and its model may omit. `hydrotele list effects` lists"
        " them;"
        " [Custom effects](../../effects.md) shows how to write one. Each page has the equation, the parameters with"
        " their ranges, and a"
        " picture of what the effect changes in pressures and motion.",
    ]
    for part, title in TITLES.items():
        rows = [f"| [{e.name}]({e.name}.md) | {e.description} |" for e in EFFECTS.values() if e.model_part == part]
        parts += [f"## {title}", "| effect | what it is |\n| --- | --- |\n" + "\n".join(rows)]
    names = "\n".join(sorted(EFFECTS))
    parts.append(f"```{{toctree}}\n:hidden:\n\n{names}\n```")
    pages["effects/index.md"] = "\n\n".join(parts) + "\n"
    return pages

"""One page per effect: equation, parameters, locations, source and a picture of its signature."""

import inspect
import re

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
"""Part of the model -> title of its group of effects."""
PART_TEXTS = {
    "force": "These effects change the forces on a drive or a link, and with them pressures and motion.",
    "flow": "These effects change flow, pressure or oil volume of the chambers, or the pump of an axis with"
    " its own pump.",
    "valve": "These effects change how a command becomes an opening of the valve, and an opening a flow.",
    "supply": "These effects change the pump and the main relief valve that feed several axes.",
    "geometry": "These effects change dimensions of links and of cylinder pins.",
    "timing": "This effect delays the commands. Delays of sensors are below Sensors.",
    "sensor": "These effects change readings only. The motion of the machine and its true pressures stay the same.",
}
"""Part of the model -> what the effects of its group change."""


def format_page(effect: Effect) -> str:
    """Return the page of an effect."""
    setting, picture = SETTINGS[effect.name], choose_picture(effect.name)
    machine = load_scenario_machine(picture.scenario)
    parameters = effect.parameters(machine, picture.location)
    places = ", ".join(f"`{place}`" for place in effect.locations(machine))
    forms = [other.name for other in EFFECTS.values() if other.mechanism == effect.mechanism and other is not effect]
    rows = [
        f"| `{key}`{' (optional)' if p.optional else ''} | {p.unit} | {_numbers(key, p)} |"
        for key, p in parameters.items()
    ]
    sizes = ", ".join(
        f"`{key}` {_show(parameters[key].nominal, p.unit, key)} → {_show(picture.values[key], p.unit, key)}"
        for key, p in parameters.items()
        if key in picture.values and picture.values[key] != p.nominal
    )
    given = ", ".join(f"{key}: {value:.4g}" for key, value in picture.values.items())
    title = TITLES[effect.model_part]
    changed = "".join(f" --set '{key}={value}'" for key, value in picture.overrides)
    source = setting["source"].replace("`models/cat215/README.md`", "[CAT 215](../machines/cat215.md)")
    parts = [
        f"# {effect.name}",
        f"{effect.description[0].upper()}{effect.description[1:]}. This effect belongs to the group"
        f" [{title}](index.md#{title.lower().replace(' ', '-')}). [Effects](index.md) explains the use of effects.",
        "## Equation",
        f"$$\n{setting['equation']}\n$$",
        f"{setting['symbols']} Source: {source}.",
        f"Valid values of `location` on the machine `{machine.name}`: {places}.",
        "## Parameters",
        f"Each row is a parameter, with the values for the location `{picture.location}` of `{machine.name}`; other"
        " machines have other values. A scenario and `hydrotele gap` state the value with the effect, not the change:"
        " it replaces *nominal*, the value without the effect. The [index](index.md#columns-of-the-parameter-tables)"
        " explains the columns.",
        "| parameter | unit | nominal | lowest | highest | prior standard deviation | smallest relevant change |\n"
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |\n" + "\n".join(rows),
        (inspect.getdoc(effect.parameters) or "").partition("\n\n")[2].replace("\n\n", "\n"),
        "## Example",
        f"The picture compares two simulations of the scenario `{picture.scenario}` (machine `{machine.name}`) with the"
        f" same commands and with sensors without errors. The effect at `{picture.location}` changes {sizes}."
        " Wide pale lines: without the effect. Thin lines: with it. Right column: the signal with the effect minus that"
        " without it.",
        f"![Signals with and without {effect.name}]({effect.name}.png)",
        setting["shows"],
        "This command adds the effect to a run. Where a controller generates the commands of the scenario, it reacts"
        " to the effect, and the signals differ from those of the picture.",
        f"```bash\nhydrotele run {picture.scenario}{changed} --set 'effects=[{{name: "
        f"{effect.name}, location: {picture.location},"
        f" parameters: {{{given}}}}}]'\n```",
        "## Similar effects",
        _link_names(setting["similar"], effect.name),
        ""
        if not effect.mechanism or not forms
        else f"{_links(forms)} and {effect.name} are forms of one effect, that is, different laws of the same"
        " physical cause. The verdict of `hydrotele gap` adds their probabilities.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _link_names(text: str, own: str) -> str:
    """Return a text in which the names of other effects, in backticks, are links to their pages."""
    return re.sub(
        r"`(\w+)`",
        lambda match: f"[{match[1]}]({match[1]}.md)" if match[1] in EFFECTS and match[1] != own else match[0],
        text,
    )


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
        "An effect is a physical phenomenon that a machine may have and its model may omit, such as"
        " leakage, friction or a sensor offset. Each effect has a name, a location and parameters. It is used"
        " in three ways:",
        "- `hydrotele run` and a scenario file add effects to the simulated machine.\n"
        "- `hydrotele gap` compares a machine with measured logs and reports which effects, at which location and of"
        " which size, explain the difference.\n"
        "- The patched machine that `hydrotele gap` writes contains the effects it has found.",
        "The location is the part of the machine that has the effect. It can be an axis or its drive (`stick`), a"
        " chamber or its transducer (`stick.head`), a link, the tool, `base`, `supply` or `all`. Each page lists the"
        " valid locations of one machine.",
        "`hydrotele list effects` prints these tables. [Custom effects](../../effects.md) shows how to add an effect.",
        "Each page gives the equation, the parameters with their ranges, a simulated example, and how to"
        " distinguish the effect from similar ones. Its quantities are those of one drive: a hydraulic"
        " cylinder, a hydraulic motor or a"
        " force actuator, which moves one joint. `positive` and `negative` are the directions of the spool:"
        " positive feeds the head side of a cylinder or port A of a motor.",
        "## Columns of the parameter tables",
        "| column | meaning |\n| --- | --- |\n"
        "| unit | SI unit; 1 for a ratio |\n"
        "| nominal | value without the effect: that of the machine file or, for a parameter that the machine file does"
        " not have, the default of the effect |\n"
        "| lowest, highest | limits of the value in `hydrotele gap` and in a scenario |\n"
        "| prior standard deviation | how far the value typically differs from nominal. `hydrotele gap` uses a normal"
        " prior about the nominal value with this standard deviation |\n"
        "| smallest relevant change | `hydrotele gap` does not report an effect if all its parameters"
        " differ from nominal by less |",
        "A parameter marked *optional* may be omitted in a scenario; it then has its nominal value.",
    ]
    for part, title in TITLES.items():
        rows = [f"| [{e.name}]({e.name}.md) | {e.description} |" for e in EFFECTS.values() if e.model_part == part]
        parts += [f"## {title}", PART_TEXTS[part], "| effect | meaning |\n| --- | --- |\n" + "\n".join(rows)]
    names = "\n".join(sorted(EFFECTS))
    parts.append(f"```{{toctree}}\n:hidden:\n\n{names}\n```")
    pages["effects/index.md"] = "\n\n".join(parts) + "\n"
    return pages

"""`hydrotele excite`: a scenario whose motion tells a machine's parameters best."""

import re
from pathlib import Path

import numpy as np
import yaml

from hydrotele.cli.console import notes, out, print_json, stages
from hydrotele.cli.identifying import closed_chain
from hydrotele.core.errors import InputError
from hydrotele.core.output import replacing
from hydrotele.identify.excitation import design_excitation, informative_base
from hydrotele.identify.record import force_noise
from hydrotele.identify.setup import machine_setup
from hydrotele.machine.machine_file import load_machine, shipped_machines
from hydrotele.scenario.scenario import load_scenario


def excite_to_file(
    machine: str, tool: str | None, sensors: str | None, target: Path, period: float,
    harmonics: int, starts: int, seed: int, cycles: float, as_json: bool,
) -> Path:  # fmt: skip
    """Design a motion and write it as a scenario.

    Args:
        machine: name or folder.
        tool: its tool, None for its own.
        sensors: name of its sensors, None for its first.
        target: YAML file to write.
        period: of the motion [s].
        harmonics: of it.
        starts: searches from random motions.
        seed: of these.
        cycles: periods that the scenario runs.
        as_json: print the figures as JSON.

    Returns:
        The file.

    Raises:
        InputError: no such machine or sensors, or no motion within the limits was found.
    """
    model = load_machine(machine, tool)
    named = sensors or next(iter(model.sensors), None)
    if named is None:
        raise InputError(machine, "has no sensors: their noise decides what a motion tells")
    name = re.sub(r"[^a-z0-9_]", "_", target.stem.lower()).lstrip("_0123456789") or "excitation"
    if target.suffix.lower() != ".yaml" or not target.parent.is_dir():
        raise InputError(target, "must be a .yaml file in a folder that is there")
    place = machine if machine in shipped_machines() else str(Path(machine).resolve())
    setup = machine_setup(model, closed_chain(model))
    noise = np.maximum(force_noise(model, named), 1e-9)
    base = informative_base(model, setup, noise, period, seed)
    with stages(f"excite {model.name}", as_json) as progress:
        found = design_excitation(
            model, setup, noise, base, period=period, harmonics=harmonics, starts=starts,
            seed=seed, progress=progress,
        )  # fmt: skip
    scenario = found.scenario(name, model, cycles, place, sensors=named)
    with replacing(target, ".yaml") as part:
        text = yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)
        part.write_text(text, encoding="utf-8")
    load_scenario(target)
    if as_json:
        print_json({
            "file": str(target), "criterion": found.criterion, "parameters": found.parameters,
            "largest_use_of_a_limit": found.worst,
        })  # fmt: skip
    else:
        out.print(
            f"a motion of {period:g} s for {found.parameters} parameters; its tightest limit is"
            f" used to {100 * found.worst:.0f} %"
        )
        notes.print(f"hydrotele run {target}", style="dim")
        out.print(f"written to [bold]{target}[/]")
    return target

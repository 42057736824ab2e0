"""Every point of a sweep becomes a scenario, checked before the first run as far as that is cheap.

Cheap is what needs no compiled model: keys, values, machine, tool, effects and sensors. A start
that cannot be reached or a plan that asks for too much shows as a failed run.
"""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.noise import sensor_set
from hydrotele.run.sweep_facts import Point, SweepFile, override_text, overrides, points
from hydrotele.run.sweep_runs import Inputs
from hydrotele.scenario.scenario import (
    Scenario,
    ScenarioFile,
    own_machine,
    read_scenario_file,
    scenario_from,
)

Progress = Callable[[int, int], None]
_Machines = dict[tuple[str, str | None], Machine]


class Base(NamedTuple):
    """A sweep with what all its runs share.

    Attributes:
        file: the sweep.
        scenario: file of the base scenario.
        inputs: the machines that are the user's own.
    """

    file: SweepFile
    scenario: ScenarioFile
    inputs: Inputs


class Checked(NamedTuple):
    """What the check of all points found.

    Attributes:
        fingerprints: of the scenario of every run, in order.
        seed: of the first run.
        units: varied key of an effect -> its unit.
        axes: of all machines.
        teleoperated: whether any pilot is.
    """

    fingerprints: tuple[bytes, ...]
    seed: int
    units: dict[str, str]
    axes: tuple[str, ...]
    teleoperated: bool

    @property
    def digest(self) -> str:
        """SHA-256 of all scenarios in their order."""
        return hashlib.sha256(b"".join(self.fingerprints)).hexdigest()


def open_base(file: SweepFile) -> Base:
    """Read the base scenario of a sweep.

    Raises:
        InputError: there is none, or it is no YAML mapping.
    """
    return Base(file, read_scenario_file(file.scenario()), Inputs())


def scenario_of(base: Base, point: Point) -> Scenario:
    """The scenario of a point; its own machines are named by their place in the sweep's folder.

    Raises:
        InputError: the point is none that `hydrotele run` would take.
    """
    scenario = scenario_from(base.scenario, overrides(base.file.sweep, point.values))
    return base.inputs.named(scenario.model_copy(update={"seed": scenario.seed + point.copy}))


def fingerprint(scenario: Scenario) -> bytes:
    """16 bytes that tell a scenario from any other, wherever its files lie."""
    return hashlib.sha256(scenario.model_dump_json().encode()).digest()[:16]


def check_points(base: Base, progress: Progress | None = None) -> Checked:
    """Check every point.

    Args:
        base: of `open_base`.
        progress: called now and then with (points checked, all points).

    Raises:
        InputError: the first point that is wrong, with file, line, key and what is allowed.
    """
    sweep = base.file.sweep
    prints: list[bytes] = []
    machines: _Machines = {}
    seed = 0
    units: dict[str, str] = {}
    teleoperated = False
    for point in points(sweep):
        try:
            if point.copy == 0:
                scenario = _checked(base, point.values, machines)
                teleoperated |= scenario.pilot.kind == "teleop"
                units |= _effect_units(scenario, sweep.varied, machines)
            whole = scenario_of(base, point)
        except InputError as error:
            raise _blamed(base, point, machines, error) from None
        seed = seed if prints else whole.seed
        prints.append(fingerprint(whole))
        if progress and point.run % 100 == 0:
            progress(point.run, sweep.runs)
    axes = dict.fromkeys(axis for machine in machines.values() for axis in machine.axes)
    return Checked(tuple(prints), seed, units, tuple(axes), teleoperated)


def _checked(base: Base, values: dict[str, Any], machines: _Machines) -> Scenario:
    """The scenario of some values, its machine, effects and sensors tried."""
    scenario = scenario_from(base.scenario, overrides(base.file.sweep, values))
    machine = _machine_of(scenario, machines)
    sensor_set(machine, scenario.sensors)
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return scenario


def _machine_of(scenario: Scenario, machines: _Machines) -> Machine:
    key = (str(own_machine(scenario) or scenario.machine), scenario.tool)
    if key not in machines:
        machines[key] = load_machine(*key)
    return machines[key]


def _blamed(base: Base, point: Point, machines: _Machines, error: InputError) -> InputError:
    """The error of a point, at the place in the sweep's file that is to blame."""
    file = base.file
    for values in ({}, *({key: value} for key, value in point.values.items())):
        try:
            _checked(base, values, machines)
        except InputError as alone:
            if _said(alone) != _said(error):
                continue
            if not values:
                return InputError(file.place("set"), _said(error)) if file.sweep.set else error
            ((key, value),) = values.items()
            return InputError(_place(file, key, value), f"{override_text(value)}: {_said(error)}")
    said = ", ".join(f"{key} {override_text(value)}" for key, value in point.values.items())
    return InputError(file.path, f"run {point.run} ({said}): {_said(error)}")


def _place(file: SweepFile, key: str, value: Any) -> str:
    if key in file.sweep.grid:
        line = file.lines.get(("grid", key, file.sweep.grid[key].index(value)))
        return f"{file.path}:{line}: grid.{key}" if line else file.place("grid", key)
    return file.place("sample", "keys", key)


def _said(error: InputError) -> str:
    """What is wrong, without the overrides that the sweep itself gave."""
    ours = error.where.startswith("--set ") or " with --set " in error.where
    return error.message if ours else str(error)


def _effect_units(
    scenario: Scenario, varied: tuple[str, ...], machines: _Machines
) -> dict[str, str]:
    """Units of the varied parameters of effects."""
    units = {}
    for key in varied:
        parts = key.split(".")
        if len(parts) == 4 and parts[0] == "effects" and parts[2] == "parameters":
            planted = scenario.effects[int(parts[1])]
            effect, machine = EFFECTS[planted.name], _machine_of(scenario, machines)
            places = effect.locations(machine)
            known = effect.parameters(machine, planted.location or places[0])
            units[key] = known[parts[3]].unit
    return units

"""Scenarios of the points of a sweep, all checked before the first run.

Keys, values, machine, tool, effects and sensors are checked. This needs no compiled model; an
unreachable start pose or an infeasible plan gives a failed run.
"""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.machine_copies import MachineCopies
from hydrotele.run.sweep_file import Point, SweepFile, iterate_points, override_text, point_overrides
from hydrotele.scenario.scenario import (
    Scenario,
    ScenarioFile,
    find_local_machine,
    make_scenario,
    read_scenario_file,
)

Progress = Callable[[int, int], None]
_Machines = dict[tuple[str, str | None], Machine]


class SweepBase(NamedTuple):
    """A sweep with the files that its runs need.

    Attributes:
        file: the sweep.
        scenario: content of the base scenario, which the runs vary.
        machine_copies: copies of the machines that are not shipped with the package.
    """

    file: SweepFile
    scenario: ScenarioFile
    machine_copies: MachineCopies


class CheckedSweep(NamedTuple):
    """Result of the check of all points.

    Attributes:
        fingerprints: 16-byte hash of the scenario of every run, in order.
        seed: seed of the first run.
        units: unit of each varied key that is a parameter of an effect.
        axes: names of the axes of all machines.
        teleoperated: whether any scenario is teleoperated.
    """

    fingerprints: tuple[bytes, ...]
    seed: int
    units: dict[str, str]
    axes: tuple[str, ...]
    teleoperated: bool

    @property
    def digest(self) -> str:
        """SHA-256 hash of the hashes of all scenarios in order, as hexadecimal text."""
        return hashlib.sha256(b"".join(self.fingerprints)).hexdigest()


def read_base_scenario(file: SweepFile) -> SweepBase:
    """Read the base scenario of a sweep.

    Raises:
        InputError: the file is missing or is not a YAML mapping.
    """
    return SweepBase(file, read_scenario_file(file.find_scenario()), MachineCopies())


def make_point_scenario(base: SweepBase, point: Point) -> Scenario:
    """Return the scenario of one run of a sweep, with the values and the repetition of a point.

    Paths of user machines are those of their copies in the sweep folder.

    Raises:
        InputError: the scenario is invalid.
    """
    scenario = make_scenario(base.scenario, point_overrides(base.file.sweep, point.values))
    return _make_repetition(base, scenario, point.repetition_number)


def _make_repetition(base: SweepBase, scenario: Scenario, repetition_number: int) -> Scenario:
    """Return a copy of a scenario whose seed is increased by the number of the repetition.

    Paths of user machines are those of their copies in the sweep folder.
    """
    seed = scenario.seed + repetition_number
    return base.machine_copies.with_copied_paths(scenario.model_copy(update={"seed": seed}))


def hash_scenario(scenario: Scenario) -> bytes:
    """Return a 16-byte hash of the content of a scenario, by which a change is detected.

    A result of `make_point_scenario` contains no absolute folder of a machine, so its hash does not
    depend on where machine files are. Paths of other files, such as a recorded motion, are absolute.
    """
    return hashlib.sha256(scenario.model_dump_json().encode()).digest()[:16]


def check_points(base: SweepBase, progress: Progress | None = None) -> CheckedSweep:
    """Check the scenarios of all runs of a sweep, with machine, effects and sensors.

    Args:
        base: result of `read_base_scenario`.
        progress: callback, called periodically with (points checked, number of points).

    Raises:
        InputError: a point is invalid; the message names file, line, key and valid values.
    """
    sweep = base.file.sweep
    prints: list[bytes] = []
    machines: _Machines = {}
    seed = 0
    units: dict[str, str] = {}
    teleoperated = False
    scenario: Scenario
    for point in iterate_points(sweep):
        try:
            if point.repetition_number == 0:
                scenario = _check_values_of_point(base, point.values, machines)
                teleoperated |= scenario.pilot.kind == "teleop"
                units |= _effect_units(scenario, sweep.varied_keys, machines)
            whole = _make_repetition(base, scenario, point.repetition_number)
        except InputError as error:
            raise _locate_error(base, point, machines, error) from None
        seed = seed if prints else whole.seed
        prints.append(hash_scenario(whole))
        if progress and point.run % 100 == 0:
            progress(point.run, sweep.runs)
    axes = dict.fromkeys(axis for machine in machines.values() for axis in machine.axes)
    return CheckedSweep(tuple(prints), seed, units, tuple(axes), teleoperated)


def _check_values_of_point(base: SweepBase, values: dict[str, Any], machines: _Machines) -> Scenario:
    """Return the scenario with some varied values, after checking its machine, effects and sensors.

    Args:
        base: the sweep.
        values: varied key -> value.
        machines: machines loaded so far, by name and tool; a new one is added.

    Raises:
        InputError: the scenario is invalid.
    """
    scenario = make_scenario(base.scenario, point_overrides(base.file.sweep, values))
    machine = _machine_of(scenario, machines)
    get_sensor_set(machine, scenario.sensors)
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return scenario


def _machine_of(scenario: Scenario, machines: _Machines) -> Machine:
    key = (str(find_local_machine(scenario) or scenario.machine), scenario.tool)
    if key not in machines:
        machines[key] = load_machine(*key)
    return machines[key]


def _locate_error(base: SweepBase, point: Point, machines: _Machines, error: InputError) -> InputError:
    """Return the error of a run with the line of the sweep file that causes it.

    The values of the run are checked one at a time; the first that gives the same error is the cause.
    """
    file = base.file
    for values in ({}, *({key: value} for key, value in point.values.items())):
        try:
            _check_values_of_point(base, values, machines)
        except InputError as alone:
            if _message_without_options(alone) != _message_without_options(error):
                continue
            if not values:
                return (
                    InputError(file.format_location("set"), _message_without_options(error))
                    if file.sweep.set
                    else error
                )
            ((key, value),) = values.items()
            return InputError(
                _value_location(file, key, value),
                f"{override_text(value)}: {_message_without_options(error)}",
            )
    said = ", ".join(f"{key} {override_text(value)}" for key, value in point.values.items())
    return InputError(file.path, f"run {point.run} ({said}): {_message_without_options(error)}")


def _value_location(file: SweepFile, key: str, value: Any) -> str:
    if key in file.sweep.grid:
        line = file.lines.get(("grid", key, file.sweep.grid[key].index(value)))
        return f"{file.path}:{line}: grid.{key}" if line else file.format_location("grid", key)
    return file.format_location("sample", "keys", key)


def _message_without_options(error: InputError) -> str:
    """Return the text of an error without a location that names a `--set` option, which the sweep generated.

    Other locations are kept in front of the message.
    """
    ours = error.where.startswith("--set ") or " with --set " in error.where
    return error.message if ours else str(error)


def _effect_units(scenario: Scenario, varied: tuple[str, ...], machines: _Machines) -> dict[str, str]:
    """Return the unit of each of the `varied` keys that is a parameter of an effect of the scenario."""
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

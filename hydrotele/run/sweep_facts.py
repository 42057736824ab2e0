"""A sweep file: which keys of a scenario are varied, and how; frozen, validated.

Keys are those of `hydrotele run --set key=value`, as in `servo.position_gain` or
`effects.0.parameters.mass`. The points of a sweep, what every run varies, have an order that never
changes. Each becomes a scenario, checked before the first run as far as that is cheap, that is
without a compiled model: keys, values, machine, tool, effects and sensors. A start that cannot be
reached or a plan that asks for too much shows as a failed run.
"""

import hashlib
import itertools
import json
import math
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from hydrotele.core.datafile import Facts, Name, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import scenarios_folder
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.machine.machine import Machine, sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.sweep_runs import Inputs
from hydrotele.scenario.scenario import (
    Scenario,
    ScenarioFile,
    own_machine,
    read_scenario_file,
    scenario_from,
    shipped_scenarios,
)

Key = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*$")]
MOST_RUNS = 100_000
_WAYS = ("uniform", "log_uniform", "normal", "choice")


def _checked_value(value: Any) -> Any:
    """A value that can stand in a scenario.

    Raises:
        ValueError: it is a date or the like, or not finite.
    """
    try:
        json.dumps(value, allow_nan=False)
    except (ValueError, TypeError):
        raise ValueError(f"{value!r} is no finite number, text, list or mapping") from None
    return value


def _checked_values(values: list[Any]) -> list[Any]:
    """Values of a grid.

    Raises:
        ValueError: one cannot stand in a scenario, or stands there twice.
    """
    texts = [json.dumps(_checked_value(value)) for value in values]
    for text in texts:
        if texts.count(text) > 1:
            raise ValueError(f"{text} stands twice; for more runs of it use repeat")
    return values


Value = Annotated[Any, AfterValidator(_checked_value)]
Values = Annotated[list[Any], Field(min_length=1), AfterValidator(_checked_values)]


class Distribution(Facts):
    """Where the values of a sampled key come from; exactly one of these.

    uniform [low, high], log_uniform [low, high] with low > 0, normal [mean, standard deviation], in
    the key's unit, or choice [values], all equally likely.
    """

    uniform: tuple[float, float] | None = None
    log_uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    choice: Annotated[list[Value], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self):
        given = [way for way in _WAYS if getattr(self, way) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(_WAYS)}")
        low, high = self.uniform or self.log_uniform or (0.0, 1.0)
        if not low < high:
            raise ValueError(f"{given[0]} must be [low, high] with low < high")
        if self.log_uniform and low <= 0.0:
            raise ValueError("log_uniform needs low > 0")
        if self.normal and self.normal[1] <= 0.0:
            raise ValueError("normal must be [mean, standard deviation > 0]")
        return self


class Sample(Facts):
    """Random values: `count` samples of all `keys` together, from a random seed of their own."""

    count: Annotated[int, Field(ge=1, le=MOST_RUNS)]
    seed: Annotated[int, Field(ge=0)] = 0
    keys: Annotated[dict[Key, Distribution], Field(min_length=1)]


class Sweep(Facts):
    """Many runs of one scenario.

    `set` holds for every run. `grid` takes every combination of its values, each of them with every
    one of the samples, and each of those `repeat` times with the scenario's seed counted up.
    `figures` names the numbers of a run's summary that are drawn; `logs` keeps every run's folder.
    """

    name: Name | None = None
    description: str = ""
    scenario: str
    set: dict[Key, Value] = {}
    grid: dict[Key, Values] = {}
    sample: Sample | None = None
    repeat: Annotated[int, Field(ge=1, le=MOST_RUNS)] = 1
    figures: tuple[str, ...] = ()
    logs: bool = False

    @model_validator(mode="after")
    def _check(self):
        sampled = self.sample.keys if self.sample else {}
        if not self.grid and not sampled and self.repeat == 1:
            raise ValueError("nothing is varied; give a grid, a sample or repeat")
        varied = [*self.grid, *sampled]
        for key in varied:
            others = [*self.set, *varied]
            if others.count(key) > 1:
                raise ValueError(f"{key} is given twice, in set, grid or sample")
            if below := [k for k in others if k.startswith(f"{key}.")]:
                raise ValueError(f"{below[0]} lies inside {key}, which is varied as a whole")
        if self.repeat > 1 and "seed" in varied:
            raise ValueError("repeat counts the seed up, so that seed cannot be varied, too")
        if self.runs > MOST_RUNS:
            raise ValueError(
                f"these are {self.runs} runs, more than {MOST_RUNS}; give fewer values, or a sample"
            )
        return self

    @property
    def runs(self) -> int:
        """Number of runs."""
        count = self.sample.count if self.sample else 1
        return math.prod(map(len, self.grid.values())) * count * self.repeat

    @property
    def varied(self) -> tuple[str, ...]:
        """The keys that differ between runs, but for the seed of repeated ones."""
        return (*self.grid, *(self.sample.keys if self.sample else ()))


class SweepFile(NamedTuple):
    """A sweep and where it was read.

    Attributes:
        path: its file.
        sweep: what it says.
        lines: key path -> line number from 1.
    """

    path: Path
    sweep: Sweep
    lines: dict[tuple, int]

    @property
    def name(self) -> str:
        """Name of the sweep, that of the file where it says none."""
        return self.sweep.name or self.path.stem

    def place(self, *keys: str | int) -> str:
        """File, line and key path, for messages."""
        found = (self.lines[keys[:k]] for k in range(len(keys), 0, -1) if keys[:k] in self.lines)
        line = next(found, None)
        return f"{self.path}{f':{line}' if line else ''}: {'.'.join(map(str, keys))}"

    def places(self, key: str) -> Iterator[str]:
        """Where a scenario's key is given in this file."""
        sample = self.sweep.sample
        if key in self.sweep.grid:
            yield self.place("grid", key)
        if sample and key in sample.keys:
            yield self.place("sample", "keys", key)
        if key in self.sweep.set:
            yield self.place("set", key)

    def scenario(self) -> str:
        """Shipped name or path of the base scenario.

        Raises:
            InputError: there is no such scenario, neither shipped nor beside the sweep's file.
        """
        asked = self.sweep.scenario
        if asked in shipped_scenarios():
            return asked
        beside = self.path.parent / asked
        if beside.is_file():
            return str(beside)
        message = f"{asked!r} is neither a shipped scenario nor a file beside this one; "
        raise InputError(self.place("scenario"), message + suggest(asked, shipped_scenarios()))


def shipped_sweeps() -> list[str]:
    """Names of the sweeps that come with the package."""
    return sorted(path.stem for path in (scenarios_folder() / "sweeps").glob("*.yaml"))


def load_sweep(name_or_path: str | Path) -> SweepFile:
    """Read a sweep file, a shipped one by its name.

    Returns:
        The validated sweep; its points are checked by `check_points`.

    Raises:
        InputError: names file, line, key path and what is allowed.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_sweeps():
        path = scenarios_folder() / "sweeps" / f"{name_or_path}.yaml"
    elif not path.is_file():
        message = f"is neither a file nor a shipped sweep; {suggest(path.stem, shipped_sweeps())}"
        raise InputError(f"sweep {str(name_or_path)!r}", message)
    data, lines = read_yaml(path)
    if "pilot" in data:
        message = f"is a scenario; a sweep names it, as in `scenario: {path.name}`"
        raise InputError(path, message)
    return SweepFile(path, parse(Sweep, data, str(path), lines), lines)


class Point(NamedTuple):
    """What one run has of its own.

    Attributes:
        run: its number, from 1.
        values: varied key -> value.
        copy: number of its repetition, from 0; the scenario's seed is counted up by it.
    """

    run: int
    values: dict[str, Any]
    copy: int


def points(sweep: Sweep) -> Iterator[Point]:
    """Every point of a sweep: the grid, its last key fastest; within it the samples; repeats last.

    >>> from hydrotele.run.sweep_facts import Sweep
    >>> [p.values["servo.lead"] for p in points(Sweep(scenario="a", grid={"servo.lead": [0, 0.1]}))]
    [0, 0.1]
    """
    drawn = samples(sweep)
    combinations = itertools.product(*sweep.grid.values())
    run = itertools.count(1)
    for values in combinations:
        here = dict(zip(sweep.grid, values, strict=True))
        for sample in drawn:
            for copy in range(sweep.repeat):
                yield Point(next(run), here | sample, copy)


def samples(sweep: Sweep) -> list[dict[str, Any]]:
    """The samples: varied key -> value; a single empty one where nothing is sampled.

    Each number depends on the sample's seed, its place and its key alone, so that more samples or
    another key leave the others as they are.
    """
    sample = sweep.sample
    if sample is None:
        return [{}]
    return [
        {key: _draw(sample.seed, k, key, where) for key, where in sample.keys.items()}
        for k in range(sample.count)
    ]


def _draw(seed: int, k: int, key: str, where: Distribution) -> Any:
    chance = np.random.default_rng([seed, k, zlib.crc32(key.encode())])
    if where.choice is not None:
        return where.choice[int(chance.integers(len(where.choice)))]
    if where.normal is not None:
        return float(chance.normal(*where.normal))
    if where.log_uniform is not None:
        low, high = map(math.log, where.log_uniform)
        return math.exp(chance.uniform(low, high))
    assert where.uniform is not None
    return float(chance.uniform(*where.uniform))


def override_text(value: Any) -> str:
    """A value as YAML text, as `--set` takes it."""
    return json.dumps(value, ensure_ascii=False)


def overrides(sweep: Sweep, values: dict[str, Any]) -> dict[str, str]:
    """Overrides of the base scenario: those of all runs, then those of one point."""
    return {key: override_text(value) for key, value in (sweep.set | values).items()}


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

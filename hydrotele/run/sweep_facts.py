"""A sweep file: which keys of a scenario are varied, and how; frozen, validated.

Keys are those of `hydrotele run --set key=value`, as in `servo.position_gain` or
`effects.0.parameters.mass`.

The points of a sweep: what every run varies, in an order that never changes.
"""

import itertools
import json
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from hydrotele.core.datafile import Facts, Name, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import scenarios_folder
from hydrotele.scenario.scenario import shipped_scenarios

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
        The validated sweep; its points are checked by `sweep_checking.check_points`.

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

"""Sweep files: sets of runs of one scenario in which keys of the scenario are varied.

Keys are those of `hydrotele run --set key=value`, for example `servo.position_gain`; the points of
a sweep are the values of each run, in a fixed order.
"""

import itertools
import json
import math
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from hydrotele.core.datafile import Name, Number, StrictModel, read_yaml, suggest_valid_name, validate_data
from hydrotele.core.errors import InputError
from hydrotele.core.files import scenarios_folder
from hydrotele.scenario.scenario import (
    shipped_scenarios,
)

Key = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*$")]
MAX_RUNS = 50_000  # of one sweep; checking them takes half a minute
_DISTRIBUTIONS = ("uniform", "log_uniform", "normal", "choice")


def _check_serialisable(value: Any) -> Any:
    """Return a value after checking that it can be written to a scenario.

    Raises:
        ValueError: the value is not finite or has no JSON form, such as a date.
    """
    try:
        json.dumps(value, allow_nan=False)
    except (ValueError, TypeError):
        raise ValueError(f"{value!r} is not a finite number, text, list or mapping") from None
    return value


def _check_grid_values(values: list[Any]) -> list[Any]:
    """Return the values of a grid after checking them.

    Raises:
        ValueError: a value cannot be written to a scenario, or occurs twice.
    """
    seen = set()
    for value in values:
        text = json.dumps(_check_serialisable(value))
        if text in seen:
            raise ValueError(f"{text} occurs twice; use repeat for several runs of one value")
        seen.add(text)
    return values


Value = Annotated[Any, AfterValidator(_check_serialisable)]
Values = Annotated[list[Any], Field(min_length=1), AfterValidator(_check_grid_values)]


class Distribution(StrictModel):
    """Random distribution of the values of a sampled key; exactly one of four forms is given.

    uniform [low, high], log_uniform [low, high] with low > 0, normal [mean, standard deviation], in
    the key's unit, or choice [values], all equally likely.
    """

    uniform: tuple[Number, Number] | None = None
    log_uniform: tuple[Number, Number] | None = None
    normal: tuple[Number, Number] | None = None
    choice: Annotated[list[Value], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self):
        given = [way for way in _DISTRIBUTIONS if getattr(self, way) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(_DISTRIBUTIONS)}")
        low, high = self.uniform or self.log_uniform or (0.0, 1.0)
        if not low < high:
            raise ValueError(f"{given[0]} must be [low, high] with low < high")
        if self.log_uniform and low <= 0.0:
            raise ValueError("log_uniform needs low > 0")
        if self.normal and self.normal[1] <= 0.0:
            raise ValueError("normal must be [mean, standard deviation > 0]")
        return self


class Sample(StrictModel):
    """Random values: `count` joint samples of all `keys`, from the random seed `seed`."""

    count: Annotated[int, Field(ge=1, le=MAX_RUNS)]
    seed: Annotated[int, Field(ge=0)] = 0
    keys: Annotated[dict[Key, Distribution], Field(min_length=1)]


class Sweep(StrictModel):
    """A set of runs of one scenario with varied parameters.

    `set` applies to every run. `grid` gives all combinations of its values. Each combination is run
    with every sample, and each of these runs is repeated `repeat` times with increasing seed.
    `figures` lists the numbers of the run summary to plot; `logs: true` keeps every run folder.
    """

    name: Name | None = None
    description: str = ""
    scenario: str
    set: dict[Key, Value] = {}
    grid: dict[Key, Values] = {}
    sample: Sample | None = None
    repeat: Annotated[int, Field(ge=1, le=MAX_RUNS)] = 1
    figures: tuple[str, ...] = ()
    logs: bool = False

    @model_validator(mode="after")
    def _check(self):
        sampled = self.sample.keys if self.sample else {}
        if not self.grid and not sampled and self.repeat == 1:
            raise ValueError("no key is varied; give a grid, a sample or repeat")
        varied = {*self.grid, *sampled}
        given = Counter([*self.set, *self.grid, *sampled])
        for key, count in given.items():
            if count > 1 and key in varied:
                raise ValueError(f"{key} is given more than once in set, grid and sample")
        # After sorting, a key is directly before one of its parts, if it has any.
        for whole, part in itertools.pairwise(sorted(key.split(".") for key in given)):
            if part[: len(whole)] == whole and (key := ".".join(whole)) in varied:
                raise ValueError(f"{'.'.join(part)} is part of {key}, which is varied as a whole")
        if self.repeat > 1 and "seed" in varied:
            raise ValueError("seed cannot be varied together with repeat, which increases the seed")
        if self.runs > MAX_RUNS:
            raise ValueError(f"the sweep has {self.runs} runs, more than {MAX_RUNS}; give fewer values or use a sample")
        return self

    @property
    def runs(self) -> int:
        """Number of runs."""
        count = self.sample.count if self.sample else 1
        return math.prod(map(len, self.grid.values())) * count * self.repeat

    @property
    def varied_keys(self) -> tuple[str, ...]:
        """Keys of the grid and of the samples; the seed of repetitions is not included."""
        return (*self.grid, *(self.sample.keys if self.sample else ()))


class SweepFile(NamedTuple):
    """A sweep and its file.

    Attributes:
        path: path of the file.
        sweep: content of the file.
        lines: path of a key in the file, such as ("grid", "seed") -> line number, starting at 1.
    """

    path: Path
    sweep: Sweep
    lines: dict[tuple, int]

    @property
    def name(self) -> str:
        """Name of the sweep; by default the file name without its ending."""
        return self.sweep.name or self.path.stem

    def format_location(self, *keys: str | int) -> str:
        """Return file, line and key path as text for messages, for example `a.yaml:3: grid.seed`."""
        found = (self.lines[keys[:k]] for k in range(len(keys), 0, -1) if keys[:k] in self.lines)
        line = next(found, None)
        return f"{self.path}{f':{line}' if line else ''}: {'.'.join(map(str, keys))}"

    def locations_of(self, key: str) -> Iterator[str]:
        """Yield file, line and key path of the places in this file that set a scenario key."""
        sample = self.sweep.sample
        if key in self.sweep.grid:
            yield self.format_location("grid", key)
        if sample and key in sample.keys:
            yield self.format_location("sample", "keys", key)
        if key in self.sweep.set:
            yield self.format_location("set", key)

    def find_scenario(self) -> str:
        """Return the name of the shipped base scenario, or the path of its file.

        Raises:
            InputError: the scenario is neither shipped nor in the folder of the sweep file.
        """
        asked = self.sweep.scenario
        if asked in shipped_scenarios():
            return asked
        beside = self.path.parent / asked
        if beside.is_file():
            return str(beside)
        message = f"{asked!r} is neither a shipped scenario nor a file in the same folder; "
        raise InputError(
            self.format_location("scenario"),
            message + suggest_valid_name(asked, shipped_scenarios()),
        )


def shipped_sweeps() -> list[str]:
    """Return the names of the sweep files in the package, without ending, in alphabetical order."""
    return sorted(path.stem for path in (scenarios_folder() / "sweeps").glob("*.yaml"))


def load_sweep(name_or_path: str | Path) -> SweepFile:
    """Read and validate a sweep file, given by its path or by the name of a shipped sweep.

    Returns:
        The sweep; its points are not checked yet, see `check_points`.

    Raises:
        InputError: the file is missing or invalid; the message names line, key and valid values.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_sweeps():
        path = scenarios_folder() / "sweeps" / f"{name_or_path}.yaml"
    elif not path.is_file():
        message = f"is neither a file nor a shipped sweep; {suggest_valid_name(path.stem, shipped_sweeps())}"
        raise InputError(f"sweep {str(name_or_path)!r}", message)
    data, lines = read_yaml(path)
    if "pilot" in data:
        message = f"is a scenario; a sweep file refers to it by `scenario: {path.name}`"
        raise InputError(path, message)
    return SweepFile(path, validate_data(Sweep, data, str(path), lines), lines)


class Point(NamedTuple):
    """One run of a sweep: its number, the values of the varied keys, and its repetition.

    Attributes:
        run: run number, starting at 1.
        values: varied key -> value.
        repetition_number: repetition number, starting at 0; it is added to the seed of the scenario.
    """

    run: int
    values: dict[str, Any]
    repetition_number: int


def iterate_points(sweep: Sweep) -> Iterator[Point]:
    """Yield all points of a sweep in the order of the runs.

    Repetitions vary fastest, then samples, then the keys of the grid from the last to the first.

    >>> from hydrotele.run.sweep_file import Sweep
    >>> [p.values["servo.lead"] for p in iterate_points(Sweep(scenario="a", grid={"servo.lead": [0, 0.1]}))]
    [0, 0.1]
    """
    drawn = draw_samples(sweep)
    combinations = itertools.product(*sweep.grid.values())
    run = itertools.count(1)
    for values in combinations:
        here = dict(zip(sweep.grid, values, strict=True))
        for sample in drawn:
            for copy in range(sweep.repeat):
                yield Point(next(run), here | sample, copy)


def draw_samples(sweep: Sweep) -> list[dict[str, Any]]:
    """Draw the random samples of a sweep, each as key -> value; one empty sample if the sweep has none.

    Each number depends only on the seed, the sample number and the key. Adding samples or keys
    therefore leaves the other numbers unchanged.
    """
    sample = sweep.sample
    if sample is None:
        return [{}]
    return [
        {key: _draw_value(sample.seed, k, key, where) for key, where in sample.keys.items()}
        for k in range(sample.count)
    ]


def _draw_value(seed: int, k: int, key: str, distribution: Distribution) -> Any:
    chance = np.random.default_rng([seed, k, zlib.crc32(key.encode())])
    if distribution.choice is not None:
        return distribution.choice[int(chance.integers(len(distribution.choice)))]
    if distribution.normal is not None:
        return float(chance.normal(*distribution.normal))
    if distribution.log_uniform is not None:
        low, high = map(math.log, distribution.log_uniform)
        return math.exp(chance.uniform(low, high))
    assert distribution.uniform is not None
    return float(chance.uniform(*distribution.uniform))


def override_text(value: Any) -> str:
    """Return a value as text for the command-line option `--set key=value`."""
    return json.dumps(value, ensure_ascii=False)


def point_overrides(sweep: Sweep, values: dict[str, Any]) -> dict[str, str]:
    """Return the scenario keys that a run sets in the base scenario, as key -> value as JSON text.

    Args:
        sweep: the sweep, whose `set` applies to all runs.
        values: varied key -> value of the run.
    """
    return {key: override_text(value) for key, value in (sweep.set | values).items()}

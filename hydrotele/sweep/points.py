"""The points of a sweep: what every run varies, in an order that never changes."""

import itertools
import json
import math
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from hydrotele.sweep.facts import Distribution, Sweep


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

    >>> from hydrotele.sweep.facts import Sweep
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

"""Evaluate controllers on complete episodes: return, error statistics and success rate."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore

SUCCESS = "success"  # name of the measure that is 1 if an episode succeeded


@dataclasses.dataclass(frozen=True)
class Scores:
    """Results of m episodes.

    Attributes:
        results: name -> (m,): `return`, `length` [s], `fault` (1 if the simulation became unstable),
            `success` if the task defines it, and the mean, RMS and final value of every measure
            (`tip_error mean` and so on).
        units: name -> unit.
    """

    results: dict[str, np.ndarray]
    units: dict[str, str]

    def mean(self, name: str) -> float:
        """Return the mean of a result over the episodes."""
        return float(self.results[name].mean())

    def standard_error(self, name: str) -> float:
        """Return the standard error of the mean of a result over the episodes; infinite for a single episode."""
        values = self.results[name]
        return float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.inf

    def to_markdown(self) -> str:
        """Return all results as a Markdown table with mean and standard error."""
        rows = ["| figure | mean | standard error | unit |", "| --- | --- | --- | --- |"]
        rows += [
            f"| {name} | {self.mean(name):.5g} | {self.standard_error(name):.2g} | {self.units[name]} |"
            for name in self.results
        ]
        return "\n".join(rows)


def evaluate_controller(core: TaskCore, controller: Controller, episodes: int, seed: int = 0) -> Scores:
    """Run a controller for complete episodes in batches.

    Every episode has the same weight, whatever its length.

    Args:
        core: running task; its autoreset must be DISABLED.
        controller: a controller of this task.
        episodes: minimum number of episodes, rounded up to whole batches.
        seed: seed of the first episode; the following episodes use the next integers.

    Returns:
        The scores.

    Raises:
        InputError: the autoreset of the core is not DISABLED.
    """
    if core.parameters["autoreset"] != DISABLED:
        raise InputError("autoreset", "must be DISABLED, so that every episode counts once")
    parts = []
    for first in range(0, max(1, episodes), core.count):
        core.reset(seed + first + np.arange(core.count))
        controller.begin(core.count)
        parts.append(_run_episode_batch(core, controller))
    figures = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Scores(figures, {name: _find_result_unit(core, name) for name in figures})


def _run_episode_batch(core: TaskCore, controller: Controller) -> dict[str, np.ndarray]:
    """Run n newly started episodes to their end and return the results, name -> (n,).

    The names are those of `Scores.results`.
    """
    n, names = core.count, [name for name, _ in core.setup.task.measures]
    total, steps = np.zeros(n), np.zeros(n)
    sums, squares = np.zeros((n, len(names))), np.zeros((n, len(names)))
    alive = np.ones(n, bool)
    while alive.any():
        core.step(controller(core.observation))
        total += np.where(alive, core.reward, 0.0)
        seen = np.where(alive[:, None], core.measures[:, : len(names)], 0.0)
        sums, squares, steps = sums + seen, squares + seen**2, steps + alive
        alive = core.episodes["over"] == 0
    clock = core.setup.clock
    figures = {
        "return": total,
        "length": steps * clock.ticks * clock.period,
        "fault": (core.episodes["fault"] != 0).astype(float),
    }
    for i, name in enumerate(names):
        last = core.measures[:, i].copy()
        if name == SUCCESS:
            figures[SUCCESS] = last
            continue
        figures[f"{name} mean"] = sums[:, i] / steps
        figures[f"{name} RMS"] = np.sqrt(squares[:, i] / steps)
        figures[f"{name} final"] = last
    return figures


def _find_result_unit(core: TaskCore, name: str) -> str:
    if name == "length":
        return "s"
    return dict(core.setup.task.measures).get(name.rpartition(" ")[0], "1")


def tabulate_scores(scores: Sequence[tuple[str, Scores]], names: Sequence[str]) -> str:
    """Return a Markdown table of results, mean ± standard error, with one row per controller.

    `scores` holds (label, scores) of each controller; `names` selects the results of the columns.
    """
    first = scores[0][1]
    heads = [f"{name} [{first.units[name]}]" for name in names]
    rows = ["| | " + " | ".join(heads) + " |", "| --- |" + " --- |" * len(heads)]
    for label, score in scores:
        cells = [f"{score.mean(name):.4g} ± {score.standard_error(name):.2g}" for name in names]
        rows.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(rows)

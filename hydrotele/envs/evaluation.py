"""What a controller is worth: returns, figures and successes of whole episodes."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.core import TaskCore
from hydrotele.envs.episode import DISABLED

SUCCESS = "success"  # a figure of this name says whether an episode succeeded


@dataclasses.dataclass(frozen=True)
class Scores:
    """Figures of m episodes.

    Attributes:
        figures: name -> (m,): `return`, `length` [s], `fault`, and of every measure its mean, RMS
            and value at the end (`tip_error mean` and so on), `success` where the task has it.
        units: name -> unit.
    """

    figures: dict[str, np.ndarray]
    units: dict[str, str]

    def mean(self, name: str) -> float:
        """Mean of a figure over the episodes."""
        return float(self.figures[name].mean())

    def error(self, name: str) -> float:
        """Standard error of that mean."""
        values = self.figures[name]
        return float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.inf

    def table(self) -> str:
        """All figures as a Markdown table: mean and standard error."""
        rows = ["| figure | mean | standard error | unit |", "| --- | --- | --- | --- |"]
        rows += [
            f"| {name} | {self.mean(name):.5g} | {self.error(name):.2g} | {self.units[name]} |"
            for name in self.figures
        ]
        return "\n".join(rows)


def evaluate(core: TaskCore, controller: Controller, episodes: int, seed: int = 0) -> Scores:
    """Let a controller do whole episodes, many side by side.

    Every episode counts once, short ones as much as long ones.

    Args:
        core: a task whose autoreset is DISABLED.
        controller: of this task.
        episodes: at least this many, whole batches of the core.
        seed: of the first episode; the others count up.

    Returns:
        The scores.

    Raises:
        InputError: the core begins new episodes by itself.
    """
    if core.facts["autoreset"] != DISABLED:
        raise InputError("autoreset", "must be DISABLED, so that every episode counts once")
    parts = []
    for first in range(0, max(1, episodes), core.count):
        core.reset(seed + first + np.arange(core.count))
        controller.begin(core.count)
        parts.append(_batch(core, controller))
    figures = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Scores(figures, {name: _unit(core, name) for name in figures})


def _batch(core: TaskCore, controller: Controller) -> dict[str, np.ndarray]:
    """Figures of one batch of episodes that have just begun."""
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


def _unit(core: TaskCore, name: str) -> str:
    if name == "length":
        return "s"
    return dict(core.setup.task.measures).get(name.rpartition(" ")[0], "1")


def compare(scores: Sequence[tuple[str, Scores]], figures: Sequence[str]) -> str:
    """A Markdown table of some figures of several controllers, with standard errors."""
    first = scores[0][1]
    heads = [f"{name} [{first.units[name]}]" for name in figures]
    rows = ["| | " + " | ".join(heads) + " |", "| --- |" + " --- |" * len(heads)]
    for label, score in scores:
        cells = [f"{score.mean(name):.4g} ± {score.error(name):.2g}" for name in figures]
        rows.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(rows)

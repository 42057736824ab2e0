"""What an experiment found: a sentence from the source beside a sentence with figures of ours."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario


class Panel(NamedTuple):
    """Curves over time, or over something else, that belong together.

    Attributes:
        title: with its unit.
        time: (n,) [s], or what `over` says.
        curves: label -> (n,) in the title's unit.
        over: label of the horizontal axis.
        log: whether the vertical axis is logarithmic.
    """

    title: str
    time: np.ndarray
    curves: Mapping[str, np.ndarray]
    over: str = "time [s]"
    log: bool = False


class Marginals(NamedTuple):
    """A sample of a posterior, to be shown in one and two dimensions.

    Attributes:
        names: p parameters.
        sample: (n, p) in `unit`.
        truth: (p,) true values in `unit`.
        unit: of all.
    """

    names: tuple[str, ...]
    sample: np.ndarray
    truth: np.ndarray
    unit: str = "mm or mrad"


class Finding(NamedTuple):
    """A claim of the source, checked.

    Attributes:
        name: short, such as `lines: up`.
        source: where it is published.
        published: what was seen.
        simulated: what is seen here, with figures.
        ok: whether that is the same.
        panels: curves to look at.
        marginals: a posterior to look at.
        basis: `document` where the source states it, `ours` where it goes beyond the source; empty
            where the series does not tell them apart.
        explanation: why it differs, or what the agreement hangs on.
    """

    name: str
    source: str
    published: str
    simulated: str
    ok: bool
    panels: tuple[Panel, ...] = ()
    marginals: Marginals | None = None
    basis: str = ""
    explanation: str = ""

    def row(self) -> dict[str, str | bool]:
        """One row as `--json` prints it; `ours_or_document` is empty where it is not told."""
        return {
            "name": self.name, "published": self.published, "where": self.source,
            "ours_or_document": self.basis, "simulated": self.simulated, "ok": bool(self.ok),
            "explanation": self.explanation,
        }  # fmt: skip


def tally(findings: Sequence[Finding]) -> str:
    """How many findings agree, those of the document and ours apart, as a sentence.

    >>> tally([Finding("a", "p. 1", "", "", True), Finding("b", "p. 2", "", "", False)])
    '1 of 2 as published'
    """
    ours = [one for one in findings if one.basis == "ours"]
    published = [one for one in findings if one.basis != "ours"]
    words = f"{sum(one.ok for one in published)} of {len(published)} as published"
    if ours:
        words += f"; beyond the document {sum(one.ok for one in ours)} of {len(ours)} hold"
    return words


def perform(name: str, overrides: Mapping[str, str] | None = None) -> tuple[Scenario, Run]:
    """Run a shipped scenario with some of its values changed."""
    scenario = load_scenario(name, dict(overrides or {}))
    return scenario, run_scenario(scenario)


def truth(run: Run, channel: str) -> np.ndarray:
    """(n,) of a true channel; zeros where nothing of the kind happened."""
    return run.truth.columns.get(channel, np.zeros(len(run.truth.time)))


def cylindrical(run: Run) -> dict[str, np.ndarray]:
    """True pose of the tip: r, z [m], theta, attitude [rad], (n,) each."""
    x, y, z = (truth(run, f"truth.tip.{c}") for c in "xyz")
    arm = run.plant.machine.arm
    assert arm is not None
    axes = {axis.joint: name for name, axis in run.plant.machine.axes.items()}
    bends = [truth(run, f"angle.{axes[j]}") for j in (arm.boom, arm.stick, arm.tool) if j]
    return {"r": np.hypot(x, y), "theta": np.unwrap(np.arctan2(y, x)), "z": z,
            "attitude": np.sum(bends, axis=0)}  # fmt: skip


Progress = Callable[[str, float], None]


def performed(
    tasks: Sequence[tuple[Callable[..., Any], tuple]], jobs: int | None = None
) -> Iterator[Any]:
    """Results in order, from processes of their own if there are several.

    Args:
        tasks: functions with their arguments.
        jobs: processes; as many as there are cores by default.

    Yields:
        What the functions return.
    """
    count = jobs or os.cpu_count() or 1
    if count == 1:
        for function, arguments in tasks:
            yield function(*arguments)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context) as pool:
        waiting = [pool.submit(function, *arguments) for function, arguments in tasks]
        for future in waiting:
            yield future.result()

"""What an experiment found: a sentence from the source beside a sentence with figures of ours.

A `Claim` of a document is judged on samples of an experiment that is repeated with other seeds.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

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


Basis = Literal["document", "ours"]
Changes = Mapping[str, str]
"""Scenario key -> value, as `hydrotele run SCENARIO key=value` takes them."""


class Sample(NamedTuple):
    """What one repetition of an experiment measured.

    Attributes:
        values: name -> figure, SI.
        panels: curves of the repetition.
    """

    values: Mapping[str, float]
    panels: tuple[Panel, ...] = ()


class Verdict(NamedTuple):
    """What the samples say of a claim.

    Attributes:
        ok: whether they agree with it.
        simulated: what was measured, with figures.
        explanation: why they disagree, or what the agreement hangs on, measured as well.
    """

    ok: bool
    simulated: str
    explanation: str = ""


@dataclass(frozen=True)
class Claim:
    """A sentence or figure of a document, and how samples are judged by it.

    Attributes:
        name: short.
        quote: what the document states, verbatim; of a claim that is ours, what we state.
        where: page and figure, table or section.
        basis: whether the document states it or it goes beyond the document.
        judge: samples of all repetitions -> verdict.
        broken: changes of the scenario with which the claim must fail.
        broken_how: those changes in words.
    """

    name: str
    quote: str
    where: str
    basis: Basis
    judge: Callable[[Sequence[Sample]], Verdict]
    broken: Changes
    broken_how: str

    def finding(self, samples: Sequence[Sample]) -> Finding:
        """The claim judged.

        Args:
            samples: of all repetitions, at least one; the curves are those of the first.

        Returns:
            A row of the table.
        """
        verdict = self.judge(samples)
        return Finding(
            self.name, self.where, self.quote, verdict.simulated, bool(verdict.ok),
            samples[0].panels, basis=self.basis, explanation=verdict.explanation,
        )  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """A measurement that is repeated, and the claims that are judged by it.

    Attributes:
        name: short.
        measure: (seed, changes of its scenario) -> sample.
        claims: judged by the samples.
        most: largest number of repetitions that are worth their time.
        times: number of repetitions where it is no choice, each another condition; else 0.
    """

    name: str
    measure: Callable[[int, Changes], Sample]
    claims: tuple[Claim, ...] = field(default=())
    most: int = 1000
    times: int = 0

    def repetitions(self, asked: int) -> int:
        """How often it is measured where `asked` repetitions are asked for."""
        return self.times or min(asked, self.most)


def drawn(seed: int) -> dict[str, str]:
    """Changes of a scenario: an operator drawn from the published spread, and a seed for noise."""
    return {"seed": str(seed), "pilot.perception.drawn": str(seed)}


def spread(samples: Sequence[Sample], name: str, scale: float = 1.0, digits: int = 1) -> str:
    """Mean of a figure over the samples with its least and largest, as text.

    Args:
        samples: at least one.
        name: of the figure.
        scale: by which it is multiplied.
        digits: after the point.

    Returns:
        Such as `2.1 (1.5 to 4.7)`; the figure alone where there is one sample.
    """
    values = [scale * sample.values[name] for sample in samples]
    mean = sum(values) / len(values)
    if len(values) == 1:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def largest(samples: Sequence[Sample], name: str) -> float:
    """Largest of a figure over the samples."""
    return max(sample.values[name] for sample in samples)


def least(samples: Sequence[Sample], name: str) -> float:
    """Smallest of a figure over the samples."""
    return min(sample.values[name] for sample in samples)


def mean(samples: Sequence[Sample], name: str) -> float:
    """Mean of a figure over the samples."""
    return sum(sample.values[name] for sample in samples) / len(samples)

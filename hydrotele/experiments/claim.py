"""A claim of a document, judged on samples of an experiment that is repeated with other seeds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from hydrotele.experiments.finding import Finding, Panel

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

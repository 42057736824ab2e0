"""Compare a published experiment with its repetition in simulation.

A `Series` is a document. It holds `Experiment`s, which are repeated with other seeds, and the
`Claim`s that are judged by their samples. A claim is judged by `Check`s: a simulated quantity
with its 95 % confidence interval against the range of values that agree with the document.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

Kind = Literal["document", "caption", "input", "additional"]
"""Kind of a row.

`document`: a sentence or figure of the document. `caption`: the document (or the part of it that is
available) gives a title only, so that the row has a simulated value and no verdict. `input`: a
number of the document that the model was built from, which is checked but not counted.
`additional`: a statement that is not in the publication.
"""

Verdict = Literal["agrees", "differs", "undecided", "cannot be computed", "no verdict"]
"""`undecided`: the interval holds values that agree and values that do not."""


class Panel(NamedTuple):
    """Curves that share their axes.

    Attributes:
        label: of the vertical axis: quantity and unit, such as `tip height [m]`.
        x: (n,) in the unit of `x_label`.
        curves: legend -> (n,) in the unit of `label`.
        x_label: of the horizontal axis: quantity and unit.
        log: whether the vertical axis is logarithmic.
        discrete: whether the points are separate measurements, which are drawn as markers.
        errors: legend -> (n,) differences, drawn on a separate axis below; for curves that
            coincide to the eye.
        error_label: of that axis: quantity and unit.
    """

    label: str
    x: np.ndarray
    curves: Mapping[str, np.ndarray]
    x_label: str = "time [s]"
    log: bool = False
    discrete: bool = False
    errors: Mapping[str, np.ndarray] = {}
    error_label: str = ""


class Marginals(NamedTuple):
    """A sample of a posterior, to be drawn in one and two dimensions.

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


class Check(NamedTuple):
    """A simulated quantity with its 95 % interval, and the values that agree with the document.

    Attributes:
        quantity: name, such as `RMS error of d0`.
        value: estimate.
        low, high: 95 % confidence interval; both equal `value` where nothing is random.
        accepted: lowest and highest value that agree.
        reason: where the accepted range comes from.
        unit: of all numbers.
        published: the document's own figure, where it has one.
    """

    quantity: str
    value: float
    low: float
    high: float
    accepted: tuple[float, float]
    reason: str
    unit: str = ""
    published: float | None = None

    @property
    def verdict(self) -> Verdict:
        """`agrees` where the whole interval is accepted, `differs` where none of it is."""
        least, most = self.accepted
        if not np.isfinite(self.value):
            return "differs"
        if least <= self.low and self.high <= most:
            return "agrees"
        if self.high < least or most < self.low:
            return "differs"
        return "undecided"

    def describe(self) -> str:
        """One line: the quantity, its interval and the document's figure.

        >>> Check("ratio", 1.52, 1.31, 1.8, (5.0, np.inf), "", published=11.0).describe()
        'ratio 1.52 [1.31, 1.8] (published 11)'
        """
        unit = f" {self.unit}" if self.unit else ""
        text = f"{self.quantity} {_format(self.value)}"
        if self.low < self.high:
            text += f" [{_format(self.low)}, {_format(self.high)}]"
        published = "" if self.published is None else f" (published {_format(self.published)})"
        return f"{text}{unit}{published}"

    def describe_range(self) -> str:
        """The accepted range with its reason.

        >>> Check("ratio", 1.52, 1.31, 1.8, (5.0, np.inf), "half of 11").describe_range()
        'ratio at least 5: half of 11'
        """
        (least, most), unit = self.accepted, f" {self.unit}" if self.unit else ""
        if np.isinf(most):
            words = f"at least {_format(least)}"
        elif np.isinf(least):
            words = f"at most {_format(most)}"
        else:
            words = f"{_format(least)} to {_format(most)}"
        return f"{self.quantity} {words}{unit}" + (f": {self.reason}" if self.reason else "")


def _format(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1e3 or np.isinf(value) else f"{value:.0f}"


class Judgement(NamedTuple):
    """The result of judging a claim by its samples.

    Attributes:
        checks: all of them have to agree; none where a caption is all that is published.
        explanation: the measured reason for a difference, or the conditions of the agreement.
        note: further simulated figures, which are not judged.
        unavailable: why the claim cannot be judged by these samples; empty where it can.
    """

    checks: tuple[Check, ...] = ()
    explanation: str = ""
    note: str = ""
    unavailable: str = ""

    @property
    def verdict(self) -> Verdict:
        """`differs` where one check differs, `agrees` where all agree, else `undecided`."""
        if self.unavailable:
            return "cannot be computed"
        verdicts = {check.verdict for check in self.checks}
        if not verdicts:
            return "no verdict"
        if "differs" in verdicts:
            return "differs"
        return "agrees" if verdicts == {"agrees"} else "undecided"


class Comparison(NamedTuple):
    """A row of the table: published result, simulated result and verdict.

    Attributes:
        name: short, such as `straight line up`.
        item: table, figure, equation or section of the document, with its page.
        published: the document's sentence or figures.
        kind: see `Kind`.
        judgement: of the samples.
        panels: curves to draw.
        marginals: a posterior to draw.
    """

    name: str
    item: str
    published: str
    kind: Kind
    judgement: Judgement
    panels: tuple[Panel, ...] = ()
    marginals: Marginals | None = None

    @property
    def verdict(self) -> Verdict:
        """Of the judgement; `no verdict` where only a caption is published."""
        return self.judgement.verdict

    @property
    def simulated(self) -> str:
        """The simulated figures with their intervals."""
        parts = [check.describe() for check in self.judgement.checks]
        return "; ".join([*parts, *([self.judgement.note] if self.judgement.note else [])])

    @property
    def criterion(self) -> str:
        """What counts as agreement, with the reason."""
        return "; ".join(check.describe_range() for check in self.judgement.checks)

    @property
    def explanation(self) -> str:
        """The measured reason for a difference, or why nothing can be computed."""
        return self.judgement.unavailable or self.judgement.explanation

    def row(self) -> dict[str, Any]:
        """The row as `--json` prints it."""
        checks = [
            check._asdict() | {"verdict": check.verdict} for check in self.judgement.checks
        ]  # fmt: skip
        return {
            "name": self.name, "item": self.item, "kind": self.kind, "published": self.published,
            "simulated": self.simulated, "verdict": self.verdict, "criterion": self.criterion,
            "explanation": self.explanation, "checks": checks,
        }  # fmt: skip


Changes = Mapping[str, Any]
"""Changes of an experiment's settings, such as scenario keys with their values."""


class Sample(NamedTuple):
    """Measurements of one repetition of an experiment.

    Attributes:
        values: name -> figure, SI.
        panels: curves of the repetition.
        arrays: name -> array, for claims that need more than single figures.
        marginals: a posterior of the repetition.
    """

    values: Mapping[str, float]
    panels: tuple[Panel, ...] = ()
    arrays: Mapping[str, np.ndarray] = {}
    marginals: Marginals | None = None


@dataclass(frozen=True)
class Claim:
    """A sentence or figure of a document, and how samples are judged by it.

    Attributes:
        name: short, unique in its series.
        quote: the document's statement; a quoted sentence is verbatim. Of an additional claim,
            the statement of this project.
        item: table, figure, equation or section, with its page.
        kind: see `Kind`.
        judge: samples of all repetitions -> judgement.
        broken: changes with which the claim must be judged `differs`; None where it has no verdict.
        broken_how: those changes in words.
        panels: which of the sample's panels the row draws, by label; all where it is None.
    """

    name: str
    quote: str
    item: str
    kind: Kind
    judge: Callable[[Sequence[Sample]], Judgement]
    broken: Changes | None = None
    broken_how: str = ""
    panels: tuple[str, ...] | None = None

    def compare(self, samples: Sequence[Sample]) -> Comparison:
        """Judge the claim by at least one sample; the curves are those of the first sample."""
        panels = tuple(panel for panel in samples[0].panels
                       if self.panels is None or panel.label in self.panels)  # fmt: skip
        return Comparison(
            self.name, self.item, self.quote, self.kind, self.judge(samples), panels,
            samples[0].marginals if self.panels is None else None,
        )  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """A measurement that is repeated, and the claims that are judged by it.

    Attributes:
        name: short.
        measure: (seed from 1 on, changes of its settings) -> sample.
        claims: judged by the samples.
        max_repetitions: largest number of repetitions that is worth its time.
        repetitions_fixed: number of repetitions where it is no choice: 1 where nothing is random,
            or the number of conditions; else 0.
    """

    name: str
    measure: Callable[[int, Changes], Sample]
    claims: tuple[Claim, ...] = field(default=())
    max_repetitions: int = 1000
    repetitions_fixed: int = 0

    def repetitions(self, requested: int) -> int:
        """Number of repetitions where `requested` ones are requested."""
        return self.repetitions_fixed or min(requested, self.max_repetitions)


@dataclass(frozen=True)
class Series:
    """A document with all of its tables and figures.

    Attributes:
        name: such as `zhu1994`.
        title: author, title, year.
        repetitions: usual number.
        experiments: in the order of the document.
        unavailable: rows that cannot be computed, each with the reason.
        drawings: table or figure -> why it has nothing to compare, such as `photograph`.
    """

    name: str
    title: str
    repetitions: int
    experiments: tuple[Experiment, ...]
    unavailable: tuple[Comparison, ...] = ()
    drawings: Mapping[str, str] = field(default_factory=dict)

    @property
    def claims(self) -> dict[str, Claim]:
        """All claims by name."""
        return {claim.name: claim for one in self.experiments for claim in one.claims}


Progress = Callable[[str, float], None]
"""Called with the name of the finished task and the finished fraction."""

BROKEN_REPETITIONS = 6
"""Smallest number of failures in a row whose 95 % interval of the fraction is below one half."""


def run_series(
    series: Series, seeds: int, jobs: int | None = None, progress: Progress | None = None
) -> list[Comparison]:
    """Run all experiments of a document.

    Args:
        series: the document.
        seeds: repetitions of every experiment; some have a smaller limit.
        jobs: processes; as many as there are cores by default.
        progress: called after every repetition.

    Returns:
        The rows, in the order of the document.
    """
    return compare_by_seeds(series, (seeds,), jobs, progress)[seeds]


def compare_by_seeds(
    series: Series, counts: Sequence[int], jobs: int | None = None,
    progress: Progress | None = None,
) -> dict[int, list[Comparison]]:  # fmt: skip
    """Judge a document with several numbers of repetitions, which share their first seeds.

    Args:
        series: the document.
        counts: numbers of repetitions.
        jobs: processes; as many as there are cores by default.
        progress: called after every repetition.

    Returns:
        Number of repetitions -> rows.
    """
    planned = [(one, {}, one.repetitions(max(counts))) for one in series.experiments]
    measured = measure_experiments(planned, jobs, progress)
    return {
        count: [
            claim.compare(samples[: one.repetitions(count)])
            for one, samples in zip(series.experiments, measured, strict=True)
            for claim in one.claims
        ] + list(series.unavailable)
        for count in counts
    }  # fmt: skip


def break_series(
    series: Series, names: Sequence[str] = (), jobs: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[Claim, Comparison]]:  # fmt: skip
    """Judge every claim that has a verdict by runs that are deliberately broken.

    Args:
        series: the document.
        names: of the claims; all by default.
        jobs: processes; as many as there are cores by default.
        progress: called after every repetition.

    Returns:
        The claims, each with a row that should say `differs`.
    """
    chosen = [(one, claim) for one in series.experiments for claim in one.claims
              if claim.broken is not None and (not names or claim.name in names)]  # fmt: skip
    planned = [(one, claim.broken or {}, one.repetitions(BROKEN_REPETITIONS))
               for one, claim in chosen]  # fmt: skip
    measured = measure_experiments(planned, jobs, progress)
    return [(claim, claim.compare(samples))
            for (_, claim), samples in zip(chosen, measured, strict=True)]  # fmt: skip


def measure_experiments(
    planned: Sequence[tuple[Experiment, Changes, int]],
    jobs: int | None = None,
    progress: Progress | None = None,
) -> list[list[Sample]]:
    """Samples of every experiment, each with its changes and number of repetitions."""
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        (one.measure, (seed, dict(changes)))
        for one, changes, count in planned
        for seed in range(1, count + 1)
    ]
    names = [one.name for one, _, count in planned for _ in range(count)]
    results = []
    for number, result in enumerate(run_tasks(tasks, jobs)):
        results.append(result)
        if progress:
            progress(names[number], (number + 1) / len(tasks))
    found, start = [], 0
    for *_, count in planned:
        found.append(results[start : start + count])
        start += count
    return found


def run_tasks(
    tasks: Sequence[tuple[Callable[..., Any], tuple]], jobs: int | None = None
) -> Iterator[Any]:
    """Yield the results of functions in order, computed by several processes.

    Args:
        tasks: functions with their arguments.
        jobs: processes; as many as there are cores by default.

    Yields:
        The results.
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


def summarize(rows: Sequence[Comparison]) -> str:
    """Count the verdicts on the document's claims, and those of additional claims.

    >>> row = Comparison("a", "p. 1", "", "document", Judgement(unavailable="no text"))
    >>> summarize([row])
    'of 1 published results 0 agree, 0 differ, 0 undecided, 1 cannot be computed'
    """
    published = [row.verdict for row in rows if row.kind == "document"]
    additional = [row.verdict for row in rows if row.kind == "additional"]
    text = (
        f"of {len(published)} published results {published.count('agrees')} agree,"
        f" {published.count('differs')} differ, {published.count('undecided')} undecided,"
        f" {published.count('cannot be computed')} cannot be computed"
    )
    captions = sum(row.kind == "caption" for row in rows)
    if captions:
        text += f"; {captions} published by caption only"
    if additional:
        text += f"; {additional.count('agrees')} of {len(additional)} additional statements hold"
    return text

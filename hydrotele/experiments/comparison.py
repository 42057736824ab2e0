"""Compare published experiments with their repetition in simulation.

A `Series` represents a document. It contains `Experiment`s, which are repeated with different
seeds, and `Claim`s, which are evaluated with the resulting `Sample`s. A claim is evaluated with
`Check`s. A check compares a simulated quantity and its 95 % confidence interval with the range of
values that agree with the document.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError

Kind = Literal["document", "caption", "input", "additional"]
"""Kind of a row.

- `document`: a sentence or figure of the document.
- `caption`: the available text has only a caption; the row has a simulated value and no verdict.
- `input`: a published value from which the model was built; it is checked but not counted.
- `additional`: a statement that is not in the publication.
"""

Verdict = Literal["agrees", "differs", "undecided", "cannot be computed", "no verdict"]
"""`undecided`: the interval is partly inside and partly outside the accepted range."""


class Panel(NamedTuple):
    """Curves that share their axes.

    Attributes:
        label: quantity and unit of the vertical axis, such as `tip height [m]`.
        x: (n,) in the unit of `x_label`.
        curves: legend -> (n,) in the unit of `label`.
        x_label: quantity and unit of the horizontal axis.
        log: whether the vertical axis is logarithmic.
        discrete: whether the points are separate measurements, which are drawn as markers.
        errors: legend -> (n,) differences between curves, drawn on a separate axis below, because they
            may be too small to see in the curves.
        error_label: quantity and unit of the error axis.
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
    """Samples of a posterior, drawn as one- and two-dimensional marginals.

    Attributes:
        names: names of the p parameters.
        sample: (n, p) samples in `unit`.
        truth: (p,) true values in `unit`.
        unit: unit of all parameters.
    """

    names: tuple[str, ...]
    sample: np.ndarray
    truth: np.ndarray
    unit: str = "mm or mrad"


class Check(NamedTuple):
    """A simulated quantity with its 95 % confidence interval and its accepted range.

    Attributes:
        quantity: name, such as `RMS error of d0`.
        value: estimate.
        low, high: 95 % confidence interval; both equal `value` if nothing is random.
        accepted: lowest and highest value that agree with the document.
        reason: source of the accepted range.
        unit: unit of all values.
        published: published value, if there is one.
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
        """Verdict by comparison of the confidence interval with the accepted range.

        `agrees` if the whole interval is accepted. `differs` if no part of it is, or if the value is not
        finite. `undecided` otherwise.
        """
        least, most = self.accepted
        if not np.isfinite(self.value):
            return "differs"
        if least <= self.low and self.high <= most:
            return "agrees"
        if self.high < least or most < self.low:
            return "differs"
        return "undecided"

    def describe(self) -> str:
        """Return the quantity, its value, its confidence interval and the published value as text.

        >>> Check("ratio", 1.52, 1.31, 1.8, (5.0, np.inf), "", published=11.0).describe()
        'ratio = 1.52 [1.31, 1.8] (published 11)'
        """
        unit = f" {self.unit}" if self.unit else ""
        text = f"{self.quantity} = {_format_value(self.value)}"
        if self.low < self.high:
            text += f" [{_format_value(self.low)}, {_format_value(self.high)}]"
        published = "" if self.published is None else f" (published {_format_value(self.published)})"
        return f"{text}{unit}{published}"

    def describe_range(self) -> str:
        """Return the accepted range and its reason as text.

        >>> Check("ratio", 1.52, 1.31, 1.8, (5.0, np.inf), "half of 11").describe_range()
        'ratio at least 5: half of 11'
        """
        return f"{self.quantity} {self.format_range()}" + (f": {self.reason}" if self.reason else "")

    def format_range(self) -> str:
        """Return the accepted range with its unit as text; one value if both ends print alike.

        >>> Check("ratio", 1.52, 1.31, 1.8, (5.0, np.inf), "half of 11").format_range()
        'at least 5'
        >>> Check("mass", 688.2, 688.2, 688.2, (687.5, 688.5), "last printed digit", "kg").format_range()
        '688 kg'
        """
        least, most = (_format_value(end) for end in self.accepted)
        if np.isinf(self.accepted[1]):
            words = f"at least {least}"
        elif np.isinf(self.accepted[0]):
            words = f"at most {most}"
        else:
            words = least if least == most else f"{least} to {most}"
        return f"{words} {self.unit}" if self.unit else words


_MIN_SCIENTIFIC_VALUE = 1e7  # values from here on are printed with an exponent


def _format_value(value: float) -> str:
    is_rounded = abs(value) < 1e3 or abs(value) >= _MIN_SCIENTIFIC_VALUE
    return f"{value:.3g}" if is_rounded else f"{value:.0f}"


def _list_numbers(numbers: Sequence[int]) -> str:
    """Return numbers of checks as text; three or more consecutive ones as a range, such as `(1) to (3), (5)`."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(
        f"({run[0]}) to ({run[-1]})" if len(run) > 2 else ", ".join(f"({number})" for number in run) for run in runs
    )


class Evaluation(NamedTuple):
    """Evaluation of a claim with the samples of its experiment.

    Attributes:
        checks: checks that must all agree; empty if only a caption is published.
        explanation: measured reason for a difference, or the conditions of the agreement.
        note: further simulated values, which do not affect the verdict.
        unavailable: reason why the claim cannot be evaluated; empty if it can.
    """

    checks: tuple[Check, ...] = ()
    explanation: str = ""
    note: str = ""
    unavailable: str = ""

    @property
    def verdict(self) -> Verdict:
        """Verdict: `differs` if one check differs, `agrees` if all agree, else `undecided`.

        The verdict is `cannot be computed` if `unavailable` gives a reason for this, and `no verdict` if
        there are no checks.
        """
        if self.unavailable:
            return "cannot be computed"
        verdicts = {check.verdict for check in self.checks}
        if not verdicts:
            return "no verdict"
        if "differs" in verdicts:
            return "differs"
        return "agrees" if verdicts == {"agrees"} else "undecided"


class Comparison(NamedTuple):
    """A row of the result table: published result, simulated result and verdict.

    Attributes:
        name: short name, such as `straight line up`.
        item: table, figure, equation or section of the document, with its page.
        published: sentence or values of the document.
        kind: see `Kind`.
        evaluation: evaluation of the claim.
        panels: curves to draw.
        marginals: posterior to draw.
    """

    name: str
    item: str
    published: str
    kind: Kind
    evaluation: Evaluation
    panels: tuple[Panel, ...] = ()
    marginals: Marginals | None = None

    @property
    def verdict(self) -> Verdict:
        """Verdict of the evaluation; `no verdict` if there are no checks because only a caption is published."""
        return self.evaluation.verdict

    @property
    def simulated(self) -> str:
        """Simulated values with their 95 % intervals, followed by the note of the evaluation, as text."""
        parts = [check.describe() for check in self.evaluation.checks]
        return "; ".join([*parts, *([self.evaluation.note] if self.evaluation.note else [])])

    @property
    def criterion(self) -> str:
        """Accepted ranges of all checks with their reasons, as text."""
        return "; ".join(check.describe_range() for check in self.evaluation.checks)

    @property
    def explanation(self) -> str:
        """Reason why the claim cannot be evaluated, or else the explanation of the evaluation.

        The latter is the measured reason for a difference, or the conditions of the agreement.
        """
        return self.evaluation.unavailable or self.evaluation.explanation

    def format_simulated_cell(self) -> str:
        """Return the simulated values as a cell of a Markdown table, with one numbered line per check."""
        checks = self.evaluation.checks
        lines = [
            f"({number}) {check.describe()}" if len(checks) > 1 else check.describe()
            for number, check in enumerate(checks, 1)
        ]
        if self.evaluation.note:
            lines.append(f"In addition: {self.evaluation.note}" if lines else self.evaluation.note)
        return "<br>".join(lines)

    def format_criterion_cell(self, only_ranges: bool = False) -> str:
        """Return the accepted ranges and the explanation as a cell of a Markdown table.

        The numbers are those of `format_simulated_cell`. Checks with the same range share a line. With
        `only_ranges`, the sources of the ranges and the explanation are omitted.
        """
        if self.evaluation.unavailable:
            return self.evaluation.unavailable
        checks = self.evaluation.checks
        shared: dict[tuple[str, str], list[int]] = {}
        for number, check in enumerate(checks, 1):
            shared.setdefault((check.format_range(), "" if only_ranges else check.reason), []).append(number)
        lines = [
            (f"{_list_numbers(numbers)}: " if len(checks) > 1 else "") + words + (f" ({reason})" if reason else "")
            for (words, reason), numbers in shared.items()
        ]
        found = {verdict: [number for number, check in enumerate(checks, 1) if check.verdict == verdict]
                 for verdict in ("differs", "undecided")}  # fmt: skip
        if len(checks) > 1 and self.verdict in found:
            lines.append(". ".join(f"{label}: {_list_numbers(numbers)}" for label, numbers in zip(
                ("Outside", "Partly outside"), found.values(), strict=True) if numbers))  # fmt: skip
        if self.evaluation.explanation and not only_ranges:
            lines.append(f"{'Reason' if self.verdict in found else 'Note'}: {self.evaluation.explanation}")
        return "<br>".join(lines)

    def row(self) -> dict[str, Any]:
        """Return the row of the result table as a dictionary, as printed with `--json`, without curves."""
        checks = [
            check._asdict() | {"verdict": check.verdict} for check in self.evaluation.checks
        ]  # fmt: skip
        return {
            "name": self.name, "item": self.item, "kind": self.kind, "published": self.published,
            "simulated": self.simulated, "verdict": self.verdict, "criterion": self.criterion,
            "explanation": self.explanation, "checks": checks,
        }  # fmt: skip


Changes = Mapping[str, Any]
"""Changes of an experiment's settings: setting or scenario key -> value."""


def merge_settings(defaults: Mapping[str, Any], changes: Changes) -> dict[str, Any]:
    """Return the default settings of an experiment, with the values of `changes` in place of the defaults.

    Raises:
        InputError: a changed key is not a setting.
    """
    if unknown := [name for name in changes if name not in defaults]:
        raise InputError(f"setting {unknown[0]}", f"is unknown; valid: {', '.join(defaults) or 'none'}")
    return {**defaults, **changes}


class Sample(NamedTuple):
    """Measurements of one repetition of an experiment.

    Attributes:
        values: name -> scalar result, in SI units unless its name states otherwise.
        panels: curves of the repetition.
        arrays: name -> array result.
        marginals: posterior samples of the repetition.
    """

    values: Mapping[str, float]
    panels: tuple[Panel, ...] = ()
    arrays: Mapping[str, np.ndarray] = {}
    marginals: Marginals | None = None


@dataclass(frozen=True)
class Claim:
    """A statement of a document and the function that evaluates it.

    Attributes:
        name: short name, unique in its series.
        quote: statement of the document, verbatim if in quotation marks; for an additional claim,
            the statement of this project.
        item: table, figure, equation or section, with its page.
        kind: see `Kind`.
        evaluate: samples of all repetitions -> evaluation.
        fault: fault (changed settings) for which the verdict must be `differs`; None if the claim
            has no verdict.
        fault_description: description of the fault.
        panel_labels: labels of the sample's panels to draw; None for all.
    """

    name: str
    quote: str
    item: str
    kind: Kind
    evaluate: Callable[[Sequence[Sample]], Evaluation]
    fault: Changes | None = None
    fault_description: str = ""
    panel_labels: tuple[str, ...] | None = None

    def compare(self, samples: Sequence[Sample]) -> Comparison:
        """Evaluate the claim with at least one sample, and return its row of the result table.

        The first sample provides the curves: the panels that `panel_labels` names, or all.
        """
        panels = tuple(panel for panel in samples[0].panels
                       if self.panel_labels is None or panel.label in self.panel_labels)  # fmt: skip
        return Comparison(
            self.name, self.item, self.quote, self.kind, self.evaluate(samples), panels,
            samples[0].marginals if self.panel_labels is None else None,
        )  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """A repeated simulation and the claims that are evaluated with its samples.

    Attributes:
        name: short name.
        measure: (seed, changes of the experiment's settings) -> sample. Seeds count repetitions from 1.
        claims: claims evaluated with the samples.
        max_repetitions: upper limit of the number of repetitions, which bounds the run time.
        fixed_repetitions: fixed number of repetitions: 1 if nothing is random, or the number of
            conditions; 0 if the number is not fixed.
    """

    name: str
    measure: Callable[[int, Changes], Sample]
    claims: tuple[Claim, ...] = field(default=())
    max_repetitions: int = 1000
    fixed_repetitions: int = 0

    def repetitions(self, requested: int) -> int:
        """Return the number of repetitions: the fixed number if there is one, else the requested one.

        The requested number is limited to `max_repetitions`.
        """
        return self.fixed_repetitions or min(requested, self.max_repetitions)


@dataclass(frozen=True)
class Series:
    """A document with its experiments, tables and figures.

    Attributes:
        name: short name, such as `zhu1994`.
        title: author, title, year.
        repetitions: default number of repetitions.
        experiments: experiments in the order of the document.
        unavailable: rows that cannot be computed, each with the reason.
        items_without_result: table or figure without a result -> its content, such as `photograph`.
    """

    name: str
    title: str
    repetitions: int
    experiments: tuple[Experiment, ...]
    unavailable: tuple[Comparison, ...] = ()
    items_without_result: Mapping[str, str] = field(default_factory=dict)

    @property
    def claims(self) -> dict[str, Claim]:
        """All claims of the document's experiments, by name."""
        return {claim.name: claim for one in self.experiments for claim in one.claims}


Progress = Callable[[str, float], None]
"""Called with the name of the finished task and the finished fraction."""

FAULT_REPETITIONS = 6
"""Repetitions with a fault: the smallest n for which 0 of n successes gives a 95 % interval of the
fraction below one half."""


def run_series(
    series: Series, seeds: int, jobs: int | None = None, progress: Progress | None = None
) -> list[Comparison]:
    """Run all experiments of a document and return the rows of its result table.

    Args:
        series: document.
        seeds: requested number of repetitions of every experiment; some have a fixed number or a limit.
        jobs: number of processes; the number of cores by default.
        progress: called after every repetition.

    Returns:
        The rows, in the order of the document.
    """
    return compare_by_repetition_count(series, (seeds,), jobs, progress)[seeds]


def compare_by_repetition_count(
    series: Series, counts: Sequence[int], jobs: int | None = None,
    progress: Progress | None = None,
) -> dict[int, list[Comparison]]:  # fmt: skip
    """Compare a document with its simulation for several numbers of repetitions.

    The experiments run once, with the largest number of repetitions. The comparison for a smaller number
    uses the samples of the first seeds.

    Args:
        series: document.
        counts: numbers of repetitions.
        jobs: number of processes; the number of cores by default.
        progress: called after every repetition.

    Returns:
        Number of repetitions -> rows of the result table.
    """
    planned = [(one, {}, one.repetitions(max(counts))) for one in series.experiments]
    measured = run_experiments(planned, jobs, progress)
    return {
        count: [
            claim.compare(samples[: one.repetitions(count)])
            for one, samples in zip(series.experiments, measured, strict=True)
            for claim in one.claims
        ] + list(series.unavailable)
        for count in counts
    }  # fmt: skip


def run_with_faults(
    series: Series, names: Sequence[str] = (), jobs: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[Claim, Comparison]]:  # fmt: skip
    """Evaluate claims in runs with a deliberate fault, to show that the criterion can fail.

    Args:
        series: document.
        names: names of the claims; by default all claims with a fault.
        jobs: number of processes; the number of cores by default.
        progress: called after every repetition.

    Returns:
        (claim, its row of the result table with the fault) for each claim; the verdict should be `differs`.
    """
    chosen = [(one, claim) for one in series.experiments for claim in one.claims
              if claim.fault is not None and (not names or claim.name in names)]  # fmt: skip
    planned = [(one, claim.fault or {}, one.repetitions(FAULT_REPETITIONS))
               for one, claim in chosen]  # fmt: skip
    measured = run_experiments(planned, jobs, progress)
    return [(claim, claim.compare(samples))
            for (_, claim), samples in zip(chosen, measured, strict=True)]  # fmt: skip


def run_experiments(
    planned: Sequence[tuple[Experiment, Changes, int]],
    jobs: int | None = None,
    progress: Progress | None = None,
) -> list[list[Sample]]:
    """Run experiments in several processes and return their samples.

    Args:
        planned: experiments to run, each as (experiment, changes of its settings, number of repetitions).
        jobs: number of processes; the number of cores by default.
        progress: called after every repetition.

    Returns:
        For each experiment, one sample per repetition.
    """
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        (one.measure, (seed, dict(changes))) for one, changes, count in planned for seed in range(1, count + 1)
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


def run_tasks(tasks: Sequence[tuple[Callable[..., Any], tuple]], jobs: int | None = None) -> Iterator[Any]:
    """Run functions in several processes and yield their results in the order of the tasks.

    Args:
        tasks: functions, each with the tuple of its arguments.
        jobs: number of processes; the number of cores by default. With 1, no process is started.

    Yields:
        The result of each function.
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


def summarize_verdicts(rows: Sequence[Comparison]) -> str:
    """Return a sentence that counts the verdicts of the published and the additional claims.

    >>> row = Comparison("a", "p. 1", "", "document", Evaluation(unavailable="no text"))
    >>> summarize_verdicts([row])
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
        text += (
            f"; of {len(additional)} statements that are not in the publication {additional.count('agrees')} agree,"
            f" {additional.count('differs')} differ, {additional.count('undecided')} undecided"
        )
    return text

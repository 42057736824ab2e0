"""What differs between runs: parameters with another value in every run.

Friction follows the oil temperature, a sensor is zeroed every morning, a bucket is loaded in one run. Every parameter
with a slope may differ: its value in run r is `mean + u_r`, and `u_r ~ N(0, s^2)`. The standard deviation s between
runs is estimated by the evidence, as the noise levels are; s = 0 is the model without differences. In the dictionary
such a parameter is a group with one column per run. Source: Laird and Ware 1982, Biometrics 38(4) (random effects);
Tipping 2001, J. Mach. Learn. Res. 1 (a scale per group, most of which are 0).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import t as student_t

from hydrotele.effects import EFFECTS, Parameter
from hydrotele.estimate.evidence import Fit, Judged, invert_information
from hydrotele.estimate.hypothesis import BETWEEN_RUNS, CALIBRATION, Guess, Hypothesis, calibration, numbers
from hydrotele.gap.dictionary import AMPLITUDES, Version
from hydrotele.gap.regression import NormalEquations, compare_groups, split_columns
from hydrotele.gap.result import SURE, RunDifference
from hydrotele.logs.dataset import RunData
from hydrotele.machine.machine import Machine

NUISANCE = (CALIBRATION, BETWEEN_RUNS)
"""Hypotheses that are no effects to be named."""
_NORMAL95 = 1.96  # half-width of a 95 % interval in standard deviations
_EM_ROUNDS = 50  # of the scale between runs; each costs microseconds


@dataclass(frozen=True)
class Quantity:
    """A parameter of a machine that may differ between runs.

    Attributes:
        key: effect, location and parameter, or the name of an uncertain parameter, such as `mass.boom`.
        parameter: its value in the given machine, bounds and prior.
        shift: machine with the parameter increased by an amount [SI].
    """

    key: str
    parameter: Parameter
    shift: Callable[[Machine, float], Machine]


def list_quantities(machine: Machine, candidates: Sequence[Hypothesis]) -> dict[str, Quantity]:
    """Return the parameters that may differ: the uncertain ones, and those of effects with one parameter.

    Effects that state start values (delays, elasticities) have no slope and are left out.

    Args:
        machine: the given machine.
        candidates: effects.
    """
    found = {}
    for key, number in numbers(machine).items():
        shift = partial(_shift_effect, *number.effect) if number.effect else partial(_shift_number, key)
        found[key] = Quantity(key, number.parameter, shift)
    for h in candidates:
        if h.size == 1 and h.change is None and not any(map(np.any, h.starts)):
            ((name, parameter),) = h.parameters.items()
            key = f"{h.name}.{h.location}.{name}"
            found.setdefault(key, Quantity(key, parameter, partial(_shift_effect, h.name, h.location, name)))
    return found


def _shift_effect(name: str, location: str, key: str, machine: Machine, amount: float) -> Machine:
    values = {k: p.nominal for k, p in EFFECTS[name].parameters(machine, location).items()}
    return EFFECTS[name].apply(machine, location, {**values, key: values[key] + amount})


def _shift_number(key: str, machine: Machine, amount: float) -> Machine:
    number = numbers(machine)[key]
    return number.change(machine, number.parameter.nominal + amount)


def effect_of(key: str) -> tuple[str, str]:
    """Return name and location of the effect of a quantity.

    >>> effect_of("pressure_offset.boom.head.offset")
    ('pressure_offset', 'boom.head')
    """
    name, _, rest = key.partition(".")
    return name, rest.rpartition(".")[0]


def between_runs(quantity: Quantity, runs: Sequence[str], scale: float) -> Hypothesis:
    """Return the hypothesis that a parameter differs between runs.

    Args:
        quantity: the parameter.
        runs: names of all runs, the held-out one included.
        scale: standard deviation between runs, relative to the parameter's prior standard deviation.

    Returns:
        A hypothesis with one parameter per run: its difference from the common value.
    """
    p = quantity.parameter
    own = Parameter(
        p.unit, 0.0, p.lower_bound - p.nominal, p.upper_bound - p.nominal, scale * p.prior_std,
        p.min_relevant_change,
    )  # fmt: skip

    def change(machine: Machine, values: Mapping[str, float]) -> Machine:
        (amount,) = values.values()
        return quantity.shift(machine, amount)

    return Hypothesis(BETWEEN_RUNS, quantity.key, dict.fromkeys(runs, own), change, runs=tuple(runs))


def has_common_value(values: np.ndarray) -> bool:
    """Return whether the mean of the values of runs (n,) differs from 0, by Student's test at the level `SURE`."""
    if len(values) < 2:
        return False
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return abs(float(np.mean(values))) > error * float(student_t.ppf(0.5 + 0.5 * SURE, len(values) - 1))


def common_value(
    effect: Hypothesis, differing: Hypothesis, deviation: np.ndarray
) -> tuple[tuple[Hypothesis, np.ndarray], tuple[Hypothesis, np.ndarray]]:
    """Split the values of a parameter that differs between runs into their mean and the differences from it.

    Args:
        effect: changes the same parameter in all runs.
        differing: the hypothesis of `between_runs`.
        deviation: (p,) of its runs, the held-out one last.

    Returns:
        The effect, and the differing parameter, each with its deviation.
    """
    (own,) = effect.parameters.values()
    mean = float(np.mean(deviation[:-1]))
    start = np.clip(
        [mean * next(iter(differing.parameters.values())).prior_std / own.prior_std], effect.low, effect.high
    )
    moved = np.append(deviation[:-1] - mean, deviation[-1])
    return (effect, start), (differing, np.clip(moved, differing.low, differing.high))


# -- linear step ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """Where a dictionary holds the column of a quantity.

    Attributes:
        quantity: the parameter.
        index: of the version, or of the nuisance column.
        is_nuisance: which of both.
        ratio: the quantity's prior standard deviation over that of the column.
    """

    quantity: Quantity
    index: int
    is_nuisance: bool
    ratio: float


def find_columns(
    parameters: Sequence[tuple[str, float]], versions: Sequence[Version], quantities: Mapping[str, Quantity]
) -> list[Column]:
    """Find the columns of the quantities that do not differ between runs yet, at small amplitudes.

    Args:
        parameters: name and prior standard deviation [SI] of each nuisance column.
        versions: of effects.
        quantities: parameters that may differ.
    """
    taken = {name.partition(".")[2] for name, _ in parameters if name.startswith(f"{BETWEEN_RUNS}.")}
    found: dict[str, Column] = {}
    for index, (name, std) in enumerate(parameters):
        key = name.removeprefix(f"{CALIBRATION}.all.")
        if key in quantities:
            found[key] = Column(quantities[key], index, True, quantities[key].parameter.prior_std / std)
    for index, version in enumerate(versions):
        h = version.hypothesis
        if h.size != 1 or h.runs or abs(version.steps[0, 0]) > AMPLITUDES[0]:
            continue
        ((name, parameter),) = h.parameters.items()
        key = f"{h.name}.{h.location}.{name}"
        if key in quantities and key not in found:
            ratio = quantities[key].parameter.prior_std / parameter.prior_std
            sign = math.copysign(1.0, version.steps[0, 0])
            found[key] = Column(quantities[key], index, False, sign * ratio)
    return [c for key, c in found.items() if not any(t.startswith(f"{key}.") for t in taken)]


def compare_between_runs(
    by_run: Sequence[NormalEquations], columns: Sequence[Column], scales: np.ndarray, sizes: Sequence[float]
) -> Iterator[tuple[Column, float, float, np.ndarray]]:
    """Compare each quantity that differs between runs with one that does not.

    Args:
        by_run: the products of R runs.
        columns: of the quantities.
        scales: (K,) prior standard deviations of the nuisance parameters.
        sizes: standard deviations between runs that are tried, in prior standard deviations.

    Yields:
        Quantity's column, the best size, twice its log Bayes factor, and the posterior means (R,) over that size.
    """
    if not columns:
        return
    columns = sorted(columns, key=lambda c: c.is_nuisance)
    single = [c.index for c in columns if not c.is_nuisance]
    terms = split_columns(by_run, single, [c.index for c in columns if c.is_nuisance])
    marginal = terms.marginalise(scales)
    best: list[tuple[float, float, np.ndarray]] = [(-np.inf, 0.0, np.zeros(0))] * len(columns)
    for size in sizes:
        ratios = np.array([size * c.ratio for c in columns])
        right = marginal.right * np.repeat(ratios, len(by_run))
        blocks = [ratio**2 * block for ratio, block in zip(ratios, marginal.blocks, strict=True)]
        factors, means = compare_groups(terms.edges, right, blocks)
        best = [
            max(old, (float(factor), size, mean), key=lambda found: found[0])
            for old, factor, mean in zip(best, factors, means, strict=True)
        ]
    for column, (factor, size, mean) in zip(columns, best, strict=True):
        yield column, size, factor, mean


# -- scale between runs -----------------------------------------------------------------------------------------------


def rescale_between_runs(judged: Judged, fit: Fit, runs: Sequence[RunData]) -> tuple[Judged, Fit]:
    """Re-estimate the standard deviations between runs; the values of the parameters stay.

    The expectation-maximisation step s^2 = mean of (u_r^2 + variance of u_r) over the fitted runs is repeated with the
    information of the fit.

    Args:
        judged: the model.
        fit: of it.
        runs: the fitted runs.

    Returns:
        The same with other prior standard deviations.
    """
    guess, names = fit.guess, [run.name for run in runs]
    if judged.guess is not guess and len(judged.guess.deviation) == len(guess.deviation):
        guess = judged.guess
    groups, first = [], 0
    for index, (h, _) in enumerate(guess.parts):
        if h.name == BETWEEN_RUNS:
            own = [first + k for k, run in enumerate(h.parameters) if run in names]
            if len(own) > 1:  # a scatter needs two runs
                groups.append((index, own, first, h.size))
        first += h.size
    if not groups:
        return judged, fit
    information = fit.information - np.eye(len(fit.information))
    ratios = np.ones(len(information))
    values = guess.deviation
    for _ in range(_EM_ROUNDS):
        scaled = information * np.outer(ratios, ratios) + np.eye(len(ratios))
        variances = np.diag(invert_information(scaled)) * ratios**2
        for _, own, start, size in groups:
            ratios[start : start + size] = math.sqrt(np.mean(values[own] ** 2 + variances[own]))
    parts = list(guess.parts)
    for index, _, start, _ in groups:
        h, deviation = parts[index]
        ratio = float(ratios[start])
        parameters = {run: replace(p, prior_std=ratio * p.prior_std) for run, p in h.parameters.items()}
        parts[index] = replace(h, parameters=parameters), deviation / ratio
    moved = Guess(tuple(parts))
    information = information * np.outer(ratios, ratios) + np.eye(len(ratios))
    change = moved.prior - guess.prior
    return (
        replace(judged, guess=moved, loss=judged.loss + change),
        replace(fit, guess=moved, loss=fit.loss + change, information=information),
    )


# -- result -----------------------------------------------------------------------------------------------------------


def between_run_differences(guess: Guess, covariance: np.ndarray, heldout: Mapping[str, float]) -> list[RunDifference]:
    """Return the parameters of a model that differ between runs.

    A new run's difference follows Student's distribution with as many degrees of freedom as there are fitted runs,
    for the standard deviation is known from these only.

    Args:
        guess: the model.
        covariance: (P, P) of its normalised deviations, from the fitted runs.
        heldout: parameter -> standard deviation of the held-out run's normalised deviation.
    """
    found, first = [], 0
    variances = np.diag(covariance)
    for h, deviation in guess.parts:
        own = variances[first : first + h.size]
        first += h.size
        if h.name != BETWEEN_RUNS:
            continue
        p, last = next(iter(h.parameters.values())), h.size - 1  # the held-out run is the last one
        spread = np.append(np.sqrt(own[:last]), heldout.get(h.location, 1.0))
        table = {
            run: (float(d * p.prior_std), float(sd * p.prior_std))
            for run, d, sd in zip(h.parameters, deviation, spread, strict=True)
        }
        reach = p.prior_std * float(student_t.ppf(0.975, last))
        found.append(RunDifference(h.location, p.unit, p.prior_std, table, reach))
    return found


def difference_in_run(h: Hypothesis, deviation: np.ndarray, spread: np.ndarray, run: str) -> RunDifference:
    """Return what a run has in addition to the model of the others.

    Args:
        h: what it has.
        deviation: (p,) of its parameters.
        spread: (p,) standard deviations.
        run: its name.
    """
    values = h.values(deviation)
    sizes = [k for k, key in enumerate(h.parameters) if key in ("size", run) or key.endswith(("cosine", "sine"))]
    table = list(h.parameters.values())
    size = values[list(values)[sizes[0]]] if len(sizes) == 1 else math.hypot(*(list(values.values())[k] for k in sizes))
    width = max(spread[k] * table[k].prior_std for k in sizes)
    others = [
        f"{key} {values[key]:.4g} {p.unit}" for key, p in h.parameters.items() if key in ("start", "duration", "period")
    ]
    axis = h.location.removesuffix(f".{run}")
    name = h.location if h.name == BETWEEN_RUNS else f"{h.name}.{axis}"
    return RunDifference(name, table[sizes[0]].unit, math.nan, {run: (size, width)}, details=", ".join(others))


def difference_words(d: RunDifference) -> str:
    """Describe a difference in one sentence.

    >>> difference_words(RunDifference("mass.boom", "kg", math.nan, {"test": (12.0, 1.5)}))
    'Run test differs from the fitted runs: mass.boom 12 +- 1.5 kg.'
    """
    if math.isnan(d.deviation):
        ((run, (size, width)),) = d.runs.items()
        more = f", {d.details}" if d.details else ""
        return f"Run {run} differs from the fitted runs: {d.name} {size:.4g} +- {width:.2g} {d.unit}{more}."
    each = ", ".join(f"{run} {size:+.3g} +- {width:.2g}" for run, (size, width) in d.runs.items())
    return (
        f"{d.name} differs between the runs by a standard deviation of {d.deviation:.3g} {d.unit} ({each})."
        f" For a new run its 95 % interval is the common value +- {d.reach:.3g} {d.unit}."
    )


def widen_to_new_run(
    guess: Guess, covariance: np.ndarray, machine: Machine, quantities: Mapping[str, Quantity]
) -> list[tuple[Guess, np.ndarray]]:
    """Add the scatter between runs to the covariance of a fit, so that it holds for a new run.

    Args:
        guess: the model.
        covariance: (P, P) of its normalised deviations.
        machine: the given machine.
        quantities: parameters that may differ.

    Returns:
        Independent fits with their covariances: parameters that have only a scatter, and the model.
    """
    widened, group, names = covariance.copy(), calibration(machine), guess.names
    sizes = [p.prior_std for h in guess.hypotheses for p in h.parameters.values()]
    extra: list[tuple[Guess, np.ndarray]] = []
    scattered: list[tuple[str, float]] = []
    for difference in between_run_differences(guess, covariance, {}):
        key, std = difference.name, difference.reach / _NORMAL95
        own = next((k for k, n in enumerate(names) if n in (key, f"{CALIBRATION}.all.{key}")), None)
        if own is not None:
            widened[own, own] += (std / sizes[own]) ** 2
        elif key in group.parameters:
            scattered.append((key, std))
        else:
            name, location = effect_of(key)
            p = quantities[key].parameter
            part = Hypothesis(name, location, {key.rpartition(".")[2]: p}), np.zeros(1)
            extra.append((Guess((part,)), np.array([[(std / p.prior_std) ** 2]])))
    if scattered:
        part = replace(group, parameters={key: group.parameters[key] for key, _ in scattered}), np.zeros(len(scattered))
        scatter = [(std / group.parameters[key].prior_std) ** 2 for key, std in scattered]
        extra.append((Guess((part,)), np.diag(scatter)))
    return [*extra, (guess, widened)]

"""Build checks from repeated simulations: estimates with 95 % confidence intervals."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hydrotele.experiments.comparison import Check, Sample

CONFIDENCE = 0.95
"""Confidence level of all intervals."""

MAJORITY_RANGE = (0.5, 1.0)
"""Accepted fraction of the operators.

The publication had one operator; its statement agrees if it holds for more than half of a
population of simulated operators.
"""

_NORMAL_QUANTILE = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))


def collect_values(samples: Sequence[Sample], name: str) -> np.ndarray:
    """Return the (n,) values of the scalar result `name`, one per sample."""
    return np.array([sample.values[name] for sample in samples])


def check_deterministic_value(
    quantity: str, value: float, accepted: tuple[float, float], reason: str, **more: Any
) -> Check:
    """Return a check of a quantity without random error, whose confidence interval is only its value.

    `accepted` is the lowest and the highest value that agree, `reason` the source of this range. `more`
    holds `unit` and `published` of `Check`.
    """
    return Check(quantity, float(value), float(value), float(value), accepted, reason, **more)


def check_mean(quantity: str, values: np.ndarray, accepted: tuple[float, float], reason: str, **more: Any) -> Check:
    """Return a check of the mean over repetitions, with Student's 95 % confidence interval.

    Args:
        quantity: name of the quantity.
        values: (n,) one value per repetition; with n = 1 the interval is unbounded.
        accepted: lowest and highest value that agree.
        reason: source of the accepted range.
        **more: `unit` and `published` of `Check`.

    Returns:
        The check.
    """
    values = np.asarray(values, float)
    mean, half = float(np.mean(values)), np.inf
    if len(values) > 1:
        scale = float(np.std(values, ddof=1) / np.sqrt(len(values)))
        half = scale * float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(values) - 1))
    return Check(quantity, mean, mean - half, mean + half, accepted, reason, **more)


def check_fraction(
    quantity: str, successes: Sequence[bool] | np.ndarray,
    accepted: tuple[float, float] = MAJORITY_RANGE,
    reason: str = "more than half of the operators; the publication had one", **more: Any,
) -> Check:  # fmt: skip
    """Return a check of the fraction of repetitions that fulfil a condition.

    Args:
        quantity: name of the fraction, such as `operators who ...`.
        successes: (n,) whether each repetition fulfils the condition.
        accepted: lowest and highest fraction that agree.
        reason: source of the accepted range.
        **more: `unit` and `published` of `Check`.

    Returns:
        The check, with the 95 % Clopper-Pearson interval of the fraction.
    """
    holds = np.asarray(successes, bool)
    found = stats.binomtest(int(holds.sum()), len(holds)).proportion_ci(CONFIDENCE, "exact")
    return Check(quantity, float(holds.mean()), float(found.low), float(found.high), accepted,
                 reason, **more)  # fmt: skip


def check_bootstrapped_statistic(
    quantity: str, values: np.ndarray, statistic: Callable[[np.ndarray], float],
    accepted: tuple[float, float], reason: str, **more: Any,
) -> Check:  # fmt: skip
    """Return a check of any statistic over repetitions, such as a ratio of two RMS values.

    Args:
        quantity: name of the statistic.
        values: (n, ...) one row per repetition; rows are resampled as a whole.
        statistic: (k, ...) rows -> value of the statistic.
        accepted: lowest and highest value that agree.
        reason: source of the accepted range.
        **more: `unit` and `published` of `Check`.

    Returns:
        The check, with the 95 % percentile interval of 2000 bootstrap resamples of the repetitions;
        with n = 1 the interval is unbounded.
    """
    values = np.asarray(values, float)
    value, low, high = float(statistic(values)), -np.inf, np.inf
    if len(values) > 1:
        rng = np.random.default_rng(0)
        rows = rng.integers(len(values), size=(2000, len(values)))
        found = [statistic(values[row]) for row in rows]
        low, high = np.nanpercentile(found, [50 - 50 * CONFIDENCE, 50 + 50 * CONFIDENCE])
    return Check(quantity, value, float(low), float(high), accepted, reason, **more)


def check_published_in_population(
    quantity: str, values: np.ndarray, published: float, unit: str = "", log: bool = True
) -> Check:
    """Return a check whether a published value lies in the central 95 % of the repetitions.

    The checked quantity is the distance d of the published value from the mean of the repetitions,
    in standard deviations of the repetitions. It agrees within 1.96. The standard error of d is
    sqrt(1/n + d^2 / (2 n)).

    Args:
        quantity: name of the published value.
        values: (n,) values of the simulated repetitions, n > 2.
        published: published value of a single experiment.
        unit: unit of the values, for the text.
        log: whether logarithms of values and published value are compared, which suits positive values.

    Returns:
        The check of d.
    """
    values = np.asarray(values, float)
    scaled, goal = (np.log(values), np.log(published)) if log else (values, published)
    n = len(values)
    spread = float(np.std(scaled, ddof=1)) if n > 1 else np.nan
    distance = float((goal - np.mean(scaled)) / spread) if n > 1 and spread else np.nan
    half = _NORMAL_QUANTILE * np.sqrt(1.0 / n + distance**2 / (2.0 * n))
    typical = float(np.exp(np.mean(scaled)) if log else np.mean(values))
    unit = f" {unit}" if unit else ""
    return Check(
        f"{quantity}: published {published:.3g}{unit}, mean of the repetitions {typical:.3g}{unit}; distance",
        distance, distance - half, distance + half, (-_NORMAL_QUANTILE, _NORMAL_QUANTILE),
        "the central 95 % of the repetitions", "standard deviations",
    )  # fmt: skip


def format_values(samples: Sequence[Sample], name: str, scale: float = 1.0, digits: int = 1) -> str:
    """Format the mean, minimum and maximum of a named result over the samples.

    Args:
        samples: at least one sample.
        name: name of the result.
        scale: factor applied to the values.
        digits: number of decimal places.

    Returns:
        Text such as `2.1 (1.5 to 4.7)`; only the value if there is one sample.
    """
    values = scale * collect_values(samples, name)
    mean = f"{np.mean(values):.{digits}f}"
    if len(values) == 1:
        return mean
    return f"{mean} ({values.min():.{digits}f} to {values.max():.{digits}f})"

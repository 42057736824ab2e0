"""Checks of a simulated quantity over repetitions: its estimate with a 95 % confidence interval."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hydrotele.experiments.comparison import Check, Sample

CONFIDENCE = 0.95
"""Of all intervals."""

MAJORITY = (0.5, 1.0)
"""Accepted fraction of the operators: the publication had one, so that a statement agrees if it
holds for more than half of a population of operators."""

_NORMAL = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))


def collect(samples: Sequence[Sample], name: str) -> np.ndarray:
    """(n,) of a figure over the samples."""
    return np.array([sample.values[name] for sample in samples])


def check_exact(
    quantity: str, value: float, accepted: tuple[float, float], reason: str, **more: Any
) -> Check:
    """Check of a quantity in which nothing is random."""
    return Check(quantity, float(value), float(value), float(value), accepted, reason, **more)


def check_mean(
    quantity: str, values: np.ndarray, accepted: tuple[float, float], reason: str, **more: Any
) -> Check:
    """Check of a mean over repetitions.

    Args:
        quantity: its name.
        values: (n,) one per repetition; with n = 1 the interval is unbounded.
        accepted: lowest and highest value that agree.
        reason: where the accepted range comes from.
        **more: `unit`, `published`.

    Returns:
        The check, with Student's interval of the mean.
    """
    values = np.asarray(values, float)
    mean, half = float(np.mean(values)), np.inf
    if len(values) > 1:
        scale = float(np.std(values, ddof=1) / np.sqrt(len(values)))
        half = scale * float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(values) - 1))
    return Check(quantity, mean, mean - half, mean + half, accepted, reason, **more)


def check_fraction(
    quantity: str, successes: Sequence[bool] | np.ndarray,
    accepted: tuple[float, float] = MAJORITY,
    reason: str = "more than half of the operators; the publication had one", **more: Any,
) -> Check:  # fmt: skip
    """Check of the fraction of repetitions in which something holds.

    Args:
        quantity: what holds, such as `operators who ...`.
        successes: (n,) whether it holds.
        accepted: lowest and highest fraction that agree.
        reason: where the accepted range comes from.
        **more: `unit`, `published`.

    Returns:
        The check, with the interval of Clopper and Pearson.
    """
    holds = np.asarray(successes, bool)
    found = stats.binomtest(int(holds.sum()), len(holds)).proportion_ci(CONFIDENCE, "exact")
    return Check(quantity, float(holds.mean()), float(found.low), float(found.high), accepted,
                 reason, **more)  # fmt: skip


def check_statistic(
    quantity: str, values: np.ndarray, statistic: Callable[[np.ndarray], float],
    accepted: tuple[float, float], reason: str, **more: Any,
) -> Check:  # fmt: skip
    """Check of any statistic of repetitions, such as a ratio of two RMS values.

    Args:
        quantity: its name.
        values: (n, ...) one row per repetition, so that what belongs together stays together.
        statistic: rows of repetitions -> number.
        accepted: lowest and highest value that agree.
        reason: where the accepted range comes from.
        **more: `unit`, `published`.

    Returns:
        The check; the interval is that of 2000 bootstrap resamples by percentiles, unbounded
        with n = 1.
    """
    values = np.asarray(values, float)
    value, low, high = float(statistic(values)), -np.inf, np.inf
    if len(values) > 1:
        rng = np.random.default_rng(0)
        rows = rng.integers(len(values), size=(2000, len(values)))
        found = [statistic(values[row]) for row in rows]
        low, high = np.nanpercentile(found, [50 - 50 * CONFIDENCE, 50 + 50 * CONFIDENCE])
    return Check(quantity, value, float(low), float(high), accepted, reason, **more)


def check_population(
    quantity: str, values: np.ndarray, published: float, unit: str = "", log: bool = True
) -> Check:
    """Check whether a published figure of one experiment is a plausible repetition of ours.

    Args:
        quantity: name of the published figure.
        values: (n,) of our repetitions, n > 2.
        published: the document's figure, of one experiment.
        unit: of the figures, for the text.
        log: whether sizes are compared on a logarithmic scale, which suits positive figures.

    Returns:
        The check of the distance of the published figure from our mean, in standard deviations of
        our repetitions; it agrees within 1.96, where 95 % of the repetitions lie. The standard
        error of the distance d is sqrt(1/n + d^2 / (2 n)).
    """
    values = np.asarray(values, float)
    scaled, goal = (np.log(values), np.log(published)) if log else (values, published)
    n = len(values)
    spread = float(np.std(scaled, ddof=1)) if n > 1 else np.nan
    distance = float((goal - np.mean(scaled)) / spread) if n > 1 and spread else np.nan
    half = _NORMAL * np.sqrt(1.0 / n + distance**2 / (2.0 * n))
    typical = float(np.exp(np.mean(scaled)) if log else np.mean(values))
    words = f"{quantity} {published:.3g} {unit}".strip()
    return Check(
        f"distance of the published {words} from ours (mean {typical:.3g}) in standard deviations",
        distance, distance - half, distance + half, (-_NORMAL, _NORMAL),
        "the central 95 % of our repetitions",
    )  # fmt: skip


def format_values(samples: Sequence[Sample], name: str, scale: float = 1.0, digits: int = 1) -> str:
    """Mean of a figure over the samples with its extremes, as text.

    Args:
        samples: at least one.
        name: of the figure.
        scale: by which it is multiplied.
        digits: after the point.

    Returns:
        Such as `2.1 (1.5 to 4.7)`; the figure alone where there is one sample.
    """
    values = scale * collect(samples, name)
    mean = f"{np.mean(values):.{digits}f}"
    if len(values) == 1:
        return mean
    return f"{mean} ({values.min():.{digits}f} to {values.max():.{digits}f})"

"""How strongly to hold parameters near their nominal values, from the measurements themselves.

Parameters of one kind (lengths, tilts, joint offsets ...) are errors of manufacture of one size.
That size and the noise are those that make the measurements most probable, so that no weight of a
regularisation has to be chosen; a kind that the measurements do not ask for gets the size zero.
Rival models are judged by predicting parts of the measurements that they were not fitted to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_SMALLEST = 1e-7  # of a size, over its start: a kind that is not there
_LARGEST = 1e3
_ROUNDING = 1e-14
_ROUNDS, _SETTLED = 200, 1e-4


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of kinds of parameters and of the noise.

    Attributes:
        std: (p,) of every parameter, by its kind.
        noise: standard deviation of an equation's error.
        effective: number of parameters that the equations decide.
        rounds: of the iteration.
    """

    std: np.ndarray
    noise: float
    effective: float
    rounds: int


def estimate_sizes(
    matrix: np.ndarray, rest: np.ndarray, kinds: Sequence[str], start: np.ndarray,
    freedom: float, noise: float, known: np.ndarray | None = None,
    known_rest: np.ndarray | None = None, finest: float = 0.0,
) -> Sizes:  # fmt: skip
    """Sizes of kinds of parameters by maximum evidence.

    For `rest = matrix x + error` with x ~ N(0, s_kind^2) the fixed point of
    `s^2 = sum x^2 / sum g`, `noise^2 = |error|^2 / (freedom - sum g)` with `g = 1 - S_ii / s^2`,
    the share of a parameter that the measurements decide, and S its covariance.

    Args:
        matrix: (m, p) equations with the unknown noise.
        rest: (m,) what they have to explain.
        kinds: (p,) name of every parameter's kind; "" for one whose size stays at the start.
        start: (p,) sizes to begin with.
        freedom: degrees of freedom of the m equations before parameters are fitted.
        noise: standard deviation to begin with.
        known: (r, p) equations whose error has the standard deviation 1, if there are any.
        known_rest: (r,) what these have to explain.
        finest: the least that the noise may be.

    Returns:
        The sizes.

    Source: MacKay 1992, Bayesian interpolation; Tipping 2001 (sizes that vanish).
    """
    normal, right = matrix.T @ matrix, matrix.T @ rest
    square = float(rest @ rest)
    extra, extra_right = np.zeros_like(normal), np.zeros_like(right)
    if known is not None and known_rest is not None:
        extra, extra_right = known.T @ known, known.T @ known_rest
    std = np.array(start, float)
    groups = {kind: np.flatnonzero([k == kind for k in kinds]) for kind in set(kinds) - {""}}
    decided = np.zeros(len(std))
    for rounds in range(1, _ROUNDS + 1):  # noqa: B007 - reported
        # In units of the sizes, so that a vanishing one does no harm.
        scaled = (normal / noise**2 + extra) * np.outer(std, std) + np.eye(len(std))
        inverse = np.linalg.inv(scaled)
        value = std * (inverse @ (std * (right / noise**2 + extra_right)))
        decided = 1.0 - np.diag(inverse)
        error = square - 2.0 * value @ right + value @ normal @ value
        error = max(error, _ROUNDING * square)  # a difference of squares
        before = np.append(std, noise)
        noise = max(float(np.sqrt(error / max(freedom - decided.sum(), 1.0))), finest)
        for places in groups.values():
            share = decided[places].sum()
            size = np.sqrt(np.sum(value[places] ** 2) / share) if share > 0.0 else 0.0
            first = start[places]
            std[places] = np.clip(size, _SMALLEST * first, _LARGEST * first)
        change = np.abs(np.log(np.append(std, noise) / before))
        there = np.append(std > 10.0 * _SMALLEST * start, True)
        if change[there].max() < _SETTLED:
            break
    return Sizes(std, noise, float(decided.sum()), rounds)


def prediction_error(
    matrix: np.ndarray, rest: np.ndarray, folds: np.ndarray, sizes: Sizes
) -> float:
    """RMS of equations predicted by fits that had not seen their part of the measurements.

    Args:
        matrix: (m, p) equations, linear in the parameters.
        rest: (m,) what they have to explain.
        folds: (m,) part that an equation belongs to.
        sizes: of parameters and noise, kept for all fits.

    Returns:
        The error, in the unit of the equations.

    >>> x = np.linspace(-1.0, 1.0, 40)
    >>> line = np.column_stack([np.ones(40), x])
    >>> sizes = Sizes(np.ones(2), 0.01, 2.0, 1)
    >>> prediction_error(line, 1.0 + 2.0 * x, np.arange(40) % 4, sizes) < 1e-4
    True
    """
    std = sizes.std / sizes.noise
    scaled = matrix * std
    normal, right = scaled.T @ scaled, scaled.T @ rest
    total = 0.0
    for fold in np.unique(folds):
        inside = folds == fold
        own, wanted = scaled[inside], rest[inside]
        left = normal - own.T @ own + np.eye(len(std))
        value = np.linalg.solve(left, right - own.T @ wanted)
        total += float(np.sum((wanted - own @ value) ** 2))
    return float(np.sqrt(total / len(rest)))

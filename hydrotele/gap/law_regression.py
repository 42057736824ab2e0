"""Regression of prediction errors on the products of a law, chosen by runs that are left out.

The errors are those of a track whose unknown inputs have taken up what they could; how they answer
to an addition is known to first order (`prediction.responses`). So a reading counts as it does in
the likelihood, and a law that is faster than the unknown inputs is seen as it is, not as a smoother
blurs it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.prediction.evidence import flat
from hydrotele.prediction.responses import error_responses
from hydrotele.prediction.track import Track

_PARTS = 4  # of a single run, left out one by one
_KEEP = 10.0  # fall of the loss that a further product must bring
_PRODUCTS = 8  # of a law, at most


class Regression(NamedTuple):
    """A law's products and coefficients.

    Attributes:
        predicted: fall of -2 log likelihood in runs that were left out, all together.
        chosen: the products that are worth it.
        scale: (K,) a large coefficient of each [unit of the addition per unit of the product].
        deviation: (K,) coefficients over scales.
        left: RMS of what the law does not take of the unknown input [unit of the addition].
    """

    predicted: float
    chosen: tuple[int, ...]
    scale: np.ndarray
    deviation: np.ndarray
    left: float


def regression(parts: Sequence[tuple[Track, np.ndarray, np.ndarray]], size: float) -> Regression:
    """Fit a law's coefficients to the errors of some tracks.

    Args:
        parts: per run the track, what a unit of the addition does (n, nz), the products (n, P).
        size: standard deviation of the unknown input in whose place the law is put.

    Returns:
        The regression.
    """
    products = np.concatenate([values for _, _, values in parts])
    scale = size / (np.sqrt((products**2).mean(axis=0)) + 1e-300)
    answers = []
    for track, column, values in parts:
        slope = error_responses(track, column, values * scale)
        there = slope.reshape(-1, slope.shape[2]), flat(track.whitened)
        cuts = 1 if len(parts) > 1 else _PARTS
        answers += zip(*(np.array_split(table, cuts) for table in there), strict=True)
    curvature = np.array([s.T @ s for s, _ in answers])
    slope = np.array([s.T @ e for s, e in answers])
    predicted = sum(_predicted(curvature, slope, out) for out in range(len(curvature)))
    curvature, slope = curvature.sum(axis=0), slope.sum(axis=0)
    chosen = _chosen(curvature, slope)
    if not chosen:
        return Regression(0.0, (), np.zeros(0), np.zeros(0), size)
    own = np.array(chosen)
    x = _solved(curvature[own[:, None], own], slope[own])
    taken = float(np.mean((products[:, own] @ (x * scale[own])) ** 2))
    left = float(np.sqrt(max(size**2 - taken, 0.0)))
    scale = scale[own] * np.maximum(1.0, 3.0 * np.abs(x))
    return Regression(predicted, chosen, scale, x / np.maximum(1.0, 3.0 * np.abs(x)), left)


def _predicted(curvature: np.ndarray, slope: np.ndarray, out: int) -> float:
    """Fall of the loss of a part that neither the choice of products nor their fit has seen."""
    others = curvature.sum(axis=0) - curvature[out], slope.sum(axis=0) - slope[out]
    chosen = _chosen(*others)
    if not chosen:
        return 0.0
    own = np.array(chosen)
    x = _solved(others[0][own[:, None], own], others[1][own])
    return -float(2.0 * slope[out, own] @ x + x @ curvature[out][own[:, None], own] @ x)


def _solved(curvature: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Coefficients of the least loss, with a unit-normal prior."""
    return -np.linalg.solve(curvature + np.eye(len(slope)), slope)


def _chosen(curvature: np.ndarray, slope: np.ndarray) -> tuple[int, ...]:
    """Products taken one by one, the most telling first, as long as the loss falls enough."""
    chosen: list[int] = []
    fall = 0.0
    while len(chosen) < min(_PRODUCTS, len(slope)):
        falls = {}
        for k in set(range(len(slope))) - set(chosen):
            own = np.array([*chosen, k])
            x = _solved(curvature[own[:, None], own], slope[own])
            falls[k] = -float(slope[own] @ x)
        best = max(falls, key=falls.__getitem__)
        if falls[best] < fall + _KEEP:
            break
        chosen, fall = [*chosen, best], falls[best]
    return tuple(sorted(chosen))

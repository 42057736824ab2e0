"""Regression of prediction errors on the entries of a law's table, judged by runs left out.

The errors are those of a track whose unknown inputs have taken up what they could; how they answer
to an addition is known to first order (`estimate.responses`). So a reading counts as it does in
the likelihood, and a law that is faster than the unknown inputs is seen as it is, not as a smoother
blurs it. Entries that follow each other are taken to be alike (P-splines, Eilers and Marx 1996).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.estimate.evidence import flat
from hydrotele.estimate.responses import error_responses
from hydrotele.estimate.track import Track
from hydrotele.gap.law_tables import Table

_PARTS = 4  # of a single run, left out one by one
_MEMORY_ROWS = 15.0  # that a smoother's answer is alike
_SMOOTHNESS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of the entries, in units of the lack


class Regression(NamedTuple):
    """A law's entries.

    Attributes:
        predicted: fall of -2 log likelihood in runs that were left out, all together.
        entries: (K,) [unit of the addition].
        covariance: (K, K) of the entries [unit of the addition, squared].
        charge: what the entries cost: log determinant of what the data add to their precision.
        left: RMS of what the law does not take of the unknown input [unit of the addition].
    """

    predicted: float
    entries: np.ndarray
    covariance: np.ndarray
    charge: float
    left: float


def regression(
    table: Table, parts: Sequence[tuple[Track, np.ndarray, np.ndarray]], size: float
) -> Regression:
    """Fit a table's entries to the errors of some tracks.

    Args:
        table: with K entries.
        parts: per run the track, what a unit of the addition does (n, nz), and the entries' shares
            (n, K).
        size: standard deviation of the unknown input in whose place the law is put.

    Returns:
        The regression, with the smoothness that predicts best what was left out.
    """
    answers = []
    for track, column, shares in parts:
        slope = error_responses(track, column, shares * size)
        answers.append((slope.reshape(-1, slope.shape[2]), flat(track.whitened)))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for _, _, shares in parts])
    left = size * float(np.sqrt(max(1.0 - np.mean(along**2), 0.0)))
    return Regression(falls, x * size, covariance * size**2, charge, left)


def lack_regression(
    table: Table, parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[Regression, float]:
    """Fit a table's entries to a lack that readings tell row by row.

    Args:
        table: with K entries.
        parts: per run the lack (n,), its standard deviation (n,) and the entries' shares (n, K).

    Returns:
        (The regression, the share of the lack's square in its standard deviations that it predicts
        where it was left out); rows over which smoothed readings hang together count as one.
    """
    lack = np.concatenate([told for told, _, _ in parts])
    size = float(np.sqrt(np.mean(lack**2)))
    answers = []
    for told, deviation, shares in parts:
        each = np.sqrt(_MEMORY_ROWS) * deviation
        answers.append((-size * shares / each[:, None], told / each))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for _, _, shares in parts])
    left = float(np.sqrt(np.mean((lack - size * along) ** 2)))
    share = falls / sum(float(errors @ errors) for _, errors in answers)
    return Regression(falls, x * size, covariance * size**2, charge, left), share


def _entries(
    table: Table, answers: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Fall of what is left out, entries, their covariance and charge, with the best smoothness.

    Args:
        table: with K entries.
        answers: per run the slopes of its errors with the entries (n, K), and the errors (n,).
    """
    if len(answers) == 1:
        cuts = (np.array_split(part, _PARTS) for part in answers[0])
        answers = list(zip(*cuts, strict=True))
    curvature = np.array([s.T @ s for s, _ in answers])
    slope = np.array([s.T @ e for s, e in answers])
    falls = {
        smooth: sum(
            _left_out(curvature, slope, table.precision(smooth), k) for k in range(len(curvature))
        )
        for smooth in _SMOOTHNESS
    }
    smooth = max(falls, key=falls.__getitem__)
    prior = table.precision(smooth)
    whole = curvature.sum(axis=0) + prior
    x = -np.linalg.solve(whole, slope.sum(axis=0))
    charge = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(prior)[1]
    return falls[smooth], x, np.linalg.inv(whole), float(charge)


def at_a_glance(table: Table, parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Share of an unknown input's square, as a smoother tells it, that a table takes if left out.

    Args:
        table: with K entries.
        parts: per run the input (n,) and the entries' shares (n, K).

    Returns:
        The share; what the smoother blurs, it misses, so that this is for choosing what to try.
    """
    if len(parts) == 1:
        ((told, shares),) = parts
        cut = (np.array_split(told, _PARTS), np.array_split(shares, _PARTS))
        parts = list(zip(*cut, strict=True))
    whole = sum(float(told @ told) for told, _ in parts)
    size = whole / sum(len(told) for told, _ in parts)
    rows = _MEMORY_ROWS * size  # readings that hang together are as few as one
    curvature = np.array([s.T @ s for _, s in parts]) / rows
    slope = -np.array([s.T @ told for told, s in parts]) / rows
    prior = table.precision(1.0) / size
    falls = (_left_out(curvature, slope, prior, k) for k in range(len(parts)))
    return sum(falls) * rows / whole if whole > 0.0 else 0.0


def _left_out(curvature: np.ndarray, slope: np.ndarray, prior: np.ndarray, out: int) -> float:
    """Fall of the loss of a part that the fit of the entries has not seen."""
    others = curvature.sum(axis=0) - curvature[out] + prior
    x = -np.linalg.solve(others, slope.sum(axis=0) - slope[out])
    return -float(2.0 * slope[out] @ x + x @ curvature[out] @ x)

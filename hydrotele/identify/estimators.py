"""Estimators of parameters that drive forces are linear in, with their uncertainty.

All work on the base parameters of `identifiability`; what they do not tell stays at its nominal
value. Equations come as (n, k, m) regressors and (n, k) forces of k drives over n rows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from hydrotele.core.errors import InputError

_WHERE = "estimate"
_NORMAL95 = 1.959964
_LONGEST = 30  # rows of memory that are looked for
_SILENT = 1e-12  # of a force: rounding


@dataclass(frozen=True)
class Estimate:
    """Parameters with their uncertainty; p of them, k drives, n rows.

    Attributes:
        value: (p,) in the parameters' SI units.
        covariance: (p, p).
        residual: (n, k) measured less predicted force [N] or [N m].
        gain: (p, n, k) of the forces: how the value follows from each; 0 for rows left out.
        condition: ratio of the singular values of the weighted, scaled equations.
        white: (k, k) by which the equations were weighted.
        normal: (p, p) inverse of the weighted normal equations: for weighted Y (or Z) and F the
            value is the prior and `normal Y' (F - Y prior)`.
        rank: number of directions that truncation left.
    """

    value: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    gain: np.ndarray
    condition: float
    white: np.ndarray
    normal: np.ndarray
    rank: int

    @property
    def std(self) -> np.ndarray:
        """(p,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def ci95(self) -> np.ndarray:
        """(p, 2) 95 % intervals."""
        reach = _NORMAL95 * self.std
        return np.column_stack([self.value - reach, self.value + reach])

    def ellipsoid(self, truth: np.ndarray) -> float:
        """Squared distance of other parameters (p,) in standard deviations: chi^2 of rank degrees.

        Directions that truncation has fixed do not count.
        """
        away = (np.asarray(truth) - self.value) / self.std
        values, ways = np.linalg.eigh(self.covariance / np.outer(self.std, self.std))
        kept = slice(len(values) - self.rank, None)
        return float(np.sum((away @ ways[:, kept]) ** 2 / values[kept]))


def estimate(
    matrix: np.ndarray, forces: np.ndarray, covariance: np.ndarray | None = None, *,
    instruments: np.ndarray | None = None, ridge: float = 0.0, cut: float = 0.0,
    prior: np.ndarray | None = None, order: int | None = None,
) -> Estimate:  # fmt: skip
    """Least squares, weighted or not, for errors that are correlated in time and between drives.

    With the covariance of the drives' errors it is the Gauss-Markov estimate; without, every drive
    counts by its own residuals. That errors follow each other is told by an autoregression of the
    residuals; it widens the covariance and leaves the estimate alone, because equations freed of
    their errors' memory weigh most what models and derivatives know least, the fast changes. With
    instruments Z it solves `Z' W (F - Y p) = 0`, which noise in Y does not bias as long as Z has
    none of it. With few rows beyond the errors' memory intervals are too narrow: 93 % of them cover
    the truth for 400 rows whose errors keep 80 % of those before. Ridge and truncation pull what
    the data hardly tell towards the prior, and say nothing of their bias.

    Args:
        matrix: (n, k, p) regressor Y; rows with NaN are left out.
        forces: (n, k) F [N] or [N m].
        covariance: (k, k) of the errors of the k drives at one instant, up to a factor.
        instruments: (n, k, p) Z, correlated with the noise-free regressor but not with its noise.
        ridge: added to the squares of the singular values, as a share of the largest.
        cut: share of the largest singular value below which directions keep the prior.
        prior: (p,) towards which ridge and truncation pull; 0 by default.
        order: of the autoregression; None to choose it, 0 for errors without memory.

    Returns:
        The estimate.

    Raises:
        InputError: shapes do not fit, fewer equations than parameters, or a column without effect.

    Source: Abdellatif 2008, section 4 (Gauss-Markov); Khoshzaban 1992, 4.59-4.60 (truncation and
    ridge); Janot, Vandanjon and Gautier 2014 (instruments); Schwarz 1978 (order).
    """
    matrix, forces = np.asarray(matrix, float), np.asarray(forces, float)
    _check(matrix, forces, covariance, instruments)
    there = np.isfinite(forces).all(axis=1) & np.isfinite(matrix).all(axis=(1, 2))
    white = np.eye(forces.shape[1]) if covariance is None else _whitener(covariance)
    x, y = white @ matrix[there], forces[there] @ white.T
    z = None if instruments is None else white @ np.asarray(instruments, float)[there]
    if y.size <= x.shape[2]:
        raise InputError(_WHERE, f"{y.size} equations do not tell {x.shape[2]} parameters")
    if not (size := np.sqrt(np.einsum("nkp,nkp->p", x, x))).all():
        raise InputError(_WHERE, f"column {int(np.argmin(size))} has no effect: leave it out")
    start = np.zeros(x.shape[2]) if prior is None else np.asarray(prior, float)
    shape = _Shape(start, ridge, cut, covariance is None)
    value, inverse, solved, scale = _solve(x, y, z, shape)
    error = y - x @ value
    follow = autoregression(error, order)
    spread = _carried(inverse, error, follow) * y.size / (y.size - x.shape[2])
    gain = np.zeros((len(value), *forces.shape))
    gain[:, there] = inverse @ white
    return Estimate(
        value, spread, forces - matrix @ value, gain, solved.condition, white / scale[:, None],
        solved.normal, solved.rank,
    )  # fmt: skip


class _Shape(NamedTuple):
    """How to solve: (p,) prior, ridge, cut, and whether drives are weighted by their residuals."""

    prior: np.ndarray
    ridge: float
    cut: float
    weigh: bool


class _Solved(NamedTuple):
    """Of scaled equations: their condition, inverse of their normal equations, and rank."""

    condition: float
    normal: np.ndarray
    rank: int


def _solve(x, y, z, shape: _Shape) -> tuple[np.ndarray, np.ndarray, _Solved, np.ndarray]:
    """Value (p,), how it follows from the forces (p, n, k), the rest, and the drives' scales."""
    value, inverse, solved = _solve_once(x, y, z, shape)
    ones = np.ones(y.shape[1])
    if shape.weigh and y.shape[1] > 1:
        scale = np.sqrt(np.mean((y - x @ value) ** 2, axis=0))
        if (scale > _SILENT * np.sqrt(np.mean(y**2, axis=0))).all():
            x, y, z = x / scale[:, None], y / scale, None if z is None else z / scale[:, None]
            value, inverse, solved = _solve_once(x, y, z, shape)
            return value, inverse / scale, solved, scale
    return value, inverse, solved, ones


def _solve_once(x, y, z, shape: _Shape):
    n, k, p = x.shape
    size = np.sqrt(np.einsum("nkp,nkp->p", x, x))
    flat, rest = (x / size).reshape(-1, p), (y - x @ shape.prior).ravel()
    if z is None:
        inverse, solved = _pseudo_inverse(flat, shape.ridge, shape.cut)
        solved = solved._replace(normal=solved.normal / np.outer(size, size))
    else:
        length = np.sqrt(np.einsum("nkp,nkp->p", z, z))
        inverse, solved = _by_instruments((z / length).reshape(-1, p), flat)
        solved = solved._replace(normal=solved.normal / np.outer(size, length))
    inverse = inverse / size[:, None]
    return shape.prior + inverse @ rest, inverse.reshape(p, n, k), solved


def _carried(inverse: np.ndarray, error: np.ndarray, follow: np.ndarray) -> np.ndarray:
    """Covariance (p, p) of `inverse @ errors`, for errors with the memory `follow`."""
    p, _, k = inverse.shape
    fresh, late = np.empty_like(error), np.empty_like(inverse)
    for c in range(k):
        weights = np.concatenate([[1.0], -follow[:, c]])
        fresh[:, c] = lfilter(weights, 1.0, error[:, c])
        # what an error does to all that follow it: the recursion backwards in time
        late[:, ::-1, c] = lfilter([1.0], weights, inverse[:, ::-1, c], axis=1)
    fresh = fresh[len(follow) :]
    between = fresh.T @ fresh / len(fresh)
    return np.einsum("pnc,cd,qnd->pq", late, between, late, optimize=True).reshape(p, p)


def autoregression(error: np.ndarray, order: int | None = None) -> np.ndarray:
    """What errors take over from those before them.

    Args:
        error: (n, k).
        order: number q of rows before; None for the one that Schwarz's criterion asks for.

    Returns:
        (q, k) weights of the rows before, the latest first.

    Source: Yule and Walker; Levinson's recursion.
    """
    n = len(error)
    longest = min(_LONGEST, n // 20) if order is None else order
    tables, best = [], 0
    for column in error.T:
        spectrum = np.abs(np.fft.rfft(column, 2 * n)) ** 2
        echo = np.fft.irfft(spectrum)[: longest + 1]
        weights, left, table, costs = np.zeros(0), echo[0], [np.zeros(0)], [0.0]
        for q in range(1, longest + 1 if echo[0] > 0.0 else 1):
            reflect = (echo[q] - weights @ echo[q - 1 : 0 : -1]) / left
            weights = np.append(weights - reflect * weights[::-1], reflect)
            left *= 1.0 - reflect**2
            table.append(weights)
            costs.append(n * np.log(max(left / echo[0], 1e-300)) + q * np.log(n))
        tables.append(table)
        best = max(best, int(np.argmin(costs)) if order is None else len(table) - 1)
    out = np.zeros((best, error.shape[1]))
    for k, table in enumerate(tables):
        weights = table[min(best, len(table) - 1)]
        out[: len(weights), k] = weights
    return out


def _pseudo_inverse(x: np.ndarray, ridge: float, cut: float) -> tuple[np.ndarray, _Solved]:
    """(p, N) with columns of length 1, and the rest."""
    u, s, v = np.linalg.svd(x, full_matrices=False)
    kept = s > max(cut, 1e-14) * s[0]
    squares = np.where(kept, 1.0 / (s**2 + ridge * s[0] ** 2), 0.0)
    solved = _Solved(float(s[0] / s[-1]), (v.T * squares) @ v, int(kept.sum()))
    return (v.T * (s * squares)) @ u.T, solved


def _by_instruments(z: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, _Solved]:
    normal = np.linalg.inv(z.T @ x)
    return normal @ z.T, _Solved(float(np.linalg.cond(x)), normal, x.shape[1])


def _whitener(covariance: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(np.asarray(covariance, float)))


def _check(matrix, forces, covariance, instruments) -> None:
    if matrix.ndim != 3 or forces.shape != matrix.shape[:2]:
        raise InputError(
            _WHERE, f"a regressor (n, k, m) and forces (n, k) must fit: {matrix.shape},"
            f" {forces.shape}")  # fmt: skip
    if covariance is not None and np.shape(covariance) != (matrix.shape[1],) * 2:
        raise InputError(_WHERE, f"the covariance must be (k, k): {np.shape(covariance)}")
    if instruments is not None and np.shape(instruments) != matrix.shape:
        raise InputError(_WHERE, "instruments must have the regressor's shape")

"""Least-squares estimates of parameters that are linear in the drive forces, with their covariance.

`estimate_linear_parameters` solves (n, k, m) regressors and (n, k) forces of k drives over n rows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.stats import t as student

from hydrotele.core.errors import InputError

_ESTIMATE_CONTEXT = "estimate"
_MAX_AUTOREGRESSION_ORDER = 30  # rows, highest order of the autoregression of the errors
_MIN_RELATIVE_RESIDUAL = 1e-12  # of a force: rounding


@dataclass(frozen=True)
class Estimate:
    """Estimated parameters with their uncertainty: p parameters, k drives, n rows.

    Attributes:
        value: (p,) estimates in SI units.
        covariance: (p, p) covariance.
        residual: (n, k) measured minus predicted force [N] or [N m].
        gain: (p, n, k) derivative of the estimates with respect to each force; 0 for omitted rows.
        condition: condition number of the weighted, scaled equations.
        whitening: (k, k) matrix by which the equations of each row were multiplied.
        inverse_normal_matrix: (p, p) inverse N of the normal equations. With weighted regressor Y and
            forces F, `value = prior + N Y' (F - Y prior)`; with instruments, they replace Y'.
        rank: number of parameter combinations that the data determine: those whose singular values
            were not truncated.
    """

    value: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    gain: np.ndarray
    condition: float
    whitening: np.ndarray
    inverse_normal_matrix: np.ndarray
    rank: int

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (p,) of the estimates."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def interval_factor(self) -> float:
        """Half width of a 95 % interval over the standard deviation, from Student's distribution.

        Its degrees of freedom are the rows minus the average number of parameters per drive.
        """
        rows, drives = self.residual.shape
        return float(student.ppf(0.975, max(rows - self.rank / drives, 1.0)))

    @property
    def ci95(self) -> np.ndarray:
        """95 % confidence intervals (p, 2) of the estimates, lower and upper bound."""
        reach = self.interval_factor * self.std
        return np.column_stack([self.value - reach, self.value + reach])

    def squared_distance(self, parameters: np.ndarray) -> float:
        """Return the squared Mahalanobis distance of other parameters (p,) from the estimate.

        Its distribution is chi^2 with `rank` degrees of freedom. Combinations of parameters whose singular
        values were truncated are excluded.
        """
        away = (np.asarray(parameters) - self.value) / self.std
        values, ways = np.linalg.eigh(self.covariance / np.outer(self.std, self.std))
        kept = slice(len(values) - self.rank, None)
        return float(np.sum((away @ ways[:, kept]) ** 2 / values[kept]))


def estimate_linear_parameters(
    matrix: np.ndarray, forces: np.ndarray, covariance: np.ndarray | None = None, *,
    instruments: np.ndarray | None = None, ridge: float = 0.0, truncation: float = 0.0,
    prior: np.ndarray | None = None, order: int | None = None,
) -> Estimate:  # fmt: skip
    """Estimate the parameters p in Y p = F by least squares; errors may correlate in time and over drives.

    With the covariance of the drives' errors this is the Gauss-Markov estimate. Without it, each
    drive is weighted by its residuals. An autoregression of the residuals models their correlation
    in time. It increases the covariance but does not change the estimate, because prewhitened
    equations would give most weight to fast changes, where models and derivatives are least
    accurate. With instruments Z and weights W the estimate solves `Z' W (F - Y p) = 0`. It is not biased by
    noise in Y as long as Z is independent of that noise. With few rows relative to the correlation
    time the intervals are too narrow. For 400 rows with a correlation of 80 % between successive
    errors, 93 % of them cover the truth. Ridge and truncation move poorly determined
    parameters towards the prior; the covariance does not include that bias.

    Args:
        matrix: (n, k, p) regressor Y; rows with NaN are omitted.
        forces: (n, k) forces F [N] or [N m].
        covariance: (k, k) covariance of the errors of the k drives at one instant, up to a factor.
        instruments: (n, k, p) Z, correlated with the noise-free regressor but not with its noise.
        ridge: added to the squared singular values, as a fraction of the largest one squared.
        truncation: fraction of the largest singular value below which directions keep the prior.
        prior: (p,) values towards which ridge and truncation move the estimate; 0 by default.
        order: order of the autoregression; None to choose it, 0 for uncorrelated errors.

    Returns:
        The estimate with its covariance and residuals.

    Raises:
        InputError: shapes do not match, fewer equations than parameters, or a column is zero.

    Source: Abdellatif 2008, section 4 (Gauss-Markov); Khoshzaban 1992, 4.59-4.60 (truncation and
    ridge); Janot, Vandanjon and Gautier 2014 (instruments); Schwarz 1978 (order).
    """
    matrix, forces = np.asarray(matrix, float), np.asarray(forces, float)
    _check_shapes(matrix, forces, covariance, instruments)
    there = np.isfinite(forces).all(axis=1) & np.isfinite(matrix).all(axis=(1, 2))
    white = np.eye(forces.shape[1]) if covariance is None else _whitening_matrix(covariance)
    x, y = white @ matrix[there], forces[there] @ white.T
    z = None if instruments is None else white @ np.asarray(instruments, float)[there]
    if y.size <= x.shape[2]:
        raise InputError(_ESTIMATE_CONTEXT, f"{y.size} equations do not determine {x.shape[2]} parameters")
    if not (size := np.sqrt(np.einsum("nkp,nkp->p", x, x))).all():
        raise InputError(_ESTIMATE_CONTEXT, f"column {int(np.argmin(size))} has no effect: remove it")
    start = np.zeros(x.shape[2]) if prior is None else np.asarray(prior, float)
    shape = _SolverOptions(start, ridge, truncation, covariance is None)
    value, inverse, solved, scale = _solve_with_drive_weights(x, y, z, shape)
    error = y - x @ value
    follow = fit_autoregression(error, order)
    spread = _propagate_covariance(inverse, error, follow) * y.size / (y.size - x.shape[2])
    gain = np.zeros((len(value), *forces.shape))
    gain[:, there] = inverse @ white
    return Estimate(
        value, spread, forces - matrix @ value, gain, solved.condition, white / scale[:, None],
        solved.inverse_normal_matrix, solved.rank,
    )  # fmt: skip


class _SolverOptions(NamedTuple):
    """Options of the solver.

    Attributes:
        prior: (p,) values towards which ridge and truncation move the estimate.
        ridge: added to the squared singular values, as a fraction of the largest one squared.
        truncation: fraction of the largest singular value below which directions keep the prior.
        weight_by_residuals: whether drives are weighted by their residuals.
    """

    prior: np.ndarray
    ridge: float
    truncation: float
    weight_by_residuals: bool


class _SolutionProperties(NamedTuple):
    """Properties of a least-squares solution.

    Attributes:
        condition: condition number of the scaled equations.
        inverse_normal_matrix: (p, p) inverse of the matrix of the normal equations.
        rank: number of singular values that were not truncated.
    """

    condition: float
    inverse_normal_matrix: np.ndarray
    rank: int


def _solve_with_drive_weights(
    x, y, z, shape: _SolverOptions
) -> tuple[np.ndarray, np.ndarray, _SolutionProperties, np.ndarray]:
    """Solve y (n, k) = x (n, k, p) @ parameters by least squares, or with instruments z (n, k, p) if given.

    If `shape.weight_by_residuals`, the equations of each drive are divided by its RMS residual and
    solved again.

    Returns:
        Four items: estimates (p,); their derivative by the forces (p, n, k); solution properties; the RMS
        residuals (k,) by which the equations of each drive were divided, 1 without weights.
    """
    value, inverse, solved = _solve_once(x, y, z, shape)
    ones = np.ones(y.shape[1])
    if shape.weight_by_residuals and y.shape[1] > 1:
        scale = np.sqrt(np.mean((y - x @ value) ** 2, axis=0))
        if (scale > _MIN_RELATIVE_RESIDUAL * np.sqrt(np.mean(y**2, axis=0))).all():
            x, y, z = x / scale[:, None], y / scale, None if z is None else z / scale[:, None]
            value, inverse, solved = _solve_once(x, y, z, shape)
            return value, inverse / scale, solved, scale
    return value, inverse, solved, ones


def _solve_once(x, y, z, shape: _SolverOptions):
    n, k, p = x.shape
    size = np.sqrt(np.einsum("nkp,nkp->p", x, x))
    flat, rest = (x / size).reshape(-1, p), (y - x @ shape.prior).ravel()
    if z is None:
        inverse, solved = _pseudo_inverse(flat, shape.ridge, shape.truncation)
        solved = solved._replace(inverse_normal_matrix=solved.inverse_normal_matrix / np.outer(size, size))
    else:
        length = np.sqrt(np.einsum("nkp,nkp->p", z, z))
        inverse, solved = _solve_by_instruments((z / length).reshape(-1, p), flat)
        solved = solved._replace(inverse_normal_matrix=solved.inverse_normal_matrix / np.outer(size, length))
    inverse = inverse / size[:, None]
    return shape.prior + inverse @ rest, inverse.reshape(p, n, k), solved


def _propagate_covariance(inverse: np.ndarray, error: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return the covariance (p, p) of estimates that are `inverse` (p, n, k) times correlated errors.

    The errors follow the autoregression with `coefficients` (q, k), fitted to the residuals `error` (n, k).
    """
    p, _, k = inverse.shape
    fresh, late = np.empty_like(error), np.empty_like(inverse)
    for c in range(k):
        weights = np.concatenate([[1.0], -coefficients[:, c]])
        fresh[:, c] = lfilter(weights, 1.0, error[:, c])
        # the effect of an error on all later errors: the recursion backwards in time
        late[:, ::-1, c] = lfilter([1.0], weights, inverse[:, ::-1, c], axis=1)
    fresh = fresh[len(coefficients) :]
    between = fresh.T @ fresh / len(fresh)
    return np.einsum("pnc,cd,qnd->pq", late, between, late, optimize=True).reshape(p, p)


def fit_autoregression(error: np.ndarray, order: int | None = None) -> np.ndarray:
    """Fit an autoregressive model, which predicts each error from previous ones, to time series of errors.

    Args:
        error: (n, k) errors.
        order: order q; None to choose it by Schwarz's criterion.

    Returns:
        (q, k) coefficients of the previous rows, the latest first.

    Source: Yule and Walker; Levinson's recursion.
    """
    n = len(error)
    longest = min(_MAX_AUTOREGRESSION_ORDER, n // 20) if order is None else order
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


def _pseudo_inverse(x: np.ndarray, ridge: float, truncation: float) -> tuple[np.ndarray, _SolutionProperties]:
    """Return the pseudo-inverse (p, N) of x (N, p), with ridge and truncated singular values.

    Also returns the condition number of x, the inverse of the normal matrix, and the number of kept singular values.
    """
    u, s, v = np.linalg.svd(x, full_matrices=False)
    kept = s > max(truncation, 1e-14) * s[0]
    squares = np.where(kept, 1.0 / (s**2 + ridge * s[0] ** 2), 0.0)
    solved = _SolutionProperties(float(s[0] / s[-1]), (v.T * squares) @ v, int(kept.sum()))
    return (v.T * (s * squares)) @ u.T, solved


def _solve_by_instruments(z: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, _SolutionProperties]:
    normal = np.linalg.inv(z.T @ x)
    return normal @ z.T, _SolutionProperties(float(np.linalg.cond(x)), normal, x.shape[1])


def _whitening_matrix(covariance: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(np.asarray(covariance, float)))


def _check_shapes(matrix, forces, covariance, instruments) -> None:
    if matrix.ndim != 3 or forces.shape != matrix.shape[:2]:
        raise InputError(
            _ESTIMATE_CONTEXT, f"regressor (n, k, m) and forces (n, k) do not match: {matrix.shape},"
            f" {forces.shape}")  # fmt: skip
    if covariance is not None and np.shape(covariance) != (matrix.shape[1],) * 2:
        raise InputError(_ESTIMATE_CONTEXT, f"the covariance must be (k, k): {np.shape(covariance)}")
    if instruments is not None and np.shape(instruments) != matrix.shape:
        raise InputError(_ESTIMATE_CONTEXT, "instruments must have the regressor's shape")

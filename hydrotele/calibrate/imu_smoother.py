"""Batch smoother: joint motion and IMU parameters that fit the readings of several runs best.

The joint positions of a run are quintic splines with a knot at every row. All spline coefficients,
the mounting rotations and the biases are estimated together by Gauss-Newton steps. The normal
equations are banded, with a border of parameters, and solved by a banded Cholesky factorisation.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from hydrotele.calibrate.imu_model import ImuChain, predict_imu_readings

_DEGREE = 5  # of the splines; the accelerations of cubic splines are 1 to 2 % too large at a tenth of the row rate
_ACCELERATION_SD = 20.0  # [rad/s^2] or [m/s^2], prior of joint accelerations; only determines rows without readings
_CHUNK = 2000  # rows per block of the normal equations
_MAX_STEPS = 40
_MAX_HALVINGS = 6
_MAX_REWEIGHTINGS = 2
_MAX_EXCESS = 1.1  # ratio of residuals to their expected RMS, due to random scatter
_CONVERGED = 1e-3  # decrease of the cost per step at which the iteration stops
_COMPLEX_STEP = 1e-30


class ImuRun(NamedTuple):
    """Readings of one run with n rows; a axes and s IMUs.

    Attributes:
        name: name of the run.
        time: (n,) time [s].
        readings: (s, 6, n) angular rates [rad/s] and specific forces [m/s^2]; NaN if missing.
        position: (a, n) known joint positions [rad] or [m]; NaN where unknown.
        position_sd: (a, n) their standard deviations.
        rest_rate_sd: (a, n) standard deviation of the joint rate around 0 at rest; inf in motion.
        accelerometer_error: (s, n) standard deviation of errors in addition to the noise [m/s^2].
    """

    name: str
    time: np.ndarray
    readings: np.ndarray
    position: np.ndarray
    position_sd: np.ndarray
    rest_rate_sd: np.ndarray
    accelerometer_error: np.ndarray


class ImuParameters(NamedTuple):
    """Parameters of s IMUs and r runs; also used for their standard deviations.

    Attributes:
        mounting: (s, 9) rotation relative to the stated one [rad], accelerometer bias [m/s^2], and
            position relative to the stated one [m].
        tilt: (2,) rotation of the machine about the world's x and y axes [rad].
        gyro_bias: (r, s, 3) [rad/s].
    """

    mounting: np.ndarray
    tilt: np.ndarray
    gyro_bias: np.ndarray

    def to_vector(self) -> np.ndarray:
        """Return all parameters in one vector."""
        return np.concatenate([part.ravel() for part in self])

    def from_vector(self, values: np.ndarray) -> "ImuParameters":
        """Return the parameters of a vector, with the shapes of these parameters."""
        parts, first = [], 0
        for part in self:
            parts.append(values[first : first + part.size].reshape(part.shape))
            first += part.size
        return ImuParameters(*parts)


class SmoothedRun(NamedTuple):
    """Estimated joint motion of a run.

    Attributes:
        name: name of the run.
        motion: (3, a, n) joint positions, velocities and accelerations at the rows.
        noise: (a,) median standard deviation of a position due to the noise of the readings [rad] or [m].
        offset: (a,) median standard deviation of a position due to the parameters [rad] or [m].
        correlation_time: (a,) integral of the correlation of the errors due to noise over time differences [s].
        residual_rms: (s, 2) RMS of the residuals of gyro and accelerometer, relative to the stated noise.
    """

    name: str
    motion: np.ndarray
    noise: np.ndarray
    offset: np.ndarray
    correlation_time: np.ndarray
    residual_rms: np.ndarray


class SmoothedImus(NamedTuple):
    """Result of the smoother: parameters, their standard deviations, and the motion of every run."""

    parameters: ImuParameters
    standard_deviations: ImuParameters
    runs: tuple[SmoothedRun, ...]


class _Spline(NamedTuple):
    """Spline of a run: interval (n,) of each row, basis (3, n, 6) of value and derivatives."""

    interval: np.ndarray
    basis: np.ndarray
    count: int
    step: float


class _Normal(NamedTuple):
    """Normal equations of one run: band (lower) of the coefficients, border, corner and gradients."""

    band: np.ndarray
    border: np.ndarray
    corner: np.ndarray
    gradient: np.ndarray
    corner_gradient: np.ndarray
    cost: float
    squares: np.ndarray


def smooth_imus(
    chain: ImuChain, runs: list[ImuRun], start: list[np.ndarray], mean: ImuParameters, prior_sd: ImuParameters,
    noise: np.ndarray, bandwidth: float,
) -> SmoothedImus:  # fmt: skip
    """Estimate the joint motion of all runs and the parameters of the IMUs.

    Args:
        chain: the chain of links.
        runs: the runs.
        start: (a, n) initial joint positions of each run.
        mean: prior mean of the parameters.
        prior_sd: prior standard deviations; a parameter with 0 is not estimated.
        noise: (s, 2) standard deviations of gyro [rad/s] and accelerometer [m/s^2] before the
            low-pass filter. If the residuals of a sensor in a run are larger than they should be,
            because of vibrations, the fit is repeated with a noise increased in proportion.
        bandwidth: bandwidth of the filtered readings relative to half the row rate.

    Returns:
        The estimates. Their standard deviations assume white noise.
    """
    splines = [_make_spline(run.time) for run in runs]
    coefficients = [_interpolate_start(run.time, s, q) for run, s, q in zip(runs, splines, start, strict=True)]
    parameters, stated = mean.to_vector(), noise
    noise = np.repeat(stated[None], len(runs), axis=0)
    for _ in range(_MAX_REWEIGHTINGS + 1):
        parameters, coefficients, normals = _minimise(
            chain, runs, splines, coefficients, parameters, mean, prior_sd, noise
        )
        rms = _residual_rms(runs, normals)
        excess = rms / np.sqrt(bandwidth)
        if np.all(excess <= _MAX_EXCESS):
            break
        noise = np.maximum(noise * excess, stated)
    covariance, _, factors = _reduce(normals, parameters, mean.to_vector(), prior_sd.to_vector())
    results = []
    for k, (run, spline, solved) in enumerate(zip(runs, splines, coefficients, strict=True)):
        axes = run.position.shape[0]
        white, common = _position_deviations(spline, factors[k], normals[k].border, covariance, axes)
        times = _correlation_times(spline, factors[k], axes)
        excess = rms[k] * noise[k] / stated / np.sqrt(bandwidth)
        results.append(SmoothedRun(run.name, _evaluate(spline, solved), white, common, times, excess))
    deviations = mean.from_vector(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    return SmoothedImus(mean.from_vector(parameters), deviations, tuple(results))


def _minimise(chain, runs, splines, coefficients, parameters, mean, prior_sd, noise):
    """Return parameters, coefficients and normal equations at the minimum of the cost."""
    center, sd = mean.to_vector(), prior_sd.to_vector()

    def assemble(c, p):
        normals = [_assemble(chain, run, k, spline, own, mean.from_vector(p), noise[k])
                   for k, (run, spline, own) in enumerate(zip(runs, splines, c, strict=True))]  # fmt: skip
        free = sd > 0.0
        return normals, sum(n.cost for n in normals) + np.sum(((p - center)[free] / sd[free]) ** 2)

    normals, cost = assemble(coefficients, parameters)
    for _ in range(_MAX_STEPS):
        _, change, factors = _reduce(normals, parameters, center, sd)
        moves = [cho_solve_banded((f, True), n.gradient - n.border @ change)
                 for f, n in zip(factors, normals, strict=True)]  # fmt: skip
        for halving in range(_MAX_HALVINGS):
            size = 0.5**halving
            tried = [c + size * move.reshape(c.shape) for c, move in zip(coefficients, moves, strict=True)]
            new_normals, new_cost = assemble(tried, parameters + size * change)
            if new_cost < cost:
                break
        else:
            break
        gain, cost = cost - new_cost, new_cost
        coefficients, parameters, normals = tried, parameters + size * change, new_normals
        if gain < _CONVERGED:
            break
    return parameters, coefficients, normals


def _make_spline(time: np.ndarray) -> _Spline:
    """Return the B-spline of a run with a uniform knot distance of one median row distance."""
    step = float(np.median(np.diff(time)))
    place = (time - time[0]) / step
    count = int(np.floor(place[-1])) + 1
    interval = np.minimum(place.astype(int), count - 1)
    element = BSpline.basis_element(np.arange(_DEGREE + 2.0), extrapolate=False)
    points = (place - interval)[:, None] + _DEGREE - np.arange(_DEGREE + 1)
    basis = [np.nan_to_num(element.derivative(d)(points) if d else element(points)) / step**d for d in range(3)]
    return _Spline(interval, np.array(basis), count + _DEGREE, step)


def _interpolate_start(time: np.ndarray, spline: _Spline, positions: np.ndarray) -> np.ndarray:
    """Return coefficients (c, a) of a spline close to the positions (a, n)."""
    knots = time[0] + spline.step * (np.arange(spline.count) - _DEGREE // 2)
    return np.array([np.interp(knots, time, q) for q in positions]).T


def _evaluate(spline: _Spline, coefficients: np.ndarray) -> np.ndarray:
    """Return positions, velocities and accelerations (3, a, n) of a spline with coefficients (c, a)."""
    local = coefficients[spline.interval[:, None] + np.arange(_DEGREE + 1)]
    return np.einsum("dnk,nka->dan", spline.basis, local)


def _assemble(
    chain, run: ImuRun, place: int, spline: _Spline, coefficients, parameters: ImuParameters, noise
) -> _Normal:
    """Return the normal equations of a run, linearised at coefficients (c, a) and parameters."""
    axes, imus = coefficients.shape[1], len(chain.imus)
    motion = _evaluate(spline, coefficients)
    size = parameters.to_vector().size
    intervals, width = spline.count - _DEGREE, (_DEGREE + 1) * axes
    hessian, border = np.zeros((intervals, width, width)), np.zeros((intervals, width, size))
    gradient, corner, corner_gradient = np.zeros((intervals, width)), np.zeros((size, size)), np.zeros(size)
    cost, squares = 0.0, np.zeros((imus, 2))
    for first in range(0, len(run.time), _CHUNK):
        rows = slice(first, first + _CHUNK)
        residual, by_motion, by_parameter = _linearise(chain, run, place, motion, parameters, noise, rows)
        basis = spline.basis[:, rows]
        local = np.einsum("dnk,dmna->nmka", basis, by_motion).reshape(basis.shape[1], residual.shape[0], width)
        turned = local.transpose(0, 2, 1)
        of_row, values = spline.interval[rows], by_parameter.transpose(1, 0, 2)
        np.add.at(hessian, of_row, turned @ local)
        np.add.at(border, of_row, turned @ values)
        np.add.at(gradient, of_row, (turned @ residual.T[:, :, None])[:, :, 0])
        flat = by_parameter.reshape(-1, size)
        corner += flat.T @ flat
        corner_gradient += flat.T @ residual.ravel()
        cost += float(np.sum(residual**2))
        squares += np.sum(residual[: 6 * imus].reshape(imus, 2, -1) ** 2, axis=2)
    band, wide, slope = (
        np.zeros((width, spline.count * axes)),
        np.zeros((spline.count * axes, size)),
        np.zeros(spline.count * axes),
    )
    last = intervals * axes
    for b in range(width):
        for a in range(b, width):
            band[a - b, b : b + last : axes] += hessian[:, a, b]
        wide[b : b + last : axes] += border[:, b]
        slope[b : b + last : axes] += gradient[:, b]
    weight = 1.0 / (spline.step**2 * _ACCELERATION_SD)
    second = weight * np.diff(coefficients, 2, axis=0)
    cost += float(np.sum(second**2))
    for k, factor in enumerate((1.0, -2.0, 1.0)):
        part = slice(k * axes, (k + spline.count - 2) * axes)
        slope[part] -= weight * factor * second.ravel()
        for other, more in enumerate((1.0, -2.0, 1.0)[: k + 1]):
            band[(k - other) * axes, other * axes : (other + spline.count - 2) * axes] += weight**2 * factor * more
    return _Normal(band, wide, corner, slope, corner_gradient, cost, squares)


def _linearise(chain, run: ImuRun, place: int, motion, parameters: ImuParameters, noise, rows: slice):
    """Return weighted residuals (m, n) and the derivatives of the predictions by motion and parameters.

    The derivatives are (3, m, n, a) by positions, velocities and accelerations, and (m, n, p).
    """
    motion = motion[:, :, rows]
    axes, count = motion.shape[1:]
    imus = len(chain.imus)
    readings = run.readings[:, :, rows]
    bias = parameters.gyro_bias[place]
    sd = np.repeat(noise, 3, axis=1)[:, :, None] * np.ones_like(readings)
    sd[:, 3:] = np.hypot(sd[:, 3:], run.accelerometer_error[:, None, rows])
    weight = np.isfinite(readings) / sd
    prediction = predict_imu_readings(chain, motion, parameters.mounting, parameters.tilt)
    prediction[:, :3] += bias[:, :, None]
    by_motion = np.zeros((3, 6 * imus + 2 * axes, count, axes))
    size = parameters.to_vector().size
    by_parameter = np.zeros((6 * imus + 2 * axes, count, size))

    def derivative(motion, mounting, tilt):
        changed = predict_imu_readings(chain, motion, mounting, tilt)
        return weight * np.imag(changed) / _COMPLEX_STEP

    for d in range(3):
        for a in range(axes):
            moved = motion.astype(complex)
            moved[d, a] += 1j * _COMPLEX_STEP
            by_motion[d, : 6 * imus, :, a] = derivative(moved, parameters.mounting, parameters.tilt).reshape(-1, count)
    for k in range(9):
        mounting = parameters.mounting.astype(complex)
        mounting[:, k] += 1j * _COMPLEX_STEP
        change = derivative(motion, mounting, parameters.tilt)
        for i in range(imus):
            by_parameter[6 * i : 6 * i + 6, :, 9 * i + k] = change[i]
    for k in range(2):
        tilt = parameters.tilt.astype(complex)
        tilt[k] += 1j * _COMPLEX_STEP
        by_parameter[: 6 * imus, :, 9 * imus + k] = derivative(motion, parameters.mounting, tilt).reshape(-1, count)
    first = 9 * imus + 2 + 3 * imus * place
    for i in range(imus):
        for k in range(3):
            by_parameter[6 * i + k, :, first + 3 * i + k] = weight[i, k]
    residual = np.zeros((6 * imus + 2 * axes, count))
    residual[: 6 * imus] = (weight * (np.where(np.isfinite(readings), readings, 0.0) - prediction)).reshape(-1, count)
    known = run.position[:, rows]
    strength = np.isfinite(known) / run.position_sd[:, rows]
    residual[6 * imus : 6 * imus + axes] = strength * (np.where(np.isfinite(known), known, 0.0) - motion[0])
    still = 1.0 / run.rest_rate_sd[:, rows]
    residual[6 * imus + axes :] = -still * motion[1]
    for a in range(axes):
        by_motion[0, 6 * imus + a, :, a] = strength[a]
        by_motion[1, 6 * imus + axes + a, :, a] = still[a]
    return residual, by_motion, by_parameter


def _reduce(normals: list[_Normal], parameters, center, sd):
    """Eliminate the coefficients of all runs.

    Returns:
        (covariance of the parameters, their Gauss-Newton step, Cholesky factors of the bands).
    """
    free = np.flatnonzero(sd > 0.0)
    matrix = np.diag(1.0 / sd[free] ** 2)
    right = -(parameters - center)[free] / sd[free] ** 2
    factors = []
    for normal in normals:
        factor = cholesky_banded(normal.band, lower=True)
        solved = cho_solve_banded((factor, True), normal.border[:, free])
        matrix = matrix + normal.corner[np.ix_(free, free)] - normal.border[:, free].T @ solved
        right = right + normal.corner_gradient[free] - solved.T @ normal.gradient
        factors.append(factor)
    whole = cho_factor(0.5 * (matrix + matrix.T))
    change, covariance = np.zeros(len(sd)), np.zeros((len(sd), len(sd)))
    change[free] = cho_solve(whole, right)
    covariance[np.ix_(free, free)] = cho_solve(whole, np.eye(len(free)))
    return covariance, change, factors


def _residual_rms(runs: list[ImuRun], normals: list[_Normal]) -> np.ndarray:
    """Return the RMS (r, s, 2) of the weighted residuals of gyros and accelerometers."""
    counts = np.array([np.isfinite(run.readings).reshape(len(run.readings), 2, -1).sum(axis=2) for run in runs])
    return np.sqrt(np.array([normal.squares for normal in normals]) / np.maximum(counts, 1))


def _correlation_times(spline: _Spline, factor, axes: int) -> np.ndarray:
    """Return the integral (a,) of the correlation of position errors due to noise about the middle of a run [s]."""
    row = len(spline.interval) // 2
    unit = np.zeros((spline.count * axes, axes))
    for a in range(axes):
        unit[(spline.interval[row] + np.arange(_DEGREE + 1)) * axes + a, a] = spline.basis[0, row]
    solved = cho_solve_banded((factor, True), unit)
    times = np.empty(axes)
    for a in range(axes):
        covariance = _evaluate(spline, solved[:, a].reshape(spline.count, axes))[0, a]
        times[a] = spline.step * np.sum(covariance) / covariance[row]
    return times


def _position_deviations(spline: _Spline, factor, border, covariance, axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the median standard deviations (a,) of positions due to noise and due to the parameters."""
    rows = np.linspace(0, len(spline.interval) - 1, 30).astype(int)
    white, common = np.empty((2, len(rows), axes))
    for place, row in enumerate(rows):
        unit = np.zeros((spline.count * axes, axes))
        for a in range(axes):
            unit[(spline.interval[row] + np.arange(_DEGREE + 1)) * axes + a, a] = spline.basis[0, row]
        solved = cho_solve_banded((factor, True), unit)
        white[place] = np.einsum("ca,ca->a", unit, solved)
        by_parameter = border.T @ solved
        common[place] = np.einsum("pa,pq,qa->a", by_parameter, covariance, by_parameter)
    return np.sqrt(np.median(white, axis=0)), np.sqrt(np.maximum(np.median(common, axis=0), 0.0))

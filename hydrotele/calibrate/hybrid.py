"""Kinematic calibration of a serial-parallel (hybrid) robot from measured platform poses.

The residual is the measured leg readings minus the readings that the error model predicts from the
measured pose and the carriage joints. It is whitened with the covariance of leg, carriage and pose
sensors, so that least squares, differential evolution and MCMC use the same likelihood.

Source: Wang 2012, sections 3.1.2 and 3.1.3 (Eq. 29 and its sum of squares); Khalil and Gautier 1991
(identifiable parameters).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.stats

from hydrotele.calibrate.design import Criterion, select_poses
from hydrotele.calibrate.estimation import ParameterFit, Prior, identifiable, least_squares
from hydrotele.calibrate.hybrid_data import Measurement
from hydrotele.core.errors import InputError
from hydrotele.identify.identifiability import COMBINATION, FULL, Identifiability
from hydrotele.kinematics.hybrid import (
    LEGS,
    ErrorModel,
    Hybrid,
    Kind,
    Unreachable,
    corrected,
    document_parameters,
    error_model,
    forward,
    pose_difference,
    predicted_readings,
)

_STEP = 1e-2  # of a parameter's scale, for central differences of second-order accuracy
_LEFT_OUT = 200  # maximum number of poses left out one by one
_MOST_OUT = 0.2  # maximum fraction of poses left out as inconsistent
_WRONG = 1e-6  # probability below which a pose's residual is not noise
_LARGE = 20.0  # scales above which an error cannot be due to manufacturing
_UNLIKELY = 1e-4  # probability below which the stated noise does not explain the residuals
_BETTER = 0.95  # ratio to the other model's error below which a model is preferred
_STILL = 1e-3  # m or rad: minimum range of a joint that moves
_LOADING = 1e-4  # minimum component of a null direction for a parameter to be part of it


@dataclass(frozen=True)
class Equations:
    """Whitened equations of a measurement: N poses, six each, for q of p parameters.

    Attributes:
        model: error model.
        measurement: measured poses.
        names: the q free parameters; all others are zero.
        whitening: (N, 6, 6) inverse Cholesky factors of the residuals' covariances.
    """

    model: ErrorModel
    measurement: Measurement
    names: tuple[str, ...]
    whitening: np.ndarray

    @property
    def scales(self) -> np.ndarray:
        """(q,) scales of the free parameters."""
        return self.model.scales[self.model.index(self.names)]

    def full(self, values: np.ndarray) -> np.ndarray:
        """Expand (..., q) free errors to errors of all parameters (..., p)."""
        values = np.asarray(values, float)
        whole = np.zeros((*values.shape[:-1], len(self.model.names)))
        whole[..., self.model.index(self.names)] = values
        return whole

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Return the whitened residuals of many parameter sets.

        Args:
            values: (W, q) free errors.

        Returns:
            (W, 6 N), of unit standard deviation if the noise is known.
        """
        m = self.measurement
        away = predicted_readings(
            self.model, self.full(values), m.joints, m.pose.rotation, m.pose.position
        )
        away -= m.legs
        return np.matmul(self.whitening, away[..., None])[..., 0].reshape(len(away), -1)

    def misfit(self, values: np.ndarray) -> np.ndarray:
        """Return half the sum of squared whitened residuals (W,), minus the log likelihood."""
        return 0.5 * np.einsum("wr,wr->w", *(2 * [self.residuals(values)]))

    def jacobian(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives (6 N, q) of the whitened residuals by central differences."""
        steps = np.diag(_STEP * self.scales)
        both = self.residuals(np.vstack([values + steps, values - steps]))
        q = len(self.names)
        return ((both[:q] - both[q:]) / (2.0 * _STEP * self.scales)[:, None]).T


def equations(
    model: ErrorModel, measurement: Measurement, names: Sequence[str] | None = None
) -> Equations:
    """Build the equations of a measurement.

    Args:
        model: error model.
        measurement: measured poses.
        names: free parameters; by default all.

    Raises:
        InputError: a parameter name is unknown.
    """
    names = tuple(names or model.names)
    model.index(names)
    factor = np.linalg.cholesky(measurement.covariance)
    return Equations(model, measurement, names, np.linalg.inv(factor))


class Redundancy(NamedTuple):
    """Redundant parameters of an error model for a given measurement.

    Attributes:
        rank: number of independent parameters, from the singular values of the Jacobian.
        held: names of the parameters left out to reach this rank, by pivoted QR.
        directions: (null, p) combinations of scaled parameters without effect on any reading.
        takes_part: names of the parameters with a component in these directions.
        words: explanations of the redundancy.
        singular: (p,) singular values of the Jacobian with unit columns, relative to the largest.
        told: names of the parameters whose standard deviation is below half of their scale.
    """

    rank: int
    held: tuple[str, ...]
    directions: np.ndarray
    takes_part: tuple[str, ...]
    words: tuple[str, ...]
    singular: np.ndarray
    told: tuple[str, ...]


def redundancy(eq: Equations, values: np.ndarray | None = None) -> Redundancy:
    """Find redundant parameters of equations from singular values and QR of the Jacobian.

    Args:
        eq: the equations.
        values: (q,) errors at which the Jacobian is evaluated; zero by default.

    Returns:
        The redundant parameters.

    Source: Khalil and Gautier 1991; Wang 2012, section 2.1 (minimality).
    """
    at = np.zeros(len(eq.names)) if values is None else values
    matrix = eq.jacobian(at) * eq.scales
    ones = np.ones(len(eq.names))
    first = [n for n in document_parameters(eq.model) if n in eq.names]
    exact = identifiable(matrix, eq.names, ones, first=first)
    length = np.linalg.norm(matrix, axis=0)
    there = length > 1e-11 * length.max()
    s = np.zeros(len(eq.names))
    s[: there.sum()] = np.linalg.svd(matrix[:, there] / length[there], compute_uv=False)
    rank = len(exact.base)
    held = tuple(n for k, n in enumerate(eq.names) if k not in set(exact.base))
    directions = null_directions(exact)
    shares = np.abs(directions).max(axis=0, initial=0.0)
    partners = tuple(n for n, share in zip(eq.names, shares, strict=True) if share > _LOADING)
    noisy = identifiable(matrix, eq.names, ones, sigma=1.0, first=first)
    told = tuple(eq.names[k] for k in sorted(noisy.base)
                 if noisy.status[k] in (FULL, COMBINATION))  # fmt: skip
    return Redundancy(rank, held, directions, partners, _in_words(eq, exact, held, partners),
                      s / s[0], told)  # fmt: skip


def null_directions(told: Identifiability) -> np.ndarray:
    """Return orthonormal parameter changes (null, p) that leave all base parameters unchanged."""
    _, s, v = np.linalg.svd(told.combination, full_matrices=True)
    return v[int(np.sum(s > 1e-9 * s[0])) :] if len(told.base) else np.eye(len(told.names))


def _in_words(eq: Equations, told: Identifiability, held, partners) -> tuple[str, ...]:
    words = []
    model, last = eq.model, len(eq.model.nominal.joints)
    for row, base in enumerate(told.base):
        others = [k for k in np.flatnonzero(told.combination[row]) if k != base]
        if others:
            words.append(f"identifiable only together: {told.text(row)}")
    carriage = [n for n in partners if n in model.names[: model.carriage_count]]
    own = {f"{part}{last}" for part in ("theta", "d", "a", "alpha")}
    if carriage and model.kind == "dh" and set(carriage) <= own and held:
        if all(n[0] == "a" for n in partners if n not in carriage):
            words.insert(
                0, f"{', '.join(carriage)} position the connecting platform after the last joint:"
                f" a common displacement of the universal joints A1 to A6 has the same effect"
                f" ({len(held)} redundant parameters)",
            )  # fmt: skip
    still = np.ptp(eq.measurement.joints, axis=0)
    for joint, moved in zip(model.nominal.joints, still, strict=True):
        if moved < _STILL:
            words.append(f"joint {joint} never moves: its axis is not identifiable; move it")
    return tuple(words)


class Errors(NamedTuple):
    """Errors of predicted poses.

    Attributes:
        position: (N,) distances [m].
        orientation: (N,) angles [rad].
    """

    position: np.ndarray
    orientation: np.ndarray

    def summary(self) -> dict[str, float]:
        """Return RMS and maximum errors in mm and mrad."""
        return {
            "position_rms_mm": 1e3 * float(np.sqrt(np.mean(self.position**2))),
            "position_max_mm": 1e3 * float(self.position.max()),
            "orientation_rms_mrad": 1e3 * float(np.sqrt(np.mean(self.orientation**2))),
            "orientation_max_mrad": 1e3 * float(self.orientation.max()),
        }


def pose_errors(robot: Hybrid, measurement: Measurement) -> Errors:
    """Compare the forward kinematics of the readings with the measured poses.

    Args:
        robot: nominal or calibrated robot.
        measurement: measured poses.

    Raises:
        InputError: the forward kinematics of a pose have no solution.
    """
    try:
        found = forward(robot, measurement.joints, measurement.legs, measurement.pose)
    except Unreachable as error:
        raise InputError(measurement.source, f"{error}: correct its leg readings") from None
    away = pose_difference(found, measurement.pose)
    return Errors(np.linalg.norm(away[:, :3], axis=1), np.linalg.norm(away[:, 3:], axis=1))


@dataclass(frozen=True)
class Calibration:
    """Result of the calibration of a hybrid robot.

    Attributes:
        model: error model.
        equations: equations from which the errors were identified.
        fit: least-squares fit of the free parameters.
        redundancy: redundancy of the free parameters.
        robot: calibrated robot.
        before: errors of the nominal robot at the poses.
        after: errors of the calibrated robot at the poses.
        wrong: rows of the poses left out as inconsistent.
        warnings: possible problems of the result, with remedies.
    """

    model: ErrorModel
    equations: Equations
    fit: ParameterFit
    redundancy: Redundancy
    robot: Hybrid
    before: Errors
    after: Errors
    wrong: tuple[int, ...]
    warnings: tuple[str, ...]

    @cached_property
    def left_out(self) -> Errors:
        """Errors of each pose predicted by a calibration without this pose."""
        return _left_out(self.equations, self.fit)

    @property
    def errors(self) -> np.ndarray:
        """(p,) identified errors of all parameters, zero for held parameters."""
        return self.equations.full(self.fit.values)


def calibrate(
    robot: Hybrid, measurement: Measurement, kind: Kind, names: Sequence[str] | None = None,
    prior: Prior | None = None,
) -> Calibration:  # fmt: skip
    """Identify the errors of a hybrid robot by least squares.

    Unidentifiable parameters keep their nominal values. Poses whose residuals cannot be noise are
    left out, at most 20 % of them, and are reported.

    Args:
        robot: nominal robot.
        measurement: measured poses.
        kind: kind of error model.
        names: free parameters; by default all parameters of the model.
        prior: prior of the free parameters; by default none.

    Returns:
        The calibration.

    Raises:
        InputError: there are too few different poses.
    """
    model = error_model(robot, kind)
    eq = equations(model, measurement, names)
    _check_poses(eq)
    wrong: list[int] = []
    while True:
        fit = _fit(eq, prior)
        suspect = _suspect(eq, fit)
        if suspect is None or len(wrong) + 1 > _MOST_OUT * len(measurement):
            break
        wrong.append(int(eq.measurement.rows[suspect]))
        kept = np.arange(len(eq.measurement)) != suspect
        eq = equations(model, eq.measurement.subset(kept), names)
    calibrated = corrected(model, eq.full(fit.values))
    return Calibration(
        model, eq, fit, redundancy(eq, fit.values), calibrated,
        pose_errors(model.nominal, eq.measurement), pose_errors(calibrated, eq.measurement),
        tuple(sorted(wrong)), _warnings(eq, fit),
    )  # fmt: skip


def best(robot: Hybrid, measurement: Measurement, names: Sequence[str] | None = None
         ) -> Calibration:  # fmt: skip
    """Calibrate with both error models; return the one that predicts left-out poses better.

    `dh` is preferred unless `poe` is better by more than 5 %. A robot specified by its axes has the
    `poe` model only.

    Args:
        robot: nominal robot.
        measurement: measured poses.
        names: free parameters of the `dh` model; by default all.

    Raises:
        InputError: as in `calibrate`.
    """
    if not robot.facts.carriage:
        return calibrate(robot, measurement, "poe", names)
    dh = calibrate(robot, measurement, "dh", names)
    if names is not None:
        return dh
    poe = calibrate(robot, measurement, "poe")
    size = [np.sqrt(np.mean(c.left_out.position**2)) for c in (dh, poe)]
    return poe if size[1] < _BETTER * size[0] else dh


def _warnings(eq: Equations, fit: ParameterFit) -> tuple[str, ...]:
    said = []
    units = [eq.model.units[k] for k in eq.model.index(eq.names)]
    large = np.flatnonzero(np.abs(fit.values) > _LARGE * eq.scales)
    if len(large):
        which = ", ".join(
            f"{fit.names[k]} {1e3 * fit.values[k]:.3g} {'mm' if units[k] == 'm' else 'mrad'}"
            for k in large[:6]
        )
        said.append(
            f"{which}: too large for manufacturing errors; the data are of another robot, a sensor"
            " has another zero, or a frame differs from that of the nominal robot"
        )
    if eq.measurement.stated:
        freedom = max(fit.freedom, 1.0)
        if scipy.stats.chi2.sf(freedom * fit.chi**2, freedom) < _UNLIKELY:
            said.append(
                f"residuals are {fit.chi:.2f} times as large as the stated noise predicts: the"
                " noise is larger than stated, or the error model (or its selected parameters)"
                " does not describe the robot"
            )
    if not fit.converged:
        said.append(fit.status)
    return tuple(said)


def _fit(eq: Equations, prior: Prior | None) -> ParameterFit:
    first = [n for n in document_parameters(eq.model) if n in eq.names]
    known = 1.0 if eq.measurement.stated else None
    return least_squares(
        lambda x: eq.residuals(x[None])[0], np.zeros(len(eq.names)), eq.names, eq.scales,
        sigma=known, prior=prior, jac=eq.jacobian, first=first,
    )  # fmt: skip


def _check_poses(eq: Equations) -> None:
    """Raise an error if there are not more equations than independent parameters."""
    m, q = eq.measurement, len(eq.names)
    matrix = eq.jacobian(np.zeros(q)) * eq.scales
    rank = len(identifiable(matrix, eq.names, np.ones(q)).base)
    if LEGS * m.distinct <= rank:
        same = "" if m.distinct == len(m) else f" ({len(m)} rows, many of them the same pose)"
        raise InputError(
            m.source,
            f"{m.distinct} different poses{same} give {LEGS * m.distinct} equations for"
            f" {q} parameters: measure at least {q // LEGS + 1} different poses, preferably twice"
            " as many, or identify fewer parameters (--parameters document)",
        )


def _suspect(eq: Equations, fit: ParameterFit) -> int | None:
    """Return the index of the pose whose residual is not noise, or None.

    The influence of each pose on the fit is removed from its six residuals. Relative to the noise
    of the other poses, their mean square follows an F(6, rest) distribution.
    """
    n = len(eq.measurement)
    residual = fit.residual.reshape(n, LEGS)
    free = np.flatnonzero(~fit.held)
    q, _ = np.linalg.qr(fit.jacobian[:, free] * fit.scales[free])
    q = q.reshape(n, LEGS, -1)
    leverage = np.einsum("nij,nkj->nik", q, q)
    rest = LEGS * (n - 1) - len(free)
    if rest < LEGS:
        return None
    inside = np.eye(LEGS) - leverage
    solid = np.linalg.eigvalsh(inside)[:, 0] > 1e-6
    squares = np.full(n, 0.0)
    squares[solid] = np.einsum(
        "ni,ni->n", residual[solid],
        np.linalg.solve(inside[solid], residual[solid][..., None])[..., 0],
    )  # fmt: skip
    total = float(np.sum(residual**2))
    left = np.maximum(total - squares, 1e-300)
    if total < 1e-12:  # residuals are rounding errors
        return None
    ratio = (squares / LEGS) / (left / rest)
    worst = int(np.argmax(ratio))
    return worst if scipy.stats.f.sf(ratio[worst], LEGS, rest) * n < _WRONG else None


def _left_out(eq: Equations, fit: ParameterFit) -> Errors:
    """Return each pose's prediction error by a calibration without it, for at most 200 poses.

    The equations are linear over changes smaller than the parameters' standard deviations. With
    the Jacobian Q R, the six rows Q_k and the residuals r_k of the pose, the change of parameters
    is R^-1 Q_k' (1 - Q_k Q_k')^-1 r_k. Poses without which the rank drops are skipped.
    """
    free = np.flatnonzero(~fit.held)
    n = len(eq.measurement)
    q, r = np.linalg.qr(fit.jacobian[:, free] * fit.scales[free])
    q, residual = q.reshape(n, LEGS, -1), fit.residual.reshape(n, LEGS)
    result = np.full((2, n), np.nan)
    for k in np.unique(np.linspace(0, n - 1, min(n, _LEFT_OUT)).astype(int)):
        inside = np.eye(LEGS) - q[k] @ q[k].T
        if np.linalg.eigvalsh(inside)[0] < 1e-9:
            continue
        step = np.linalg.solve(r, q[k].T @ np.linalg.solve(inside, residual[k]))
        values = fit.values.copy()
        values[free] += step * fit.scales[free]
        robot = corrected(eq.model, eq.full(values))
        try:
            found = pose_errors(robot, eq.measurement.subset(np.array([k])))
        except InputError:  # without this pose, the calibration is not valid there
            continue
        result[:, k] = found.position[0], found.orientation[0]
    known = ~np.isnan(result[0])
    return Errors(*(result[:, known] if known.any() else result))


def subset(calibration: Calibration) -> Equations:
    """Return the equations of a calibration restricted to its fitted parameters."""
    eq, held = calibration.equations, calibration.fit.held
    return replace(eq, names=tuple(n for n, h in zip(eq.names, held, strict=True) if not h))


def informative_poses(
    model: ErrorModel, candidates: Measurement, count: int, criterion: Criterion = "D"
) -> np.ndarray:
    """Select the most informative poses from candidates.

    Args:
        model: error model.
        candidates: poses as measured on the nominal robot, with their covariances.
        count: number of poses to select.
        criterion: `D` or an observability index `O1` to `O5`.

    Returns:
        (count,) indices of the poses.

    Raises:
        InputError: there are too few candidates or poses.
    """
    eq = equations(model, candidates)
    matrix = eq.jacobian(np.zeros(len(eq.names))) * eq.scales
    base = identifiable(matrix, eq.names, np.ones(len(eq.names))).base
    rows = matrix[:, base].reshape(len(candidates), LEGS, -1)
    return np.sort(select_poses(rows, count, criterion).chosen)

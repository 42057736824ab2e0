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

from hydrotele.calibrate.estimation import (
    ParameterFit,
    Prior,
    classify_scaled_parameters,
    least_squares,
)
from hydrotele.calibrate.hybrid_measurement import Measurement
from hydrotele.calibrate.pose_selection import Criterion, select_poses
from hydrotele.core.errors import InputError
from hydrotele.identify.identifiability import STATUS_COMBINATION, STATUS_FULL, Identifiability
from hydrotele.kinematics.hybrid_error_model import (
    ErrorModel,
    ErrorModelKind,
    apply_geometry_errors,
    build_error_model,
    predict_leg_readings,
    refined_model_parameters,
)
from hydrotele.kinematics.hybrid_robot import (
    LEG_COUNT,
    HybridRobot,
    UnreachableError,
    forward_kinematics,
    pose_difference,
)

_DIFFERENCE_STEP = 1e-2  # of a parameter's scale, for central differences of second-order accuracy
_MAX_LEFT_OUT_POSES = 200  # maximum number of poses left out one by one
_MAX_REMOVED_FRACTION = 0.2  # maximum fraction of poses left out as inconsistent
_MIN_POSE_PROBABILITY = 1e-6  # probability below which a pose's residual is not noise
_MAX_ERROR_SCALES = 20.0  # scales above which an error cannot be due to manufacturing
_MIN_NOISE_PROBABILITY = 1e-4  # probability below which the stated noise does not explain the residuals
_PREFERENCE_RATIO = 0.95  # ratio to the other model's error below which a model is preferred
_MIN_JOINT_RANGE = 1e-3  # m or rad: minimum range of a joint that moves
_MIN_NULL_COMPONENT = 1e-4  # minimum component of a null direction for a parameter to be part of it


@dataclass(frozen=True)
class PoseEquations:
    """Equations of leg readings at N measured poses, six each, for q free of p error parameters.

    The residuals are predicted minus measured leg readings, scaled (whitened) to unit covariance.

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
        """(q,) expected sizes (scales) of the free error parameters [m] or [rad]."""
        return self.model.scales[self.model.parameter_indices(self.names)]

    def expand_to_all_parameters(self, values: np.ndarray) -> np.ndarray:
        """Expand (..., q) errors of the free parameters to errors of all parameters (..., p), 0 for the others."""
        values = np.asarray(values, float)
        whole = np.zeros((*values.shape[:-1], len(self.model.names)))
        whole[..., self.model.parameter_indices(self.names)] = values
        return whole

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Compute the whitened residuals, predicted minus measured leg readings, of W parameter sets.

        Args:
            values: (W, q) free errors.

        Returns:
            (W, 6 N), of unit standard deviation if the noise is known.
        """
        m = self.measurement
        away = predict_leg_readings(
            self.model, self.expand_to_all_parameters(values), m.joints, m.pose.rotation, m.pose.position
        )
        away -= m.legs
        return np.matmul(self.whitening, away[..., None])[..., 0].reshape(len(away), -1)

    def negative_log_likelihood(self, values: np.ndarray) -> np.ndarray:
        """Return minus the log likelihood (W,) of W parameter sets (W, q), up to a constant.

        It is half the sum of squared whitened residuals.
        """
        return 0.5 * np.einsum("wr,wr->w", *(2 * [self.residuals(values)]))

    def jacobian(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives (6 N, q) of the whitened residuals at free errors (q,).

        They are computed by central differences.
        """
        steps = np.diag(_DIFFERENCE_STEP * self.scales)
        both = self.residuals(np.vstack([values + steps, values - steps]))
        q = len(self.names)
        return ((both[:q] - both[q:]) / (2.0 * _DIFFERENCE_STEP * self.scales)[:, None]).T


def build_equations(model: ErrorModel, measurement: Measurement, names: Sequence[str] | None = None) -> PoseEquations:
    """Build the equations that compare measured leg readings with those predicted by an error model.

    Args:
        model: error model.
        measurement: measured poses.
        names: free parameters; by default all.

    Raises:
        InputError: a parameter name is unknown.
    """
    names = tuple(names or model.names)
    model.parameter_indices(names)
    factor = np.linalg.cholesky(measurement.covariance)
    return PoseEquations(model, measurement, names, np.linalg.inv(factor))


class Redundancy(NamedTuple):
    """Redundant parameters of an error model for a given measurement.

    Attributes:
        rank: number of independent parameters, from the singular values of the Jacobian.
        held_names: names of the parameters left out to reach this rank, by pivoted QR.
        null_directions: (null, p) combinations of scaled parameters without effect on any reading.
        redundant_names: names of the parameters with a component in these directions.
        explanations: explanations of the redundancy.
        singular_values: (p,) singular values of the Jacobian with unit columns, relative to the largest.
        determined_names: names of the parameters whose standard deviation is below half of their scale.
    """

    rank: int
    held_names: tuple[str, ...]
    null_directions: np.ndarray
    redundant_names: tuple[str, ...]
    explanations: tuple[str, ...]
    singular_values: np.ndarray
    determined_names: tuple[str, ...]


def find_redundancy(eq: PoseEquations, values: np.ndarray | None = None) -> Redundancy:
    """Find parameters that the measured poses cannot separate, from the Jacobian's null space and QR.

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
    first = [n for n in refined_model_parameters(eq.model) if n in eq.names]
    exact = classify_scaled_parameters(matrix, eq.names, ones, preferred=first)
    length = np.linalg.norm(matrix, axis=0)
    there = length > 1e-11 * length.max()
    s = np.zeros(len(eq.names))
    s[: there.sum()] = np.linalg.svd(matrix[:, there] / length[there], compute_uv=False)
    rank = len(exact.base)
    held = tuple(n for k, n in enumerate(eq.names) if k not in set(exact.base))
    directions = null_directions(exact)
    shares = np.abs(directions).max(axis=0, initial=0.0)
    partners = tuple(n for n, share in zip(eq.names, shares, strict=True) if share > _MIN_NULL_COMPONENT)
    noisy = classify_scaled_parameters(matrix, eq.names, ones, sigma=1.0, preferred=first)
    told = tuple(eq.names[k] for k in sorted(noisy.base)
                 if noisy.status[k] in (STATUS_FULL, STATUS_COMBINATION))  # fmt: skip
    return Redundancy(rank, held, directions, partners, _explain_redundancy(eq, exact, held, partners),
                      s / s[0], told)  # fmt: skip


def null_directions(identifiability: Identifiability) -> np.ndarray:
    """Return orthonormal parameter changes (null, p) that change none of the identifiable combinations."""
    _, s, v = np.linalg.svd(identifiability.combination, full_matrices=True)
    return v[int(np.sum(s > 1e-9 * s[0])) :] if len(identifiability.base) else np.eye(len(identifiability.names))


def _explain_redundancy(eq: PoseEquations, identifiability: Identifiability, held, partners) -> tuple[str, ...]:
    words = []
    model, last = eq.model, len(eq.model.nominal.joints)
    for row, base in enumerate(identifiability.base):
        others = [k for k in np.flatnonzero(identifiability.combination[row]) if k != base]
        if others:
            words.append(f"identifiable only together: {identifiability.format_combination(row)}")
    carriage = [n for n in partners if n in model.names[: model.carriage_parameter_count]]
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
        if moved < _MIN_JOINT_RANGE:
            words.append(f"joint {joint} never moves: its axis is not identifiable; move it")
    return tuple(words)


class PoseErrors(NamedTuple):
    """Errors of N predicted platform poses relative to the measured ones.

    Attributes:
        position: (N,) distances of the platform's origin [m].
        orientation: (N,) angles of the relative rotation [rad].
    """

    position: np.ndarray
    orientation: np.ndarray

    def summarize(self) -> dict[str, float]:
        """Return RMS and largest errors of position [mm] and orientation [mrad] by name."""
        return {
            "position_rms_mm": 1e3 * float(np.sqrt(np.mean(self.position**2))),
            "position_max_mm": 1e3 * float(self.position.max()),
            "orientation_rms_mrad": 1e3 * float(np.sqrt(np.mean(self.orientation**2))),
            "orientation_max_mrad": 1e3 * float(self.orientation.max()),
        }


def pose_errors(robot: HybridRobot, measurement: Measurement) -> PoseErrors:
    """Compute the errors of platform poses computed from joint and leg readings by forward kinematics.

    They are relative to the measured poses.

    Args:
        robot: nominal or calibrated robot.
        measurement: measured poses.

    Raises:
        InputError: the forward kinematics of a pose have no solution.
    """
    try:
        found = forward_kinematics(robot, measurement.joints, measurement.legs, measurement.pose)
    except UnreachableError as error:
        raise InputError(measurement.source, f"{error}: correct its leg readings") from None
    away = pose_difference(found, measurement.pose)
    return PoseErrors(np.linalg.norm(away[:, :3], axis=1), np.linalg.norm(away[:, 3:], axis=1))


@dataclass(frozen=True)
class Calibration:
    """Result of the calibration of a hybrid robot.

    Attributes:
        model: error model.
        equations: equations from which the errors were identified.
        fit: least-squares fit of the free parameters.
        redundancy: redundancy of the free parameters.
        robot: calibrated robot.
        nominal_errors: errors of the nominal robot at the poses.
        calibrated_errors: errors of the calibrated robot at the poses.
        inconsistent_rows: rows of the poses left out as inconsistent.
        warnings: possible problems of the result, with remedies.
    """

    model: ErrorModel
    equations: PoseEquations
    fit: ParameterFit
    redundancy: Redundancy
    robot: HybridRobot
    nominal_errors: PoseErrors
    calibrated_errors: PoseErrors
    inconsistent_rows: tuple[int, ...]
    warnings: tuple[str, ...]

    @cached_property
    def leave_one_out_errors(self) -> PoseErrors:
        """Errors of poses, each predicted by a linearised calibration to all other poses.

        They are computed for at most 200 poses, evenly spaced.
        """
        return _leave_one_out_errors(self.equations, self.fit)

    @property
    def parameter_errors(self) -> np.ndarray:
        """(p,) identified errors of all parameters, zero for held parameters."""
        return self.equations.expand_to_all_parameters(self.fit.values)


def calibrate_hybrid_robot(
    robot: HybridRobot, measurement: Measurement, kind: ErrorModelKind, names: Sequence[str] | None = None,
    prior: Prior | None = None,
) -> Calibration:  # fmt: skip
    """Identify the errors of a hybrid robot by least squares.

    Unidentifiable parameters keep their nominal values. Poses whose residuals cannot be noise (F
    test, probability below 1e-6) are left out one by one, at most 20 % of them, and are reported.

    Args:
        robot: nominal robot.
        measurement: measured poses.
        kind: error model, `dh` (errors of D-H rows) or `poe` (errors of axis lines).
        names: free parameters; by default all parameters of the model.
        prior: prior of the free parameters; by default none.

    Returns:
        The calibration.

    Raises:
        InputError: there are too few different poses.

    Examples:
        The robot of Wang 2012 (four serial axes that carry a hexapod), simulated with random errors:

        >>> from hydrotele.experiments.wang_robots import simulate_robot
        >>> from hydrotele.kinematics.hybrid_error_model import build_error_model, refined_model_parameters
        >>> from hydrotele.kinematics.hybrid_robot import load_hybrid
        >>> robot = load_hybrid("iwr")
        >>> simulated = simulate_robot(1, 25, noise=0.0)
        >>> names = refined_model_parameters(build_error_model(robot, "dh"))
        >>> found = calibrate_hybrid_robot(robot, simulated.measurement, "dh", names)
        >>> found.redundancy.rank, len(names)  # all 36 errors are identifiable
        (36, 36)
        >>> f"{1e3 * pose_errors(robot, simulated.measurement).position.max():.1f} mm before"
        '12.1 mm before'
        >>> bool(pose_errors(found.robot, simulated.measurement).position.max() < 1e-9)  # m, after
        True
    """
    model = build_error_model(robot, kind)
    eq = build_equations(model, measurement, names)
    _check_poses(eq)
    wrong: list[int] = []
    while True:
        fit = _fit_equations(eq, prior)
        suspect = _find_inconsistent_pose(eq, fit)
        if suspect is None or len(wrong) + 1 > _MAX_REMOVED_FRACTION * len(measurement):
            break
        wrong.append(int(eq.measurement.rows[suspect]))
        kept = np.arange(len(eq.measurement)) != suspect
        eq = build_equations(model, eq.measurement.subset(kept), names)
    calibrated = apply_geometry_errors(model, eq.expand_to_all_parameters(fit.values))
    return Calibration(
        model, eq, fit, find_redundancy(eq, fit.values), calibrated,
        pose_errors(model.nominal, eq.measurement), pose_errors(calibrated, eq.measurement),
        tuple(sorted(wrong)), _collect_warnings(eq, fit),
    )  # fmt: skip


def calibrate_best_model(robot: HybridRobot, measurement: Measurement, names: Sequence[str] | None = None
         ) -> Calibration:  # fmt: skip
    """Calibrate with both error models; return the calibration that predicts left-out poses better.

    The models are `dh` (errors of D-H rows) and `poe` (errors of axis lines). The criterion is the
    RMS position error of poses predicted without them (leave-one-out). `dh` is preferred unless
    `poe` is better by more than 5 %. A robot specified by its axes has the `poe` model only.
    If `names` are given for another robot, only `dh` is calibrated.

    Args:
        robot: nominal robot.
        measurement: measured poses.
        names: free parameters; by default all.

    Raises:
        InputError: as in `calibrate_hybrid_robot`.
    """
    if not robot.specification.carriage:
        return calibrate_hybrid_robot(robot, measurement, "poe", names)
    dh = calibrate_hybrid_robot(robot, measurement, "dh", names)
    if names is not None:
        return dh
    poe = calibrate_hybrid_robot(robot, measurement, "poe")
    size = [np.sqrt(np.mean(c.leave_one_out_errors.position**2)) for c in (dh, poe)]
    return poe if size[1] < _PREFERENCE_RATIO * size[0] else dh


def _collect_warnings(eq: PoseEquations, fit: ParameterFit) -> tuple[str, ...]:
    said = []
    units = [eq.model.units[k] for k in eq.model.parameter_indices(eq.names)]
    large = np.flatnonzero(np.abs(fit.values) > _MAX_ERROR_SCALES * eq.scales)
    if len(large):
        which = ", ".join(
            f"{fit.names[k]} {1e3 * fit.values[k]:.3g} {'mm' if units[k] == 'm' else 'mrad'}" for k in large[:6]
        )
        said.append(
            f"{which}: too large for manufacturing errors; the data are of another robot, a sensor"
            " has another zero, or a frame differs from that of the nominal robot"
        )
    if eq.measurement.noise_is_known:
        freedom = max(fit.degrees_of_freedom, 1.0)
        if scipy.stats.chi2.sf(freedom * fit.chi**2, freedom) < _MIN_NOISE_PROBABILITY:
            said.append(
                f"residuals are {fit.chi:.2f} times as large as the stated noise predicts: the"
                " noise is larger than stated, or the error model (or its selected parameters)"
                " does not describe the robot"
            )
    if not fit.converged:
        said.append(fit.status)
    return tuple(said)


def _fit_equations(eq: PoseEquations, prior: Prior | None) -> ParameterFit:
    first = [n for n in refined_model_parameters(eq.model) if n in eq.names]
    known = 1.0 if eq.measurement.noise_is_known else None
    return least_squares(
        lambda x: eq.residuals(x[None])[0], np.zeros(len(eq.names)), eq.names, eq.scales,
        sigma=known, prior=prior, jac=eq.jacobian, preferred=first,
    )  # fmt: skip


def _check_poses(eq: PoseEquations) -> None:
    """Raise InputError unless the different poses give more equations than independent parameters."""
    m, q = eq.measurement, len(eq.names)
    matrix = eq.jacobian(np.zeros(q)) * eq.scales
    rank = len(classify_scaled_parameters(matrix, eq.names, np.ones(q)).base)
    if LEG_COUNT * m.distinct_count <= rank:
        same = "" if m.distinct_count == len(m) else f" ({len(m)} rows, many of them the same pose)"
        raise InputError(
            m.source,
            f"{m.distinct_count} different poses{same} give {LEG_COUNT * m.distinct_count} equations for"
            f" {q} parameters: measure at least {q // LEG_COUNT + 1} different poses, preferably twice"
            " as many, or identify fewer parameters (--parameters document)",
        )


def _find_inconsistent_pose(eq: PoseEquations, fit: ParameterFit) -> int | None:
    """Return the index of the pose whose residual is least likely to be noise; None if all can be noise.

    The influence of each pose on the fit is removed from its six residuals. The ratio of their mean
    square to that of the other poses, with `rest` degrees of freedom, has an F(6, rest) distribution.
    A pose is inconsistent if its probability times the number of poses is below 1e-6.
    """
    n = len(eq.measurement)
    residual = fit.residual.reshape(n, LEG_COUNT)
    free = np.flatnonzero(~fit.held)
    q, _ = np.linalg.qr(fit.jacobian[:, free] * fit.scales[free])
    q = q.reshape(n, LEG_COUNT, -1)
    leverage = np.einsum("nij,nkj->nik", q, q)
    rest = LEG_COUNT * (n - 1) - len(free)
    if rest < LEG_COUNT:
        return None
    inside = np.eye(LEG_COUNT) - leverage
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
    ratio = (squares / LEG_COUNT) / (left / rest)
    worst = int(np.argmax(ratio))
    return worst if scipy.stats.f.sf(ratio[worst], LEG_COUNT, rest) * n < _MIN_POSE_PROBABILITY else None


def _leave_one_out_errors(eq: PoseEquations, fit: ParameterFit) -> PoseErrors:
    """Compute the error of each pose, predicted by a calibration without it, for at most 200 poses.

    The equations are linear over changes smaller than the parameters' standard deviations. With
    the Jacobian Q R, the six rows Q_k and the residuals r_k of the pose, the change of parameters
    is R^-1 Q_k' (1 - Q_k Q_k')^-1 r_k. Poses without which the rank drops are skipped.
    """
    free = np.flatnonzero(~fit.held)
    n = len(eq.measurement)
    q, r = np.linalg.qr(fit.jacobian[:, free] * fit.scales[free])
    q, residual = q.reshape(n, LEG_COUNT, -1), fit.residual.reshape(n, LEG_COUNT)
    result = np.full((2, n), np.nan)
    for k in np.unique(np.linspace(0, n - 1, min(n, _MAX_LEFT_OUT_POSES)).astype(int)):
        inside = np.eye(LEG_COUNT) - q[k] @ q[k].T
        if np.linalg.eigvalsh(inside)[0] < 1e-9:
            continue
        step = np.linalg.solve(r, q[k].T @ np.linalg.solve(inside, residual[k]))
        values = fit.values.copy()
        values[free] += step * fit.scales[free]
        robot = apply_geometry_errors(eq.model, eq.expand_to_all_parameters(values))
        try:
            found = pose_errors(robot, eq.measurement.subset(np.array([k])))
        except InputError:  # without this pose, the calibration is not valid there
            continue
        result[:, k] = found.position[0], found.orientation[0]
    known = ~np.isnan(result[0])
    return PoseErrors(*(result[:, known] if known.any() else result))


def restrict_to_fitted_parameters(calibration: Calibration) -> PoseEquations:
    """Return a calibration's equations with only the parameters that were fitted, without held ones."""
    eq, held = calibration.equations, calibration.fit.held
    return replace(eq, names=tuple(n for n, h in zip(eq.names, held, strict=True) if not h))


def select_informative_poses(
    model: ErrorModel, candidates: Measurement, count: int, criterion: Criterion = "D"
) -> np.ndarray:
    """Select the candidate poses whose measurement determines the error parameters best.

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
    eq = build_equations(model, candidates)
    matrix = eq.jacobian(np.zeros(len(eq.names))) * eq.scales
    base = classify_scaled_parameters(matrix, eq.names, np.ones(len(eq.names))).base
    rows = matrix[:, base].reshape(len(candidates), LEG_COUNT, -1)
    return np.sort(select_poses(rows, count, criterion).chosen)

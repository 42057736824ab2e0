"""Closed-chain calibration of a serial robot from joint angles, with its ball in sockets.

While the ball is in a socket, the robot moves in its null space and all postures must put the ball
at one position. Unknown are six errors in front of every joint, the ball position in the last link,
and the socket positions, which are eliminated as means. The known distance of two sockets of one
tool gives the scale.

Parameters of one kind (lengths, tilts, joint offsets ...) have a normal prior with a common
standard deviation. These standard deviations and the noise maximise the evidence, so that no
regularisation weight has to be chosen. Joint deflection under gravity and encoder eccentricity are
added if they improve the cross-validated prediction.

Source: Khoshzaban 1992, chapter 3 (closed chain with a passive end point); Franzese, Spahn, Kober
and Della Santina 2025, MUKCa (ball and sockets).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.stats

from hydrotele.calibrate.estimation import (
    ParameterFit,
    Prior,
    classify_scaled_parameters,
    least_squares,
)
from hydrotele.calibrate.socket_measurement import Socket, place_names
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import chain_poses, chain_poses_and_derivatives
from hydrotele.kinematics.serial_robot import (
    SerialRobot,
    apply_calibrated_parameters,
    correction_derivatives,
    correction_names,
    robot_chain,
)
from hydrotele.kinematics.serial_robot_files import load_robot, shipped_robots

_MIN_SIZE_RATIO = 1e-7  # minimum size relative to its start: the kind has no errors
_MAX_SIZE_RATIO = 1e2  # 0.1 m and 0.1 rad: larger sizes make all points coincide, which fits any data
_MAX_ROUNDS, _SIZE_TOLERANCE = 200, 1e-4


@dataclass(frozen=True)
class ErrorSizes:
    """Estimated standard deviations of the parameters' normal priors and of the noise.

    Attributes:
        std: (p,) prior standard deviation of each parameter.
        noise: standard deviation of an equation's error.
        effective_parameters: effective number of parameters determined by the equations.
        rounds: number of iterations.
    """

    std: np.ndarray
    noise: float
    effective_parameters: float
    rounds: int


def estimate_prior_std_by_kind(
    matrix: np.ndarray, right_hand_side: np.ndarray, kinds: Sequence[str], start: np.ndarray,
    degrees_of_freedom: float, noise: float, known: np.ndarray | None = None,
    known_right_hand_side: np.ndarray | None = None, min_noise: float = 0.0,
) -> ErrorSizes:  # fmt: skip
    """Estimate the prior standard deviation of each kind of parameters, and the noise, by maximum evidence.

    For `right_hand_side = matrix x + error` with x ~ N(0, s_kind^2), a fixed point is iterated:
    `s^2 = sum x^2 / sum g` over the parameters of a kind, and
    `noise^2 = |error|^2 / (freedom - sum g)` with the sum over all parameters. Here x is the
    posterior mean, S its covariance, and `g = 1 - S_ii / s^2` is the fraction of a parameter that
    the measurements determine. Each s stays within 1e-7 to 100 times its start.

    Args:
        matrix: (m, p) equations with the unknown noise.
        right_hand_side: (m,) right-hand side of these equations.
        kinds: (p,) kind of each parameter; "" for one whose standard deviation stays at `start`.
        start: (p,) initial standard deviations.
        degrees_of_freedom: degrees of freedom of the m equations before parameters are fitted.
        noise: initial standard deviation of the noise.
        known: (r, p) equations whose error has the standard deviation 1, or None.
        known_right_hand_side: (r,) right-hand side of the known equations.
        min_noise: lower bound of the noise.

    Returns:
        The standard deviations of parameters and noise.

    Source: MacKay 1992, Bayesian interpolation; Tipping 2001 (sizes that vanish).
    """
    basis, triangle = np.linalg.qr(matrix)
    inside = basis.T @ right_hand_side
    outside = float(np.sum((right_hand_side - basis @ inside) ** 2))
    if known is None or known_right_hand_side is None:
        known, known_right_hand_side = np.empty((0, matrix.shape[1])), np.empty(0)
    std = np.array(start, float)
    groups = {kind: np.flatnonzero([k == kind for k in kinds]) for kind in set(kinds) - {""}}
    decided = np.zeros(len(std))
    for rounds in range(1, _MAX_ROUNDS + 1):  # noqa: B007 - reported
        # scaled by size and noise, solved by SVD, so that small noise causes no rounding errors
        scaled = np.vstack([triangle / noise, known]) * std
        wanted = np.concatenate([inside / noise, known_right_hand_side])
        u, s, v = np.linalg.svd(scaled, full_matrices=False)
        value = std * (v.T @ (s / (1.0 + s**2) * (u.T @ wanted)))
        decided = (s**2 / (1.0 + s**2)) @ v**2
        error = float(np.sum((inside - triangle @ value) ** 2)) + outside
        before = np.append(std, noise)
        noise = max(
            float(np.sqrt(max(error, 1e-300) / max(degrees_of_freedom - decided.sum(), 1.0))),
            min_noise,
        )
        for places in groups.values():
            share = decided[places].sum()
            size = np.sqrt(np.sum(value[places] ** 2) / share) if share > 0.0 else 0.0
            first = start[places]
            std[places] = np.clip(size, _MIN_SIZE_RATIO * first, _MAX_SIZE_RATIO * first)
        change = np.abs(np.log(np.append(std, noise) / before))
        there = np.append(std > 10.0 * _MIN_SIZE_RATIO * start, True)
        if change[there].max() < _SIZE_TOLERANCE:
            break
    return ErrorSizes(std, noise, float(decided.sum()), rounds)


def cross_validation_error(
    matrix: np.ndarray, right_hand_side: np.ndarray, folds: np.ndarray, sizes: ErrorSizes,
    known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> float:  # fmt: skip
    """Return the RMS error of equations, each predicted by a fit to the equations of all other folds.

    Args:
        matrix: (m, p) equations, linear in the parameters.
        right_hand_side: (m,) right-hand side of the equations.
        folds: (m,) number of the fold, a group that is left out together, of each equation.
        sizes: standard deviations of parameters and noise, the same for all folds.
        known: equations (r, p) with an error of standard deviation 1, their right-hand side (r,) and
            folds (r,), such as those of known distances of sockets. They are fitted with the other
            folds but not predicted.

    Returns:
        The error, in the unit of the equations.

    >>> x = np.linspace(-1.0, 1.0, 40)
    >>> line = np.column_stack([np.ones(40), x])
    >>> sizes = ErrorSizes(np.ones(2), 0.01, 2.0, 1)
    >>> cross_validation_error(line, 1.0 + 2.0 * x, np.arange(40) % 4, sizes) < 1e-4
    True
    """
    # Each fold is compressed to its triangular factor. Normal equations would square the condition
    # number, which is large for frames far from the robot.
    scaled = np.column_stack([matrix * (sizes.std / sizes.noise), right_hand_side / sizes.noise])
    factors = [np.linalg.qr(scaled[folds == fold])[1] for fold in np.unique(folds)]
    prior = np.eye(scaled.shape[1])[:-1]
    stated, of = prior[:0], np.empty(0)
    if known is not None:
        stated, of = np.column_stack([known[0] * sizes.std, known[1]]), known[2]
    total = 0.0
    for k, (fold, own) in enumerate(zip(np.unique(folds), factors, strict=True)):
        rest = np.vstack([prior, stated[of != fold], *factors[:k], *factors[k + 1 :]])
        value = np.linalg.lstsq(rest[:, :-1], rest[:, -1], rcond=None)[0]
        total += float(np.sum((own[:, -1] - own[:, :-1] @ value) ** 2))
    return sizes.noise * float(np.sqrt(total / len(right_hand_side)))


JOINT_MODELS = {
    "rigid": (False, False),
    "gravity": (True, False),
    "eccentricity": (False, True),
    "both": (True, True),
}
"""Joint models: (deflection under gravity, encoder errors once per turn) by name."""

_START_SIZE = 1e-3  # m and rad, initial size: a typical tolerance
_START_SAG_SIZE = 1e-4  # rad s^2/m^2, initial size: 1 mrad per kilogram at 1 m
_BALL_PRIOR_STD = 0.3  # m, prior standard deviation of the ball position in the last link
_MIN_NOISE = 1e-8  # m, minimum noise: below it rounding determines the result
_MAX_PASSES, _NOISE_TOLERANCE = 6, 1e-3
_MEDIAN_CHI3 = 1.5382  # median length of three standard normal errors
_FALSE_ALARM_PROBABILITY = 1e-3  # probability that normal noise causes an outlier in any row of a data set
# Scatter of the ball relative to its travel if the joints moved independently. It is below 0.02 for
# the nominal robot and close to 1 for another robot, unit or sign, whatever the robot's size.
_MAX_RELATIVE_SCATTER = 0.05
_MAX_SCATTER_RATIO = 5.0  # ratio of a file's scatter to that of the others above which it is of another robot
_MAX_DISTANCE_SIGMAS = 3.0  # in scatters of the nominal robot's ball, for the distance of two sockets
_MAX_FITTED_DISTANCE_SIGMAS = 10.0  # in standard deviations of the fitted distance; effects that are not modelled
_MAX_LENGTH_RATIO = 0.1  # error of a length relative to the robot's reach: not due to manufacturing
_MAX_ANGLE_ERROR = 0.3  # rad, error of an angle that is not due to assembly or the zero of an encoder
_KIND_BY_LETTER = {"t": "length", "r": "tilt"}


@dataclass(frozen=True)
class SocketOptions:
    """Options of the calibration of a robot from postures with its ball in sockets.

    Attributes:
        distance: distance of neighbouring sockets of one tool [m]; None if unknown.
        accuracy: standard deviation of that distance [m].
        model: joint model, a key of `JOINT_MODELS`; None to select it by cross-validation.
    """

    distance: float | None = 0.050
    accuracy: float = 5.0e-5
    model: str | None = None


@dataclass(frozen=True)
class Outlier:
    """A measured posture (row) whose predicted ball position disagrees with most rows of its socket.

    Attributes:
        socket: name of the socket.
        line: line number in its file.
        distance: distance of the ball from the mean of the socket's consistent rows [m].
    """

    socket: str
    line: int
    distance: float


@dataclass(frozen=True)
class SocketErrors:
    """Prediction errors of a robot whose ball was in sockets; each row is one posture.

    Attributes:
        rms: root mean square distance of the predicted balls from their sockets' means [m].
        rms_without_outliers: the same without the rows in `outliers`.
        rms_by_socket: root mean square distance [m] by socket.
        socket_distances: distance of the first two sockets' mean balls [m] by place of the tool.
        outliers: rows that disagree with the other rows of their socket.
        distances_by_socket: distance of each row's ball from the socket's mean [m] by socket.
    """

    rms: float
    rms_without_outliers: float
    rms_by_socket: dict[str, float]
    socket_distances: dict[str, float]
    outliers: tuple[Outlier, ...]
    distances_by_socket: dict[str, np.ndarray]


@dataclass(frozen=True)
class SocketCalibration:
    """Result of the calibration of a robot from postures with its ball in sockets.

    Attributes:
        nominal: the given robot.
        robot: the calibrated robot.
        model: joint model, a key of `JOINT_MODELS`.
        model_errors: cross-validated RMS error of a coordinate [m] by joint model.
        fit: fit of all parameters.
        sizes: estimated prior standard deviation [m], [rad] or [rad s^2/m^2] by kind of parameter.
        noise: standard deviation of one coordinate of the ball [m].
        nominal_errors: errors of the nominal robot with its ball fitted, at all sockets.
        calibrated_errors: errors of the calibrated robot at all sockets.
        outliers: rows that were not fitted.
        options: options of the calibration.
    """

    nominal: SerialRobot
    robot: SerialRobot
    model: str
    model_errors: dict[str, float]
    fit: ParameterFit
    sizes: dict[str, float]
    noise: float
    nominal_errors: SocketErrors
    calibrated_errors: SocketErrors
    outliers: tuple[Outlier, ...]
    options: SocketOptions = field(default_factory=SocketOptions)


@dataclass(frozen=True)
class HeldOutPrediction:
    """Errors at the sockets of one place of the tool, or at one socket, that were not used to calibrate.

    Attributes:
        name: name of the place or socket.
        given_errors: errors of the nominal robot with the ball position of its file.
        nominal_errors: errors of the nominal robot with the ball fitted to all others.
        calibrated_errors: errors of the robot calibrated on all others.
        model: joint model, a key of `JOINT_MODELS`, selected without this place or socket.
    """

    name: str
    given_errors: SocketErrors
    nominal_errors: SocketErrors
    calibrated_errors: SocketErrors
    model: str


class _SocketProblem:
    """Equations of a robot whose ball is at one position in all n postures of each socket.

    The p unknowns are the parameters of the robot's chain and the joint corrections `extra`
    (deflection under gravity, encoder eccentricity). Socket positions are eliminated as means.
    """

    def __init__(self, robot: SerialRobot, sockets: Sequence[Socket], extra: Sequence[str], options):
        self.robot, self.sockets, self.extra = robot, tuple(sockets), tuple(extra)
        self.chain = robot_chain(robot)
        self.names = (*self.chain.parameters, *self.extra)
        self.joints = np.vstack([s.joints for s in sockets])
        self.index = np.repeat(np.arange(len(sockets)), [len(s.joints) for s in sockets])
        self.count = np.bincount(self.index)
        self.first = np.concatenate([[0], np.cumsum(self.count)[:-1]])
        self.basis = correction_derivatives(robot, self.joints, self.extra)
        self.start = np.concatenate([self.chain.nominal_values, np.zeros(len(self.extra))])
        self.options = options
        self.pairs = _neighbour_pairs(sockets) if options.distance is not None else []

    @property
    def degrees_of_freedom(self) -> int:
        """Number of ball coordinates minus that of the unknown socket positions."""
        return 3 * (len(self.joints) - len(self.sockets))

    def socket_means(self, values: np.ndarray) -> np.ndarray:
        """Return the means of values (n, ...) over the rows of each socket, (sockets, ...)."""
        total = np.add.reduceat(values, self.first, axis=0)
        return total / self.count.reshape(-1, *[1] * (values.ndim - 1))

    def predict_balls(self, x: np.ndarray) -> np.ndarray:
        """Compute the ball positions (n, 3) [m] in the base frame of all n postures for parameters x (p,)."""
        p = len(self.chain.nominal_values)
        joints = self.joints + self.basis @ x[p:] if self.extra else self.joints
        return chain_poses(self.chain, joints, x[:p]).position

    def subtract_means(self, balls: np.ndarray) -> np.ndarray:
        """Return ball positions `balls` (n, 3) minus the mean ball position of each one's socket [m]."""
        return balls - self.socket_means(balls)[self.index]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals [m]: ball positions minus their socket's mean, then socket distance errors.

        A distance error is the distance of the mean ball positions in two neighbouring sockets
        minus the stated distance.
        """
        balls = self.predict_balls(x)
        means = self.socket_means(balls)
        gaps = [np.linalg.norm(means[a] - means[b]) - self.options.distance for a, b in self.pairs]
        return np.concatenate([(balls - means[self.index]).ravel(), gaps])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives (equations, p) of the ball positions and socket distances in `residual`."""
        p = len(self.chain.nominal_values)
        joints = self.joints + self.basis @ x[p:] if self.extra else self.joints
        rates = chain_poses_and_derivatives(self.chain, joints, x[:p])
        whole = rates.position_by_parameter
        if self.extra:
            whole = np.concatenate([whole, rates.position_by_joint @ self.basis], axis=2)
        means, middle = self.socket_means(rates.position), self.socket_means(whole)
        rows = [(whole - middle[self.index]).reshape(-1, whole.shape[2])]
        for a, b in self.pairs:
            way = means[a] - means[b]
            way = way / max(float(np.linalg.norm(way)), 1e-12)
            rows.append((way @ (middle[a] - middle[b]))[None])
        return np.vstack(rows)

    def equation_standard_deviations(self, noise: float) -> np.ndarray:
        """Return the standard deviation of each equation of `residual` [m] for ball noise `noise` [m].

        That of a socket distance includes the accuracy of the stated distance.
        """
        means = [1.0 / self.count[a] + 1.0 / self.count[b] for a, b in self.pairs]
        gaps = np.sqrt(self.options.accuracy**2 + noise**2 * np.array(means))
        return np.concatenate([np.full(3 * len(self.joints), noise), gaps])


def choose_robot(sockets: Sequence[Socket]) -> tuple[SerialRobot, dict[str, float]]:
    """Select the shipped robot that puts the ball most consistently at one position per socket.

    The criterion is the scatter of the ball in its sockets, with its position in the last link fitted,
    over its free travel, the scatter after each joint's readings are permuted at random.

    Args:
        sockets: the measurements.

    Returns:
        The robot, and the median distance [m] of the ball from its socket's mean by candidate.

    Raises:
        InputError: no shipped robot has this number of joints, or the criterion of all exceeds 5 %.
    """
    count, folder = sockets[0].joints.shape[1], sockets[0].path.parent
    robots = {name: load_robot(name) for name in shipped_robots()}
    robots = {name: robot for name, robot in robots.items() if len(robot.joints) == count}
    if not robots:
        raise InputError(
            folder, f"has {count} columns, but no shipped robot has {count} joints:"
            f" give --robot FILE (YAML, URDF or MJCF)"
        )  # fmt: skip
    found = {name: _ball_scatter(robot, sockets) for name, robot in robots.items()}
    best = min(found, key=lambda name: found[name].relative)
    if found[best].relative > _MAX_RELATIVE_SCATTER:
        said = ", ".join(f"{name} {_format_scatter(one)}" for name, one in found.items())
        raise InputError(
            folder, f"no shipped robot fits the measurements (median scatter of the ball: {said}):"
            f" give --robot FILE (YAML, URDF or MJCF){_unit_hint(robots, sockets)}"
        )  # fmt: skip
    return robots[best], {name: one.distance for name, one in found.items()}


def check_robot_fits_sockets(
    robot: SerialRobot, sockets: Sequence[Socket], options: SocketOptions | None = None
) -> None:
    """Raise InputError if a robot's ball positions scatter too much within the sockets.

    The scatter is compared with the free travel, the scatter if the joints moved independently. In a
    socket, the motions of the joints cancel; with another unit, sign or order they do not.

    Args:
        robot: nominal robot.
        sockets: the measurements.
        options: options of the calibration; by default the distance of the sockets is unknown.

    Raises:
        InputError: the scatter exceeds 5 % of the free travel, that of one file also five times the
            median, or the distance of two sockets differs by more than 3 (scatter + accuracy).
    """
    scatter = _ball_scatter(robot, sockets)
    if scatter.relative > _MAX_RELATIVE_SCATTER:
        raise InputError(
            sockets[0].path.parent, f"the ball of robot {robot.name} scatters by {_format_scatter(scatter)}"
            f" (at most {100.0 * _MAX_RELATIVE_SCATTER:.0f} %): another robot, another order, sign or unit of joints,"
            f" or postures that differ too little{_unit_hint({robot.name: robot}, sockets)}"
        )  # fmt: skip
    for socket, ratio, spread in zip(sockets, scatter.relative_by_socket, scatter.distance_by_socket, strict=True):
        if ratio > max(_MAX_RELATIVE_SCATTER, _MAX_SCATTER_RATIO * scatter.relative):
            raise InputError(
                socket.path, f"the ball of robot {robot.name} scatters by {1e3 * spread:.3g} mm, in"
                f" the other files by {1e3 * scatter.distance:.3g} mm: a file of another robot or unit, or"
                " postures with the ball outside the socket"
            )  # fmt: skip
    if options is None or options.distance is None:
        return
    limit = _MAX_DISTANCE_SIGMAS * (scatter.distance + options.accuracy)
    for a, b in _neighbour_pairs(sockets):
        apart = float(np.linalg.norm(scatter.means[a] - scatter.means[b]))
        if abs(apart - options.distance) > limit:
            raise InputError(
                sockets[b].path, f"with robot {robot.name} this socket is {1e3 * apart:.4g} mm from"
                f" {sockets[a].name}, not {1e3 * options.distance:.4g} mm: correct --distance (0 if it is not known),"
                " the robot or the unit of the joints"
            )  # fmt: skip


def calibrate_sockets(
    robot: SerialRobot, sockets: Sequence[Socket], options: SocketOptions | None = None
) -> SocketCalibration:
    """Calibrate a robot from postures with its ball in sockets.

    All geometric parameters are fitted so that the ball is at one position in all postures of a
    socket. Standard deviations of their priors and of the noise are estimated. The joint model is
    selected by cross-validation. Outlying postures are left out.

    Args:
        robot: nominal robot.
        sockets: sockets at one or more places of the tool that holds them.
        options: options of the calibration.

    Returns:
        The calibration.

    Raises:
        InputError: there are fewer equations than parameters, or the fit contradicts the distance
            of the sockets or needs errors that are not due to manufacturing.
    """
    options = options or SocketOptions()
    nominal, robot = robot, move_far_frames_near(robot, sockets)
    problem = _SocketProblem(robot, sockets, (), options)
    _check_equation_count(problem)
    robust, gone = _remove_gross_outliers(problem)
    outliers: list[Outlier] = []
    state = None
    for _ in range(_MAX_PASSES):
        problem = _SocketProblem(robot, robust, (), options)
        state = _alternate_fit_and_prior(problem, state)
        model, rivals = _select_model(problem, state)
        extra = correction_names(robot, *JOINT_MODELS[model])
        full = _SocketProblem(robot, robust, extra, options)
        found = _alternate_fit_and_prior(full, state if not extra else _extend_state(full, state))
        fresh = _find_outliers(robot, sockets, extra, found.x, found.sizes.noise)
        outliers, names = fresh, {(one.socket, one.line) for one in fresh}
        if names == gone:
            break
        gone = names
        robust = _remove_rows(sockets, gone)
    fit = _final_fit(full, found)
    _check_fit(full, fit, found.sizes.noise)
    p = len(full.chain.nominal_values)
    values = dict(zip(full.names, fit.values.tolist(), strict=True))
    made = apply_calibrated_parameters(robot, values, dict(zip(extra, fit.values[p:].tolist(), strict=True)))
    kinds = _parameter_kinds(full)
    sizes = {kind: float(found.sizes.std[kinds.index(kind)]) for kind in dict.fromkeys(kinds) if kind}
    plain = _SocketProblem(robot, sockets, (), options)
    before = _compute_socket_errors(plain, plain.predict_balls(_fit_nominal_ball(plain)))
    return SocketCalibration(
        nominal, made, model, rivals, fit, sizes, found.sizes.noise, before,
        evaluate_robot(made, sockets), tuple(outliers), options,
    )  # fmt: skip


def move_far_frames_near(robot: SerialRobot, sockets: Sequence[Socket]) -> SerialRobot:
    """Return the same robot with far joint frames moved along their axes to within the robot's reach.

    A frame may lie anywhere on its axis. The factory calibration of robots with parallel axes puts
    frames hundreds of metres away, where a small tilt is a large displacement: the equations are
    badly scaled, and errors of one kind have no common size.

    Args:
        robot: the robot.
        sockets: postures, from which the reach follows.

    Returns:
        The robot with such frames at the point of their axis closest to the frame before.
    """
    problem = _SocketProblem(robot, sockets, (), SocketOptions(distance=None))
    reach = _median_reach(problem)
    joints, back = [], np.eye(4)
    for joint in robot.joints:
        origin, slide = back @ joint.origin, np.eye(4)
        along = origin[:3, :3] @ joint.axis
        if abs(along @ origin[:3, 3]) > reach:
            slide[:3, 3] = -(along @ origin[:3, 3]) * joint.axis
        joints.append(replace(joint, origin=origin @ slide))
        back = np.linalg.inv(slide)
    return replace(robot, joints=tuple(joints), tool=back @ robot.tool)


def _median_reach(problem: _SocketProblem) -> float:
    """Return the median distance [m] of the nominal ball positions of all rows from the first joint."""
    balls = problem.predict_balls(problem.start)
    return float(np.median(np.linalg.norm(balls - problem.robot.joints[0].origin[:3, 3], axis=1)))


def evaluate_robot(robot: SerialRobot, sockets: Sequence[Socket]) -> SocketErrors:
    """Compute how far a robot's ball positions are from their socket means, without any fit.

    Args:
        robot: nominal or calibrated robot, with its corrections.
        sockets: the measured postures by socket.

    Returns:
        RMS distances from the means, distances of the sockets, and outliers.
    """
    problem = _SocketProblem(robot, sockets, tuple(robot.corrections), SocketOptions(distance=None))
    x = np.concatenate([problem.chain.nominal_values, list(robot.corrections.values())])
    return _compute_socket_errors(problem, problem.predict_balls(x))


def predict_held_out_places(
    robot: SerialRobot,
    sockets: Sequence[Socket],
    names: Sequence[str],
    options: SocketOptions | None = None,
) -> tuple[HeldOutPrediction, ...]:
    """Cross-validate: evaluate the sockets of each name with a robot calibrated on all other sockets.

    Args:
        robot: nominal robot.
        sockets: all sockets.
        names: names of places of the tool, or of sockets, each left out in turn.
        options: options of the calibrations.

    Returns:
        One prediction per name.

    Raises:
        InputError: there is no such place, or no other place to calibrate on.
    """
    return tuple(predict_held_out_place(robot, sockets, name, options)[0] for name in names)


def predict_held_out_place(
    robot: SerialRobot, sockets: Sequence[Socket], name: str, options: SocketOptions | None = None
) -> tuple[HeldOutPrediction, SocketCalibration]:
    """Evaluate one socket, or all sockets of one place of the tool, with a robot calibrated on all other sockets.

    Args:
        robot: nominal robot.
        sockets: all sockets.
        name: name of the place or socket.
        options: options of the calibration.

    Returns:
        The prediction, and the calibration on all others.

    Raises:
        InputError: there is no such place, or no other place to calibrate on.
    """
    own = tuple(s for s in sockets if name in (s.place, s.name))
    rest = tuple(s for s in sockets if name not in (s.place, s.name))
    if not own:
        known = (*place_names(sockets), *(s.name for s in sockets))
        raise InputError(f"--heldout {name}", f"is not a place of the data; {suggest_valid_name(name, known)}")
    if not rest:
        raise InputError(
            f"--heldout {name}",
            "holds all sockets, so that none is left to calibrate on; record sockets at another place, too",
        )
    found = calibrate_sockets(robot, rest, options)
    problem = _SocketProblem(robot, rest, (), SocketOptions(distance=None))
    values = dict(zip(problem.names, _fit_nominal_ball(problem).tolist(), strict=True))
    nominal = apply_calibrated_parameters(robot, values, {})
    return HeldOutPrediction(
        name,
        evaluate_robot(robot, own),
        evaluate_robot(nominal, own),
        evaluate_robot(found.robot, own),
        found.model,
    ), found


def list_names_to_hold_out(sockets: Sequence[Socket]) -> tuple[str, ...]:
    """Return the names of places of the tool, or of sockets, to leave out in turn for validation.

    They are the places if there are several, otherwise the sockets; empty for a single socket.
    """
    places = place_names(sockets)
    if len(places) > 1:
        return places
    return tuple(s.name for s in sockets) if len(sockets) > 1 else ()


@dataclass(frozen=True)
class _FitState:
    """Parameter values `x` (p,) with their prior standard deviations (sizes) and the noise."""

    x: np.ndarray
    sizes: ErrorSizes


def _alternate_fit_and_prior(problem: _SocketProblem, begin: _FitState | None) -> _FitState:
    """Alternate between a fit of the parameters and an estimate of their prior deviations and the noise.

    The iteration stops when the noise changes by less than 0.1 %, or after six fits. It starts from
    `begin`, or with None from the nominal robot with the ball position fitted.
    """
    kinds = _parameter_kinds(problem)
    if begin is None:
        start = np.array([_START_SAG_SIZE if k.startswith("sag") else _START_SIZE for k in kinds])
        start[np.array(kinds) == ""] = _BALL_PRIOR_STD
        begin = _FitState(_fit_nominal_ball(problem), ErrorSizes(start, _START_SIZE, 0.0, 0))
    x, sizes = begin.x, begin.sizes
    first = np.array([_START_SAG_SIZE if k.startswith("sag") else _START_SIZE for k in kinds])
    first[np.array(kinds) == ""] = _BALL_PRIOR_STD
    many = 3 * len(problem.joints)
    for _ in range(_MAX_PASSES):
        sigma = problem.equation_standard_deviations(sizes.noise)
        fit = least_squares(
            problem.residual, x, problem.names, np.maximum(sizes.std, 1e-12), sigma=sigma,
            prior=Prior(problem.start, sizes.std), jac=problem.jacobian, select="none",
        )  # fmt: skip
        x, matrix = fit.values, fit.jacobian
        rest = matrix @ (x - problem.start) - fit.residual
        weight = 1.0 / sigma[many:, None]
        new = estimate_prior_std_by_kind(
            matrix[:many], rest[:many], kinds, first, problem.degrees_of_freedom, sizes.noise,
            matrix[many:] * weight, rest[many:] * weight[:, 0], _MIN_NOISE,
        )  # fmt: skip
        close = abs(new.noise - sizes.noise) < _NOISE_TOLERANCE * sizes.noise
        sizes = new
        if close:
            break
    return _FitState(x, sizes)


def _final_fit(problem: _SocketProblem, state: _FitState) -> ParameterFit:
    """Fit the parameters with the estimated noise and prior deviations, and classify their identifiability."""
    sigma = problem.equation_standard_deviations(state.sizes.noise)
    fit = least_squares(
        problem.residual, state.x, problem.names, np.maximum(state.sizes.std, 1e-12), sigma=sigma,
        prior=Prior(problem.start, state.sizes.std), jac=problem.jacobian, select="none",
    )  # fmt: skip
    scales = _identifiability_scales(problem, state)
    order = sorted(range(len(scales)), key=lambda k: _representative_rank(problem.names[k]))
    told = classify_scaled_parameters(
        fit.jacobian[:, order], [problem.names[k] for k in order], scales[order], sigma=sigma
    )
    return replace(fit, identifiability=told, scales=scales)


def _representative_rank(name: str) -> int:
    """Return the rank of a parameter; of an identifiable combination the one with the smallest rank is named first.

    The order is ball position, joint offsets, lengths, tilts, then joint corrections.
    """
    kind, _, place = name.partition(".")
    if place == "tool":
        return 0
    order = ("rz", "tx", "ty", "tz", "rx", "ry", "sag", "sine", "cosine")
    return 1 + order.index(kind)


def _identifiability_scales(problem: _SocketProblem, state: _FitState) -> np.ndarray:
    """Return the sizes (p,) with which the standard deviations of parameters are compared.

    A parameter is identifiable if its standard deviation is below half of its size. Sizes are the
    estimated prior standard deviations, at least a tenth of their start values.
    """
    sag = np.array([name.startswith("sag") for name in problem.names])
    return np.maximum(state.sizes.std, np.where(sag, 0.1 * _START_SAG_SIZE, 0.1 * _START_SIZE))


def _parameter_kinds(problem: _SocketProblem) -> list[str]:
    """Return the kind of each parameter: offset, length, tilt, sag or eccentricity; "" for the ball position.

    Sag is deflection under gravity. All parameters of a kind have the same prior standard deviation.
    """
    kinds = []
    for name in problem.names:
        first, _, joint = name.partition(".")
        if joint == "tool":
            kinds.append("")
        elif first in ("rz", "tz") and _axis_letter(problem.robot, joint) == first[0]:
            kinds.append("offset" if first == "rz" else "length")
        elif first in ("sag", "sine", "cosine"):
            kinds.append("sag" if first == "sag" else "eccentricity")
        else:
            kinds.append(_KIND_BY_LETTER[first[0]])
    return kinds


def _axis_letter(robot: SerialRobot, joint: str) -> str:
    kind = next(j.kind for j in robot.joints if j.name == joint)
    return "r" if kind == "revolute" else "t"


def _fit_nominal_ball(problem: _SocketProblem) -> np.ndarray:
    """Return the nominal parameters (p,) with the ball position in the last link fitted.

    The fit minimises the sum of the ball's (unsquared) distances from its socket's mean.
    """
    x = problem.start.copy()
    places = [problem.names.index(f"{c}.tool") for c in "xyz"]
    rates = chain_poses_and_derivatives(problem.chain, problem.joints, problem.chain.nominal_values)
    ball = rates.position_by_parameter[:, :, places]
    apart = problem.subtract_means(rates.position).ravel()
    matrix = (ball - problem.socket_means(ball)[problem.index]).reshape(-1, 3)
    weight = np.ones(len(matrix) // 3)
    step = np.zeros(3)
    for _ in range(30):  # least absolute distances, robust against outliers
        rows = np.repeat(weight, 3)
        step = np.linalg.lstsq(matrix * rows[:, None], -apart * rows, rcond=1e-6)[0]
        left = np.linalg.norm((apart + matrix @ step).reshape(-1, 3), axis=1)
        weight = 1.0 / np.sqrt(np.maximum(left, 1e-4))
    x[places] += step
    return x


@dataclass(frozen=True)
class _BallScatter:
    """Scatter of the ball of the nominal robot in its sockets, with the ball position fitted.

    Attributes:
        distance: median over sockets of `distance_by_socket` [m].
        relative: median over sockets of `relative_by_socket` [1].
        distance_by_socket: (k,) median distance of the ball from its mean position in a socket [m].
        relative_by_socket: (k,) that over the distance if the joints moved independently [1].
        means: (k, 3) mean positions of the ball in the base frame [m].
    """

    distance: float
    relative: float
    distance_by_socket: np.ndarray
    relative_by_socket: np.ndarray
    means: np.ndarray


def _ball_scatter(robot: SerialRobot, sockets: Sequence[Socket]) -> _BallScatter:
    """Compute how far the nominal robot's ball scatters in its sockets, also relative to its free travel.

    The free travel is the scatter after each joint's readings are permuted at random.
    """
    problem = _SocketProblem(robot, sockets, (), SocketOptions(distance=None))
    x = _fit_nominal_ball(problem)
    balls = problem.predict_balls(x)
    rng = np.random.default_rng(0)
    mixed = np.vstack([rng.permuted(socket.joints, axis=0) for socket in sockets])
    loose = chain_poses(problem.chain, mixed, x[: len(problem.chain.nominal_values)]).position
    parts = [slice(first, first + n) for first, n in zip(problem.first, problem.count, strict=True)]
    apart, travel = (
        np.array([np.median(np.linalg.norm(problem.subtract_means(rows)[part], axis=1)) for part in parts])
        for rows in (balls, loose)
    )
    ratio = apart / np.maximum(travel, np.finfo(float).tiny)
    return _BallScatter(float(np.median(apart)), float(np.median(ratio)), apart, ratio, problem.socket_means(balls))


def _format_scatter(scatter: _BallScatter) -> str:
    return f"{1e3 * scatter.distance:.3g} mm, {100.0 * scatter.relative:.2g} % of its free travel"


def _unit_hint(robots: dict[str, SerialRobot], sockets: Sequence[Socket]) -> str:
    """Return advice to state degrees or radians if a robot's ball then scatters little, otherwise an empty text."""
    for unit, convert in (("deg", np.radians), ("rad", np.degrees)):
        other = [replace(s, joints=convert(s.joints)) for s in sockets]
        for name, robot in robots.items():
            scatter = _ball_scatter(robot, other)
            if scatter.relative <= _MAX_RELATIVE_SCATTER:
                named = {"deg": "degrees", "rad": "radians"}[unit]
                return (
                    f"; read as {named}, the ball of {name} scatters by {_format_scatter(scatter)}: give --unit {unit}"
                )
    return ""


def _check_fit(problem: _SocketProblem, fit: ParameterFit, noise: float) -> None:
    """Raise InputError if a fit contradicts the stated socket distance, or an error is implausibly large.

    Limits: 10 standard deviations (distance), a tenth of the reach (length), 0.3 rad (angle).
    """
    folder = problem.sockets[0].path.parent
    many = 3 * len(problem.joints)
    gaps, sigma = fit.residual[many:], problem.equation_standard_deviations(noise)[many:]
    for (a, b), gap, deviation in zip(problem.pairs, gaps, sigma, strict=True):
        if abs(gap) > _MAX_FITTED_DISTANCE_SIGMAS * deviation:
            found = 1e3 * (problem.options.distance + gap)
            raise InputError(
                problem.sockets[b].path, f"the calibrated robot puts this socket {found:.4g} mm from"
                f" {problem.sockets[a].name}, not {1e3 * problem.options.distance:.4g} mm:"
                " correct --distance, the robot or the unit of the joints, or state the --accuracy of the distance"
            )  # fmt: skip
    reach = _median_reach(problem)
    for name, value in zip(problem.names, fit.values - problem.start, strict=True):
        kind, _, joint = name.partition(".")
        if joint == "tool" or kind not in ("tx", "ty", "tz", "rx", "ry", "rz"):
            continue
        limit = _MAX_LENGTH_RATIO * reach if kind[0] == "t" else _MAX_ANGLE_ERROR
        if abs(value) > limit:
            unit, factor = ("mm", 1e3) if kind[0] == "t" else ("deg", float(np.degrees(1.0)))
            raise InputError(
                folder, f"the fit needs an error of {factor * value:.3g} {unit} in {name} of robot"
                f" {problem.robot.name}, beyond {factor * limit:.3g} {unit}: it is not accepted."
                " Correct the robot, --distance, or the unit, order or sign of the joints"
            )  # fmt: skip


def _select_model(problem: _SocketProblem, state: _FitState) -> tuple[str, dict[str, float]]:
    """Select the joint model (rigid, gravity, eccentricity, both) with the smallest cross-validated error.

    Folds are the places of the tool if there are more than two, otherwise the sockets. A model in
    the options is kept. With a single fold, the model is otherwise `rigid`, and errors are empty.

    Returns:
        (name of the model, cross-validated RMS error [m] by model).
    """
    wanted = problem.options.model
    if wanted is not None and wanted not in JOINT_MODELS:
        raise InputError(f"--model {wanted}", f"is not known: {', '.join(JOINT_MODELS)}")
    places = place_names(problem.sockets)
    part = [places.index(s.place) if len(places) > 2 else k
            for k, s in enumerate(problem.sockets)]  # fmt: skip
    folds = np.repeat(np.array(part)[problem.index], 3)
    if len(set(part)) < 2:
        return wanted or "rigid", {}
    errors = {}
    many = 3 * len(problem.joints)
    for model, kinds in JOINT_MODELS.items():
        extra = correction_names(problem.robot, *kinds)
        full = _SocketProblem(problem.robot, problem.sockets, extra, problem.options)
        begun = state if not extra else _extend_state(full, state)
        matrix, left = full.jacobian(begun.x), full.residual(begun.x)
        rest = matrix @ (begun.x - full.start) - left
        weight = 1.0 / full.equation_standard_deviations(state.sizes.noise)[many:]
        sizes = estimate_prior_std_by_kind(
            matrix[:many], rest[:many], _parameter_kinds(full), begun.sizes.std, full.degrees_of_freedom,
            state.sizes.noise, matrix[many:] * weight[:, None], rest[many:] * weight, _MIN_NOISE,
        )  # fmt: skip
        known = (matrix[many:] * weight[:, None], rest[many:] * weight, np.array(part)[[a for a, _ in full.pairs]])
        errors[model] = cross_validation_error(matrix[:many], rest[:many], folds, sizes, known if full.pairs else None)
    return wanted or min(errors, key=lambda model: errors[model]), errors


def _extend_state(problem: _SocketProblem, state: _FitState) -> _FitState:
    """Append joint correction parameters, with value 0 and start prior deviations, to a state of the rigid model."""
    more = [_START_SAG_SIZE if name.startswith("sag") else _START_SIZE for name in problem.extra]
    sizes = ErrorSizes(np.append(state.sizes.std, more), state.sizes.noise, state.sizes.effective_parameters, 0)
    return _FitState(np.append(state.x, np.zeros(len(more))), sizes)


def _outlier_distance(noise: float, rows: int) -> float:
    """Return the distance [m] from its socket's mean above which a ball position is an outlier.

    Noise of standard deviation `noise` [m] exceeds it in one of a thousand data sets of `rows` rows.
    """
    return noise * float(np.sqrt(scipy.stats.chi2.isf(_FALSE_ALARM_PROBABILITY / rows, 3)))


def _find_outliers(
    robot: SerialRobot, sockets: Sequence[Socket], extra: Sequence[str], x: np.ndarray, noise: float
) -> list[Outlier]:
    problem = _SocketProblem(robot, sockets, extra, SocketOptions(distance=None))
    return _outlier_rows(problem, problem.predict_balls(x), noise)


def _outlier_rows(problem: _SocketProblem, balls: np.ndarray, noise: float) -> list[Outlier]:
    """Return the rows whose ball (n, 3) [m] is farther from its socket's mean than `_outlier_distance`.

    The mean is that of the rows within this distance. `noise` is the deviation of a coordinate [m].
    """
    found = []
    limit = _outlier_distance(noise, len(balls))
    for k, socket in enumerate(problem.sockets):
        own = balls[problem.index == k]
        middle = np.median(own, axis=0)
        near = np.linalg.norm(own - middle, axis=1) < 2.0 * limit
        for _ in range(5):
            middle = own[near].mean(axis=0) if near.any() else middle
            near = np.linalg.norm(own - middle, axis=1) <= limit
        away = np.linalg.norm(own - middle, axis=1)
        found += [Outlier(socket.name, int(socket.lines[row]), float(away[row]))
                  for row in np.flatnonzero(~near)]  # fmt: skip
    return found


def _remove_gross_outliers(
    problem: _SocketProblem,
) -> tuple[tuple[Socket, ...], set[tuple[str, int]]]:
    """Remove rows that are outliers already with the nominal robot, with its ball position fitted.

    The limit is that of twice the noise, estimated from the median distance from socket medians.

    Returns:
        (the remaining sockets, the removed rows as (socket name, line number)).
    """
    balls = problem.predict_balls(_fit_nominal_ball(problem))
    away = np.empty(len(balls))
    for k in range(len(problem.sockets)):
        own = balls[problem.index == k]
        away[problem.index == k] = np.linalg.norm(own - np.median(own, axis=0), axis=1)
    noise = float(np.median(away)) / _MEDIAN_CHI3
    gone = {(one.socket, one.line) for one in _outlier_rows(problem, balls, 2.0 * noise)}
    return _remove_rows(problem.sockets, gone), gone


def _remove_rows(sockets: Sequence[Socket], gone: set[tuple[str, int]]) -> tuple[Socket, ...]:
    made = []
    for socket in sockets:
        kept = np.array([(socket.name, int(line)) not in gone for line in socket.lines])
        if kept.sum() > 1:
            made.append(Socket(socket.place, socket.hole, socket.path, socket.joints[kept],
                               socket.lines[kept]))  # fmt: skip
    return tuple(made)


def _compute_socket_errors(problem: _SocketProblem, balls: np.ndarray) -> SocketErrors:
    apart = np.linalg.norm(problem.subtract_means(balls), axis=1)
    noise = float(np.median(apart)) / _MEDIAN_CHI3
    outliers = _outlier_rows(problem, balls, noise)
    gone = {(one.socket, one.line) for one in outliers}
    kept = np.concatenate([
        [(s.name, int(line)) not in gone for line in s.lines] for s in problem.sockets
    ]).astype(bool)  # fmt: skip
    clean, squares = [], []
    for k in range(len(problem.sockets)):
        own = balls[(problem.index == k) & kept]
        if len(own):
            clean.append(own.mean(axis=0))
            squares.append(np.sum((own - clean[-1]) ** 2, axis=1))
        else:
            clean.append(balls[problem.index == k].mean(axis=0))
    means = problem.socket_means(balls)
    distances = {
        problem.sockets[a].place: float(np.linalg.norm(means[a] - means[b]))
        for a, b in reversed(_neighbour_pairs(problem.sockets))
    }
    return SocketErrors(
        float(np.sqrt(np.mean(apart**2))),
        float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else float("nan"),
        {s.name: float(np.sqrt(np.mean(apart[problem.index == k] ** 2)))
         for k, s in enumerate(problem.sockets)},
        dict(reversed(distances.items())), tuple(outliers),
        {s.name: apart[problem.index == k] for k, s in enumerate(problem.sockets)},
    )  # fmt: skip


def _neighbour_pairs(sockets: Sequence[Socket]) -> list[tuple[int, int]]:
    """Return pairs of indices of successive sockets in the list that have the same place and successive numbers."""
    return [
        (k, k + 1) for k in range(len(sockets) - 1)
        if sockets[k].place == sockets[k + 1].place and sockets[k + 1].hole == sockets[k].hole + 1
    ]  # fmt: skip


def _check_equation_count(problem: _SocketProblem) -> None:
    needed = 4 * len(problem.robot.joints)
    if problem.degrees_of_freedom < needed:
        raise InputError(
            problem.sockets[0].path.parent,
            f"{len(problem.joints)} rows in {len(problem.sockets)} sockets give"
            f" {problem.degrees_of_freedom} equations, but the robot's geometry has at least {needed}"
            " parameters: record 20 postures or more per socket",
        )

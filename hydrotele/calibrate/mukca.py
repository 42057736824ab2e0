"""Closed-chain calibration of a serial robot from joint angles alone: its ball sits in sockets.

With the ball in a socket the robot moves in its null space, and all postures must put the ball at
one place. Unknown are six errors in front of every joint, the ball in the last link, and the
sockets' places, which leave the equations as means; known is the distance of two sockets in the
tool that holds them, which gives the scale. Sizes of the errors and the noise are estimated with
them; joints that yield under gravity and encoders that are not centred are added where they
predict places better that they were not fitted to.

Source: Khoshzaban 1992, chapter 3 (closed chain with a passive end point); Franzese, Spahn, Kober
and Della Santina 2025, MUKCa (ball and sockets).

How strongly to hold parameters near their nominal values, from the measurements themselves.

Parameters of one kind (lengths, tilts, joint offsets ...) are errors of manufacture of one size.
That size and the noise are those that make the measurements most probable, so that no weight of a
regularisation has to be chosen; a kind that the measurements do not ask for gets the size zero.
Rival models are judged by predicting parts of the measurements that they were not fitted to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.stats

from hydrotele.calibrate.estimation import ParameterFit, Prior, identifiable, least_squares
from hydrotele.calibrate.sockets import Socket, places_of
from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import forward, forward_and_rates
from hydrotele.kinematics.serial_robot import (
    Robot,
    corrected_robot,
    deflection_names,
    deflections,
    load_robot,
    robot_chain,
    shipped_robots,
)

_SMALLEST = 1e-7  # of a size, over its start: a kind that is not there
_LARGEST = 1e3
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
    basis, triangle = np.linalg.qr(matrix)
    inside = basis.T @ rest
    outside = float(np.sum((rest - basis @ inside) ** 2))
    if known is None or known_rest is None:
        known, known_rest = np.empty((0, matrix.shape[1])), np.empty(0)
    std = np.array(start, float)
    groups = {kind: np.flatnonzero([k == kind for k in kinds]) for kind in set(kinds) - {""}}
    decided = np.zeros(len(std))
    for rounds in range(1, _ROUNDS + 1):  # noqa: B007 - reported
        # In units of sizes and noise; singular values, so that a small noise loses no digits.
        scaled = np.vstack([triangle / noise, known]) * std
        wanted = np.concatenate([inside / noise, known_rest])
        u, s, v = np.linalg.svd(scaled, full_matrices=False)
        value = std * (v.T @ (s / (1.0 + s**2) * (u.T @ wanted)))
        decided = (s**2 / (1.0 + s**2)) @ v**2
        error = float(np.sum((inside - triangle @ value) ** 2)) + outside
        before = np.append(std, noise)
        noise = max(float(np.sqrt(max(error, 1e-300) / max(freedom - decided.sum(), 1.0))), finest)
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


MODELS = {
    "rigid": (False, False),
    "gravity": (True, False),
    "eccentricity": (False, True),
    "both": (True, True),
}
"""Model of the joints -> whether they yield under gravity, and whether encoders err once a turn."""

_SIZE = 1e-3  # m and rad to begin with, a usual tolerance
_SAG_SIZE = 1e-4  # rad s^2/m^2 to begin with: a milliradian by a kilogram at a metre
_BALL = 0.3  # m by which the ball may be elsewhere in the last link
_FINEST = 1e-8  # m of noise: below it rounding decides what the data tell
_PASSES, _SAME_NOISE = 6, 1e-3
_MEDIAN_CHI3 = 1.5382  # median length of three standard normal errors
_FALSE_ALARM = 1e-3  # chance that normal noise alone makes an outlier of any row of a data set
_WRONG_ROBOT = 30e-3  # m of a nominal robot's spread: no joint errs by so much
_KINDS = {"t": "length", "r": "tilt"}


@dataclass(frozen=True)
class Options:
    """What a user may choose.

    Attributes:
        distance: of the sockets of one tool [m]; None where it is not known.
        accuracy: standard deviation of that distance [m].
        model: of the joints, a key of `MODELS`; None to choose it.
    """

    distance: float | None = 0.050
    accuracy: float = 5.0e-5
    model: str | None = None


@dataclass(frozen=True)
class Outlier:
    """A row whose ball is not where the other rows of its socket put it.

    Attributes:
        socket: name of the socket.
        line: in its file.
        distance: of the ball from the others' mean [m].
    """

    socket: str
    line: int
    distance: float


@dataclass(frozen=True)
class Judged:
    """How consistently a robot predicts sockets.

    Attributes:
        rms: root mean square distance of the predicted balls from their sockets' means [m].
        rms_without_outliers: the same without the rows named in `outliers`.
        sockets: socket -> its own root mean square [m].
        distances: place -> distance of its sockets' means, the first two [m].
        outliers: rows apart from the rest of their socket.
        rows: socket -> distance of every row's ball from the socket's mean [m].
    """

    rms: float
    rms_without_outliers: float
    sockets: dict[str, float]
    distances: dict[str, float]
    outliers: tuple[Outlier, ...]
    rows: dict[str, np.ndarray]


@dataclass(frozen=True)
class SocketCalibration:
    """A calibrated robot.

    Attributes:
        nominal: as given.
        robot: calibrated.
        model: of the joints, a key of `MODELS`.
        rivals: model -> RMS error [m] of a coordinate at places, or sockets, not fitted.
        fit: of all parameters.
        sizes: kind of parameter -> standard deviation [m], [rad] or [rad s^2/m^2].
        noise: standard deviation of one coordinate of the ball [m].
        before: the nominal robot with its ball fitted, on the fitted sockets.
        after: the calibrated robot on them.
        outliers: rows that were not fitted.
        options: that were used.
    """

    nominal: Robot
    robot: Robot
    model: str
    rivals: dict[str, float]
    fit: ParameterFit
    sizes: dict[str, float]
    noise: float
    before: Judged
    after: Judged
    outliers: tuple[Outlier, ...]
    options: Options = field(default_factory=Options)


@dataclass(frozen=True)
class LeftOut:
    """One place, or socket, predicted by a calibration that has not seen it.

    Attributes:
        name: of the place or socket.
        given: of the nominal robot with the ball where its file says.
        nominal: of the nominal robot with the ball fitted to all others.
        calibrated: of the robot calibrated on all others.
        model: of the joints, chosen without it.
    """

    name: str
    given: Judged
    nominal: Judged
    calibrated: Judged
    model: str


class _Problem:
    """Equations of sockets for a robot with corrections of its joints."""

    def __init__(self, robot: Robot, sockets: Sequence[Socket], extra: Sequence[str], options):
        self.robot, self.sockets, self.extra = robot, tuple(sockets), tuple(extra)
        self.chain = robot_chain(robot)
        self.names = (*self.chain.parameters, *self.extra)
        self.joints = np.vstack([s.joints for s in sockets])
        self.index = np.repeat(np.arange(len(sockets)), [len(s.joints) for s in sockets])
        self.count = np.bincount(self.index)
        self.basis = deflections(robot, self.joints, self.extra)
        self.start = np.concatenate([self.chain.nominal, np.zeros(len(self.extra))])
        self.options = options
        self.pairs = _pairs(sockets) if options.distance is not None else []

    @property
    def freedom(self) -> int:
        """Coordinates less the sockets' unknown places."""
        return 3 * (len(self.joints) - len(self.sockets))

    def means(self, values: np.ndarray) -> np.ndarray:
        """Mean of rows (n, ...) over every socket."""
        total = np.zeros((len(self.count), *values.shape[1:]))
        np.add.at(total, self.index, values)
        return total / self.count.reshape(-1, *[1] * (values.ndim - 1))

    def balls(self, x: np.ndarray) -> np.ndarray:
        """(n, 3) predicted places of the ball."""
        p = len(self.chain.nominal)
        joints = self.joints + self.basis @ x[p:] if self.extra else self.joints
        return forward(self.chain, joints, x[:p]).position

    def apart(self, balls: np.ndarray) -> np.ndarray:
        """(n, 3) balls less their socket's mean."""
        return balls - self.means(balls)[self.index]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """All coordinates apart from their means, then errors of the sockets' distances [m]."""
        balls = self.balls(x)
        means = self.means(balls)
        gaps = [np.linalg.norm(means[a] - means[b]) - self.options.distance for a, b in self.pairs]
        return np.concatenate([(balls - means[self.index]).ravel(), gaps])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of `residual`."""
        p = len(self.chain.nominal)
        joints = self.joints + self.basis @ x[p:] if self.extra else self.joints
        rates = forward_and_rates(self.chain, joints, x[:p])
        whole = rates.position_by_parameter
        if self.extra:
            whole = np.concatenate([whole, rates.position_by_joint @ self.basis], axis=2)
        means, middle = self.means(rates.position), self.means(whole)
        rows = [(whole - middle[self.index]).reshape(-1, whole.shape[2])]
        for a, b in self.pairs:
            way = means[a] - means[b]
            way = way / max(float(np.linalg.norm(way)), 1e-12)
            rows.append((way @ (middle[a] - middle[b]))[None])
        return np.vstack(rows)

    def sigma(self, noise: float) -> np.ndarray:
        """Standard deviation of every equation."""
        means = [1.0 / self.count[a] + 1.0 / self.count[b] for a, b in self.pairs]
        gaps = np.sqrt(self.options.accuracy**2 + noise**2 * np.array(means))
        return np.concatenate([np.full(3 * len(self.joints), noise), gaps])


def choose_robot(sockets: Sequence[Socket], options: Options) -> tuple[Robot, dict[str, float]]:
    """The shipped robot whose nominal chain keeps the ball together best.

    Args:
        sockets: the measurements.
        options: of the calibration.

    Returns:
        The robot and every candidate's RMS spread [m] with its ball fitted.

    Raises:
        InputError: no shipped robot has that number of joints, or none keeps the ball together.
    """
    count, folder = sockets[0].joints.shape[1], sockets[0].path.parent
    spreads: dict[str, float] = {}
    robots = {}
    for name in shipped_robots():
        robot = load_robot(name)
        if len(robot.joints) == count:
            robots[name] = robot
            spreads[name] = _nominal_spread(robot, sockets)
    if not spreads:
        raise InputError(
            folder, f"has {count} columns and no shipped robot has {count} joints:"
            f" give --robot FILE (YAML, URDF or MJCF)"
        )  # fmt: skip
    best = min(spreads, key=lambda name: spreads[name])
    if spreads[best] > _WRONG_ROBOT:
        said = ", ".join(f"{name} {1e3 * spread:.0f} mm" for name, spread in spreads.items())
        raise InputError(
            folder, f"no shipped robot keeps the ball together (RMS spread: {said}):"
            f" give --robot FILE (YAML, URDF or MJCF){_degrees_hint(robots, sockets)}"
        )  # fmt: skip
    return robots[best], spreads


def check_robot(robot: Robot, sockets: Sequence[Socket]) -> None:
    """Refuse measurements that do not belong to a robot.

    Args:
        robot: nominal.
        sockets: the measurements.

    Raises:
        InputError: all files, or one of them, put the ball at places centimetres apart.
    """
    problem = _Problem(robot, sockets, (), Options(distance=None))
    apart = problem.apart(problem.balls(_with_ball(problem)))
    typical = np.array([
        np.median(np.linalg.norm(apart[problem.index == k], axis=1)) for k in range(len(sockets))
    ])  # fmt: skip
    usual = float(np.median(typical))
    if usual > _WRONG_ROBOT:
        raise InputError(
            sockets[0].path.parent, f"robot {robot.name} spreads the ball by {1e3 * usual:.0f} mm:"
            f" another robot, another order or sign of joints"
            f"{_degrees_hint({robot.name: robot}, sockets)}"
        )  # fmt: skip
    for socket, spread in zip(sockets, typical, strict=True):
        if spread > max(_WRONG_ROBOT, 5.0 * usual):
            raise InputError(
                socket.path, f"robot {robot.name} spreads the ball by {1e3 * spread:.0f} mm, in the"
                f" other files by {1e3 * usual:.1f} mm: a file of another robot or unit, or"
                " postures with the ball outside the socket"
            )  # fmt: skip


def calibrate_sockets(
    robot: Robot, sockets: Sequence[Socket], options: Options | None = None
) -> SocketCalibration:
    """Calibrate a robot.

    Args:
        robot: nominal.
        sockets: at one place or more.
        options: what is known and chosen.

    Returns:
        The calibration.

    Raises:
        InputError: there are fewer equations than parameters that rows could tell.
    """
    options = options or Options()
    problem = _Problem(robot, sockets, (), options)
    _check_count(problem)
    robust, gone = _without_gross(problem)
    outliers: list[Outlier] = []
    state = None
    for _ in range(_PASSES):
        problem = _Problem(robot, robust, (), options)
        state = _settled(problem, state)
        model, rivals = _chosen(problem, state)
        extra = deflection_names(robot, *MODELS[model])
        full = _Problem(robot, robust, extra, options)
        found = _settled(full, state if not extra else _extended(full, state))
        fresh = _outlying(robot, sockets, extra, found.x, found.sizes.noise)
        outliers, names = fresh, {(one.socket, one.line) for one in fresh}
        if names == gone:
            break
        gone = names
        robust = _without(sockets, gone)
    fit = _fit(full, found)
    p = len(full.chain.nominal)
    values = dict(zip(full.names, fit.values.tolist(), strict=True))
    made = corrected_robot(robot, values, dict(zip(extra, fit.values[p:].tolist(), strict=True)))
    kinds = _kinds(full)
    sizes = {
        kind: float(found.sizes.std[kinds.index(kind)]) for kind in dict.fromkeys(kinds) if kind
    }
    plain = _Problem(robot, sockets, (), options)
    before = _judged(plain, plain.balls(_with_ball(plain)))
    return SocketCalibration(
        robot, made, model, rivals, fit, sizes, found.sizes.noise, before,
        judge(made, sockets), tuple(outliers), options,
    )  # fmt: skip


def judge(robot: Robot, sockets: Sequence[Socket]) -> Judged:
    """How consistently a robot, as it is, predicts sockets.

    Args:
        robot: nominal or calibrated, with its corrections.
        sockets: at any places.

    Returns:
        RMS distances from the means, distances of the sockets, and rows that stand apart.
    """
    problem = _Problem(robot, sockets, tuple(robot.corrections), Options(distance=None))
    x = np.concatenate([problem.chain.nominal, list(robot.corrections.values())])
    return _judged(problem, problem.balls(x))


def leave_out(
    robot: Robot, sockets: Sequence[Socket], names: Sequence[str], options: Options | None = None
) -> tuple[LeftOut, ...]:
    """Predict places, or sockets, by calibrations that have not seen them.

    Args:
        robot: nominal.
        sockets: all of them.
        names: places, or sockets by their names, each left out in turn.
        options: of the calibrations.

    Returns:
        One per name.

    Raises:
        InputError: nothing is left to calibrate on.
    """
    return tuple(hold_out(robot, sockets, name, options)[0] for name in names)


def hold_out(
    robot: Robot, sockets: Sequence[Socket], name: str, options: Options | None = None
) -> tuple[LeftOut, SocketCalibration]:
    """Predict one place, or socket, by a calibration that has not seen it.

    Args:
        robot: nominal.
        sockets: all of them.
        name: of the place, or of a socket.
        options: of the calibration.

    Returns:
        How well it is predicted, and the calibration on all others.

    Raises:
        InputError: there is no such place, or nothing is left to calibrate on.
    """
    own = tuple(s for s in sockets if name in (s.place, s.name))
    rest = tuple(s for s in sockets if name not in (s.place, s.name))
    if not own:
        known = (*places_of(sockets), *(s.name for s in sockets))
        raise InputError(f"--heldout {name}", f"is no place of the data; {suggest(name, known)}")
    if not rest:
        raise InputError(f"--heldout {name}", "is all there is; record another place")
    found = calibrate_sockets(robot, rest, options)
    problem = _Problem(robot, rest, (), Options(distance=None))
    values = dict(zip(problem.names, _with_ball(problem).tolist(), strict=True))
    nominal = corrected_robot(robot, values, {})
    return LeftOut(
        name, judge(robot, own), judge(nominal, own), judge(found.robot, own), found.model
    ), found


def parts_to_leave_out(sockets: Sequence[Socket]) -> tuple[str, ...]:
    """Places where there are several, else sockets where there are several, else nothing."""
    places = places_of(sockets)
    if len(places) > 1:
        return places
    return tuple(s.name for s in sockets) if len(sockets) > 1 else ()


@dataclass(frozen=True)
class _State:
    """Values with sizes and noise."""

    x: np.ndarray
    sizes: Sizes


def _settled(problem: _Problem, begin: _State | None) -> _State:
    """Parameters, sizes and noise that agree with each other."""
    kinds = _kinds(problem)
    if begin is None:
        start = np.array([_SAG_SIZE if k.startswith("sag") else _SIZE for k in kinds])
        start[np.array(kinds) == ""] = _BALL
        begin = _State(_with_ball(problem), Sizes(start, _SIZE, 0.0, 0))
    x, sizes = begin.x, begin.sizes
    first = np.array([_SAG_SIZE if k.startswith("sag") else _SIZE for k in kinds])
    first[np.array(kinds) == ""] = _BALL
    many = 3 * len(problem.joints)
    for _ in range(_PASSES):
        sigma = problem.sigma(sizes.noise)
        fit = least_squares(
            problem.residual, x, problem.names, np.maximum(sizes.std, 1e-12), sigma=sigma,
            prior=Prior(problem.start, sizes.std), jac=problem.jacobian, select="none",
        )  # fmt: skip
        x, matrix = fit.values, fit.jacobian
        rest = matrix @ (x - problem.start) - fit.residual
        weight = 1.0 / sigma[many:, None]
        new = estimate_sizes(
            matrix[:many], rest[:many], kinds, first, problem.freedom, sizes.noise,
            matrix[many:] * weight, rest[many:] * weight[:, 0], _FINEST,
        )  # fmt: skip
        close = abs(new.noise - sizes.noise) < _SAME_NOISE * sizes.noise
        sizes = new
        if close:
            break
    return _State(x, sizes)


def _fit(problem: _Problem, state: _State) -> ParameterFit:
    """The final fit with intervals, and what the data tell in the noise that there is."""
    sigma = problem.sigma(state.sizes.noise)
    fit = least_squares(
        problem.residual, state.x, problem.names, np.maximum(state.sizes.std, 1e-12), sigma=sigma,
        prior=Prior(problem.start, state.sizes.std), jac=problem.jacobian, select="none",
    )  # fmt: skip
    scales = _expected(problem, state)
    order = sorted(range(len(scales)), key=lambda k: _standing(problem.names[k]))
    told = identifiable(
        fit.jacobian[:, order], [problem.names[k] for k in order], scales[order], sigma=sigma
    )
    return replace(fit, told=told, scales=scales)


def _standing(name: str) -> int:
    """Which parameters stand for combinations first: the ball, joint offsets, lengths, tilts."""
    kind, _, place = name.partition(".")
    if place == "tool":
        return 0
    order = ("rz", "tx", "ty", "tz", "rx", "ry", "sag", "sine", "cosine")
    return 1 + order.index(kind)


def _expected(problem: _Problem, state: _State) -> np.ndarray:
    """Sizes by which a parameter counts as told: the estimated one, or a tolerance if none is."""
    sag = np.array([name.startswith("sag") for name in problem.names])
    return np.maximum(state.sizes.std, np.where(sag, 0.1 * _SAG_SIZE, 0.1 * _SIZE))


def _kinds(problem: _Problem) -> list[str]:
    """Kind of every parameter: errors of one kind are of one size. The ball has none."""
    kinds = []
    for name in problem.names:
        first, _, joint = name.partition(".")
        if joint == "tool":
            kinds.append("")
        elif first in ("rz", "tz") and _axial(problem.robot, joint) == first[0]:
            kinds.append("offset" if first == "rz" else "length")
        elif first in ("sag", "sine", "cosine"):
            kinds.append("sag" if first == "sag" else "eccentricity")
        else:
            kinds.append(_KINDS[first[0]])
    return kinds


def _axial(robot: Robot, joint: str) -> str:
    kind = next(j.kind for j in robot.joints if j.name == joint)
    return "r" if kind == "revolute" else "t"


def _with_ball(problem: _Problem) -> np.ndarray:
    """Start values with the ball where the nominal chain keeps it together best."""
    x = problem.start.copy()
    places = [problem.names.index(f"{c}.tool") for c in "xyz"]
    rates = forward_and_rates(problem.chain, problem.joints, problem.chain.nominal)
    ball = rates.position_by_parameter[:, :, places]
    apart = problem.apart(rates.position).ravel()
    matrix = (ball - problem.means(ball)[problem.index]).reshape(-1, 3)
    weight = np.ones(len(matrix) // 3)
    step = np.zeros(3)
    for _ in range(30):  # least absolute distances, which a few wrong rows do not move
        rows = np.repeat(weight, 3)
        step = np.linalg.lstsq(matrix * rows[:, None], -apart * rows, rcond=1e-6)[0]
        left = np.linalg.norm((apart + matrix @ step).reshape(-1, 3), axis=1)
        weight = 1.0 / np.sqrt(np.maximum(left, 1e-4))
    x[places] += step
    return x


def _nominal_spread(robot: Robot, sockets: Sequence[Socket]) -> float:
    """Median over sockets of the median distance from the mean [m], with the ball fitted."""
    problem = _Problem(robot, sockets, (), Options(distance=None))
    apart = np.linalg.norm(problem.apart(problem.balls(_with_ball(problem))), axis=1)
    return float(np.median([np.median(apart[problem.index == k]) for k in range(len(sockets))]))


def _degrees_hint(robots: dict[str, Robot], sockets: Sequence[Socket]) -> str:
    radians = [Socket(s.place, s.hole, s.path, np.radians(s.joints), s.lines) for s in sockets]
    for name, robot in robots.items():
        spread = _nominal_spread(robot, radians)
        if spread < _WRONG_ROBOT:
            return (
                f"; read as degrees, {name} spreads it by {1e3 * spread:.1f} mm:"
                " convert the angles to radians or give --unit deg"
            )
    return ""


def _chosen(problem: _Problem, state: _State) -> tuple[str, dict[str, float]]:
    """The model of the joints that predicts best what it was not fitted to, and all errors."""
    wanted = problem.options.model
    if wanted is not None and wanted not in MODELS:
        raise InputError(f"--model {wanted}", f"is not known: {', '.join(MODELS)}")
    places = places_of(problem.sockets)
    part = [places.index(s.place) if len(places) > 2 else k
            for k, s in enumerate(problem.sockets)]  # fmt: skip
    folds = np.repeat(np.array(part)[problem.index], 3)
    if len(set(part)) < 2:
        return wanted or "rigid", {}
    errors = {}
    many = 3 * len(problem.joints)
    for model, kinds in MODELS.items():
        extra = deflection_names(problem.robot, *kinds)
        full = _Problem(problem.robot, problem.sockets, extra, problem.options)
        begun = state if not extra else _extended(full, state)
        matrix, left = full.jacobian(begun.x), full.residual(begun.x)
        rest = matrix @ (begun.x - full.start) - left
        weight = 1.0 / full.sigma(state.sizes.noise)[many:]
        sizes = estimate_sizes(
            matrix[:many], rest[:many], _kinds(full), begun.sizes.std, full.freedom,
            state.sizes.noise, matrix[many:] * weight[:, None], rest[many:] * weight, _FINEST,
        )  # fmt: skip
        errors[model] = prediction_error(matrix[:many], rest[:many], folds, sizes)
    return wanted or min(errors, key=lambda model: errors[model]), errors


def _extended(problem: _Problem, state: _State) -> _State:
    """A state of the rigid model for one with corrections of the joints."""
    more = [_SAG_SIZE if name.startswith("sag") else _SIZE for name in problem.extra]
    sizes = Sizes(np.append(state.sizes.std, more), state.sizes.noise, state.sizes.effective, 0)
    return _State(np.append(state.x, np.zeros(len(more))), sizes)


def _limit(noise: float, rows: int) -> float:
    """Distance [m] beyond which no row of normal noise lies, but for once in a thousand sets."""
    return noise * float(np.sqrt(scipy.stats.chi2.isf(_FALSE_ALARM / rows, 3)))


def _outlying(
    robot: Robot, sockets: Sequence[Socket], extra: Sequence[str], x: np.ndarray, noise: float
) -> list[Outlier]:
    problem = _Problem(robot, sockets, extra, Options(distance=None))
    return _apart_rows(problem, problem.balls(x), noise)


def _apart_rows(problem: _Problem, balls: np.ndarray, noise: float) -> list[Outlier]:
    """Rows beyond the limit from the mean of their socket's other rows within it."""
    found = []
    limit = _limit(noise, len(balls))
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


def _without_gross(problem: _Problem) -> tuple[tuple[Socket, ...], set[tuple[str, int]]]:
    """Sockets without rows that are far away already with the nominal robot."""
    balls = problem.balls(_with_ball(problem))
    away = np.empty(len(balls))
    for k in range(len(problem.sockets)):
        own = balls[problem.index == k]
        away[problem.index == k] = np.linalg.norm(own - np.median(own, axis=0), axis=1)
    noise = float(np.median(away)) / _MEDIAN_CHI3
    gone = {(one.socket, one.line) for one in _apart_rows(problem, balls, 2.0 * noise)}
    return _without(problem.sockets, gone), gone


def _without(sockets: Sequence[Socket], gone: set[tuple[str, int]]) -> tuple[Socket, ...]:
    made = []
    for socket in sockets:
        kept = np.array([(socket.name, int(line)) not in gone for line in socket.lines])
        if kept.sum() > 1:
            made.append(Socket(socket.place, socket.hole, socket.path, socket.joints[kept],
                               socket.lines[kept]))  # fmt: skip
    return tuple(made)


def _judged(problem: _Problem, balls: np.ndarray) -> Judged:
    apart = np.linalg.norm(problem.apart(balls), axis=1)
    noise = float(np.median(apart)) / _MEDIAN_CHI3
    outliers = _apart_rows(problem, balls, noise)
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
    means = problem.means(balls)
    distances = {
        problem.sockets[a].place: float(np.linalg.norm(means[a] - means[b]))
        for a, b in reversed(_pairs(problem.sockets))
    }
    return Judged(
        float(np.sqrt(np.mean(apart**2))),
        float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else float("nan"),
        {s.name: float(np.sqrt(np.mean(apart[problem.index == k] ** 2)))
         for k, s in enumerate(problem.sockets)},
        dict(reversed(distances.items())), tuple(outliers),
        {s.name: apart[problem.index == k] for k, s in enumerate(problem.sockets)},
    )  # fmt: skip


def _pairs(sockets: Sequence[Socket]) -> list[tuple[int, int]]:
    """Neighbouring sockets of one tool."""
    return [
        (k, k + 1) for k in range(len(sockets) - 1)
        if sockets[k].place == sockets[k + 1].place and sockets[k + 1].hole == sockets[k].hole + 1
    ]  # fmt: skip


def _check_count(problem: _Problem) -> None:
    needed = 4 * len(problem.robot.joints)
    if problem.freedom < needed:
        raise InputError(
            problem.sockets[0].path.parent,
            f"{len(problem.joints)} rows in {len(problem.sockets)} sockets give"
            f" {problem.freedom} equations, the robot's geometry has {needed} parameters and more:"
            " record 20 postures or more per socket",
        )

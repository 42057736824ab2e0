"""Design of calibrators and selection of measurement poses by information.

A calibrator design (link lengths, ball joint position) is evaluated by the weighted Jacobian of a
complete measurement, in which one link sweeps while the others are held (Khoshzaban 1992,
section 5.3). The criteria are the accuracy of the calibrated arm's tip over its workspace and the
fraction of poses within reach. Poses are selected by the parameters' information matrix: its
determinant (D) or an observability index O1 to O5. The search adds poses one by one, then exchanges
poses until no exchange improves the criterion.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import scipy.optimize

from hydrotele.calibrate.arm import (
    StageEquations,
    candidate_parameters,
    classify_candidates,
    expected_parameter_error,
    initial_parameters,
)
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.loop import (
    CalibrationLoop,
    frame_after_links,
    link_chain,
    solve_calibrator_angles,
)
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import chain_poses_and_derivatives


class Sweep(NamedTuple):
    """Reciprocating motion of one link while the others are held [deg, K's signs].

    Attributes:
        moving: range of the moving link.
        held: angle of each held link, by name.
        drift: drift of each held link until the last pose, by name.
        wander: amplitude of the grapple's rotation about the angle at which it points at the ball.
        poses: number of poses.
        cycles: number of back-and-forth cycles of the moving link.
        phase: phase of the first pose within a cycle, 0 at the lower end [rad].
    """

    moving: tuple[float, float]
    held: Mapping[str, float]
    drift: Mapping[str, float]
    wander: float = 20.0
    poses: int = 300
    cycles: float = 1.0
    phase: float = 0.0


PUBLISHED_SWEEPS: Mapping[str, Sweep] = {
    "pitch": Sweep((20.0, 80.0), {"swing": 0.0, "boom": -27.5, "stick": 80.0},
                   {"boom": -0.2, "stick": 0.3}, 40.0),
    "stick": Sweep((45.0, 145.0), {"swing": 0.0, "boom": -27.5, "pitch": 42.9}, {"boom": -0.4}),
    "boom": Sweep((-48.0, -4.0), {"swing": 0.0, "stick": 80.2, "pitch": 42.9}, {"stick": 0.6}),
    "swing": Sweep((-95.0, 60.0), {"boom": -26.8, "stick": 81.0, "pitch": 42.9},
                   {"boom": -0.4, "stick": 0.8}, 10.0, 400),
}  # fmt: skip
"""Ranges, drifts and numbers of poses of Khoshzaban 1992 Figs 16 to 18; link 4 is an assumption."""

_HELD_ANGLES = {"swing": 0.0, "boom": -27.8, "stick": 80.6, "pitch": 42.9}  # K Table 2

DRIFT_FREE_SWEEPS = {name: sweep._replace(drift={}, held=_HELD_ANGLES) for name, sweep in PUBLISHED_SWEEPS.items()}
"""The same sweeps without drift, with each held link at one angle in all stages."""


class SweepPoses(NamedTuple):
    """Error-free poses of a stage.

    Attributes:
        link: moving link.
        theta: (M, N) true angles with offsets [rad].
        reached_fraction: fraction of the requested poses that the calibrator reaches [1].
    """

    link: str
    theta: np.ndarray
    reached_fraction: float


def generate_sweep_poses(loop: CalibrationLoop, link: str, sweep: Sweep, seed: int = 0) -> SweepPoses:
    """Generate true poses while a link sweeps its range and held links drift.

    Args:
        loop: the true chain.
        link: moving link.
        sweep: its trajectory.
        seed: seed of the grapple's random rotation.

    Returns:
        The poses that the calibrator reaches.
    """
    rng, count = np.random.default_rng([seed, len(link)]), 2 * sweep.poses
    u = np.linspace(0.0, 1.0, count)
    low, high = np.radians(sweep.moving)
    theta = np.tile(loop.values[:, 0], (count, 1))
    for name, angle in sweep.held.items():
        theta[:, loop.links.index(name)] = np.radians(angle + sweep.drift.get(name, 0.0) * u)
    moving = loop.links.index(link)
    turn = 2.0 * np.pi * sweep.cycles * u + sweep.phase
    theta[:, moving] = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(turn)
    pointing = _grapple_angle_to_ball(loop, theta)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = sum(np.sin(2.0 * np.pi * f * u + p) for f, p in zip((3.7, 7.3, 11.9), phases, strict=True))
    theta[:, loop.powered_count] = pointing + np.radians(sweep.wander) * wave / 3.0 * 1.6
    theta, reached = solve_calibrator_angles(loop, theta)
    good = theta[reached]
    rows = np.linspace(0, len(good) - 1, min(sweep.poses, len(good))).astype(int)
    return SweepPoses(link, good[rows], float(reached.mean()))


def _grapple_angle_to_ball(loop: CalibrationLoop, theta: np.ndarray) -> np.ndarray:
    """Return the grapple joint's angles (M,) [rad] at which the calibrator's arm can point at the ball."""
    place, turn = frame_after_links(loop, loop.powered_count, theta)
    x, y, _ = np.einsum("mji,mj->im", turn, loop.ball - place)
    return np.arctan2(y, x)


ARM_LENGTHS = np.linspace(2.0, 4.8, 8)
"""Grid of calibrator arm lengths [m]."""

FOREARM_LENGTHS = np.linspace(2.4, 4.8, 7)
"""Grid of calibrator forearm lengths [m]."""

_POSES_PER_LINK = 60  # per link
_MIN_REACHED_FRACTION = 0.98  # minimum fraction of poses that a design must reach
_TIP_POSES = (
    (-0.8, 0.9),
    (-0.5, 1.4),
    (-0.1, 1.9),
    (-0.1, 0.7),
    (-0.8, 2.2),
)  # boom, stick [rad, K]
_UNREACHED_TIP_ERROR = 1.0e3  # m: tip error assigned to a design that does not reach its poses


class Design(NamedTuple):
    """Calibrator design and its figures of merit.

    Attributes:
        arm: length from yoke to elbow, d of the twist joint [m].
        forearm: length from elbow to ball, a of the elbow [m].
        ball_x: position of the ball joint in front of the swing axis [m].
        ball_z: height of the ball joint above the boom pin [m].
        tip_error: RMS standard deviation of the calibrated arm's tip over its workspace [m].
        information: log determinant of the information matrix of the arm's parameters, normalised
            by their expected errors.
        reached: fraction of the measurement's poses that the calibrator reaches [1].
    """

    arm: float
    forearm: float
    ball_x: float
    ball_z: float
    tip_error: float
    information: float
    reached: float


class DesignSurvey(NamedTuple):
    """Evaluated calibrator designs over a grid of arm and forearm lengths, and the present design."""

    designs: tuple[Design, ...]
    present: Design


def evaluate_calibrator_design(
    loop: CalibrationLoop, arm: float, forearm: float, ball_x: float, ball_z: float, max_angle_error: float
) -> Design:
    """Evaluate how accurately a calibrator of given dimensions would calibrate the arm.

    A complete measurement with one sweep per link is simulated. It gives the fraction of the poses
    in reach and the covariance of the identified parameters.

    Args:
        loop: the nominal chain.
        arm: length from yoke to elbow [m].
        forearm: length from elbow to ball [m].
        ball_x: position of the ball joint in front of the swing axis [m].
        ball_z: height of the ball joint above the boom pin [m].
        max_angle_error: largest error of an angle sensor, uniformly distributed [rad].

    Returns:
        The design with its figures of merit.
    """
    values = loop.values.copy()
    values[-2, 3], values[-1, 2] = arm, forearm
    loop = replace(loop, values=values, ball=np.array([ball_x, loop.ball[1], ball_z]))
    sigma = np.full(len(loop) - loop.powered_count, max_angle_error / np.sqrt(3.0))
    stages, reached = [], []
    for link, sweep in DRIFT_FREE_SWEEPS.items():
        clean = generate_sweep_poses(loop, link, sweep._replace(poses=_POSES_PER_LINK))
        reached.append(clean.reached_fraction)
        if len(clean.theta) < _POSES_PER_LINK // 2:
            return Design(arm, forearm, ball_x, ball_z, _UNREACHED_TIP_ERROR, -np.inf, float(np.mean(reached)))
        shown = clean.theta - loop.values[:, 0]
        own = {n: shown[:, k] for k, n in enumerate(loop.links[: loop.powered_count])}
        stages.append(Poses(link, shown[:, loop.powered_count :], sigma, own))
    names, matrix = _stacked_jacobian(loop, stages)
    sizes = np.array([expected_parameter_error(loop, name) for name in names])
    scaled = matrix * sizes
    covariance = np.linalg.pinv(scaled.T @ scaled, rcond=1e-14) * np.outer(sizes, sizes)
    own = [k for k, n in enumerate(names) if not n.startswith("p_")
           and n.partition(".")[2] in loop.links[: loop.powered_count]]  # fmt: skip
    part = covariance[np.ix_(own, own)] / np.outer(sizes[own], sizes[own])
    information = -float(np.linalg.slogdet(part)[1])
    tip = _tip_position_std(loop, names, covariance)
    return Design(arm, forearm, ball_x, ball_z, tip, information, float(np.mean(reached)))


def _stacked_jacobian(loop: CalibrationLoop, stages: list[Poses]) -> tuple[list[str], np.ndarray]:
    """Return the p identifiable parameters and the Jacobian (rows, p) of all stages' equations.

    The rows are divided by the standard deviations of the equations' noise.
    """
    numbers = initial_parameters(loop, stages)
    names: list[str] = []
    parts = []
    for poses in stages:
        equations = StageEquations(loop, poses)
        told = classify_candidates(equations, numbers, candidate_parameters(loop, poses.link))
        names += [told.names[k] for k in sorted(told.base)]
    for poses in stages:
        equations = StageEquations(loop, poses)
        _, by, sensed = equations.residual_and_jacobian(numbers)
        rows = equations.whitening_factors(sensed) @ equations.select_parameter_derivatives(by, names)
        parts.append(rows.reshape(-1, len(names)))
    return names, np.vstack(parts)


def _tip_position_std(loop: CalibrationLoop, names: list[str], covariance: np.ndarray) -> float:
    """Return the uncertainty of the arm's tip position due to a parameter covariance (p, p) [m].

    It is the root mean square standard deviation over five arm poses.
    """
    count = loop.powered_count - 1
    chain = link_chain(loop.values[:count])
    total = 0.0
    for boom, stick in _TIP_POSES:
        rates = chain_poses_and_derivatives(chain, np.array([[0.0, boom, stick][:count]]))
        by = rates.position_by_parameter[0].reshape(3, count, 5)
        slope = np.zeros((3, len(names)))
        for column, name in enumerate(names):
            kind, _, link = name.partition(".")
            if link in loop.links[:count] and kind in ("held", "d", "a", "alpha", "beta"):
                at = ("held", "d", "a", "alpha", "beta").index(kind)
                slope[:, column] = by[:, loop.links.index(link), at]
        total += float(np.trace(slope @ covariance @ slope.T))
    return float(np.sqrt(total / len(_TIP_POSES)))


def evaluate_design_grid(loop: CalibrationLoop, accuracy: float) -> DesignSurvey:
    """Evaluate calibrators over a grid of arm and forearm lengths, with the ball joint at its present place.

    Args:
        loop: the nominal chain.
        accuracy: largest error of an angle sensor, uniformly distributed [rad].

    Returns:
        The designs, ordered by forearm length, and the design of the present calibrator.
    """
    x, z = float(loop.ball[0]), float(loop.ball[2])
    grid = [
        evaluate_calibrator_design(loop, float(a), float(f), x, z, accuracy)
        for f in FOREARM_LENGTHS
        for a in ARM_LENGTHS
    ]
    arm, forearm = float(loop.values[-2, 3]), float(loop.values[-1, 2])
    present = evaluate_calibrator_design(loop, arm, forearm, x, z, accuracy)
    return DesignSurvey(tuple(grid), present)


def optimize_design(loop: CalibrationLoop, survey: DesignSurvey, accuracy: float) -> Design:
    """Find the calibrator lengths and ball joint position with the smallest error of the arm's tip.

    Designs that reach fewer than 98 % of the poses get a penalty. The search is that of Nelder and
    Mead.

    Args:
        loop: the nominal chain.
        survey: grid of designs, the best of which starts the search.
        accuracy: largest error of an angle sensor, uniformly distributed [rad].

    Returns:
        The design; the ball joint stays on the chassis, 1.0 to 2.6 m in front of the swing axis
        and 1.3 to 0.6 m below the boom pin.
    """
    reaching = [d for d in (*survey.designs, survey.present) if d.reached >= _MIN_REACHED_FRACTION]
    start = min(reaching or [survey.present], key=lambda d: d.tip_error)

    def cost(x):
        found = evaluate_calibrator_design(loop, x[0], x[1], x[2], x[3], accuracy)
        return np.log(found.tip_error) + 50.0 * max(0.0, _MIN_REACHED_FRACTION - found.reached)

    bounds = [(1.5, 4.8), (1.5, 5.2), (1.0, 2.6), (-1.3, -0.6)]
    first = np.clip(start[:4], *np.array(bounds).T)
    found = scipy.optimize.minimize(
        cost, first, method="Nelder-Mead", bounds=bounds,
        options={"maxfev": 120, "xatol": 0.02, "fatol": 1e-3},
    )  # fmt: skip
    arm, forearm, ball_x, ball_z = found.x.tolist()
    return evaluate_calibrator_design(loop, arm, forearm, ball_x, ball_z, accuracy)


Criterion = Literal["D", "O1", "O2", "O3", "O4", "O5"]
_RELATIVE_RIDGE = 1e-9  # times the mean information, so that the first poses have a nonzero determinant

Key = TypeVar("Key", bound=Hashable)
Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class PoseSelection:
    """Selected poses.

    Attributes:
        chosen: indices of the poses among the candidates.
        index: value of the criterion; larger is better.
        exchanges: number of exchanges made by the search.
    """

    chosen: tuple[int, ...]
    index: float
    exchanges: int


def observability_index(information: np.ndarray, criterion: Criterion, equations: int) -> float:
    """Compute an observability index, which rates how well measured poses determine parameters.

    A larger index is better.

    With singular values s1 >= ... >= sp of the scaled identification Jacobian of m equations:
    D = O1 = (s1 ... sp)^(1/p) / sqrt(m), O2 = sp / s1, O3 = sp, O4 = sp^2 / s1,
    O5 = 1 / (1/s1 + ... + 1/sp).

    Args:
        information: (p, p) information matrix J'J of parameters in units of their scales.
        criterion: name of the index.
        equations: m, number of equations.

    Returns:
        The index; 0 if the information matrix is singular.

    Source: Borm and Menq 1991 (O1); Driels and Pathre 1990 (O2); Nahvi, Hollerbach and Hayward 1994
    (O3); Nahvi and Hollerbach 1996 (O4); Sun and Hollerbach 2008 (O5, comparison).

    >>> observability_index(np.diag([4.0, 1.0]), "O2", 10)
    0.5
    """
    s = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))[::-1]
    if s[-1] <= 0.0:
        return 0.0
    if criterion in ("D", "O1"):
        return float(np.exp(np.mean(np.log(s))) / np.sqrt(equations))
    if criterion == "O2":
        return float(s[-1] / s[0])
    if criterion == "O3":
        return float(s[-1])
    if criterion == "O4":
        return float(s[-1] ** 2 / s[0])
    return float(1.0 / np.sum(1.0 / s))


def select_poses(
    jacobians: np.ndarray, count: int, criterion: Criterion = "D",
    prior: np.ndarray | None = None,
) -> PoseSelection:  # fmt: skip
    """Select the poses whose measurements are most informative about the parameters.

    Args:
        jacobians: (n, k, p) derivatives of the k equations of each candidate by identifiable
            parameters in units of their scales, divided by the equations' standard deviations.
        count: number of poses to select.
        criterion: `D` or an observability index.
        prior: (p, p) information already available, for example from earlier poses.

    Returns:
        The poses, found by addition and exchange; no exchange of one pose improves the criterion.

    Raises:
        InputError: there are fewer candidates than poses, or too few equations.

    Source: Fedorov 1972 (exchange); Daney, Papegay and Madeline 2005 (robot calibration).
    """
    rows = np.asarray(jacobians, float)
    n, k, p = rows.shape
    if not 0 < count <= n:
        raise InputError("poses", f"cannot select {count} poses from {n} candidates")
    if prior is None and count * k < p:
        raise InputError("poses", f"{count} poses give {count * k} equations for {p} parameters: choose more")
    each = np.einsum("nki,nkj->nij", rows, rows)
    small = _RELATIVE_RIDGE * max(float(np.trace(each.mean(axis=0))) / p, 1e-300) * np.eye(p)
    base = small if prior is None else np.asarray(prior, float) + small

    def find_best_candidate(total: np.ndarray, open_: np.ndarray, size: int) -> tuple[int, float]:
        if criterion in ("D", "O1"):
            gains = _log_det_gains(total, rows[open_])
            place = int(np.argmax(gains))
        else:
            values = [observability_index(total + each[c], criterion, size * k) for c in open_]
            place = int(np.argmax(values))
        chosen = int(open_[place])
        return chosen, observability_index(total + each[chosen], criterion, size * k)

    chosen: list[int] = []
    total = base.copy()
    for size in range(1, count + 1):
        open_ = np.setdiff1d(np.arange(n), chosen)
        new, _ = find_best_candidate(total, open_, size)
        chosen.append(new)
        total = total + each[new]
    value, exchanges, improved = observability_index(total, criterion, count * k), 0, True
    while improved and count < n:
        improved = False
        for place in range(count):
            without = total - each[chosen[place]]
            open_ = np.setdiff1d(np.arange(n), chosen)
            new, better = find_best_candidate(without, open_, count)
            if better > value * (1.0 + 1e-9):
                chosen[place], total, value = new, without + each[new], better
                exchanges, improved = exchanges + 1, True
    return PoseSelection(tuple(chosen), value, exchanges)


def _log_det_gains(total: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return by how much each candidate's rows J (k, p) would increase the log determinant of `total`.

    Args:
        total: (p, p) present information matrix.
        rows: (n, k, p) rows of the n candidates.

    Returns:
        (n,) log det(I + J total^-1 J').
    """
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(factor, np.swapaxes(rows, 1, 2).transpose(1, 0, 2).reshape(len(total), -1))
    half = half.reshape(len(total), len(rows), -1)
    grown = np.einsum("pnk,pnl->nkl", half, half) + np.eye(rows.shape[1])
    return np.linalg.slogdet(grown)[1]


def leave_one_out(
    groups: Iterable[Key], fit: Callable[[Sequence[Key]], Fitted],
    evaluate: Callable[[Fitted, Key], float],
) -> dict[Key, float]:  # fmt: skip
    """Cross-validate: compute the error of each group with a fit to all other groups.

    Args:
        groups: names of poses, or of groups of poses that are left out together.
        fit: function from groups to a fit.
        evaluate: function that returns the error of a fit on a group.

    Returns:
        Error by group.

    >>> data = {"a": 1.0, "b": 2.0, "c": 6.0}
    >>> mean = lambda names: sum(data[name] for name in names) / len(names)
    >>> leave_one_out(data, mean, lambda fitted, name: abs(fitted - data[name]))
    {'a': 3.0, 'b': 1.5, 'c': 4.5}
    """
    named = list(groups)
    return {name: evaluate(fit([other for other in named if other != name]), name) for name in named}

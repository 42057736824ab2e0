"""Design of calibrators: link lengths and position of the ball joint (Khoshzaban 1992, section 5.3).

The criteria are the tip error of the calibrated arm and the fraction of poses within reach.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.optimize

from hydrotele.calibrate.arm_identification import (
    StageEquations,
    candidate_parameters,
    classify_candidates,
    expected_parameter_error,
    initial_parameters,
)
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import (
    CalibrationLoop,
    link_chain,
)
from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, generate_sweep_poses
from hydrotele.kinematics.serial_chain import chain_poses_and_derivatives

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
    """Evaluated calibrator designs over a grid of arm and forearm lengths.

    Attributes:
        designs: the designs of the grid.
        present: the design with the lengths of the calibrator in the given chain.
    """

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
        The design with its figures of merit. If fewer than half of the poses of a link are in reach,
        the tip error is 1000 m and the information is minus infinity.
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
    """Return the uncertainty of the arm's tip position due to the covariance (p, p) of parameters `names` [m].

    It is the square root of the mean, over five arm poses, of the trace of the position's covariance.
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
    """Evaluate calibrators over a grid of arm and forearm lengths, with the ball joint as in the given chain.

    Args:
        loop: the nominal chain.
        accuracy: largest error of an angle sensor, uniformly distributed [rad].

    Returns:
        The designs, ordered by forearm length and then arm length, and the design of the calibrator
        in the given chain.
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
        survey: grid of designs. The search starts from the one with the smallest tip error that
            reaches 98 % of the poses.
        accuracy: largest error of an angle sensor, uniformly distributed [rad].

    Returns:
        The design. The ball joint stays on the chassis, 1.0 to 2.6 m in front of the swing axis
        and 1.3 to 0.6 m below the boom pin. The arm is 1.5 to 4.8 m long, the forearm 1.5 to 5.2 m.
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

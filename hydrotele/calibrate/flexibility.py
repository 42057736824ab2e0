"""Noise model of flexible calibrator joints, estimated together with the arm's parameters.

A loaded joint bends, so that its sensor reading differs from the angle between its links. The error
of joint k has the variance `sigma_k^2 + (f_k l_k)^2`. The load l_k is the horizontal distance from
the joint to the ball as a fraction of its maximum; the bending moment is proportional to it. The
f_k are maximum-likelihood estimates.

Source: Khoshzaban 1992, sections 3.7.3 (p. 60) and 5.3 (p. 124), which proposes such a noise model.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.optimize

from hydrotele.calibrate.arm_identification import ArmFit, StageEquations
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import CalibrationLoop, ball_position_from_axis, frame_after_links

_MAX_ALTERNATIONS = 3  # alternations of noise model and parameters; the third changes the f_k by below 1 %
_MAX_FLEXIBILITY = np.radians(10.0)  # rad at full load: far above that of any calibrator
_START_FLEXIBILITY = np.radians(0.2)  # rad at full load, start of the search

Refit = Callable[[Sequence[Poses]], ArmFit]


class Flexibility(NamedTuple):
    """Estimated flexibility of the calibrator's joints.

    Attributes:
        joints: names of the S joints.
        at_full_load: (S,) standard deviation of the angle error at full load [rad]. Full load is a
            horizontal distance from joint to ball that equals the maximum reach.
        log_likelihood_gain: increase in log likelihood over a model without flexibility [1].
    """

    joints: tuple[str, ...]
    at_full_load: np.ndarray
    log_likelihood_gain: float


def relative_lever_arms(loop: CalibrationLoop, poses: Poses, fit: ArmFit) -> np.ndarray:
    """Compute the relative load of each calibrator joint: horizontal distance to the ball over maximum reach.

    Returns:
        (M, S) relative loads from 0 to 1 for the M poses of one stage (one moving link) and the S
        joints of the calibrator. Maximum reach is the sum of the link lengths beyond a joint.
    """
    equations = StageEquations(loop, poses)
    chain, theta = equations.chain_and_angles(fit.parameters)
    place = equations.place
    angles = np.tile(loop.home, (len(poses), 1))
    angles[:, place + 1 :] = theta
    for k, link in enumerate(loop.links[:place]):
        if link in poses.manipulator:
            angles[:, k] = poses.manipulator[link] + loop.values[k, 0]
    origin, rotation = frame_after_links(fit.loop, place, angles)
    ball = np.einsum("mji,mj->mi", rotation, fit.loop.ball - origin)
    along = ball_position_from_axis(chain, place, theta)
    angles[:, place] = np.arctan2(ball[:, 1], ball[:, 0]) - np.arctan2(along[:, 1], along[:, 0])
    loads = np.empty((len(poses), len(loop) - loop.powered_count))
    lengths = np.hypot(chain.values[loop.powered_count :, 2], chain.values[loop.powered_count :, 3])
    for column in range(loads.shape[1]):
        at, _ = frame_after_links(chain, loop.powered_count + column, angles)
        reach = lengths[column:].sum()
        loads[:, column] = np.hypot(*(fit.loop.ball - at)[:, :2].T) / reach
    return np.minimum(loads, 1.0)


def add_flexibility_to_noise(loop: CalibrationLoop, poses: Poses, fit: ArmFit, flexibility: np.ndarray) -> Poses:
    """Return poses whose sensor noise includes the bending of the calibrator's joints under load.

    The variance of a reading becomes that of its sensor plus the square of `flexibility` (S,) [rad]
    times the relative load of the joint (from 0 to 1).
    """
    loads = relative_lever_arms(loop, poses, fit)
    return replace(poses, sigma=np.hypot(poses.sigma, flexibility * loads))


def estimate_flexibility(loop: CalibrationLoop, stages: Sequence[Poses], fit: ArmFit) -> Flexibility:
    """Estimate the flexibility of the calibrator's joints by maximum likelihood, with fixed arm parameters.

    Args:
        loop: the nominal chain.
        stages: poses, one item per moving link, with the sensors' own standard deviations (S,).
        fit: fit of these poses.

    Returns:
        The flexibility; 0 for joints whose errors are explained by sensor noise.
    """
    errors, sensed, loads, sigma = [], [], [], []
    for poses in stages:
        equations = StageEquations(loop, poses)
        error, _, by = equations.residual_and_jacobian(fit.parameters)
        errors.append(error)
        sensed.append(by)
        loads.append(relative_lever_arms(loop, poses, fit))
        sigma.append(np.broadcast_to(poses.sigma, loads[-1].shape))
    error, by = np.concatenate(errors), np.concatenate(sensed)
    load, known = np.concatenate(loads), np.concatenate(sigma)

    def negative_log_likelihood(x: np.ndarray) -> float:
        variance = known**2 + (x * load) ** 2
        c = np.einsum("mis,ms,mjs->mij", by, variance, by) + StageEquations.MIN_DEVIATION**2 * np.eye(2)
        whole = c[:, 0, 0] * c[:, 1, 1] - c[:, 0, 1] ** 2
        e0, e1 = error[:, 0], error[:, 1]
        square = (c[:, 1, 1] * e0**2 - 2 * c[:, 0, 1] * e0 * e1 + c[:, 0, 0] * e1**2) / whole
        return float(0.5 * np.sum(np.log(whole) + square))

    count = load.shape[1]
    found = scipy.optimize.minimize(
        lambda u: negative_log_likelihood(u * _START_FLEXIBILITY), np.ones(count), method="L-BFGS-B",
        bounds=[(0.0, _MAX_FLEXIBILITY / _START_FLEXIBILITY)] * count,
    )  # fmt: skip
    at_full_load = found.x * _START_FLEXIBILITY
    gain = negative_log_likelihood(np.zeros(count)) - negative_log_likelihood(at_full_load)
    return Flexibility(loop.links[loop.powered_count :], at_full_load, gain)


def refit_with_flexibility(
    loop: CalibrationLoop, stages: Sequence[Poses], fit: ArmFit, refit: Refit
) -> tuple[ArmFit, Flexibility]:
    """Refit the arm parameters with the bending of the calibrator's joints in the noise model.

    The joint flexibility is estimated with fixed parameters. Then a fit with this noise and a new
    estimate of the flexibility are repeated three times.

    Args:
        loop: the nominal chain.
        stages: poses with the sensors' own standard deviations.
        fit: fit of these poses, the start of the search.
        refit: function from poses to a fit, such as `identify_arm`.

    Returns:
        The fit weighted by the noise model, and the flexibility.
    """
    found = estimate_flexibility(loop, stages, fit)
    for _ in range(_MAX_ALTERNATIONS):
        fit = refit([add_flexibility_to_noise(loop, p, fit, found.at_full_load) for p in stages])
        found = estimate_flexibility(loop, stages, fit)
    return fit, found

"""Simulated pose measurements of a hybrid robot.

Random manufacturing errors, reachable poses, and noisy readings of carriage, legs and wires [m,
rad].
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.kinematics.hybrid_error_model import ErrorModel
from hydrotele.kinematics.hybrid_robot import (
    LEG_COUNT,
    REVOLUTE,
    HybridRobot,
    PlatformPose,
    euler_to_rotation,
    forward_kinematics,
    home_pose,
    leg_readings,
)
from hydrotele.kinematics.wire_measurement import WireGeometry, pose_covariance, wire_lengths

PLATFORM_REACH, PLATFORM_TILT = (
    0.08,
    0.25,
)  # m, rad: range of random platform poses about the home pose
_MAX_ERROR_RATIO = 20.0  # largest ratio of a pose coordinate's error [m or rad] to the wires' error [m]
_MAX_TRIALS = 200


class MeasuredPoses(NamedTuple):
    """Simulated readings of N poses, and the true values.

    Attributes:
        joints: (N, n) carriage readings [m] or [rad].
        legs: (N, 6) leg readings [m].
        wires: (N, 6) wire readings [m].
        true_joints: (N, n) true carriage positions [m] or [rad].
        true_legs: (N, 6) true leg lengths, as readings without noise [m].
        pose: true poses of the moving platform.
    """

    joints: np.ndarray
    legs: np.ndarray
    wires: np.ndarray
    true_joints: np.ndarray
    true_legs: np.ndarray
    pose: PlatformPose


def default_wires() -> WireGeometry:
    """Return six measuring wires for the robot IWR, from a hexagon around its rails to its platform.

    The hexagon has a radius of 1.5 m and lies 1 m below frame 0 (base), centred at half the length
    of the rails. The arms are fixed to the platform and have a length of 0.45 m. Of all assignments
    of arms to corners, this one gives the smallest measurement errors over the workspace.
    """
    at = np.arange(LEG_COUNT) * np.pi / 3.0
    corners = np.column_stack([np.full(LEG_COUNT, -1.0), 1.5 * np.cos(at), 1.45 + 1.5 * np.sin(at)])
    arms = np.arange(3) * 2.0 * np.pi / 3.0
    points = np.column_stack([0.45 * np.cos(arms), 0.45 * np.sin(arms), np.full(3, 0.05)])
    corners, points = corners[[0, 2, 4, 1, 5, 3]].round(6), points[[1, 2, 0]].round(6)
    return WireGeometry(anchors=tuple(map(tuple, corners.tolist())),
                 points=tuple(map(tuple, points.tolist())))  # fmt: skip


def sample_manufacturing_errors(
    model: ErrorModel, rng: np.random.Generator, names: tuple[str, ...] | None = None,
    size: float = 1.0,
) -> np.ndarray:  # fmt: skip
    """Sample the manufacturing errors (p,) of a robot from normal distributions of mean zero.

    The standard deviation of each of the p errors of `model` is `size` times its value in `model.scales`.
    With `names`, only the errors of these names are sampled; all others are zero.
    """
    errors = rng.normal(size=len(model.names)) * model.scales * size
    if names is not None:
        kept = np.zeros(len(errors), bool)
        kept[model.parameter_indices(names)] = True
        errors[~kept] = 0.0
    return errors


def sample_poses(
    robot: HybridRobot, count: int, rng: np.random.Generator, wires: WireGeometry | None = None,
    reach: float = PLATFORM_REACH, tilt: float = PLATFORM_TILT,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Sample random reachable poses: carriage over its whole range, platform about its home pose.

    Args:
        robot: the robot, without manufacturing errors.
        count: number of poses N.
        rng: random generator.
        wires: if given, poses are rejected in which the error of any pose coordinate [m] or [rad]
            exceeds 20 times the error of a wire [m].
        reach: largest displacement of the platform from its home pose along each axis [m].
        tilt: largest Euler angle of the platform relative to its home pose [rad].

    Returns:
        (joints (N, n), leg readings (N, 6)), all legs within their range.

    Raises:
        ValueError: too few poses are within the ranges.
    """
    low, high = robot.joint_range.T
    joints, legs = np.empty((0, len(low))), np.empty((0, LEG_COUNT))
    for _ in range(_MAX_TRIALS):
        q = rng.uniform(low, high, (count, len(low)))
        home = home_pose(robot, q)
        local = rng.uniform(-1.0, 1.0, (count, 6)) * np.repeat([reach, tilt], 3)
        place = np.einsum("nij,nj->ni", home.rotation, local[:, :3]) + home.position
        pose = PlatformPose(home.rotation @ euler_to_rotation(local[:, 3:]), place)
        readings = leg_readings(robot, q, pose)
        good = (readings > robot.leg_range[0]).all(1) & (readings < robot.leg_range[1]).all(1)
        if wires is not None:
            cov = pose_covariance(wires, pose, 1.0)
            good &= np.sqrt(np.einsum("nii->ni", cov)).max(axis=1) < _MAX_ERROR_RATIO
        joints, legs = np.vstack([joints, q[good]]), np.vstack([legs, readings[good]])
        if len(legs) >= count:
            return joints[:count], legs[:count]
    raise ValueError(f"robot {robot.name}: too few random poses are within the legs' range")


def simulate_measured_poses(
    robot: HybridRobot, joints: np.ndarray, legs: np.ndarray, wires: WireGeometry,
    noise: Mapping[str, float], rng: np.random.Generator,
) -> MeasuredPoses:  # fmt: skip
    """Simulate noisy sensor readings of a robot with manufacturing errors.

    Args:
        robot: the robot as built.
        joints: (N, n) true carriage positions [m] or [rad].
        legs: (N, 6) true leg readings [m].
        wires: geometry of the measuring wires.
        noise: standard deviations of the readings `leg`, `prismatic`, `wire` [m], `revolute` [rad];
            0 by default.
        rng: random generator of the noise.

    Returns:
        Readings with noise, and the true values.
    """
    pose = forward_kinematics(robot, joints, legs)
    sizes = np.where(robot.kinds == REVOLUTE, noise.get("revolute", 0.0), noise.get("prismatic", 0.0))
    lengths = wire_lengths(wires, pose)
    return MeasuredPoses(
        joints + sizes * rng.normal(size=joints.shape),
        legs + noise.get("leg", 0.0) * rng.normal(size=legs.shape),
        lengths + noise.get("wire", 0.0) * rng.normal(size=lengths.shape), joints, legs, pose,
    )  # fmt: skip

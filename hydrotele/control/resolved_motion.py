"""Resolved motion in cylindrical coordinates (r, theta, z, attitude, head), by rate or position.

`step_references_to_pose` computes joint references by inverse kinematics and their rates by the
inverse Jacobian, so that no error is integrated. If a step would leave the workspace or a joint
range, the reference is held and `is_blocked` is set until the command returns to the held pose.

`step_references_by_rate` is the alternative of Zhu 1994, Eq. 2.1: joint rates by the inverse
Jacobian at the measured joint angles, integrated to references. Errors of the direction of motion
accumulate.
"""

import dataclasses
import math

import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.core.compiled import compiled
from hydrotele.kinematics.task_space import (
    compute_joint_rates,
    compute_tip_pose,
    solve_joint_angles,
)
from hydrotele.machine.machine import Machine

POSE_SIZE = 5  # r, theta, z, attitude, head
_RELEASE_DISTANCE = 0.02  # m or rad, release distance of a blocked reference: about one control period


@compiled
def step_references_to_pose(arm_constants, ranges, target, rate, blocked, pose, q, speed):
    """Set joint references to the inverse kinematics of a target pose of the tip, or hold them.

    They are held if the target is out of reach or singular, needs an angle outside a joint range,
    or, after a held step, is farther than 0.02 m or rad from the held pose in any coordinate.

    Args:
        arm_constants: (9,) parameters of the arm, of `kinematics.task_space.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        target: (5,) target pose: r [m], theta [rad], z [m], attitude [rad], head [rad].
        rate: (5,) time derivative of the target [m/s], [rad/s].
        blocked: whether the references were held in the last step, scalar.
        pose: (5,) tip pose that belongs to the joint references, updated unless held.
        q: (k,) joint references, updated unless held [rad].
        speed: (k,) rates of the joint references, written; 0 while held [rad/s].

    Returns:
        Whether the references were held, as a scalar.

    Source: Zhu 1994, chapter 2.
    """
    k = len(q)
    found = np.empty(POSE_SIZE)[:k]
    held = False
    if blocked:
        for i in range(max(k, 3)):
            if i < k and not abs(target[i] - pose[i]) <= _RELEASE_DISTANCE:
                held = True
    held = held or solve_joint_angles(arm_constants, target, q[0], found) != 0
    if not held:
        for i in range(k):
            if not ranges[i, 0] <= found[i] <= ranges[i, 1]:
                held = True
    held = held or compute_joint_rates(arm_constants, found, target, rate, speed) != 0
    if held:
        speed[:] = 0.0
        return True
    for i in range(k):
        q[i] = found[i]
    for i in range(len(pose)):
        pose[i] = target[i]
    if k < 4:
        pose[3] = found[1] + found[2]
    return False


@compiled
def step_references_by_rate(arm_constants, ranges, measured, rate, period, pose, q, speed):
    """Convert a rate of the tip to joint rates and integrate the joint references, or hold them at a limit.

    Args:
        arm_constants: (9,) parameters of the arm, of `kinematics.task_space.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        measured: (k,) joint angles at which the Jacobian is evaluated [rad].
        rate: (5,) rate of r, theta, z, attitude and head [m/s], [rad/s].
        period: integration period, scalar [s].
        pose: (5,) tip pose that belongs to the joint references, updated unless held [m], [rad].
        q: (k,) joint references, updated unless held [rad].
        speed: (k,) rates of the joint references, written; 0 while held [rad/s].

    Returns:
        Whether the references were held, as a scalar. They are held if the arm is singular, a joint
        reference would leave its range, or a measured angle is not finite.

    Source: Zhu 1994, Eq. 2.1.
    """
    k = len(q)
    there = np.zeros(5)
    held = False
    for i in range(k):
        held = held or not math.isfinite(measured[i])
    if not held:
        compute_tip_pose(arm_constants, measured, there)
        held = compute_joint_rates(arm_constants, measured, there, rate, speed) != 0
    if not held:
        for i in range(k):
            if not ranges[i, 0] <= q[i] + period * speed[i] <= ranges[i, 1]:
                held = True
    if held:
        speed[:] = 0.0
        return True
    for i in range(k):
        q[i] += period * speed[i]
    compute_tip_pose(arm_constants, q, pose)
    return False


@dataclasses.dataclass(frozen=True)
class ResolvedMotion:
    """State of the resolved-motion controller, which converts motion of the tip to joint references.

    Attributes:
        arm_geometry_parameters: (9,) parameters of the arm, of
            `kinematics.task_space.arm_parameters`.
        axes: k axis names from swing outwards, 3 to 5.
        ranges: (k, 2) joint ranges [rad], same order.
        joints: (k,) joint references [rad], same order.
        pose: reference r [m], theta [rad], z [m], attitude [rad] and, with a head, its angle [rad].
            The attitude is the angle of the last link (tool or stick) in the plane of the arm. The
            head rotates the tool sideways.
        is_blocked: whether the references were held in the last step, at a limit of workspace or
            joints.
    """

    arm_geometry_parameters: np.ndarray
    axes: tuple[str, ...]
    ranges: np.ndarray
    joints: tuple[float, ...]
    pose: tuple[float, ...]
    is_blocked: bool = False

    @staticmethod
    def from_joints(machine: Machine, joints: dict[str, float]) -> "ResolvedMotion":
        """Create the state of the controller whose references are given joint positions (axis name -> [rad]).

        Raises:
            InputError: the machine has no arm.
        """
        numbers, axes, ranges = arm_specification(machine)
        q = tuple(float(joints[a]) for a in axes)
        pose = np.zeros(5)
        compute_tip_pose(numbers, np.array(q), pose)
        return ResolvedMotion(numbers, axes, ranges, q, tuple(pose[: max(4, len(axes))].tolist()))

    def step_by_rate(self, rate, dt: float) -> tuple["ResolvedMotion", dict, dict]:
        """Advance the references by a rate of the tip that is constant for dt.

        The reference pose changes by `rate` times `dt`; `step_to_pose` converts it to joint
        references.

        Args:
            rate: (4,) or (5,) dr/dt [m/s], dtheta/dt [rad/s], dz/dt [m/s], dattitude/dt [rad/s],
                dhead/dt [rad/s].
            dt: duration [s].

        Returns:
            (next state, axis -> joint reference [rad], axis -> rate of the reference [rad/s]).
        """
        wanted = tuple(p + v * dt for p, v in zip(self.pose, rate, strict=False))
        return self.step_to_pose(wanted, rate)

    def step_to_pose(self, target, rate) -> tuple["ResolvedMotion", dict, dict]:
        """Set the joint references to a target pose of the tip, and convert the rate of this pose to joint rates.

        The references are held at a limit; see `step_references_to_pose`.

        Args:
            target: (4,) or (5,) target r [m], theta [rad], z [m], attitude [rad], head [rad].
            rate: (4,) or (5,) time derivative of the target [m/s], [rad/s].

        Returns:
            (next state, axis -> joint reference [rad], axis -> rate of the reference [rad/s]).
        """
        pose, q, speed = _pad_to_five(self.pose), np.array(self.joints), np.zeros(len(self.axes))
        blocked = step_references_to_pose(
            self.arm_geometry_parameters,
            self.ranges,
            _pad_to_five(target),
            _pad_to_five(rate),
            self.is_blocked,
            pose,
            q,
            speed,
        )
        state = dataclasses.replace(
            self, joints=tuple(q.tolist()), pose=tuple(pose[: len(self.pose)].tolist()),
            is_blocked=bool(blocked),
        )  # fmt: skip
        return (
            state,
            dict(zip(self.axes, state.joints, strict=True)),
            dict(zip(self.axes, speed.tolist(), strict=True)),
        )


def _pad_to_five(values) -> np.ndarray:
    out = np.zeros(5)
    out[: min(5, len(values))] = values[:5]
    return out

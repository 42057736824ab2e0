"""Resolved motion in cylindrical coordinates (r, theta, z, attitude, head), by rate or position.

`step_references_to_pose` computes joint references by inverse kinematics and their rates by the inverse
Jacobian, so that no error is integrated. If a step would leave the workspace or a joint range, the
reference is held and `is_blocked` is set until the command returns to the held pose.

`step_references_by_rate` is the alternative of Zhu 1994, Eq. 2.1: joint rates by the inverse Jacobian at the
measured joint angles, integrated to references. Errors of the direction accumulate.
"""

import dataclasses
import math

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import UnreachableError, inverse_kinematics
from hydrotele.kinematics.from_machine import (
    arm_geometry,
    feller_geometry,
    is_planar_arm,
    solve_joints_for_tip,
    tip_position,
)
from hydrotele.kinematics.task import (
    REACHED,
    arm_parameters,
    compute_joint_rates,
    compute_tip_pose,
    solve_joint_angles,
)
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Pose

COORDINATES = ("r", "theta", "z", "attitude", "head")
_RELEASE_DISTANCE = 0.02  # m or rad, release distance of a blocked reference: about one control period


@compiled
def step_references_to_pose(arm_constants, ranges, target, rate, blocked, pose, q, speed):
    """Set joint references to the inverse kinematics of a target pose, or hold them if it is out of reach.

    Args:
        arm_constants: (9,) parameters of the arm, of `kinematics.task.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        target: (5,) target pose: r [m], theta [rad], z [m], attitude [rad], head [rad].
        rate: (5,) time derivative of the target [m/s], [rad/s].
        blocked: whether the last step was held, scalar; then only a pose near the held one releases
            the references.
        pose: (5,) pose of the references, updated.
        q: (k,) joint references, updated [rad].
        speed: (k,) their rates, written; 0 while held [rad/s].

    Returns:
        Whether the references were held, as a scalar.

    Source: Zhu 1994, chapter 2.
    """
    k = len(q)
    found = np.empty(k)
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
        arm_constants: (9,) parameters of the arm, of `kinematics.task.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        measured: (k,) joint angles at which the Jacobian is evaluated [rad].
        rate: (5,) rate of r, theta, z, attitude and head [m/s], [rad/s].
        period: integration period, scalar [s].
        pose: (5,) pose of the references, updated [m], [rad].
        q: (k,) joint references, updated [rad].
        speed: (k,) their rates, written; 0 while held [rad/s].

    Returns:
        Whether the references were held, as a scalar: the arm is singular, a joint would leave its
        range, or a measured angle is not finite.

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
    """State of the resolved-motion controller.

    Attributes:
        arm_geometry_parameters: (9,) parameters of the arm, of `kinematics.task.arm_parameters`.
        axes: k axis names from swing outwards, 3 to 5.
        ranges: (k, 2) joint ranges [rad], same order.
        joints: (k,) joint references [rad], same order.
        pose: desired r [m], theta [rad], z [m], attitude [rad] and, with a head, its angle [rad].
        is_blocked: whether the last step was held at a limit of the workspace.
    """

    arm_geometry_parameters: np.ndarray
    axes: tuple[str, ...]
    ranges: np.ndarray
    joints: tuple[float, ...]
    pose: tuple[float, ...]
    is_blocked: bool = False

    @staticmethod
    def from_joints(machine: Machine, joints: dict[str, float]) -> "ResolvedMotion":
        """Create the state of the controller at given positions of the axes (name -> [rad]).

        Raises:
            InputError: the machine has no arm.
        """
        numbers, axes, ranges = arm_specification(machine)
        q = tuple(float(joints[a]) for a in axes)
        pose = np.zeros(5)
        compute_tip_pose(numbers, np.array(q), pose)
        return ResolvedMotion(numbers, axes, ranges, q, tuple(pose[: max(4, len(axes))].tolist()))

    def step_by_rate(self, rate, dt: float) -> tuple["ResolvedMotion", dict, dict]:
        """Advance the references by a rate command of the tip that is constant for dt.

        Args:
            rate: (4,) or (5,) dr/dt [m/s], dtheta/dt [rad/s], dz/dt [m/s], dattitude/dt [rad/s],
                dhead/dt [rad/s].
            dt: duration [s].

        Returns:
            (next state, axis -> position [rad], axis -> velocity [rad/s]).
        """
        wanted = tuple(p + v * dt for p, v in zip(self.pose, rate, strict=False))
        return self.step_to_pose(wanted, rate)

    def step_to_pose(self, target, rate) -> tuple["ResolvedMotion", dict, dict]:
        """Set the references to a target pose of the tip and convert its rate to joint rates.

        Args:
            target: (4,) or (5,) target r [m], theta [rad], z [m], attitude [rad], head [rad].
            rate: (4,) or (5,) time derivative of the target [m/s], [rad/s].

        Returns:
            (next state, axis -> position [rad], axis -> velocity [rad/s]).
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


def arm_axes(machine: Machine) -> tuple[str, ...]:
    """Return the axis names of the arm's joints, from swing outwards.

    Raises:
        InputError: the machine has no arm, or a joint of its arm is not driven.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm for resolved motion or poses")
    by_joint = {axis.joint: name for name, axis in machine.axes.items()}
    joints = [j for j in (arm.swing, arm.boom, arm.stick, arm.tool, arm.head) if j]
    if missing := [j for j in joints if j not in by_joint]:
        raise InputError(f"machine {machine.name}: arm", f"{missing} are not driven by an axis")
    return tuple(by_joint[j] for j in joints)


def arm_specification(machine: Machine) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """Return kinematic parameters (9,) of the arm, its k axis names, and its joint ranges (k, 2) [rad].

    The axes are ordered from swing outwards.

    Raises:
        InputError: the machine has no arm, or a joint of its arm is not driven.
    """
    axes = arm_axes(machine)
    limits = [machine.joints[machine.axes[a].joint].range for a in axes]
    ranges = np.array([limit or (-math.inf, math.inf) for limit in limits])
    headed = machine.arm is not None and machine.arm.head is not None
    geometry = feller_geometry(machine) if headed else arm_geometry(machine)
    return arm_parameters(geometry), axes, ranges


def pose_to_joints(machine: Machine, pose: Pose, current: dict[str, float], where: str = "pose") -> dict[str, float]:
    """Compute the axis positions at which the tip has a pose (inverse kinematics).

    The joint axes of a calibrated arm may be twisted out of its plane. For an arm of three joints,
    Newton's method then refines the solution of the planar arm.

    Args:
        machine: the machine.
        pose: target pose; without `attitude` the tool keeps that of `current`.
        current: axis -> current position [rad].
        where: key path of the pose, for messages.

    Returns:
        Axis -> position [rad].

    Raises:
        InputError: the pose is out of reach or violates a joint range.
    """
    numbers, axes, ranges = arm_specification(machine)
    attitude, head = pose.attitude, pose.head
    if attitude is None:
        attitude = sum(current[a] for a in axes[1:4])
    if head is None:
        head = current[axes[4]] if len(axes) == 5 else 0.0
    joints, wanted = np.zeros(len(axes)), np.array([pose.r, pose.theta, pose.z, attitude, head])
    if solve_joint_angles(numbers, wanted, pose.theta, joints) != REACHED:
        raise InputError(where, _describe_unreachable(machine, wanted[: len(axes)]))
    if len(axes) == 3 and not is_planar_arm(machine):
        place = (pose.r * math.cos(pose.theta), pose.r * math.sin(pose.theta), pose.z)
        joints = solve_joints_for_tip(machine, np.array(place), joints)
        if not np.allclose(tip_position(machine, joints), place, rtol=0.0, atol=1e-6):
            raise InputError(where, _describe_unreachable(machine, wanted[: len(axes)]))
    for name, q, (low, high) in zip(axes, joints.tolist(), ranges, strict=True):
        if not low <= q <= high:
            raise InputError(
                where,
                f"needs {name} at {math.degrees(q):.1f} deg, but its joint range is"
                f" {math.degrees(low):.1f} to {math.degrees(high):.1f} deg",
            )
    return dict(zip(axes, joints.tolist(), strict=True))


def _describe_unreachable(machine: Machine, pose: np.ndarray) -> str:
    if len(pose) == 5:
        return f"the tool cannot reach r {pose[0]:.6g} m, z {pose[2]:.6g} m"
    try:
        inverse_kinematics(arm_geometry(machine), pose.tolist())
    except UnreachableError as error:
        return str(error)
    return "is out of reach"

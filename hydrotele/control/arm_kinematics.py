"""Axes, kinematic parameters and joint ranges of a machine's arm, and the axis positions of a pose of its tip."""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import UnreachableError, inverse_kinematics
from hydrotele.kinematics.arm_dimensions import (
    arm_geometry,
    feller_geometry,
    is_planar_arm,
    solve_joints_for_tip,
    tip_position,
)
from hydrotele.kinematics.task_space import (
    REACHED,
    arm_parameters,
    solve_joint_angles,
)
from hydrotele.machine.machine import Machine
from hydrotele.scenario.pilots import Pose

COORDINATES = ("r", "theta", "z", "attitude", "head")


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
    """Return kinematic parameters, axis names and joint ranges of a machine's arm.

    Returns:
        (parameters (9,) of `kinematics.task_space.arm_parameters`, names of the k axes from swing
        outwards, joint ranges (k, 2) [rad], infinite for a joint without a range).

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
        pose: target pose; without `attitude` or `head`, the tool keeps the attitude or head angle
            that it has at the positions `current`.
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

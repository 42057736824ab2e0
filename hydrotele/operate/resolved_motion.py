"""Resolved motion in cylindrical coordinates (r, theta, z, attitude), by rate or position.

Inverse kinematics gives the joint references and the inverse Jacobian their rates, so that no error
is integrated. A step that would leave the reach or a joint's range is not made: the reference stays
and `blocked` says so, until the command comes back to where it stands.
"""

import dataclasses
import math

import numpy as np

from hydrotele.errors import InputError
from hydrotele.kinematics.arm import (
    ArmGeometry,
    Unreachable,
    forward,
    inverse,
    jacobian,
)
from hydrotele.kinematics.from_machine import arm_geometry
from hydrotele.machine import Machine
from hydrotele.scenario import Pose

_NEAR = 0.02  # m or rad, about one control period of motion: a blocked reference must not jump


@dataclasses.dataclass(frozen=True)
class ResolvedMotion:
    """State of the resolved-motion controller.

    Attributes:
        geometry: the arm.
        axes: axis names from swing outwards, (3,) or (4,).
        ranges: joint ranges [rad], same order.
        joints: joint references [rad], same order.
        pose: desired r [m], theta [rad], z [m], attitude [rad].
        blocked: whether the last step was stopped at the edge of the workspace.
    """

    geometry: ArmGeometry
    axes: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    joints: tuple[float, ...]
    pose: tuple[float, float, float, float]
    blocked: bool = False

    @staticmethod
    def begin(machine: Machine, joints: dict[str, float]) -> "ResolvedMotion":
        """Start at the given axis positions [rad].

        Raises:
            InputError: the machine has no arm.
        """
        geometry, axes, ranges = _arm_facts(machine)
        q = tuple(float(joints[a]) for a in axes)
        return ResolvedMotion(geometry, axes, ranges, q, _pose(geometry, q))

    def rate_step(self, rate, dt: float) -> tuple["ResolvedMotion", dict, dict]:
        """Move by a rate command held for dt.

        Args:
            rate: (4,) dr/dt [m/s], dtheta/dt [rad/s], dz/dt [m/s], dattitude/dt [rad/s].
            dt: [s].

        Returns:
            (next state, axis -> position [rad], axis -> velocity [rad/s]).
        """
        wanted = tuple(p + v * dt for p, v in zip(self.pose, rate, strict=True))
        return self.position_step(wanted, rate)

    def position_step(self, wanted, rate) -> tuple["ResolvedMotion", dict, dict]:
        """Move to a pose, with its rate for feedforward.

        Args:
            wanted: (4,) r [m], theta [rad], z [m], attitude [rad].
            rate: (4,) its time derivative.

        Returns:
            (next state, axis -> position [rad], axis -> velocity [rad/s]).
        """
        size = len(self.axes)
        joints = self._solve(tuple(wanted))
        speeds = None if joints is None else self._speeds(joints, np.array(rate)[:size])
        if joints is None or speeds is None:
            still = dict.fromkeys(self.axes, 0.0)
            held = dataclasses.replace(self, blocked=True)
            return held, dict(zip(self.axes, self.joints, strict=True)), still
        attitude = wanted[3] if size == 4 else sum(joints[1:])
        pose = (wanted[0], wanted[1], wanted[2], attitude)
        state = dataclasses.replace(self, joints=joints, pose=pose, blocked=False)
        return (
            state,
            dict(zip(self.axes, joints, strict=True)),
            dict(zip(self.axes, speeds.tolist(), strict=True)),
        )

    def _speeds(self, joints, rate) -> np.ndarray | None:
        try:
            return np.linalg.solve(np.array(jacobian(self.geometry, joints)), rate)
        except np.linalg.LinAlgError:  # a straight arm
            return None

    def _solve(self, wanted) -> tuple[float, ...] | None:
        size = len(self.axes)
        way = np.subtract(wanted[:size], self.pose[:size])
        if self.blocked and np.abs(way).max() > _NEAR:
            return None
        try:
            joints = inverse(self.geometry, wanted[: len(self.axes)])
        except Unreachable:
            return None
        turns = round((self.joints[0] - joints[0]) / math.tau)
        joints = (joints[0] + turns * math.tau, *joints[1:])
        inside = all(lo <= q <= hi for q, (lo, hi) in zip(joints, self.ranges, strict=True))
        return joints if inside else None


def _pose(geometry: ArmGeometry, joints) -> tuple[float, float, float, float]:
    pose = forward(geometry, joints)
    attitude = pose[3] if len(pose) == 4 else sum(joints[1:])
    return pose[0], pose[1], pose[2], attitude


def arm_axes(machine: Machine) -> tuple[str, ...]:
    """Axis names of the arm's joints, from swing outwards.

    Raises:
        InputError: the machine has no arm, or a joint of its arm is not driven.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm for resolved motion or poses")
    by_joint = {axis.joint: name for name, axis in machine.axes.items()}
    joints = [j for j in (arm.swing, arm.boom, arm.stick, arm.tool) if j]
    if missing := [j for j in joints if j not in by_joint]:
        raise InputError(f"machine {machine.name}: arm", f"{missing} are not driven by an axis")
    return tuple(by_joint[j] for j in joints)


def _arm_facts(machine: Machine):
    axes = arm_axes(machine)
    limits = [machine.joints[machine.axes[a].joint].range for a in axes]
    ranges = tuple(limit or (-math.inf, math.inf) for limit in limits)
    return arm_geometry(machine), axes, ranges


def pose_to_joints(
    machine: Machine, pose: Pose, here: dict[str, float], where: str = "pose"
) -> dict[str, float]:
    """Axis positions that bring the tip to a pose.

    Args:
        machine: the machine.
        pose: the pose; without `attitude` the tool keeps that of `here`.
        here: axis -> present position [rad].
        where: key path of the pose, for messages.

    Returns:
        Axis -> position [rad].

    Raises:
        InputError: the pose is out of reach or beyond a joint's range.
    """
    geometry, axes, ranges = _arm_facts(machine)
    attitude = pose.attitude
    if attitude is None:
        attitude = sum(here[a] for a in axes[1:])
    try:
        joints = inverse(geometry, (pose.r, pose.theta, pose.z, attitude)[: len(axes)])
    except Unreachable as error:
        raise InputError(where, str(error)) from None
    for name, q, (low, high) in zip(axes, joints, ranges, strict=True):
        if not low <= q <= high:
            raise InputError(
                where,
                f"needs {name} at {math.degrees(q):.1f} deg, which its joint allows only from"
                f" {math.degrees(low):.1f} to {math.degrees(high):.1f} deg",
            )
    return dict(zip(axes, joints, strict=True))

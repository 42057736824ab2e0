"""References of the joint servo from rate commands: joint rates, or rates of the tip.

The acceleration of the references is limited, since a machine of 20 t cannot follow a step. A
reference cannot run away from an arm that is stalled. Environments and policies in scenario runs
share these functions.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.resolved_motion import POSE_SIZE, step_references_to_pose
from hydrotele.core.compiled import compiled
from hydrotele.kinematics.task_space import compute_tip_pose

_MAX_REFERENCE_LEAD = 0.2  # rad or m, maximum lead of a reference over its joint: anti-windup for a stalled arm


@compiled
def limit_change(now, goal, change):
    """Return the value that is nearest to `goal` and differs from `now` by at most `change`, scalars."""
    return min(now + change, max(now - change, goal))


@compiled
def advance_joint_reference(reference, rate, goal, joint, limits, acceleration, period):
    """Integrate a rate command over one control period to the reference of a joint.

    Acceleration, joint range and the lead of the reference over the measured joint are limited; at
    the limits of range or lead, the reference rate becomes 0.

    Args:
        reference: joint reference, scalar [rad] or [m].
        rate: rate of the reference, scalar [rad/s] or [m/s].
        goal: commanded rate, scalar [rad/s] or [m/s].
        joint: measured position of the joint, scalar [rad] or [m].
        limits: (2,) joint range [rad] or [m].
        acceleration: limit of the acceleration, scalar [rad/s^2] or [m/s^2].
        period: control period, scalar [s].

    Returns:
        (new reference, new rate), scalars.

    Source: this module.
    """
    speed = limit_change(rate, goal, acceleration * period)
    place = reference + period * speed
    low = max(limits[0], joint - _MAX_REFERENCE_LEAD)
    high = min(limits[1], joint + _MAX_REFERENCE_LEAD)
    if place < low or place > high:
        return min(high, max(low, reference)), 0.0
    return place, speed


class ArmLimits(NamedTuple):
    """Dimensions and limits of an arm of k axes.

    Attributes:
        parameters: (9,) of `kinematics.task_space.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        accelerations: (5,) limits of the pose accelerations [m/s^2], [rad/s^2].
    """

    parameters: np.ndarray
    ranges: np.ndarray
    accelerations: np.ndarray


@compiled
def advance_pose_reference(arm, goal, period, joint, pose, pose_rate, q, rates):
    """Integrate tip rate commands over one control period, and convert the tip pose to joint references.

    If the new pose is not reachable, the references are held. If a reference is too far from its
    measured joint, the references are moved to a limited distance from the measured joints.

    Args:
        arm: ArmLimits of k axes.
        goal: (5,) commanded rates of r, theta, z, attitude, head [m/s], [rad/s]; 0 beyond axis k.
        period: control period, scalar [s].
        joint: (k,) measured joint angles [rad].
        pose: (5,) pose of the references, updated [m], [rad].
        pose_rate: (5,) rate of this pose, updated [m/s], [rad/s].
        q: (k,) joint references, updated [rad].
        rates: (k,) rates of the joint references, updated [rad/s].

    Returns:
        Whether the references were held, as a scalar.

    Source: `control.resolved_motion`.
    """
    k, wanted = len(q), np.empty(POSE_SIZE)
    for c in range(POSE_SIZE):
        pose_rate[c] = limit_change(pose_rate[c], goal[c], arm.accelerations[c] * period)
        wanted[c] = pose[c] + period * pose_rate[c]
    far = False
    for a in range(k):
        far = far or abs(q[a] - joint[a]) > _MAX_REFERENCE_LEAD
    held = far or step_references_to_pose(arm.parameters, arm.ranges, wanted, pose_rate, False, pose, q, rates)
    if held:
        pose_rate[:], rates[:] = 0.0, 0.0
    if far:  # the arm is blocked by an obstacle: continue from its measured position
        for a in range(k):
            q[a] = limit_change(joint[a], q[a], _MAX_REFERENCE_LEAD)
        compute_tip_pose(arm.parameters, q, pose)
    return held

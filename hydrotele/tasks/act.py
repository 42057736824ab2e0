"""Actions of an agent into commands of valves and drives, once per control period.

Rates are bounded in their change, since a machine of 20 t follows no jump: joint rates move joint
references, pose rates those of the arm by resolved motion, and the joint servo follows them.
"""

import numpy as np

from hydrotele.control.drive_rows import POINTS, drive_row
from hydrotele.control.resolved_motion import follow_pose
from hydrotele.control.servo import servo_step
from hydrotele.core.compiled import compiled
from hydrotele.kinematics.task import task_forward
from hydrotele.simulate.pointers import floats
from hydrotele.tasks.memory import ARM, JOINT_RATE, RESOLVED_MOTION, VALVE

_AHEAD = 0.2  # rad or m by which a reference may lead its joint: a stalled arm winds nothing up


@compiled
def _asked(f, action, a):
    """An action as it counts."""
    return 0.0 if a == f.locked else min(1.0, max(-1.0, action[a]))


@compiled
def _towards(now, goal, change):
    return min(now + change, max(now - change, goal))


@compiled
def _joint_rates(f, e, action, first):
    """Move the references of axes by their own rates; actions from `first` on."""
    for a in range(first, f.actions):
        i = f.driven_axis[a]
        goal = _asked(f, action, a) * f.fastest[i]
        rate = _towards(e.reference_rate[i], goal, f.acceleration * f.period)
        place = e.reference[i] + f.period * rate
        low = max(f.ranges[i, 0], e.joint[i] - _AHEAD)
        high = min(f.ranges[i, 1], e.joint[i] + _AHEAD)
        if place < low or place > high:
            place, rate = min(high, max(low, e.reference[i])), 0.0
        e.reference[i], e.reference_rate[i] = place, rate


@compiled
def _pose_rates(f, e, action):
    """Move the references of the arm by rates of its pose."""
    k, wanted = f.arm_axes, np.empty(ARM)
    for c in range(ARM):
        goal = 0.0
        if c < k:
            goal = _asked(f, action, c) * f.fastest_pose[c]
        e.pose_rate[c] = _towards(e.pose_rate[c], goal, f.accelerations[c] * f.period)
        wanted[c] = e.pose[c] + f.period * e.pose_rate[c]
    far = False
    for i in range(k):
        far = far or abs(e.reference[i] - e.joint[i]) > _AHEAD
    held = far or follow_pose(
        f.arm, f.ranges[:k], wanted, e.pose_rate, False, e.pose, e.reference[:k],
        e.reference_rate[:k],
    )  # fmt: skip
    e.blocked = 1 if held else 0
    if held:
        e.pose_rate[:] = 0.0
        e.reference_rate[:k] = 0.0
    if far:  # the arm is stopped by something: go on from where it stands
        for i in range(k):
            e.reference[i] = _towards(e.joint[i], e.reference[i], _AHEAD)
        task_forward(f.arm, e.reference[:k], e.pose)


@compiled
def act(f, e, action):
    """Commands of this control period.

    Args:
        f: record of FACTS.
        e: record of MEMORY; `command` and, unless actions are valves, references are written.
        action: (actions,) of the agent, full at +-1; beyond they count as full.

    Returns:
        Nothing.

    Source: `control.resolved_motion`, `control.servo`.
    """
    if f.mode == VALVE:
        for a in range(f.actions):
            i = f.driven_axis[a]
            e.command[i] = _asked(f, action, a) * f.limit[i]
        return
    if f.mode == RESOLVED_MOTION:
        _pose_rates(f, e, action)
        _joint_rates(f, e, action, f.arm_axes)
    elif f.mode == JOINT_RATE:
        _joint_rates(f, e, action, 0)
    k = f.axes
    table = floats(f.table, k * POINTS * 3).reshape((k, POINTS, 3))
    drive_row(
        f.grid[:k], table, e.reference[:k], e.reference_rate[:k], f.feedforward, e.drive[0, :k],
        e.drive[1, :k], e.drive[2, :k], e.drive[3, :k],
    )  # fmt: skip
    none = np.zeros(k)
    servo_step(
        f.servo[:k], f.closed[:k], e.drive[0, :k], e.drive[1, :k], e.drive[2, :k], e.drive[3, :k],
        e.sampled_reference[:k], e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply,
        e.load[:k], False, none, none, e.command[:k],
    )  # fmt: skip

"""Where an arm starts: poses drawn from ranges until one lies well inside the workspace.

Whether an arm can go straight from one pose to another, and how much that asks of its drives.
"""

import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import ARM
from hydrotele.kinematics.task import REACHED, task_forward, task_inverse, task_rates
from hydrotele.machine.machine import Machine

_DRAWS = 1000
_ROOM = 0.08  # rad to the ends of the joints' ranges


def draw_start(
    machine: Machine, rng: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...]
) -> dict[str, float]:
    """Positions of an arm's axes for a pose between two.

    Args:
        machine: the machine.
        rng: random generator.
        low: (5,) or, without a head, (4,) least r [m], theta [rad], z [m], attitude, head [rad].
        high: the same, at most.

    Returns:
        Axis -> position [rad].

    Raises:
        InputError: next to none of these poses can be reached.
    """
    numbers, axes, ranges = arm_facts(machine)
    pose, joints = np.zeros(5), np.zeros(len(axes))
    for _ in range(_DRAWS):
        pose[: len(low)] = rng.uniform(low, high)
        if (
            task_inverse(numbers, pose, pose[1], joints) == REACHED
            and ((ranges[:, 0] + _ROOM <= joints) & (joints <= ranges[:, 1] - _ROOM)).all()
        ):
            return dict(zip(axes, joints.tolist(), strict=True))
    raise InputError(f"start of {machine.name}", f"no pose from {low} to {high} can be reached")


_PLACES = 16  # at which a path is looked at
_ROOM_WORKSPACE = 0.03  # rad that stay free to the ends of the joints' ranges


@compiled
def path_effort(f, start, change):
    """Most that a straight path of the pose asks of the drives, for one that takes a second.

    Args:
        f: record of TASK_PARAMETERS.
        start: (ARM,) pose where it begins: r [m], theta [rad], z [m], attitude, head [rad].
        change: (ARM,) from there to its end, the same units.

    Returns:
        Sum of the axes' rates, each as a share of its rate at full action, at the worst place of
        the path, scalar [s]; infinite where it leaves the workspace. Drives share a pump, so that
        it is the sum that counts.

    Source: `kinematics.task`.
    """
    k = f.arm_axes
    pose, q, rates = np.empty(ARM), np.empty(k), np.empty(k)
    worst = 0.0
    for n in range(_PLACES + 1):
        for c in range(ARM):
            pose[c] = start[c] + change[c] * n / _PLACES
        if task_inverse(f.arm, pose, pose[1], q) != 0:
            return np.inf
        for i in range(k):
            if not f.ranges[i, 0] + _ROOM_WORKSPACE <= q[i] <= f.ranges[i, 1] - _ROOM_WORKSPACE:
                return np.inf
        if task_rates(f.arm, q, pose, change, rates) != 0:
            return np.inf
        effort = 0.0
        for i in range(k):
            effort += abs(rates[i]) / f.fastest[i]
        worst = max(worst, effort)
    return worst


@compiled
def pose_read(f, e, pose):
    """Pose of the tip by the readings of the joints.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        pose: (ARM,) written.

    Returns:
        Nothing.

    Source: `kinematics.task.task_forward`.
    """
    task_forward(f.arm, e.joint[: f.arm_axes], pose)


@compiled
def turned(angle):
    """The angle from -pi to pi that points the same way, scalar [rad]."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))

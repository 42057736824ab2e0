"""Where an arm starts: poses drawn from ranges until one lies well inside the workspace."""

import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.errors import InputError
from hydrotele.kinematics.task import REACHED, task_inverse
from hydrotele.machine.machine import Machine

_DRAWS = 1000
_ROOM = 0.08  # rad to the ends of the joints' ranges


def draw_start(
    machine: Machine, chance: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...]
) -> dict[str, float]:
    """Positions of an arm's axes for a pose between two.

    Args:
        machine: the machine.
        chance: random generator.
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
        pose[: len(low)] = chance.uniform(low, high)
        if (
            task_inverse(numbers, pose, pose[1], joints) == REACHED
            and ((ranges[:, 0] + _ROOM <= joints) & (joints <= ranges[:, 1] - _ROOM)).all()
        ):
            return dict(zip(axes, joints.tolist(), strict=True))
    raise InputError(f"start of {machine.name}", f"no pose from {low} to {high} can be reached")

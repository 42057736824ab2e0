"""Actions of any kind that bring the tip along a pose and its rate."""

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_facts
from hydrotele.tasks.controllers.controller import columns, position_columns, step_time
from hydrotele.tasks.controllers.rows import inverse_rows
from hydrotele.tasks.controllers.track import Asked
from hydrotele.tasks.controllers.valve_law import ValveLaw
from hydrotele.tasks.facts import ACCELERATION, POSE_ACCELERATIONS, Setup, full_rate
from hydrotele.tasks.memory import ARM

_INTEGRAL = 2.0  # 1/s^2
_JOINTS = (6.0, 1.0)  # 1/s: of the model's place to the goal, of the model to what is measured
_POSE = (4.0, 1.0)


class PoseFollower:
    """The tip of an arm without axes beyond it, on a pose that moves."""

    def __init__(self, setup: Setup) -> None:
        """Look up the nominal machine."""
        k = setup.arm_axes
        self._arm, _, self._ranges = arm_facts(setup.machine)
        self._dt, self._k = step_time(setup), k
        self._tip, self._joint = columns(setup, "tip", COORDINATES[:k]), position_columns(setup)
        self._law = self._asked = None
        if setup.options.action == "valve":
            self._law = ValveLaw(setup, setup.task.servo, _INTEGRAL)
        elif setup.options.action == "joint_rate":
            fastest = np.array([full_rate(setup.machine, axis) for axis in setup.axes])
            self._asked = Asked(setup, fastest, np.full(k, ACCELERATION), _JOINTS)
        else:
            accelerations = np.array(POSE_ACCELERATIONS[:k])
            self._asked = Asked(setup, np.array(setup.task.pose_rates[:k]), accelerations, _POSE)
        self._by_pose = setup.options.action == "resolved_motion"

    def begin(self, count: int) -> None:
        """Start `count` episodes."""
        (self._law or self._asked).begin(count)  # pyright: ignore - one of them is there
        self._q, self._fresh = np.zeros((count, self._k)), np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes of mask (n,)."""
        (self._law or self._asked).reset(mask)  # pyright: ignore - one of them is there
        self._fresh |= mask

    def __call__(self, observation: np.ndarray, pose: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Actions of this step.

        Args:
            observation: (n, o).
            pose: (n, k) where the tip should be.
            rate: (n, k) the rate there.

        Returns:
            (n, k).
        """
        if self._by_pose:
            assert self._asked
            return self._asked.rates(observation[:, self._tip].astype(float), pose, rate)
        measured = observation[:, self._joint].astype(float)
        self._q[self._fresh], self._fresh[:] = measured[self._fresh], False
        before, full = self._q.copy(), np.zeros((len(pose), ARM))
        full[:, : self._k] = pose
        inverse_rows(self._arm, self._ranges, full, self._q)
        speed = (self._q - before) / self._dt
        if self._law:
            return self._law(observation, self._q, speed)
        assert self._asked
        return self._asked.rates(measured, self._q, speed)

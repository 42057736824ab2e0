"""References followed by valves, joint rates or rates of the tip: feedforward and feedback."""

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_facts
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveLaw,
    columns,
    forward_poses,
    position_columns,
    step_time,
)
from hydrotele.envs.episode import ARM
from hydrotele.envs.facts import (
    ACCELERATION,
    POSE_ACCELERATIONS,
    TaskSetup,
    full_rate,
)
from hydrotele.envs.track import PREVIEWS
from hydrotele.scenario.scenario import Servo

SERVO = Servo()
_INTEGRAL = 2.0  # 1/s^2
_LEAD = 0.06  # s: the spool's lag and half a step
_JOINTS = (8.0, 1.0)  # 1/s: of the model's place to the goal, of the model to what is measured
_POSE = (3.0, 3.0)  # the same of a tip that must often be faster than it may
_NEAR = 0.02  # s to either side, of a difference quotient


class Preview:
    """References between those that the observation shows, by the polynomial through all of them.

    Positions at now and the PREVIEWS and the rate now make it one of fourth order.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Find the columns."""
        ahead = [f"reference_in_{time * 1000:.0f}_ms" for time in PREVIEWS]
        self._columns = [
            columns(setup, what, setup.axes) for what in ("reference", "reference_rate", *ahead)
        ]
        powers = np.arange(len(self._columns))
        rows = [[float(p == 0) for p in powers], [float(p == 1) for p in powers]]
        self._solved = np.linalg.inv(np.array(rows + [[t**p for p in powers] for t in PREVIEWS]))

    def at(self, observation: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """References and their rates, (n, k) each, `time` [s] from now."""
        powers = np.arange(len(self._columns))
        place = time**powers @ self._solved
        rate = (powers[1:] * time ** (powers[1:] - 1)) @ self._solved[1:]
        shown = np.stack([observation[:, c] for c in self._columns]).astype(float)
        return np.tensordot(place, shown, 1), np.tensordot(rate, shown, 1)


class TrackByValves:
    """The joint servo with an integral, its velocities ahead by the spools' lag."""

    def __init__(
        self,
        setup: TaskSetup,
        servo: Servo = SERVO,
        integral: float = _INTEGRAL,
        lead: float = _LEAD,
    ) -> None:
        """Look up the nominal machine."""
        self._law, self._preview = ValveLaw(setup, servo, integral), Preview(setup)
        self._lead = lead
        self.begin, self.reset = self._law.begin, self._law.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        now, _ = self._preview.at(observation, 0.0)
        _, rate = self._preview.at(observation, self._lead)
        return self._law(observation, now, rate)


class RateFeedback:
    """Rates for loops below that integrate them, by a model of what they were asked for so far.

    Feedback of the measured error through the loops below can only be slow; that of the model's
    place, which rates move at once, is fast. The model creeps to what is measured.
    """

    def __init__(
        self, setup: TaskSetup, fastest: np.ndarray, accelerations: np.ndarray, gains
    ) -> None:
        """Remember clocks and limits, both (k,), and gains [1/s]."""
        self._stiff, self._slow = gains
        self._fastest, self._dt = fastest, step_time(setup)
        self._period, self._ticks = setup.clock.period, setup.clock.ticks
        self._change = accelerations * self._period

    def begin(self, count: int) -> None:
        """Start `count` episodes."""
        shape = (count, len(self._fastest))
        self._place, self._rate = np.zeros(shape), np.zeros(shape)
        self._fresh = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes of mask (n,)."""
        self._fresh |= mask

    def rates(self, measured: np.ndarray, place: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Rates to ask for, (n, k), full at +-1.

        Args:
            measured: (n, k) places as measured.
            place: (n, k) where they should be.
            rate: (n, k) the rate there.

        Returns:
            (n, k).
        """
        self._place[self._fresh] = measured[self._fresh]
        self._rate[self._fresh], self._fresh[:] = 0.0, False
        self._place += self._slow * self._dt * (measured - self._place)
        wanted = (rate + self._stiff * (place - self._place)) / self._fastest
        action = np.clip(wanted, -1.0, 1.0)
        for _ in range(self._ticks):
            self._rate += np.clip(action * self._fastest - self._rate, -self._change, self._change)
            self._place += self._period * self._rate
        return action


class TrackByJointRates:
    """Joint references by their rates."""

    def __init__(self, setup: TaskSetup) -> None:
        """Look up the nominal machine."""
        self._preview, self._joint = Preview(setup), position_columns(setup)
        fastest = np.array([full_rate(setup.machine, axis) for axis in setup.axes])
        self._asked = RateFeedback(setup, fastest, np.full(len(fastest), ACCELERATION), _JOINTS)
        self.begin, self.reset = self._asked.begin, self._asked.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        measured = observation[:, self._joint].astype(float)
        return self._asked.rates(measured, *self._preview.at(observation, 0.0))


class TrackByResolvedMotion:
    """The pose of the references, through the arm's kinematics, by its rates."""

    def __init__(self, setup: TaskSetup) -> None:
        """Look up the nominal machine.

        Raises:
            InputError: axes beyond the arm's are driven.
        """
        k = setup.arm_axes
        if k < len(setup.axes):
            raise InputError(f"task {setup.task.name}", "drives axes beside the arm's")
        self._preview, self._arm = Preview(setup), arm_facts(setup.machine)[0]
        self._tip = columns(setup, "tip", COORDINATES[:k])
        fastest = np.array(setup.task.pose_rates[:k])
        self._asked = RateFeedback(setup, fastest, np.array(POSE_ACCELERATIONS[:k]), _POSE)
        self.begin, self.reset = self._asked.begin, self._asked.reset

    def _pose(self, observation: np.ndarray, time: float) -> np.ndarray:
        """Pose (n, k) of the references `time` [s] from now."""
        q = self._preview.at(observation, time)[0]
        pose = np.zeros((len(q), ARM))
        forward_poses(self._arm, np.ascontiguousarray(q), pose)
        return pose[:, : q.shape[1]]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        after = self._pose(observation, _NEAR)
        before = self._pose(observation, -_NEAR)
        measured = observation[:, self._tip].astype(float)
        rate = (after - before) / (2.0 * _NEAR)
        return self._asked.rates(measured, self._pose(observation, 0.0), rate)


def track_controller(setup: TaskSetup) -> Controller:
    """Controller of TrackTrajectory for the chosen kind of actions."""
    kinds = {"valve": TrackByValves, "joint_rate": TrackByJointRates}
    return kinds.get(setup.options.action or "", TrackByResolvedMotion)(setup)

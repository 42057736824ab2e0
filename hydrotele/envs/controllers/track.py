"""References followed by valves, joint rates or rates of the tip: feedforward and feedback.

A tip follows a line or goes to a pose by its own rates, those of the joints, or valves. Its error
is fed back gently, since hydraulics and servo below are slow and a house that slews on its oil is
slower still. To a plate of unknown stiffness it comes down slowly, then the error sets the speed.
"""

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_facts
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveLaw,
    columns,
    forward_poses,
    inverse_joints,
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
from hydrotele.envs.line import PREVIEWS as LINE_PREVIEWS
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


_LINE_GAIN = 0.5  # 1/s
_REACH_GAINS = (1.0, 0.45, 1.0, 1.0, 1.0)  # 1/s of r, theta, z, attitude, head
_JOINT_GAINS = (0.45, 1.0, 1.0, 1.0, 1.0)  # 1/s of the joints, from swing outwards
_TIP_INTEGRAL = 1.2  # 1/s^2: of valves that must hold a pose against leakage and dead bands
_GENTLY = 0.6  # share of a joint's full rate that a reach uses


class Tip:
    """Pose and rates of the tip into actions of the chosen kind."""

    def __init__(self, setup: TaskSetup, integral: float = 0.0) -> None:
        """Look up the nominal machine; the gain of the valves' integral is in [1/s^2]."""
        k = self._k = setup.arm_axes
        self._kind = setup.options.action
        self._arm, _, self._ranges = arm_facts(setup.machine)
        self._joint = position_columns(setup)[:k]
        self._tip = columns(setup, "tip", COORDINATES[:k])
        self._fastest = np.array([full_rate(setup.machine, axis) for axis in setup.axes[:k]])
        self._fastest_pose = np.array(setup.task.pose_rates[:k])
        self._valves = (
            ValveLaw(setup, setup.task.servo, integral) if self._kind == "valve" else None
        )

    def begin(self, count: int) -> None:
        """Start `count` episodes."""
        if self._valves:
            self._valves.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes of mask (n,)."""
        if self._valves:
            self._valves.reset(mask)

    def joints(self, observation: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Joint angles (n, k) for poses (n, k)."""
        found = np.ascontiguousarray(observation[:, self._joint], float)
        whole = np.zeros((len(pose), ARM))
        whole[:, : self._k] = pose
        inverse_joints(self._arm, self._ranges, whole, found)
        return found


class LineController(Tip):
    """Follows the line by the rate shortly ahead and the error of now."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the columns."""
        super().__init__(setup)
        self._wanted = columns(setup, "wanted", COORDINATES[: self._k])
        self._ahead = [
            columns(setup, f"wanted_in_{time * 1000:.0f}_ms", COORDINATES[:3])
            for time in LINE_PREVIEWS[:2]
        ]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        seen = observation.astype(float)
        wanted = seen[:, self._wanted]
        later = [np.concatenate([seen[:, c], wanted[:, 3:]], axis=1) for c in self._ahead]
        if self._kind == "resolved_motion":
            rate = (later[1] - later[0]) / (LINE_PREVIEWS[1] - LINE_PREVIEWS[0])
            off = wanted - seen[:, self._tip]
            return (rate + _LINE_GAIN * off) / self._fastest_pose
        now, soon = self.joints(observation, wanted), self.joints(observation, later[0])
        rate = (soon - now) / LINE_PREVIEWS[0]
        if self._valves:
            return self._valves(observation, now, rate)
        return (rate + _LINE_GAIN * (now - seen[:, self._joint])) / self._fastest


class ReachController(Tip):
    """Goes to the pose, the slower the nearer."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the columns."""
        super().__init__(setup, _TIP_INTEGRAL)
        self._wanted = columns(setup, "wanted", COORDINATES[: self._k])
        servo = setup.task.servo
        gains = [servo.axis_gains.get(axis, servo.position_gain) for axis in setup.axes[: self._k]]
        self._stiff = np.array(gains)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        seen = observation.astype(float)
        wanted = seen[:, self._wanted]
        if self._kind == "resolved_motion":
            off = wanted - seen[:, self._tip]
            return np.array(_REACH_GAINS) * off / self._fastest_pose
        joint = seen[:, self._joint]
        most = _GENTLY * self._fastest
        rate = np.array(_JOINT_GAINS) * (self.joints(observation, wanted) - joint)
        rate = np.clip(rate, -most, most)
        if self._valves:
            return self._valves(observation, joint + rate / self._stiff, np.zeros_like(rate))
        return rate / self._fastest


def line_controller(setup: TaskSetup) -> Controller:
    """Controller of StraightLine for the chosen kind of actions."""
    return LineController(setup)


def reach_controller(setup: TaskSetup) -> Controller:
    """Controller of ReachFeller for the chosen kind of actions."""
    return ReachController(setup)


_TOUCH = 1.5e3  # N: what the load cell does not read by error
_APPROACH, _MOST = 0.08, 0.10  # m/s
_GAIN = 2.0e-6  # m/s per N: two per second on 1e6 N/m


class Press:
    """The rate of the tip's height from the error of the force; nothing is remembered."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the columns.

        Raises:
            InputError: actions are not rates of the tip.
        """
        if setup.options.action != "resolved_motion":
            raise InputError(f"action {setup.options.action!r}", "presses by resolved_motion only")
        self._force = columns(setup, "force", [""])[0]
        self._wanted = columns(setup, "wanted_force", [""])[0]
        self._fastest, self._actions = setup.task.pose_rates[2], len(setup.axes)

    def begin(self, count: int) -> None:
        """Nothing to remember."""

    def reset(self, mask: np.ndarray) -> None:
        """Nothing to forget."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        force, wanted = observation[:, self._force], observation[:, self._wanted]
        speed = np.clip(_GAIN * (force - wanted), -_MOST, _MOST)
        actions = np.zeros((len(observation), self._actions))
        actions[:, 2] = np.where(force < _TOUCH, -_APPROACH, speed) / self._fastest
        return actions


def press_controller(setup: TaskSetup) -> Controller:
    """Controller of HoldForce, whose actions must be rates of the tip."""
    return Press(setup)

"""A tip that follows a line or goes to a pose: by its own rates, those of the joints, or valves.

The error of the tip is fed back gently, since hydraulics and servo below are slow and a house that
slews on its oil is slower still.

A force on a plate of unknown stiffness: come down slowly, then let the error set the speed.
"""

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_facts
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveLaw,
    columns,
    inverse_joints,
    position_columns,
)
from hydrotele.envs.episode import ARM
from hydrotele.envs.facts import TaskSetup, full_rate
from hydrotele.envs.line import PREVIEWS

_LINE_GAIN = 0.5  # 1/s
_REACH_GAINS = (1.0, 0.45, 1.0, 1.0, 1.0)  # 1/s of r, theta, z, attitude, head
_JOINT_GAINS = (0.45, 1.0, 1.0, 1.0, 1.0)  # 1/s of the joints, from swing outwards
_INTEGRAL = 1.2  # 1/s^2: of valves that must hold a pose against leakage and dead bands
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
            for time in PREVIEWS[:2]
        ]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        seen = observation.astype(float)
        wanted = seen[:, self._wanted]
        later = [np.concatenate([seen[:, c], wanted[:, 3:]], axis=1) for c in self._ahead]
        if self._kind == "resolved_motion":
            rate = (later[1] - later[0]) / (PREVIEWS[1] - PREVIEWS[0])
            off = wanted - seen[:, self._tip]
            return (rate + _LINE_GAIN * off) / self._fastest_pose
        now, soon = self.joints(observation, wanted), self.joints(observation, later[0])
        rate = (soon - now) / PREVIEWS[0]
        if self._valves:
            return self._valves(observation, now, rate)
        return (rate + _LINE_GAIN * (now - seen[:, self._joint])) / self._fastest


class ReachController(Tip):
    """Goes to the pose, the slower the nearer."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the columns."""
        super().__init__(setup, _INTEGRAL)
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

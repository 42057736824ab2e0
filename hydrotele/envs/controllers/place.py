"""Reference controller of the task `PlaceLog`: a sequence of moves without residual swing.

Every move has a trapezoidal speed profile. Its ramps last one period of the grapple's pendulum
motion, so the grapple does not swing after them. If the log is lost, the sequence starts again.
"""

import math

import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveLaw,
    columns,
    inverse_joints,
    position_columns,
    step_time,
)
from hydrotele.envs.controllers.track import RateFeedback
from hydrotele.envs.episode import ARM
from hydrotele.envs.facts import ACCELERATION, POSE_ACCELERATIONS, TaskSetup, full_rate

ABOVE, TAKE, CARRY, LAY = 2.5, 1.34, 2.6, 1.36  # m, heights of the pin at the stick's tip
SWAY = 0.03  # m by which the closing jaw pushes the grapple aside
PERIOD = 2.0  # s, period of the pendulum motion
SHUT, OPEN = 1.3, 0.0  # rad, jaw angles
_SPEEDS = np.array([0.35, 0.2, 0.35, 0.5, 0.8])  # m/s, rad/s, m/s, rad/s, rad/s, maximum rates
_GAINS = (3.0, 0.3)  # 1/s, gains of `RateFeedback`
_LEAD = 0.06  # s, phase lead of valve actions: the spool lag and half a step
_R, _THETA, _Z, _TURN, _JAW = range(5)
GO, DOWN, CLOSE, UP, SLEW, LOWER, RELEASE, LEAVE = range(8)
_PAUSES = np.array([1.0, 0.3, 0.5, 0.5, 1.0, 0.3, 0.3, 1.0])  # s after every phase


def course(time: np.ndarray, length: np.ndarray, ramp: np.ndarray) -> np.ndarray:
    """Return the completed fraction of a move with trapezoidal speed.

    Args:
        time: (n,) time since the start of the move [s].
        length: (n,) duration of the move at full speed without ramps [s].
        ramp: (n,) duration of the first and of the last ramp [s]; the move takes `length + ramp`.

    Returns:
        (n,) from 0 to 1: the integral of a box of speed convolved with a box of width `ramp`, whose
        spectrum is zero at the frequency 1 / `ramp`.
    """

    def gone(t):
        part = np.clip(t / length, 0.0, 1.0)
        return 0.5 * length * part**2 + np.maximum(0.0, t - length)

    return (gone(time) - gone(time - ramp)) / ramp


def _nearest(angle: np.ndarray, turn: float) -> np.ndarray:
    """Return the angle modulo `turn`, from -turn/2 to turn/2."""
    return angle - turn * np.round(angle / turn)


def pin_columns(setup: TaskSetup) -> np.ndarray:
    """Return the observation columns (5,) of pin r, theta, z, grapple rotation and jaw."""
    return np.concatenate([columns(setup, "tip", ("r", "theta", "z")), position_columns(setup)[3:]])


class Moves:
    """Plan the motion of the stick's pin, the grapple rotation and the jaw, phase by phase."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the nominal machine and the observation columns."""
        self._aside = float(arm_facts(setup.machine)[0][2])
        self._tip = pin_columns(setup)
        self._log = columns(setup, "log", ("r", "theta", "sin_2_yaw", "cos_2_yaw"))
        self._goal = columns(setup, "goal", ("r", "theta", "sin_2_yaw", "cos_2_yaw"))
        self._held = columns(setup, "held", [""])[0]
        rates = [full_rate(setup.machine, name) for name in setup.axes[3:]]
        self._speeds = np.minimum(_SPEEDS, 0.8 * np.array([*setup.task.pose_rates[:3], *rates]))
        self._dt = step_time(setup)

    def begin(self, count: int) -> None:
        """Allocate the state of `count` episodes."""
        self._phase = np.full(count, GO)
        self._time, self._length, self._ramp = (np.zeros(count) for _ in range(3))
        self._from, self._to = np.zeros((count, 5)), np.zeros((count, 5))
        self._fresh = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the state of the episodes selected by the mask (n,)."""
        self._fresh |= mask

    def update(self, seen: np.ndarray) -> None:
        """Advance the plan by one step with observations (n, o)."""
        fresh = self._fresh.copy()
        self._to[fresh], self._phase[fresh], self._fresh[:] = seen[fresh][:, self._tip], GO, False
        self._plan(seen, fresh)
        self._time[~fresh] += self._dt
        over = self._time > self._length + self._ramp + _PAUSES[self._phase]
        self._phase[over] = self._next(seen)[over]
        self._plan(seen, over)

    def at(self, ahead: float) -> np.ndarray:
        """Return the reference (n, 5) `ahead` [s] from now: r, z [m], theta, rotation, jaw [rad].

        The columns are r, theta, z, rotation, jaw.
        """
        share = course(self._time + ahead, self._length, self._ramp)[:, None]
        return self._from + share * (self._to - self._from)

    def _next(self, seen: np.ndarray) -> np.ndarray:
        """Return the phases (n,) that follow the current ones; a lost log leads to RELEASE."""
        following = (self._phase + 1) % (LEAVE + 1)
        lost = (seen[:, self._held] < 0.5) & np.isin(self._phase, (CLOSE, UP, SLEW))
        return np.where(lost, RELEASE, following)

    def _plan(self, seen: np.ndarray, which: np.ndarray) -> None:
        """Plan the moves of the episodes selected by the mask (n,), from the last targets."""
        if not which.any():
            return
        phase, goes = self._phase[which], self._to[which].copy()
        to, seen = goes.copy(), seen[which]
        rows = phase == GO
        to[rows] = self._over_log(seen[rows], goes[rows])
        rows = (phase == SLEW) | (phase == LOWER)
        to[rows] = self._over_goal(seen[rows], goes[rows])
        for chosen, column, value in (
            (DOWN, _Z, TAKE), (CLOSE, _JAW, SHUT), (UP, _Z, CARRY), (LOWER, _Z, LAY),
            (RELEASE, _JAW, OPEN), (LEAVE, _Z, ABOVE),
        ):  # fmt: skip
            to[phase == chosen, column] = value
        length = np.maximum(np.abs((to - goes) / self._speeds).max(axis=1), self._dt)
        swings = np.isin(phase, (GO, SLEW, LOWER))
        self._from[which], self._to[which], self._length[which] = goes, to, length
        self._ramp[which] = np.where(swings, PERIOD, 0.5)
        self._time[which] = 0.0

    def _swing(self, r: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the swing angle for a pin at r, theta; the arm has a lateral offset."""
        return theta - np.arcsin(self._aside / r)

    def _over_log(self, seen: np.ndarray, goes: np.ndarray) -> np.ndarray:
        """Return the target of the open grapple above the log, aligned with it."""
        r, theta, sine, cosine = seen[:, self._log].T
        to = goes.copy()
        swing = self._swing(r, theta)
        # the axis of the pocket is across the arm; it rotates with the house, against its motor
        turn = swing + 0.5 * math.pi - 0.5 * np.arctan2(sine, cosine)
        to[:, _TURN] = goes[:, _TURN] + _nearest(turn - goes[:, _TURN], math.pi)
        side = swing - to[:, _TURN]
        x = r * np.cos(theta) - SWAY * np.cos(side)
        y = r * np.sin(theta) - SWAY * np.sin(side)
        to[:, _R], to[:, _THETA] = np.hypot(x, y), np.arctan2(y, x)
        to[:, _Z], to[:, _JAW] = ABOVE, OPEN
        return to

    def _over_goal(self, seen: np.ndarray, goes: np.ndarray) -> np.ndarray:
        """Return the target that brings the held log over its goal with the goal yaw."""
        r, theta, sine, cosine = seen[:, self._log].T
        goal_r, goal_theta, goal_sine, goal_cosine = seen[:, self._goal].T
        now, to = seen[:, self._tip], goes.copy()
        slewed = self._swing(goal_r, goal_theta) - self._swing(now[:, _R], now[:, _THETA])
        yaw = 0.5 * (np.arctan2(goal_sine, goal_cosine) - np.arctan2(sine, cosine))
        turn = _nearest(slewed - yaw, math.pi)
        to[:, _TURN] = now[:, _TURN] + turn
        x = r * np.cos(theta) - now[:, _R] * np.cos(now[:, _THETA])
        y = r * np.sin(theta) - now[:, _R] * np.sin(now[:, _THETA])
        c, s = np.cos(slewed - turn), np.sin(slewed - turn)
        to_x = goal_r * np.cos(goal_theta) - (c * x - s * y)
        to_y = goal_r * np.sin(goal_theta) - (s * x + c * y)
        to[:, _R], to[:, _THETA] = np.hypot(to_x, to_y), np.arctan2(to_y, to_x)
        return to


class PlaceByTip:
    """Track the planned moves by rates of the pin (`resolved_motion`)."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the nominal machine."""
        self.moves, self._tip, self._dt = Moves(setup), pin_columns(setup), step_time(setup)
        rates = [full_rate(setup.machine, name) for name in setup.axes[3:]]
        change = np.array([*POSE_ACCELERATIONS[:3], ACCELERATION, ACCELERATION])
        fastest = np.array([*setup.task.pose_rates[:3], *rates])
        self._asked = RateFeedback(setup, fastest, change, _GAINS)

    def begin(self, count: int) -> None:
        """Allocate the state of `count` episodes."""
        self.moves.begin(count)
        self._asked.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the state of the episodes selected by the mask (n,)."""
        self.moves.reset(mask)
        self._asked.reset(mask)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (n, 5) for observations (n, o)."""
        seen = observation.astype(float)
        self.moves.update(seen)
        now = self.moves.at(0.0)
        rate = (now - self.moves.at(-self._dt)) / self._dt
        return self._asked.rates(seen[:, self._tip], now, rate)


class PlaceByAxes:
    """Track the planned moves by axis rates (`joint_rate`) or valve commands (`valve`)."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the nominal machine."""
        self.moves, self._joint = Moves(setup), position_columns(setup)
        (self._arm, _, self._ranges), self._dt = arm_facts(setup.machine), step_time(setup)
        fastest = np.array([full_rate(setup.machine, axis) for axis in setup.axes])
        by_valves = setup.options.action == "valve"
        self._valves = ValveLaw(setup, setup.task.servo) if by_valves else None
        self._asked = RateFeedback(setup, fastest, np.full(len(fastest), ACCELERATION), _GAINS)

    def begin(self, count: int) -> None:
        """Allocate the state of `count` episodes."""
        for part in (self.moves, self._asked, self._valves):
            if part:
                part.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the state of the episodes selected by the mask (n,)."""
        for part in (self.moves, self._asked, self._valves):
            if part:
                part.reset(mask)

    def _axes_at(self, ahead: float, joint: np.ndarray) -> np.ndarray:
        """Return the axis references (n, 5) `ahead` [s] from now; `joint` (n, 5) is measured."""
        places, q = self.moves.at(ahead), joint[:, :3].copy()
        pose = np.zeros((len(places), ARM))
        pose[:, :3] = places[:, :3]
        inverse_joints(self._arm, self._ranges, pose, q)
        return np.hstack([q, places[:, 3:]])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (n, 5) for observations (n, o)."""
        seen = observation.astype(float)
        self.moves.update(seen)
        joint = seen[:, self._joint]
        now = self._axes_at(0.0, joint)
        if self._valves:
            later = self._axes_at(_LEAD + self._dt, joint)
            rate = (later - self._axes_at(_LEAD, joint)) / self._dt
            return self._valves(observation, now, rate)
        rate = (now - self._axes_at(-self._dt, joint)) / self._dt
        return self._asked.rates(joint, now, rate)


def place_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `PlaceLog` for the chosen kind of actions."""
    return (PlaceByTip if setup.options.action == "resolved_motion" else PlaceByAxes)(setup)

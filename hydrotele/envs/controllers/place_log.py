"""Reference controller of the task `PlaceLog`: a sequence of moves without residual swing.

Every move has a trapezoidal speed profile. If a move swings the grapple, its ramps last one period
of the grapple's pendulum motion, so the grapple does not swing after it. If the log is lost, the
sequence starts again.
"""

import math

import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveServo,
    compute_joint_angles,
    environment_step_time,
    find_observation_columns,
    find_position_columns,
)
from hydrotele.envs.controllers.rate_feedback import RateFeedback
from hydrotele.envs.episode import MAX_ARM_AXES
from hydrotele.envs.task_setup import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, TaskSetup, full_action_rate

CLEARANCE_HEIGHT, GRIP_HEIGHT, CARRY_HEIGHT, LAY_DOWN_HEIGHT = (
    2.5,
    1.34,
    2.6,
    1.36,
)  # m, heights of the pin at the stick's tip
JAW_OFFSET = 0.03  # m by which the closing jaw pushes the grapple aside
SWING_PERIOD = 2.0  # s, period of the pendulum motion
CLOSED_JAW_ANGLE, OPEN_JAW_ANGLE = 1.3, 0.0  # rad, jaw angles
_MAX_RATES = np.array([0.35, 0.2, 0.35, 0.5, 0.8])  # m/s, rad/s, m/s, rad/s, rad/s, maximum rates
_FEEDBACK_GAINS = (3.0, 0.3)  # 1/s, gains of `RateFeedback`
_PHASE_LEAD = 0.06  # s, phase lead of valve actions: the spool lag and half a step
_R, _THETA, _Z, _ROTATION, _JAW = range(5)
APPROACH, DESCEND, CLOSE, LIFT, SLEW, LOWER, RELEASE, LEAVE = range(8)
_PAUSES = np.array([1.0, 0.3, 0.5, 0.5, 1.0, 0.3, 0.3, 1.0])  # s after every phase


def trapezoidal_move_fraction(time: np.ndarray, length: np.ndarray, ramp: np.ndarray) -> np.ndarray:
    """Return the completed fraction of a move with trapezoidal speed.

    Args:
        time: (n,) time since the start of the move [s].
        length: (n,) duration of the move at full speed without ramps [s].
        ramp: (n,) duration of the first and of the last ramp [s]; the move takes `length + ramp`.

    Returns:
        (n,) from 0 to 1. The ramps do not excite a vibration of period `ramp`, because the spectrum of the
        speed is zero at the frequency 1 / `ramp`.
    """

    def travelled_distance(t):
        part = np.clip(t / length, 0.0, 1.0)
        return 0.5 * length * part**2 + np.maximum(0.0, t - length)

    return (travelled_distance(time) - travelled_distance(time - ramp)) / ramp


def _wrap_angle(angle: np.ndarray, period: float) -> np.ndarray:
    """Return the angle modulo `period`, from -period/2 to period/2."""
    return angle - period * np.round(angle / period)


def find_pin_and_grapple_columns(setup: TaskSetup) -> np.ndarray:
    """Return the observation columns (5,) of the pin at the stick's tip (r, theta, z), grapple rotation and jaw."""
    return np.concatenate(
        [find_observation_columns(setup, "tip", ("r", "theta", "z")), find_position_columns(setup)[3:]]
    )


class MovePlanner:
    """Planner of the motion of the pin at the stick's tip, of the grapple rotation and of the jaw.

    Every episode passes through the phases APPROACH to LEAVE, with one move and one pause per
    phase.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Read rate limits and geometry from `setup.machine`, and find the observation columns that are used."""
        self._lateral_offset = float(arm_specification(setup.machine)[0][2])
        self._tip = find_pin_and_grapple_columns(setup)
        self._log = find_observation_columns(setup, "log", ("r", "theta", "sin_2_yaw", "cos_2_yaw"))
        self._goal = find_observation_columns(setup, "goal", ("r", "theta", "sin_2_yaw", "cos_2_yaw"))
        self._held = find_observation_columns(setup, "held", [""])[0]
        rates = [full_action_rate(setup.machine, name) for name in setup.axes[3:]]
        self._speeds = np.minimum(_MAX_RATES, 0.8 * np.array([*setup.task.pose_rates[:3], *rates]))
        self._dt = environment_step_time(setup)

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        self._phase = np.full(count, APPROACH)
        self._time, self._length, self._ramp = (np.zeros(count) for _ in range(3))
        self._move_start, self._move_end = np.zeros((count, 5)), np.zeros((count, 5))
        self._is_new = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next update plans their first move."""
        self._is_new |= mask

    def update(self, seen: np.ndarray) -> None:
        """Advance the plan by one step; after a move and its pause, plan the move of the next phase.

        `seen` (n, o) are the observations.
        """
        fresh = self._is_new.copy()
        self._move_end[fresh], self._phase[fresh], self._is_new[:] = (
            seen[fresh][:, self._tip],
            APPROACH,
            False,
        )
        self._plan_moves(seen, fresh)
        self._time[~fresh] += self._dt
        over = self._time > self._length + self._ramp + _PAUSES[self._phase]
        self._phase[over] = self._next_phases(seen)[over]
        self._plan_moves(seen, over)

    def reference_ahead(self, ahead: float) -> np.ndarray:
        """Return the reference (n, 5) of the current moves at a time `ahead` [s] after now.

        The columns are r [m], theta [rad], z [m] of the pin, grapple rotation [rad] and jaw angle
        [rad].
        """
        share = trapezoidal_move_fraction(self._time + ahead, self._length, self._ramp)[:, None]
        return self._move_start + share * (self._move_end - self._move_start)

    def _next_phases(self, seen: np.ndarray) -> np.ndarray:
        """Return the phases (n,) that follow the current ones, from observations `seen` (n, o).

        The next phase in order follows, and APPROACH follows the last. RELEASE follows if the log
        is not held after CLOSE, LIFT or SLEW.
        """
        following = (self._phase + 1) % (LEAVE + 1)
        lost = (seen[:, self._held] < 0.5) & np.isin(self._phase, (CLOSE, LIFT, SLEW))
        return np.where(lost, RELEASE, following)

    def _plan_moves(self, seen: np.ndarray, which: np.ndarray) -> None:
        """Plan the move of the present phase for the episodes of the boolean mask `which` (n,).

        The move starts at the target of the last move. `seen` (n, o) are the observations.
        """
        if not which.any():
            return
        phase, goes = self._phase[which], self._move_end[which].copy()
        to, seen = goes.copy(), seen[which]
        rows = phase == APPROACH
        to[rows] = self._plan_grip_target(seen[rows], goes[rows])
        rows = (phase == SLEW) | (phase == LOWER)
        to[rows] = self._plan_lay_down_target(seen[rows], goes[rows])
        for chosen, column, value in (
            (DESCEND, _Z, GRIP_HEIGHT), (CLOSE, _JAW, CLOSED_JAW_ANGLE), (LIFT, _Z, CARRY_HEIGHT), (LOWER, _Z,
            LAY_DOWN_HEIGHT),
            (RELEASE, _JAW, OPEN_JAW_ANGLE), (LEAVE, _Z, CLEARANCE_HEIGHT),
        ):  # fmt: skip
            to[phase == chosen, column] = value
        length = np.maximum(np.abs((to - goes) / self._speeds).max(axis=1), self._dt)
        swings = np.isin(phase, (APPROACH, SLEW, LOWER))
        self._move_start[which], self._move_end[which], self._length[which] = goes, to, length
        self._ramp[which] = np.where(swings, SWING_PERIOD, 0.5)
        self._time[which] = 0.0

    def _swing_angle_of_pin(self, r: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the swing axis angle [rad] for a pin at r [m], theta [rad]; the arm has a lateral offset."""
        return theta - np.arcsin(self._lateral_offset / r)

    def _plan_grip_target(self, seen: np.ndarray, goes: np.ndarray) -> np.ndarray:
        """Return the target (m, 5) of the open grapple above the log, aligned with it.

        `seen` (m, o) are observations and `goes` (m, 5) the last targets. The columns are those of
        `reference_ahead`.
        """
        r, theta, sine, cosine = seen[:, self._log].T
        to = goes.copy()
        swing = self._swing_angle_of_pin(r, theta)
        # the axis of the pocket is across the arm; it rotates with the house, against its motor
        turn = swing + 0.5 * math.pi - 0.5 * np.arctan2(sine, cosine)
        to[:, _ROTATION] = goes[:, _ROTATION] + _wrap_angle(turn - goes[:, _ROTATION], math.pi)
        side = swing - to[:, _ROTATION]
        x = r * np.cos(theta) - JAW_OFFSET * np.cos(side)
        y = r * np.sin(theta) - JAW_OFFSET * np.sin(side)
        to[:, _R], to[:, _THETA] = np.hypot(x, y), np.arctan2(y, x)
        to[:, _Z], to[:, _JAW] = CLEARANCE_HEIGHT, OPEN_JAW_ANGLE
        return to

    def _plan_lay_down_target(self, seen: np.ndarray, goes: np.ndarray) -> np.ndarray:
        """Return the target (m, 5) that brings the held log over its goal position with the goal yaw.

        `seen` (m, o) are observations and `goes` (m, 5) the last targets, whose height and jaw
        angle are kept. The columns are those of `reference_ahead`.
        """
        r, theta, sine, cosine = seen[:, self._log].T
        goal_r, goal_theta, goal_sine, goal_cosine = seen[:, self._goal].T
        now, to = seen[:, self._tip], goes.copy()
        slewed = self._swing_angle_of_pin(goal_r, goal_theta) - self._swing_angle_of_pin(now[:, _R], now[:, _THETA])
        yaw = 0.5 * (np.arctan2(goal_sine, goal_cosine) - np.arctan2(sine, cosine))
        turn = _wrap_angle(slewed - yaw, math.pi)
        to[:, _ROTATION] = now[:, _ROTATION] + turn
        x = r * np.cos(theta) - now[:, _R] * np.cos(now[:, _THETA])
        y = r * np.sin(theta) - now[:, _R] * np.sin(now[:, _THETA])
        c, s = np.cos(slewed - turn), np.sin(slewed - turn)
        to_x = goal_r * np.cos(goal_theta) - (c * x - s * y)
        to_y = goal_r * np.sin(goal_theta) - (s * x + c * y)
        to[:, _R], to[:, _THETA] = np.hypot(to_x, to_y), np.arctan2(to_y, to_x)
        return to


class PlaceByTip:
    """Controller that tracks the moves of a `MovePlanner` by rates of the pin (actions `resolved_motion`)."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects."""
        self.planner, self._tip, self._dt = (
            MovePlanner(setup),
            find_pin_and_grapple_columns(setup),
            environment_step_time(setup),
        )
        rates = [full_action_rate(setup.machine, name) for name in setup.axes[3:]]
        change = np.array([*MAX_POSE_ACCELERATIONS[:3], MAX_ACCELERATION, MAX_ACCELERATION])
        fastest = np.array([*setup.task.pose_rates[:3], *rates])
        self._rate_feedback = RateFeedback(setup, fastest, change, _FEEDBACK_GAINS)

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        self.planner.begin(count)
        self._rate_feedback.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new in the planner and in the feedback loops."""
        self.planner.reset(mask)
        self._rate_feedback.reset(mask)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, 5) of the next step from the observations (n, o) of n parallel episodes."""
        seen = observation.astype(float)
        self.planner.update(seen)
        now = self.planner.reference_ahead(0.0)
        rate = (now - self.planner.reference_ahead(-self._dt)) / self._dt
        return self._rate_feedback.compute_rate_commands(seen[:, self._tip], now, rate)


class PlaceByAxes:
    """Controller that tracks the moves of a `MovePlanner` by axis rates (`joint_rate`) or valve commands (`valve`)."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects."""
        self.planner, self._joint = MovePlanner(setup), find_position_columns(setup)
        (self._arm, _, self._ranges), self._dt = arm_specification(setup.machine), environment_step_time(setup)
        fastest = np.array([full_action_rate(setup.machine, axis) for axis in setup.axes])
        by_valves = setup.options.action == "valve"
        self._valve_servo = ValveServo(setup, setup.task.servo) if by_valves else None
        self._rate_feedback = RateFeedback(setup, fastest, np.full(len(fastest), MAX_ACCELERATION), _FEEDBACK_GAINS)

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        for part in (self.planner, self._rate_feedback, self._valve_servo):
            if part:
                part.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new in the planner and in the feedback loops."""
        for part in (self.planner, self._rate_feedback, self._valve_servo):
            if part:
                part.reset(mask)

    def _axis_references_ahead(self, ahead: float, joint: np.ndarray) -> np.ndarray:
        """Return the axis references (n, 5) at a time `ahead` [s] after now.

        `joint` (n, 5) are the measured positions, which replace the arm references if the pose is
        unreachable.
        """
        places, q = self.planner.reference_ahead(ahead), joint[:, :3].copy()
        pose = np.zeros((len(places), MAX_ARM_AXES))
        pose[:, :3] = places[:, :3]
        compute_joint_angles(self._arm, self._ranges, pose, q)
        return np.hstack([q, places[:, 3:]])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, 5) of the next step from the observations (n, o) of n parallel episodes."""
        seen = observation.astype(float)
        self.planner.update(seen)
        joint = seen[:, self._joint]
        now = self._axis_references_ahead(0.0, joint)
        if self._valve_servo:
            later = self._axis_references_ahead(_PHASE_LEAD + self._dt, joint)
            rate = (later - self._axis_references_ahead(_PHASE_LEAD, joint)) / self._dt
            return self._valve_servo(observation, now, rate)
        rate = (now - self._axis_references_ahead(-self._dt, joint)) / self._dt
        return self._rate_feedback.compute_rate_commands(joint, now, rate)


def make_place_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `PlaceLog` for the chosen kind of actions."""
    return (PlaceByTip if setup.options.action == "resolved_motion" else PlaceByAxes)(setup)

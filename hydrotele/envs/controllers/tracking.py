"""Reference controllers that track references by valve commands, joint rates or tip rates.

The module holds the controllers of `TrackTrajectory`, `StraightLine`, `ReachFeller` and
`HoldForce`. They combine feedforward and feedback. Feedback gains of the tip are low, since the
hydraulics and the servo are slow, and slewing on compressible oil is slower still. The force
controller approaches the plate slowly and then sets the speed from the force error.
"""

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveServo,
    compute_joint_angles,
    compute_tip_poses,
    find_observation_columns,
    find_position_columns,
)
from hydrotele.envs.controllers.rate_feedback import RateFeedback
from hydrotele.envs.episode import MAX_ARM_AXES
from hydrotele.envs.straight_line import PREVIEW_TIMES as LINE_PREVIEWS
from hydrotele.envs.task_setup import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, TaskSetup, full_action_rate
from hydrotele.envs.track_trajectory import PREVIEW_TIMES
from hydrotele.scenario.scenario import Servo

DEFAULT_SERVO = Servo()
_INTEGRAL_GAIN = 2.0  # 1/s^2, integral gain of valve actions
_PHASE_LEAD = 0.06  # s, phase lead of valve actions: the spool lag and half a step
_JOINT_RATE_GAINS = (
    8.0,
    1.0,
)  # 1/s, gains of `RateFeedback` for joints: tracking, model correction
_POSE_RATE_GAINS = (3.0, 3.0)  # 1/s, the same for a tip whose rates often saturate
_DIFFERENCE_STEP = 0.02  # s, half width of the central difference quotient


class ReferencePreview:
    """Interpolate the observed references in time by a polynomial.

    The observation holds the references now and at some times ahead (`PREVIEW_TIMES`), and the rate now. The
    polynomial passes through all of them.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns of the references and invert the interpolation matrix."""
        ahead = [f"reference_in_{time * 1000:.0f}_ms" for time in PREVIEW_TIMES]
        self._columns = [
            find_observation_columns(setup, what, setup.axes) for what in ("reference", "reference_rate", *ahead)
        ]
        powers = np.arange(len(self._columns))
        rows = [[float(p == 0) for p in powers], [float(p == 1) for p in powers]]
        self._inverse = np.linalg.inv(np.array(rows + [[t**p for p in powers] for t in PREVIEW_TIMES]))

    def interpolate(self, observation: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the interpolated axis references and their rates, (n, k) each, `time` [s] from now."""
        powers = np.arange(len(self._columns))
        place = time**powers @ self._inverse
        rate = (powers[1:] * time ** (powers[1:] - 1)) @ self._inverse[1:]
        shown = np.stack([observation[:, c] for c in self._columns]).astype(float)
        return np.tensordot(place, shown, 1), np.tensordot(rate, shown, 1)


class TrackByValves:
    """Controller that tracks the axis references by valve commands of the joint servo, with an integral term.

    The reference rates are taken from a time slightly ahead, which compensates the lag of the valves.
    """

    def __init__(
        self,
        setup: TaskSetup,
        servo: Servo = DEFAULT_SERVO,
        integral: float = _INTEGRAL_GAIN,
        lead: float = _PHASE_LEAD,
    ) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects.

        Args:
            setup: the task with its options.
            servo: gains of the joint servo.
            integral: gain of the integral term [1/s^2].
            lead: time ahead from which the reference rates are taken [s].
        """
        self._valve_servo, self._preview = (
            ValveServo(setup, servo, integral),
            ReferencePreview(setup),
        )
        self._lead = lead
        self.begin, self.reset = self._valve_servo.begin, self._valve_servo.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        now, _ = self._preview.interpolate(observation, 0.0)
        _, rate = self._preview.interpolate(observation, self._lead)
        return self._valve_servo(observation, now, rate)


class TrackByJointRates:
    """Controller that tracks the axis references by joint rates (`joint_rate`), with `RateFeedback`."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects."""
        self._preview, self._joint = ReferencePreview(setup), find_position_columns(setup)
        fastest = np.array([full_action_rate(setup.machine, axis) for axis in setup.axes])
        self._rate_feedback = RateFeedback(setup, fastest, np.full(len(fastest), MAX_ACCELERATION), _JOINT_RATE_GAINS)
        self.begin, self.reset = self._rate_feedback.begin, self._rate_feedback.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        measured = observation[:, self._joint].astype(float)
        return self._rate_feedback.compute_rate_commands(measured, *self._preview.interpolate(observation, 0.0))


class TrackByResolvedMotion:
    """Controller that tracks, by tip rates, the tip pose that corresponds to the joint references."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects.

        Raises:
            InputError: the task drives axes that do not belong to the arm.
        """
        k = setup.arm_axes
        if k < len(setup.axes):
            raise InputError(f"task {setup.task.name}", "drives axes that are not part of the arm")
        self._preview, self._arm = ReferencePreview(setup), arm_specification(setup.machine)[0]
        self._tip = find_observation_columns(setup, "tip", COORDINATES[:k])
        fastest = np.array(setup.task.pose_rates[:k])
        self._rate_feedback = RateFeedback(setup, fastest, np.array(MAX_POSE_ACCELERATIONS[:k]), _POSE_RATE_GAINS)
        self.begin, self.reset = self._rate_feedback.begin, self._rate_feedback.reset

    def _reference_tip_pose(self, observation: np.ndarray, time: float) -> np.ndarray:
        """Return the tip pose (n, k) that the joint references have `time` [s] from now."""
        q = self._preview.interpolate(observation, time)[0]
        pose = np.zeros((len(q), MAX_ARM_AXES))
        compute_tip_poses(self._arm, np.ascontiguousarray(q), pose)
        return pose[:, : q.shape[1]]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        after = self._reference_tip_pose(observation, _DIFFERENCE_STEP)
        before = self._reference_tip_pose(observation, -_DIFFERENCE_STEP)
        measured = observation[:, self._tip].astype(float)
        rate = (after - before) / (2.0 * _DIFFERENCE_STEP)
        return self._rate_feedback.compute_rate_commands(measured, self._reference_tip_pose(observation, 0.0), rate)


def make_track_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `TrackTrajectory` for the chosen kind of actions."""
    kinds = {"valve": TrackByValves, "joint_rate": TrackByJointRates}
    return kinds.get(setup.options.action or "", TrackByResolvedMotion)(setup)


_LINE_GAIN = 0.5  # 1/s, position gain on a line
_REACH_GAINS = (1.0, 0.45, 1.0, 1.0, 1.0)  # 1/s, gains of r, theta, z, attitude, head
_JOINT_GAINS = (0.45, 1.0, 1.0, 1.0, 1.0)  # 1/s, gains of the joints, from swing outwards
_TIP_INTEGRAL = 1.2  # 1/s^2, integral gain to hold a pose against leakage and dead bands
_REACH_RATE_FRACTION = 0.6  # maximum joint rate of a reach, as a fraction of the full rate


class TipController:
    """Base class of the controllers that track a tip pose with any kind of actions."""

    def __init__(self, setup: TaskSetup, integral: float = 0.0) -> None:
        """Read the parameters of the controller from `setup.machine`, the machine without added effects.

        Args:
            setup: the task with its options.
            integral: integral gain of valve actions [1/s^2].
        """
        k = self._k = setup.arm_axes
        self._kind = setup.options.action
        self._arm, _, self._ranges = arm_specification(setup.machine)
        self._joint = find_position_columns(setup)[:k]
        self._tip = find_observation_columns(setup, "tip", COORDINATES[:k])
        self._fastest = np.array([full_action_rate(setup.machine, axis) for axis in setup.axes[:k]])
        self._fastest_pose = np.array(setup.task.pose_rates[:k])
        self._valves = ValveServo(setup, setup.task.servo, integral) if self._kind == "valve" else None

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        if self._valves:
            self._valves.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the controller state of the episodes selected by the boolean mask (n,)."""
        if self._valves:
            self._valves.reset(mask)

    def solve_joint_angles(self, observation: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the joint angles (n, k) for tip poses (n, k).

        For poses that are unreachable, they are the measured angles in the observations (n, o).
        """
        found = np.ascontiguousarray(observation[:, self._joint], float)
        whole = np.zeros((len(pose), MAX_ARM_AXES))
        whole[:, : self._k] = pose
        compute_joint_angles(self._arm, self._ranges, whole, found)
        return found


class LineController(TipController):
    """Controller of a tip that follows the observed reference pose of a line.

    It commands the rate of the reference a short time ahead plus feedback of the tracking error.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns that the controller uses."""
        super().__init__(setup)
        self._reference_columns = find_observation_columns(setup, "reference", COORDINATES[: self._k])
        self._preview_columns = [
            find_observation_columns(setup, f"reference_in_{time * 1000:.0f}_ms", COORDINATES[:3])
            for time in LINE_PREVIEWS[:2]
        ]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        seen = observation.astype(float)
        wanted = seen[:, self._reference_columns]
        later = [np.concatenate([seen[:, c], wanted[:, 3:]], axis=1) for c in self._preview_columns]
        if self._kind == "resolved_motion":
            rate = (later[1] - later[0]) / (LINE_PREVIEWS[1] - LINE_PREVIEWS[0])
            off = wanted - seen[:, self._tip]
            return (rate + _LINE_GAIN * off) / self._fastest_pose
        now, soon = self.solve_joint_angles(observation, wanted), self.solve_joint_angles(observation, later[0])
        rate = (soon - now) / LINE_PREVIEWS[0]
        if self._valves:
            return self._valves(observation, now, rate)
        return (rate + _LINE_GAIN * (now - seen[:, self._joint])) / self._fastest


class ReachController(TipController):
    """Controller that moves the tip to the goal pose at rates proportional to the remaining error."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns that the controller uses."""
        super().__init__(setup, _TIP_INTEGRAL)
        self._reference_columns = find_observation_columns(setup, "reference", COORDINATES[: self._k])
        servo = setup.task.servo
        gains = [servo.axis_gains.get(axis, servo.position_gain) for axis in setup.axes[: self._k]]
        self._position_gains = np.array(gains)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        seen = observation.astype(float)
        wanted = seen[:, self._reference_columns]
        if self._kind == "resolved_motion":
            off = wanted - seen[:, self._tip]
            return np.array(_REACH_GAINS) * off / self._fastest_pose
        joint = seen[:, self._joint]
        most = _REACH_RATE_FRACTION * self._fastest
        rate = np.array(_JOINT_GAINS) * (self.solve_joint_angles(observation, wanted) - joint)
        rate = np.clip(rate, -most, most)
        if self._valves:
            return self._valves(observation, joint + rate / self._position_gains, np.zeros_like(rate))
        return rate / self._fastest


def make_line_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `StraightLine` for the chosen kind of actions."""
    return LineController(setup)


def make_reach_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `ReachFeller` for the chosen kind of actions."""
    return ReachController(setup)


_CONTACT_FORCE = 1.5e3  # N, measured force that counts as contact, above the error of the load cell
_APPROACH_SPEED, _MAX_PRESS_SPEED = (
    0.08,
    0.10,
)  # m/s, speed without contact, maximum speed with contact
_FORCE_GAIN = 2.0e-6  # m/s per N: a loop gain of 2 /s on 1e6 N/m


class PressController:
    """Controller that presses on the plate, with actions `resolved_motion`.

    Without contact it lowers the tip at constant speed. In contact, its vertical speed is
    proportional to the force error.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns that the controller uses.

        Raises:
            InputError: the actions are not tip rates.
        """
        if setup.options.action != "resolved_motion":
            raise InputError(f"action {setup.options.action!r}", "must be resolved_motion")
        self._force_column = find_observation_columns(setup, "force", [""])[0]
        self._reference_column = find_observation_columns(setup, "reference_force", [""])[0]
        self._fastest, self._actions = setup.task.pose_rates[2], len(setup.axes)

    def begin(self, count: int) -> None:
        """Do nothing: the controller has no state."""

    def reset(self, mask: np.ndarray) -> None:
        """Do nothing: the controller has no state."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, k) of the next step from the observations (n, o) of n parallel episodes."""
        force, wanted = observation[:, self._force_column], observation[:, self._reference_column]
        speed = np.clip(_FORCE_GAIN * (force - wanted), -_MAX_PRESS_SPEED, _MAX_PRESS_SPEED)
        actions = np.zeros((len(observation), self._actions))
        actions[:, 2] = np.where(force < _CONTACT_FORCE, -_APPROACH_SPEED, speed) / self._fastest
        return actions


def make_press_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `HoldForce`; its actions must be `resolved_motion`."""
    return PressController(setup)

"""Reference controller of the task `Grade`: repeated passes that cut, curl, carry and dump.

`GradeController` plans the tip pose with a state machine. `PoseFollower` converts the reference pose and its
rate to actions of the chosen kind.
"""

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
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
from hydrotele.envs.grade import MAX_RADIUS, MEAN_RADIUS, MIN_RADIUS, SECTION_COUNT, profile_section_radii
from hydrotele.envs.task_setup import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, TaskSetup, full_action_rate

_INTEGRAL_GAIN = 2.0  # 1/s^2, integral gain of valve actions
_JOINT_GAINS = (6.0, 1.0)  # 1/s, gains of `RateFeedback` for joints: tracking, model correction
_POSE_GAINS = (4.0, 1.0)  # 1/s, the same for the tip pose


class PoseFollower:
    """Controller that makes the tip track a moving reference pose, with any kind of actions.

    All driven axes must belong to the arm.
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Create the controller for the kind of actions of the setup.

        It is a `ValveServo` for valve actions, otherwise a `RateFeedback` for joint rates or tip
        rates. Its parameters are those of `setup.machine`, the machine without added effects.
        """
        k = setup.arm_axes
        self._arm, _, self._ranges = arm_specification(setup.machine)
        self._dt, self._k = environment_step_time(setup), k
        self._tip, self._joint = (
            find_observation_columns(setup, "tip", COORDINATES[:k]),
            find_position_columns(setup),
        )
        self._valve_servo = self._rate_feedback = None
        if setup.options.action == "valve":
            self._valve_servo = ValveServo(setup, setup.task.servo, _INTEGRAL_GAIN)
        elif setup.options.action == "joint_rate":
            fastest = np.array([full_action_rate(setup.machine, axis) for axis in setup.axes])
            self._rate_feedback = RateFeedback(setup, fastest, np.full(k, MAX_ACCELERATION), _JOINT_GAINS)
        else:
            accelerations = np.array(MAX_POSE_ACCELERATIONS[:k])
            self._rate_feedback = RateFeedback(setup, np.array(setup.task.pose_rates[:k]), accelerations, _POSE_GAINS)
        self._uses_pose_rates = setup.options.action == "resolved_motion"

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        (self._valve_servo or self._rate_feedback).begin(count)  # pyright: ignore - one of them is there
        self._q, self._is_new = np.zeros((count, self._k)), np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next call initialises their controller state."""
        (self._valve_servo or self._rate_feedback).reset(mask)  # pyright: ignore - one of them is there
        self._is_new |= mask

    def __call__(self, observation: np.ndarray, pose: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the actions of this step.

        Args:
            observation: (n, o).
            pose: (n, k) reference pose of the tip: r [m], theta [rad], z [m], attitude [rad].
            rate: (n, k) rate of the reference pose [m/s], [rad/s]. Only tip-rate actions use it;
                the others use the difference between the joint references of this step and the
                last.

        Returns:
            (n, k) actions.
        """
        if self._uses_pose_rates:
            assert self._rate_feedback
            return self._rate_feedback.compute_rate_commands(observation[:, self._tip].astype(float), pose, rate)
        measured = observation[:, self._joint].astype(float)
        self._q[self._is_new], self._is_new[:] = measured[self._is_new], False
        before, full = self._q.copy(), np.zeros((len(pose), MAX_ARM_AXES))
        full[:, : self._k] = pose
        compute_joint_angles(self._arm, self._ranges, full, self._q)
        speed = (self._q - before) / self._dt
        if self._valve_servo:
            return self._valve_servo(observation, self._q, speed)
        assert self._rate_feedback
        return self._rate_feedback.compute_rate_commands(measured, self._q, speed)


APPROACH, LOWER, DRAW, CURL, CARRY, DUMP = range(6)
R, Z, ATTITUDE = range(3)
_DEGREE = np.pi / 180.0
_MAX_CUT_DEPTH = 0.15  # m, maximum depth of one cut
_MIN_SECTION_ERROR = 0.03  # m, minimum section error that starts a pass
_FLAT_ERROR = 0.027  # m, RMS error below which the controller waits
_PASS_LEAD, _PASS_TRAIL = (
    0.20,
    0.10,
)  # m by which a pass starts before and stops behind the uneven part
_FULL_MASS = 800.0  # kg, mass carried that ends a cut
_APPROACH_HEIGHT, _CARRY_HEIGHT = 0.5, 1.0  # m above the plane: edge before a pass, carried load
_CUT_ATTITUDES = (
    (MIN_RADIUS, MAX_RADIUS + _PASS_LEAD),
    (-121.0 * _DEGREE, -106.0 * _DEGREE),
)  # radius -> attitude of a cut
_CARRY_ATTITUDE, _DUMP_ATTITUDE = (
    -165.0 * _DEGREE,
    -85.0 * _DEGREE,
)  # attitudes of a carrying and an empty bucket
_MAX_RATES = np.array([0.45, 0.35, 0.45])  # m/s, m/s, rad/s, maximum rates of r, z, attitude
_MAX_CURL_RATES = np.array([0.45, 0.25, 0.30])  # the same while curling, where boom and stick also move
_DRAW_SPEED, _LOWER_SPEED, _SINK_SPEED = (
    0.30,
    0.20,
    0.15,
)  # m/s along the plane, in the air, into the soil
_CONTACT_HEIGHT = 0.03  # m, height of the edge above the ground at which a cut starts
_MAX_ACCELERATIONS = np.array([0.8, 0.8, 0.8])  # m/s^2, m/s^2, rad/s^2, maximum accelerations
_MAX_RISE_SPEED = 0.4  # m/s, maximum upward speed of the edge during a cut
_POSITION_GAIN = 2.0  # 1/s, position gain of the reference motion
_MAX_REFERENCE_LEAD = np.array([0.20, 0.08, 0.25])  # m, m, rad, maximum lead of the reference over the tip
_STALL_TIME = 2.0  # s, minimum time of a cut before it counts as stalled
_ATTITUDES = np.array([-180.0, -170.0, -140.0, -125.0, -115.0, -105.0, -90.0, -60.0]) * _DEGREE
_MAX_RADII = np.array([5.35, 5.55, 6.00, 6.30, 6.50, 6.75, 7.10, 7.75]) - 0.05  # m, at _ATTITUDES
_OPENING_LAG = 0.10  # m by which the opening of the bucket may lag behind the reach
_MIN_RADII = np.array([3.0, 3.0, 3.0, 3.45, 3.86, 4.30, 5.10, 6.70]) + 0.05  # m, at _ATTITUDES


class GradeController:
    """Controller that cuts the ground down to the target plane in passes of at most 0.15 m depth."""

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns that the controller uses, and create the follower of the reference pose."""
        self._tip = find_observation_columns(setup, "tip", COORDINATES[:4])
        self._errors = find_observation_columns(setup, "profile_error", [str(p) for p in range(SECTION_COUNT)])
        self._mass, self._edge, self._plane, self._slope = (
            find_observation_columns(setup, name, [""])[0]
            for name in ("carried_mass", "edge_height", "plane_height", "plane_slope")
        )
        self._follower, self._dt = PoseFollower(setup), environment_step_time(setup)
        self._radii = np.array(profile_section_radii())

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        self._follower.begin(count)
        self._phase, self._phase_time = np.zeros(count, int), np.zeros(count)
        self._reference, self._reference_rate = np.zeros((count, 3)), np.zeros((count, 3))
        self._pass_start, self._pass_end, self._theta = (np.zeros(count) for _ in range(3))
        self._is_new, self._goal = np.ones(count, bool), np.full((count, 3), np.inf)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next call initialises their controller state."""
        self._follower.reset(mask)
        self._is_new |= mask

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, 4) of the next step from the observations (n, o) of n parallel episodes.

        The phases and the reference pose of the tip advance by one step.
        """
        seen = observation.astype(float)
        tip, errors = seen[:, self._tip][:, [0, 2, 3]], seen[:, self._errors]
        fresh = self._is_new
        self._phase[fresh], self._phase_time[fresh] = APPROACH, 0.0
        self._reference[fresh], self._reference_rate[fresh] = tip[fresh], 0.0
        self._theta[fresh], self._is_new = seen[fresh, self._tip[1]], np.zeros(len(seen), bool)
        self._update_phases(tip, errors, seen[:, self._mass], seen[:, self._edge])
        goal, fast = self._compute_phase_targets(seen, errors)
        self._advance_reference(goal, fast, tip)
        pose = np.insert(self._reference, 1, self._theta, axis=1)
        return self._follower(seen, pose, np.insert(self._reference_rate, 1, 0.0, axis=1))

    def _update_phases(self, tip: np.ndarray, errors: np.ndarray, mass: np.ndarray, edge: np.ndarray):
        """Switch every episode whose phase is finished to its next phase, and choose the radii of the next cut.

        The phases are APPROACH, LOWER, DRAW (cut towards the machine), CURL, CARRY and DUMP. The
        radii are updated from the uneven sections of the profile until APPROACH ends.

        Args:
            tip: (n, 3) measured r [m], z [m] and attitude [rad] of the tip.
            errors: (n, SECTION_COUNT) heights of the profile sections above the target plane [m].
            mass: (n,) mass carried [kg].
            edge: (n,) height of the bucket's edge above the ground [m].
        """
        self._phase_time += self._dt
        phase, place = self._phase, self._reference
        waiting = np.sqrt(np.mean(errors**2, axis=1)) < _FLAT_ERROR
        uneven = errors > np.maximum(_MIN_SECTION_ERROR, 0.3 * errors.max(axis=1, keepdims=True) - 0.03)
        first = np.where(uneven.any(1), self._radii[SECTION_COUNT - 1 - uneven[:, ::-1].argmax(1)], MAX_RADIUS)
        last = np.where(uneven.any(1), self._radii[uneven.argmax(1)], MIN_RADIUS)
        near = np.abs(tip - self._goal)
        moved = self._phase_time > 0.5
        late = self._phase_time > 12.0
        stalled = (self._phase_time > _STALL_TIME) & (np.abs(tip - place)[:, R] > 0.9 * _MAX_REFERENCE_LEAD[R])
        done = (
            np.select(
                [phase == p for p in range(6)],
                [
                    (near[:, R] < 0.08) & (near[:, Z] < 0.1) & (near[:, ATTITUDE] < 0.1) & ~waiting,
                    (edge < _CONTACT_HEIGHT) | (near[:, Z] < 0.03) | (self._phase_time > 4.0),
                    (tip[:, R] < self._pass_end + 0.03) | (mass > _FULL_MASS) | stalled | late,
                    (tip[:, ATTITUDE] < _CARRY_ATTITUDE + 0.25) & (near[:, Z] < 0.2) | late,
                    (near[:, R] < 0.1) | late,
                    (tip[:, ATTITUDE] > _DUMP_ATTITUDE - 0.15) | late,
                ],
            ).astype(bool)
            & moved
        )
        passing = done & (phase == APPROACH)
        held = (phase == APPROACH) & ~passing  # the range is updated until the pass starts
        self._pass_start[held] = np.minimum(first[held] + _PASS_LEAD, MAX_RADIUS + _PASS_LEAD)
        self._pass_end[held] = np.maximum(last[held] - _PASS_TRAIL, MIN_RADIUS - _PASS_TRAIL)
        phase[done] = (phase[done] + 1) % 6
        self._phase_time[done] = 0.0

    def _compute_phase_targets(self, seen: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return targets of the tip (n, 3) in the current phases, and limits of its rates (n, 3).

        The columns are r [m], z [m] and attitude [rad]; the limits are per second. `seen` (n, o)
        are the observations and `errors` (n, SECTION_COUNT) the heights of the profile sections
        above the plane [m].
        """
        phase, place = self._phase, self._reference

        def plane(r: np.ndarray) -> np.ndarray:
            return seen[:, self._plane] + np.tan(seen[:, self._slope]) * (r - MEAN_RADIUS)

        rows = zip(place[:, R], errors, strict=True)
        over = np.array([np.interp(r, self._radii, e) for r, e in rows])
        cut = plane(place[:, R]) + np.maximum(over - _MAX_CUT_DEPTH, 0.0)
        blade = np.interp(place[:, R], *_CUT_ATTITUDES)
        start = np.interp(self._pass_start, *_CUT_ATTITUDES)
        high = plane(np.full(len(seen), MEAN_RADIUS)) + _CARRY_HEIGHT
        clear = plane(self._pass_start) + _APPROACH_HEIGHT
        here = place[:, R]
        # the bucket opens only as it extends, so that all soil falls beyond the graded ground
        opened = np.minimum(np.interp(here + _OPENING_LAG, _MAX_RADII, _ATTITUDES), _DUMP_ATTITUDE)
        goal = np.stack([
            np.choose(phase, [self._pass_start, self._pass_start, self._pass_end, np.minimum(here, 5.0),
                              np.full_like(here, 5.4), np.full_like(here, 7.0)]),
            np.choose(phase, [clear, cut, cut, high, high, high]),
            np.choose(phase, [start, blade, blade, *np.broadcast_to(_CARRY_ATTITUDE, (2, len(here))),
                              opened]),
        ], axis=1)  # fmt: skip
        fast = np.tile(_MAX_RATES, (len(here), 1))
        fast[phase == DRAW, R] = _DRAW_SPEED
        fast[phase == LOWER, Z] = _LOWER_SPEED
        fast[phase == DRAW, Z] = _SINK_SPEED
        fast[phase == CURL] = _MAX_CURL_RATES
        self._goal = goal
        return goal, fast

    def _advance_reference(self, goal: np.ndarray, fast: np.ndarray, tip: np.ndarray) -> None:
        """Move the reference pose of the tip towards `goal` by one step, with rates up to `fast`.

        Both are (n, 3), with columns r [m], z [m] and attitude [rad]. The reference stays within
        the reach of the arm and within a maximum distance from the measured `tip` (n, 3). The
        reference rates are updated, too.
        """
        wanted = np.clip(_POSITION_GAIN * (goal - self._reference), -fast, fast)
        drawn = (self._phase == DRAW) | (self._phase == LOWER)
        # during a cut, the height tracks the plane without lag
        wanted[drawn, Z] = np.clip(8.0 * (goal - self._reference)[drawn, Z], -fast[drawn, Z], _MAX_RISE_SPEED)
        change = _MAX_ACCELERATIONS * self._dt
        self._reference_rate += np.clip(wanted - self._reference_rate, -change, change)
        before = self._reference.copy()
        self._reference += self._dt * self._reference_rate
        np.clip(
            self._reference,
            tip - _MAX_REFERENCE_LEAD,
            tip + _MAX_REFERENCE_LEAD,
            out=self._reference,
        )
        farthest = np.interp(self._reference[:, ATTITUDE], _ATTITUDES, _MAX_RADII)
        nearest = np.interp(self._reference[:, ATTITUDE], _ATTITUDES, _MIN_RADII)
        self._reference[:, R] = np.clip(self._reference[:, R], nearest, farthest)
        fast[drawn, Z] = _MAX_RISE_SPEED
        self._reference_rate = np.clip((self._reference - before) / self._dt, -fast, fast)


def make_grade_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `Grade` for the chosen kind of actions."""
    return GradeController(setup)

"""Reference controller of the task `Grade`: repeated passes that cut, curl, carry and dump.

`Grade` plans the tip pose with a state machine. `PoseFollower` converts the reference pose and its
rate to actions of the chosen kind.
"""

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_facts
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
from hydrotele.envs.grade import FAR, MIDDLE, NEAR, POINTS, grade_radii

_INTEGRAL = 2.0  # 1/s^2, integral gain of valve actions
_JOINTS = (6.0, 1.0)  # 1/s, gains of `RateFeedback` for joints: tracking, model correction
_POSE = (4.0, 1.0)  # 1/s, the same for the tip pose


class PoseFollower:
    """Track a moving tip pose with an arm that has no further driven axes."""

    def __init__(self, setup: TaskSetup) -> None:
        """Read the parameters of the nominal machine."""
        k = setup.arm_axes
        self._arm, _, self._ranges = arm_facts(setup.machine)
        self._dt, self._k = step_time(setup), k
        self._tip, self._joint = columns(setup, "tip", COORDINATES[:k]), position_columns(setup)
        self._law = self._asked = None
        if setup.options.action == "valve":
            self._law = ValveLaw(setup, setup.task.servo, _INTEGRAL)
        elif setup.options.action == "joint_rate":
            fastest = np.array([full_rate(setup.machine, axis) for axis in setup.axes])
            self._asked = RateFeedback(setup, fastest, np.full(k, ACCELERATION), _JOINTS)
        else:
            accelerations = np.array(POSE_ACCELERATIONS[:k])
            self._asked = RateFeedback(
                setup, np.array(setup.task.pose_rates[:k]), accelerations, _POSE
            )
        self._by_pose = setup.options.action == "resolved_motion"

    def begin(self, count: int) -> None:
        """Allocate the state of `count` episodes."""
        (self._law or self._asked).begin(count)  # pyright: ignore - one of them is there
        self._q, self._fresh = np.zeros((count, self._k)), np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the state of the episodes selected by the mask (n,)."""
        (self._law or self._asked).reset(mask)  # pyright: ignore - one of them is there
        self._fresh |= mask

    def __call__(self, observation: np.ndarray, pose: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the actions of this step.

        Args:
            observation: (n, o).
            pose: (n, k) reference pose of the tip.
            rate: (n, k) rate of the reference pose.

        Returns:
            (n, k) actions.
        """
        if self._by_pose:
            assert self._asked
            return self._asked.rates(observation[:, self._tip].astype(float), pose, rate)
        measured = observation[:, self._joint].astype(float)
        self._q[self._fresh], self._fresh[:] = measured[self._fresh], False
        before, full = self._q.copy(), np.zeros((len(pose), ARM))
        full[:, : self._k] = pose
        inverse_joints(self._arm, self._ranges, full, self._q)
        speed = (self._q - before) / self._dt
        if self._law:
            return self._law(observation, self._q, speed)
        assert self._asked
        return self._asked.rates(measured, self._q, speed)


OVER, LOWER, DRAW, CURL, CARRY, DUMP = range(6)
R, Z, ATTITUDE = range(3)
_DEGREE = np.pi / 180.0
_DEEP = 0.15  # m, maximum depth of one cut
_UNEVEN = 0.03  # m, minimum section error that starts a pass
_FLAT = 0.027  # m, RMS error below which the controller waits
_LEAD, _TRAIL = 0.20, 0.10  # m by which a pass starts before and stops behind the uneven part
_FULL = 800.0  # kg, mass carried that ends a cut
_CLEAR, _HIGH = 0.5, 1.0  # m above the plane: edge before a pass, carried load
_CUTS = (NEAR, FAR + _LEAD), (-121.0 * _DEGREE, -106.0 * _DEGREE)  # radius -> attitude of a cut
_HELD, _EMPTY = -165.0 * _DEGREE, -85.0 * _DEGREE  # attitudes of a carrying and an empty bucket
_FAST = np.array([0.45, 0.35, 0.45])  # m/s, m/s, rad/s, maximum rates of r, z, attitude
_CURLED = np.array([0.45, 0.25, 0.30])  # the same while curling, where boom and stick also move
_DRAWN, _LOWERED, _SUNK = 0.30, 0.20, 0.15  # m/s along the plane, in the air, into the soil
_TOUCH = 0.03  # m, height of the edge above the ground at which a cut starts
_CHANGE = np.array([0.8, 0.8, 0.8])  # m/s^2, m/s^2, rad/s^2, maximum accelerations
_RAISED = 0.4  # m/s, maximum upward speed of the edge during a cut
_GAIN = 2.0  # 1/s, position gain of the reference motion
_LEADS = np.array([0.20, 0.08, 0.25])  # m, m, rad, maximum lead of the reference over the tip
_STALLED = 2.0  # s, minimum time of a cut before it counts as stalled
_ATTITUDES = np.array([-180.0, -170.0, -140.0, -125.0, -115.0, -105.0, -90.0, -60.0]) * _DEGREE
_FARTHEST = np.array([5.35, 5.55, 6.00, 6.30, 6.50, 6.75, 7.10, 7.75]) - 0.05  # m, at _ATTITUDES
_OPEN = 0.10  # m by which the opening of the bucket may lag behind the reach
_NEAREST = np.array([3.0, 3.0, 3.0, 3.45, 3.86, 4.30, 5.10, 6.70]) + 0.05  # m, at _ATTITUDES


class Grade:
    """Grade the ground in passes along the plane, each at most 0.15 m deep."""

    def __init__(self, setup: TaskSetup) -> None:
        """Look up the observation columns."""
        self._tip = columns(setup, "tip", COORDINATES[:4])
        self._errors = columns(setup, "profile_error", [str(p) for p in range(POINTS)])
        self._mass, self._edge, self._plane, self._slope = (
            columns(setup, name, [""])[0]
            for name in ("carried_mass", "edge_height", "plane_height", "plane_slope")
        )
        self._follow, self._dt = PoseFollower(setup), step_time(setup)
        self._radii = np.array(grade_radii())

    def begin(self, count: int) -> None:
        """Allocate the state of `count` episodes."""
        self._follow.begin(count)
        self._phase, self._since = np.zeros(count, int), np.zeros(count)
        self._place, self._rate = np.zeros((count, 3)), np.zeros((count, 3))
        self._first, self._last, self._theta = (np.zeros(count) for _ in range(3))
        self._fresh = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the state of the episodes selected by the mask (n,)."""
        self._follow.reset(mask)
        self._fresh |= mask

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (n, 4) for observations (n, o)."""
        seen = observation.astype(float)
        tip, errors = seen[:, self._tip][:, [0, 2, 3]], seen[:, self._errors]
        fresh = self._fresh
        self._phase[fresh], self._since[fresh] = OVER, 0.0
        self._place[fresh], self._rate[fresh] = tip[fresh], 0.0
        self._theta[fresh], self._fresh = seen[fresh, self._tip[1]], np.zeros(len(seen), bool)
        self._plan(tip, errors, seen[:, self._mass], seen[:, self._edge])
        goal, fast = self._goals(seen, errors)
        self._move(goal, fast, tip)
        pose = np.insert(self._place, 1, self._theta, axis=1)
        return self._follow(seen, pose, np.insert(self._rate, 1, 0.0, axis=1))

    def _plan(self, tip: np.ndarray, errors: np.ndarray, mass: np.ndarray, edge: np.ndarray):
        """Switch finished episodes to their next phase, and choose the range of the next pass."""
        self._since += self._dt
        phase, place = self._phase, self._place
        waiting = np.sqrt(np.mean(errors**2, axis=1)) < _FLAT
        uneven = errors > np.maximum(_UNEVEN, 0.3 * errors.max(axis=1, keepdims=True) - 0.03)
        first = np.where(uneven.any(1), self._radii[POINTS - 1 - uneven[:, ::-1].argmax(1)], FAR)
        last = np.where(uneven.any(1), self._radii[uneven.argmax(1)], NEAR)
        near = np.abs(tip - self._goal) if hasattr(self, "_goal") else np.ones_like(tip)
        moved = self._since > 0.5
        late = self._since > 12.0
        stalled = (self._since > _STALLED) & (np.abs(tip - place)[:, R] > 0.9 * _LEADS[R])
        done = (
            np.select(
                [phase == p for p in range(6)],
                [
                    (near[:, R] < 0.08) & (near[:, Z] < 0.1) & (near[:, ATTITUDE] < 0.1) & ~waiting,
                    (edge < _TOUCH) | (near[:, Z] < 0.03) | (self._since > 4.0),
                    (tip[:, R] < self._last + 0.03) | (mass > _FULL) | stalled | late,
                    (tip[:, ATTITUDE] < _HELD + 0.25) & (near[:, Z] < 0.2) | late,
                    (near[:, R] < 0.1) | late,
                    (tip[:, ATTITUDE] > _EMPTY - 0.15) | late,
                ],
            ).astype(bool)
            & moved
        )
        passing = done & (phase == OVER)
        held = (phase == OVER) & ~passing  # the range is updated until the pass starts
        self._first[held] = np.minimum(first[held] + _LEAD, FAR + _LEAD)
        self._last[held] = np.maximum(last[held] - _TRAIL, NEAR - _TRAIL)
        phase[done] = (phase[done] + 1) % 6
        self._since[done] = 0.0

    def _goals(self, seen: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the target (r, z, attitude) (n, 3) and the maximum rates (n, 3)."""
        phase, place = self._phase, self._place

        def plane(r: np.ndarray) -> np.ndarray:
            return seen[:, self._plane] + np.tan(seen[:, self._slope]) * (r - MIDDLE)

        rows = zip(place[:, R], errors, strict=True)
        over = np.array([np.interp(r, self._radii, e) for r, e in rows])
        cut = plane(place[:, R]) + np.maximum(over - _DEEP, 0.0)
        blade = np.interp(place[:, R], *_CUTS)
        start = np.interp(self._first, *_CUTS)
        high = plane(np.full(len(seen), MIDDLE)) + _HIGH
        clear = plane(self._first) + _CLEAR
        here = place[:, R]
        # the bucket opens only as it extends, so that all soil falls beyond the graded ground
        opened = np.minimum(np.interp(here + _OPEN, _FARTHEST, _ATTITUDES), _EMPTY)
        goal = np.stack([
            np.choose(phase, [self._first, self._first, self._last, np.minimum(here, 5.0),
                              np.full_like(here, 5.4), np.full_like(here, 7.0)]),
            np.choose(phase, [clear, cut, cut, high, high, high]),
            np.choose(phase, [start, blade, blade, *np.broadcast_to(_HELD, (2, len(here))),
                              opened]),
        ], axis=1)  # fmt: skip
        fast = np.tile(_FAST, (len(here), 1))
        fast[phase == DRAW, R] = _DRAWN
        fast[phase == LOWER, Z] = _LOWERED
        fast[phase == DRAW, Z] = _SUNK
        fast[phase == CURL] = _CURLED
        self._goal = goal
        return goal, fast

    def _move(self, goal: np.ndarray, fast: np.ndarray, tip: np.ndarray) -> None:
        """Advance the reference within the reach of the arm and its maximum lead over the tip."""
        wanted = np.clip(_GAIN * (goal - self._place), -fast, fast)
        drawn = (self._phase == DRAW) | (self._phase == LOWER)
        # during a cut, the height tracks the plane without lag
        wanted[drawn, Z] = np.clip(8.0 * (goal - self._place)[drawn, Z], -fast[drawn, Z], _RAISED)
        change = _CHANGE * self._dt
        self._rate += np.clip(wanted - self._rate, -change, change)
        before = self._place.copy()
        self._place += self._dt * self._rate
        np.clip(self._place, tip - _LEADS, tip + _LEADS, out=self._place)
        farthest = np.interp(self._place[:, ATTITUDE], _ATTITUDES, _FARTHEST)
        nearest = np.interp(self._place[:, ATTITUDE], _ATTITUDES, _NEAREST)
        self._place[:, R] = np.clip(self._place[:, R], nearest, farthest)
        fast[drawn, Z] = _RAISED
        self._rate = np.clip((self._place - before) / self._dt, -fast, fast)


def grade_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `Grade` for the chosen kind of actions."""
    return Grade(setup)

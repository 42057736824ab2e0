"""Reference controller of the task `LoadTruck`: a scripted cycle of digging, hauling, dumping and returning.

The cut follows a path of the bucket's edge. All other moves go straight to joint angles, with the swing and the
arm at the same time as far as bank and truck allow. The joint references respect the limits of the
joint servo and share the flow of the pump.
"""

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
from hydrotele.envs.controllers.controller import (
    Controller,
    ValveServo,
    compute_joint_angles,
    compute_tip_poses,
    environment_step_time,
    find_observation_columns,
    find_position_columns,
)
from hydrotele.envs.controllers.rate_feedback import RateFeedback
from hydrotele.envs.episode import MAX_ARM_AXES
from hydrotele.envs.load_truck import BANK_HALF_ANGLE, LOAD_SECTION_COUNT, SECTION_COUNT, profile_section_radii
from hydrotele.envs.task_setup import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, TaskSetup, full_action_rate
from hydrotele.envs.truck_bed import RAIL_HEIGHT, TRUCK

_DEGREE = np.pi / 180.0
_INTEGRAL_GAIN = 2.0  # 1/s^2, integral gain of valve actions
_JOINT_GAINS, _POSE_GAINS = (6.0, 1.0), (4.0, 1.0)  # 1/s, gains of `RateFeedback`
_PUMP_SHARE = 0.9  # share of the flow of the pump that the references use
_RATE_SHARE, _ACCELERATION_SHARE = 0.98, 0.9  # shares of the limits of rates and accelerations
_MAX_LEAD = 0.15  # rad, maximum lead of a reference over its joint
_BRAKING_GAIN = 4.0  # 1/s, gain of a reference close to its goal

READY, ENTER, DRAW, CURL, HAUL, DUMP = range(6)
R, THETA, Z, ATTITUDE = range(4)
_CUT_LENGTH, _CUT_AREA = 1.9, 0.65  # m, m^2 of soil above the bottom of a cut
_START_RADII = np.linspace(6.2, 7.4, 13)  # m, possible radii at which a cut starts
_LOWEST_CUT = -1.6  # m
_HALVINGS = 12  # of the interval of the bottom's height, to 1 mm
_READY_HEIGHT = 0.25  # m above the bank
_ENTRY_ATTITUDES = (6.2, 7.0), (-81.0 * _DEGREE, -66.0 * _DEGREE)  # start of the cut [m] -> attitude of the entry
_CUT_ATTITUDES = (-80.0 * _DEGREE, -123.0 * _DEGREE)  # at the start and the end of a cut
_ENTRY_LENGTH = 0.4  # m, horizontal way while the edge enters the ground
_CUT_RATES = np.array([0.7, 1.0, 0.48])  # m/s, m/s, rad/s: r, z, attitude
_CUT_ACCELERATIONS = np.array([1.5, 1.5, 1.5])  # m/s^2, m/s^2, rad/s^2
_FULL_MASS = 1050.0  # kg, mass carried that ends a cut
_MAX_CUT_TIME = 6.0  # s
_CURL_ATTITUDE, _CURL_LENGTH, _CURL_RISE = -165.0 * _DEGREE, 0.75, (0.2, 0.75)  # rad, m, m
_FREE_DEPTH = 0.4  # m, depth of a trench that needs no ramp at its inner end
_CURLED_ATTITUDE = -148.0 * _DEGREE  # attitude at which hauling starts
_CARRY_ATTITUDE, _DUMP_ATTITUDE = -168.0 * _DEGREE, -66.0 * _DEGREE
_BUCKET_DEPTH = 0.68  # m by which the heel of a curled bucket is lower than its edge
_CLEARANCE = 0.15  # m between bucket and bank before the swing starts
_RAIL_CLEARANCE = 0.2  # m between bucket and walls of the truck
_DUMP_RADII = (4.8, 6.5)  # m, range of the radius of the bucket's pin while dumping
_DUMP_RISE = 0.15  # m by which the edge is lower while the bucket opens
_FALL_OFFSET = 0.4  # m by which the soil falls closer to the machine than the pin
_ARRIVE_ANGLE = 0.5  # rad between arm and truck at which the swing waits for the boom
_LEAVE_ANGLE = 0.35  # rad between arm and truck before the boom is lowered
_DUMP_ANGLE = 0.25  # rad before the middle of the bed at which the bucket starts to open
_EMPTY_MASS = 40.0  # kg
_READY_TOLERANCES = np.array([0.05, 0.1, 0.1, 0.15])  # rad


class JointFollower:
    """Controller that makes the arm follow joint references, with any kind of actions."""

    def __init__(self, setup: TaskSetup) -> None:
        """Create the controller for the kind of actions of the setup, for `setup.machine` without added effects."""
        k, kind = setup.arm_axes, setup.options.action
        self._arm, self._kind = arm_specification(setup.machine)[0], kind
        self._joint, self._dt = find_position_columns(setup), environment_step_time(setup)
        self._tip = find_observation_columns(setup, "tip", COORDINATES[:k])
        if kind == "valve":
            self._servo = ValveServo(setup, setup.task.servo, _INTEGRAL_GAIN)
        elif kind == "joint_rate":
            fastest = np.array([full_action_rate(setup.machine, axis) for axis in setup.axes])
            self._servo = RateFeedback(setup, fastest, np.full(k, MAX_ACCELERATION), _JOINT_GAINS)
        else:
            fastest = np.array(setup.task.pose_rates[:k])
            self._servo = RateFeedback(setup, fastest, np.array(MAX_POSE_ACCELERATIONS[:k]), _POSE_GAINS)

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        self._servo.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next call initialises their controller state."""
        self._servo.reset(mask)

    def __call__(self, observation: np.ndarray, q: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the actions (n, k) for joint references `q` (n, k) [rad] and their rates (n, k) [rad/s]."""
        if isinstance(self._servo, ValveServo):
            return self._servo(observation, q, rate)
        if self._kind == "joint_rate":
            return self._servo.compute_rate_commands(observation[:, self._joint].astype(float), q, rate)
        pose = tip_poses(self._arm, q)
        speed = (tip_poses(self._arm, q + self._dt * rate) - pose) / self._dt
        return self._servo.compute_rate_commands(observation[:, self._tip].astype(float), pose, speed)


def tip_poses(arm: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the poses (n, k) of the tip, r [m], theta [rad], z [m], attitude [rad], for joint angles (n, k) [rad]."""
    pose = np.zeros((len(q), MAX_ARM_AXES))
    compute_tip_poses(arm, np.ascontiguousarray(q), pose)
    return pose[:, : q.shape[1]]


class LoadTruckController:
    """Controller that fills the truck by repeated cycles; it also completes the single phases of the task.

    Attributes:
        phase: (n,) READY (move to the bank), ENTER, DRAW, CURL (cut), HAUL or DUMP.
        flow_demand: (n,) flow that the requested rates take, as a fraction of the flow that may be used [1].
    """

    def __init__(self, setup: TaskSetup) -> None:
        """Find the observation columns that the controller uses, and read limits from `setup.machine`."""
        self._tip = find_observation_columns(setup, "tip", COORDINATES[:4])
        self._joint, self._dt = find_position_columns(setup), environment_step_time(setup)
        self._bank = find_observation_columns(setup, "bank_height", [str(p) for p in range(SECTION_COUNT)])
        self._load = find_observation_columns(setup, "load_height", [str(p) for p in range(LOAD_SECTION_COUNT)])
        self._mass, self._to_bank, self._to_truck = (
            find_observation_columns(setup, name, [""])[0] for name in ("carried_mass", "bank_bearing", "truck_bearing")
        )
        self._follower, self._radii = JointFollower(setup), profile_section_radii()
        self._arm, _, self._ranges = arm_specification(setup.machine)
        machine = setup.machine
        self._fastest = _RATE_SHARE * np.array([full_action_rate(machine, axis) for axis in setup.axes])
        self._areas = np.array([machine.axes[axis].hydraulic_drive.effective_areas for axis in setup.axes])
        assert machine.supply
        self._flow = _PUMP_SHARE * machine.supply.pump_flow
        columns = [setup.variants.plant.axes.index(axis) for axis in setup.axes]
        self._moment_arms = setup.drive_table[columns, :, 0]
        ranges = [machine.joints[machine.axes[axis].joint].range or (-np.pi, np.pi) for axis in setup.axes]
        points = self._moment_arms.shape[1]
        self._grids = [np.linspace(*limits, points) for limits in ranges]
        place = (np.arange(LOAD_SECTION_COUNT) + 0.5) / LOAD_SECTION_COUNT - 0.5
        self._bed_radii = np.hypot(*TRUCK.position) + TRUCK.length * place

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        self._follower.begin(count)
        self.phase, self._time = np.zeros(count, int), np.zeros(count)
        self._q, self._rate, self._speed = np.zeros((count, 4)), np.zeros((count, 4)), np.zeros((count, 3))
        self._start, self._pin, self._bottom = np.zeros(count), np.full(count, 5.6), np.zeros(count)
        self._is_new = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next call initialises their controller state."""
        self._follower.reset(mask)
        self._is_new |= mask

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Compute the actions (n, 4) of the next step from the observations (n, o) of n parallel episodes."""
        seen = observation.astype(float)
        joint, tip = seen[:, self._joint], seen[:, self._tip]
        fresh = self._is_new
        self._q[fresh], self._rate[fresh], self._speed[fresh] = joint[fresh], 0.0, 0.0
        loaded = seen[:, self._mass] > 0.3 * _FULL_MASS
        self.phase[fresh], self._time[fresh] = np.where(loaded, HAUL, READY)[fresh], 0.0
        self._is_new = np.zeros(len(seen), bool)
        self._update_phases(seen, tip, joint)
        cutting = (self.phase >= ENTER) & (self.phase <= CURL)
        wanted = np.where(cutting[:, None], self._cut_rates(seen), self._move_rates(seen, tip))
        self._advance(wanted, cutting, joint)
        return self._follower(seen, self._q, self._rate)

    def _update_phases(self, seen: np.ndarray, tip: np.ndarray, joint: np.ndarray) -> None:
        """Switch every episode whose phase is finished to its next phase, and plan cut and dump.

        `seen` (n, o) are the observations, `tip` (n, 4) the measured pose and `joint` (n, 4) the
        measured joint angles.
        """
        self._time += self._dt
        phase, mass = self.phase, seen[:, self._mass]
        waiting = phase == READY  # the cut is planned until it starts
        start, bottom = self._plan_cut(seen[:, self._bank])
        self._start[waiting], self._bottom[waiting] = start[waiting], bottom[waiting]
        carrying = (phase == CURL) | (phase == HAUL)
        self._pin[carrying] = self._plan_dump(seen[:, self._load])[carrying]
        pose = tip_poses(self._arm, self._q)
        swing_error = np.abs(seen[:, self._to_truck])
        end = self._start - _CUT_LENGTH
        near = np.abs(self._goal_joints(seen) - joint)
        ready = ((near / _READY_TOLERANCES).max(1) < 1.0) & (np.abs(self._rate[:, 0]) < 0.1)
        done = np.select(
            [phase == p for p in range(6)],
            [
                ready,
                pose[:, Z] < self._bottom + 0.05,
                (pose[:, R] < end + 0.05) | (mass > _FULL_MASS) | (self._time > _MAX_CUT_TIME),
                (tip[:, ATTITUDE] < _CURLED_ATTITUDE) | (self._time > _MAX_CUT_TIME),
                (swing_error < _DUMP_ANGLE) & (tip[:, Z] - _BUCKET_DEPTH > RAIL_HEIGHT + _RAIL_CLEARANCE / 2.0),
                mass < _EMPTY_MASS,
            ],
        ).astype(bool)
        phase[done] = (phase[done] + 1) % 6
        self._time[done] = 0.0
        self._speed[done & (phase == ENTER)] = 0.0

    def _plan_cut(self, bank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the radius (n,) at which a cut starts, and the height (n,) of its level bottom [m].

        Every cut has the same area of soil above its bottom. The one with the highest bottom is taken.
        `bank` (n, SECTION_COUNT) are the heights of the bank [m].
        """
        before = _START_RADII[:, None] - self._radii
        inside = (before > _ENTRY_LENGTH) & (before < _CUT_LENGTH + 0.5 * _CURL_LENGTH)
        width = self._radii[1] - self._radii[0]
        low, high = np.full((len(bank), len(inside)), _LOWEST_CUT), np.full((len(bank), len(inside)), bank.max())
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            area = width * (inside * np.maximum(bank[:, None] - middle[:, :, None], 0.0)).sum(2)
            low, high = np.where(area > _CUT_AREA, middle, low), np.where(area > _CUT_AREA, high, middle)
        best = low.argmax(1)
        return _START_RADII[best], low[np.arange(len(bank)), best]

    def _plan_dump(self, load: np.ndarray) -> np.ndarray:
        """Return the radius (n,) of the bucket's pin at which the soil falls where the load is lowest [m].

        `load` (n, LOAD_SECTION_COUNT) are the heights of the load [m].
        """
        reachable = (self._bed_radii > _DUMP_RADII[0] - _FALL_OFFSET) & (self._bed_radii < _DUMP_RADII[1] + 0.3)
        lowest = np.where(reachable, load, np.inf).argmin(1)
        return np.clip(self._bed_radii[lowest] + _FALL_OFFSET, *_DUMP_RADII)

    def _bank_height_at(self, seen: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.array([np.interp(x, self._radii, row) for x, row in zip(r, seen[:, self._bank], strict=True)])

    def _goal_joints(self, seen: np.ndarray) -> np.ndarray:
        """Return the joint angles (n, 4) at the end of the moves READY, HAUL and DUMP [rad]."""
        phase, theta = self.phase, seen[:, self._tip[THETA]]
        pose, q = np.zeros((len(seen), MAX_ARM_AXES)), self._q.copy()
        above = seen[:, self._bank].max(1)  # the sides of the trench are as high as the bank
        carry, reach = TOOL_LENGTH * np.cos(_CARRY_ATTITUDE), TOOL_LENGTH * np.cos(_DUMP_ATTITUDE)
        hauling, dumping = phase == HAUL, phase == DUMP
        pose[:, R] = np.where(hauling, self._pin + carry, np.where(dumping, self._pin + reach, self._start))
        pose[:, THETA] = theta + np.where(hauling | dumping, seen[:, self._to_truck], seen[:, self._to_bank])
        high = RAIL_HEIGHT + _RAIL_CLEARANCE
        lowered = np.where(dumping, high + _DUMP_RISE, above + _READY_HEIGHT)
        pose[:, Z] = np.where(hauling, high + _BUCKET_DEPTH, lowered)
        entry = np.interp(self._start, *_ENTRY_ATTITUDES)
        pose[:, ATTITUDE] = np.where(hauling, _CARRY_ATTITUDE, np.where(dumping, _DUMP_ATTITUDE, entry))
        compute_joint_angles(self._arm, self._ranges, pose, q)
        return q

    def _move_rates(self, seen: np.ndarray, tip: np.ndarray) -> np.ndarray:
        """Return the joint rates (n, 4) towards the goal of a move [rad/s].

        A loaded bucket swings only above the bank, and to the truck only above its walls. An empty one
        is lowered only after it has left the truck.
        """
        left = self._goal_joints(seen) - self._q
        hauling, to_truck = self.phase == HAUL, np.abs(seen[:, self._to_truck])
        lowest = tip[:, Z] - _BUCKET_DEPTH
        in_bank = lowest < seen[:, self._bank].max(1) + _CLEARANCE
        in_bank &= np.abs(seen[:, self._to_bank]) < BANK_HALF_ANGLE
        below_rail = lowest < RAIL_HEIGHT + _RAIL_CLEARANCE / 2.0
        swing = np.sign(left[:, 0]) * np.maximum(np.abs(left[:, 0]) - _ARRIVE_ANGLE, 0.0)
        left[:, 0] = np.where(hauling & in_bank, 0.0, np.where(hauling & below_rail, swing, left[:, 0]))
        leaving = (self.phase == READY) & (to_truck < _LEAVE_ANGLE)
        left[leaving, 1:3] = np.maximum(left[leaving, 1:3], 0.0)
        left[leaving & (tip[:, Z] < RAIL_HEIGHT + _RAIL_CLEARANCE / 2.0), 0] = 0.0
        size = np.abs(left)
        brake = np.sqrt(2.0 * 0.8 * _ACCELERATION_SHARE * MAX_ACCELERATION * size)
        return np.sign(left) * np.minimum(np.minimum(self._fastest, brake), _BRAKING_GAIN * size)

    def _cut_rates(self, seen: np.ndarray) -> np.ndarray:
        """Return the joint rates (n, 4) that move the edge along the path of the cut [rad/s]."""
        phase, pose = self.phase, np.zeros((len(seen), MAX_ARM_AXES))
        pose[:, :4] = tip_poses(self._arm, self._q)
        here = pose[:, R]
        end, cut = self._start - _CUT_LENGTH, self._bottom
        rise = np.clip(seen[:, self._bank].max(1) - cut - _FREE_DEPTH, *_CURL_RISE)  # a deep trench gets a ramp
        part = np.clip((self._start - here) / _CUT_LENGTH, 0.0, 1.0)
        blade = _CUT_ATTITUDES[0] + part * (_CUT_ATTITUDES[1] - _CUT_ATTITUDES[0])
        choice = phase - ENTER
        clipped = np.clip(choice, 0, 2)
        goal = np.stack([
            np.choose(clipped, [self._start - _ENTRY_LENGTH, end - 0.3, end - _CURL_LENGTH]),
            np.choose(clipped, [cut, cut, self._bottom + rise]),
            np.choose(clipped, [np.interp(self._start, *_ENTRY_ATTITUDES), blade, np.full_like(here, _CURL_ATTITUDE)]),
        ], axis=1)  # fmt: skip
        wanted = np.clip(3.0 * (goal - pose[:, [R, Z, ATTITUDE]]), -_CUT_RATES, _CUT_RATES)
        change = _CUT_ACCELERATIONS * self._dt
        self._speed += np.clip(wanted - self._speed, -change, change)
        pose[:, [R, Z, ATTITUDE]] += self._dt * self._speed
        q = self._q.copy()
        compute_joint_angles(self._arm, self._ranges, pose, q)
        rate = (q - self._q) / self._dt
        rate[:, 0] = 0.0
        return rate

    def _advance(self, wanted: np.ndarray, cutting: np.ndarray, joint: np.ndarray) -> None:
        """Advance the joint references by one step with the requested rates (n, 4), within all limits.

        If the rates exceed the rate of a joint or the flow of the pump, all are reduced by the same
        factor. `cutting` (n,) is whether the reference follows the path of a cut, whose
        acceleration is limited already. `joint` (n, 4) are the measured joint angles.
        """
        flow = np.zeros(len(wanted))
        for a in range(wanted.shape[1]):
            arm = np.interp(self._q[:, a], self._grids[a], self._moment_arms[a])
            travel = arm * wanted[:, a]
            flow += np.where(travel > 0.0, self._areas[a, 0], self._areas[a, 1]) * np.abs(travel)
        self.flow_demand = flow / self._flow
        over = np.maximum(np.max(np.abs(wanted) / self._fastest, axis=1), self.flow_demand)
        wanted = wanted / np.maximum(over, 1.0)[:, None]
        change = np.where(cutting, 4.0, _ACCELERATION_SHARE * MAX_ACCELERATION)[:, None] * self._dt
        before = self._q.copy()
        self._rate += np.clip(wanted - self._rate, -change, change)
        self._q = np.clip(self._q + self._dt * self._rate, joint - _MAX_LEAD, joint + _MAX_LEAD)
        self._rate = np.clip((self._q - before) / self._dt, -self._fastest, self._fastest)


TOOL_LENGTH = 1.35  # m, from the pin to the edge of the bucket


def make_load_controller(setup: TaskSetup) -> Controller:
    """Make the controller of the task `LoadTruck` for the chosen kind of actions."""
    return LoadTruckController(setup)

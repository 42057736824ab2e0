"""A policy in the control loop of a run: observations from readings, commands and references from actions.

Actions have the same meaning as in environments (`control.rate_references`).
"""

import re
from typing import NamedTuple

import numpy as np

from hydrotele.control.action_limits import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, full_action_rate
from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
from hydrotele.control.plan import Plan
from hydrotele.control.rate_references import ArmLimits, advance_joint_reference, advance_pose_reference
from hydrotele.control.resolved_motion import POSE_SIZE
from hydrotele.control.servo import DriveReferences, interpolate_drive_reference, tabulate_drive_geometry
from hydrotele.core.errors import InputError
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.run.policy import PilotState, Policy
from hydrotele.scenario.pilots import PolicyPilot
from hydrotele.scenario.scenario import Servo
from hydrotele.simulate.sensor_models import Feedback

_PREVIEW = re.compile(r"reference_in_(\d+)_ms")


class PolicyLoop(NamedTuple):
    """The part of a running session that a policy reads and writes.

    Attributes:
        plan: commands, references and goal; commands and references are written.
        drives: references of the drives, written.
        readings: the last sensor readings.
        commands: (n, k) commands of the past ticks.
        initial_commands: (k,) commands before the first tick.
        control_rate: control ticks per second [Hz].
    """

    plan: Plan
    drives: DriveReferences
    readings: Feedback
    commands: np.ndarray
    initial_commands: np.ndarray
    control_rate: float


class PolicyDriver:
    """Calls a policy at its rate and converts its actions in every control tick."""

    def __init__(self, policy: Policy, pilot: PolicyPilot, machine: Machine, servo: Servo, loop: PolicyLoop) -> None:
        """Prepare observations and actions.

        Args:
            policy: the program.
            pilot: its specification with all values.
            machine: the machine without the scenario's effects.
            servo: settings of the servo.
            loop: the running session.

        Raises:
            InputError: the rate does not divide the control rate, the observation has an unknown value, or the
                servo has a force model.
        """
        assert pilot.rate and pilot.pose_rates
        every = loop.control_rate / pilot.rate
        if every < 0.999 or abs(every - round(every)) > 1e-6:
            raise InputError("pilot.rate", f"{pilot.rate:g} Hz must divide control_rate {loop.control_rate:g} Hz")
        if servo.force_model and pilot.action != "valve":
            raise InputError("servo.force_model", "needs a motion that is known before the run; remove it for a policy")
        self._policy, self._pilot, self._loop, self._every = policy, pilot, loop, round(every)
        axes, plan = loop.plan.axes, loop.plan
        self._columns = np.array([axes.index(name) for name in pilot.axes])
        self._valves = np.array([machine.axes[name].is_hydraulic for name in pilot.axes])
        limits = [drive.command_limit if (drive := machine.axes[name].force) else 1.0 for name in axes]
        self._limits, self._feedforward = np.array(limits), servo.feedforward
        self._fastest = np.array([full_action_rate(machine, name) for name in axes])
        ranges = [machine.joints[machine.axes[name].joint].range for name in axes]
        self._ranges = np.array([limits or (-np.inf, np.inf) for limits in ranges])
        self._grid, self._table = tabulate_drive_geometry(machine, axes)
        self._arm, self._arm_columns = None, self._columns[:0]
        if machine.arm:
            numbers, names, arm_ranges = arm_specification(machine)
            self._arm = ArmLimits(numbers, arm_ranges, np.array(MAX_POSE_ACCELERATIONS))
            self._arm_columns = np.array([axes.index(name) for name in names])
        self._pose_speed = np.zeros(POSE_SIZE)
        self._pose_speed[: len(self._arm_columns)] = pilot.pose_rates[: len(self._arm_columns)]
        self._goal = plan.reference[:1].copy() if plan.goal is None else plan.goal
        self._goal_rate = np.zeros_like(self._goal) if plan.goal_rate is None else plan.goal_rate
        self._goal_pose: np.ndarray | None = None
        self._action = np.zeros(len(pilot.axes))
        self._fields = [self._find_source(name, machine) for name in pilot.observation]
        if policy.begin:
            policy.begin(machine, pilot.axes)

    def prepare_tick(self, tick: int) -> int:
        """Compute the action if one is due, and write the commands or references of a tick.

        Args:
            tick: number of the next control tick.

        Returns:
            The tick before which this function must be called again.

        Raises:
            InputError: the policy raised an exception, or its action has the wrong size or is not finite.
        """
        if tick == 0:
            self._start()
        if tick % self._every == 0:
            self._action = self._compute_action(tick)
        plan, end = self._loop.plan, tick + self._every - tick % self._every
        if self._pilot.action == "valve":
            plan.command[tick:end, self._columns] = self._action * self._limits[self._columns]
            return end
        plan.reference[tick] = self._reference  # the servo compares it with the readings of the same time
        self._advance_references()
        plan.rate[tick] = self._rate
        drives = self._loop.drives
        interpolate_drive_reference(
            self._grid, self._table, self._reference, self._rate, self._feedforward, drives.velocity[tick],
            drives.arm[tick], drives.volume_head[tick], drives.volume_rod[tick],
        )  # fmt: skip
        return tick + 1

    def _start(self) -> None:
        """Start with the measured positions as references; axes that are not driven keep their commands."""
        self._loop.plan.command[:] = self._loop.initial_commands
        self._reference = self._loop.readings.joint.copy()
        self._rate = np.zeros_like(self._reference)
        self._pose, self._pose_rate = self._tip_pose(self._reference), np.zeros(POSE_SIZE)

    def _tip_pose(self, position: np.ndarray) -> np.ndarray:
        """Return the pose (5,) of the tip at positions of all axes; 0 without an arm."""
        pose = np.zeros(POSE_SIZE)
        if self._arm:
            compute_tip_pose(self._arm.parameters, position[self._arm_columns], pose)
        return pose

    def _advance_references(self) -> None:
        joint, period, first = self._loop.readings.joint, 1.0 / self._loop.control_rate, 0
        if self._pilot.action == "resolved_motion":
            assert self._arm
            first, goal = len(self._arm_columns), np.zeros(POSE_SIZE)
            goal[:first] = self._action[:first] * self._pose_speed[:first]
            q, rates = self._reference[self._arm_columns], self._rate[self._arm_columns]
            advance_pose_reference(
                self._arm, goal, period, joint[self._arm_columns], self._pose, self._pose_rate, q, rates
            )
            self._reference[self._arm_columns], self._rate[self._arm_columns] = q, rates
        for number in range(first, len(self._columns)):
            i = self._columns[number]
            self._reference[i], self._rate[i] = advance_joint_reference(
                self._reference[i], self._rate[i], self._action[number] * self._fastest[i], joint[i],
                self._ranges[i], MAX_ACCELERATION, period,
            )  # fmt: skip

    def _compute_action(self, tick: int) -> np.ndarray:
        state = self._make_state(tick)
        try:
            if self._fields:
                values = [self._read(state, tick, *source) for source in self._fields]
                found = self._policy.act(np.array(values, np.float32))
            else:
                found = self._policy.act(state)
            action = np.array(found, float).reshape(-1)
        except InputError:
            raise
        except Exception as error:  # any error of the user's code
            message = f"failed at {state.time:g} s: {type(error).__name__}: {error}"
            raise InputError(self._policy.source, message) from error
        if len(action) != len(self._columns) or not np.isfinite(action).all():
            names = ", ".join(self._pilot.axes)
            message = f"returned {action} at {state.time:g} s; {len(self._columns)} finite actions are needed: {names}"
            raise InputError(self._policy.source, message)
        return np.clip(action, -1.0, 1.0).astype(np.float32).astype(float)

    def _make_state(self, tick: int) -> PilotState:
        seen, c = self._loop.readings, self._columns
        command = self._loop.commands[tick - 1] if tick else self._loop.initial_commands
        row = min(tick, len(self._goal) - 1)
        return PilotState(
            tick / self._loop.control_rate, seen.joint[c], seen.rate[c], np.where(self._valves, seen.head[c], 0.0),
            np.where(self._valves, seen.rod[c], 0.0), seen.supply.copy(), self._tip_pose(seen.joint), command[c],
            self._goal[row, c], self._goal_rate[row, c],
        )  # fmt: skip

    def _find_source(self, name: str, machine: Machine) -> tuple[str, int, int]:
        """Return where the value of an observation comes from: quantity, index and ticks ahead of now."""
        what, _, where = name.partition(".")
        axes = self._pilot.axes
        plain = {"rate": "rate", "pressure_head": "pressure_head", "pressure_rod": "pressure_rod", "command": "command"}
        if what in plain and where in axes:
            return plain[what], axes.index(where), 0
        if where in axes and what == machine.position_kind(where):
            return "position", axes.index(where), 0
        if what == "tip" and where in COORDINATES and self._arm:
            return "tip_pose", COORDINATES.index(where), 0
        if what == "pressure_supply" and name in machine.supply_channels:
            return "pressure_supply", list(machine.supply_channels).index(name), 0
        ahead = _PREVIEW.fullmatch(what)
        ticks = round(int(ahead[1]) * 1e-3 * self._loop.control_rate) if ahead else 0
        if (what in ("reference", "reference_rate") or ahead) and self._loop.plan.goal is not None:
            kind = "rate" if what == "reference_rate" else "position"
            if where in axes and where not in COORDINATES:
                return f"goal_{kind}", axes.index(where), ticks
            if where in COORDINATES and self._arm:
                return f"goal_pose_{kind}", COORDINATES.index(where), ticks
        raise InputError(f"pilot.observation {name!r}", self._describe_sources(what))

    def _describe_sources(self, what: str) -> str:
        if what.startswith("reference") and self._loop.plan.goal is None:
            return "the scenario has no reference: give `pilot.reference`, or a scenario whose pilot moves the joints"
        known = "angle/position, rate, pressure_head, pressure_rod, command, reference, reference_rate"
        more = "reference_in_N_ms (with an axis or r, theta, z, attitude, head), tip, pressure_supply"
        return f"is not a value of a scenario; known: {known}, {more}. A Python function can compute others"

    def _read(self, state: PilotState, tick: int, quantity: str, index: int, ahead: int) -> float:
        """Return one value of the observation; arguments as in the result of `_find_source`."""
        if not quantity.startswith("goal"):
            return getattr(state, quantity)[index]
        row = min(tick + ahead, len(self._goal) - 1)
        if quantity == "goal_position":
            return self._goal[row, self._columns[index]]
        if quantity == "goal_rate":
            return self._goal_rate[row, self._columns[index]]
        poses = self._make_goal_poses()
        if quantity == "goal_pose_position":
            return poses[row, index]
        following, before = min(row + 1, len(poses) - 1), max(row - 1, 0)
        return (poses[following, index] - poses[before, index]) / (following - before) * self._loop.control_rate

    def _make_goal_poses(self) -> np.ndarray:
        """Return the pose (n, 5) of the tip at the goal in every tick."""
        if self._goal_pose is None:
            self._goal_pose = np.array([self._tip_pose(row) for row in self._goal])
        return self._goal_pose

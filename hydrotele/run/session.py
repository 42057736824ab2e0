"""A running simulation of a scenario, which is advanced by control ticks.

All arrays are allocated for the full duration of the scenario and cut if the run stops earlier.
"""

import dataclasses
import time as clock
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.control.control_loop import (
    Controller,
    PlannedRun,
    planned_run_record,
    step_planned_run,
)
from hydrotele.control.feedforward import compute_force_references
from hydrotele.control.plan import Plan
from hydrotele.control.servo import compute_drive_references, servo_parameters
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.run.policy import Policy
from hydrotele.run.policy_driver import PolicyDriver, PolicyLoop
from hydrotele.run.tick_loop import (
    make_tick_loop,
    run_planned_ticks,
    run_teleoperated_ticks,
    update_max_pin_opening,
)
from hydrotele.scenario.pilots import PolicyPilot
from hydrotele.scenario.scenario import Scenario, find_local_force_model
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.conservation_checks import full_physics_state
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record, Recorder, start_leapfrog
from hydrotele.simulate.sensor_models import Feedback
from hydrotele.simulate.soil_bed import SoilBed
from hydrotele.simulate.stepping import Stepper
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.teleop.operator_model import HandInput
from hydrotele.teleop.teleoperation_system import TeleoperationSystem


class PreparedRun(NamedTuple):
    """A machine, its initial state and a plan: all that is needed to start the run of a scenario.

    Attributes:
        plant: the simulated machine.
        data: its MuJoCo data in the initial state.
        plan: references and commands of the axes over time.
        sensor_feedback: simulated sensor readings that the controller uses.
        nominal_machine: the machine as its controller knows it, without the scenario's effects.
        policy: program that computes the actions, and its specification with all values; None without one.
    """

    plant: Plant
    data: mujoco.MjData
    plan: Plan
    sensor_feedback: Feedback
    nominal_machine: Machine
    policy: tuple[Policy, PolicyPilot] | None = None


class SessionResult(NamedTuple):
    """Result of the simulated ticks of a session.

    Attributes:
        plan: reference and commands of every axis.
        record: states at the log rows.
        commands: (n, nu) commands by control tick.
        max_pin_opening: largest distance between the two halves of a pin of a closed loop [m].
        computing_seconds: real time from the end of the first call of the compiled loop, which
            loads compiled code, to `finish` [s].
        station: operator station of a teleoperated run, otherwise None.
        events: (time [s], description) of events in the surroundings, such as a falling tree.
        soil: soil that the bucket has dug, None if there is none.
    """

    plan: Plan
    record: Record
    commands: np.ndarray
    max_pin_opening: float
    computing_seconds: float
    station: TeleoperationSystem | None
    events: tuple[tuple[float, str], ...]
    soil: SoilBed | None


class Session:
    """A running simulation of a scenario.

    Attributes:
        plant: the simulated machine.
        data: its MuJoCo data; positions and velocities are half a physics step apart, as in leapfrog
            integration (`simulate.record`).
        scenario: the scenario.
        sensor_feedback: sampled sensor readings that the controller uses.
        station: operator station of a teleoperated run, otherwise None.
        initial_physics_state: full physics state before the first tick.
        initial_commands: (nu,) commands before the first tick.
        tick: number of the next control tick.
        ticks_per_row: control ticks per log row.
    """

    def __init__(self, prepared: PreparedRun, scenario: Scenario, hand: HandInput | None = None) -> None:
        """Allocate the arrays of the whole run and prepare the first tick.

        Args:
            prepared: machine, initial state and plan.
            scenario: the scenario.
            hand: function that returns a live operator's reference position of the handle.

        Raises:
            InputError: servo, force model or station do not fit the machine.
        """
        plant, data, plan, seen, nominal, policy = prepared
        plan = dataclasses.replace(
            plan, reference=np.ascontiguousarray(plan.reference, float),
            rate=np.ascontiguousarray(plan.rate, float),
            command=np.ascontiguousarray(plan.command, float),
        )  # fmt: skip
        start_leapfrog(plant.model, data)
        self.plant, self.data, self.sensor_feedback, self.scenario = plant, data, seen, scenario
        self.initial_physics_state, self.initial_commands = (
            full_physics_state(plant.model, data),
            np.array(data.ctrl),
        )
        self._plan, self._dt = plan, 1.0 / scenario.control_rate
        self.ticks_per_row = round(scenario.control_rate / scenario.log_rate)
        parameters = servo_parameters(plant.machine, plant.axes, scenario.servo, self._dt)
        drives = compute_drive_references(plant.machine, plan, scenario.servo)
        drives = drives._make(map(np.ascontiguousarray, drives))
        model = find_local_force_model(scenario) or scenario.servo.force_model
        servo = scenario.servo.model_copy(update={"force_model": str(model) if model else None})
        forces = compute_force_references(nominal, plan, servo)
        k, ticks = len(plant.axes), scenario.tick_count
        self._recorder = Recorder(plant, scenario.row_count)
        self._stepper = Stepper(plant, data, round(self._dt / scenario.timestep))
        self.sensor_feedback.update(0, self._stepper)
        load = parameters[:, 1] * seen.head - parameters[:, 2] * seen.rod - forces.force[0]
        self._commands = np.zeros((ticks, k))
        self._run = PlannedRun(
            controller=Controller(parameters, plan.closed_loop.astype(np.int64), load, np.zeros(k)),
            feedback=seen.table,
            drives=drives,
            forces=forces,
            reference=plan.reference,
            command=plan.command,
            given=self._commands,
        )
        self._planned = planned_run_record(self._run)
        self.station = None
        if isinstance(scenario.pilot, TeleopPilot):
            self.station = TeleoperationSystem(plant, data, scenario, plan, drives, seen, hand)
        self._policy = None
        if policy:
            loop = PolicyLoop(plan, drives, seen, self._commands, self.initial_commands, 1.0 / self._dt)
            self._policy = PolicyDriver(*policy, nominal, scenario.servo, loop)
        self._around = Surroundings(plant.machine, plant.model, scenario.surroundings)
        self._ticks = make_tick_loop(
            plant.model, data, self._stepper.steps, self.ticks_per_row, scenario.row_count, self._dt
        )
        self._records = (
            self._ticks.record, self._stepper.record, self._planned, *self._recorder.row_address_records(data),
            *(self.station.memory_records if self.station else ()),
        )  # fmt: skip
        self._begin = 0.0
        self.tick = 0

    @property
    def time(self) -> float:
        """Simulated time at the next tick [s]."""
        return self.tick / self.scenario.control_rate

    def advance(self, n_ticks: int = 1) -> None:
        """Simulate control ticks.

        Args:
            n_ticks: number of ticks.

        Raises:
            SimulationFailed: states became infinite or not a number.
        """
        end = self.tick + n_ticks
        while self.tick < end:
            self._run_ticks(end)
            if not self._begin:
                self._begin = clock.perf_counter()

    def _run_ticks(self, end: int) -> None:
        """Run control ticks in compiled code up to tick `end`, or up to a tick at which Python must act.

        Python acts if surroundings change, sensor readings must be recorded, or the operator
        station must be prepared or checked. The current tick is advanced by at least one.
        """
        first, station, stepper = self.tick, self.station, self._stepper
        if self._around.needs_update or not first:
            end = first + 1
        if stepper.has_delayed_sensors:
            row, left = divmod(first, self.ticks_per_row)
            end = min(end, first + self.ticks_per_row - left)
            if not left and row < len(self._recorder.late):
                self._recorder.record_sensor_values(row, stepper.sensor_values())
        if self._policy:
            end = min(end, self._policy.prepare_tick(first))
        if station is None:
            self.tick = run_planned_ticks(*self._records, first, end, False)
        else:
            station.prepare_tick(first)
            end = min(end, station.next_prepared_tick(first))
            self.tick = run_teleoperated_ticks(*self._records, first, end, station.valves_closed)
        if self.tick < 0:
            raise self._recorder.instability_error((-1 - self.tick) // self.ticks_per_row)
        if station and self.tick < end:
            stopped = station.run_safety_checks(self.tick)
            step_planned_run(stepper.record, self._planned, self.tick, stepper.steps, stopped)
            update_max_pin_opening(self._ticks.record)
            self.tick += 1
        stepper.tick = self.tick
        if self._around.needs_update:
            row, left = divmod(first, self.ticks_per_row)
            if not left and row < len(self._recorder.contact):
                self._recorder.contact[row, 0] += self._around.soil_force
                self._recorder.load[row] = self._around.soil_load
            self._around.update(first * self._dt, self.data, self._dt)

    def set_command(self, axis: str, value: float) -> None:
        """Set the command of an axis that the joystick does not move, from the next tick on.

        Args:
            axis: name of the axis; a button of the scenario must refer to it.
            value: the command [1], or in the unit of the drive.
        """
        self._plan.command[self.tick :, self.plant.axes.index(axis)] = value

    def set_commands(self, values: np.ndarray, n_ticks: int) -> None:
        """Set the commands of all axes for the next ticks; each axis must have no reference.

        Args:
            values: (nu,) commands [1], or in the units of the drives.
            n_ticks: number of ticks.
        """
        self._plan.command[self.tick : self.tick + n_ticks] = values

    def commands_at(self, tick: int) -> np.ndarray:
        """Return the commands (nu,) of a past tick [1], or in the units of the drives."""
        return self._commands[tick]

    @property
    def events(self) -> list[tuple[float, str]]:
        """Events in the surroundings so far: (time [s], description)."""
        return self._around.events

    def finish(self) -> SessionResult:
        """Stop the run and return its result; an incomplete last log row is left out of the record.

        Raises:
            InputError: the run has fewer than the ten rows that a log needs.
        """
        wall = clock.perf_counter() - self._begin
        self._around.restore_model()
        rows = min(self.tick // self.ticks_per_row, self.scenario.row_count)
        if rows < 10:
            message = f"stopped after {self.time:.2f} s: too short for a log, nothing is written"
            raise InputError(self.scenario.name, message)
        whole = self._commands[: rows * self.ticks_per_row].reshape(rows, self.ticks_per_row, -1)
        self._recorder.command[:rows] = whole.mean(axis=1)
        station, plan = self.station, self._plan
        if self.tick < self.scenario.tick_count:
            plan = _cut_plan(plan, self.tick)
            if station:
                station.log.truncate(self.tick)
        record = self._recorder.to_record(rows)
        commands = self._commands[: self.tick]
        events = tuple(self._around.events)
        opening = float(self._ticks.max_pin_opening[0])
        return SessionResult(plan, record, commands, opening, wall, station, events, self._around.soil)


def _cut_plan(plan: Plan, ticks: int) -> Plan:
    pose = None if plan.pose is None else plan.pose[:ticks]
    goal, rate = (None if array is None else array[:ticks] for array in (plan.goal, plan.goal_rate))
    return dataclasses.replace(
        plan, time=plan.time[:ticks], command=plan.command[:ticks],
        reference=plan.reference[:ticks], rate=plan.rate[:ticks], pose=pose, goal=goal, goal_rate=rate,
    )  # fmt: skip

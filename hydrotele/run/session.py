"""A run under way: by control ticks, for as long as whoever drives it wants.

Everything a tick writes has room for the scenario's whole duration; a run that ends earlier is cut
to the rows that it has.
"""

import dataclasses
import time as clock
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.control.feedforward import force_references
from hydrotele.control.plan import Plan
from hydrotele.control.servo import drive_references, servo_parameters
from hydrotele.control.tick import Controller, Planned, planned_record, planned_tick
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.run.ticks import look_at_pins, planned_ticks, teleoperated_ticks, ticks_of
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.audit import full_state
from hydrotele.simulate.feedback import Feedback
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record, Recorder, begin_leapfrog
from hydrotele.simulate.stepping import Stepper
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.teleop.operator_model import Hand
from hydrotele.teleop.station import Station


class PreparedRun(NamedTuple):
    """A scenario before its first step."""

    plant: Plant
    data: mujoco.MjData
    plan: Plan
    seen: Feedback


class SessionResult(NamedTuple):
    """What the ticks leave.

    Attributes:
        plan: what was asked of every axis.
        record: states at the log's rows.
        commands: (n, nu) by control tick.
        pins: largest pin opening [m].
        wall: time [s] from the second control tick on, since the first one loads compiled code.
        station: the operator's, of a teleoperated run.
        events: (time [s], what happened around the machine).
    """

    plan: Plan
    record: Record
    commands: np.ndarray
    pins: float
    wall: float
    station: Station | None
    events: tuple[tuple[float, str], ...]


class Session:
    """A scenario that is being run.

    Attributes:
        plant: what is simulated.
        data: its state; staggered, see `simulate.record`.
        scenario: what was asked.
        seen: what the machine's sensors say.
        station: the operator's, of a teleoperated run.
        start: full physics state before the first tick.
        before: (nu,) commands in force before the first tick.
        tick: number of the next control tick.
        every: control ticks per row of the logs.
    """

    def __init__(
        self, prepared: PreparedRun, scenario: Scenario, nominal: Machine, hand: Hand | None = None
    ) -> None:
        """Make room for the whole run.

        Args:
            prepared: of the scenario.
            scenario: what is asked.
            nominal: its machine without planted effects.
            hand: where a live operator wants the handle.

        Raises:
            InputError: servo, forces or station do not suit the machine.
        """
        plant, data, plan, seen = prepared
        plan = dataclasses.replace(
            plan, reference=np.ascontiguousarray(plan.reference, float),
            rate=np.ascontiguousarray(plan.rate, float),
            command=np.ascontiguousarray(plan.command, float),
        )  # fmt: skip
        begin_leapfrog(plant.model, data)
        self.plant, self.data, self.seen, self.scenario = plant, data, seen, scenario
        self.start, self.before = full_state(plant.model, data), np.array(data.ctrl)
        self._plan, self._dt = plan, 1.0 / scenario.control_rate
        self.every = round(scenario.control_rate / scenario.log_rate)
        parameters = servo_parameters(plant.machine, plant.axes, scenario.servo, self._dt)
        drives = drive_references(plant.machine, plan, scenario.servo)
        drives = drives._make(map(np.ascontiguousarray, drives))
        forces = force_references(nominal, plan, scenario.servo)
        k, ticks = len(plant.axes), scenario.ticks
        self._recorder = Recorder(plant, scenario.rows)
        self._stepper = Stepper(plant, data, round(self._dt / scenario.timestep))
        self.seen.update(0, self._stepper)
        load = parameters[:, 1] * seen.head - parameters[:, 2] * seen.rod - forces.force[0]
        self._commands = np.zeros((ticks, k))
        self._run = Planned(
            controller=Controller(parameters, plan.closed.astype(np.int64), load, np.zeros(k)),
            feedback=seen.table,
            drives=drives,
            forces=forces,
            reference=plan.reference,
            command=plan.command,
            given=self._commands,
        )
        self._planned = planned_record(self._run)
        self.station = None
        if isinstance(scenario.pilot, TeleopPilot):
            self.station = Station(plant, data, scenario, plan, drives, seen, hand)
        self._around = Surroundings(plant.machine, plant.model, scenario.surroundings)
        self._ticks = ticks_of(
            plant.model, data, self._stepper.steps, self.every, scenario.rows, self._dt
        )
        self._records = (
            self._ticks.record, self._stepper.record, self._planned, *self._recorder.records(data),
            *(self.station.records if self.station else ()),
        )  # fmt: skip
        self._begin = 0.0
        self.tick = 0

    @property
    def time(self) -> float:
        """Simulated time of the next tick [s]."""
        return self.tick / self.scenario.control_rate

    def advance(self, most: int = 1) -> None:
        """Go on by one control tick, and by those after it that need nothing but native code.

        Args:
            most: number of ticks to go on by at most.

        Raises:
            SimulationFailed: states became infinite or not a number.
        """
        end = self.tick + most
        while self.tick < end:
            self._go_on(end)
            if not self._begin:
                self._begin = clock.perf_counter()

    def _go_on(self, end: int) -> None:
        """Go on natively until Python has something to do, or until a tick."""
        first, station, stepper = self.tick, self.station, self._stepper
        if self._around.changes or not first:
            end = first + 1
        if stepper.late:
            row, left = divmod(first, self.every)
            end = min(end, first + self.every - left)
            if not left and row < len(self._recorder.late):
                self._recorder.show(row, stepper.shown())
        if station is None:
            self.tick = planned_ticks(*self._records, first, end, False)
        else:
            station.prepare(first)
            end = min(end, station.until(first))
            self.tick = teleoperated_ticks(*self._records, first, end, station.tripped)
        if self.tick < 0:
            raise self._recorder.failure((-1 - self.tick) // self.every)
        if station and self.tick < end:
            stopped = station.notice(self.tick)
            planned_tick(stepper.record, self._planned, self.tick, stepper.steps, stopped)
            look_at_pins(self._ticks.record)
            self.tick += 1
        stepper.tick = self.tick
        if self._around.changes:
            self._around.update(first * self._dt, self.data, self._dt)

    def set_command(self, axis: str, value: float) -> None:
        """Command an axis that the joystick does not move, from the next tick on.

        Args:
            axis: one that a button of the scenario names.
            value: the command [1], or in the drive's unit.
        """
        self._plan.command[self.tick :, self.plant.axes.index(axis)] = value

    def command_of(self, tick: int) -> np.ndarray:
        """Commands (nu,) of a tick that is over [1], or in the drives' units."""
        return self._commands[tick]

    @property
    def events(self) -> list[tuple[float, str]]:
        """What has happened around the machine: (time [s], sentence)."""
        return self._around.events

    def finish(self) -> SessionResult:
        """End the run here; everything is cut to its whole rows.

        Raises:
            InputError: there are fewer than the ten rows that a log needs.
        """
        wall = clock.perf_counter() - self._begin
        self._around.restore()
        rows = min(self.tick // self.every, self.scenario.rows)
        if rows < 10:
            message = f"ended after {self.time:.2f} s: too short for a log, nothing is written"
            raise InputError(self.scenario.name, message)
        whole = self._commands[: rows * self.every].reshape(rows, self.every, -1)
        self._recorder.command[:rows] = whole.mean(axis=1)
        station, plan = self.station, self._plan
        if self.tick < self.scenario.ticks:
            plan = _cut_plan(plan, self.tick)
            if station:
                station.log.cut(self.tick)
        record = self._recorder.record(rows)
        commands = self._commands[: self.tick]
        events = tuple(self._around.events)
        return SessionResult(
            plan, record, commands, float(self._ticks.widest[0]), wall, station, events
        )


def _cut_plan(plan: Plan, ticks: int) -> Plan:
    pose = None if plan.pose is None else plan.pose[:ticks]
    return dataclasses.replace(
        plan, time=plan.time[:ticks], command=plan.command[:ticks],
        reference=plan.reference[:ticks], rate=plan.rate[:ticks], pose=pose,
    )  # fmt: skip

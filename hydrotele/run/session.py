"""A run under way: by control ticks, for as long as whoever drives it wants.

Everything a tick writes has room for the scenario's whole duration; a run that ends earlier is cut
to the rows that it has. Ticks follow one another in native code while nothing else is to be done:
between two, Python would push machine and joystick out of the processor's caches, and a tick in
contact takes a fifth longer then, one of a bare plan an eighth.
"""

import dataclasses
import time as clock
from typing import NamedTuple

import mujoco
import numpy as np
from numba import boolean, int64, typeof

from hydrotele.control.feedforward import force_references
from hydrotele.control.plan import Plan
from hydrotele.control.servo import drive_references, servo_parameters
from hydrotele.control.tick import PLANNED, Controller, Planned, planned_record, planned_tick
from hydrotele.core.compiled import compile_elsewhere, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.audit import full_state
from hydrotele.simulate.closure import pin_sites, widest_pin
from hydrotele.simulate.feedback import Feedback
from hydrotele.simulate.joystick import FLOTOR
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import (
    CONTACTS,
    STATE_ROW,
    Record,
    Recorder,
    begin_leapfrog,
    take_row,
)
from hydrotele.simulate.stepping import SIMULATION, Stepper
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.teleop.operator_model import Hand
from hydrotele.teleop.round_trip import CHECKED, STATION, round_trip
from hydrotele.teleop.station import Station

TICKS = np.dtype(
    [(name, np.int64) for name in ("steps", "every", "rows", "sites", "pins")]
    + [("period", np.float64)]
    + [(name, np.int64) for name in ("places", "one", "two", "widest")],  # addresses
    align=True,
)
"""Record of Ticks."""


class Ticks(NamedTuple):
    """What native ticks need beside machine, plan and station.

    Attributes:
        record: (1,) for native code.
        widest: (1,) largest opening of a pin so far [m].
        kept: arrays whose addresses the record has.
    """

    record: np.ndarray
    widest: np.ndarray
    kept: dict[str, np.ndarray]


def ticks_of(
    model: mujoco.MjModel, data: mujoco.MjData, steps: int, every: int, rows: int, period: float
) -> Ticks:  # fmt: skip
    """Prepare the ticks of a run.

    Args:
        model: the plant's.
        data: its state.
        steps: physics steps per tick.
        every: ticks per row of the logs.
        rows: number of rows.
        period: of a tick [s].
    """
    one, two = pin_sites(model)
    widest = np.zeros(1)
    kept = {"places": data.site_xpos, "one": one.astype(np.int64), "two": two.astype(np.int64),
            "widest": widest}  # fmt: skip
    record = address_record(TICKS, kept)
    for name, value in {"steps": steps, "every": every, "rows": rows, "period": period,
                        "sites": model.nsite, "pins": len(one)}.items():  # fmt: skip
        record[name] = value
    return Ticks(record, widest, kept)


@compiled
def planned_ticks(ticks, simulated, planned, row, contacts, first, last, stopped):
    """Go on along a plan.

    Args:
        ticks: `Ticks.record`, written.
        simulated: record of `simulate.stepping.simulation_record`.
        planned: record of `control.tick.planned_record`.
        row: record of a `Recorder`.
        contacts: record of `simulate.record.contact_record`.
        first: control tick, scalar.
        last: the one before which to stop, scalar.
        stopped: whether all commands are 0, scalar.

    Returns:
        The tick to go on with, scalar: `last`; or -1 less the one whose row is not finite.

    Source: `control.tick`.
    """
    for tick in range(first, last):
        if not _write_down(ticks[0], row, contacts, tick):
            return -1 - tick
        planned_tick(simulated, planned, tick, ticks[0].steps, stopped)
        look_at_pins(ticks)
    return last


@compiled
def teleoperated_ticks(
    ticks, simulated, planned, row, contacts, station, flotor, first, last, stopped
):  # fmt: skip
    """Go on with a station; stop before the physics of a tick at which it is to be looked at.

    Args:
        ticks: see `planned_ticks`, written.
        simulated: see `planned_ticks`.
        planned: see `planned_ticks`.
        row: see `planned_ticks`.
        contacts: see `planned_ticks`.
        station: see `teleop.round_trip`.
        flotor: see `teleop.round_trip`.
        first: control tick, prepared, scalar.
        last: the one before which to stop, scalar.
        stopped: whether the machine has been stopped for good, scalar.

    Returns:
        The tick to go on with, scalar: `last`, or the one whose physics is left to do; or -1 less
        the one whose row is not finite.

    Source: `control.tick`, `teleop.round_trip`.
    """
    for tick in range(first, last):
        if not _write_down(ticks[0], row, contacts, tick):
            return -1 - tick
        if round_trip(station, flotor, tick, stopped) or tick % CHECKED == 0:
            return tick
        planned_tick(simulated, planned, tick, ticks[0].steps, stopped)
        look_at_pins(ticks)
    return last


@compiled
def _write_down(r, row, contacts, tick):
    """Write the row that is due at a tick, if one is; whether all is well."""
    if tick % r.every != 0 or tick // r.every >= r.rows:
        return True
    return take_row(row, contacts, tick // r.every, tick * r.period)


@compiled
def look_at_pins(ticks):
    """Keep how far the pins have opened.

    Args:
        ticks: `Ticks.record`.

    Returns:
        Nothing.

    Source: `simulate.closure`.
    """
    r = ticks[0]
    widest, places = floats(r.widest, 1), rows_of(r.places, r.sites, 3)
    one, two = integers(r.one, r.pins), integers(r.two, r.pins)
    widest[0] = max(widest[0], widest_pin(places, one, two))


def compile_ahead() -> None:
    """Begin to compile what a teleoperated run calls, in a process beside this one."""
    compile_elsewhere(teleoperated_ticks, f"from {__name__} import compile_ticks; compile_ticks()")


def compile_ticks() -> None:
    """Compile what a teleoperated run calls."""
    records = TICKS, SIMULATION, PLANNED, STATE_ROW, CONTACTS, STATION, FLOTOR
    arguments = *(typeof(np.zeros(1, kind)) for kind in records), int64, int64, boolean
    teleoperated_ticks.compile(arguments)


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

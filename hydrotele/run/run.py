"""Simulate a scenario and return the `measured` log, the `truth` log and a summary.

`run_scenario` does a whole run; a `Session` advances by control ticks for interactive use. All
arrays are allocated for the full duration of the scenario and cut if the run stops earlier.

Consecutive ticks run in compiled code. Returning to Python between two ticks evicts machine and
joystick data from the processor caches, and makes a tick 12 to 20 % slower.
"""

import dataclasses
import functools
import json
import subprocess
import time as clock
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import boolean, int64, typeof

import hydrotele
from hydrotele.control.feedforward import compute_force_references
from hydrotele.control.plan import Plan, make_plan
from hydrotele.control.resolved_motion import pose_to_joints
from hydrotele.control.servo import compute_drive_references, servo_parameters
from hydrotele.control.tick import (
    PLANNED_RUN_DTYPE,
    Controller,
    PlannedRun,
    planned_run_record,
    step_planned_run,
)
from hydrotele.core.compiled import compile_in_background, compiled
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.effects import apply_effect
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.scenario import Scenario, find_local_machine
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.audit import compute_balance_errors, full_physics_state
from hydrotele.simulate.closure import max_pin_opening, pin_sites
from hydrotele.simulate.feedback import Feedback, create_feedback, simulate_readings
from hydrotele.simulate.joystick import FLOTOR_DTYPE
from hydrotele.simulate.mechanism import axes_with_transmission
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.record import (
    CONTACTS_DTYPE,
    STATE_ROW_DTYPE,
    Record,
    Recorder,
    delayed_channels,
    record_row,
    start_leapfrog,
    true_channels,
)
from hydrotele.simulate.soil_bed import SoilBed
from hydrotele.simulate.stepping import SIMULATION_DTYPE, Stepper, delayed_commands
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.teleop.operator_model import HandInput
from hydrotele.teleop.round_trip import STATION_DTYPE, TICKS_PER_CHECK, step_teleoperation
from hydrotele.teleop.station import TeleoperationLog, TeleoperationSystem

TICK_LOOP_RECORD = np.dtype(
    [(name, np.int64) for name in ("steps", "every", "rows", "sites", "pins")]
    + [("period", np.float64)]
    + [(name, np.int64) for name in ("places", "one", "two", "widest")],  # addresses
    align=True,
)
"""Record type of the compiled tick loop; see `make_tick_loop`."""


class TickLoop(NamedTuple):
    """Settings and memory of the compiled loop over control ticks, passed to it as one record.

    Attributes:
        record: (1,) record of type `TICK_LOOP_RECORD`.
        max_pin_opening: (1,) largest gap between the two points of a pin so far [m].
        referenced_arrays: arrays whose addresses are in the record; kept alive here.
    """

    record: np.ndarray
    max_pin_opening: np.ndarray
    referenced_arrays: dict[str, np.ndarray]


def make_tick_loop(
    model: mujoco.MjModel, data: mujoco.MjData, steps: int, every: int, rows: int, period: float
) -> TickLoop:  # fmt: skip
    """Create the record that the compiled loop over control ticks needs.

    Args:
        model: MuJoCo model of the plant.
        data: MuJoCo data of the plant.
        steps: physics steps per tick.
        every: ticks per log row.
        rows: number of log rows.
        period: duration of a tick [s].
    """
    one, two = pin_sites(model)
    widest = np.zeros(1)
    kept = {"places": data.site_xpos, "one": one.astype(np.int64), "two": two.astype(np.int64),
            "widest": widest}  # fmt: skip
    record = address_record(TICK_LOOP_RECORD, kept)
    for name, value in {"steps": steps, "every": every, "rows": rows, "period": period,
                        "sites": model.nsite, "pins": len(one)}.items():  # fmt: skip
        record[name] = value
    return TickLoop(record, widest, kept)


@compiled
def run_planned_ticks(ticks, simulated, planned, row, contacts, first, last, stopped):
    """Simulate control ticks of a run in which the motion of all axes is planned.

    Args:
        ticks: `TickLoop.record`, modified.
        simulated: record of the machine, from `simulate.stepping.simulation_record`.
        planned: record of plan and controller, from `control.tick.planned_run_record`.
        row: record of the log rows, from a `Recorder`.
        contacts: record of contact forces, from `simulate.record.make_contact_addresses`.
        first: number of the first control tick, scalar.
        last: number of the control tick before which to stop, scalar.
        stopped: whether all commands are set to 0, scalar.

    Returns:
        The next tick, scalar: `last`; or -1 - k if the log row of tick k contains values that are not
        finite, because the simulation is unstable.

    Source: `control.tick`.
    """
    for tick in range(first, last):
        if not _record_row(ticks[0], row, contacts, tick):
            return -1 - tick
        step_planned_run(simulated, planned, tick, ticks[0].steps, stopped)
        update_max_pin_opening(ticks)
    return last


@compiled
def run_teleoperated_ticks(
    ticks, simulated, planned, row, contacts, station, flotor, first, last, stopped
):  # fmt: skip
    """Simulate control ticks of a run in which an operator moves the machine with a joystick.

    The loop stops before the physics of a tick at which Python must process the operator station, for
    example to check its safety conditions.

    Args:
        ticks: `TickLoop.record`, modified.
        simulated: record of the machine, as for `run_planned_ticks`.
        planned: record of plan and controller, as for `run_planned_ticks`.
        row: record of the log rows, as for `run_planned_ticks`.
        contacts: record of contact forces, as for `run_planned_ticks`.
        station: record of the operator station, see `teleop.round_trip`.
        flotor: record of the moving part of the joystick, see `teleop.round_trip`.
        first: first control tick, already prepared by the station, scalar.
        last: control tick before which to stop, scalar.
        stopped: whether the machine has been stopped permanently, scalar.

    Returns:
        The next tick, scalar: `last`, or the tick whose physics is still to be done; or -1 - k if
        the log row of tick k is not finite.

    Source: `control.tick`, `teleop.round_trip`.
    """
    for tick in range(first, last):
        if not _record_row(ticks[0], row, contacts, tick):
            return -1 - tick
        if step_teleoperation(station, flotor, tick, stopped) or tick % TICKS_PER_CHECK == 0:
            return tick
        step_planned_run(simulated, planned, tick, ticks[0].steps, stopped)
        update_max_pin_opening(ticks)
    return last


@compiled
def _record_row(r, row, contacts, tick):
    """Write the log row of a control tick, if one is due.

    Returns:
        False if the row contains a value that is not finite, otherwise True.
    """
    if tick % r.every != 0 or tick // r.every >= r.rows:
        return True
    return record_row(row, contacts, tick // r.every, tick * r.period)


@compiled
def update_max_pin_opening(ticks):
    """Update the largest pin opening of the run by that of the present state.

    A pin joins two links of a closed kinematic loop; its opening is the distance of the two points.

    Args:
        ticks: `TickLoop.record`, modified.

    Returns:
        Nothing.

    Source: `simulate.closure`.
    """
    r = ticks[0]
    widest, places = float64_view(r.widest, 1), matrix_view(r.places, r.sites, 3)
    one, two = int64_view(r.one, r.pins), int64_view(r.two, r.pins)
    widest[0] = max(widest[0], max_pin_opening(places, one, two))


def start_background_compilation() -> None:
    """Start to compile the tick loop of a teleoperated run in a separate process."""
    name = compile_tick_loop.__name__
    compile_in_background(run_teleoperated_ticks, f"from {__name__} import {name}; {name}()")


def compile_tick_loop() -> None:
    """Compile the tick loop of a teleoperated run."""
    records = (
        TICK_LOOP_RECORD,
        SIMULATION_DTYPE,
        PLANNED_RUN_DTYPE,
        STATE_ROW_DTYPE,
        CONTACTS_DTYPE,
        STATION_DTYPE,
        FLOTOR_DTYPE,
    )
    arguments = *(typeof(np.zeros(1, kind)) for kind in records), int64, int64, boolean
    run_teleoperated_ticks.compile(arguments)


class PreparedRun(NamedTuple):
    """A machine, its initial state and a plan: all that a scenario needs for its first step.

    Attributes:
        plant: the simulated machine.
        data: its MuJoCo data in the initial state.
        plan: references and commands of the axes over time.
        sensor_feedback: simulated sensor readings that the controller uses.
    """

    plant: Plant
    data: mujoco.MjData
    plan: Plan
    sensor_feedback: Feedback


class SessionResult(NamedTuple):
    """Result of the simulated ticks of a session.

    Attributes:
        plan: reference and commands of every axis.
        record: states at the log rows.
        commands: (n, nu) commands by control tick.
        max_pin_opening: largest pin opening [m].
        computing_seconds: computing time [s] without the first tick, which loads compiled code.
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
        sensor_feedback: sensor feedback of the controller.
        station: operator station of a teleoperated run, otherwise None.
        initial_physics_state: full physics state before the first tick.
        initial_commands: (nu,) commands before the first tick.
        tick: number of the next control tick.
        ticks_per_row: control ticks per log row.
    """

    def __init__(
        self,
        prepared: PreparedRun,
        scenario: Scenario,
        nominal: Machine,
        hand: HandInput | None = None,
    ) -> None:
        """Allocate the arrays of the whole run and prepare the first tick.

        Args:
            prepared: machine, initial state and plan.
            scenario: the scenario.
            nominal: machine of the scenario without the effects that are hidden from the controller.
            hand: function that returns a live operator's reference position of the handle.

        Raises:
            InputError: servo, force model or station do not fit the machine.
        """
        plant, data, plan, seen = prepared
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
        forces = compute_force_references(nominal, plan, scenario.servo)
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
        """Run control ticks in compiled code up to tick `end` or to one at which Python must act.

        Python acts if surroundings change, sensor readings must be recorded, or the operator station needs
        it. The current tick is advanced by at least one.
        """
        first, station, stepper = self.tick, self.station, self._stepper
        if self._around.needs_update or not first:
            end = first + 1
        if stepper.has_delayed_sensors:
            row, left = divmod(first, self.ticks_per_row)
            end = min(end, first + self.ticks_per_row - left)
            if not left and row < len(self._recorder.late):
                self._recorder.record_sensor_values(row, stepper.sensor_values())
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
            self._around.update(first * self._dt, self.data, self._dt)

    def set_command(self, axis: str, value: float) -> None:
        """Set the command of an axis without a joystick axis, from the next tick on.

        Args:
            axis: name of the axis; a button of the scenario must refer to it.
            value: the command [1], or in the unit of the drive.
        """
        self._plan.command[self.tick :, self.plant.axes.index(axis)] = value

    def commands_at(self, tick: int) -> np.ndarray:
        """Return the commands (nu,) of a past tick [1], or in the units of the drives."""
        return self._commands[tick]

    @property
    def events(self) -> list[tuple[float, str]]:
        """Events in the surroundings so far: (time [s], description)."""
        return self._around.events

    def finish(self) -> SessionResult:
        """Stop the run and return its result, without an incomplete last log row.

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
    return dataclasses.replace(
        plan, time=plan.time[:ticks], command=plan.command[:ticks],
        reference=plan.reference[:ticks], rate=plan.rate[:ticks], pose=pose,
    )  # fmt: skip


_MIN_PRESSURE = -1.0e5  # Pa relative to the atmosphere, the lowest physically possible pressure


def summarise(
    plant: Plant,
    scenario: Scenario,
    plan: Plan,
    record: Record,
    max_pin_opening: float,
    computing_seconds: float,
) -> dict[str, Any]:
    """Return the content of `summary.json`, without the flow and energy balances.

    Args:
        plant: the simulated machine.
        scenario: the scenario.
        plan: reference and commands of every axis.
        record: states at the log rows.
        max_pin_opening: largest pin opening at a control tick [m].
        computing_seconds: computing time of the tick loop [s].

    Returns:
        Numbers and texts; units are part of the keys, or given by `unit`.
    """
    return {
        "kind": "run",
        "scenario": scenario.name,
        "machine": plant.machine.name,
        "tool": plant.machine.tool,
        "seed": scenario.seed,
        "effects": [planted.model_dump() for planted in scenario.effects],
        "simulated_seconds": scenario.duration,
        "wall_seconds": round(computing_seconds, 4),
        "realtime_factor": round(scenario.duration / computing_seconds, 1),
        "physics_steps": round(scenario.duration / scenario.timestep),
        "max_pin_opening_mm": max_pin_opening * 1e3,
        "notes": [*plan.notes, *_find_impossible_states(plant, record)],
        "max_contact_force_N": float(np.linalg.norm(record.contact, axis=1).max()),
        "tracking": _tracking_errors(plant, plan, record),
        "versions": dict(_package_versions()),
        "git_commit": _git_commit(),
    }


def _find_impossible_states(plant: Plant, record: Record) -> list[str]:
    """Return a warning if a chamber pressure falls below absolute vacuum in a run, otherwise an empty list."""
    if not plant.hydraulic:
        return []
    act = record.act[:, : ACTIVATIONS_PER_AXIS * plant.hydraulic]
    pressures = act.reshape(len(record.time), -1, ACTIVATIONS_PER_AXIS)[:, :, 2:]
    lowest = pressures.min(initial=0.0)
    if lowest < _MIN_PRESSURE:
        return [
            f"a chamber pressure falls to {lowest / 1e6:.1f} MPa, which is physically impossible:"
            " check the parameters of the machine"
        ]
    return []


def _tracking_errors(plant: Plant, plan: Plan, record: Record) -> dict[str, Any]:
    """Return RMS and maximum of the tracking errors of a run, as name -> rms, max and unit.

    The errors are actual minus reference position of every closed-loop axis. If the plan gives a pose of
    the arm's tip, those of radius, height and attitude are included.
    """
    rows = np.searchsorted(plan.time, record.time - 1e-9)
    result: dict[str, Any] = {}
    for i, name in enumerate(plan.axes):
        if plan.closed_loop[i]:
            error = record.qpos[:, plant.qpos[i]] - plan.reference[rows, i]
            result[name] = _error_statistics(error, "rad" if plant.machine.position_kind(name) == "angle" else "m")
    if plan.pose is not None and record.tip.shape[1]:
        desired = plan.pose[rows]
        r = np.hypot(record.tip[:, 0], record.tip[:, 1]) - desired[:, 0]
        arm = plant.machine.arm
        joints = [j for j in (arm.boom, arm.stick, arm.tool) if j] if arm else []
        places = [plant.model.joint(j).qposadr[0] for j in joints]
        attitude = record.qpos[:, places].sum(axis=1) - desired[:, 3]
        z = record.tip[:, 2] - desired[:, 2]
        result["tip_r"], result["tip_z"] = _error_statistics(r, "m"), _error_statistics(z, "m")
        result["tip_attitude"] = _error_statistics(attitude, "rad")
    return result


def _error_statistics(error: np.ndarray, unit: str) -> dict[str, Any]:
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return {"rms": rms, "max": largest, "unit": unit}


@functools.cache
def _package_versions() -> dict[str, str]:
    names = ("mujoco", "dm-control", "numpy", "scipy", "numba", "pyarrow", "rerun-sdk")
    return {"hydrotele": hydrotele.__version__, **{n: version(n) for n in names}}


def _git_commit() -> str | None:
    """Return the git commit of this installation, with `+` for local changes; None without git."""
    folder = Path(hydrotele.__file__).parent.parent
    if not (folder / ".git").exists():
        return None
    git = ["git", "-C", str(folder)]
    how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 5}
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], **how)
        dirty = subprocess.run([*git, "status", "--porcelain", "-uno"], **how)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return head.stdout.strip() + ("+" if dirty.stdout.strip() else "") or None


AUDIT_SECONDS = 5.0
_PROGRESS_ROWS = 50
_MAX_INITIAL_PENETRATION = 0.05  # m: contact is compliant, so a resting tool penetrates the ground a little
Progress = Callable[[float, float], None]


@dataclasses.dataclass(frozen=True)
class Run:
    """Result of a simulated run.

    Attributes:
        scenario: the scenario.
        plant: the simulated machine, including the planted effects.
        plan: reference and commands of every axis.
        measured: log of the sensor readings.
        truth: log of the true values, with `initial_state` in its metadata.
        summary: versions, speed, pin openings, balances, tracking errors.
        station: operator station of a teleoperated run, otherwise None.
    """

    scenario: Scenario
    plant: Plant
    plan: Plan
    measured: Log
    truth: Log
    summary: dict[str, Any]
    station: TeleoperationSystem | None = None

    def __repr__(self) -> str:
        """Return scenario, machine and duration of the run."""
        machine = f"machine={self.plant.machine.name!r}, tool={self.plant.machine.tool!r}"
        return f"Run({self.scenario.name!r}, {machine}, {self.measured.time[-1]:g} s)"


def load_nominal_machine(scenario: Scenario) -> Machine:
    """Load the machine of a scenario as its controller knows it, without the scenario's effects.

    Raises:
        InputError: unknown machine or tool.
    """
    return load_machine(find_local_machine(scenario) or scenario.machine, scenario.tool)


def load_simulated_machine(scenario: Scenario) -> Machine:
    """Load the machine of a scenario with the effects that the scenario adds to it.

    Raises:
        InputError: unknown machine, tool, effect or location.
    """
    machine = load_nominal_machine(scenario)
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return machine


def prepare_run(scenario: Scenario) -> PreparedRun:
    """Build the simulated machine of a scenario, set its initial state and plan the run.

    Raises:
        InputError: the scenario does not fit the machine.
    """
    machine = load_simulated_machine(scenario)
    sensors = get_sensor_set(machine, scenario.sensors)
    plant = build_plant(machine, scenario.timestep, scenario.ground, scenario.surroundings)
    data, start = _initial_data(plant, scenario)
    times = np.arange(scenario.tick_count) / scenario.control_rate
    plan = make_plan(machine, plant.axes, scenario.pilot, start, times)
    seen = create_feedback(plant, sensors, scenario.seed, scenario.tick_count, scenario.control_rate)
    if sensors and round(scenario.control_rate / scenario.log_rate) % seen.ticks_per_sample:
        message = f"the sample rate {sensors.rate:g} Hz must be a multiple of log_rate {scenario.log_rate:g} Hz"
        raise InputError(f"sensors {scenario.sensors}", message)
    return PreparedRun(plant, data, plan, seen)


def run_scenario(scenario: Scenario, progress: Progress | None = None) -> Run:
    """Simulate a scenario from start to end.

    Args:
        scenario: the scenario.
        progress: called periodically with (simulated seconds, total seconds).

    Returns:
        The run.

    Raises:
        InputError: the scenario does not fit the machine.
        SimulationFailed: states became infinite or not a number.
    """
    session = start_session(scenario)
    stride = _PROGRESS_ROWS * session.ticks_per_row
    while session.tick < scenario.tick_count:
        if progress and session.tick % stride == 0:
            progress(session.time, scenario.duration)
        session.advance(min(stride - session.tick % stride, scenario.tick_count - session.tick))
    if progress:
        progress(scenario.duration, scenario.duration)
    return finish_run(session, scenario)


def start_session(scenario: Scenario, hand: HandInput | None = None) -> Session:
    """Prepare a scenario and return a session at its first tick.

    Args:
        scenario: the scenario.
        hand: function that returns a live operator's reference position of the handle.

    Raises:
        InputError: the scenario does not fit the machine.
    """
    if isinstance(scenario.pilot, TeleopPilot):
        start_background_compilation()
    return Session(prepare_run(scenario), scenario, load_nominal_machine(scenario), hand)


def finish_run(session: Session, scenario: Scenario) -> Run:
    """Stop a session and return its run with logs, summary and balances.

    Args:
        session: the session after its last tick.
        scenario: the scenario, with the duration that was simulated.

    Raises:
        InputError: the run is too short for a log.
    """
    looped, plant = session.finish(), session.plant
    plan, record = looped.plan, looped.record
    truth, measured = _make_logs(plant, scenario, record, session.sensor_feedback)
    summary = summarise(plant, scenario, plan, record, looped.max_pin_opening, looped.computing_seconds)
    if looped.station:
        measured = _add_station_channels(measured, looped.station.log, scenario)
        truth = _add_station_channels(truth, looped.station.log, scenario)
        summary["teleoperation"] = looped.station.summary()
        summary["notes"] += looped.station.notes
    summary["notes"] += [f"{said} at {time:.2f} s" for time, said in looped.events]
    if looped.soil:
        summary["soil"] = {
            "carried_mass_kg": looped.soil.carried_mass,
            "trench_depth_m": max(0.0, -float(looped.soil.surface.min())),
        }
    steps = round(1.0 / (scenario.control_rate * scenario.timestep))
    window = looped.commands[: round(AUDIT_SECONDS * scenario.control_rate)]
    controls = delayed_commands(plant, session.initial_commands, window, steps)
    summary["balance"] = compute_balance_errors(plant, session.initial_physics_state, controls)
    if looped.soil:  # the audit simulates the machine without it
        summary["balance"]["energy_balance"] = None
    return Run(scenario, plant, plan, measured, truth, summary, looped.station)


def _add_station_channels(log: Log, station: TeleoperationLog, scenario: Scenario) -> Log:
    """Return a copy of a machine's log with the channels of the operator station added.

    Args:
        log: log of the machine.
        station: record of the operator station, by control tick.
        scenario: scenario with control rate and log rate.
    """
    every = round(scenario.control_rate / scenario.log_rate)
    columns, units = station.channels(every, scenario.row_count)
    return dataclasses.replace(log, columns={**log.columns, **columns}, units={**log.units, **units})


def _make_logs(plant: Plant, scenario: Scenario, record: Record, seen: Feedback) -> tuple[Log, Log]:
    """Return the log of the true values and the log of the sensor readings of a run.

    Args:
        plant: the simulated machine.
        scenario: the scenario.
        record: states at the log rows.
        seen: readings that the controller used; the second log has the same sensor errors.
    """
    machine = plant.machine
    values, units = true_channels(plant, record)
    truth = _make_log(scenario, machine, record.time, values, units, "ideal")
    state = json.dumps(_describe_initial_state(plant, record))
    things = json.dumps([thing.model_dump() for thing in scenario.surroundings])
    known = {"initial_state": state} | ({"surroundings": things} if scenario.surroundings else {})
    truth = dataclasses.replace(truth, metadata={**truth.metadata, **known})
    per_row = round(scenario.control_rate / scenario.log_rate) // seen.ticks_per_sample
    errors = {name: e[::per_row][: scenario.row_count] for name, e in seen.errors.items()}
    visible = {c: v for c, v in values.items() if not c.startswith(("truth.", "command."))}
    sensors = get_sensor_set(machine, scenario.sensors)
    readings = {c: v for c, v in values.items() if c.startswith("command.")}
    visible |= delayed_channels(plant, record)
    readings |= simulate_readings(machine, sensors, scenario.seed, visible, errors, 1.0 / scenario.log_rate)
    units = {c: units[c] for c in readings}
    return truth, _make_log(scenario, machine, record.time, readings, units, scenario.sensors)


def _initial_data(plant: Plant, scenario: Scenario) -> tuple[mujoco.MjData, dict[str, float]]:
    machine = plant.machine
    joints = {name: machine.home.get(name, 0.0) for name in machine.joints}
    for name, value in scenario.start.joints.items():
        if name not in joints:
            raise InputError(
                "start.joints",
                f"{name!r} is not a joint of the machine; {suggest_valid_name(name, joints)}",
            )
        joints[name] = value
    if scenario.start.pose:
        here = {a: joints[machine.axes[a].joint] for a in plant.axes}
        there = pose_to_joints(machine, scenario.start.pose, here, "start.pose")
        if twice := scenario.start.joints.keys() & {machine.axes[a].joint for a in there}:
            message = f"give either a pose or the joints {', '.join(sorted(twice))}, not both"
            raise InputError("start", message)
        joints |= {machine.axes[a].joint: value for a, value in there.items()}
    for name, joint in machine.joints.items():
        if joint.range and not joint.range[0] <= joints[name] <= joint.range[1]:
            low, high = joint.range
            raise InputError("start", f"{name} {joints[name]:.4g} is outside its range {low:.4g} .. {high:.4g}")
    data = rest_state(plant, joints)
    mujoco.mj_fwdPosition(plant.model, data)
    depth = -min((data.contact[k].dist for k in range(data.ncon)), default=0.0)
    if depth > _MAX_INITIAL_PENETRATION:
        things = "the ground or an object" if plant.surroundings else "the ground"
        raise InputError("start", f"the machine would penetrate {things} by {depth:.2f} m")
    return data, joints


def _make_log(scenario, machine, time, values, units, sensors: str) -> Log:
    metadata = {
        "machine": machine.name,
        "tool": machine.tool,
        "sample_rate_hz": f"{scenario.log_rate:g}",
        "sensors": sensors,
        "run": scenario.name,
        "seed": str(scenario.seed),
        "ground": "yes" if scenario.ground else "no",
        "hydrotele": hydrotele.__version__,
        "command": "held" if scenario.control_rate == scenario.log_rate else "mean over the row",
    }
    if things := [thing.kind for thing in scenario.surroundings if thing.kind != "soil"]:
        metadata["things"] = ", ".join(things)
    if soils := [thing for thing in scenario.surroundings if thing.kind == "soil"]:
        metadata["soil"] = soils[0].model_dump_json()
    return Log(time=time, columns=values, units=units, metadata=metadata, source=scenario.name)


def _describe_initial_state(plant: Plant, record: Record) -> dict[str, Any]:
    act = record.act[0, : ACTIVATIONS_PER_AXIS * plant.hydraulic].reshape(plant.hydraulic, ACTIVATIONS_PER_AXIS)
    keys = ("spool", "spool_rate", "pressure_head", "pressure_rod")
    driven = {axis.joint for axis in plant.machine.axes.values()}
    free = [n for n in plant.machine.joints if n not in driven]
    flexible = {n: plant.axes.index(n) for n in axes_with_transmission(plant.machine)}
    qpos, qvel = record.qpos[0], record.qvel[0]
    drives = {
        "drive": {n: float(qpos[plant.drive_qpos[i]]) for n, i in flexible.items()},
        "drive_velocity": {n: float(qvel[plant.drive_dof[i]]) for n, i in flexible.items()},
    }
    return {
        "order": list(plant.axes),
        "angle": record.qpos[0, plant.qpos].tolist(),
        "velocity": record.qvel[0, plant.dof].tolist(),
        **{key: act[:, column].tolist() for column, key in enumerate(keys)},
        "joints": {n: float(record.qpos[0, plant.model.joint(n).qposadr[0]]) for n in free},
        **(drives if flexible else {}),
        **_initial_internal_states(plant, record),
    }


def _initial_internal_states(plant: Plant, record: Record) -> dict[str, dict[str, float]]:
    """Return the states in addition to motion, spools and pressures at the first row of a run.

    They belong to friction before sliding, pump and added effects: kind -> owner -> value.
    """
    found: dict[str, dict[str, float]] = {}
    for name, place in plant.extra_states.items():
        kind, _, owner = name.partition(".")
        found.setdefault(kind, {})[owner] = float(record.act[0, place])
    return found

"""The one loop: a scenario runs, and two logs come out, `measured` and `truth`."""

import dataclasses
import json
import time as clock
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

import hydrotele
from hydrotele.datafile import suggest
from hydrotele.effects import apply_effect
from hydrotele.errors import InputError
from hydrotele.feedforward import force_references
from hydrotele.hydraulics.circuit import ACTIVATIONS
from hydrotele.log import Log
from hydrotele.machine import Machine
from hydrotele.machine_file import load_machine
from hydrotele.noise import sensor_set
from hydrotele.operate.plan import Plan, make_plan
from hydrotele.operate.resolved_motion import pose_to_joints
from hydrotele.operate.servo import drive_references, servo_numbers, servo_step
from hydrotele.scenario import Scenario, own_machine
from hydrotele.simulate.audit import audit, full_state
from hydrotele.simulate.closure import pin_opening
from hydrotele.simulate.drive_side import flexible_axes
from hydrotele.simulate.feedback import Feedback, feedback
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.readout import late_channels, true_channels
from hydrotele.simulate.record import Record, Recorder, begin_leapfrog
from hydrotele.simulate.sensors import measure
from hydrotele.simulate.stepping import DelayLine, Stepper
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.station import Station
from hydrotele.station_log import StationLog
from hydrotele.summary import summarise
from hydrotele.teleoperation import TeleopPilot

AUDIT_SECONDS = 5.0
_DEEPEST_START = 0.05  # m: contact is soft, so a tool may rest a little in the ground
Progress = Callable[[float, float], None]


@dataclasses.dataclass(frozen=True)
class Run:
    """Everything a run yields.

    Attributes:
        scenario: what was asked.
        plant: what was simulated; its machine has the planted effects.
        plan: what was asked of every axis.
        measured: what the sensors say.
        truth: what was true, with `initial_state` in its metadata.
        summary: versions, speed, pins, balances, tracking.
        station: the operator's, of a teleoperated run.
    """

    scenario: Scenario
    plant: Plant
    plan: Plan
    measured: Log
    truth: Log
    summary: dict[str, Any]
    station: Station | None = None


def scenario_model(scenario: Scenario) -> Machine:
    """The machine of a scenario as its model has it, without the planted effects.

    Raises:
        InputError: unknown machine or tool.
    """
    return load_machine(own_machine(scenario) or scenario.machine, scenario.tool)


def scenario_machine(scenario: Scenario) -> Machine:
    """The machine of a scenario that is simulated, with its planted effects.

    Raises:
        InputError: unknown machine, tool, effect or location.
    """
    machine = scenario_model(scenario)
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return machine


class Prepared(NamedTuple):
    """A scenario before its first step."""

    plant: Plant
    data: mujoco.MjData
    plan: Plan
    seen: Feedback


def prepare(scenario: Scenario) -> Prepared:
    """Compile the machine of a scenario, put it at its start and plan the run.

    Raises:
        InputError: the scenario asks for what the machine has not.
    """
    machine = scenario_machine(scenario)
    sensors = sensor_set(machine, scenario.sensors)
    plant = build_plant(machine, scenario.timestep, scenario.ground, scenario.surroundings)
    data, start = _start(plant, scenario)
    times = np.arange(scenario.ticks) / scenario.control_rate
    plan = make_plan(machine, plant.axes, scenario.pilot, start, times)
    seen = feedback(plant, sensors, scenario.seed, scenario.ticks, scenario.control_rate)
    if sensors and round(scenario.control_rate / scenario.log_rate) % seen.every:
        message = f"sample at {sensors.rate:g} Hz; log_rate {scenario.log_rate:g} Hz must divide it"
        raise InputError(f"sensors {scenario.sensors}", message)
    return Prepared(plant, data, plan, seen)


def run_scenario(scenario: Scenario, progress: Progress | None = None) -> Run:
    """Simulate a scenario.

    Args:
        scenario: the scenario.
        progress: called now and then with (simulated seconds, total seconds).

    Returns:
        The run.

    Raises:
        InputError: the scenario asks for what the machine has not.
        SimulationFailed: states became infinite or not a number.
    """
    prepared = prepare(scenario)
    plant, data, plan, seen = prepared
    begin_leapfrog(plant.model, data)
    begin, line = full_state(plant.model, data), DelayLine(plant, data.ctrl)
    looped = _loop(prepared, scenario, progress)
    record = looped.record
    truth, measured = _logs(plant, scenario, record, seen)
    summary = summarise(plant, scenario, plan, record, looped.pins, looped.wall)
    if looped.station:
        measured = _with_station(measured, looped.station.log, scenario)
        summary["teleoperation"] = looped.station.summary()
        summary["notes"] += looped.station.notes
    summary["notes"] += [f"{said} at {time:.2f} s" for time, said in looped.events]
    steps = round(1.0 / (scenario.control_rate * scenario.timestep))
    window = looped.commands[: round(AUDIT_SECONDS * scenario.control_rate)]
    controls = np.concatenate([line.controls(command, steps) for command in window])
    summary["balance"] = audit(plant, begin, controls)
    return Run(scenario, plant, plan, measured, truth, summary, looped.station)


def _with_station(measured: Log, station: StationLog, scenario: Scenario) -> Log:
    """The measured log with what the operator's station measured."""
    every = round(scenario.control_rate / scenario.log_rate)
    columns, units = station.channels(every, scenario.rows)
    return dataclasses.replace(
        measured, columns={**measured.columns, **columns}, units={**measured.units, **units}
    )


def _logs(plant: Plant, scenario: Scenario, record: Record, seen: Feedback) -> tuple[Log, Log]:
    """What was true and what the sensors say; the latter with the errors that were fed back."""
    machine = plant.machine
    values, units = true_channels(plant, record)
    truth = _log(scenario, machine, record.time, values, units, "ideal")
    state = json.dumps(_initial_state(plant, record))
    truth = dataclasses.replace(truth, metadata={**truth.metadata, "initial_state": state})
    per_row = round(scenario.control_rate / scenario.log_rate) // seen.every
    errors = {name: e[::per_row][: scenario.rows] for name, e in seen.errors.items()}
    visible = {c: v for c, v in values.items() if not c.startswith(("truth.", "command."))}
    sensors = sensor_set(machine, scenario.sensors)
    readings = {c: v for c, v in values.items() if c.startswith("command.")}
    visible |= late_channels(plant, record)
    readings |= measure(machine, sensors, scenario.seed, visible, errors)
    units = {c: units[c] for c in readings}
    return truth, _log(scenario, machine, record.time, readings, units, scenario.sensors)


def _start(plant: Plant, scenario: Scenario) -> tuple[mujoco.MjData, dict[str, float]]:
    machine = plant.machine
    joints = {name: machine.home.get(name, 0.0) for name in machine.joints}
    for name, value in scenario.start.joints.items():
        if name not in joints:
            raise InputError(
                "start.joints", f"{name!r} is no joint of the machine; {suggest(name, joints)}"
            )
        joints[name] = value
    if scenario.start.pose:
        here = {a: joints[machine.axes[a].joint] for a in plant.axes}
        there = pose_to_joints(machine, scenario.start.pose, here, "start.pose")
        if twice := scenario.start.joints.keys() & {machine.axes[a].joint for a in there}:
            raise InputError("start", f"{', '.join(sorted(twice))} follow from the pose; give one")
        joints |= {machine.axes[a].joint: value for a, value in there.items()}
    for name, joint in machine.joints.items():
        if joint.range and not joint.range[0] <= joints[name] <= joint.range[1]:
            low, high = joint.range
            raise InputError(
                "start", f"{name} {joints[name]:.4g} is outside its range {low:.4g} .. {high:.4g}"
            )
    data = rest_state(plant, joints)
    mujoco.mj_fwdPosition(plant.model, data)
    depth = -min((data.contact[k].dist for k in range(data.ncon)), default=0.0)
    if depth > _DEEPEST_START:
        raise InputError("start", f"the machine would stand {depth:.2f} m deep in the ground")
    return data, joints


class Looped(NamedTuple):
    """What the loop leaves.

    Attributes:
        record: states at the log's rows.
        commands: (n, nu) by control tick.
        pins: largest pin opening [m].
        wall: time [s] from the second control tick on, since the first one loads compiled code.
        station: the operator's, of a teleoperated run.
        events: (time [s], what happened around the machine).
    """

    record: Record
    commands: np.ndarray
    pins: float
    wall: float
    station: Station | None
    events: tuple[tuple[float, str], ...]


def _loop(prepared: Prepared, scenario: Scenario, progress: Progress | None) -> Looped:
    """Step through the run."""
    plant, data, plan, seen = prepared
    model, dt = plant.model, 1.0 / scenario.control_rate
    steps = round(dt / scenario.timestep)
    every = round(scenario.control_rate / scenario.log_rate)
    ticks, rows = scenario.ticks, scenario.rows
    numbers = servo_numbers(plant.machine, plant.axes, scenario.servo, dt)
    drives = drive_references(plant.machine, plan, scenario.servo)
    forces = force_references(scenario_model(scenario), plan, scenario.servo)
    k = len(plant.axes)
    load, command, commands = np.zeros(k), np.zeros(k), np.empty((ticks, k))
    recorder, stepper = Recorder(plant, rows), Stepper(plant, data, steps)
    station = _station(plant, scenario, plan, drives, seen)
    around = Surroundings(plant.machine, model, scenario.surroundings)
    worst, begin = 0.0, 0.0
    for tick in range(ticks):
        if tick % every == 0 and tick // every < rows:
            recorder.take(tick // every, tick * dt, data, stepper.past)
            if progress and tick % (every * 50) == 0:
                progress(tick * dt, scenario.duration)
        seen.update(tick, data, stepper.past)
        if tick == 0:
            load[:] = numbers[:, 1] * seen.head - numbers[:, 2] * seen.rod - forces.force[0]
        command[:] = plan.command[tick]
        tripped = station is not None and station.tick(tick, data, seen)
        servo_step(
            numbers, plan.closed, drives.velocity[tick], drives.arm[tick],
            drives.volume_head[tick], drives.volume_rod[tick],
            plan.reference[tick - tick % seen.every], seen.joint, seen.rate, seen.head, seen.rod,
            seen.supply, load, forces.known, forces.force[tick], forces.rate[tick], command,
        )  # fmt: skip
        if tripped:
            command[:] = 0.0
        commands[tick] = command
        begin = begin if tick else clock.perf_counter()
        stepper.advance(command)
        if scenario.surroundings:
            around.update(tick * dt, data, dt)
        worst = max(worst, pin_opening(model, data))
    recorder.command[:] = commands[: rows * every].reshape(rows, every, k).mean(axis=1)
    if progress:
        progress(scenario.duration, scenario.duration)
    around.restore()
    wall = clock.perf_counter() - begin
    return Looped(recorder.record(), commands, worst, wall, station, tuple(around.events))


def _station(plant: Plant, scenario: Scenario, plan: Plan, drives, seen: Feedback):
    """The operator's station of a teleoperated scenario, none of another."""
    if not isinstance(scenario.pilot, TeleopPilot):
        return None
    return Station(plant, scenario, plan, drives, seen)


def _log(scenario, machine, time, values, units, sensors: str) -> Log:
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
    return Log(time=time, columns=values, units=units, metadata=metadata, source=scenario.name)


def _initial_state(plant: Plant, record: Record) -> dict[str, Any]:
    act = record.act[0, : ACTIVATIONS * plant.hydraulic].reshape(plant.hydraulic, ACTIVATIONS)
    keys = ("spool", "spool_rate", "pressure_head", "pressure_rod")
    driven = {axis.joint for axis in plant.machine.axes.values()}
    free = [n for n in plant.machine.joints if n not in driven]
    flexible = {n: plant.axes.index(n) for n in flexible_axes(plant.machine)}
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
    }

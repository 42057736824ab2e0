"""The one loop: a scenario runs, and two logs come out, `measured` and `truth`."""

import dataclasses
import json
import subprocess
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

import hydrotele
from hydrotele.datafile import suggest
from hydrotele.effects import apply_effect
from hydrotele.errors import InputError
from hydrotele.hydraulics.circuit import ACTIVATIONS, circuit_scratch
from hydrotele.log import Log
from hydrotele.machine import Machine
from hydrotele.machine_file import load_machine
from hydrotele.operate.plan import Plan, make_plan
from hydrotele.operate.resolved_motion import pose_to_joints
from hydrotele.operate.servo import drive_references, servo_numbers, servo_step
from hydrotele.scenario import Scenario, own_machine
from hydrotele.simulate.audit import audit, full_state
from hydrotele.simulate.closure import pin_opening
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.readout import read_feedback, true_channels
from hydrotele.simulate.record import Record, Recorder, begin_leapfrog
from hydrotele.simulate.sensors import (
    channel_sensor,
    measure,
    sensor_errors,
    sensor_set,
)

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
    """

    scenario: Scenario
    plant: Plant
    plan: Plan
    measured: Log
    truth: Log
    summary: dict[str, Any]


def scenario_machine(scenario: Scenario) -> Machine:
    """The machine of a scenario, with its planted effects.

    Raises:
        InputError: unknown machine, tool, effect or location.
    """
    machine = load_machine(own_machine(scenario) or scenario.machine, scenario.tool)
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return machine


class Prepared(NamedTuple):
    """A scenario before its first step."""

    plant: Plant
    data: mujoco.MjData
    plan: Plan


def prepare(scenario: Scenario) -> Prepared:
    """Compile the machine of a scenario, put it at its start and plan the run.

    Raises:
        InputError: the scenario asks for what the machine has not.
    """
    machine = scenario_machine(scenario)
    sensor_set(machine, scenario.sensors)
    plant = build_plant(machine, scenario.timestep, scenario.ground)
    data, start = _start(plant, scenario)
    times = np.arange(scenario.ticks) / scenario.control_rate
    return Prepared(plant, data, make_plan(machine, plant.axes, scenario.pilot, start, times))


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
    plant, data, plan = prepare(scenario)
    machine = plant.machine
    begin_leapfrog(plant.model, data)
    begin = full_state(plant.model, data)
    record, commands, pins, wall = _loop(plant, scenario, plan, data, progress)
    values, units = true_channels(plant, record)
    truth = _log(scenario, machine, record.time, values, units, "ideal")
    state = json.dumps(_initial_state(plant, record))
    truth = dataclasses.replace(truth, metadata={**truth.metadata, "initial_state": state})
    sensors = sensor_set(machine, scenario.sensors)
    seen = {c: v for c, v in values.items() if not c.startswith(("truth.", "command."))}
    readings = measure(machine, sensors, scenario.seed, seen, _row_errors(plant, scenario))
    readings = {c: values[c] for c in values if c.startswith("command.")} | readings
    measured = _log(
        scenario, machine, record.time, readings, {c: units[c] for c in readings}, scenario.sensors
    )
    summary = _summary(plant, scenario, plan, record, pins, wall, data)
    steps = round(1.0 / (scenario.control_rate * scenario.timestep))
    window = np.repeat(commands[: round(AUDIT_SECONDS * scenario.control_rate)], steps, axis=0)
    summary["balance"] = audit(plant, begin, window)
    return Run(scenario, plant, plan, measured, truth, summary)


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


def _feedback_errors(plant: Plant, scenario: Scenario) -> dict[str, np.ndarray]:
    """Errors of the fed-back channels at every control tick; the log shows some of them."""
    sensors = sensor_set(plant.machine, scenario.sensors)
    names = [f"{plant.machine.position_kind(a)}.{a}" for a in plant.axes]
    for axis in plant.axes[: plant.hydraulic]:
        names += [f"pressure_head.{axis}", f"pressure_rod.{axis}"]
    if plant.hydraulic:
        names.append("pressure_supply")
    return {
        name: sensor_errors(
            channel_sensor(plant.machine, sensors, name), scenario.seed, name, scenario.ticks
        )
        for name in names
    }


def _row_errors(plant: Plant, scenario: Scenario) -> dict[str, np.ndarray]:
    every = round(scenario.control_rate / scenario.log_rate)
    return {k: v[::every][: scenario.rows] for k, v in _feedback_errors(plant, scenario).items()}


def _converter_steps(plant: Plant, scenario: Scenario, names: list[str]) -> np.ndarray:
    sensors = sensor_set(plant.machine, scenario.sensors)
    steps = []
    for name in names:
        sensor = channel_sensor(plant.machine, sensors, name)
        exact = not (sensor.bits and sensor.span)
        steps.append(0.0 if exact else sensor.span / 2.0**sensor.bits)  # type: ignore[operator]
    return np.array(steps)


def _loop(plant: Plant, scenario: Scenario, plan: Plan, data, progress: Progress | None):
    """Step through the run.

    Returns:
        (record, commands (n, nu), largest pin opening [m], wall time [s] from the second control
        tick on, since the first one loads compiled code).
    """
    model, dt = plant.model, 1.0 / scenario.control_rate
    steps = round(dt / scenario.timestep)
    every = round(scenario.control_rate / scenario.log_rate)
    ticks, rows, count = scenario.ticks, scenario.rows, plant.hydraulic
    numbers = servo_numbers(plant.machine, plant.axes, scenario.servo, dt)
    drives = drive_references(plant.machine, plan, scenario.servo)
    errors = _feedback_errors(plant, scenario)
    feedback = np.column_stack(list(errors.values()))
    grain = _converter_steps(plant, scenario, list(errors))
    user, scratch = model.actuator_user.ravel(), circuit_scratch()
    k = len(plant.axes)
    joint, last, load = np.empty(k), np.empty(k), np.zeros(k)
    head, rod = np.zeros(k), np.zeros(k)
    command, commands = np.zeros(k), np.empty((ticks, k))
    recorder = Recorder(plant, rows)
    qpos, qvel, act, ctrl = data.qpos, data.qvel, data.act, data.ctrl
    worst, begin = 0.0, 0.0
    for tick in range(ticks):
        if tick % every == 0 and tick // every < rows:
            recorder.take(tick // every, tick * dt, data)
            if progress and tick % (every * 50) == 0:
                progress(tick * dt, scenario.duration)
        supply = read_feedback(
            qpos - scenario.timestep * qvel, plant.qpos, act, user, count, feedback[tick], grain,
            joint, head, rod, scratch,
        )  # fmt: skip
        if tick == 0:
            last[:] = joint
            load[:] = numbers[:, 1] * head - numbers[:, 2] * rod
        command[:] = plan.command[tick]
        servo_step(
            numbers, plan.closed, drives.velocity[tick], drives.arm[tick],
            drives.volume_head[tick], drives.volume_rod[tick], plan.reference[tick], joint, last,
            head, rod, supply, dt, load, command,
        )  # fmt: skip
        ctrl[:] = command
        commands[tick] = command
        begin = begin if tick else clock.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        worst = max(worst, pin_opening(model, data))
    recorder.command[:] = commands[: rows * every].reshape(rows, every, k).mean(axis=1)
    if progress:
        progress(scenario.duration, scenario.duration)
    return recorder.record(), commands, worst, clock.perf_counter() - begin


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
    return {
        "order": list(plant.axes),
        "angle": record.qpos[0, plant.qpos].tolist(),
        "velocity": record.qvel[0, plant.dof].tolist(),
        **{key: act[:, column].tolist() for column, key in enumerate(keys)},
        "joints": {n: float(record.qpos[0, plant.model.joint(n).qposadr[0]]) for n in free},
    }


def _summary(plant, scenario, plan: Plan, record: Record, pins, wall, data) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "scenario": scenario.name,
        "machine": plant.machine.name,
        "tool": plant.machine.tool,
        "seed": scenario.seed,
        "simulated_seconds": scenario.duration,
        "wall_seconds": round(wall, 4),
        "realtime_factor": round(scenario.duration / wall, 1),
        "physics_steps": round(scenario.duration / scenario.timestep),
        "largest_pin_opening_mm": pins * 1e3,
        "warnings": int(data.warning.number.sum()),
        "notes": list(plan.notes),
        "largest_contact_force_N": float(np.linalg.norm(record.contact, axis=1).max()),
        "tracking": _tracking(plant, plan, record),
        "versions": _versions(),
        "git_commit": _git_commit(),
    }
    return summary


def _tracking(plant: Plant, plan: Plan, record: Record) -> dict[str, Any]:
    """Largest and RMS deviation of every followed axis, and of the tip from its desired pose."""
    rows = np.searchsorted(plan.time, record.time - 1e-9)
    result: dict[str, Any] = {}
    for i, name in enumerate(plan.axes):
        if plan.closed[i]:
            error = record.qpos[:, plant.qpos[i]] - plan.reference[rows, i]
            result[name] = _size(error)
    if plan.pose is not None and record.tip.shape[1]:
        desired = plan.pose[rows]
        r = np.hypot(record.tip[:, 0], record.tip[:, 1]) - desired[:, 0]
        arm = plant.machine.arm
        joints = [j for j in (arm.boom, arm.stick, arm.tool) if j] if arm else []
        places = [plant.model.joint(j).qposadr[0] for j in joints]
        attitude = record.qpos[:, places].sum(axis=1) - desired[:, 3]
        z = record.tip[:, 2] - desired[:, 2]
        errors = {"tip_r": r, "tip_z": z, "tip_attitude": attitude}
        result |= {name: _size(error) for name, error in errors.items()}
    return result


def _size(error: np.ndarray) -> dict[str, float]:
    return {"rms": float(np.sqrt(np.mean(error**2))), "max": float(np.abs(error).max())}


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    names = ("mujoco", "dm-control", "numpy", "scipy", "numba", "pyarrow", "rerun-sdk")
    return {"hydrotele": hydrotele.__version__, **{n: version(n) for n in names}}


def _git_commit() -> str | None:
    """Commit of the checkout that this package runs from, with `+` if it has changes."""
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

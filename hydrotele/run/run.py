"""The one loop: a scenario runs, and two logs come out, `measured` and `truth`.

Summary of a run: speed, pins, contact, tracking, and what produced it.
"""

import dataclasses
import functools
import json
import subprocess
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import hydrotele
from hydrotele.control.plan import Plan, make_plan
from hydrotele.control.resolved_motion import pose_to_joints
from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.effects import apply_effect
from hydrotele.hydraulics.circuit import ACTIVATIONS
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.signals import sensor_set
from hydrotele.run.session import PreparedRun, Session, compile_ahead
from hydrotele.scenario.scenario import Scenario, own_machine
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.audit import audit
from hydrotele.simulate.feedback import Feedback, feedback, measure
from hydrotele.simulate.mechanism import flexible_axes
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.record import Record, late_channels, true_channels
from hydrotele.simulate.stepping import delayed_commands
from hydrotele.teleop.operator_model import Hand
from hydrotele.teleop.station import Station, StationLog

_VACUUM = -1.0e5  # Pa below the atmosphere, as far as pressure can fall


def summarise(
    plant: Plant, scenario: Scenario, plan: Plan, record: Record, pins: float, wall: float
) -> dict[str, Any]:
    """What `summary.json` says, but for the balances.

    Args:
        plant: what ran.
        scenario: what was asked.
        plan: what was asked of every axis.
        record: the states at the log's rows.
        pins: largest pin opening seen at a control tick [m].
        wall: time that the loop took [s].

    Returns:
        Plain numbers and texts; units stand in the keys, or in `unit`.
    """
    return {
        "kind": "run",
        "scenario": scenario.name,
        "machine": plant.machine.name,
        "tool": plant.machine.tool,
        "seed": scenario.seed,
        "effects": [planted.model_dump() for planted in scenario.effects],
        "simulated_seconds": scenario.duration,
        "wall_seconds": round(wall, 4),
        "realtime_factor": round(scenario.duration / wall, 1),
        "physics_steps": round(scenario.duration / scenario.timestep),
        "largest_pin_opening_mm": pins * 1e3,
        "notes": [*plan.notes, *_doubts(plant, record)],
        "largest_contact_force_N": float(np.linalg.norm(record.contact, axis=1).max()),
        "tracking": _tracking(plant, plan, record),
        "versions": dict(_versions()),
        "git_commit": _git_commit(),
    }


def _doubts(plant: Plant, record: Record) -> list[str]:
    """Sentences about states that no machine can have."""
    if not plant.hydraulic:
        return []
    act = record.act[:, : ACTIVATIONS * plant.hydraulic]
    pressures = act.reshape(len(record.time), -1, ACTIVATIONS)[:, :, 2:]
    lowest = pressures.min(initial=0.0)
    if lowest < _VACUUM:
        return [f"a chamber falls to {lowest / 1e6:.1f} MPa, which oil cannot: check the machine"]
    return []


def _tracking(plant: Plant, plan: Plan, record: Record) -> dict[str, Any]:
    """Largest and RMS deviation of every followed axis, and of the tip from its desired pose."""
    rows = np.searchsorted(plan.time, record.time - 1e-9)
    result: dict[str, Any] = {}
    for i, name in enumerate(plan.axes):
        if plan.closed[i]:
            error = record.qpos[:, plant.qpos[i]] - plan.reference[rows, i]
            result[name] = _size(
                error, "rad" if plant.machine.position_kind(name) == "angle" else "m"
            )
    if plan.pose is not None and record.tip.shape[1]:
        desired = plan.pose[rows]
        r = np.hypot(record.tip[:, 0], record.tip[:, 1]) - desired[:, 0]
        arm = plant.machine.arm
        joints = [j for j in (arm.boom, arm.stick, arm.tool) if j] if arm else []
        places = [plant.model.joint(j).qposadr[0] for j in joints]
        attitude = record.qpos[:, places].sum(axis=1) - desired[:, 3]
        z = record.tip[:, 2] - desired[:, 2]
        result["tip_r"], result["tip_z"] = _size(r, "m"), _size(z, "m")
        result["tip_attitude"] = _size(attitude, "rad")
    return result


def _size(error: np.ndarray, unit: str) -> dict[str, Any]:
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return {"rms": rms, "max": largest, "unit": unit}


@functools.cache
def _versions() -> dict[str, str]:
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


AUDIT_SECONDS = 5.0
_PROGRESS_ROWS = 50
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


def prepare(scenario: Scenario) -> PreparedRun:
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
    return PreparedRun(plant, data, plan, seen)


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
    session = begin(scenario)
    stride = _PROGRESS_ROWS * session.every
    while session.tick < scenario.ticks:
        if progress and session.tick % stride == 0:
            progress(session.time, scenario.duration)
        session.advance(min(stride - session.tick % stride, scenario.ticks - session.tick))
    if progress:
        progress(scenario.duration, scenario.duration)
    return finished(session, scenario)


def begin(scenario: Scenario, hand: Hand | None = None) -> Session:
    """Everything of a run before its first tick.

    Args:
        scenario: what is asked.
        hand: where a live operator wants the handle.

    Raises:
        InputError: the scenario asks for what the machine has not.
    """
    if isinstance(scenario.pilot, TeleopPilot):
        compile_ahead()
    return Session(prepare(scenario), scenario, scenario_model(scenario), hand)


def finished(session: Session, scenario: Scenario) -> Run:
    """The run of a session that has gone far enough.

    Args:
        session: after its last tick.
        scenario: what was asked, of the duration that it went.

    Raises:
        InputError: it is too short for a log.
    """
    looped, plant = session.finish(), session.plant
    plan, record = looped.plan, looped.record
    truth, measured = _logs(plant, scenario, record, session.seen)
    summary = summarise(plant, scenario, plan, record, looped.pins, looped.wall)
    if looped.station:
        measured = _with_station(measured, looped.station.log, scenario)
        truth = _with_station(truth, looped.station.log, scenario)
        summary["teleoperation"] = looped.station.summary()
        summary["notes"] += looped.station.notes
    summary["notes"] += [f"{said} at {time:.2f} s" for time, said in looped.events]
    steps = round(1.0 / (scenario.control_rate * scenario.timestep))
    window = looped.commands[: round(AUDIT_SECONDS * scenario.control_rate)]
    controls = delayed_commands(plant, session.before, window, steps)
    summary["balance"] = audit(plant, session.start, controls)
    return Run(scenario, plant, plan, measured, truth, summary, looped.station)


def _with_station(log: Log, station: StationLog, scenario: Scenario) -> Log:
    """A log with what the operator's station measured and made."""
    every = round(scenario.control_rate / scenario.log_rate)
    columns, units = station.channels(every, scenario.rows)
    return dataclasses.replace(
        log, columns={**log.columns, **columns}, units={**log.units, **units}
    )


def _logs(plant: Plant, scenario: Scenario, record: Record, seen: Feedback) -> tuple[Log, Log]:
    """What was true and what the sensors say; the latter with the errors that were fed back."""
    machine = plant.machine
    values, units = true_channels(plant, record)
    truth = _log(scenario, machine, record.time, values, units, "ideal")
    state = json.dumps(_initial_state(plant, record))
    things = json.dumps([thing.model_dump() for thing in scenario.surroundings])
    known = {"initial_state": state} | ({"surroundings": things} if scenario.surroundings else {})
    truth = dataclasses.replace(truth, metadata={**truth.metadata, **known})
    per_row = round(scenario.control_rate / scenario.log_rate) // seen.every
    errors = {name: e[::per_row][: scenario.rows] for name, e in seen.errors.items()}
    visible = {c: v for c, v in values.items() if not c.startswith(("truth.", "command."))}
    sensors = sensor_set(machine, scenario.sensors)
    readings = {c: v for c, v in values.items() if c.startswith("command.")}
    visible |= late_channels(plant, record)
    readings |= measure(machine, sensors, scenario.seed, visible, errors, 1.0 / scenario.log_rate)
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
        things = "the ground or what stands around" if plant.surroundings else "the ground"
        raise InputError("start", f"the machine would stand {depth:.2f} m deep in {things}")
    return data, joints


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
    if scenario.surroundings:
        metadata["things"] = ", ".join(thing.kind for thing in scenario.surroundings)
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
        **_remembered(plant, record),
    }


def _remembered(plant: Plant, record: Record) -> dict[str, dict[str, float]]:
    """What bristles and a slow pump remember at a record's start, by kind and owner."""
    found: dict[str, dict[str, float]] = {}
    for name, place in plant.memory.items():
        kind, _, owner = name.partition(".")
        found.setdefault(kind, {})[owner] = float(record.act[0, place])
    return found

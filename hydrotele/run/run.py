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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import hydrotele
from hydrotele.control.arm_kinematics import pose_to_joints
from hydrotele.control.plan import Plan, make_plan
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.effects import apply_effect
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.oil_temperature import with_oil_temperature
from hydrotele.run.policy import check_policy_is_allowed, complete_policy_pilot, load_policy
from hydrotele.run.session import PreparedRun, Session
from hydrotele.run.tick_loop import (
    start_background_compilation,
)
from hydrotele.scenario.pilots import PolicyPilot
from hydrotele.scenario.scenario import Scenario, find_local_machine
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.conservation_checks import compute_balance_errors
from hydrotele.simulate.mechanism import axes_with_transmission
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.record import Record
from hydrotele.simulate.retrofit_sensors import simulate_retrofit_readings
from hydrotele.simulate.sensor_models import Feedback, create_feedback, simulate_readings
from hydrotele.simulate.stepping import delayed_commands
from hydrotele.simulate.true_values import delayed_channels, true_channels
from hydrotele.teleop.operator_model import HandInput
from hydrotele.teleop.teleoperation_log import TeleoperationLog
from hydrotele.teleop.teleoperation_system import TeleoperationSystem

_MIN_PRESSURE = -1.0e5  # Pa relative to the atmosphere, the lowest physically possible pressure


def summarise(
    plant: Plant,
    scenario: Scenario,
    plan: Plan,
    record: Record,
    max_pin_opening: float,
    computing_seconds: float,
) -> dict[str, Any]:
    """Return the entries of `summary.json` of a run: settings, speed, largest forces, tracking errors, versions.

    The flow and energy balances are not included; `finish_run` adds them.

    Args:
        plant: the simulated machine.
        scenario: the scenario.
        plan: reference and commands of every axis.
        record: states at the log rows.
        max_pin_opening: largest distance between the two halves of a pin of a closed loop, at any
            control tick [m].
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
    """Return RMS and largest absolute value of the tracking errors of a run: name -> `rms`, `max`, `unit`.

    The errors are true minus reference position of every closed-loop axis, or of every axis for which a
    policy has a reference, at the log rows. If the
    plan gives a pose of the arm's tip, those of radius, height and attitude are included.
    """
    rows = np.searchsorted(plan.time, record.time - 1e-9)
    result: dict[str, Any] = {}
    for i, name in enumerate(plan.axes):
        if plan.closed_loop[i] or plan.goal is not None:
            reference = plan.reference if plan.goal is None else plan.goal
            error = record.qpos[:, plant.qpos[i]] - reference[rows, i]
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

    Examples:
        >>> import hydrotele as ht
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", {"duration": "1"}))
        >>> run
        Run('rig_steps', machine='rig', tool='none', 0.999 s)

        The log of the sensors has noise and quantisation, the log of the truth has neither.

        >>> error = run.measured["pressure_head.slide"] - run.truth["pressure_head.slide"]
        >>> round(float(error.std()) / 1e5, 2)  # bar; the machine file states an accuracy of 0.5 bar
        0.28

        The summary contains balances of energy and oil, by which every run checks itself.

        >>> sorted(run.summary["balance"])
        ['energy_balance', 'flow_balance', 'seconds']
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
    """Load the machine of a scenario as its controller knows it: without the scenario's effects.

    Raises:
        InputError: unknown machine or tool.
    """
    return load_machine(find_local_machine(scenario) or scenario.machine, scenario.tool)


def load_simulated_machine(scenario: Scenario) -> Machine:
    """Load the machine of a scenario with the effects that the scenario adds to it.

    Raises:
        InputError: unknown machine, tool, effect or location.
    """
    return add_scenario_effects(load_nominal_machine(scenario), scenario)


def add_scenario_effects(machine: Machine, scenario: Scenario) -> Machine:
    """Return a machine with the effects that a scenario adds to it.

    Raises:
        InputError: unknown effect or location.
    """
    for planted in scenario.effects:
        machine = apply_effect(machine, planted.name, planted.location, planted.parameters)
    return machine


def prepare_run(scenario: Scenario) -> PreparedRun:
    """Build the simulated machine of a scenario, set its initial state and plan the run.

    Raises:
        InputError: the scenario does not fit the machine.
    """
    nominal = load_nominal_machine(scenario)
    machine = add_scenario_effects(nominal, scenario)
    if scenario.oil_temperature is not None:
        machine = with_oil_temperature(machine, scenario.oil_temperature)
    sensors = get_sensor_set(machine, scenario.sensors)
    plant = build_plant(machine, scenario.timestep, scenario.ground, scenario.surroundings)
    data, start = _initial_data(plant, scenario)
    times = np.arange(scenario.tick_count) / scenario.control_rate
    policy, pilot = None, scenario.pilot
    if isinstance(pilot, PolicyPilot):
        check_policy_is_allowed(pilot.policy, scenario.folder)
        program = load_policy(pilot.policy, scenario.folder)
        pilot = complete_policy_pilot(pilot, program, machine, plant.axes)
        policy = program, pilot
    plan = make_plan(machine, plant.axes, pilot, start, times)
    seen = create_feedback(plant, sensors, scenario.seed, scenario.tick_count, scenario.control_rate)
    if sensors and round(scenario.control_rate / scenario.log_rate) % seen.ticks_per_sample:
        message = f"the sample rate {sensors.rate:g} Hz must be a multiple of log_rate {scenario.log_rate:g} Hz"
        raise InputError(f"sensors {scenario.sensors}", message)
    return PreparedRun(plant, data, plan, seen, nominal, policy)


def run_scenario(scenario: Scenario, progress: Progress | None = None) -> Run:
    """Simulate a scenario from start to end.

    Args:
        scenario: the scenario.
        progress: callback, called periodically with (simulated seconds, total seconds).

    Returns:
        The run.

    Raises:
        InputError: the scenario does not fit the machine.
        SimulationFailed: states became infinite or not a number.

    Examples:
        Half the valve opening moves the cylinder of the test rig at a constant speed. The head side then needs the
        flow `area * speed`, which the log of the truth contains:

        >>> import hydrotele as ht
        >>> pilot = "{kind: constant, commands: {slide: 0.5}}"
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", {"duration": "0.8", "pilot": pilot}))
        >>> speed = float(run.truth["truth.velocity.slide"][-1])
        >>> area = run.plant.machine.axes["slide"].cylinder.area_head
        >>> round(speed, 3), round(6e4 * area * speed, 1)  # m/s, L/min
        (0.249, 18.7)
        >>> round(6e4 * float(run.truth["truth.flow_head.slide"][-1]), 1)  # L/min
        18.7
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
    return Session(prepare_run(scenario), scenario, hand)


def finish_run(session: Session, scenario: Scenario) -> Run:
    """Stop a session and return its run with logs and summary.

    The balances of oil volume and energy in the summary come from a repeated simulation of the
    first 5 s.

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
    """Return two logs of a run: (true values, sensor readings).

    Args:
        plant: the simulated machine.
        scenario: the scenario.
        record: states at the log rows.
        seen: sensor feedback of the controller; its random sensor errors are also those of the
            second log.
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
    if sensors:
        readings = {c: v for c, v in readings.items() if not c.startswith(sensors.absent)}
        added, added_units = simulate_retrofit_readings(plant, sensors, record, values, scenario.seed)
        readings, units = readings | added, {c: units[c] for c in readings} | added_units
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
    """Return the internal states of a machine at the first row of a run, as kind -> owner -> value.

    They are the states in addition to motion, spools and pressures: those of friction before
    sliding, of the pump and of added effects. The owner is an axis or another part.
    """
    found: dict[str, dict[str, float]] = {}
    for name, place in plant.extra_states.items():
        kind, _, owner = name.partition(".")
        found.setdefault(kind, {})[owner] = float(record.act[0, place])
    return found

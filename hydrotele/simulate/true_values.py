"""True values of all channels of a log, computed from recorded states, in SI units.

Measurable channels have their names, all others are `truth.*`.
"""

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS_PER_AXIS,
    FEED,
    SCRATCH_SIZE,
    SLOT_COUNT,
    Slot,
    axis_flows_and_force,
    solve_state_supplies,
)
from hydrotele.simulate.closed_loops import dependent_joints
from hydrotele.simulate.plant import Plant, evaluate_terms
from hydrotele.simulate.record import Record, sensed_channels
from hydrotele.simulate.surroundings import object_joints

_BRISTLE, _STIFFNESS = int(Slot.BRISTLE), int(Slot.BRISTLE_STIFFNESS)
_SPOOL_CHANNELS = ("spool", "1"), ("spool_rate", "1/s")


@compiled
def compute_state_flows_and_forces(user, count, act, x, v):
    """Compute supply pressures, valve flows and drive forces of n states.

    Args:
        user: (nu * SLOT_COUNT,) actuator parameters.
        count: number of hydraulic axes.
        act: (n, >= 4 count) activations.
        x: (n, nu) drive positions [m] or [rad].
        v: (n, nu) drive velocities [m/s] or [rad/s].

    Returns:
        (n, 4 count), for every axis: pressure that feeds it [Pa], valve flows into head and rod
        chamber [m^3/s] and the force after friction [N] or [N m], without terms.

    Source: models/cat215/README.md.
    """
    scratch = np.zeros(SCRATCH_SIZE)
    out = np.zeros((act.shape[0], 4 * count))
    for row in range(act.shape[0]):
        solve_state_supplies(user, 0, count, act[row], scratch)
        for i in range(count):
            share = 0.0
            if user[i * SLOT_COUNT + _STIFFNESS] > 0.0:
                share = act[row, int(user[i * SLOT_COUNT + _BRISTLE])]
            q_head, q_rod, force = axis_flows_and_force(
                user, i, scratch[FEED + i], act[row, 4 * i : 4 * i + 4], x[row, i], v[row, i], share
            )
            out[row, 4 * i], out[row, 4 * i + 1] = scratch[FEED + i], q_head
            out[row, 4 * i + 2], out[row, 4 * i + 3] = q_rod, force
    return out


def true_channels(plant: Plant, record: Record) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Compute the true values of all channels: measurable ones by name, others as `truth.*`.

    Args:
        plant: the simulated plant.
        record: its recorded states.

    Returns:
        (channel -> (n,) values in SI, channel -> unit).
    """
    values, units = _measurable_channels(plant, record)
    hidden, hidden_units = _unmeasured_channels(plant, record)
    return {**values, **hidden}, {**units, **hidden_units}


def _measurable_channels(plant: Plant, record: Record):
    """Return the channels of commands, positions, cylinder lengths and chamber pressures.

    The result is (channel -> values (n,), channel -> unit).
    """
    machine, values, units = plant.machine, {}, {}
    for i, name in enumerate(plant.axes):
        axis = machine.axes[name]
        values[f"command.{name}"] = record.command[:, i]
        units[f"command.{name}"] = axis.force.command_unit if axis.force else "1"
    sensed = _sensed_values(plant, record.qpos, record.act)
    sizes = {"angle": "rad", "position": "m", "length": "m"}
    units |= {name: sizes.get(name.partition(".")[0], "Pa") for name in sensed}
    return {**values, **sensed}, units


def _sensed_values(plant: Plant, qpos: np.ndarray, act: np.ndarray) -> dict[str, np.ndarray]:
    """Return channel -> (n,) true joint positions, cylinder lengths and chamber pressures.

    They are read from `qpos` (n, nq) and the activations `act` (n, na) of n states.
    """
    values = {}
    for i, name in enumerate(plant.axes):
        values[f"{plant.machine.position_kind(name)}.{name}"] = qpos[:, plant.qpos[i]]
    for name in plant.machine.undriven_sensed_joints:
        values[f"angle.{name}"] = qpos[:, plant.model.joint(name).qposadr[0]]
    for i, name in enumerate(plant.axes):
        if plant.machine.axes[name].cylinder:
            values[f"length.{name}"] = qpos[:, plant.rod_qpos[i]]
    for i, name in enumerate(plant.axes[: plant.hydraulic]):
        for column, side in ((2, "head"), (3, "rod")):
            values[f"pressure_{side}.{name}"] = act[:, ACTIVATIONS_PER_AXIS * i + column]
    return values


def delayed_channels(plant: Plant, record: Record) -> dict[str, np.ndarray]:
    """Return the values of the channels whose sensors have a delay or lag, after delay and lag.

    Args:
        plant: the simulated plant.
        record: its recorded states.

    Returns:
        Channel -> (n,) values in SI; only channels with a delay or a time constant.
    """
    names = sensed_channels(plant)
    return {
        channel: record.delayed_readings[:, names.index(channel)]
        for channel, error in plant.machine.sensor_errors.items()
        if error.is_delayed and channel in names
    }


def _unmeasured_channels(plant: Plant, record: Record):
    """Return all `truth.*` channels and the supply pressure.

    The result is (channel -> values (n,), channel -> unit).
    """
    machine, model = plant.machine, plant.model
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}

    def add_channel(name: str, column: np.ndarray, unit: str) -> None:
        values[name], units[name] = column, unit

    for i, name in enumerate(plant.axes):
        unit = "rad" if machine.position_kind(name) == "angle" else "m"
        add_channel(f"truth.velocity.{name}", record.qvel[:, plant.dof[i]], f"{unit}/s")
        add_channel(f"truth.acceleration.{name}", record.qacc[:, plant.dof[i]], f"{unit}/s^2")
    driven = {axis.joint for axis in machine.axes.values()}
    for name, joint in machine.joints.items():
        if name not in driven and name not in dependent_joints(machine):
            kind, unit = ("angle", "rad") if joint.type == "hinge" else ("position", "m")
            add_channel(f"truth.{kind}.{name}", record.qpos[:, model.joint(name).qposadr[0]], unit)
    for name, place in plant.extra_states.items():
        shown = name.removesuffix(".supply")
        add_channel(f"truth.{shown}", record.act[:, place], "1")
    _add_object_poses(plant, record, add_channel)
    _add_hydraulic_channels(plant, record, add_channel)
    for name, force in record.contact_of.items():
        if np.any(force):
            for letter, column in zip("xyz", force.T, strict=True):
                add_channel(f"truth.object_contact.{name}_{letter}", column, "N")
    if np.any(record.load):
        add_channel("truth.load", record.load, "kg")
    for k, letter in enumerate("xyz"):
        if np.any(record.contact):
            add_channel(f"truth.contact_force.{letter}", record.contact[:, k], "N")
        if record.tip.shape[1]:
            add_channel(f"truth.tip.{letter}", record.tip[:, k], "m")
    return values, units


def _add_object_poses(plant: Plant, record: Record, put) -> None:
    """Add channels with the poses of plates, trees and logs, by calls `put(name, column, unit)`.

    Rotations are rotation vectors [rad].
    """
    for joint, place in object_joints(plant.model):
        name, kind = plant.model.joint(joint).name, plant.model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            for letter, column in zip("xyz", record.qpos[:, place : place + 3].T, strict=True):
                put(f"truth.position.{name}_{letter}", column, "m")
            _add_rotation(name, record.qpos[:, place + 3 : place + 7], put)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            _add_rotation(name.removesuffix("_turn"), record.qpos[:, place : place + 4], put)
        else:
            put(f"truth.position.{name}", record.qpos[:, place], "m")


def _add_rotation(name: str, quaternions: np.ndarray, put) -> None:
    """Add three channels with the rotation vector [rad] of an object, given as quaternions (n, 4)."""
    vectors = np.empty((len(quaternions), 3))
    for vector, quaternion in zip(vectors, quaternions, strict=True):
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    for letter, column in zip("xyz", vectors.T, strict=True):
        put(f"truth.angle.{name}_r{letter}", column, "rad")


def _add_hydraulic_channels(plant: Plant, record: Record, put) -> None:
    """Add channels with spools, flows, forces and supply pressure, by calls `put(name, column, unit)`.

    For an axis with its own pump, pump speed and load pressure replace spool position and spool
    rate. The forces include friction and terms, the flows no terms. Without hydraulic axes nothing
    is added.
    """
    count = plant.hydraulic
    if not count:
        return
    x, v = extract_drive_motion(plant, record.qpos, record.qvel)
    user = plant.model.actuator_user.ravel()
    table = compute_state_flows_and_forces(user, count, np.ascontiguousarray(record.act), x, v)
    if plant.machine.valve_axes:
        for channel, pump in zip(plant.machine.supply_channels, plant.machine.pumps, strict=True):
            first = plant.axes.index(plant.machine.axes_of_pump(pump)[0])
            put(channel, table[:, 4 * first], "Pa")
    more = evaluate_terms(plant.machine, record.time, record.act, x, v, record.command)
    flows = {pump: np.zeros(len(record.time)) for pump in plant.machine.pumps}
    for i, name in enumerate(plant.axes[:count]):
        cylinder, pumped = plant.machine.axes[name].cylinder, plant.machine.axes[name].pump
        kinds = (("speed", "rad/s"), ("pressure_load", "Pa")) if pumped else _SPOOL_CHANNELS
        for place, (kind, unit) in enumerate(kinds):
            put(f"truth.{kind}.{name}", record.act[:, ACTIVATIONS_PER_AXIS * i + place], unit)
        put(f"truth.flow_head.{name}", table[:, 4 * i + 1], "m^3/s")
        put(f"truth.flow_rod.{name}", table[:, 4 * i + 2], "m^3/s")
        force = table[:, 4 * i + 3] + more[:, i, 0]
        put(f"truth.force.{name}", force, "N" if cylinder else "N m")
        if cylinder:
            put(f"truth.piston_velocity.{name}", v[:, i], "m/s")
        if pumped:  # has its own pump
            continue
        fed_head = record.act[:, ACTIVATIONS_PER_AXIS * i] > 0.0
        flows[plant.machine.pump_of(name)] += np.where(fed_head, table[:, 4 * i + 1], table[:, 4 * i + 2])
    if plant.machine.valve_axes:
        for pump, flow in flows.items():
            put("truth.flow_supply" if pump == "supply" else f"truth.flow_supply.{pump}", flow, "m^3/s")


def extract_drive_motion(plant: Plant, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Select the drive positions and velocities from n complete states.

    Args:
        plant: the plant.
        qpos: (n, nq) positions.
        qvel: (n, nv) velocities.

    Returns:
        (x (n, nu) [m] or [rad], v (n, nu) [m/s] or [rad/s]): displacement and velocity of piston or
        rotor; without a transmission they are those of the load.
    """
    return (
        np.ascontiguousarray(qpos[:, plant.drive_qpos]),
        np.ascontiguousarray(qvel[:, plant.drive_dof]),
    )

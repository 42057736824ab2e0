"""What a run shows: true channels from recorded states."""

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS,
    SCRATCH,
    SLOTS,
    Slot,
    axis_state,
    circuit_scratch,
    circuit_supply,
    delivered_share,
    open_ports,
)
from hydrotele.simulate.closure import following_joints
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record
from hydrotele.simulate.surroundings import thing_joints
from hydrotele.simulate.term_readout import added_by_terms

_BRISTLE, _STIFFNESS = int(Slot.BRISTLE), int(Slot.BRISTLE_STIFFNESS)
_SPOOL = ("spool", "1"), ("spool_rate", "1/s")


@compiled
def state_supply(user, count, act, scratch):
    """Supply pressure in a state.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        count: number of hydraulic axes, which come first.
        act: (>= 4 count,) activations, and what a slow pump remembers.
        scratch: (SCRATCH,) work space.

    Returns:
        p_s, scalar [Pa].

    Source: nominal model, "Supply".
    """
    open_ports(user, act, act, scratch, 0, count, 0.0, act)
    return circuit_supply(user, 0, count, scratch, delivered_share(user, 0, act))


@compiled
def state_flows(user, count, act, x, v):
    """Supply pressure, valve flows and drive forces of many states.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        count: number of hydraulic axes.
        act: (n, >= 4 count) activations.
        x: (n, nu) drive positions [m] or [rad].
        v: (n, nu) drive velocities [m/s] or [rad/s].

    Returns:
        (n, 1 + 3 count): p_s [Pa], then q_head, q_rod [m^3/s], force [N] or [N m] of every axis.

    Source: nominal model.
    """
    scratch = np.zeros(SCRATCH)
    out = np.zeros((act.shape[0], 1 + 3 * count))
    for row in range(act.shape[0]):
        supply = state_supply(user, count, act[row], scratch)
        out[row, 0] = supply
        for i in range(count):
            share = 0.0
            if user[i * SLOTS + _STIFFNESS] > 0.0:
                share = act[row, int(user[i * SLOTS + _BRISTLE])]
            q_head, q_rod, force = axis_state(
                user, i, supply, act[row, 4 * i : 4 * i + 4], x[row, i], v[row, i], share
            )
            out[row, 1 + 3 * i], out[row, 2 + 3 * i], out[row, 3 + 3 * i] = q_head, q_rod, force
    return out


def true_channels(plant: Plant, record: Record) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """All true channels of a record, measurable ones under their own names, others as `truth.*`.

    Args:
        plant: the plant that ran.
        record: its states.

    Returns:
        (channel -> (n,) values in SI, channel -> unit).
    """
    values, units = _measurable(plant, record)
    hidden, hidden_units = _hidden(plant, record)
    return {**values, **hidden}, {**units, **hidden_units}


def _measurable(plant: Plant, record: Record):
    machine, values, units = plant.machine, {}, {}
    for i, name in enumerate(plant.axes):
        axis = machine.axes[name]
        values[f"command.{name}"] = record.command[:, i]
        units[f"command.{name}"] = axis.force.command_unit if axis.force else "1"
    sensed = _sensed(plant, record.qpos, record.act)
    sizes = {"angle": "rad", "position": "m", "length": "m"}
    units |= {name: sizes.get(name.partition(".")[0], "Pa") for name in sensed}
    return {**values, **sensed}, units


def _sensed(plant: Plant, qpos: np.ndarray, act: np.ndarray) -> dict[str, np.ndarray]:
    """Positions, lengths and chamber pressures in states (n, nq), (n, na)."""
    values = {}
    for i, name in enumerate(plant.axes):
        values[f"{plant.machine.position_kind(name)}.{name}"] = qpos[:, plant.qpos[i]]
    for i, name in enumerate(plant.axes):
        if plant.machine.axes[name].cylinder:
            values[f"length.{name}"] = qpos[:, plant.rod_qpos[i]]
    for i, name in enumerate(plant.axes[: plant.hydraulic]):
        for column, side in ((2, "head"), (3, "rod")):
            values[f"pressure_{side}.{name}"] = act[:, ACTIVATIONS * i + column]
    return values


def late_channels(plant: Plant, record: Record) -> dict[str, np.ndarray]:
    """True values of the channels whose sensors read late, as their delay and lag let them through.

    Args:
        plant: the plant that ran.
        record: its states, with those before.

    Returns:
        Channel -> (n,) values in SI; only channels with a delay or a time constant.
    """
    values = {}
    for channel, error in plant.machine.sensor_errors.items():
        if not error.late:
            continue
        qpos, act, supply = record.late[error.delay, error.time_constant]
        if channel == "pressure_supply" and error.time_constant:
            values[channel] = supply
        elif channel == "pressure_supply":
            user, scratch = plant.model.actuator_user.ravel(), circuit_scratch()
            values[channel] = np.array(
                [state_supply(user, plant.hydraulic, row, scratch) for row in act]
            )
        else:
            values[channel] = _sensed(plant, qpos, act)[channel]
    return values


def _hidden(plant: Plant, record: Record):
    machine, model = plant.machine, plant.model
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}

    def put(name: str, column: np.ndarray, unit: str) -> None:
        values[name], units[name] = column, unit

    for i, name in enumerate(plant.axes):
        unit = "rad" if machine.position_kind(name) == "angle" else "m"
        put(f"truth.velocity.{name}", record.qvel[:, plant.dof[i]], f"{unit}/s")
        put(f"truth.acceleration.{name}", record.qacc[:, plant.dof[i]], f"{unit}/s^2")
    driven = {axis.joint for axis in machine.axes.values()}
    for name, joint in machine.joints.items():
        if name not in driven and name not in following_joints(machine):
            kind, unit = ("angle", "rad") if joint.type == "hinge" else ("position", "m")
            put(f"truth.{kind}.{name}", record.qpos[:, model.joint(name).qposadr[0]], unit)
    for name, place in plant.memory.items():
        shown = name.removesuffix(".supply")
        put(f"truth.{shown}", record.act[:, place], "1")
    _put_things(plant, record, put)
    _put_hydraulics(plant, record, put)
    for k, letter in enumerate("xyz"):
        if np.any(record.contact):
            put(f"truth.contact_force.{letter}", record.contact[:, k], "N")
        if record.tip.shape[1]:
            put(f"truth.tip.{letter}", record.tip[:, k], "m")
    return values, units


def _put_things(plant: Plant, record: Record, put) -> None:
    """Where plates, trees and logs are; turning as a rotation vector."""
    for joint, place in thing_joints(plant.model):
        name, kind = plant.model.joint(joint).name, plant.model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            for letter, column in zip("xyz", record.qpos[:, place : place + 3].T, strict=True):
                put(f"truth.position.{name}_{letter}", column, "m")
            _put_turning(name, record.qpos[:, place + 3 : place + 7], put)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            _put_turning(name.removesuffix("_turn"), record.qpos[:, place : place + 4], put)
        else:
            put(f"truth.position.{name}", record.qpos[:, place], "m")


def _put_turning(name: str, quaternions: np.ndarray, put) -> None:
    vectors = np.empty((len(quaternions), 3))
    for vector, quaternion in zip(vectors, quaternions, strict=True):
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    for letter, column in zip("xyz", vectors.T, strict=True):
        put(f"truth.angle.{name}_r{letter}", column, "rad")


def _put_hydraulics(plant: Plant, record: Record, put) -> None:
    count = plant.hydraulic
    if not count:
        return
    x, v = drive_motion(plant, record.qpos, record.qvel)
    user = plant.model.actuator_user.ravel()
    table = state_flows(user, count, np.ascontiguousarray(record.act), x, v)
    if plant.machine.valve_axes:
        put("pressure_supply", table[:, 0], "Pa")
    more = added_by_terms(plant.machine, record.time, record.act, x, v, record.command)
    total = np.zeros(len(record.time))
    for i, name in enumerate(plant.axes[:count]):
        cylinder, pumped = plant.machine.axes[name].cylinder, plant.machine.axes[name].pump
        kinds = (("speed", "rad/s"), ("pressure_load", "Pa")) if pumped else _SPOOL
        for place, (kind, unit) in enumerate(kinds):
            put(f"truth.{kind}.{name}", record.act[:, ACTIVATIONS * i + place], unit)
        put(f"truth.flow_head.{name}", table[:, 1 + 3 * i], "m^3/s")
        put(f"truth.flow_rod.{name}", table[:, 2 + 3 * i], "m^3/s")
        force = table[:, 3 + 3 * i] + more[:, i, 0]
        put(f"truth.force.{name}", force, "N" if cylinder else "N m")
        if cylinder:
            put(f"truth.piston_velocity.{name}", v[:, i], "m/s")
        if pumped:  # feeds itself
            continue
        fed_head = record.act[:, ACTIVATIONS * i] > 0.0
        total += np.where(fed_head, table[:, 1 + 3 * i], table[:, 2 + 3 * i])
    if plant.machine.valve_axes:
        put("truth.flow_supply", total, "m^3/s")


def drive_motion(plant: Plant, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drive positions and velocities of many states.

    Args:
        plant: the plant.
        qpos: (n, nq).
        qvel: (n, nv).

    Returns:
        (x (n, nu), v (n, nu)): displacement and velocity of piston or rotor, which are those of the
        load where nothing gives.
    """
    return (
        np.ascontiguousarray(qpos[:, plant.drive_qpos]),
        np.ascontiguousarray(qvel[:, plant.drive_dof]),
    )

"""What a run shows: true channels from recorded states."""

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS,
    SCRATCH,
    Slot,
    axis_state,
    open_ports,
    supply_pressure,
)
from hydrotele.simulate.closure import following_joints
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record

_D, _RELIEF, _PUMP = int(Slot.ORIFICE_SMOOTHING), int(Slot.RELIEF_PRESSURE), int(Slot.PUMP_FLOW)


@compiled
def state_supply(user, count, act, scratch):
    """Supply pressure in a state.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        count: number of hydraulic axes, which come first.
        act: (4 count,) activations.
        scratch: (SCRATCH,) work space.

    Returns:
        p_s, scalar [Pa].

    Source: nominal model, "Supply".
    """
    open_ports(user, act, act, scratch, 0, count, 0.0, act)
    return supply_pressure(scratch, count, user[_D], user[_RELIEF], user[_PUMP])


@compiled
def state_flows(user, count, act, x, v):
    """Supply pressure, valve flows and drive forces of many states.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        count: number of hydraulic axes.
        act: (n, 4 count) activations.
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
            q_head, q_rod, force = axis_state(
                user, i, supply, act[row, 4 * i : 4 * i + 4], x[row, i], v[row, i]
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
    for i, name in enumerate(plant.axes):
        kind = machine.position_kind(name)
        values[f"{kind}.{name}"] = record.qpos[:, plant.qpos[i]]
        units[f"{kind}.{name}"] = "rad" if kind == "angle" else "m"
    for i, name in enumerate(plant.axes):
        if machine.axes[name].cylinder:
            values[f"length.{name}"] = record.qpos[:, plant.rod_qpos[i]]
            units[f"length.{name}"] = "m"
    for i, name in enumerate(plant.axes[: plant.hydraulic]):
        for column, side in ((2, "head"), (3, "rod")):
            values[f"pressure_{side}.{name}"] = record.act[:, ACTIVATIONS * i + column]
            units[f"pressure_{side}.{name}"] = "Pa"
    return values, units


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
    _put_hydraulics(plant, record, put)
    for k, letter in enumerate("xyz"):
        if np.any(record.contact):
            put(f"truth.contact_force.{letter}", record.contact[:, k], "N")
        if record.tip.shape[1]:
            put(f"truth.tip.{letter}", record.tip[:, k], "m")
    return values, units


def _put_hydraulics(plant: Plant, record: Record, put) -> None:
    count = plant.hydraulic
    if not count:
        return
    x, v = drive_motion(plant, record.qpos, record.qvel)
    user = plant.model.actuator_user.ravel()
    table = state_flows(user, count, np.ascontiguousarray(record.act), x, v)
    put("pressure_supply", table[:, 0], "Pa")
    total = np.zeros(len(record.time))
    for i, name in enumerate(plant.axes[:count]):
        cylinder = plant.machine.axes[name].cylinder
        put(f"truth.spool.{name}", record.act[:, ACTIVATIONS * i], "1")
        put(f"truth.spool_rate.{name}", record.act[:, ACTIVATIONS * i + 1], "1/s")
        put(f"truth.flow_head.{name}", table[:, 1 + 3 * i], "m^3/s")
        put(f"truth.flow_rod.{name}", table[:, 2 + 3 * i], "m^3/s")
        put(f"truth.force.{name}", table[:, 3 + 3 * i], "N" if cylinder else "N m")
        if cylinder:
            put(f"truth.piston_velocity.{name}", v[:, i], "m/s")
        fed_head = record.act[:, ACTIVATIONS * i] > 0.0
        total += np.where(fed_head, table[:, 1 + 3 * i], table[:, 2 + 3 * i])
    put("truth.flow_supply", total, "m^3/s")


def drive_motion(plant: Plant, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drive positions and velocities of many states.

    Args:
        plant: the plant.
        qpos: (n, nq).
        qvel: (n, nv).

    Returns:
        (x (n, nu), v (n, nu)): piston displacement [m] and velocity, joint coordinate without
        cylinder.
    """
    model = plant.model
    columns, dofs = plant.qpos.copy(), plant.dof.copy()
    for i, name in enumerate(plant.axes):
        if plant.rod_qpos[i] >= 0:
            columns[i] = plant.rod_qpos[i]
            dofs[i] = model.joint(f"{name}_rod").dofadr[0]
    return np.ascontiguousarray(qpos[:, columns]), np.ascontiguousarray(qvel[:, dofs])

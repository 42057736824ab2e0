"""Recording of a run: states aligned in time, contact forces, and the true channels of the log.

MuJoCo's semi-implicit Euler step together with the hydraulics, which use the piston velocity at the
start of the step and give the force at its end, is a leapfrog scheme. When the activations are at
time t, the velocities are at t + h/2 and the positions at t + h. Without alignment the positions
would be one step early. This module aligns all states to time t; the error is of second order in
the step, except for friction.
"""
# pyright: reportCallIssue=false
# numba's intrinsics are called without their typing context.

import dataclasses
import math

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import (
    address_record,
    copy_values,
    float64_view,
    int32_view,
    int64_view,
    matrix_view,
)
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS_PER_AXIS,
    SCRATCH_SIZE,
    SLOT_COUNT,
    Slot,
    axis_flows_and_force,
    circuit_supply_pressure,
    compute_inlet_conditions,
    delivered_flow_fraction,
)
from hydrotele.simulate.closure import dependent_joints
from hydrotele.simulate.layout import (
    call_mj_contact_force,
    field_offsets,
    function_address,
    struct_size,
)
from hydrotele.simulate.mechanism import TIP_SITE
from hydrotele.simulate.plant import Plant, evaluate_terms
from hydrotele.simulate.surroundings import is_surrounding_object, object_joints

_STEP_TOLERANCE = 1.0e-9  # steps: rounding error up to which a delay counts as a whole number of steps


class SimulationFailed(RuntimeError):
    """The simulation became unstable; the message contains the last states."""


@dataclasses.dataclass(frozen=True)
class Record:
    """States of a run at the log's rows, all aligned to the row's time.

    Attributes:
        time: (n,) time [s].
        qpos: (n, nq) positions.
        qvel: (n, nv) velocities.
        qacc: (n, nv) accelerations.
        act: (n, na) activations.
        command: (n, nu) mean command over the row's interval.
        contact: (n, 3) total contact force of ground and objects on the machine, world frame [N].
        contact_of: name of each surrounding object -> (n, 3) its force on the machine [N].
        tip: (n, 3) position of the arm's tip [m]; empty (n, 0) without an arm.
        delayed_readings: (n, c) delayed and filtered values of `sensed_channels`, without sensor errors; empty
            (n, 0) if no sensor has a delay or lag.
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    act: np.ndarray
    command: np.ndarray
    contact: np.ndarray
    contact_of: dict[str, np.ndarray]
    tip: np.ndarray
    delayed_readings: np.ndarray


def start_leapfrog(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Convert a state at time t to the staggered state from which stepping starts.

    Args:
        model: the model.
        data: `qvel` is advanced by half a step and `qpos` by a whole step; accelerations, site
            positions and contacts are those of time t.
    """
    mujoco.mj_forward(model, data)
    half = 0.5 * model.opt.timestep
    data.qvel[:] += half * data.qacc
    mujoco.mj_integratePos(model, data.qpos, data.qvel, model.opt.timestep)


def current_aligned_positions(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the current positions (nq,), moved back by one step to the time of the activations.

    Positions from the first ball or free joint on (trees and logs) are not aligned.
    """
    return align_staggered_positions(model, data.qpos, data.qvel)


def align_staggered_positions(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return staggered positions (..., nq), moved back by one step with the velocities (..., nv).

    This aligns them with the time of the activations, see the module.
    """
    positions = np.array(qpos)
    rows, rates = positions.reshape(-1, model.nq), qvel.reshape(-1, model.nv)
    _move_back_one_step(rows, rates, model.opt.timestep, _count_alignable_positions(model))
    return positions


@compiled
def _move_back_one_step(positions, velocities, timestep, plain):
    """Subtract time step times velocity (n, nv) from the first `plain` positions of every row (n, nq)."""
    for row in range(len(positions)):
        for i in range(plain):
            positions[row, i] -= timestep * velocities[row, i]


def _count_alignable_positions(model: mujoco.MjModel) -> int:
    """Return the number of leading elements of `qpos` whose time derivatives are those of `qvel`.

    Quaternions of ball and free joints, which come last, have other derivatives.
    """
    return model.nq if model.nq == model.nv else _count_single_dof_joints(model.jnt_type)


_BALL, _FREE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_FREE)


@compiled
def _count_single_dof_joints(kinds):
    """Return the number of joints of one degree of freedom that precede the first ball or free joint.

    `kinds` (njnt,) are MuJoCo's joint types; the result is 0 if there is no ball or free joint.
    """
    for k in range(len(kinds)):
        if kinds[k] == _BALL or kinds[k] == _FREE:
            return k
    return 0


def sensed_channels(plant: Plant) -> tuple[str, ...]:
    """Return the log channels that a sensor measures: positions, chamber pressures, supply pressure, lengths.

    The order is that of the sensor values in compiled code.
    """
    machine = plant.machine
    names = [f"{machine.position_kind(axis)}.{axis}" for axis in plant.axes]
    for axis in plant.axes[: plant.hydraulic]:
        names += [f"pressure_head.{axis}", f"pressure_rod.{axis}"]
    if plant.hydraulic:
        names.append("pressure_supply")
    return (*names, *(f"length.{axis}" for axis in plant.axes if machine.axes[axis].cylinder))


def split_delay(delay: float, timestep: float) -> tuple[int, float]:
    """Split a delay [s] into whole steps and the remaining fraction of a step, in [0, 1) [1]."""
    steps = math.floor(delay / timestep + _STEP_TOLERANCE)
    rest = delay / timestep - steps
    return steps, rest if rest > _STEP_TOLERANCE else 0.0


STATE_ROW_DTYPE = np.dtype(
    [(name, np.int64) for name in ("rows", "nq", "nv", "na", "plain", "sites", "tip", "warning")]
    + [("timestep", np.float64)]
    + [(name, np.int64) for name in ("qpos", "qvel", "qacc", "act", "site")]  # addresses from here
    + [(name, np.int64) for name in ("to_time", "to_qpos", "to_qvel", "to_qacc", "to_act")]
    + [(name, np.int64) for name in ("to_contact", "to_tip")]
    + [("groups", np.int64)],
    align=True,
)
"""Record type of a Recorder for compiled code."""
_WARNING_COUNT = int(mujoco.mjtWarning.mjNWARNING)


@compiled
def record_row(record, contacts, row, time):
    """Write the current state, aligned in time, to a row of the recorder's arrays.

    Args:
        record: record of a `Recorder`.
        contacts: record of `make_contact_addresses`.
        row: index of the row, scalar.
        time: time of the row, scalar [s].

    Returns:
        Whether the state is finite and MuJoCo has issued no warning.

    Source: `Record`.
    """
    r = record[0]
    velocity, acceleration, act = (
        float64_view(r.qvel, r.nv),
        float64_view(r.qacc, r.nv),
        float64_view(r.act, r.na),
    )
    float64_view(r.to_time, r.rows)[row] = time
    positions = matrix_view(r.to_qpos, r.rows, r.nq)[row : row + 1]
    copy_values(positions[0], float64_view(r.qpos, r.nq))
    _move_back_one_step(positions, velocity.reshape((1, r.nv)), r.timestep, r.plain)
    to_velocity = matrix_view(r.to_qvel, r.rows, r.nv)[row]
    good = True
    for i in range(r.nv):
        to_velocity[i] = velocity[i] - 0.5 * r.timestep * acceleration[i]
        good = good and np.isfinite(acceleration[i])
    copy_values(matrix_view(r.to_qacc, r.rows, r.nv)[row], acceleration)
    copy_values(matrix_view(r.to_act, r.rows, r.na)[row], act)
    if r.tip >= 0:
        copy_values(matrix_view(r.to_tip, r.rows, 3)[row], matrix_view(r.site, r.sites, 3)[r.tip])
    _sum_contact_forces_by_group(contacts[0], matrix_view(r.to_contact, r.rows, 3 * r.groups)[row])
    warnings = int32_view(r.warning, 2 * _WARNING_COUNT)  # information and number of each
    for kind in range(_WARNING_COUNT):
        good = good and warnings[2 * kind + 1] == 0
    return good


class Recorder:
    """Arrays that a run fills, one row per log sample.

    Args:
        plant: the simulated plant.
        rows: number of rows.
    """

    def __init__(self, plant: Plant, rows: int) -> None:
        """Allocate all rows."""
        model = plant.model
        self.model, self._data = model, None
        self.tip_site = model.site(TIP_SITE).id if plant.machine.arm else -1
        self.geom_groups, self.group_names = surrounding_groups(plant)
        self.time = np.zeros(rows)
        self.qpos, self.qvel = np.zeros((rows, model.nq)), np.zeros((rows, model.nv))
        self.qacc, self.act = np.zeros((rows, model.nv)), np.zeros((rows, model.na))
        self.command = np.zeros((rows, model.nu))
        self.contact = np.zeros((rows, len(self.group_names), 3))
        self.tip = np.zeros((rows, 3 if self.tip_site >= 0 else 0))
        late = any(error.is_delayed for error in plant.machine.sensor_errors.values())
        self.late = np.zeros((rows, len(sensed_channels(plant)) if late else 0))

    def record_state(
        self, row: int, time: float, data: mujoco.MjData, delayed_readings: np.ndarray | None = None
    ) -> None:
        """Record the current state; must be called before the next step.

        Args:
            row: index of the row.
            time: time of the row [s].
            data: staggered state after `start_leapfrog` or a step.
            delayed_readings: (c,) delayed values of `sensed_channels`, if a sensor has a delay or lag.

        Raises:
            SimulationFailed: the state is not finite, or MuJoCo has issued a warning.
        """
        self.row_address_records(data)
        if delayed_readings is not None:
            self.record_sensor_values(row, delayed_readings)
        if not record_row(self._row, self._contacts, row, time):
            raise self.instability_error(row)

    def record_sensor_values(self, row: int, delayed_readings: np.ndarray) -> None:
        """Record the delayed values (c,) of `sensed_channels`, if a sensor has a delay or lag."""
        if self.late.shape[1]:
            self.late[row] = delayed_readings

    def row_address_records(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return the records for `record_row`: that of the recorder's arrays and that of the contacts.

        They are created anew if `data` differs from that of the last call.
        """
        if data is not self._data:
            self._create_records(data)
        return self._row, self._contacts

    def _create_records(self, data: mujoco.MjData) -> None:
        """Create the records with the addresses of MuJoCo's data and of this recorder's arrays."""
        model, self._data = self.model, data
        self._row = address_record(
            STATE_ROW_DTYPE,
            {
                "qpos": data.qpos, "qvel": data.qvel, "qacc": data.qacc, "act": data.act,
                "site": data.site_xpos, "to_time": self.time, "to_qpos": self.qpos,
                "to_qvel": self.qvel, "to_qacc": self.qacc, "to_act": self.act,
                "to_contact": self.contact, "to_tip": self.tip,
            },
        )  # fmt: skip
        for name, value in {
            "rows": len(self.time), "nq": model.nq, "nv": model.nv, "na": model.na,
            "plain": _count_alignable_positions(model), "sites": model.nsite, "tip": self.tip_site,
            "warning": data._address + field_offsets("mjData")["warning"],
            "timestep": model.opt.timestep, "groups": len(self.group_names),
        }.items():  # fmt: skip
            self._row[name] = value
        self._contacts = make_contact_addresses(model, data, self.geom_groups)

    def instability_error(self, row: int) -> SimulationFailed:
        """Create the exception for an unstable simulation; its message lists the states up to a row."""
        lines = [f"the simulation became unstable at {self.time[row]:.3f} s; the last states:"]
        for r in range(max(0, row - 3), row + 1):
            qpos, act = (np.array2string(a[r], precision=4) for a in (self.qpos, self.act))
            lines += [f"  t={self.time[r]:.3f} qpos={qpos}", f"    spools and pressures={act}"]
        return SimulationFailed("\n".join(lines))

    def to_record(self, rows: int | None = None) -> Record:
        """Return all rows, or the first `rows` rows, as a Record."""
        contact = self.contact[:rows]
        single = {name: contact[:, k] for k, name in enumerate(self.group_names) if k > 0}
        return Record(
            self.time[:rows], self.qpos[:rows], self.qvel[:rows], self.qacc[:rows],
            self.act[:rows], self.command[:rows], contact.sum(axis=1), single, self.tip[:rows],
            self.late[:rows],
        )  # fmt: skip


def mark_surrounding_bodies(plant: Plant) -> np.ndarray:
    """Return whether each body (nbody,) is the ground, fixed to it, or a surrounding object."""
    model = plant.model
    named = [is_surrounding_object(model.body(b).name) for b in range(model.nbody)]
    return (model.body_weldid == 0) | (np.array(named) & bool(plant.surroundings))


def mark_surrounding_geoms(plant: Plant) -> np.ndarray:
    """Return for each geom (ngeom,) 1 if it belongs to the ground or a surrounding object, else 0."""
    return _geom_flags(plant.model, mark_surrounding_bodies(plant))


def surrounding_groups(plant: Plant) -> tuple[np.ndarray, tuple[str, ...]]:
    """Group the geoms of ground and surrounding objects for the recording of contact forces.

    Args:
        plant: the plant.

    Returns:
        (ngeom,) group of each geom, 0 for the machine and k + 1 for the k-th name; and the names:
        `ground`, including fixed geoms, then every plate, tree, stump and log.
    """
    model, numbers, names = plant.model, mark_surrounding_geoms(plant), ["ground"]
    for geom in np.flatnonzero(numbers):
        name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
        thing = body if model.body_weldid[model.geom_bodyid[geom]] else name
        if plant.surroundings and is_surrounding_object(thing):
            if thing not in names:
                names.append(thing)
            numbers[geom] = names.index(thing) + 1
    return numbers, tuple(names)


def _geom_flags(model: mujoco.MjModel, around: np.ndarray) -> np.ndarray:
    return around[model.geom_bodyid].astype(np.int64)


def total_contact_force(model: mujoco.MjModel, data: mujoco.MjData, around: np.ndarray) -> np.ndarray:
    """Return the sum (3,) of the contact forces of ground and objects on the machine, world frame [N].

    Args:
        model: the model.
        data: its data, with contacts and contact forces.
        around: (nbody,) result of `mark_surrounding_bodies`.
    """
    total, around = np.zeros(3), _geom_flags(model, around)
    sum_contact_forces(make_contact_addresses(model, data, around), total)
    return total


CONTACTS_DTYPE = np.dtype(
    [(name, np.int64) for name in ("function", "model", "data", "count", "contacts", "geoms")]
    + [(name, np.int64) for name in ("size", "frame", "geom", "around")],
    align=True,
)
"""Record type of `make_contact_addresses`."""


def make_contact_addresses(model: mujoco.MjModel, data: mujoco.MjData, around: np.ndarray) -> np.ndarray:
    """Create the record with the addresses of contacts and forces for `sum_contact_forces`.

    Args:
        model: the model.
        data: its data; model and data must outlive the record.
        around: (ngeom,) result of `mark_surrounding_geoms`, which must outlive the record, too.

    Returns:
        (1,) record.
    """
    found, in_data = address_record(CONTACTS_DTYPE, {"around": around}), field_offsets("mjData")
    for name, value in {
        "function": function_address("mj_contactForce"), "model": model._address,
        "data": data._address, "count": data._address + in_data["ncon"],
        "contacts": data._address + in_data["contact"], "geoms": len(around),
        "size": struct_size("mjContact"), "frame": field_offsets("mjContact")["frame"],
        "geom": field_offsets("mjContact")["geom"],
    }.items():  # fmt: skip
        found[name] = value
    return found


@compiled
def sum_contact_forces(record, total):
    """Compute the sum of the contact forces of ground and objects on the machine, in compiled code.

    Args:
        record: record of `make_contact_addresses`.
        total: (3,) written: the sum, world frame [N].

    Returns:
        Nothing.

    Source: `total_contact_force`.
    """
    _sum_contact_forces_by_group(record[0], total)


@compiled
def _sum_contact_forces_by_group(r, totals):
    """Write the sums of the contact forces on the machine per group, in the world frame.

    `totals` (3 n,) [N]: the force of group k is the k-th triple, those of groups above n are added to the last.
    """
    totals[:] = 0.0
    around, wrench, groups = int64_view(r.around, r.geoms), np.empty(6), len(totals) // 3
    first_contact = int64_view(r.contacts, 1)[0]
    for k in range(int32_view(r.count, 1)[0]):
        contact = first_contact + k * r.size
        geom = int32_view(contact + r.geom, 2)
        first, second = around[geom[0]], around[geom[1]]
        if (first > 0) == (second > 0):
            continue  # contact within the machine or between surrounding objects
        call_mj_contact_force(r.function, r.model, r.data, k, wrench.ctypes.data)
        frame, sign = float64_view(contact + r.frame, 9), 1.0 if first > 0 else -1.0
        start = 3 * (min(max(first, second), groups) - 1)
        for i in range(3):
            force = frame[i] * wrench[0] + frame[3 + i] * wrench[1]
            totals[start + i] += sign * (force + frame[6 + i] * wrench[2])


_BRISTLE, _STIFFNESS = int(Slot.BRISTLE), int(Slot.BRISTLE_STIFFNESS)
_SPOOL_CHANNELS = ("spool", "1"), ("spool_rate", "1/s")


@compiled
def state_supply_pressure(user, count, act, scratch):
    """Compute the supply pressure of the hydraulic circuit from the activations of a state.

    Args:
        user: (nu * SLOT_COUNT,) actuator parameters.
        count: number of hydraulic axes, which come first.
        act: (>= 4 count,) activations, and the state of a pump with a time constant.
        scratch: (SCRATCH_SIZE,) work space.

    Returns:
        p_s, scalar [Pa].

    Source: models/cat215/README.md, "Supply".
    """
    compute_inlet_conditions(user, act, act, scratch, 0, count, 0.0, act)
    return circuit_supply_pressure(user, 0, count, scratch, delivered_flow_fraction(user, 0, act))


@compiled
def compute_state_flows_and_forces(user, count, act, x, v):
    """Compute supply pressure, valve flows and drive forces of n states.

    Args:
        user: (nu * SLOT_COUNT,) actuator parameters.
        count: number of hydraulic axes.
        act: (n, >= 4 count) activations.
        x: (n, nu) drive positions [m] or [rad].
        v: (n, nu) drive velocities [m/s] or [rad/s].

    Returns:
        (n, 1 + 3 count): supply pressure [Pa]; then for every axis the valve flows into head and rod
        chamber [m^3/s] and the force after friction [N] or [N m], without terms.

    Source: models/cat215/README.md.
    """
    scratch = np.zeros(SCRATCH_SIZE)
    out = np.zeros((act.shape[0], 1 + 3 * count))
    for row in range(act.shape[0]):
        supply = state_supply_pressure(user, count, act[row], scratch)
        out[row, 0] = supply
        for i in range(count):
            share = 0.0
            if user[i * SLOT_COUNT + _STIFFNESS] > 0.0:
                share = act[row, int(user[i * SLOT_COUNT + _BRISTLE])]
            q_head, q_rod, force = axis_flows_and_force(
                user, i, supply, act[row, 4 * i : 4 * i + 4], x[row, i], v[row, i], share
            )
            out[row, 1 + 3 * i], out[row, 2 + 3 * i], out[row, 3 + 3 * i] = q_head, q_rod, force
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
    """Return values and units of the measurable channels: commands, positions and pressures."""
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
    """Return channel -> (n,) true positions, cylinder lengths and chamber pressures.

    They are read from the positions (n, nq) and activations (n, na) of n states.
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
    """Return the true values after delay and lag of the sensors that have a delay or lag.

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
    """Return values and units of the channels without a sensor: `truth.*`, and the supply pressure."""
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
    """Add channels with spools, flows, forces and supply pressure, by calls `put(name, column, unit)`."""
    count = plant.hydraulic
    if not count:
        return
    x, v = extract_drive_motion(plant, record.qpos, record.qvel)
    user = plant.model.actuator_user.ravel()
    table = compute_state_flows_and_forces(user, count, np.ascontiguousarray(record.act), x, v)
    if plant.machine.valve_axes:
        put("pressure_supply", table[:, 0], "Pa")
    more = evaluate_terms(plant.machine, record.time, record.act, x, v, record.command)
    total = np.zeros(len(record.time))
    for i, name in enumerate(plant.axes[:count]):
        cylinder, pumped = plant.machine.axes[name].cylinder, plant.machine.axes[name].pump
        kinds = (("speed", "rad/s"), ("pressure_load", "Pa")) if pumped else _SPOOL_CHANNELS
        for place, (kind, unit) in enumerate(kinds):
            put(f"truth.{kind}.{name}", record.act[:, ACTIVATIONS_PER_AXIS * i + place], unit)
        put(f"truth.flow_head.{name}", table[:, 1 + 3 * i], "m^3/s")
        put(f"truth.flow_rod.{name}", table[:, 2 + 3 * i], "m^3/s")
        force = table[:, 3 + 3 * i] + more[:, i, 0]
        put(f"truth.force.{name}", force, "N" if cylinder else "N m")
        if cylinder:
            put(f"truth.piston_velocity.{name}", v[:, i], "m/s")
        if pumped:  # has its own pump
            continue
        fed_head = record.act[:, ACTIVATIONS_PER_AXIS * i] > 0.0
        total += np.where(fed_head, table[:, 1 + 3 * i], table[:, 2 + 3 * i])
    if plant.machine.valve_axes:
        put("truth.flow_supply", total, "m^3/s")


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

"""Recording of a run with all states aligned to time t.

MuJoCo's semi-implicit step with the hydraulics is a leapfrog scheme, with velocities at t + h/2 and
positions at t + h. The error of the alignment is of second order in the step, except for friction.
"""

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
    matrix_view,
)
from hydrotele.simulate.contact_forces import make_contact_addresses, sum_contact_forces_by_group, surrounding_groups
from hydrotele.simulate.mechanism import TIP_SITE
from hydrotele.simulate.mujoco_c_api import (
    field_offsets,
)
from hydrotele.simulate.plant import Plant

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
        command: (n, nu) mean command over the interval of the row, each in its drive's unit.
        contact: (n, 3) total contact force of ground and objects on the machine, world frame [N].
        load: (n,) mass of the soil in the bucket [kg].
        contact_of: name of each surrounding object -> (n, 3) its force on the machine [N].
        tip: (n, 3) position of the arm's tip [m]; empty (n, 0) without an arm.
        delayed_readings: (n, c) values of `sensed_channels` after delay and lag of the sensors,
            without other sensor errors; empty (n, 0) if no sensor has a delay or lag.
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    act: np.ndarray
    command: np.ndarray
    contact: np.ndarray
    load: np.ndarray
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


def positions_one_step_earlier(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the current positions (nq,), moved back by one step to the time of the activations.

    Positions from the first ball or free joint on (trees and logs) are not moved back.
    """
    return align_staggered_positions(model, data.qpos, data.qvel)


def align_staggered_positions(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return staggered positions (..., nq), moved back by one step with the velocities (..., nv).

    The result is at the time of the activations, because MuJoCo's positions are one step later.
    Positions from the first ball or free joint on are not moved back.
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
    """Return the names of the log channels of the sensor values, in the order of compiled code.

    These are the positions of all axes, head and rod pressure of every hydraulic axis, the pressure
    of every supply if there are hydraulic axes, and the lengths of all cylinders.
    """
    machine = plant.machine
    names = [f"{machine.position_kind(axis)}.{axis}" for axis in plant.axes]
    for axis in plant.axes[: plant.hydraulic]:
        names += [f"pressure_head.{axis}", f"pressure_rod.{axis}"]
    if plant.hydraulic:
        names += machine.supply_channels
    return (*names, *(f"length.{axis}" for axis in plant.axes if machine.axes[axis].cylinder))


def split_delay(delay: float, timestep: float) -> tuple[int, float]:
    """Split a delay [s] into a number of whole steps and the remaining fraction of a step, in [0, 1)."""
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
    """Write the current state to a row of the recorder's arrays, aligned to the time of the activations.

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
    sum_contact_forces_by_group(contacts[0], matrix_view(r.to_contact, r.rows, 3 * r.groups)[row])
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
        self.load = np.zeros(rows)
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
        """Write the delayed values (c,) of `sensed_channels` to a row.

        Nothing is written if no sensor has a delay or lag.
        """
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
        """Create (not raise) the exception for an unstable simulation.

        Its message lists the states of up to four rows, the last of which is `row`.
        """
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
            self.act[:rows], self.command[:rows], contact.sum(axis=1), self.load[:rows], single,
            self.tip[:rows], self.late[:rows],
        )  # fmt: skip

"""One control period of teleoperation: joystick (master), communication channel and machine (slave).

Two compiled functions run before and after the joystick's motion; a third combines them with the
simulated joystick. Channel delays use ring buffers: a packet that is written at one tick is read
later by its delay.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.servo import DriveReference, interpolate_drive_reference
from hydrotele.core.compiled import compiled
from hydrotele.core.memory import copy_values, float64_view, int32_view, int64_view, matrix_view
from hydrotele.simulate.joystick import flotor_step, flotor_step_in_cab
from hydrotele.teleop.axis_table import DAMPING
from hydrotele.teleop.master import (
    PASSIVITY_CONTROL,
    SENT_SIGNAL,
    WAVE_VARIABLES,
    step_master,
    unpack_master_parameters,
    unpack_master_state,
)
from hydrotele.teleop.neuromuscular_dynamics import compute_muscle_forces, unpack_neuromuscular_state
from hydrotele.teleop.slave import (
    HAND,
    HANDLE,
    HANDLE_SPEED,
    HELD_AT_EDGE,
    NO_PACKETS,
    VALVES_CLOSED,
    measure_tip,
    step_slave,
    unpack_slave_parameters,
    unpack_slave_state,
    write_machine_packet,
)

SILENT_TIME, PACKET_GAIN, PERIOD, MAX_SILENT_TIME, FADE_OUT_TIME = range(5)  # indices into `ChannelBuffers.state`
TICKS_PER_CHECK = 20  # ticks between two safety checks


class SlaveSide(NamedTuple):
    """Arrays of the machine side of teleoperation; k joints of the arm among nu axes.

    Attributes:
        joint: (nu,) measured joint positions of all axes [rad] or [m].
        force: (k,) force of the environment on the tip, in task coordinates [N], [N m].
        columns: (k,) indices of the arm's joints among the axes.
        slave: (24 + 14 k,) SlaveParameters as a flat array.
        state: (102 + 3 k,) SlaveState as a flat array, written.
    """

    joint: np.ndarray
    force: np.ndarray
    columns: np.ndarray
    slave: np.ndarray
    state: np.ndarray


class ChannelBuffers(NamedTuple):
    """Buffers of the communication channel between joystick and machine.

    Attributes:
        forward: (n, 3, 6) ring buffer of the master's packets, written: displacement and rate of
            the handle, and hand force minus the force of the joystick's spring and damper. A
            passive channel replaces the last two by the time integral of its waves or the handle
            position, and the energy.
        back: (n, 8, k) ring buffer of the machine's packets, written.
        packet: (8, k) last packet received by the master, written.
        age: (ticks, 2) age of the arriving packet, forward and back, in ticks; negative if no
            packet arrives that is newer than the last.
        state: (5,) time without a packet from the machine [s] and gain of the packet [1], both written;
            control period, time without packets after which the gain fades out, and fade-out time [s].
    """

    forward: np.ndarray
    back: np.ndarray
    packet: np.ndarray
    age: np.ndarray
    state: np.ndarray


class MasterSide(NamedTuple):
    """Arrays of the operator side of teleoperation: joystick and simulated operator.

    Attributes:
        master: (168,) MasterParameters as a flat array.
        state: (123,) MasterState as a flat array, written.
        qpos: (7,) flotor position [m] and quaternion, scalar first.
        muscles: (80,) NeuromuscularState as a flat array, written.
        past: (d + 1, 6) ring buffer of handle displacements, for a reflex delay of d periods [m],
            [rad].
        tremor: (n, 6) tremor forces of the operator [N], [N m].
    """

    master: np.ndarray
    state: np.ndarray
    qpos: np.ndarray
    muscles: np.ndarray
    past: np.ndarray
    tremor: np.ndarray


@compiled
def step_master_side(tick, has_new_sample, elapsed, tripped, machine, line, operator):
    """Run the first half of a control tick, up to the forces on the joystick's handle.

    The machine's packet is written to the channel, the master receives the newest packet, and the coil
    currents and the operator's muscle forces are computed. The master's packet is written to the
    channel.

    Args:
        tick: number of the control tick, scalar.
        has_new_sample: whether the sensors have a new sample, scalar.
        elapsed: time since the last sample, scalar [s].
        tripped: whether the machine has been stopped permanently, scalar.
        machine: SlaveSide.
        line: ChannelBuffers.
        operator: MasterSide.

    Returns:
        Nothing.

    Source: `teleop.master`, `teleop.slave`, `teleop.operator_model`.
    """
    joint, force, columns, slave_flat, state_flat = machine
    forward, back, packet, age, state = line
    master_flat, master_state, qpos, hand_flat, past, tremor = operator
    k = len(columns)
    slave, s = unpack_slave_parameters(slave_flat, k), unpack_slave_state(state_flat, k)
    m, hand = unpack_master_state(master_state), unpack_neuromuscular_state(hand_flat)
    period, rows = state[PERIOD], len(back)
    arm = np.empty(k)
    for i in range(k):
        arm[i] = joint[columns[i]]
    measure_tip(slave, arm, has_new_sample, elapsed, s)
    write_machine_packet(slave, force, s, back[tick % rows])
    late = age[tick % len(age), 1]
    if late < 0:
        state[SILENT_TIME] += period
    else:
        state[SILENT_TIME] = 0.0
        come = back[(tick - late) % rows]
        for row in range(len(come)):
            for i in range(k):  # values that are not finite are ignored
                if np.isfinite(come[row, i]):
                    packet[row, i] = come[row, i]
    goal = 0.0 if tripped or state[SILENT_TIME] > state[MAX_SILENT_TIME] else 1.0
    state[PACKET_GAIN] += (goal - state[PACKET_GAIN]) * min(1.0, period / state[FADE_OUT_TIME])
    numbers = unpack_master_parameters(master_flat)
    step_master(numbers, qpos, packet, state[PACKET_GAIN], period, tick == 0, m)
    compute_muscle_forces(hand, past, tremor, m.handle, tick, period)
    ahead = forward[tick % len(forward)]
    for i in range(6):
        own = m.stiffness[i] * m.handle[i] + numbers.axis[i, DAMPING] * m.speed[i]
        ahead[HANDLE, i], ahead[HANDLE_SPEED, i] = m.handle[i], m.speed[i]
        ahead[HAND, i] = m.hand[i] - own
        if numbers.kind[0] == WAVE_VARIABLES or numbers.kind[0] == PASSIVITY_CONTROL:
            ahead[HANDLE_SPEED, i], ahead[HAND, i] = (
                m.line[i, SENT_SIGNAL],
                m.line[i, SENT_SIGNAL + 1],
            )


@compiled
def step_slave_side(tick, machine, line, grid, table, scale, reference, rate, drive):
    """Run the second half of a control tick: convert the received packet to references.

    The slave receives the master's packet, and the references of joints and drives are written.

    Args:
        tick: number of the control tick, scalar.
        machine: SlaveSide.
        line: ChannelBuffers.
        grid: (nu, 2) lowest joint position and step of the table, from `tabulate_drive_geometry`.
        table: (nu, points, 3) moment arms and chamber volumes, from `tabulate_drive_geometry`.
        scale: factor on the reference velocities of the drives, the servo's feedforward, scalar.
        reference: (nu,) joint references [rad] or [m]; those of the arm are written.
        rate: (nu,) rates of the joint references [rad/s] or [m/s]; those of the arm are written.
        drive: DriveReference, written.

    Returns:
        Nothing.

    Source: `teleop.slave`, `control.servo`.
    """
    joint, force, columns, slave_flat, state_flat = machine
    forward, _, _, age, state = line
    velocity, arm, volume_head, volume_rod = drive
    k, rows = len(columns), len(forward)
    slave, s = unpack_slave_parameters(slave_flat, k), unpack_slave_state(state_flat, k)
    measured = np.empty(k)
    for i in range(k):
        measured[i] = joint[columns[i]]
    late = age[tick % len(age), 0]
    come = forward[(tick - max(late, 0)) % rows]
    step_slave(slave, come, late >= 0, force, measured, state[PERIOD], s)
    for i in range(k):
        reference[columns[i]], rate[columns[i]] = s.joint[i], s.joint_rate[i]
    interpolate_drive_reference(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod)
    for i in range(k):
        velocity[columns[i]] = scale * arm[columns[i]] * s.ahead[i]


STATION_DTYPE = np.dtype(
    [(name, np.int64) for name in ("axes", "joints", "ticks", "dofs", "swing", "simulated")]
    + [(name, np.int64) for name in ("forward_rows", "back_rows", "ages", "past_rows")]
    + [(name, np.int64) for name in ("tremor_rows", "points", "pose_columns")]
    + [(name, np.int64) for name in ("slave_size", "slave_state_size", "muscles_size")]
    + [(name, np.int64) for name in ("master_size", "master_state_size")]
    + [("sampled", np.int64), ("scale", np.float64), ("sample_period", np.float64)]
    + [(name, np.int64) for name in ("joint", "force", "columns")]  # addresses from here on
    + [(name, np.int64) for name in ("slave", "slave_state", "master", "master_state")]
    + [(name, np.int64) for name in ("forward", "back", "packet", "age", "line_state")]
    + [(name, np.int64) for name in ("qpos", "muscles", "past", "tremor", "qvel", "qacc")]
    + [(name, np.int64) for name in ("grid", "table", "reference", "rate", "pose")]
    + [(name, np.int64) for name in ("velocity", "arm", "volume_head", "volume_rod")]
    + [(name, np.int64) for name in ("log_master", "log_slave", "log_force", "log_muscles")]
    + [(name, np.int64) for name in ("touching", "contacts")],
    align=True,
)
"""Sizes and addresses of the arrays of a `TeleoperationSystem`."""


@compiled
def _unpack_record(r):
    """Return SlaveSide, ChannelBuffers and MasterSide as views of the arrays of a record.

    The record `r` (STATION_DTYPE) holds sizes and memory addresses of the arrays.
    """
    k, rows, back = r.joints, r.forward_rows, r.back_rows
    machine = SlaveSide(
        float64_view(r.joint, r.axes), float64_view(r.force, k), int64_view(r.columns, k),
        float64_view(r.slave, r.slave_size), float64_view(r.slave_state, r.slave_state_size),
    )  # fmt: skip
    line = ChannelBuffers(
        float64_view(r.forward, rows * 18).reshape((rows, 3, 6)),
        float64_view(r.back, back * 8 * k).reshape((back, 8, k)), matrix_view(r.packet, 8, k),
        int64_view(r.age, 2 * r.ages).reshape((r.ages, 2)), float64_view(r.line_state, FADE_OUT_TIME + 1),
    )  # fmt: skip
    operator = MasterSide(
        float64_view(r.master, r.master_size), float64_view(r.master_state, r.master_state_size),
        float64_view(r.qpos, 7), float64_view(r.muscles, r.muscles_size), matrix_view(r.past, r.past_rows, 6),
        matrix_view(r.tremor, r.tremor_rows, 6),
    )  # fmt: skip
    return machine, line, operator


@compiled
def step_teleoperation(station, flotor, tick, tripped):
    """Run one control tick of the whole teleoperation loop, and log it.

    The first half (`step_master_side`), one period of the simulated joystick and the second half
    (`step_slave_side`) follow each other.

    Args:
        station: STATION_DTYPE record, with sizes and addresses of all arrays.
        flotor: `SimulatedFlotor.record`, written.
        tick: number of the control tick, scalar.
        tripped: whether the machine has been stopped permanently, scalar.

    Returns:
        Whether a flag of the slave is set: held at the workspace edge, no packets, valves closed.

    Source: `step_master_side`, `simulate.joystick`, `step_slave_side`.
    """
    r = station[0]
    machine, line, operator = _unpack_record(r)
    fresh, elapsed = tick % r.sampled == 0, r.sample_period if tick > 0 else 0.0
    step_master_side(tick, fresh, elapsed, tripped, machine, line, operator)
    s, m = unpack_slave_state(machine.state, r.joints), unpack_master_state(operator.state)
    force, n, nu = unpack_neuromuscular_state(operator.muscles).force, r.ticks, r.axes
    if r.simulated:
        unpack_master_parameters(operator.master).max_current[0] = flotor[0].allowed
        if r.swing < 0:
            flotor_step(flotor[0], m.currents, force)
        else:
            spin, spin_rate = (
                float64_view(r.qvel, r.dofs)[r.swing],
                float64_view(r.qacc, r.dofs)[r.swing],
            )
            flotor_step_in_cab(flotor[0], m.currents, force, spin, spin_rate)
    copy_values(matrix_view(r.log_master, n, r.master_state_size)[tick], operator.state)
    copy_values(matrix_view(r.log_slave, n, r.slave_state_size)[tick], machine.state)
    copy_values(matrix_view(r.log_force, n, r.joints)[tick], machine.force)
    copy_values(matrix_view(r.log_muscles, n, 6)[tick], force)
    drive = DriveReference(
        matrix_view(r.velocity, n, nu)[tick], matrix_view(r.arm, n, nu)[tick],
        matrix_view(r.volume_head, n, nu)[tick], matrix_view(r.volume_rod, n, nu)[tick],
    )  # fmt: skip
    step_slave_side(
        tick, machine, line, matrix_view(r.grid, nu, 2),
        float64_view(r.table, nu * r.points * 3).reshape((nu, r.points, 3)), r.scale,
        matrix_view(r.reference, n, nu)[tick], matrix_view(r.rate, n, nu)[tick], drive,
    )  # fmt: skip
    copy_values(matrix_view(r.pose, n, r.pose_columns)[tick], s.pose[: r.pose_columns])
    int64_view(r.touching, n)[tick] = int32_view(r.contacts, 1)[0] > 0
    return s.flags[HELD_AT_EDGE] != 0.0 or s.flags[NO_PACKETS] != 0.0 or s.flags[VALVES_CLOSED] != 0.0

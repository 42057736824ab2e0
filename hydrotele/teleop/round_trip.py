"""One control period of teleoperation in two compiled halves, before and after the joystick moves.

Delay lines are rings: what is written at a tick is read as many ticks later as the ring is long.
"""

import numpy as np

from hydrotele.control.drive_rows import drive_row
from hydrotele.core.compiled import compiled
from hydrotele.teleop.master import master_step, unpack_master, unpack_master_state
from hydrotele.teleop.person import pull, unpack_muscles
from hydrotele.teleop.slave import (
    measure_task,
    report,
    slave_step,
    unpack_slave,
    unpack_slave_state,
)

QUIET, SHARE, PERIOD, SILENCE, FADING = range(5)  # of `line`


@compiled
def to_the_hand(
    tick, fresh, elapsed, tripped, joint, force, columns, slave_flat, state_flat, back, packet,
    lost, line, master_flat, master_state, qpos, hand_flat, past, tremor, forward,
):  # fmt: skip
    """Report the machine to the master, reflect, pull: ends in coil currents and muscle forces.

    Args:
        tick: scalar.
        fresh: whether the sensors have a new sample, scalar.
        elapsed: since the last one, scalar [s].
        tripped: whether the machine has been stopped for good, scalar.
        joint: (nu,) measured [rad] or [m].
        force: (k,) at the tip, task coordinates [N], [N m].
        columns: (k,) places of the arm's joints among the axes.
        slave_flat: (21 + 13 k,) Slave.
        state_flat: (52 + 3 k,) SlaveState, written.
        back: (n, 7, k) packets of the machine on their way, written.
        packet: (7, k) the last one that the master got, written.
        lost: (ticks, 2) whether the packet that arrives then is lost: forward, back.
        line: (5,) QUIET, SHARE, written, PERIOD, SILENCE, FADING [s].
        master_flat: (160,) Master.
        master_state: (63,) MasterState, written.
        qpos: (7,) of the flotor: position [m] and quaternion.
        hand_flat: (61,) Muscles, written.
        past: (reflex + 1, 6) see `pull`.
        tremor: (n, 6) see `pull`.
        forward: (n, 3, 6) packets of the master on their way, written: displacement and rate of the
            handle, what is left of the hand's force beyond the joystick's own spring and damper.

    Returns:
        Nothing.

    Source: `teleop.master`, `teleop.slave`, `teleop.person`.
    """
    k = len(columns)
    slave, s = unpack_slave(slave_flat, k), unpack_slave_state(state_flat, k)
    m, hand = unpack_master_state(master_state), unpack_muscles(hand_flat)
    period, rows = line[2], len(back)
    arm = np.empty(k)
    for i in range(k):
        arm[i] = joint[columns[i]]
    measure_task(slave, arm, fresh, elapsed, s)
    report(slave, force, s, back[tick % rows])
    if lost[tick % len(lost), 1]:
        line[0] += period
    else:
        line[0] = 0.0
        for row in range(7):
            for i in range(k):  # a number that is none does not count
                if np.isfinite(back[(tick + 1) % rows, row, i]):
                    packet[row, i] = back[(tick + 1) % rows, row, i]
    goal = 0.0 if tripped or line[0] > line[3] else 1.0
    line[1] += (goal - line[1]) * min(1.0, period / line[4])
    numbers = unpack_master(master_flat)
    master_step(numbers, qpos, packet, line[1], period, tick == 0, m)
    pull(hand, past, tremor, m.handle, tick, period)
    ahead = forward[tick % len(forward)]
    for i in range(6):
        own = m.stiffness[i] * m.handle[i] + numbers.axis[i, 4] * m.speed[i]
        ahead[0, i], ahead[1, i], ahead[2, i] = m.handle[i], m.speed[i], m.hand[i] - own


@compiled
def to_the_machine(
    tick, joint, force, columns, slave_flat, state_flat, forward, lost, line, grid, table, scale,
    reference, rate, velocity, arm, volume_head, volume_rod,
):  # fmt: skip
    """Take the packet that arrives, and write the references of joints and drives.

    Args:
        tick: scalar.
        joint: (nu,) measured [rad] or [m].
        force: (k,) at the tip, task coordinates [N], [N m].
        columns: (k,) places of the arm's joints among the axes.
        slave_flat: (21 + 13 k,) Slave.
        state_flat: (52 + 3 k,) SlaveState, written.
        forward: (n, 3, 6) packets of the master on their way.
        lost: (ticks, 2) whether the packet that arrives then is lost: forward, back.
        line: (5,) see `to_the_hand`.
        grid: (nu, 2) of `drive_tables`.
        table: (nu, POINTS, 3) of `drive_tables`.
        scale: of drive velocities, scalar.
        reference: (nu,) joint references, those of the arm written [rad] or [m].
        rate: (nu,) the same, their rates [rad/s] or [m/s].
        velocity: (nu,) written, see `drive_row` [m/s] or [rad/s].
        arm: (nu,) written.
        volume_head: (nu,) written [m^3].
        volume_rod: (nu,) written [m^3].

    Returns:
        Nothing.

    Source: `teleop.slave`, `control.drive_rows`.
    """
    k, rows = len(columns), len(forward)
    slave, s = unpack_slave(slave_flat, k), unpack_slave_state(state_flat, k)
    measured = np.empty(k)
    for i in range(k):
        measured[i] = joint[columns[i]]
    coming = tick >= rows - 1 and lost[tick % len(lost), 0]
    slave_step(slave, forward[(tick + 1) % rows], not coming, force, measured, line[2], s)
    for i in range(k):
        reference[columns[i]], rate[columns[i]] = s.joint[i], s.joint_rate[i]
    drive_row(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod)
    for i in range(k):
        velocity[columns[i]] = scale * arm[columns[i]] * s.ahead[i]

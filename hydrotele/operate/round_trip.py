"""One control period of teleoperation in two compiled halves, before and after the joystick moves.

Delay lines are rings: what is written at a tick is read as many ticks later as the ring is long.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.operate.drive_rows import drive_row
from hydrotele.operate.master import master_step
from hydrotele.operate.muscles import pull
from hydrotele.operate.slave import measure_task, report, slave_step

QUIET, SHARE = range(2)


class Line(NamedTuple):
    """The line between the two sides.

    Attributes:
        forward: (n, 3, 6) packets of the master on their way.
        back: (n, 7, k) packets of the machine on their way.
        packet: (7, k) the last one that the master got.
        lost: (ticks, 2) whether the packet that arrives then is lost: forward, back.
        state: (2,) since when none came back [s]; share of the reflected force that counts.
        times: (3,) of the control period, of silence that is borne, of fading [s].
    """

    forward: np.ndarray
    back: np.ndarray
    packet: np.ndarray
    lost: np.ndarray
    state: np.ndarray
    times: np.ndarray


@compiled
def to_the_hand(tick, fresh, elapsed, tripped, joint, force, slave, s, line, master, m, qpos, hand):
    """Report the machine to the master, reflect, pull: ends in coil currents and muscle forces.

    Args:
        tick: scalar.
        fresh: whether the sensors have a new sample, scalar.
        elapsed: since the last one, scalar [s].
        tripped: whether the machine has been stopped for good, scalar.
        joint: (k,) measured [rad].
        force: (k,) at the tip, task coordinates [N], [N m].
        slave: Slave.
        s: SlaveState, written.
        line: Line, written.
        master: Master.
        m: MasterState, written.
        qpos: (7,) of the flotor: position [m] and quaternion.
        hand: Muscles, written.

    Returns:
        Nothing.

    Source: `operate.master`, `operate.slave`, `operate.muscles`.
    """
    period = line.times[0]
    measure_task(slave, joint, fresh, elapsed, s)
    rows = len(line.back)
    report(slave, force, s, line.back[tick % rows])
    if line.lost[tick % len(line.lost), 1]:
        line.state[0] += period
    else:
        line.state[0] = 0.0
        line.packet[:] = line.back[(tick + 1) % rows]
    goal = 0.0 if tripped or line.state[0] > line.times[1] else 1.0
    line.state[1] += (goal - line.state[1]) * min(1.0, period / line.times[2])
    master_step(master, qpos, line.packet, line.state[1], period if tick else 0.0, m)
    pull(hand, m.handle, tick, period)
    ahead = line.forward[tick % len(line.forward)]
    ahead[0], ahead[1], ahead[2] = m.handle, m.speed, m.hand


@compiled
def to_the_machine(
    tick, joint, force, columns, slave, s, line, grid, table, scale, reference, rate, velocity, arm,
    volume_head, volume_rod,
):  # fmt: skip
    """Take the packet that arrives, and write the references of joints and drives.

    Args:
        tick: scalar.
        joint: (k,) measured [rad].
        force: (k,) at the tip, task coordinates [N], [N m].
        columns: (k,) places of the arm's joints among the axes.
        slave: Slave.
        s: SlaveState, written.
        line: Line.
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

    Source: `operate.slave`, `operate.drive_rows`.
    """
    rows = len(line.forward)
    coming = tick >= rows - 1 and line.lost[tick % len(line.lost), 0]
    packet = line.forward[(tick + 1) % rows]
    slave_step(slave, packet, not coming, force, joint, line.times[0], s)
    for i in range(len(columns)):
        reference[columns[i]], rate[columns[i]] = s.joint[i], s.joint_rate[i]
    drive_row(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod)
    for i in range(len(columns)):
        velocity[columns[i]] = scale * arm[columns[i]] * s.ahead[i]

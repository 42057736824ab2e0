"""The slave's side of teleoperation as arrays: its numbers, its state, and how they lie flat."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled

BLOCKED, SILENT, TRIPPED, AGE = range(4)  # of `SlaveState.flags`
# columns of `Slave.table`
AXIS, WAY, SCALE, EDGE, STOP, SPRING, DAMPER, SHARE, LEVERAGE, FASTEST, STRONGEST = range(11)
SILENCE, FOLLOWING, ACCELERATION, VIRTUAL_MASS, LEAD = range(5)  # of `Slave.limits`
# rows of a command packet
HANDLE, HANDLE_SPEED, HAND = range(3)


class Slave(NamedTuple):
    """Numbers of the slave's side; k joints and task coordinates.

    Attributes:
        arm: (9,) of `kinematics.task.task_numbers`.
        ranges: (k, 2) joint ranges [rad].
        start: (5,) pose at the start: r [m], theta [rad], z [m], attitude [rad], head [rad].
        table: (k, 11) of every coordinate: joystick axis (-1 without), sign, gain, dead band,
            reach, coupling, its damping, hand per machine force, lever of the virtual mass [1] or
            [m^2], largest speed [m/s] or [rad/s], largest force that counts [N] or [N m].
        limits: (5,) silence [s], following error [rad], acceleration [m/s^2] or [rad/s^2], virtual
            mass [kg], lead of the drives [s].
        kind: (2,) structure and mode.
    """

    arm: np.ndarray
    ranges: np.ndarray
    start: np.ndarray
    table: np.ndarray
    limits: np.ndarray
    kind: np.ndarray


class SlaveState(NamedTuple):
    """What the slave's side knows and asks for.

    Attributes:
        pose: (5,) of the references [m], [rad].
        rate: (5,) of it.
        joint: (k,) joint references [rad].
        joint_rate: (k,) [rad/s].
        ahead: (k,) rates as they will be by the time the valves have moved [rad/s].
        measured: (2, 5) pose of the measured joints and its filtered rate.
        command: (3, 6) last packet: handle, its rate, hand's force.
        force_integral: (5,) of the hand's force, for four channels under rate control.
        asked: (5,) integral of the rate that the handle asks for, for the same [m], [rad].
        flags: (4,) whether it is held at the edge, the line silent, the valves closed for good; age
            of the last packet [s].
    """

    pose: np.ndarray
    rate: np.ndarray
    joint: np.ndarray
    joint_rate: np.ndarray
    ahead: np.ndarray
    measured: np.ndarray
    command: np.ndarray
    force_integral: np.ndarray
    asked: np.ndarray
    flags: np.ndarray


@compiled
def unpack_slave(flat, k):
    """The parts of `flat_view(Slave)`.

    Args:
        flat: (21 + 13 k,) array.
        k: number of joints, scalar.

    Returns:
        Slave, views of it.

    Source: order and shapes of Slave.
    """
    a = 9 + 2 * k
    b = a + 5
    c = b + 11 * k
    return Slave(
        flat[0:9], flat[9:a].reshape(k, 2), flat[a:b], flat[b:c].reshape(k, 11), flat[c : c + 5],
        flat[c + 5 : c + 7],
    )  # fmt: skip


@compiled
def unpack_slave_state(flat, k):
    """The parts of `flat_view(SlaveState)`.

    Args:
        flat: (52 + 3 k,) array.
        k: number of joints, scalar.

    Returns:
        SlaveState, views of it.

    Source: order and shapes of SlaveState.
    """
    a = 10 + 3 * k
    return SlaveState(
        flat[0:5], flat[5:10], flat[10 : 10 + k], flat[10 + k : 10 + 2 * k], flat[10 + 2 * k : a],
        flat[a : a + 10].reshape(2, 5), flat[a + 10 : a + 28].reshape(3, 6),
        flat[a + 28 : a + 33], flat[a + 33 : a + 38], flat[a + 38 : a + 42],
    )  # fmt: skip

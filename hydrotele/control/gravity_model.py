"""Static model of an arm: the torque of its weight, linear in a few parameters."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.control.recursive import RecursiveLeastSquares
from hydrotele.control.state_filter import LOW, RATE, filter_table, filtered
from hydrotele.control.tip_balance import (
    arm_joints,
    arm_tables,
    dynamic_balance,
    free_axes,
    gravity_size,
    static_torque,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine

_NAMES = ("C2", "S2", "C23", "S23", "C234", "S234", "C5")
_GRID = 9  # poses per joint to which the masses' torques are fitted
_SPREAD = 3.0e5  # N m: nothing is known of the parameters before
_RUBBING = 3.0e4  # N: nor of friction
_PERIOD = 0.2  # s between equations
_SMOOTH = 1.0  # Hz
_CREEP = 5.0e-3  # m/s or rad/s: slower drives may stand, and are asked nothing about friction
_START = 50  # equations whose parameters are no estimate yet (Zhu 1994, 6.1.3)
_NORMAL = 1.96


@dataclass(frozen=True)
class Gravity:
    """Parameters of the static model.

    Attributes:
        names: (p,) what every parameter multiplies: C2, S2, C23, S23, C234, S234, C5.
        value: (p,) parameters [N m].
        interval: (p,) half the width of their 95 % interval [N m]; 0 where they were computed.
        history: (r, p) parameters after every equation [N m]; empty where they were computed.
        residual: (m - 1,) RMS of the torques that are left, from the boom outwards [N m].
    """

    names: tuple[str, ...]
    value: np.ndarray
    interval: np.ndarray
    history: np.ndarray
    residual: np.ndarray


def gravity_rows(q: np.ndarray) -> np.ndarray:
    """Rows Y of the static model `tau = Y(q) P`.

    Args:
        q: (m,) joint angles of the arm, swing first [rad].

    Returns:
        (m, p) [1].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    joint, size = np.arange(len(q)), gravity_size(len(q))
    units = np.eye(size)
    return np.array(
        [[static_torque(q, joint, units[p], i) for p in range(size)] for i in range(len(q))]
    )


def gravity_from_masses(machine: Machine) -> Gravity:
    """The static model that comes nearest to the torques of all a machine's masses.

    Fitted to the complete model at rest over the joints' ranges. The links' own weight is of the
    form of the model; that of cylinders and linkages is not, which leaves `residual`.

    Args:
        machine: with an arm whose joints are driven by valves.

    Returns:
        The parameters.

    Raises:
        InputError: the arm's joints are not all driven.
    """
    arm = arm_tables(machine, f"gravity of {machine.name}")
    joints = arm_joints(machine)
    ranges = [machine.joints[j].range or (-math.pi, math.pi) for j in joints[1:]]
    grid = np.meshgrid(*(np.linspace(low, high, _GRID) for low, high in ranges), indexing="ij")
    poses = np.column_stack([np.zeros(grid[0].size), *(axis.ravel() for axis in grid)])
    torque = np.zeros((len(poses), len(joints)))
    _weights(arm, poses, torque)
    rows = np.array([gravity_rows(q)[1:] for q in poses])
    value = np.linalg.lstsq(rows.reshape(-1, rows.shape[2]), torque[:, 1:].ravel(), rcond=None)[0]
    left = torque[:, 1:] - rows @ value
    size = len(value)
    return Gravity(
        _NAMES[:size], value, np.zeros(size), np.zeros((0, size)), np.sqrt(np.mean(left**2, axis=0))
    )


@compiled
def _weights(arm, poses, torque):
    """Torques (r, m) of gravity on the arm's joints in poses (r, m)."""
    outside = np.zeros(len(arm.work))
    for row in range(len(poses)):
        for i in range(len(arm.joint)):
            arm.z[arm.joint[i]] = poses[row, i]
        dynamic_balance(arm, outside)
        for i in range(len(arm.joint)):
            torque[row, i] = outside[arm.joint[i]]


class SlowMoves(NamedTuple):
    """What slow moves tell of an arm with m joints, r rows; all passed the same filter.

    Attributes:
        angle: (r, m) [rad].
        torque: (r, m) of the drives [N m].
        rubbing: (r, m) torque of a newton of dry friction of the drive; 0 where it may stand [m].
    """

    angle: np.ndarray
    torque: np.ndarray
    rubbing: np.ndarray


def slow_moves(machine: Machine, log: Log) -> SlowMoves:
    """Angles and torques of an arm's drives in a log, by virtual work through their linkages.

    Args:
        machine: the machine.
        log: measured angles and pressures.

    Returns:
        One row for every period between equations.

    Raises:
        InputError: a channel is missing, or a joint is not driven by a valve.

    Source: Zhu 1994, 6.12 and 6.13.
    """
    free_axes(machine, f"torques of {machine.name}")
    driver = {axis.joint: name for name, axis in machine.axes.items()}
    table, every = filter_table(_SMOOTH, 1.0 / log.rate), max(1, round(_PERIOD * log.rate))
    columns = []
    for name in (driver[joint] for joint in arm_joints(machine)):
        head, rod = machine.axes[name].hydraulic_drive.areas
        force = head * log[f"pressure_head.{name}"] - rod * log[f"pressure_rod.{name}"]
        moved, pushed = (filtered(table, x)[::every] for x in (log[f"angle.{name}"], force))
        lever = axis_linkage(machine, name).rate(moved[:, LOW])
        speed = np.abs(lever * moved[:, RATE])
        way = np.where(speed > _CREEP, np.sign(moved[:, RATE]), 0.0)
        columns.append((moved[:, LOW], lever * pushed[:, LOW], np.abs(lever) * way))
    return SlowMoves(*(np.column_stack(part) for part in zip(*columns, strict=True)))


def identify_gravity(machine: Machine, log: Log, friction: bool = True) -> Gravity:
    """Static model of a machine from a log of slow moves, by recursive least squares.

    Args:
        machine: the machine; its masses are not used.
        log: measured angles and pressures of joints that move slowly to and fro over their ranges.
        friction: whether a dry friction of every drive is estimated along with it, or left in the
            torques as by Zhu, to average out.

    Returns:
        The parameters with their history.

    Raises:
        InputError: a channel is missing or the log is too short.

    Source: Zhu 1994, 6.1.3.
    """
    moves = slow_moves(machine, log)
    size, joints = gravity_size(moves.angle.shape[1]), moves.angle.shape[1]
    if len(moves.angle) < _START:
        raise InputError(log.source, f"{_START * _PERIOD:g} s of slow moves are needed at least")
    rows = np.array([gravity_rows(q)[1:] for q in moves.angle])
    if friction:
        rubbing = moves.rubbing[:, 1:, None] * np.eye(joints - 1)
        rows = np.concatenate([rows, rubbing], axis=2)
    spread = np.append(np.full(size, _SPREAD), np.full(rows.shape[2] - size, _RUBBING))
    found, history = RecursiveLeastSquares(np.zeros(rows.shape[2]), spread), []
    for table, torque in zip(rows, moves.torque[:, 1:], strict=True):
        for row, one in zip(table, torque, strict=True):
            found.update(row, one)
        history.append(found.value[:size])
    left = moves.torque[:, 1:] - rows @ found.value
    usual = math.sqrt(float(np.sum(left**2)) / (left.size - rows.shape[2]))
    return Gravity(
        _NAMES[:size],
        found.value[:size],
        _NORMAL * usual * np.sqrt(np.diag(found.covariance)[:size]),
        np.array(history),
        np.sqrt(np.mean(left**2, axis=0)),
    )

"""Static model of an arm's gravity torques, linear in its parameters, and its identification (Zhu 1994, 6.1).

`fit_gravity_to_masses` fits it to the masses of a machine, `identify_gravity` to a log of slow motion.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hydrotele.control.state_filter import (
    RATE,
    VALUE,
    filter_signal,
    filter_step_matrix,
)
from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.control.tip_balance import (
    arm_joints,
    compute_dynamic_external_forces,
    create_arm_balance,
    gravity_parameter_count,
    independent_axes,
    joint_gravity_torque,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine

_GRAVITY_NAMES = ("C2", "S2", "C23", "S23", "C234", "S234", "C5")
_POSES_PER_JOINT = 9  # poses per joint at which the static model is fitted to the masses
_INITIAL_GRAVITY_STD = 3.0e5  # N m, initial standard deviation of the gravity parameters: no prior knowledge
_INITIAL_FRICTION_STD = 3.0e4  # N, initial standard deviation of dry friction
EQUATION_PERIOD_S = 0.2
"""Time between the equations of an identification [s]."""
_SLOW_MOTION_BANDWIDTH_HZ = 1.0  # Hz, bandwidth of the filter of slow motion
_MIN_SLIDING_SPEED = 5.0e-3  # m/s or rad/s: slower drives may be at rest and give no friction equation
_MIN_EQUATIONS = 50  # equations before the parameters are a valid estimate (Zhu 1994, 6.1.3)
_NORMAL95 = 1.96


@dataclass(frozen=True)
class GravityModel:
    """Parameters of the static gravity model.

    Attributes:
        names: (p,) trigonometric factors of the parameters: C2, S2, C23, S23, C234, S234, C5, where
            C23 is cos(q2 + q3) and so on.
        value: (p,) parameters [N m].
        ci95_half_width: (p,) half width of the 95 % intervals [N m]; 0 if computed from masses.
        history: (r, p) parameters after each of r instants of the identification [N m]; empty if
            computed from masses.
        residual: (m - 1,) RMS of the residual torques of each joint from the boom outwards [N m].
        outlier_indices: (q,) indices of the instants removed as outliers, sorted.
    """

    names: tuple[str, ...]
    value: np.ndarray
    ci95_half_width: np.ndarray
    history: np.ndarray
    residual: np.ndarray
    outlier_indices: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def gravity_regressor(q: np.ndarray) -> np.ndarray:
    """Return the regressor Y of the static model `tau = Y(q) P` of an arm's gravity torques tau [N m].

    P are the gravity parameters [N m].

    Args:
        q: (m,) joint angles of the arm, swing first [rad].

    Returns:
        (m, p) regressor of m joints and p parameters [1].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    joint, size = np.arange(len(q)), gravity_parameter_count(len(q))
    units = np.eye(size)
    return np.array([[joint_gravity_torque(q, joint, units[p], i) for p in range(size)] for i in range(len(q))])


def fit_gravity_to_masses(machine: Machine) -> GravityModel:
    """Fit the static model to the gravity torques of a machine's masses.

    The complete model at rest is fitted over the ranges of the joints. The gravity torques of
    the links have the form of the static model. Those of cylinders and linkages do not, which causes the
    residual torques.

    Args:
        machine: machine with an arm whose joints are driven by valves.

    Returns:
        The gravity parameters and the residual torques of the fit.

    Raises:
        InputError: the arm's joints are not all driven.
    """
    arm = create_arm_balance(machine, f"gravity of {machine.name}")
    joints = arm_joints(machine)
    ranges = [machine.joints[j].range or (-math.pi, math.pi) for j in joints[1:]]
    grid = np.meshgrid(*(np.linspace(low, high, _POSES_PER_JOINT) for low, high in ranges), indexing="ij")
    poses = np.column_stack([np.zeros(grid[0].size), *(axis.ravel() for axis in grid)])
    torque = np.zeros((len(poses), len(joints)))
    _gravity_torques(arm, poses, torque)
    rows = np.array([gravity_regressor(q)[1:] for q in poses])
    value = np.linalg.lstsq(rows.reshape(-1, rows.shape[2]), torque[:, 1:].ravel(), rcond=None)[0]
    left = torque[:, 1:] - rows @ value
    size = len(value)
    return GravityModel(
        _GRAVITY_NAMES[:size],
        value,
        np.zeros(size),
        np.zeros((0, size)),
        np.sqrt(np.mean(left**2, axis=0)),
    )


@compiled
def _gravity_torques(arm, poses, torque):
    """Compute the gravity torques on the m joints of an arm at rest in r poses, by the complete model.

    Args:
        arm: ArmBalance; its positions are overwritten.
        poses: (r, m) joint angles [rad].
        torque: (r, m) written: torques that hold the arm [N m].
    """
    outside = np.zeros(len(arm.work))
    for row in range(len(poses)):
        for i in range(len(arm.joint)):
            arm.z[arm.joint[i]] = poses[row, i]
        compute_dynamic_external_forces(arm, outside)
        for i in range(len(arm.joint)):
            torque[row, i] = outside[arm.joint[i]]


class SlowMotion(NamedTuple):
    """Low-pass filtered signals of slow motion of an arm with m joints at r instants.

    Attributes:
        angle: (r, m) joint angles [rad].
        torque: (r, m) torques of the drives on the joints [N m].
        friction_torque: (r, m) torque per newton of dry friction of the drive, with the sign of the
            joint rate [m]; 0 if the drive may be at rest.
    """

    angle: np.ndarray
    torque: np.ndarray
    friction_torque: np.ndarray


def extract_slow_motion(machine: Machine, log: Log, period: float = EQUATION_PERIOD_S) -> SlowMotion:
    """Compute joint angles and drive torques of an arm from a log of slow motion, low-pass filtered at 1 Hz.

    Drive forces follow from the pressures. They are converted to joint torques by virtual work
    through the linkages.

    Args:
        machine: the machine.
        log: measured angles and pressures.
        period: time between rows [s], rounded to a multiple of the log's period.

    Returns:
        The filtered signals, one row per period.

    Raises:
        InputError: a channel is missing, or a joint is not driven by a valve.

    Source: Zhu 1994, 6.12 and 6.13.
    """
    independent_axes(machine, f"torques of {machine.name}")
    driver = {axis.joint: name for name, axis in machine.axes.items()}
    table, every = (
        filter_step_matrix(_SLOW_MOTION_BANDWIDTH_HZ, 1.0 / log.rate),
        max(1, round(period * log.rate)),
    )
    columns = []
    for name in (driver[joint] for joint in arm_joints(machine)):
        head, rod = machine.axes[name].hydraulic_drive.effective_areas
        force = head * log[f"pressure_head.{name}"] - rod * log[f"pressure_rod.{name}"]
        moved, pushed = (filter_signal(table, x)[::every] for x in (log[f"angle.{name}"], force))
        lever = axis_linkage(machine, name).rate(moved[:, VALUE])
        speed = np.abs(lever * moved[:, RATE])
        way = np.where(speed > _MIN_SLIDING_SPEED, np.sign(moved[:, RATE]), 0.0)
        columns.append((moved[:, VALUE], lever * pushed[:, VALUE], np.abs(lever) * way))
    return SlowMotion(*(np.column_stack(part) for part in zip(*columns, strict=True)))


def identify_gravity(
    machine: Machine, log: Log, friction: bool = True, *, remove_outliers: bool = False,
    period: float = EQUATION_PERIOD_S,
) -> GravityModel:  # fmt: skip
    """Identify the static gravity model from a log of slow motion by recursive least squares.

    Every `period` gives an instant with one torque equation per joint, except the swing joint. With
    `remove_outliers`, instants with a large residual, as during a temporary sensor failure, are
    removed and the estimation is repeated until none is left. By Chauvenet's criterion, the
    residual of a joint is large if less than half a residual of this size or larger is expected in
    all instants. The expected distribution is normal, with its scale from the joint's median
    absolute residual.

    Args:
        machine: the machine; its masses are not used.
        log: measured angles and pressures of joints that move slowly back and forth over their
            ranges.
        friction: whether dry friction of every drive is estimated as well. If not, friction is
            assumed to average out over both directions of motion, as in Zhu.
        remove_outliers: whether instants with large residuals are removed.
        period: time between the instants [s].

    Returns:
        The gravity parameters with their intervals, their history, the RMS residuals, and the
        removed instants.

    Raises:
        InputError: a channel is missing, the log is too short, or fewer than 50 instants are left
            after removing outliers.

    Source: Zhu 1994, 6.1.3; Chauvenet 1863, A manual of spherical and practical astronomy, vol. 2.

    Examples:
        A slow motion identifies the static moments of an excavator's arm from its pressures. They agree with those
        that follow from the masses of the machine file.

        >>> import hydrotele as ht
        >>> from hydrotele.control.gravity_model import fit_gravity_to_masses
        >>> run = ht.run_scenario(ht.load_scenario("slow_moves", {"duration": "60", "sensors": "ideal"}))
        >>> machine = run.plant.machine
        >>> found = ht.identify_gravity(machine, run.measured)
        >>> for name, value, true in zip(found.names, found.value, fit_gravity_to_masses(machine).value):
        ...     print(f"{name}: {value / 1e3:.1f} kN m, from the masses {true / 1e3:.1f} kN m")
        C2: 136.5 kN m, from the masses 136.4 kN m
        S2: -6.4 kN m, from the masses -5.8 kN m
        C23: 21.5 kN m, from the masses 21.7 kN m
        S23: -1.5 kN m, from the masses -1.4 kN m
        C234: 4.5 kN m, from the masses 4.5 kN m
        S234: -1.8 kN m, from the masses -1.7 kN m
    """
    moves = extract_slow_motion(machine, log, period)
    size, joints = gravity_parameter_count(moves.angle.shape[1]), moves.angle.shape[1]
    rows = np.array([gravity_regressor(q)[1:] for q in moves.angle])
    if friction:
        rubbing = moves.friction_torque[:, 1:, None] * np.eye(joints - 1)
        rows = np.concatenate([rows, rubbing], axis=2)
    torque, kept = moves.torque[:, 1:], np.ones(len(rows), bool)
    while True:
        if np.count_nonzero(kept) < _MIN_EQUATIONS:
            raise InputError(log.source, f"at least {_MIN_EQUATIONS * period:g} s of slow motion are needed")
        found, history = _solve_recursively(rows[kept], torque[kept], size)
        left = torque - rows @ found.value
        outside = kept & _are_outliers(left, kept)
        if not remove_outliers or not outside.any():
            break
        kept &= ~outside
    left = left[kept]
    usual = math.sqrt(float(np.sum(left**2)) / (left.size - rows.shape[2]))
    return GravityModel(
        _GRAVITY_NAMES[:size],
        found.value[:size],
        _NORMAL95 * usual * np.sqrt(np.diag(found.covariance)[:size]),
        np.array(history),
        np.sqrt(np.mean(left**2, axis=0)),
        np.flatnonzero(~kept),
    )


def _solve_recursively(
    rows: np.ndarray, torque: np.ndarray, size: int
) -> tuple[RecursiveLeastSquares, list[np.ndarray]]:
    """Solve the equations `rows @ P = torque` by recursive least squares.

    Args:
        rows: (r, m - 1, p) regressors of r instants, without the swing joint.
        torque: (r, m - 1) torques of the drives [N m].
        size: number of gravity parameters, which are the first of the p parameters; the others are
            the dry friction of the drives.

    Returns:
        The estimator with the final parameters P, and the gravity parameters (size,) after every
        instant [N m].
    """
    spread = np.append(np.full(size, _INITIAL_GRAVITY_STD), np.full(rows.shape[2] - size, _INITIAL_FRICTION_STD))
    found, history = RecursiveLeastSquares(np.zeros(rows.shape[2]), spread), []
    for table, torques in zip(rows, torque, strict=True):
        for row, one in zip(table, torques, strict=True):
            found.update(row, one)
        history.append(found.value[:size])
    return found, history


def _are_outliers(residuals: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return for each instant (r,) whether the residual of any joint is an outlier (Chauvenet's criterion).

    Args:
        residuals: (r, m - 1) residual torques of the joints [N m].
        kept: (r,) False for instants that were removed before. The scale of the residuals, from
            their median absolute value per joint, and the number of instants count only the others.
    """
    from scipy.special import ndtri  # imported here, because runs do not need it

    scale = np.median(np.abs(residuals[kept]), axis=0) / ndtri(0.75)
    most = -ndtri(0.25 / np.count_nonzero(kept))
    return np.asarray((np.abs(residuals) > most * scale).any(axis=1))

"""Force regressor of a machine with closed chains: drive forces, linear in the parameters."""

from dataclasses import dataclass

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dynamics.integrate import place
from hydrotele.dynamics.mechanism import (
    BAR,
    COM,
    DAMPING,
    INERTIA,
    JOINT,
    MASS,
    body_names,
    coordinate_names,
)
from hydrotele.dynamics.model import Model, model_space, reduced_model
from hydrotele.dynamics.motion import (
    ACCELERATION,
    DRIFT,
    LENGTH_BIAS,
    LENGTH_ROW,
    RATE,
    SPIN,
    SPIN_RATE,
    TURN,
)
from hydrotele.errors import InputError
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.identify.friction_columns import friction_columns
from hydrotele.machine import Machine

# Of one body, in its own frame: mass, mass times centre of mass, inertia about the frame's origin.
BODY_PARAMETERS = {
    "mass": "kg", "moment_x": "kg m", "moment_y": "kg m", "moment_z": "kg m",
    "inertia_xx": "kg m^2", "inertia_xy": "kg m^2", "inertia_xz": "kg m^2",
    "inertia_yy": "kg m^2", "inertia_yz": "kg m^2", "inertia_zz": "kg m^2",
}  # fmt: skip
_PAIRS = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])
_WHERE = "regressor"


@dataclass(frozen=True)
class Regressor:
    """Forces of all drives at every row as matrix times parameters.

    Attributes:
        matrix: (n, k, m) force [N] or torque [N m] of drive k per unit of parameter m.
        axes: the k axes in actuator order.
        names: the m parameters, such as `mass.boom`, `inertia_yy.boom_rod`, `viscous.swing`.
        units: (m,) their SI units.
        nominal: (m,) their values in the machine.
    """

    matrix: np.ndarray
    axes: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray


def regressor(
    machine: Machine, positions: np.ndarray, rates: np.ndarray, accelerations: np.ndarray
) -> Regressor:
    """Regressor of a whole log: `matrix @ nominal` is what the drives must do for the motion.

    Columns: ten inertial parameters of every link, tube and rod, gravity included; dampers of
    joints that have one; inertia of drives behind a transmission, which counts as rigid; friction
    columns as in `friction_columns`. The force of a drive is `A_h p_A - A_r p_B`, or D (p_A - p_B)
    of a motor, so the friction is a part of what is needed.

    Args:
        machine: the machine, whose loops must be closed by its geometry alone.
        positions: (n, k) joint positions of the k axes, in actuator order [rad] or [m].
        rates: (n, k) [rad/s] or [m/s].
        accelerations: (n, k) [rad/s^2] or [m/s^2].

    Returns:
        The regressor.

    Raises:
        InputError: another shape, a value is missing, or not every independent joint has a drive.

    Source: Newton-Euler about the link frames, projected on the closed chains by virtual work;
    Khoshzaban 1992, chapter 4.
    """
    axes, model = actuator_order(machine), reduced_model(machine, ())
    free = {int(joint): i for i, joint in enumerate(model.mech.free)}
    if sorted(map(int, model.mech.drive[:, JOINT])) != sorted(free):
        joints = coordinate_names(machine)
        loose = sorted({joints[i] for i in free} - {machine.axes[a].joint for a in axes})
        raise InputError(
            _WHERE,
            f"machine {machine.name} has joints without a drive ({', '.join(loose) or 'none'}) or"
            " drives without an independent joint; forces follow only where each has its own",
        )
    motion = [_table(v, len(axes)) for v in (positions, rates, accelerations)]
    if len({len(part) for part in motion}) > 1:
        raise InputError(_WHERE, "positions, rates and accelerations must have the same rows")
    place_of = [free[int(joint)] for joint in model.mech.drive[:, JOINT]]
    table = np.empty((len(motion[0]), 3, len(axes)))
    table[:, :, place_of] = np.stack(motion, axis=1)
    damped = np.flatnonzero(model.mech.joint[DAMPING])
    bodies = body_names(machine)[1:]
    width = 10 * len(bodies) + len(damped) + len(model.transmission)
    matrix = np.zeros((len(table), len(axes), width))
    velocities = _fill(model, model_space(model), table, damped, matrix)
    names = [f"{kind}.{body}" for body in bodies for kind in BODY_PARAMETERS]
    units = [*BODY_PARAMETERS.values()] * len(bodies)
    nominal = [*_inertial(model), *model.mech.joint[DAMPING][damped], *model.transmission[:, 0]]
    joints = coordinate_names(machine)
    hinges = [machine.joints[joints[i]].type == "hinge" for i in damped]
    names += [f"damping.{joints[i]}" for i in damped]
    units += ["N m s/rad" if hinge else "N s/m" for hinge in hinges]
    for axis, gear in zip(axes, model.gear, strict=True):
        if gear >= 0:
            names.append(f"drive_inertia.{axis}")
            units.append("kg" if machine.axes[axis].cylinder else "kg m^2")
    extra = friction_columns(machine, velocities)
    return Regressor(
        np.concatenate([matrix, extra.matrix], axis=2), tuple(axes), (*names, *extra.names),
        (*units, *extra.units), np.concatenate([nominal, extra.nominal]),
    )  # fmt: skip


def _table(values: np.ndarray, width: int) -> np.ndarray:
    table = np.array(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(_WHERE, f"motion must be (n, {width}), one column per axis: {table.shape}")
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_WHERE, f"row {row} has no motion: smooth the log over its gaps first")
    return table


def _inertial(model: Model) -> np.ndarray:
    """(10 b,) parameters of all bodies but the world, about their frames."""
    mech = model.mech
    rows = []
    for body in mech.shape[1 : mech.bodies]:
        mass, com, inertia = body[MASS], body[COM : COM + 3], body[INERTIA : INERTIA + 3]
        about = np.diag(inertia) + mass * (com @ com * np.eye(3) - np.outer(com, com))
        rows.append([mass, *(mass * com), *about[_PAIRS[:, 0], _PAIRS[:, 1]]])
    return np.array(rows).ravel()


@compiled
def _cross(a, b):
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@compiled
def _wrenches(turn, acceleration, spin, spin_rate, forces, torques):
    """Force and torque (3, 10) at a body's frame per unit of each inertial parameter, in the world.

    `f = m a + alpha x s + w x (w x s)` and `n = I alpha + w x I w + s x a` with s = m c.
    """
    forces[:, :] = 0.0
    torques[:, :] = 0.0
    forces[:, 0] = acceleration
    for k in range(3):
        way = turn[:, k].copy()
        forces[:, 1 + k] = _cross(spin_rate, way) + _cross(spin, _cross(spin, way))
        torques[:, 1 + k] = _cross(way, acceleration)
    local_spin, local_rate = turn.T @ spin, turn.T @ spin_rate
    for p in range(6):
        i, j = _PAIRS[p, 0], _PAIRS[p, 1]
        momentum, change = np.zeros(3), np.zeros(3)
        momentum[i], change[i] = local_spin[j], local_rate[j]
        if i != j:
            momentum[j], change[j] = local_spin[i], local_rate[i]
        torques[:, 4 + p] = turn @ (change + _cross(local_spin, momentum))


@compiled
def _fill(model, space, motion, damped, matrix):
    """Write the columns of bodies, dampers and drive inertias; return the drives' velocities.

    Args:
        model: Model.
        space: its Space.
        motion: (n, 3, f) of the independent coordinates, in tree order.
        damped: tree coordinates with a damper.
        matrix: (n, nu, m) zeros, written.

    Returns:
        (n, nu) drive velocities [m/s] or [rad/s].
    """
    mech, m = model.mech, space.motion
    free, drives, bodies = len(mech.free), len(model.gear), 1 + mech.links + 2 * mech.bars
    total = free + len(model.transmission)
    z, velocities = np.zeros(2 * total + 4 * model.hydraulic), np.empty((len(motion), drives))
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for k in range(len(motion)):
        z[:free] = motion[k, 0]
        z[total : total + free] = motion[k, 1]
        place(model, space, z)
        tree = m.joint[DRIFT] + m.basis @ motion[k, 2]
        # virtual work: J' F = N' tau, with J the drives' Jacobian and N that of the tree
        share = np.linalg.inv(space.row.T.copy()) @ m.basis.T
        velocities[k] = space.row @ motion[k, 1]
        for body in range(1, bodies):
            first = 10 * (body - 1)
            frame, jacobian = m.frame[body], m.jacobian[body]
            change = tree @ jacobian
            _wrenches(
                frame[TURN : TURN + 9].copy().reshape(3, 3),
                frame[ACCELERATION : ACCELERATION + 3] + change[:3], frame[SPIN : SPIN + 3].copy(),
                frame[SPIN_RATE : SPIN_RATE + 3] + change[3:], forces, torques,
            )  # fmt: skip
            moving, turning = jacobian[:, :3].copy(), jacobian[:, 3:].copy()
            load = moving @ forces + turning @ torques
            matrix[k, :, first : first + 10] = share @ load
        first = 10 * (bodies - 1)
        for d in range(len(damped)):
            matrix[k, :, first + d] = share[:, damped[d]] * m.joint[RATE, damped[d]]
        first += len(damped)
        for i in range(drives):
            if model.gear[i] >= 0:
                bar, speeding = mech.drive[i, BAR], np.sum(space.row[i] * motion[k, 2])
                if bar >= 0:
                    speeding += m.bar[bar, LENGTH_BIAS]
                    speeding += np.sum(m.bar[bar, LENGTH_ROW:] * m.joint[DRIFT])
                matrix[k, i, first + model.gear[i]] = speeding
    return velocities

"""Inverse dynamics of a closed chain: motion of all its joints, forces of its drives.

All rows of a log at once, compiled. Loops are closed by Newton's method from the row before; rates
and accelerations follow from the closures' Jacobian; forces of passive joints are carried to the
drives by virtual work.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closures import (
    CLOSED,
    check_determined,
    close_from,
    close_near,
    closure_acceleration,
    loop_space,
)
from hydrotele.multibody.tree_motion import (
    dot,
    move_tree,
    point_column,
    qr_factor,
    qr_solve,
    subtract,
    vector,
    wrenches,
)

_STRIDE = 0.1  # rad or m, to which the given joints move at once, lest a loop change its branch
_WHERE = "closures"


class Projection(NamedTuple):
    """n rows, v joints, b bodies, k drives.

    Attributes:
        position: (n, v) of all joints [rad] or [m].
        rate: (n, v) [rad/s] or [m/s].
        acceleration: (n, v) [rad/s^2] or [m/s^2].
        share: (n, k, v) force of drive k per unit of force or torque in joint v.
        bodies: (n, k, 10 b) force of drive k [N] or [N m] per unit of a body's inertial parameter.
        twist: (n, c) rate at which the two bodies of a closure turn against each other [rad/s].
        pins: (n, k, c) force of drive k per unit of viscous friction in a closure.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    share: np.ndarray
    bodies: np.ndarray
    twist: np.ndarray
    pins: np.ndarray


def project(
    chain: Chain, given: tuple[str, ...], position: np.ndarray, rate: np.ndarray,
    acceleration: np.ndarray, drives: tuple[str, ...] | None = None,
    start: np.ndarray | None = None,
) -> Projection:  # fmt: skip
    """Project a chain on its drives.

    Args:
        chain: the chain.
        given: the k joints whose motion is known; the closures must determine the others.
        position: (n, k) [rad] or [m].
        rate: (n, k) [rad/s] or [m/s].
        acceleration: (n, k) [rad/s^2] or [m/s^2].
        drives: k joints whose forces are asked for; the chain's own by default.
        start: (v,) positions from which to go to the first row; the chain's by default.

    Returns:
        The projection. `bodies @ inertia.ravel()`, plus what friction asks for, are the drives'
        forces.

    Raises:
        InputError: shapes do not fit, a value is missing, the closures do not determine the other
            joints, or a row cannot be reached.

    Source: Newton-Euler about the body frames, D'Alembert; Abdellatif 2008, section 2.
    """
    drives = chain.drives if drives is None else drives
    columns = np.array([chain.index(name) for name in given], np.int64)
    moved = np.array([chain.index(name) for name in drives], np.int64)
    tables = [_table(values, len(given)) for values in (position, rate, acceleration)]
    if len({len(table) for table in tables}) > 1:
        raise InputError(_WHERE, "positions, rates and accelerations must have the same rows")
    if len(moved) != len(columns):
        raise InputError(
            _WHERE,
            f"{len(columns)} joints are given but {len(moved)} have a drive; forces follow only"
            " where there are as many",
        )
    n, v, k = len(tables[0]), len(chain.joints), len(columns)
    others = np.setdiff1d(np.arange(v), columns)
    q = np.array(chain.start if start is None else start, float)
    if not close_from(chain.tree, q, np.arange(v), CLOSED, np.inf) < CLOSED:
        raise InputError(
            _WHERE, f"the loops of {chain.name} cannot be closed from where they start"
        )
    check_determined(chain, q, columns)
    out = Projection(
        np.empty((n, v)), np.empty((n, v)), np.empty((n, v)), np.empty((n, k, v)),
        np.empty((n, k, 10 * len(chain.bodies))), np.empty((n, len(chain.tree.ends))),
        np.empty((n, k, len(chain.tree.ends))),
    )  # fmt: skip
    failed = _project(chain.tree, _Given(columns, *tables), others, moved, q, out)
    if failed >= 0:
        raise InputError(
            _WHERE,
            f"row {failed}: the loops of {chain.name} cannot be closed there, or the pose is"
            f" singular for the drives {', '.join(drives)}",
        )
    return out


def _table(values: np.ndarray, width: int) -> np.ndarray:
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(
            _WHERE, f"motion must be (n, {width}), one column per joint: {table.shape}"
        )
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_WHERE, f"row {row} has no motion: smooth the log over its gaps first")
    return table


class _Given(NamedTuple):
    """Places (k,) of the given joints, and their motion, (n, k) each."""

    joints: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


@compiled
def _project(tree, given, others, drives, q, out):
    """Fill a `Projection` row by row; the row that failed, or -1."""
    b, v, k = len(tree.parent), len(tree.zero), len(given.joints)
    hidden, space = len(others), loop_space(tree, len(others), k)
    frames, part, ground = space.frames, space.part, -tree.gravity
    moves = np.zeros((v, k))  # of all joints per unit of the given ones
    q_drive, r_drive, unit = np.empty((k, k)), np.empty((k, k)), np.eye(k)
    inverse, every = np.empty((k, k)), np.arange(k)
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for i in range(k):
        moves[given.joints[i], i] = 1.0
    for row in range(len(given.position)):
        far = 0.0
        for i in range(k):
            far = max(far, abs(given.position[row, i] - q[given.joints[i]]))
        steps = max(1, int(math.ceil(far / _STRIDE))) if len(space.error) > 0 else 1
        for step in range(steps, 0, -1):
            for i in range(k):
                at = given.joints[i]
                q[at] += (given.position[row, i] - q[at]) / step
            if not close_near(tree, q, others, space):
                return row
        for i in range(k if hidden else 0):
            qr_solve(space.q_factor, space.r_factor, hidden, space.slope, given.joints[i], part, i)
            for o in range(hidden):
                moves[others[o], i] = -part[o, i]
        rate, acceleration = out.rate[row], out.acceleration[row]
        for j in range(v):
            rate[j] = acceleration[j] = 0.0
            for i in range(k):
                rate[j] += moves[j, i] * given.rate[row, i]
        if hidden:
            move_tree(tree, q, rate, space.still, space.none, frames)
            closure_acceleration(tree, frames, space.error)
            qr_solve(space.q_factor, space.r_factor, hidden, space.error, 0, part, 0)
            for o in range(hidden):
                acceleration[others[o]] = -part[o, 0]
        for j in range(v):
            out.position[row, j] = q[j]
            for i in range(k):
                acceleration[j] += moves[j, i] * given.acceleration[row, i]
        move_tree(tree, q, rate, acceleration, ground, frames)
        if not qr_factor(moves[drives].T.copy(), every, q_drive, r_drive):
            return row
        for i in range(k):
            qr_solve(q_drive, r_drive, k, unit, i, inverse, i)
        share = out.share[row]
        for i in range(k):
            for j in range(v):
                total = 0.0
                for m in range(k):
                    total += inverse[i, m] * moves[j, m]
                share[i, j] = total
        for body in range(1, b):
            wrenches(frames, body, forces, torques)
            _load(tree, frames, body, forces, torques, share, out.bodies[row])
        for m in range(len(tree.ends)):
            out.twist[row, m] = _rub(tree, frames, m, share, out.pins[row])
    return -1


@allocation_free
def _load(tree, frames, body, forces, torques, share, out):
    """Carry a body's wrench through the joints that move it to the drives."""
    first, point = 10 * (body - 1), vector(frames.place, body)
    for i in range(len(share)):
        for m in range(10):
            out[i, first + m] = 0.0
    for j in range(share.shape[1]):
        if not tree.above[body, j]:
            continue
        way, turn = point_column(tree, frames, j, point), vector(frames.axis, j)
        for m in range(10):
            effort = way[0] * forces[0, m] + way[1] * forces[1, m] + way[2] * forces[2, m]
            if not tree.slides[j]:
                effort += (
                    turn[0] * torques[0, m] + turn[1] * torques[1, m] + turn[2] * torques[2, m]
                )
            for i in range(len(share)):
                out[i, first + m] += share[i, j] * effort


@allocation_free
def _rub(tree, frames, closure, share, out):
    """Carry viscous friction in a closure to the drives; return the rate of its turning."""
    one, two = tree.ends[closure, 0], tree.ends[closure, 1]
    spin = subtract(vector(frames.spin, one), vector(frames.spin, two))
    for i in range(len(share)):
        out[i, closure] = 0.0
    for j in range(share.shape[1]):
        if tree.slides[j] or tree.above[one, j] == tree.above[two, j]:
            continue
        along = dot(vector(frames.axis, j), spin)
        along = along if tree.above[one, j] else -along
        for i in range(len(share)):
            out[i, closure] += share[i, j] * along
    return math.sqrt(dot(spin, spin))

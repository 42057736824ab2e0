"""Motion of a closed chain from that of some joints, and drive forces per unit of a parameter.

All rows of a log at once, compiled. Loops are closed by Newton's method from the row before; rates
and accelerations follow from the closures' Jacobian; forces of passive joints are carried to the
drives by virtual work.
"""

import math
from dataclasses import dataclass

import numpy as np

from hydrotele.core.compiled import compiled, lean
from hydrotele.core.errors import InputError
from hydrotele.identify.chain import Chain
from hydrotele.identify.small_least_squares import factor, least
from hydrotele.identify.space import dot, less, vector
from hydrotele.identify.tree_motion import (
    gaps,
    move_tree,
    new_frames,
    parting,
    point_column,
    wrenches,
)

_CLOSED = 1e-11  # m, gap of a loop that counts as closed: rounding at a machine's size
_ROUNDS = 50
_STRIDE = 0.1  # rad or m, to which the given joints move at once, lest a loop change its branch
_LEAP = 0.5  # rad or m, by which a hidden joint may then move at once: five times as far
_SMALL = 1e-7  # least ratio of singular values in use when a start is closed
_WHERE = "closures"


@dataclass(frozen=True)
class Projection:
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
    if not _settle(chain.tree, q):
        raise InputError(
            _WHERE, f"the loops of {chain.name} cannot be closed from where they start"
        )
    loose = np.linalg.svd(_start_slope(chain.tree, q)[:, others], full_matrices=True)
    hidden = np.linalg.norm(loose[2][np.sum(loose[1] > _SMALL) :], axis=0)
    if (hidden > _SMALL).any():
        names = ", ".join(chain.joints[j] for j in others[hidden > _SMALL])
        raise InputError(_WHERE, f"neither given nor determined by a closure: {names}")
    out = Projection(
        np.empty((n, v)), np.empty((n, v)), np.empty((n, v)), np.empty((n, k, v)),
        np.empty((n, k, 10 * len(chain.bodies))), np.empty((n, len(chain.tree.ends))),
        np.empty((n, k, len(chain.tree.ends))),
    )  # fmt: skip
    failed = _project(
        chain.tree, columns, others, moved, q, tables[0], tables[1], tables[2], out.position,
        out.rate, out.acceleration, out.share, out.bodies, out.twist, out.pins,
    )  # fmt: skip
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


@compiled
def _project(
    tree, given, others, drives, q, positions, rates, accelerations, all_q, all_rate,
    all_acceleration, share, bodies, twist, pins,
):  # fmt: skip
    """Fill a `Projection` row by row; the row that failed, or -1."""
    b, v, k, c = len(tree.parent), len(tree.zero), len(given), 3 * len(tree.ends)
    hidden = len(others)
    frames = new_frames(tree)
    still, none, ground = np.zeros(v), np.zeros(3), -tree.gravity
    gap, slope = np.zeros((c, 1)), np.zeros((c, v))
    q_factor, r_factor = np.empty((c, hidden)), np.empty((hidden, hidden))
    moves = np.zeros((v, k))  # of all joints per unit of the given ones
    part = np.empty((hidden, max(k, 1)))
    q_drive, r_drive, unit = np.empty((k, k)), np.empty((k, k)), np.eye(k)
    inverse, every = np.empty((k, k)), np.arange(k)
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for i in range(k):
        moves[given[i], i] = 1.0
    for row in range(len(positions)):
        far = 0.0
        for i in range(k):
            far = max(far, abs(positions[row, i] - q[given[i]]))
        steps = max(1, int(math.ceil(far / _STRIDE))) if c > 0 else 1
        for step in range(steps, 0, -1):
            for i in range(k):
                q[given[i]] += (positions[row, i] - q[given[i]]) / step
            if not _close(
                tree, q, others, still, none, frames, gap, slope, q_factor, r_factor, part
            ):
                return row
        for i in range(k if hidden else 0):
            least(q_factor, r_factor, hidden, slope, given[i], part, i)
            for o in range(hidden):
                moves[others[o], i] = -part[o, i]
        rate, acceleration = all_rate[row], all_acceleration[row]
        for j in range(v):
            rate[j] = acceleration[j] = 0.0
            for i in range(k):
                rate[j] += moves[j, i] * rates[row, i]
        if hidden:
            move_tree(tree, q, rate, still, none, frames)
            parting(tree, frames, gap)
            least(q_factor, r_factor, hidden, gap, 0, part, 0)
            for o in range(hidden):
                acceleration[others[o]] = -part[o, 0]
        for j in range(v):
            all_q[row, j] = q[j]
            for i in range(k):
                acceleration[j] += moves[j, i] * accelerations[row, i]
        move_tree(tree, q, rate, acceleration, ground, frames)
        if not factor(moves[drives].T.copy(), every, q_drive, r_drive):
            return row
        for i in range(k):
            least(q_drive, r_drive, k, unit, i, inverse, i)
        for i in range(k):
            for j in range(v):
                total = 0.0
                for m in range(k):
                    total += inverse[i, m] * moves[j, m]
                share[row, i, j] = total
        for body in range(1, b):
            wrenches(frames, body, forces, torques)
            _load(tree, frames, body, forces, torques, share[row], bodies[row])
        for m in range(len(tree.ends)):
            twist[row, m] = _rub(tree, frames, m, share[row], pins[row])
    return -1


@compiled
def _settle(tree, q):
    """Close the loops of a start by moving all joints (v,) a little; whether that worked."""
    v, c = len(q), 3 * len(tree.ends)
    frames, gap, slope = new_frames(tree), np.zeros((c, 1)), np.zeros((c, v))
    still, none = np.zeros(v), np.zeros(3)
    for _ in range(_ROUNDS if c else 0):
        move_tree(tree, q, still, still, none, frames)
        gaps(tree, frames, gap, slope)
        if np.max(np.abs(gap)) < _CLOSED:
            return True
        q -= np.linalg.lstsq(slope, gap, _SMALL)[0][:, 0]
    return c == 0


@compiled
def _start_slope(tree, q):
    """Slopes (3 c, v) of the closures at positions (v,)."""
    v, c = len(q), 3 * len(tree.ends)
    frames, gap, slope, still = new_frames(tree), np.zeros((c, 1)), np.zeros((c, v)), np.zeros(v)
    move_tree(tree, q, still, still, np.zeros(3), frames)
    gaps(tree, frames, gap, slope)
    return slope


@lean
def _close(tree, q, others, still, none, frames, gap, slope, q_factor, r_factor, part):
    """Close the loops near a position; False if that fails or leads to another branch."""
    for _ in range(_ROUNDS):
        move_tree(tree, q, still, still, none, frames)
        if len(gap) == 0:
            return True
        gaps(tree, frames, gap, slope)
        if not factor(slope, others, q_factor, r_factor):
            return False
        open_by = 0.0
        for m in range(len(gap)):
            open_by = max(open_by, abs(gap[m, 0]))
        if open_by < _CLOSED:
            return True
        least(q_factor, r_factor, len(others), gap, 0, part, 0)
        for o in range(len(others)):
            if not abs(part[o, 0]) < _LEAP:
                return False
            q[others[o]] -= part[o, 0]
    return False


@lean
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


@lean
def _rub(tree, frames, closure, share, out):
    """Carry viscous friction in a closure to the drives; return the rate of its turning."""
    one, two = tree.ends[closure, 0], tree.ends[closure, 1]
    spin = less(vector(frames.spin, one), vector(frames.spin, two))
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

"""Motion of a closed chain from that of some joints, and drive forces per unit of a parameter.

All rows of a log at once, compiled. Loops are closed by Newton's method from the row before; rates
and accelerations follow from the closures' Jacobian; forces of passive joints are carried to the
drives by virtual work.

Vectors of three and rotations as tuples of numbers, which compiled code keeps off the heap.

Least squares of a few columns without memory of its own, for row after row of a log.

Motion of a joint tree: frames, joint velocities of points, closures, wrenches of bodies.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.identify.chain import Chain


@allocation_free
def vector(rows, k):
    """Row k of (n, 3) rows as a tuple (x, y, z)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@allocation_free
def put(rows, k, a):
    """Write a tuple (x, y, z) into row k of (n, 3) rows."""
    rows[k, 0], rows[k, 1], rows[k, 2] = a


@allocation_free
def add(a, b):
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@allocation_free
def less(a, b):
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@allocation_free
def times(s, a):
    """A vector times a number."""
    return s * a[0], s * a[1], s * a[2]


@allocation_free
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@allocation_free
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@allocation_free
def swept(w, dw, arm):
    """Acceleration `dw x r + w x (w x r)` of a point at an arm r of a turning body."""
    return add(cross(dw, arm), cross(w, cross(w, arm)))


@allocation_free
def rotation(rows, k):
    """Matrix k of (n, 3, 3) as three row vectors."""
    m = rows[k]
    return (
        (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    )  # fmt: skip


@allocation_free
def put_rotation(rows, k, r):
    """Write three row vectors into matrix k of (n, 3, 3)."""
    m = rows[k]
    m[0, 0], m[0, 1], m[0, 2] = r[0]
    m[1, 0], m[1, 1], m[1, 2] = r[1]
    m[2, 0], m[2, 1], m[2, 2] = r[2]


@allocation_free
def turned(r, a):
    """A vector turned by a rotation."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


@allocation_free
def turned_back(r, a):
    """A vector turned by the inverse of a rotation."""
    return add(add(times(a[0], r[0]), times(a[1], r[1])), times(a[2], r[2]))


@allocation_free
def after(r, s):
    """The rotation that first does s, then r."""
    return turned_back(s, r[0]), turned_back(s, r[1]), turned_back(s, r[2])


@allocation_free
def about(axis, angle):
    """Rotation about a unit axis by an angle [rad] (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )


_STIFF = 1e-7  # least ratio of a column's own part to the largest column; below, rank is lacking


@allocation_free
def factor(matrix, columns, q, r):
    """QR of chosen columns by modified Gram-Schmidt, twice; False if they lack rank."""
    rows, count, size = len(matrix), len(columns), 0.0
    for j in range(count):
        total = 0.0
        for m in range(rows):
            q[m, j] = matrix[m, columns[j]]
            total += q[m, j] ** 2
        size = max(size, math.sqrt(total))
    for j in range(count):
        for i in range(j):
            r[i, j] = 0.0
        for _ in range(2):
            for i in range(j):
                along = 0.0
                for m in range(rows):
                    along += q[m, i] * q[m, j]
                r[i, j] += along
                for m in range(rows):
                    q[m, j] -= along * q[m, i]
        total = 0.0
        for m in range(rows):
            total += q[m, j] ** 2
        r[j, j] = math.sqrt(total)
        if not r[j, j] > _STIFF * size:
            return False
        for m in range(rows):
            q[m, j] /= r[j, j]
    return True


@allocation_free
def least(q, r, count, right, column, answer, k):
    """Least squares after `_factor`, of one column of the right side into one of the answer."""
    for j in range(count - 1, -1, -1):
        total = 0.0
        for m in range(len(right)):
            total += q[m, j] * right[m, column]
        for i in range(j + 1, count):
            total -= r[j, i] * answer[i, k]
        answer[j, k] = total / r[j, j]


_PAIRS = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])


class Frames(NamedTuple):
    """Where bodies are and how they move, all in the world; b bodies, v joints.

    Attributes:
        place: (b, 3) origins.
        turn: (b, 3, 3) orientations.
        spin: (b, 3) angular velocities.
        spin_rate: (b, 3) their rates.
        pull: (b, 3) accelerations of the origins.
        axis: (v, 3) joint axes.
        anchor: (v, 3) points on them.
    """

    place: np.ndarray
    turn: np.ndarray
    spin: np.ndarray
    spin_rate: np.ndarray
    pull: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray


@compiled
def new_frames(tree):
    """Room for the frames of a tree."""
    b, v = len(tree.parent), len(tree.zero)
    return Frames(
        np.empty((b, 3)), np.empty((b, 3, 3)), np.empty((b, 3)), np.empty((b, 3)),
        np.empty((b, 3)), np.empty((v, 3)), np.empty((v, 3)),
    )  # fmt: skip


@allocation_free
def move_tree(tree, q, rate, acceleration, ground, frames):
    """Place and move all bodies, from (v,) positions, rates, accelerations; ground: (3,)."""
    put(frames.place, 0, (0.0, 0.0, 0.0))
    put(frames.spin, 0, (0.0, 0.0, 0.0))
    put(frames.spin_rate, 0, (0.0, 0.0, 0.0))
    put(frames.pull, 0, (ground[0], ground[1], ground[2]))
    put_rotation(frames.turn, 0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    for b in range(1, len(tree.parent)):
        up = tree.parent[b]
        t, w, dw = rotation(frames.turn, up), vector(frames.spin, up), vector(frames.spin_rate, up)
        arm = turned(t, vector(tree.offset, b))
        p = add(vector(frames.place, up), arm)
        a = add(vector(frames.pull, up), swept(w, dw, arm))
        t = after(t, rotation(tree.turn, b))
        for j in range(tree.first[b], tree.first[b + 1]):
            own, center = vector(tree.axis, j), vector(tree.anchor, j)
            way, arm = turned(t, own), turned(t, center)
            put(frames.axis, j, way)
            put(frames.anchor, j, add(p, arm))
            step, turning = q[j] - tree.zero[j], cross(w, way)
            if tree.slides[j]:
                arm = times(step, way)
                a = add(a, swept(w, dw, arm))
                a = add(a, add(times(2.0 * rate[j], turning), times(acceleration[j], way)))
                p = add(p, arm)
                continue
            a = add(a, swept(w, dw, arm))
            dw = add(dw, add(times(acceleration[j], way), times(rate[j], turning)))
            w = add(w, times(rate[j], way))
            t = after(t, about(own, step))
            back = times(-1.0, turned(t, center))
            a = add(a, swept(w, dw, back))
            p = add(add(p, arm), back)
        put(frames.place, b, p)
        put_rotation(frames.turn, b, t)
        put(frames.spin, b, w)
        put(frames.spin_rate, b, dw)
        put(frames.pull, b, a)


@allocation_free
def point_column(tree, frames, j, point):
    """Velocity of a point per unit rate of a joint that moves it."""
    way = vector(frames.axis, j)
    return way if tree.slides[j] else cross(way, less(point, vector(frames.anchor, j)))


@allocation_free
def gaps(tree, frames, gap, slope):
    """How far closures gape (3 c, 1), and its slopes (3 c, v)."""
    slope[:, :] = 0.0
    gap[:, 0] = 0.0
    for c in range(len(tree.ends)):
        for side in range(2):
            body, sign = tree.ends[c, side], 1.0 - 2.0 * side
            arm = turned(rotation(frames.turn, body), vector(tree.points[c], side))
            point = add(vector(frames.place, body), arm)
            for k in range(3):
                gap[3 * c + k, 0] += sign * point[k]
            for j in range(len(frames.axis)):
                if tree.above[body, j]:
                    column = point_column(tree, frames, j, point)
                    for k in range(3):
                        slope[3 * c + k, j] += sign * column[k]


@allocation_free
def closure_acceleration(tree, frames, out):
    """Acceleration (3 c, 1) with which closures part."""
    out[:, 0] = 0.0
    for c in range(len(tree.ends)):
        for side in range(2):
            body, sign = tree.ends[c, side], 1.0 - 2.0 * side
            arm = turned(rotation(frames.turn, body), vector(tree.points[c], side))
            w, dw = vector(frames.spin, body), vector(frames.spin_rate, body)
            part = add(vector(frames.pull, body), swept(w, dw, arm))
            for k in range(3):
                out[3 * c + k, 0] += sign * part[k]


@allocation_free
def wrenches(frames, body, forces, torques):
    """Force and torque (3, 10) at a body's origin per unit of an inertial parameter, in the world.

    `f = m a + alpha x s + w x (w x s)` and `n = I alpha + w x I w + s x a` with s = m c.
    """
    t, a = rotation(frames.turn, body), vector(frames.pull, body)
    w, dw = vector(frames.spin, body), vector(frames.spin_rate, body)
    for k in range(3):
        forces[k, 0], torques[k, 0] = a[k], 0.0
        way = (t[0][k], t[1][k], t[2][k])
        f, n = swept(w, dw, way), cross(way, a)
        for m in range(3):
            forces[m, 1 + k], torques[m, 1 + k] = f[m], n[m]
    v, dv = turned_back(t, w), turned_back(t, dw)
    for p in range(6):
        i, j = _PAIRS[p, 0], _PAIRS[p, 1]
        x, y, z = 0.0, 0.0, 0.0  # I w, with a unit at (i, j) and (j, i)
        dx, dy, dz = 0.0, 0.0, 0.0
        if i == 0:
            x, dx = v[j], dv[j]
        elif i == 1:
            y, dy = v[j], dv[j]
        else:
            z, dz = v[j], dv[j]
        if i != j:
            if j == 1:
                y, dy = v[i], dv[i]
            else:
                z, dz = v[i], dv[i]
        n = turned(t, add((dx, dy, dz), cross(v, (x, y, z))))
        for m in range(3):
            forces[m, 4 + p], torques[m, 4 + p] = 0.0, n[m]


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
            closure_acceleration(tree, frames, gap)
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


@allocation_free
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

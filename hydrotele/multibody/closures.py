"""Closures of a joint tree: how far loops are open, and the joints that they determine.

A `connect` gives three equations, that two points coincide; a `weld` three more, that two frames
are parallel. For small angles the latter are the rotation from one frame to the other.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain, Tree
from hydrotele.multibody.tree_motion import (
    Frames,
    add,
    cross,
    move_tree,
    new_frames,
    point_column,
    qr_factor,
    qr_solve,
    rotated,
    rotating_acceleration,
    rotation,
    scaled,
    vector,
)

CLOSED = 1e-11  # m or rad, opening of a loop that counts as closed: rounding at a machine's size
_ROUNDS = 50  # of Newton's method
_LEAP = 0.5  # rad or m, by which a joint that is sought may move at once near a known pose
_SMALL = 1e-7  # least ratio of singular values in use
_WHERE = "closures"


@allocation_free
def loop_errors(tree, frames, error, slope):
    """Openings of the closures and their Jacobian.

    Args:
        tree: Tree.
        frames: Frames after `move_tree`.
        error: (r, 1) written: r equations, 3 or 6 of every closure [m], [rad].
        slope: (r, v) written: d error / d joint positions.

    Returns:
        Nothing.

    Source: differential kinematics; MuJoCo manual, "Computation", equality constraints.
    """
    slope[:, :] = 0.0
    error[:, 0] = 0.0
    for c in range(len(tree.ends)):
        first = tree.row[c]
        weld = tree.row[c + 1] - first == 6
        for side in range(2):
            body, sign = tree.ends[c, side], 1.0 - 2.0 * side
            arm = rotated(rotation(frames.turn, body), vector(tree.points[c], side))
            point = add(vector(frames.place, body), arm)
            for k in range(3):
                error[first + k, 0] += sign * point[k]
            for j in range(len(frames.axis)):
                if not tree.above[body, j]:
                    continue
                column = point_column(tree, frames, j, point)
                for k in range(3):
                    slope[first + k, j] += sign * column[k]
                    if weld and not tree.slides[j]:
                        slope[first + 3 + k, j] += sign * frames.axis[j, k]
        if weld:
            way = _rotation_error(tree, frames, c)
            for k in range(3):
                error[first + 3 + k, 0] = way[k]


@allocation_free
def _rotation_error(tree, frames, c):
    """Sine of the rotation from the second frame of a weld to the first, about its axis."""
    one, two = rotation(frames.turn, tree.ends[c, 0]), rotation(frames.turn, tree.ends[c, 1])
    own, other = tree.turns[c, 0], tree.turns[c, 1]
    total = (0.0, 0.0, 0.0)
    for k in range(3):
        a = rotated(one, (own[0, k], own[1, k], own[2, k]))
        b = rotated(two, (other[0, k], other[1, k], other[2, k]))
        total = add(total, cross(b, a))
    return scaled(0.5, total)


@allocation_free
def closure_acceleration(tree, frames, out):
    """Acceleration (r, 1) with which closures part [m/s^2], [rad/s^2].

    Source: second derivative of the loop equations.
    """
    out[:, 0] = 0.0
    for c in range(len(tree.ends)):
        first = tree.row[c]
        weld = tree.row[c + 1] - first == 6
        for side in range(2):
            body, sign = tree.ends[c, side], 1.0 - 2.0 * side
            arm = rotated(rotation(frames.turn, body), vector(tree.points[c], side))
            w, dw = vector(frames.spin, body), vector(frames.spin_rate, body)
            part = add(vector(frames.acceleration, body), rotating_acceleration(w, dw, arm))
            for k in range(3):
                out[first + k, 0] += sign * part[k]
                if weld:
                    out[first + 3 + k, 0] += sign * dw[k]


class LoopSpace(NamedTuple):
    """Work space of `close_near`; v joints, m of them sought, r equations.

    Attributes:
        still: (v,) zeros.
        none: (3,) zeros.
        frames: where the bodies are.
        error: (r, 1) openings [m], [rad].
        slope: (r, v) d error / d joint positions.
        q_factor: (r, m) orthonormal factor of the columns of `slope` that are sought.
        r_factor: (m, m) triangular factor.
        part: (m, k) solutions, k at least 1.
    """

    still: np.ndarray
    none: np.ndarray
    frames: Frames
    error: np.ndarray
    slope: np.ndarray
    q_factor: np.ndarray
    r_factor: np.ndarray
    part: np.ndarray


@compiled
def loop_space(tree, sought, columns):
    """Room to close the loops of a tree by `sought` joints, for solutions of some columns."""
    v, r = len(tree.zero), tree.row[-1]
    return LoopSpace(
        np.zeros(v), np.zeros(3), new_frames(tree), np.zeros((r, 1)), np.zeros((r, v)),
        np.empty((r, sought)), np.empty((sought, sought)), np.empty((sought, max(columns, 1))),
    )  # fmt: skip


@allocation_free
def close_near(tree, q, others, space):
    """Close the loops near a position; without memory of its own, row after row.

    Args:
        tree: Tree.
        q: (v,) positions, changed in place [rad] or [m].
        others: (m,) joints that may move.
        space: LoopSpace of m sought joints; afterwards it has frames, slope and factors there.

    Returns:
        False if that fails or leads to another branch; `close_from` starts farther away.

    Source: Gauss-Newton.
    """
    error, part = space.error, space.part
    for _ in range(_ROUNDS):
        move_tree(tree, q, space.still, space.still, space.none, space.frames)
        if len(error) == 0:
            return True
        loop_errors(tree, space.frames, error, space.slope)
        if not qr_factor(space.slope, others, space.q_factor, space.r_factor):
            return False
        open_by = 0.0
        for m in range(len(error)):
            open_by = max(open_by, abs(error[m, 0]))
        if open_by < CLOSED:
            return True
        qr_solve(space.q_factor, space.r_factor, len(others), error, 0, part, 0)
        for o in range(len(others)):
            if not abs(part[o, 0]) < _LEAP:
                return False
            q[others[o]] -= part[o, 0]
    return False


def close_from(
    tree: Tree, q: np.ndarray, others: np.ndarray, closed: float, longest: float
) -> float:
    """Close the loops from some way off by moving some of the joints.

    Args:
        tree: of the joints.
        q: (v,) positions, changed in place [rad] or [m].
        others: (m,) joints that may move.
        closed: opening that counts as closed [m], [rad].
        longest: most that a joint moves in one round [rad], [m].

    Returns:
        Opening that is left [m], [rad].

    Source: Gauss-Newton with a bounded step, minimum norm where the closures leave a choice.
    """
    open_by = 0.0
    for _ in range(_ROUNDS if tree.row[-1] else 0):
        gap, slope = _openings(tree, q)
        open_by = float(np.abs(gap).max())
        if not closed <= open_by < np.inf:
            break
        step = np.linalg.lstsq(slope[:, others], gap[:, 0], _SMALL)[0]
        q[others] -= step * min(1.0, longest / max(float(np.abs(step).max()), 1e-300))
    return open_by


@compiled
def _openings(tree, q):
    """Openings (r, 1) of the closures at positions (v,), and their Jacobian (r, v)."""
    v, r = len(q), tree.row[-1]
    frames, gap, slope, still = new_frames(tree), np.zeros((r, 1)), np.zeros((r, v)), np.zeros(v)
    move_tree(tree, q, still, still, np.zeros(3), frames)
    loop_errors(tree, frames, gap, slope)
    return gap, slope


def motion_basis(chain: Chain, q: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Velocities of all joints per unit velocity of each independent one.

    Args:
        chain: the chain.
        q: (v,) positions in which its loops are closed [rad] or [m].
        independent: (n,) places of the independent joints.

    Returns:
        (v, n), with `rates = basis @ rates[independent]`.

    Source: `J_d r_d = -J_i r_i` of the closures' Jacobian, dependent and independent part.
    """
    others = np.setdiff1d(np.arange(len(q)), independent)
    basis = np.zeros((len(q), len(independent)))
    basis[independent, np.arange(len(independent))] = 1.0
    if len(others):
        slope = _openings(chain.tree, np.ascontiguousarray(q, float))[1]
        basis[others] = -np.linalg.lstsq(slope[:, others], slope[:, independent], rcond=1e-10)[0]
    return basis


def check_determined(chain: Chain, q: np.ndarray, independent: np.ndarray) -> None:
    """Refuse joints that are neither independent nor determined by a closure.

    Args:
        chain: the chain.
        q: (v,) positions in which its loops are closed [rad] or [m].
        independent: (n,) places of the independent joints.

    Raises:
        InputError: names them.
    """
    others = np.setdiff1d(np.arange(len(q)), independent)
    loose = np.linalg.svd(_openings(chain.tree, q)[1][:, others], full_matrices=True)
    hidden = np.linalg.norm(loose[2][np.sum(loose[1] > _SMALL) :], axis=0)
    if (hidden > _SMALL).any():
        names = ", ".join(chain.joints[j] for j in others[hidden > _SMALL])
        raise InputError(_WHERE, f"neither given nor determined by a closure: {names}")

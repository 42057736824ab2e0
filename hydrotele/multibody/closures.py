"""Loop closures of a joint tree, solved by Newton's method.

A `connect` gives three equations (two points coincide), a `weld` gives three more (two frames are
parallel).
"""

from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.multibody.chain import Chain, Tree, load_chain
from hydrotele.multibody.tree_motion import Frames, allocate_frames, compute_frames, point_jacobian_column
from hydrotele.multibody.vector_algebra import (
    add_vectors,
    cross,
    get_rotation,
    get_vector,
    point_acceleration,
    qr_factor,
    qr_solve,
    rotate_vector,
    scale_vector,
)

CLOSURE_TOLERANCE = 1e-11  # m or rad, maximum residual of a closed loop: rounding at the size of a machine
_MAX_ITERATIONS = 50  # maximum number of Newton iterations
_MAX_NEAR_STEP = 0.5  # rad or m, maximum step of an unknown joint near a known pose
_MIN_SINGULAR_RATIO = 1e-7  # minimum relative singular value


@compile_without_allocation
def compute_loop_residuals(tree, frames, error, error_jacobian):
    """Compute the residuals of all loop closure equations and their Jacobian.

    Args:
        tree: Tree.
        frames: Frames after `compute_frames`.
        error: (r, 1) written: residuals, 3 or 6 per closure [m], [rad].
        error_jacobian: (r, v) written: d error / d joint positions.

    Returns:
        Nothing.

    Source: differential kinematics; MuJoCo manual, "Computation", equality constraints.
    """
    error_jacobian[:, :] = 0.0
    error[:, 0] = 0.0
    for c in range(len(tree.closure_bodies)):
        first = tree.first_equation[c]
        weld = tree.first_equation[c + 1] - first == 6
        for side in range(2):
            body, sign = tree.closure_bodies[c, side], 1.0 - 2.0 * side
            arm = rotate_vector(get_rotation(frames.rotation, body), get_vector(tree.closure_points[c], side))
            point = add_vectors(get_vector(frames.origin, body), arm)
            for k in range(3):
                error[first + k, 0] += sign * point[k]
            for j in range(len(frames.axis)):
                if not tree.is_moved[body, j]:
                    continue
                column = point_jacobian_column(tree, frames, j, point)
                for k in range(3):
                    error_jacobian[first + k, j] += sign * column[k]
                    if weld and not tree.is_slide[j]:
                        error_jacobian[first + 3 + k, j] += sign * frames.axis[j, k]
        if weld:
            way = _rotation_error(tree, frames, c)
            for k in range(3):
                error[first + 3 + k, 0] = way[k]


@compile_without_allocation
def _rotation_error(tree, frames, c):
    """Return the orientation error of a weld closure c as a vector in the world frame.

    It is the sine of the rotation angle from its second to its first frame, times the rotation axis.
    """
    one, two = (
        get_rotation(frames.rotation, tree.closure_bodies[c, 0]),
        get_rotation(frames.rotation, tree.closure_bodies[c, 1]),
    )
    own, other = tree.closure_rotations[c, 0], tree.closure_rotations[c, 1]
    total = (0.0, 0.0, 0.0)
    for k in range(3):
        a = rotate_vector(one, (own[0, k], own[1, k], own[2, k]))
        b = rotate_vector(two, (other[0, k], other[1, k], other[2, k]))
        total = add_vectors(total, cross(b, a))
    return scale_vector(0.5, total)


@compile_without_allocation
def compute_closure_acceleration(tree, frames, out):
    """Compute the second time derivative of the residuals of all loop equations.

    Args:
        tree: Tree.
        frames: Frames after `compute_frames` with rates and accelerations.
        out: (r, 1) written: accelerations, 3 or 6 per closure [m/s^2], [rad/s^2].

    Source: second derivative of the loop equations.
    """
    out[:, 0] = 0.0
    for c in range(len(tree.closure_bodies)):
        first = tree.first_equation[c]
        weld = tree.first_equation[c + 1] - first == 6
        for side in range(2):
            body, sign = tree.closure_bodies[c, side], 1.0 - 2.0 * side
            arm = rotate_vector(get_rotation(frames.rotation, body), get_vector(tree.closure_points[c], side))
            w, dw = (
                get_vector(frames.angular_velocity, body),
                get_vector(frames.angular_acceleration, body),
            )
            part = add_vectors(get_vector(frames.acceleration, body), point_acceleration(w, dw, arm))
            for k in range(3):
                out[first + k, 0] += sign * part[k]
                if weld:
                    out[first + 3 + k, 0] += sign * dw[k]


class LoopWorkspace(NamedTuple):
    """Workspace of `close_loops_near`; v joints, m unknown joints, r equations.

    Attributes:
        zero_rates: (v,) zeros.
        zero_vector: (3,) zeros.
        frames: frames of the bodies.
        error: (r, 1) residuals of the loop equations [m], [rad].
        error_jacobian: (r, v) d error / d joint positions.
        q_factor: (r, m) orthonormal factor of the columns of `error_jacobian` of the unknown
            joints.
        r_factor: (m, m) triangular factor.
        solution: (m, k) solutions of the linear systems for k right-hand sides, k at least 1.
    """

    zero_rates: np.ndarray
    zero_vector: np.ndarray
    frames: Frames
    error: np.ndarray
    error_jacobian: np.ndarray
    q_factor: np.ndarray
    r_factor: np.ndarray
    solution: np.ndarray


@compiled
def make_loop_workspace(tree, unknowns, columns):
    """Allocate the work arrays for closing the loops of a tree.

    `unknowns` is the number of unknown joints, and `columns` that of right-hand sides to be solved for.
    """
    v, r = len(tree.reference_position), tree.first_equation[-1]
    return LoopWorkspace(
        np.zeros(v), np.zeros(3), allocate_frames(tree), np.zeros((r, 1)), np.zeros((r, v)),
        np.empty((r, unknowns)), np.empty((unknowns, unknowns)), np.empty((unknowns, max(columns, 1))),
    )  # fmt: skip


@compile_without_allocation
def close_loops_near(tree, q, unknowns, space):
    """Close the loops by Newton's method from a nearby position, without allocating memory.

    Args:
        tree: Tree.
        q: (v,) positions, changed in place [rad] or [m].
        unknowns: (m,) indices of the joints that may move.
        space: LoopWorkspace of m unknown joints; receives frames, Jacobian and factors at the solution.

    Returns:
        Whether it succeeded. It fails at a singular position, or if a step is so large that it may lead
        to another assembly; `close_loops_from` handles larger distances.

    Source: Gauss-Newton.
    """
    error, part = space.error, space.solution
    for _ in range(_MAX_ITERATIONS):
        compute_frames(tree, q, space.zero_rates, space.zero_rates, space.zero_vector, space.frames)
        if len(error) == 0:
            return True
        compute_loop_residuals(tree, space.frames, error, space.error_jacobian)
        if not qr_factor(space.error_jacobian, unknowns, space.q_factor, space.r_factor):
            return False
        open_by = 0.0
        for m in range(len(error)):
            open_by = max(open_by, abs(error[m, 0]))
        if open_by < CLOSURE_TOLERANCE:
            return True
        qr_solve(space.q_factor, space.r_factor, len(unknowns), error, 0, part, 0)
        for o in range(len(unknowns)):
            if not abs(part[o, 0]) < _MAX_NEAR_STEP:
                return False
            q[unknowns[o]] -= part[o, 0]
    return False


def close_loops_from(tree: Tree, q: np.ndarray, unknowns: np.ndarray, tolerance: float, max_step: float) -> float:
    """Close the loops from a distant position by moving some of the joints.

    Args:
        tree: joint tree.
        q: (v,) positions, changed in place [rad] or [m].
        unknowns: (m,) indices of the joints that may move.
        tolerance: maximum residual of a closed loop [m], [rad].
        max_step: maximum joint step per iteration [rad], [m].

    Returns:
        Maximum remaining residual [m], [rad].

    Source: Gauss-Newton with a bounded step, of minimum norm if the closures are not sufficient.
    """
    open_by = 0.0
    for _ in range(_MAX_ITERATIONS if tree.first_equation[-1] else 0):
        gap, slope = evaluate_loop_residuals(tree, q)
        open_by = float(np.abs(gap).max())
        if not tolerance <= open_by < np.inf:
            break
        step = np.linalg.lstsq(slope[:, unknowns], gap[:, 0], _MIN_SINGULAR_RATIO)[0]
        q[unknowns] -= step * min(1.0, max_step / max(float(np.abs(step).max()), 1e-300))
    return open_by


@compiled
def evaluate_loop_residuals(tree, q):
    """Return the residuals (r, 1) of the loop equations at joint positions (v,), and their Jacobian (r, v)."""
    v, r = len(q), tree.first_equation[-1]
    frames, gap, slope, still = allocate_frames(tree), np.zeros((r, 1)), np.zeros((r, v)), np.zeros(v)
    compute_frames(tree, q, still, still, np.zeros(3), frames)
    compute_loop_residuals(tree, frames, gap, slope)
    return gap, slope


def precompile_loop_residuals() -> None:
    """Compile the functions that compute loop residuals before they are needed, by one call for a pendulum."""
    body = '<body><joint name="hinge"/><geom size="1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    tree = load_chain(model).tree
    evaluate_loop_residuals(tree, np.zeros_like(tree.reference_position))


def motion_basis(chain: Chain, q: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Return the rates of all joints of a closed chain per unit rate of each independent joint.

    Args:
        chain: the chain.
        q: (v,) positions with closed loops [rad] or [m].
        independent: (n,) indices of the independent joints.

    Returns:
        (v, n), with `rates = basis @ rates[independent]`.

    Source: `J_d r_d = -J_i r_i` for rates r, with the dependent and independent columns of the Jacobian
        of the loop equations.
    """
    others = np.setdiff1d(np.arange(len(q)), independent)
    basis = np.zeros((len(q), len(independent)))
    basis[independent, np.arange(len(independent))] = 1.0
    if len(others):
        slope = evaluate_loop_residuals(chain.tree, np.ascontiguousarray(q, float))[1]
        basis[others] = -np.linalg.lstsq(slope[:, others], slope[:, independent], rcond=1e-10)[0]
    return basis


def find_undetermined_joints(chain: Chain, q: np.ndarray, independent: np.ndarray) -> tuple[str, ...]:
    """Return the joints that the independent joints and the closures do not determine at a pose.

    Args:
        chain: the chain.
        q: (v,) positions with closed loops [rad] or [m].
        independent: (n,) indices of the independent joints.

    Returns:
        Joint names; empty if all joints are determined.
    """
    others = np.setdiff1d(np.arange(len(q)), independent)
    _, s, v = np.linalg.svd(evaluate_loop_residuals(chain.tree, q)[1][:, others], full_matrices=True)
    hidden = np.linalg.norm(v[np.sum(s > _MIN_SINGULAR_RATIO) :], axis=0)
    return tuple(chain.joints[j] for j in others[hidden > _MIN_SINGULAR_RATIO])

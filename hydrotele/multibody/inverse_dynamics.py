"""Inverse dynamics of a closed chain in compiled code.

It computes the motion of all joints along a log, and their forces projected on the drives by
virtual work.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closed_chain_kinematics import describe_unclosed_loop, find_assemblies, find_start_pose
from hydrotele.multibody.closures import close_loops_near, compute_closure_acceleration, make_loop_workspace
from hydrotele.multibody.tree_motion import compute_frames, compute_unit_wrenches, point_jacobian_column
from hydrotele.multibody.vector_algebra import (
    dot,
    get_rotation,
    get_vector,
    qr_factor,
    qr_solve,
    rotate_vector,
    subtract_vectors,
)

_MAX_GIVEN_STEP = 0.1  # rad or m, maximum step of the given joints, so that loops stay on their branch
_ERROR_CONTEXT = "closures"


class Projection(NamedTuple):
    """Motion and forces of a chain projected on its drives; n rows, v joints, b bodies, k drives.

    Attributes:
        position: (n, v) of all joints [rad] or [m].
        rate: (n, v) [rad/s] or [m/s].
        acceleration: (n, v) [rad/s^2] or [m/s^2].
        joint_projection: (n, k, v) force of drive k per unit force or torque in joint v.
        body_projection: (n, k, 10 b) force of drive k [N] or [N m] per unit of an inertial parameter.
        closure_rate: (n, c) relative rotation rate of the two bodies of a closure [rad/s].
        closure_projection: (n, k, c) force of drive k per unit of viscous friction in a closure.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    joint_projection: np.ndarray
    body_projection: np.ndarray
    closure_rate: np.ndarray
    closure_projection: np.ndarray


def project_on_drives(
    chain: Chain, given: tuple[str, ...], position: np.ndarray, rate: np.ndarray,
    acceleration: np.ndarray, drives: tuple[str, ...] | None = None,
    start: np.ndarray | None = None,
    moment_free: Mapping[str, tuple[float, float, float]] | None = None,
) -> Projection:  # fmt: skip
    """Compute the motion of all joints and project the forces of a chain on its drives.

    Args:
        chain: the chain.
        given: the k joints with known motion; the closures must determine the others.
        position: (n, k) their positions [rad] or [m].
        rate: (n, k) their rates [rad/s] or [m/s].
        acceleration: (n, k) their accelerations [rad/s^2] or [m/s^2].
        drives: k joints whose forces are computed; the drives of the chain by default.
        start: (v,) initial positions before the first row; those of the chain by default.
        moment_free: body -> unit axis through the origin of the body's frame, in that frame. The
            neighbours transmit no moment to the body about this axis. The motion is not affected.

    Returns:
        The projection. The forces that the drives must exert are `body_projection @
        chain.inertia.ravel()` (inertia and gravity) plus friction.

    Raises:
        InputError: a shape is wrong, a value is missing, a body does not exist, the closures do not
            determine the other joints, or a row cannot be reached.

    Source: Newton-Euler about the body frames, D'Alembert; Abdellatif 2008, section 2; bodies
    without moment about an axis: Khoshzaban 1992, p. 92, Eq. 4.23.
    """
    drives = chain.drives if drives is None else drives
    columns = np.array([chain.index(name) for name in given], np.int64)
    moved = np.array([chain.index(name) for name in drives], np.int64)
    tables = [_check_table(values, len(given)) for values in (position, rate, acceleration)]
    if len({len(table) for table in tables}) > 1:
        raise InputError(_ERROR_CONTEXT, "positions, rates and accelerations must have the same rows")
    if len(moved) != len(columns):
        raise InputError(
            _ERROR_CONTEXT,
            f"{len(columns)} joints are given but {len(moved)} have a drive; inverse dynamics needs equal numbers",
        )
    n, v, k = len(tables[0]), len(chain.joints), len(columns)
    axes = np.zeros((len(chain.bodies) + 1, 3))
    for body, axis in (moment_free or {}).items():
        axes[find_body_index(chain, body) + 1] = axis
    others = np.setdiff1d(np.arange(v), columns)
    q = find_start_pose(chain, given, tables[0], start)
    out = Projection(
        np.empty((n, v)), np.empty((n, v)), np.empty((n, v)), np.empty((n, k, v)),
        np.empty((n, k, 10 * len(chain.bodies))), np.empty((n, len(chain.tree.closure_bodies))),
        np.empty((n, k, len(chain.tree.closure_bodies))),
    )  # fmt: skip
    given_rows = _GivenMotion(columns, *tables)
    failed = _project_rows(chain.tree, given_rows, others, moved, axes, q, out)
    if failed >= 0:
        if len(chain.closures) and not len(find_assemblies(chain, given, tables[0][failed])):
            message = describe_unclosed_loop(chain, given, tables[0][failed], failed)
        else:
            message = (
                f"row {failed}: the loops of {chain.name} cannot be closed there without a jump to another"
                f" assembly, or the pose is singular for the drives {', '.join(drives)}"
            )
        raise InputError(chain.source or _ERROR_CONTEXT, message)
    return out


def find_body_index(chain: Chain, body: str) -> int:
    """Return the index of a body among the bodies of a chain without the world; raise InputError if it has none."""
    if body not in chain.bodies:
        raise InputError(_ERROR_CONTEXT, f"{chain.name} has no body {body}: {', '.join(chain.bodies)}")
    return chain.bodies.index(body)


def _check_table(values: np.ndarray, width: int) -> np.ndarray:
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(_ERROR_CONTEXT, f"motion must be (n, {width}), one column per joint: {table.shape}")
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        message = f"row {row} has no position, rate or acceleration: fill the gaps of the log or leave such rows out"
        raise InputError(_ERROR_CONTEXT, message)
    return table


class _GivenMotion(NamedTuple):
    """Indices (k,) of the given joints, and their motion, (n, k) each."""

    joints: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


@compiled
def _project_rows(tree, given, others, drives, moment_free, q, out):
    """Compute motion and projected forces of a chain row by row, and write them to a `Projection`.

    Args:
        tree: Tree.
        given: _GivenMotion of k joints.
        others: (v - k,) indices of the other joints.
        drives: (k,) indices of the driven joints.
        moment_free: (b, 3) unit axis without moment of every body in its frame, or 0.
        q: (v,) closed positions before the first row, updated.
        out: Projection, written.

    Returns:
        Index of the first row where this fails, or -1.
    """
    b, v, k = len(tree.parent), len(tree.reference_position), len(given.joints)
    hidden, space = len(others), make_loop_workspace(tree, len(others), k)
    frames, part, ground = space.frames, space.solution, -tree.gravity
    moves = np.zeros((v, k))  # rates of all joints per unit rate of the given joints
    q_drive, r_drive, unit = np.empty((k, k)), np.empty((k, k)), np.eye(k)
    inverse, every = np.empty((k, k)), np.arange(k)
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for i in range(k):
        moves[given.joints[i], i] = 1.0
    for row in range(len(given.position)):
        far = 0.0
        for i in range(k):
            far = max(far, abs(given.position[row, i] - q[given.joints[i]]))
        steps = max(1, int(math.ceil(far / _MAX_GIVEN_STEP))) if len(space.error) > 0 else 1
        for step in range(steps, 0, -1):
            for i in range(k):
                at = given.joints[i]
                q[at] += (given.position[row, i] - q[at]) / step
            if not close_loops_near(tree, q, others, space):
                return row
        for i in range(k if hidden else 0):
            qr_solve(space.q_factor, space.r_factor, hidden, space.error_jacobian, given.joints[i], part, i)
            for o in range(hidden):
                moves[others[o], i] = -part[o, i]
        rate, acceleration = out.rate[row], out.acceleration[row]
        for j in range(v):
            rate[j] = acceleration[j] = 0.0
            for i in range(k):
                rate[j] += moves[j, i] * given.rate[row, i]
        if hidden:
            compute_frames(tree, q, rate, space.zero_rates, space.zero_vector, frames)
            compute_closure_acceleration(tree, frames, space.error)
            qr_solve(space.q_factor, space.r_factor, hidden, space.error, 0, part, 0)
            for o in range(hidden):
                acceleration[others[o]] = -part[o, 0]
        for j in range(v):
            out.position[row, j] = q[j]
            for i in range(k):
                acceleration[j] += moves[j, i] * given.acceleration[row, i]
        compute_frames(tree, q, rate, acceleration, ground, frames)
        if not qr_factor(moves[drives].T.copy(), every, q_drive, r_drive):
            return row
        for i in range(k):
            qr_solve(q_drive, r_drive, k, unit, i, inverse, i)
        share = out.joint_projection[row]
        for i in range(k):
            for j in range(v):
                total = 0.0
                for m in range(k):
                    total += inverse[i, m] * moves[j, m]
                share[i, j] = total
        for body in range(1, b):
            compute_unit_wrenches(frames, body, forces, torques)
            _remove_moment(frames, body, get_vector(moment_free, body), torques)
            _project_wrench(tree, frames, body, forces, torques, share, out.body_projection[row])
        for m in range(len(tree.closure_bodies)):
            out.closure_rate[row, m] = _project_closure_friction(tree, frames, m, share, out.closure_projection[row])
    return -1


@compile_without_allocation
def _remove_moment(frames, body, axis, torques):
    """Remove the component along a unit axis of a body's frame from torques (3, 10) in the world frame.

    A zero axis has no effect.
    """
    way = rotate_vector(get_rotation(frames.rotation, body), axis)
    for m in range(10):
        along = way[0] * torques[0, m] + way[1] * torques[1, m] + way[2] * torques[2, m]
        for k in range(3):
            torques[k, m] -= along * way[k]


@compile_without_allocation
def _project_wrench(tree, frames, body, forces, torques, joint_projection, out):
    """Project the wrench of a body on the drives by virtual work, through the joints that move it.

    Args:
        tree: Tree.
        frames: Frames.
        body: index of the body.
        forces: (3, 10) force per unit of each inertial parameter, see `compute_unit_wrenches`.
        torques: (3, 10) torque, likewise.
        joint_projection: (k, v) force of drive k per unit force or torque in joint v.
        out: (k, 10 b) forces of the drives per unit of each inertial parameter; the ten columns of
            this body are written.
    """
    first, point = 10 * (body - 1), get_vector(frames.origin, body)
    for i in range(len(joint_projection)):
        for m in range(10):
            out[i, first + m] = 0.0
    for j in range(joint_projection.shape[1]):
        if not tree.is_moved[body, j]:
            continue
        way, turn = point_jacobian_column(tree, frames, j, point), get_vector(frames.axis, j)
        for m in range(10):
            effort = way[0] * forces[0, m] + way[1] * forces[1, m] + way[2] * forces[2, m]
            if not tree.is_slide[j]:
                effort += turn[0] * torques[0, m] + turn[1] * torques[1, m] + turn[2] * torques[2, m]
            for i in range(len(joint_projection)):
                out[i, first + m] += joint_projection[i, j] * effort


@compile_without_allocation
def _project_closure_friction(tree, frames, closure, joint_projection, out):
    """Project viscous rotational friction in a closure on the drives, per unit of its coefficient.

    `joint_projection` (k, v) is the force of drive k per unit force in joint v; column `closure` of `out` (k, c) is
    written.

    Returns:
        Relative rotation rate of the two bodies of the closure [rad/s].
    """
    one, two = tree.closure_bodies[closure, 0], tree.closure_bodies[closure, 1]
    spin = subtract_vectors(get_vector(frames.angular_velocity, one), get_vector(frames.angular_velocity, two))
    for i in range(len(joint_projection)):
        out[i, closure] = 0.0
    for j in range(joint_projection.shape[1]):
        if tree.is_slide[j] or tree.is_moved[one, j] == tree.is_moved[two, j]:
            continue
        along = dot(get_vector(frames.axis, j), spin)
        along = along if tree.is_moved[one, j] else -along
        for i in range(len(joint_projection)):
            out[i, closure] += joint_projection[i, j] * along
    return math.sqrt(dot(spin, spin))

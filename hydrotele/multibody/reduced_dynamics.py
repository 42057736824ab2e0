"""Fast dynamics of a machine's mechanism in reduced (independent) coordinates.

Frames and Jacobians, loop closures, mass matrix and bias forces by Kane's projection, compiled
without allocation.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation
from hydrotele.multibody.reduced_mechanism import (
    AXIS,
    COM,
    COORDINATE,
    COORDINATE_END,
    HINGE,
    HOME,
    INERTIA,
    KIND,
    MASS,
    PARENT,
    POSITION,
    SLIDE,
    ReducedMechanism,
)


@compile_without_allocation
def factorise_cholesky(matrix):
    """Replace a symmetric positive definite matrix by its lower Cholesky factor.

    Args:
        matrix: (>= n, n); the lower triangle of its first n rows is overwritten by the factor.

    Returns:
        Nothing.

    Source: Golub and Van Loan, Matrix Computations, Algorithm 4.2.1.
    """
    for i in range(matrix.shape[1]):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]


@compile_without_allocation
def solve_cholesky(factor, right):
    """Solve a linear system `L L' x = right` with the lower Cholesky factor L, in place.

    Args:
        factor: (>= n, n) result of `factorise_cholesky`.
        right: (n,) right-hand side, overwritten by the solution.

    Returns:
        Nothing.

    Source: Golub and Van Loan, Matrix Computations, section 3.1.
    """
    n = len(right)
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@compile_without_allocation
def compute_bar_frames(tree, shape, first, frame, jacobian, bar):
    """Compute the frames and Jacobians of all cylinders (bars between two pins).

    Tube and rod of a bar have the same orientation: the x axis points from base pin to rod pin, and
    the y axis is opposite to the pin axis (AXIS of `shape`). Their origins are at their pins.

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        shape: (f, SHAPE_SIZE) geometry of the frames, see `ReducedMechanism`.
        first: index of the first tube.
        frame: (f, FRAME_SIZE) orientation and origin of the frames, written; see `ReducedMotion`.
        jacobian: (f, N, 6) velocity and spin of tubes and rods per joint rate, written.
        bar: (bars, 3 + N) columns LENGTH (pin to pin) and, from LENGTH_ROW on, its Jacobian;
            written.

    Returns:
        Nothing.

    Source: Khoshzaban 1992, chapter 2.
    """
    for b in range(len(bar)):
        tube, rod = first + 2 * b, first + 2 * b + 1
        base = tree[tube, PARENT]
        compute_frame_origin(tree, shape, frame, jacobian, tube)
        compute_frame_origin(tree, shape, frame, jacobian, rod)
        dx = frame[rod, ORIGIN] - frame[tube, ORIGIN]
        dy = frame[rod, ORIGIN + 1] - frame[tube, ORIGIN + 1]
        dz = frame[rod, ORIGIN + 2] - frame[tube, ORIGIN + 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        ex, ey, ez = dx / length, dy / length, dz / length
        px, py, pz = shape[tube, AXIS], shape[tube, AXIS + 1], shape[tube, AXIS + 2]
        nx = px * frame[base, 0] + py * frame[base, 1] + pz * frame[base, 2]
        ny = px * frame[base, 3] + py * frame[base, 4] + pz * frame[base, 5]
        nz = px * frame[base, 6] + py * frame[base, 7] + pz * frame[base, 8]
        ux, uy, uz = cross(nx, ny, nz, ex, ey, ez)
        bar[b, LENGTH] = length
        for i in (tube, rod):
            frame[i, 0], frame[i, 1], frame[i, 2] = ex, -nx, ux
            frame[i, 3], frame[i, 4], frame[i, 5] = ey, -ny, uy
            frame[i, 6], frame[i, 7], frame[i, 8] = ez, -nz, uz
        for k in range(tree[tube, COORDINATE_END]):
            vx = jacobian[rod, k, 0] - jacobian[tube, k, 0]
            vy = jacobian[rod, k, 1] - jacobian[tube, k, 1]
            vz = jacobian[rod, k, 2] - jacobian[tube, k, 2]
            wx, wy, wz = jacobian[base, k, 3], jacobian[base, k, 4], jacobian[base, k, 5]
            cx, cy, cz = cross(wx, wy, wz, dx, dy, dz)
            turn = (ux * (vx - cx) + uy * (vy - cy) + uz * (vz - cz)) / length
            bar[b, LENGTH_ROW + k] = ex * vx + ey * vy + ez * vz
            for i in (tube, rod):
                jacobian[i, k, 3] = wx + nx * turn
                jacobian[i, k, 4] = wy + ny * turn
                jacobian[i, k, 5] = wz + nz * turn


@compile_without_allocation
def compute_bar_motion(tree, first, frame, bar):
    """Compute the motion of all cylinders (bars): spin, accelerations, and rate of their length.

    The accelerations are those at zero joint acceleration. `compute_bar_frames` must be called
    first.

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        first: index of the first tube.
        frame: (f, FRAME_SIZE) motion of tubes and rods, written; see `ReducedMotion`.
        bar: (bars, 3 + N) columns LENGTH_RATE and LENGTH_BIAS, the rate and acceleration of the
            pin-to-pin length, are written.

    Returns:
        Nothing.

    Source: Khoshzaban 1992, chapter 2.
    """
    for b in range(len(bar)):
        tube, rod = first + 2 * b, first + 2 * b + 1
        base, c = tree[tube, PARENT], bar[b, LENGTH]
        compute_frame_origin_motion(tree, frame, tube)
        compute_frame_origin_motion(tree, frame, rod)
        ex, ey, ez = frame[tube, 0], frame[tube, 3], frame[tube, 6]
        nx, ny, nz = -frame[tube, 1], -frame[tube, 4], -frame[tube, 7]
        ux, uy, uz = frame[tube, 2], frame[tube, 5], frame[tube, 8]
        dx, dy, dz = c * ex, c * ey, c * ez
        wx, wy, wz = frame[base, SPIN], frame[base, SPIN + 1], frame[base, SPIN + 2]
        vx = frame[rod, VELOCITY] - frame[tube, VELOCITY]
        vy = frame[rod, VELOCITY + 1] - frame[tube, VELOCITY + 1]
        vz = frame[rod, VELOCITY + 2] - frame[tube, VELOCITY + 2]
        ax = frame[rod, ACCELERATION] - frame[tube, ACCELERATION]
        ay = frame[rod, ACCELERATION + 1] - frame[tube, ACCELERATION + 1]
        az = frame[rod, ACCELERATION + 2] - frame[tube, ACCELERATION + 2]
        rate = ex * vx + ey * vy + ez * vz
        square = vx * vx + vy * vy + vz * vz
        bar[b, LENGTH_RATE] = rate
        bar[b, LENGTH_BIAS] = ex * ax + ey * ay + ez * az + (square - rate * rate) / c
        # velocity and acceleration relative to the base link, perpendicular to the bar
        cx, cy, cz = cross(wx, wy, wz, dx, dy, dz)
        sx, sy, sz = vx - cx, vy - cy, vz - cz
        turn = (ux * sx + uy * sy + uz * sz) / c
        tx, ty, tz = cross(
            frame[base, SPIN_RATE], frame[base, SPIN_RATE + 1], frame[base, SPIN_RATE + 2],
            dx, dy, dz,
        )  # fmt: skip
        # Coriolis and centripetal terms together: w x (2 s + w x d)
        gx, gy, gz = cross(wx, wy, wz, 2.0 * sx + cx, 2.0 * sy + cy, 2.0 * sz + cz)
        across = ux * (ax - tx - gx) + uy * (ay - ty - gy) + uz * (az - tz - gz)
        turn_rate = (across - 2.0 * rate * turn) / c
        mx, my, mz = cross(wx, wy, wz, nx, ny, nz)
        for i in (tube, rod):
            frame[i, SPIN] = wx + nx * turn
            frame[i, SPIN + 1] = wy + ny * turn
            frame[i, SPIN + 2] = wz + nz * turn
            frame[i, SPIN_RATE] = frame[base, SPIN_RATE] + nx * turn_rate + mx * turn
            frame[i, SPIN_RATE + 1] = frame[base, SPIN_RATE + 1] + ny * turn_rate + my * turn
            frame[i, SPIN_RATE + 2] = frame[base, SPIN_RATE + 2] + nz * turn_rate + mz * turn


_MAX_ITERATIONS = 20  # maximum number of Newton iterations
CLOSURE_TOLERANCE = 1.0e-12  # m, maximum residual of a closed loop: rounding of a 10 m machine
_MAX_INDEPENDENT_STEP = 0.2  # rad or m, maximum step of an independent coordinate between two Newton solutions
_MAX_DISTANCE = 20.0  # rad or m, distance per call above which steps get larger than _STEP
_MAX_DEPENDENT_STEP = 0.3  # rad or m, maximum change of a dependent coordinate per Newton iteration


@compile_without_allocation
def close_loops(mech, m, z):
    """Set the independent coordinates to given positions, close all loops, and compute the dependent rates.

    Newton's method computes the dependent coordinates. It starts from the last position in `m`, or
    from home if the last position is not finite. The independent coordinates move in steps of less
    than 0.2 rad or m (for distances up to 20), so that the linkages stay on the same branch.

    Args:
        mech: ReducedMechanism.
        m: ReducedMotion; written are the frames of the links, the positions, the dependent rates,
            the rates of dependent per independent coordinates (`basis`), and the closure equations
            with their factor (`loop`, `normal`). The independent rates are read.
        z: (>= n,) independent positions [rad] or [m].

    Returns:
        Maximum residual of a closure [m].

    Source: Newton's method on the loop equations; J_b r_b = -J_f r_f for the rates r, with the
        dependent (b) and independent (f) columns of their Jacobian.
    """
    joint, free, bound = m.joint, mech.independent, mech.dependent
    n, nb, lost, far, worst = len(free), len(bound), False, 0.0, 0.0
    for k in range(joint.shape[1]):
        lost = lost or not math.isfinite(joint[Q, k])
    if lost:
        for k in range(joint.shape[1]):
            joint[Q, k] = mech.joint[HOME, k]
        for b in range(nb):
            for f in range(n):
                m.basis[bound[b], f] = 0.0
    for f in range(n):
        move = abs(z[f] - joint[Q, free[f]])
        if move > far:
            far = move
    for part in range(1 + int(min(far, _MAX_DISTANCE) / _MAX_INDEPENDENT_STEP), 0, -1):
        move_coordinates(mech, m, z, part)
        for _ in range(_MAX_ITERATIONS):
            worst = linearise_loops(mech, m)
            if worst < CLOSURE_TOLERANCE:
                break
            correct_dependent_coordinates(mech, m)
        compute_dependent_slopes(mech, m)
    compute_dependent_rates(mech, m)
    return worst


@compile_without_allocation
def move_coordinates(mech, m, z, part):
    """Move the coordinates by 1 / `part` of the distance to the independent positions `z` (n,) [rad] or [m].

    The dependent coordinates move with the slopes in `basis`.
    """
    joint, free, bound = m.joint, mech.independent, mech.dependent
    for f in range(len(free)):
        move = (z[f] - joint[Q, free[f]]) / part
        joint[Q, free[f]] += move
        for b in range(len(bound)):
            joint[Q, bound[b]] += m.basis[bound[b], f] * move


@compile_without_allocation
def linearise_loops(mech, m):
    """Compute the frames of the links, the closure residuals, their Jacobian and its factor at positions.

    Returns:
        Maximum residual of a closure [m].
    """
    compute_link_frames(mech.tree, mech.shape, mech.link_count, m.joint, m.frame, m.jacobian)
    first = len(mech.tree) - 2 * len(m.loop) // 3
    worst = _compute_residuals(mech.tree, mech.shape, first, m.frame, m.jacobian, m.loop)
    _factorise_loops(mech.dependent, m.loop, m.normal)
    return worst


@compile_without_allocation
def correct_dependent_coordinates(mech, m):
    """Correct the dependent positions by one step of Newton's method, after `linearise_loops`."""
    bound, nb = mech.dependent, len(mech.dependent)
    _solve_loops(bound, m.loop, m.joint.shape[1], m.normal)
    for b in range(nb):
        m.joint[Q, bound[b]] += min(_MAX_DEPENDENT_STEP, max(-_MAX_DEPENDENT_STEP, m.normal[nb, b]))


@compile_without_allocation
def compute_dependent_slopes(mech, m):
    """Compute the rates of dependent per independent coordinates (`basis`), after `linearise_loops`."""
    bound, nb = mech.dependent, len(mech.dependent)
    for f in range(len(mech.independent)):
        _solve_loops(bound, m.loop, mech.independent[f], m.normal)
        for b in range(nb):
            m.basis[bound[b], f] = m.normal[nb, b]


@compile_without_allocation
def compute_dependent_rates(mech, m):
    """Compute the rates of the dependent coordinates from those of the independent ones and `basis`."""
    joint, free, bound = m.joint, mech.independent, mech.dependent
    for b in range(len(bound)):
        joint[RATE, bound[b]] = 0.0
        for f in range(len(free)):
            joint[RATE, bound[b]] += m.basis[bound[b], f] * joint[RATE, free[f]]


@compile_without_allocation
def compute_drift(mech, m):
    """Compute the accelerations (DRIFT) of the dependent coordinates at zero independent accelerations.

    Args:
        mech: ReducedMechanism.
        m: ReducedMotion after `close_loops` and `compute_link_motion`; DRIFT of the dependent coordinates
            is written.

    Returns:
        Nothing.

    Source: second derivative of the loop equations.
    """
    n, first = m.joint.shape[1], len(mech.tree) - 2 * len(m.loop) // 3
    for row in range(len(m.loop)):
        i = first + 2 * (row // 3)
        if row % 3 == 0:
            compute_frame_origin_motion(mech.tree, m.frame, i)
            compute_frame_origin_motion(mech.tree, m.frame, i + 1)
        at = ACCELERATION + row % 3
        m.loop[row, n + 1] = m.frame[i, at] - m.frame[i + 1, at]
    _solve_loops(mech.dependent, m.loop, n + 1, m.normal)
    for b in range(len(mech.dependent)):
        m.joint[DRIFT, mech.dependent[b]] = m.normal[len(mech.dependent), b]


@compile_without_allocation
def _compute_residuals(tree, shape, first, frame, jacobian, loop):
    """Compute the residuals of all closures and their Jacobian, and write them to `loop`.

    `loop` (3 closures, N + 2) holds the Jacobian and, in column N, the residuals [m]. `first` is the frame
    index of the first closure pin.

    Returns:
        Maximum residual [m].
    """
    n, worst = loop.shape[1] - 2, 0.0
    for row in range(len(loop)):
        i, r = first + 2 * (row // 3), row % 3
        if r == 0:
            compute_frame_origin(tree, shape, frame, jacobian, i)
            compute_frame_origin(tree, shape, frame, jacobian, i + 1)
        loop[row, n] = frame[i, ORIGIN + r] - frame[i + 1, ORIGIN + r]
        worst = max(worst, abs(loop[row, n]))
        for k in range(n):
            loop[row, k] = jacobian[i, k, r] - jacobian[i + 1, k, r]
    return worst


@compile_without_allocation
def _factorise_loops(bound, loop, normal):
    """Factorise the normal matrix A'A of the loop equations for the dependent coordinates.

    A are the columns `bound` of the Jacobian in `loop`. `normal` receives the Cholesky factor. The
    diagonal is increased by 1e-14 times the trace, so that it stays positive definite.
    """
    nb, trace = len(bound), 0.0
    for a in range(nb):
        for b in range(a + 1):
            normal[a, b] = 0.0
            for r in range(len(loop)):
                normal[a, b] += loop[r, bound[a]] * loop[r, bound[b]]
        trace += normal[a, a]
    for a in range(nb):
        normal[a, a] += 1.0e-14 * trace
    factorise_cholesky(normal)


@compile_without_allocation
def _solve_loops(bound, loop, column, normal):
    """Solve the loop equations `A x = -loop[:, column]` for the dependent coordinates by least squares.

    A are the columns `bound` of `loop`, with the factor of `_factorise_loops` in `normal`. The solution
    is written to the last row of `normal`.
    """
    nb = len(bound)
    for a in range(nb):
        normal[nb, a] = 0.0
        for r in range(len(loop)):
            normal[nb, a] -= loop[r, bound[a]] * loop[r, column]
    solve_cholesky(normal, normal[nb])


# columns of `frame`
ROTATION, ORIGIN, SPIN, VELOCITY = 0, 9, 12, 15
SPIN_RATE, ACCELERATION, FORCE, FRAME_SIZE = 18, 21, 24, 30
LENGTH, LENGTH_RATE, LENGTH_BIAS, LENGTH_ROW = range(4)  # columns of `bar`
Q, RATE, DRIFT, BIAS = range(4)  # rows of `joint`


class ReducedMotion(NamedTuple):
    """Workspace and result of the functions of this module, for f frames and N coordinates.

    Attributes:
        frame: (f, FRAME_SIZE) columns ROTATION (9, row by row, rotation to the world), ORIGIN [m],
            SPIN (angular velocity) [rad/s], VELOCITY of the origin [m/s]; at zero joint
            acceleration SPIN_RATE [rad/s^2] and ACCELERATION of the origin minus gravity [m/s^2];
            FORCE (6), force [N] and torque about the origin [N m] that this motion requires,
            including the support of the weight.
        jacobian: (f, N, 6) derivatives of velocity and spin by the N coordinate rates.
        momentum: (f, N, 6) derivatives of momentum and angular momentum about the frame's origin by
            the rates.
        bar: (bars, 3 + N) columns LENGTH, pin to pin [m], LENGTH_RATE [m/s], LENGTH_BIAS,
            acceleration of the length at zero joint acceleration [m/s^2], and from LENGTH_ROW on
            the derivatives of the length rate by the N coordinate rates.
        mass: (N, N) mass matrix of the tree with its bars [kg m^2] or [kg].
        joint: (4, N) rows Q, positions, RATE, DRIFT, joint accelerations at zero independent
            acceleration, and BIAS, gravity and velocity forces [N m] or [N].
        basis: (N, n) derivatives of all coordinate rates by the n independent rates.
        loop: (3 closures, N + 2) Jacobian of the closure residuals; then the residuals [m], and
            their accelerations at zero joint acceleration [m/s^2].
        normal: (N - n + 1, N - n) Cholesky factor of the normal matrix of the closure equations;
            the last row holds a right-hand side or solution.
    """

    frame: np.ndarray
    jacobian: np.ndarray
    momentum: np.ndarray
    bar: np.ndarray
    mass: np.ndarray
    joint: np.ndarray
    basis: np.ndarray
    loop: np.ndarray
    normal: np.ndarray


def make_reduced_motion(mech: ReducedMechanism) -> ReducedMotion:
    """Allocate the work arrays of a reduced mechanism, with its joints at their home positions and all rates 0."""
    f, n, bound = len(mech.tree), mech.joint.shape[1], len(mech.dependent)
    frame = np.zeros((f, FRAME_SIZE))
    frame[:, ROTATION : ROTATION + 9] = np.eye(3).ravel()
    frame[0, ACCELERATION : ACCELERATION + 3] = -mech.gravity
    basis = np.zeros((n, len(mech.independent)))
    basis[mech.independent, np.arange(len(mech.independent))] = 1.0
    joint = np.zeros((4, n))
    joint[Q] = mech.joint[HOME]
    return ReducedMotion(
        frame, np.zeros((f, n, 6)), np.zeros((f, n, 6)), np.zeros((mech.bar_count, LENGTH_ROW + n)),
        np.zeros((n, n)), joint, basis, np.zeros((3 * (f - mech.body_count) // 2, n + 2)),
        np.zeros((bound + 1, bound)),
    )  # fmt: skip


@compile_without_allocation
def cross(ax, ay, az, bx, by, bz):
    """Return the cross product of two vectors given by their components.

    Args:
        ax: scalar.
        ay: scalar.
        az: scalar.
        bx: scalar.
        by: scalar.
        bz: scalar.

    Returns:
        Its three components.

    Source: definition.
    """
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@compile_without_allocation
def rotate_to_world(frame, i, x, y, z):
    """Rotate a vector from a frame to the axes of the world.

    Args:
        frame: (f, FRAME_SIZE) frames, see `ReducedMotion`.
        i: index of the frame.
        x: component along its x axis, scalar.
        y: component along its y axis, scalar.
        z: component along its z axis, scalar.

    Returns:
        The three components in the world.

    Source: definition.
    """
    return (
        frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z,
        frame[i, 3] * x + frame[i, 4] * y + frame[i, 5] * z,
        frame[i, 6] * x + frame[i, 7] * y + frame[i, 8] * z,
    )


@compile_without_allocation
def compute_frame_origin(tree, shape, frame, jacobian, i):
    """Compute the world position of frame i's origin and its Jacobian, as a point fixed to the parent frame.

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        shape: (f, SHAPE_SIZE) geometry of the frames, see `ReducedMechanism`.
        frame: (f, FRAME_SIZE) frames, see `ReducedMotion`; the origin is written.
        jacobian: (f, N, 6) velocities of the frames per joint rate; written, with the spin of the
            parent.
        i: index of the frame.

    Returns:
        Nothing.

    Source: rigid-body kinematics.
    """
    p = tree[i, PARENT]
    rx, ry, rz = rotate_to_world(frame, p, shape[i, POSITION], shape[i, POSITION + 1], shape[i, POSITION + 2])
    frame[i, ORIGIN] = frame[p, ORIGIN] + rx
    frame[i, ORIGIN + 1] = frame[p, ORIGIN + 1] + ry
    frame[i, ORIGIN + 2] = frame[p, ORIGIN + 2] + rz
    for k in range(tree[p, COORDINATE_END]):
        wx, wy, wz = jacobian[p, k, 3], jacobian[p, k, 4], jacobian[p, k, 5]
        jacobian[i, k, 0] = jacobian[p, k, 0] + wy * rz - wz * ry
        jacobian[i, k, 1] = jacobian[p, k, 1] + wz * rx - wx * rz
        jacobian[i, k, 2] = jacobian[p, k, 2] + wx * ry - wy * rx
        jacobian[i, k, 3] = wx
        jacobian[i, k, 4] = wy
        jacobian[i, k, 5] = wz


@compile_without_allocation
def compute_frame_origin_motion(tree, frame, i):
    """Compute velocity, spin and accelerations of frame i as if it were fixed to its parent frame.

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        frame: (f, FRAME_SIZE) frames after `compute_frame_origin`; the motion of frame i is
            written.
        i: index of the frame.

    Returns:
        Nothing.

    Source: rigid-body kinematics.
    """
    p = tree[i, PARENT]
    rx = frame[i, ORIGIN] - frame[p, ORIGIN]
    ry = frame[i, ORIGIN + 1] - frame[p, ORIGIN + 1]
    rz = frame[i, ORIGIN + 2] - frame[p, ORIGIN + 2]
    wx, wy, wz = frame[p, SPIN], frame[p, SPIN + 1], frame[p, SPIN + 2]
    ax, ay, az = frame[p, SPIN_RATE], frame[p, SPIN_RATE + 1], frame[p, SPIN_RATE + 2]
    vx, vy, vz = cross(wx, wy, wz, rx, ry, rz)
    tx, ty, tz = cross(ax, ay, az, rx, ry, rz)
    cx, cy, cz = cross(wx, wy, wz, vx, vy, vz)
    frame[i, VELOCITY] = frame[p, VELOCITY] + vx
    frame[i, VELOCITY + 1] = frame[p, VELOCITY + 1] + vy
    frame[i, VELOCITY + 2] = frame[p, VELOCITY + 2] + vz
    frame[i, ACCELERATION] = frame[p, ACCELERATION] + tx + cx
    frame[i, ACCELERATION + 1] = frame[p, ACCELERATION + 1] + ty + cy
    frame[i, ACCELERATION + 2] = frame[p, ACCELERATION + 2] + tz + cz
    frame[i, SPIN], frame[i, SPIN + 1], frame[i, SPIN + 2] = wx, wy, wz
    frame[i, SPIN_RATE], frame[i, SPIN_RATE + 1], frame[i, SPIN_RATE + 2] = ax, ay, az


@compile_without_allocation
def _rotate_frame_about_axis(frame, i, p, x, y, z, angle):
    """Set the orientation of frame i to that of frame p, rotated about an axis (x, y, z) of p by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    k = 1.0 - c
    r00, r01, r02 = c + x * x * k, x * y * k - z * s, x * z * k + y * s
    r10, r11, r12 = y * x * k + z * s, c + y * y * k, y * z * k - x * s
    r20, r21, r22 = z * x * k - y * s, z * y * k + x * s, c + z * z * k
    for r in range(0, 9, 3):
        a, b, d = frame[p, r], frame[p, r + 1], frame[p, r + 2]
        frame[i, r] = a * r00 + b * r10 + d * r20
        frame[i, r + 1] = a * r01 + b * r11 + d * r21
        frame[i, r + 2] = a * r02 + b * r12 + d * r22


@compile_without_allocation
def compute_link_frames(tree, shape, links, joint, frame, jacobian):
    """Compute pose and Jacobian of every link from the joint positions (forward kinematics).

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        shape: (f, SHAPE_SIZE) geometry of the frames, see `ReducedMechanism`.
        links: number of links.
        joint: (4, N) joint quantities, see `ReducedMotion`; the positions are read.
        frame: (f, FRAME_SIZE) frames; orientations and origins are written.
        jacobian: (f, N, 6) velocities of the frames per joint rate, written.

    Returns:
        Nothing.

    Source: differential kinematics of a tree.
    """
    for i in range(1, 1 + links):
        p, j = tree[i, PARENT], tree[i, COORDINATE]
        compute_frame_origin(tree, shape, frame, jacobian, i)
        lx, ly, lz = shape[i, AXIS], shape[i, AXIS + 1], shape[i, AXIS + 2]
        x, y, z = rotate_to_world(frame, p, lx, ly, lz)
        if tree[i, KIND] == HINGE:
            _rotate_frame_about_axis(frame, i, p, lx, ly, lz, joint[Q, j])
            jacobian[i, j, 3], jacobian[i, j, 4], jacobian[i, j, 5] = x, y, z
            continue
        for r in range(9):
            frame[i, r] = frame[p, r]
        if tree[i, KIND] == SLIDE:
            sx, sy, sz = x * joint[Q, j], y * joint[Q, j], z * joint[Q, j]
            frame[i, ORIGIN] += sx
            frame[i, ORIGIN + 1] += sy
            frame[i, ORIGIN + 2] += sz
            for k in range(tree[p, COORDINATE_END]):
                vx, vy, vz = cross(jacobian[p, k, 3], jacobian[p, k, 4], jacobian[p, k, 5], sx, sy, sz)
                jacobian[i, k, 0] += vx
                jacobian[i, k, 1] += vy
                jacobian[i, k, 2] += vz
            jacobian[i, j, 0], jacobian[i, j, 1], jacobian[i, j, 2] = x, y, z


@compile_without_allocation
def compute_link_motion(tree, links, joint, frame, jacobian):
    """Compute velocity, spin and accelerations of every link from the joint rates.

    The accelerations are those at zero joint acceleration. `compute_link_frames` must be called
    first.

    Args:
        tree: (f, 4) kinematic tree, see `ReducedMechanism`.
        links: number of links.
        joint: (4, N) joint quantities, see `ReducedMotion`; the rates are read.
        frame: (f, FRAME_SIZE) frames; their motion is written.
        jacobian: (f, N, 6) of `compute_link_frames`; the joint axes are read.

    Returns:
        Nothing.

    Source: differential kinematics of a tree.
    """
    for i in range(1, 1 + links):
        compute_frame_origin_motion(tree, frame, i)
        if tree[i, KIND] != HINGE and tree[i, KIND] != SLIDE:
            continue
        p, j = tree[i, PARENT], tree[i, COORDINATE]
        rate, hinge = joint[RATE, j], tree[i, KIND] == HINGE
        a = 3 if hinge else 0
        x, y, z = jacobian[i, j, a], jacobian[i, j, a + 1], jacobian[i, j, a + 2]
        tx, ty, tz = cross(frame[p, SPIN], frame[p, SPIN + 1], frame[p, SPIN + 2], x, y, z)
        first, second, twice = (SPIN, SPIN_RATE, 1.0) if hinge else (VELOCITY, ACCELERATION, 2.0)
        frame[i, first] += x * rate
        frame[i, first + 1] += y * rate
        frame[i, first + 2] += z * rate
        frame[i, second] += twice * tx * rate
        frame[i, second + 1] += twice * ty * rate
        frame[i, second + 2] += twice * tz * rate


@compile_without_allocation
def compute_mass_and_bias(mech, m):
    """Compute the mass matrix and bias forces of the tree with its bars (Kane's projection).

    `M = sum J' P` and `h = sum J' F` over all bodies, with Jacobians J, momenta per unit rate P,
    and wrenches F of inertia at zero joint acceleration and of gravity.

    Args:
        mech: ReducedMechanism.
        m: ReducedMotion with the motion of links and bars; `momentum`, `mass`, the columns FORCE of
            `frame` and the row BIAS of `joint` are written.

    Returns:
        Nothing.

    Source: Kane and Levinson 1985, Dynamics.
    """
    bodies, n = 1 + mech.link_count + 2 * mech.bar_count, m.mass.shape[0]
    frame, jacobian, momentum = m.frame, m.jacobian, m.momentum
    for b in range(1, bodies):
        _compute_body_wrench(mech.shape, frame, jacobian, b, mech.tree[b, COORDINATE_END], momentum)
    for i in range(n):
        bias = 0.0
        for b in range(1, bodies):
            if mech.tree[b, COORDINATE_END] > i:
                for r in range(6):
                    bias += jacobian[b, i, r] * frame[b, FORCE + r]
        m.joint[BIAS, i] = bias
        for j in range(i + 1):
            mass = 0.0
            for b in range(1, bodies):
                if mech.tree[b, COORDINATE_END] > i:
                    for r in range(6):
                        mass += jacobian[b, j, r] * momentum[b, i, r]
            m.mass[i, j] = mass
            m.mass[j, i] = mass


@compile_without_allocation
def _compute_body_wrench(shape, frame, jacobian, b, reach, momentum):
    """Compute momentum per unit joint rate of body b, and its wrench of inertia and gravity.

    Both are about the origin of its frame, in world axes; `momentum` and the FORCE columns of `frame` are
    written. `reach` is the number of leading coordinates that can move the body.
    """
    mass = shape[b, MASS]
    rx, ry, rz = rotate_to_world(frame, b, shape[b, COM], shape[b, COM + 1], shape[b, COM + 2])
    i0, i1, i2 = shape[b, INERTIA], shape[b, INERTIA + 1], shape[b, INERTIA + 2]
    t0, t1, t2 = frame[b, 0], frame[b, 1], frame[b, 2]
    t3, t4, t5 = frame[b, 3], frame[b, 4], frame[b, 5]
    t6, t7, t8 = frame[b, 6], frame[b, 7], frame[b, 8]
    xx = i0 * t0 * t0 + i1 * t1 * t1 + i2 * t2 * t2  # inertia in the world's axes
    xy = i0 * t0 * t3 + i1 * t1 * t4 + i2 * t2 * t5
    xz = i0 * t0 * t6 + i1 * t1 * t7 + i2 * t2 * t8
    yy = i0 * t3 * t3 + i1 * t4 * t4 + i2 * t5 * t5
    yz = i0 * t3 * t6 + i1 * t4 * t7 + i2 * t5 * t8
    zz = i0 * t6 * t6 + i1 * t7 * t7 + i2 * t8 * t8
    wx, wy, wz = frame[b, SPIN], frame[b, SPIN + 1], frame[b, SPIN + 2]
    ax, ay, az = frame[b, SPIN_RATE], frame[b, SPIN_RATE + 1], frame[b, SPIN_RATE + 2]
    vx, vy, vz = cross(wx, wy, wz, rx, ry, rz)
    cx, cy, cz = cross(wx, wy, wz, vx, vy, vz)
    tx, ty, tz = cross(ax, ay, az, rx, ry, rz)
    fx = mass * (frame[b, ACCELERATION] + tx + cx)
    fy = mass * (frame[b, ACCELERATION + 1] + ty + cy)
    fz = mass * (frame[b, ACCELERATION + 2] + tz + cz)
    gx, gy, gz = cross(
        wx, wy, wz,
        xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz * wz,
    )  # fmt: skip
    sx, sy, sz = cross(rx, ry, rz, fx, fy, fz)
    frame[b, FORCE], frame[b, FORCE + 1], frame[b, FORCE + 2] = fx, fy, fz
    frame[b, FORCE + 3] = sx + gx + xx * ax + xy * ay + xz * az
    frame[b, FORCE + 4] = sy + gy + xy * ax + yy * ay + yz * az
    frame[b, FORCE + 5] = sz + gz + xz * ax + yz * ay + zz * az
    for i in range(reach):
        wx, wy, wz = jacobian[b, i, 3], jacobian[b, i, 4], jacobian[b, i, 5]
        vx, vy, vz = cross(wx, wy, wz, rx, ry, rz)
        px = mass * (jacobian[b, i, 0] + vx)
        py = mass * (jacobian[b, i, 1] + vy)
        pz = mass * (jacobian[b, i, 2] + vz)
        sx, sy, sz = cross(rx, ry, rz, px, py, pz)
        momentum[b, i, 0], momentum[b, i, 1], momentum[b, i, 2] = px, py, pz
        momentum[b, i, 3] = sx + xx * wx + xy * wy + xz * wz
        momentum[b, i, 4] = sy + xy * wx + yy * wy + yz * wz
        momentum[b, i, 5] = sz + xz * wx + yz * wy + zz * wz

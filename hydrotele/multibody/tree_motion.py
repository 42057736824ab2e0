"""Motion of a joint tree: frames of the bodies, Jacobian columns of points, wrenches of bodies.

Three-component vectors and rotations are tuples, so that compiled code does not allocate. The QR
functions solve least-squares problems of a few columns in given arrays.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled


@compile_without_allocation
def get_vector(rows, k):
    """Return row k of an (n, 3) array as a tuple (x, y, z)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@compile_without_allocation
def set_vector(rows, k, a):
    """Write a tuple (x, y, z) into row k of an (n, 3) array."""
    rows[k, 0], rows[k, 1], rows[k, 2] = a


@compile_without_allocation
def add_vectors(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compile_without_allocation
def subtract_vectors(a, b):
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compile_without_allocation
def scale_vector(s, a):
    """Return a vector times a scalar."""
    return s * a[0], s * a[1], s * a[2]


@compile_without_allocation
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compile_without_allocation
def cross(a, b):
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compile_without_allocation
def point_acceleration(w, dw, arm):
    """Return the acceleration `dw x r + w x (w x r)` of a body's point at r = `arm` from its fixed origin.

    w and dw are angular velocity [rad/s] and angular acceleration [rad/s^2].
    """
    return add_vectors(cross(dw, arm), cross(w, cross(w, arm)))


@compile_without_allocation
def get_rotation(rows, k):
    """Return matrix k of an (n, 3, 3) array as three row vectors."""
    m = rows[k]
    return (
        (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    )  # fmt: skip


@compile_without_allocation
def set_rotation(rows, k, r):
    """Write three row vectors into matrix k of an (n, 3, 3) array."""
    m = rows[k]
    m[0, 0], m[0, 1], m[0, 2] = r[0]
    m[1, 0], m[1, 1], m[1, 2] = r[1]
    m[2, 0], m[2, 1], m[2, 2] = r[2]


@compile_without_allocation
def rotate_vector(r, a):
    """Return the vector a, rotated by the rotation matrix r (three row vectors)."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


@compile_without_allocation
def rotate_vector_back(r, a):
    """Return the vector a, rotated by the inverse (transpose) of the rotation matrix r."""
    return add_vectors(add_vectors(scale_vector(a[0], r[0]), scale_vector(a[1], r[1])), scale_vector(a[2], r[2]))


@compile_without_allocation
def compose_rotations(r, s):
    """Return the rotation r s, which applies s first and then r."""
    return rotate_vector_back(s, r[0]), rotate_vector_back(s, r[1]), rotate_vector_back(s, r[2])


@compile_without_allocation
def axis_rotation(axis, angle):
    """Return the rotation matrix (three row vectors) about a unit axis by an angle [rad] (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )


_MIN_RANK_RATIO = 1e-7  # minimum ratio of an orthogonalised column to the largest one for full rank


@compile_without_allocation
def qr_factor(matrix, columns, q, r):
    """Compute the QR factorisation of selected columns of a matrix, by modified Gram-Schmidt done twice.

    `q` (rows, count) and `r` (count, count) are written.

    Returns:
        Whether the columns are linearly independent.
    """
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
        if not r[j, j] > _MIN_RANK_RATIO * size:
            return False
        for m in range(rows):
            q[m, j] /= r[j, j]
    return True


@compile_without_allocation
def qr_solve(q, r, count, right, column, answer, k):
    """Solve a least-squares problem with the factors q and r of `qr_factor` for `count` unknowns.

    The right-hand side is column `column` of `right`; the solution is written to column k of `answer`.
    """
    for j in range(count - 1, -1, -1):
        total = 0.0
        for m in range(len(right)):
            total += q[m, j] * right[m, column]
        for i in range(j + 1, count):
            total -= r[j, i] * answer[i, k]
        answer[j, k] = total / r[j, j]


_INERTIA_PAIRS = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])


class Frames(NamedTuple):
    """Positions and motion of bodies and joint axes in the world frame; b bodies, v joints.

    Attributes:
        origin: (b, 3) origins [m].
        rotation: (b, 3, 3) orientations.
        angular_velocity: (b, 3) angular velocities [rad/s].
        angular_acceleration: (b, 3) angular accelerations [rad/s^2].
        acceleration: (b, 3) accelerations of the origins [m/s^2].
        axis: (v, 3) joint axes.
        anchor: (v, 3) points on the joint axes [m].
    """

    origin: np.ndarray
    rotation: np.ndarray
    angular_velocity: np.ndarray
    angular_acceleration: np.ndarray
    acceleration: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray


@compiled
def allocate_frames(tree):
    """Allocate arrays for positions and motion of all bodies and joint axes of a joint tree."""
    b, v = len(tree.parent), len(tree.reference_position)
    return Frames(
        np.empty((b, 3)), np.empty((b, 3, 3)), np.empty((b, 3)), np.empty((b, 3)),
        np.empty((b, 3)), np.empty((v, 3)), np.empty((v, 3)),
    )  # fmt: skip


@compile_without_allocation
def compute_frames(tree, q, rate, acceleration, ground, frames):
    """Compute poses, velocities and accelerations of all bodies from the motion of the joints.

    Args:
        tree: Tree of v joints.
        q: (v,) joint positions [rad] or [m].
        rate: (v,) joint rates [rad/s] or [m/s].
        acceleration: (v,) joint accelerations [rad/s^2] or [m/s^2].
        ground: (3,) acceleration of the world, such as minus gravity [m/s^2].
        frames: Frames, written.
    """
    set_vector(frames.origin, 0, (0.0, 0.0, 0.0))
    set_vector(frames.angular_velocity, 0, (0.0, 0.0, 0.0))
    set_vector(frames.angular_acceleration, 0, (0.0, 0.0, 0.0))
    set_vector(frames.acceleration, 0, (ground[0], ground[1], ground[2]))
    set_rotation(frames.rotation, 0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    for b in range(1, len(tree.parent)):
        up = tree.parent[b]
        t, w, dw = (
            get_rotation(frames.rotation, up),
            get_vector(frames.angular_velocity, up),
            get_vector(frames.angular_acceleration, up),
        )
        arm = rotate_vector(t, get_vector(tree.offset, b))
        p = add_vectors(get_vector(frames.origin, up), arm)
        a = add_vectors(get_vector(frames.acceleration, up), point_acceleration(w, dw, arm))
        t = compose_rotations(t, get_rotation(tree.rotation, b))
        for j in range(tree.first_joint[b], tree.first_joint[b + 1]):
            own, center = get_vector(tree.axis, j), get_vector(tree.anchor, j)
            way, arm = rotate_vector(t, own), rotate_vector(t, center)
            set_vector(frames.axis, j, way)
            set_vector(frames.anchor, j, add_vectors(p, arm))
            step, turning = q[j] - tree.reference_position[j], cross(w, way)
            if tree.is_slide[j]:
                arm = scale_vector(step, way)
                a = add_vectors(a, point_acceleration(w, dw, arm))
                a = add_vectors(
                    a, add_vectors(scale_vector(2.0 * rate[j], turning), scale_vector(acceleration[j], way))
                )
                p = add_vectors(p, arm)
                continue
            a = add_vectors(a, point_acceleration(w, dw, arm))
            dw = add_vectors(dw, add_vectors(scale_vector(acceleration[j], way), scale_vector(rate[j], turning)))
            w = add_vectors(w, scale_vector(rate[j], way))
            t = compose_rotations(t, axis_rotation(own, step))
            back = scale_vector(-1.0, rotate_vector(t, center))
            a = add_vectors(a, point_acceleration(w, dw, back))
            p = add_vectors(add_vectors(p, arm), back)
        set_vector(frames.origin, b, p)
        set_rotation(frames.rotation, b, t)
        set_vector(frames.angular_velocity, b, w)
        set_vector(frames.angular_acceleration, b, dw)
        set_vector(frames.acceleration, b, a)


@compile_without_allocation
def point_jacobian_column(tree, frames, j, point):
    """Return the velocity of a point per unit rate of joint j, in the world frame.

    This is a column of the point's Jacobian. The joint must move the point.
    """
    way = get_vector(frames.axis, j)
    return way if tree.is_slide[j] else cross(way, subtract_vectors(point, get_vector(frames.anchor, j)))


@compile_without_allocation
def compute_unit_wrenches(frames, body, forces, torques):
    """Compute force and torque that a body's motion requires, per unit of its ten inertial parameters.

    `f = m a + alpha x s + w x (w x s)` and `n = I alpha + w x I w + s x a` with mass m, acceleration a of
    the origin, s = m times the centre of mass, inertia I, angular velocity w and acceleration alpha.
    `forces` and `torques` (3, 10) about the origin, in the world frame, are written.
    """
    t, a = get_rotation(frames.rotation, body), get_vector(frames.acceleration, body)
    w, dw = get_vector(frames.angular_velocity, body), get_vector(frames.angular_acceleration, body)
    for k in range(3):
        forces[k, 0], torques[k, 0] = a[k], 0.0
        way = (t[0][k], t[1][k], t[2][k])
        f, n = point_acceleration(w, dw, way), cross(way, a)
        for m in range(3):
            forces[m, 1 + k], torques[m, 1 + k] = f[m], n[m]
    v, dv = rotate_vector_back(t, w), rotate_vector_back(t, dw)
    for p in range(6):
        i, j = _INERTIA_PAIRS[p, 0], _INERTIA_PAIRS[p, 1]
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
        n = rotate_vector(t, add_vectors((dx, dy, dz), cross(v, (x, y, z))))
        for m in range(3):
            forces[m, 4 + p], torques[m, 4 + p] = 0.0, n[m]

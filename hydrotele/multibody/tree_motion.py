"""Motion of a joint tree: frames of the bodies, Jacobian columns of points, wrenches of bodies."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.multibody.vector_algebra import (
    add_vectors,
    axis_rotation,
    compose_rotations,
    cross,
    get_rotation,
    get_vector,
    point_acceleration,
    rotate_vector,
    rotate_vector_back,
    scale_vector,
    set_rotation,
    set_vector,
    subtract_vectors,
)

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
        ground: (3,) acceleration of the world, which all accelerations include [m/s^2]; minus
            gravity accounts for the weight of the bodies.
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

"""Motion of a joint tree: frames of the bodies, joint velocities of points, wrenches of bodies."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.multibody.vectors import (
    add,
    axis_rotation,
    composed,
    cross,
    rotated,
    rotated_back,
    rotating_acceleration,
    rotation,
    scaled,
    store,
    store_rotation,
    subtract,
    vector,
)

_PAIRS = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])


class Frames(NamedTuple):
    """Where bodies are and how they move, all in the world; b bodies, v joints.

    Attributes:
        place: (b, 3) origins.
        turn: (b, 3, 3) orientations.
        spin: (b, 3) angular velocities.
        spin_rate: (b, 3) their rates.
        acceleration: (b, 3) accelerations of the origins.
        axis: (v, 3) joint axes.
        anchor: (v, 3) points on them.
    """

    place: np.ndarray
    turn: np.ndarray
    spin: np.ndarray
    spin_rate: np.ndarray
    acceleration: np.ndarray
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
    store(frames.place, 0, (0.0, 0.0, 0.0))
    store(frames.spin, 0, (0.0, 0.0, 0.0))
    store(frames.spin_rate, 0, (0.0, 0.0, 0.0))
    store(frames.acceleration, 0, (ground[0], ground[1], ground[2]))
    store_rotation(frames.turn, 0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    for b in range(1, len(tree.parent)):
        up = tree.parent[b]
        t, w, dw = rotation(frames.turn, up), vector(frames.spin, up), vector(frames.spin_rate, up)
        arm = rotated(t, vector(tree.offset, b))
        p = add(vector(frames.place, up), arm)
        a = add(vector(frames.acceleration, up), rotating_acceleration(w, dw, arm))
        t = composed(t, rotation(tree.turn, b))
        for j in range(tree.first[b], tree.first[b + 1]):
            own, center = vector(tree.axis, j), vector(tree.anchor, j)
            way, arm = rotated(t, own), rotated(t, center)
            store(frames.axis, j, way)
            store(frames.anchor, j, add(p, arm))
            step, turning = q[j] - tree.zero[j], cross(w, way)
            if tree.slides[j]:
                arm = scaled(step, way)
                a = add(a, rotating_acceleration(w, dw, arm))
                a = add(a, add(scaled(2.0 * rate[j], turning), scaled(acceleration[j], way)))
                p = add(p, arm)
                continue
            a = add(a, rotating_acceleration(w, dw, arm))
            dw = add(dw, add(scaled(acceleration[j], way), scaled(rate[j], turning)))
            w = add(w, scaled(rate[j], way))
            t = composed(t, axis_rotation(own, step))
            back = scaled(-1.0, rotated(t, center))
            a = add(a, rotating_acceleration(w, dw, back))
            p = add(add(p, arm), back)
        store(frames.place, b, p)
        store_rotation(frames.turn, b, t)
        store(frames.spin, b, w)
        store(frames.spin_rate, b, dw)
        store(frames.acceleration, b, a)


@allocation_free
def point_column(tree, frames, j, point):
    """Velocity of a point per unit rate of a joint that moves it."""
    way = vector(frames.axis, j)
    return way if tree.slides[j] else cross(way, subtract(point, vector(frames.anchor, j)))


@allocation_free
def wrenches(frames, body, forces, torques):
    """Force and torque (3, 10) at a body's origin per unit of an inertial parameter, in the world.

    `f = m a + alpha x s + w x (w x s)` and `n = I alpha + w x I w + s x a` with s = m c.
    """
    t, a = rotation(frames.turn, body), vector(frames.acceleration, body)
    w, dw = vector(frames.spin, body), vector(frames.spin_rate, body)
    for k in range(3):
        forces[k, 0], torques[k, 0] = a[k], 0.0
        way = (t[0][k], t[1][k], t[2][k])
        f, n = rotating_acceleration(w, dw, way), cross(way, a)
        for m in range(3):
            forces[m, 1 + k], torques[m, 1 + k] = f[m], n[m]
    v, dv = rotated_back(t, w), rotated_back(t, dw)
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
        n = rotated(t, add((dx, dy, dz), cross(v, (x, y, z))))
        for m in range(3):
            forces[m, 4 + p], torques[m, 4 + p] = 0.0, n[m]

"""Motion of every body, and the mass matrix and bias forces that follow: the projection method.

Links come from the tree; a bar (tube and rod) follows from its two pins. Everything is differential
kinematics in tree coordinates, so that one pass serves simulation, estimation and regressors.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dynamics.mechanism import Mechanism


class Motion(NamedTuple):
    """Work space and result of `move_bodies`, for b bodies and N tree coordinates.

    Attributes:
        turn: (b, 3, 3) body to world.
        origin: (b, 3) of the body's frame [m].
        spin: (b, 3) angular velocity [rad/s].
        velocity: (b, 3) of the origin [m/s].
        spin_rate: (b, 3) angular acceleration at zero joint acceleration [rad/s^2].
        acceleration: (b, 3) of the origin at zero joint acceleration, minus gravity [m/s^2].
        turning: (b, 3, N) d spin / d rates.
        moving: (b, 3, N) d velocity / d rates.
        length: (bars,) pin-to-pin length [m].
        length_rate: (bars,) [m/s].
        length_row: (bars, N) d length_rate / d rates [m/rad] or [1].
        length_bias: (bars,) acceleration of the length at zero joint acceleration [m/s^2].
        mass: (N, N) mass matrix of the tree with its bars [kg m^2] or [kg].
        bias: (N,) gravity and velocity forces [N m] or [N].
        basis: (N, n) d rates / d independent rates.
        drift: (N,) joint acceleration at zero independent acceleration [rad/s^2].
        bound: (N - n,) positions of the bound coordinates, the start of the next search.
    """

    turn: np.ndarray
    origin: np.ndarray
    spin: np.ndarray
    velocity: np.ndarray
    spin_rate: np.ndarray
    acceleration: np.ndarray
    turning: np.ndarray
    moving: np.ndarray
    length: np.ndarray
    length_rate: np.ndarray
    length_row: np.ndarray
    length_bias: np.ndarray
    mass: np.ndarray
    bias: np.ndarray
    basis: np.ndarray
    drift: np.ndarray
    bound: np.ndarray


def motion_space(mech: Mechanism) -> Motion:
    """Fresh work space for `move_bodies`."""
    b, n, bars = len(mech.mass), len(mech.home), len(mech.bar_links)
    turn = np.zeros((b, 3, 3))
    turn[:] = np.eye(3)
    basis = np.zeros((n, len(mech.free)))
    basis[mech.free, np.arange(len(mech.free))] = 1.0
    return Motion(
        turn, np.zeros((b, 3)), np.zeros((b, 3)), np.zeros((b, 3)), np.zeros((b, 3)),
        np.zeros((b, 3)), np.zeros((b, 3, n)), np.zeros((b, 3, n)), np.zeros(bars),
        np.zeros(bars), np.zeros((bars, n)), np.zeros(bars), np.zeros((n, n)), np.zeros(n),
        basis, np.zeros(n), mech.home[mech.bound].copy(),
    )  # fmt: skip


@compiled
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _turned(turn, local, out):
    for r in range(3):
        out[r] = turn[r, 0] * local[0] + turn[r, 1] * local[1] + turn[r, 2] * local[2]


@compiled
def _rotate(turn, axis, angle, out):
    """`out = turn * rotation(axis, angle)`."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = axis[0], axis[1], axis[2]
    k = 1.0 - c
    r00, r01, r02 = c + x * x * k, x * y * k - z * s, x * z * k + y * s
    r10, r11, r12 = y * x * k + z * s, c + y * y * k, y * z * k - x * s
    r20, r21, r22 = z * x * k - y * s, z * y * k + x * s, c + z * z * k
    for i in range(3):
        a, b, d = turn[i, 0], turn[i, 1], turn[i, 2]
        out[i, 0] = a * r00 + b * r10 + d * r20
        out[i, 1] = a * r01 + b * r11 + d * r21
        out[i, 2] = a * r02 + b * r12 + d * r22


@compiled
def point_motion(m, body, local, place, velocity, acceleration, moving):
    """Motion of a point fixed to a body.

    Args:
        m: Motion whose bodies have been moved.
        body: index of the body.
        local: (3,) point in the body's frame [m].
        place: (3,) written: its place [m].
        velocity: (3,) written [m/s].
        acceleration: (3,) written: at zero joint acceleration, minus gravity [m/s^2].
        moving: (3, N) written: d velocity / d rates.

    Returns:
        Nothing.

    Source: rigid-body kinematics.
    """
    n = moving.shape[1]
    rx = m.turn[body, 0, 0] * local[0] + m.turn[body, 0, 1] * local[1] + m.turn[body, 0, 2] * local[2]
    ry = m.turn[body, 1, 0] * local[0] + m.turn[body, 1, 1] * local[1] + m.turn[body, 1, 2] * local[2]
    rz = m.turn[body, 2, 0] * local[0] + m.turn[body, 2, 1] * local[1] + m.turn[body, 2, 2] * local[2]
    wx, wy, wz = m.spin[body, 0], m.spin[body, 1], m.spin[body, 2]
    ax, ay, az = m.spin_rate[body, 0], m.spin_rate[body, 1], m.spin_rate[body, 2]
    vx, vy, vz = wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx
    place[0], place[1], place[2] = (
        m.origin[body, 0] + rx, m.origin[body, 1] + ry, m.origin[body, 2] + rz
    )  # fmt: skip
    velocity[0] = m.velocity[body, 0] + vx
    velocity[1] = m.velocity[body, 1] + vy
    velocity[2] = m.velocity[body, 2] + vz
    acceleration[0] = m.acceleration[body, 0] + ay * rz - az * ry + wy * vz - wz * vy
    acceleration[1] = m.acceleration[body, 1] + az * rx - ax * rz + wz * vx - wx * vz
    acceleration[2] = m.acceleration[body, 2] + ax * ry - ay * rx + wx * vy - wy * vx
    for k in range(n):
        tx, ty, tz = m.turning[body, 0, k], m.turning[body, 1, k], m.turning[body, 2, k]
        moving[0, k] = m.moving[body, 0, k] + ty * rz - tz * ry
        moving[1, k] = m.moving[body, 1, k] + tz * rx - tx * rz
        moving[2, k] = m.moving[body, 2, k] + tx * ry - ty * rx


@compiled
def _move_links(mech, m, q, rates):
    """Forward pass over the tree."""
    n = len(q)
    axis, cross, base = np.empty(3), np.empty(3), np.empty(3)
    for r in range(3):
        m.acceleration[0, r] = -mech.gravity[r]
    for i in range(1, len(mech.parent)):
        p = mech.parent[i]
        point_motion(
            m, p, mech.position[i], m.origin[i], m.velocity[i], m.acceleration[i], m.moving[i]
        )
        for r in range(3):
            m.spin[i, r] = m.spin[p, r]
            m.spin_rate[i, r] = m.spin_rate[p, r]
            for k in range(n):
                m.turning[i, r, k] = m.turning[p, r, k]
        if mech.kind[i] == 0:
            m.turn[i] = m.turn[p]
            continue
        j = mech.coordinate[i]
        _turned(m.turn[p], mech.axis[i], axis)
        _cross(m.spin[p], axis, cross)
        if mech.kind[i] == 1:
            _rotate(m.turn[p], mech.axis[i], q[j], m.turn[i])
            for r in range(3):
                m.spin[i, r] += axis[r] * rates[j]
                m.spin_rate[i, r] += cross[r] * rates[j]
                m.turning[i, r, j] += axis[r]
            continue
        m.turn[i] = m.turn[p]
        for r in range(3):
            base[r] = axis[r] * q[j]
        _cross(m.spin[p], base, axis)  # velocity of the moved origin, turning with the parent
        for r in range(3):
            m.origin[i, r] += base[r]
            m.velocity[i, r] += axis[r]
        a, b = np.empty(3), np.empty(3)
        _cross(m.spin_rate[p], base, a)
        _cross(m.spin[p], axis, b)
        _turned(m.turn[p], mech.axis[i], axis)
        for r in range(3):
            m.acceleration[i, r] += a[r] + b[r] + 2.0 * cross[r] * rates[j]
            m.velocity[i, r] += axis[r] * rates[j]
        for k in range(n):
            tx, ty, tz = m.turning[p, 0, k], m.turning[p, 1, k], m.turning[p, 2, k]
            m.moving[i, 0, k] += ty * base[2] - tz * base[1]
            m.moving[i, 1, k] += tz * base[0] - tx * base[2]
            m.moving[i, 2, k] += tx * base[1] - ty * base[0]
        for r in range(3):
            m.moving[i, r, j] += axis[r]


@compiled
def _move_bars(mech, m):
    """Tube and rod of every cylinder, from its two pins."""
    n = m.mass.shape[0]
    first = len(mech.parent)
    d, e, u, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    normal, cross, accel, turn_row = np.empty(3), np.empty(3), np.empty(3), np.empty(n)
    for k in range(len(mech.bar_links)):
        tube, rod = first + 2 * k, first + 2 * k + 1
        base, load = mech.bar_links[k, 0], mech.bar_links[k, 1]
        for body, link, side in ((tube, base, 0), (rod, load, 1)):
            point_motion(
                m, link, mech.bar_pins[k, side], m.origin[body], m.velocity[body],
                m.acceleration[body], m.moving[body],
            )  # fmt: skip
        c = 0.0
        for r in range(3):
            d[r] = m.origin[rod, r] - m.origin[tube, r]
            c += d[r] * d[r]
            normal[r] = -m.turn[base, r, 1]
        c = np.sqrt(c)
        spin = m.spin[base]
        _cross(spin, d, cross)
        rate, speed2 = 0.0, 0.0
        for r in range(3):
            e[r] = d[r] / c
            v = m.velocity[rod, r] - m.velocity[tube, r]
            speed2 += v * v
            rate += e[r] * v
            u[r] = v - cross[r]
        _cross(normal, e, w)  # n . (e x u) = u . (n x e)
        phi = (w[0] * u[0] + w[1] * u[1] + w[2] * u[2]) / c
        m.length[k], m.length_rate[k] = c, rate
        along = 0.0
        for r in range(3):
            accel[r] = m.acceleration[rod, r] - m.acceleration[tube, r]
            along += e[r] * accel[r]
        m.length_bias[k] = along + (speed2 - rate * rate) / c
        # relative acceleration in the base link's frame
        turned = np.empty(3)
        _cross(m.spin_rate[base], d, turned)
        for r in range(3):
            accel[r] -= turned[r]
        _cross(spin, u, turned)
        for r in range(3):
            accel[r] -= 2.0 * turned[r]
        _cross(spin, cross, turned)
        for r in range(3):
            accel[r] -= turned[r]
        phi_rate = (w[0] * accel[0] + w[1] * accel[1] + w[2] * accel[2] - 2.0 * rate * phi) / c
        _cross(spin, normal, cross)
        for j in range(n):
            row, turn = 0.0, 0.0
            tx, ty, tz = m.turning[base, 0, j], m.turning[base, 1, j], m.turning[base, 2, j]
            c0, c1, c2 = ty * d[2] - tz * d[1], tz * d[0] - tx * d[2], tx * d[1] - ty * d[0]
            for r in range(3):
                v = m.moving[rod, r, j] - m.moving[tube, r, j]
                row += e[r] * v
                turn += w[r] * v
            m.length_row[k, j] = row
            turn_row[j] = (turn - w[0] * c0 - w[1] * c1 - w[2] * c2) / c
        for body in (tube, rod):
            for r in range(3):
                m.spin[body, r] = spin[r] + normal[r] * phi
                m.spin_rate[body, r] = (
                    m.spin_rate[base, r] + normal[r] * phi_rate + cross[r] * phi
                )
                m.turn[body, r, 0], m.turn[body, r, 1] = e[r], -normal[r]
                m.turn[body, r, 2] = w[r]
                for j in range(n):
                    m.turning[body, r, j] = m.turning[base, r, j] + normal[r] * turn_row[j]


@compiled
def move_bodies(mech, m, q, rates):
    """Motion of all bodies at tree positions and rates.

    Args:
        mech: Mechanism.
        m: Motion, written up to `length_bias`.
        q: (N,) tree positions [rad] or [m].
        rates: (N,) tree rates [rad/s] or [m/s].

    Returns:
        Nothing.

    Source: differential kinematics of a tree; bar between two pins: Khoshzaban 1992, chapter 2.
    """
    _move_links(mech, m, q, rates)
    _move_bars(mech, m)


@compiled
def gather_forces(mech, m):
    """Mass matrix and bias forces of the tree with its bars (Kane's projection).

    `M = sum m J_v' J_v + J_w' I J_w`, `h = sum J_v' m a + J_w' (I alpha + w x I w)`.

    Args:
        mech: Mechanism.
        m: Motion after `move_bodies`; `mass` and `bias` are written.

    Returns:
        Nothing.

    Source: Kane and Levinson 1985, Dynamics.
    """
    n = m.mass.shape[0]
    for i in range(n):
        m.bias[i] = 0.0
        for j in range(n):
            m.mass[i, j] = 0.0
    place, velocity, force = np.empty(3), np.empty(3), np.empty(3)
    moving, local, torque = np.empty((3, n)), np.empty((3, n)), np.empty(3)
    for body in range(1, len(mech.mass)):
        mass = mech.mass[body]
        point_motion(m, body, mech.com[body], place, velocity, force, moving)
        turn = m.turn[body]
        s0 = turn[0, 0] * m.spin[body, 0] + turn[1, 0] * m.spin[body, 1] + turn[2, 0] * m.spin[body, 2]
        s1 = turn[0, 1] * m.spin[body, 0] + turn[1, 1] * m.spin[body, 1] + turn[2, 1] * m.spin[body, 2]
        s2 = turn[0, 2] * m.spin[body, 0] + turn[1, 2] * m.spin[body, 1] + turn[2, 2] * m.spin[body, 2]
        i0, i1, i2 = mech.inertia[body, 0], mech.inertia[body, 1], mech.inertia[body, 2]
        for r in range(3):
            a = 0.0
            for k in range(3):
                a += turn[k, r] * m.spin_rate[body, k]
            torque[r] = mech.inertia[body, r] * a
            for j in range(n):
                local[r, j] = (
                    turn[0, r] * m.turning[body, 0, j]
                    + turn[1, r] * m.turning[body, 1, j]
                    + turn[2, r] * m.turning[body, 2, j]
                )
        torque[0] += s1 * i2 * s2 - s2 * i1 * s1
        torque[1] += s2 * i0 * s0 - s0 * i2 * s2
        torque[2] += s0 * i1 * s1 - s1 * i0 * s0
        for i in range(n):
            x, y, z = mass * moving[0, i], mass * moving[1, i], mass * moving[2, i]
            a, b, c = i0 * local[0, i], i1 * local[1, i], i2 * local[2, i]
            m.bias[i] += (
                x * force[0] + y * force[1] + z * force[2]
                + local[0, i] * torque[0] + local[1, i] * torque[1] + local[2, i] * torque[2]
            )  # fmt: skip
            for j in range(i + 1):
                m.mass[i, j] += (
                    x * moving[0, j] + y * moving[1, j] + z * moving[2, j]
                    + a * local[0, j] + b * local[1, j] + c * local[2, j]
                )  # fmt: skip
    for i in range(n):
        for j in range(i):
            m.mass[j, i] = m.mass[i, j]

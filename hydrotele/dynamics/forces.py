"""Mass matrix and bias forces of a mechanism: the projection method."""

from hydrotele.core.compiled import lean
from hydrotele.dynamics.mechanism import COM, INERTIA, MASS, REACH
from hydrotele.dynamics.motion import (
    ACCELERATION,
    BIAS,
    FORCE,
    SPIN,
    SPIN_RATE,
    cross,
    turned,
)


@lean
def gather_forces(mech, m):
    """Mass matrix and bias forces of the tree with its bars (Kane's projection).

    `M = sum J' P` and `h = sum J' F` with the momenta P and the wrenches F of all bodies.

    Args:
        mech: Mechanism.
        m: Motion after `close_chains`; `momentum`, `mass`, the columns FORCE of `frame` and the
            row BIAS of `joint` are written.

    Returns:
        Nothing.

    Source: Kane and Levinson 1985, Dynamics.
    """
    bodies, n = 1 + mech.links + 2 * mech.bars, m.mass.shape[0]
    frame, jacobian, momentum = m.frame, m.jacobian, m.momentum
    for b in range(1, bodies):
        _load_body(mech.shape, frame, jacobian, b, mech.tree[b, REACH], momentum)
    for i in range(n):
        bias = 0.0
        for b in range(1, bodies):
            if mech.tree[b, REACH] > i:
                for r in range(6):
                    bias += jacobian[b, i, r] * frame[b, FORCE + r]
        m.joint[BIAS, i] = bias
        for j in range(i + 1):
            mass = 0.0
            for b in range(1, bodies):
                if mech.tree[b, REACH] > i:
                    for r in range(6):
                        mass += jacobian[b, j, r] * momentum[b, i, r]
            m.mass[i, j] = mass
            m.mass[j, i] = mass


@lean
def _load_body(shape, frame, jacobian, b, reach, momentum):
    """Momentum per unit rate, and force and torque of inertia and gravity, about the origin."""
    mass = shape[b, MASS]
    rx, ry, rz = turned(frame, b, shape[b, COM], shape[b, COM + 1], shape[b, COM + 2])
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

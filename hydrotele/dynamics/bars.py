"""Motion of the cylinders: a bar between two pins, tube and rod turning together."""

import math

from hydrotele.core.compiled import lean
from hydrotele.dynamics.mechanism import AXIS, PARENT, REACH
from hydrotele.dynamics.motion import (
    ACCELERATION,
    LENGTH,
    LENGTH_BIAS,
    LENGTH_RATE,
    LENGTH_ROW,
    ORIGIN,
    SPIN,
    SPIN_RATE,
    VELOCITY,
    cross,
    move_origin,
    place_origin,
)


@lean
def place_bars(tree, shape, first, frame, jacobian, bar):
    """Places and Jacobians of all bars: x along the bar, y along the pins.

    Args:
        tree: see `Mechanism`.
        shape: see `Mechanism`.
        first: index of the first tube.
        frame: see `Motion`; written.
        jacobian: see `Motion`; written.
        bar: see `Motion`; LENGTH and LENGTH_ROW written.

    Returns:
        Nothing.

    Source: Khoshzaban 1992, chapter 2.
    """
    for b in range(len(bar)):
        tube, rod = first + 2 * b, first + 2 * b + 1
        base = tree[tube, PARENT]
        place_origin(tree, shape, frame, jacobian, tube)
        place_origin(tree, shape, frame, jacobian, rod)
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
        for k in range(tree[tube, REACH]):
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


@lean
def move_bars(tree, first, frame, bar):
    """Rates and accelerations of all placed bars.

    Args:
        tree: see `Mechanism`.
        first: index of the first tube.
        frame: see `Motion`; written.
        bar: see `Motion`; LENGTH_RATE and LENGTH_BIAS written.

    Returns:
        Nothing.

    Source: Khoshzaban 1992, chapter 2.
    """
    for b in range(len(bar)):
        tube, rod = first + 2 * b, first + 2 * b + 1
        base, c = tree[tube, PARENT], bar[b, LENGTH]
        move_origin(tree, frame, tube)
        move_origin(tree, frame, rod)
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
        # velocity and acceleration as the base link sees them, across the bar
        cx, cy, cz = cross(wx, wy, wz, dx, dy, dz)
        sx, sy, sz = vx - cx, vy - cy, vz - cz
        turn = (ux * sx + uy * sy + uz * sz) / c
        tx, ty, tz = cross(
            frame[base, SPIN_RATE], frame[base, SPIN_RATE + 1], frame[base, SPIN_RATE + 2],
            dx, dy, dz,
        )  # fmt: skip
        # Coriolis and centripetal part in one: w x (2 s + w x d)
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

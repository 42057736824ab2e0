"""Closed chains in reduced coordinates: positions, rates and accelerations that closures determine.

Cylinders are bars between two pins, tube and rod turning together. Few unknowns are solved by a
Cholesky factorisation of its own, quicker than a library call at this size.
"""

import math

from hydrotele.core.compiled import allocation_free
from hydrotele.multibody.reduced_mechanism import (
    ACCELERATION,
    AXIS,
    DRIFT,
    HOME,
    LENGTH,
    LENGTH_BIAS,
    LENGTH_RATE,
    LENGTH_ROW,
    ORIGIN,
    PARENT,
    RATE,
    REACH,
    SPIN,
    SPIN_RATE,
    VELOCITY,
    Q,
    cross,
    move_origin,
    place_links,
    place_origin,
)


@allocation_free
def factorise(matrix):
    """Replace a symmetric positive definite matrix by its lower Cholesky factor.

    Args:
        matrix: (>= n, n), overwritten in its lower triangle; further rows are left alone.

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


@allocation_free
def solve(factor, right):
    """Solve with a Cholesky factor, in place.

    Args:
        factor: (>= n, n) result of `factorise`.
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


@allocation_free
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


@allocation_free
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


_NEWTON_STEPS = 20
_CLOSED = 1.0e-12  # m: rounding of a 10 m machine
_STEP = 0.2  # largest move of a free coordinate between two searches [rad] or [m]
_FAR = 20.0  # the same in one call: nobody asks for more
_TURN = 0.3  # largest move of a bound coordinate in a step of a search [rad] or [m]


@allocation_free
def close_chains(mech, m, z):
    """Go to independent positions with all chains closed, and find the rates that follow.

    Goes there from the last place in steps small enough to stay on the linkages' branch; from
    home, if that place is not finite.

    Args:
        mech: Mechanism.
        m: Motion; links are placed, bound positions and rates, `basis`, `loop` and `normal`
            written.
        z: (>= n,) independent positions [rad] or [m].

    Returns:
        Largest opening of a closure [m].

    Source: Newton's method on the loop equations; J_b r_b = -J_f r_f for the rates.
    """
    joint, free, bound = m.joint, mech.free, mech.bound
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
    for part in range(1 + int(min(far, _FAR) / _STEP), 0, -1):
        for f in range(n):
            move = (z[f] - joint[Q, free[f]]) / part
            joint[Q, free[f]] += move
            for b in range(nb):
                joint[Q, bound[b]] += m.basis[bound[b], f] * move
        for _ in range(_NEWTON_STEPS):
            place_links(mech.tree, mech.shape, mech.links, joint, m.frame, m.jacobian)
            first = len(mech.tree) - 2 * len(m.loop) // 3
            worst = _open_pins(mech.tree, mech.shape, first, m.frame, m.jacobian, m.loop)
            _factorise_loops(bound, m.loop, m.normal)
            if worst < _CLOSED:
                break
            _solve_loops(bound, m.loop, joint.shape[1], m.normal)
            for b in range(nb):
                joint[Q, bound[b]] += min(_TURN, max(-_TURN, m.normal[nb, b]))
        for f in range(n):
            _solve_loops(bound, m.loop, free[f], m.normal)
            for b in range(nb):
                m.basis[bound[b], f] = m.normal[nb, b]
    for b in range(nb):
        joint[RATE, bound[b]] = 0.0
        for f in range(n):
            joint[RATE, bound[b]] += m.basis[bound[b], f] * joint[RATE, free[f]]
    return worst


@allocation_free
def drift_chains(mech, m):
    """Bound accelerations at zero independent ones, of links that have been moved.

    Args:
        mech: Mechanism.
        m: Motion after `close_chains` and `move_links`; DRIFT of the bound coordinates is written.

    Returns:
        Nothing.

    Source: second derivative of the loop equations.
    """
    n, first = m.joint.shape[1], len(mech.tree) - 2 * len(m.loop) // 3
    for row in range(len(m.loop)):
        i = first + 2 * (row // 3)
        if row % 3 == 0:
            move_origin(mech.tree, m.frame, i)
            move_origin(mech.tree, m.frame, i + 1)
        at = ACCELERATION + row % 3
        m.loop[row, n + 1] = m.frame[i, at] - m.frame[i + 1, at]
    _solve_loops(mech.bound, m.loop, n + 1, m.normal)
    for b in range(len(mech.bound)):
        m.joint[DRIFT, mech.bound[b]] = m.normal[len(mech.bound), b]


@allocation_free
def _open_pins(tree, shape, first, frame, jacobian, loop):
    """Place the pins of all closures; their openings with Jacobian, and the largest opening."""
    n, worst = loop.shape[1] - 2, 0.0
    for row in range(len(loop)):
        i, r = first + 2 * (row // 3), row % 3
        if r == 0:
            place_origin(tree, shape, frame, jacobian, i)
            place_origin(tree, shape, frame, jacobian, i + 1)
        loop[row, n] = frame[i, ORIGIN + r] - frame[i + 1, ORIGIN + r]
        worst = max(worst, abs(loop[row, n]))
        for k in range(n):
            loop[row, k] = jacobian[i, k, r] - jacobian[i + 1, k, r]
    return worst


@allocation_free
def _factorise_loops(bound, loop, normal):
    """Factor of `A' A` of the bound columns, made positive by a trace of its size."""
    nb, trace = len(bound), 0.0
    for a in range(nb):
        for b in range(a + 1):
            normal[a, b] = 0.0
            for r in range(len(loop)):
                normal[a, b] += loop[r, bound[a]] * loop[r, bound[b]]
        trace += normal[a, a]
    for a in range(nb):
        normal[a, a] += 1.0e-14 * trace
    factorise(normal)


@allocation_free
def _solve_loops(bound, loop, column, normal):
    """Bound part of the answer to a column of the loops, into the last row of `normal`."""
    nb = len(bound)
    for a in range(nb):
        normal[nb, a] = 0.0
        for r in range(len(loop)):
            normal[nb, a] -= loop[r, bound[a]] * loop[r, column]
    solve(normal, normal[nb])

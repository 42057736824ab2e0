"""Closed chains of links: positions, rates and accelerations of the coordinates they determine."""

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dynamics.linear import factorise, solve
from hydrotele.dynamics.motion import move_bodies, point_motion

_NEWTON_STEPS = 20
_CLOSED = 1.0e-12  # m: rounding of a 10 m machine


@compiled
def _openings(mech, m, opening, acceleration, moving):
    """Openings of all closures, their bias accelerations and Jacobian rows, stacked."""
    n = moving.shape[1]
    place, velocity, accel = np.empty((2, 3)), np.empty(3), np.empty((2, 3))
    rows = np.empty((2, 3, n))
    for k in range(len(mech.closure_links)):
        for side in range(2):
            point_motion(
                m, mech.closure_links[k, side], mech.closure_points[k, side], place[side],
                velocity, accel[side], rows[side],
            )  # fmt: skip
        for r in range(3):
            opening[3 * k + r] = place[0, r] - place[1, r]
            acceleration[3 * k + r] = accel[0, r] - accel[1, r]
            for j in range(n):
                moving[3 * k + r, j] = rows[0, r, j] - rows[1, r, j]


@compiled
def _normal_equations(moving, bound, matrix):
    """`A' A` of the bound columns, made positive by a trace of its size."""
    nb, trace = len(bound), 0.0
    for a in range(nb):
        for b in range(nb):
            total = 0.0
            for r in range(moving.shape[0]):
                total += moving[r, bound[a]] * moving[r, bound[b]]
            matrix[a, b] = total
        trace += matrix[a, a]
    for a in range(nb):
        matrix[a, a] += 1.0e-14 * trace


@compiled
def _column_product(matrix, column, vector):
    total = 0.0
    for r in range(len(vector)):
        total += matrix[r, column] * vector[r]
    return total


@compiled
def close_chains(mech, m, q, rates):
    """Complete tree positions and rates from the independent ones, and move all bodies.

    Args:
        mech: Mechanism.
        m: Motion; on return all bodies are moved, `basis` and `drift` written, `bound` updated.
        q: (N,) tree positions; the free ones given, the bound ones written [rad] or [m].
        rates: (N,) tree rates; the free ones given, the bound ones written.

    Returns:
        Largest opening of a closure [m].

    Source: Newton's method on the loop equations; J_b r_b = -J_f r_f for the rates.
    """
    nb = len(mech.bound)
    if nb == 0:
        move_bodies(mech, m, q, rates)
        return 0.0
    rows, n = 3 * len(mech.closure_links), len(q)
    opening, acceleration = np.empty(rows), np.empty(rows)
    moving, matrix, right = np.empty((rows, n)), np.empty((nb, nb)), np.empty(nb)
    for a in range(nb):
        q[mech.bound[a]] = m.bound[a]
        rates[mech.bound[a]] = 0.0
    worst = 0.0
    for _ in range(_NEWTON_STEPS):
        move_bodies(mech, m, q, rates)
        _openings(mech, m, opening, acceleration, moving)
        worst = np.max(np.abs(opening))
        _normal_equations(moving, mech.bound, matrix)
        factorise(matrix)
        if worst < _CLOSED:
            break
        for a in range(nb):
            right[a] = -_column_product(moving, mech.bound[a], opening)
        solve(matrix, right)
        for a in range(nb):
            q[mech.bound[a]] += min(0.3, max(-0.3, right[a]))
    for a in range(nb):
        m.bound[a] = q[mech.bound[a]]
    for f in range(len(mech.free)):
        for a in range(nb):
            right[a] = 0.0
            for r in range(rows):
                right[a] -= moving[r, mech.bound[a]] * moving[r, mech.free[f]]
        solve(matrix, right)
        for a in range(nb):
            m.basis[mech.bound[a], f] = right[a]
            rates[mech.bound[a]] += right[a] * rates[mech.free[f]]
    move_bodies(mech, m, q, rates)
    _openings(mech, m, opening, acceleration, moving)
    for a in range(nb):
        right[a] = -_column_product(moving, mech.bound[a], acceleration)
    solve(matrix, right)
    for a in range(nb):
        m.drift[mech.bound[a]] = right[a]
    return worst

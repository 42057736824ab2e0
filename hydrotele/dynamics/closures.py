"""Closed chains of links: positions, rates and accelerations of the coordinates they determine."""

import math

from hydrotele.core.compiled import lean
from hydrotele.dynamics.linear import factorise, solve
from hydrotele.dynamics.mechanism import HOME
from hydrotele.dynamics.motion import (
    ACCELERATION,
    DRIFT,
    ORIGIN,
    RATE,
    Q,
    move_origin,
    place_links,
    place_origin,
)

_NEWTON_STEPS = 20
_CLOSED = 1.0e-12  # m: rounding of a 10 m machine
_STEP = 0.2  # largest move of a free coordinate between two searches [rad] or [m]
_FAR = 20.0  # the same in one call: nobody asks for more
_TURN = 0.3  # largest move of a bound coordinate in a step of a search [rad] or [m]


@lean
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


@lean
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


@lean
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


@lean
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


@lean
def _solve_loops(bound, loop, column, normal):
    """Bound part of the answer to a column of the loops, into the last row of `normal`."""
    nb = len(bound)
    for a in range(nb):
        normal[nb, a] = 0.0
        for r in range(len(loop)):
            normal[nb, a] -= loop[r, bound[a]] * loop[r, column]
    solve(normal, normal[nb])

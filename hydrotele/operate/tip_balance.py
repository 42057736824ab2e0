"""Forces on an arm from outside: what its motion needs, less what its drives give."""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.compiled import lean
from hydrotele.dynamics.forces import gather_forces
from hydrotele.dynamics.integrate import place
from hydrotele.dynamics.mechanism import DAMPING, Mechanism
from hydrotele.dynamics.model import GEAR_INERTIA
from hydrotele.dynamics.motion import BIAS, DRIFT, ORIGIN, RATE, Motion, cross, turned
from hydrotele.hydraulics.circuit import SLOTS, actuator_friction

_SINGULAR = 1.0e-6  # pivot against the largest entry; the last force is kept below it
_AXIS = 1.0e-3  # m: closer to the swing axis the tip has no azimuth
# Gauss's rule of three points for a normal distribution: its outer nodes and their weights
_NODE, _OUTER = math.sqrt(3.0), 1.0 / 6.0


class Body(NamedTuple):
    """What a balance needs of `dynamics.model.Model`, whose attributes these are.

    Every array that Python hands over costs a tenth of a microsecond.
    """

    mech: Mechanism
    user: np.ndarray
    gear: np.ndarray
    transmission: np.ndarray


class Work(NamedTuple):
    """What a balance needs of `dynamics.model.Space`, whose attributes these are."""

    motion: Motion
    drive: np.ndarray
    row: np.ndarray


class Arm(NamedTuple):
    """An arm in its machine: m joints, n independent coordinates, h valves.

    Attributes:
        model: the machine.
        space: its work space.
        z: state of the model that is asked for; its first n and its rates are used.
        joint: (m,) independent coordinate of every joint, swing first.
        bends: (m,) 1 where a joint changes the attitude of the tool, else 0.
        tip: (3,) tip in its link's frame [m].
        links: (2,) frames of the tip's link and of the swing.
        gravity: (p,) parameters of the static model [N m].
        acceleration: (n,) of the independent coordinates.
        push: (h,) forces of the drives from their pressures [N] or [N m].
        rate_noise: (n,) standard deviations of the independent rates.
        outside: (n,) forces on the independent coordinates from outside [N m] or [N].
        table: (m, m) transposed Jacobian of the tip, destroyed.
    """

    model: Body
    space: Work
    z: np.ndarray
    joint: np.ndarray
    bends: np.ndarray
    tip: np.ndarray
    links: np.ndarray
    gravity: np.ndarray
    acceleration: np.ndarray
    push: np.ndarray
    rate_noise: np.ndarray
    outside: np.ndarray
    table: np.ndarray


@lean
def dynamic_balance(arm):
    """Forces from outside by the complete model: inertia, gravity, friction, closed chains.

    `tau = B' (M (B q'' + d) + h + D q') - sum r_i (F_i - E f_i(v_i))`

    Args:
        arm: Arm; z, acceleration and push are read, outside is written.

    Returns:
        Nothing.

    Source: Zhu 1994, 6.2, with the projection of `dynamics.integrate`.
    """
    model, sp, m, out = arm.model, arm.space, arm.space.motion, arm.outside
    n, nt = len(out), m.joint.shape[1]
    place(model, sp, arm.z)
    gather_forces(model.mech, m)
    for f in range(n):
        out[f] = 0.0
    for j in range(nt):
        need = m.joint[BIAS, j] + model.mech.joint[DAMPING, j] * m.joint[RATE, j]
        for k in range(nt):
            way = m.joint[DRIFT, k]
            for f in range(n):
                way += m.basis[k, f] * arm.acceleration[f]
            need += m.mass[j, k] * way
        for f in range(n):
            out[f] += m.basis[j, f] * need
    _subtract_drives(arm, True)


@lean
def static_balance(arm):
    """Forces from outside by the static model of gravity alone.

    `tau = Y(q) P - sum r_i F_i`

    Args:
        arm: Arm; z (whose rates must be 0), gravity and push are read, outside is written.

    Returns:
        Nothing.

    Source: Zhu 1994, 6.6.
    """
    place(arm.model, arm.space, arm.z)
    for f in range(len(arm.outside)):
        arm.outside[f] = 0.0
    for i in range(len(arm.joint)):
        arm.outside[arm.joint[i]] = static_torque(arm.z, arm.joint, arm.gravity, i)
    _subtract_drives(arm, False)


@lean
def static_torque(q, joint, gravity, i):
    """Torque that gravity asks of a joint of the arm.

    Every bending link has two parameters, of the cosine and of the sine of its attitude, which act
    on all joints before it; the seventh turns with the head of a feller-buncher.

    Args:
        q: (>= n,) positions of the independent coordinates [rad].
        joint: (m,) independent coordinate of every joint, swing first.
        gravity: (2 (m - 1),) parameters of 3 or 4 joints, (7,) of 5: C2, S2, C23, S23, C234,
            S234 and C5 [N m].
        i: index of the joint.

    Returns:
        Torque, scalar [N m].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    if i == 0:
        return 0.0
    bending, angle, total = min(4, len(joint)), 0.0, 0.0
    for k in range(1, bending):
        angle += q[joint[k]]
        if k >= i:
            total += gravity[2 * k - 2] * math.cos(angle) + gravity[2 * k - 1] * math.sin(angle)
    if len(joint) < 5:
        return total
    head = q[joint[4]]
    if i == 4:
        return -gravity[6] * math.sin(head) * math.sin(angle)
    return total + gravity[6] * math.cos(head) * math.cos(angle)


@lean
def _subtract_drives(arm, rubbing):
    """Take what the drives give off the forces outside, friction as expected from noisy rates."""
    model, sp, out = arm.model, arm.space, arm.outside
    n = len(out)
    for i in range(len(arm.push)):
        give, inertia = arm.push[i], 0.0
        if rubbing:
            v, noise, first = 0.0, 0.0, n + len(model.transmission)
            for f in range(n):
                v += sp.row[i, f] * arm.z[first + f]
                noise += (sp.row[i, f] * arm.rate_noise[f]) ** 2
                inertia += sp.row[i, f] * arm.acceleration[f]
            away, u = _NODE * math.sqrt(noise), i * SLOTS
            give -= (1.0 - 2.0 * _OUTER) * actuator_friction(model.user, u, v)
            give -= _OUTER * actuator_friction(model.user, u, v - away)
            give -= _OUTER * actuator_friction(model.user, u, v + away)
            gear = model.gear[i]
            if gear >= 0:
                give -= model.transmission[gear, GEAR_INERTIA] * inertia
        for f in range(n):
            out[f] -= sp.row[i, f] * give


@lean
def tip_force(arm, out):
    """Force at the tip that gives the forces outside.

    Args:
        arm: Arm after a balance; `table` is destroyed.
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m]; left alone
            where the Jacobian is singular.

    Returns:
        Whether it was written.

    Source: Zhu 1994, 6.6: `F = J^-T tau`.
    """
    if not _transposed_jacobian(arm):
        return False
    table, m = arm.table, len(out)
    most = 0.0
    for i in range(m):
        arm.acceleration[i] = arm.outside[arm.joint[i]]  # not needed any more: the right-hand side
        for j in range(m):
            most = max(most, abs(table[i, j]))
    right = arm.acceleration
    for i in range(m):
        best = i
        for r in range(i + 1, m):
            if abs(table[r, i]) > abs(table[best, i]):
                best = r
        if not abs(table[best, i]) > _SINGULAR * most:
            return False
        for j in range(m):
            table[i, j], table[best, j] = table[best, j], table[i, j]
        right[i], right[best] = right[best], right[i]
        for r in range(i + 1, m):
            part = table[r, i] / table[i, i]
            right[r] -= part * right[i]
            for j in range(i, m):
                table[r, j] -= part * table[i, j]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            right[i] -= table[i, j] * right[j]
        right[i] /= table[i, i]
    for i in range(m):
        out[i] = right[i]
    return True


@lean
def _transposed_jacobian(arm):
    """Derivatives of (r, theta, z, attitude, head) by the arm's joints; False on the swing axis."""
    m, frame, link, table = arm.space.motion, arm.space.motion.frame, arm.links[0], arm.table
    x, y, z = turned(frame, link, arm.tip[0], arm.tip[1], arm.tip[2])
    px = frame[link, ORIGIN] + x - frame[arm.links[1], ORIGIN]
    py = frame[link, ORIGIN + 1] + y - frame[arm.links[1], ORIGIN + 1]
    r = math.sqrt(px * px + py * py)
    if r < _AXIS:
        return False
    nt = m.joint.shape[1]
    for i in range(len(arm.joint)):
        vx, vy, vz = 0.0, 0.0, 0.0
        for k in range(nt):
            part = m.basis[k, arm.joint[i]]
            if part == 0.0:
                continue
            jac = m.jacobian[link, k]
            cx, cy, cz = cross(jac[3], jac[4], jac[5], x, y, z)
            vx += part * (jac[0] + cx)
            vy += part * (jac[1] + cy)
            vz += part * (jac[2] + cz)
        table[i, 0] = (px * vx + py * vy) / r
        table[i, 1] = (px * vy - py * vx) / (r * r)
        table[i, 2] = vz
        if len(arm.joint) > 3:
            table[i, 3] = arm.bends[i]
        if len(arm.joint) > 4:
            table[i, 4] = 1.0 if i == 4 else 0.0
    return True

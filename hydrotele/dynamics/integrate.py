"""The reduced model in time: kick, drift, kick, with the circuit of the MuJoCo plant between."""

import math

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dynamics.closures import close_chains
from hydrotele.dynamics.linear import factorise, solve
from hydrotele.dynamics.motion import gather_forces
from hydrotele.hydraulics.circuit import (
    SLOTS,
    Slot,
    actuator_friction,
    actuator_friction_slope,
    open_ports,
    step_circuit,
    supply_pressure,
)

_D, _RELIEF, _PUMP = int(Slot.ORIFICE_SMOOTHING), int(Slot.RELIEF_PRESSURE), int(Slot.PUMP_FLOW)
_AH, _AR, _OFFSET = int(Slot.AREA_HEAD), int(Slot.AREA_ROD), int(Slot.OFFSET)


@compiled
def place(model, sp, z):
    """Put the mechanism at a state: bodies, drive positions and their Jacobian rows.

    Args:
        model: Model.
        sp: Space; `motion`, `q`, `rates`, `x`, `row` are written. `x` of a drive with a
            transmission is its own position, not the load's.
        z: (nz,) state.

    Returns:
        Nothing.

    Source: kinematics of the closed chains.
    """
    mech = model.mech
    n, t = len(mech.free), len(model.transmission)
    for f in range(n):
        sp.q[mech.free[f]] = z[f]
        sp.rates[mech.free[f]] = z[n + t + f]
    close_chains(mech, sp.motion, sp.q, sp.rates)
    for i in range(len(model.gear)):
        bar = mech.drive_bar[i]
        if bar >= 0:
            sp.x[i] = sp.motion.length[bar] - mech.bar_closed[bar]
            for f in range(n):
                total = 0.0
                for k in range(len(sp.q)):
                    total += sp.motion.length_row[bar, k] * sp.motion.basis[k, f]
                sp.row[i, f] = total
        else:
            joint = mech.drive_joint[i]
            sp.x[i] = sp.q[joint]
            for f in range(n):
                sp.row[i, f] = sp.motion.basis[joint, f]
        if model.gear[i] >= 0:
            sp.x[i] = z[n + model.gear[i]]


@compiled
def load_position(model, sp, i):
    """Position of a drive's load side, scalar [m] or [rad], at the state of the last `place`.

    Source: kinematics of the closed chains.
    """
    bar = model.mech.drive_bar[i]
    if bar >= 0:
        return sp.motion.length[bar] - model.mech.bar_closed[bar]
    return sp.q[model.mech.drive_joint[i]]


@compiled
def accelerate(model, sp, z, dt):
    """Linearly implicit acceleration over a kick; leaves the mechanism where `place` put it.

    `a = (M + dt/2 D)^-1 (sum J' F - h)` with the slope D of friction and dampers, which is of
    second order and stable however steep the friction is.

    Args:
        model: Model.
        sp: Space after `place`; `force` receives the (n + t,) acceleration.
        z: (nz,) state, whose rates and pressures act.
        dt: length of the kick, scalar [s]; 0 gives the acceleration itself.

    Returns:
        Nothing.

    Source: linearly implicit midpoint rule.
    """
    mech, m, user = model.mech, sp.motion, model.user
    n, t, nt = len(mech.free), len(model.transmission), len(sp.q)
    gather_forces(mech, m)
    half = 0.5 * dt
    for f in range(n + t):
        sp.force[f] = 0.0
        for g in range(n + t):
            sp.mass[f, g] = 0.0
    for j in range(nt):
        m.mass[j, j] += half * mech.damping[j]
        m.bias[j] += mech.damping[j] * sp.rates[j]
    if nt == n:
        for f in range(n):
            sp.force[f] = -m.bias[f]
            for g in range(f + 1):
                sp.mass[f, g] = m.mass[f, g]
    else:
        for j in range(nt):
            bias = m.bias[j]
            for k in range(nt):
                bias += m.mass[j, k] * m.drift[k]
            for f in range(n):
                sp.force[f] -= m.basis[j, f] * bias
                for k in range(nt):
                    for g in range(f + 1):
                        sp.mass[f, g] += m.basis[j, f] * m.mass[j, k] * m.basis[k, g]
    rates = z[n + t : 2 * (n + t)]
    for i in range(len(model.gear)):
        u, gear = i * SLOTS, model.gear[i]
        if i < model.hydraulic:
            a = 2 * (n + t) + 4 * i
            push = user[u + _AH] * z[a + 2] - user[u + _AR] * z[a + 3]
        else:
            push = model.gain[i] * sp.command[i] - user[u + _OFFSET]
        v = 0.0
        for f in range(n):
            v += sp.row[i, f] * rates[f]
        if gear >= 0:
            inertia, stiffness, damping, backlash = model.transmission[gear]
            own = rates[n + gear]
            twist = z[n + gear] - load_position(model, sp, i)
            free = 0.5 * backlash
            spring = stiffness * (twist - min(free, max(-free, twist))) + damping * (own - v)
            slope = half * damping
            sp.mass[n + gear, n + gear] += inertia + slope + half * actuator_friction_slope(
                user, u, own
            )
            sp.force[n + gear] += push - actuator_friction(user, u, own) - spring
            for f in range(n):
                sp.force[f] += sp.row[i, f] * spring
                sp.mass[n + gear, f] -= slope * sp.row[i, f]
                for g in range(f + 1):
                    sp.mass[f, g] += slope * sp.row[i, f] * sp.row[i, g]
            continue
        push -= actuator_friction(user, u, v)
        slope = half * actuator_friction_slope(user, u, v)
        for f in range(n):
            sp.force[f] += sp.row[i, f] * push
            for g in range(f + 1):
                sp.mass[f, g] += slope * sp.row[i, f] * sp.row[i, g]
    factorise(sp.mass)
    solve(sp.mass, sp.force)


@compiled
def arriving(command, row, begin, end, period, delay):
    """Mean of a held and delayed command over part of a row.

    Args:
        command: (n,) commands, each held for a period [1].
        row: index of the row.
        begin: start of the part within the row, scalar [s].
        end: end of the part, scalar [s].
        period: scalar [s].
        delay: scalar [s].

    Returns:
        Mean command, scalar [1]; before the first row the first command is held.

    Source: pure transport delay of a zero-order hold.

    >>> import numpy as np
    >>> arriving(np.array([0.0, 1.0]), 1, 0.0, 0.5, 1.0, 0.25)
    0.5
    """
    if delay == 0.0:
        return command[row]
    place = row + (begin - delay) / period
    stop = row + (end - delay) / period
    total, here = 0.0, place
    while here < stop - 1e-9:
        k = math.floor(here + 1e-9)
        there = min(stop, k + 1.0)
        total += command[min(len(command) - 1, max(0, k))] * (there - here)
        here = there
    return total / (stop - place)


@compiled
def advance(model, sp, z, command, row, period, steps, trail, keep):
    """Advance a state over one row of a log.

    Positions and pressures stand at the whole steps, rates half-way between them; at both ends of
    the row all are brought to equal times.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state, advanced in place.
        command: (n, nu) commands, held from row to row.
        row: index of the row to cross.
        period: length of a row, scalar [s].
        steps: steps per row.
        trail: (>= steps (row + 1) + 1, c) values of the channels with a lag at every step.
        keep: whether to write `trail`.

    Returns:
        Nothing.

    Source: velocity Verlet; circuit: `hydraulics.circuit.step_circuit`.
    """
    n, t = len(model.mech.free), len(model.transmission)
    total, nu, count = n + t, len(model.gear), model.hydraulic
    h = period / steps
    act = z[2 * total :]
    for i in range(nu):
        sp.command[i] = arriving(command[:, i], row, 0.0, h, period, model.delay[i])
    place(model, sp, z)
    accelerate(model, sp, z, 0.5 * h)
    for f in range(total):
        z[total + f] += 0.5 * h * sp.force[f]
    for step in range(steps):
        for i in range(nu):
            sp.v[i] = sp.x[i]
            if step:
                sp.command[i] = arriving(
                    command[:, i], row, step * h, (step + 1) * h, period, model.delay[i]
                )
        for f in range(total):
            z[f] += h * z[total + f]
        place(model, sp, z)
        for i in range(nu):
            sp.v[i] = (sp.x[i] - sp.v[i]) / h
        if count:
            step_circuit(
                model.user, 0, count, act, sp.command, sp.x, sp.v, h, sp.act_dot, sp.scratch
            )
            for k in range(4 * count):
                act[k] += h * sp.act_dot[k]
        kick = h if step < steps - 1 else 0.5 * h
        accelerate(model, sp, z, kick)
        for f in range(total):
            z[total + f] += kick * sp.force[f]
        if keep:
            _write_trail(model, sp, z, trail[row * steps + step + 1])


@compiled
def _write_trail(model, sp, z, out):
    first = 2 * (len(model.mech.free) + len(model.transmission))
    for c in range(len(model.kind)):
        if model.lag[c] > 0.0:
            out[c] = _plain(model, sp, z, c, first)


@compiled
def _plain(model, sp, z, c, first):
    """What an ideal sensor of a channel other than the supply shows, after `place`."""
    kind, i = model.kind[c], model.drive[c]
    if kind == 0:
        return sp.q[model.mech.drive_joint[i]]
    if kind == 1:
        return sp.x[i]
    return z[first + 4 * i + kind]


@compiled
def supply_of(model, sp, z):
    """Supply pressure in a state, scalar [Pa].

    Source: nominal model, "Supply".
    """
    first = 2 * (len(model.mech.free) + len(model.transmission))
    act = z[first:]
    open_ports(model.user, act, act, sp.scratch, 0, model.hydraulic, 0.0, act)
    user = model.user
    return supply_pressure(sp.scratch, model.hydraulic, user[_D], user[_RELIEF], user[_PUMP])


@compiled
def read_channels(model, sp, z, row, steps, h, trail, out):
    """What the sensors show in a state, without noise.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state.
        row: index of the row, for channels with a lag.
        steps: steps per row.
        h: step, scalar [s].
        trail: (rows, c) as in `advance`.
        out: (c,) written [channel's unit].

    Returns:
        Nothing.

    Source: nominal model, "Sensors".
    """
    place(model, sp, z)
    first = 2 * (len(model.mech.free) + len(model.transmission))
    for c in range(len(model.kind)):
        if model.kind[c] == 4:
            value = supply_of(model, sp, z)
        elif model.lag[c] > 0.0 and row >= 0:
            back = max(0.0, row * steps - model.lag[c] / h)
            low = int(math.floor(back))
            part = back - low
            value = trail[low, c]
            if part > 0.0:
                value += part * (trail[low + 1, c] - value)
        else:
            value = _plain(model, sp, z, c, first)
        out[c] = model.scale[c] * value + model.offset[c]


@compiled
def simulate_rows(model, sp, z, command, period, steps, out, states):
    """Free run from a state over all rows of a log.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state at the first row, advanced in place to the last.
        command: (n, nu) commands.
        period: scalar [s].
        steps: steps per row.
        out: (n, c) written: what the sensors show [channel's unit].
        states: (n, nz) written.

    Returns:
        Nothing.

    Source: `advance`.
    """
    rows = len(command)
    trail = np.zeros((rows * steps + 1, len(model.kind)))
    place(model, sp, z)
    _write_trail(model, sp, z, trail[0])
    for row in range(rows):
        read_channels(model, sp, z, row, steps, period / steps, trail, out[row])
        states[row] = z
        if row < rows - 1:
            advance(model, sp, z, command, row, period, steps, trail, True)

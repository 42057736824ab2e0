"""Residuals of the model's laws on given signals, compiled; nothing here knows of logs."""

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.reduced_dynamics import load_position, place
from hydrotele.estimate.reduced_model import X
from hydrotele.hydraulics.circuit import (
    SLOTS,
    Slot,
    actuator_friction,
    actuator_stop,
    axis_opening,
    chamber_flows,
    circuit_supply,
    delivered_share,
    demanded_share,
    open_ports,
    pump_response,
)
from hydrotele.hydraulics.laws import air_compliance, port_flow, softening
from hydrotele.hydraulics.supply import drawn_flow, highest_supply
from hydrotele.multibody.reduced_mechanism import (
    BAR,
    BIAS,
    DAMPING,
    DRIFT,
    LENGTH_BIAS,
    LENGTH_ROW,
    RATE,
    gather_forces,
)

_AH, _AR, _LEAK = int(Slot.AREA_HEAD), int(Slot.AREA_ROD), int(Slot.LEAKAGE)
_PORT, _KR = int(Slot.PORT_RELIEF), int(Slot.RELIEF_GAIN)
_TANK, _KM = int(Slot.TANK_PRESSURE), int(Slot.MAKEUP_GAIN)
_BETA, _HOSE = int(Slot.BULK_MODULUS), int(Slot.HOSE_COMPLIANCE)
_AIR, _ONSET = int(Slot.AIR_RELEASE), int(Slot.AIR_ONSET)
_BUBBLES = int(Slot.ENTRAINED_AIR)
_LAG, _DELIVERY = int(Slot.PUMP_TIME_CONSTANT), int(Slot.DELIVERY)
_MEMORY, _PUMP = int(Slot.MEMORY), int(Slot.PUMP_FLOW)


@compiled
def load_forces(model, space, motion):
    """Force of every drive that a motion needs, its own friction included, less its end stops'.

    `J' F = N' (M (N q'' + c) + h + D q')`, where N maps independent to tree rates, c is what the
    closures add, D the dampers of the joints and J the drives' Jacobian; a transmission counts as
    rigid.

    Args:
        model: Model of the reduced dynamics with as many drives as independent coordinates.
        space: its Space.
        motion: (n, 3, f) positions, rates and accelerations of the independent coordinates.

    Returns:
        (n, nu) forces [N] or torques [N m].

    Source: virtual work on the closed chains.
    """
    mech, m = model.mech, space.motion
    rows, free, drives = len(motion), len(mech.free), len(model.gear)
    total = free + len(model.transmission)
    z, load = np.zeros(2 * total + 4 * model.hydraulic), np.zeros(free)
    forces = np.empty((rows, drives))
    for k in range(rows):
        z[:free] = motion[k, 0]
        z[total : total + free] = motion[k, 1]
        place(model, space, z)
        gather_forces(mech, m)
        acceleration = m.joint[DRIFT] + m.basis @ motion[k, 2]
        tree = m.mass @ acceleration + m.joint[BIAS] + mech.joint[DAMPING] * m.joint[RATE]
        load[:] = m.basis.T @ tree
        forces[k] = np.linalg.solve(space.row.T.copy(), load)
        for i in range(drives):
            velocity, change = 0.0, 0.0
            for f in range(free):
                velocity += space.row[i, f] * motion[k, 1, f]
                change += space.row[i, f] * motion[k, 2, f]
            bar = mech.drive[i, BAR]
            if bar >= 0:
                change += m.bar[bar, LENGTH_BIAS] + np.sum(m.bar[bar, LENGTH_ROW:] * m.joint[DRIFT])
            forces[k, i] += actuator_friction(model.user, i * SLOTS, velocity)
            at = space.drive[X, i] if model.gear[i] < 0 else load_position(model, space, i)
            forces[k, i] -= actuator_stop(model.user, i * SLOTS, at, velocity)[0]
            if model.gear[i] >= 0:
                forces[k, i] += model.transmission[model.gear[i], 0] * change
    return forces


@compiled
def chamber_residuals(user, spool, supply, head, rod, volumes, velocity):
    """What a chamber's oil does not account for: `V p'/beta + A v + leak - valve - port`.

    Args:
        user: (SLOTS,) numbers of the axis' actuator.
        spool: (n,) spool positions [1].
        supply: (n,) supply pressure [Pa].
        head: (2, n) head-side pressure [Pa] and its rate [Pa/s].
        rod: (2, n) the same of the rod side.
        volumes: (2, n) volumes of head and rod chamber [m^3].
        velocity: (n,) piston velocity [m/s] or [rad/s].

    Returns:
        (2, n) residual flows of head and rod chamber [m^3/s]; positive: oil is missing. Those of a
        chamber drawn below atmosphere count as little as its pressure tells of them
        (`laws.softening`).

    Source: nominal model, "Chambers".
    """
    out = np.empty((2, len(spool)))
    tank, hose, beta = user[_TANK], user[_HOSE], user[_BETA]
    for k in range(len(spool)):
        p_head, p_rod = head[0, k], rod[0, k]
        opening = axis_opening(user, 0, spool[k])
        q_head, q_rod, _, _ = chamber_flows(user, 0, opening, supply[k], p_head, p_rod)
        r_head, _ = port_flow(p_head, user[_PORT], user[_KR], tank, user[_KM])
        r_rod, _ = port_flow(p_rod, user[_PORT], user[_KR], tank, user[_KM])
        leak = user[_LEAK] * (p_head - p_rod)
        soft = 1.0 / beta + air_compliance(p_head, user[_BUBBLES])
        stored_head = (volumes[0, k] * soft + hose) * head[1, k]
        soft = 1.0 / beta + air_compliance(p_rod, user[_BUBBLES])
        stored_rod = (volumes[1, k] * soft + hose) * rod[1, k]
        soft_head = softening(p_head, user[_AIR], user[_ONSET])
        soft_rod = softening(p_rod, user[_AIR], user[_ONSET])
        out[0, k] = stored_head + soft_head * (user[_AH] * velocity[k] + leak - q_head - r_head)
        out[1, k] = stored_rod - soft_rod * (user[_AR] * velocity[k] + leak + q_rod + r_rod)
    return out


@compiled
def _settle(user, spools, pressures, period, act, ports):
    """Write a row's activations and ports; a slow pump has followed over a period, 0 at first."""
    count, at = len(spools), int(user[_DELIVERY])
    for i in range(count):
        act[4 * i] = spools[i]
        act[4 * i + 2], act[4 * i + 3] = pressures[i]
    open_ports(user, act, act, ports, 0, count, 0.0, act)
    if user[_LAG] > 0.0:
        wanted = demanded_share(user, 0, count, ports)
        act[at] = pump_response(user, 0, wanted, act[at], period) if period > 0.0 else wanted


@compiled
def supply_pressures(user, spools, pressures, period):
    """Supply pressure from spools and chamber pressures.

    Args:
        user: (h * SLOTS,) numbers of the h valves.
        spools: (h, n) [1].
        pressures: (h, 2, n) head and rod pressures [Pa].
        period: between rows, scalar [s]. A pump with a time constant begins settled and follows
            from row to row.

    Returns:
        (n,) [Pa].

    Source: nominal model, "Supply".
    """
    count, rows = spools.shape
    ports, out = np.zeros(4 * count), np.empty(rows)
    act = np.zeros(4 * count + int(user[_MEMORY]))
    for k in range(rows):
        _settle(user, spools[:, k], pressures[:, :, k], period if k else 0.0, act, ports)
        out[k] = circuit_supply(user, 0, count, ports, delivered_share(user, 0, act))
    return out


@compiled
def pump_lacks(user, spools, pressures, supply, period):
    """Flow that a pump which is short gives beyond what it should.

    Args:
        user: (h * SLOTS,) numbers of the h valves.
        spools: (h, n) [1].
        pressures: (h, 2, n) head and rod pressures [Pa].
        supply: (n,) supply pressure [Pa].
        period: as of `supply_pressures`.

    Returns:
        (2, n): what the valves draw at that pressure less the pump's flow [m^3/s], and by how much
        the pressure is below that of a pump that is not short [Pa].

    Source: nominal model, "Supply".
    """
    count, rows = spools.shape
    ports, out = np.zeros(4 * count), np.empty((2, rows))
    act = np.zeros(4 * count + int(user[_MEMORY]))
    for k in range(rows):
        _settle(user, spools[:, k], pressures[:, :, k], period if k else 0.0, act, ports)
        given = user[_PUMP] * delivered_share(user, 0, act)
        out[0, k] = drawn_flow(user, 0, count, ports, supply[k]) - given
        out[1, k] = highest_supply(user, 0, count, ports) - supply[k]
    return out

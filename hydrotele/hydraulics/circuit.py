"""The hydraulic circuit: several valves, chambers and one shared supply, advanced by one step.

Pure functions on flat arrays laid out as MuJoCo keeps them, so that the native callbacks, the
tests and an estimator run the same code. Axis `i` reads its numbers at `user[i * SLOTS + Slot]` and
its activations `spool, spool_rate, p_head, p_rod` at `act[4 i ...]`, counted from the first
hydraulic axis.
"""

import enum
import math

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.hydraulics.laws import (
    friction,
    friction_slope,
    orifice,
    port_flow,
    spool_step,
    valve_opening,
)
from hydrotele.terms.law import DriveState
from hydrotele.terms.table import added_flows


class Slot(enum.IntEnum):
    """Places of an actuator's numbers in `actuator_user`, all SI."""

    MARKER = 0
    KIND = 1
    FIRST = 2
    COUNT = 3
    AREA_HEAD = 4
    AREA_ROD = 5
    VOLUME_HEAD = 6
    VOLUME_ROD = 7
    STROKE = 8
    LEAKAGE = 9
    BANDWIDTH = 10
    DAMPING = 11
    DEADBAND = 12
    FLOW_GAIN = 13
    ORIFICE_SMOOTHING = 14
    PORT_RELIEF = 15
    RELIEF_GAIN = 16
    MAKEUP_GAIN = 17
    BULK_MODULUS = 18
    TANK_PRESSURE = 19
    RELIEF_PRESSURE = 20
    PUMP_FLOW = 21
    COULOMB = 22
    STRIBECK = 23
    STRIBECK_VELOCITY = 24
    VISCOUS = 25
    COULOMB_VELOCITY = 26
    OFFSET = 27
    COULOMB_ASYMMETRY = 28
    VISCOUS_ASYMMETRY = 29
    HOSE_COMPLIANCE = 30
    DRIVE_INERTIA = 31


SLOTS = 32
ACTIVATIONS = 4
MAX_AXES = 8
SCRATCH = 4 * MAX_AXES


class Kind(enum.IntEnum):
    """What an actuator is: a cylinder, a rotary motor or a plain force drive with friction."""

    CYLINDER = 1
    MOTOR = 2
    FORCE = 3


_ROS2 = 1.0 + 1.0 / math.sqrt(2.0)  # L-stable, of second order with any approximate Jacobian
_NEWTON_STEPS = 60
_NO_FLOWS = (0.0, 0.0, 0.0, 0.0)
_FLOW_TOLERANCE = 1.0e-12  # of the pump flow: far below the flow balance of 1e-6 that is promised

(
    _AH, _AR, _VH, _VR, _STROKE, _LEAK, _W, _Z, _DB, _K, _D, _PORT, _KR, _KM, _BETA, _TANK,
    _RELIEF, _PUMP, _FC, _FS, _VS, _B, _V0,
) = (int(slot) for slot in list(Slot)[4:27])  # fmt: skip
_AC, _AV, _HOSE = (int(slot) for slot in list(Slot)[28:31])


@compiled
def supply_pressure(ports, count, smoothing, relief, pump_flow):
    """Largest pressure up to the relief setting at which the valves draw no more than the pump.

    Solves `sum_i k_i g(p_s - p_i) = Q_pump` over the valves whose load check is open, by Newton's
    method in `sqrt(p_s - min p_i)` inside a bracket, which is halved where Newton fails.

    Args:
        ports: (>= 4 count,) per axis `k_i` [m^3/(s sqrt(Pa))], `p_i` [Pa] and two unused places.
        count: number of axes.
        smoothing: orifice smoothing d, scalar [Pa].
        relief: relief setting, scalar [Pa].
        pump_flow: Q_pump, scalar [m^3/s].

    Returns:
        p_s, scalar [Pa].

    Source: nominal model, "Supply".

    >>> import numpy as np
    >>> one_valve = np.array([2.0e-6, 5.0e6, 0.0, 0.0])
    >>> round(supply_pressure(one_valve, 1, 5.0e4, 28.0e6, 5.0e-3) / 1e6, 3)
    11.25
    """
    low, high, p, last = relief, relief, relief, math.inf
    for i in range(count):
        if ports[4 * i] > 0.0:
            low = min(low, ports[4 * i + 1])
    floor = low
    for _ in range(_NEWTON_STEPS):
        demand, slope = 0.0, 0.0
        for i in range(count):
            drop = p - ports[4 * i + 1]
            if drop > 0.0 and ports[4 * i] > 0.0:
                flow, gain = orifice(drop, ports[4 * i], smoothing)
                demand += flow
                slope += gain
        excess = demand - pump_flow
        if excess > 0.0:
            high = p
        elif p == relief:
            return relief
        else:
            low = p
        if abs(excess) <= _FLOW_TOLERANCE * pump_flow or high - low <= 1.0e-15 * relief:
            return p
        root = math.sqrt(p - floor) if p > floor else 0.0
        guess = -1.0
        if slope > 0.0 and root > 0.0 and abs(excess) < 0.5 * last:  # else Newton may cycle
            root -= excess / (2.0 * slope * root)
            if root > 0.0:
                guess = floor + root * root
        last = abs(excess)
        p = guess if low < guess < high else 0.5 * (low + high)
    return p


@compiled
def open_ports(user, act, spool, ports, first, count, ahead, rate):
    """Flow gain and supply-side pressure of every axis, for `supply_pressure`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        act: (4 count,) activations; pressures [Pa].
        spool: (4 count,) array whose every fourth entry is the spool position to use [1].
        ports: (>= 4 count,) written: `k_i` [m^3/(s sqrt(Pa))], `p_i` [Pa].
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ahead: time to look ahead with `rate`, scalar [s].
        rate: (4 count,) array with pressure rates at places 2 and 3 of every axis [Pa/s].

    Returns:
        Nothing; `ports` is filled.

    Source: nominal model, "Orifice".
    """
    for i in range(count):
        u = (first + i) * SLOTS
        opening = valve_opening(spool[4 * i], user[u + _DB])
        ports[4 * i] = user[u + _K] * abs(opening)
        side = 2 if opening > 0.0 else 3
        ports[4 * i + 1] = act[4 * i + side]
        if ahead != 0.0:
            ports[4 * i + 1] += ahead * rate[4 * i + side]


@compiled
def chamber_flows(user, u, opening, p_supply, p_head, p_rod):
    """Valve flows into both chambers of an axis and their slopes.

    With o > 0 the head side is fed through its load check and the rod side drains to tank; with
    o < 0 the other way round.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        opening: o, scalar [1].
        p_supply: scalar [Pa].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]).

    Source: nominal model, "Orifice".
    """
    if opening == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gain, smoothing = user[u + _K] * abs(opening), user[u + _D]
    tank = user[u + _TANK]
    q_in, slope_in = 0.0, 0.0
    if opening > 0.0:
        if p_supply > p_head:
            q_in, slope_in = orifice(p_supply - p_head, gain, smoothing)
        q_out, slope_out = orifice(p_rod - tank, gain, smoothing)
        return q_in, -q_out, -slope_in, -slope_out
    if p_supply > p_rod:
        q_in, slope_in = orifice(p_supply - p_rod, gain, smoothing)
    q_out, slope_out = orifice(p_head - tank, gain, smoothing)
    return -q_out, q_in, -slope_out, -slope_in


@compiled
def pressure_rates(user, u, opening, p_supply, p_head, p_rod, x, v, ahead, added):
    """Pressure rates of both chambers and their slopes with respect to their own pressure.

    `p_A' = (beta / V_A)(q_A - A_h v - q_l + r_A)`, `p_B' = (beta / V_B)(q_B + A_r v + q_l + r_B)`,
    where a hose of compliance C_h counts as `beta C_h` of volume.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        opening: o, scalar [1].
        p_supply: scalar [Pa].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        x: piston displacement, scalar [m] (0 for a motor, whose volumes are constant).
        v: piston velocity, scalar [m/s] or [rad/s].
        ahead: time over which the slopes must hold, scalar [s]: a relief or make-up valve that
            would open within it counts as open in the slope (not in the rate).
        added: flows of the machine's terms into both chambers [m^3/s] and their slopes with
            respect to these chambers' pressures [m^3/(s Pa)], see `terms.table.added_flows`.

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]).

    Source: nominal model, "Chambers".
    """
    q_head, q_rod, slope_head, slope_rod = chamber_flows(user, u, opening, p_supply, p_head, p_rod)
    leak = user[u + _LEAK] * (p_head - p_rod)
    port, relief_gain = user[u + _PORT], user[u + _KR]
    tank, makeup_gain = user[u + _TANK], user[u + _KM]
    r_head, k_head = port_flow(p_head, port, relief_gain, tank, makeup_gain)
    r_rod, k_rod = port_flow(p_rod, port, relief_gain, tank, makeup_gain)
    beta = user[u + _BETA]
    swept_head, swept_rod = user[u + _AH], user[u + _AR]
    volume_head, volume_rod = user[u + _VH], user[u + _VR]
    if user[u + 1] == 1.0:  # Kind.CYLINDER
        volume_head += swept_head * x
        volume_rod += swept_rod * (user[u + _STROKE] - x)
    hose = beta * user[u + _HOSE]
    head, rod = beta / (volume_head + hose), beta / (volume_rod + hose)
    rate_head = head * (q_head - swept_head * v - leak + r_head + added[0])
    rate_rod = rod * (q_rod + swept_rod * v + leak + r_rod + added[1])
    if k_head == 0.0:
        _, k_head = port_flow(p_head + ahead * rate_head, port, relief_gain, tank, makeup_gain)
    if k_rod == 0.0:
        _, k_rod = port_flow(p_rod + ahead * rate_rod, port, relief_gain, tank, makeup_gain)
    return (
        rate_head,
        rate_rod,
        head * (slope_head + k_head - user[u + _LEAK] + added[2]),
        rod * (slope_rod + k_rod - user[u + _LEAK] + added[3]),
    )


@compiled
def _flows_of_terms(terms, i, user, time, x, v, spool, rate, p_head, p_rod, supply, command):
    """What the terms add to the flows of an axis, see `terms.table.added_flows`."""
    u = i * SLOTS
    force = user[u + _AH] * p_head - user[u + _AR] * p_rod
    s = DriveState(time, x, v, spool, rate, p_head, p_rod, supply, command, force)
    return added_flows(terms, i, s)


@compiled
def step_circuit(
    user, first, count, act, command, length, velocity, dt, act_dot, scratch, terms=None, time=0.0
):
    """Advance spools and chamber pressures of all axes that share a supply by one step.

    Spools follow their exact exponential; pressures take one step of the L-stable second-order
    Rosenbrock method ROS2 with a diagonal Jacobian, with piston velocities held over the step. The
    supply pressure is solved in both stages.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators, <= MAX_AXES.
        act: (4 count,) spool [1], spool rate [1/s] and pressures [Pa] at the start of the step.
        command: (nu,) valve commands, clipped here to [-1, 1] [1].
        length: (nu,) piston displacements x at the end of the step, where MuJoCo's leapfrog has
            them [m] (joint angle for a motor).
        velocity: (nu,) piston velocities [m/s] or [rad/s].
        dt: step, scalar [s].
        act_dot: (4 count,) written: mean rates over the step, in the unit of `act` per [s].
        scratch: (SCRATCH,) work space.
        terms: (n,) table of the machine's terms, None for none.
        time: at the start of the step, scalar [s]; only terms see it.

    Returns:
        (supply pressure at the start of the step [Pa], at its end [Pa]).

    Source: nominal model; ROS2: Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), Eq. 2.6.
    """
    gamma_h = _ROS2 * dt
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        bounded = min(1.0, max(-1.0, command[first + i]))
        act_dot[a], act_dot[a + 1] = spool_step(
            act[a], act[a + 1], bounded, user[u + _W], user[u + _Z], dt
        )
    shared = first * SLOTS
    relief, pump, smoothing = user[shared + _RELIEF], user[shared + _PUMP], user[shared + _D]
    open_ports(user, act, act, scratch, first, count, 0.0, act_dot)
    p_start = supply_pressure(scratch, count, smoothing, relief, pump)
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        x, v = length[first + i] - dt * velocity[first + i], velocity[first + i]
        more = _NO_FLOWS
        if terms is not None:
            if len(terms) > 0:
                more = _flows_of_terms(
                    terms, first + i, user, time, x, v, act[a], act[a + 1], act[a + 2], act[a + 3],
                    p_start, command[first + i],
                )  # fmt: skip
        head, rod, j_head, j_rod = pressure_rates(
            user, u, valve_opening(act[a], user[u + _DB]), p_start, act[a + 2], act[a + 3],
            x, v, dt, more,
        )  # fmt: skip
        scratch[a + 2] = 1.0 / (1.0 - gamma_h * j_head)
        scratch[a + 3] = 1.0 / (1.0 - gamma_h * j_rod)
        act_dot[a + 2] = head * scratch[a + 2]
        act_dot[a + 3] = rod * scratch[a + 3]
    open_ports(user, act, act_dot, scratch, first, count, dt, act_dot)
    p_end = supply_pressure(scratch, count, smoothing, relief, pump)
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        k_head, k_rod = act_dot[a + 2], act_dot[a + 3]
        x, v = length[first + i], velocity[first + i]
        p_head, p_rod = act[a + 2] + dt * k_head, act[a + 3] + dt * k_rod
        more = _NO_FLOWS
        if terms is not None:
            if len(terms) > 0:
                more = _flows_of_terms(
                    terms, first + i, user, time + dt, x, v, act_dot[a], act_dot[a + 1], p_head,
                    p_rod, p_end, command[first + i],
                )  # fmt: skip
        head, rod, _, _ = pressure_rates(
            user, u, valve_opening(act_dot[a], user[u + _DB]), p_end, p_head, p_rod, x, v, 0.0,
            more,
        )  # fmt: skip
        act_dot[a + 2] = 1.5 * k_head + 0.5 * scratch[a + 2] * (head - 2.0 * k_head)
        act_dot[a + 3] = 1.5 * k_rod + 0.5 * scratch[a + 3] * (rod - 2.0 * k_rod)
        act_dot[a] = (act_dot[a] - act[a]) / dt
        act_dot[a + 1] = (act_dot[a + 1] - act[a + 1]) / dt
    return p_start, p_end


@compiled
def actuator_friction(user, u, velocity):
    """Friction of one actuator at a velocity.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        Friction force, scalar [N] or [N m], with the sign of the velocity.

    Source: nominal model, "Piston force".
    """
    return friction(
        velocity,
        user[u + _FC],
        user[u + _FS],
        user[u + _VS],
        user[u + _B],
        user[u + _V0],
        user[u + _AC],
        user[u + _AV],
    )


@compiled
def actuator_friction_slope(user, u, velocity):
    """Slope of `actuator_friction` with respect to the velocity.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        dF_f/dv, scalar [N s/m] or [N m s/rad].

    Source: derivative of the nominal model's "Piston force".
    """
    return friction_slope(
        velocity, user[u + _FC], user[u + _FS], user[u + _VS], user[u + _B], user[u + _V0],
        user[u + _AC], user[u + _AV],
    )  # fmt: skip


@compiled
def axis_state(user, i, supply, act, x, v):
    """Flows and force of one axis in a state, for logs and balances.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        i: index of the actuator.
        supply: supply pressure, scalar [Pa].
        act: (4,) spool [1], spool rate [1/s], p_head, p_rod [Pa].
        x: piston displacement, scalar [m].
        v: piston velocity, scalar [m/s] or [rad/s].

    Returns:
        (q_head, q_rod [m^3/s], force or torque after friction [N] or [N m]).

    Source: nominal model, "Orifice" and "Piston force".
    """
    u = i * SLOTS
    opening = valve_opening(act[0], user[u + _DB])
    q_head, q_rod, _, _ = chamber_flows(user, u, opening, supply, act[2], act[3])
    force = user[u + _AH] * act[2] - user[u + _AR] * act[3] - actuator_friction(user, u, v)
    return q_head, q_rod, force


def circuit_scratch() -> np.ndarray:
    """Work space for `step_circuit`, shape (SCRATCH,)."""
    return np.zeros(SCRATCH)

"""Shared hydraulic supply: pressure from the flows of the valves, and pump with a time constant.

Flat arrays have the layout described in `circuit`; `ports` has four values per axis, see
`compute_inlet_conditions`.
"""

import math

from hydrotele.core.compiled import compile_inlined, compile_without_allocation
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, ActuatorKind, Slot
from hydrotele.hydraulics.valve import axis_valve_opening, inlet_flow, inlet_gain

_MAX_NEWTON_STEPS = 60
_FLOW_TOLERANCE = 1.0e-12  # of the pump flow: far below the documented flow balance of 1e-6
_MIN_FLOW_FRACTION = 1.0e-6  # smallest fraction of the maximum pump flow; it makes the pressure unique
TERM_FLOW_TIME_CONSTANT = 0.02  # s, time constant with which the pump flow follows terms: it cannot jump

_D, _TANK = int(Slot.ORIFICE_SMOOTHING), int(Slot.TANK_PRESSURE)
_RELIEF, _PUMP = int(Slot.RELIEF_PRESSURE), int(Slot.PUMP_FLOW)
_MARGIN, _DROOP = int(Slot.LOAD_SENSING_MARGIN), int(Slot.PUMP_DROOP)
_DROP = int(Slot.COMPENSATED_DROP)
_LAG, _DELIVERY = int(Slot.PUMP_TIME_CONSTANT), int(Slot.DELIVERY)
_ADDED, _OVERRIDE = int(Slot.ADDED_DELIVERY), int(Slot.RELIEF_OVERRIDE)
_KIND, _PUMPED = int(Slot.KIND), float(ActuatorKind.PUMP_DRIVE)


@compile_without_allocation
def solve_supply_pressure(ports, count, smoothing, relief, pump_flow, droop=0.0, override=0.0):
    """Solve for the supply pressure at which the pump flow equals the flows of valves and relief.

    Solves `sum_i k_i g(min(p_s - p_i, d_i)) = Q_pump - c_p p_s` with the smoothed root g over the valves
    whose load check is open, by Newton's method in `sqrt(p_s - min p_i)` with bisection as a fallback. A relief valve
    with an override r opens at its setting p_r and passes the flow `(p_s - p_r) / r`. Without
    override the pressure is limited to the setting.

    Args:
        ports: (>= 4 count,) per axis `k_i` [m^3/(s sqrt(Pa))], `p_i` [Pa], the pressure drop `d_i`
            set by its compensator [Pa] (0 without one), and an unused value.
        count: number of axes.
        smoothing: orifice smoothing d, scalar [Pa].
        relief: relief setting, scalar [Pa].
        pump_flow: Q_pump, scalar [m^3/s].
        droop: c_p, decrease of the pump flow with pressure, scalar [m^3/(s Pa)].
        override: r, increase of the relief pressure with its flow, scalar [Pa s/m^3].

    Returns:
        p_s, scalar [Pa].

    Source: models/cat215/README.md, "Supply"; droop: leakage proportional to the pressure (Merritt 1967);
        override: static characteristic of a direct-acting relief valve, linear in its flow.

    >>> import numpy as np
    >>> one_valve = np.array([2.0e-6, 5.0e6, 0.0, 0.0])
    >>> round(solve_supply_pressure(one_valve, 1, 5.0e4, 28.0e6, 5.0e-3) / 1e6, 3)
    11.25
    """
    top = relief + override * pump_flow
    low, high, p, last = relief, top, top, math.inf
    for i in range(count):
        if ports[4 * i] > 0.0:
            low = min(low, ports[4 * i + 1])
    floor = low
    for _ in range(_MAX_NEWTON_STEPS):
        demand, slope = 0.0, 0.0
        for i in range(count):
            drop = p - ports[4 * i + 1]
            if drop > 0.0 and ports[4 * i] > 0.0:
                flow, gain = inlet_flow(drop, ports[4 * i], smoothing, ports[4 * i + 2])
                demand += flow
                slope += gain
        excess = demand - pump_flow
        if droop > 0.0:
            excess += droop * p
            slope += droop
        if p > relief:
            excess += (p - relief) / override
            slope += 1.0 / override
        if excess > 0.0:
            high = p
        elif p == top:
            return top
        else:
            low = p
        if abs(excess) <= _FLOW_TOLERANCE * pump_flow or high - low <= 1.0e-15 * relief:
            return p
        root = math.sqrt(p - floor) if p > floor else 0.0
        guess = -1.0
        if slope > 0.0 and root > 0.0 and abs(excess) < 0.5 * last:  # otherwise Newton may cycle
            root -= excess / (2.0 * slope * root)
            if root > 0.0:
                guess = floor + root * root
        last = abs(excess)
        p = guess if low < guess < high else 0.5 * (low + high)
    return p


@compile_inlined
def compute_inlet_conditions(user, act, spool, ports, first, count, ahead, rate):
    """Write valve opening, inlet gain and fed chamber pressure of every axis to `ports`.

    The functions of this module compute the supply pressure from `ports`.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        act: (4 count,) activations; of each axis only the pressures at indices 2 and 3 are read
            [Pa].
        spool: (4 count,) array with the spool position of every axis at index 0 of its four [1].
        ports: (>= 4 count,) written, four values per axis: inlet gain [m^3/(s sqrt(Pa))], fed
            chamber pressure [Pa], pressure drop set by the compensator [Pa], opening [1]. The last
            is the pump speed [rad/s] for an axis with its own pump.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ahead: time by which the pressures are extrapolated with `rate`, scalar [s].
        rate: (4 count,) array with pressure rates at indices 2 and 3 of every axis [Pa/s].

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Orifice".
    """
    for i in range(count):
        u = (first + i) * SLOT_COUNT
        if user[u + _KIND] == _PUMPED:  # does not use the shared supply
            ports[4 * i], ports[4 * i + 3] = 0.0, spool[4 * i]
            continue
        opening = axis_valve_opening(user, u, spool[4 * i])
        ports[4 * i] = inlet_gain(user, u, opening)
        ports[4 * i + 2], ports[4 * i + 3] = user[u + _DROP], opening
        side = 2 if opening > 0.0 else 3
        ports[4 * i + 1] = act[4 * i + side]
        if ahead != 0.0:
            ports[4 * i + 1] += ahead * rate[4 * i + side]


@compile_without_allocation
def delivered_flow_fraction(user, first, act):
    """Return the fraction of its maximum flow that the pump delivers, including the flow that terms add.

    Terms are additional laws of a machine. The fraction is 1 for a pump without time constant and
    terms.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        act: (>= 4 count + EXTRA_STATES,) activations; DELIVERY is read if the pump has a time
            constant, ADDED_DELIVERY if terms add to the flow [1].

    Returns:
        Fraction, scalar [1].

    Source: `demanded_flow_fraction`.
    """
    s, added = first * SLOT_COUNT, 0.0
    if user[s + _ADDED] > 0.0:
        added = act[int(user[s + _ADDED])]
    return add_flow_fractions(pump_flow_fraction(user, first, act), added)


@compile_without_allocation
def pump_flow_fraction(user, first, act):
    """Return the fraction of its maximum flow that the pump delivers, without the flow that terms add.

    Terms are additional laws of a machine. The fraction is 1 for a pump without time constant.
    Otherwise it is a state of the simulation, limited to 1e-6 .. 1.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        act: (>= 4 count + EXTRA_STATES,) activations [1].

    Returns:
        Fraction, scalar [1].

    Source: `demanded_flow_fraction`.
    """
    s = first * SLOT_COUNT
    if user[s + _LAG] == 0.0:
        return 1.0
    return min(1.0, max(_MIN_FLOW_FRACTION, act[int(user[s + _DELIVERY])]))


@compile_without_allocation
def add_flow_fractions(fraction, added):
    """Return the sum of a pump's flow fraction and the fraction that terms (additional laws) add.

    The sum is at least 1e-6, so that the supply pressure is unique.

    Args:
        fraction: flow fraction without terms, scalar [1].
        added: flow fraction of the terms, scalar [1].

    Returns:
        Fraction of the maximum flow, scalar [1], > 0.

    Source: a pump's displacement, bounded from below.
    """
    return max(_MIN_FLOW_FRACTION, fraction + added)


@compile_without_allocation
def advance_pump_flow_fraction(user, first, demanded, fraction, dt):
    """Return the flow fraction of a pump with first-order lag after a duration (exact exponential).

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        demanded: fraction of the maximum flow that the valves demand, constant over the time,
            scalar [1].
        fraction: delivered fraction at the start, scalar [1].
        dt: duration, scalar [s].

    Returns:
        Fraction of the maximum flow, scalar [1]; 1 for a pump without time constant.

    Source: `demanded_flow_fraction`.
    """
    lag = user[first * SLOT_COUNT + _LAG]
    return demanded + (fraction - demanded) * math.exp(-dt / lag) if lag > 0.0 else 1.0


@compile_without_allocation
def demanded_flow_fraction(user, first, count, ports):
    """Return the fraction of the maximum pump flow that the valves demand.

    `q = (sum_i q_i + c_p p_s) / Q_pump` with valve flows q_i, pump leakage c_p and maximum flow
    Q_pump, at the pressure p_s that a pump without time constant would maintain. A pump with time
    constant T delivers at most the fraction r with `T dr/dt = q - r`. While r rises, the pressure
    drops until the valves draw no more than that. While r falls, the excess flow passes the relief
    or unloading valve.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.

    Returns:
        q, scalar [1], 0 .. 1.

    Source: models/cat215/README.md, "Supply"; first-order swash plate: Merritt 1967, sec. 8-6.
    """
    supply = circuit_supply_pressure(user, first, count, ports, 1.0)
    return min(1.0, drawn_flow(user, first, count, ports, supply) / user[first * SLOT_COUNT + _PUMP])


@compile_without_allocation
def drawn_flow(user, first, count, ports, supply):
    """Return the flow that all valves and the pump's internal leakage draw at a supply pressure.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.
        supply: p_s, scalar [Pa].

    Returns:
        `sum_i q_i + c_p p_s` with valve flows q_i and leakage coefficient c_p, scalar [m^3/s].

    Source: models/cat215/README.md, "Supply".
    """
    s = first * SLOT_COUNT
    drawn = user[s + _DROOP] * supply
    for i in range(count):
        drop = supply - ports[4 * i + 1]
        if drop > 0.0 and ports[4 * i] > 0.0:
            drawn += inlet_flow(drop, ports[4 * i], user[s + _D], ports[4 * i + 2])[0]
    return drawn


@compile_inlined
def max_supply_pressure(user, first, count, ports):
    """Return the upper limit of the supply pressure, without the override of the relief valve.

    It is the setting of the relief valve. For a load-sensing pump it is the smaller of this setting
    and the largest pressure of a fed chamber (or the tank pressure) plus the margin.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.

    Returns:
        Pressure, scalar [Pa].

    Source: `circuit_supply_pressure`.
    """
    s = first * SLOT_COUNT
    most = user[s + _RELIEF]
    if user[s + _MARGIN] > 0.0:
        load = user[s + _TANK]
        for i in range(count):
            if ports[4 * i] > 0.0:
                load = max(load, ports[4 * i + 1])
        most = min(most, load + user[s + _MARGIN])
    return most


@compile_inlined
def circuit_supply_pressure(user, first, count, ports, fraction):
    """Compute the supply pressure of a circuit from pump, valves, relief valve and load sensing.

    A load-sensing pump maintains `max p_i + margin` over the open valves (tank pressure counts as a
    load), within the limits of relief setting and flow.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.
        fraction: fraction of its maximum flow that the pump delivers, scalar [1], > 0.

    Returns:
        p_s, scalar [Pa].

    Source: models/cat215/README.md, "Supply".
    """
    s, most = first * SLOT_COUNT, max_supply_pressure(user, first, count, ports)
    flow = user[s + _PUMP] * fraction
    droop, override = user[s + _DROOP], user[s + _OVERRIDE]
    return solve_supply_pressure(ports, count, user[s + _D], most, flow, droop, override)


@compile_without_allocation
def compute_supply_pressure_derivatives(user, first, count, ports, supply, out):
    """Write the derivatives of the supply pressure by the pressures of the fed chambers to `out`.

    `dp_s/dp_i` is `g_i / (sum_j g_j + c_p)` if the pump flow limits the pressure. It is 1 for the
    largest load if load sensing maintains its margin, 0 at the relief setting, or
    `g_i / (sum_j g_j + c_p + 1/r)` above it if the relief valve has an override r. g_i is the
    derivative of an inlet's flow with respect to its pressure drop.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.
        supply: p_s of `circuit_supply_pressure`, scalar [Pa].
        out: (>= 4 count,) written at indices 2 and 3 of every axis: g_i [m^3/(s Pa)] and
            dp_s/dp_i [1].

    Returns:
        Whether any dp_s/dp_i is not 0, scalar [1]; otherwise `out` may be unchanged.

    Source: implicit function theorem on "Supply" of models/cat215/README.md.
    """
    s, total, leader = first * SLOT_COUNT, user[first * SLOT_COUNT + _DROOP], -1
    most, load = user[s + _RELIEF], user[s + _TANK]
    if supply > most and user[s + _OVERRIDE] > 0.0:
        total += 1.0 / user[s + _OVERRIDE]
    elif supply >= most and user[s + _MARGIN] == 0.0:
        return False
    for i in range(count):
        out[4 * i + 2], out[4 * i + 3] = 0.0, 0.0
        drop = supply - ports[4 * i + 1]
        if ports[4 * i] > 0.0:
            if ports[4 * i + 1] > load:
                load, leader = ports[4 * i + 1], i
            if drop > 0.0:
                out[4 * i + 2] = inlet_flow(drop, ports[4 * i], user[s + _D], ports[4 * i + 2])[1]
                total += out[4 * i + 2]
    if user[s + _MARGIN] > 0.0 and load + user[s + _MARGIN] < most:
        if supply >= load + user[s + _MARGIN]:
            if leader >= 0:
                out[4 * leader + 3] = 1.0
            return leader >= 0
    elif supply >= most and user[s + _OVERRIDE] == 0.0:
        return False
    if total <= 0.0:
        return False
    for i in range(count):
        out[4 * i + 3] = out[4 * i + 2] / total
    return True

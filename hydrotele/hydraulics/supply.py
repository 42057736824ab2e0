"""Hydraulic supply: pressures from the flows of valves, pumps with time constant, merging and engine limit.

Flat arrays have the layout described in `circuit`. A pump feeds the valves of a group of axes that
follow one another; functions of one pump take the first axis of the group and the number of axes.
`ports` has four values per axis, see `compute_inlet_conditions`; functions of all pumps use the
whole work space `scratch`, which begins with the ports of all axes. Its other parts have one value
per axis, of which those of a pump are at the first axis of its group.

Merging valves divide the displacement of a pump: a share of it delivers to the line of another
pump, at the pressure there. The flow, and the leakage of the pump, of line j are thus
`Q_j = sum_i w_ij Q_i`, `c_j = sum_i w_ij c_i` with the shares w_ij of pump i. Every line keeps its
relief valve. Of several merging valves of one pump each takes its share of what the ones before
leave. Two equal pumps of which one delivers completely to the line of the other equal one pump of
double size.

An engine limit reduces the flows of all pumps by one common factor, as the regulators of excavator
pumps do that act on the sum of both pump pressures (total horsepower control).

Source: Volvo EC210B operator's manual, two pumps and spools for conflux (merging); Caterpillar
SESV1638, pumps of the 350 and 375 with constant horsepower control.
"""

import math

from hydrotele.core.compiled import compile_inlined, compile_without_allocation
from hydrotele.hydraulics.actuator_layout import CURVE_KNOTS, SLOT_COUNT, ActuatorKind, Slot
from hydrotele.hydraulics.valve import axis_valve_opening, inlet_flow, inlet_gain

_MAX_NEWTON_STEPS = 60
_FLOW_TOLERANCE = 1.0e-12  # of the pump flow: far below the documented flow balance of 1e-6
_MIN_FLOW_FRACTION = 1.0e-6  # smallest fraction of the maximum pump flow; it makes the pressure unique
TERM_FLOW_TIME_CONSTANT = 0.02  # s, time constant with which the pump flow follows terms: it cannot jump

_D, _TANK = int(Slot.ORIFICE_SMOOTHING), int(Slot.TANK_PRESSURE)
_RELIEF, _PUMP = int(Slot.RELIEF_PRESSURE), int(Slot.PUMP_FLOW)
_MARGIN, _DROOP = int(Slot.LOAD_SENSING_MARGIN), int(Slot.PUMP_DROOP)
_DROP = int(Slot.COMPENSATED_DROP)
_GROUP, _PRIORITY, _POWER = int(Slot.GROUP_SIZE), int(Slot.PRIORITY_DROP), int(Slot.ENGINE_POWER)
_FROM, _TO, _MERGE = int(Slot.MERGE_FROM), int(Slot.MERGE_TO), int(Slot.MERGE_CURVE)
_MAX_POWER_STEPS = 60
_POWER_TOLERANCE = 1.0e-12  # of power and flow factor at the engine limit: that of the flow balance

MAX_AXES = 8
# Layout of the work space: ports of all axes; factors of pressures and supply coupling; the
# softening of both chambers, later replaced by their rates of the first stage; then one value per
# axis or pump.
FACTOR_OFFSET = 4 * MAX_AXES
STAGE_OFFSET = 8 * MAX_AXES
FEED = 10 * MAX_AXES  # pressure at the inlet of the valve of each axis [Pa]
FRACTION = 11 * MAX_AXES  # fraction of its maximum flow that each pump delivers [1]
OWN_SHARE = 12 * MAX_AXES  # share of each pump's flow that its own line receives [1]
MOVED_SHARE = 13 * MAX_AXES  # share of a pump's flow that the merging valve of each axis moves [1]
LINE_FLOW = 14 * MAX_AXES  # flow of the pumps into each line [m^3/s]
LINE_DROOP = 15 * MAX_AXES  # decrease of this flow with pressure [m^3/(s Pa)]
DEMAND = 16 * MAX_AXES  # fraction of each pump's flow that the valves demand [1]
PUMP_START = 17 * MAX_AXES  # demand at the start of a step [1]
PUMP_ADDED = 18 * MAX_AXES  # flow fraction that terms add to each pump [1]
IS_COUPLED = 19 * MAX_AXES  # whether a line couples the pressures of its axes
BLOCK_SIZE = 20 * MAX_AXES  # number of axes that are coupled with each other, at the first of them
SCRATCH_SIZE = 21 * MAX_AXES

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
    """Write valve opening, inlet gain and fed chamber pressure of every axis, and the merged shares.

    The functions of this module compute the supply pressures from them.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        act: (4 count,) activations; of each axis only the pressures at indices 2 and 3 are read
            [Pa].
        spool: (4 count,) array with the spool position of every axis at index 0 of its four [1].
        ports: (SCRATCH_SIZE,) work space, written. Four values per axis: inlet gain
            [m^3/(s sqrt(Pa))], fed chamber pressure [Pa], pressure drop set by the compensator
            [Pa], opening [1]. The last is the pump speed [rad/s] for an axis with its own pump. In
            addition the shares at OWN_SHARE and MOVED_SHARE [1].
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ahead: time by which the pressures are extrapolated with `rate`, scalar [s].
        rate: (4 count,) array with pressure rates at indices 2 and 3 of every axis [Pa/s].

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Orifice".
    """
    for i in range(count):
        ports[OWN_SHARE + i], ports[MOVED_SHARE + i] = 1.0, 0.0
    for i in range(count):
        u = (first + i) * SLOT_COUNT
        if user[u + _MERGE] > 0.0:
            pump = OWN_SHARE + int(user[u + _FROM])
            ports[MOVED_SHARE + i] = ports[pump] * merging_share(user, u, spool[4 * i])
            ports[pump] -= ports[MOVED_SHARE + i]
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
def merging_share(user, u, spool):
    """Return the share of a pump's flow that a merging valve takes at a spool position of its axis.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of the axis that shifts the valve in `user`.
        spool: spool position of this axis, scalar [1].

    Returns:
        Share, scalar [1], 0 .. 1: linear between the knots, constant beyond them.

    Source: `machine.MergingValve`.
    """
    knots, c = int(user[u + _MERGE]), u + _MERGE + 1
    if spool <= user[c]:
        return user[c + CURVE_KNOTS]
    for k in range(c + 1, c + knots):
        if spool < user[k]:
            low, high = user[k - 1 + CURVE_KNOTS], user[k + CURVE_KNOTS]
            return low + (high - low) * (spool - user[k - 1]) / (user[k] - user[k - 1])
    return user[c + knots - 1 + CURVE_KNOTS]


@compile_inlined
def group_size(user, first, count, k):
    """Return the number of axes of the pump whose first axis is k, at least 1 and at most to the last axis.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        k: index of the axis, counted from the first hydraulic actuator [1].

    Returns:
        Number of axes, scalar [1].

    Source: `machine.PumpGroup`.
    """
    return min(count - k, max(1, int(user[(first + k) * SLOT_COUNT + _GROUP])))


@compile_without_allocation
def write_line_flows(user, first, count, scratch):
    """Write flow and droop of the line of every pump, from flow fractions and merged shares.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        scratch: (SCRATCH_SIZE,) work space with the shares of `compute_inlet_conditions` and the
            fractions at FRACTION; LINE_FLOW [m^3/s] and LINE_DROOP [m^3/(s Pa)] are written.

    Returns:
        Nothing.

    Source: this module's docstring.
    """
    k = 0
    while k < count:
        s, own = (first + k) * SLOT_COUNT, scratch[OWN_SHARE + k]
        scratch[LINE_FLOW + k] = max(_MIN_FLOW_FRACTION, own * scratch[FRACTION + k]) * user[s + _PUMP]
        scratch[LINE_DROOP + k] = own * user[s + _DROOP]
        k += group_size(user, first, count, k)
    for i in range(count):
        moved = scratch[MOVED_SHARE + i]
        if moved > 0.0:
            u = (first + i) * SLOT_COUNT
            pump, line = int(user[u + _FROM]), int(user[u + _TO])
            s = (first + pump) * SLOT_COUNT
            scratch[LINE_FLOW + line] += moved * user[s + _PUMP] * scratch[FRACTION + pump]
            scratch[LINE_DROOP + line] += moved * user[s + _DROOP]


@compile_without_allocation
def solve_supply_pressures(user, first, count, scratch):
    """Compute the pressures of all lines from pumps, valves, merging, priority and engine limit.

    Without an engine limit every line is solved by `circuit_supply_pressure`. If the hydraulic
    power of all pumps at these pressures exceeds the limit, the flows of all pumps are multiplied
    by the factor at which the power equals the limit. The power increases with the factor. The
    logarithm of the factor is found by the Illinois method from that of the power, because the
    power of flows through orifices is nearly a power law.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        scratch: (SCRATCH_SIZE,) work space with the results of `compute_inlet_conditions` and the
            fractions at FRACTION. Written: FEED, the pressure that feeds each axis [Pa], which at
            the first axis of a pump is the pressure of its line; LINE_FLOW and LINE_DROOP, with the
            engine limit. The limit counts as the droop `Q / p`, its derivative.

    Returns:
        Hydraulic power of all pumps, scalar [W]; 0 without an engine limit.

    Source: this module's docstring.
    """
    write_line_flows(user, first, count, scratch)
    limit = user[first * SLOT_COUNT + _POWER]
    power = _solve_lines(user, first, count, scratch, 1.0, limit > 0.0)
    if limit > 0.0 and power > limit:
        power = _limit_power(user, first, count, scratch, power, limit)
    return power


@compile_without_allocation
def _limit_power(user, first, count, scratch, power, limit):
    """Reduce the flows of all pumps to the power limit [W]; see `solve_supply_pressures`.

    `power` is that without the limit [W]. The result is the power with it [W].
    """
    low, high, below, above, side, factor = -math.inf, 0.0, 0.0, math.log(power / limit), 0, 1.0
    for _ in range(_MAX_POWER_STEPS):
        guess = high - above if below == 0.0 else low - below * (high - low) / (above - below)
        factor = math.exp(guess)
        power = _solve_lines(user, first, count, scratch, factor, True)
        excess = math.log(power / limit)
        if abs(excess) <= _POWER_TOLERANCE or high - low <= _POWER_TOLERANCE:
            break
        if excess > 0.0:
            high, above = guess, excess
            below *= 0.5 if side > 0 else 1.0
            side = 1
        else:
            low, below = guess, excess
            above *= 0.5 if side < 0 else 1.0
            side = -1
    k = 0
    while k < count:
        scratch[LINE_FLOW + k] *= factor
        scratch[LINE_DROOP + k] += scratch[LINE_FLOW + k] / max(scratch[FEED + k], user[first * SLOT_COUNT + _D])
        k += group_size(user, first, count, k)
    return power


@compile_without_allocation
def _solve_lines(user, first, count, scratch, factor, with_power):
    """Write the pressures at FEED for pump flows times a factor, and return the hydraulic power [W].

    The power is the flow that a pump displaces times the pressure of its line. A load-sensing pump
    that maintains its pressure displaces the flow that is drawn; any other one all of its flow.
    Without `with_power` the result is 0.
    """
    k, power = 0, 0.0
    while k < count:
        size, ports = group_size(user, first, count, k), scratch[4 * k :]
        flow, droop = factor * scratch[LINE_FLOW + k], scratch[LINE_DROOP + k]
        s, most = (first + k) * SLOT_COUNT, max_supply_pressure(user, first + k, size, ports)
        p = solve_supply_pressure(ports, size, user[s + _D], most, flow, droop, user[s + _OVERRIDE])
        others = p
        if user[s + _PRIORITY] > 0.0 and ports[0] > 0.0 and p < min(most, ports[1] + user[s + _PRIORITY]):
            p = min(most, ports[1] + user[s + _PRIORITY])
            drop = p - ports[1]
            rest = flow - droop * p
            if drop > 0.0:
                rest -= inlet_flow(drop, ports[0], user[s + _D], ports[2])[0]
            if rest <= 0.0:  # not enough for the first axis alone
                p = solve_supply_pressure(ports, 1, user[s + _D], most, flow, droop, 0.0)
            rest, gain = max(rest, _MIN_FLOW_FRACTION * flow), ports[0]
            ports[0] = 0.0
            others = min(p, solve_supply_pressure(ports, size, user[s + _D], most, rest, 0.0, 0.0))
            ports[0] = gain
        scratch[FEED + k] = p
        for i in range(k + 1, k + size):
            scratch[FEED + i] = others
        if with_power:
            if user[s + _MARGIN] > 0.0 and p >= most:
                flow = min(flow, drawn_flow(user, first + k, size, ports, p, droop))
            power += flow * p
        k += size
    return power


@compile_without_allocation
def write_delivered_fractions(user, first, count, act, scratch):
    """Write the fraction of its maximum flow that every pump delivers to FRACTION of the work space.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        act: (>= 4 count,) activations, and the states of pumps with a time constant [1].
        scratch: (SCRATCH_SIZE,) work space.

    Returns:
        Nothing.

    Source: `delivered_flow_fraction`.
    """
    k = 0
    while k < count:
        scratch[FRACTION + k] = delivered_flow_fraction(user, first + k, act)
        k += group_size(user, first, count, k)


@compile_without_allocation
def solve_state_supplies(user, first, count, act, scratch):
    """Compute the supply pressures of a state.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        act: (>= 4 count,) activations: spools [1], pressures [Pa], and the states of pumps with a
            time constant [1].
        scratch: (SCRATCH_SIZE,) work space; written as by `solve_supply_pressures`.

    Returns:
        Pressure of the first line, scalar [Pa].

    Source: models/cat215/README.md, "Supply".
    """
    compute_inlet_conditions(user, act, act, scratch, first, count, 0.0, act)
    write_delivered_fractions(user, first, count, act, scratch)
    solve_supply_pressures(user, first, count, scratch)
    return scratch[FEED]


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
def write_demanded_fractions(user, first, count, scratch):
    """Write the fraction of its maximum flow that the valves demand of every pump to DEMAND.

    `q = (sum_i q_i + c_p p_s) / Q_pump` with valve flows q_i, pump leakage c_p and maximum flow
    Q_pump, at the pressure p_s that a pump without time constant would maintain. A pump with time
    constant T delivers at most the fraction r with `T dr/dt = q - r`. While r rises, the pressure
    drops until the valves draw no more than that. While r falls, the excess flow passes the relief
    or unloading valve. Of a pump that delivers to several lines, q is the mean over the shares that
    these receive.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        scratch: (SCRATCH_SIZE,) work space with the results of `compute_inlet_conditions`; DEMAND
            [1], 0 .. 1, is written. FRACTION becomes 1, LINE_FLOW and LINE_DROOP those at full flow.

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Supply"; first-order swash plate: Merritt 1967, sec. 8-6.
    """
    for k in range(count):
        scratch[FRACTION + k] = 1.0
    write_line_flows(user, first, count, scratch)
    k = 0
    while k < count:
        size, ports = group_size(user, first, count, k), scratch[4 * k :]
        flow, droop = scratch[LINE_FLOW + k], scratch[LINE_DROOP + k]
        p = circuit_supply_pressure(user, first + k, size, ports, flow, droop)
        scratch[DEMAND + k] = min(1.0, drawn_flow(user, first + k, size, ports, p, droop) / flow)
        k += size
    for i in range(count):
        if scratch[MOVED_SHARE + i] > 0.0:  # demands of the lines become those of the pumps, in place
            _share_demands(user, first, count, scratch)
            break


@compile_without_allocation
def _share_demands(user, first, count, scratch):
    """Replace the demands of the lines at DEMAND by those of the pumps that deliver to them."""
    for k in range(count):
        scratch[FRACTION + k] = scratch[DEMAND + k]
        scratch[DEMAND + k] *= scratch[OWN_SHARE + k]
    for i in range(count):
        if scratch[MOVED_SHARE + i] > 0.0:
            u = (first + i) * SLOT_COUNT
            line = int(user[u + _TO])
            scratch[DEMAND + int(user[u + _FROM])] += scratch[MOVED_SHARE + i] * scratch[FRACTION + line]
    for k in range(count):
        scratch[FRACTION + k] = 1.0


@compile_without_allocation
def drawn_flow(user, first, count, ports, supply, droop):
    """Return the flow that all valves and the pump's internal leakage draw at a supply pressure.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.
        supply: p_s, scalar [Pa].
        droop: c_p, decrease of the pump flow with pressure, scalar [m^3/(s Pa)].

    Returns:
        `sum_i q_i + c_p p_s` with valve flows q_i and leakage coefficient c_p, scalar [m^3/s].

    Source: models/cat215/README.md, "Supply".
    """
    s = first * SLOT_COUNT
    drawn = droop * supply
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
def circuit_supply_pressure(user, first, count, ports, flow, droop):
    """Compute the supply pressure of the valves of one pump from flow, relief valve and load sensing.

    A load-sensing pump maintains `max p_i + margin` over the open valves (tank pressure counts as a
    load), within the limits of relief setting and flow.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ports: (>= 4 count,) inlet gain [m^3/(s sqrt(Pa))], pressure of the fed chamber [Pa],
            pressure drop set by the compensator [Pa] and opening [1] of every axis, see
            `compute_inlet_conditions`.
        flow: flow of the pump at pressure 0, scalar [m^3/s], > 0.
        droop: c_p, decrease of this flow with pressure, scalar [m^3/(s Pa)].

    Returns:
        p_s, scalar [Pa].

    Source: models/cat215/README.md, "Supply".
    """
    s, most = first * SLOT_COUNT, max_supply_pressure(user, first, count, ports)
    return solve_supply_pressure(ports, count, user[s + _D], most, flow, droop, user[s + _OVERRIDE])


@compile_inlined
def write_supply_couplings(user, first, count, scratch):
    """Write the derivatives of all supply pressures, and which axes they couple, to the work space.

    The axes of a pump are one block, or two if the supply of its first axis is higher because of
    its priority.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        scratch: (SCRATCH_SIZE,) work space after `solve_supply_pressures`. Written at the first axis of
            each block: BLOCK_SIZE and IS_COUPLED; at FACTOR_OFFSET the derivatives of
            `compute_supply_pressure_derivatives`.

    Returns:
        Nothing.

    Source: `compute_supply_pressure_derivatives`.
    """
    k, end, droop = 0, 0, 0.0
    while k < count:
        if k == end:
            end, droop = k + group_size(user, first, count, k), scratch[LINE_DROOP + k]
        has_priority = scratch[FEED + k] > scratch[FEED + end - 1]
        size, f = 1 if has_priority else end - k, FACTOR_OFFSET + 4 * k
        scratch[BLOCK_SIZE + k] = size
        scratch[IS_COUPLED + k] = compute_supply_pressure_derivatives(
            user, first + k, size, scratch[4 * k :], scratch[FEED + k], 0.0 if has_priority else droop, scratch[f:]
        )
        k += size


@compile_without_allocation
def compute_supply_pressure_derivatives(user, first, count, ports, supply, droop, out):
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
        droop: c_p, decrease of the pump flow with pressure, scalar [m^3/(s Pa)].
        out: (>= 4 count,) written at indices 2 and 3 of every axis: g_i [m^3/(s Pa)] and
            dp_s/dp_i [1].

    Returns:
        Whether any dp_s/dp_i is not 0, scalar [1]; otherwise `out` may be unchanged.

    Source: implicit function theorem on "Supply" of models/cat215/README.md.
    """
    s, total, leader = first * SLOT_COUNT, droop, -1
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

"""Time step of the hydraulic circuit: valves and chambers with one or more shared supplies.

Pure functions on flat arrays in MuJoCo's layout, so that the native callbacks, the tests and the
estimator run the same code. The parameters of axis `i` are at `user[i * SLOT_COUNT + Slot]`. Its
activations `spool, spool_rate, p_head, p_rod` are at `act[4 i ...]`, counted from the first
hydraulic axis. The states of bristles, of pumps with a time constant and of terms follow after all
axes. An axis with its own pump (`ActuatorKind.PUMP_DRIVE`, see `pump_drive`) has pump speed and
load cylinder pressure instead of spool and spool rate.

The module also evaluates the terms of a machine in a step, and the implicit friction of a light
drive side, for which an explicit step would oscillate about rest.
"""

import math

import numpy as np

from hydrotele.core.compiled import compile_inlined, compile_without_allocation
from hydrotele.hydraulics.actuator import (
    actuator_end_stop_force,
    actuator_friction,
    actuator_friction_slope,
    bristle_friction,
    force_after_friction,
    pump_drive_force,
    pump_drive_pressure_rates,
    pump_drive_volumes,
)
from hydrotele.hydraulics.actuator_layout import PUMP_OFFSET, SLOT_COUNT, ActuatorKind, Slot
from hydrotele.hydraulics.laws import (
    air_compliance,
    air_softening_factor,
    pressure_with_released_air,
    pressure_without_released_air,
    relief_and_makeup_flow,
    spool_step,
)
from hydrotele.hydraulics.pump_drive import (
    load_pressure_step,
    pump_flows,
    pump_speed_after_switching,
    pump_speed_step,
)
from hydrotele.hydraulics.supply import (
    BLOCK_SIZE,
    DEMAND,
    FACTOR_OFFSET,
    FEED,
    FRACTION,
    IS_COUPLED,
    MAX_AXES,
    PUMP_ADDED,
    PUMP_START,
    SCRATCH_SIZE,
    STAGE_OFFSET,
    TERM_FLOW_TIME_CONSTANT,
    add_flow_fractions,
    advance_pump_flow_fraction,
    circuit_supply_pressure,
    compute_inlet_conditions,
    delivered_flow_fraction,
    group_size,
    pump_flow_fraction,
    solve_state_supplies,
    solve_supply_pressure,
    solve_supply_pressures,
    write_delivered_fractions,
    write_demanded_fractions,
    write_supply_couplings,
)
from hydrotele.hydraulics.valve import axis_valve_opening, chamber_flows
from hydrotele.terms.drive_state import VARIABLES, DriveState
from hydrotele.terms.table import (
    ANY_DRIVE,
    COMMAND,
    COUNT_INDEX,
    FLOW_HEAD,
    FLOW_ROD,
    FLOW_SUPPLY,
    has_term,
    locate_hysteresis_state,
    sum_flow_terms,
    sum_terms,
    update_term_state,
)

__all__ = [
    "ACTIVATIONS_PER_AXIS", "MAX_AXES", "NO_EXTRA_STATES", "SCRATCH_SIZE", "SLOT_COUNT", "ActuatorKind", "Slot",
    "actuator_friction",
    "actuator_friction_slope", "actuator_end_stop_force", "axis_valve_opening", "axis_flows_and_force", "chamber_flows",
    "circuit_scratch", "circuit_supply_pressure", "delivered_flow_fraction", "force_after_friction",
    "compute_inlet_conditions", "chamber_pressure_rates", "pump_drive_force", "step_circuit", "solve_supply_pressure",
    "FEED", "group_size", "solve_state_supplies", "write_demanded_fractions",
]  # fmt: skip

ACTIVATIONS_PER_AXIS = 4
NO_EXTRA_STATES = -1  # value of `memory` that skips all code of additional states
_ROS2_GAMMA = 1.0 + 1.0 / math.sqrt(2.0)  # L-stable, of second order with any approximate Jacobian
_NO_FLOWS = (0.0, 0.0, 0.0, 0.0)

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_VH, _VR = int(Slot.VOLUME_HEAD), int(Slot.VOLUME_ROD)
_STROKE, _LEAK = int(Slot.STROKE), int(Slot.LEAKAGE)
_W, _Z = int(Slot.BANDWIDTH), int(Slot.DAMPING)
_SLEW, _PORT = int(Slot.SLEW_LIMIT), int(Slot.PORT_RELIEF)
_KR, _KM = int(Slot.RELIEF_GAIN), int(Slot.MAKEUP_GAIN)
_BETA, _TANK = int(Slot.BULK_MODULUS), int(Slot.TANK_PRESSURE)
_HOSE, _AIR = int(Slot.HOSE_COMPLIANCE), int(Slot.AIR_RELEASE)
_ONSET, _ENTRAINED = int(Slot.AIR_ONSET), int(Slot.ENTRAINED_AIR)
_LAG, _DELIVERY = int(Slot.PUMP_TIME_CONSTANT), int(Slot.DELIVERY)
_ADDED, _PUMP = int(Slot.ADDED_DELIVERY), int(Slot.PUMP_FLOW)
_BRISTLE_STIFFNESS, _BRISTLE = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE)
_KIND, _PUMPED = int(Slot.KIND), float(ActuatorKind.PUMP_DRIVE)
_TIME, _POSITION, _VELOCITY = (VARIABLES[name] for name in ("time", "position", "velocity"))
_COMMAND, _SUPPLY, _FORCE = (VARIABLES[n] for n in ("command", "pressure_supply", "force"))


@compile_inlined
def _chamber_stiffness(user, u, x, p_head, p_rod):
    """Return the pressure rise per added oil volume of the head and the rod chamber [Pa/m^3].

    It includes the compliance of hoses and of air bubbles in the oil. x is the piston displacement [m].
    """
    beta = user[u + _BETA]
    volume_head, volume_rod = user[u + _VH], user[u + _VR]
    if user[u + 1] == 1.0:  # Kind.CYLINDER
        inside = min(max(x, 0.0), user[u + _STROKE])
        volume_head += user[u + _AH] * inside
        volume_rod += user[u + _AR] * (user[u + _STROKE] - inside)
    hose, air = beta * user[u + _HOSE], user[u + _ENTRAINED]
    if air > 0.0:
        volume_head *= 1.0 + beta * air_compliance(p_head, air)
        volume_rod *= 1.0 + beta * air_compliance(p_rod, air)
    return beta / (volume_head + hose), beta / (volume_rod + hose)


@compile_inlined
def chamber_pressure_rates(user, u, opening, p_supply, p_head, p_rod, x, v, ahead, added):
    """Return the pressure rates of both chambers of an axis, and their derivatives.

    `p_A' = (beta / V_A)(q_A - A_h v - q_l + r_A)`, `p_B' = (beta / V_B)(q_B + A_r v + q_l + r_B)`
    with bulk modulus beta, volumes V, valve flows q, areas A, piston leakage q_l, and flows r of
    port relief, make-up valve and terms. A hose of compliance C_h counts as additional volume
    `beta C_h`, and air bubbles in the oil as beta times their compliance (`laws.air_compliance`).
    Beyond an end of the stroke the volumes are constant. The rates are those without released air;
    `laws.pressure_with_released_air` converts pressures below atmosphere.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        opening: signed valve opening, scalar [1]; for an axis with its own pump the pump speed
            [rad/s].
        p_supply: supply pressure, scalar [Pa].
        p_head: head-side pressure p_A, scalar [Pa].
        p_rod: rod-side pressure p_B, scalar [Pa].
        x: piston displacement, scalar [m] (0 for a motor, whose volumes are constant).
        v: piston velocity, scalar [m/s] or [rad/s].
        ahead: time over which the slopes are used, scalar [s]: a relief or make-up valve that
            would open within it counts as open in the slope (not in the rate).
        added: flows of the machine's terms into both chambers [m^3/s] and their slopes with respect
            to the pressures of these chambers [m^3/(s Pa)], see `terms.table.sum_flow_terms`.

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]), where ' is d/dt.

    Source: models/cat215/README.md, "Chambers".
    """
    if user[u + _KIND] == _PUMPED:
        return pump_drive_pressure_rates(user, u, opening, p_head, p_rod, x, v, added)
    q_head, q_rod, slope_head, slope_rod = chamber_flows(user, u, opening, p_supply, p_head, p_rod)
    leak = user[u + _LEAK] * (p_head - p_rod)
    port, relief_gain = user[u + _PORT], user[u + _KR]
    tank, makeup_gain = user[u + _TANK], user[u + _KM]
    r_head, k_head = relief_and_makeup_flow(p_head, port, relief_gain, tank, makeup_gain)
    r_rod, k_rod = relief_and_makeup_flow(p_rod, port, relief_gain, tank, makeup_gain)
    head, rod = _chamber_stiffness(user, u, x, p_head, p_rod)
    rate_head = head * (q_head - user[u + _AH] * v - leak + r_head + added[0])
    rate_rod = rod * (q_rod + user[u + _AR] * v + leak + r_rod + added[1])
    if k_head == 0.0:
        _, k_head = relief_and_makeup_flow(p_head + ahead * rate_head, port, relief_gain, tank, makeup_gain)
    if k_rod == 0.0:
        _, k_rod = relief_and_makeup_flow(p_rod + ahead * rate_rod, port, relief_gain, tank, makeup_gain)
    return (
        rate_head,
        rate_rod,
        head * (slope_head + k_head - user[u + _LEAK] + added[2]),
        rod * (slope_rod + k_rod - user[u + _LEAK] + added[3]),
    )


@compile_without_allocation
def _term_flows(terms, i, user, time, x, oil, supply, drives):
    """Return the flows that a machine's terms (additional laws) add to the chambers of axis i.

    `oil` is (spool [1], spool rate [1/s], head-side pressure, rod-side pressure [Pa]) of the axis,
    and x its position [m] or [rad]. `supply` is the supply pressure [Pa]; velocities and commands
    are those of `drives`.

    Returns:
        (flow into head side, into rod side [m^3/s], their slopes with respect to the pressures of
        these chambers [m^3/(s Pa)]).
    """
    if not (has_term(terms, FLOW_HEAD, i) or has_term(terms, FLOW_ROD, i)):
        return _NO_FLOWS
    spool, rate, p_head, p_rod = oil
    v, command = drives.velocity[i], drives.command[i]
    force = user[i * SLOT_COUNT + _AH] * p_head - user[i * SLOT_COUNT + _AR] * p_rod
    s = DriveState(time, x, v, spool, rate, p_head, p_rod, supply, command, force, 0.0, 0.0)
    return sum_flow_terms(terms, i, s, drives)


@compile_without_allocation
def _term_flow_fraction(user, first, k, drives, terms, time, scratch, dt):
    """Return the flow that terms add to a pump at the end of a step, per maximum pump flow [1].

    Terms are additional laws of a machine; those of the axes of the pump count, whose first axis is
    k. The flow follows the sum of the terms at the start of the step with a first-order lag of
    20 ms. It is 0 for a pump without such terms.
    """
    at = int(user[(first + k) * SLOT_COUNT + _ADDED])
    if at == 0:
        return 0.0
    total, act = 0.0, drives.act
    if has_term(terms, FLOW_SUPPLY, ANY_DRIVE):
        for i in range(k, k + group_size(user, first, drives.count, k)):
            u, a, v = (first + i) * SLOT_COUNT, 4 * i, drives.velocity[first + i]
            force = user[u + _AH] * act[a + 2] - user[u + _AR] * act[a + 3]
            s = DriveState(
                time, drives.position[first + i] - dt * v, v, act[a], act[a + 1], act[a + 2],
                act[a + 3], scratch[FEED + i], drives.command[first + i], force, 0.0, 0.0,
            )  # fmt: skip
            total += sum_terms(terms, FLOW_SUPPLY, first + i, s, drives)
    wanted = total / user[(first + k) * SLOT_COUNT + _PUMP]
    return wanted + (act[at] - wanted) * math.exp(-dt / TERM_FLOW_TIME_CONSTANT)


@compile_without_allocation
def step_circuit(user, first, drives, dt, act_dot, scratch, terms, time, extra_states):
    """Compute the mean rates of spools (or pump speeds) and chamber pressures over a time step.

    The activations themselves are not changed; adding dt times the rates advances them by the step.

    Spools follow their exact exponential. Pressures take one step of the L-stable second-order
    Rosenbrock method ROS2, with constant piston velocities over the step. Its Jacobian is diagonal
    except for the supplies, each of which couples the chambers that it feeds
    (`compute_supply_pressure_derivatives`, solved by the Sherman-Morrison formula). The supply
    pressures are solved in both stages. Below
    atmosphere the method integrates the pressure P without released air
    (`laws.pressure_without_released_air`), which is linear in the missing oil volume. A pump with a
    time constant follows the mean of the flow demands at both ends of the step, by its exact
    exponential.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        first: index of the first hydraulic actuator.
        drives: Drives: number of hydraulic actuators, <= MAX_AXES; their spool [1], spool rate
            [1/s] and pressures [Pa] at the start of the step, followed by the additional states of
            `actuator_layout.extra_state_names`. For all actuators: positions at the end of the
            step, as in MuJoCo's leapfrog [m] or [rad], velocities during the step [m/s] or [rad/s],
            and commands, which are clipped to [-1, 1] [1].
        dt: time step, scalar [s].
        act_dot: (>= 4 count,) written: mean rates over the step, in the unit of `drives.act` per
            [s]; of the additional states only those of the pump.
        scratch: (SCRATCH_SIZE,) work space. At FEED it then has the pressure that feeds each axis at
            the end of the step [Pa].
        terms: (n,) table of the machine's terms, `NO_TERMS` for none [SI].
        time: time at the start of the step, scalar [s]; used by terms only.
        extra_states: number of additional states after the activations, scalar [1];
            `NO_EXTRA_STATES` skips them and saves the time of the check.

    Returns:
        (pressure of the first supply at the start of the step [Pa], at its end [Pa]).

    Source: models/cat215/README.md; ROS2: Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), Eq. 2.6.
    """
    gamma_h = _ROS2_GAMMA * dt
    count, act, length, velocity, command = drives
    for i in range(count):
        u, a = (first + i) * SLOT_COUNT, 4 * i
        bounded = min(1.0, max(-1.0, command[first + i]))
        if user[u + _KIND] == _PUMPED:
            act_dot[a] = pump_speed_step(user, u + PUMP_OFFSET, act[a], bounded, act[a + 2], act[a + 3], dt)
            act_dot[a + 1] = load_pressure_step(user, u + PUMP_OFFSET, act[a + 1], velocity[first + i], dt)
            continue
        act_dot[a], act_dot[a + 1] = spool_step(
            act[a], act[a + 1], bounded, user[u + _W], user[u + _Z], dt, user[u + _SLEW]
        )
    compute_inlet_conditions(user, act, act, scratch, first, count, 0.0, act_dot)
    for k in range(count):
        scratch[FRACTION + k] = 1.0
    if extra_states >= 0:
        write_delivered_fractions(user, first, count, act, scratch)
    solve_supply_pressures(user, first, count, scratch)
    p_start = scratch[FEED]
    write_supply_couplings(user, first, count, scratch)
    if extra_states >= 0:
        _advance_pump_fractions(user, first, drives, terms, time, scratch, dt)
    for i in range(count):
        u, a = (first + i) * SLOT_COUNT, 4 * i
        x, v = length[first + i] - dt * velocity[first + i], velocity[first + i]
        if user[u + _KIND] == _PUMPED:
            scratch[a + 3] = pump_speed_after_switching(act[a], act_dot[a])
        more = _NO_FLOWS
        if len(terms) > 0:
            oil = (act[a], act[a + 1], act[a + 2], act[a + 3])
            more = _term_flows(terms, first + i, user, time, x, oil, scratch[FEED + i], drives)
        head, rod, j_head, j_rod = chamber_pressure_rates(
            user, u, scratch[a + 3], scratch[FEED + i], act[a + 2], act[a + 3], x, v, dt, more,
        )  # fmt: skip
        f, k = FACTOR_OFFSET + a, STAGE_OFFSET + 2 * i
        scratch[k] = _predicted_softening(user, u, act[a + 2], head, dt)
        scratch[k + 1] = _predicted_softening(user, u, act[a + 3], rod, dt)
        scratch[f] = 1.0 / (1.0 - gamma_h * (scratch[k] * j_head))
        scratch[f + 1] = 1.0 / (1.0 - gamma_h * (scratch[k + 1] * j_rod))
        act_dot[a + 2], act_dot[a + 3] = head * scratch[f], rod * scratch[f + 1]
    k = 0
    while k < count:
        size = int(scratch[BLOCK_SIZE + k])
        if scratch[IS_COUPLED + k] > 0.0:
            _prepare_supply_coupling(user, first, k, size, drives, dt, gamma_h, scratch)
            _apply_supply_coupling(k, size, act_dot, scratch)
        k += size
    for i in range(count):
        u, a, k = (first + i) * SLOT_COUNT, 4 * i, STAGE_OFFSET + 2 * i
        scratch[k], scratch[k + 1] = act_dot[a + 2], act_dot[a + 3]
        act_dot[a + 2] = _rate_with_air(user, u, act[a + 2], act_dot[a + 2], dt)
        act_dot[a + 3] = _rate_with_air(user, u, act[a + 3], act_dot[a + 3], dt)
    compute_inlet_conditions(user, act, act_dot, scratch, first, count, dt, act_dot)
    solve_supply_pressures(user, first, count, scratch)
    p_end = scratch[FEED]
    if extra_states >= 0:
        _write_pump_rates(user, first, count, act, act_dot, scratch, dt)
    for i in range(count):
        u, a = (first + i) * SLOT_COUNT, 4 * i
        x, v = length[first + i], velocity[first + i]
        p_head, p_rod = act[a + 2] + dt * act_dot[a + 2], act[a + 3] + dt * act_dot[a + 3]
        more = _NO_FLOWS
        if len(terms) > 0:
            oil = (act_dot[a], act_dot[a + 1], p_head, p_rod)
            more = _term_flows(terms, first + i, user, time + dt, x, oil, scratch[FEED + i], drives)
        head, rod, _, _ = chamber_pressure_rates(
            user, u, scratch[a + 3], scratch[FEED + i], p_head, p_rod, x, v, 0.0, more,
        )  # fmt: skip
        f, k = FACTOR_OFFSET + a, STAGE_OFFSET + 2 * i
        act_dot[a + 2] = scratch[f] * (head - 2.0 * scratch[k])
        act_dot[a + 3] = scratch[f + 1] * (rod - 2.0 * scratch[k + 1])
        act_dot[a] = (act_dot[a] - act[a]) / dt
        act_dot[a + 1] = (act_dot[a + 1] - act[a + 1]) / dt
    k = 0
    while k < count:
        size = int(scratch[BLOCK_SIZE + k])
        if scratch[IS_COUPLED + k] > 0.0:
            _apply_supply_coupling(k, size, act_dot, scratch)
        k += size
    for i in range(count):
        u, a, k = (first + i) * SLOT_COUNT, 4 * i, STAGE_OFFSET + 2 * i
        head = 1.5 * scratch[k] + 0.5 * act_dot[a + 2]
        rod = 1.5 * scratch[k + 1] + 0.5 * act_dot[a + 3]
        port = user[u + _PORT]
        if act[a + 2] < port < act[a + 2] + dt * head:
            stiffness = _chamber_stiffness(user, u, length[first + i], port, act[a + 3])[0]
            head = _relief_limited_rate(port - act[a + 2], head, stiffness * user[u + _KR], dt)
        if act[a + 3] < port < act[a + 3] + dt * rod:
            stiffness = _chamber_stiffness(user, u, length[first + i], act[a + 2], port)[1]
            rod = _relief_limited_rate(port - act[a + 3], rod, stiffness * user[u + _KR], dt)
        act_dot[a + 2] = _rate_with_air(user, u, act[a + 2], head, dt)
        act_dot[a + 3] = _rate_with_air(user, u, act[a + 3], rod, dt)
    return p_start, p_end


@compile_without_allocation
def _advance_pump_fractions(user, first, drives, terms, time, scratch, dt):
    """Write the fractions of all pumps at the end of a step to FRACTION, and what leads to them.

    PUMP_START gets the demand at the start of the step, PUMP_ADDED the fraction that terms add at
    its end. The arguments are those of `step_circuit`.
    """
    count, act, k = drives.count, drives.act, 0
    write_demanded_fractions(user, first, count, scratch)
    while k < count:
        begun = scratch[DEMAND + k]
        added = _term_flow_fraction(user, first, k, drives, terms, time, scratch, dt)
        share = advance_pump_flow_fraction(user, first + k, begun, pump_flow_fraction(user, first + k, act), dt)
        scratch[PUMP_START + k], scratch[PUMP_ADDED + k] = begun, added
        scratch[FRACTION + k] = add_flow_fractions(share, added)
        k += group_size(user, first, count, k)


@compile_without_allocation
def _write_pump_rates(user, first, count, act, act_dot, scratch, dt):
    """Write the mean rates of the states of all pumps over a step; arguments as of `step_circuit`."""
    write_demanded_fractions(user, first, count, scratch)
    k = 0
    while k < count:
        s = (first + k) * SLOT_COUNT
        if user[s + _LAG] > 0.0:
            at = int(user[s + _DELIVERY])
            wanted = 0.5 * (scratch[PUMP_START + k] + scratch[DEMAND + k])
            act_dot[at] = (advance_pump_flow_fraction(user, first + k, wanted, act[at], dt) - act[at]) / dt
        if user[s + _ADDED] > 0.0:
            at = int(user[s + _ADDED])
            act_dot[at] = (scratch[PUMP_ADDED + k] - act[at]) / dt
        k += group_size(user, first, count, k)


@compile_without_allocation
def write_term_state_rates(user, terms, drives, act_dot, dt, time, feed):
    """Write the mean rates over a step of the internal states of terms with hysteresis.

    Call this function after the rates of all other activations have been written, since it uses
    them.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        terms: (n,) table of the machine's terms [SI].
        drives: Drives with the activations at the start of the step, positions at its end and
            velocities over it, and the commands that arrive [SI, commands in 1].
        act_dot: (>= 4 count,) mean rates over the step; those of the terms' internal states are
            written [1/s].
        dt: time step, scalar [s].
        time: time at the start of the step, scalar [s].
        feed: (>= count,) pressures that feed the axes at the end of the step [Pa].

    Returns:
        Nothing.

    Source: `terms.table.update_term_state`.
    """
    act, count = drives.act, drives.count
    for term in range(int(terms[COUNT_INDEX])):
        place, i, k = locate_hysteresis_state(terms, term)
        if not (4 * count <= place < len(act_dot) and 0 <= i < len(drives.velocity)):
            continue
        a = 4 * i
        if k == _TIME:
            value = time + dt
        elif k == _POSITION:
            value = drives.position[i]
        elif k == _VELOCITY:
            value = drives.velocity[i]
        elif k == _COMMAND:
            value = drives.command[i]
        elif k == _SUPPLY:
            value = feed[min(i, count - 1)]
        elif i >= count:
            value = 0.0
        elif k == _FORCE:
            head, rod = act[a + 2] + dt * act_dot[a + 2], act[a + 3] + dt * act_dot[a + 3]
            value = user[i * SLOT_COUNT + _AH] * head - user[i * SLOT_COUNT + _AR] * rod
        else:
            value = act[a + k - 3] + dt * act_dot[a + k - 3]
        act_dot[place] = (update_term_state(terms, term, value, act[place]) - act[place]) / dt


@compile_without_allocation
def _relief_limited_rate(margin, rate, relief_rate, dt):
    """Return the mean pressure rate over a step in which the port relief valve opens [Pa/s].

    The function is used if the pressure passes the setting within the step. The pressure rises with
    the rate r up to the setting; from there the excess e over the setting follows `e' = r - e q`.

    Args:
        margin: pressure difference up to the setting, scalar [Pa].
        rate: r, rate without the relief valve, scalar [Pa/s].
        relief_rate: q, rate at which the relief flow reduces the excess, scalar [1/s].
        dt: time step, scalar [s].
    """
    beyond = dt * rate - margin
    turns = relief_rate * beyond / rate
    return rate if turns <= 0.0 else (margin - beyond * math.expm1(-turns) / turns) / dt


@compile_inlined
def _rate_with_air(user, u, pressure, rate, dt):
    """Convert a mean pressure rate of oil without released air to that with released air [Pa/s].

    `pressure` is the chamber pressure with air at the start of the step of length dt [Pa above
    atmosphere]. The rate is unchanged if the oil has no dissolved air, or if `pressure` and
    `pressure` plus dt times `rate` are both at least -onset. The onset is the pressure deficit at
    which the oil releases air [Pa].
    """
    release, onset = user[u + _AIR], user[u + _ONSET]
    if (pressure >= -onset and pressure + dt * rate >= -onset) or release == 0.0:
        return rate
    oil = pressure_without_released_air(pressure, release, onset)
    return (pressure_with_released_air(oil + dt * rate, release, onset) - pressure) / dt


@compile_inlined
def _predicted_softening(user, u, pressure, rate, dt):
    """Return the factor by which released air reduces the derivatives of a pressure rate [1].

    It is `laws.air_softening_factor` at the start of the step. It is 1 if no air is released at the
    start, because the oil has no dissolved air or the chamber `pressure` [Pa above atmosphere] is
    at least -onset. It is also 1 if the air dissolves again within the step: the pressure without
    released air at the start, plus dt times its `rate` [Pa/s], is above -onset. The onset is the
    pressure deficit at which the oil releases air [Pa].
    """
    release, onset = user[u + _AIR], user[u + _ONSET]
    if pressure >= -onset or release == 0.0:
        return 1.0
    if pressure_without_released_air(pressure, release, onset) + dt * rate > -onset:
        return 1.0
    return air_softening_factor(pressure, release, onset)


@compile_without_allocation
def _prepare_supply_coupling(user, first, begin, size, drives, dt, gamma_h, scratch):
    """Prepare the Sherman-Morrison solution of the stage equations that the supply of some axes couples.

    The stage equations of ROS2 are `(I - gamma h (D + b w^T)) k = r` for the pressure rates k, with step h
    and coefficient gamma. D is diagonal, b the pressure rates per supply pressure and w = dp_s/dp. Index 2
    of the four factors of every axis (in `scratch`) gets `gamma h b / (1 - gamma h D)` over the common
    divisor `1 - gamma h w^T b / (1 - gamma h D)`, negative if the rod side is fed. Index 3 gets w times
    the softening of the fed chamber by released air.
    """
    divisor, act = 1.0, drives.act
    for i in range(begin, begin + size):
        f = FACTOR_OFFSET + 4 * i
        if scratch[f + 2] == 0.0:
            continue
        head, rod = _chamber_stiffness(
            user, (first + i) * SLOT_COUNT, drives.position[first + i] - dt * drives.velocity[first + i],
            act[4 * i + 2], act[4 * i + 3],
        )  # fmt: skip
        own = gamma_h * scratch[f + 2]
        own *= head * scratch[f] if scratch[4 * i + 3] > 0.0 else rod * scratch[f + 1]
        k = STAGE_OFFSET + 2 * i
        scratch[f + 3] *= scratch[k] if scratch[4 * i + 3] > 0.0 else scratch[k + 1]
        divisor -= scratch[f + 3] * own
        scratch[f + 2] = own if scratch[4 * i + 3] > 0.0 else -own
    for f in range(FACTOR_OFFSET + 4 * begin, FACTOR_OFFSET + 4 * (begin + size), 4):
        scratch[f + 2] /= divisor


@compile_inlined
def _apply_supply_coupling(begin, size, rate, scratch):
    """Correct the stage rates of uncoupled chambers for the coupling through the supply, in place.

    It applies the Sherman-Morrison factors of `_prepare_supply_coupling` to `rate` (4 count,), for
    the `size` axes of a pump from index `begin` on.
    """
    pull = 0.0
    for a in range(4 * begin, 4 * (begin + size), 4):
        f = FACTOR_OFFSET + a
        pull += scratch[f + 3] * rate[a + 2 if scratch[f + 2] > 0.0 else a + 3]
    for a in range(4 * begin, 4 * (begin + size), 4):
        f = FACTOR_OFFSET + a
        if scratch[f + 2] > 0.0:
            rate[a + 2] += scratch[f + 2] * pull
        else:
            rate[a + 3] -= scratch[f + 2] * pull


@compile_without_allocation
def axis_flows_and_force(user, i, supply, act, x, v, bristle_fraction=0.0):
    """Return the flows into both chambers and the force of one axis in a given state.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        i: index of the actuator.
        supply: supply pressure, scalar [Pa].
        act: (4,) spool [1], spool rate [1/s], head-side and rod-side pressure [Pa]. For an axis
            with its own pump the first two are pump speed [rad/s] and load pressure [Pa].
        x: piston displacement, scalar [m].
        v: piston velocity, scalar [m/s] or [rad/s].
        bristle_fraction: fraction of the breakaway force that the bristles carry, scalar [1].

    Returns:
        (q_head, q_rod [m^3/s], force or torque after friction [N] or [N m]). The flows are those of
        the valve or pump, without port relief, piston leakage and terms.

    Source: models/cat215/README.md, "Orifice" and "Force".
    """
    u = i * SLOT_COUNT
    if user[u + _KIND] == _PUMPED:
        taken = pump_drive_volumes(user, u, x)[2]
        q_head, q_rod, _, _ = pump_flows(user, u + PUMP_OFFSET, act[0], act[2], act[3], taken)
        return q_head, q_rod, pump_drive_force(user, u, act[1], act[2], act[3], v, 0.0, 0.0)
    opening = axis_valve_opening(user, u, act[0])
    q_head, q_rod, _, _ = chamber_flows(user, u, opening, supply, act[2], act[3])
    force = user[u + _AH] * act[2] - user[u + _AR] * act[3]
    if user[u + _BRISTLE_STIFFNESS] > 0.0:
        return q_head, q_rod, force - bristle_friction(user, u, bristle_fraction, v, 0.0, 0.0)[0]
    return q_head, q_rod, force - actuator_friction(user, u, v)


def circuit_scratch() -> np.ndarray:
    """Allocate the work space (SCRATCH_SIZE,) of `step_circuit`, filled with zeros."""
    return np.zeros(SCRATCH_SIZE)


_MAX_ITERATIONS = 60  # bisection alone converges to rounding errors in 60 steps
_RELATIVE_TOLERANCE = 1.0e-13


@compile_without_allocation
def implicit_friction(user, u, velocity, other_force, inertia, dt):
    """Return the friction on a body at the end of an implicit time step, without bristles.

    Only the friction F_f of the actuator and the force F act on the body. The function solves
    `v' = v + dt / J (F - F_f(v'))` for the velocity v' at the end by Newton's method in a bracket.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        velocity: v at the start of the step, scalar [m/s] or [rad/s].
        other_force: F, all other force, scalar [N] or [N m].
        inertia: J of the body, scalar [kg] or [kg m^2], > 0.
        dt: time step, scalar [s], > 0.

    Returns:
        F_f(v'), scalar [N] or [N m].

    Source: implicit Euler rule.
    """
    per_force = dt / inertia
    free = velocity + per_force * other_force  # velocity without friction
    low, high = min(0.0, free), max(0.0, free)
    v = free
    for _ in range(_MAX_ITERATIONS):
        resisting = actuator_friction(user, u, v)
        excess = v - free + per_force * resisting
        if excess > 0.0:
            high = v
        else:
            low = v
        if high - low <= _RELATIVE_TOLERANCE * abs(free):
            break
        slope = 1.0 + per_force * actuator_friction_slope(user, u, v)
        guess = v - excess / slope if slope > 0.0 else high
        if slope > 0.0 and abs(guess - v) <= _RELATIVE_TOLERANCE * abs(free):
            break
        v = guess if low < guess < high else 0.5 * (low + high)
    return actuator_friction(user, u, v)


_OFFSET = int(Slot.OFFSET)


@compile_without_allocation
def make_drive_state(user, i, count, act, supply, time, x, v, command, gain):
    """Return the state of one drive, which is the input of the laws of terms.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        i: index of the actuator.
        count: number of hydraulic axes, which come first.
        act: (>= 4 count,) spool [1], spool rate [1/s] and two pressures [Pa] of every hydraulic
            axis.
        supply: supply pressure, scalar [Pa].
        time: scalar [s].
        x: position of the drive, scalar [m] or [rad].
        v: its velocity, scalar [m/s] or [rad/s].
        command: command after its delay, scalar [1] or [V].
        gain: force per unit of command of a force drive, scalar [N/V] or [N m/V]; not used for
            others.

    Returns:
        DriveState [SI]. The force is that before friction; the outputs of a backlash operator are
        0.

    Source: docs/effects.md, "The law".
    """
    u, a = i * SLOT_COUNT, 4 * i
    if i >= count:
        force = gain * command - user[u + _OFFSET]
        return DriveState(time, x, v, 0.0, 0.0, 0.0, 0.0, supply, command, force, 0.0, 0.0)
    force = user[u + _AH] * act[a + 2] - user[u + _AR] * act[a + 3]
    return DriveState(time, x, v, act[a], act[a + 1], act[a + 2], act[a + 3], supply, command, force, 0.0, 0.0)


@compile_without_allocation
def add_command_terms(user, terms, drives, dt, time, scratch, out):
    """Compute the commands of the hydraulic axes plus the terms that add to commands.

    Terms are additional laws of a machine.

    The terms are evaluated with positions and time at the middle of the step, and with spools and
    pressures at its start; their effect on a command is therefore late by half a step.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        terms: (n,) table of terms [SI].
        drives: Drives with the activations at the start of the step, positions at its end and
            velocities over it, and the commands that arrive [SI, commands in 1].
        dt: time step, scalar [s].
        time: time at the start of the step, scalar [s].
        scratch: (SCRATCH_SIZE,) work space.
        out: (>= count,) commands with terms, written [1].

    Returns:
        Nothing.

    Source: docs/effects.md, "The term": terms whose `balance` is `command`.
    """
    count, act, length, velocity, command = drives
    if not has_term(terms, COMMAND, ANY_DRIVE):
        for i in range(count):
            out[i] = command[i]
        return
    solve_state_supplies(user, 0, count, act, scratch)
    middle = time + 0.5 * dt
    for i in range(count):
        x = length[i] - 0.5 * dt * velocity[i]
        s = make_drive_state(user, i, count, act, scratch[FEED + i], middle, x, velocity[i], command[i], 0.0)
        out[i] = command[i] + sum_terms(terms, COMMAND, i, s, drives)

"""Flows through the valve of an axis.

The valve has a dead band and a flow curve per direction, a gain per metering edge, a pressure-
compensated inlet and counterbalance valves (Merritt 1967, `models/cat215/README.md`).
"""

import math

from hydrotele.core.compiled import compile_inlined
from hydrotele.hydraulics.actuator_layout import CURVE_KNOTS, CURVE_SIZE, Slot
from hydrotele.hydraulics.laws import counterbalance_opening, orifice_flow, valve_opening

_DB, _DBN, _K = int(Slot.DEADBAND), int(Slot.DEADBAND_NEGATIVE), int(Slot.FLOW_GAIN)
_PA, _BT = int(Slot.METERING_PA), int(Slot.METERING_BT)
_PB, _AT = int(Slot.METERING_PB), int(Slot.METERING_AT)
_D, _TANK, _DROP = int(Slot.ORIFICE_SMOOTHING), int(Slot.TANK_PRESSURE), int(Slot.COMPENSATED_DROP)
_HEAD, _ROD = int(Slot.HOLDING_HEAD), int(Slot.HOLDING_ROD)
_CURVES, _TANK_LEAK = int(Slot.CURVES), int(Slot.TANK_LEAKAGE)


@compile_inlined
def axis_valve_opening(user, u, spool):
    """Return the signed opening of an axis' valve at a spool position, from dead band and flow curve.

    `o = c(t)` with the travel beyond the dead band `t = (|s| - db) / (1 - db)`. The curve c is
    linear between its knots and is extrapolated beyond the last one. Without a curve `o = t`.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        spool: spool position s, scalar [1].

    Returns:
        Opening o, scalar [1], with the sign of the spool.

    Source: flow characteristic as tabulated by valve manufacturers.
    """
    deadband, c = user[u + _DB], u + _CURVES
    if spool < 0.0:
        deadband, c = user[u + _DBN], c + CURVE_SIZE
    opening = valve_opening(spool, deadband)
    knots = int(user[c])
    if knots == 0 or opening == 0.0:
        return opening
    travel, k = abs(opening), c + 2  # the second knot
    while k < c + knots and user[k] < travel:
        k += 1
    before, after = user[k - 1], user[k]
    low, high = user[k - 1 + CURVE_KNOTS], user[k + CURVE_KNOTS]
    return math.copysign(low + (high - low) * (travel - before) / (after - before), spool)


@compile_inlined
def inlet_gain(user, u, opening):
    """Return the flow gain of the metering edge that feeds a chamber.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        opening: o, signed valve opening, scalar [1].

    Returns:
        Flow per root of the pressure drop of the edge P-A (o > 0) or P-B, scalar
        [m^3/(s sqrt(Pa))].

    Source: models/cat215/README.md, "Orifice".
    """
    edge = user[u + _PA] if opening > 0.0 else user[u + _PB]
    return user[u + _K] * edge * abs(opening)


@compile_inlined
def inlet_flow(drop, gain, smoothing, compensated):
    """Return the flow through an inlet edge, which can be pressure-compensated, and its derivative.

    Args:
        drop: pressure drop, scalar [Pa], > 0.
        gain: flow per root of the pressure drop, scalar [m^3/(s sqrt(Pa))].
        smoothing: pressure drop below which the root law is smoothed, scalar [Pa].
        compensated: largest drop over the edge that the compensator allows, scalar [Pa]; 0 without
            compensator.

    Returns:
        (flow [m^3/s], its derivative by the drop [m^3/(s Pa)] >= 0).

    Source: pressure-compensated flow control, an orifice with a held drop (Merritt 1967).

    >>> inlet_flow(9.0e6, 1.0e-6, 5.0e4, 1.0e6) == inlet_flow(2.0e6, 1.0e-6, 5.0e4, 1.0e6)
    True
    """
    if compensated > 0.0 and drop > compensated:
        return orifice_flow(compensated, gain, smoothing)[0], 0.0
    return orifice_flow(drop, gain, smoothing)


@compile_inlined
def _outlet_flow(user, u, holding, gain, pressure, pilot):
    """Return the flow out of a chamber through the valve's open edge to tank, and its derivative.

    `gain` is the flow gain of the edge [m^3/(s sqrt(Pa))], and `holding` the slot with the setting
    of the chamber's counterbalance valve. `pressure` is that of the chamber and `pilot` that of the
    opposite chamber [Pa].

    Returns:
        (flow [m^3/s], its derivative by the chamber pressure [m^3/(s Pa)]).
    """
    flow, slope = orifice_flow(pressure - user[u + _TANK], gain, user[u + _D])
    return _counterbalanced_flow(user, u, holding, flow, slope, pressure, pilot)


@compile_inlined
def _tank_leakage(user, u, holding, pressure, pilot):
    """Return the leakage from a chamber through the spool's clearance to tank, and its derivative.

    Arguments and result are those of `_outlet_flow`. The counterbalance valve of the chamber
    reduces the leakage.
    """
    leak = user[u + _TANK_LEAK]
    flow = leak * (pressure - user[u + _TANK])
    return _counterbalanced_flow(user, u, holding, flow, leak, pressure, pilot)


@compile_inlined
def _counterbalanced_flow(user, u, holding, flow, slope, pressure, pilot):
    """Return a flow from a chamber to tank, and its derivative, reduced by the counterbalance valve.

    The flow [m^3/s] is multiplied by the valve's relative opening; `slope` is its derivative by the
    chamber pressure [m^3/(s Pa)]. Without a counterbalance valve, or for flow into the chamber,
    both are returned unchanged. The other arguments are those of `_outlet_flow`.
    """
    if user[u + holding] == 0.0 or flow <= 0.0:
        return flow, slope
    share, steep = counterbalance_opening(
        pressure, pilot, user[u + holding], user[u + holding + 1], user[u + holding + 2]
    )
    return share * flow, share * slope + steep * flow


@compile_inlined
def chamber_flows(user, u, opening, p_supply, p_head, p_rod):
    """Return the valve flows into both chambers of an axis, and their pressure derivatives.

    With o > 0 the head side is fed through its load check and the rod side drains to tank; with
    o < 0 vice versa. From each chamber oil leaks to tank through the spool's radial clearance,
    `c_t (p - p_t)` at any opening. A concentric spool of diameter d with clearance c over the
    overlap L has `c_t = pi d c^3 / (12 mu L)`. The overlap is that of the spool at rest, since the
    leakage is negligible for other openings: an open edge to tank passes about a thousand times as
    much, and a closing edge belongs to a chamber that the pump feeds. Leakage from the pump gallery
    into a chamber is not modelled.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        opening: o, signed valve opening, scalar [1].
        p_supply: supply pressure, scalar [Pa].
        p_head: head-side pressure, scalar [Pa].
        p_rod: rod-side pressure, scalar [Pa].

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]).

    Source: models/cat215/README.md, "Orifice"; Merritt 1967, laminar flow through an annular
    clearance.
    """
    q_head, q_rod, slope_head, slope_rod = _edge_flows(user, u, opening, p_supply, p_head, p_rod)
    if user[u + _TANK_LEAK] == 0.0:
        return q_head, q_rod, slope_head, slope_rod
    leak_head, steep_head = _tank_leakage(user, u, _HEAD, p_head, p_rod)
    leak_rod, steep_rod = _tank_leakage(user, u, _ROD, p_rod, p_head)
    return q_head - leak_head, q_rod - leak_rod, slope_head - steep_head, slope_rod - steep_rod


@compile_inlined
def _edge_flows(user, u, opening, p_supply, p_head, p_rod):
    """Return the valve flows into both chambers through the open edges of the spool, without leakage.

    Arguments and result are those of `chamber_flows`.
    """
    if opening == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gain, smoothing, drop = user[u + _K] * abs(opening), user[u + _D], user[u + _DROP]
    q_in, slope_in = 0.0, 0.0
    if opening > 0.0:
        if p_supply > p_head:
            q_in, slope_in = inlet_flow(p_supply - p_head, gain * user[u + _PA], smoothing, drop)
        q_out, slope_out = _outlet_flow(user, u, _ROD, gain * user[u + _BT], p_rod, p_head)
        return q_in, -q_out, -slope_in, -slope_out
    if p_supply > p_rod:
        q_in, slope_in = inlet_flow(p_supply - p_rod, gain * user[u + _PB], smoothing, drop)
    q_out, slope_out = _outlet_flow(user, u, _HEAD, gain * user[u + _AT], p_head, p_rod)
    return -q_out, q_in, -slope_out, -slope_in

"""The valve of one axis, read from its record: spool travel to opening, opening to chamber flows.

The positive direction meters P-A into the head side and B-T out of the rod side, the negative one
P-B into the rod side and A-T out of the head side. Each may have its own dead band and flow curve,
each edge its own gain; the inlet may be pressure-compensated, and a counterbalance valve may hold
the oil of either side.
"""

import math

from hydrotele.core.compiled import inlined
from hydrotele.hydraulics.laws import holding_share, orifice, valve_opening
from hydrotele.hydraulics.parameters import CURVE, CURVE_KNOTS, Slot

_DB, _DBN, _K = int(Slot.DEADBAND), int(Slot.DEADBAND_NEGATIVE), int(Slot.FLOW_GAIN)
_PA, _BT = int(Slot.METERING_PA), int(Slot.METERING_BT)
_PB, _AT = int(Slot.METERING_PB), int(Slot.METERING_AT)
_D, _TANK, _DROP = int(Slot.ORIFICE_SMOOTHING), int(Slot.TANK_PRESSURE), int(Slot.COMPENSATED_DROP)
_HEAD, _ROD = int(Slot.HOLDING_HEAD), int(Slot.HOLDING_ROD)
_CURVES = int(Slot.CURVES)


@inlined
def axis_opening(user, u, spool):
    """Opening of an axis' valve: dead band and flow curve of the direction of travel.

    `o = c(t)` with the travel beyond the dead band `t = (|s| - db) / (1 - db)` and the curve c
    linear between its knots; beyond the last knot its last piece goes on. Without a curve `o = t`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        spool: spool position s, scalar [1].

    Returns:
        Opening o, scalar [1], with the sign of the spool.

    Source: flow characteristic as valve makers tabulate it.
    """
    deadband, c = user[u + _DB], u + _CURVES
    if spool < 0.0:
        deadband, c = user[u + _DBN], c + CURVE
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


@inlined
def inlet_gain(user, u, opening):
    """Flow gain of the edge that feeds a chamber.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        opening: o, scalar [1].

    Returns:
        k of P-A (o > 0) or P-B, scalar [m^3/(s sqrt(Pa))].

    Source: nominal model, "Orifice".
    """
    edge = user[u + _PA] if opening > 0.0 else user[u + _PB]
    return user[u + _K] * edge * abs(opening)


@inlined
def inlet_flow(drop, gain, smoothing, compensated):
    """Flow through an inlet edge and its slope; a compensator takes up the drop beyond its setting.

    Args:
        drop: pressure drop, scalar [Pa], > 0.
        gain: k, scalar [m^3/(s sqrt(Pa))].
        smoothing: d, scalar [Pa].
        compensated: drop over the edge that the compensator holds, scalar [Pa]; 0 without one.

    Returns:
        (q [m^3/s], dq/d(drop) [m^3/(s Pa)] >= 0).

    Source: pressure-compensated flow control, an orifice with a held drop (Merritt 1967).

    >>> inlet_flow(9.0e6, 1.0e-6, 5.0e4, 1.0e6) == inlet_flow(2.0e6, 1.0e-6, 5.0e4, 1.0e6)
    True
    """
    if compensated > 0.0 and drop > compensated:
        return orifice(compensated, gain, smoothing)[0], 0.0
    return orifice(drop, gain, smoothing)


@inlined
def _outlet_flow(user, u, holding, gain, pressure, pilot):
    """Flow out of a chamber to tank, throttled by its counterbalance valve, and its slope."""
    flow, slope = orifice(pressure - user[u + _TANK], gain, user[u + _D])
    if user[u + holding] == 0.0 or flow <= 0.0:
        return flow, slope
    share, steep = holding_share(
        pressure, pilot, user[u + holding], user[u + holding + 1], user[u + holding + 2]
    )
    return share * flow, share * slope + steep * flow


@inlined
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

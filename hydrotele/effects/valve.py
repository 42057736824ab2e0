"""Effects of valves: deadband, flow gain, bandwidth, flow curve, metering edges and slew limit.

Deadband and flow gain may differ between the two directions, because notches, springs and centring
differ. A progressive flow curve opens little over the first travel and much over the last. The slew
limit is the largest speed at which the pilot stage moves the spool.
"""

import numpy as np

from hydrotele.effects.effect import Effect, Parameter, Values, valve_axes, with_value
from hydrotele.machine.drives import FlowCurve, Metering, Valve
from hydrotele.machine.machine import Machine


def _get_axis_valve(machine: Machine, location: str) -> Valve:
    valve = machine.axes[location].valve
    assert valve
    return valve


def _common_deadband_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the valve axes with at least one direction that has no separate deadband.

    The common deadband of the valve has an effect only in such a direction.
    """
    return tuple(
        name for name in valve_axes(machine)
        if any(way.deadband is None
               for way in (_get_axis_valve(machine, name).positive, _get_axis_valve(machine, name).negative))
    )  # fmt: skip


def _deadband_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of a valve's deadband, common to both directions.

    The deadband is the fraction of the spool's stroke without flow, a few per cent. The smallest
    relevant change is 0.4 %, the typical hysteresis of a spool.
    """
    present = _get_axis_valve(machine, location).deadband
    return {"deadband": Parameter("1", present, 0.0, max(0.3, present), 0.03, 0.004)}


def _set_deadband(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, f"axes.{location}.valve.deadband", values["deadband"])


def _gain_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (1), bounds and prior of the ratio of true to given flow gain of a valve.

    A manufacturer's flow rating is accurate to 5 or 10 %. The smallest relevant change is 2 %, the
    linearity of a spool. The bounds include a different spool in the same body.
    """
    return {"ratio": Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02)}


def _scale_gain(machine: Machine, location: str, values: Values) -> Machine:
    flow = _get_axis_valve(machine, location).rated_flow * values["ratio"]
    return with_value(machine, f"axes.{location}.valve.rated_flow", flow)


def _bandwidth_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the bandwidth of a valve's spool.

    The smallest relevant change is 8 %. For a bandwidth of 8 Hz it changes the lag of the spool by 3 ms,
    the smallest relevant change of a delay.
    """
    w = _get_axis_valve(machine, location).bandwidth
    return {"bandwidth": Parameter("rad/s", w, 0.1 * w, 4.0 * w, 0.4 * w, 0.08 * w)}


def _set_bandwidth(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, f"axes.{location}.valve.bandwidth", values["bandwidth"])


COMMON_VALVE_EFFECTS = (
    Effect(
        "valve_deadband",
        "valve overlap that differs from the model",
        "valve",
        _common_deadband_axes,
        _deadband_parameters,
        _set_deadband,
        "overlap",
    ),
    Effect(
        "valve_gain",
        "valve flow gain that differs from the model",
        "valve",
        valve_axes,
        _gain_parameters,
        _scale_gain,
        "flow gain",
    ),
    Effect(
        "spool_lag",
        "spool bandwidth that differs from the model",
        "valve",
        valve_axes,
        _bandwidth_parameters,
        _set_bandwidth,
    ),
)


DIRECTIONS = ("positive", "negative")


def _direction_gain_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (1), bounds and prior of the ratio of true to given flow gain per direction.

    The directions are `positive` and `negative`. The bounds are 0.05 and 5, the prior standard
    deviation is 0.15, and the smallest relevant change 0.02, as for a ratio that is common to both
    directions.
    """
    return dict.fromkeys(DIRECTIONS, Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02))


def _scale_direction_gains(machine: Machine, location: str, values: Values) -> Machine:
    for direction in DIRECTIONS:
        present = getattr(_get_axis_valve(machine, location), direction)
        for edge in ("inlet", "outlet"):
            path = f"axes.{location}.valve.{direction}.{edge}"
            machine = with_value(machine, path, getattr(present, edge) * values[direction])
    return machine


def _direction_deadband_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of a valve's deadband for each direction, `positive` and `negative`.

    The upper bound is 0.6 instead of the 0.3 of a common deadband, because a spool may rest off its
    centre.
    """
    present = _get_axis_valve(machine, location).deadbands
    return {
        direction: Parameter("1", band, 0.0, max(0.6, band), 0.03, 0.004)
        for direction, band in zip(DIRECTIONS, present, strict=True)
    }


def _set_direction_deadbands(machine: Machine, location: str, values: Values) -> Machine:
    present = _get_axis_valve(machine, location).deadbands
    for direction, band in zip(DIRECTIONS, present, strict=True):
        if values[direction] != band:
            path = f"axes.{location}.valve.{direction}.deadband"
            machine = with_value(machine, path, values[direction])
    return machine


DIRECTION_EFFECTS = (
    Effect(
        "valve_gain_direction", "valve flow gains that differ between the directions", "valve",
        valve_axes, _direction_gain_parameters, _scale_direction_gains, "flow gain",
    ),
    Effect(
        "valve_deadband_direction", "valve overlaps that differ between the directions", "valve",
        valve_axes, _direction_deadband_parameters, _set_direction_deadbands, "overlap",
    ),
)  # fmt: skip


_CURVE_KNOTS = tuple(float(t) for t in np.linspace(0.0, 1.0, 8))


def _flow_curve_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (0), bounds and prior of the flow curve's progression for each direction.

    A positive value reduces the opening at small travel compared with a linear valve: with 0.3 the
    opening at half travel is 42 %. Spools for fine control reach 0.6; the smallest relevant value is
    0.04, as caused by notches (estimates).
    """
    return dict.fromkeys(DIRECTIONS, Parameter("1", 0.0, -0.9, 0.9, 0.3, 0.04))


def _set_flow_curve(machine: Machine, location: str, values: Values) -> Machine:
    valve = machine.axes[location].valve
    assert valve
    for direction in DIRECTIONS:
        if values[direction] != 0.0:
            curve = bend_flow_curve(getattr(valve, direction), values[direction])
            machine = with_value(machine, f"axes.{location}.valve.{direction}.curve", curve)
    return machine


def bend_flow_curve(present: Metering, progression: float) -> FlowCurve:
    """Return a valve's flow curve (opening over spool travel) for one direction, with added progression.

    The opening is multiplied by 1 - c + c t, where t is the travel from 0 to 1 and c the
    progression. The full opening does not change.

    Args:
        present: metering of the direction; its opening is linear if it has no curve.
        progression: c, from -1 (steep at first) to 1 (flat at first) [1].

    Returns:
        The curve at the knots of the given one, otherwise at eight knots.
    """
    old = present.curve or FlowCurve(travel=_CURVE_KNOTS, opening=_CURVE_KNOTS)
    pairs = zip(old.travel, old.opening, strict=True)
    opening = tuple(o * (1.0 - progression + progression * t) for t, o in pairs)
    return FlowCurve(travel=old.travel, opening=opening)


FLOW_CURVE = Effect(
    "flow_curve", "a nonlinear valve opening over the travel", "valve", valve_axes, _flow_curve_parameters,
    _set_flow_curve
)  # fmt: skip


EDGE_FIELDS = {
    "p_a": "positive.inlet", "b_t": "positive.outlet", "p_b": "negative.inlet",
    "a_t": "negative.outlet",
}  # fmt: skip
"""Metering edge -> field of the valve that holds its gain."""


def _metering_edge_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the relative gain of each metering edge of a valve.

    The edges connect pump P, tank T and the work ports A and B: `p_a`, `b_t`, `p_b`, `a_t`. A gain
    of 1 corresponds to the valve's rated flow. In spools for single-rod cylinders the gains differ
    by tens of per cent. The smallest relevant change is 0.03, as caused by a notch (estimates).
    """
    valve = machine.axes[location].valve
    assert valve
    present = {
        "p_a": valve.positive.inlet, "b_t": valve.positive.outlet, "p_b": valve.negative.inlet,
        "a_t": valve.negative.outlet,
    }  # fmt: skip
    return {
        edge: Parameter("1", ratio, min(0.05, ratio), max(5.0, ratio), 0.3, 0.03) for edge, ratio in present.items()
    }


def _set_metering_edges(machine: Machine, location: str, values: Values) -> Machine:
    for edge, field in EDGE_FIELDS.items():
        machine = with_value(machine, f"axes.{location}.valve.{field}", values[edge])
    return machine


METERING_EDGES = Effect(
    "metering_edges", "areas of a valve's metering edges (P-A, B-T, P-B, A-T) that differ from the"
    " model", "valve", valve_axes, _metering_edge_parameters, _set_metering_edges,
)  # fmt: skip


def _travel_time_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of `travel_time`, in which the spool opens fully at its largest speed.

    It is the reciprocal of the valve's slew limit; 0 means no speed limit. With the bandwidth w of
    the spool [rad/s] and no limit, the spool moves by at most 0.38 w of its travel per second in a
    full step (damping ratio 0.9). A limit has an effect only if it is lower than this speed, that is, for
    a travel time above 1 / (0.38 w) = 2.6 / w. Prior and bounds are estimates.
    """
    valve = machine.axes[location].valve
    assert valve
    own = 1.0 / valve.bandwidth
    present = 1.0 / valve.slew_limit if valve.slew_limit else 0.0
    return {
        "travel_time": Parameter(
            "s", present, 0.0, max(200.0 * own, present), 8.0 * own, 4.0 * own,
            start_values=(8.0 * own, 40.0 * own),
        )
    }  # fmt: skip


def _set_slew_limit(machine: Machine, location: str, values: Values) -> Machine:
    limit = 1.0 / values["travel_time"] if values["travel_time"] > 0.0 else None
    valve = machine.axes[location].valve
    assert valve
    if valve.slew_limit and limit and abs(limit / valve.slew_limit - 1.0) < 1.0e-15:
        return machine  # the reciprocal of a reciprocal may differ by rounding
    return with_value(machine, f"axes.{location}.valve.slew_limit", limit)


SPOOL_SLEW = Effect(
    "spool_slew", "a spool speed that is limited by the pilot stage", "valve", valve_axes,
    _travel_time_parameters, _set_slew_limit,
)  # fmt: skip

EFFECTS = (*COMMON_VALVE_EFFECTS, *DIRECTION_EFFECTS, FLOW_CURVE, METERING_EDGES, SPOOL_SLEW)

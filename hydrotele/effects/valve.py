"""Valves that open later, wider or slower than in the model.

Valves whose two directions differ: notches, springs and centring are not made alike.

Valves that open progressively: little over the first travel, much over the last.

Valves whose four edges have areas of their own.

Spools that a small pilot stage moves no faster than at a limited rate.
"""

import numpy as np

from hydrotele.effects.effect import Effect, Parameter, Values, changed, valves
from hydrotele.machine.drives import FlowCurve, Metering, Valve
from hydrotele.machine.machine import Machine


def _valve(machine: Machine, location: str) -> Valve:
    valve = machine.axes[location].valve
    assert valve
    return valve


def _common_deadband(machine: Machine) -> tuple[str, ...]:
    """Valves that have a dead band for both directions, or for one of them."""
    return tuple(
        name for name in valves(machine)
        if any(way.deadband is None
               for way in (_valve(machine, name).positive, _valve(machine, name).negative))
    )  # fmt: skip


def _deadband(machine: Machine, location: str) -> dict[str, Parameter]:
    """Overlaps are a few per cent of the stroke; 0.4 % is a spool's usual hysteresis."""
    present = _valve(machine, location).deadband
    return {"deadband": Parameter("1", present, 0.0, max(0.3, present), 0.03, 0.004)}


def _set_deadband(machine: Machine, location: str, values: Values) -> Machine:
    return changed(machine, f"axes.{location}.valve.deadband", values["deadband"])


def _gain(machine: Machine, location: str) -> dict[str, Parameter]:
    """A makers' flow rating is good to 5 or 10 %; 2 % is the linearity of a spool.

    The range is that of another spool in the same body.
    """
    return {"ratio": Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02)}


def _scale_gain(machine: Machine, location: str, values: Values) -> Machine:
    flow = _valve(machine, location).rated_flow * values["ratio"]
    return changed(machine, f"axes.{location}.valve.rated_flow", flow)


def _bandwidth(machine: Machine, location: str) -> dict[str, Parameter]:
    """Least is 8 %, which at 8 Hz is a lag of 3 ms, as the least delay worth naming."""
    w = _valve(machine, location).bandwidth
    return {"bandwidth": Parameter("rad/s", w, 0.1 * w, 4.0 * w, 0.4 * w, 0.08 * w)}


def _set_bandwidth(machine: Machine, location: str, values: Values) -> Machine:
    return changed(machine, f"axes.{location}.valve.bandwidth", values["bandwidth"])


VALVE = (
    Effect(
        "valve_deadband",
        "another overlap of a valve",
        "valve",
        _common_deadband,
        _deadband,
        _set_deadband,
        "overlap",
    ),
    Effect(
        "valve_gain",
        "another flow gain of a valve",
        "valve",
        valves,
        _gain,
        _scale_gain,
        "flow gain",
    ),
    Effect(
        "spool_lag", "another bandwidth of a spool", "valve", valves, _bandwidth, _set_bandwidth
    ),
)


DIRECTIONS = ("positive", "negative")


def _gains(machine: Machine, location: str) -> dict[str, Parameter]:
    """As the flow gain of a whole valve: rated to 5 or 10 %, linear to 2 %."""
    return dict.fromkeys(DIRECTIONS, Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02))


def _scale_gains(machine: Machine, location: str, values: Values) -> Machine:
    for direction in DIRECTIONS:
        present = getattr(_valve(machine, location), direction)
        for edge in ("inlet", "outlet"):
            path = f"axes.{location}.valve.{direction}.{edge}"
            machine = changed(machine, path, getattr(present, edge) * values[direction])
    return machine


def _deadbands(machine: Machine, location: str) -> dict[str, Parameter]:
    """As the overlap of a whole valve, with room for a spool off its centre."""
    present = _valve(machine, location).deadbands
    return {
        direction: Parameter("1", band, 0.0, max(0.6, band), 0.03, 0.004)
        for direction, band in zip(DIRECTIONS, present, strict=True)
    }


def _set_deadbands(machine: Machine, location: str, values: Values) -> Machine:
    present = _valve(machine, location).deadbands
    for direction, band in zip(DIRECTIONS, present, strict=True):
        if values[direction] != band:
            path = f"axes.{location}.valve.{direction}.deadband"
            machine = changed(machine, path, values[direction])
    return machine


BY_DIRECTION = (
    Effect(
        "valve_gain_direction", "flow gains of a valve that differ between its directions", "valve",
        valves, _gains, _scale_gains, "flow gain",
    ),
    Effect(
        "valve_deadband_direction", "overlaps of a valve that differ between its directions",
        "valve", valves, _deadbands, _set_deadbands, "overlap",
    ),
)  # fmt: skip


_KNOTS = tuple(float(t) for t in np.linspace(0.0, 1.0, 8))
_DIRECTIONS = ("positive", "negative")


def _progression(machine: Machine, location: str) -> dict[str, Parameter]:
    """0.3 opens to 42 % at half travel; estimates: fine control comes to 0.6, notches to 4 %."""
    return dict.fromkeys(_DIRECTIONS, Parameter("1", 0.0, -0.9, 0.9, 0.3, 0.04))


def _bend(machine: Machine, location: str, values: Values) -> Machine:
    valve = machine.axes[location].valve
    assert valve
    for direction in _DIRECTIONS:
        if values[direction] != 0.0:
            curve = bent(getattr(valve, direction), values[direction])
            machine = changed(machine, f"axes.{location}.valve.{direction}.curve", curve)
    return machine


def bent(present: Metering, progression: float) -> FlowCurve:
    """A direction's curve times `1 - c + c t`, which leaves the full opening what it is.

    Args:
        present: the direction; straight without a curve.
        progression: c, from -1 (steep at first) to 1 (flat at first) [1].

    Returns:
        The curve, at the knots of the present one, or at eight.
    """
    old = present.curve or FlowCurve(travel=_KNOTS, opening=_KNOTS)
    pairs = zip(old.travel, old.opening, strict=True)
    opening = tuple(o * (1.0 - progression + progression * t) for t, o in pairs)
    return FlowCurve(travel=old.travel, opening=opening)


FLOW_CURVE = Effect(
    "flow_curve", "a valve that opens progressively over its travel, or early", "valve", valves,
    _progression, _bend,
)  # fmt: skip


EDGES = {
    "p_a": "positive.inlet", "b_t": "positive.outlet", "p_b": "negative.inlet",
    "a_t": "negative.outlet",
}  # fmt: skip
"""Edge -> its gain in the valve's facts."""


def _edges(machine: Machine, location: str) -> dict[str, Parameter]:
    """Estimates: spools for unequal cylinders differ by tens of per cent; 3 % is a notch's cut."""
    valve = machine.axes[location].valve
    assert valve
    present = {
        "p_a": valve.positive.inlet, "b_t": valve.positive.outlet, "p_b": valve.negative.inlet,
        "a_t": valve.negative.outlet,
    }  # fmt: skip
    return {
        edge: Parameter("1", ratio, min(0.05, ratio), max(5.0, ratio), 0.3, 0.03)
        for edge, ratio in present.items()
    }


def _set_edges(machine: Machine, location: str, values: Values) -> Machine:
    for edge, field in EDGES.items():
        machine = changed(machine, f"axes.{location}.valve.{field}", values[edge])
    return machine


METERING_EDGES = Effect(
    "metering_edges", "metering edges of a valve (P-A, B-T, P-B, A-T) with other areas", "valve",
    valves, _edges, _set_edges,
)  # fmt: skip


def _travel_time(machine: Machine, location: str) -> dict[str, Parameter]:
    """Time from centre to full opening, in units of the spool's own 1 / w; 0 without a limit.

    A step to full opening moves a free spool of damping 0.9 at most at 0.38 w, so that a limit is
    felt from a travel time of 2.6 / w on; the sizes are estimates, 3 times that and more.
    """
    valve = machine.axes[location].valve
    assert valve
    own = 1.0 / valve.bandwidth
    present = 1.0 / valve.slew_limit if valve.slew_limit else 0.0
    return {
        "travel_time": Parameter(
            "s", present, 0.0, max(200.0 * own, present), 8.0 * own, 4.0 * own,
            starts=(8.0 * own, 40.0 * own),
        )
    }  # fmt: skip


def _set(machine: Machine, location: str, values: Values) -> Machine:
    limit = 1.0 / values["travel_time"] if values["travel_time"] > 0.0 else None
    valve = machine.axes[location].valve
    assert valve
    if valve.slew_limit and limit and abs(limit / valve.slew_limit - 1.0) < 1.0e-15:
        return machine  # the reciprocal of a reciprocal may be off by a rounding
    return changed(machine, f"axes.{location}.valve.slew_limit", limit)


SPOOL_SLEW = Effect(
    "spool_slew", "a spool that moves no faster than its pilot stage lets it", "valve", valves,
    _travel_time, _set,
)  # fmt: skip

EFFECTS = (*VALVE, *BY_DIRECTION, FLOW_CURVE, METERING_EDGES, SPOOL_SLEW)

"""Valves whose four edges have areas of their own."""

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine

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


EFFECT = Effect(
    "metering_edges", "metering edges of a valve (P-A, B-T, P-B, A-T) with other areas", "valve",
    valves, _edges, _set_edges,
)  # fmt: skip

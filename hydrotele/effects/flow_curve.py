"""Valves that open progressively: little over the first travel, much over the last."""

import numpy as np

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.drives import FlowCurve, Metering
from hydrotele.machine.machine import Machine

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


EFFECT = Effect(
    "flow_curve", "a valve that opens progressively over its travel, or early", "valve", valves,
    _progression, _bend,
)  # fmt: skip

"""Pressure compensators: inlets whose flow does not follow the load."""

import math

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine

_USUAL_DROP = 0.5  # of the relief pressure: there a valve flows with a compensator as without one


def _drop(machine: Machine, location: str) -> float:
    """Pressure drop that the inlet edge can have [Pa]."""
    valve = machine.axes[location].valve
    assert valve and machine.supply
    most = machine.supply.relief_pressure
    return min(valve.held_drop, most) if valve.held_drop else most


def _regulation(machine: Machine, location: str) -> dict[str, Parameter]:
    """Part of the relief pressure that a compensator takes up: 90 to 98 % (estimate).

    Least is the tenth that only an empty arm at full supply pressure would feel.
    """
    assert machine.supply
    present = 1.0 - _drop(machine, location) / machine.supply.relief_pressure
    return {"regulation": Parameter("1", present, 0.0, max(0.98, present), 0.4, 0.1,
                                    starts=(0.6, 0.95))}  # fmt: skip


def _compensate(machine: Machine, location: str, values: Values) -> Machine:
    """Limit the drop, and open the inlets so far that the usual flow stays what it was."""
    valve, supply = machine.axes[location].valve, machine.supply
    assert valve and supply
    before = _drop(machine, location)
    if values["regulation"] == 1.0 - before / supply.relief_pressure:
        return machine
    drop = (1.0 - values["regulation"]) * supply.relief_pressure
    usual = _USUAL_DROP * supply.relief_pressure
    wider = math.sqrt(min(before, usual) / min(drop, usual))
    where = f"axes.{location}.valve"
    machine = changed(machine, f"{where}.compensation", "pressure")
    machine = changed(machine, f"{where}.compensated_drop", drop)
    for direction in ("positive", "negative"):
        inlet = getattr(valve, direction).inlet * wider
        machine = changed(machine, f"{where}.{direction}.inlet", inlet)
    return machine


EFFECT = Effect(
    "load_compensation", "a pressure compensator that keeps the load out of a valve's flow",
    "valve", valves, _regulation, _compensate,
)  # fmt: skip

"""Pressure compensators: inlets whose flow does not follow the load.

Counterbalance valves that hold a load and throttle its lowering.
"""

import math

from hydrotele.effects.effect import Effect, Parameter, Values, changed, valves
from hydrotele.machine.drives import Counterbalance
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


LOAD_COMPENSATION = Effect(
    "load_compensation", "a pressure compensator that keeps the load out of a valve's flow",
    "valve", valves, _regulation, _compensate,
)  # fmt: skip


def _sides(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in machine.valve_axes for side in ("head", "rod"))


def _present(machine: Machine, location: str) -> Counterbalance | None:
    axis, _, side = location.partition(".")
    return getattr(machine.axes[axis].load_holding, side)


def _setting(machine: Machine, location: str) -> dict[str, Parameter]:
    """Set to 1.3 times the load's pressure, up to the port relief; 0 without a valve.

    Least is what a tank line at 0.5 MPa with the usual pilot ratio opens by itself.
    """
    assert machine.supply
    relief = machine.supply.relief_pressure
    valve = _present(machine, location)
    setting = valve.setting if valve else 0.0
    return {"setting": Parameter("Pa", setting, 0.0, max(1.5 * relief, setting), 0.4 * relief,
                                 0.07 * relief, starts=(0.4 * relief, relief))}  # fmt: skip


def _set(machine: Machine, location: str, values: Values) -> Machine:
    axis, _, side = location.partition(".")
    setting = values["setting"]
    valve = _present(machine, location) or Counterbalance(setting=max(setting, 1.0))
    held = valve.model_copy(update={"setting": setting}) if setting > 0.0 else None
    return changed(machine, f"axes.{axis}.load_holding.{side}", held)


LOAD_HOLDING = Effect(
    "load_holding", "a counterbalance valve at a chamber", "valve", _sides, _setting, _set
)

EFFECTS = (LOAD_COMPENSATION, LOAD_HOLDING)

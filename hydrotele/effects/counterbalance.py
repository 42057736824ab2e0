"""Effects of additional valves: pressure compensators and counterbalance valves.

A pressure compensator makes the inlet flow independent of the load. A counterbalance valve holds a
load and throttles its lowering.
"""

import math

from hydrotele.effects.effect import Effect, Parameter, Values, valve_axes, with_value
from hydrotele.machine.drives import Counterbalance
from hydrotele.machine.machine import Machine

_TYPICAL_DROP_RATIO = 0.5  # of the relief pressure: drop at which a compensator does not change the flow


def _max_inlet_drop(machine: Machine, location: str) -> float:
    """Return the largest pressure drop from pump to drive across a valve's spool [Pa].

    With a pressure compensator it is the drop that the compensator holds, otherwise the relief pressure.
    """
    valve = machine.axes[location].valve
    assert valve and machine.supply
    most = machine.supply.relief_pressure
    return min(valve.compensator_pressure_drop, most) if valve.compensator_pressure_drop else most


def _compensator_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of `regulation`, which describes a pressure compensator.

    It is 1 minus the largest pressure drop across the inlet edge of the spool over the relief
    pressure; 0 means no compensator. Usual are 0.9 to 0.98 (estimate). The smallest relevant change
    is 0.1. A compensator with 0.1 limits the drop to 90 % of the relief pressure, and larger drops occur
    only at low load and full supply pressure.
    """
    assert machine.supply
    present = 1.0 - _max_inlet_drop(machine, location) / machine.supply.relief_pressure
    return {"regulation": Parameter("1", present, 0.0, max(0.98, present), 0.4, 0.1,
                                    start_values=(0.6, 0.95))}  # fmt: skip


def _set_pressure_compensator(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a pressure compensator in a valve.

    The pressure drop across the inlet edge is limited to (1 - `regulation`) times the relief
    pressure. The gains of the inlet edges are changed so that the flow does not change if half the
    relief pressure is available as pressure drop. With the present `regulation`, the machine is
    returned unchanged.
    """
    valve, supply = machine.axes[location].valve, machine.supply
    assert valve and supply
    before = _max_inlet_drop(machine, location)
    if values["regulation"] == 1.0 - before / supply.relief_pressure:
        return machine
    drop = (1.0 - values["regulation"]) * supply.relief_pressure
    usual = _TYPICAL_DROP_RATIO * supply.relief_pressure
    wider = math.sqrt(min(before, usual) / min(drop, usual))
    where = f"axes.{location}.valve"
    machine = with_value(machine, f"{where}.compensation", "pressure")
    machine = with_value(machine, f"{where}.compensated_drop", drop)
    for direction in ("positive", "negative"):
        inlet = getattr(valve, direction).inlet * wider
        machine = with_value(machine, f"{where}.{direction}.inlet", inlet)
    return machine


LOAD_COMPENSATION = Effect(
    "load_compensation", "a pressure compensator that makes a valve's flow independent of the load",
    "valve", valve_axes, _compensator_parameters, _set_pressure_compensator,
)  # fmt: skip


def _chamber_locations(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in machine.valve_axes for side in ("head", "rod"))


def _installed_valve(machine: Machine, location: str) -> Counterbalance | None:
    axis, _, side = location.partition(".")
    return getattr(machine.axes[axis].load_holding, side)


def _counterbalance_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of a counterbalance valve's setting; 0 means no valve.

    The setting is the pressure of the chamber at which the valve opens without pilot pressure.
    Usually it is 1.3 times the load pressure. Bounds and prior are fractions of the supply's relief
    pressure; the smallest relevant change is 7 % of it.
    """
    assert machine.supply
    relief = machine.supply.relief_pressure
    valve = _installed_valve(machine, location)
    setting = valve.setting if valve else 0.0
    return {"setting": Parameter("Pa", setting, 0.0, max(1.5 * relief, setting), 0.4 * relief,
                                 0.07 * relief, start_values=(0.4 * relief, relief))}  # fmt: skip


def _set_counterbalance(machine: Machine, location: str, values: Values) -> Machine:
    axis, _, side = location.partition(".")
    setting = values["setting"]
    valve = _installed_valve(machine, location) or Counterbalance(setting=max(setting, 1.0))
    held = valve.model_copy(update={"setting": setting}) if setting > 0.0 else None
    return with_value(machine, f"axes.{axis}.load_holding.{side}", held)


LOAD_HOLDING = Effect(
    "load_holding",
    "a counterbalance valve at a chamber",
    "valve",
    _chamber_locations,
    _counterbalance_parameters,
    _set_counterbalance,
)

EFFECTS = (LOAD_COMPENSATION, LOAD_HOLDING)

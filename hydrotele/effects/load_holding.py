"""Counterbalance valves that hold a load and throttle its lowering."""

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.drives import Counterbalance
from hydrotele.machine.machine import Machine


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


EFFECT = Effect(
    "load_holding", "a counterbalance valve at a chamber", "valve", _sides, _setting, _set
)

"""A pump or a main relief valve with other limits than in the model."""

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine import Machine


def _place(machine: Machine) -> tuple[str, ...]:
    return ("supply",) if machine.supply and machine.hydraulic_axes else ()


def _pump(machine: Machine, location: str) -> dict[str, Parameter]:
    """Engine speed and wear take tens of per cent; 2 % is the droop of an engine's governor."""
    assert machine.supply
    q = machine.supply.pump_flow
    return {"pump_flow": Parameter("m^3/s", q, 0.1 * q, 2.5 * q, 0.15 * q, 0.02 * q)}


def _relief(machine: Machine, location: str) -> dict[str, Parameter]:
    """Set by hand to a few per cent; 0.3 % is a gauge's finest mark."""
    assert machine.supply
    p = machine.supply.relief_pressure
    low = max(0.3 * p, 1.5 * machine.supply.tank_pressure)
    return {"relief_pressure": Parameter("Pa", p, min(low, p), 1.4 * p, 0.08 * p, 0.003 * p)}


def _set(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        machine = changed(machine, f"supply.{field}", value)
    return machine


EFFECTS = (
    Effect("pump_flow_limit", "another flow of the pump", "supply", _place, _pump, _set),
    Effect(
        "relief_pressure", "another setting of the main relief valve", "supply", _place, _relief,
        _set,
    ),
)  # fmt: skip

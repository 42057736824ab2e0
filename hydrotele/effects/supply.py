"""A pump or a main relief valve with other limits, droop or response than in the model."""

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine


def _place(machine: Machine) -> tuple[str, ...]:
    return ("supply",) if machine.supply and machine.valve_axes else ()


def _pumping(machine: Machine) -> tuple[str, ...]:
    """Where a pump limits the flow: not on a constant-pressure supply."""
    supply = machine.supply
    return _place(machine) if supply and supply.kind != "constant_pressure" else ()


def _pump(machine: Machine, location: str) -> dict[str, Parameter]:
    """Engine speed and wear take tens of per cent; 2 % is the droop of an engine's governor."""
    assert machine.supply
    q = machine.supply.pump_flow
    return {"pump_flow": Parameter("m^3/s", q, 0.1 * q, 2.5 * q, 0.15 * q, 0.02 * q)}


def _droop(machine: Machine, location: str) -> dict[str, Parameter]:
    """Leakage and an engine's governor take 5 % at full pressure; 1 % is what a new pump loses."""
    assert machine.supply
    whole = machine.supply.pump_flow / machine.supply.relief_pressure
    present = machine.supply.pump_droop
    high = max(0.6 * whole, present)
    return {"droop": Parameter("m^3/(s Pa)", present, 0.0, high, 0.05 * whole, 0.01 * whole)}


def _set_droop(machine: Machine, location: str, values: Values) -> Machine:
    return changed(machine, "supply.pump_droop", values["droop"])


def _lag(machine: Machine, location: str) -> dict[str, Parameter]:
    """Swash plates take 50 to 300 ms; least is what a fast one takes, 20 ms."""
    assert machine.supply
    present = machine.supply.time_constant
    high = max(1.0, present)
    return {"time_constant": Parameter("s", present, 0.0, high, 0.1, 0.02, starts=(0.05, 0.2))}


def _relief(machine: Machine, location: str) -> dict[str, Parameter]:
    """Set by hand to a few per cent; 0.3 % is a gauge's finest mark.

    From opening to all of the pump's flow the pressure rises by some 10 %; 1 % is a piloted valve.
    """
    supply = machine.supply
    assert supply
    p, present = supply.relief_pressure, supply.relief_override
    low = max(0.3 * p, 1.5 * supply.tank_pressure)
    found = {"relief_pressure": Parameter("Pa", p, min(low, p), 1.4 * p, 0.08 * p, 0.003 * p)}
    if supply.kind == "constant_flow":
        usual = 0.1 * p / supply.pump_flow
        found["relief_override"] = Parameter(
            "Pa s/m^3", present, 0.0, max(5.0 * usual, present), usual, 0.1 * usual, optional=True
        )
    return found


def _set(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        machine = changed(machine, f"supply.{field}", value)
    return machine


EFFECTS = (
    Effect("pump_flow_limit", "another flow of the pump", "supply", _pumping, _pump, _set),
    Effect(
        "pump_droop", "a pump whose flow falls with its pressure", "supply", _pumping, _droop,
        _set_droop,
    ),
    Effect(
        "pump_lag", "a pump whose flow follows what is drawn after a time", "supply", _pumping,
        _lag, _set,
    ),
    Effect(
        "relief_pressure", "another setting of the main relief valve", "supply", _place, _relief,
        _set,
    ),
)  # fmt: skip

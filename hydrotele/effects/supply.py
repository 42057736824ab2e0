"""Effects of the supply: pump flow, droop and lag, and setting of the main relief valve."""

from hydrotele.effects.effect import Effect, Parameter, Values, with_value
from hydrotele.machine.machine import Machine


def _supply_effect_locations(machine: Machine) -> tuple[str, ...]:
    return ("supply",) if machine.supply and machine.valve_axes else ()


def _limited_flow_locations(machine: Machine) -> tuple[str, ...]:
    """Return ("supply",) as the only location, or () for a machine whose supply does not limit the flow.

    A supply of constant pressure has no such limit. The result is also () without supply or valve
    axes.
    """
    supply = machine.supply
    return _supply_effect_locations(machine) if supply and supply.kind != "constant_pressure" else ()


def _pump_flow_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the largest flow of the supply pump.

    Engine speed and wear change it by tens of per cent. The smallest relevant change is 2 %, by which
    an engine governor lets the speed fall under load.
    """
    assert machine.supply
    q = machine.supply.pump_flow
    return {"pump_flow": Parameter("m^3/s", q, 0.1 * q, 2.5 * q, 0.15 * q, 0.02 * q)}


def _droop_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the decrease of pump flow per pressure.

    Leakage and engine governor typically reduce the flow by 5 % at full pressure. The smallest relevant
    decrease is 1 %, that of a new pump.
    """
    assert machine.supply
    whole = machine.supply.pump_flow / machine.supply.relief_pressure
    present = machine.supply.pump_droop
    high = max(0.6 * whole, present)
    return {"droop": Parameter("m^3/(s Pa)", present, 0.0, high, 0.05 * whole, 0.01 * whole)}


def _set_droop(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, "supply.pump_droop", values["droop"])


def _pump_lag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the first-order time constant of the pump flow.

    The swash plate of a pump responds in 50 to 300 ms. The smallest relevant change is 20 ms, the time
    constant of a fast one.
    """
    assert machine.supply
    present = machine.supply.time_constant
    high = max(1.0, present)
    return {"time_constant": Parameter("s", present, 0.0, high, 0.1, 0.02, start_values=(0.05, 0.2))}


def _relief_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of pressure and override of the main relief valve.

    The override is the pressure rise per flow through the open valve; only a pump of constant flow has
    it as a parameter. The smallest relevant change of the pressure is 0.3 %, the finest mark of a gauge.
    The pressure typically rises by 10 % up to full pump flow; the smallest relevant rise is 1 %.
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


def _set_supply(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        machine = with_value(machine, f"supply.{field}", value)
    return machine


EFFECTS = (
    Effect(
        "pump_flow_limit", "pump flow that differs from the model", "supply", _limited_flow_locations,
        _pump_flow_parameters, _set_supply
    ),
    Effect(
        "pump_droop", "pump flow that decreases with pressure", "supply", _limited_flow_locations, _droop_parameters,
        _set_droop,
    ),
    Effect(
        "pump_lag", "pump flow that follows the demand with a lag", "supply", _limited_flow_locations,
        _pump_lag_parameters,         _set_supply
    ),
    Effect(
        "relief_pressure", "setting of the main relief valve that differs from the model", "supply",
        _supply_effect_locations, _relief_parameters, _set_supply,
    ),
)  # fmt: skip

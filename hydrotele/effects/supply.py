"""Effects of the supplies: pump flow, droop and lag, setting of the main relief valve, merging valve.

The location is `supply`, or `supply.<pump>` of a machine with several pumps. That of a merging valve
is the axis that shifts it.
"""

from hydrotele.effects.effect import Effect, Parameter, Values, with_value
from hydrotele.machine.machine import Machine, Supply


def _supply_effect_locations(machine: Machine) -> tuple[str, ...]:
    return tuple(_location_of_pump(name) for name in machine.pumps) if machine.valve_axes else ()


def _location_of_pump(name: str) -> str:
    return name if name == "supply" else f"supply.{name}"


def _pump_at(machine: Machine, location: str) -> Supply:
    """Return the pump at a location of these effects."""
    return machine.pumps[location.removeprefix("supply.")]


def _with_pump_value(machine: Machine, location: str, field: str, value: float) -> Machine:
    """Return the machine with one value of the pump at a location replaced."""
    section = location if location == "supply" else f"supplies.{location.removeprefix('supply.')}"
    return with_value(machine, f"{section}.{field}", value)


def _limited_flow_locations(machine: Machine) -> tuple[str, ...]:
    """Return the locations of the pumps that limit the flow, which a supply of constant pressure does not."""
    return tuple(
        place for place in _supply_effect_locations(machine) if _pump_at(machine, place).kind != "constant_pressure"
    )


def _pump_flow_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the largest flow of the supply pump.

    Engine speed and wear change it by tens of per cent. The smallest relevant change is 2 %, by which
    an engine governor lets the speed fall under load.
    """
    q = _pump_at(machine, location).pump_flow
    return {"pump_flow": Parameter("m^3/s", q, 0.1 * q, 2.5 * q, 0.15 * q, 0.02 * q)}


def _droop_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the decrease of pump flow per pressure.

    Leakage and engine governor typically reduce the flow by 5 % at full pressure. The smallest relevant
    decrease is 1 %, that of a new pump.
    """
    pump = _pump_at(machine, location)
    whole, present = pump.pump_flow / pump.relief_pressure, pump.pump_droop
    high = max(0.6 * whole, present)
    return {"droop": Parameter("m^3/(s Pa)", present, 0.0, high, 0.05 * whole, 0.01 * whole)}


def _set_droop(machine: Machine, location: str, values: Values) -> Machine:
    return _with_pump_value(machine, location, "pump_droop", values["droop"])


def _pump_lag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the first-order time constant of the pump flow.

    The swash plate of a pump responds in 50 to 300 ms. The smallest relevant change is 20 ms, the time
    constant of a fast one.
    """
    present = _pump_at(machine, location).time_constant
    high = max(1.0, present)
    return {"time_constant": Parameter("s", present, 0.0, high, 0.1, 0.02, start_values=(0.05, 0.2))}


def _relief_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of pressure and override of the main relief valve.

    The smallest relevant change of the pressure is 0.3 %, the finest mark of a gauge. The override is the
    pressure rise per flow through the open valve. It is a parameter only if the pump has constant flow.
    Typically it raises the pressure by 10 % at full pump flow; the smallest relevant rise is 1 %.
    """
    supply = _pump_at(machine, location)
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
        machine = _with_pump_value(machine, location, field, value)
    return machine


def _merging_locations(machine: Machine) -> tuple[str, ...]:
    return tuple(machine.merging)


def _merging_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the scale of a merging valve's share.

    A valve that is stuck shut moves nothing (0); dirt and a weak pilot signal let it open in part.
    The smallest relevant change is 5 %, which changes the sum of two equal flows by 2.5 %.
    """
    present = machine.merging[location].share_scale
    return {"scale": Parameter("1", present, 0.0, max(1.5, present), 0.3, 0.05)}


def _set_merging_share(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, f"merging.{location}.share_scale", values["scale"])


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
    Effect(
        "merging_valve", "merging valve that moves more or less flow than in the model", "supply",
        _merging_locations, _merging_parameters, _set_merging_share,
    ),
)  # fmt: skip

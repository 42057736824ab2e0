"""Effects of the pressure chambers of drives: leakage, and compliance of hoses and oil.

Laminar leakage is proportional to the pressure difference. Turbulent leakage, proportional to its
square root, is the flow through a short gap, as of a torn seal or a cracked piston.
"""

import math

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    drive_kind,
    hydraulic_axes,
    term_parameter,
    valve_axes,
    with_terms,
    with_value,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

_MIN_BULK_MODULUS_PA = 1.0e7  # Pa, oil full of air: the smallest bulk modulus that a machine file may state


def _internal_leakage_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the leakage coefficient between a drive's chambers.

    Bounds and prior are fractions of the rated flow divided by the highest pressure. The smallest
    relevant change is 0.5 %; a good seal leaks about 1 % of the rated flow at full pressure.
    """
    whole = machine.axes[location].rated_flow / machine.max_feed_pressure(location)
    present = machine.axes[location].hydraulic_drive.leakage
    high = present + 0.5 * whole
    return {"leakage": Parameter("m^3/(s Pa)", present, 0.0, high, 0.05 * whole, 0.005 * whole)}


def _tank_leakage_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of a spool's leakage coefficient from work port to tank.

    Bounds and prior are fractions of the rated flow divided by the highest pressure. The smallest
    relevant change is 0.05 %, the leakage of a 25 mm spool with a radial clearance of 12 um.
    """
    valve = machine.axes[location].valve
    assert valve
    whole = valve.rated_flow / machine.max_feed_pressure(location)
    present = valve.tank_leakage
    high = present + 0.1 * whole
    return {"leakage": Parameter("m^3/(s Pa)", present, 0.0, high, 5e-3 * whole, 5e-4 * whole)}


def _set_tank_leakage(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, f"axes.{location}.valve.tank_leakage", values["leakage"])


def _hose_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the volume that a hose gains per pressure.

    Bounds and prior are proportional to the compliance of the oil (volume over bulk modulus) in the
    head chamber at mid-stroke. The smallest relevant change is 5 % of that compliance, the scatter
    of a hose's rating.
    """
    drive, cylinder = machine.axes[location].hydraulic_drive, machine.axes[location].cylinder
    assert machine.supply
    middle = 0.5 * cylinder.stroke if cylinder else 0.0
    volume = drive.dead_volume + drive.effective_areas[0] * middle
    oil = volume / machine.supply.bulk_modulus
    present = drive.hose_compliance
    return {"compliance": Parameter("m^3/Pa", present, 0.0, present + 3 * oil, 0.3 * oil,
                                    0.05 * oil)}  # fmt: skip


def _make_drive_field_setter(field: str, parameter: str):
    def set_drive_field(machine: Machine, location: str, values: Values) -> Machine:
        path = f"axes.{location}.{drive_kind(machine, location)}.{field}"
        return with_value(machine, path, values[parameter])

    return set_drive_field


def _oil_effect_locations(machine: Machine) -> tuple[str, ...]:
    return ("all",) if machine.supply and machine.valve_axes else ()


def _bulk_modulus_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the bulk modulus of the oil.

    Entrained air reduces the bulk modulus by tens of per cent. The smallest relevant change is 5 %.
    """
    assert machine.supply
    present = machine.supply.bulk_modulus
    low = max(_MIN_BULK_MODULUS_PA, 0.1 * present)
    return {"bulk_modulus": Parameter("Pa", present, low, 2.5 * present, 0.25 * present,
                                      0.05 * present)}  # fmt: skip


def _set_bulk_modulus(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, "supply.bulk_modulus", values["bulk_modulus"])


def _entrained_air_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the volume fraction of air in the oil.

    The oil of a working machine contains 0.5 to 5 %. The smallest relevant fraction is 0.2 %; so
    little air is hardly measurable at pressures above 2 MPa.
    """
    assert machine.supply
    present = machine.supply.entrained_air
    high = max(0.15, present)
    return {"fraction": Parameter("1", present, 0.0, high, 0.02, 0.002)}


def _set_entrained_air(machine: Machine, location: str, values: Values) -> Machine:
    return with_value(machine, "supply.entrained_air", values["fraction"])


CHAMBER_EFFECTS = (
    Effect(
        "internal_leakage", "leakage between a drive's chambers that differs from the model",
        "flow", hydraulic_axes, _internal_leakage_parameters, _make_drive_field_setter("leakage", "leakage"), "leakage",
    ),
    Effect(
        "tank_leakage",
        "spool leakage from both work ports to tank that differs from the model",
        "flow", valve_axes, _tank_leakage_parameters, _set_tank_leakage, "leakage",
    ),
    Effect(
        "hose_compliance", "expansion of the hoses with pressure", "flow", valve_axes, _hose_parameters,
        _make_drive_field_setter("hose_compliance", "compliance"),
    ),
    Effect(
        "bulk_modulus", "bulk modulus of the oil that differs from the model", "flow", _oil_effect_locations,
        _bulk_modulus_parameters, _set_bulk_modulus, "oil compliance",
    ),
    Effect(
        "entrained_air", "air in the oil, which makes it compliant at low pressure", "flow",
        _oil_effect_locations, _entrained_air_parameters, _set_entrained_air, "oil compliance",
    ),
)  # fmt: skip


NAME = "orifice_leakage"


def _sqrt_relief_pressure(machine: Machine) -> float:
    """Return the square root of the supply's relief pressure [sqrt(Pa)].

    The turbulent leakage flow is a gain times the square root of the pressure difference. The
    parameter of the effect is the flow at relief pressure, which is the gain times the returned
    value.
    """
    assert machine.supply
    return math.sqrt(machine.supply.relief_pressure)


def _orifice_leakage_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the turbulent leakage flow at the relief pressure.

    The upper bound is 50 % of the valve's rated flow above the nominal value, the prior standard
    deviation 5 % of the rated flow, and the smallest relevant change 0.5 %. These are the fractions
    used for laminar leakage.
    """
    valve = machine.axes[location].valve
    assert valve
    gain = term_parameter(machine, NAME, location, "flow_rod", "flow_gain", 0.0)
    present, rated = gain * _sqrt_relief_pressure(machine), valve.rated_flow
    high = present + 0.5 * rated
    return {"flow": Parameter("m^3/s", present, 0.0, high, 0.05 * rated, 0.005 * rated)}


def _set_orifice_leakage(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with turbulent leakage between the head and the rod chamber of a drive.

    A `flow` of 0 removes the leakage.
    """
    valve, gain = machine.axes[location].valve, values["flow"] / _sqrt_relief_pressure(machine)
    assert valve
    numbers = {"smoothing": valve.smoothing}
    terms = [
        Term(name=NAME, axis=location, balance="flow_rod", law="orifice_leakage",
             parameters={"flow_gain": gain, **numbers}),
        Term(name=NAME, axis=location, balance="flow_head", law="orifice_leakage",
             parameters={"flow_gain": -gain, **numbers}),
    ]  # fmt: skip
    return with_terms(machine, NAME, terms if gain else [], [location])


ORIFICE_LEAKAGE = Effect(
    NAME, "turbulent leakage between the chambers of a drive", "flow", valve_axes, _orifice_leakage_parameters,
    _set_orifice_leakage,
    "leakage",
)  # fmt: skip

EFFECTS = (*CHAMBER_EFFECTS, ORIFICE_LEAKAGE)

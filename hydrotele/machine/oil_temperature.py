"""Friction and leakage of a machine at another oil temperature."""

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.machine.oil import MAX_TEMPERATURE, MIN_TEMPERATURE, kinematic_viscosity


def with_oil_temperature(machine: Machine, temperature: float) -> Machine:
    """Return the machine with its oil at a temperature [degC].

    Viscous friction of hydraulic drives is proportional to the viscosity, laminar leakage inversely
    proportional. The difference in density (1.4 % per 20 K) is neglected.

    Raises:
        InputError: the machine file has no `oil`, or the temperature is out of range.
    """
    if machine.oil is None:
        message = "has no oil: add `oil: {temperature: 40}`, the temperature at which its friction holds [degC]"
        raise InputError(f"machine {machine.name}", message)
    if not MIN_TEMPERATURE <= temperature <= MAX_TEMPERATURE:
        message = f"{temperature:g} degC is outside {MIN_TEMPERATURE:g} .. {MAX_TEMPERATURE:g} degC"
        raise InputError("oil temperature", message)
    ratio = kinematic_viscosity(machine.oil, temperature) / kinematic_viscosity(machine.oil, machine.oil.temperature)
    for name, axis in machine.hydraulic_axes.items():
        drive = axis.hydraulic_drive
        part = f"axes.{name}.{'cylinder' if axis.cylinder else 'motor'}"
        machine = machine.replace(f"{part}.friction.viscous", ratio * drive.friction.viscous, validate=False)
        machine = machine.replace(f"{part}.leakage", drive.leakage / ratio, validate=False)
    return machine.replace("oil.temperature", temperature)

"""Effects of drives with an own pump: pump, motor, lines, accumulator and load cylinder.

Most effects change one parameter, so that a search for wrong parameters can name it. Bounds and
priors of catalogue parameters are fractions of their values. For losses that catalogues omit, they are
fractions of the motor's stall torque or the pump's rated flow. A load cylinder resists the
extension of a drive, because its oil leaves through a relief valve.
"""

from hydrotele.effects.effect import Effect, Parameter, Values, with_value
from hydrotele.machine.machine import Machine

_SIDES = ("head", "rod")


def _pump_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drive has its own pump instead of a valve."""
    return tuple(name for name, axis in machine.axes.items() if axis.pump)


def _pump_motor_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose own pump has an electric motor in the model."""
    return tuple(n for n in _pump_axes(machine) if (p := machine.axes[n].pump) and p.motor)


def _axes_with_load_relief_valve(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes that push against a load cylinder with a relief valve."""
    return tuple(n for n in machine.loads if machine.loads[n].relief_pressure > 0.0)


def _get_axis_pump(machine: Machine, axis: str):
    pump = machine.axes[axis].pump
    assert pump
    return pump


def _get_pump_motor(machine: Machine, axis: str):
    motor = _get_axis_pump(machine, axis).motor
    assert motor
    return motor


def _proportional_parameter(unit: str, present: float, scale: float, least: float, widest: float) -> Parameter:
    """Return a positive parameter whose bounds and prior are proportional to its nominal value.

    Args:
        unit: SI unit.
        present: nominal value [unit].
        scale: standard deviation of the prior over the nominal value [1].
        least: smallest relevant change over the nominal value [1].
        widest: upper bound over the nominal value, and nominal value over the lower bound [1].
    """
    sizes = present / widest, present * widest, scale * present, least * present
    return Parameter(unit, present, *sizes)


def _displacement_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the displacement of an axis pump.

    Gear pumps of one size differ by some per cent. The smallest relevant change is 1 %, which a flow
    meter resolves.
    """
    present = _get_axis_pump(machine, location).displacement
    return {"displacement": _proportional_parameter("m^3/rad", present, 0.1, 0.01, 3.0)}


def _pump_leakage_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the leakage coefficient of an axis pump.

    Bounds and prior are fractions of the rated flow divided by the highest pressure. A change of 10 %
    of that ratio is typical, and 1 % is the smallest relevant one.
    """
    pump = _get_axis_pump(machine, location)
    whole = pump.rated_flow / machine.max_feed_pressure(location)
    high = pump.leakage + 0.5 * whole
    numbers = "m^3/(s Pa)", pump.leakage, 0.0, high, 0.1 * whole, 0.01 * whole
    return {"leakage": Parameter(*numbers)}


def _torque_loss_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the torque loss of an axis pump, relative to its torque.

    Small gear pumps lose 10 to 60 % of their torque. The smallest relevant change is 3 % of the torque,
    as caused by warm oil.
    """
    present = _get_axis_pump(machine, location).torque_loss
    return {"torque_loss": Parameter("1", present, 0.0, max(2.0, present), 0.2, 0.03)}


def _motor_constant_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the torque constant of a pump motor.

    The constant of equal motors differs by 10 %. The smallest relevant change is 2 %, as caused by heating.
    """
    present = _get_pump_motor(machine, location).torque_constant
    return {"torque_constant": _proportional_parameter("V s/rad", present, 0.1, 0.02, 5.0)}


def _motor_inertia_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the inertia of a pump motor together with its pump.

    The inertia is usually known to tens of per cent; the prior standard deviation is 30 %, the
    smallest relevant change 5 %. The bounds, a thirtieth and thirty times the given value, include
    a wrong unit.
    """
    present = _get_pump_motor(machine, location).inertia
    return {"inertia": _proportional_parameter("kg m^2", present, 0.3, 0.05, 30.0)}


def _stall_torque(machine: Machine, location: str) -> float:
    motor = _get_pump_motor(machine, location)
    return motor.torque_constant * motor.voltage / motor.resistance


def _motor_drag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of `drag` (dry friction torque) and `breakaway` torque of a pump motor.

    Both include the friction of the pump. Bounds and priors are fractions of the motor's stall
    torque. Brushes and seals typically cause 5 % of that torque; the smallest relevant change
    is 1 %.
    """
    motor, whole = _get_pump_motor(machine, location), _stall_torque(machine, location)
    return {
        name: Parameter("N m", present, 0.0, present + 0.5 * whole, 0.05 * whole, 0.01 * whole)
        for name, present in (("drag", motor.drag), ("breakaway", motor.breakaway))
    }


def _viscous_drag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the coefficient of viscous drag of motor and pump.

    Let b_0 be the motor's stall torque over the pump's rated speed. The upper bound is the nominal value
    plus 0.5 b_0, the prior standard deviation 0.05 b_0, and the smallest relevant change 0.01 b_0.
    """
    present = _get_pump_motor(machine, location).viscous
    whole = _stall_torque(machine, location) / _get_axis_pump(machine, location).rated_speed
    sizes = 0.0, present + 0.5 * whole, 0.05 * whole, 0.01 * whole
    return {"viscous": Parameter("N m s/rad", present, *sizes)}


def _line_locations(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in _pump_axes(machine) for side in _SIDES)


def _line_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of compliance and air volume of a hose between pump and drive.

    Bounds and priors are proportional to compliance and volume of the oil in the connected chamber
    at mid-stroke. A hose is typically several times more compliant than its oil. The air volume is
    stated at atmospheric pressure. A few per cent of the oil volume are typical; the prior standard
    deviation is 5 %.
    """
    axis, _, side = location.partition(".")
    drive, pump = machine.axes[axis].cylinder, _get_axis_pump(machine, axis)
    assert drive
    volume = drive.dead_volume + 0.5 * drive.stroke * drive.effective_areas[_SIDES.index(side)]
    oil = volume / pump.bulk_modulus
    walls, air = getattr(pump, f"compliance_{side}"), getattr(pump, f"air_{side}")
    return {
        "compliance": Parameter("m^3/Pa", walls, 0.0, walls + 50 * oil, 5 * oil, oil),
        "air": Parameter("m^3", air, 0.0, air + volume, 0.05 * volume, 0.01 * volume),
    }


def _set_lines(machine: Machine, location: str, values: Values) -> Machine:
    axis, _, side = location.partition(".")
    for name, value in values.items():
        machine = with_value(machine, f"axes.{axis}.pump.{name}_{side}", value)
    return machine


def _accumulator_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the charge pressure of the accumulator of an axis' own pump.

    The pressure is set manually with an error of tens of per cent. The smallest relevant change is
    2 %, the finest mark of a gauge.
    """
    present = _get_axis_pump(machine, location).accumulator.pressure
    return {"pressure": _proportional_parameter("Pa", present, 0.2, 0.02, 5.0)}


def _load_relief_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the relief pressure of a load cylinder.

    The pressure is set manually with an error of tens of per cent. The smallest relevant change is
    2 %, the finest mark of a gauge.
    """
    present = machine.loads[location].relief_pressure
    return {"relief_pressure": Parameter("Pa", present, 0.0, 3.0 * present, 0.2 * present,
                                         0.02 * present)}  # fmt: skip


def _load_friction_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the seal friction of a load cylinder.

    The friction is a fraction of the load cylinder's force. Seals cause up to some tens of per
    cent. The smallest relevant change is 0.02.
    """
    present = machine.loads[location].friction
    return {"friction": Parameter("1", present, 0.0, max(1.0, present), 0.1, 0.02)}


def _make_parameter_setter(part: str):
    def set_parameters(machine: Machine, location: str, values: Values) -> Machine:
        for name, value in values.items():
            machine = with_value(machine, part.format(location) + "." + name, value)
        return machine

    return set_parameters


_set_pump, _set_motor = _make_parameter_setter("axes.{}.pump"), _make_parameter_setter("axes.{}.pump.motor")
_set_accumulator, _set_load = _make_parameter_setter("axes.{}.pump.accumulator"), _make_parameter_setter("loads.{}")
EFFECTS = (
    Effect("pump_displacement", "displacement of an axis pump that differs from the model", "flow",
           _pump_axes, _displacement_parameters, _set_pump),
    Effect("pump_leakage", "leakage of an axis pump that differs from the model", "flow", _pump_axes,
           _pump_leakage_parameters, _set_pump),
    Effect("pump_torque_loss", "torque loss of an axis pump that differs from the model", "flow",
           _pump_motor_axes, _torque_loss_parameters, _set_pump),
    Effect("motor_constant", "torque constant of a pump motor that differs from the model", "flow",
           _pump_motor_axes, _motor_constant_parameters, _set_motor),
    Effect("motor_inertia", "inertia of pump and motor that differs from the model", "flow",
           _pump_motor_axes, _motor_inertia_parameters, _set_motor),
    Effect("motor_drag", "dry drag of pump and motor that differs from the model", "flow", _pump_motor_axes,
           _motor_drag_parameters, _set_motor),
    Effect("motor_viscous_drag", "viscous drag of pump and motor that differs from the model",
           "flow", _pump_motor_axes, _viscous_drag_parameters, _set_motor),
    Effect("line_compliance", "compliance of, or air in, the lines between pump and cylinder",
           "flow", _line_locations, _line_parameters, _set_lines),
    Effect("accumulator_pressure", "accumulator charge pressure that differs from the model",
           "flow", _pump_axes, _accumulator_parameters, _set_accumulator),
    Effect("load_relief", "relief pressure of a load cylinder that differs from the model", "force",
           _axes_with_load_relief_valve, _load_relief_parameters, _set_load),
    Effect("load_friction", "packing friction of a load cylinder that differs from the model",
           "force", _axes_with_load_relief_valve, _load_friction_parameters, _set_load),
)  # fmt: skip

"""A pump of an axis' own, its motor, its lines and its load with other numbers than in the model.

Each is one number, so that whoever states it wrongly is told which one. Numbers of a catalogue are
sized relative to themselves; losses that a catalogue leaves out, relative to what the motor can do.
"""

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine

_SIDES = ("head", "rod")


def _pumped(machine: Machine) -> tuple[str, ...]:
    """Axes with a pump of their own."""
    return tuple(name for name, axis in machine.axes.items() if axis.pump)


def _motored(machine: Machine) -> tuple[str, ...]:
    """Axes whose pump has a motor."""
    return tuple(n for n in _pumped(machine) if (p := machine.axes[n].pump) and p.motor)


def _loaded(machine: Machine) -> tuple[str, ...]:
    """Axes against which a load cylinder with a relief valve pushes."""
    return tuple(n for n in machine.loads if machine.loads[n].relief_pressure > 0.0)


def _pump(machine: Machine, axis: str):
    pump = machine.axes[axis].pump
    assert pump
    return pump


def _motor(machine: Machine, axis: str):
    motor = _pump(machine, axis).motor
    assert motor
    return motor


def _ratio_of(unit: str, present: float, scale: float, least: float, widest: float) -> Parameter:
    """A positive number of a catalogue: from 1/widest to widest times what it says."""
    sizes = present / widest, present * widest, scale * present, least * present
    return Parameter(unit, present, *sizes)


def _displacement(machine: Machine, location: str) -> dict[str, Parameter]:
    """Gear pumps of one size scatter by some per cent; 1 % is what a flow meter sees."""
    present = _pump(machine, location).displacement
    return {"displacement": _ratio_of("m^3/rad", present, 0.1, 0.01, 3.0)}


def _leakage(machine: Machine, location: str) -> dict[str, Parameter]:
    """Of what makes the rated flow leak at the highest pressure: 10 % are usual, 1 % is seen."""
    pump = _pump(machine, location)
    whole = pump.rated_flow / machine.highest_pressure(location)
    high = pump.leakage + 0.5 * whole
    numbers = "m^3/(s Pa)", pump.leakage, 0.0, high, 0.1 * whole, 0.01 * whole
    return {"leakage": Parameter(*numbers)}


def _torque_loss(machine: Machine, location: str) -> dict[str, Parameter]:
    """Small gear pumps lose 10 to 60 % of their torque; 3 % is what warm oil changes."""
    present = _pump(machine, location).torque_loss
    return {"torque_loss": Parameter("1", present, 0.0, max(2.0, present), 0.2, 0.03)}


def _emf(machine: Machine, location: str) -> dict[str, Parameter]:
    """Magnets and windings scatter by 10 %; 2 % is what heat takes."""
    present = _motor(machine, location).emf
    return {"emf": _ratio_of("V s/rad", present, 0.1, 0.02, 5.0)}


def _inertia(machine: Machine, location: str) -> dict[str, Parameter]:
    """Known to tens of per cent, and to powers of ten where a unit was mistaken."""
    present = _motor(machine, location).inertia
    return {"inertia": _ratio_of("kg m^2", present, 0.3, 0.05, 30.0)}


def _stall_torque(machine: Machine, location: str) -> float:
    motor = _motor(machine, location)
    return motor.emf * motor.voltage / motor.resistance


def _drag(machine: Machine, location: str) -> dict[str, Parameter]:
    """Fractions of the torque at stall: brushes and seals take 5 %; 1 % is worth naming."""
    motor, whole = _motor(machine, location), _stall_torque(machine, location)
    return {
        name: Parameter("N m", present, 0.0, present + 0.5 * whole, 0.05 * whole, 0.01 * whole)
        for name, present in (("drag", motor.drag), ("breakaway", motor.breakaway))
    }


def _viscous_drag(machine: Machine, location: str) -> dict[str, Parameter]:
    """Fractions of the torque at stall, at the rated speed; as of dry drag."""
    present = _motor(machine, location).viscous
    whole = _stall_torque(machine, location) / _pump(machine, location).rated_speed
    sizes = 0.0, present + 0.5 * whole, 0.05 * whole, 0.01 * whole
    return {"viscous": Parameter("N m s/rad", present, *sizes)}


def _lines(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in _pumped(machine) for side in _SIDES)


def _softness(machine: Machine, location: str) -> dict[str, Parameter]:
    """Relative to the oil in the middle of the stroke: hoses give some times as much as their oil.

    Air counts at the atmosphere's pressure; a few per cent of the volume are usual.
    """
    axis, _, side = location.partition(".")
    drive, pump = machine.axes[axis].cylinder, _pump(machine, axis)
    assert drive
    volume = drive.dead_volume + 0.5 * drive.stroke * drive.areas[_SIDES.index(side)]
    oil = volume / pump.bulk_modulus
    walls, air = getattr(pump, f"compliance_{side}"), getattr(pump, f"air_{side}")
    return {
        "compliance": Parameter("m^3/Pa", walls, 0.0, walls + 50 * oil, 5 * oil, oil),
        "air": Parameter("m^3", air, 0.0, air + volume, 0.05 * volume, 0.01 * volume),
    }


def _set_lines(machine: Machine, location: str, values: Values) -> Machine:
    axis, _, side = location.partition(".")
    for name, value in values.items():
        machine = changed(machine, f"axes.{axis}.pump.{name}_{side}", value)
    return machine


def _accumulator(machine: Machine, location: str) -> dict[str, Parameter]:
    """Filled by hand to tens of per cent; 2 % is a gauge's finest mark."""
    present = _pump(machine, location).accumulator.pressure
    return {"pressure": _ratio_of("Pa", present, 0.2, 0.02, 5.0)}


def _load_relief(machine: Machine, location: str) -> dict[str, Parameter]:
    """Set by hand to tens of per cent of a low setting; 2 % is a gauge's finest mark."""
    present = machine.loads[location].relief_pressure
    return {"relief_pressure": Parameter("Pa", present, 0.0, 3.0 * present, 0.2 * present,
                                         0.02 * present)}  # fmt: skip


def _load_friction(machine: Machine, location: str) -> dict[str, Parameter]:
    """Of the load's force: packings take up to some tens of per cent; 2 % is worth naming."""
    present = machine.loads[location].friction
    return {"friction": Parameter("1", present, 0.0, max(1.0, present), 0.1, 0.02)}


def _set(part: str):
    def apply(machine: Machine, location: str, values: Values) -> Machine:
        for name, value in values.items():
            machine = changed(machine, part.format(location) + "." + name, value)
        return machine

    return apply


_PUMP, _MOTOR = _set("axes.{}.pump"), _set("axes.{}.pump.motor")
_GAS, _LOAD = _set("axes.{}.pump.accumulator"), _set("loads.{}")
EFFECTS = (
    Effect("pump_displacement", "another displacement of an axis' own pump", "flow", _pumped,
           _displacement, _PUMP),
    Effect("pump_leakage", "another leakage of an axis' own pump", "flow", _pumped, _leakage,
           _PUMP),
    Effect("pump_torque_loss", "another loss of torque in an axis' own pump", "flow", _motored,
           _torque_loss, _PUMP),
    Effect("motor_constant", "another torque per current of a pump's motor", "flow", _motored,
           _emf, _MOTOR),
    Effect("motor_inertia", "another inertia of a pump and its motor", "flow", _motored, _inertia,
           _MOTOR),
    Effect("motor_drag", "another dry drag of a pump and its motor", "flow", _motored, _drag,
           _MOTOR),
    Effect("motor_viscous_drag", "another drag of a pump and its motor that grows with the speed",
           "flow", _motored, _viscous_drag, _MOTOR),
    Effect("line_compliance", "lines between a pump and its cylinder that give more, or hold air",
           "flow", _lines, _softness, _set_lines),
    Effect("accumulator_pressure", "another filling of a pump drive's accumulator", "flow",
           _pumped, _accumulator, _GAS),
    Effect("load_relief", "another relief pressure of a load cylinder", "force", _loaded,
           _load_relief, _LOAD),
    Effect("load_friction", "another friction of a load cylinder's packings", "force", _loaded,
           _load_friction, _LOAD),
)  # fmt: skip

"""Sensors that read with an offset, another scale, or late."""

import math

from hydrotele.effects._sizes import axes, cylinders, valves
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine import Machine
from hydrotele.sensors import SensorError

_PERFECT = SensorError()
_SIDES = ("head", "rod")


def _position(machine: Machine, axis: str) -> str:
    return f"{machine.position_kind(axis)}.{axis}"


def _error(machine: Machine, channel: str) -> SensorError:
    return machine.sensor_errors.get(channel, _PERFECT)


def _with(machine: Machine, channel: str, **numbers: float) -> Machine:
    error = _error(machine, channel).model_copy(update=numbers)
    errors = {name: e for name, e in machine.sensor_errors.items() if name != channel}
    if error != _PERFECT:
        errors[channel] = error
    return machine.model_copy(update={"sensor_errors": errors})


def _angle_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """A resolver is mounted to half a degree or worse and read to a twentieth; a slide alike."""
    present = _error(machine, _position(machine, location)).offset
    if machine.position_kind(location) == "angle":
        unit, one = "rad", math.radians(1.0)
        sizes = present - 5 * one, present + 5 * one, 0.5 * one, 0.05 * one
    else:
        low, high = machine.joints[machine.axes[location].joint].range or (-0.5, 0.5)
        unit, span = "m", high - low
        sizes = present - 0.1 * span, present + 0.1 * span, 0.01 * span, 0.001 * span
    return {"offset": Parameter(unit, present, *sizes)}


def _set_angle(field: str, parameter: str):
    def apply(machine: Machine, location: str, values: Values) -> Machine:
        return _with(machine, _position(machine, location), **{field: values[parameter]})

    return apply


def _angle_scale(machine: Machine, location: str) -> dict[str, Parameter]:
    """A wrong gear or reference voltage; 0.3 % over a radian is a resolver's linearity."""
    present = _error(machine, _position(machine, location)).scale
    low, high = min(0.8, present), max(1.2, present)
    return {"ratio": Parameter("1", present, low, high, 0.02, 0.003)}


def _late(present: float) -> dict[str, Parameter]:
    """Filters and buses take some 10 ms; 3 ms is one bus cycle."""
    high = max(0.3, present)
    return {"delay": Parameter("s", present, 0.0, high, 0.02, 0.003, starts=(0.02, 0.06))}


def _angle_delay(machine: Machine, location: str) -> dict[str, Parameter]:
    return _late(_error(machine, _position(machine, location)).delay)


def _length_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """Fractions of the stroke: mounted to a centimetre, worth naming from a millimetre on."""
    cylinder = machine.axes[location].cylinder
    assert cylinder
    present, stroke = _error(machine, f"length.{location}").offset, cylinder.stroke
    low, high = present - 0.1 * stroke, present + 0.1 * stroke
    return {"offset": Parameter("m", present, low, high, 0.01 * stroke, 0.001 * stroke)}


def _set_length(machine: Machine, location: str, values: Values) -> Machine:
    return _with(machine, f"length.{location}", offset=values["offset"])


def _ports(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in machine.hydraulic_axes for side in _SIDES)


def _transducer(location: str) -> str:
    axis, _, side = location.rpartition(".")
    return f"pressure_{side}.{axis}"


def _pressure_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """Zero drift: a transducer's class is 0.5 % of its span, its repeatability under 0.1 %."""
    assert machine.supply
    present = _error(machine, _transducer(location)).offset
    span = machine.supply.relief_pressure
    low, high = present - 0.05 * span, present + 0.05 * span
    return {"offset": Parameter("Pa", present, low, high, 0.005 * span, 20.0e3 / 28.0e6 * span)}


def _set_pressure(machine: Machine, location: str, values: Values) -> Machine:
    return _with(machine, _transducer(location), offset=values["offset"])


def _pressure_delay(machine: Machine, location: str) -> dict[str, Parameter]:
    return _late(min(_error(machine, f"pressure_{side}.{location}").delay for side in _SIDES))


def _set_pressure_delay(machine: Machine, location: str, values: Values) -> Machine:
    """Both transducers of an axis; the faster one gets the delay, the other shifts as much."""
    delays = {s: _error(machine, f"pressure_{s}.{location}").delay for s in _SIDES}
    more = values["delay"] - min(delays.values())
    for side, delay in delays.items():
        machine = _with(machine, f"pressure_{side}.{location}", delay=max(0.0, delay + more))
    return machine


EFFECTS = (
    Effect(
        "angle_offset", "a position sensor that is mounted askew", "sensor", axes, _angle_offset,
        _set_angle("offset", "offset"),
    ),
    Effect(
        "angle_scale", "a position sensor with another scale", "sensor", axes, _angle_scale,
        _set_angle("scale", "ratio"),
    ),
    Effect(
        "angle_delay", "a position sensor that reads late", "sensor", axes, _angle_delay,
        _set_angle("delay", "delay"),
    ),
    Effect(
        "length_offset", "a cylinder's length sensor with an offset", "sensor", cylinders,
        _length_offset, _set_length,
    ),
    Effect(
        "pressure_offset", "a pressure transducer with an offset", "sensor", _ports,
        _pressure_offset, _set_pressure,
    ),
    Effect(
        "pressure_delay", "pressure transducers of an axis that read late", "sensor", valves,
        _pressure_delay, _set_pressure_delay,
    ),
)  # fmt: skip

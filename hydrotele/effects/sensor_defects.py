"""Sensors that read with an offset, another scale, late, or by a clock of their own.

Position sensors whose offset drifts while they warm up.
"""

import math

from hydrotele.effects.effect import Effect, Parameter, Values, axes, hydraulics, linkages
from hydrotele.machine.machine import Machine, SensorError

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


def _angle_drift(machine: Machine, location: str) -> dict[str, Parameter]:
    """Sizes in a warm sensor as of an offset; 600 s in which it warms up are an estimate."""
    error = _error(machine, _position(machine, location))
    sizes = _angle_offset(machine, location)["offset"]
    reach = sizes.high - sizes.nominal
    low, high = error.drift - reach, error.drift + reach
    return {
        "drift": Parameter(sizes.unit, error.drift, low, high, sizes.scale, sizes.least),
        "time_constant": Parameter(
            "s", error.drift_time_constant, 1.0, 36000.0, 300.0, 30.0, optional=True
        ),
    }


def _set_angle_drift(machine: Machine, location: str, values: Values) -> Machine:
    """Without drift its time constant means nothing and is left out."""
    numbers = {"drift": values["drift"]}
    if values["drift"] and "time_constant" in values:
        numbers["drift_time_constant"] = values["time_constant"]
    return _with(machine, _position(machine, location), **numbers)


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


def _slow(present: float) -> dict[str, Parameter]:
    """Transducers and their filters have time constants of 1 to 50 ms; 3 ms is worth naming."""
    high = max(0.3, present)
    return {"time_constant": Parameter("s", present, 0.0, high, 0.02, 0.003, starts=(0.01, 0.04))}


def _angle_lag(machine: Machine, location: str) -> dict[str, Parameter]:
    return _slow(_error(machine, _position(machine, location)).time_constant)


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
    present = _error(machine, _transducer(location)).offset
    span = machine.highest_pressure(location.rpartition(".")[0])
    low, high = present - 0.05 * span, present + 0.05 * span
    return {"offset": Parameter("Pa", present, low, high, 0.005 * span, 20.0e3 / 28.0e6 * span)}


def _set_pressure(machine: Machine, location: str, values: Values) -> Machine:
    return _with(machine, _transducer(location), offset=values["offset"])


def _pressure_scale(machine: Machine, location: str) -> dict[str, Parameter]:
    """A wrong span setting or supply voltage; a calibrated transducer is right to 0.25 %."""
    present = _error(machine, _transducer(location)).scale
    low, high = min(0.8, present), max(1.2, present)
    return {"ratio": Parameter("1", present, low, high, 0.02, 0.003)}


def _set_pressure_scale(machine: Machine, location: str, values: Values) -> Machine:
    return _with(machine, _transducer(location), scale=values["ratio"])


def _both(axis: str) -> tuple[str, ...]:
    return tuple(f"pressure_{side}.{axis}" for side in _SIDES)


def _common(machine: Machine, channels: tuple[str, ...], field: str) -> float:
    """What all channels have in common of a delay or time constant [s]: the least of them."""
    return min(getattr(_error(machine, channel), field) for channel in channels)


def _with_common(machine: Machine, channels: tuple[str, ...], field: str, value: float) -> Machine:
    """The least of the channels gets the value, the others shift as much."""
    more = value - _common(machine, channels, field)
    for channel in channels:
        shifted = getattr(_error(machine, channel), field) + more
        machine = _with(machine, channel, **{field: max(0.0, shifted)})
    return machine


def _pressure_delay(machine: Machine, location: str) -> dict[str, Parameter]:
    return _late(_common(machine, _both(location), "delay"))


def _set_pressure_delay(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common(machine, _both(location), "delay", values["delay"])


def _pressure_lag(machine: Machine, location: str) -> dict[str, Parameter]:
    return _slow(_common(machine, _both(location), "time_constant"))


def _set_pressure_lag(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common(machine, _both(location), "time_constant", values["time_constant"])


def _clocks(machine: Machine) -> dict[str, tuple[str, ...]]:
    """Groups of channels that one logger may have stamped; one axis alone has its own delays."""
    pressures = tuple(c for c in machine.sensed_channels if c.startswith("pressure"))
    positions = tuple(c for c in machine.sensed_channels if not c.startswith("pressure"))
    groups = {}
    if len(machine.axes) > 1:
        groups["positions"] = positions
    if len(machine.hydraulic_axes) > 1:
        groups["pressures"] = pressures
    return groups


def _clock_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """Seconds by which a group of sensors is stamped late, against commands and other sensors.

    A group is never early, which would be a response before its command; against the other group
    either sign is possible, as an offset of one or of the other. Loggers are off by some 10 ms.
    """
    present = _common(machine, _clocks(machine)[location], "delay")
    high = max(0.5, present)
    return {"offset": Parameter("s", present, 0.0, high, 0.02, 0.003, starts=(0.02, 0.1))}


def _set_clock_offset(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common(machine, _clocks(machine)[location], "delay", values["offset"])


EFFECTS = (
    Effect(
        "angle_offset", "a position sensor that is mounted askew", "sensor", axes, _angle_offset,
        _set_angle("offset", "offset"),
    ),
    Effect(
        "angle_drift", "a position sensor whose offset drifts while it warms up", "sensor", axes,
        _angle_drift, _set_angle_drift,
    ),
    Effect(
        "angle_scale", "a position sensor with another scale", "sensor", axes, _angle_scale,
        _set_angle("scale", "ratio"),
    ),
    Effect(
        "angle_delay", "a position sensor that reads late", "sensor", axes, _angle_delay,
        _set_angle("delay", "delay"), "late position sensor",
    ),
    Effect(
        "angle_lag", "a position sensor behind a first-order lag", "sensor", axes, _angle_lag,
        _set_angle("time_constant", "time_constant"), "late position sensor",
    ),
    Effect(
        "length_offset", "a cylinder's length sensor with an offset", "sensor", linkages,
        _length_offset, _set_length,
    ),
    Effect(
        "pressure_offset", "a pressure transducer with an offset", "sensor", _ports,
        _pressure_offset, _set_pressure,
    ),
    Effect(
        "pressure_delay", "pressure transducers of an axis that read late", "sensor", hydraulics,
        _pressure_delay, _set_pressure_delay, "late pressure transducers",
    ),
    Effect(
        "pressure_scale", "a pressure transducer with another scale", "sensor", _ports,
        _pressure_scale, _set_pressure_scale,
    ),
    Effect(
        "pressure_lag", "pressure transducers of an axis behind a first-order lag", "sensor",
        hydraulics, _pressure_lag, _set_pressure_lag, "late pressure transducers",
    ),
    Effect(
        "clock_offset", "a clock of the positions or of the pressures that is late", "sensor",
        lambda machine: tuple(_clocks(machine)), _clock_offset, _set_clock_offset,
    ),
)  # fmt: skip

"""Effects of sensors: offset, drift during warm-up, scale, delay, lag, and clock offset."""

import math

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    all_axes,
    hydraulic_axes,
    nonparallel_cylinder_axes,
)
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError

_NO_ERROR = SensorError()
_SIDES = ("head", "rod")


def _position_channel(machine: Machine, axis: str) -> str:
    return f"{machine.position_kind(axis)}.{axis}"


def _sensor_error(machine: Machine, channel: str) -> SensorError:
    return machine.sensor_errors.get(channel, _NO_ERROR)


def _with_sensor_error(machine: Machine, channel: str, **numbers: float) -> Machine:
    error = _sensor_error(machine, channel).model_copy(update=numbers)
    errors = {name: e for name, e in machine.sensor_errors.items() if name != channel}
    if error != _NO_ERROR:
        errors[channel] = error
    return machine.model_copy(update={"sensor_errors": errors})


def _angle_offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the offset of a position sensor.

    Angle sensors are mounted with errors of half a degree or more. The smallest relevant offset is a
    twentieth of a degree, their resolution. For sliding joints, bounds and prior are fractions of the
    joint's range.
    """
    present = _sensor_error(machine, _position_channel(machine, location)).offset
    if machine.position_kind(location) == "angle":
        unit, one = "rad", math.radians(1.0)
        sizes = present - 5 * one, present + 5 * one, 0.5 * one, 0.05 * one
    else:
        low, high = machine.joints[machine.axes[location].joint].range or (-0.5, 0.5)
        unit, span = "m", high - low
        sizes = present - 0.1 * span, present + 0.1 * span, 0.01 * span, 0.001 * span
    return {"offset": Parameter(unit, present, *sizes)}


def _make_position_error_setter(field: str, parameter: str):
    def set_position_error(machine: Machine, location: str, values: Values) -> Machine:
        return _with_sensor_error(machine, _position_channel(machine, location), **{field: values[parameter]})

    return set_position_error


def _angle_drift_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of drift and warm-up time constant of a position sensor.

    The drift is the change of the sensor's offset from start to warm state. Bounds and prior are
    those of the constant offset (effect angle_offset), about the nominal drift. The time constant is optional.
    """
    error = _sensor_error(machine, _position_channel(machine, location))
    sizes = _angle_offset_parameters(machine, location)["offset"]
    reach = sizes.upper_bound - sizes.nominal
    low, high = error.drift - reach, error.drift + reach
    return {
        "drift": Parameter(sizes.unit, error.drift, low, high, sizes.prior_std, sizes.min_relevant_change),
        "time_constant": Parameter("s", error.drift_time_constant, 1.0, 36000.0, 300.0, 30.0, optional=True),
    }


def _set_angle_drift(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with another drift and warm-up time constant of a position sensor.

    With a drift of 0 the time constant has no effect and is not set.
    """
    numbers = {"drift": values["drift"]}
    if values["drift"] and "time_constant" in values:
        numbers["drift_time_constant"] = values["time_constant"]
    return _with_sensor_error(machine, _position_channel(machine, location), **numbers)


def _angle_scale_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the scale factor of a position sensor.

    The factor differs from 1 with a wrong gear or reference voltage. The smallest relevant change
    is 0.3 %, the linearity of an angle sensor over one radian.
    """
    present = _sensor_error(machine, _position_channel(machine, location)).scale
    low, high = min(0.8, present), max(1.2, present)
    return {"ratio": Parameter("1", present, low, high, 0.02, 0.003)}


def _sensor_delay_parameters(present: float) -> dict[str, Parameter]:
    """Return nominal value (`present` [s]), bounds and prior of a sensor delay.

    Filters and buses delay by about 10 ms. The smallest relevant change is 3 ms, one bus cycle.
    """
    high = max(0.3, present)
    return {"delay": Parameter("s", present, 0.0, high, 0.02, 0.003, start_values=(0.02, 0.06))}


def _angle_delay_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    return _sensor_delay_parameters(_sensor_error(machine, _position_channel(machine, location)).delay)


def _sensor_lag_parameters(present: float) -> dict[str, Parameter]:
    """Return nominal value (`present` [s]), bounds and prior of the first-order time constant of a sensor.

    Sensors and their filters have time constants of 1 to 50 ms. The smallest relevant change is 3
    ms.
    """
    high = max(0.3, present)
    return {"time_constant": Parameter("s", present, 0.0, high, 0.02, 0.003, start_values=(0.01, 0.04))}


def _angle_lag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    return _sensor_lag_parameters(_sensor_error(machine, _position_channel(machine, location)).time_constant)


def _length_offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the offset of a cylinder's length sensor.

    Bounds and prior are fractions of the stroke. For a stroke of 1 m, length sensors are mounted with an
    error of a centimetre, and the smallest relevant offset is a millimetre.
    """
    cylinder = machine.axes[location].cylinder
    assert cylinder
    present, stroke = _sensor_error(machine, f"length.{location}").offset, cylinder.stroke
    low, high = present - 0.1 * stroke, present + 0.1 * stroke
    return {"offset": Parameter("m", present, low, high, 0.01 * stroke, 0.001 * stroke)}


def _set_length_offset(machine: Machine, location: str, values: Values) -> Machine:
    return _with_sensor_error(machine, f"length.{location}", offset=values["offset"])


def _transducer_locations(machine: Machine) -> tuple[str, ...]:
    return tuple(f"{axis}.{side}" for axis in machine.hydraulic_axes for side in _SIDES)


def _pressure_channel_of_location(location: str) -> str:
    axis, _, side = location.rpartition(".")
    return f"pressure_{side}.{axis}"


def _pressure_offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the zero offset of a pressure transducer.

    Bounds and prior are fractions of the span, which is taken to be the highest feed pressure of
    the axis. The typical offset is 0.5 % of it, the accuracy class. The smallest relevant change is
    0.07 %, similar to the repeatability of a transducer (better than 0.1 %).
    """
    present = _sensor_error(machine, _pressure_channel_of_location(location)).offset
    span = machine.max_feed_pressure(location.rpartition(".")[0])
    low, high = present - 0.05 * span, present + 0.05 * span
    return {"offset": Parameter("Pa", present, low, high, 0.005 * span, 20.0e3 / 28.0e6 * span)}


def _set_pressure_offset(machine: Machine, location: str, values: Values) -> Machine:
    return _with_sensor_error(machine, _pressure_channel_of_location(location), offset=values["offset"])


def _pressure_scale_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the scale factor of a pressure transducer.

    The factor differs from 1 with a wrong span setting or supply voltage. The smallest relevant
    change is 0.3 %, about the accuracy of a calibrated transducer.
    """
    present = _sensor_error(machine, _pressure_channel_of_location(location)).scale
    low, high = min(0.8, present), max(1.2, present)
    return {"ratio": Parameter("1", present, low, high, 0.02, 0.003)}


def _set_pressure_scale(machine: Machine, location: str, values: Values) -> Machine:
    return _with_sensor_error(machine, _pressure_channel_of_location(location), scale=values["ratio"])


def _pressure_channels_of_axis(axis: str) -> tuple[str, ...]:
    return tuple(f"pressure_{side}.{axis}" for side in _SIDES)


def _common_delay_or_lag(machine: Machine, channels: tuple[str, ...], field: str) -> float:
    """Return the smallest delay or time constant of several sensor channels [s], which all of them have in common.

    Args:
        machine: the machine.
        channels: channel names.
        field: `delay` or `time_constant`.
    """
    return min(getattr(_sensor_error(machine, channel), field) for channel in channels)


def _with_common_delay_or_lag(machine: Machine, channels: tuple[str, ...], field: str, value: float) -> Machine:
    """Return the machine with another common delay or time constant of several sensor channels.

    The smallest delay or time constant becomes `value` [s]. Those of the other channels change by
    the same time, but not below 0. `field` is `delay` or `time_constant`.
    """
    more = value - _common_delay_or_lag(machine, channels, field)
    for channel in channels:
        shifted = getattr(_sensor_error(machine, channel), field) + more
        machine = _with_sensor_error(machine, channel, **{field: max(0.0, shifted)})
    return machine


def _pressure_delay_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    return _sensor_delay_parameters(_common_delay_or_lag(machine, _pressure_channels_of_axis(location), "delay"))


def _set_pressure_delay(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common_delay_or_lag(machine, _pressure_channels_of_axis(location), "delay", values["delay"])


def _pressure_lag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    return _sensor_lag_parameters(_common_delay_or_lag(machine, _pressure_channels_of_axis(location), "time_constant"))


def _set_pressure_lag(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common_delay_or_lag(
        machine, _pressure_channels_of_axis(location), "time_constant", values["time_constant"]
    )


def _clock_groups(machine: Machine) -> dict[str, tuple[str, ...]]:
    """Return the groups of sensor channels that may have been recorded with a separate clock.

    The groups are `positions`, if the machine has several axes, and `pressures`, if it has several
    hydraulic axes. For a single axis, an offset of the clock is the same as a delay of its sensors.

    Returns:
        Name of the group -> channel names.
    """
    pressures = tuple(c for c in machine.sensed_channels if c.startswith("pressure"))
    positions = tuple(c for c in machine.sensed_channels if not c.startswith("pressure"))
    groups = {}
    if len(machine.axes) > 1:
        groups["positions"] = positions
    if len(machine.hydraulic_axes) > 1:
        groups["pressures"] = pressures
    return groups


def _clock_offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the time by which a group of sensors is recorded late.

    The time is relative to commands and other sensors. It is never negative, because readings would
    then respond before their command. If one group is early relative to the other, the other group is
    the location: early pressures are late positions. Typical offsets are about 10 ms; the smallest relevant change
    is 3 ms.
    """
    present = _common_delay_or_lag(machine, _clock_groups(machine)[location], "delay")
    high = max(0.5, present)
    return {"offset": Parameter("s", present, 0.0, high, 0.02, 0.003, start_values=(0.02, 0.1))}


def _set_clock_offset(machine: Machine, location: str, values: Values) -> Machine:
    return _with_common_delay_or_lag(machine, _clock_groups(machine)[location], "delay", values["offset"])


EFFECTS = (
    Effect(
        "angle_offset", "an offset of a position sensor", "sensor", all_axes, _angle_offset_parameters,
        _make_position_error_setter("offset", "offset"),
    ),
    Effect(
        "angle_drift", "an offset of a position sensor that drifts during warm-up", "sensor", all_axes,
        _angle_drift_parameters, _set_angle_drift,
    ),
    Effect(
        "angle_scale", "a scale error of a position sensor", "sensor", all_axes, _angle_scale_parameters,
        _make_position_error_setter("scale", "ratio"),
    ),
    Effect(
        "angle_delay", "a delay of a position sensor", "sensor", all_axes, _angle_delay_parameters,
        _make_position_error_setter("delay", "delay"), "position sensor delay",
    ),
    Effect(
        "angle_lag", "a first-order lag of a position sensor", "sensor", all_axes, _angle_lag_parameters,
        _make_position_error_setter("time_constant", "time_constant"), "position sensor delay",
    ),
    Effect(
        "length_offset", "an offset of a cylinder's length sensor", "sensor", nonparallel_cylinder_axes,
        _length_offset_parameters, _set_length_offset,
    ),
    Effect(
        "pressure_offset", "an offset of a pressure transducer", "sensor", _transducer_locations,
        _pressure_offset_parameters, _set_pressure_offset,
    ),
    Effect(
        "pressure_delay", "a delay of an axis' pressure transducers", "sensor", hydraulic_axes,
        _pressure_delay_parameters, _set_pressure_delay, "pressure transducer delay",
    ),
    Effect(
        "pressure_scale", "a scale error of a pressure transducer", "sensor", _transducer_locations,
        _pressure_scale_parameters, _set_pressure_scale,
    ),
    Effect(
        "pressure_lag", "a first-order lag of an axis' pressure transducers", "sensor",
        hydraulic_axes, _pressure_lag_parameters, _set_pressure_lag, "pressure transducer delay",
    ),
    Effect(
        "clock_offset", "a time offset of all positions or all pressures", "sensor",
        lambda machine: tuple(_clock_groups(machine)), _clock_offset_parameters, _set_clock_offset,
    ),
)  # fmt: skip

"""Errors of the sensors of a machine, in the units of their channels.

Random error, converter steps, systematic errors, warming drift and first-order lag.
"""

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    Vector,
)


class Sensor(StrictModel):
    """A sensor with a random error and a converter of 2^bits equal steps over the span.

    The error is uniform in +-`accuracy`, or normal with `standard_deviation`. Without either, the
    simulator treats the sensor as ideal, and identification treats its noise as unknown. `bits` and
    `span` are None for a sensor without converter steps.

    The errors of two readings at a distance t have the correlation exp(-t / `correlation_time`) [s].
    `gap` and `identify` then use one reading per correlation time, so that the errors are independent.
    """

    accuracy: NonNegativeFloat = 0.0
    standard_deviation: NonNegativeFloat = 0.0
    bits: Annotated[int, Field(ge=1, le=32)] | None = None
    span: PositiveFloat | None = None
    correlation_time: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.correlation_time and not self.standard_deviation:
            raise ValueError("correlation_time needs standard_deviation: only normal errors can be correlated")
        if self.accuracy and self.standard_deviation:
            raise ValueError("give accuracy (the bound of a uniform error) or standard_deviation, not both")
        return self

    @property
    def error_rms(self) -> float:
        """Standard deviation of the random error [channel's unit]; 0 if none is stated."""
        return self.standard_deviation or self.accuracy / math.sqrt(3.0)


MOUNTED_KINDS = {
    "imu": (*(f"gyro_{c}" for c in "xyz"), *(f"accelerometer_{c}" for c in "xyz")),
    "gyro": ("gyro_z",),
    "inclination": ("inclination",),
    "tilt": ("roll", "pitch"),
}
"""Type of a mounted sensor -> kinds of its channels."""


class MountedSensor(StrictModel):
    """A sensor mounted on a link: an IMU, a gyro about its z axis, or an inclination or tilt sensor.

    `link` may be `world` for the chassis. `position` [m] is in the frame of the link. `rotation`
    [rad] is the rotation vector that rotates the axes of the link into those of the sensor. An IMU
    measures angular rate and specific force in its axes; at rest the specific force points up and
    has the size of gravity. An inclination sensor measures the angle of its x axis above the
    horizontal in its x-z plane. A tilt sensor measures roll about its x axis and pitch about its y
    axis. Both compute the angle from the specific force and filter it with `time_constant` [s].

    `gyro_noise` [rad/s], `accelerometer_noise` [m/s^2] and `angle_noise` [rad] are standard
    deviations of one reading. A sensor with a `rate` [Hz] holds its reading between updates. The
    biases are added to readings; `angle_bias` is that of all angles of the sensor. `calibrate imu`
    uses the standard deviations `rotation_sd` [rad], `position_sd` [m], `gyro_bias_sd` and
    `accelerometer_bias_sd` of the stated values. Their defaults are those of a sensor mounted by
    eye, with its position measured by a tape, and of a MEMS sensor.
    """

    type: Literal["imu", "gyro", "inclination", "tilt"] = "imu"
    link: Name
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    gyro_noise: NonNegativeFloat = 0.0
    accelerometer_noise: NonNegativeFloat = 0.0
    angle_noise: NonNegativeFloat = 0.0
    gyro_bias: Vector = (0.0, 0.0, 0.0)
    accelerometer_bias: Vector = (0.0, 0.0, 0.0)
    angle_bias: float = 0.0
    time_constant: NonNegativeFloat = 0.0
    rate: PositiveFloat | None = None
    rotation_sd: PositiveFloat = 0.1
    position_sd: PositiveFloat = 0.02
    gyro_bias_sd: PositiveFloat = 0.01
    accelerometer_bias_sd: PositiveFloat = 0.05

    def channels(self, name: str) -> tuple[str, ...]:
        """Return the names of the channels of this sensor, which has the name `name`."""
        return tuple(f"{kind}.{name}" for kind in MOUNTED_KINDS[self.type])

    def noise(self, channel: str) -> float:
        """Return the standard deviation of one reading of a channel [channel's unit]."""
        if channel.startswith("gyro"):
            return self.gyro_noise
        return self.accelerometer_noise if channel.startswith("accelerometer") else self.angle_noise


class SensorSet(StrictModel):
    """Sensors of a machine by kind of channel, sampled at `rate` [Hz].

    `absent` are the kinds that the machine does not have; they are not logged. Retrofitted sensors
    are logged if the set contains them: `mounted` are those on links, by name; `flow` measures the
    valve flow into the head side of each axis, `pressure_ls` the highest pressure of a fed chamber,
    `oil_temperature` [degC] that of the tank, and `pilot_pressure` the two pilot pressures of each
    axis, which rise to `span` at full command.

    The sampling instants of the rows have a normally distributed error with standard deviation
    `jitter` [s], common to all channels. An entry of `channels`, such as `pressure_head.boom`,
    replaces the sensor of its kind; an empty entry means an unknown accuracy. `velocity` measures
    the rates of the joints, as gyros do.
    """

    rate: PositiveFloat = 50.0
    jitter: NonNegativeFloat = 0.0
    angle: Sensor = Sensor()
    position: Sensor = Sensor()
    length: Sensor = Sensor()
    pressure: Sensor = Sensor()
    velocity: Sensor | None = None
    channels: dict[str, Sensor] = {}
    absent: tuple[Literal["angle", "position", "length", "pressure"], ...] = ()
    mounted: dict[Name, MountedSensor] = {}
    flow: Sensor | None = None
    pressure_ls: Sensor | None = None
    pilot_pressure: Sensor | None = None
    oil_temperature: Sensor | None = None

    @model_validator(mode="after")
    def _check(self):
        if self.pilot_pressure and self.pilot_pressure.span is None:
            raise ValueError("pilot_pressure: give span, the pilot pressure at full command")
        kinds = {kind: getattr(self, kind) for kind in ("angle", "position", "pressure")}
        others = {n: s for n, s in self.channels.items() if not n.startswith("length.")}
        for name, sensor in (kinds | others).items():
            if sensor.bits is not None and sensor.span is None:
                raise ValueError(f"{name}: {sensor.bits} bits need a span (only length has a default span)")
        return self


class SensorError(StrictModel):
    """Systematic error of one channel: the reading is `scale * y(t - delay) + offset`, delay [s].

    y follows the true value with a first-order lag, `time_constant dy/dt = value - y` [s]; without
    a time constant y is the true value. The coupling of the sensor of an undriven joint may be
    misaligned by `tilt` [rad], like a universal joint, `tan(reading) = tan(y) cos(tilt)`, and have
    a `backlash` [rad], its total width. While the sensor warms up from the start of the run, its
    offset changes by `drift` with the time constant `drift_time_constant` [s] (`warming_drift`).
    """

    offset: float = 0.0
    scale: PositiveFloat = 1.0
    delay: NonNegativeFloat = 0.0
    time_constant: NonNegativeFloat = 0.0
    tilt: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    backlash: NonNegativeFloat = 0.0
    drift: float = 0.0
    drift_time_constant: PositiveFloat = 600.0

    def offset_at(self, time: np.ndarray) -> np.ndarray:
        """Return the offset including drift (n,) at times (n,) since the start of the run [s]."""
        if self.drift == 0.0:
            return np.full_like(time, self.offset, dtype=float)
        return self.offset + warming_drift(time, self.drift, self.drift_time_constant)

    @property
    def has_misalignment_or_backlash(self) -> bool:
        """Whether the coupling of the sensor has a misalignment or a backlash."""
        return self.tilt > 0.0 or self.backlash > 0.0

    @property
    def is_delayed(self) -> bool:
        """Whether the sensor has a delay or a lag."""
        return self.delay > 0.0 or self.time_constant > 0.0


class Converter(NamedTuple):
    """An analogue-to-digital converter: rounds to steps within low .. high [channel's unit].

    A step of 0 means no rounding.
    """

    step: float
    low: float
    high: float


def make_channel_converter(sensor: Sensor, channel: str) -> Converter:
    """Return the analogue-to-digital converter of a channel that a sensor measures.

    Its step is span / 2^bits; a sensor without bits or span is not rounded. Lengths and pressures
    are limited to 0 .. span, angles and positions are not limited.
    """
    if sensor.bits is None or sensor.span is None:
        return Converter(0.0, -math.inf, math.inf)
    step = sensor.span / 2.0**sensor.bits
    if channel.startswith(("angle", "position")):
        return Converter(step, -math.inf, math.inf)
    return Converter(step, 0.0, sensor.span)


@compiled
def warming_drift(time, drift, time_constant):
    """Return the change of a sensor's offset at a time after it was switched on.

    `e (1 - exp(-t / T))`: the offset is proportional to the temperature of a single heat capacity.

    Args:
        time: t since the sensor was switched on, scalar or array [s].
        drift: e, final change of the warm sensor, scalar [channel's unit].
        time_constant: T, scalar, positive [s].

    Returns:
        Offset change, in the shape of `time` [channel's unit].

    Source: Khoshzaban 1992 p. 37 (resolvers drift with temperature, not linearly); Newton's law of
        cooling.

    >>> float(round(warming_drift(600.0, 1.0, 600.0), 6))
    0.632121
    """
    return -drift * np.expm1(-time / time_constant)


@compiled
def step_first_order_lag(output, input_start, input_end, ratio):
    """Return the output of a first-order lag after a time step with linearly varying input.

    `T dy/dt = x - y` with `x` from `input_start` to `input_end`, integrated exactly.

    Args:
        output: y at the start of the step, scalar or array [channel's unit].
        input_start: input at the start of the step, same shape and unit.
        input_end: input at the end of the step, same shape and unit.
        ratio: step length divided by the time constant T, scalar, positive [1].

    Returns:
        y at the end of the step, same shape and unit as `output`.

    Source: step and ramp response of the first-order lag.

    >>> float(round(step_first_order_lag(0.0, 1.0, 1.0, 1.0), 6))
    0.632121
    """
    gone = -np.expm1(-ratio)
    return output + gone * (input_start - output) + (1.0 - gone / ratio) * (input_end - input_start)

"""Facts of the sensors."""

import math
from typing import Annotated

from pydantic import Field, model_validator

from hydrotele.core.datafile import Facts, NonNegative, Positive


class Sensor(Facts):
    """A random error, then 2^bits equal steps of the span; `None` = no such defect.

    The error is uniform in +-`accuracy`, or normal with `standard_deviation`. With neither the
    sensor is ideal to the simulator, and of unknown noise to whoever learns from its readings.
    """

    accuracy: NonNegative = 0.0
    standard_deviation: NonNegative = 0.0
    bits: Annotated[int, Field(ge=1, le=32)] | None = None
    span: Positive | None = None

    @model_validator(mode="after")
    def _check(self):
        if self.accuracy and self.standard_deviation:
            raise ValueError(
                "give accuracy (the bound of a uniform error) or standard_deviation, not both"
            )
        return self

    @property
    def error_rms(self) -> float:
        """Standard deviation of the random error [channel's unit]; 0 where none is stated."""
        return self.standard_deviation or self.accuracy / math.sqrt(3.0)


class SensorSet(Facts):
    """Sensors of a machine by kind of channel, sampled at `rate` [Hz].

    The log's rows are read at instants that are off by `jitter` [s], normal, of all channels alike.
    What `channels` says of a channel, such as `pressure_head.boom`, holds there in place of its
    kind; an empty entry says that nothing is known of it.
    """

    rate: Positive = 50.0
    jitter: NonNegative = 0.0
    angle: Sensor = Sensor()
    position: Sensor = Sensor()
    length: Sensor = Sensor()
    pressure: Sensor = Sensor()
    channels: dict[str, Sensor] = {}

    @model_validator(mode="after")
    def _check(self):
        kinds = {kind: getattr(self, kind) for kind in ("angle", "position", "pressure")}
        others = {n: s for n, s in self.channels.items() if not n.startswith("length.")}
        for name, sensor in (kinds | others).items():
            if sensor.bits is not None and sensor.span is None:
                raise ValueError(
                    f"{name}: {sensor.bits} bits need a span (only length has its own)"
                )
        return self


class SensorError(Facts):
    """A defect of one channel: it reads `scale * y(t - delay) + offset`, delay in [s].

    y follows the true value with a first-order lag, `time_constant dy/dt = value - y` [s]; without
    a time constant it is the true value. The coupling of an undriven joint's sensor may be tilted
    against its axis by `tilt` [rad], as a universal joint is, `tan(shown) = tan(y) cos(tilt)`, and
    have a play of `backlash` [rad].
    """

    offset: float = 0.0
    scale: Positive = 1.0
    delay: NonNegative = 0.0
    time_constant: NonNegative = 0.0
    tilt: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    backlash: NonNegative = 0.0

    @property
    def coupled(self) -> bool:
        """Whether the sensor's coupling has a tilt or a play."""
        return self.tilt > 0.0 or self.backlash > 0.0

    @property
    def late(self) -> bool:
        """Whether it shows anything but the present value."""
        return self.delay > 0.0 or self.time_constant > 0.0

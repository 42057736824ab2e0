"""Facts of the sensors."""

from typing import Annotated

from pydantic import Field, model_validator

from hydrotele.datafile import Facts, NonNegative, Positive


class Sensor(Facts):
    """Uniform error +-accuracy, then 2^bits equal steps of the span; `None` = no such defect."""

    accuracy: NonNegative = 0.0
    bits: Annotated[int, Field(ge=1, le=32)] | None = None
    span: Positive | None = None


class SensorSet(Facts):
    """Sensors of a machine by kind of channel, sampled at `rate` [Hz]."""

    rate: Positive = 50.0
    angle: Sensor = Sensor()
    position: Sensor = Sensor()
    length: Sensor = Sensor()
    pressure: Sensor = Sensor()

    @model_validator(mode="after")
    def _check(self):
        for kind in ("angle", "position", "pressure"):
            sensor: Sensor = getattr(self, kind)
            if sensor.bits is not None and sensor.span is None:
                raise ValueError(
                    f"{kind}: {sensor.bits} bits need a span (only length has its own)"
                )
        return self


class SensorError(Facts):
    """A defect of one channel: it reads `scale * value(t - delay) + offset`, delay in [s]."""

    offset: float = 0.0
    scale: Positive = 1.0
    delay: NonNegative = 0.0

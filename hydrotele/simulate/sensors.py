"""Sensors: uniform error inside a bound, then an analogue-to-digital converter.

Every channel draws from its own stream, keyed by the scenario's seed and the channel's name, so
that leaving a channel out changes no other.
"""

import math
import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.datafile import suggest
from hydrotele.errors import InputError
from hydrotele.machine import Machine, Sensor, SensorSet

IDEAL = "ideal"

_KINDS = {
    "angle": "angle",
    "position": "position",
    "length": "length",
    "pressure_head": "pressure",
    "pressure_rod": "pressure",
    "pressure_supply": "pressure",
}


def sensor_set(machine: Machine, name: str) -> SensorSet | None:
    """A machine's sensors by name; None for ideal ones.

    Raises:
        InputError: the machine has no such sensors; lists those it has.
    """
    if name == IDEAL:
        return None
    if name not in machine.sensors:
        raise InputError(
            f"sensors {name!r}",
            f"machine {machine.name} has none; {suggest(name, [IDEAL, *machine.sensors])}",
        )
    return machine.sensors[name]


def channel_sensor(machine: Machine, sensors: SensorSet | None, channel: str) -> Sensor:
    """Sensor of a channel with its span filled in: a length spans its cylinder's stroke."""
    if sensors is None:
        return Sensor()
    kind, _, axis = channel.partition(".")
    sensor: Sensor = getattr(sensors, _KINDS[kind])
    if kind == "length" and sensor.bits and sensor.span is None:
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return sensor.model_copy(update={"span": cylinder.stroke})
    return sensor


def sensor_errors(sensor: Sensor, seed: int, channel: str, count: int) -> np.ndarray:
    """Uniform errors of a channel for a whole run.

    Args:
        sensor: its accuracy [channel's unit].
        seed: the scenario's seed.
        channel: channel name, which selects the stream.
        count: number of samples n.

    Returns:
        (n,) errors, uniform in [-accuracy, accuracy].

    Source: Khoshzaban 1992, section 4.4.3 (uniform error inside the sensor's bound).
    """
    stream = np.random.Generator(np.random.PCG64([seed, zlib.crc32(channel.encode())]))
    return stream.uniform(-1.0, 1.0, count) * sensor.accuracy


class Converter(NamedTuple):
    """An analogue-to-digital converter: nearest step, kept inside low .. high [channel's unit].

    A step of 0 passes everything unchanged.
    """

    step: float
    low: float
    high: float


def converter(sensor: Sensor, channel: str) -> Converter:
    """Converter of a channel: 2^bits steps of the span; lengths and pressures end at 0 and span."""
    if sensor.bits is None or sensor.span is None:
        return Converter(0.0, -math.inf, math.inf)
    step = sensor.span / 2.0**sensor.bits
    if channel.startswith(("angle", "position")):
        return Converter(step, -math.inf, math.inf)
    return Converter(step, 0.0, sensor.span)


@compiled
def convert(value, step, low, high):
    """Reading of a converter.

    Args:
        value: what comes in, scalar [channel's unit].
        step: converter step, scalar [channel's unit]; 0 for none.
        low: lowest reading, scalar [channel's unit].
        high: highest reading, scalar [channel's unit].

    Returns:
        The reading, scalar [channel's unit].

    Source: nominal model, "Sensors".

    >>> convert(0.30, 0.25, 0.0, 1.0), convert(1.2, 0.25, 0.0, 1.0), convert(0.3, 0.0, 0.0, 1.0)
    (0.25, 1.0, 0.3)
    """
    if step == 0.0:
        return value
    return min(high, max(low, np.rint(value / step) * step))


@compiled
def _convert_all(values, step, low, high):
    readings = np.empty(len(values))
    for row in range(len(values)):
        readings[row] = convert(values[row], step, low, high)
    return readings


def measure(
    machine: Machine, sensors: SensorSet | None, seed: int, truth: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """What the sensors read of true values.

    Args:
        machine: the machine (strokes).
        sensors: the set, None for ideal.
        seed: the scenario's seed.
        truth: channel -> (n,) true values.
        errors: channel -> (n,) errors already drawn; others are drawn here.

    Returns:
        Channel -> (n,) readings.

    Source: nominal model, "Sensors": noise first, then the converter.
    """
    readings = {}
    for channel, values in truth.items():
        sensor = channel_sensor(machine, sensors, channel)
        if sensor.accuracy or sensor.bits:
            error = (errors or {}).get(channel)
            if error is None:
                error = sensor_errors(sensor, seed, channel, len(values))
            values = _convert_all(values + error, *converter(sensor, channel))
        readings[channel] = np.asarray(values, dtype=float)
    return readings


def noise_rms(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Standard deviation of one reading [channel's unit]: uniform error plus converter."""
    sensor = channel_sensor(machine, sensors, channel)
    return math.sqrt(sensor.accuracy**2 / 3.0 + converter(sensor, channel).step ** 2 / 12.0)

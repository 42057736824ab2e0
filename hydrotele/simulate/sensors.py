"""Sensors: scale and offset, a random error, then an analogue-to-digital converter.

Every channel draws from its own stream, keyed by the scenario's seed and the channel's name, so
that leaving a channel out changes no other.
"""

import zlib
from collections.abc import Mapping

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import channel_sensor, converter
from hydrotele.machine.sensors import Sensor, SensorSet


def sensor_errors(sensor: Sensor, seed: int, channel: str, count: int) -> np.ndarray:
    """Random errors of a channel for a whole run.

    Args:
        sensor: its accuracy or standard deviation [channel's unit].
        seed: the scenario's seed.
        channel: channel name, which selects the stream.
        count: number of samples n.

    Returns:
        (n,) errors, uniform in [-accuracy, accuracy], or normal.

    Source: Khoshzaban 1992, section 4.4.3 (uniform error inside the sensor's bound).
    """
    stream = np.random.Generator(np.random.PCG64([seed, zlib.crc32(channel.encode())]))
    if sensor.standard_deviation:
        return stream.normal(0.0, sensor.standard_deviation, count)
    return stream.uniform(-1.0, 1.0, count) * sensor.accuracy


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


def defective(machine: Machine, truth: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What sensors without noise read: `scale * value + offset` of the machine's sensor errors.

    Args:
        machine: the machine.
        truth: channel -> (n,) values at the times at which they are read.

    Returns:
        Channel -> (n,) values.
    """
    errors = machine.sensor_errors
    return {c: errors[c].scale * v + errors[c].offset if c in errors else v
            for c, v in truth.items()}  # fmt: skip


def measure(
    machine: Machine, sensors: SensorSet | None, seed: int, truth: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """What the sensors read of true values.

    Args:
        machine: the machine (strokes).
        sensors: the set, None for ideal.
        seed: the scenario's seed.
        truth: channel -> (n,) true values; where a sensor reads late, those that it reads
            (`readout.late_channels`).
        errors: channel -> (n,) errors already drawn; others are drawn here.

    Returns:
        Channel -> (n,) readings.

    Source: nominal model, "Sensors": noise first, then the converter; defects (`sensor_errors` of
        the machine, ideal sensors have them too) before both.
    """
    readings = {}
    for channel, values in defective(machine, truth).items():
        sensor = channel_sensor(machine, sensors, channel)
        if sensor.error_rms or sensor.bits:
            error = (errors or {}).get(channel)
            if error is None:
                error = sensor_errors(sensor, seed, channel, len(values))
            values = _convert_all(values + error, *converter(sensor, channel))
        readings[channel] = np.asarray(values, dtype=float)
    return readings

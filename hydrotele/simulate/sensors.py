"""Sensors: uniform error inside a bound, then an analogue-to-digital converter.

Every channel draws from its own stream, keyed by the scenario's seed and the channel's name, so
that leaving a channel out changes no other.
"""

import math
import zlib
from collections.abc import Mapping

import numpy as np

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
    "force": "force",
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


def quantise(values: np.ndarray, sensor: Sensor, clip: bool) -> np.ndarray:
    """Nearest of 2^bits equal steps of the span; lengths and pressures clipped to 0 .. span.

    Args:
        values: any shape [channel's unit].
        sensor: bits and span.
        clip: whether the converter ends at its span (an angle goes round instead).

    Returns:
        Same shape as values.

    >>> quantise(np.array([0.30, 1.2]), Sensor(bits=2, span=1.0), clip=True)
    array([0.25, 1.  ])
    """
    if sensor.bits is None or sensor.span is None:
        return values
    step = sensor.span / 2.0**sensor.bits
    rounded = np.round(values / step) * step
    return np.clip(rounded, 0.0, sensor.span) if clip else rounded


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
            clip = not channel.startswith(("angle", "position"))
            values = quantise(values + error, sensor, clip)
        readings[channel] = np.asarray(values, dtype=float)
    return readings


def noise_rms(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Standard deviation of one reading [channel's unit]: uniform error plus converter."""
    sensor = channel_sensor(machine, sensors, channel)
    step = sensor.span / 2.0**sensor.bits if sensor.bits and sensor.span else 0.0
    return math.sqrt(sensor.accuracy**2 / 3.0 + step**2 / 12.0)

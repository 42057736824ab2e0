"""How a machine's sensors read: which sensor a channel has, its lag, its converter, its noise."""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import Sensor, SensorSet

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
    of_kind: Sensor = getattr(sensors, _KINDS[kind])
    sensor = sensors.channels.get(channel, of_kind)
    if kind == "length" and sensor.bits and sensor.span is None:
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return sensor.model_copy(update={"span": cylinder.stroke})
    return sensor


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


def noise_rms(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Standard deviation of one reading [channel's unit]: random error plus converter."""
    sensor = channel_sensor(machine, sensors, channel)
    return math.sqrt(sensor.error_rms**2 + converter(sensor, channel).step ** 2 / 12.0)


@compiled
def first_order(shown, before, now, ratio):
    """What a first-order lag shows after a step over which its input runs straight.

    `T dy/dt = x - y` with `x` from `before` to `now`, integrated exactly.

    Args:
        shown: y at the step's start, scalar or array [channel's unit].
        before: input at the step's start, alike.
        now: input at the step's end, alike.
        ratio: length of the step over the time constant T, scalar, positive [1].

    Returns:
        y at the step's end, as `shown`.

    Source: step and ramp response of the first-order lag.

    >>> float(round(first_order(0.0, 1.0, 1.0, 1.0), 6))
    0.632121
    """
    gone = -np.expm1(-ratio)
    return shown + gone * (before - shown) + (1.0 - gone / ratio) * (now - before)

"""Sensor models: sampled joint positions and pressures with errors, quantisation and hold.

A reading is the true value with scale, offset and random error, quantised by an
analogue-to-digital converter. Runs and environments use the functions of this module. Each channel
has its own random stream, seeded by the scenario's seed and the channel's name, so that removing a
channel does not change the others.
"""

import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine, find_channel_sensor
from hydrotele.machine.sensors import Sensor, SensorError, SensorSet, make_channel_converter
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import sensed_channels
from hydrotele.simulate.stepping import Stepper, apply_sensor_delays, true_sensor_values


def sample_sensor_errors(
    sensor: Sensor, seed: int, channel: str, count: int, period: float = 0.0
) -> np.ndarray:  # fmt: skip
    """Sample the random errors of a sensor channel for a whole run, reproducibly from the seed.

    Args:
        sensor: sensor with its accuracy or standard deviation [channel's unit].
        seed: the scenario's seed.
        channel: channel name, which selects the random stream.
        count: number of samples n.
        period: time between samples [s], for correlated errors.

    Returns:
        (n,) errors, uniform in [-accuracy, accuracy], or normal if there is a standard deviation.

    Source: Khoshzaban 1992, section 4.4.3 (uniform error inside the sensor's bound).
    """
    stream = np.random.Generator(np.random.PCG64([seed, zlib.crc32(channel.encode())]))
    if sensor.standard_deviation:
        errors = stream.normal(0.0, sensor.standard_deviation, count)
        if sensor.correlation_time and count:
            from scipy.signal import lfilter  # starts slowly

            kept = np.exp(-period / sensor.correlation_time)
            errors[1:] *= np.sqrt(1.0 - kept**2)
            errors = np.asarray(lfilter([1.0], [1.0, -kept], errors))
        return errors
    return stream.uniform(-1.0, 1.0, count) * sensor.accuracy


@compiled
def quantise_reading(value, step, low, high):
    """Round a value to the steps of an analogue-to-digital converter and clip it to the converter's range.

    Args:
        value: converter input, scalar [channel's unit].
        step: converter step, scalar [channel's unit]; 0 for no converter, which returns `value`.
        low: lowest reading, scalar [channel's unit].
        high: highest reading, scalar [channel's unit].

    Returns:
        The reading, scalar [channel's unit].

    Source: models/cat215/README.md, "Sensors".

    >>> quantise_reading(0.30, 0.25, 0.0, 1.0), quantise_reading(1.2, 0.25, 0.0, 1.0)
    (0.25, 1.0)
    >>> quantise_reading(0.3, 0.0, 0.0, 1.0)
    0.3
    """
    if step == 0.0:
        return value
    return min(high, max(low, np.rint(value / step) * step))


@compiled
def quantise_readings(values, step, low, high):
    """Round (n,) values to converter steps and clip them to the range `low` to `high` (`quantise_reading`)."""
    readings = np.empty(len(values))
    for row in range(len(values)):
        readings[row] = quantise_reading(values[row], step, low, high)
    return readings


def apply_sensor_errors(machine: Machine, truth: Mapping[str, np.ndarray], time: np.ndarray) -> dict[str, np.ndarray]:
    """Apply the machine's deterministic sensor errors (coupling, scale, offset, drift) to true values.

    First acts the shaft coupling of an angle sensor, which can be tilted or have backlash. Then the
    value becomes `scale * value + offset`, where the offset may change with time.

    Args:
        machine: the machine.
        truth: channel -> (n,) true values at the sampling times.
        time: (n,) time of the rows since the start of the run [s].

    Returns:
        Channel -> (n,) values with errors; channels without an error are unchanged.
    """
    errors = machine.sensor_errors
    return {
        c: errors[c].scale * _apply_shaft_coupling_errors(errors[c], v) + errors[c].offset_at(time)
        if c in errors
        else v
        for c, v in truth.items()
    }  # fmt: skip


def _apply_shaft_coupling_errors(error: SensorError, values: np.ndarray) -> np.ndarray:
    """Return the angles (n,) [rad] that a sensor measures behind a shaft coupling with tilt and backlash.

    The backlash is initially centred.
    """
    if error.tilt:
        turned = np.arctan2(np.sin(values) * np.cos(error.tilt), np.cos(values))
        values = values + np.remainder(turned - values + np.pi, 2.0 * np.pi) - np.pi
    if error.backlash and len(values):
        half, shown = 0.5 * error.backlash, np.empty(len(values))
        last = float(values[0])
        for row, value in enumerate(values):
            last = min(max(last, value - half), value + half)
            shown[row] = last
        values = shown
    return values


def simulate_readings(
    machine: Machine, sensors: SensorSet | None, seed: int, truth: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray] | None = None, period: float = 0.0,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Convert true values to simulated sensor readings with sampling jitter, errors and quantisation.

    Args:
        machine: the machine, with its sensor errors.
        sensors: the sensor set; None for ideal sensors.
        seed: the scenario's seed.
        truth: channel -> (n,) true values; for a sensor with delay or lag, the delayed values
            (`true_values.delayed_channels`).
        errors: channel -> (n,) random errors, if already sampled; those of other channels are
            sampled here.
        period: time between rows [s], for sampling jitter and drift; values are interpolated
            linearly between rows.

    Returns:
        Channel -> (n,) readings.

    Source: models/cat215/README.md, "Sensors": noise first, then the converter. The errors of
        `apply_sensor_errors` act before both, also on ideal sensors.
    """
    readings = {}
    time = period * np.arange(max((len(values) for values in truth.values()), default=0))
    for channel, values in apply_sensor_errors(machine, truth, time).items():
        if sensors and sensors.jitter and period:
            rows = np.arange(len(values))
            values = np.interp(rows + _sampling_jitter(sensors, seed, len(values)) / period, rows, values)
        sensor = find_channel_sensor(machine, sensors, channel)
        if sensor.error_rms or sensor.bits:
            error = (errors or {}).get(channel)
            if error is None:
                error = sample_sensor_errors(sensor, seed, channel, len(values), period)
            values = quantise_readings(values + error, *make_channel_converter(sensor, channel))
        readings[channel] = np.asarray(values, dtype=float)
    return readings


def _sampling_jitter(sensors: SensorSet, seed: int, count: int) -> np.ndarray:
    """Sample the random timing errors [s] of `count` sampling instants, which are the same for all channels."""
    stream = np.random.Generator(np.random.PCG64([seed, zlib.crc32(b"jitter")]))
    return stream.normal(0.0, sensors.jitter, count)


class SensorParameters(NamedTuple):
    """Parameters of c sensors.

    Attributes:
        scale: (c,) scale factors [1].
        offset: (c,) offsets [channel's unit].
        step: (c,) converter steps [channel's unit]; 0 for none.
        low: (c,) lowest readings [channel's unit].
        high: (c,) highest readings [channel's unit].
    """

    scale: np.ndarray
    offset: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Readings(NamedTuple):
    """Last sampled sensor readings of k axes, held until the next sample.

    Attributes:
        joint: (k,) positions [rad] or [m].
        rate: (k,) difference quotients of the last two positions [rad/s] or [m/s].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        supply: (s,) pressures of the supplies, in the order of `Machine.pumps` [Pa].
    """

    joint: np.ndarray
    rate: np.ndarray
    head: np.ndarray
    rod: np.ndarray
    supply: np.ndarray


@compiled
def convert_to_readings(sensors, values, errors):
    """Convert true values into readings, in place: scale, offset, random error, converter.

    Args:
        sensors: SensorParameters.
        values: (c,) true values, replaced by the readings [channel's unit].
        errors: (c,) random errors of this sample [channel's unit].

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Sensors".
    """
    for c in range(len(errors)):
        value = sensors.scale[c] * values[c] + sensors.offset[c] + errors[c]
        values[c] = quantise_reading(value, sensors.step[c], sensors.low[c], sensors.high[c])


@compiled
def store_readings(values, hydraulic_count, sample_time, readings):
    """Store a new sample of all sensors and compute the joint rates by finite differences.

    Args:
        values: (c,) new readings: k joint positions, head and rod pressure of every hydraulic axis,
            pressure of every supply [rad] or [m], [Pa].
        hydraulic_count: number of hydraulic axes, scalar.
        sample_time: time since the last sample, scalar [s]; 0 for the first one, whose rates are 0.
        readings: Readings, written.

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Sensors".
    """
    k = len(readings.joint)
    for i in range(k):
        readings.rate[i] = (values[i] - readings.joint[i]) / sample_time if sample_time > 0.0 else 0.0
        readings.joint[i] = values[i]
    for i in range(hydraulic_count):
        readings.head[i], readings.rod[i] = values[k + 2 * i], values[k + 2 * i + 1]
    if hydraulic_count > 0:
        for i in range(len(readings.supply)):
            readings.supply[i] = values[k + 2 * hydraulic_count + i]


class FeedbackTable(NamedTuple):
    """Sensors of a controller, their sampled errors for a whole run, and their last readings.

    Attributes:
        ticks_per_sample: control ticks per sample.
        period: time between samples [s].
        sensors: parameters of c sensors.
        errors: (samples, c) random errors and drifts [channel's unit].
        readings: readings of the last sample.
    """

    ticks_per_sample: int
    period: float
    sensors: SensorParameters
    errors: np.ndarray
    readings: Readings


@compiled
def sample_sensors_if_due(table, sim, tick, steps):
    """Sample all sensors every `ticks_per_sample` control ticks; at other ticks keep the last readings.

    Args:
        table: FeedbackTable; its readings are written.
        sim: Simulation, from which the true values are read.
        tick: number of the control tick, from 0, scalar.
        steps: physics steps per tick, scalar.

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Sensors".
    """
    if tick % table.ticks_per_sample != 0:
        return
    values = np.empty(len(sim.sensor_history.before))
    true_sensor_values(sim, values)
    apply_sensor_delays(sim.sensor_history, tick * steps, values)
    convert_to_readings(table.sensors, values, table.errors[tick // table.ticks_per_sample])
    span = table.period if tick > 0 else 0.0
    store_readings(values, sim.hydraulic, span, table.readings)


class Feedback:
    """Sensor readings of a plant for a controller, held between samples; `update` renews them in place.

    Attributes:
        table: sensors, errors and readings for compiled code.
        errors: channel -> (samples,) random errors, so that the log can use the same ones.
        ticks_per_sample: control ticks per sample.
        period: time between samples [s].
        joint: (k,) positions [rad] or [m].
        rate: (k,) difference quotients of the last two positions [rad/s] or [m/s].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        supply: (s,) pressures of the supplies [Pa]; 0 without hydraulic axes.
    """

    def __init__(self, table: FeedbackTable, errors: Mapping[str, np.ndarray]) -> None:
        """Create the feedback, before its first sample."""
        self.table, self.errors = table, errors
        self.ticks_per_sample, self.period = table.ticks_per_sample, table.period
        self.joint, self.rate, self.head, self.rod, self.supply = table.readings

    def update(self, tick: int, stepper: Stepper) -> None:
        """Sample all sensors every `ticks_per_sample` control ticks; at other ticks keep the last readings.

        Args:
            tick: the control tick, equal to that of the stepper.
            stepper: the stepper of the plant.
        """
        sample_sensors_if_due(self.table, stepper.sim, tick, stepper.steps)


def create_feedback(plant: Plant, sensors: SensorSet | None, seed: int, ticks: int, control_rate: float) -> Feedback:
    """Create the sensor feedback of a run's controller.

    Args:
        plant: the plant.
        sensors: the sensor set; None for ideal sensors.
        seed: the scenario's seed.
        ticks: number of control ticks.
        control_rate: rate of the controller [Hz].

    Returns:
        The feedback, before its first sample. Readings of sensors slower than the controller are
        held.

    Raises:
        InputError: the control rate is not a multiple of the sensors' rate.
    """
    every, k = periods_per_sample(control_rate, sensors), len(plant.axes)
    supplies = len(plant.machine.supply_channels)
    names = sensed_channels(plant)[: k + 2 * plant.hydraulic + (supplies if plant.hydraulic else 0)]
    kinds = {name: find_channel_sensor(plant.machine, sensors, name) for name in names}
    count = ticks // every + 1  # including the unused sample after the last tick
    errors = {name: sample_sensor_errors(kinds[name], seed, name, count, every / control_rate) for name in names}
    defects = [plant.machine.sensor_errors.get(name, SensorError()) for name in names]
    time = every / control_rate * np.arange(count)
    changes = [d.offset_at(time) - d.offset for d in defects]
    table = FeedbackTable(
        every,
        every / control_rate,
        SensorParameters(
            np.array([d.scale for d in defects]), np.array([d.offset for d in defects]),
            *np.array([make_channel_converter(kinds[name], name) for name in names]).T.copy(),
        ),
        np.column_stack(list(errors.values())) + np.column_stack(changes),
        Readings(np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(supplies)),
    )  # fmt: skip
    return Feedback(table, errors)


def periods_per_sample(rate: float, sensors: SensorSet | None) -> int:
    """Return the number of clock periods per sensor sample.

    It is 1 for ideal sensors, and for sensors whose rate is at least that of the clock.

    Args:
        rate: clock rate [Hz].
        sensors: the sensor set; None for ideal sensors.

    Raises:
        InputError: the clock rate is not a multiple of the sensors' rate.
    """
    if sensors is None or sensors.rate >= rate:
        return 1
    ratio = rate / sensors.rate
    if abs(ratio - round(ratio)) > 1e-6:
        message = f"the sampling rate of {sensors.rate:g} Hz must divide {rate:g} Hz"
        raise InputError("sensors", message)
    return round(ratio)

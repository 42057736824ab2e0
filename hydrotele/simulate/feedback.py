"""What the controller sees: joint positions and pressures, sampled, with error, converted, held.

What late sensors show of a plant: its last states, delayed or behind a first-order lag.

Sensors: scale and offset, a random error, then an analogue-to-digital converter.

Every channel draws from its own stream, keyed by the scenario's seed and the channel's name, so
that leaving a channel out changes no other.
"""

import dataclasses
import math
import zlib
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.circuit import circuit_scratch
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import channel_sensor, converter, first_order
from hydrotele.machine.sensors import Sensor, SensorError, SensorSet
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Lag, aligned_positions, sensor_lags, split_delay, state_supply


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

    Before that, what a tilted or loose coupling makes of the value, see `SensorError`.

    Args:
        machine: the machine.
        truth: channel -> (n,) values at the times at which they are read.

    Returns:
        Channel -> (n,) values.
    """
    errors = machine.sensor_errors
    return {
        c: errors[c].scale * _through_coupling(errors[c], v) + errors[c].offset
        if c in errors
        else v
        for c, v in truth.items()
    }  # fmt: skip


def _through_coupling(error: SensorError, values: np.ndarray) -> np.ndarray:
    """Angles (n,) behind a coupling with tilt and play; the play starts in its middle [rad]."""
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


class Past:
    """States of the last physics steps, for sensors that read late.

    Args:
        plant: the plant, with the delays and time constants of its `sensor_errors`.
        data: state at the start, as `begin_leapfrog` left it; it stands for all times before.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData) -> None:
        """Make room for the longest delay."""
        self._plant, self.lags = plant, sensor_lags(plant.machine)
        self._step = plant.model.opt.timestep
        self._parts = {delay: split_delay(delay, self._step) for delay, _ in self.lags}
        supply = plant.machine.sensor_errors.get("pressure_supply")
        self._slow_supply = supply is not None and supply.time_constant > 0.0
        self._scratch = circuit_scratch()
        self._before = self._state(data)
        size = 2 + max((steps for steps, _ in self._parts.values()), default=0)
        self._rings = {
            constant: tuple(np.tile(part, (size, 1)) for part in self._before)
            for constant in dict.fromkeys(constant for _, constant in self.lags)
        }
        self._size, self._now = size, 0

    def _state(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (nq,), activations (na,) and supply pressure (1,), 0 where nobody asks."""
        supply = np.zeros(1)
        if self._slow_supply:
            user = self._plant.model.actuator_user.ravel()
            supply[0] = state_supply(user, self._plant.hydraulic, data.act, self._scratch)
        return aligned_positions(self._plant.model, data), data.act.copy(), supply

    def keep(self, data: mujoco.MjData) -> None:
        """Remember the state after a step."""
        state, last = self._state(data), self._now
        self._now = (last + 1) % self._size
        for constant, rings in self._rings.items():
            for ring, before, now in zip(rings, self._before, state, strict=True):
                ring[self._now] = (
                    first_order(ring[last], before, now, self._step / constant)
                    if constant else now
                )  # fmt: skip
        self._before = state

    def at(self, lag: Lag) -> tuple[np.ndarray, np.ndarray, float]:
        """What a sensor with this delay and time constant shows.

        Args:
            lag: one of `lags` [s].

        Returns:
            Positions (nq,), activations (na,) and supply pressure [Pa], linear between two steps;
            the supply pressure only where its own sensor has a time constant.
        """
        delay, constant = lag
        steps, part = self._parts[delay]
        new, old = (self._now - steps) % self._size, (self._now - steps - 1) % self._size
        qpos, act, supply = (
            ring[new] + part * (ring[old] - ring[new]) for ring in self._rings[constant]
        )
        return qpos, act, float(supply[0])


class SensorErrors(NamedTuple):
    """What c sensors make of the truth: joints, then head and rod of every axis, then supply.

    Attributes:
        scales: (c,) [1].
        offsets: (c,) [channel's unit].
        errors: (c,) random errors of the sample [channel's unit].
        steps: (c,) converter steps [channel's unit].
        low: (c,) lowest readings [channel's unit].
        high: (c,) highest readings [channel's unit].
    """

    scales: np.ndarray
    offsets: np.ndarray
    errors: np.ndarray
    steps: np.ndarray
    low: np.ndarray
    high: np.ndarray


class SensorReadings(NamedTuple):
    """SensorReadings of k axes.

    Attributes:
        joint: (k,) joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
    """

    joint: np.ndarray
    head: np.ndarray
    rod: np.ndarray


@compiled
def read_sensors(qpos, places, act, supply_act, slow_supply, user, count, sensors, out, work):
    """SensorReadings of the fed-back sensors in a state.

    Args:
        qpos: (nq,) positions [rad] or [m].
        places: (k,) place of each axis' joint in `qpos`.
        act: (na,) activations; pressures [Pa].
        supply_act: (na,) activations that the supply's sensor sees.
        slow_supply: supply pressure behind its sensor's first-order lag, scalar [Pa]; NaN without
            one.
        user: (k * SLOTS,) actuator numbers.
        count: number of hydraulic axes.
        sensors: SensorErrors.
        out: SensorReadings, written.
        work: (SCRATCH,) work space.

    Returns:
        Measured supply pressure, scalar [Pa]; 0 without hydraulic axes.

    Source: nominal model, "Sensors".
    """
    scales, offsets, errors, steps, low, high = sensors
    joint, head, rod = out
    k = len(places)
    for i in range(k):
        value = scales[i] * qpos[places[i]] + offsets[i]
        joint[i] = convert(value + errors[i], steps[i], low[i], high[i])
    for i in range(count):
        c = k + 2 * i
        value = scales[c] * act[4 * i + 2] + offsets[c]
        head[i] = convert(value + errors[c], steps[c], low[c], high[c])
        c += 1
        value = scales[c] * act[4 * i + 3] + offsets[c]
        rod[i] = convert(value + errors[c], steps[c], low[c], high[c])
    if count == 0:
        return 0.0
    c = k + 2 * count
    supply = slow_supply
    if np.isnan(supply):
        supply = state_supply(user, count, supply_act, work)
    value = scales[c] * supply + offsets[c]
    return convert(value + errors[c], steps[c], low[c], high[c])


@dataclasses.dataclass
class Feedback:
    """Sampled and held readings of a plant; `update` refreshes them in place.

    Attributes:
        plant: the plant.
        every: control ticks per sample.
        period: time between samples [s].
        errors: channel -> (samples,) errors, for the log to show the same ones.
        converters: (3, c) step, low and high of every channel's converter.
        joint: (k,) positions [rad] or [m].
        rate: (k,) difference quotients of the last two positions [rad/s] or [m/s].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        supply: supply pressure [Pa].
    """

    plant: Plant
    every: int
    period: float
    errors: dict[str, np.ndarray]
    converters: np.ndarray
    joint: np.ndarray
    rate: np.ndarray
    head: np.ndarray
    rod: np.ndarray
    supply: float = 0.0

    def __post_init__(self) -> None:
        """Lay out what every update needs."""
        self._table = np.column_stack(list(self.errors.values()))
        defects = [self.plant.machine.sensor_errors.get(n, SensorError()) for n in self.errors]
        self._scales = np.array([d.scale for d in defects])
        self._offsets = np.array([d.offset for d in defects])
        self._late = [
            (place, (d.delay, d.time_constant)) for place, d in enumerate(defects) if d.late
        ]
        self._user = self.plant.model.actuator_user.ravel()
        self._work = circuit_scratch()

    def update(self, tick: int, data: mujoco.MjData, past: Past | None = None) -> None:
        """Take a new sample if one is due at this control tick; otherwise hold the last one.

        Args:
            tick: the control tick.
            data: the staggered state.
            past: the states before; needed only where sensors read late.
        """
        if tick % self.every:
            return
        before = self.joint.copy()
        plant, (steps, low, high) = self.plant, self.converters
        qpos, act, supply_act = aligned_positions(plant.model, data), data.act, data.act
        slow_supply = math.nan
        if past and self._late:
            qpos, act, supply_act, slow_supply = self._seen_late(qpos, act, past)
        self.supply = read_sensors(
            qpos, plant.qpos, act, supply_act, slow_supply, self._user, plant.hydraulic,
            SensorErrors(
                self._scales, self._offsets, self._table[tick // self.every], steps, low, high
            ),
            SensorReadings(self.joint, self.head, self.rod), self._work,
        )  # fmt: skip
        if tick:
            self.rate[:] = (self.joint - before) / self.period

    def _seen_late(self, qpos, act, past: Past):
        """States in which what every sensor reads stands as its delay and lag let it through."""
        qpos, act, supply_act, slow_supply = qpos.copy(), act.copy(), act, math.nan
        axes = len(self.plant.axes)
        for place, lag in self._late:
            old_qpos, old_act, old_supply = past.at(lag)
            if place < axes:
                qpos[self.plant.qpos[place]] = old_qpos[self.plant.qpos[place]]
            elif place < axes + 2 * self.plant.hydraulic:
                i, side = divmod(place - axes, 2)
                act[4 * i + 2 + side] = old_act[4 * i + 2 + side]
            else:
                supply_act = old_act
                slow_supply = old_supply if lag[1] else math.nan
        return qpos, act, supply_act, slow_supply


def feedback(
    plant: Plant, sensors: SensorSet | None, seed: int, ticks: int, control_rate: float
) -> Feedback:
    """Sensors of a run's controller.

    Args:
        plant: the plant.
        sensors: the set, None for ideal ones.
        seed: the scenario's seed.
        ticks: number of control ticks.
        control_rate: [Hz].

    Returns:
        The feedback, before its first sample. Sensors slower than the controller are held.

    Raises:
        InputError: the sensors' rate does not divide the control rate.
    """
    every = samples_every(control_rate, sensors)
    names = [f"{plant.machine.position_kind(a)}.{a}" for a in plant.axes]
    for axis in plant.axes[: plant.hydraulic]:
        names += [f"pressure_head.{axis}", f"pressure_rod.{axis}"]
    if plant.machine.valve_axes:
        names.append("pressure_supply")
    kinds = {name: channel_sensor(plant.machine, sensors, name) for name in names}
    count = -(-ticks // every)
    k = len(plant.axes)
    return Feedback(
        plant=plant,
        every=every,
        period=every / control_rate,
        errors={name: sensor_errors(kinds[name], seed, name, count) for name in names},
        converters=np.array([converter(kinds[name], name) for name in names]).T.copy(),
        joint=np.zeros(k),
        rate=np.zeros(k),
        head=np.zeros(k),
        rod=np.zeros(k),
    )


def samples_every(rate: float, sensors: SensorSet | None) -> int:
    """Periods of a clock [Hz] per sample of the sensors; 1 if they are as fast or ideal.

    Raises:
        InputError: the sensors' rate does not divide the clock's.
    """
    if sensors is None or sensors.rate >= rate:
        return 1
    ratio = rate / sensors.rate
    if abs(ratio - round(ratio)) > 1e-6:
        raise InputError("sensors", f"sample at {sensors.rate:g} Hz, which must divide {rate:g} Hz")
    return round(ratio)

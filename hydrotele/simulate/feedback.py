"""What the controller sees: joint positions and pressures, sampled, with error, converted, held."""

import dataclasses

import mujoco
import numpy as np

from hydrotele.compiled import compiled
from hydrotele.errors import InputError
from hydrotele.hydraulics.circuit import circuit_scratch
from hydrotele.noise import channel_sensor, converter
from hydrotele.sensors import SensorSet
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.readout import state_supply
from hydrotele.simulate.record import aligned_positions
from hydrotele.simulate.sensors import convert, sensor_errors


@compiled
def read_sensors(qpos, places, act, user, count, errors, steps, low, high, joint, head, rod, work):
    """Readings of the fed-back sensors in a state.

    Args:
        qpos: (nq,) positions [rad] or [m].
        places: (k,) place of each axis' joint in `qpos`.
        act: (na,) activations; pressures [Pa].
        user: (k * SLOTS,) actuator numbers.
        count: number of hydraulic axes.
        errors: (c,) sensor errors: joints, then head and rod of every axis, then supply.
        steps: (c,) converter steps.
        low: (c,) lowest readings.
        high: (c,) highest readings.
        joint: (k,) written [rad] or [m].
        head: (k,) written [Pa].
        rod: (k,) written [Pa].
        work: (SCRATCH,) work space.

    Returns:
        Measured supply pressure, scalar [Pa]; 0 without hydraulic axes.

    Source: nominal model, "Sensors".
    """
    k = len(places)
    for i in range(k):
        joint[i] = convert(qpos[places[i]] + errors[i], steps[i], low[i], high[i])
    for i in range(count):
        c = k + 2 * i
        head[i] = convert(act[4 * i + 2] + errors[c], steps[c], low[c], high[c])
        c += 1
        rod[i] = convert(act[4 * i + 3] + errors[c], steps[c], low[c], high[c])
    if count == 0:
        return 0.0
    c = k + 2 * count
    return convert(state_supply(user, count, act, work) + errors[c], steps[c], low[c], high[c])


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
        self._user = self.plant.model.actuator_user.ravel()
        self._work = circuit_scratch()

    def update(self, tick: int, data: mujoco.MjData) -> None:
        """Take a new sample if one is due at this control tick; otherwise hold the last one."""
        if tick % self.every:
            return
        before = self.joint.copy()
        plant, (steps, low, high) = self.plant, self.converters
        self.supply = read_sensors(
            aligned_positions(plant.model, data), plant.qpos, data.act, self._user, plant.hydraulic,
            self._table[tick // self.every], steps, low, high, self.joint, self.head, self.rod,
            self._work,
        )  # fmt: skip
        if tick:
            self.rate[:] = (self.joint - before) / self.period


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
    if plant.hydraulic:
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

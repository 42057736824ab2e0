"""A log's signals for the balances: on one clock, smoothed, and once more with other noise."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hydrotele.dynamics.integrate import arriving
from hydrotele.hydraulics.laws import spool_step
from hydrotele.identify import smoothing
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.kinematics.triangle import LoopOpen
from hydrotele.logs.clock import fit_clock
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import noise_rms, sensor_set
from hydrotele.machine.sensors import SensorError
from hydrotele.machine.signals import parse_channel

DRAWS = 16  # a standard deviation from 16 draws, averaged over a second, is known to some 5 %
_LEAST = 10  # readings that a channel needs


@dataclass(frozen=True)
class Signals:
    """Signals of one run; the first of the d sets is the measured one, the others have more noise.

    Attributes:
        time: (n,) uniform clock [s].
        period: time between samples [s].
        command: axis -> (n,) valve command or drive input held from row to row [1], [V] or [N].
        reading: channel -> (n,) readings corrected by the machine's sensor errors, NaN where
            missing [channel's unit].
        noise: channel -> standard deviation of one reading [channel's unit].
        smoothed: channel -> (d, 3, n) value, rate and acceleration.
    """

    time: np.ndarray
    period: float
    command: Mapping[str, np.ndarray]
    reading: Mapping[str, np.ndarray]
    noise: Mapping[str, float]
    smoothed: Mapping[str, np.ndarray]

    def has(self, *channels: str) -> bool:
        """Whether all these channels were measured."""
        return all(channel in self.smoothed for channel in channels)


def read_signals(
    machine: Machine, log: Log, sensors: str | None, noise: Mapping[str, float] | None = None
) -> Signals:
    """Signals of a log.

    Args:
        machine: the machine, whose sensor errors are taken out of the readings.
        log: the run; rows may be missing.
        sensors: name of the machine's sensors; None to find the noise from the data.
        noise: channel -> standard deviation of one reading, in place of the sensors'.

    Returns:
        The signals of all channels that have enough samples.

    Raises:
        InputError: the time stamps follow no clock, or the machine has no such sensors.
    """
    clock, _ = fit_clock(log.time, log.source)
    rows = int(clock.tick[-1]) + 1
    time = clock.start + clock.period * np.arange(rows)
    stated = None if sensors is None else sensor_set(machine, sensors)
    command, reading, found, smoothed = {}, {}, {}, {}
    told = noise or {}
    for k, (name, values) in enumerate(log.columns.items()):
        channel = parse_channel(name)
        if channel.truth or (channel.axis and channel.axis not in machine.axes):
            continue
        on_clock = np.full(rows, np.nan)
        on_clock[clock.tick] = values[clock.row]
        if channel.kind == "command":
            command[channel.axis] = on_clock[_last_known(on_clock)]
        if channel.kind not in ("angle", "position", "length") and "pressure" not in channel.kind:
            continue
        error = machine.sensor_errors.get(name, SensorError())
        on_clock = _corrected(on_clock, error, clock.period)
        known = on_clock[np.isfinite(on_clock)]
        sigma = told.get(name) or noise_rms(machine, stated, name)
        sigma = sigma / error.scale or None
        if len(known) < _LEAST or (sigma is None and np.ptp(known) == 0.0):
            continue
        motion = smoothing.smooth(on_clock[:, None], clock.period, sigma)
        best = np.stack([motion.value, motion.rate, motion.acceleration])[None, :, :, 0]
        draws = smoothing.error_draws(motion, DRAWS, k)[..., 0]
        reading[name], found[name] = on_clock, float(motion.noise[0])
        smoothed[name] = np.concatenate([best, best + draws])
    return Signals(time, clock.period, command, reading, found, smoothed)


def joint_motion(machine: Machine, signals: Signals, axis: str) -> np.ndarray | None:
    """Motion of an axis' joint from its own sensor or else from its cylinder's length.

    Args:
        machine: the machine.
        signals: of a run.
        axis: name.

    Returns:
        (d, 3, n) position [rad] or [m], rate and acceleration; None where nothing tells it.
    """
    own = f"{machine.position_kind(axis)}.{axis}"
    if signals.has(own):
        return signals.smoothed[own]
    cylinder = machine.axes[axis].cylinder
    if cylinder is None or not signals.has(f"length.{axis}"):
        return None
    linkage = axis_linkage(machine, axis)
    length, speed, change = np.moveaxis(signals.smoothed[f"length.{axis}"], 1, 0)
    try:
        angle = linkage.angle(length + cylinder.closed_length)
    except LoopOpen:
        return None
    lever, step = linkage.rate(angle), 1.0e-5  # rad or m: truncation 1e-10, cancellation 1e-11
    bend = (linkage.rate(angle + step) - linkage.rate(angle - step)) / (2.0 * step)
    rate = speed / lever
    return np.stack([angle, rate, (change - bend * rate**2) / lever], axis=1)


def spool_positions(machine: Machine, signals: Signals, axis: str) -> np.ndarray:
    """Spool of an axis at every row: its equation needs the command only.

    Args:
        machine: the machine; a command delay is taken into account.
        signals: of a run that has the command.
        axis: name.

    Returns:
        (n,) [1]; at the first row it stands at the first command.
    """
    valve, delay = machine.axes[axis].valve, machine.axes[axis].command_delay
    assert valve is not None
    command = np.clip(signals.command[axis], -1.0, 1.0)
    spool = np.empty(len(command))
    position, rate = float(command[0]), 0.0
    parts = max(1, round(signals.period / 1.0e-3)) if delay else 1
    part = signals.period / parts
    for row in range(len(command)):
        spool[row] = position
        for i in range(parts):
            target = arriving(command, row, i * part, (i + 1) * part, signals.period, delay)
            position, rate = spool_step(
                position, rate, target, valve.bandwidth, valve.damping, part,
                valve.slew_limit or 0.0,
            )  # fmt: skip
    return spool


def _last_known(values: np.ndarray) -> np.ndarray:
    """Row of the last known value at or before every row; the first row is known."""
    return np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))


def _corrected(values: np.ndarray, error: SensorError, period: float) -> np.ndarray:
    values = (values - error.offset) / error.scale
    if not error.late:
        return values
    # a first-order lag delays motions slower than itself by its time constant
    rows, lag = np.arange(len(values)), (error.delay + error.time_constant) / period
    return np.interp(rows + lag, rows, values, right=np.nan)

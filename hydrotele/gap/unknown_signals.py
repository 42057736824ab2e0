"""Signals of one run that an unknown effect may depend on, by name, and what logs they need."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from hydrotele.compiled import compiled
from hydrotele.dataset.load import Dataset, RunData
from hydrotele.gap.balance_signals import Signals, joint_motion, read_signals, spool_positions
from hydrotele.gap.balances import BAND
from hydrotele.hydraulics.circuit import Slot, chamber_flows
from hydrotele.hydraulics.laws import valve_opening
from hydrotele.hydraulics.parameters import actuator_numbers
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.log import Log
from hydrotele.machine import Machine
from hydrotele.signals import usual_unit

_DB, _TANK, _D = int(Slot.DEADBAND), int(Slot.TANK_PRESSURE), int(Slot.ORIFICE_SMOOTHING)


@dataclass(frozen=True)
class Scene:
    """One run as an unknown effect sees it.

    Attributes:
        period: time between rows [s].
        values: name -> (n,); `time` from the start of the run [s]; per axis `angle` or `position`,
            `length` (piston displacement), `rate` (of the drive), `acceleration`, `command`,
            `spool`, `overlap` (dead band), and per chamber, such as `_head`: `pressure` and its
            rate `change`, flow through the valve into it `valve`, change of that flow with the
            spool `opened` and with the tank pressure `drained`; `pressure_supply`; `demand`, what
            all valves draw, and `return`, what they give back [SI].
    """

    period: float
    values: Mapping[str, np.ndarray]

    def in_band(self, columns: np.ndarray) -> np.ndarray:
        """(n, k) columns below `BAND`, as the balances are."""
        if 0.4 / self.period <= BAND:
            return columns
        filtered = butter(2, BAND, fs=1.0 / self.period, output="sos")
        pad = min(len(columns) - 1, round(1.0 / (BAND * self.period)))
        return sosfiltfilt(filtered, columns, axis=0, padlen=pad)


def run_log(data: Dataset, run: RunData, reading: np.ndarray | None = None) -> Log:
    """A run's mended rows as a log; `reading` (n, c) [SI] in place of the measured ones."""
    reading = run.reading if reading is None else reading
    columns = {f"command.{a}": v for a, v in zip(data.axes, run.command.T, strict=True)}
    columns |= dict(zip(data.channels, reading.T, strict=True))
    time = run.start + run.period * np.arange(len(run.command))
    return Log(time, columns, {c: usual_unit(c, columns) for c in columns}, source=run.name)


def drive_position(machine: Machine, axis: str) -> str:
    """Name of where a drive stands: `length.boom`, or `angle.swing` without a cylinder."""
    kind = "length" if machine.axes[axis].cylinder else machine.position_kind(axis)
    return f"{kind}.{axis}"


def read_scene(machine: Machine, log: Log, sensors: str | None) -> Scene:
    """Signals of a run.

    Args:
        machine: the model.
        log: the run.
        sensors: name of the machine's sensors; None to find their noise from the data.

    Returns:
        Whatever the channels allow.

    Raises:
        InputError: the time stamps follow no clock, or the machine has no such sensors.
    """
    signals = read_signals(machine, log, sensors)
    values = {"time": signals.time - signals.time[0]}
    values |= {f"command.{axis}": v for axis, v in signals.command.items()}
    if signals.has("pressure_supply"):
        values["pressure_supply"] = signals.smoothed["pressure_supply"][0, 0]
    for axis in machine.axes:
        values |= _motion(machine, signals, axis)
        for side in ("head", "rod"):
            if signals.has(channel := f"pressure_{side}.{axis}"):
                values[channel], values[f"change_{side}.{axis}"] = signals.smoothed[channel][0, :2]
    _flows(machine, signals, values)
    return Scene(signals.period, values)


def _motion(machine: Machine, signals: Signals, axis: str) -> dict[str, np.ndarray]:
    motion = joint_motion(machine, signals, axis)
    if motion is None:
        return {}
    angle, rate, change = motion[0]
    linkage, cylinder = axis_linkage(machine, axis), machine.axes[axis].cylinder
    values = {
        f"{machine.position_kind(axis)}.{axis}": angle,
        f"rate.{axis}": np.asarray(linkage.rate(angle)) * rate,
        f"acceleration.{axis}": np.asarray(linkage.rate(angle)) * change,
    }
    if cylinder:
        values[f"length.{axis}"] = np.asarray(linkage.length(angle)) - cylinder.closed_length
    return values


def _flows(machine: Machine, signals: Signals, values: dict[str, np.ndarray]) -> None:
    """Add spools and the flows of the valves, and their totals where all are known."""
    drawn, given = [], []
    for axis, numbers in actuator_numbers(machine).items():
        if axis not in machine.hydraulic_axes or axis not in signals.command:
            continue
        values[f"spool.{axis}"] = spool_positions(machine, signals, axis)
        values[f"overlap.{axis}"] = np.full(len(signals.time), numbers[_DB])
        needed = f"pressure_head.{axis}", f"pressure_rod.{axis}", "pressure_supply"
        if all(name in values for name in needed):
            head, rod, supply = (values[name] for name in needed)
            flows = valve_flows(numbers, values[f"spool.{axis}"], supply, head, rod)
            full = valve_flows(numbers, np.sign(values[f"spool.{axis}"]), supply, head, rod)
            tank, smooth = numbers[_TANK], numbers[_D]
            for side, p, flow, most in zip(("head", "rod"), (head, rod), flows, full, strict=True):
                values[f"valve_{side}.{axis}"] = flow
                values[f"opened_{side}.{axis}"] = np.abs(most) * (1.0 if side == "head" else -1.0)
                drop = np.maximum(p - tank, smooth)
                values[f"drained_{side}.{axis}"] = np.maximum(-flow, 0.0) / (2.0 * drop)
            drawn.append(np.maximum(flows, 0.0).sum(axis=0))
            given.append(np.maximum(-flows, 0.0).sum(axis=0))
    if drawn and len(drawn) == len(machine.hydraulic_axes):
        values["demand"], values["return"] = np.sum(drawn, axis=0), np.sum(given, axis=0)


@compiled
def valve_flows(user, spool, supply, head, rod):
    """Flows of a valve into the chambers of its axis.

    Args:
        user: (SLOTS,) numbers of the axis' actuator.
        spool: (n,) spool positions [1].
        supply: (n,) supply pressure [Pa].
        head: (n,) head-side pressure [Pa].
        rod: (n,) rod-side pressure [Pa].

    Returns:
        (2, n) flows into head and rod chamber [m^3/s].

    Source: `hydraulics.circuit.chamber_flows`.
    """
    out = np.empty((2, len(spool)))
    for k in range(len(spool)):
        opening = valve_opening(spool[k], user[_DB])
        out[0, k], out[1, k], _, _ = chamber_flows(user, 0, opening, supply[k], head[k], rod[k])
    return out

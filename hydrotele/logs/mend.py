"""Takes out of the readings what no sensor in working order says; every change leaves a note."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.logs import stuck, value_range
from hydrotele.logs.refresh import refreshed_every, stale
from hydrotele.logs.rows import Rows
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import channel_sensor, converter
from hydrotele.machine.sensors import Sensor, SensorSet

_KEPT = 0.1  # of its readings a channel must keep in a run to be of use there
_NEAR = 3.0  # of its noise, within which a limit of a sensor cuts off some of it
_CLIPPED = 0.02  # of a run; a starved chamber reads 0 now and then on any machine
_RESOLVED = 1.0e-4  # of its span: what a sensor without a stated converter resolves, at worst
_STARVED = 0.5e6  # [Pa] above tank, where a chamber on its make-up valve may rest


class _Data(NamedTuple):
    """All runs of one machine and its sensors."""

    machine: Machine
    sensors: SensorSet | None
    axes: Sequence[str]
    channels: Sequence[str]
    noise: np.ndarray
    runs: dict[str, Rows]

    def column(self, channel: str, run: str) -> np.ndarray | None:
        """Readings (n,) of a channel in a run; None if the channel is unknown."""
        if channel not in self.channels:
            return None
        return self.runs[run].reading[:, list(self.channels).index(channel)]

    def span(self, channel: str) -> float:
        """Range of a channel over all runs [channel's unit], 0 without readings."""
        every = [self.column(channel, run) for run in self.runs]
        values = np.concatenate([v[np.isfinite(v)] for v in every if v is not None] or [[]])
        return float(np.ptp(values)) if len(values) else 0.0

    def sensor(self, channel: str) -> Sensor:
        """Sensor of a channel, with its span."""
        return channel_sensor(self.machine, self.sensors, channel)


def mend(
    machine: Machine, sensors: SensorSet | None, axes: Sequence[str], channels: Sequence[str],
    noise: np.ndarray, runs: Mapping[str, Rows],
) -> tuple[dict[str, Rows], tuple[str, ...]]:  # fmt: skip
    """Replace by NaN what is beyond a sensor, impossible, frozen or written twice.

    Args:
        machine: the machine.
        sensors: its sensors, None if unknown.
        axes: the nu axes, in the order of the commands.
        channels: the c channels.
        noise: (c,) standard deviation of one reading, NaN if unknown.
        runs: run -> rows.

    Returns:
        (run -> mended rows, notes).
    """
    copies = {name: rows._replace(reading=rows.reading.copy()) for name, rows in runs.items()}
    data = _Data(machine, sensors, axes, channels, noise, copies)
    notes: list[str] = []
    for column, channel in enumerate(channels):
        for run in data.runs:
            notes += _out_of_sensor(data, run, channel, noise[column])
            notes += _stale(data, run, channel)
    fresh = {name: rows.reading.copy() for name, rows in data.runs.items()}
    found = [(run, ch, _frozen(data, run, ch)) for run in data.runs for ch in channels]
    for run, channel, parts in found:  # after all were judged: a frozen one is a poor witness
        notes += _take_out_frozen(data, run, channel, parts)
    for run in data.runs:
        notes += _take_out_repeated_rows(data, run)
        notes += _take_out_useless(data, run, fresh[run])
    return data.runs, tuple(notes)


def _out_of_sensor(data: _Data, run: str, channel: str, noise: float) -> list[str]:
    reading, period, notes = data.column(channel, run), data.runs[run].period, []
    assert reading is not None
    if bad := int(np.isinf(reading).sum()):
        reading[np.isinf(reading)] = np.nan
        notes.append(f"{run}: {bad} infinite readings of {channel} were left out.")
    for what, noted, rows in (
        ("at the end of its sensor", _CLIPPED,
         value_range.clipped(data.sensor(channel), channel, reading, period)),
        ("which nothing physical explains", 0.0,
         value_range.spikes(data.machine, channel, reading, period, noise)),
    ):  # fmt: skip
        if rows.mean() > noted:
            first = data.runs[run].start + period * int(np.flatnonzero(rows)[0])
            notes.append(f"{run}: {rows.sum()} readings of {channel} {what} were left out, the"
                         f" first at {first:.6g} s.")  # fmt: skip
        reading[rows] = np.nan
    return notes


def _stale(data: _Data, run: str, channel: str) -> list[str]:
    """Leave out rows that only repeat a channel's last value because it is refreshed less often."""
    reading, period = data.column(channel, run), data.runs[run].period
    assert reading is not None
    every = refreshed_every(reading)
    if every == 1.0:
        return []
    step = period * float(np.median(np.diff(np.flatnonzero(np.isfinite(reading)))))
    reading[stale(reading, every)] = np.nan
    lasts = 1e3 * every * step
    return [f"{run}: {channel} is refreshed every {lasts:.3g} ms only; the rows between repeat it"
            " and count as missing."]  # fmt: skip


def _count(data: _Data) -> int:
    return sum(rows.reading.size for rows in data.runs.values())


def _frozen(data: _Data, run: str, channel: str) -> list[stuck.Stretch]:
    """Stretches of a run in which a channel is frozen, by the strictest test that applies."""
    reading, sensor, period = data.column(channel, run), data.sensor(channel), data.runs[run].period
    assert reading is not None
    probability = stuck.repeat_probability(sensor, channel)
    if probability and stuck.as_noisy_as_stated(sensor, channel, _floors(data, run, channel)):
        return stuck.frozen_by_noise(reading, probability, _count(data), period)
    kind, _, axis = channel.partition(".")
    if kind == "pressure_supply":  # rests at its relief for as long as it likes
        return []
    if kind.startswith("pressure"):
        other = "pressure_rod" if kind == "pressure_head" else "pressure_head"
        partner = data.column(f"{other}.{axis}", run)
        lowest = data.machine.return_pressure(axis) + _STARVED
        if partner is None:
            return []
        return stuck.frozen_chamber(reading, partner, lowest, period)
    if not np.isfinite(reading).any():
        return []
    return _frozen_position(data, run, channel, axis)


def _frozen_position(data: _Data, run: str, channel: str, axis: str) -> list[stuck.Stretch]:
    position = f"{data.machine.position_kind(axis)}.{axis}"
    partner = position if channel != position else f"length.{axis}"
    force = data.machine.axes[axis].force
    command = data.runs[run].command[:, list(data.axes).index(axis)]
    others = [data.column(f"{data.machine.position_kind(a)}.{a}", run) for a in data.axes]
    apart = [v for a, v in zip(data.axes, others, strict=True) if v is not None and a != axis]
    span = data.span(channel)
    reading = data.column(channel, run)
    assert reading is not None
    return stuck.frozen_by_motion(
        reading, data.column(partner, run), command / (force.command_limit if force else 1.0),
        np.column_stack(apart) if apart else np.empty((len(command), 0)),
        converter(data.sensor(channel), channel).step or _RESOLVED * span,
        (span, data.span(partner)), data.runs[run].period,
    )  # fmt: skip


def _floors(data: _Data, run: str, channel: str) -> list[float]:
    """Noise floors of the channel here, in other runs, and of others with an equal sensor."""
    sensor, witnesses = data.sensor(channel), [(channel, run)]
    witnesses += [(channel, other) for other in data.runs if other != run]
    kind = channel.partition("_")[0].partition(".")[0]
    witnesses += [
        (c, r) for c in data.channels for r in data.runs
        if c != channel and c.startswith(kind) and data.sensor(c).error_rms == sensor.error_rms
    ]  # fmt: skip
    floors = (stuck.noise_floor(v) for c, r in witnesses
              if (v := data.column(c, r)) is not None)  # fmt: skip
    return [next((floor for floor in floors if math.isfinite(floor)), math.nan)]


def _take_out_frozen(data: _Data, run: str, channel: str, parts) -> list[str]:
    if not parts:
        return []
    reading, rows = data.column(channel, run), data.runs[run]
    assert reading is not None
    spans = [f"from {rows.start + rows.period * a:.6g} to {rows.start + rows.period * b:.6g} s"
             for a, b in parts]  # fmt: skip
    listed = ", ".join(spans[:3]) + (f" and {len(spans) - 3} times more" if spans[3:] else "")
    value = np.nanmedian(reading[slice(*parts[0])])
    said = f"{run}: {channel} is stuck at {value:.6g} {listed}; these readings were left out."
    if stuck.saturated(reading, parts):
        noise = float(data.noise[list(data.channels).index(channel)])
        near = np.abs(reading - value) <= _NEAR * (noise if math.isfinite(noise) else 0.0)
        reading[near] = np.nan
        said = f"{run}: {channel} does not get beyond {value:.6g}, as {listed}; left out there."
    for part in parts:
        reading[slice(*part)] = np.nan
    return [said]


def _take_out_repeated_rows(data: _Data, run: str) -> list[str]:
    rows = data.runs[run]
    odds = [stuck.repeat_probability(data.sensor(c), c) for c in data.channels]
    odds = [p if p and stuck.as_noisy_as_stated(data.sensor(c), c, _floors(data, run, c))
            else None for c, p in zip(data.channels, odds, strict=True)]  # fmt: skip
    again = stuck.repeated_rows(rows.reading, odds, _count(data))
    if not again.any():
        return []
    rows.reading[again] = np.nan
    same = np.append(False, (np.diff(rows.command, axis=0) == 0.0).all(axis=1))
    data.runs[run] = rows._replace(known=rows.known & ~(again & same))
    return [f"{run}: {again.sum()} rows repeat all readings of the row before, which their noise"
            " forbids; they count as missing."]  # fmt: skip


def _take_out_useless(data: _Data, run: str, before: np.ndarray) -> list[str]:
    notes, after = [], data.runs[run].reading
    had, has = np.isfinite(before).sum(axis=0), np.isfinite(after).sum(axis=0)
    for column, channel in enumerate(data.channels):
        if not 0 < has[column] < _KEPT * had[column]:
            continue
        after[:, column] = np.nan
        notes.append(f"{run}: {channel} has too few good readings and was left out"
                     " of this run.")  # fmt: skip
    return notes

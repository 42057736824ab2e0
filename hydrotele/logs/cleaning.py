"""Replace faulty readings of logs by NaN; every change is recorded in a note."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.logs.faulty_readings import (
    Interval,
    are_repeats_at_extreme,
    equal_reading_probability,
    estimate_noise,
    find_duplicated_rows,
    find_frozen_by_noise,
    find_frozen_position,
    find_frozen_pressure,
    find_readings_without_update,
    find_saturated,
    find_spikes,
    is_noise_as_stated,
    readings_per_update,
)
from hydrotele.logs.resampling import RunRows
from hydrotele.machine.machine import Machine, find_channel_sensor
from hydrotele.machine.sensors import Sensor, SensorSet, make_channel_converter

_MIN_KEPT_FRACTION = 0.1  # minimum fraction of readings that a channel must keep in a run
_LIMIT_NOISE_RATIO = 3.0  # noise standard deviations from a sensor limit within which readings are removed
_MAX_SATURATED_FRACTION = 0.02  # fraction of a run; any machine has some chamber pressures of 0
_DEFAULT_RESOLUTION = 1.0e-4  # worst resolution of a sensor without a stated converter, relative to its span
_REASONS = {
    "at the limit of the sensor": "at the limit of the sensor, which the machine file states as its span",
    "that are physically impossible": "physically impossible for the machine",
}
_STARVED_PRESSURE = 0.5e6  # [Pa] above tank pressure, range in which a make-up valve may hold a pressure


class _CleaningData(NamedTuple):
    """All runs of one machine, with its sensors and noise, and the number of removed readings by reason.

    Attributes:
        machine: the machine.
        sensors: sensors of the machine, None if unknown.
        axes: the nu axes, in the order of the commands.
        channels: the c channels, in the order of the readings.
        noise: (c,) noise standard deviation of one reading, NaN if unknown.
        runs: run -> rows; the readings are changed in place.
        removed: (channel, run) -> reason -> number of removed readings.
    """

    machine: Machine
    sensors: SensorSet | None
    axes: Sequence[str]
    channels: Sequence[str]
    noise: np.ndarray
    runs: dict[str, RunRows]
    removed: dict[tuple[str, str], dict[str, int]]

    def count_removed(self, channel: str, run: str, reason: str, count: int) -> None:
        """Add to the number of readings of a channel that were removed from a run for a reason."""
        counts = self.removed.setdefault((channel, run), {})
        counts[reason] = counts.get(reason, 0) + count

    def column(self, channel: str, run: str) -> np.ndarray | None:
        """Return the readings (n,) of a channel in a run; None if the data have no such channel."""
        if channel not in self.channels:
            return None
        return self.runs[run].reading[:, list(self.channels).index(channel)]

    def span(self, channel: str) -> float:
        """Return maximum minus minimum of a channel over all runs [channel's unit]; 0 without readings."""
        every = [self.column(channel, run) for run in self.runs]
        values = np.concatenate([v[np.isfinite(v)] for v in every if v is not None] or [[]])
        return float(np.ptp(values)) if len(values) else 0.0

    def sensor(self, channel: str) -> Sensor:
        """Return the properties of a channel's sensor: noise, resolution and span."""
        return find_channel_sensor(self.machine, self.sensors, channel)


class CleanedRuns(NamedTuple):
    """Runs without faulty readings.

    Attributes:
        runs: run -> rows; removed readings are NaN.
        notes: one sentence per kind of fault, channel and run, on the removed readings.
        unused_channels: one sentence per channel without a usable reading in a run, with the
            reason.
    """

    runs: dict[str, RunRows]
    notes: tuple[str, ...]
    unused_channels: tuple[str, ...]


def remove_faults(
    machine: Machine, sensors: SensorSet | None, axes: Sequence[str], channels: Sequence[str],
    noise: np.ndarray, runs: Mapping[str, RunRows],
) -> CleanedRuns:  # fmt: skip
    """Return copies of runs in which faulty readings are NaN, with notes on the removed readings.

    Faulty are infinite, saturated, impossible, frozen, repeated and duplicated readings. If the
    removal of frozen and duplicated readings leaves a channel less than a tenth of its readings in
    a run, all its readings in this run are removed.

    Args:
        machine: the machine.
        sensors: sensors of the machine, None if unknown.
        axes: the nu axes, in the order of the commands.
        channels: the c channels.
        noise: (c,) noise standard deviation of one reading, NaN if unknown.
        runs: run -> rows.

    Returns:
        The cleaned runs.
    """
    copies = {name: rows._replace(reading=rows.reading.copy()) for name, rows in runs.items()}
    data = _CleaningData(machine, sensors, axes, channels, noise, copies, {})
    notes: list[str] = []
    for column, channel in enumerate(channels):
        for run in data.runs:
            notes += _remove_impossible_readings(data, run, channel, noise[column])
            notes += _remove_repeated_readings(data, run, channel)
    fresh = {name: rows.reading.copy() for name, rows in data.runs.items()}
    found = [(run, ch, _find_frozen_intervals(data, run, ch)) for run in data.runs for ch in channels]
    for run, channel, parts in found:  # after all tests, which compare channels with each other
        notes += _remove_frozen_readings(data, run, channel, parts)
    for run in data.runs:
        notes += _remove_duplicated_rows(data, run)
        notes += _remove_sparse_channels(data, run, fresh[run])
    return CleanedRuns(data.runs, tuple(notes), _list_unused_channels(data, runs))


def _list_unused_channels(data: _CleaningData, before: Mapping[str, RunRows]) -> tuple[str, ...]:
    """Return one sentence per channel that lost all its readings in some runs, with these runs and the reasons.

    Args:
        data: the cleaned runs, and the numbers of removed readings.
        before: the same runs before cleaning; channels that had no reading there are not listed.
    """
    reasons: dict[tuple[str, str], list[str]] = {}
    for column, channel in enumerate(data.channels):
        for run, rows in data.runs.items():
            logged = int((~np.isnan(before[run].reading[:, column])).sum())
            if not logged or np.isfinite(rows.reading[:, column]).any():
                continue
            counts = data.removed.get((channel, run), {})
            listed = ", ".join(
                f"{100 * count / logged:.0f} % of its readings are {why}" for why, count in counts.items()
            )
            reasons.setdefault((channel, listed), []).append(run)
    return tuple(
        f"{channel} is not used{'' if len(runs) == len(data.runs) else ' in ' + ', '.join(runs)}: {reason}."
        for (channel, reason), runs in reasons.items()
    )


def _remove_impossible_readings(data: _CleaningData, run: str, channel: str, noise: float) -> list[str]:
    reading, period, notes = data.column(channel, run), data.runs[run].period, []
    assert reading is not None
    if bad := int(np.isinf(reading).sum()):
        reading[np.isinf(reading)] = np.nan
        notes.append(f"{run}: {bad} infinite readings of {channel} were removed.")
        data.count_removed(channel, run, "infinite", bad)
    for what, noted, rows in (
        ("at the limit of the sensor", _MAX_SATURATED_FRACTION,
         find_saturated(data.sensor(channel), channel, reading, period)),
        ("that are physically impossible", 0.0,
         find_spikes(data.machine, channel, reading, period, noise)),
    ):  # fmt: skip
        if rows.mean() > noted:
            first = data.runs[run].start + period * int(np.flatnonzero(rows)[0])
            notes.append(f"{run}: {rows.sum()} readings of {channel} {what} were removed, the"
                         f" first at {first:.6g} s.")  # fmt: skip
        if rows.any():
            data.count_removed(channel, run, _REASONS[what], int(rows.sum()))
        reading[rows] = np.nan
    return notes


def _remove_repeated_readings(data: _CleaningData, run: str, channel: str) -> list[str]:
    """Replace readings by NaN that only repeat the last update of a slow channel.

    Returns:
        A list with one note, or an empty list if each reading of the channel is an update.
    """
    reading, period = data.column(channel, run), data.runs[run].period
    assert reading is not None
    every = readings_per_update(reading)
    if every == 1.0:
        return []
    step = period * float(np.median(np.diff(np.flatnonzero(np.isfinite(reading)))))
    repeated = find_readings_without_update(reading, every)
    data.count_removed(channel, run, "repetitions of a slow channel", int(repeated.sum()))
    reading[repeated] = np.nan
    lasts = 1e3 * every * step
    return [f"{run}: {channel} is updated only every {lasts:.3g} ms; the repeated values in"
            " between count as missing."]  # fmt: skip


def _count_readings(data: _CleaningData) -> int:
    return sum(rows.reading.size for rows in data.runs.values())


def _find_frozen_intervals(data: _CleaningData, run: str, channel: str) -> list[Interval]:
    """Find the intervals of a run in which a channel is frozen, that is, repeats a value although it must change.

    If the sensor is as noisy as stated, equal readings for longer than its noise allows are
    sufficient. Otherwise another channel must also show that the machine moved or the pressure
    changed.
    """
    reading, sensor, period = data.column(channel, run), data.sensor(channel), data.runs[run].period
    assert reading is not None
    probability = equal_reading_probability(sensor, channel)
    if probability and is_noise_as_stated(sensor, channel, _first_noise_estimate(data, run, channel)):
        return find_frozen_by_noise(reading, probability, _count_readings(data), period)
    kind, _, axis = channel.partition(".")
    if kind in ("pressure_supply", "velocity"):  # may be constant at the relief pressure, or 0, for any time
        return []
    if kind.startswith("pressure"):
        other = "pressure_rod" if kind == "pressure_head" else "pressure_head"
        partner = data.column(f"{other}.{axis}", run)
        lowest = data.machine.return_pressure(axis) + _STARVED_PRESSURE
        if partner is None:
            return []
        return find_frozen_pressure(reading, partner, lowest, period)
    if not np.isfinite(reading).any():
        return []
    return _find_frozen_positions(data, run, channel, axis)


def _find_frozen_positions(data: _CleaningData, run: str, channel: str, axis: str) -> list[Interval]:
    position = f"{data.machine.position_kind(axis)}.{axis}"
    partner = position if channel != position else f"length.{axis}"
    force = data.machine.axes[axis].force
    command = data.runs[run].command[:, list(data.axes).index(axis)]
    others = [data.column(f"{data.machine.position_kind(a)}.{a}", run) for a in data.axes]
    apart = [v for a, v in zip(data.axes, others, strict=True) if v is not None and a != axis]
    span = data.span(channel)
    reading = data.column(channel, run)
    assert reading is not None
    return find_frozen_position(
        reading, data.column(partner, run), command / (force.command_limit if force else 1.0),
        np.column_stack(apart) if apart else np.empty((len(command), 0)),
        make_channel_converter(data.sensor(channel), channel).step or _DEFAULT_RESOLUTION * span,
        (span, data.span(partner)), data.runs[run].period,
    )  # fmt: skip


def _first_noise_estimate(data: _CleaningData, run: str, channel: str) -> list[float]:
    """Return a list with one noise standard deviation of a channel, estimated from readings; NaN if impossible.

    The first finite estimate is used: from this run, from other runs, or from channels of the same
    kind whose sensor has the same stated noise.
    """
    sensor, witnesses = data.sensor(channel), [(channel, run)]
    witnesses += [(channel, other) for other in data.runs if other != run]
    kind = channel.partition("_")[0].partition(".")[0]
    witnesses += [
        (c, r) for c in data.channels for r in data.runs
        if c != channel and c.startswith(kind) and data.sensor(c).error_rms == sensor.error_rms
    ]  # fmt: skip
    floors = (estimate_noise(v) for c, r in witnesses
              if (v := data.column(c, r)) is not None)  # fmt: skip
    return [next((floor for floor in floors if math.isfinite(floor)), math.nan)]


def _remove_frozen_readings(data: _CleaningData, run: str, channel: str, parts) -> list[str]:
    if not parts:
        return []
    reading, rows = data.column(channel, run), data.runs[run]
    assert reading is not None
    spans = [f"from {rows.start + rows.period * a:.6g} to {rows.start + rows.period * b:.6g} s"
             for a, b in parts]  # fmt: skip
    listed = ", ".join(spans[:3]) + (f" and {len(spans) - 3} more times" if spans[3:] else "")
    value = np.nanmedian(reading[slice(*parts[0])])
    said = f"{run}: {channel} is frozen at {value:.6g} {listed}; these readings were removed."
    before, reason = np.isfinite(reading).sum(), "frozen"
    if are_repeats_at_extreme(reading, parts):
        noise = float(data.noise[list(data.channels).index(channel)])
        near = np.abs(reading - value) <= _LIMIT_NOISE_RATIO * (noise if math.isfinite(noise) else 0.0)
        reading[near] = np.nan
        reason = "saturated"
        said = f"{run}: {channel} is saturated at {value:.6g} {listed}; these readings were removed."
    for part in parts:
        reading[slice(*part)] = np.nan
    data.count_removed(channel, run, reason, int(before - np.isfinite(reading).sum()))
    return [said]


def _remove_duplicated_rows(data: _CleaningData, run: str) -> list[str]:
    rows = data.runs[run]
    odds = [equal_reading_probability(data.sensor(c), c) for c in data.channels]
    odds = [p if p and is_noise_as_stated(data.sensor(c), c, _first_noise_estimate(data, run, c))
            else None for c, p in zip(data.channels, odds, strict=True)]  # fmt: skip
    again = find_duplicated_rows(rows.reading, odds, _count_readings(data))
    if not again.any():
        return []
    rows.reading[again] = np.nan
    same = np.append(False, (np.diff(rows.command, axis=0) == 0.0).all(axis=1))
    data.runs[run] = rows._replace(known=rows.known & ~(again & same))
    return [f"{run}: {again.sum()} rows are duplicates of the previous row, because noisy readings"
            " do not repeat; they count as missing."]  # fmt: skip


def _remove_sparse_channels(data: _CleaningData, run: str, before: np.ndarray) -> list[str]:
    notes, after = [], data.runs[run].reading
    had, has = np.isfinite(before).sum(axis=0), np.isfinite(after).sum(axis=0)
    for column, channel in enumerate(data.channels):
        if not 0 < has[column] < _MIN_KEPT_FRACTION * had[column]:
            continue
        after[:, column] = np.nan
        data.count_removed(channel, run, "too few to be used", int(has[column]))
        notes.append(f"{run}: {channel} has too few usable readings and was removed from this"
                     " run.")  # fmt: skip
    return notes

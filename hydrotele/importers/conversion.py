"""Convert recordings of other programs to one log of hydrotele with common rows.

The group with the most rows states the time of the rows. Columns of other groups are placed on these
rows: commands are held, readings are interpolated linearly. A reading of a slower group appears only in
the row that is nearest to it, so that no reading is used twice. Where a group has a hole, the readings are
missing (NaN). The time of a group is that of its messages (`header.stamp`), or else that at which they were
received.
"""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

import hydrotele
from hydrotele.core.errors import InputError
from hydrotele.importers.readers import read_recording
from hydrotele.importers.recordings import Group, Recording
from hydrotele.logs.clock import estimate_clock_offset, fit_clock
from hydrotele.logs.log import CommandRange, Log, convert_mask_column, make_log, normalise_commands
from hydrotele.logs.table import Table
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.log_columns import SKIP_COLUMN, LogColumn

_MAX_STEP_RATIO = 1.5  # a group whose median step is longer than this multiple of that of the rows is slower
_MAX_DISTANCE_RATIO = 0.75  # of the median step of a group: between 0.5, in a full sequence, and 1, at a missing sample
_MAX_SPARSE_FRACTION = 0.5  # of the rows of a group: a column with values in fewer rows has separate times
_MAX_STEP_BACK = 1.0  # [s] of stamps: longer than any delay by which messages overtake each other
_HELD_KINDS = ("command", "valid", "reference")
_KEPT_METADATA = ("machine", "tool", "sensors")


@dataclass
class ChannelReport:
    """Origin of one channel of an imported log.

    Attributes:
        channel: name of the channel.
        source: column of the recording.
        samples: number of values in the recording.
        rate: median rate of these values [Hz].
        placement: `rows` for a column of the group with the time of the rows, otherwise `interpolated`,
            `nearest row` or `held`.
        missing: fraction of the rows without a value.
    """

    channel: str
    source: str
    samples: int
    rate: float
    placement: str
    missing: float


@dataclass
class ImportReport:
    """What an import read, ignored and repaired.

    Attributes:
        channels: the channels of the log.
        ignored: topic or column that was not mapped -> number of its messages or rows.
        unused: entries of the mapping that the recordings do not contain.
        notes: one sentence per decision or repair.
    """

    channels: list[ChannelReport] = field(default_factory=list)
    ignored: dict[str, int] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class _Series(NamedTuple):
    """Values of one channel: entry of the mapping, group, time (n,) [s] and value (n,), without missing ones."""

    key: str
    entry: LogColumn
    group: str
    time: np.ndarray
    value: np.ndarray
    unit: str | None = None


def import_log(
    paths: Sequence[Path],
    columns: Mapping[str, LogColumn],
    commands: Mapping[str, CommandRange] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> tuple[Log, ImportReport]:
    """Convert the recordings of one run to a log.

    Args:
        paths: bags, MATLAB files, CSV or Parquet files of the same run.
        columns: mapping of the columns, see `machine.log_columns`. Columns that are named like a
            channel need no entry.
        commands: command channel -> range of its column, as for `load_log`.
        metadata: metadata of the log, in addition to the version of hydrotele and to machine, tool and sensors
            that the recordings state.

    Returns:
        (log, report).

    Raises:
        InputError: a recording cannot be read, or no column is mapped; the message gives the remedy.
    """
    report = ImportReport()
    times = {key: entry for key, entry in columns.items() if entry.channel == "time"}
    wanted = {k for k, entry in columns.items() if entry.channel not in (SKIP_COLUMN, "time")}
    wanted |= {entry.minus for entry in columns.values() if entry.minus}
    recordings = [_read_with_channel_names(path, wanted, times) for path in paths]
    for recording in recordings:
        report.notes += recording.notes
        report.ignored |= {name: count for name, count in recording.ignored.items() if name not in columns}
    series = _collect_series(recordings, columns, report)
    if not series:
        raise InputError(", ".join(map(str, paths)), _nothing_mapped_message(columns, report))
    series = _align_repeated_channels(series, report)
    main = max(series, key=lambda item: len(item.time))
    names: list[str] = ["time"]
    values: list[np.ndarray] = [main.time]
    units: list[str | None] = ["s"]
    for item in series:
        channel = item.entry.channel
        if channel in names:
            continue
        placed, placement = _place_on_rows(main.time, item, parse_channel_kind(channel) in _HELD_KINDS)
        names.append(channel)
        values.append(placed)
        units.append(item.unit)
        known, missing = _drop_missing_values(item), float(np.mean(~np.isfinite(placed)))
        rate = 1.0 / _median_step(known.time) if len(known.time) > 1 else 0.0
        report.channels.append(ChannelReport(channel, item.key, len(known.time), rate, placement, missing))
    if (origin := recordings[0].origin) is not None:
        values[0] = np.rint((main.time - main.time[0]) * 1e9) / 1e9
        start = datetime.datetime.fromtimestamp(origin / 1e9 + main.time[0], datetime.UTC)
        report.notes.append(f"time 0 is {start.isoformat(timespec='milliseconds')}.")
    kept = {k: v for recording in reversed(recordings) for k, v in recording.metadata.items() if k in _KEPT_METADATA}
    known = {**kept, "hydrotele": hydrotele.__version__, **(metadata or {})}
    table = Table(", ".join(map(str, paths)), names, values, units, known)
    log = make_log(normalise_commands(convert_mask_column(table), commands or {}))
    report.notes += log.notes
    return log, report


def parse_channel_kind(channel: str) -> str:
    """Return the kind of a channel, or the name itself if it is no channel."""
    try:
        return parse_channel(channel).kind
    except ValueError:
        return channel


def _read_with_channel_names(path: Path, wanted: set, times: Mapping[str, LogColumn]) -> Recording:
    """Read the requested columns of a recording, and those of a table or MATLAB file that are named like channels."""
    recording = read_recording(path, wanted, times)
    own = {name for name in recording.ignored if name not in wanted and parse_channel_kind(name) != name}
    own |= {name for name in recording.ignored if name in ("mask", "valid", "pressure_supply")}
    return read_recording(path, wanted | own, times) if own else recording


def _nothing_mapped_message(columns: Mapping[str, LogColumn], report: ImportReport) -> str:
    listed = sorted(report.ignored, key=lambda name: -report.ignored[name])
    has = f"it has {', '.join(listed[:12])}{' ...' if len(listed) > 12 else ''}" if listed else "it has no columns"
    if columns:
        return f"contains none of the columns of the mapping ({', '.join(list(columns)[:8])}); {has}"
    return (
        f"has no column that is named like a channel, and no mapping was given; {has}. Write a proposal with"
        " --write-mapping FILE.yaml, check it, and give it with --mapping FILE.yaml"
    )


def _collect_series(recordings: Sequence[Recording], columns: Mapping[str, LogColumn], report) -> list[_Series]:
    """Return the converted values of all mapped columns, in the order of the mapping."""
    groups: dict[str, Group] = {}
    found: dict[str, str] = {}
    for number, recording in enumerate(recordings):
        for group in sorted(recording.groups, key=lambda g: -len(g.name)):  # a topic before its prefix
            label = f"{number}:{group.name}"
            groups[label] = group
            for name in group.columns:
                found.setdefault(name, label)
    times = _choose_times(groups, recordings, report)
    subtracted = {entry.minus for entry in columns.values() if entry.minus}
    own = {name: LogColumn(channel=name) for name in found if name not in columns and name not in subtracted}
    series = []
    for key, entry in {**columns, **own}.items():
        if entry.channel in (SKIP_COLUMN, "time"):
            continue
        if absent := [name for name in (key, entry.minus) if name and name not in found]:
            report.unused += absent
            continue
        label = found[key]
        group, values = groups[label], groups[label].columns[key]
        minus = None
        if entry.minus and found[entry.minus] == label:
            minus = group.columns[entry.minus]
        elif entry.minus:
            place = found[entry.minus]
            other = _sort_by_time(
                _drop_missing_values(_Series("", entry, "", times[place], groups[place].columns[entry.minus]))
            )
            minus = np.interp(times[label], other.time, other.value)
        unit = entry.unit or group.units.get(key)
        series.append(_Series(key, entry, label, times[label], entry.convert(values, minus), unit))
        if np.isfinite(values).mean() <= _MAX_SPARSE_FRACTION:
            series[-1] = _drop_missing_values(series[-1])._replace(group=f"{label} {key}")
    return series


def _choose_times(groups: Mapping[str, Group], recordings: Sequence[Recording], report) -> dict[str, np.ndarray]:
    """Return the time (n,) [s] of each group on a common clock.

    The clocks of two groups are different if the shortest delay between measurement and reception
    differs by more than one row. The time of the second group is then shifted by the difference.
    """
    times: dict[str, np.ndarray] = {}
    delays: dict[str, np.ndarray | None] = {}
    start = recordings[0].origin
    for label, group in groups.items():
        recording = recordings[int(label.partition(":")[0])]
        stamped, why = group.stamped, ""
        if stamped is not None and (np.diff(stamped) < -_MAX_STEP_BACK).any():
            why = "the clock of the stamps was set back"
        elif stamped is not None and len(np.unique(stamped)) < 0.5 * len(stamped):
            why = "most stamps are 0 or repeated"
        used = group.received if stamped is None or why else stamped
        if stamped is not None:
            said = f"of reception is used: {why}" if why else "of the message stamps is used"
            report.notes.append(f"{group.name}: the time {said}.")
        delays[label] = None if used is group.received else group.received - used
        times[label] = used
        if start is not None and recording.origin is not None:
            times[label] = used + (recording.origin - start) / 1e9
    if not groups:
        return times
    main = max(groups, key=lambda label: len(times[label]))
    period = _median_step(times[main])
    shortest = {label: 0.0 if delay is None else float(delay.min()) for label, delay in delays.items()}
    for label, delay in delays.items():
        difference = shortest[label] - shortest[main]
        if label.partition(":")[0] == main.partition(":")[0] and abs(difference) > period:
            times[label] = times[label] + difference
            report.notes.append(
                f"{groups[label].name}: its clock was shifted by {difference:+.6g} s: the shortest delay between stamp"
                f" and reception is {shortest[label]:.4g} s, that of {groups[main].name} {shortest[main]:.4g} s."
            )
        if delay is not None and any(other is None for other in delays.values()):
            quarter = max(len(delay) // 4, 1)
            drift = float(np.median(delay[-quarter:]) - np.median(delay[:quarter]))
            if abs(drift) > period:
                times[label] = groups[label].received
                report.notes.append(
                    f"{groups[label].name}: the time of reception is used, because other topics have no stamps and the"
                    f" clock of the stamps drifts by {drift:.3g} s."
                )
    return times


def _align_repeated_channels(series: list[_Series], report) -> list[_Series]:
    """Shift the times of groups that repeat a channel of another group, so that both agree.

    All groups of a second recording are shifted together.
    """
    first: dict[str, _Series] = {}
    shifts: dict[str, float] = {}
    for item in series:
        main = first.setdefault(item.entry.channel, item)
        if main is item or main.group == item.group:
            continue
        recording, own = (label.partition(":")[0] for label in (item.group, main.group))
        target = item.group if recording == own else recording
        if target in shifts:
            continue
        offset = _estimate_offset(main, item)
        if offset is None:
            report.notes.append(
                f"{item.key}: repeats {item.entry.channel}, but does not determine the offset to the clock of"
                f" {main.key}; it is not used."
            )
            continue
        shifts[target] = offset
        report.notes.append(
            f"{item.key}: repeats {item.entry.channel}; the clock of {target.partition(':')[2] or 'its file'} was"
            f" shifted by {offset:+.6g} s, which aligns it with {main.key}."
        )
    shifted = [
        item._replace(time=item.time + shift) if (shift := _find_shift(shifts, item.group)) else item for item in series
    ]
    starts = {label: min(i.time[0] for i in shifted if i.group.startswith(f"{label}:"))
              for label in dict.fromkeys(i.group.partition(":")[0] for i in shifted)}  # fmt: skip
    return _note_unaligned_recordings(shifted, shifts, starts, report)


def _find_shift(shifts: Mapping[str, float], group: str) -> float:
    return shifts.get(group, 0.0) + shifts.get(group.partition(":")[0], 0.0)


def _note_unaligned_recordings(series: list[_Series], shifts, starts: Mapping[str, float], report) -> list[_Series]:
    """Note recordings whose clock is unknown; let those that do not overlap with the first one begin with it."""
    labels = list(starts)
    result = list(series)
    for label in labels[1:]:
        if label in shifts:
            continue
        first = [i for i in series if i.group.startswith(f"{labels[0]}:")]
        own = [i for i in series if i.group.startswith(f"{label}:")]
        apart = max(i.time[-1] for i in own) < starts[labels[0]] or max(i.time[-1] for i in first) < starts[label]
        said = "both are taken to begin at the same time" if apart else "0 is assumed"
        report.notes.append(
            f"{own[0].key}: no channel that both files contain determines the offset of its clock to that of"
            f" {first[0].key}; {said}. An offset would appear as a common delay of its channels."
        )
        if apart:
            shift = starts[labels[0]] - starts[label]
            result = [i._replace(time=i.time + shift) if i in own else i for i in result]
    return result


def _estimate_offset(main: _Series, other: _Series) -> float | None:
    clocks = []
    for item in map(_sort_by_time, map(_drop_missing_values, (main, other))):
        if len(item.time) < 2:
            return None
        try:
            clock, _ = fit_clock(item.time, item.key)
        except InputError:
            return None
        clocks += [clock, item.value[clock.row][:, None]]
    return estimate_clock_offset(*clocks)


def _drop_missing_values(item: _Series) -> _Series:
    """Return a series without missing values."""
    known = np.isfinite(item.value) & np.isfinite(item.time)
    return item if known.all() else item._replace(time=item.time[known], value=item.value[known])


def _sort_by_time(item: _Series) -> _Series:
    """Return a series with increasing times; of values with the same time the last one is used."""
    if (np.diff(item.time) > 0.0).all():
        return item
    order = np.argsort(item.time, kind="stable")
    time, value = item.time[order], item.value[order]
    last = np.append(np.diff(time) > 0.0, True)
    return item._replace(time=time[last], value=value[last])


def _median_step(time: np.ndarray) -> float:
    step = np.diff(time)
    return float(np.median(step[step > 0.0])) if (step > 0.0).any() else 1.0


def _place_on_rows(rows: np.ndarray, item: _Series, held: bool) -> tuple[np.ndarray, str]:
    """Return the values of a series at the times of the rows (n,) [s], NaN where it has none, and how they were found.

    `held` is whether a value remains valid until the next one.
    """
    if item.time is rows or np.array_equal(item.time, rows):
        return item.value, "rows"
    known = _sort_by_time(_drop_missing_values(item))
    if held:
        middle = rows + 0.5 * _median_step(rows)  # a value is held until the next row
        latest = np.searchsorted(known.time, middle, side="right") - 1
        return np.where(latest >= 0, known.value[np.maximum(latest, 0)], np.nan), "held"
    value = np.interp(rows, known.time, known.value)
    after = np.clip(np.searchsorted(known.time, rows), 1, len(known.time) - 1) if len(known.time) > 1 else 0
    distance = np.minimum(np.abs(rows - known.time[after]), np.abs(rows - known.time[np.maximum(after, 1) - 1]))
    step, row_step = _median_step(known.time), _median_step(rows)
    inside = (rows >= known.time[0]) & (rows <= known.time[-1])
    if step <= _MAX_STEP_RATIO * row_step:
        return np.where(inside & (distance <= _MAX_DISTANCE_RATIO * step), value, np.nan), "interpolated"
    order = np.argsort(rows, kind="stable")
    right = np.clip(np.searchsorted(rows[order], known.time), 1, len(rows) - 1)
    nearer = known.time - rows[order[right - 1]] < rows[order[right]] - known.time
    nearest = np.unique(order[np.where(nearer, right - 1, right)])
    result = np.full(len(rows), np.nan)
    result[nearest] = value[nearest]
    return np.where(distance <= row_step, result, np.nan), "nearest row"

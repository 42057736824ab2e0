"""Write one or more logs as a rerun recording: 3D machines, plots of all channels, differences.

Each log is logged below its own root entity; all logs share the timeline `time` [s].
"""

import os
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.show.channels import (
    assign_axis_colours,
    common_channels,
    compute_channel_difference,
    group_channels,
    scale_channel_for_plot,
)
from hydrotele.show.logged_poses import (
    extract_joint_motion,
)
from hydrotele.show.rerun_blueprint import Plot, make_blueprint
from hydrotele.show.rerun_scene import log_scene
from hydrotele.show.rerun_stream import entity_path, open_recording, time_column

if TYPE_CHECKING:
    import rerun as rr

_ENTRY_NAME = re.compile(r"[a-z][a-z0-9_]*")
_RESERVED_NAMES = ("about", "difference", "ground")
_WHITE_FRACTION = 0.65  # fraction of white in the line colours of all logs but the first


def write_recording(
    path: str | os.PathLike,
    entries: Mapping[str, tuple[Machine, Log]],
    title: str = "",
) -> None:
    """Write logs with their machines to one `.rrd` file, completely or not at all.

    The first entry is the reference: its machine is solid, the other machines are transparent. For
    each channel in common, `/difference/<entry>/<channel>` is the first log minus the other one at
    the times of the first.

    Args:
        path: file to write, with the suffix `.rrd`.
        entries: {root entity, such as `measured`: (machine, log)}, the reference first.
        title: name of the recording, default machine and runs.

    Raises:
        InputError: a name is not a valid root entity, two logs do not overlap in time, a linkage
            cannot be closed at the logged angles, or the file cannot be written.
    """
    _check_names(entries)
    machine, _ = next(iter(entries.values()))
    runs = " and ".join(dict.fromkeys(entry_log.name for _, entry_log in entries.values()))
    with open_recording(path, f"hydrotele {machine.name} {machine.tool} {' '.join(entries)}") as out:
        out.send_recording_name(title or f"{machine.name} {runs}")
        scene = log_scene(out, entries)
        plots = _log_channels(out, entries)
        differences = _log_differences(out, entries)
        out.log("about", _about_document(entries), static=True)
        first, *others = entries
        minus = f"{first} - {' or '.join(others)}"
        out.send_blueprint(make_blueprint(plots, differences, scene, minus))


def _check_names(entries: Mapping[str, tuple[Machine, Log]]) -> None:
    if not entries:
        raise InputError("recording", "holds no log: give at least one machine with its log")
    for name in entries:
        if not _ENTRY_NAME.fullmatch(name) or name in _RESERVED_NAMES:
            raise InputError(
                f"recording entry {name!r}",
                f"use lower-case letters, digits and _, and none of {', '.join(_RESERVED_NAMES)}",
            )


def _log_channels(stream, entries) -> list[Plot]:
    import rerun as rr

    logs = [log for _, log in entries.values()]
    palette, drawn = assign_axis_colours(logs), {}
    for rank, (name, (_, log)) in enumerate(entries.items()):
        clock, groups = time_column(log.time), group_channels(log.columns)
        members = {channel: kind for kind, some in groups.items() for channel in some}
        for channel in log.columns:
            trace = scale_channel_for_plot(log, channel)
            path = entity_path(name, channel)
            label = f"{name} {trace.legend_name}" if len(entries) > 1 else trace.legend_name
            width = 1.0 if rank else 3.0 if len(entries) > 1 else 1.6
            style = _line_style(palette[trace.channel.axis], f"{label} [{trace.unit}]", rank, width)
            stream.log(path, style, static=True)
            stream.send_columns(path, [clock], rr.Scalars.columns(scalars=trace.values))
            if channel in members:
                drawn.setdefault(members[channel], []).append((path, label, trace))
    return _make_plots(drawn)


def _log_differences(stream, entries) -> list[Plot]:
    import rerun as rr

    (_, (_, log)), *others = entries.items()
    palette, drawn = assign_axis_colours([log]), {}
    for rank, (name, (_, other)) in enumerate(others):
        groups = group_channels(common_channels(log, other))
        for kind, channels in groups.items():
            for channel in channels:
                time, trace = compute_channel_difference(log, other, channel)
                path = entity_path(f"difference/{name}", channel)
                label = f"{name} {trace.legend_name}" if len(others) > 1 else trace.legend_name
                style = _line_style(palette[trace.channel.axis], f"{label} [{trace.unit}]", rank)
                stream.log(path, style, static=True)
                columns = rr.Scalars.columns(scalars=trace.values)
                stream.send_columns(path, [time_column(time)], columns)
                drawn.setdefault(kind, []).append((path, label, trace))
    return _make_plots(drawn, is_difference=True)


def _make_plots(drawn: Mapping[str, list], is_difference: bool = False) -> list[Plot]:
    plots = []
    for kind, lines in drawn.items():
        paths, labels, traces = zip(*lines, strict=True)
        units = tuple(dict.fromkeys(trace.unit for trace in traces))
        values = [trace.values for trace in traces]
        plots.append(Plot(kind, paths, labels, units, values, is_difference))
    return plots


def _line_style(colour: tuple[int, int, int], name: str, rank: int, width: float = 1.2):
    """Return rerun's line style of a channel; the colour is paler in all logs but the first (rank 0).

    Args:
        colour: RGB colour of the axis, 0 .. 255.
        name: name in the legend.
        rank: index of the log in the recording.
        width: line width in the viewer.
    """
    import rerun as rr

    paler = [round(c + (_WHITE_FRACTION if rank else 0.0) * (255 - c)) for c in colour]
    peaks = rr.components.AggregationPolicy.MinMax  # averages would hide peaks when zoomed out
    return rr.SeriesLines(colors=paler, names=name, widths=width, aggregation_policy=peaks)


def _about_document(entries: Mapping[str, tuple[Machine, Log]]) -> "rr.TextDocument":
    import rerun as rr

    lines = []
    for name, (machine, log) in entries.items():
        lost = [axis.joint for axis in machine.axes.values()]
        lost = [joint for joint in lost if joint not in extract_joint_motion(machine, log)]
        lines += [
            f"# {name}",
            f"- machine **{machine.name}**, tool **{machine.tool}**: {machine.description}",
            f"- log `{log.source}`: {len(log)} rows, {log.time[0]:g} to {log.time[-1]:g} s"
            f" at {log.rate:.4g} Hz, {len(log.columns)} channels",
            *([f"- not logged, shown in the home pose: {', '.join(lost)}"] if lost else []),
            *(f"- {key}: {value}" for key, value in log.metadata.items() if len(value) < 200),
            "",
        ]
    if len(entries) > 1:
        first, *others = entries
        lines.append(f"Differences are {first} minus {' or '.join(others)}, by linear"
                     " interpolation in time.")  # fmt: skip
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)

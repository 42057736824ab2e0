"""One or more logs as a rerun recording: machines in 3D, plots of all channels, differences.

The `.rrd` is written by column after the run. Each log stands under its own root entity; all share
the timeline `time` [s].
"""

import os
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.show.channels import colours, common_channels, difference, grouped, shown
from hydrotele.show.layout import Plot, Scene, blueprint
from hydrotele.show.looks import bounds
from hydrotele.show.pose import (
    Poses,
    body_poses,
    logged_joints,
    logged_surroundings,
    model_with_looks,
    points_on_body,
)
from hydrotele.show.recording_file import recording_file
from hydrotele.show.scene import log_ground, log_machine, log_tip

if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "time"
_ENTRY = re.compile(r"[a-z][a-z0-9_]*")
_RESERVED = ("about", "difference", "ground")
_PALENESS = 0.65  # part of white in the lines of logs after the first
_EYE_DISTANCE = 1.4  # in radii of what is to be seen


def write_recording(
    path: str | os.PathLike,
    entries: Mapping[str, tuple[Machine, Log]],
    title: str = "",
) -> None:
    """Write logs with their machines as one `.rrd`, all or nothing.

    The first entry is shown as it looks and is what others are compared with: for each channel in
    common there is `/difference/<entry>/<channel>`, the first minus the other on the first's clock.
    The other machines are drawn as tinted glass in the same place.

    Args:
        path: the file to write, ending in `.rrd`.
        entries: root entity, such as `measured` -> machine and log; in the order of importance.
        title: name of the recording; default is made of machine and runs.

    Raises:
        InputError: a name cannot be a root entity, two logs share no time, a linkage does not close
            on the logged angles, or the file cannot be written. Nothing is written then.
    """
    _check_names(entries)
    machine, _ = next(iter(entries.values()))
    runs = " and ".join(dict.fromkeys(entry_log.name for _, entry_log in entries.values()))
    with recording_file(
        path, f"hydrotele {machine.name} {machine.tool} {' '.join(entries)}"
    ) as out:
        out.send_recording_name(title or f"{machine.name} {runs}")
        scene = _log_machines(out, entries)
        plots = _log_channels(out, entries)
        differences = _log_differences(out, entries)
        out.log("about", _about(entries), static=True)
        first, *others = entries
        minus = f"{first} - {' or '.join(others)}"
        out.send_blueprint(blueprint(plots, differences, scene, minus))


def time_column(time: np.ndarray) -> "rr.TimeColumn":
    """Times (n,) [s] on the timeline `time`, rounded to the nanosecond."""
    import rerun as rr

    nanoseconds = np.round(np.asarray(time) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn(TIMELINE, duration=nanoseconds)


def entity(root: str, channel: str) -> str:
    """Entity path of a channel.

    >>> entity("measured", "truth.flow_head.boom")
    '/measured/truth/flow_head/boom'
    """
    return "/".join(["", root, *channel.split(".")])


def _check_names(entries: Mapping[str, tuple[Machine, Log]]) -> None:
    if not entries:
        raise InputError("recording", "holds no log: give at least one machine with its log")
    for name in entries:
        if not _ENTRY.fullmatch(name) or name in _RESERVED:
            raise InputError(
                f"recording entry {name!r}",
                f"use lower-case letters, digits and _, and none of {', '.join(_RESERVED)}",
            )


def _log_machines(stream, entries) -> Scene:
    contents, trails, models, scene = [], [], {}, None
    for name, (machine, log) in entries.items():
        things = logged_surroundings(log)
        key = machine.model_dump_json() + log.metadata.get("surroundings", "")
        if key not in models:
            models[key] = model_with_looks(machine, surroundings=things)
        model = models[key]
        poses = body_poses(machine, model, logged_joints(machine, log), log)
        clock, tip = time_column(log.time), _tip(machine, log, poses)
        log_machine(stream, f"/{name}/machine", model, poses, clock, ghost=scene is not None)
        log_tip(stream, f"/{name}/tip_path", tip, clock, scene is not None)
        contents += [f"/{name}/machine/**", f"/{name}/tip_path/**"]
        trails.append(f"/{name}/tip_path/trail")
        if scene is None:
            eye, target = _eye(model, tip)
            ground = log_ground(stream, model)
            scene = Scene(_scene_title(list(entries)), contents, trails, eye, target, ground)
    contents.append("/ground/**")
    assert scene is not None  # there is at least one entry
    return scene


def _scene_title(names: list[str]) -> str:
    solid, *glass = names
    return f"{solid} (solid), {', '.join(glass)} (blue glass)" if glass else "machine"


def _tip(machine: Machine, log: Log, poses: Poses) -> np.ndarray | None:
    recorded = [f"truth.tip.{component}" for component in "xyz"]
    if all(name in log for name in recorded):
        return np.stack([log[name] for name in recorded], axis=1)
    if machine.arm is None or machine.arm.tip.link not in poses.bodies:
        return None
    return points_on_body(poses, machine.arm.tip.link, machine.arm.tip.position)


def _eye(model: mujoco.MjModel, tip: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Where the machine and all that its tip does are well seen from, and what to look at [m].

    The direction is that of the camera `overview` where there is one.
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    low, high = bounds(model, data)
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "overview")
    way = data.cam_xpos[camera] - 0.5 * (low + high) if camera >= 0 else np.array([1.6, 1.4, 0.8])
    if tip is not None:
        low, high = np.minimum(low, tip.min(axis=0)), np.maximum(high, tip.max(axis=0))
    target = 0.5 * (low + high)
    distance = _EYE_DISTANCE * 0.5 * float(np.linalg.norm(high - low))
    return target + distance * way / np.linalg.norm(way), target


def _log_channels(stream, entries) -> list[Plot]:
    import rerun as rr

    logs = [log for _, log in entries.values()]
    palette, drawn = colours(logs), {}
    for rank, (name, (_, log)) in enumerate(entries.items()):
        clock, groups = time_column(log.time), grouped(log.columns)
        members = {channel: kind for kind, some in groups.items() for channel in some}
        for channel in log.columns:
            trace = shown(log, channel)
            path = entity(name, channel)
            label = f"{name} {trace.name}" if len(entries) > 1 else trace.name
            width = 1.0 if rank else 3.0 if len(entries) > 1 else 1.6
            style = _line_style(palette[trace.channel.axis], f"{label} [{trace.unit}]", rank, width)
            stream.log(path, style, static=True)
            stream.send_columns(path, [clock], rr.Scalars.columns(scalars=trace.values))
            if channel in members:
                drawn.setdefault(members[channel], []).append((path, label, trace))
    return _plots(drawn)


def _log_differences(stream, entries) -> list[Plot]:
    import rerun as rr

    (_, (_, log)), *others = entries.items()
    palette, drawn = colours([log]), {}
    for rank, (name, (_, other)) in enumerate(others):
        groups = grouped(common_channels(log, other))
        for kind, channels in groups.items():
            for channel in channels:
                time, trace = difference(log, other, channel)
                path = entity(f"difference/{name}", channel)
                label = f"{name} {trace.name}" if len(others) > 1 else trace.name
                style = _line_style(palette[trace.channel.axis], f"{label} [{trace.unit}]", rank)
                stream.log(path, style, static=True)
                columns = rr.Scalars.columns(scalars=trace.values)
                stream.send_columns(path, [time_column(time)], columns)
                drawn.setdefault(kind, []).append((path, label, trace))
    return _plots(drawn, is_difference=True)


def _plots(drawn: Mapping[str, list], is_difference: bool = False) -> list[Plot]:
    plots = []
    for kind, lines in drawn.items():
        paths, labels, traces = zip(*lines, strict=True)
        units = tuple(dict.fromkeys(trace.unit for trace in traces))
        values = [trace.values for trace in traces]
        plots.append(Plot(kind, paths, labels, units, values, is_difference))
    return plots


def _line_style(colour: tuple[int, int, int], name: str, rank: int, width: float = 1.2):
    """The first log is drawn wide and strong, others thin and pale upon it."""
    import rerun as rr

    paler = [round(c + (_PALENESS if rank else 0.0) * (255 - c)) for c in colour]
    peaks = rr.components.AggregationPolicy.MinMax  # an average would hide them when zoomed out
    return rr.SeriesLines(colors=paler, names=name, widths=width, aggregation_policy=peaks)


def _about(entries: Mapping[str, tuple[Machine, Log]]) -> "rr.TextDocument":
    import rerun as rr

    lines = []
    for name, (machine, log) in entries.items():
        lost = [axis.joint for axis in machine.axes.values()]
        lost = [joint for joint in lost if joint not in logged_joints(machine, log)]
        lines += [
            f"# {name}",
            f"- machine **{machine.name}**, tool **{machine.tool}**: {machine.description}",
            f"- log `{log.source}`: {len(log)} rows, {log.time[0]:g} to {log.time[-1]:g} s"
            f" at {log.rate:.4g} Hz, {len(log.columns)} channels",
            *([f"- not logged, shown at home: {', '.join(lost)}"] if lost else []),
            *(f"- {key}: {value}" for key, value in log.metadata.items() if len(value) < 200),
            "",
        ]
    if len(entries) > 1:
        first, *others = entries
        lines.append(f"Differences are {first} minus {' or '.join(others)}, linearly interpolated.")
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)

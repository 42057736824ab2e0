"""Write one or more logs as a rerun recording: 3D machines, plots of all channels, differences.

Each log is logged below its own root entity; all logs share the timeline `time` [s]. The module
also defines the initial layout of the viewer (blueprint), and the entities of machine, ground and
tool-tip path. A recording file is written completely or not at all.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import SoilGround
from hydrotele.show import looks as shapes
from hydrotele.show.channels import (
    TITLES,
    assign_axis_colours,
    common_channels,
    compute_channel_difference,
    group_channels,
    padded_range,
    scale_channel_for_plot,
)
from hydrotele.show.looks import BodyMesh, body_meshes, ground_height, visible_bounds
from hydrotele.show.pose import (
    Poses,
    body_poses,
    compile_visual_model,
    extract_joint_motion,
    logged_surroundings,
    point_trajectory,
)
from hydrotele.show.soil import (
    LOOSE_COLOUR,
    SoilHistory,
    SoilShape,
    make_bucket_load_mesh,
    make_ground_around_trench,
    soil_history,
    trench_mesh,
)

if TYPE_CHECKING:
    import rerun as rr

_MAX_ID_LENGTH = 180  # maximum number of characters of an application id in rerun


@contextlib.contextmanager
def open_recording(path: str | os.PathLike, application: str) -> Iterator["rr.RecordingStream"]:
    """Open a rerun recording stream that is kept in memory and written to a file at the end.

    The writer of rerun is not used, because its thread does not report a full disk.

    Args:
        path: file to write, with the suffix `.rrd`.
        application: application id; rerun stores the layout of a user per id.

    Yields:
        The recording stream.

    Raises:
        InputError: the suffix is wrong, or the file cannot be written; no file is left.
    """
    import rerun as rr

    name = application.encode("ascii", "replace").decode()[:_MAX_ID_LENGTH]
    with atomic_file(path, ".rrd") as part, rr.RecordingStream(name) as stream:
        memory = stream.binary_stream()
        yield stream
        part.write_bytes(memory.read(flush=True) or b"")


if TYPE_CHECKING:
    import rerun.blueprint as rrb

# {tab: kinds of its plots, from top to bottom}
_TAB_KINDS: Mapping[str, tuple[str, ...]] = {
    "Overview": ("command", "angle", "position", "pressure_head", "pressure_rod"),
    "Hydraulics": ("pressure_supply", "flow_supply", "flow_head", "flow_rod", "spool"),
    "Mechanics": ("length", "position", "force", "torque", "contact_force", "tip"),
    "Teleoperation": ("tip_force", "handle", "hand_force", "handle_stiffness", "tip_pose"),
    "Rates": ("velocity", "acceleration", "piston_velocity", "spool_rate", "reference"),
}
_COMPARED_KINDS = ("angle", "position", "pressure_head", "pressure_rod", "length")
_FIXED_RANGES = {"command": (-1.05, 1.05)}
_SKY = (206, 217, 228)
_GRID = (120, 125, 130, 90)
_TRAIL_DURATION = 5.0  # s, duration of the displayed part of a tip path
_LEGEND_PLOT_HEIGHT = 1.5  # height of a plot with legend, relative to other plots


class Plot(NamedTuple):
    """Time-series view.

    Attributes:
        kind: kind of the channels.
        entities: entity paths of the lines.
        labels: names of the lines in the legend, without units.
        units: distinct units of the lines.
        values: values of the lines [unit].
        is_difference: whether the view shows the difference of two logs.
    """

    kind: str
    entities: Sequence[str]
    labels: Sequence[str]
    units: Sequence[str]
    values: Sequence[np.ndarray]
    is_difference: bool = False


class Scene(NamedTuple):
    """3D view.

    Attributes:
        title: title of the view.
        contents: entity paths.
        trails: entities of which only the last seconds are displayed.
        camera_position: (3,) position of the camera [m].
        target: (3,) point at which the camera looks [m].
        ground: whether there is a ground; otherwise the viewer draws a grid.
    """

    title: str
    contents: Sequence[str]
    trails: Sequence[str]
    camera_position: np.ndarray
    target: np.ndarray
    ground: bool


def make_blueprint(
    plots: Sequence[Plot],
    differences: Sequence[Plot],
    scene: Scene,
    difference_name: str = "",
) -> "rrb.Blueprint":
    """Create the layout of a recording for the rerun viewer: 3D view left, tabs of plots right.

    Args:
        plots: one plot per kind of channel.
        differences: plots of the difference of two logs; may be empty.
        scene: 3D view.
        difference_name: description of the differences, such as `measured - simulated`.

    Returns:
        The layout; the time panel is paused on the timeline `time`.
    """
    import rerun.blueprint as rrb

    about = rrb.TextDocumentView(name="About", origin="/about")
    tabs = [*_tabs(plots, differences, difference_name), about]
    return rrb.Blueprint(
        rrb.Horizontal(_machine_view(scene), rrb.Tabs(*tabs, active_tab=0), column_shares=[11, 9]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused", loop_mode="all"),
        auto_views=False,
    )


def _machine_view(scene: Scene):
    import rerun.blueprint as rrb

    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_DURATION)
    recent = rrb.VisibleTimeRange("time", start=start, end=rrb.TimeRangeBoundary.cursor_relative())
    return rrb.Spatial3DView(
        name=scene.title,
        origin="/",
        contents=list(scene.contents),
        overrides={path: rrb.VisibleTimeRanges([recent]) for path in scene.trails},
        background=_SKY,
        line_grid=rrb.LineGrid3D(visible=not scene.ground, spacing=1.0, color=_GRID),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=scene.camera_position,
            look_target=scene.target,
            eye_up=(0, 0, 1),
        ),
    )


def _tabs(plots: Sequence[Plot], differences: Sequence[Plot], minus: str):
    by_kind = {plot.kind: plot for plot in plots}
    gap_of = {plot.kind: plot for plot in differences}
    tabs = []
    if differences:
        kinds = [kind for kind in _COMPARED_KINDS if kind in gap_of] or list(gap_of)
        pairs = [(by_kind[kind], gap_of[kind]) for kind in kinds[:3]]
        views = [plot for pair in pairs for plot in pair]
        tabs.append(_make_plot_column("Comparison", views, minus, [2, 1] * len(pairs)))
    for title, kinds in _TAB_KINDS.items():
        if views := [by_kind[kind] for kind in kinds if kind in by_kind]:
            tabs.append(_make_plot_column(title, views, minus))
    if differences:
        tabs.append(_make_plot_column("Differences", list(differences), minus))
    return tabs


def _make_plot_column(
    title: str, plots: Sequence[Plot], minus: str, shares: Sequence[float] | None = None
) -> "rrb.Vertical":
    """Arrange plots in a column; show a legend only for lines that no plot above has named.

    Args:
        title: title of the tab.
        plots: plots from top to bottom.
        minus: description of the differences, such as `measured - simulated`.
        shares: relative heights of the plots, default equal.
    """
    import rerun.blueprint as rrb

    named: set[str] = set()
    views, heights = [], []
    for plot, share in zip(plots, shares or [1.0] * len(plots), strict=True):
        legend = len(plot.labels) > 1 and not named.issuperset(plot.labels)
        if legend:
            named.update(plot.labels, (label.split()[-1] for label in plot.labels))
        views.append(_make_plot_view(plot, minus if plot.is_difference else "", legend))
        heights.append(share * (_LEGEND_PLOT_HEIGHT if legend else 1.0))
    return rrb.Vertical(*views, name=title, row_shares=heights)


def _make_plot_view(plot: Plot, minus: str, legend: bool) -> "rrb.TimeSeriesView":
    import rerun.blueprint as rrb

    units = ", ".join("-" if unit == "1" else unit for unit in plot.units)
    fixed = None if minus or units != "-" else _FIXED_RANGES.get(plot.kind)
    note = f", {minus}" if minus else ""
    return rrb.TimeSeriesView(
        name=f"{TITLES.get(plot.kind, plot.kind)}{note} [{units}]",
        origin="/",
        contents=list(plot.entities),
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        axis_y=rrb.ScalarAxis(range=fixed or padded_range(plot.values, plot.units[0])),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
    )


if TYPE_CHECKING:
    import rerun as rr

_GHOST_COLOUR = np.array([40.0, 130.0, 255.0])
_GHOST_TINT = 0.7  # fraction of the ghost colour in the displayed colour
_GHOST_OPACITY = 0.35
_GHOST_INSET = 0.01  # m, reduction in size, so that the solid machine hides an equal ghost
_GROUND_COLOURS = np.array([[134, 122, 104], [144, 131, 112]], dtype=np.uint8)
_GROUND_HALF_SIZE, _TILE_LENGTH = 20.0, 2.0  # m
_SOIL_PERIOD = 0.1  # s between two meshes of the same trench
_TIP_COLOUR, _GHOST_TIP_COLOUR = (215, 40, 30), (40, 110, 230)


def log_machine(
    stream: "rr.RecordingStream",
    root: str,
    model: mujoco.MjModel,
    poses: Poses,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Add a moving 3D machine to a recording: its meshes once, the poses of its bodies for all times.

    Args:
        stream: recording stream.
        root: parent entity of the bodies.
        model: model with visual geometry.
        poses: body poses at n times; a single pose is static.
        clock: n times.
        ghost: draw only moving bodies, tinted and transparent.
    """
    moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    for look in body_meshes(model):
        if ghost and look.body not in moving:
            continue
        part = "shape" if look.opacity == 1.0 else f"glass_{round(100 * look.opacity)}"
        path = f"{root}/{poses.bodies[look.body]}/{part}"
        stream.log(path, make_rerun_mesh(look, ghost), static=True)
    for body, name in enumerate(poses.bodies):
        if body in moving or not ghost:
            _log_body_poses(stream, f"{root}/{name}", poses, body, clock, static=body not in moving)


def make_rerun_mesh(look: BodyMesh, ghost: bool = False) -> "rr.Mesh3D":
    """Convert the mesh of a body to a rerun mesh; a ghost (second machine) is tinted and transparent."""
    import rerun as rr

    colours, opacity, vertices = look.colours, look.opacity, look.mesh.vertices
    if ghost:
        vertices = vertices - _GHOST_INSET * look.mesh.normals
        colours = (1.0 - _GHOST_TINT) * colours + _GHOST_TINT * _GHOST_COLOUR
        opacity *= _GHOST_OPACITY
    return rr.Mesh3D(
        vertex_positions=vertices.astype(np.float32),
        vertex_normals=look.mesh.normals.astype(np.float32),
        triangle_indices=look.mesh.triangles.astype(np.uint32),
        vertex_colors=np.asarray(colours, dtype=np.uint8),
        albedo_factor=[1.0, 1.0, 1.0, opacity] if opacity < 1.0 else None,
    )


def log_ground(stream: "rr.RecordingStream", model: mujoco.MjModel, soil: SoilHistory | None = None) -> bool:
    """Add a chequered ground with tiles of 2 m to a recording, if the model has a ground plane.

    With soil, the ground has a gap for the strip in which the bucket digs.

    Returns:
        Whether the model has a ground plane.
    """
    height = ground_height(model)
    if height is None:
        return False
    if soil:
        mesh, parity = make_ground_around_trench(soil.bed, _GROUND_HALF_SIZE, _TILE_LENGTH)
    else:
        mesh, parity = shapes.make_chequered_square(_GROUND_HALF_SIZE, round(2.0 * _GROUND_HALF_SIZE / _TILE_LENGTH))
    mesh = shapes.transform_mesh(mesh, (0.0, 0.0, height), np.eye(3))
    stream.log("ground", make_rerun_mesh(BodyMesh(0, 1.0, mesh, _GROUND_COLOURS[parity])), static=True)
    return True


def log_soil(stream: "rr.RecordingStream", root: str, bucket: str, soil: SoilHistory, time: np.ndarray) -> None:
    """Add the changing soil to a recording: trench and heaps, and the soil in the bucket.

    Trench and heaps are updated at most every 0.1 s, the soil in the bucket at every change.

    Args:
        stream: recording stream.
        root: parent entity of the machine.
        bucket: name of the bucket's body.
        soil: soil at the rows of the log.
        time: (n,) times of the rows [s].
    """
    import rerun as rr

    drawn_at, drawn, load = -np.inf, None, np.empty((0, 2))
    for row, shape in enumerate(soil.shapes):
        stream.set_time(TIMELINE, duration=float(time[row]))
        is_last = row == len(time) - 1
        if drawn is None or ((time[row] - drawn_at >= _SOIL_PERIOD or is_last) and _has_soil_changed(drawn, shape)):
            mesh, colours = trench_mesh(soil.bed, shape)
            stream.log(f"{root}/soil", make_rerun_mesh(BodyMesh(0, 1.0, mesh, colours.astype(np.uint8))))
            drawn_at, drawn = time[row], shape
        if not np.array_equal(load, shape.load):
            load, path = shape.load, f"{root}/{bucket}/load"
            if (mesh := make_bucket_load_mesh(soil, row)) is None:
                stream.log(path, rr.Clear(recursive=False))
            else:
                colours = np.tile(LOOSE_COLOUR, (len(mesh.vertices), 1)).astype(np.uint8)
                stream.log(path, make_rerun_mesh(BodyMesh(0, 1.0, mesh, colours)))
    stream.reset_time()


def _has_soil_changed(before: SoilShape, now: SoilShape) -> bool:
    return not (np.array_equal(before.surface, now.surface) and np.array_equal(before.loose, now.loose))


def log_tip(
    stream: "rr.RecordingStream",
    root: str,
    tip: np.ndarray | None,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Add the path of the tool tip (n, 3) [m] to a recording: whole path, latest part, current point.

    The entity `trail` has one line segment per row; the layout selects the displayed seconds.
    """
    import rerun as rr

    if tip is None or len(tip) < 2:
        return
    colour = _GHOST_TIP_COLOUR if ghost else _TIP_COLOUR
    pale = [round(0.5 * (c + 220)) for c in colour]
    thin = rr.LineStrips3D([tip.astype(np.float32)], colors=[pale], radii=[0.005])
    stream.log(f"{root}/way", thin, static=True)
    pieces = np.stack([np.concatenate([tip[:1], tip[:-1]]), tip], axis=1)
    style = rr.LineStrips3D.from_fields(colors=[colour], radii=[0.012 if ghost else 0.02])
    stream.log(f"{root}/trail", style, static=True)
    stream.send_columns(f"{root}/trail", [clock], rr.LineStrips3D.columns(strips=pieces))
    style = rr.Points3D.from_fields(colors=[colour], radii=[0.06 if ghost else 0.07])
    stream.log(f"{root}/now", style, static=True)
    stream.send_columns(f"{root}/now", [clock], rr.Points3D.columns(positions=tip))


def _log_body_poses(stream, path: str, poses: Poses, body: int, clock, static: bool) -> None:
    import rerun as rr

    position = poses.position[:, body]
    quaternion = np.roll(poses.quaternion[:, body], -1, axis=1)  # rerun: x y z w
    if static or len(position) == 1:
        turn = rr.Quaternion(xyzw=quaternion[0])
        stream.log(path, rr.Transform3D(translation=position[0], quaternion=turn), static=True)
        return
    columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
    stream.send_columns(path, [clock], columns)


if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "time"
_ENTRY_NAME = re.compile(r"[a-z][a-z0-9_]*")
_RESERVED_NAMES = ("about", "difference", "ground")
_WHITE_FRACTION = 0.65  # fraction of white in the line colours of all logs but the first
_EYE_DISTANCE = 1.4  # camera distance, relative to the radius of the scene


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
        scene = _log_machines(out, entries)
        plots = _log_channels(out, entries)
        differences = _log_differences(out, entries)
        out.log("about", _about_document(entries), static=True)
        first, *others = entries
        minus = f"{first} - {' or '.join(others)}"
        out.send_blueprint(make_blueprint(plots, differences, scene, minus))


def time_column(time: np.ndarray) -> "rr.TimeColumn":
    """Convert times (n,) [s] to rerun's column of the timeline `time`, rounded to nanoseconds."""
    import rerun as rr

    nanoseconds = np.round(np.asarray(time) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn(TIMELINE, duration=nanoseconds)


def entity_path(root: str, channel: str) -> str:
    """Return the path of a log channel in the tree of a rerun recording.

    >>> entity_path("measured", "truth.flow_head.boom")
    '/measured/truth/flow_head/boom'
    """
    return "/".join(["", root, *channel.split(".")])


def _check_names(entries: Mapping[str, tuple[Machine, Log]]) -> None:
    if not entries:
        raise InputError("recording", "holds no log: give at least one machine with its log")
    for name in entries:
        if not _ENTRY_NAME.fullmatch(name) or name in _RESERVED_NAMES:
            raise InputError(
                f"recording entry {name!r}",
                f"use lower-case letters, digits and _, and none of {', '.join(_RESERVED_NAMES)}",
            )


def _log_machines(stream, entries) -> Scene:
    contents, trails, models, scene = [], [], {}, None
    for name, (machine, log) in entries.items():
        things = logged_surroundings(log)
        key = machine.model_dump_json() + log.metadata.get("surroundings", "")
        if key not in models:
            models[key] = compile_visual_model(machine, surroundings=things)
        model = models[key]
        poses = body_poses(machine, model, extract_joint_motion(machine, log), log)
        clock, tip = time_column(log.time), compute_tip_path(machine, log, poses)
        log_machine(stream, f"/{name}/machine", model, poses, clock, ghost=scene is not None)
        log_tip(stream, f"/{name}/tip_path", tip, clock, scene is not None)
        grounds = [thing for thing in things if isinstance(thing, SoilGround)]
        soil = soil_history(machine, grounds[0], log, poses) if grounds and len(log) > 1 else None
        contents += [f"/{name}/machine/**", f"/{name}/tip_path/**"]
        trails.append(f"/{name}/tip_path/trail")
        if scene is None:
            eye, target = compute_machine_camera(model, tip)
            ground = log_ground(stream, model, soil)
            if soil and machine.arm:
                log_soil(stream, f"/{name}/machine", machine.arm.tip.link, soil, log.time)
            scene = Scene(_scene_title(list(entries)), contents, trails, eye, target, ground)
    contents.append("/ground/**")
    assert scene is not None  # there is at least one entry
    return scene


def _scene_title(names: list[str]) -> str:
    solid, *glass = names
    return f"{solid} (solid), {', '.join(glass)} (transparent blue)" if glass else "machine"


def compute_tip_path(machine: Machine, log: Log, poses: Poses) -> np.ndarray | None:
    """Return the path of the tool tip (n, 3) in the world [m]; None for a machine without an arm.

    It is the true path if the log contains it, else it is computed from the body poses.
    """
    recorded = [f"truth.tip.{component}" for component in "xyz"]
    if all(name in log for name in recorded):
        return np.stack([log[name] for name in recorded], axis=1)
    if machine.arm is None or machine.arm.tip.link not in poses.bodies:
        return None
    return point_trajectory(poses, machine.arm.tip.link, machine.arm.tip.position)


def compute_machine_camera(model: mujoco.MjModel, tip: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Compute a camera that shows the whole machine and, if given, the whole path of its tip (n, 3).

    The direction is that of the camera `overview` if the model has one.

    Returns:
        (position of the camera (3,), point that it looks at (3,)) in the world [m].
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    low, high = visible_bounds(model, data)
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
    """Return rerun's line style of a channel; the colour is paler for all logs but the first (rank 0)."""
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

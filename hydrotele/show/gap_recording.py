"""Write the result of a search for model errors (gap) as a rerun recording.

The recording shows measurements, predictions and prediction errors of the held-out run. Whitened
errors are prediction errors divided by their predicted standard deviation.

Entities: `/measured` contains the measurements, `/nominal` and `/patched` the one-step predictions
of the given and the corrected (patched) model. `/residual/nominal` and `/residual/patched` contain
the whitened errors, `/gap` their RMS over time and the intervals with significant errors (gap
windows). The 3D machine moves as measured.
"""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hydrotele.core.units import plot_axis_unit
from hydrotele.gap.description import channel_words, headline, learned_title, verdict_words
from hydrotele.gap.patched import has_patch
from hydrotele.gap.result import Gap, Prediction
from hydrotele.logs.dataset import RunData
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import default_channel_unit, parse_channel
from hydrotele.show.channels import padded_range
from hydrotele.show.prediction_errors import GapWindow, find_gap_windows, find_most_improved_channels, windowed_errors
from hydrotele.show.rerun_blueprint import Scene, make_machine_view
from hydrotele.show.rerun_scene import log_scene
from hydrotele.show.rerun_stream import entity_path, open_recording, time_column

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_MIN_ERROR_RANGE = 4.0  # times noise, minimum range of a plot of whitened errors


def gap_blueprint(
    scene: Scene, before: Prediction, models: Mapping[str, tuple[Prediction, Any]],
    channels: Sequence[str],
) -> "rrb.Blueprint":  # fmt: skip
    """Create the layout of a recording of model errors for the rerun viewer.

    The machine and the list of intervals with significant errors are on the left, tabs of plots on
    the right.

    Args:
        scene: 3D view.
        before: prediction of the given model.
        models: {`nominal` or `patched`: (prediction, any value)}; the second value is not used.
        channels: channels that the first tab shows.

    Returns:
        The layout; the time panel is paused on the timeline `time`.
    """
    import rerun.blueprint as rrb

    left = rrb.Vertical(
        make_machine_view(scene),
        rrb.TextLogView(name="gap windows", origin="/gap/text"),
        row_shares=[3, 1],
    )
    first = [_rms_view(models)]
    for channel in channels:
        first += [_channel_view(before, models, channel, legend=channel == channels[0])]
        first += [_error_view(models, channel)]
    shares = [1.2, *([1.3, 0.8] * len(channels))]
    tabs: list[Any] = [rrb.Vertical(*first, name="Gap", row_shares=shares)]
    axes = dict.fromkeys(parse_channel(channel).axis for channel in before.channels)
    for axis in axes:
        mine = [c for c in before.channels if parse_channel(c).axis == axis]
        views = [_channel_view(before, models, c, legend=c == mine[0]) for c in mine]
        command = [_make_command_view(axis)] if axis else []
        tabs.append(rrb.Vertical(*command, *views, name=axis or "supply"))
    errors = [_error_view(models, channel) for channel in before.channels]
    tabs.append(rrb.Grid(*errors, grid_columns=2, name="Residuals"))
    tabs.append(rrb.TextDocumentView(name="Verdict", origin="/about"))
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs, active_tab=0), column_shares=[9, 11]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused", loop_mode="all"),
        auto_views=False,
    )


def _rms_view(models) -> "rrb.TimeSeriesView":
    paths = [f"/gap/{name}" for name in models]
    title = "RMS prediction error [x noise]; red: gap windows"
    return _make_time_series_view(title, [*paths, "/gap/perfect", "/gap/window"], None, legend=True)


def _channel_view(before: Prediction, models, channel: str, legend: bool) -> "rrb.TimeSeriesView":
    unit, factor = plot_axis_unit(default_channel_unit(channel))
    column = before.channels.index(channel)
    values = [before.measured[:, column], *(p.predicted[:, column] for p, _ in models.values())]
    span = padded_range([factor * v[np.isfinite(v)] for v in values], unit)
    paths = [entity_path(name, channel) for name in ("measured", *models)]
    return _make_time_series_view(f"{channel_words(channel)} [{unit}]", paths, span, legend)


def _error_view(models, channel: str) -> "rrb.TimeSeriesView":
    column = next(iter(models.values()))[0].channels.index(channel)
    values = [p.whitened[:, column] for p, _ in models.values()]
    largest = max(np.nanmax(np.abs(v), initial=0.0) for v in values)
    span = 1.05 * max(_MIN_ERROR_RANGE, float(largest))
    paths = [entity_path(f"residual/{name}", channel) for name in models]
    title = f"{channel_words(channel)}, error [x noise]"
    return _make_time_series_view(title, paths, (-span, span), legend=False)


def _make_command_view(axis: str) -> "rrb.TimeSeriesView":
    return _make_time_series_view(f"{axis} command", [f"/command/{axis}"], None, legend=False)


def _make_time_series_view(
    title: str, paths: Sequence[str], span: tuple[float, float] | None, legend: bool
) -> "rrb.TimeSeriesView":
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=list(paths),
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        axis_y=rrb.ScalarAxis(range=span) if span else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
    )


_MEASURED_COLOUR, _NOMINAL_COLOUR, _PATCHED_COLOUR = (205, 210, 216), (240, 150, 0), (86, 160, 233)
_WINDOW_COLOUR, _FLOOR_COLOUR = (225, 70, 60), (120, 128, 136)
_WIDTHS = {"measured": 3.0, "nominal": 1.4, "patched": 1.4}


def write_gap_recording(path: str | os.PathLike, gap: Gap, run: RunData, axes: Sequence[str]) -> None:
    """Write measurements and predictions of the held-out run to one `.rrd` file, completely or not at all.

    Args:
        path: file to write, with the suffix `.rrd`.
        gap: result of the search.
        run: held-out run, whose commands are shown.
        axes: names of the axes of the commands.

    Raises:
        InputError: a linkage cannot be closed at the measured angles, or the file cannot be
            written.
    """
    before, after = gap.before[0], gap.after[0]
    models = {"nominal": (before, _NOMINAL_COLOUR)}
    if has_patch(gap):
        models["patched"] = (after, _PATCHED_COLOUR)
    windows = find_gap_windows(before, gap.size.noise_floor or gap.size.before)
    identity = f"hydrotele gap {gap.machine.name} {gap.machine.tool}"
    with open_recording(path, identity) as out:
        out.send_recording_name(f"{gap.machine.name} {before.run}: {headline(gap)}")
        scene = log_scene(out, {"measured": (gap.machine, _interpolated_log(before, run))})
        _log_commands(out, run, axes)
        _log_channels(out, models)
        _log_rms(out, models, gap.size.noise_floor)
        _log_windows(out, gap, windows, before)
        out.log("about", _verdict_document(gap), static=True)
        worst = find_most_improved_channels(before, after, 2)
        out.send_blueprint(gap_blueprint(scene, before, models, worst))


def _interpolated_log(prediction: Prediction, run: RunData) -> Log:
    """Return the measurements of a run as a log, with missing samples interpolated for the 3D view."""
    columns = {}
    for k, channel in enumerate(prediction.channels):
        values = prediction.measured[:, k]
        known = np.isfinite(values)
        if known.any():
            columns[channel] = np.interp(prediction.time, prediction.time[known], values[known])
    units = {channel: default_channel_unit(channel) for channel in columns}
    return Log(prediction.time, columns, units, run.log.metadata, run.log.source)


def _log_commands(out, run: RunData, axes: Sequence[str]) -> None:
    import rerun as rr

    time = run.start + run.period * np.arange(len(run.command))
    for k, axis in enumerate(axes):
        path = f"/command/{axis}"
        out.log(path, _style(_MEASURED_COLOUR, f"command {axis}", 1.4), static=True)
        columns = rr.Scalars.columns(scalars=run.command[:, k])
        out.send_columns(path, [time_column(time)], columns)


def _log_channels(out, models) -> None:
    """Add lines of measurements, predictions and whitened errors of all channels to a recording.

    Args:
        out: recording stream.
        models: {`nominal` or `patched`: (prediction, RGB colour)}.
    """
    before, _ = models["nominal"]
    for k, channel in enumerate(before.channels):
        unit, factor = plot_axis_unit(default_channel_unit(channel))
        lines = {"measured": (before.measured[:, k], _MEASURED_COLOUR)}
        for name, (prediction, colour) in models.items():
            lines[name] = (prediction.predicted[:, k], colour)
            error = prediction.whitened[:, k]
            path = entity_path(f"residual/{name}", channel)
            _log_time_series(out, path, prediction.time, error, _style(colour, f"{name} [x noise]", 1.2))
        for name, (values, colour) in lines.items():
            style = _style(colour, f"{name} [{unit}]", _WIDTHS[name])
            _log_time_series(out, entity_path(name, channel), before.time, factor * values, style)


def _log_rms(out, models, floor: float | None) -> None:
    """Add lines of the RMS whitened error of all channels in windows of 0.5 s, per model, to a recording.

    Args:
        out: recording stream.
        models: {`nominal` or `patched`: (prediction, RGB colour)}.
        floor: RMS error of a perfect model, drawn as a constant line; None if unknown.
    """
    for name, (prediction, colour) in models.items():
        found = windowed_errors(prediction)
        total = np.nansum(found.rms**2 * found.count, axis=1)
        size = np.sqrt(total / np.maximum(found.count.sum(axis=1), 1))
        middle = 0.5 * (found.edges[:-1] + found.edges[1:])
        _log_time_series(out, f"/gap/{name}", middle, size, _style(colour, f"{name} [x noise]", 2.0))
    if floor is None:
        return
    ends = models["nominal"][0].time[[0, -1]]
    _log_time_series(out, "/gap/perfect", ends, np.full(2, floor), _style(_FLOOR_COLOUR, "perfect model", 1.2))


def _log_windows(out, gap: Gap, windows: Sequence[GapWindow], before: Prediction) -> None:
    """Add the intervals with significant errors to a recording: a thick red line at zero, and texts.

    The intervals with the largest errors due to an unknown effect are added as texts only.

    Args:
        out: recording stream.
        gap: result of the search.
        windows: intervals with significant errors of the given model.
        before: prediction of the given model.
    """
    import rerun as rr

    time = np.array([t for w in windows for t in (w.start, w.stop, w.stop + 1e-6)])
    level = np.array([v for _ in windows for v in (0.0, 0.0, np.nan)])
    name = "significant error of the given model"
    out.log("/gap/window", _style(_WINDOW_COLOUR, name, 7.0), static=True)
    if len(time):
        columns = rr.Scalars.columns(scalars=level)
        out.send_columns("/gap/window", [time_column(time)], columns)
    said = [
        (
            w.start,
            f"{w.start:.1f} to {w.stop:.1f} s: {channel_words(w.channel)} {w.rms:.1f} x noise",
        )
        for w in windows
    ]
    if gap.unknown:
        said += [(start, f"{start:.1f} to {end:.1f} s: largest errors due to the unknown effect")
                 for start, end in gap.unknown.windows]  # fmt: skip
    said = sorted(said) or [(float(before.time[0]), "the model has no significant errors")]
    times, texts = zip(*said, strict=True)
    levels = ["WARN" if windows or gap.unknown else "INFO"] * len(texts)
    columns = rr.TextLog.columns(text=texts, level=levels)
    out.send_columns("/gap/text", [time_column(np.array(times))], columns)


def _log_time_series(out, path: str, time: np.ndarray, values: np.ndarray, style) -> None:
    import rerun as rr

    known = np.isfinite(values)
    out.log(path, style, static=True)
    if known.any():
        columns = rr.Scalars.columns(scalars=values[known])
        out.send_columns(path, [time_column(time[known])], columns)


def _style(colour: tuple[int, int, int], name: str, width: float):
    import rerun as rr

    peaks = rr.components.AggregationPolicy.MinMax  # an average would hide them when zoomed out
    return rr.SeriesLines(colors=colour, names=name, widths=width, aggregation_policy=peaks)


def _verdict_document(gap: Gap):
    import rerun as rr

    laws = [f"- {learned_title(law)}: `{law.formula}` [{law.unit}]" for law in gap.learned]
    lines = [f"# {headline(gap)}", *verdict_words(gap), *laws, *(f"- {n}" for n in gap.notes)]
    return rr.TextDocument("\n\n".join(lines), media_type=rr.MediaType.MARKDOWN)

"""What a gap's recording shows at first sight: the rerun blueprint."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hydrotele.gap.result import Prediction
from hydrotele.gap.words import channel_words
from hydrotele.machine.signals import parse_channel, usual_unit
from hydrotele.show.channels import padded_range, shown_unit
from hydrotele.show.layout import Scene, _machine_view
from hydrotele.show.recording import entity

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_LEAST_ERROR = 4.0  # times noise that a plot of whitened errors shows at least


def gap_blueprint(
    scene: Scene, before: Prediction, models: Mapping[str, tuple[Prediction, Any]],
    worst: Sequence[str],
) -> "rrb.Blueprint":  # fmt: skip
    """Lay out a gap's recording: machine and gap windows on the left, tabs of plots on the right.

    Args:
        scene: the 3D view.
        before: predictions of the given model.
        models: `nominal` and perhaps `patched` -> predictions and anything else.
        worst: the channels of the first tab.

    Returns:
        The blueprint; the time panel starts paused on the timeline `time`.
    """
    import rerun.blueprint as rrb

    left = rrb.Vertical(
        _machine_view(scene),
        rrb.TextLogView(name="gap windows", origin="/gap/text"),
        row_shares=[3, 1],
    )
    first = [_sizes(models)]
    for channel in worst:
        first += [_signal(before, models, channel, legend=channel == worst[0])]
        first += [_errors(models, channel)]
    shares = [1.2, *([1.3, 0.8] * len(worst))]
    tabs: list[Any] = [rrb.Vertical(*first, name="Gap", row_shares=shares)]
    axes = dict.fromkeys(parse_channel(channel).axis for channel in before.channels)
    for axis in axes:
        mine = [c for c in before.channels if parse_channel(c).axis == axis]
        views = [_signal(before, models, c, legend=c == mine[0]) for c in mine]
        command = [_command(axis)] if axis else []
        tabs.append(rrb.Vertical(*command, *views, name=axis or "supply"))
    errors = [_errors(models, channel) for channel in before.channels]
    tabs.append(rrb.Grid(*errors, grid_columns=2, name="Residuals"))
    tabs.append(rrb.TextDocumentView(name="Verdict", origin="/about"))
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs, active_tab=0), column_shares=[9, 11]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused", loop_mode="all"),
        auto_views=False,
    )


def _sizes(models) -> "rrb.TimeSeriesView":
    paths = [f"/gap/{name}" for name in models]
    title = "size of the prediction errors [x noise], red: gap windows"
    return _view(title, [*paths, "/gap/perfect", "/gap/window"], None, legend=True)


def _signal(before: Prediction, models, channel: str, legend: bool) -> "rrb.TimeSeriesView":
    unit, factor = shown_unit(usual_unit(channel))
    column = before.channels.index(channel)
    values = [before.measured[:, column], *(p.predicted[:, column] for p, _ in models.values())]
    span = padded_range([factor * v[np.isfinite(v)] for v in values], unit)
    paths = [entity(name, channel) for name in ("measured", *models)]
    return _view(f"{channel_words(channel)} [{unit}]", paths, span, legend)


def _errors(models, channel: str) -> "rrb.TimeSeriesView":
    column = next(iter(models.values()))[0].channels.index(channel)
    values = [p.whitened[:, column] for p, _ in models.values()]
    largest = max(np.nanmax(np.abs(v), initial=0.0) for v in values)
    span = 1.05 * max(_LEAST_ERROR, float(largest))
    paths = [entity(f"residual/{name}", channel) for name in models]
    title = f"{channel_words(channel)}, error [x noise]"
    return _view(title, paths, (-span, span), legend=False)


def _command(axis: str) -> "rrb.TimeSeriesView":
    return _view(f"{axis} command", [f"/command/{axis}"], None, legend=False)


def _view(
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

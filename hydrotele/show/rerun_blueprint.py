"""Initial layout (blueprint) of the rerun viewer for a recording: 3D view and tabs of plots."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hydrotele.show.channels import (
    TITLES,
    padded_range,
)

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
    """Content of one time-series view of the rerun viewer.

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
    """Content and camera of the 3D view of the rerun viewer.

    Attributes:
        title: title of the view.
        contents: paths of the displayed entities.
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
        rrb.Horizontal(make_machine_view(scene), rrb.Tabs(*tabs, active_tab=0), column_shares=[11, 9]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused", loop_mode="all"),
        auto_views=False,
    )


def make_machine_view(scene: Scene):
    """Return rerun's 3D view of a scene; of its trails, only the last 5 s are visible."""
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

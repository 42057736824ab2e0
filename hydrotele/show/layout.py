"""What a recording shows at first sight: the rerun blueprint."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hydrotele.show.channels import TITLES, padded_range

if TYPE_CHECKING:
    import rerun.blueprint as rrb

# Tab -> kinds of plots in it, from top to bottom.
_TABS: Mapping[str, tuple[str, ...]] = {
    "Overview": ("command", "angle", "position", "pressure_head", "pressure_rod"),
    "Hydraulics": ("pressure_supply", "flow_supply", "flow_head", "flow_rod", "spool"),
    "Mechanics": ("length", "position", "force", "torque", "contact_force", "tip"),
    "Teleoperation": ("tip_force", "handle", "hand_force", "handle_stiffness", "tip_pose"),
    "Rates": ("velocity", "acceleration", "piston_velocity", "spool_rate", "reference"),
}
_COMPARED = ("angle", "position", "pressure_head", "pressure_rod", "length")
_FIXED_RANGES = {"command": (-1.05, 1.05)}
_SKY = (206, 217, 228)
_GRID = (120, 125, 130, 90)
_TRAIL = 5.0  # s
_FIRST_SHARE = 1.5  # height of the plot with the legend, in heights of others


class Plot(NamedTuple):
    """One time-series view.

    Attributes:
        kind: kind of its channels.
        entities: entity paths of its lines.
        labels: their names in the legend, without units.
        units: units of its lines, without repetition.
        values: arrays of its lines [unit].
        is_difference: whether it shows the difference of two logs.
    """

    kind: str
    entities: Sequence[str]
    labels: Sequence[str]
    units: Sequence[str]
    values: Sequence[np.ndarray]
    is_difference: bool = False


class Scene(NamedTuple):
    """The 3D view.

    Attributes:
        title: what is seen.
        contents: entity paths.
        trails: entities of which only the last seconds are shown.
        eye: (3,) where it is seen from [m].
        target: (3,) what it looks at [m].
        ground: whether there is a ground; otherwise the viewer draws a grid.
    """

    title: str
    contents: Sequence[str]
    trails: Sequence[str]
    eye: np.ndarray
    target: np.ndarray
    ground: bool


def blueprint(
    plots: Sequence[Plot],
    differences: Sequence[Plot],
    scene: Scene,
    minus: str = "",
) -> "rrb.Blueprint":
    """Lay out a recording: the machine on the left, tabs of plots on the right, time below.

    Args:
        plots: one per kind of channel.
        differences: the same for the difference of two logs; may be empty.
        scene: the 3D view.
        minus: what the differences are, such as `measured - simulated`.

    Returns:
        The blueprint; the time panel starts paused on the timeline `time`.
    """
    import rerun.blueprint as rrb

    about = rrb.TextDocumentView(name="About", origin="/about")
    tabs = [*_tabs(plots, differences, minus), about]
    return rrb.Blueprint(
        rrb.Horizontal(_machine_view(scene), rrb.Tabs(*tabs, active_tab=0), column_shares=[11, 9]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused", loop_mode="all"),
        auto_views=False,
    )


def _machine_view(scene: Scene):
    import rerun.blueprint as rrb

    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL)
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
            position=scene.eye,
            look_target=scene.target,
            eye_up=(0, 0, 1),
        ),
    )


def _tabs(plots: Sequence[Plot], differences: Sequence[Plot], minus: str):
    by_kind = {plot.kind: plot for plot in plots}
    gap_of = {plot.kind: plot for plot in differences}
    tabs = []
    if differences:
        kinds = [kind for kind in _COMPARED if kind in gap_of] or list(gap_of)
        pairs = [(by_kind[kind], gap_of[kind]) for kind in kinds[:3]]
        views = [plot for pair in pairs for plot in pair]
        tabs.append(_column("Comparison", views, minus, [2, 1] * len(pairs)))
    for title, kinds in _TABS.items():
        if views := [by_kind[kind] for kind in kinds if kind in by_kind]:
            tabs.append(_column(title, views, minus))
    if differences:
        tabs.append(_column("Differences", list(differences), minus))
    return tabs


def _column(
    title: str, plots: Sequence[Plot], minus: str, shares: Sequence[float] | None = None
) -> "rrb.Vertical":
    """Plots below each other; a legend only where it names lines that none above has named."""
    import rerun.blueprint as rrb

    named: set[str] = set()
    views, heights = [], []
    for plot, share in zip(plots, shares or [1.0] * len(plots), strict=True):
        legend = len(plot.labels) > 1 and not named.issuperset(plot.labels)
        if legend:
            named.update(plot.labels, (label.split()[-1] for label in plot.labels))
        views.append(_view(plot, minus if plot.is_difference else "", legend))
        heights.append(share * (_FIRST_SHARE if legend else 1.0))
    return rrb.Vertical(*views, name=title, row_shares=heights)


def _view(plot: Plot, minus: str, legend: bool) -> "rrb.TimeSeriesView":
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

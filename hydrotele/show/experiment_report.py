"""Write the report of an experiment series: published and simulated results, with figures.

The figures are written as PNG and as SVG for print.
"""

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import hydrotele
from hydrotele.experiments.comparison import Comparison, Panel, summarize_verdicts
from hydrotele.show import report_html
from hydrotele.show.calibration_report import draw_posterior
from hydrotele.show.report_html import figure_to_png, open_report_figure, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLES = (
    ("#1769aa", "-", "o"), ("#e07b00", "--", "s"), ("#23794a", "-.", "^"), ("#8a5fb0", ":", "D"),
    ("#a33b3b", (0, (5, 1)), "v"), ("#5b6670", (0, (3, 1, 1, 1)), "x"),
)  # fmt: skip
"""Colour, line style and marker of each curve; distinguishable in black-and-white print."""
_MAX_POINTS = 4000  # maximum number of points per curve; more are not visible
_PANEL_HEIGHT = 1.9  # inch, height of one panel
_LABEL_WIDTH = 24  # characters per line of an axis label
_MIN_POINTS_SMALL_MARKER = 60  # number of points from which markers are smaller


class ReportFigure(NamedTuple):
    """Figure of a report and its files.

    Attributes:
        row: comparison that the figure belongs to.
        stem: stem of the file names.
        caption: caption, one paragraph.
        png: PNG image for the screen and for documents.
        svg: SVG image for print, None for the dense points of a posterior.
    """

    row: Comparison
    stem: str
    caption: str
    png: bytes
    svg: bytes | None


def write_experiment_report(
    title: str, rows: Sequence[Comparison], items_without_result: Mapping[str, str], folder: Path
) -> None:
    """Write `report.html`, and `figures/` with an SVG and a PNG per figure and `captions.md`.

    Args:
        title: title of the publication.
        rows: comparisons of published and simulated results.
        items_without_result: {table or figure of the publication without a result to compare: its
            content, such as `photograph`}.
        folder: existing output folder.
    """
    figures = draw_figures(rows)
    if figures:
        (folder / "figures").mkdir(exist_ok=True)
    for one in figures:
        (folder / "figures" / f"{one.stem}.png").write_bytes(one.png)
        if one.svg:
            (folder / "figures" / f"{one.stem}.svg").write_bytes(one.svg)
    if figures:
        captions = [f"- `{one.stem}`: {one.caption}" for one in figures]
        (folder / "figures" / "captions.md").write_text("\n".join(captions) + "\n", "utf-8")
    report_html.write_template_report(
        "experiments", folder / "report.html", title=f"Experiments of {title}",
        version=hydrotele.__version__, document=title, summary=summarize_verdicts(rows),
        counted=[row for row in rows if row.kind != "input"],
        inputs=[row for row in rows if row.kind == "input"],
        drawings=list(items_without_result.items()), figures=figures,
    )  # fmt: skip


def draw_figures(rows: Sequence[Comparison]) -> list[ReportFigure]:
    """Draw the figures of all comparisons of published and simulated results, numbered consecutively.

    A comparison has up to two figures: curves, and samples of a posterior. Comparisons with neither
    have none.
    """
    figures = []
    for row in rows:
        slug = re.sub(r"[^a-z0-9]+", "-", row.name.lower()).strip("-")
        if row.panels:
            made = draw_panels(row.panels)
            stem = f"{len(figures) + 1:02d}-{slug}"
            figures.append(ReportFigure(row, stem, _caption(row, _describe_panels(row.panels)), *made))
        if row.marginals:
            shown = row.marginals
            picture = draw_posterior(shown.sample, shown.names, shown.truth, "truth", shown.unit)
            stem = f"{len(figures) + 1:02d}-{slug}-posterior"
            what = f"Posterior of {', '.join(shown.names)} [{shown.unit}]; lines: truth."
            figures.append(ReportFigure(row, stem, _caption(row, what), picture, None))
    return figures


def _caption(row: Comparison, what: str) -> str:
    return f"{row.name[:1].upper()}{row.name[1:]} ({row.item}). {what}"


def _describe_panels(panels: Sequence[Panel]) -> str:
    labels = dict.fromkeys(panel.label.split(" [")[0] for panel in panels)
    across = dict.fromkeys(panel.x_label.split(" [")[0] for panel in panels)
    return f"First repetition, plotted over {', '.join(across)}: {'; '.join(labels)}."


def draw_panels(panels: Sequence[Panel]) -> tuple[bytes, bytes]:
    """Draw panels of curves below each other; a panel with errors is followed by a panel of its errors.

    The panels share their x axis if they have the same x quantity.

    Args:
        panels: panels with curves and, optionally, their errors.

    Returns:
        The figure as PNG and as SVG.
    """
    rows = [(panel, error) for panel in panels for error in (False, True)
            if not error or panel.errors]  # fmt: skip
    with open_report_figure(0.5 + _PANEL_HEIGHT * len(rows)) as figure:
        shared = len({panel.x_label for panel in panels}) == 1
        axes = figure.subplots(len(rows), 1, sharex=shared, squeeze=False)[:, 0]
        for (panel, error), place in zip(rows, axes, strict=True):
            _draw_curves(place, panel, error)
            if not shared:
                place.set_xlabel(panel.x_label)
        axes[-1].set_xlabel(panels[-1].x_label)
        figure.align_ylabels(list(axes))
        return figure_to_png(figure), svg(figure)


def _draw_curves(place: "Axes", panel: Panel, draws_errors: bool) -> None:
    curves = panel.errors if draws_errors else panel.curves
    every = max(1, len(panel.x) // _MAX_POINTS)
    order = list(dict.fromkeys([*panel.curves, *panel.errors]))
    for label, curve in curves.items():
        colour, line, marker = _STYLES[order.index(label) % len(_STYLES)]
        look = (
            {"ls": "none", "marker": marker, "ms": 4.0 if len(curve) < _MIN_POINTS_SMALL_MARKER else 2.0,
             "mfc": "none"} if panel.discrete
            else {"ls": "-" if draws_errors else line, "lw": 1.2}
        )  # fmt: skip
        place.plot(panel.x[::every], curve[::every], color=colour, label=label, **look)
    name, _, unit = (panel.error_label if draws_errors else panel.label).rpartition(" [")
    place.set_ylabel("\n".join([*textwrap.wrap(name, _LABEL_WIDTH), f"[{unit}"]) if name else unit)
    if panel.log and not draws_errors:
        place.set_yscale("log")
    if len(curves) > 1 or draws_errors:
        place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)

"""The report of a series of experiments: published beside simulated, with the curves."""

from collections.abc import Sequence
from pathlib import Path

import hydrotele
from hydrotele.experiments.finding import Finding, Panel, tally
from hydrotele.show import report_html
from hydrotele.show.calibration_report import corner
from hydrotele.show.report_html import drawing, png

_COLOURS = ("#1769aa", "#e07b00", "#23794a", "#8a5fb0", "#a33b3b", "#5b6670")
_MOST = 4000  # points of a curve: more are not seen


def write_experiment_report(name: str, findings: Sequence[Finding], path: Path) -> None:
    """Write the report.

    Args:
        name: of the series.
        findings: of its experiments.
        path: HTML file to write.
    """
    report_html.write_report(
        "experiments", path, title=f"experiments {name}", version=hydrotele.__version__, name=name,
        tally=tally(findings), findings=findings,
        curves=[(one, draw_panels(one.panels)) for one in findings if one.panels],
        posteriors=[(one, _corner(one)) for one in findings if one.marginals],
    )  # fmt: skip


def _corner(finding: Finding) -> bytes:
    shown = finding.marginals
    assert shown is not None
    return corner(shown.sample, shown.names, shown.truth, "truth", shown.unit)


def draw_panels(panels: Sequence[Panel]) -> bytes:
    """Curves below each other; those over time on one clock.

    Args:
        panels: what to draw.

    Returns:
        A PNG.
    """
    with drawing(0.4 + 1.35 * len(panels)) as figure:
        shared = len({panel.over for panel in panels}) == 1
        axes = figure.subplots(len(panels), 1, sharex=shared, squeeze=False)[:, 0]
        for panel, place in zip(panels, axes, strict=True):
            every = max(1, len(panel.time) // _MOST)
            for (label, curve), colour in zip(panel.curves.items(), _COLOURS, strict=False):
                place.plot(panel.time[::every], curve[::every], color=colour, lw=1.0, label=label)
            place.set_title(panel.title)
            if panel.log:
                place.set_yscale("log")
            if not shared:
                place.set_xlabel(panel.over)
            if len(panel.curves) > 1:
                place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axes[-1].set_xlabel(panels[-1].over)
        return png(figure)

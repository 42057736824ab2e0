"""The report of a series of experiments: published beside simulated, with the curves."""

from collections.abc import Sequence
from pathlib import Path

import hydrotele
from hydrotele.experiments.finding import Finding, Panel
from hydrotele.show.report_html import (
    STYLE,
    Cell,
    Markup,
    drawing,
    page,
    picture,
    png,
    section,
    table,
    tag,
)

_COLOURS = ("#1769aa", "#e07b00", "#23794a", "#8a5fb0", "#b5302a", "#7a6a58")
_MOST = 4000  # points of a curve: more are not seen


def write_experiment_report(name: str, findings: Sequence[Finding], path: Path) -> None:
    """Write the report.

    Args:
        name: of the series.
        findings: of its experiments.
        path: HTML file to write.
    """
    same = sum(one.ok for one in findings)
    head = tag(
        "header",
        tag("p", f"hydrotele {hydrotele.__version__} - experiments {name}", class_="over"),
        tag("h1", f"{same} of {len(findings)} experiments as published"),
        tag("p", "Published experiments repeated in simulation; every row says what the source"
            " reports and what is seen here."),
    )  # fmt: skip
    rows = [
        (
            Cell(Markup(f"{tag('b', one.name)}{tag('small', one.source)}")),
            one.published,
            one.simulated,
            Cell("same" if one.ok else "differs", "yes" if one.ok else "no"),
        )
        for one in findings
    ]
    parts = [head, section("Published and simulated", "", table(
        ("experiment", "published", "simulated", ""), rows))]  # fmt: skip
    parts += [_curves(one) for one in findings if one.panels]
    path.write_text(page(f"experiments {name}", STYLE, parts), encoding="utf-8")


def _curves(finding: Finding) -> Markup:
    image = picture(draw_panels(finding.panels), finding.name)
    return section(finding.name, f"{finding.source}: {finding.published}.",
                   tag("figure", image, tag("figcaption", finding.simulated)))  # fmt: skip


def draw_panels(panels: Sequence[Panel]) -> bytes:
    """Curves below each other on one clock.

    Args:
        panels: what to draw.

    Returns:
        A PNG.
    """
    with drawing(0.4 + 1.35 * len(panels)) as figure:
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for panel, place in zip(panels, axes, strict=True):
            every = max(1, len(panel.time) // _MOST)
            for (label, curve), colour in zip(panel.curves.items(), _COLOURS, strict=False):
                place.plot(panel.time[::every], curve[::every], color=colour, lw=1.0, label=label)
            place.set_title(panel.title)
            if len(panel.curves) > 1:
                place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axes[-1].set_xlabel(panels[-1].across)
        return png(figure)

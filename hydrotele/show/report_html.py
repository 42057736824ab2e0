"""Pieces of HTML: tables, bars, pictures. Every text that comes in is escaped here.

The style of reports, for a screen of 1200 px and for A4 paper.

Pictures of reports: their width, style and font, and how they become PNG.
"""

import base64
import contextlib
import html
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hydrotele.gap.result import Estimate

STYLE = """
:root { --ink: #1d232b; --soft: #5c6672; --line: #dfe3e8; --pale: #f5f7f9;
  --before: #e07b00; --after: #1769aa; --good: #23794a; --bad: #b5281c; --unsure: #9a6700;
  --partly: #7b4aa3; }
* { box-sizing: border-box; }
html { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
body { margin: 0; background: #fff; color: var(--ink); font: 15px/1.55 "Segoe UI", "Helvetica Neue",
  Helvetica, Arial, "Liberation Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 32px 64px; }
header { border-bottom: 3px solid var(--ink); padding-bottom: 20px; }
.over { color: var(--soft); font-size: 13px; letter-spacing: .04em; margin: 0 0 10px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 14px; font-weight: 650; }
h2 { font-size: 19px; margin: 44px 0 6px; font-weight: 650; break-after: avoid; }
h3 { font-size: 15px; margin: 22px 0 6px; font-weight: 650; break-after: avoid; }
p { margin: 6px 0; max-width: 82ch; }
.why { color: var(--soft); font-size: 13.5px; margin-bottom: 12px; }
.chip { display: inline-block; border-radius: 4px; padding: 3px 11px; color: #fff; font-size: 13px;
  font-weight: 650; letter-spacing: .02em; margin-bottom: 12px; }
.chip.named { background: var(--after); } .chip.no_gap { background: var(--good); }
.chip.partly { background: var(--partly); }
.chip.ambiguous { background: var(--unsure); } .chip.unknown { background: var(--bad); }
.verdict p { font-size: 16px; }
.figures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 14px; margin: 26px 0 0; }
.figures div { background: var(--pale); border-left: 4px solid var(--line); padding: 12px 16px; }
.figures .before { border-color: var(--before); } .figures .after { border-color: var(--after); }
.figures b { display: block; font-size: 26px; line-height: 1.25; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: 13px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; margin: 8px 0 4px; }
th { text-align: left; color: var(--soft); font-weight: 600; font-size: 12.5px;
  border-bottom: 1.5px solid var(--ink); padding: 6px 10px; vertical-align: bottom; }
td { border-bottom: 1px solid var(--line); padding: 6px 10px; font-variant-numeric: tabular-nums; }
tr { break-inside: avoid; } thead { display: table-header-group; }
.n { text-align: right; white-space: nowrap; }
small { color: var(--soft); display: block; font-size: 12px; font-weight: 400; }
th b { color: var(--ink); }
table.laws td.r { text-align: center; white-space: nowrap; border-left: 1px solid #fff; }
table.laws th { text-align: left; } table.laws th.n { text-align: center; }
table.laws th:nth-child(even), table.laws td:nth-child(even) { padding-left: 14px; }
.yes { color: var(--good); font-weight: 650; } .no { color: var(--bad); font-weight: 650; }
.bar { background: var(--pale); height: 12px; min-width: 140px; }
.bar div { background: var(--after); height: 12px; min-width: 1px; }
svg { display: block; } svg .one { stroke: var(--soft); stroke-dasharray: 3 2; }
svg .way { stroke: #b9c2cc; stroke-width: 2.5; }
svg .scale { stroke: var(--line); stroke-width: 2; }
svg .before { fill: var(--before); } svg .after { fill: var(--after); }
svg .ci { fill: #8fbce2; } svg .model { stroke: var(--before); stroke-width: 3; }
.key { font-size: 13px; color: var(--soft); }
.key i { display: inline-block; width: 11px; height: 11px; border-radius: 50%;
  margin: 0 5px 0 12px; }
.key i.b { background: var(--before); margin-left: 0; } .key i.a { background: var(--after); }
figure { margin: 14px 0; break-inside: avoid; } img { width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: 13px; }
pre { background: var(--pale); border-left: 4px solid var(--line); padding: 12px 16px;
  font: 12.5px/1.5 "DejaVu Sans Mono", Menlo, Consolas, monospace; overflow-x: auto;
  white-space: pre-wrap; break-inside: avoid-page; }
code { font: 13px "DejaVu Sans Mono", Menlo, Consolas, monospace; }
ul { margin: 6px 0; padding-left: 20px; }
footer { margin-top: 48px; border-top: 1px solid var(--line); padding-top: 12px;
  color: var(--soft); font-size: 13px; }
@media (max-width: 760px) { .figures { grid-template-columns: repeat(2, 1fr); } }
@page { size: A4; margin: 14mm 13mm; }
@media print {
  body { font-size: 10.5pt; } main { padding: 0; max-width: none; }
  h1 { font-size: 20pt; } h2 { margin-top: 22pt; } .wide { overflow: visible; }
  .figures { grid-template-columns: repeat(4, 1fr); gap: 8px; } td, th { padding: 3px 6px; }
  svg.interval { width: 100px; height: auto; } svg.dumbbell { width: 280px; height: auto; }
  .verdict p { font-size: 11pt; } table { font-size: 9pt; } .figures b { font-size: 17pt; }
}
"""


if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 200
_WIDTH = 11.0  # inch, the width of the report's text
_FONTS = ("Helvetica Neue", "Helvetica", "Arial", "Liberation Sans")
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.edgecolor": "0.55",
    "axes.labelcolor": "0.25",
    "xtick.color": "0.25",
    "ytick.color": "0.25",
    "grid.color": "0.9",
    "grid.linewidth": 0.7,
}


def _font() -> str:
    """The page's font where matplotlib has it, else matplotlib's own."""
    from matplotlib.font_manager import fontManager

    present = {font.name for font in fontManager.ttflist}
    return next((name for name in _FONTS if name in present), "DejaVu Sans")


def png(figure: "Figure") -> bytes:
    """A figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, dpi=_DPI, format="png")
    return stream.getvalue()


@contextlib.contextmanager
def drawing(height: float) -> Iterator["Figure"]:
    """A figure of the report's width and a height [inch], in the report's style."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**_STYLE, "font.family": _font()}):  # pyright: ignore - its keys are checked by matplotlib
        figure = Figure(figsize=(_WIDTH, height), facecolor="white", layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


class Markup(str):
    """Text that is HTML already."""


def text(value: object) -> Markup:
    """A value as HTML; markup stays as it is.

    >>> text("a < b"), text(Markup("<b>a</b>"))
    ('a &lt; b', '<b>a</b>')
    """
    return value if isinstance(value, Markup) else Markup(html.escape(str(value)))


def tag(name: str, *inside: object, **attributes: str) -> Markup:
    """An element; `class_` stands for the attribute class.

    >>> tag("p", "1 < 2", class_="a")
    '<p class="a">1 &lt; 2</p>'
    """
    said = "".join(f' {k.rstrip("_")}="{html.escape(v)}"' for k, v in attributes.items())
    return Markup(f"<{name}{said}>{''.join(text(part) for part in inside)}</{name}>")


class Cell(NamedTuple):
    """A cell of a table: what is in it, its class and its style."""

    inside: object
    class_: str = ""
    style: str = ""


def table(
    head: Sequence[object], rows: Iterable[Sequence[object]], class_: str = "", numbers: str = ""
) -> Markup:
    """A table.

    Args:
        head: heads of the columns.
        rows: cells, `Cell` or anything that becomes text.
        class_: class of the table.
        numbers: one letter per column, `n` for those with numbers, which stand right.
    """
    right = [letter == "n" for letter in numbers.ljust(len(head))]
    line = [tag("th", cell, class_="n" if n else "") for cell, n in zip(head, right, strict=True)]
    body = []
    for row in rows:
        cells = [cell if isinstance(cell, Cell) else Cell(cell) for cell in row]
        body.append(tag("tr", *(
            tag("td", c.inside, class_=f"{c.class_}{' n' if n else ''}".strip(), style=c.style)
            for c, n in zip(cells, right, strict=True)
        )))  # fmt: skip
    whole = tag("table", tag("thead", tag("tr", *line)), tag("tbody", *body), class_=class_)
    return tag("div", whole, class_="wide")


def picture(png: bytes, alt: str) -> Markup:
    """A PNG inside the page."""
    data = base64.b64encode(png).decode("ascii")
    return Markup(f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}">')


def bar(part: float) -> Markup:
    """A horizontal bar, 0 .. 1."""
    width = f"width:{100 * min(max(part, 0.0), 1.0):.1f}%"
    return tag("div", tag("div", style=width), class_="bar")


def dumbbell(before: float, after: float | None, low: float, high: float) -> Markup:
    """Sizes before and after on a scale from `low` to `high`, with a line at 1, as inline SVG."""
    width, height = 440, 18
    sizes = (1.0, before, before if after is None else after)
    one, old, new = (8 + (width - 16) * (size - low) / (high - low) for size in sizes)
    parts = [f'<line x1="{one:.1f}" x2="{one:.1f}" y1="0" y2="{height}" class="one"/>']
    if after is not None:
        parts.append(f'<line x1="{old:.1f}" x2="{new:.1f}" y1="9" y2="9" class="way"/>')
    parts.append(f'<circle cx="{old:.1f}" cy="9" r="5" class="before"/>')
    if after is not None:
        parts.append(f'<circle cx="{new:.1f}" cy="9" r="5" class="after"/>')
    return _svg("dumbbell", width, height, parts)


def interval(estimate: Estimate) -> Markup:
    """Value with its interval beside the given model's value, to scale, as inline SVG."""
    numbers = [estimate.value, estimate.low, estimate.high, estimate.nominal]
    finite = [v for v in numbers if math.isfinite(v)]
    if not finite:
        return Markup("")
    width, height, low = 220, 18, min(finite)
    span = (max(finite) - low) or 1.0
    value, start, end, model = (12 + (width - 24) * (v - low) / span for v in numbers)
    parts = [f'<line x1="12" x2="{width - 12}" y1="9" y2="9" class="scale"/>']
    if math.isfinite(model):
        parts.append(f'<line x1="{model:.1f}" x2="{model:.1f}" y1="3" y2="15" class="model"/>')
    if math.isfinite(start) and math.isfinite(end):
        thick = max(end - start, 2.0)
        parts.append(f'<rect x="{start:.1f}" y="5" width="{thick:.1f}" height="8" class="ci"/>')
    if math.isfinite(value):
        parts.append(f'<circle cx="{value:.1f}" cy="9" r="3" class="after"/>')
    return _svg("interval", width, height, parts)


def _svg(class_: str, width: int, height: int, parts: list[str]) -> Markup:
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    head = f'<svg class="{class_}" {size} role="img">'
    return Markup(f"{head}{''.join(parts)}</svg>")


def section(heading: str, why: str, *inside: Markup) -> Markup:
    """A section with a heading and a sentence on what it is for."""
    return tag("section", tag("h2", heading), tag("p", why, class_="why"), *inside)


def page(title: str, style: str, sections: Iterable[Markup]) -> str:
    """A whole document that needs nothing else.

    Args:
        title: for the browser.
        style: CSS.
        sections: its content.

    Returns:
        HTML.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{tag('title', title)}<style>{style}</style></head>\n"
        f"<body><main>{''.join(sections)}</main></body></html>\n"
    )

"""Pieces of HTML: tables, bars, pictures. Every text that comes in is escaped here."""

import base64
import html
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from hydrotele.gap.result import Estimate


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

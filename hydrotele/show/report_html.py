"""Reports as one HTML file: Jinja templates of the folder `templates`, and pictures.

Every value that a template shows is escaped. Templates and their style are for a screen of 1200 px
and for A4 paper. Pictures have the width, style and font of the text, and become PNG.
"""

import base64
import contextlib
import functools
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

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


def svg(figure: "Figure") -> bytes:
    """A figure as SVG, the same bytes for the same figure."""
    import matplotlib

    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hydrotele"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
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


@functools.cache
def _environment() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("hydrotele.show"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters["data_uri"] = _data_uri
    return environment


def _data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def write_report(template: str, path: str | Path, **content: object) -> None:
    """Write a report that needs nothing else.

    Args:
        template: its name in `templates`, without `.html.j2`.
        path: HTML file to write.
        content: what the template shows, by name.
    """
    text = _environment().get_template(f"{template}.html.j2").render(content)
    Path(path).write_text(text, encoding="utf-8")


class Section(NamedTuple):
    """A section of the template `sections`: what of it is empty is left out.

    Attributes:
        heading: of the section.
        why: a sentence on what it is for.
        head: headings of the table's columns.
        rows: its cells.
        numbers: a letter per column, n for those with numbers, which stand right.
        picture: a PNG.
        notes: a list of sentences.
    """

    heading: str
    why: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()
    numbers: str = ""
    picture: bytes | None = None
    notes: Sequence[str] = ()


def write_sections(
    path: str | Path, over: str, heading: str, lead: str, sections: Sequence[Section],
    figures: Sequence[tuple[str, str, str]] = (),
) -> None:  # fmt: skip
    """Write a report of sections.

    Args:
        path: HTML file to write.
        over: a line over the heading, and the browser's title.
        heading: what was found, in a few words.
        lead: one or two sentences below it.
        sections: what follows.
        figures: (class, number, what it is), shown large.
    """
    write_report(
        "sections", path, title=over, over=over, heading=heading, lead=lead, sections=sections,
        figures=figures,
    )  # fmt: skip


class Interval(NamedTuple):
    """Places in a drawing [px]: a value, the start and length of its interval, another value."""

    width: int
    value: float | None
    start: float | None
    length: float | None
    model: float | None


def interval(value: float, low: float, high: float, model: float) -> Interval | None:
    """Where a value, its interval and a model's value stand on one scale; None if none is finite.

    >>> interval(1.5, 1.0, 2.0, 0.0)
    Interval(width=220, value=159.0, start=110.0, length=98.0, model=12.0)
    """
    finite = [v for v in (value, low, high, model) if math.isfinite(v)]
    if not finite:
        return None
    width, least = 220, min(finite)
    span = (max(finite) - least) or 1.0
    at, start, end, other = (
        round(12 + (width - 24) * (v - least) / span, 1) if math.isfinite(v) else None
        for v in (value, low, high, model)
    )
    length = None if start is None or end is None else round(max(end - start, 2.0), 1)
    return Interval(width, at, start, length, other)


class Dumbbell(NamedTuple):
    """Places in a drawing [px]: of 1, of the size before, of the size after."""

    width: int
    one: float
    before: float
    after: float | None


def dumbbell(before: float, after: float | None, low: float, high: float) -> Dumbbell:
    """Where sizes before and after stand on a scale from `low` to `high`, and where 1 is."""
    width = 440

    def place(size: float) -> float:
        return round(8 + (width - 16) * (size - low) / (high - low), 1)

    return Dumbbell(width, place(1.0), place(before), None if after is None else place(after))

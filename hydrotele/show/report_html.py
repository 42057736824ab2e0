"""Write self-contained HTML reports from the Jinja templates in the folder `templates`.

All values inserted by a template are escaped. The layout fits a screen of 1200 px and A4 paper.
Figures use the width, style and font of the page and are embedded as PNG.
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
_WIDTH = 11.0  # inch, width of the text in a report
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


def _choose_font() -> str:
    """Return the font of the page if matplotlib has it, else the default font of matplotlib."""
    from matplotlib.font_manager import fontManager

    present = {font.name for font in fontManager.ttflist}
    return next((name for name in _FONTS if name in present), "DejaVu Sans")


def print_dollar_signs_literally(figure: "Figure") -> None:
    """Make a figure show dollar signs in its texts as they are, not as mathematical formulas.

    A name such as `$x` may be no valid formula. Only the labels of logarithmic axes are formulas.
    """
    from matplotlib.text import Text
    from matplotlib.ticker import LogFormatter

    axes = (axis for each in figure.axes for axis in (each.xaxis, each.yaxis))
    logarithmic = [axis for axis in axes if isinstance(axis.get_major_formatter(), LogFormatter)]
    powers = {text for axis in logarithmic for text in (*axis.get_majorticklabels(), *axis.get_minorticklabels())}
    for text in figure.findobj(Text):
        if isinstance(text, Text) and "$" in text.get_text() and text not in powers:
            text.set_parse_math(False)


def figure_to_png(figure: "Figure") -> bytes:
    """Render a matplotlib figure and return it as PNG bytes."""
    print_dollar_signs_literally(figure)
    stream = io.BytesIO()
    figure.savefig(stream, dpi=_DPI, format="png")
    return stream.getvalue()


def svg(figure: "Figure") -> bytes:
    """Render a matplotlib figure and return it as SVG bytes, equal for equal figures."""
    import matplotlib

    print_dollar_signs_literally(figure)
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hydrotele"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


@contextlib.contextmanager
def open_report_figure(height: float) -> Iterator["Figure"]:
    """Create a matplotlib figure in the style and width of a report, with a height [inch]."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**_STYLE, "font.family": _choose_font()}):  # pyright: ignore - its keys are checked by matplotlib
        figure = Figure(figsize=(_WIDTH, height), facecolor="white", layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


@functools.cache
def _make_template_environment() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("hydrotele.show"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters["data_uri"] = _data_uri
    return environment


def _data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def write_template_report(template: str, path: str | Path, **content: object) -> None:
    """Fill a Jinja template with values and write it as one self-contained HTML file.

    Args:
        template: name of the template in `templates`, without `.html.j2`.
        path: HTML file to write.
        content: variables of the template.
    """
    text = _make_template_environment().get_template(f"{template}.html.j2").render(content)
    Path(path).write_text(text, encoding="utf-8")


class Section(NamedTuple):
    """Section of the template `sections`; empty parts are omitted.

    Attributes:
        heading: heading of the section.
        why: explanation of the section.
        head: column headings of the table.
        rows: rows of the table.
        numbers: one letter per column; columns with letter n are right-aligned.
        picture: PNG image.
        notes: list of sentences.
    """

    heading: str
    why: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()
    numbers: str = ""
    picture: bytes | None = None
    notes: Sequence[str] = ()


def write_sections(
    path: str | Path, overline: str, heading: str, lead: str, sections: Sequence[Section],
    figures: Sequence[tuple[str, str, str]] = (),
) -> None:  # fmt: skip
    """Write an HTML report that consists of sections with tables and pictures.

    Args:
        path: HTML file to write.
        overline: line above the heading, and title of the browser window.
        heading: summary of the result in a few words.
        lead: one or two sentences below the heading.
        sections: sections of the report.
        figures: key figures as (CSS class, number, label), shown in large type.
    """
    write_template_report(
        "sections", path, title=overline, over=overline, heading=heading, lead=lead, sections=sections,
        figures=figures,
    )  # fmt: skip


class Interval(NamedTuple):
    """Positions of an estimate and its confidence interval in a drawing of `width` [px].

    `value` is the position of the estimate, `model` that of the value in the given model. The
    interval begins at `start` and has the length `length`. None stands for a number that is not
    finite.
    """

    width: int
    value: float | None
    start: float | None
    length: float | None
    model: float | None


def scale_interval_to_pixels(value: float, low: float, high: float, model: float) -> Interval | None:
    """Scale an estimate, its interval and the value in the given model to positions in a small drawing [px].

    Values that are not finite have the position None; the result is None if no value is finite.

    >>> scale_interval_to_pixels(1.5, 1.0, 2.0, 0.0)
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
    """Positions of two error ratios in a drawing of `width` [px]: before and after a correction of the model.

    `one` is the position of the ratio 1, that of a perfect model. `after` is None without a
    correction.
    """

    width: int
    one: float
    before: float
    after: float | None


def scale_dumbbell_to_pixels(before: float, after: float | None, low: float, high: float) -> Dumbbell:
    """Scale error ratios before and after a correction to positions in a small drawing [px].

    Args:
        before: value of the given model.
        after: value of the corrected model, or None.
        low: value at the left end.
        high: value at the right end.

    Returns:
        Positions of 1 (a perfect model) and of both values.
    """
    width = 440

    def to_pixels(size: float) -> float:
        return round(8 + (width - 16) * (size - low) / (high - low), 1)

    return Dumbbell(width, to_pixels(1.0), to_pixels(before), None if after is None else to_pixels(after))

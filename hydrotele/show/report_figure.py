"""Pictures of reports: their width, style and font, and how they become PNG."""

import contextlib
import io
from collections.abc import Iterator
from typing import TYPE_CHECKING

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

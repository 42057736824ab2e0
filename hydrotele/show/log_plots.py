"""Draw logs as PNG: all channels of a log, two logs with their difference, and predictions.

The predictions are those of `hydrotele compare`: measurements and open-loop predictions of several
models.
"""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.core.units import display_unit
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import parse_channel
from hydrotele.show.channels import (
    TITLES,
    Trace,
    assign_axis_colours,
    common_channels,
    compute_channel_difference,
    group_channels,
    padded_range,
    scale_channel_for_plot,
)
from hydrotele.show.report_html import figure_to_png, open_report_figure, print_dollar_signs_literally

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COMPARED_KINDS = ("angle", "position", "length", "pressure_head", "pressure_rod", "pressure_supply")
_DPI = 100
_CELL, _PANEL = (560, 270), (820, 220)  # pixel
_HEADER, _FOOTER, _LEFT_MARGIN, _RIGHT_MARGIN, _LABEL_OFFSET = 84, 56, 72, 28, 46  # pixel
_STYLE = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.edgecolor": "0.5",
    "grid.color": "0.88",
    "grid.linewidth": 0.7,
}
_BAND_OPACITY = 0.25
_FIRST_COLOUR, _OTHER_COLOUR, _DIFFERENCE_COLOUR = "#1f4e79", "#f08a00", "#a32a22"
_BAND_COLOUR = "#fbd7a6"  # as the other colour looks with the opacity of a band


def plot_overlay(
    first: Log,
    other: Log,
    path: str | os.PathLike,
    names: tuple[str, str] = ("measured", "simulated"),
    kinds: Sequence[str] = COMPARED_KINDS,
    size: tuple[int, int] | None = None,
    title: str = "",
    band: tuple[Log, Log] | None = None,
) -> None:
    """Draw two logs as PNG, one plot per common channel, with the difference `first - other` below each.

    Args:
        first: log that defines the times of the difference.
        other: log to compare with; it is interpolated linearly.
        path: PNG file, written completely or not at all.
        names: names of the logs in the legend.
        kinds: kinds of channels to draw, if both logs have them.
        size: width and height [pixel], default according to the number of channels.
        title: heading, default the names of the logs.
        band: lower and upper limits of the prediction band of `other`, at its times.

    Raises:
        InputError: the logs have no such channel in common or do not overlap in time, or the file
            cannot be written.
    """
    groups = group_channels(common_channels(first, other))
    rows = [groups[kind] for kind in kinds if kind in groups]
    if not rows:
        raise InputError(other.source, f"has no {', '.join(kinds)} in common with {first.source}")
    axes_shown = [parse_channel(name).axis for some in rows for name in some]
    columns = [axis for axis in dict.fromkeys(axes_shown) if axis] or [""]
    default = max(2, len(columns)) * _CELL[0], len(rows) * _CELL[1] + _HEADER + _FOOTER
    runs = " and ".join(dict.fromkeys(log.name for log in (first, other)))
    with _png_figure(path, size or default) as figure:
        grid = _grid(figure, len(rows), len(columns))
        for row, channels in enumerate(rows):
            for name in channels:
                axis = parse_channel(name).axis
                place = grid[row, columns.index(axis)] if axis else grid[row, :]
                _draw_log_pair(figure, place, first, other, name, band)
        keys = [
            *zip(names, (_FIRST_COLOUR, _OTHER_COLOUR), strict=True),
            (" - ".join(names), _DIFFERENCE_COLOUR),
            *([("95 % band", _BAND_COLOUR)] if band else []),
        ]
        _draw_title_and_legend(figure, title or f"{' and '.join(names)}: {runs}", keys)


def plot_log(log: Log, path: str | os.PathLike, size: tuple[int, int] | None = None, title: str = "") -> None:
    """Draw all channels of a log as PNG, with one panel per kind of channel and one colour per axis.

    Args:
        log: the log.
        path: PNG file, written completely or not at all.
        size: width and height [pixel], default according to the number of panels.
        title: heading, default the name of the log.

    Raises:
        InputError: the log has no channel, or the file cannot be written.
    """
    groups = group_channels(log.columns)
    if not groups:
        raise InputError(log.source, "has no channel to draw")
    columns = 2 if len(groups) > 4 else 1
    rows = -(-len(groups) // columns)
    default = columns * _PANEL[0], rows * _PANEL[1] + _HEADER + _FOOTER
    palette = {axis: tuple(0.85 * c / 255 for c in rgb) for axis, rgb in assign_axis_colours([log]).items()}
    with _png_figure(path, size or default) as figure:
        grid = _grid(figure, rows, columns)
        for place, (kind, names) in enumerate(groups.items()):
            axes = figure.add_subplot(grid[place % rows, place // rows])
            traces = [scale_channel_for_plot(log, name) for name in names]
            for trace in traces:
                axes.plot(log.time, trace.values, color=palette[trace.channel.axis], lw=1.0)
            _format_axes(axes, log.time, traces, TITLES.get(kind, kind))
            axes.set_xlabel("time [s]" if place % rows == rows - 1 else "")
        _draw_title_and_legend(figure, title or log.name, [(axis, c) for axis, c in palette.items() if axis])


def _draw_log_pair(
    figure: "Figure", place, first: Log, other: Log, name: str, band: tuple[Log, Log] | None = None
) -> None:
    """Draw a channel of two logs in a cell of the figure's grid and, below, their difference.

    Args:
        figure: the figure.
        place: cell of its grid.
        first: log that defines the times of the difference.
        other: log that is subtracted.
        name: name of the channel.
        band: lower and upper limits of the prediction band of `other`; channels may be missing.
    """
    cell = place.subgridspec(2, 1, height_ratios=(3, 1.1), hspace=0.12)
    upper = figure.add_subplot(cell[0])
    lower = figure.add_subplot(cell[1], sharex=upper)
    ours, theirs = scale_channel_for_plot(first, name), scale_channel_for_plot(other, name)
    upper.plot(first.time, ours.values, color=_FIRST_COLOUR, lw=1.9)
    upper.plot(other.time, theirs.values, color=_OTHER_COLOUR, lw=0.9)
    if band and name in band[0]:
        low, high = (scale_channel_for_plot(limit, name).values for limit in band)
        upper.fill_between(other.time, low, high, color=_OTHER_COLOUR, lw=0.0, alpha=_BAND_OPACITY)
    what = TITLES.get(ours.channel.kind, ours.channel.kind)
    heading = f"{ours.channel.axis} {what}" if ours.channel.axis else what
    _format_axes(upper, first.time, [ours, theirs], heading)
    upper.tick_params(labelbottom=False)
    time, gap = compute_channel_difference(first, other, name)
    lower.plot(time, gap.values, color=_DIFFERENCE_COLOUR, lw=0.8)
    _format_axes(lower, first.time, [gap], "")
    rms = float(np.sqrt(np.mean(gap.values**2)))
    upper.set_title(f"RMS difference {rms:.3g} {gap.unit}", loc="right", fontsize=8.5, color=_DIFFERENCE_COLOUR)
    lower.set_xlabel("time [s]")


def _format_axes(axes: "Axes", time: np.ndarray, traces: Sequence[Trace], title: str) -> None:
    """Set title, axis limits and unit label of a plot.

    Args:
        axes: the plot.
        time: (n,) times [s]; the first and last one limit the x axis.
        traces: lines of the plot; their values determine the limits of the y axis.
        title: title of the plot.
    """
    units = dict.fromkeys("" if trace.unit == "1" else trace.unit for trace in traces)
    axes.set_title(title)
    axes.set_ylabel(", ".join(units))
    width = axes.get_window_extent().width
    axes.yaxis.set_label_coords(-_LABEL_OFFSET / width, 0.5)
    axes.set_xlim(time[0], time[-1])
    axes.set_ylim(padded_range([trace.values for trace in traces], traces[0].unit))
    axes.locator_params(axis="y", nbins=5 if title else 3)


@contextlib.contextmanager
def _png_figure(path: str | os.PathLike, size: tuple[int, int]) -> Iterator["Figure"]:
    """Create a figure of a size [pixel] and write it as PNG at the end of the context."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # pyplot would open windows and keep global state.
    with atomic_file(path, ".png") as part, matplotlib.rc_context(_STYLE):  # pyright: ignore - its keys are checked by matplotlib
        figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        yield figure
        print_dollar_signs_literally(figure)
        figure.savefig(part, dpi=_DPI)


def _grid(figure: "Figure", rows: int, columns: int):
    width, height = figure.get_size_inches() * _DPI
    return figure.add_gridspec(
        rows, columns, left=_LEFT_MARGIN / width, right=1.0 - _RIGHT_MARGIN / width, bottom=_FOOTER / height,
        top=1.0 - _HEADER / height, wspace=0.2, hspace=0.42,
    )  # fmt: skip


def _draw_title_and_legend(figure: "Figure", title: str, keys: Sequence[tuple[str, Any]]) -> None:
    """Draw title and common legend at the top of a figure; `keys` are (name, colour) of the lines."""
    from matplotlib.lines import Line2D

    width, height = figure.get_size_inches() * _DPI
    figure.text(_LEFT_MARGIN / width, 1.0 - 22 / height, title, fontsize=14, fontweight="bold", va="center")
    figure.legend(
        handles=[Line2D([], [], color=colour, lw=2.4, label=name) for name, colour in keys],
        loc="center right", bbox_to_anchor=(1.0 - _RIGHT_MARGIN / width, 1.0 - 22 / height),
        ncols=len(keys), frameon=False, borderaxespad=0.0,
    )  # fmt: skip


MEASURED_COLOUR = "#262b33"
_COLOURS = ("#e07b00", "#1769aa", "#2e8b57", "#b5281c", "#7b4fa3", "#8c6d31")
_PANEL_HEIGHT = 1.6  # inch, height of a panel
_MARGIN_FRACTION = 0.15  # margin above and below, relative to the range of the measurements


def draw_open_loop_predictions(
    time: np.ndarray, measured: np.ndarray, predicted: Mapping[str, np.ndarray],
    channels: Sequence[str], units: Sequence[str], title: str,
    bands: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
) -> bytes:  # fmt: skip
    """Draw measurements and open-loop predictions of several models over time, one panel per channel.

    Args:
        time: (n,) times [s].
        measured: (n, c) measurements in SI units, NaN if missing.
        predicted: {model name: (n, c) open-loop predictions in SI units, NaN if missing}.
        channels: names of the c channels.
        units: SI units of the channels.
        title: title of the figure.
        bands: {model name: lower and upper limits of its prediction band, each (n, c) in SI units}.

    Returns:
        A PNG.
    """
    with open_report_figure(0.7 + _PANEL_HEIGHT * len(channels)) as figure:
        plots = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
        for c, (plot, channel, unit) in enumerate(zip(plots, channels, units, strict=True)):
            known = measured[:, c][np.isfinite(measured[:, c])]
            low, high = (known.min(), known.max()) if len(known) else (0.0, 1.0)
            shown, factor = display_unit(unit, max(abs(low), abs(high)))
            plot.plot(time, factor * measured[:, c], color=MEASURED_COLOUR, lw=2.2, alpha=0.5,
                      label="measured")  # fmt: skip
            for k, (name, values) in enumerate(predicted.items()):
                plot.plot(time, factor * values[:, c], color=_COLOURS[k % len(_COLOURS)], lw=0.9,
                          ls="-" if k < len(_COLOURS) else "--", label=name)  # fmt: skip
                if bands and name in bands:
                    low_limit, high_limit = (factor * side[:, c] for side in bands[name])
                    plot.fill_between(time, low_limit, high_limit, color=_COLOURS[k % len(_COLOURS)], lw=0.0,
                                      alpha=_BAND_OPACITY)  # fmt: skip
            room = _MARGIN_FRACTION * (high - low) or 1.0
            plot.set_ylim(factor * (low - room), factor * (high + room))
            plot.set_ylabel(channel.replace(".", "\n") + f" [{shown}]")
        plots[0].set_title(title)
        plots[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8.5,
                        ncols=min(4, 1 + len(predicted)), borderaxespad=0.1)  # fmt: skip
        plots[-1].set_xlabel("time [s]")
        plots[-1].set_xlim(time[0], time[-1])
        figure.align_ylabels()
        return figure_to_png(figure)

"""The pictures of a gap report: heat map of prediction errors, and predictions over readings."""

from typing import TYPE_CHECKING

import numpy as np

from hydrotele.gap.customary import customary
from hydrotele.gap.result import LearnedLaw, Prediction
from hydrotele.gap.words import channel_words, variable_words
from hydrotele.machine.signals import usual_unit
from hydrotele.show.channels import padded_range, shown_unit
from hydrotele.show.gap_windows import windowed
from hydrotele.show.report_figure import drawing, png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED, NOMINAL, PATCHED = "#262b33", "#e07b00", "#1769aa"
_ADDED = {"force": "force", "command": "command"} | dict.fromkeys(
    ("flow_head", "flow_rod", "flow_through", "flow_supply"), "flow"
)
_ZOOM = 2.0  # s
_LOUDEST = 6.0  # times noise, where the colours of the heat map end at the latest


def draw_heat_map(before: Prediction, after: Prediction, changed: bool) -> bytes:
    """Channels over time: size of the whitened errors in windows, before and after.

    Args:
        before: predictions of the given model.
        after: predictions of the patched model.
        changed: whether they are two models; otherwise only the first is drawn.

    Returns:
        A PNG.
    """
    pairs = [("model as given", before), *([("patched model", after)] if changed else [])]
    labels = [channel_words(channel) for channel in before.channels]
    loudest = np.nanpercentile(windowed(before).rms, 99.5)
    top = float(np.clip(np.ceil(loudest), 2.0, _LOUDEST))
    with drawing(0.24 * len(labels) + 1.3) as figure:
        rows = figure.subplots(1, len(pairs), sharey=True, squeeze=False)[0]
        meshes = []
        for axes, (title, prediction) in zip(rows, pairs, strict=True):
            found = windowed(prediction)
            places = np.arange(len(labels) + 1)
            size = np.ma.masked_invalid(found.rms.T)
            mesh = axes.pcolormesh(
                found.edges, places, size, cmap=_colours(top), vmin=0.0, vmax=top, linewidth=0
            )
            meshes.append(mesh)
            axes.set_title(title)
            axes.set_xlabel("time [s]")
            axes.set_yticks(places[:-1] + 0.5, labels)
            axes.set_ylim(len(labels), 0)
            axes.set_facecolor("0.85")
            axes.grid(False)
            axes.tick_params(left=False)
        bar = figure.colorbar(meshes[0], ax=rows.tolist(), pad=0.015, aspect=26, extend="max")
        bar.set_label("error / sensor noise")
        bar.outline.set_visible(False)  # pyright: ignore - stubs lack the outline's type
        return png(figure)


def draw_overlay(before: Prediction, after: Prediction, channel: str, changed: bool) -> bytes:
    """One channel: readings and predictions, their differences, and a zoom on the worst window.

    Args:
        before: predictions of the given model.
        after: predictions of the patched model.
        channel: the channel.
        changed: whether they are two models; otherwise only the first is drawn.

    Returns:
        A PNG.
    """
    column = before.channels.index(channel)
    unit, factor = shown_unit(usual_unit(channel))
    measured = factor * before.measured[:, column]
    lines = [("model as given", NOMINAL, factor * before.predicted[:, column])]
    if changed:
        lines.append(("patched model", PATCHED, factor * after.predicted[:, column]))
    low, high = _worst(before, column)
    with drawing(3.0) as figure:
        places = figure.subplots(2, 2, height_ratios=(1.7, 1.0), width_ratios=(1.55, 1.0))
        for side, span in enumerate(((before.time[0], before.time[-1]), (low, high))):
            inside = (before.time >= span[0]) & (before.time <= span[1])
            upper, lower = places[0, side], places[1, side]
            _signals(upper, before.time, measured, lines, inside, dots=side == 1)
            _errors(lower, before.time, measured, lines, inside)
            upper.tick_params(labelbottom=False)
            for axes in (upper, lower):
                axes.set_xlim(*span)
            lower.set_xlabel("time [s]")
        places[0, 0].axvspan(low, high, color="0.5", alpha=0.15, lw=0)
        places[1, 0].axvspan(low, high, color="0.5", alpha=0.15, lw=0)
        places[0, 0].set_title(channel_words(channel))
        places[0, 0].set_ylabel(unit)
        places[0, 1].set_title(f"worst window, {low:.1f} to {high:.1f} s")
        places[1, 0].set_ylabel(f"reading -\nprediction\n[{unit}]")
        figure.align_ylabels()
        return png(figure)


def draw_law(law: LearnedLaw) -> bytes:
    """A learned law over its variable, with a band of two standard deviations.

    Args:
        law: the law.

    Returns:
        A PNG.
    """
    points, values, spread = (np.array(v) for v in (law.points, law.values, law.spread))
    along, per_point = customary(law.variable_unit, float(np.max(np.abs(points))))
    unit, per_value = customary(law.unit, float(np.max(np.abs(values))))
    with drawing(2.6) as figure:
        axes = figure.subplots()
        low, high = per_value * (values - 2.0 * spread), per_value * (values + 2.0 * spread)
        axes.fill_between(per_point * points, low, high, color=PATCHED, alpha=0.2, lw=0)
        axes.plot(per_point * points, per_value * values, color=PATCHED, lw=1.6)
        axes.axhline(0.0, color="0.6", lw=0.8)
        axes.set_xlabel(f"{variable_words(law.variable)} [{along}]")
        axes.set_ylabel(f"added {_ADDED[law.balance]} [{unit}]")
        return png(figure)


def _signals(axes: "Axes", time, measured, lines, inside, dots: bool) -> None:
    style = {"ls": "none", "marker": "o", "ms": 2.6} if dots else {"lw": 2.2, "alpha": 0.55}
    axes.plot(time, measured, color=MEASURED, label="measured", zorder=1, **style)  # pyright: ignore - matplotlib's stubs take no mixed keywords
    for name, colour, values in lines:
        axes.plot(time, values, color=colour, lw=1.3 if dots else 0.9, label=name)
    values = [measured, *(values for _, _, values in lines)]
    _limit(axes, [v[inside] for v in values])
    if not dots:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1,
            fontsize=8.5, handlelength=1.4, columnspacing=1.0,
        )  # fmt: skip


def _errors(axes: "Axes", time, measured, lines, inside) -> None:
    axes.axhline(0.0, color="0.6", lw=0.8)
    for _, colour, values in lines:
        axes.plot(time, measured - values, color=colour, lw=0.9)
    _limit(axes, [(measured - values)[inside] for _, _, values in lines])
    axes.locator_params(axis="y", nbins=4)


def _limit(axes: "Axes", values: list[np.ndarray]) -> None:
    finite = [v[np.isfinite(v)] for v in values]
    axes.set_ylim(padded_range(finite, ""))


def _worst(prediction: Prediction, column: int) -> tuple[float, float]:
    """Two seconds around the worst window of a channel [s]."""
    found = windowed(prediction)
    worst = int(np.argmax(np.nan_to_num(found.rms[:, column])))
    middle = 0.5 * (found.edges[worst] + found.edges[worst + 1])
    first, last = float(prediction.time[0]), float(prediction.time[-1])
    low = max(first, min(middle - 0.5 * _ZOOM, last - _ZOOM))
    return low, min(last, low + _ZOOM)


def _colours(top: float):
    """White for noise alone, then through amber to dark red at `top` times noise."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = ((0.0, "#f9fafb"), (1.0, "#f3f5f7"), (1.35, "#f3ecdc"), (1.5, "#fbd68b"))
    rest = ("#ee8a2d", "#b5281c", "#5f0f1d")
    steps = [(1.5 + (top - 1.5) * (k + 1) / len(rest), rest[k]) for k in range(len(rest))]
    scaled = [(level / top, colour) for level, colour in (*stops, *steps)]
    return LinearSegmentedColormap.from_list("gap", scaled)

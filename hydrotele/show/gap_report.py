"""Write the HTML report of a search for differences (gap) between a model and logs.

The module formats the tables (effects, channels, laws, ranking, residual tests) for the template
`gap.html.j2`. It draws the heat map of the prediction errors, the predictions of single channels
and the learned laws.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

import hydrotele
from hydrotele.core.units import display_unit, plot_axis_unit
from hydrotele.effects import EFFECTS
from hydrotele.gap.description import (
    channel_words,
    effect_title,
    gap_closed,
    headline,
    lack_words,
    law_words,
    learned_title,
    most_moved,
    number_title,
    probability_text,
    share_words,
    variable_words,
    verdict_words,
)
from hydrotele.gap.patched import has_patch
from hydrotele.gap.result import (
    Candidate,
    Estimate,
    Gap,
    LearnedLaw,
    Prediction,
    amount,
    finite,
    in_customary_units,
)
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine import Machine
from hydrotele.show import report_html
from hydrotele.show.channels import padded_range
from hydrotele.show.gap_explanation import regression_content, why_content
from hydrotele.show.prediction_errors import channel_rms, find_most_improved_channels, windowed_errors
from hydrotele.show.report_html import (
    figure_to_png,
    open_report_figure,
    scale_dumbbell_to_pixels,
    scale_interval_to_pixels,
)

_MAX_RANKED_EFFECTS = 12
_MAX_COLOUR_RATIO = 10.0  # times sensor noise at which the colour of a cell is darkest
_MAX_PLOTTED_CHANNELS = 4
_VERDICT_LABELS = {
    "named": "Effect identified",
    "no_gap": "No gap",
    "ambiguous": "Ambiguous",
    "unknown": "Unknown effect",
    "partly": "Partly identified",
    "learned": "Law learned",
}


def write_report(gap: Gap, path: str | Path) -> None:
    """Write the HTML report of a search for model errors as one self-contained file.

    Args:
        gap: result of the search.
        path: file to write.
    """
    mechanism = not isinstance(gap.machine, Machine)
    patched, runs = has_patch(gap), ", ".join(p.run for p in gap.before[1:])
    over = f"GAP REPORT  ·  machine {gap.machine.name}"
    over += f", tool {gap.machine.tool}" if gap.machine.tool else ""
    if gap.before:
        over += f"  ·  held-out run {gap.before[0].run}" + (f", fitted on {runs}" if runs else "")
    report_html.write_template_report(
        "gap", path, title=f"{gap.machine.name}: {headline(gap)}", over=over, heading=headline(gap),
        chip=(gap.verdict, _VERDICT_LABELS[gap.verdict]), figures=_key_figure_cards(gap), verdict=verdict_words(gap),
        found=_effect_rows(gap), calibrated=_calibration_rows(gap), learned=[*map(_law_content, gap.learned)],
        unknown=_unknown_content(gap), lacks=_residual_input_rows(gap), patched=patched,
        run=gap.before[0].run if gap.before else "", proof=_validation_content(gap) if gap.before else None,
        laws=_law_residual_table(gap, patched) if gap.laws else None,
        heat_map=draw_heat_map(gap.before[0], gap.after[0], patched) if gap.before else None,
        ranking=_ranking(gap), unlisted=len(gap.ranking) - _MAX_RANKED_EFFECTS, tests=_residual_test_rows(gap),
        proof_words=_VALIDATION_TEXTS[mechanism].format(gap.before[0].run if gap.before else ""),
        commands=_COMMANDS[mechanism], open_loop=_open_loop_content(gap),
        noise=_noise(gap), rivals=_alternative_rows(gap), experiment=_next_experiment_content(gap), notes=gap.notes,
        unused=gap.unused_channels, regressions=regression_content(gap), why=why_content(gap),
        version=hydrotele.__version__, seconds=f"{gap.seconds:.0f}",
    )  # fmt: skip


_VALIDATION_TEXTS = {
    False: "RMS one-step prediction errors on run {}, which was not fitted, divided by the sensor"
    " noise (lower is better). From the measurements up to a row, the model predicts those of the"
    " next row. A perfect model has the value 1.0, which is sensor noise alone.",
    True: "RMS errors of the drive forces on run {}, which was not fitted, divided by the noise"
    " (lower is better). The model computes the forces from the measured motion by inverse"
    " dynamics. A perfect model has the value 1.0, which is noise alone.",
}  # fmt: skip
_COMMANDS = {
    False: "hydrotele replay LOG --machine patched/\nhydrotele run SCENARIO --machine patched/",
    True: "hydrotele gap --mjcf patched/robot.xml --columns patched/columns.yaml --data LOGS\n"
    "hydrotele identify --mjcf patched/robot.xml --columns patched/columns.yaml --data LOGS",
}  # fmt: skip


def _open_loop_content(gap: Gap) -> dict[str, Any] | None:
    """Return text and table rows of the open-loop position errors of a mechanism, per drive.

    The columns are the errors of the given and, if there is one, the corrected model. The result is
    None if no open-loop errors were computed.
    """
    if not gap.open_loop:
        return None
    horizon, models = gap.open_loop["horizon"], [gap.open_loop["before"]]
    models += [gap.open_loop["after"]] if "after" in gap.open_loop else []
    rows = []
    for drive in models[0]:
        unit = "m" if gap.law_units["force"] == "N" else "rad"
        rows.append((drive, *(amount(model[drive], unit) for model in models)))
    words = (
        "MuJoCo simulates the MJCF with the measured forces and without a controller, starting from"
        f" measured states. The table shows the RMS position error of each drive after {horizon:g}"
        " s (lower is better)."
    )
    return {"words": words, "rows": rows}


def _key_figure_cards(gap: Gap) -> list[tuple[str, str, str]]:
    size, closed, patched = gap.size, gap_closed(gap.size), has_patch(gap)
    cards = [("before", f"{size.before:.2f} × noise", "prediction error, given model")]
    if patched:
        cards.append(("after", f"{size.after:.2f} × noise", "prediction error, patched model"))
    if patched and math.isfinite(closed):
        cards.append(("", f"{100 * closed:.0f} %", "of the gap closed on held-out data"))
    if size.noise_floor is not None:
        cards.append(("", f"{size.noise_floor:.2f} × noise", "prediction error of a perfect model"))
    return cards


def _scale_interval(estimate: Estimate) -> report_html.Interval | None:
    return scale_interval_to_pixels(estimate.value, estimate.low, estimate.high, estimate.nominal)


def _effect_rows(gap: Gap) -> list[dict[str, Any]]:
    rows = []
    for effect in gap.effects:
        for name, estimate in effect.parameters.items():
            s = in_customary_units(estimate, name)
            rows.append({
                "effect": effect_title(effect),
                "texts": (name.replace("_", " "), s.nominal, s.value, f"{s.low} to {s.high}",
                           s.unit),
                "drawn": _scale_interval(estimate),
                "trust": (probability_text(effect.probability), share_words(effect.share)),
            })  # fmt: skip
    return rows


def _calibration_rows(gap: Gap) -> list[dict[str, Any]]:
    """Return table rows of the parameters that the search calibrated before it tested effects.

    The first rows are those with the largest change in relation to the width of the interval.
    """
    rows = []
    for key in most_moved(gap) if gap.calibration else ():
        s = in_customary_units(gap.calibration[key], key)
        values = (number_title(key), s.nominal, s.value, f"{s.low} to {s.high}", s.unit)
        rows.append({"texts": values, "drawn": _scale_interval(gap.calibration[key])})
    return rows


def _law_content(law: LearnedLaw) -> dict[str, Any]:
    share = f" It closes {share_words(law.share)} of the gap on the held-out run."
    return {
        "title": learned_title(law), "unit": law.unit, "formula": law.formula,
        "description": law.description + (share if math.isfinite(law.share) else ""),
        "picture": draw_law(law),
    }  # fmt: skip


def _unknown_content(gap: Gap) -> dict[str, Any] | None:
    unknown = gap.unknown
    if unknown is None:
        return None
    windows = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in unknown.windows)
    facts = [
        ("violated law", f"{unknown.law}: {law_words(unknown.law)}"),
        ("channel with the largest error", channel_words(unknown.channel)),
        ("correlated with", ", ".join(map(channel_words, unknown.depends_on)) or "-"),
        ("time of the largest errors", windows or "-"),
    ]
    return {"description": unknown.description, "facts": facts}


def _residual_input_rows(gap: Gap) -> list[tuple[str, str, float]]:
    """Return table rows of the forces, flows and commands that the corrected model still misses.

    Returns:
        (name, size as a percentage of full force, rated flow or full command, size relative to the
        first row), the largest first.
    """
    return [
        (lack_words(lack), f"{100 * lack.part:.2g} %", lack.part / gap.lacks[0].part)
        for lack in gap.lacks if lack.part > 0
    ]  # fmt: skip


def _validation_content(gap: Gap) -> dict[str, Any]:
    before, after, patched = gap.before[0], gap.after[0], has_patch(gap)
    return {
        "channels": _channel_error_rows(before, after if patched else None),
        "pictures": [
            (channel_words(name), draw_channel_predictions(before, after, name, patched))
            for name in find_most_improved_channels(before, after, _MAX_PLOTTED_CHANNELS)
        ],
    }


def _channel_error_rows(before: Prediction, after: Prediction | None) -> list[dict[str, Any]]:
    """Return table rows of the RMS prediction error of each channel over its predicted standard deviation.

    `before` is the prediction of the given model, `after` that of the corrected one, if there is one.
    """
    old = channel_rms(before)
    new = channel_rms(after) if after else np.full(len(old), np.nan)
    finite_ones = [v for v in (*old, *new) if math.isfinite(v)]
    low, high = 0.95 * min([1.0, *finite_ones]), 1.05 * max([1.2, *finite_ones])
    rows = []
    for channel, b, a in zip(before.channels, old, new, strict=True):
        known = math.isfinite(b)
        sizes = [f"{b:.2f}" if known else "not measured"]
        sizes += [f"{a:.2f}" if known else ""] if after else []
        drawn = scale_dumbbell_to_pixels(float(b), float(a) if after else None, low, high) if known else None
        rows.append({"texts": (channel_words(channel), *sizes), "drawn": drawn})
    return rows


def _law_residual_table(gap: Gap, is_patched: bool) -> dict[str, Any]:
    """Return the table of the RMS residuals of each physical law at each component, with ratios to noise.

    With a corrected model (`is_patched`), each component has two columns: given and patched.

    Returns:
        `head`: (component, model) of each column. `rows`: name and description of a law, and its
        cells.
    """
    places = list(dict.fromkeys(place for by_place in gap.laws.values() for place in by_place))
    keys = {"before": "given", "after": "patched"} if is_patched else {"before": "given"}
    rows = []
    for law, by_place in gap.laws.items():
        unit = gap.law_units.get(law, "1")
        cells = [_law_residual_cell(by_place.get(place), key, unit) for place in places for key in keys]
        rows.append({"law": law, "words": law_words(law), "cells": cells})
    return {"head": [(place, words) for place in places for words in keys.values()], "rows": rows}


def _law_residual_cell(residual: Mapping[str, float] | None, key: str, unit: str) -> dict[str, str]:
    if residual is None or not math.isfinite(residual.get(key, math.nan)):
        return {"ratio": "", "size": "", "colour": ""}
    value, noise = residual[key], residual.get("noise", math.nan)
    size = amount(value, unit)
    if not (math.isfinite(noise) and noise > 0):
        return {"ratio": "-", "size": size, "colour": ""}
    return {
        "ratio": f"{value / noise:.1f} ×",
        "size": size,
        "colour": _residual_colour(value / noise),
    }


def _residual_colour(ratio: float) -> str:
    """Return the cell colour (#rrggbb) of a residual-to-noise ratio: white up to 1.2, then amber, red from 10."""
    part = min(max(math.log(max(ratio, 1e-9) / 1.2) / math.log(_MAX_COLOUR_RATIO / 1.2), 0.0), 1.0)
    stops = ((255, 255, 255), (253, 226, 170), (240, 160, 110))
    low, high = (stops[0], stops[1]) if part < 0.5 else (stops[1], stops[2])
    mix = 2 * part if part < 0.5 else 2 * part - 1
    return "#" + "".join(f"{round(a + mix * (b - a)):02x}" for a, b in zip(low, high, strict=True))


def _ranking(gap: Gap) -> list[dict[str, Any]]:
    """Return table rows of the up to 12 best single effects, in the order of the ranking."""
    shown = gap.ranking[:_MAX_RANKED_EFFECTS]
    best = max((c.log_bayes_factor for c in shown), default=1.0)
    named = {(effect.name, effect.location) for effect in gap.effects}
    rows = []
    for place, candidate in enumerate(shown, 1):
        factor = candidate.log_bayes_factor
        rows.append({
            "place": place, "title": effect_title(candidate), "factor": f"{factor:,.0f}",
            "named": (candidate.name, candidate.location) in named,
            "best": ", ".join(_format_parameter(gap, candidate, name) for name in candidate.parameters),
            "part": factor / best if best > 0 else 0.0,
        })  # fmt: skip
    return rows


def _format_parameter(gap: Gap, candidate: Candidate, name: str) -> str:
    value, label = candidate.parameters[name], name.replace("_", " ")
    effect = EFFECTS.get(candidate.name)
    facts = {}
    if effect is not None and not candidate.units:
        facts = effect.parameters(gap.machine, candidate.location)
    unit = candidate.units.get(name) or (facts[name].unit if name in facts else None)
    return f"{label} {amount(value, unit, name) if unit else f'{value:.3g}'}"


def _residual_test_rows(gap: Gap) -> list[tuple[str, str, str, bool]]:
    """Return table rows of the residual tests of the final model: name, value, limit, passed."""
    return [
        (
            name,
            _format_number(test.get("value")),
            _format_number(test.get("limit")),
            bool(test.get("passed")),
        )
        for name, test in gap.tests.items()
    ]


def _format_number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, int | float) and math.isfinite(value) else "-"


def _noise(gap: Gap) -> list[tuple[str, str, str, str]]:
    """Return table rows of sensor noise: channel, estimated and stated standard deviation, their ratio."""
    rows = []
    for channel, (found, stated) in gap.noise.items():
        unit, known = default_channel_unit(channel), math.isfinite(stated)
        ratio = f"{found / stated:.2f}" if known and stated > 0 else "-"
        rows.append((channel_words(channel), amount(found, unit),
                     amount(stated, unit) if known else "not stated", ratio))  # fmt: skip
    return rows


def _alternative_rows(gap: Gap) -> list[tuple[str, ...]]:
    return [
        (effect_title(e), effect_title(a), probability_text(e.probability),
         probability_text(a.probability))
        for e in gap.effects for a in e.alternatives
    ]  # fmt: skip


def _next_experiment_content(gap: Gap) -> dict[str, str] | None:
    if not gap.next_experiment:
        return None
    scenario, written = gap.next_experiment.get("scenario"), ""
    if scenario:
        written = yaml.safe_dump(finite(scenario), sort_keys=False, default_flow_style=None)
    return {"reason": gap.next_experiment.get("reason", ""), "scenario": written}


if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED_COLOUR, NOMINAL_COLOUR, PATCHED_COLOUR = "#262b33", "#e07b00", "#1769aa"
_ADDED_QUANTITIES = {"force": "force", "command": "command"} | dict.fromkeys(
    ("flow_head", "flow_rod", "flow_through", "flow_supply"), "flow"
)
_ZOOM_DURATION = 2.0  # s, duration of the enlarged interval
_MIN_CUSTOMARY_VALUE = 0.5  # value in the customary unit below which the SI unit is used, such as N for kN
_MAX_HEAT_MAP_RATIO = 6.0  # times sensor noise, maximum upper limit of the colour scale


def draw_heat_map(before: Prediction, after: Prediction, is_patched: bool) -> bytes:
    """Draw the RMS prediction errors of all channels in windows of 0.5 s as a heat map, relative to noise.

    Args:
        before: one-step predictions of the given model.
        after: one-step predictions of the corrected model.
        is_patched: whether the models differ; otherwise only the first is drawn.

    Returns:
        A PNG.
    """
    pairs = [("given model", before), *([("patched model", after)] if is_patched else [])]
    labels = [channel_words(channel) for channel in before.channels]
    loudest = np.nanpercentile(windowed_errors(before).rms, 99.5)
    top = float(np.clip(np.ceil(loudest), 2.0, _MAX_HEAT_MAP_RATIO))
    with open_report_figure(0.24 * len(labels) + 1.3) as figure:
        rows = figure.subplots(1, len(pairs), sharey=True, squeeze=False)[0]
        meshes = []
        for axes, (title, prediction) in zip(rows, pairs, strict=True):
            found = windowed_errors(prediction)
            places = np.arange(len(labels) + 1)
            size = np.ma.masked_invalid(found.rms.T)
            mesh = axes.pcolormesh(
                found.edges,
                places,
                size,
                cmap=_heat_colour_map(top),
                vmin=0.0,
                vmax=top,
                linewidth=0,
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
        bar.set_label("RMS error / sensor noise [1]")
        bar.outline.set_visible(False)  # pyright: ignore - stubs lack the outline's type
        return figure_to_png(figure)


def draw_channel_predictions(before: Prediction, after: Prediction, channel: str, is_patched: bool) -> bytes:
    """Draw measurements, one-step predictions and errors of a channel over a run.

    A second column enlarges the 2 s around the largest error of the given model.

    Args:
        before: predictions of the given model.
        after: predictions of the patched model.
        channel: name of the channel.
        is_patched: whether the models differ; otherwise only the first is drawn.

    Returns:
        A PNG.
    """
    column = before.channels.index(channel)
    unit, factor = plot_axis_unit(default_channel_unit(channel))
    if np.nanmax(np.abs(before.measured[:, column]), initial=0.0) * factor < _MIN_CUSTOMARY_VALUE:
        unit, factor = default_channel_unit(channel), 1.0
    measured = factor * before.measured[:, column]
    lines = [("given model", NOMINAL_COLOUR, factor * before.predicted[:, column])]
    if is_patched:
        lines.append(("patched model", PATCHED_COLOUR, factor * after.predicted[:, column]))
    low, high = _worst_interval(before, column)
    with open_report_figure(3.0) as figure:
        places = figure.subplots(2, 2, height_ratios=(1.7, 1.0), width_ratios=(1.55, 1.0))
        for side, span in enumerate(((before.time[0], before.time[-1]), (low, high))):
            inside = (before.time >= span[0]) & (before.time <= span[1])
            upper, lower = places[0, side], places[1, side]
            _plot_signals(upper, before.time, measured, lines, inside, dots=side == 1)
            _plot_errors(lower, before.time, measured, lines, inside)
            upper.tick_params(labelbottom=False)
            for axes in (upper, lower):
                axes.set_xlim(*span)
            lower.set_xlabel("time [s]")
        places[0, 0].axvspan(low, high, color="0.5", alpha=0.15, lw=0)
        places[1, 0].axvspan(low, high, color="0.5", alpha=0.15, lw=0)
        places[0, 0].set_title(channel_words(channel))
        places[0, 0].set_ylabel(unit)
        places[0, 1].set_title(f"worst window, {low:.1f} to {high:.1f} s")
        places[1, 0].set_ylabel(f"measured -\npredicted\n[{unit}]")
        figure.align_ylabels()
        return figure_to_png(figure)


def draw_law(law: LearnedLaw) -> bytes:
    """Draw a law learned from the logs over its variable, with a band of two standard deviations.

    Args:
        law: added force, flow or command as a function of a variable.

    Returns:
        A PNG.
    """
    points, values, spread = (np.array(v) for v in (law.points, law.values, law.spread))
    along, per_point = display_unit(law.variable_unit, float(np.max(np.abs(points))))
    unit, per_value = display_unit(law.unit, float(np.max(np.abs(values))))
    with open_report_figure(2.6) as figure:
        axes = figure.subplots()
        low, high = per_value * (values - 2.0 * spread), per_value * (values + 2.0 * spread)
        axes.fill_between(per_point * points, low, high, color=PATCHED_COLOUR, alpha=0.2, lw=0)
        axes.plot(per_point * points, per_value * values, color=PATCHED_COLOUR, lw=1.6)
        axes.axhline(0.0, color="0.6", lw=0.8)
        axes.set_xlabel(f"{variable_words(law.variable)} [{along}]")
        axes.set_ylabel(f"added {_ADDED_QUANTITIES[law.balance]} [{unit}]")
        return figure_to_png(figure)


def _plot_signals(axes: "Axes", time, measured, lines, inside, dots: bool) -> None:
    style = {"ls": "none", "marker": "o", "ms": 2.6} if dots else {"lw": 2.2, "alpha": 0.55}
    axes.plot(time, measured, color=MEASURED_COLOUR, label="measured", zorder=1, **style)  # pyright: ignore - matplotlib's stubs take no mixed keywords
    for name, colour, values in lines:
        axes.plot(time, values, color=colour, lw=1.3 if dots else 0.9, label=name)
    values = [measured, *(values for _, _, values in lines)]
    _set_limits(axes, [v[inside] for v in values])
    if not dots:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1,
            fontsize=8.5, handlelength=1.4, columnspacing=1.0,
        )  # fmt: skip


def _plot_errors(axes: "Axes", time, measured, lines, inside) -> None:
    axes.axhline(0.0, color="0.6", lw=0.8)
    for _, colour, values in lines:
        axes.plot(time, measured - values, color=colour, lw=0.9)
    _set_limits(axes, [(measured - values)[inside] for _, _, values in lines])
    axes.locator_params(axis="y", nbins=4)


def _set_limits(axes: "Axes", values: list[np.ndarray]) -> None:
    finite = [v[np.isfinite(v)] for v in values]
    axes.set_ylim(padded_range(finite, ""))


def _worst_interval(prediction: Prediction, column: int) -> tuple[float, float]:
    """Return start and end [s] of the 2 s around the largest error of a channel.

    The error is the RMS over the windows of `windowed_errors`; `column` is the index of the channel.
    """
    found = windowed_errors(prediction)
    worst = int(np.argmax(np.nan_to_num(found.rms[:, column])))
    middle = 0.5 * (found.edges[worst] + found.edges[worst + 1])
    first, last = float(prediction.time[0]), float(prediction.time[-1])
    low = max(first, min(middle - 0.5 * _ZOOM_DURATION, last - _ZOOM_DURATION))
    return low, min(last, low + _ZOOM_DURATION)


def _heat_colour_map(top: float):
    """Return a matplotlib colour map of errors: white for noise alone, amber, dark red at `top` times noise."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = ((0.0, "#f9fafb"), (1.0, "#f3f5f7"), (1.35, "#f3ecdc"), (1.5, "#fbd68b"))
    rest = ("#ee8a2d", "#b5281c", "#5f0f1d")
    steps = [(1.5 + (top - 1.5) * (k + 1) / len(rest), rest[k]) for k in range(len(rest))]
    scaled = [(level / top, colour) for level, colour in (*stops, *steps)]
    return LinearSegmentedColormap.from_list("gap", scaled)

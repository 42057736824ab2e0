"""`report.html` of a Gap: one page that needs nothing else, for the screen and for paper.

The tables of a gap report: channels, laws, ranking and residual tests.

The pictures of a gap report: heat map of prediction errors, and predictions over readings.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

import hydrotele
from hydrotele.core.units import axis_unit, customary
from hydrotele.effects import EFFECTS
from hydrotele.gap.customary import amount, in_customary_units
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
from hydrotele.gap.result import Candidate, Gap, LearnedLaw, Prediction, finite
from hydrotele.machine.signals import usual_unit
from hydrotele.show.channels import padded_range
from hydrotele.show.gap_recording import channel_rms, most_changed, windowed
from hydrotele.show.report_html import (
    STYLE,
    Cell,
    Markup,
    bar,
    drawing,
    dumbbell,
    interval,
    page,
    picture,
    png,
    section,
    table,
    tag,
    text,
)

_CANDIDATES = 12
_DARKEST = 10.0  # times noise, where the colour of a cell is darkest

_GIVEN = '<i class="b"></i>model as given'
_PATCHED = '<i class="a"></i>patched model'


def channel_table(before: Prediction, after: Prediction | None) -> Markup:
    """Size of the prediction errors per channel, before and after."""
    old = channel_rms(before)
    new = channel_rms(after) if after else np.full(len(old), np.nan)
    known = [v for v in (*old, *new) if math.isfinite(v)]
    low, high = 0.95 * min([1.0, *known]), 1.05 * max([1.2, *known])
    rows = []
    for channel, b, a in zip(before.channels, old, new, strict=True):
        known = math.isfinite(b)
        drawn = dumbbell(float(b), float(a) if after else None, low, high) if known else ""
        sizes = [f"{b:.2f}" if known else "not measured"]
        sizes += [f"{a:.2f}" if known else ""] if after else []
        rows.append((channel_words(channel), *sizes, drawn))
    columns = ("as given", "patched") if after else ("as given",)
    key = f"{_GIVEN}{_PATCHED if after else ''}&nbsp;&nbsp;&nbsp;dashed: a perfect model"
    head = ("channel", *columns, "error / sensor noise")
    whole = table(head, rows, numbers=" " + "n" * len(columns))
    return Markup(whole + tag("p", Markup(key), class_="key"))


def law_table(
    laws: Mapping[str, Mapping[str, Mapping[str, float]]], units: Mapping[str, str], changed: bool
) -> Markup:
    """Balance residuals by law and place, in multiples of what noise alone would give."""
    places = list(dict.fromkeys(place for by_place in laws.values() for place in by_place))
    keys = ("before", "after") if changed else ("before",)
    heading = {"before": "as given", "after": "patched"}
    head = [
        "law",
        *(Markup(tag("b", p) + tag("small", heading[k])) for p in places for k in keys),
    ]
    rows = []
    for law, by_place in laws.items():
        cells: list[object] = [Markup(tag("b", law) + tag("small", law_words(law)))]
        for place in places:
            for key in keys:
                cells.append(_law_cell(by_place.get(place), key, units.get(law, "1")))
        rows.append(cells)
    note = "RMS of what does not add up, over what sensor noise alone would give."
    numbers = " " + "n" * (len(head) - 1)
    return Markup(table(head, rows, "laws", numbers) + tag("p", note, class_="key"))


def _law_cell(residual: Mapping[str, float] | None, key: str, unit: str) -> Cell:
    if residual is None or not math.isfinite(residual.get(key, math.nan)):
        return Cell("", "r")
    value, noise = residual[key], residual.get("noise", math.nan)
    small = tag("small", amount(value, unit))
    if not (math.isfinite(noise) and noise > 0):
        return Cell(Markup("-" + small), "r")
    ratio = value / noise
    return Cell(Markup(f"{ratio:.1f} ×" + small), "r", f"background:{_heat(ratio)}")


def _heat(ratio: float) -> str:
    """From white at noise through amber to red."""
    part = min(max(math.log(max(ratio, 1e-9) / 1.2) / math.log(_DARKEST / 1.2), 0.0), 1.0)
    stops = ((255, 255, 255), (253, 226, 170), (240, 160, 110))
    low, high = (stops[0], stops[1]) if part < 0.5 else (stops[1], stops[2])
    mix = 2 * part if part < 0.5 else 2 * part - 1
    return "#" + "".join(f"{round(a + mix * (b - a)):02x}" for a, b in zip(low, high, strict=True))


def calibration_table(gap: Gap) -> Markup:
    """Calibrated numbers with their intervals, those that moved most first."""
    rows = []
    for key in most_moved(gap):
        estimate = gap.calibration[key]
        s = in_customary_units(estimate, key)
        rows.append((number_title(key), s.nominal, s.value, f"{s.low} to {s.high}", s.unit,
                     interval(estimate)))  # fmt: skip
    head = ("number", "model had", "found", "95 % interval", "unit", "model and found, to scale")
    return table(head, rows, numbers=" nnn")


def lack_table(gap: Gap) -> Markup:
    """Unknown forces, flows and commands that remain, the largest first."""
    rows = [
        (lack_words(lack), f"{100 * lack.part:.2g} %", bar(lack.part / gap.lacks[0].part))
        for lack in gap.lacks if lack.part > 0
    ]  # fmt: skip
    head = ("", "of full force, rated flow or full command", "")
    return table(head, rows, numbers=" n ")


def noise_table(gap: Gap) -> Markup:
    """Standard deviation of a reading per channel: found, and stated by the machine."""
    rows = []
    for channel, (found, stated) in gap.noise.items():
        unit = usual_unit(channel)
        known = math.isfinite(stated)
        ratio = f"{found / stated:.2f}" if known and stated > 0 else "-"
        rows.append((channel_words(channel), amount(found, unit),
                     amount(stated, unit) if known else "not stated", ratio))  # fmt: skip
    return table(("channel", "found", "stated", "found / stated"), rows, numbers=" nnn")


def ranking_table(gap: Gap) -> Markup:
    """Single effects by what naming them would gain."""
    shown = gap.ranking[:_CANDIDATES]
    best = max((c.gain - c.charge for c in shown), default=1.0)
    named = {(effect.name, effect.location) for effect in gap.effects}
    rows = []
    for place, candidate in enumerate(shown, 1):
        title: object = effect_title(candidate)
        if (candidate.name, candidate.location) in named:
            title = tag("b", title)
        net = candidate.gain - candidate.charge
        values = ", ".join(_value(gap, candidate, name) for name in candidate.parameters)
        rows.append((place, title, values, f"{net:,.0f}", bar(net / best if best > 0 else 0.0)))
    head = ("", "effect", "best value", "net gain", "")
    more = len(gap.ranking) - len(shown)
    note = tag("p", f"{more} more gain less.", class_="key") if more > 0 else Markup("")
    return Markup(table(head, rows, numbers="n  n ") + note)


def _value(gap: Gap, candidate: Candidate, name: str) -> str:
    value, label = candidate.parameters[name], name.replace("_", " ")
    effect = EFFECTS.get(candidate.name)
    facts = effect.parameters(gap.machine, candidate.location) if effect else {}
    if name not in facts:
        return f"{label} {value:.3g}"
    return f"{label} {amount(value, facts[name].unit, name)}"


def test_table(tests: Mapping[str, Mapping[str, Any]]) -> Markup:
    """Residual tests of the final model."""
    rows = []
    for name, test in tests.items():
        passed = bool(test.get("passed"))
        mark = tag("span", "passed" if passed else "failed", class_="yes" if passed else "no")
        rows.append((name, _plain(test.get("value")), _plain(test.get("limit")), mark))
    return table(("test", "value", "limit", ""), rows, numbers=" nn ")


def _plain(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, int | float) and math.isfinite(value) else "-"


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
    unit, factor = axis_unit(usual_unit(channel))
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


_CHANNELS = 4
_CHIPS = {
    "named": "Effect named",
    "no_gap": "No gap",
    "ambiguous": "Ambiguous",
    "unknown": "Unknown effect",
    "partly": "Partly named",
}


def write_report(gap: Gap, path: str | Path) -> None:
    """Write a Gap as one self-contained HTML file.

    Args:
        gap: what the search yields.
        path: file to write.
    """
    title = f"{gap.machine.name}: {headline(gap)}"
    sections = [
        _header(gap),
        _found(gap),
        _calibrated(gap),
        _learned(gap),
        _unknown(gap),
        _proof(gap),
        _where(gap),
        _ranking(gap),
        _rest(gap),
        _next(gap),
        _notes(gap),
        _use(gap),
    ]
    Path(path).write_text(page(title, STYLE, sections), encoding="utf-8")


def _header(gap: Gap) -> Markup:
    size, closed = gap.size, gap_closed(gap.size)
    patched = has_patch(gap)
    runs = ", ".join(p.run for p in gap.before[1:])
    over = f"GAP REPORT  ·  machine {gap.machine.name}, tool {gap.machine.tool}"
    if gap.before:
        over += f"  ·  judged on {gap.before[0].run}" + (f", fitted on {runs}" if runs else "")
    cards = [("before", f"{size.before:.2f} × noise", "prediction error, model as given")]
    if patched:
        cards.append(("after", f"{size.after:.2f} × noise", "prediction error, patched"))
    if patched and math.isfinite(closed):
        cards.append(("", f"{100 * closed:.0f} %", "of the gap closed, on data not fitted"))
    if size.noise_floor is not None:
        cards.append(("", f"{size.noise_floor:.2f} × noise", "prediction error of a perfect model"))
    figures = [tag("div", tag("b", b), tag("span", s), class_=c) for c, b, s in cards]
    return tag(
        "header",
        tag("p", over, class_="over"),
        tag("div", _CHIPS[gap.verdict], class_=f"chip {gap.verdict}"),
        tag("h1", headline(gap)),
        tag("div", *(tag("p", words) for words in verdict_words(gap)), class_="verdict"),
        tag("div", *figures, class_="figures"),
    )


def _found(gap: Gap) -> Markup:
    if not gap.effects:
        return Markup("")
    rows = []
    for effect in gap.effects:
        for name, estimate in effect.parameters.items():
            s = in_customary_units(estimate, name)
            what = tag("b", effect_title(effect))
            rows.append((
                what, name.replace("_", " "), s.nominal, s.value, f"{s.low} to {s.high}", s.unit,
                interval(estimate), probability_text(effect.probability), share_words(effect.share),
            ))  # fmt: skip
    head = ("effect", "parameter", "model had", "found", "95 % interval", "unit",
            "model and found, to scale", "probability", "share of the gap")  # fmt: skip
    why = (
        "Values that the fit runs ask for. The interval holds the true value in 95 of 100 cases;"
        " the share is what comes back on the held-out run without the effect."
    )
    return section("What was found", why, table(head, rows, numbers="  nnn  nn"))


def _calibrated(gap: Gap) -> Markup:
    if not gap.calibration:
        return Markup("")
    why = (
        "Numbers that the machine file states with an uncertainty, fitted together with it as their"
        " prior. They are in the patched model; those that moved most, by their intervals, first."
    )
    return section("Numbers that were calibrated", why, calibration_table(gap))


def _learned(gap: Gap) -> Markup:
    if not gap.learned:
        return Markup("")
    why = (
        "No known effect explains these; their form was taken from the data. They are terms of the"
        " patched model, which every simulator calculates. The band is two standard deviations."
    )
    parts = []
    for law in gap.learned:
        share = f" It closes {share_words(law.share)} of the gap on the held-out run."
        parts += [
            tag("h3", learned_title(law)),
            tag("p", law.description + (share if math.isfinite(law.share) else "")),
            tag("figure", picture(draw_law(law), learned_title(law))),
            tag("p", f"In SI units [{law.unit}]:", class_="key"),
            tag("pre", law.formula),
        ]
    return section("Laws learned from the data", why, *parts)


def _unknown(gap: Gap) -> Markup:
    unknown = gap.unknown
    if unknown is None:
        return Markup("")
    windows = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in unknown.windows)
    facts = [
        ("law that fails", f"{unknown.law}: {law_words(unknown.law)}"),
        ("seen most in", channel_words(unknown.channel)),
        ("changes with", ", ".join(map(channel_words, unknown.depends_on)) or "-"),
        ("shows most at", windows or "-"),
    ]
    why = "None of the known effects removes this; here is what can be said of it."
    rows = [(tag("b", name), value) for name, value in facts]
    parts = [tag("p", unknown.description), table(("", ""), rows)]
    if gap.lacks:
        parts += [tag("h3", "What the patched model still lacks"), lack_table(gap)]
    return section("What is not explained", why, *parts)


def _proof(gap: Gap) -> Markup:
    if not gap.before:
        return Markup("")
    before, after, patched = gap.before[0], gap.after[0], has_patch(gap)
    why = (
        f"One-step prediction errors on {before.run}: from its readings so far, the model says what"
        " the sensors will read next. A perfect model is off by the sensors' noise alone, 1.0."
    )
    pictures = [
        tag("figure", picture(draw_overlay(before, after, name, patched), channel_words(name)))
        for name in most_changed(before, after, _CHANNELS)
    ]
    which = "that changed most" if patched else "that are off most"
    return section(
        "Proof on data that were not fitted" if patched else "Predictions on data not fitted", why,
        channel_table(before, after if patched else None),
        tag("h3", f"Readings and predictions of the channels {which}"), *pictures,
    )  # fmt: skip


def _where(gap: Gap) -> Markup:
    if not gap.before:
        return Markup("")
    changed = has_patch(gap)
    heat = tag(
        "figure",
        picture(draw_heat_map(gap.before[0], gap.after[0], changed), "errors by channel and time"),
        tag("figcaption", "Size of the prediction errors in windows of half a second."
            " White is noise alone; grey was not measured."),
    )  # fmt: skip
    why = f"Which law of the model fails, and in which channel and when, on {gap.before[0].run}."
    laws = law_table(gap.laws, gap.law_units, changed) if gap.laws else Markup("")
    return section("Where the model is off", why, laws, heat)


def _ranking(gap: Gap) -> Markup:
    if not gap.ranking:
        return Markup("")
    why = (
        "Every effect was tried at every place, each alone. The gain is the fall of -2 log"
        " likelihood over the fit runs, less the charge for its parameters; below 0 an effect is"
        " not worth naming."
    )
    return section("Ranking of single effects", why, ranking_table(gap))


def _rest(gap: Gap) -> Markup:
    if not gap.tests:
        return Markup("")
    why = "What is left after the last model must look like sensor noise in every respect."
    noise = [tag("h3", "Noise of the readings"), noise_table(gap)] if gap.noise else []
    return section("Is anything left?", why, test_table(gap.tests), *noise)


def _next(gap: Gap) -> Markup:
    rivals = [(effect, a) for effect in gap.effects for a in effect.alternatives]
    parts = []
    if rivals:
        rows = [
            (
                effect_title(e),
                effect_title(a),
                *map(probability_text, (e.probability, a.probability)),
            )
            for e, a in rivals
        ]
        head = ("in the patched model", "could also be", "probability", "of the other")
        parts.append(table(head, rows, numbers="  nn"))
    if gap.next_experiment:
        reason = gap.next_experiment.get("reason", "")
        parts.append(tag("p", tag("b", "Next experiment: "), reason))
        if scenario := gap.next_experiment.get("scenario"):
            written = yaml.safe_dump(finite(scenario), sort_keys=False, default_flow_style=None)
            parts.append(tag("pre", written))
    if not parts:
        return Markup("")
    why = "What these data leave open, and what would settle it."
    return section("Alternatives and the next experiment", why, *parts)


def _notes(gap: Gap) -> Markup:
    if not gap.notes:
        return Markup("")
    items = tag("ul", *(tag("li", note) for note in gap.notes))
    return section("Notes on the data", "What was left out or mended before the search.", items)


def _use(gap: Gap) -> Markup:
    commands = ["hydrotele review recording.rrd"]
    if has_patch(gap):
        commands = [
            "hydrotele replay LOG --machine patched/",
            "hydrotele run SCENARIO --machine patched/",
        ]
    lines = tag("pre", "\n".join(commands)) if has_patch(gap) else Markup("")
    use = tag("p", "The patched model stands beside this page:") if lines else Markup("")
    took = text(f"hydrotele {hydrotele.__version__}, searched for {gap.seconds:.0f} s.")
    return tag("footer", use, lines, tag("p", took))

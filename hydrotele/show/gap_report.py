"""`report.html` of a Gap: one page that needs nothing else, for the screen and for paper."""

import math
from pathlib import Path

import yaml

import hydrotele
from hydrotele.gap.customary import said
from hydrotele.gap.gap_json import finite
from hydrotele.gap.patched import has_patch
from hydrotele.gap.result import Gap
from hydrotele.gap.words import (
    chance_words,
    channel_words,
    effect_title,
    gap_closed,
    headline,
    law_words,
    learned_title,
    share_words,
    verdict_words,
)
from hydrotele.show.gap_figures import draw_heat_map, draw_law, draw_overlay
from hydrotele.show.gap_tables import (
    calibration_table,
    channel_table,
    lack_table,
    law_table,
    noise_table,
    ranking_table,
    test_table,
)
from hydrotele.show.gap_windows import most_changed
from hydrotele.show.report_html import Markup, interval, page, picture, section, table, tag, text
from hydrotele.show.report_style import STYLE

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
            s = said(estimate, name)
            what = tag("b", effect_title(effect))
            rows.append((
                what, name.replace("_", " "), s.nominal, s.value, f"{s.low} to {s.high}", s.unit,
                interval(estimate), chance_words(effect.probability), share_words(effect.share),
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
            (effect_title(e), effect_title(a), *map(chance_words, (e.probability, a.probability)))
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

"""The tables of a gap report: channels, laws, ranking and residual tests."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.gap.customary import amount, said
from hydrotele.gap.result import Candidate, Gap, Prediction
from hydrotele.gap.words import (
    channel_words,
    effect_title,
    lack_words,
    law_words,
    most_moved,
    number_title,
)
from hydrotele.machine.signals import usual_unit
from hydrotele.show.gap_windows import channel_rms
from hydrotele.show.report_html import Cell, Markup, bar, dumbbell, interval, table, tag

_CANDIDATES = 12
_LOUDEST = 10.0  # times noise, where the colour of a cell is darkest

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
    said = {"before": "as given", "after": "patched"}
    head = ["law", *(Markup(tag("b", p) + tag("small", said[k])) for p in places for k in keys)]
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
    part = min(max(math.log(max(ratio, 1e-9) / 1.2) / math.log(_LOUDEST / 1.2), 0.0), 1.0)
    stops = ((255, 255, 255), (253, 226, 170), (240, 160, 110))
    low, high = (stops[0], stops[1]) if part < 0.5 else (stops[1], stops[2])
    mix = 2 * part if part < 0.5 else 2 * part - 1
    return "#" + "".join(f"{round(a + mix * (b - a)):02x}" for a, b in zip(low, high, strict=True))


def calibration_table(gap: Gap) -> Markup:
    """Calibrated numbers with their intervals, those that moved most first."""
    rows = []
    for key in most_moved(gap):
        estimate = gap.calibration[key]
        s = said(estimate, key)
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

"""`report.html` of an identification: one page that needs nothing else.

The pictures of an identification report: forces on the held-out run, and the parameters.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

import hydrotele
from hydrotele.gap.customary import amount, in_customary_units
from hydrotele.gap.result import Estimate
from hydrotele.identify.consistent import Consistent
from hydrotele.identify.hydraulic import Hydraulics
from hydrotele.identify.result import (
    MEANING,
    Forces,
    HeldOut,
    Identification,
    counts,
    parameter_rows,
)
from hydrotele.show.report_html import (
    STYLE,
    Markup,
    drawing,
    interval,
    page,
    picture,
    png,
    section,
    table,
    tag,
    text,
)

MEASURED, NOMINAL, IDENTIFIED = "#262b33", "#e07b00", "#1769aa"


def draw_forces(forces: Forces, drive: str, judged: HeldOut) -> bytes:
    """Measured and predicted force of a drive, and their difference with the noise's band.

    Args:
        forces: of the held-out run.
        drive: which one.
        judged: how well it is predicted.

    Returns:
        A PNG.
    """
    k = forces.drives.index(drive)
    unit, factor = ("k" + judged.unit, 1e-3) if np.nanmax(
        np.abs(forces.measured[:, k])) >= 2e3 else (judged.unit, 1.0)  # fmt: skip
    measured = factor * forces.measured[:, k]
    lines = [
        ("machine as given", NOMINAL, factor * forces.nominal[:, k]),
        ("identified machine", IDENTIFIED, factor * forces.predicted[:, k]),
    ]
    with drawing(3.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
        upper.plot(forces.time, measured, color=MEASURED, lw=2.2, alpha=0.5, label="measured")
        for name, colour, values in lines:
            upper.plot(forces.time, values, color=colour, lw=0.9, label=name)
            lower.plot(forces.time, measured - values, color=colour, lw=0.9)
        if np.isfinite(judged.noise_rms):
            reach = 2.0 * factor * judged.noise_rms
            lower.axhspan(-reach, reach, color="0.5", alpha=0.15, lw=0)
        own = np.nanmax(np.abs(measured - lines[1][2]))
        lower.set_ylim(-3.0 * own, 3.0 * own)
        upper.set_title(drive.replace("_", " "))
        upper.set_ylabel(unit)
        lower.set_ylabel(f"measured -\npredicted\n[{unit}]")
        lower.set_xlabel("time [s]")
        lower.set_xlim(forces.time[0], forces.time[-1])
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False,
                     borderaxespad=0.1, fontsize=8.5)  # fmt: skip
        figure.align_ylabels()
        return png(figure)


_MEMBERS = 6  # of a combination that are written out


class LearnedFrom(NamedTuple):
    """What an identification learned from.

    Attributes:
        name: of the machine or mechanism.
        tool: of the machine; None for a mechanism without a machine.
        fit: names of the fitted runs.
        heldout: name of the run to judge on.
        notes: on the data.
    """

    name: str
    tool: str | None
    fit: tuple[str, ...]
    heldout: str
    notes: tuple[str, ...] = ()


def write_identify_report(
    learned: LearnedFrom, found: Identification | None, hydraulics: Hydraulics | None,
    best: Consistent | None, path: str | Path,
) -> None:  # fmt: skip
    """Write an identification as one self-contained HTML file.

    Args:
        learned: what it learned from.
        found: the mechanism, None where no force is known.
        hydraulics: the hydraulics, None where not asked for.
        best: the nearest machine that can exist, None without a mechanism.
        path: file to write.
    """
    sections = [_header(learned, found, hydraulics)]
    if found:
        sections += [_proof(found), _parameters(found), _tests(found, best), _others(found)]
    if hydraulics:
        sections.append(_hydraulics(hydraulics))
    notes = found.notes if found else learned.notes
    if notes:
        items = tag("ul", *(tag("li", note) for note in notes))
        sections.append(section("Notes", "On the data and on what was left out.", items))
    sections.append(_use(learned, found, hydraulics))
    title = f"{learned.name}: identification"
    Path(path).write_text(page(title, STYLE, sections), encoding="utf-8")


def _header(
    learned: LearnedFrom, found: Identification | None, hydraulics: Hydraulics | None
) -> Markup:
    of = f"mechanism {learned.name}"
    if learned.tool is not None:
        of = f"machine {learned.name}, tool {learned.tool}"
    over = (
        f"IDENTIFICATION REPORT  ·  {of}  ·  judged on"
        f" {learned.heldout}, fitted on {', '.join(learned.fit)}"
    )
    cards = []
    for drive, h in list(found.heldout.items())[:3] if found else ():
        against = f"{h.rms / h.noise_rms:.2f} × noise, " if h.noise_rms > 0.0 else ""
        name = drive.replace("_", " ")
        cards.append(
            ("after", f"{100 * h.relative:.2f} %", f"{against}error of the {name}'s force")
        )
    if hydraulics:
        said_of = f"one-step prediction errors ({hydraulics.before:.2f} before)"
        cards.append(("after", f"{hydraulics.after:.2f} × noise", said_of))
    status = found.status if found else hydraulics.status if hydraulics else ""
    good = status == "ok" and (hydraulics is None or hydraulics.status == "ok")
    chip = tag(
        "div",
        "Identified" if good else "See below",
        class_=f"chip {'no_gap' if good else 'ambiguous'}",
    )
    heading = "The machine's numbers, from its logs" if good else status
    figures = [tag("div", tag("b", b), tag("span", s), class_=c) for c, b, s in cards]
    return tag(
        "header", tag("p", over, class_="over"), chip, tag("h1", heading),
        tag("div", *figures, class_="figures"),
    )  # fmt: skip


def _proof(found: Identification) -> Markup:
    rows = []
    for drive, h in found.heldout.items():
        noise = amount(h.noise_rms, h.unit) if math.isfinite(h.noise_rms) else "not stated"
        rows.append((tag("b", drive.replace("_", " ")), amount(h.nominal_rms, h.unit),
                     amount(h.rms, h.unit), noise, f"{100 * h.relative:.2f} %"))  # fmt: skip
    head = ("drive", "as given", "identified", "noise alone", "relative error")
    pictures = [
        tag("figure", picture(draw_forces(found.forces, drive, h), f"force of {drive}"))
        for drive, h in found.heldout.items()
    ]
    why = (
        f"RMS of measured less predicted force on {found.forces.run}, below {found.band:.3g} Hz,"
        " where the positions tell accelerations. Noise alone is what a perfect model would show"
        " with these sensors; the grey band is twice that."
    )
    return section("Forces on data that were not fitted", why,
                    table(head, rows, numbers=" nnnn"), *pictures)  # fmt: skip


def _parameters(found: Identification) -> Markup:
    rows = []
    for row in parameter_rows(found):
        if row.value is None or row.ci95 is None:
            continue
        estimate = Estimate(row.value, row.unit, *row.ci95, row.nominal)
        s = in_customary_units(estimate)
        rows.append((
            Markup(tag("b", row.name) + tag("small", _short(row.combination))), s.nominal, s.value,
            f"{s.low} to {s.high}", s.unit, interval(estimate), row.status,
        ))  # fmt: skip
    head = ("parameter", "given", "identified", "95 % interval", "unit", "given and identified",
            "status")  # fmt: skip
    why = (
        "A combination stands under the name of its first member; all numbers in its row are those"
        f" of the whole. Condition of the equations {found.estimate.condition:.3g}."
    )
    return section("What the data tell", why, table(head, rows, numbers=" nnn"))


def _tests(found: Identification, best: Consistent | None) -> Markup:
    distance, limit = found.distance(found.nominal)
    verdict = "could be the true ones" if distance <= limit else "are refuted"
    rows = [("the given parameters, all together", f"{distance:.3g}", f"{limit:.3g}", verdict)]
    if best:
        verdict = "agrees with the estimate" if best.loss <= limit else "cannot have all of it"
        rows.append(("a machine that can exist", f"{best.loss:.3g}", f"{limit:.3g}", verdict))
    head = ("95 % ellipsoid", "squared distance", "limit", "verdict")
    memory = ", ".join(f"{drive.replace('_', ' ')} {r:.2f}" for drive, r in found.whiteness.items())
    why = (
        "How far other parameters are from the estimate in standard deviations, and what 95 of 100"
        " true ones stay below. Bodies that can exist have positive mass and the inertia of a mass"
        f" distribution. Residuals correlate with those before them by: {memory}; the intervals"
        " know of it."
    )
    return section("Tests", why, table(head, rows, numbers=" nn"))


def _others(found: Identification) -> Markup:
    rows = parameter_rows(found)
    parts = []
    for status, number in counts(rows).items():
        names = [row.name for row in rows if row.status == status and row.value is None]
        parts.append((tag("b", status), str(number), MEANING[status], ", ".join(names) or "-"))
    head = ("status", "number", "meaning", "those without a number of their own")
    why = "Why some parameters have no number: the data do not hold one."
    return section("Identifiability", why, table(head, parts, numbers=" n"))


def _short(combination: str) -> str:
    """A combination, cut where it is long."""
    parts = combination.replace(" - ", " + -").split(" + ")
    if len(parts) <= _MEMBERS:
        return combination
    return " + ".join(parts[:_MEMBERS]).replace("+ -", "- ") + f" + {len(parts) - _MEMBERS} more"


def _hydraulics(found: Hydraulics) -> Markup:
    rows = []
    for n in found.numbers:
        estimate = Estimate(n.value, n.unit, *n.ci95, n.nominal)
        s = in_customary_units(estimate, n.parameter)
        cells = (s.value, f"{s.low} to {s.high}") if n.told else ("not told", "")
        drawn = interval(estimate) if n.told else Markup("")
        rows.append(
            (tag("b", n.name), n.parameter.replace("_", " "), s.nominal, *cells, s.unit, drawn)
        )
    head = ("number", "parameter", "given", "identified", "95 % interval", "unit",
            "given and identified")  # fmt: skip
    why = (
        "All fitted together to one-step prediction errors of commands, pressures and motion,"
        f" which fall from {found.before:.2f} to {found.after:.2f} times noise on the held-out run."
    )
    return section("Valves, oil and supply", why, table(head, rows, numbers="  nnn"))


def _use(
    learned: LearnedFrom, found: Identification | None, hydraulics: Hydraulics | None
) -> Markup:
    commands = (
        "hydrotele replay LOG --machine identified/\nhydrotele run SCENARIO --machine identified/"
    )
    seconds = sum(part.seconds for part in (found, hydraulics) if part)
    took = text(f"hydrotele {hydrotele.__version__}, identified in {seconds:.1f} s.")
    if learned.tool is None:
        return tag("footer", tag("p", took))
    return tag("footer", tag("p", "The identified machine stands beside this page:"),
               tag("pre", commands), tag("p", took))  # fmt: skip

"""`report.html` of a teleoperator's analysis: one page that needs nothing else."""

from pathlib import Path

import hydrotele
from hydrotele.show.report_html import Cell, Markup, page, picture, section, table, tag
from hydrotele.show.report_style import STYLE
from hydrotele.show.teleop_figures import (
    draw_felt,
    draw_hybrid,
    draw_nyquist,
    draw_scattering,
    draw_stiffness,
    plain_name,
)
from hydrotele.teleop.findings import (
    Findings,
    said_delay,
    said_error,
    said_factor,
    said_size,
    why_unstable,
)
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import Impedance

_CHANNELS = {
    "position_position": "the slave's position comes back (coordinating force)",
    "position_force": "the task's force comes back (direct force)",
    "four_channel_position": "all four channels; transparent without delay",
    "rate_position": "rate control, the slave's position comes back (coordinating force)",
    "rate_force": "rate control, the task's force comes back (direct force)",
    "four_channel_rate": "rate control, all four channels, without jerk",
}


def write_teleop_report(found: Findings, maps: bytes, path: str | Path) -> None:
    """Write an analysis as one self-contained HTML file.

    Args:
        found: what was found.
        maps: the picture of its maps of stability, a PNG.
        path: file to write.
    """
    sections = [_header(found), _verdicts(found), _maps(found, maps), _nyquist(found), _felt(found)]
    sections += [_passivity(found), _hybrid(found)]
    if found.spring:
        sections.append(_stiffness(found.spring, found.spring.held(found.case.hand)))
    sections += [_numbers(found), _foot()]
    text = page(f"{found.name}: teleoperator", STYLE, sections)
    Path(path).write_text(text, encoding="utf-8")


def _header(found: Findings) -> Markup:
    case, many = found.case, len(found.analyses)
    good = [one for one in found.analyses if one.stable]
    over = (
        f"TELEOPERATOR ANALYSIS  ·  {found.name}  ·  delay {1e3 * case.delay_forward:g} ms forward,"
        f" {1e3 * case.delay_back:g} ms back"
    )
    names = ", ".join(plain_name(one.structure) for one in good)
    heading = f"Stable: {names}" if good else "No structure is stable"
    cards = [("after", f"{len(good)} of {many}", "structures stable, with the task and free")]
    passive = sum(one.passive for one in found.analyses)
    cards.append(("", f"{passive} of {many}", "passive two-ports, safe with any task"))
    if found.agreements:
        worst = min(one.share for one in found.agreements)
        cards.append(("after", f"{100 * worst:.1f} %", "of the maps' cells confirmed, at least"))
        errors = [s.error for s in found.sweeps if s.error is not None]
        if errors:
            cards.append(("after", f"{100 * max(errors):.2f} %", "largest error of a sine sweep"))
    colour = "no_gap" if len(good) == many else "ambiguous" if good else "unknown"
    chip = "All stable" if len(good) == many else "Some unstable" if good else "Unstable"
    figures = [tag("div", tag("b", b), tag("span", s), class_=c) for c, b, s in cards]
    return tag(
        "header", tag("p", over, class_="over"), tag("div", chip, class_=f"chip {colour}"),
        tag("h1", heading), tag("div", *figures, class_="figures"),
    )  # fmt: skip


def _verdicts(found: Findings) -> Markup:
    rows = []
    for one in found.analyses:
        name = Markup(tag("b", plain_name(one.structure)) + tag("small", _CHANNELS[one.structure]))
        margin, delay = said_factor(one.gain_margin), said_delay(one.largest_delay)
        rows.append((name, _yes(one.stable, why_unstable(one)), margin, delay,
                     f"{one.scattering.max():.3g}", _yes(one.passive, "no")))  # fmt: skip
    head = ("structure", "stable", "gain margin", "largest delay", "scattering norm", "passive")
    why = (
        "Gain margin: factor on what comes back to the hand up to which the loop stays stable;"
        " below 1, what comes back has to be made that much smaller. Largest delay: each way, with"
        " the gains as they are. Any: no factor up to 1000 and no delay up to 10 s"
        " hurts. A passive two-port, whose scattering norm nowhere exceeds 1, is"
        " stable with every passive hand and task; without passivity it depends on them."
    )
    parts = [table(head, rows, numbers="  nnn")]
    if found.agreements:
        parts.append(_confirmed(found))
    return section("Verdicts", why, *parts)


def _confirmed(found: Findings) -> Markup:
    rows = []
    for one in found.agreements:
        errors = [said_error(s.error) for s in found.sweeps if s.structure == one.structure]
        cells = f"{int((one.predicted == one.seen).sum())} of {one.seen.size}"
        rows.append((tag("b", plain_name(one.structure)), *[*errors, "-"][:2], cells))
    head = ("in simulation", "felt, no delay", "felt, with delay", "cells of the map that agree")
    return Markup(
        tag("p", "Two masses simulated in time, independently of the formulas: the felt impedance"
            " in sine sweeps of 0.1 to 5 Hz, largest error; and a kick of the hand in every cell"
            " of the map.", class_="why") + table(head, rows, numbers=" nnn")
    )  # fmt: skip


def _maps(found: Findings, maps: bytes) -> Markup:
    why = (
        "Blue is stable with the task. Upwards, more comes back to the hand (force, or the slave's"
        " motion); 1 is the case's own gain. The point is this case. Only the sum of both delays"
        " matters."
    )
    if found.agreements:
        why += " A red cross marks a cell in which a simulation says otherwise."
    return section("Stability over delay and gain", why, _figure(maps, "maps"))


def _nyquist(found: Findings) -> Markup:
    why = (
        "Gain of the loop from the hand to the task and back (Zhu 1994, 3.13), with the task and"
        " free; pale for negative frequencies. Unstable poles are counted by the argument"
        " principle on the loop's characteristic function, so that curves which leave the window"
        " count rightly. A free curve that ends at -1 at frequency 0 is drift."
    )
    return section("Nyquist curves", why, _figure(draw_nyquist(found), "Nyquist curves"))


def _felt(found: Findings) -> Markup:
    why = (
        "Impedance that the hand feels, against that of the task (grey). A transparent"
        " teleoperator feels like its task; at high frequency the master's own mass remains."
    )
    return section("What the operator feels", why, _figure(draw_felt(found), "felt impedance"))


def _passivity(found: Findings) -> Markup:
    why = (
        "Largest singular value of S = diag(1, -1)(H - 1)(H + 1)⁻¹, with forces counted in units of"
        " the hand's own impedance; whether it exceeds 1 does not depend on that unit."
    )
    return section("Passivity", why, _figure(draw_scattering(found), "scattering norm"))


def _hybrid(found: Findings) -> Markup:
    why = (
        "[F_h, -V_e] = H [V_h, F_e]. The ideal has h12 = 1 and h21 = -1 (dotted) under position"
        " control, and nothing else."
    )
    return section("Hybrid matrix", why, _figure(draw_hybrid(found), "hybrid matrix"))


def _stiffness(spring: Spring, held: Spring) -> Markup:
    rows = [
        (tag("b", name), f"{one.mass:.3g}", f"{one.damping:.4g}", f"{one.least:g} to {one.most:g}",
         said_size(one.margin), f"{one.enough_damping:.4g}", f"{one.growth:.3g}")
        for name, one in (("held", held), ("let go", spring))
    ]  # fmt: skip
    head = ("joystick", "M [kg]", "B [N s/m]", "K [N/m]", "B² - 4 M K_max", "B that it asks for",
            "growth of half a swing")  # fmt: skip
    sure, safe = held.margin > 0.0, held.growth < 1.0
    said = (
        "The theorem holds for this case: no change of the stiffness makes it unstable."
        if sure
        else "The theorem does not cover this case, which is no proof of instability: at the worst"
        f" switching of the stiffness half a swing {'shrinks' if safe else 'grows'} to"
        f" {held.growth:.3g} times the one before, so that it {'stays' if safe else 'is not'}"
        " stable."
    )
    why = (
        "A joystick whose stiffness follows the contact force is stable whatever delay and task do"
        " if B² > 4 M K_max (Zhu 1994, 4.14). That is sufficient, not necessary: the worst that a"
        " stiffness can do is to be least on the way out and largest on the way back, which is"
        " simulated beside it."
    )
    return section("Stiffness feedback", why, table(head, rows, numbers=" nnnnnn"),
                   tag("p", said), _figure(draw_stiffness(spring, held), "stiffness"))  # fmt: skip


def _numbers(found: Findings) -> Markup:
    case = found.case
    parts: list[tuple[str, Impedance]] = [
        ("master", case.master), ("its controller", case.master_control), ("hand", case.hand),
        ("slave", case.slave), ("its controller", case.slave_control), ("task", case.task),
    ]  # fmt: skip
    rows = [
        (tag("b", name), f"{z.mass:.4g}", f"{z.damping:.4g}", f"{z.stiffness:.6g}")
        for name, z in parts
    ]
    gains = case.gains
    why = (
        f"Gains: position {gains.position:g}, velocity {gains.velocity:g} 1/s, force"
        f" {gains.force:g}. All in one scale of lengths and forces."
    )
    head = ("part", "mass [kg]", "damping [N s/m]", "stiffness [N/m]")
    return section("The case", why, table(head, rows, numbers=" nnn"))


def _foot() -> Markup:
    text = (
        f"hydrotele {hydrotele.__version__}. All numbers stand in analysis.json beside this page."
    )
    return tag("footer", tag("p", text))


def _figure(png: bytes, alt: str) -> Markup:
    return tag("figure", picture(png, alt))


def _yes(good: bool, otherwise: str) -> Cell:
    return Cell("yes" if good else otherwise, "yes" if good else "no")

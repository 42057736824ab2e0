"""`hydrotele analyse teleop`: a teleoperator as a two-port, with hand, task and delays."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hydrotele
from hydrotele.cli.console import notes, out, plain, print_json, stages, table
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.teleop.findings import (
    Findings,
    find,
    findings_document,
    said_delay,
    said_error,
    said_factor,
    said_size,
    why_unstable,
)
from hydrotele.teleop.teleop_case import LONGEST, TeleopCase, known_structures, load_teleop_case

_LEGEND = (
    "margin: factor on what comes back (force, or the slave's motion) up to which it stays stable;"
    " below 1 it has to be made that much smaller\n"
    "delay: each way, up to which it stays stable; any: up to a factor of 1000 and 10 s, at least\n"
    "norm: of the scattering matrix, largest that is drawn; passive only if it is nowhere above 1"
)


def analyse_teleop_to_folder(
    file: Path | None, target: Path | None, structures: Sequence[str], delay: float | None,
    confirm: bool, as_json: bool,
) -> Path | None:  # fmt: skip
    """Analyse a teleoperator; write report and figures into a folder, whole or not at all.

    Args:
        file: case, None for the shipped one.
        target: folder, default `runs/analyse_<name>`; with `as_json` none.
        structures: instead of the case's; none for those.
        delay: each way, instead of the case's [s].
        confirm: whether to simulate what is predicted.
        as_json: print `analysis.json` instead of words.

    Returns:
        The folder, None where none was written.

    Raises:
        InputError: case, structures, delay or target are not usable.
    """
    facts = load_teleop_case(file)
    target = target or (None if as_json else Path("runs") / f"analyse_{facts.name}")
    if target:
        check_target(target, "two-port analysis")
    found = analyse_case(facts, structures, delay, confirm, as_json)
    document = plain(findings_document(found))
    if target:
        with whole_folder(target, "two-port analysis") as folder:
            _write(folder, found, document)
    if as_json:
        print_json(document)
    else:
        _print(found)
        out.print(f"written to [bold]{target}[/]; open {target}/report.html")
    return target


def analyse_case(
    facts: TeleopCase, structures: Sequence[str], delay: float | None, confirm: bool, quiet: bool
) -> Findings:
    """Analyse a case.

    Args:
        facts: the case.
        structures: instead of the case's; none for those.
        delay: each way, instead of the case's [s].
        confirm: whether to simulate what is predicted.
        quiet: no bar.

    Returns:
        What was found.

    Raises:
        InputError: structures or delay are not usable.
    """
    try:
        names = known_structures(tuple(structures)) or facts.structures
    except ValueError as error:
        raise InputError("--structure", str(error)) from None
    case = facts.case()
    if delay is not None:
        if not 0.0 <= delay <= LONGEST:
            raise InputError("--delay", f"must be from 0 to {LONGEST:g} s, got {delay:g}")
        case = case.with_delay(delay)
    reach = facts.map
    delays = max(reach.longest_delay, case.delay) * np.linspace(0.0, 1.0, reach.points) ** 2
    factors = np.geomspace(reach.least_factor, reach.most_factor, reach.points)
    spring = facts.stiffness.spring() if facts.stiffness else None
    with stages(f"analyse {facts.name}", quiet) as progress:
        return find(facts.name, case, names, delays, factors, spring, confirm, progress)


def _write(folder: Path, found: Findings, document: dict) -> None:
    text = json.dumps(document, indent=2, allow_nan=False)
    (folder / "analysis.json").write_text(text + "\n", encoding="utf-8")
    from hydrotele.show.teleop_figures import draw_maps
    from hydrotele.show.teleop_report import write_teleop_report

    notes.print("writing report.html ...", style="dim")
    maps = draw_maps(found)
    write_teleop_report(found, maps, folder / "report.html")
    (folder / "stability.png").write_bytes(maps)
    summary = {"kind": "two-port analysis", "name": found.name, "hydrotele": hydrotele.__version__}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _print(found: Findings) -> None:
    case = found.case
    delays = f"{1e3 * case.delay_forward:g} ms forward, {1e3 * case.delay_back:g} ms back"
    title = f"{found.name}, delay {delays}"
    rows = table(title, "structure", "stable", "margin", "delay", "norm", "passive")  # fmt: skip
    for one in found.analyses:
        rows.add_row(
            one.structure, "yes" if one.stable else f"[red]{why_unstable(one)}[/]",
            said_factor(one.gain_margin), said_delay(one.largest_delay),
            f"{one.scattering.max():.3g}", "yes" if one.passive else "no",
        )  # fmt: skip
    out.print(rows)
    out.print(_LEGEND, style="dim")
    if found.spring:
        _print_springs(found)
    if found.agreements:
        _print_confirmed(found)


def _print_springs(found: Findings) -> None:
    assert found.spring
    rows = table("stiffness feedback: B^2 - 4 M K_max, and the worst switching", "joystick", "B",
                 "K_max", "margin", "B asked for", "growth")  # fmt: skip
    for name, one in (("held", found.spring.held(found.case.hand)), ("let go", found.spring)):
        rows.add_row(name, f"{one.damping:g} N s/m", f"{one.most:g} N/m", said_size(one.margin),
                     f"{one.enough_damping:.4g}", f"{one.growth:.3g}")  # fmt: skip
    out.print(rows)
    out.print("growth: of half a swing, stable below 1; the theorem asks for more", style="dim")


def _print_confirmed(found: Findings) -> None:
    rows = table("confirmed in simulation", "structure", "sweep, no delay",
                 "sweep, with delay", "map agrees")  # fmt: skip
    for one in found.agreements:
        errors = [said_error(s.error) for s in found.sweeps if s.structure == one.structure]
        rows.add_row(one.structure, *[*errors, "-"][:2], f"{100.0 * one.share:.1f} %")
    out.print(rows)
    out.print("sweep: largest error of the felt impedance; map: share of its cells", style="dim")

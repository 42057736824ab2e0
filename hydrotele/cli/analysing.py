"""`hydrotele analyse teleop`: a teleoperator as a two-port, with hand, task and delays.

`hydrotele analyse teleop SCENARIO`: the linear loop of a teleoperated scenario.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hydrotele
from hydrotele.cli.console import notes, out, plain, print_json, stages, table
from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.machine.joystick import load_joystick
from hydrotele.run.run import scenario_model
from hydrotele.scenario.scenario import Scenario, load_scenario, shipped_scenarios
from hydrotele.teleop.analysis import LONGEST, TeleopCase, known_structures, load_teleop_case
from hydrotele.teleop.findings import (
    Findings,
    ScenarioFindings,
    find,
    find_loop,
    findings_document,
    format_delay,
    format_error,
    format_factor,
    format_number,
    loop_document,
    why_unstable,
)
from hydrotele.teleop.linear_case import joystick_of, scenario_case

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
    from hydrotele.show.teleop_report import draw_maps, write_teleop_report

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
            format_factor(one.gain_margin), format_delay(one.largest_delay),
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
        rows.add_row(name, f"{one.damping:g} N s/m", f"{one.most:g} N/m", format_number(one.margin),
                     f"{one.enough_damping:.4g}", f"{one.growth:.3g}")  # fmt: skip
    out.print(rows)
    out.print("growth: of half a swing, stable below 1; the theorem asks for more", style="dim")


def _print_confirmed(found: Findings) -> None:
    rows = table("confirmed in simulation", "structure", "sweep, no delay",
                 "sweep, with delay", "map agrees")  # fmt: skip
    for one in found.agreements:
        errors = [format_error(s.error) for s in found.sweeps if s.structure == one.structure]
        rows.add_row(one.structure, *[*errors, "-"][:2], f"{100.0 * one.share:.1f} %")
    out.print(rows)
    out.print("sweep: largest error of the felt impedance; map: share of its cells", style="dim")


_KIND = "loop analysis"


def is_scenario(file: Path | None) -> bool:
    """Whether a name or file is a scenario: shipped, or a YAML file with a pilot."""
    if file is None:
        return False
    if str(file) in shipped_scenarios():
        return True
    try:
        return "pilot" in read_yaml(file)[0]
    except InputError:
        return False


def analyse_any_to_folder(
    file: Path | None, target: Path | None, structures: list[str] | None, delay: float | None,
    confirm: bool, coordinate: str | None, overrides: dict[str, str], as_json: bool,
) -> Path | None:  # fmt: skip
    """Analyse a case or a scenario; see `analyse_teleop_to_folder`, `analyse_scenario_to_folder`.

    Raises:
        InputError: an option is of the other kind, or as of these two.
    """
    if not is_scenario(file):
        if coordinate or overrides:
            raise InputError("--coordinate, --set", "are for scenarios")
        return analyse_teleop_to_folder(file, target, structures or [], delay, confirm, as_json)
    if structures or delay is not None or confirm:
        message = "are for cases; a scenario has its own structure, and delays by --set"
        raise InputError("--structure, --delay, --confirm", message)
    return analyse_scenario_to_folder(str(file), target, coordinate, overrides, as_json)


def analyse_scenario(scenario: Scenario, coordinate: str | None = None) -> ScenarioFindings:
    """Analyse the linear loop of a teleoperated scenario.

    Args:
        scenario: the scenario.
        coordinate: of the arm; that of the operator's force target by default, else z.

    Returns:
        What was found.

    Raises:
        InputError: the scenario has no such loop.
    """
    machine = scenario_model(scenario)
    joystick = load_joystick(joystick_of(scenario))
    case, contact = scenario_case(scenario, machine, joystick, coordinate)
    return find_loop(scenario.name, case, contact.source)


def analyse_scenario_to_folder(
    name: str, target: Path | None, coordinate: str | None, overrides: dict[str, str],
    as_json: bool,
) -> Path | None:  # fmt: skip
    """Analyse a scenario; write report and map into a folder, whole or not at all.

    Args:
        name: of the scenario, or its file.
        target: folder, default `runs/analyse_<name>`; with `as_json` none.
        coordinate: of the arm, None for the default.
        overrides: key path -> YAML text.
        as_json: print `analysis.json` instead of words.

    Returns:
        The folder, None where none was written.

    Raises:
        InputError: scenario, coordinate or target are not usable.
    """
    scenario = load_scenario(name, overrides)
    target = target or (None if as_json else Path("runs") / f"analyse_{scenario.name}")
    if target:
        check_target(target, _KIND)
    found = analyse_scenario(scenario, coordinate)
    document = plain(loop_document(found))
    if target:
        with whole_folder(target, _KIND) as folder:
            _write_loop(folder, found, document)
    if as_json:
        print_json(document)
    else:
        for label, value, why in findings_table(found):
            out.print(f"{label}: [bold]{value}[/] {why}".rstrip())
        _print_loop_springs(found)
        out.print(f"written to [bold]{target}[/]; open {target}/report.html")
    return target


def findings_table(found: ScenarioFindings) -> list[tuple[str, str, str]]:
    """What was found in words: (what, value, remark)."""
    case, loop, tip = found.case, found.loop, found.case.tip
    pole, turns = loop.pole, tip.coordinate not in ("r", "z")
    force, mass, oil = ("N m", "kg m^2", "N m/rad") if turns else ("N", "kg", "N/m")
    rows = [
        ("scenario", found.name, f"{case.pilot.reflection} under {case.pilot.mode} control"),
        ("coordinate", tip.coordinate, f"{tip.mass:.0f} {mass}, oil {tip.stiffness:.3g} {oil}"),
        ("task", f"{case.task.stiffness:.3g} {oil}", f"({found.task_source})"),
        ("loop", loop.structure, "" if loop.own else "in the place of stiffness feedback or none"),
        ("stable", "yes" if loop.stable else f"no, {loop.unstable_poles} poles", ""),
        ("gain margin", format_factor(loop.gain_margin), f"on a ratio of {case.ratio:.3g}"),
        ("largest delay", format_delay(loop.largest_delay), "each way"),
    ]
    if math.isfinite(loop.frequency):
        rows.append(("swing", f"{loop.frequency:.2f} Hz", "where it becomes unstable"))
        rows.append(("pole", f"{pole.real:.3f} {pole.imag:+.3f}j rad/s", "now"))
    if math.isfinite(loop.largest_ratio):
        why = f"{loop.hand_force:.2f} for {case.force_limit:.0f} {force}, outside the dead band"
        rows.append(("largest ratio", f"{loop.largest_ratio:.3g}", why))
    if math.isfinite(loop.ratio_with_deadband):
        why = "for a swing from stop to stop across the dead band"
        rows.append(("with dead band", f"{loop.ratio_with_deadband:.3g}", why))
    why = "that stiffness feedback reflects at the dead band's edge"
    return [*rows, ("local ratio", f"{found.edge_ratio:.3g}", why)]


def _print_loop_springs(found: ScenarioFindings) -> None:
    rows = table("stiffness feedback: B^2 - 4 M K_max, and the worst switching", "joystick", "B",
                 "K_max", "margin", "B asked for", "growth")  # fmt: skip
    for name, one in (("held", found.held), ("let go", found.free)):
        rows.add_row(name, f"{one.damping:g}", f"{one.most:g}", format_number(one.margin),
                     f"{one.enough_damping:.4g}", f"{one.growth:.3g}")  # fmt: skip
    out.print(rows)


def _write_loop(folder: Path, found: ScenarioFindings, document: dict) -> None:
    from hydrotele.show.teleop_report import draw_loop_map, write_loop_report

    text = json.dumps(document, indent=2, allow_nan=False)
    (folder / "analysis.json").write_text(text + "\n", encoding="utf-8")
    picture = draw_loop_map(found)
    (folder / "stability.png").write_bytes(picture)
    write_loop_report(found, findings_table(found), picture, folder / "report.html")
    summary = {"kind": _KIND, "name": found.name, "hydrotele": hydrotele.__version__}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")

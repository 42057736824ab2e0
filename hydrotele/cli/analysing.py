"""`hydrotele analyse teleop`: a teleoperator as a two-port, with hand, task and delays.

`hydrotele analyse teleop SCENARIO`: the linear loop of a teleoperated scenario.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import hydrotele
from hydrotele.cli.console import (
    notes,
    out,
    plain,
    print_json,
    print_result,
    stages,
    table,
    write_json,
)
from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.machine.joystick import load_joystick
from hydrotele.run.run import scenario_model
from hydrotele.scenario.scenario import Scenario, load_scenario, shipped_scenarios
from hydrotele.teleop.analysis import LONGEST, Case, TeleopCase, known_structures, load_teleop_case
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
from hydrotele.teleop.robust import robustness, spread_of
from hydrotele.teleop.round_trip import load_delays
from hydrotele.teleop.sampled import SAMPLED_STRUCTURES, PacketAges, jittering_line, steady_line
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import STRUCTURES

_LEGEND = (
    "stable: with the task and free, in the operator's hand; let go: without a hand\n"
    "margin: factor on what comes back (force, or the slave's motion) up to which it stays stable;"
    " below 1 it has to be made that much smaller\n"
    "delay: each way, up to which it stays stable; >: the largest that was tried\n"
    "norm: of the scattering matrix, largest that is drawn; passive only if it is nowhere above 1"
)
_ROBUST_LEGEND = (
    "operators: drawn hands and tasks with which it is stable; let go: the same tasks, no hand\n"
    "Llewellyn: least stability parameter; from 1 on every passive hand and task is safe\n"
    "Z-width: decades between what is felt free and with a clamped slave, 0.1 to 5 Hz\n"
    "stiffest task: N/m, with the hand and let go; >: the stiffest that was tried"
)


class Robustly(NamedTuple):
    """How robustness is asked for: period [s], file of measured delays, drawn hands and tasks."""

    period: float = 0.005
    delays: Path | None = None
    operators: int = 20


def analyse_teleop_to_folder(
    file: Path | None, target: Path | None, structures: Sequence[str], delay: float | None,
    confirm: bool, as_json: bool, robustly: Robustly | None = None,
) -> Path | None:  # fmt: skip
    """Analyse a teleoperator; write report and figures into a folder, whole or not at all.

    Args:
        file: case, None for the shipped one.
        target: folder, default `runs/analyse_<name>`; with `as_json` none.
        structures: instead of the case's; none for those.
        delay: each way, instead of the case's [s].
        confirm: whether to simulate what is predicted.
        as_json: print `analysis.json` instead of words.
        robustly: how to find what it withstands, None not to.

    Returns:
        The folder, None where none was written.

    Raises:
        InputError: case, structures, delay or target are not usable.
    """
    facts = load_teleop_case(file)
    target = target or (None if as_json else Path("runs") / f"analyse_{facts.name}")
    if target:
        check_target(target, "two-port analysis")
    found = analyse_case(facts, structures, delay, confirm, as_json, robustly)
    document = plain(findings_document(found))
    if target:
        with whole_folder(target, "two-port analysis") as folder:
            _write(folder, found, document)
    print_result(document, as_json, lambda: _print(found), target)
    return target


def analyse_case(
    facts: TeleopCase, structures: Sequence[str], delay: float | None, confirm: bool, quiet: bool,
    robustly: Robustly | None = None,
) -> Findings:  # fmt: skip
    """Analyse a case.

    Args:
        facts: the case.
        structures: instead of the case's; none for those.
        delay: each way, instead of the case's [s].
        confirm: whether to simulate what is predicted.
        quiet: no bar.
        robustly: how to find what it withstands, None not to.

    Returns:
        What was found.

    Raises:
        InputError: structures or delay are not usable.
    """
    try:
        known = SAMPLED_STRUCTURES if robustly else STRUCTURES
        names = known_structures(tuple(structures), known)
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
    linear = tuple(name for name in names if name in STRUCTURES) if names else facts.structures
    with stages(f"analyse {facts.name}", quiet) as progress:
        found = find(facts.name, case, linear, delays, factors, spring, confirm, progress)
        if not robustly:
            return found
        line = _line(case, robustly)
        robust = []
        for one in names or (*facts.structures, *SAMPLED_STRUCTURES[len(STRUCTURES) :]):
            if progress:
                progress(f"{one}, what it withstands", len(robust) / len(SAMPLED_STRUCTURES))
            spread = spread_of(facts)
            robust.append(robustness(case, one, line, spread, robustly.operators))
        return replace(found, robust=tuple(robust), period=robustly.period)


def _line(case: Case, robustly: Robustly) -> PacketAges:
    """Ages of packets: measured, or of the case's own delays."""
    if not 1e-4 <= robustly.period <= 0.1:
        raise InputError("--period", f"must be from 0.0001 to 0.1 s, got {robustly.period:g}")
    if not 1 <= robustly.operators <= 10_000:
        raise InputError("--operators", f"must be from 1 to 10000, got {robustly.operators}")
    if robustly.delays is None:
        return steady_line(robustly.period, case.delay_forward, case.delay_back)
    return jittering_line(robustly.period, *load_delays(robustly.delays))


def _write(folder: Path, found: Findings, document: dict) -> None:
    write_json(folder / "analysis.json", document)
    from hydrotele.show.teleop_report import draw_maps, write_teleop_report

    notes.print("writing report.html ...", style="dim")
    maps = draw_maps(found)
    write_teleop_report(found, maps, folder / "report.html")
    (folder / "stability.png").write_bytes(maps)
    summary = {"kind": "two-port analysis", "name": found.name, "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def _print(found: Findings) -> None:
    case = found.case
    delays = f"{1e3 * case.delay_forward:g} ms forward, {1e3 * case.delay_back:g} ms back"
    title = f"{found.name}, delay {delays}"
    rows = table(title, "structure", "stable", "let go", "margin", "delay", "norm", "passive")
    for one in found.analyses:
        rows.add_row(
            one.structure, _verdict(why_unstable(one)), _verdict(why_unstable(one, True)),
            format_factor(one.gain_margin), format_delay(one.largest_delay),
            f"{one.scattering.max():.3g}", "yes" if one.passive else "no",
        )  # fmt: skip
    out.print(rows)
    out.print(_LEGEND, style="dim")
    if found.spring:
        _print_springs(found)
    if found.agreements:
        _print_confirmed(found)
    if found.robust:
        _print_robust(found)


def _verdict(words: str) -> str:
    return words if words == "yes" else f"[red]{words}[/]"


def _print_robust(found: Findings) -> None:
    title = f"sampled every {1e3 * found.period:g} ms, with the line's jitter"
    rows = table(title, "structure", "hand, task", "hand, free", "let go, task", "let go, free",
                 "operators", "let go", "Llewellyn", "Z-width", "stiffest task")  # fmt: skip
    for one in found.robust:
        told = [_verdict("yes" if p.stable else f"no, {p.reason}") for p in one.sampled]
        worst, width = one.worst, one.width
        stiffest = "-"
        if width:
            most = f"> {width.most_tried:.2g}"
            stiffest = " / ".join(
                most if math.isinf(k) else f"{k:.2g}"
                for k in (width.stiffest_held, width.stiffest_let_go)
            )
        rows.add_row(
            one.structure, *told, f"{worst.pairs - worst.unstable} of {worst.pairs}",
            f"{worst.pairs - worst.unstable_let_go} of {worst.pairs}",
            "-" if math.isnan(one.llewellyn) else f"{one.llewellyn:.3g}",
            f"{width.decades:.2f}" if width else "-", stiffest,
        )  # fmt: skip
    out.print(rows)
    out.print(_ROBUST_LEGEND, style="dim")


def _print_springs(found: Findings) -> None:
    assert found.spring
    _print_spring_table(found.spring.held(found.case.hand), found.spring)


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
    robustly: Robustly | None = None,
) -> Path | None:  # fmt: skip
    """Analyse a case or a scenario; see `analyse_teleop_to_folder`, `analyse_scenario_to_folder`.

    Raises:
        InputError: an option is of the other kind, or as of these two.
    """
    if not is_scenario(file):
        if coordinate or overrides:
            raise InputError("--coordinate, --set", "are for scenarios")
        return analyse_teleop_to_folder(
            file, target, structures or [], delay, confirm, as_json, robustly
        )
    if structures or delay is not None or confirm or robustly:
        message = "are for cases; a scenario has its own structure, and delays by --set"
        raise InputError("--structure, --delay, --confirm, --robust", message)
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
        _print_spring_table(found.held, found.free)
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


def _print_spring_table(held: Spring, free: Spring) -> None:
    rows = table("stiffness feedback: B^2 - 4 M K_max, and the worst switching", "joystick", "B",
                 "K_min", "K_max", "margin", "B for it", "growth", "B for 1", "stable by",
                 )  # fmt: skip
    for name, one in (("held", held), ("let go", free)):
        rows.add_row(
            name, f"{one.damping:g}", f"{one.least:g}", f"{one.most:g}", format_number(one.margin),
            f"{one.enough_damping:.4g}", f"{one.growth:.3g}", f"{one.least_damping:.3g}",
            _verdict(one.stable_by) if one.stable_by == "nothing" else one.stable_by,
        )  # fmt: skip
    out.print(rows)
    out.print(
        "theorem 4-2 asks for a positive margin and K_min > 0; growth: of half a swing under the"
        " worst switching between K_min and K_max, which dies out below 1",
        style="dim",
    )


def _write_loop(folder: Path, found: ScenarioFindings, document: dict) -> None:
    from hydrotele.show.teleop_report import draw_loop_map, write_loop_report

    write_json(folder / "analysis.json", document)
    picture = draw_loop_map(found)
    (folder / "stability.png").write_bytes(picture)
    write_loop_report(found, findings_table(found), picture, folder / "report.html")
    summary = {"kind": _KIND, "name": found.name, "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)

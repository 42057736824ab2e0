"""Implement `hydrotele analyse teleop`: analyse a linear teleoperator or a scenario.

A case describes a teleoperator (joystick, channel and slave machine) as a linear two-port between
operator and task. A scenario is linearised about its contact pose, and its force-reflection loop is
analysed.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import hydrotele
from hydrotele.cli.console import (
    make_table,
    print_json,
    print_result,
    show_stages,
    stderr_console,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.machine.joystick import load_joystick
from hydrotele.run.run import load_nominal_machine
from hydrotele.scenario.scenario import Scenario, find_scenario_joystick, load_scenario, shipped_scenarios
from hydrotele.show.teleop_text import (
    describe_stability,
    format_delay,
    format_gain_margin,
    format_number,
    format_relative_error,
)
from hydrotele.teleop.analysis_document import findings_to_dict, scenario_findings_to_dict
from hydrotele.teleop.case_analysis import TeleopFindings, analyse_structures
from hydrotele.teleop.case_file import MAX_DELAY, TeleopCaseFile, TeleoperatorAxis, check_structures, load_teleop_case
from hydrotele.teleop.linear_case import build_scenario_case
from hydrotele.teleop.packet_delays import load_packet_delays
from hydrotele.teleop.robustness import case_impedance_ranges, evaluate_robustness
from hydrotele.teleop.sampled_stability import (
    SAMPLED_STRUCTURES,
    PacketAges,
    constant_delay_ages,
    measured_delay_ages,
)
from hydrotele.teleop.scenario_analysis import ScenarioFindings, analyse_scenario_case
from hydrotele.teleop.stiffness_switching import StiffnessAxis
from hydrotele.teleop.two_port import STRUCTURES

_STABILITY_LEGEND = (
    "held: stability with the operator's hand on the handle, in contact with the task and in free"
    " motion; released: the same without a hand\n"
    "gain margin: factor on the reflected signal (force, or motion of the slave) up to which the"
    " loop is stable; higher is better, and below 1 the loop is unstable\n"
    "max delay: one-way delay up to which the loop is stable; higher is better; >: largest delay that was tested\n"
    "norm: maximum norm of the scattering matrix over frequency; the two-port is passive if it does not exceed 1"
)
_ROBUST_LEGEND = (
    "pairs held: random pairs of operator and task with which the loop is stable; pairs released:"
    " the same tasks without a hand; higher is better\n"
    "Llewellyn: minimum of the stability parameter; at 1 or more, the loop is stable with every"
    " passive operator and task\n"
    "Z-width: ratio, in decades, of the impedances felt with a clamped and with a free slave, 0.1"
    " to 5 Hz; higher is better\n"
    "max task: largest stable task stiffness [N/m], held / released; >: largest that was tested"
)


class RobustnessOptions(NamedTuple):
    """Options of the robustness analysis, which adds sampling, varying delays and random operators.

    Attributes:
        period: sampling period of the controllers of joystick and machine [s].
        delays: CSV file of measured packet delays, None for the constant delays of the case.
        operators: number of pairs of random operator and task impedances to test.
    """

    period: float = 0.005
    delays: Path | None = None
    operators: int = 20


def analyse_case_to_folder(
    file: Path | None, target: Path | None, structures: Sequence[str], delay: float | None,
    confirm: bool, as_json: bool, robustness_options: RobustnessOptions | None = None,
) -> Path | None:  # fmt: skip
    """Analyse a teleoperator case, print the result and write a report with figures.

    A case describes operator, joystick, slave and task as linear impedances, with delays between
    them. The output folder is written completely or not at all.

    Args:
        file: case file, None for the shipped case.
        target: output folder, default `runs/analyse_<name>`, or none with `as_json`.
        structures: control structures to analyse, such as `position_force`; if empty, those of the
            case.
        delay: one-way delay [s], None for that of the case.
        confirm: whether to verify the predictions by simulation.
        as_json: print `analysis.json` instead of text.
        robustness_options: options of the robustness analysis, None to omit it.

    Returns:
        The output folder, None if nothing was written.

    Raises:
        InputError: case, structures, delay or target are not usable.
    """
    facts = load_teleop_case(file)
    target = target or (None if as_json else Path("runs") / f"analyse_{facts.name}")
    if target:
        check_output_folder(target, "two-port analysis")
    found = analyse_case(facts, structures, delay, confirm, as_json, robustness_options)
    document = to_json_types(findings_to_dict(found))
    if target:
        with atomic_folder(target, "two-port analysis") as folder:
            _write(folder, found, document)
    print_result(document, as_json, lambda: _print(found), target)
    return target


def analyse_case(
    specification: TeleopCaseFile, structures: Sequence[str], delay: float | None, confirm: bool, quiet: bool,
    robustness_options: RobustnessOptions | None = None,
) -> TeleopFindings:  # fmt: skip
    """Compute stability, margins and passivity of a teleoperator under several control structures.

    Args:
        specification: content of the case file.
        structures: control structures to analyse, such as `position_force`; if empty, those of the
            case.
        delay: one-way delay [s], None for that of the case.
        confirm: whether to verify the predictions by simulation.
        quiet: whether to omit the progress bar.
        robustness_options: options of the robustness analysis, None to omit it.

    Returns:
        Results for each structure, with stability maps and, if requested, robustness.

    Raises:
        InputError: structures or delay are not usable.
    """
    try:
        known = SAMPLED_STRUCTURES if robustness_options else STRUCTURES
        names = check_structures(tuple(structures), known)
    except ValueError as error:
        raise InputError("--structure", str(error)) from None
    case = specification.to_axis()
    if delay is not None:
        if not 0.0 <= delay <= MAX_DELAY:
            raise InputError("--delay", f"must be from 0 to {MAX_DELAY:g} s, got {delay:g}")
        case = case.with_delay(delay)
    reach = specification.map
    delays = max(reach.max_delay, case.delay) * np.linspace(0.0, 1.0, reach.points) ** 2
    factors = np.geomspace(reach.min_factor, reach.max_factor, reach.points)
    spring = specification.stiffness.to_stiffness_axis() if specification.stiffness else None
    linear = tuple(name for name in names if name in STRUCTURES) if names else specification.structures
    with show_stages(f"analyse {specification.name}", quiet) as progress:
        found = analyse_structures(specification.name, case, linear, delays, factors, spring, confirm, progress)
        if not robustness_options:
            return found
        line = _packet_ages(case, robustness_options)
        robust = []
        for one in names or (*specification.structures, *SAMPLED_STRUCTURES[len(STRUCTURES) :]):
            if progress:
                progress(f"robustness of {one}", len(robust) / len(SAMPLED_STRUCTURES))
            spread = case_impedance_ranges(specification)
            robust.append(evaluate_robustness(case, one, line, spread, robustness_options.operators))
        return replace(found, robustness_results=tuple(robust), period=robustness_options.period)


def _packet_ages(case: TeleoperatorAxis, robustness_options: RobustnessOptions) -> PacketAges:
    """Return the fractions of sampling periods in which the newest received packet is 0, 1, 2, ... periods old.

    The result has one distribution per direction. The packet delays are those of the CSV file in
    the options, else the constant delays of the case.

    Raises:
        InputError: period, number of operators or file are not usable.
    """
    if not 1e-4 <= robustness_options.period <= 0.1:
        raise InputError("--period", f"must be from 0.0001 to 0.1 s, got {robustness_options.period:g}")
    if not 1 <= robustness_options.operators <= 10_000:
        raise InputError("--operators", f"must be from 1 to 10000, got {robustness_options.operators}")
    if robustness_options.delays is None:
        return constant_delay_ages(robustness_options.period, case.delay_forward, case.delay_back)
    return measured_delay_ages(robustness_options.period, *load_packet_delays(robustness_options.delays))


def _write(folder: Path, findings: TeleopFindings, document: dict) -> None:
    write_json(folder / "analysis.json", document)
    from hydrotele.show.teleop_report import draw_stability_maps, write_teleop_report

    stderr_console.print("writing report.html ...", style="dim")
    maps = draw_stability_maps(findings)
    write_teleop_report(findings, maps, folder / "report.html")
    (folder / "stability.png").write_bytes(maps)
    summary = {
        "kind": "two-port analysis",
        "name": findings.name,
        "hydrotele": hydrotele.__version__,
    }
    write_json(folder / "summary.json", summary)


def _print(findings: TeleopFindings) -> None:
    case = findings.case
    delays = f"{1e3 * case.delay_forward:g} ms forward, {1e3 * case.delay_back:g} ms back"
    title = f"{findings.name}, delay {delays}"
    rows = make_table(title, "structure", "held", "released", "gain margin", "max delay", "norm",
                 "passive")  # fmt: skip
    for one in findings.analyses:
        rows.add_row(
            one.structure, _color_verdict(describe_stability(one)), _color_verdict(describe_stability(one, True)),
            format_gain_margin(one.gain_margin), format_delay(one.max_delay),
            f"{one.scattering_norms.max():.3g}", "yes" if one.has_passive_port else "no",
        )  # fmt: skip
    stdout_console.print(rows)
    stdout_console.print(_STABILITY_LEGEND, style="dim")
    if findings.spring:
        _print_case_stiffness_feedback(findings)
    if findings.agreements:
        _print_simulation_agreement(findings)
    if findings.robustness_results:
        _print_robustness(findings)


def _color_verdict(verdict: str) -> str:
    return verdict if verdict == "yes" else f"[red]{verdict}[/]"


def _print_robustness(found: TeleopFindings) -> None:
    title = f"robustness with sampling every {1e3 * found.period:g} ms and jitter of the delays"
    rows = make_table(title, "structure", "held, task", "held, free", "released, task",
                 "released, free", "pairs held", "pairs released", "Llewellyn", "Z-width",
                 "max task")  # fmt: skip
    for one in found.robustness_results:
        told = [_color_verdict("yes" if p.is_stable else f"no, {p.reason}") for p in one.sampled]
        worst, width = one.sampled_pairs, one.z_width_result
        stiffest = "-"
        if width:
            most = f"> {width.max_tested_stiffness:.2g}"
            stiffest = " / ".join(
                most if math.isinf(k) else f"{k:.2g}" for k in (width.max_stiffness_held, width.max_stiffness_released)
            )
        rows.add_row(
            one.structure, *told, f"{worst.pair_count - worst.unstable_count} of {worst.pair_count}",
            f"{worst.pair_count - worst.unstable_released_count} of {worst.pair_count}",
            "-" if math.isnan(one.llewellyn) else f"{one.llewellyn:.3g}",
            f"{width.mean_width_decades:.2f}" if width else "-", stiffest,
        )  # fmt: skip
    stdout_console.print(rows)
    stdout_console.print(_ROBUST_LEGEND, style="dim")


def _print_case_stiffness_feedback(found: TeleopFindings) -> None:
    assert found.spring
    _print_stiffness_feedback_table(found.spring.with_hand(found.case.hand), found.spring)


def _print_simulation_agreement(found: TeleopFindings) -> None:
    rows = make_table("confirmed in simulation", "structure", "sweep error, no delay",
                 "sweep error, with delay", "map agreement")  # fmt: skip
    for one in found.agreements:
        errors = [format_relative_error(s.max_relative_error) for s in found.sweeps if s.structure == one.structure]
        rows.add_row(one.structure, *[*errors, "-"][:2], f"{100.0 * one.agreement_fraction:.1f} %")
    stdout_console.print(rows)
    stdout_console.print("sweep error: largest error of the impedance felt by the operator (lower is better);"
              " map agreement: fraction of the cells of the stability map in which simulation and"
              " prediction agree (higher is better)", style="dim")  # fmt: skip


_KIND = "loop analysis"


def is_scenario(file: Path | None) -> bool:
    """Return whether an argument is a shipped scenario or a YAML file with the key `pilot`."""
    if file is None:
        return False
    if str(file) in shipped_scenarios():
        return True
    try:
        return "pilot" in read_yaml(file)[0]
    except InputError:
        return False


def analyse_case_or_scenario_to_folder(
    file: Path | None, target: Path | None, structures: list[str] | None, delay: float | None,
    confirm: bool, coordinate: str | None, overrides: dict[str, str], as_json: bool,
    robustness_options: RobustnessOptions | None = None,
) -> Path | None:  # fmt: skip
    """Analyse a teleoperator case or a scenario, whichever the file is; print and write the result.

    The arguments are those of `analyse_case_to_folder` and `analyse_scenario_to_folder`.

    Returns:
        The output folder, None if nothing was written.

    Raises:
        InputError: an option does not apply to this kind of file, or the analysis raises it.
    """
    if not is_scenario(file):
        if coordinate or overrides:
            raise InputError("--coordinate, --set", "apply to scenarios only")
        return analyse_case_to_folder(file, target, structures or [], delay, confirm, as_json, robustness_options)
    if structures or delay is not None or confirm or robustness_options:
        message = "apply to cases only; change a scenario by --set"
        raise InputError("--structure, --delay, --confirm, --robust", message)
    return analyse_scenario_to_folder(str(file), target, coordinate, overrides, as_json)


def analyse_scenario(scenario: Scenario, coordinate: str | None = None) -> ScenarioFindings:
    """Linearise a teleoperated scenario in contact and analyse the stability of its force reflection.

    The machine touches the scenario's plate, or else stiff ground at its start pose.

    Args:
        scenario: the scenario.
        coordinate: coordinate of the arm's tip to analyse, such as `r` or `z`. By default it is the one in
            which the simulated operator controls a force, otherwise z.

    Returns:
        Stability and margins of the loop, and those of the joystick under stiffness feedback.

    Raises:
        InputError: the scenario has no force-reflection loop.
    """
    machine = load_nominal_machine(scenario)
    joystick = load_joystick(find_scenario_joystick(scenario))
    case, contact = build_scenario_case(scenario, machine, joystick, coordinate)
    return analyse_scenario_case(scenario.name, case, contact.source)


def analyse_scenario_to_folder(
    name: str, target: Path | None, coordinate: str | None, overrides: dict[str, str],
    as_json: bool,
) -> Path | None:  # fmt: skip
    """Analyse the force-reflection loop of a scenario, print the result and write a report.

    The output folder is written completely or not at all.

    Args:
        name: name or file of the scenario.
        target: output folder, default `runs/analyse_<name>`, or none with `as_json`.
        coordinate: coordinate of the arm's tip to analyse, None for the default of `analyse_scenario`.
        overrides: scenario overrides, {key path: YAML text}.
        as_json: print `analysis.json` instead of text.

    Returns:
        The output folder, None if nothing was written.

    Raises:
        InputError: scenario, coordinate or target are not usable.
    """
    scenario = load_scenario(name, overrides)
    target = target or (None if as_json else Path("runs") / f"analyse_{scenario.name}")
    if target:
        check_output_folder(target, _KIND)
    found = analyse_scenario(scenario, coordinate)
    document = to_json_types(scenario_findings_to_dict(found))
    if target:
        with atomic_folder(target, _KIND) as folder:
            _write_loop_files(folder, found, document)
    if as_json:
        print_json(document)
    else:
        for label, value, why in format_findings(found):
            stdout_console.print(f"{label}: [bold]{value}[/] {why}".rstrip())
        _print_stiffness_feedback_table(found.held_spring, found.released_spring)
        stdout_console.print(f"written to [bold]{target}[/]; open {target}/report.html")
    return target


def format_findings(findings: ScenarioFindings) -> list[tuple[str, str, str]]:
    """Format the results of a scenario analysis as rows of text: (quantity, value, remark)."""
    case, loop, tip = findings.case, findings.loop, findings.case.tip
    pole, turns = loop.pole, tip.coordinate not in ("r", "z")
    force, mass, oil = ("N m", "kg m^2", "N m/rad") if turns else ("N", "kg", "N/m")
    rows = [
        ("scenario", findings.name, f"{case.pilot.reflection} under {case.pilot.mode} control"),
        ("coordinate", tip.coordinate, f"{tip.mass:.0f} {mass}, oil {tip.stiffness:.3g} {oil}"),
        ("task", f"{case.task.stiffness:.3g} {oil}", f"({findings.task_source})"),
        ("analysed loop", loop.structure,
         "" if loop.is_scenario_structure else "used because the scenario has stiffness feedback or no reflection"),
        ("stable", "yes" if loop.is_stable else f"no, {loop.unstable_poles} unstable poles", ""),
        ("gain margin", format_gain_margin(loop.gain_margin),
         f"factor on the reflection ratio of {case.ratio:.3g}; higher is better"),
        ("maximum delay", format_delay(loop.max_delay), "one way; higher is better"),
    ]  # fmt: skip
    if math.isfinite(loop.frequency):
        rows.append(("oscillation frequency", f"{loop.frequency:.2f} Hz", "at the stability limit"))
        rows.append(("dominant pole", f"{pole.real:.3f} {pole.imag:+.3f}j rad/s", "at this ratio"))
    if math.isfinite(loop.max_ratio):
        why = (
            f"hand force {loop.hand_force:.2f} {force} at {case.force_limit:.0f} {force}, handle outside its dead band"
        )
        rows.append(("maximum stable ratio", f"{loop.max_ratio:.3g}", why))
    if math.isfinite(loop.max_ratio_with_deadband):
        why = "for an oscillation from stop to stop across the dead band"
        label = "maximum stable ratio with dead band"
        rows.append((label, f"{loop.max_ratio_with_deadband:.3g}", why))
    why = "reflected by stiffness feedback at the edge of the dead band"
    return [*rows, ("local reflection ratio", f"{findings.deadband_edge_ratio:.3g}", why)]


def _print_stiffness_feedback_table(held: StiffnessAxis, released: StiffnessAxis) -> None:
    rows = make_table("stiffness feedback: margin B^2 - 4 M K_max and worst-case switching", "joystick",
                 "B", "K_min", "K_max", "margin", "B for margin 0", "growth", "B for growth 1",
                 "stable by",
                 )  # fmt: skip
    for name, one in (("held", held), ("released", released)):
        rows.add_row(
            name, f"{one.damping:g}", f"{one.min_stiffness:g}", f"{one.max_stiffness:g}",
            format_number(one.stability_theorem_margin),
            f"{one.stability_theorem_damping:.4g}", f"{one.half_swing_growth:.3g}", f"{one.min_stable_damping:.3g}",
            _color_verdict(one.stability_criterion)
            if one.stability_criterion == "nothing" else one.stability_criterion,
        )  # fmt: skip
    stdout_console.print(rows)
    stdout_console.print(
        "theorem 4-2 guarantees stability for a positive margin and K_min > 0; growth: amplitude"
        " ratio of successive half oscillations under the worst-case switching between K_min and"
        " K_max, stable below 1; B [N s/m], K [N/m]",
        style="dim",
    )


def _write_loop_files(folder: Path, found: ScenarioFindings, document: dict) -> None:
    from hydrotele.show.teleop_report import draw_loop_map, write_loop_report

    write_json(folder / "analysis.json", document)
    picture = draw_loop_map(found)
    (folder / "stability.png").write_bytes(picture)
    write_loop_report(found, format_findings(found), picture, folder / "report.html")
    summary = {"kind": _KIND, "name": found.name, "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)

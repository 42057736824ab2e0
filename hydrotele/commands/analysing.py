"""`hydrotele analyse teleop`: a teleoperator as a two-port, with hand, task and delays."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hydrotele
from hydrotele.commands.console import notes, out, plain, print_json, stages, table
from hydrotele.errors import InputError
from hydrotele.output import check_target, whole_folder
from hydrotele.teleop.findings import Findings, find, findings_document
from hydrotele.teleop_case import TeleopCase, known_structures, load_teleop_case

_LEGEND = (
    "gain margin: factor on what comes back (force, or the slave's motion) up to which it stays"
    " stable; below 1 it has to be made that much smaller"
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
        check_target(target, "analyse")
    found = analyse_case(facts, structures, delay, confirm, as_json)
    document = plain(findings_document(found))
    if target:
        with whole_folder(target, "analyse") as folder:
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
        if not 0.0 <= delay < math.inf:
            raise InputError("--delay", f"must be a time of 0 s or more, got {delay:g}")
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
    from hydrotele.show.teleop_report import write_teleop_report

    notes.print("writing report.html ...", style="dim")
    write_teleop_report(found, folder / "report.html")
    summary = {"kind": "analyse", "name": found.name, "hydrotele": hydrotele.__version__}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _print(found: Findings) -> None:
    case = found.case
    title = f"{found.name}, delay {1e3 * case.delay_forward:g} ms forward, {1e3 * case.delay_back:g} ms back"  # fmt: skip  # noqa: E501 - one title
    rows = table(title, "structure", "stable", "unstable poles", "free", "gain margin",
                 "largest delay", "scattering", "passive")  # fmt: skip
    for one in found.analyses:
        rows.add_row(
            one.structure, "yes" if one.stable else "[red]no[/]", str(one.unstable_poles),
            str(one.unstable_free), _factor(one.gain_margin), _delay(one.largest_delay),
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
    rows = table("stiffness feedback", "joystick", "B [N s/m]", "K_max [N/m]", "B^2 - 4 M K_max",
                 "B asked for", "worst growth of half a swing")  # fmt: skip
    for name, one in (("held", found.spring.held(found.case.hand)), ("let go", found.spring)):
        rows.add_row(name, f"{one.damping:g}", f"{one.most:g}", f"{one.margin:.4g}",
                     f"{one.enough_damping:.4g}", f"{one.growth:.3g}")  # fmt: skip
    out.print(rows)


def _print_confirmed(found: Findings) -> None:
    rows = table("confirmed in simulation", "structure", "sweep, no delay",
                 "sweep, with delay", "map agrees")  # fmt: skip
    for one in found.agreements:
        errors = [_error(s.error) for s in found.sweeps if s.structure == one.structure]
        rows.add_row(one.structure, *[*errors, "-"][:2], f"{100.0 * one.share:.1f} %")
    out.print(rows)
    out.print("sweep: largest error of the felt impedance; map: share of its cells", style="dim")


def _factor(margin: float) -> str:
    return "none found" if math.isinf(margin) else f"{margin:.3g}"


def _delay(delay: float) -> str:
    return "none found" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def _error(error: float | None) -> str:
    return "not measurable" if error is None else f"{100.0 * error:.2g} %"

"""Write the HTML report of an identification.

The module formats the tables (forces, parameters, tests, identifiability) for the template
`identify.html.j2` and draws measured and predicted forces of the held-out run.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hydrotele
from hydrotele.gap.result import Estimate, amount, in_customary_units
from hydrotele.identify.consistent_parameters import ConsistentParameters
from hydrotele.identify.hydraulic_identification import HydraulicIdentification
from hydrotele.identify.result import (
    STATUS_DESCRIPTIONS,
    HeldOutError,
    HeldOutForces,
    Identification,
    count_statuses,
    parameter_rows,
)
from hydrotele.show import report_html
from hydrotele.show.report_html import figure_to_png, open_report_figure

MEASURED_COLOUR, NOMINAL_COLOUR, IDENTIFIED_COLOUR = "#262b33", "#e07b00", "#1769aa"


def draw_force_predictions(forces: HeldOutForces, drive: str, judged: HeldOutError) -> bytes:
    """Draw measured and predicted force of a drive on the held-out run, and the prediction errors below.

    A grey band shows twice the RMS noise, if known.

    Args:
        forces: measured forces, and forces predicted by the given and the identified model.
        drive: name of the drive.
        judged: prediction errors of the drive, with the RMS noise.

    Returns:
        A PNG.
    """
    k = forces.drives.index(drive)
    unit, factor = ("k" + judged.unit, 1e-3) if np.nanmax(
        np.abs(forces.measured[:, k])) >= 2e3 else (judged.unit, 1.0)  # fmt: skip
    measured = factor * forces.measured[:, k]
    lines = [
        ("given model", NOMINAL_COLOUR, factor * forces.nominal[:, k]),
        ("identified model", IDENTIFIED_COLOUR, factor * forces.predicted[:, k]),
    ]
    with open_report_figure(3.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
        upper.plot(forces.time, measured, color=MEASURED_COLOUR, lw=2.2, alpha=0.5, label="measured")
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
        return figure_to_png(figure)


_MAX_MEMBERS = 6  # maximum number of listed members of a combination


class ReportSource(NamedTuple):
    """Machine and logs of an identification.

    Attributes:
        name: name of the machine or mechanism.
        tool: tool of the machine, None for a mechanism without a machine.
        fit: names of the fitted runs.
        heldout: name of the held-out run.
        notes: remarks on the logs.
    """

    name: str
    tool: str | None
    fit: tuple[str, ...]
    heldout: str
    notes: tuple[str, ...] = ()


def write_identify_report(
    source: ReportSource, identification: Identification | None, hydraulics: HydraulicIdentification | None,
    consistent: ConsistentParameters | None, path: str | Path,
) -> None:  # fmt: skip
    """Write the report of an identification as one self-contained HTML file.

    Args:
        source: machine and logs.
        identification: identified mechanism, None if the logs contain no forces.
        hydraulics: identified hydraulics, None if they were not identified.
        consistent: nearest physically consistent parameters, None without a mechanism.
        path: file to write.
    """
    of = f"mechanism {source.name}"
    if source.tool is not None:
        of = f"machine {source.name}, tool {source.tool}"
    status = identification.status if identification else hydraulics.status if hydraulics else ""
    good = status == "ok" and (hydraulics is None or hydraulics.status == "ok")
    report_html.write_template_report(
        "identify", path, title=f"{source.name}: identification",
        over=f"IDENTIFICATION REPORT  ·  {of}  ·  held-out run {source.heldout}, fitted on"
        f" {', '.join(source.fit)}",
        heading="Parameters identified from logs" if good else status,
        chip=("no_gap", "Identified") if good else ("ambiguous", "Incomplete"),
        figures=_key_figure_cards(identification, hydraulics), found=_mechanism_content(identification,
        consistent) if identification else None,
        hydraulics=_hydraulics_content(hydraulics) if hydraulics else None,
        notes=identification.notes if identification else source.notes, version=hydrotele.__version__,
        runs=source.tool is not None,
        seconds=f"{sum(part.seconds for part in (identification, hydraulics) if part):.1f}",
    )  # fmt: skip


def _key_figure_cards(
    found: Identification | None, hydraulics: HydraulicIdentification | None
) -> list[tuple[str, str, str]]:
    cards = []
    for drive, h in list(found.heldout.items())[:3] if found else ():
        against = f"{h.rms / h.noise_rms:.2f} × noise, " if h.noise_rms > 0.0 else ""
        what = f"{against}relative force error of {_display_name(drive)}"
        cards.append(("after", f"{100 * h.relative_error:.2f} %", what))
    if hydraulics:
        what = f"one-step prediction error ({hydraulics.nominal_rms_error:.2f} with the given hydraulics)"
        cards.append(("after", f"{hydraulics.identified_rms_error:.2f} × noise", what))
    return cards


def _display_name(drive: str) -> str:
    return drive.replace("_", " ")


def _mechanism_content(found: Identification, best: ConsistentParameters | None) -> dict[str, Any]:
    forces = [
        (_display_name(drive), amount(h.nominal_rms, h.unit), amount(h.rms, h.unit),
         amount(h.noise_rms, h.unit) if math.isfinite(h.noise_rms) else "not stated",
         f"{100 * h.relative_error:.2f} %")
        for drive, h in found.heldout.items()
    ]  # fmt: skip
    return {
        "run": found.forces.run, "band": f"{found.band:.3g}", "forces": forces,
        "pictures": [(drive, draw_force_predictions(found.forces, drive, h))
                     for drive, h in found.heldout.items()],
        "friction": [
            (_display_name(f.drive), f"{f.speed:g} {'m/s' if f.unit == 'N' else 'rad/s'}", amount(f.force, f.unit),
             " to ".join(amount(limit, f.unit) for limit in f.ci95))
            for f in found.friction
        ],
        "condition": f"{found.estimate.condition:.3g}", "parameters": _parameters(found),
        "tests": _consistency_test_rows(found, best), "statuses": _identifiability_rows(found),
        "correlation": ", ".join(f"{_display_name(drive)} {r:.2f}" for drive,
        r in found.residual_autocorrelation.items()),
    }  # fmt: skip


def _scale_interval(estimate: Estimate) -> report_html.Interval | None:
    return report_html.scale_interval_to_pixels(estimate.value, estimate.low, estimate.high, estimate.nominal)


def _parameters(found: Identification) -> list[dict[str, Any]]:
    rows = []
    for row in parameter_rows(found):
        if row.value is None or row.ci95 is None:
            continue
        estimate = Estimate(row.value, row.unit, *row.ci95, row.nominal)
        s = in_customary_units(estimate)
        rows.append({
            "name": row.name, "combination": _shorten_combination(row.combination), "status": row.status,
            "texts": (s.nominal, s.value, f"{s.low} to {s.high}", s.unit),
            "drawn": _scale_interval(estimate),
        })  # fmt: skip
    return rows


def _consistency_test_rows(found: Identification, best: ConsistentParameters | None) -> list[tuple[str, ...]]:
    distance, limit = found.squared_distance(found.nominal)
    verdict = "consistent with the logs" if distance <= limit else "rejected by the logs"
    rows = [("given parameters", f"{distance:.3g}", f"{limit:.3g}", verdict)]
    if best:
        agree = best.squared_distance <= limit
        verdict = "consistent with the estimate" if agree else "differs from the estimate"
        name = "nearest physically consistent parameters"
        rows.append((name, f"{best.squared_distance:.3g}", f"{limit:.3g}", verdict))
    return rows


def _identifiability_rows(found: Identification) -> list[tuple[str, ...]]:
    rows = parameter_rows(found)
    parts = []
    for status, number in count_statuses(rows).items():
        names = [row.name for row in rows if row.status == status and row.value is None]
        parts.append((status, str(number), STATUS_DESCRIPTIONS[status], ", ".join(names) or "-"))
    return parts


def _shorten_combination(combination: str) -> str:
    """Shorten a sum of parameters, written as text, to its first 6 members and `+ N more`."""
    parts = combination.replace(" - ", " + -").split(" + ")
    if len(parts) <= _MAX_MEMBERS:
        return combination
    return " + ".join(parts[:_MAX_MEMBERS]).replace("+ -", "- ") + f" + {len(parts) - _MAX_MEMBERS} more"


def _hydraulics_content(found: HydraulicIdentification) -> dict[str, Any]:
    rows = []
    for n in found.parameters:
        estimate = Estimate(n.value, n.unit, *n.ci95, n.nominal)
        s = in_customary_units(estimate, n.parameter)
        values = (s.value, f"{s.low} to {s.high}") if n.is_determined else ("not identifiable", "")
        rows.append({
            "name": n.qualified_name, "texts": (_display_name(n.parameter), s.nominal, *values, s.unit),
            "drawn": _scale_interval(estimate) if n.is_determined else None,
        })  # fmt: skip
    return {
        "before": f"{found.nominal_rms_error:.2f}",
        "after": f"{found.identified_rms_error:.2f}",
        "numbers": rows,
    }

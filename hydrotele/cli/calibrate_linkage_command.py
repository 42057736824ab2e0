"""Implement `hydrotele calibrate linkage`: calibrate the pin positions of the cylinders of an arm."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hydrotele.calibrate.arm_identification import identify_arm, identify_jointly
from hydrotele.calibrate.calibration_loop import build_loop
from hydrotele.calibrate.calibrator_logs import extract_strokes, log_to_poses, read_calibration_logs
from hydrotele.calibrate.linkage_identification import (
    PARAMETER_NAMES,
    AxisStrokes,
    LinkageFit,
    compute_angles_from_calibrator,
    identify_linkage,
    linkage_parameters,
    machine_with_linkage,
)
from hydrotele.cli.calibrate_arm_command import print_output_folder, write_calibration_folder
from hydrotele.cli.console import (
    StageReport,
    ignore_stage,
    make_table,
    print_json,
    print_notes,
    show_stages,
    stdout_console,
    to_json_types,
)
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_output_folder
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine

_KIND = "linkage calibration"  # kind of the output folder


def calibrate_linkage(data: Path, machine: str, angles: str, target: Path | None, as_json: bool) -> list[LinkageFit]:
    """Calibrate the pin positions of the cylinders that move in a folder of logs; print and write them.

    Each cylinder forms a triangle of its two pins and the joint that it turns.

    Args:
        data: folder of logs.
        machine: nominal machine, as a shipped name or a folder.
        angles: source of the joint angles: `measured` by sensors or `identified` by the calibrator.
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        One fit per axis that moves.

    Raises:
        InputError: no linkage moves, or the logs are not usable.
    """
    if angles not in ("measured", "identified"):
        raise InputError("--angles", f"{angles!r} is unknown; valid: measured, identified")
    if target:
        check_output_folder(target, _KIND)
    nominal = load_machine(machine)
    with show_stages("calibrate linkage", as_json) as progress:
        fits = fit_linkages(nominal, data, angles, progress or ignore_stage)
    said = to_json_types({"machine": nominal.name, "angles": angles, "axes": {
        found.axis: linkage_fit_to_dict(found) for found in fits}})  # fmt: skip
    made = nominal
    for found in fits:
        made = machine_with_linkage(made, found)
    if target:
        from hydrotele.show.calibration_report import write_linkage_report

        write_calibration_folder(target, _KIND, said, made, lambda f: write_linkage_report(fits, f / "report.html"))
    if as_json:
        print_json(said)
    else:
        _print_linkages(said)
        print_output_folder(target)
    return fits


def fit_linkages(nominal: Machine, data: Path, angles: str, report: StageReport = ignore_stage) -> list[LinkageFit]:
    """Fit the triangle of joint and two pins of each cylinder to joint angles and lengths; write no files.

    If several logs move a cylinder, the one with the largest range of joint angles is fitted.

    Args:
        nominal: nominal machine.
        data: folder of logs.
        angles: source of the joint angles: `measured` by sensors, or `identified` from the readings
            of the external calibrator.
        report: called with the name of each stage and the completed fraction.

    Returns:
        One fit per axis that moves by 5 deg or more.

    Raises:
        InputError: no linkage moves, or the logs are not usable.
    """
    axes = [name for name, axis in nominal.axes.items() if axis.cylinder and not axis.four_bar]
    report("read the logs", 0.0)
    logs, notes = read_calibration_logs(data, nominal)
    print_notes(notes)
    strokes = [s for log in logs for s in extract_strokes(log, nominal, axes)]
    if angles == "identified":
        report("identify the joint angles", 0.1)
        loop = build_loop(nominal)
        stages = [log_to_poses(log, nominal, loop) for log in logs]
        fit = identify_jointly(identify_arm(loop, stages), stages)
        by_source = {log.source: log for log in logs}
        strokes = []
        for poses in stages:
            log = by_source[poses.source]
            known = extract_strokes(log, nominal, [poses.link])
            if not known or poses.rows is None:
                continue
            strokes.append(AxisStrokes(
                poses.link, compute_angles_from_calibrator(fit, poses), log[f"length.{poses.link}"][poses.rows],
                float(poses.sigma.max()) * 2.0, known[0].length_sigma, "identified", log.source,
            ))  # fmt: skip
    if not strokes:
        names = ", ".join(f"angle.{a} and length.{a}" for a in axes)
        message = f"no cylinder turns its joint by 5 deg or more: log {names} during a motion"
        raise InputError(data, message)
    longest = {s.axis: s for s in sorted(strokes, key=lambda s: np.ptp(s.angle))}
    fits = []
    for number, stroke in enumerate(longest.values()):
        report(f"fit the linkage of {stroke.axis}", 0.5 + 0.5 * number / len(longest))
        fits.append(identify_linkage(nominal, stroke))
    return fits


def linkage_fit_to_dict(fit: LinkageFit) -> dict[str, Any]:
    """Return a linkage calibration in the form that `--json` prints.

    Values are in SI units, except the variance accounted for [%] on held-out samples.
    """
    deviations = dict(zip(fit.fit.names, fit.fit.standard_deviations, strict=True))
    return {
        "parameters": [
            {"name": name, "unit": "rad" if name == "theta_off" else "m", "nominal": nominal,
             "value": value, "standard_deviation": deviations.get(name),
             "held": name in fit.fixed}
            for name, nominal, value in zip(PARAMETER_NAMES, fit.nominal, linkage_parameters(fit), strict=True)
        ],
        "heldout": {"rms_m": fit.rms, "vaf_percent": fit.vaf,
                    "rms_nominal_m": fit.rms_before},
        "samples": fit.samples,
    }  # fmt: skip


def _print_linkages(document: Mapping[str, Any]) -> None:
    for axis, found in document["axes"].items():
        shown = make_table(f"{axis}: {document['angles']} angles", "parameter", "nominal", "identified", "95 % +-")
        for row in found["parameters"]:
            scale = np.degrees(1.0) if row["unit"] == "rad" else 1.0
            wide = "held" if row["held"] else f"{1.96 * scale * row['standard_deviation']:.4f}"
            shown.add_row(row["name"], f"{scale * row['nominal']:.4f}",
                          f"{scale * row['value']:.4f}", wide)  # fmt: skip
        stdout_console.print(shown)
        held = found["heldout"]
        stdout_console.print(f"held-out samples: RMS error {1e3 * held['rms_m']:.2f} mm (nominal"
                  f" {1e3 * held['rms_nominal_m']:.2f} mm), VAF {held['vaf_percent']:.3f} %"
                  )  # fmt: skip

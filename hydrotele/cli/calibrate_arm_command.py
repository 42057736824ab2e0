"""Implement `hydrotele calibrate arm`, `linkage` and `design`.

Each command loads logs or a machine, runs the calibration, prints the result as text or JSON and
writes `calibration.json`, the calibrated machine and a report.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hydrotele
from hydrotele.calibrate.arm_identification import ArmFit, identify_arm, identify_jointly, stage_residuals
from hydrotele.calibrate.arm_poses import Poses, add_held_link_drift
from hydrotele.calibrate.bad_data import CorruptedRegion, identify_without_bad_data
from hydrotele.calibrate.calibration_loop import CalibrationLoop, build_loop, unit_of
from hydrotele.calibrate.calibrator_logs import log_to_poses, read_calibration_logs, split_poses
from hydrotele.calibrate.flexibility import (
    Flexibility,
    add_flexibility_to_noise,
    refit_with_flexibility,
)
from hydrotele.calibrate.machine_correction import calibrated_machine
from hydrotele.cli.console import (
    StageReport,
    ignore_stage,
    make_table,
    print_json,
    print_notes,
    show_stages,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine, save_machine

_ARM_KIND, _DESIGN_KIND = "arm calibration", "calibrator design"  # kinds of output folders
_MAX_RESIDUAL_RATIO = 1.5  # ratio of residuals to sensor noise above which a note is printed


class ArmChoices(NamedTuple):
    """Options of the arm calibration with an external calibrator.

    Attributes:
        method: `joint` fits all links together, `hierarchical` one link after the other.
        poses: maximum number of poses used of each log.
        accuracy_deg: standard deviation of an angle sensor [deg], None for that of the log.
        bad_data: whether corrupted samples are detected and excluded.
        drift: whether slow motion of links that should be at rest is measured by the arm's own
            sensors and included in the fit.
        heldout: N as text: every N-th pose is held out (not fitted, but predicted for validation);
            None for 5.
        flexibility: whether the flexibility of the calibrator's joints is estimated.
    """

    method: str = "joint"
    poses: int = 300
    accuracy_deg: float | None = None
    bad_data: bool = True
    drift: bool = True
    heldout: str | None = None
    flexibility: bool = True


class ArmResult(NamedTuple):
    """Result of an arm calibration.

    Attributes:
        machine: machine with the parameters before the calibration.
        fit: fitted parameters of the arm.
        stages: fitted poses, one item per log, without held-out and excluded poses.
        regions: intervals of poses with a corrupted angle sensor. The poses were excluded if this
            sensor belongs to the calibrator, and kept if it is the arm's own.
        heldout_errors: errors on held-out poses, as from `_heldout_errors`; empty without such
            poses.
        calibrated: machine with the fitted parameters.
        flexibility: flexibility of the calibrator's joints, None if it was not estimated.
    """

    machine: Machine
    fit: ArmFit
    stages: list[Poses]
    regions: list[CorruptedRegion]
    heldout_errors: Mapping[str, Any]
    calibrated: Machine
    flexibility: Flexibility | None


def calibrate_arm(data: Path, machine: str, choices: ArmChoices, target: Path | None, as_json: bool) -> ArmResult:
    """Calibrate the links of an arm from a folder of logs; print and write the result.

    The calibrator is a passive linkage with angle sensors that connects the arm to the chassis.

    Args:
        data: folder of logs; one link moves in each log.
        machine: nominal machine with a calibrator, as a shipped name or a folder.
        choices: options of the calibration.
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        Fitted parameters, calibrated machine and errors on held-out poses.

    Raises:
        InputError: logs, machine, options or target are not usable.
    """
    if choices.method not in ("joint", "hierarchical"):
        raise InputError("--method", f"{choices.method!r} is unknown; valid: joint, hierarchical")
    every = _parse_heldout_interval(choices.heldout)
    if target:
        check_output_folder(target, _ARM_KIND)
    nominal = load_machine(machine)
    with show_stages("calibrate arm", as_json) as progress:
        result = fit_arm(nominal, data, choices, every, progress or ignore_stage)
    said = arm_result_to_dict(result)
    if target:
        write_calibration_folder(
            target, _ARM_KIND, said, result.calibrated, lambda folder: write_arm_report(folder, result)
        )
    if as_json:
        print_json(said)
    else:
        _print_arm_document(said)
        print_output_folder(target)
    return result


def _parse_heldout_interval(text: str | None) -> int:
    if text is None:
        return 5
    if not text.isdigit():
        message = f"{text!r} is not a whole number N; every N-th pose is held out"
        raise InputError("--heldout", message)
    return int(text)


def fit_arm(
    nominal: Machine, data: Path, choices: ArmChoices, heldout_interval: int, report: StageReport = ignore_stage
) -> ArmResult:
    """Calibrate the links of an arm from logs of an external calibrator; write no files.

    Args:
        nominal: nominal machine with a calibrator.
        data: folder of logs; one link moves in each log.
        choices: options of the calibration.
        heldout_interval: N; every N-th pose is held out.
        report: called with the name of each stage and the completed fraction.

    Returns:
        Fitted parameters, calibrated machine and errors on held-out poses.

    Raises:
        InputError: the logs or options are not usable.
    """
    loop = build_loop(nominal)
    accuracy = None if choices.accuracy_deg is None else float(np.radians(choices.accuracy_deg))
    report("read the logs", 0.0)
    logs, notes = read_calibration_logs(data, nominal)
    print_notes(notes)
    stages = [log_to_poses(log, nominal, loop, choices.poses, accuracy) for log in logs]
    if choices.drift:
        report("remove the drift of the sensors", 0.1)
        stages = [add_held_link_drift(loop, poses) for poses in stages]
    regions: list[CorruptedRegion] = []
    kept = stages
    if choices.bad_data:
        report("find corrupted samples", 0.2)
        cleaned = identify_without_bad_data(loop, stages)
        regions, kept = cleaned.regions, cleaned.stages
    fitted, judged = split_poses(kept, heldout_interval)

    def identify(stages: Sequence[Poses]) -> ArmFit:
        fit = identify_arm(loop, stages)
        return identify_jointly(fit, stages) if choices.method == "joint" else fit

    report("fit the links", 0.5)
    fit, flexibility = identify(fitted), None
    if choices.flexibility:
        report("fit the links with the flexibility of the calibrator", 0.7)
        fit, flexibility = refit_with_flexibility(loop, fitted, fit, identify)
        bend = flexibility.at_full_load
        judged = [add_flexibility_to_noise(loop, poses, fit, bend) for poses in judged]
    made = calibrated_machine(nominal, fit, fitted)
    report("predict the held-out poses", 0.9)
    errors = _heldout_errors(loop, fit, judged)
    return ArmResult(nominal, fit, fitted, regions, errors, made, flexibility)


def _heldout_errors(loop: CalibrationLoop, fit: ArmFit, heldout_poses: list[Poses]) -> dict[str, Any]:
    """Return how well the kinematic loop of arm and calibrator closes on held-out poses.

    The loop has two errors per pose [m]: of the distance of the calibrator's ball joint from the
    axis of the moving joint, and of its height along this axis.

    Returns:
        `poses`: number of held-out poses. `rms_nominal_mm`: RMS of both errors with the parameters
        before the fit, minus the mean of each error over the poses of a log. `rms_identified_mm`:
        RMS of both errors with the fitted parameters. `chi`: RMS of the errors with the fitted
        parameters, divided by their standard deviation due to sensor noise. The dict is empty
        without held-out poses.
    """
    if not heldout_poses:
        return {}
    from hydrotele.calibrate.arm_identification import StageEquations

    rows: dict[str, list] = {"nominal": [], "identified": []}
    chi = []
    for poses in heldout_poses:
        equations = StageEquations(loop, poses)
        for name, numbers in (("nominal", fit.start_parameters), ("identified", fit.parameters)):
            error = equations.residual(numbers)
            rows[name].append(error - error.mean(axis=0) if name == "nominal" else error)
        chi.append(stage_residuals(loop, poses, fit.parameters))
    rms = {f"rms_{k}_mm": 1e3 * float(np.sqrt(np.mean(np.concatenate(v) ** 2)))
           for k, v in rows.items()}  # fmt: skip
    return {"poses": sum(map(len, heldout_poses)), **rms,
            "chi": float(np.sqrt(np.mean(np.concatenate(chi) ** 2)))}  # fmt: skip


def arm_result_to_dict(result: ArmResult) -> dict[str, Any]:
    """Return an arm calibration in the form of `calibration.json`.

    Parameters are in SI units. RMS errors are in mm and errors of corrupted sensors in deg, as the
    suffixes `_mm` and `_deg` of their keys state.
    """
    fit = result.fit
    rows = [
        {
            "name": name, "unit": unit_of(name), "nominal": fit.start_parameters[name],
            "value": float(value), "standard_deviation": float(deviation),
            "interval": [float(low), float(high)],
        }
        for name, value, deviation, (low, high) in zip(
            fit.names, fit.values, fit.standard_deviations, fit.intervals, strict=True
        )
    ]  # fmt: skip
    stages = [
        {
            "link": s.link, "poses": s.poses, "iterations": s.iterations, "rms_mm": 1e3 * s.rms,
            "chi": s.chi, "condition": s.condition, "identified": list(s.names),
            "not_identified": dict(s.hold_reasons),
        }
        for s in fit.stages
    ]  # fmt: skip
    regions = [
        {
            "link": r.link, "first_pose": r.first, "last_pose": r.last,
            "joint": r.joint or f"{r.link} (the arm's own sensor)", "possible": list(r.possible),
            "size_deg": float(np.degrees(r.size)), "left_out": bool(r.joint),
        }
        for r in result.regions
    ]  # fmt: skip
    bend = result.flexibility
    flexibility = bend and {
        "at_full_load_rad": dict(zip(bend.joints, bend.at_full_load.tolist(), strict=True)),
        "log_likelihood_gain": bend.log_likelihood_gain,
    }  # fmt: skip
    return to_json_types({
        "machine": fit.nominal.machine, "method": fit.method, "parameters": rows,
        "flexibility": flexibility,
        "stages": stages, "bad_data": regions, "heldout": dict(result.heldout_errors),
        "links_without_log": _find_links_without_motion(fit), "notes": _list_fit_warnings(fit),
    })  # fmt: skip


def _find_links_without_motion(fit: ArmFit) -> dict[str, list[str]]:
    """Return {link that moves in no log: its parameters, which keep their nominal values}."""
    moved = {stage.link for stage in fit.stages}
    return {
        link: [f"{kind}.{link}" for kind in ("alpha", "a", "beta" if parallel else "d")]
        for link, parallel in zip(
            fit.nominal.links[: fit.nominal.powered_count], fit.nominal.parallel, strict=False
        )
        if link not in moved
    }  # fmt: skip


def _list_fit_warnings(fit: ArmFit) -> list[str]:
    said = [
        f"residuals of {s.link} are {s.chi:.1f} times the sensor noise: held links move, joints"
        " bend, or a sensor is worse than stated; the intervals are enlarged by this factor"
        for s in fit.stages
        if s.chi > _MAX_RESIDUAL_RATIO
    ]
    for link, names in _find_links_without_motion(fit).items():
        said.append(f"{link} moves in no log: {', '.join(names)} keep their nominal values")
    return said


def _print_arm_document(document: Mapping[str, Any]) -> None:
    shown = make_table(f"{document['machine']}: {document['method']} identification", "parameter", "nominal",
                  "identified", "95 % +-", "unit")  # fmt: skip
    for row in document["parameters"]:
        degrees = row["unit"] == "rad"
        scale = np.degrees(1.0) if degrees else 1.0
        shown.add_row(
            row["name"], f"{scale * row['nominal']:.4f}", f"{scale * row['value']:.4f}",
            f"{1.96 * scale * row['standard_deviation']:.4f}", "deg" if degrees else "m",
        )  # fmt: skip
    stdout_console.print(shown)
    for stage in document["stages"]:
        stdout_console.print(f"{stage['link']}: {stage['poses']} poses, {stage['iterations']} iterations, RMS"
                  f" {stage['rms_mm']:.2f} mm, {stage['chi']:.2f} times sensor noise")  # fmt: skip
        for name, reason in stage["not_identified"].items():
            stdout_console.print(f"  {name} {reason}", style="dim")
    if document["flexibility"]:
        bends = document["flexibility"]["at_full_load_rad"].items()
        text = ", ".join(f"{name} {np.degrees(value):.3f}" for name, value in bends)
        stdout_console.print(f"angle errors of flexible joints at full load, standard deviation [deg]: {text}")
    for region in document["bad_data"]:
        stdout_console.print(f"[yellow]bad data[/] {region['link']}, poses {region['first_pose']} to"
                  f" {region['last_pose']}: {region['joint']}, {region['size_deg']:.2f} deg"
                  )  # fmt: skip
    if document["heldout"]:
        held = document["heldout"]
        stdout_console.print(f"{held['poses']} held-out poses: RMS closure error"
                  f" {held['rms_nominal_mm']:.1f} mm with nominal and"
                  f" {held['rms_identified_mm']:.2f} mm with identified parameters")  # fmt: skip
    for note in document["notes"]:
        stdout_console.print(note)


def print_output_folder(target: Path | None) -> None:
    """Print the output folder of a calibration and the file of the calibrated machine; nothing for None."""
    if target:
        stdout_console.print(f"written to [bold]{target}[/]; the calibrated machine is {target}/{MACHINE_FILE}")


def write_calibration_folder(
    target: Path, kind: str, document: Mapping[str, Any], machine: Machine, write_report
) -> None:
    """Write the results of an arm or linkage calibration to a folder, completely or not at all.

    Args:
        target: output folder.
        kind: kind of the folder, a key of `OUTPUT_FILES`.
        document: content of `calibration.json`.
        machine: calibrated machine, written as `machine.yaml`.
        write_report: function of the folder that writes the report into it.
    """
    with atomic_folder(target, kind) as folder:
        write_json(folder / "calibration.json", document)
        save_machine(machine, folder / MACHINE_FILE)
        write_report(folder)
        summary = {"kind": kind, "hydrotele": hydrotele.__version__}
        write_json(folder / "summary.json", summary)


def write_arm_report(folder: Path, result: ArmResult) -> None:
    """Write `report.html` of an arm calibration into a folder."""
    from hydrotele.show import calibration_report

    path = folder / "report.html"
    calibration_report.write_arm_report(result.fit, result.stages, result.regions, path)


def design_calibrator(machine: str, accuracy_deg: float, target: Path | None, as_json: bool) -> None:
    """Search for the calibrator whose arm calibration gives the smallest error of the arm's tip; print it.

    The design variables are both link lengths and the position of the ball joint on the chassis.
    The present and the best design are printed. With a target, a grid of link lengths is drawn with
    both designs, and all are written as JSON.

    Args:
        machine: machine with a calibrator, as a shipped name or a folder.
        accuracy_deg: error bound of an angle sensor [deg].
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Raises:
        InputError: machine or target are not usable.
    """
    from hydrotele.calibrate.calibrator_design import evaluate_design_grid, optimize_design

    if target:
        check_output_folder(target, _DESIGN_KIND)
    nominal = load_machine(machine)
    loop = build_loop(nominal)
    with show_stages("calibrate design", as_json) as progress:
        report = progress or ignore_stage
        report("evaluate the designs of a grid", 0.0)
        survey = evaluate_design_grid(loop, float(np.radians(accuracy_deg)))
        report("optimise the best design", 0.5)
        best = optimize_design(loop, survey, float(np.radians(accuracy_deg)))
    said = to_json_types({
        "machine": machine, "present": survey.present._asdict(), "best": best._asdict(),
        "designs": [d._asdict() for d in survey.designs],
    })  # fmt: skip
    if target:
        from hydrotele.show.calibration_report import draw_designs

        with atomic_folder(target, _DESIGN_KIND) as folder:
            (folder / "design.png").write_bytes(draw_designs(survey, best))
            write_json(folder / "calibration.json", said)
            summary = {"kind": _DESIGN_KIND, "hydrotele": hydrotele.__version__}
            write_json(folder / "summary.json", summary)
    if as_json:
        print_json(said)
        return
    for name, one in (("present", survey.present), ("best", best)):
        stdout_console.print(f"{name}: arm {one.arm:.2f} m, forearm {one.forearm:.2f} m, ball joint"
                  f" {one.ball_x:.2f} m"
                  f" in front at height {one.ball_z:+.2f} m: tip error"
                  f" {1e3 * one.tip_error:.1f} mm, {100 * one.reached:.0f} % of the poses reached"
                  )  # fmt: skip

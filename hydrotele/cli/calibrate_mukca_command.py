"""Implement `hydrotele calibrate mukca`: calibrate a serial robot whose ball tool is held in fixed sockets."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.estimation import estimate_combinations, list_identifiability
from hydrotele.calibrate.socket_calibration import (
    HeldOutPrediction,
    Outlier,
    SocketCalibration,
    SocketErrors,
    SocketOptions,
    calibrate_sockets,
    check_robot_fits_sockets,
    choose_robot,
    list_names_to_hold_out,
    predict_held_out_place,
)
from hydrotele.calibrate.socket_measurement import Socket, find_idle_joints, load_sockets, place_names
from hydrotele.cli.console import (
    ignore_stage,
    make_table,
    print_json,
    show_stages,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.cli.option_values import check_range
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.identify.identifiability import STATUS_FULL
from hydrotele.kinematics.serial_robot import SerialRobot, expand_mimic_joints
from hydrotele.kinematics.serial_robot_files import load_robot, robot_to_yaml, write_origins_to_urdf

_ROBOT_FILES = ("robot.yaml", "robot.yml", "*.urdf", "*.xml")
MAX_SOCKET_DISTANCE = 10_000.0  # mm: larger than the reach of a robot
_MAX_PRINTED_ROWS, _MAX_TEXT_LENGTH = (
    25,
    60,
)  # rows of the printed table, and characters of a combination


@dataclass(frozen=True)
class SocketChoices:
    """Options of `hydrotele calibrate mukca`.

    The tool that holds the sockets stands at several places, one after the other.

    Attributes:
        robot: shipped robot or file, None to find one.
        heldout: place or single socket that is held out, None for each place in turn.
        distance: distance of neighbouring sockets of the tool [m], 0 if not known.
        accuracy: standard deviation of that distance [m].
        unit: unit of the joint angles, `rad` or `deg`.
        model: joint model, None to select the most accurate one.
    """

    robot: str | None = None
    heldout: str | None = None
    distance: float = 0.050
    accuracy: float = 5.0e-5
    unit: str = "rad"
    model: str | None = None


def calibrate_mukca(data: Path, choices: SocketChoices, target: Path | None, as_json: bool) -> dict[str, Any]:
    """Calibrate a serial robot from joint angles while its ball tool sits in fixed sockets.

    The result is printed and written, with predictions of held-out places.

    Args:
        data: folder with one subfolder for each place of the tool that holds the sockets, and in it
            one CSV file of joint angles per socket.
        choices: options of the calibration.
        target: output folder, written completely or not at all; None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        The result in the form of `calibration.json`.

    Raises:
        InputError: data, robot or target are not usable.
    """
    if choices.unit not in ("rad", "deg"):
        raise InputError(f"--unit {choices.unit}", "must be rad or deg")
    check_range("--distance", 1e3 * choices.distance, 0.0, MAX_SOCKET_DISTANCE, "distance [mm]")
    check_range("--accuracy", 1e3 * choices.accuracy, 1e-6, MAX_SOCKET_DISTANCE, "standard deviation [mm]")
    if target is not None:
        check_output_folder(target, "robot calibration")
    sockets, notes = load_sockets(data, choices.unit == "deg")
    options = SocketOptions(choices.distance or None, choices.accuracy, choices.model)
    robot, said = _load_or_choose_robot(data, choices.robot, sockets, options)
    sockets = tuple(replace(one, joints=expand_mimic_joints(robot, one.joints)) for one in sockets)
    check_robot_fits_sockets(robot, sockets, options)
    notes = [*said, *notes, *_identifiability_notes(robot, sockets, options)]
    left: list[HeldOutPrediction] = []
    with show_stages("calibrate mukca", as_json) as progress:
        report = progress or ignore_stage
        report("fit the robot", 0.0)
        if choices.heldout is not None:
            one, found = predict_held_out_place(robot, sockets, choices.heldout, options)
            left.append(one)
        else:
            found = calibrate_sockets(robot, sockets, options)
            names = list_names_to_hold_out(sockets)
            for number, name in enumerate(names, start=1):
                report(f"predict {name}, held out", number / (len(names) + 1))
                left.append(predict_held_out_place(robot, sockets, name, options)[0])
    document = socket_document(data, sockets, found, left, notes)
    if target is not None:
        with atomic_folder(target, "robot calibration") as folder:
            _write(folder, document, found, left)
    if as_json:
        print_json(document)
    else:
        _print(document, found, left)
        if target is not None:
            stdout_console.print(f"written to [bold]{target}[/]")
    return document


def socket_document(
    data: Path, sockets: Sequence[Socket], calibration: SocketCalibration, heldout_parts: Sequence[HeldOutPrediction],
    notes: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Return a calibration of a robot with its ball in sockets in the form of `calibration.json`.

    Errors and distances are in mm, parameters in SI units.

    Args:
        data: folder of the measurements.
        sockets: measured joint angles of each socket.
        calibration: result of the calibration with the fitted sockets.
        heldout_parts: predictions of held-out places or sockets, each by a calibration without it.
        notes: sentences for the user.
    """
    fit, angular = calibration.fit, ("r", "s", "c")
    status = dict(zip(fit.identifiability.names, fit.identifiability.status, strict=True))
    alone = {name for name, told in status.items() if told == STATUS_FULL}
    parameters = [
        {
            "name": name, "value": value, "unit": _parameter_unit(name, angular), "identifiability": status[name],
            "std": std if name in alone else None, "low": low if name in alone else None,
            "high": high if name in alone else None,
        }
        for name, value, std, (low, high) in zip(
            fit.names, fit.values, fit.standard_deviations, fit.intervals, strict=True
        )
    ]  # fmt: skip
    rows = {one.name: sum(len(r) for r in one.calibrated_errors.distances_by_socket.values()) for one in heldout_parts}
    return to_json_types(
        {
            "robot": calibration.nominal.name,
            "robot_file": calibration.nominal.source,
            "data": str(data),
            "places": list(place_names(sockets)),
            "rows": {s.name: len(s.joints) for s in sockets},
            "heldout": _heldout_document(heldout_parts, rows) if heldout_parts else None,
            "fitted": {
                "nominal_rms_mm": 1e3 * calibration.nominal_errors.rms,
                "rms_mm": 1e3 * calibration.calibrated_errors.rms,
                "rms_without_outliers_mm": 1e3 * calibration.calibrated_errors.rms_without_outliers,
                "socket_distance_mm": _convert_to_millimetres(calibration.calibrated_errors.socket_distances),
            },
            "distance_mm": None if calibration.options.distance is None else 1e3 * calibration.options.distance,
            "noise_mm": 1e3 * calibration.noise,
            "model": calibration.model,
            "model_errors_mm": _convert_to_millimetres(calibration.model_errors),
            "expected_sizes": calibration.sizes,
            "parameters": parameters,
            "effective_parameters": len(calibration.fit.residual) - calibration.fit.degrees_of_freedom,
            **list_identifiability(fit.identifiability),
            "identifiable_combinations": [asdict(one) for one in estimate_combinations(fit)],
            "outliers": _outlier_rows(calibration.outliers),
            "status": fit.status,
            "notes": list(notes),
        }
    )


def _heldout_document(heldout_parts: Sequence[HeldOutPrediction], rows: dict[str, int]) -> dict[str, Any]:
    def rms_over_parts(kind: str, what: str) -> float:
        squares = [getattr(getattr(one, f"{kind}_errors"), what) ** 2 * rows[one.name] for one in heldout_parts]
        return 1e3 * float(np.sqrt(np.sum(squares) / sum(rows.values())))

    distances = {k: v for one in heldout_parts for k, v in one.calibrated_errors.socket_distances.items()}
    return {
        "rms_mm": rms_over_parts("calibrated", "rms"),
        "rms_without_outliers_mm": rms_over_parts("calibrated", "rms_without_outliers"),
        "nominal_rms_mm": rms_over_parts("nominal", "rms"),
        "given_rms_mm": rms_over_parts("given", "rms"),
        "socket_distance_mm": _convert_to_millimetres(distances),
        "parts": {
            one.name: {
                "rms_mm": 1e3 * one.calibrated_errors.rms,
                "rms_without_outliers_mm": 1e3 * one.calibrated_errors.rms_without_outliers,
                "nominal_rms_mm": 1e3 * one.nominal_errors.rms,
                "sockets_mm": _convert_to_millimetres(one.calibrated_errors.rms_by_socket),
                "model": one.model,
                "outliers": _outlier_rows(one.calibrated_errors.outliers),
            }
            for one in heldout_parts
        },
    }


def _load_or_choose_robot(
    data: Path, robot_option: str | None, sockets: Sequence[Socket], options: SocketOptions
) -> tuple[SerialRobot, list[str]]:
    """Load the robot of the option, else the file in the data folder, else the shipped robot that fits best.

    Returns:
        The robot, and a note if it was not given by the option.
    """
    count = sockets[0].joints.shape[1]
    if robot_option is not None:
        return load_robot(robot_option, count), []
    inside = [path for pattern in _ROBOT_FILES for path in sorted(data.glob(pattern))]
    if inside:
        return load_robot(inside[0], count), [f"robot: {inside[0]}, found in the data folder"]
    robot, spreads = choose_robot(sockets)
    tried = ", ".join(f"{name} {1e3 * spread:.3g}" for name, spread in spreads.items())
    message = f"robot: {robot.name}, the shipped robot that fits best (scatter [mm]: {tried})"
    return robot, [message]


def _identifiability_notes(robot: SerialRobot, sockets: Sequence[Socket], options: SocketOptions) -> list[str]:
    notes = [
        f"{robot.joints[k].name} does not move in any file: its offset is identifiable only in"
        " combination with errors of the adjacent joints"
        for k in find_idle_joints(sockets)
    ]
    if options.distance is None:
        notes.append("no socket distance is given: the scale of the robot is not identifiable")
    elif all(s.hole == sockets[0].hole for s in sockets):
        notes.append("no place has two neighbouring sockets: the scale of the robot is not identifiable")
    return notes


def _write(
    folder: Path,
    document: dict[str, Any],
    calibration: SocketCalibration,
    heldout_parts: Sequence[HeldOutPrediction],
) -> None:
    from hydrotele.show.calibration_report import draw_socket_errors, write_robot_report

    write_json(folder / "calibration.json", document)
    source = f"calibrated by hydrotele {hydrotele.__version__} from {document['data']}"
    (folder / "calibrated.yaml").write_text(robot_to_yaml(calibration.robot, source), encoding="utf-8")
    origin = Path(calibration.nominal.source)
    if origin.suffix == ".urdf":
        made = write_origins_to_urdf(calibration.robot, read_text(origin))
        (folder / "calibrated.urdf").write_text(made, encoding="utf-8")
    picture = draw_socket_errors(calibration, heldout_parts)
    (folder / "sockets.png").write_bytes(picture)
    write_robot_report(folder / "report.html", document, picture)
    summary = {
        "kind": "robot calibration",
        "robot": document["robot"],
        "data": document["data"],
        "heldout": document["heldout"],
        "hydrotele": hydrotele.__version__,
    }
    write_json(folder / "summary.json", summary)


def _print(
    document: dict[str, Any],
    calibration: SocketCalibration,
    heldout_parts: Sequence[HeldOutPrediction],
) -> None:
    heading = f"{document['robot']}: RMS distance of the ball from its mean position in the socket (lower is better)"
    rows = make_table(heading, "held-out part", "nominal [mm]", "calibrated [mm]", "socket distance [mm]")
    for one in heldout_parts:
        apart = ", ".join(f"{1e3 * d:.3f}" for d in one.calibrated_errors.socket_distances.values())
        rows.add_row(
            one.name,
            _format_rms_mm(one.nominal_errors),
            f"[bold]{_format_rms_mm(one.calibrated_errors)}[/]",
            apart or "-",
        )
    if len(heldout_parts) > 1:
        whole = document["heldout"]
        rows.add_section()
        rows.add_row("all parts", f"{whole['nominal_rms_mm']:.3f}",
                     f"[bold]{whole['rms_mm']:.3f}[/]", "")  # fmt: skip
    rows.add_section()
    apart = ", ".join(f"{1e3 * d:.3f}" for d in calibration.calibrated_errors.socket_distances.values())
    rows.add_row(
        "(all data, fitted)",
        _format_rms_mm(calibration.nominal_errors),
        _format_rms_mm(calibration.calibrated_errors),
        apart or "-",
    )
    stdout_console.print(rows)
    errors = ", ".join(f"{name} {value:.4f}" for name, value in document["model_errors_mm"].items())
    stdout_console.print(f"joint model: [bold]{calibration.model}[/] (held-out error per coordinate [mm]: {errors})")
    _print_combinations(document)
    for outlier in document["outliers"]:
        stdout_console.print(
            f"[yellow]outlier[/] {outlier['socket']}, row {outlier['row']}:"
            f" {outlier['distance_mm']:.2f} mm from its socket, excluded from the fit"
        )
    for one in heldout_parts:
        for outlier in one.calibrated_errors.outliers:
            stdout_console.print(
                f"[yellow]outlier[/] {outlier.socket}, row {outlier.line}:"
                f" {1e3 * outlier.distance:.2f} mm from its socket in the held-out prediction, included in the RMS"
            )
    for note in document["notes"]:
        stdout_console.print(f"[yellow]note[/] {note}")


def _print_combinations(document: dict[str, Any]) -> None:
    units = {one["name"]: one["unit"] for one in document["parameters"]}
    title = "Identifiable parameters and combinations"
    rows = make_table(title, "parameter or combination", "value", "95 % +-", "unit")
    told = sorted(document["identifiable_combinations"], key=lambda one: len(one["text"]))
    for one in told[:_MAX_PRINTED_ROWS]:
        unit = units[one["text"].split()[0]]
        shown, factor = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(unit, (unit, 1.0))
        text = one["text"] if len(one["text"]) < _MAX_TEXT_LENGTH else f"{one['text'][:_MAX_TEXT_LENGTH]} ..."
        reach = f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        rows.add_row(text, f"{factor * one['value']:.4g}", reach, shown)
    stdout_console.print(rows)
    if len(told) > _MAX_PRINTED_ROWS:
        stdout_console.print(f"... and {len(told) - _MAX_PRINTED_ROWS} longer combinations; --out or --json lists all")
    stdout_console.print("not identifiable: " + (", ".join(document["not_identifiable"]) or "none"))


def _parameter_unit(name: str, angular: Sequence[str]) -> str:
    if name.startswith("sag."):
        return "rad s^2/m^2"
    return "rad" if name[0] in angular else "m"


def _format_rms_mm(errors: SocketErrors) -> str:
    return f"{1e3 * errors.rms:.3f}"


def _convert_to_millimetres(values: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * value for name, value in values.items()}


def _outlier_rows(outliers: Sequence[Outlier]) -> list[dict[str, Any]]:
    return [{"socket": one.socket, "row": one.line, "distance_mm": 1e3 * one.distance} for one in outliers]

"""Implement `hydrotele calibrate mukca`, `scara` and `hybrid`.

`mukca` calibrates a serial robot whose ball tool is held in fixed sockets. `scara` calibrates a
planar arm with two links from measured positions. `hybrid` calibrates a serial robot that carries a
hexapod (parallel robot with six legs).
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.estimation import estimate_combinations, list_identifiability
from hydrotele.calibrate.hybrid import (
    Calibration,
    PoseErrors,
    calibrate_best_model,
    calibrate_hybrid_robot,
    pose_errors,
    restrict_to_fitted_parameters,
    select_informative_poses,
)
from hydrotele.calibrate.hybrid_data import (
    HELDOUT_STEM,
    POSES_STEM,
    find_robot_file,
    format_measurement_yaml,
    measurement_from_wires,
    read_measurement,
    save_measurement,
)
from hydrotele.calibrate.mukca import (
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
from hydrotele.calibrate.posterior import (
    MAX_STEPS,
    MIN_STEPS,
    EvolutionResult,
    Posterior,
    minimize_by_evolution,
    sample_posterior,
)
from hydrotele.calibrate.scara import (
    ScaraSpec,
    calibrate_scara,
    load_scara,
    save_scara,
    select_scara_poses,
    simulate_scara,
)
from hydrotele.calibrate.sockets import Socket, find_idle_joints, load_sockets, place_names
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
from hydrotele.kinematics.hybrid import (
    HybridRobot,
    UnreachableError,
    build_error_model,
    forward_kinematics,
    load_hybrid,
    refined_model_parameters,
    save_hybrid,
)
from hydrotele.kinematics.serial_robot import (
    SerialRobot,
    expand_mimic_joints,
    load_robot,
    robot_to_yaml,
    write_origins_to_urdf,
)
from hydrotele.kinematics.wires import NoIntersectionError, wire_lengths

_ROBOT_FILES = ("robot.yaml", "robot.yml", "*.urdf", "*.xml")
MAX_SOCKET_DISTANCE = 10_000.0  # mm: larger than the reach of a robot
MAX_SCARA_NOISE = 100.0  # mm: a larger position error is not noise for links of 0.4 and 0.3 m
_EXAMPLE = ScaraSpec(length_a=0.4, length_b=0.3)
_EXAMPLE_ERRORS = (
    0.0,
    0.8e-3,
    0.0,
    -0.5e-3,
)  # errors of the simulated arm: lengths only, as in Eq. 2
_MAX_PRINTED_ROWS, _MAX_TEXT_LENGTH = (
    25,
    60,
)  # rows of the printed table, and characters of a combination


@dataclass(frozen=True)
class SocketChoices:
    """Options of `hydrotele calibrate mukca`.

    Attributes:
        robot: shipped robot or file, None to find one.
        heldout: held-out place or socket, None for each place in turn.
        distance: distance of neighbouring sockets [m], 0 if not known.
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
        data: folder with a subfolder for each place of the sockets; it has one CSV file per socket.
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
        calibration: calibration from the fitted sockets.
        heldout_parts: predictions of held-out places or sockets.
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
                f" {1e3 * outlier.distance:.2f} mm from its socket in the held-out prediction,"
                " included in the RMS"
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


def simulate_scara_to_folder(folder: Path, poses: int, noise: float, seed: int) -> None:
    """Write simulated measurements of a planar arm with two links of nominally 0.4 m and 0.3 m.

    The first link is 0.8 mm longer and the second one 0.5 mm shorter than nominal.

    Args:
        folder: folder to write.
        poses: number of poses.
        noise: standard deviation of the positions [m].
        seed: random seed of poses and noise.

    Raises:
        InputError: the folder is not empty.
    """
    check_range("--seed", seed, 0, MAX_SEED, "random seed")
    check_range("--noise", 1e3 * noise, 0.0, MAX_SCARA_NOISE, "standard deviation [mm]")
    check_range("--poses", poses, 4, MAX_POSES, "number of poses")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(folder, "exists; give another folder to --simulate")
    save_scara(folder, _EXAMPLE, simulate_scara(_EXAMPLE, _EXAMPLE_ERRORS, poses, noise, seed))


def calibrate_scara_to_folder(
    data: Path, heldout: str | None, choose: int | None, target: Path | None, as_json: bool
) -> dict[str, Any]:
    """Calibrate the link lengths of a planar SCARA arm from measured positions; print and write them.

    Args:
        data: folder with `nominal.yaml` and `measured.csv`.
        heldout: numbers of the held-out poses, from 1, separated by commas; None for each in turn.
        choose: number of most informative poses to list, None for none.
        target: output folder, written completely or not at all; None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        The result in the form of `calibration.json`.

    Raises:
        InputError: data or target are not usable.
    """
    if target is not None:
        check_output_folder(target, "robot calibration")
    nominal, measured = load_scara(data)
    judged = _parse_pose_numbers(heldout, len(measured.joints))
    found = calibrate_scara(nominal, measured, judged)
    fit = found.fit
    start = {"length.a": nominal.length_a, "length.b": nominal.length_b}
    document = to_json_types(
        {
            "data": str(data),
            "poses": len(measured.joints),
            "heldout": {
                "rms_mm": 1e3 * found.heldout_rms,
                "nominal_rms_mm": 1e3 * found.nominal_rms,
                "poses": [k + 1 for k in judged] or "each in turn",
            },
            "model": "lengths and offsets" if found.has_offsets else "lengths",
            "model_errors_mm": {name: 1e3 * error for name, error in found.model_errors.items()},
            "noise_mm": 1e3 * fit.noise,
            "parameters": [
                {"name": name, "nominal": start.get(name, 0.0), "value": value, "std": std,
                 "low": low, "high": high, "unit": "m" if name.startswith("length") else "rad"}
                for name, value, std, (low, high) in zip(
                    fit.names, fit.values, fit.standard_deviations, fit.intervals, strict=True)
            ],
            **list_identifiability(fit.identifiability),
            "status": fit.status,
        }
    )  # fmt: skip
    if choose is not None:
        chosen = select_scara_poses(nominal, measured, choose)
        document["best_poses"] = sorted(k + 1 for k in chosen.chosen)
    if target is not None:
        with atomic_folder(target, "robot calibration") as folder:
            write_json(folder / "calibration.json", document)
            summary = {
                "kind": "robot calibration",
                "data": document["data"],
                "heldout": document["heldout"],
                "hydrotele": hydrotele.__version__,
            }
            write_json(folder / "summary.json", summary)
    if as_json:
        print_json(document)
    else:
        _print_scara(document)
        if target is not None:
            stdout_console.print(f"written to [bold]{target}[/]")
    return document


def _parse_pose_numbers(heldout: str | None, count: int) -> list[int]:
    if heldout is None:
        return []
    words = heldout.split(",")
    if not all(word.strip().isdigit() and 1 <= int(word) <= count for word in words):
        raise InputError(f"--heldout {heldout}", f"must be numbers of poses from 1 to {count}")
    return sorted({int(word) - 1 for word in words})


def _print_scara(document: dict[str, Any]) -> None:
    rows = make_table(f"{document['poses']} poses, model: {document['model']}", "parameter", "nominal",
                 "calibrated", "95 % +-", "unit")  # fmt: skip
    for one in document["parameters"]:
        unit = {"m": "mm", "rad": "mrad"}[one["unit"]]
        if one["std"] is None:
            rows.add_row(one["name"], f"{1e3 * one['nominal']:.4f}", "-", "not identifiable", unit)
            continue
        rows.add_row(one["name"], f"{1e3 * one['nominal']:.4f}", f"{1e3 * one['value']:.4f}",
                     f"{0.5e3 * (one['high'] - one['low']):.4f}", unit)  # fmt: skip
    stdout_console.print(rows)
    judged = document["heldout"]
    stdout_console.print(f"held-out position error: [bold]{judged['rms_mm']:.4f} mm[/] RMS"
              f" (nominal {judged['nominal_rms_mm']:.4f} mm)")  # fmt: skip
    if "best_poses" in document:
        stdout_console.print("most informative poses: " + ", ".join(map(str, document["best_poses"])))
    for text in document["combinations"]:
        stdout_console.print(f"[yellow]identifiable only as a combination[/] {text}")
    if document["not_identifiable"]:
        stdout_console.print("[yellow]not identifiable[/] " + ", ".join(document["not_identifiable"]))


KIND = "hybrid calibration"
MEASUREMENT = "hybrid measurement"
CRITERIA = ("D", "O1", "O2", "O3", "O4", "O5")
MAX_SEED = 2**32 - 1  # of NumPy's RandomState, which emcee uses
MAX_ERROR_FACTOR = 50.0  # of 1 mm and 1 mrad: with larger errors the legs do not reach the poses
MAX_NOISE_FACTOR = 1000.0  # of 0.01 mm: larger noise is not that of a sensor
MAX_POSES = 100_000  # poses: 100 MB of equations
CANDIDATES = 200  # number of random poses from which the most informative are selected
SENSOR_NOISE = {
    "leg": 1e-5,
    "prismatic": 1e-5,
    "revolute": 2e-5,
    "wire": 2e-5,
}  # m, rad: models/iwr/README.md
SEARCH_BOX_SIGMAS = 8.0  # half width of the search box, in expected sizes of the manufacturing errors


def calibrate_hybrid(
    data: Path, robot: str | None, error_model: str, parameters: str, evolution: bool, mcmc_steps: int,
    seed: int, target: Path | None, as_json: bool,
) -> Calibration:  # fmt: skip
    """Calibrate a serial robot that carries a hexapod from measured poses; print and write the result.

    Args:
        data: folder with `poses.csv` or `poses.parquet`.
        robot: nominal robot, None for that of the folder, else `iwr`.
        error_model: error model: `dh` (Denavit-Hartenberg), `poe` (product of exponentials) or `auto`.
        parameters: `all`, `document` (the 36 of Wang 2012) or names separated by commas.
        evolution: whether to search by differential evolution as well.
        mcmc_steps: number of MCMC steps, 0 for no MCMC.
        seed: random seed of differential evolution and MCMC.
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        The calibration.

    Raises:
        InputError: the folder, the robot or an option is not usable.
    """
    if error_model not in ("auto", "dh", "poe"):
        raise InputError(f"--model {error_model}", "valid: auto, dh, poe")
    check_range("--seed", seed, 0, MAX_SEED, "random seed")
    if mcmc_steps:
        check_range("--posterior", mcmc_steps, MIN_STEPS, MAX_STEPS, "number of MCMC steps")
    if target:
        check_output_folder(target, KIND)
    nominal = load_hybrid(robot or find_robot_file(Path(data)) or "iwr")
    measurement, heldout = read_measurement(data, nominal)
    names = _parse_parameter_names(nominal, error_model, parameters)
    with show_stages("calibrate hybrid", as_json) as progress:
        report = progress or ignore_stage
        report("fit the robot", 0.0)
        if error_model == "auto":
            done = calibrate_best_model(nominal, measurement, names)
        else:
            done = calibrate_hybrid_robot(nominal, measurement, "dh" if error_model == "dh" else "poe", names)
        report("differential evolution", 0.3)
        evolved = _run_evolution(done, seed) if evolution else None
        report("MCMC", 0.6)
        posterior = _run_mcmc(done, mcmc_steps, seed) if mcmc_steps else None
    result = _hybrid_document(data, done, heldout, evolved, posterior)
    if target:
        with atomic_folder(target, KIND) as folder:
            _write_hybrid_files(folder, result, done, heldout, posterior)
    if as_json:
        print_json(result)
    else:
        _print_hybrid(result)
        if target:
            stdout_console.print(f"written to [bold]{target}[/]; robot.yaml there is the calibrated robot")
    return done


def _parse_parameter_names(nominal: HybridRobot, kind: str, parameters: str) -> tuple[str, ...] | None:
    if parameters == "all":
        return None
    model = build_error_model(nominal, "poe" if kind == "poe" or not nominal.specification.carriage else "dh")
    if parameters == "document":
        return refined_model_parameters(model)
    names = tuple(name.strip() for name in parameters.split(","))
    model.parameter_indices(names)
    return names


def _run_evolution(calibration: Calibration, seed: int) -> EvolutionResult:
    eq = restrict_to_fitted_parameters(calibration)
    return minimize_by_evolution(
        eq.negative_log_likelihood,
        -SEARCH_BOX_SIGMAS * eq.scales,
        SEARCH_BOX_SIGMAS * eq.scales,
        seed=seed,
    )


def _run_mcmc(calibration: Calibration, steps: int, seed: int) -> Posterior:
    eq, fit = restrict_to_fitted_parameters(calibration), calibration.fit
    free = ~fit.held
    noise = 1.0 if calibration.equations.measurement.noise_is_known else fit.noise
    return sample_posterior(
        lambda x: -eq.negative_log_likelihood(x) / noise**2, fit.values[free],
        fit.covariance[np.ix_(free, free)], eq.names, steps=steps, burn_in=steps // 4, seed=seed,
    )  # fmt: skip


def _hybrid_document(data, calibration: Calibration, heldout, evolved, posterior) -> dict[str, Any]:
    fit, model = calibration.fit, calibration.model
    held = dict(zip(fit.names, fit.held, strict=True))
    values = dict(zip(fit.names, fit.values, strict=True))
    deviations = dict(zip(fit.names, fit.standard_deviations, strict=True))
    intervals = dict(zip(fit.names, fit.intervals, strict=True))
    weak = [n for n in fit.names if not held[n] and n not in calibration.redundancy.determined_names]
    result: dict[str, Any] = {
        "robot": model.nominal.name, "data": str(data), "hydrotele": hydrotele.__version__,
        "model": model.kind, "poses": len(calibration.equations.measurement),
        "excluded_poses": list(calibration.inconsistent_rows),
        "noise": "stated" if calibration.equations.measurement.noise_is_known else "estimated",
        "chi": fit.chi, "degrees_of_freedom": fit.degrees_of_freedom, "iterations": fit.iterations,
        "converged": fit.converged, "status": fit.status, "warnings": list(calibration.warnings),
        "redundancy": {
            "parameters": len(fit.names), "rank": calibration.redundancy.rank,
            "redundant": list(calibration.redundancy.held_names),
            "involved": list(calibration.redundancy.redundant_names),
            "explanations": list(calibration.redundancy.explanations),
            "identifiable_at_noise": len(calibration.redundancy.determined_names),
            "poorly_identifiable": weak,
            "singular_values": calibration.redundancy.singular_values,
        },
        "not_identifiable": [n for n in fit.names if held[n]],
        "errors": {"before": calibration.nominal_errors.summarize(), "after": calibration.calibrated_errors.summarize(),
                   "leave_one_out": calibration.leave_one_out_errors.summarize()},
        "parameters": [
            {"name": name, "description": words, "unit": unit, "identified": not held[name],
             "value": values[name], "standard_deviation": deviations[name],
             "interval_95": intervals[name]}
            for name, words, unit in zip(model.names, model.descriptions, model.units, strict=True)
            if name in held
        ],
    }  # fmt: skip
    if heldout is not None:
        after, before = pose_errors(calibration.robot, heldout), pose_errors(model.nominal, heldout)
        result["heldout"] = _hybrid_heldout_document(len(heldout), before, after)
    free = ~fit.held
    if evolved is not None:
        away = np.abs(evolved.values - fit.values[free]) / fit.standard_deviations[free]
        result["evolution"] = {
            "generations": evolved.generations, "evaluations": evolved.evaluations,
            "converged": evolved.converged, "misfit": evolved.cost,
            "misfit_least_squares": float(
                restrict_to_fitted_parameters(calibration).negative_log_likelihood(fit.values[free][None])[0]),
            "max_difference_in_std": float(away.max()),
            "values": dict(zip(restrict_to_fitted_parameters(calibration).names, evolved.values.tolist(), strict=True)),
        }  # fmt: skip
    if posterior is not None:
        away = np.abs(posterior.mean - fit.values[free]) / fit.standard_deviations[free]
        result["posterior"] = {
            "converged": posterior.converged, "status": posterior.status,
            "steps": posterior.steps, "evaluations": posterior.evaluations,
            "acceptance": posterior.acceptance_fraction,
            "max_autocorrelation_time": posterior.autocorrelation.max(),
            "max_split_rhat": posterior.rhat.max(),
            "min_effective_size": posterior.effective_size.min(),
            "max_difference_in_std": float(away.max()),
            "parameters": [
                {"name": n, "mean": m, "standard_deviation": s, "interval_95": i,
                 "split_rhat": r, "effective_size": e}
                for n, m, s, i, r, e in zip(posterior.names, posterior.mean, posterior.standard_deviations,
                                            posterior.intervals, posterior.rhat,
                                            posterior.effective_size, strict=True)
            ],
        }  # fmt: skip
    return result


def _hybrid_heldout_document(count: int, before: PoseErrors, after: PoseErrors) -> dict[str, Any]:
    had, has = before.summarize(), after.summarize()
    return {
        "poses": count, "rms_mm": has["position_rms_mm"], "max_mm": has["position_max_mm"],
        "orientation_rms_mrad": has["orientation_rms_mrad"],
        "orientation_max_mrad": has["orientation_max_mrad"],
        "before_rms_mm": had["position_rms_mm"], "before_max_mm": had["position_max_mm"],
    }  # fmt: skip


def _write_hybrid_files(folder: Path, result, calibration: Calibration, heldout, posterior) -> None:
    from hydrotele.show.calibration_report import draw_pose_errors, draw_posterior

    write_json(folder / "calibration.json", result)
    save_hybrid(calibration.robot, folder / "robot.yaml", "calibrated by hydrotele calibrate hybrid")
    before, after, what = (
        calibration.nominal_errors,
        calibration.leave_one_out_errors,
        "poses, leave-one-out predictions",
    )
    if len(before.position) != len(after.position):
        after, what = calibration.calibrated_errors, "fitted poses"
    if heldout is not None:
        before, after = (
            pose_errors(calibration.model.nominal, heldout),
            pose_errors(calibration.robot, heldout),
        )
        what = "held-out poses"
    picture = draw_pose_errors(
        {"position [mm]": (1e3 * before.position, 1e3 * after.position),
         "orientation [mrad]": (1e3 * before.orientation, 1e3 * after.orientation)}, what,
    )  # fmt: skip
    (folder / "errors.png").write_bytes(picture)
    if posterior is not None:
        place = np.argsort(-np.abs(posterior.correlation - np.eye(len(posterior.names))).max(0))[:6]
        chosen = np.sort(place)
        sizes = [1e-3] * len(chosen)
        truth = calibration.fit.values[[calibration.fit.names.index(posterior.names[k]) for k in chosen]]
        image = draw_posterior(posterior.flat_sample[:, chosen] / sizes, [posterior.names[k] for k in chosen],
                       truth / sizes, "least squares")  # fmt: skip
        (folder / "posterior.png").write_bytes(image)
    summary = {"kind": KIND, "name": result["robot"], "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def _print_hybrid(result: dict[str, Any]) -> None:
    errors, told = result["errors"], result["redundancy"]
    shown = make_table(f"{result['robot']}: {result['poses']} poses, model {result['model']}",
                  "pose errors (lower is better)", "RMS mm", "max mm", "RMS mrad")  # fmt: skip
    rows = [("nominal", errors["before"]), ("calibrated", errors["after"]),
            ("leave-one-out prediction", errors["leave_one_out"])]  # fmt: skip
    for name, e in rows:
        shown.add_row(name, f"{e['position_rms_mm']:.3f}", f"{e['position_max_mm']:.3f}",
                      f"{e['orientation_rms_mrad']:.3f}")  # fmt: skip
    if "heldout" in result:
        h = result["heldout"]
        shown.add_row(f"{h['poses']} held-out poses, nominal", f"{h['before_rms_mm']:.3f}",
                      f"{h['before_max_mm']:.3f}", "")  # fmt: skip
        shown.add_row(f"{h['poses']} held-out poses, calibrated", f"{h['rms_mm']:.3f}",
                      f"{h['max_mm']:.3f}", f"{h['orientation_rms_mrad']:.3f}")  # fmt: skip
    stdout_console.print(shown)
    stdout_console.print(
        f"{told['parameters']} parameters, {told['rank']} independent; noise {result['noise']};"
        f" ratio of residuals to noise {result['chi']:.2f}"
    )
    for words in told["explanations"][:12]:
        stdout_console.print(f"  {words}")
    if result["not_identifiable"]:
        stdout_console.print(f"kept at their nominal values: {', '.join(result['not_identifiable'])}")
    if told["poorly_identifiable"]:
        names = ", ".join(told["poorly_identifiable"])
        stdout_console.print(f"poorly identifiable at this noise: {names}")
    if result["excluded_poses"]:
        rows_ = ", ".join(map(str, result["excluded_poses"]))
        stdout_console.print(f"excluded, because their measurements fit no calibration: rows {rows_}")
    for words in result["warnings"]:
        stdout_console.print(f"[yellow]warning[/] {words}")
    for key, name in (("evolution", "differential evolution"), ("posterior", "MCMC")):
        if key in result:
            one = result[key]
            said = one.get("status", "converged" if one["converged"] else "not converged")
            away = one["max_difference_in_std"]
            stdout_console.print(
                f"{name}: {said}; differs from least squares by at most {away:.2f} standard deviations"
            )


def simulate_hybrid_to_folder(
    target: Path, robot: str | None, poses: int, heldout: int, seed: int, noise: float,
    errors: float, parameters: str, error_model: str, choose: str = "random",
) -> None:  # fmt: skip
    """Simulate the measurement of a hexapod-carrying robot with manufacturing errors; write it to a folder.

    The true errors and the true robot are written to the subfolder `truth`.

    Args:
        target: output folder.
        robot: nominal robot, None for `iwr`.
        poses: number of poses for the calibration.
        heldout: number of held-out poses.
        seed: random seed of errors, poses and noise.
        noise: factor on the noise of all sensors.
        errors: factor on the manufacturing errors of 1 mm and 1 mrad.
        parameters: parameters with errors: `all`, `document` or names separated by commas.
        error_model: error model of the simulated errors: `auto`, `dh` or `poe`.
        choose: `random` poses, or a criterion of `select_informative_poses`.

    Raises:
        InputError: the folder cannot be written, or an option is not usable.
    """
    from hydrotele.kinematics.hybrid import apply_geometry_errors
    from hydrotele.simulate.hybrid import (
        default_wires,
        sample_manufacturing_errors,
        sample_poses,
        simulate_measured_poses,
    )

    if choose not in ("random", *CRITERIA):
        raise InputError(f"--choose {choose}", f"valid: random, {', '.join(CRITERIA)}")
    check_range("--seed", seed, 0, MAX_SEED, "random seed")
    check_range("--errors", errors, 0.0, MAX_ERROR_FACTOR, "factor on errors of 1 mm and 1 mrad")
    check_range("--noise", noise, 0.0, MAX_NOISE_FACTOR, "factor on the noise of the sensors")
    check_range("--poses", poses, 1, MAX_POSES, "number of poses")
    check_range("--heldout", heldout, 0, MAX_POSES, "number of poses")
    check_output_folder(target, MEASUREMENT)
    nominal = load_hybrid(robot or "iwr")
    error_model = (
        "dh"
        if error_model == "auto" and nominal.specification.carriage
        else "poe"
        if error_model == "auto"
        else error_model
    )
    names = _parse_parameter_names(nominal, error_model, parameters)
    model = build_error_model(nominal, "dh" if error_model == "dh" else "poe")
    rng, wires = np.random.default_rng(seed), default_wires()
    planted = sample_manufacturing_errors(model, rng, names, errors)
    true = apply_geometry_errors(model, planted)
    sizes = {key: noise * size for key, size in SENSOR_NOISE.items()}
    stated = sizes if noise > 0.0 else {}
    with atomic_folder(target, MEASUREMENT) as folder:
        for stem, count in ((POSES_STEM, poses), (HELDOUT_STEM, heldout)):
            if count:
                joints, legs = sample_poses(nominal, count, rng, wires)
                if stem == POSES_STEM and choose != "random":
                    joints, legs = _sample_informative_poses(model, wires, count, rng, choose)
                try:
                    read = simulate_measured_poses(true, joints, legs, wires, sizes, rng)
                except (UnreachableError, NoIntersectionError) as error:
                    raise InputError(
                        f"--errors {errors:g} --noise {noise:g}", f"{error}: reduce the errors or the noise"
                    ) from None
                save_measurement(folder, stem, nominal, read.joints, read.legs, wires=read.wires)
        (folder / "measurement.yaml").write_text(format_measurement_yaml(nominal.name, wires, stated))
        save_hybrid(nominal, folder / "robot.yaml", "nominal robot")
        (folder / "truth").mkdir()
        save_hybrid(true, folder / "truth" / "robot.yaml", "the robot that was simulated")
        text = json.dumps(dict(zip(model.names, planted.tolist(), strict=True)), indent=2)
        (folder / "truth" / "errors.json").write_text(text + "\n", encoding="utf-8")
        summary = {"kind": MEASUREMENT, "name": nominal.name, "hydrotele": hydrotele.__version__}
        write_json(folder / "summary.json", summary)
    stdout_console.print(f"written to [bold]{target}[/]: {poses} poses and {heldout} held-out poses")


def _sample_informative_poses(model, wires, count: int, rng: np.random.Generator, criterion: Any):
    """Return joint values and leg lengths of the `count` most informative of many random poses.

    `criterion` is the observability criterion to maximise: D or O1 to O5.
    """
    from hydrotele.simulate.hybrid import sample_poses

    robot = model.nominal
    joints, legs = sample_poses(robot, max(CANDIDATES, count), rng, wires)
    lengths = wire_lengths(wires, forward_kinematics(robot, joints, legs))
    candidates = measurement_from_wires(robot, joints, legs, lengths, wires, SENSOR_NOISE, "candidates")
    places = select_informative_poses(model, candidates, count, criterion)
    return joints[places], legs[places]

"""`hydrotele calibrate mukca` and `scara`: serial robots."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.estimation import told_combinations, told_in_words
from hydrotele.calibrate.mukca import (
    Judged,
    LeftOut,
    Options,
    Outlier,
    SocketCalibration,
    calibrate_sockets,
    check_robot,
    choose_robot,
    hold_out,
    leave_out,
    parts_to_leave_out,
)
from hydrotele.calibrate.scara import (
    ScaraFacts,
    best_poses,
    calibrate_scara,
    load_scara,
    save_scara,
    simulated_scara,
)
from hydrotele.calibrate.sockets import Socket, idle_joints, load_sockets, places_of
from hydrotele.cli.console import out, plain, print_json, table, write_json
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.core.output import check_target, whole_folder
from hydrotele.identify.identifiability import FULL
from hydrotele.kinematics.serial_robot import Robot, corrected_urdf, load_robot, robot_yaml

_ROBOT_FILES = ("robot.yaml", "robot.yml", "*.urdf", "*.xml")
_EXAMPLE = ScaraFacts(length_a=0.4, length_b=0.3)
_ERRORS = (0.0, 0.8e-3, 0.0, -0.5e-3)  # of the simulated arm: lengths only, as in Eq. 2
_SHOWN, _WIDE = 25, 60  # combinations of the printed table, and their letters


@dataclass(frozen=True)
class SocketChoices:
    """What a user may choose for `mukca`.

    Attributes:
        robot: shipped robot or file, None to find one.
        heldout: place or socket to judge on, None for every one in turn.
        distance: of neighbouring sockets [m], 0 if not known.
        accuracy: its standard deviation [m].
        unit: of angles, `rad` or `deg`.
        model: of the joints, None to choose.
    """

    robot: str | None = None
    heldout: str | None = None
    distance: float = 0.050
    accuracy: float = 5.0e-5
    unit: str = "rad"
    model: str | None = None


def calibrate_mukca(
    data: Path, choices: SocketChoices, target: Path | None, as_json: bool
) -> dict[str, Any]:
    """Calibrate a robot on sockets; print the result and write it, whole or not at all.

    Args:
        data: folder of places.
        choices: see there.
        target: folder to write, None for none.
        as_json: print JSON instead of words.

    Returns:
        The document that is printed or written.

    Raises:
        InputError: data, robot or target are not usable.
    """
    if choices.unit not in ("rad", "deg"):
        raise InputError(f"--unit {choices.unit}", "must be rad or deg")
    if target is not None:
        check_target(target, "robot calibration")
    sockets, notes = load_sockets(data, choices.unit == "deg")
    options = Options(choices.distance or None, choices.accuracy, choices.model)
    robot, said = _robot(data, choices.robot, sockets, options)
    check_robot(robot, sockets)
    notes = [*said, *notes, *_warnings(robot, sockets, options)]
    if choices.heldout is not None:
        one, found = hold_out(robot, sockets, choices.heldout, options)
        left: tuple[LeftOut, ...] = (one,)
    else:
        found = calibrate_sockets(robot, sockets, options)
        left = leave_out(robot, sockets, parts_to_leave_out(sockets), options)
    document = socket_document(data, sockets, found, left, notes)
    if target is not None:
        with whole_folder(target, "robot calibration") as folder:
            _write(folder, document, found, left)
    if as_json:
        print_json(document)
    else:
        _print(document, found, left)
        if target is not None:
            out.print(f"written to [bold]{target}[/]")
    return document


def socket_document(
    data: Path, sockets: Sequence[Socket], found: SocketCalibration, left: Sequence[LeftOut],
    notes: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """The result as JSON: lengths of results in mm, parameters in SI units."""
    fit, angular = found.fit, ("r", "s", "c")
    status = dict(zip(fit.told.names, fit.told.status, strict=True))
    alone = {name for name, told in status.items() if told == FULL}
    parameters = [
        {
            "name": name, "value": value, "unit": _unit(name, angular), "told": status[name],
            "std": std if name in alone else None, "low": low if name in alone else None,
            "high": high if name in alone else None,
        }
        for name, value, std, (low, high) in zip(
            fit.names, fit.values, fit.deviations, fit.intervals, strict=True
        )
    ]  # fmt: skip
    rows = {one.name: sum(len(r) for r in one.calibrated.rows.values()) for one in left}
    return plain(
        {
            "robot": found.nominal.name,
            "robot_file": found.nominal.source,
            "data": str(data),
            "places": list(places_of(sockets)),
            "rows": {s.name: len(s.joints) for s in sockets},
            "heldout": _heldout(left, rows) if left else None,
            "fitted": {
                "nominal_rms_mm": 1e3 * found.before.rms,
                "rms_mm": 1e3 * found.after.rms,
                "rms_without_outliers_mm": 1e3 * found.after.rms_without_outliers,
                "socket_distance_mm": _millimetres(found.after.distances),
            },
            "distance_mm": None if found.options.distance is None else 1e3 * found.options.distance,
            "noise_mm": 1e3 * found.noise,
            "model": found.model,
            "model_errors_mm": _millimetres(found.rivals),
            "sizes": found.sizes,
            "parameters": parameters,
            "effective_parameters": len(found.fit.residual) - found.fit.freedom,
            **told_in_words(fit.told),
            "told": [asdict(one) for one in told_combinations(fit)],
            "outliers": _outliers(found.outliers),
            "status": fit.status,
            "notes": list(notes),
        }
    )


def _heldout(left: Sequence[LeftOut], rows: dict[str, int]) -> dict[str, Any]:
    def over(kind: str, what: str) -> float:
        squares = [getattr(getattr(one, kind), what) ** 2 * rows[one.name] for one in left]
        return 1e3 * float(np.sqrt(np.sum(squares) / sum(rows.values())))

    distances = {k: v for one in left for k, v in one.calibrated.distances.items()}
    return {
        "rms_mm": over("calibrated", "rms"),
        "rms_without_outliers_mm": over("calibrated", "rms_without_outliers"),
        "nominal_rms_mm": over("nominal", "rms"),
        "given_rms_mm": over("given", "rms"),
        "socket_distance_mm": _millimetres(distances),
        "parts": {
            one.name: {
                "rms_mm": 1e3 * one.calibrated.rms,
                "rms_without_outliers_mm": 1e3 * one.calibrated.rms_without_outliers,
                "nominal_rms_mm": 1e3 * one.nominal.rms,
                "sockets_mm": _millimetres(one.calibrated.sockets),
                "model": one.model,
                "outliers": _outliers(one.calibrated.outliers),
            }
            for one in left
        },
    }


def _robot(
    data: Path, named: str | None, sockets: Sequence[Socket], options: Options
) -> tuple[Robot, list[str]]:
    """The robot, and a note on how it was found."""
    count = sockets[0].joints.shape[1]
    if named is not None:
        return load_robot(named, count), []
    inside = [path for pattern in _ROBOT_FILES for path in sorted(data.glob(pattern))]
    if inside:
        return load_robot(inside[0], count), [f"robot: {inside[0]}, found beside the data"]
    robot, spreads = choose_robot(sockets, options)
    tried = ", ".join(f"{name} {1e3 * spread:.3g}" for name, spread in spreads.items())
    return robot, [f"robot: {robot.name}, the shipped one that fits best (spread in mm: {tried})"]


def _warnings(robot: Robot, sockets: Sequence[Socket], options: Options) -> list[str]:
    notes = [
        f"{robot.joints[k].name} does not move in any file:"
        " its offset shows only together with errors of its neighbours"
        for k in idle_joints(sockets)
    ]
    if options.distance is None:
        notes.append("no distance of sockets is given: nothing tells the robot's scale")
    elif all(s.hole == sockets[0].hole for s in sockets):
        notes.append("no place has two neighbouring sockets: nothing tells the robot's scale")
    return notes


def _write(
    folder: Path, document: dict[str, Any], found: SocketCalibration, left: Sequence[LeftOut]
) -> None:
    from hydrotele.show.calibration_report import draw_sockets, write_robot_report

    write_json(folder / "calibration.json", document)
    source = f"calibrated by hydrotele {hydrotele.__version__} from {document['data']}"
    (folder / "calibrated.yaml").write_text(robot_yaml(found.robot, source), encoding="utf-8")
    origin = Path(found.nominal.source)
    if origin.suffix == ".urdf":
        made = corrected_urdf(found.robot, read_text(origin))
        (folder / "calibrated.urdf").write_text(made, encoding="utf-8")
    picture = draw_sockets(found, left)
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


def _print(document: dict[str, Any], found: SocketCalibration, left: Sequence[LeftOut]) -> None:
    heading = f"{document['robot']}: RMS distance of the ball from its socket's mean"
    rows = table(
        heading, "predicted, not fitted", "nominal mm", "calibrated mm", "sockets apart mm"
    )
    for one in left:
        apart = ", ".join(f"{1e3 * d:.3f}" for d in one.calibrated.distances.values())
        rows.add_row(one.name, _mm(one.nominal), f"[bold]{_mm(one.calibrated)}[/]", apart or "-")
    if len(left) > 1:
        whole = document["heldout"]
        rows.add_section()
        rows.add_row("all of them", f"{whole['nominal_rms_mm']:.3f}",
                     f"[bold]{whole['rms_mm']:.3f}[/]", "")  # fmt: skip
    rows.add_section()
    apart = ", ".join(f"{1e3 * d:.3f}" for d in found.after.distances.values())
    rows.add_row("(fitted)", _mm(found.before), _mm(found.after), apart or "-")
    out.print(rows)
    errors = ", ".join(f"{name} {value:.4f}" for name, value in document["model_errors_mm"].items())
    out.print(f"joints: [bold]{found.model}[/] (error of a coordinate not fitted, mm: {errors})")
    _print_parameters(document)
    for outlier in document["outliers"]:
        out.print(
            f"[yellow]outlier[/] {outlier['socket']}, row {outlier['row']}:"
            f" {outlier['distance_mm']:.2f} mm from its socket, not fitted"
        )
    for one in left:
        for outlier in one.calibrated.outliers:
            out.print(
                f"[yellow]outlier[/] {outlier.socket}, row {outlier.line}:"
                f" {1e3 * outlier.distance:.2f} mm apart in what is predicted, counted there"
            )
    for note in document["notes"]:
        out.print(f"[yellow]note[/] {note}")


def _print_parameters(document: dict[str, Any]) -> None:
    units = {one["name"]: one["unit"] for one in document["parameters"]}
    rows = table("What the data tell", "parameter or combination", "value", "95 % +-", "unit")
    told = sorted(document["told"], key=lambda one: len(one["text"]))
    for one in told[:_SHOWN]:
        unit = units[one["text"].split()[0]]
        shown, factor = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(unit, (unit, 1.0))
        text = one["text"] if len(one["text"]) < _WIDE else f"{one['text'][:_WIDE]} ..."
        reach = f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        rows.add_row(text, f"{factor * one['value']:.4g}", reach, shown)
    out.print(rows)
    if len(told) > _SHOWN:
        out.print(f"... and {len(told) - _SHOWN} longer combinations: --out or --json lists all")
    out.print("not told: " + (", ".join(document["unknown"]) or "nothing"))


def _unit(name: str, angular: Sequence[str]) -> str:
    if name.startswith("sag."):
        return "rad s^2/m^2"
    return "rad" if name[0] in angular else "m"


def _mm(judged: Judged) -> str:
    return f"{1e3 * judged.rms:.3f}"


def _millimetres(values: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * value for name, value in values.items()}


def _outliers(outliers: Sequence[Outlier]) -> list[dict[str, Any]]:
    return [
        {"socket": one.socket, "row": one.line, "distance_mm": 1e3 * one.distance}
        for one in outliers
    ]


def simulate_scara_folder(folder: Path, poses: int, noise: float, seed: int) -> None:
    """Write measurements of an arm of 0.4 and 0.3 m whose links are 0.8 mm longer, 0.5 mm shorter.

    Args:
        folder: to write into.
        poses: number of them.
        noise: of the positions [m].
        seed: of poses and noise.

    Raises:
        InputError: the folder holds something.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(folder, "exists; choose another --simulate")
    save_scara(folder, _EXAMPLE, simulated_scara(_EXAMPLE, _ERRORS, poses, noise, seed))


def calibrate_scara_folder(
    data: Path, heldout: str | None, choose: int | None, target: Path | None, as_json: bool
) -> dict[str, Any]:
    """Calibrate an arm; print the result and write it, whole or not at all.

    Args:
        data: folder of `nominal.yaml` and `measured.csv`.
        heldout: numbers of poses to judge on, None for each in turn.
        choose: number of poses to name that tell most, None for none.
        target: folder to write, None for none.
        as_json: print JSON instead of words.

    Returns:
        The document that is printed or written.

    Raises:
        InputError: data or target are not usable.
    """
    if target is not None:
        check_target(target, "robot calibration")
    nominal, measured = load_scara(data)
    judged = _pose_numbers(heldout, len(measured.joints))
    found = calibrate_scara(nominal, measured, judged)
    fit = found.fit
    start = {"length.a": nominal.length_a, "length.b": nominal.length_b}
    document = plain(
        {
            "data": str(data),
            "poses": len(measured.joints),
            "heldout": {
                "rms_mm": 1e3 * found.heldout_rms,
                "nominal_rms_mm": 1e3 * found.nominal_rms,
                "poses": [k + 1 for k in judged] or "each in turn",
            },
            "model": "lengths and offsets" if found.offsets else "lengths",
            "model_errors_mm": {name: 1e3 * error for name, error in found.rivals.items()},
            "noise_mm": 1e3 * fit.noise,
            "parameters": [
                {"name": name, "nominal": start.get(name, 0.0), "value": value, "std": std,
                 "low": low, "high": high, "unit": "m" if name.startswith("length") else "rad"}
                for name, value, std, (low, high) in zip(
                    fit.names, fit.values, fit.deviations, fit.intervals, strict=True)
            ],
            **told_in_words(fit.told),
            "status": fit.status,
        }
    )  # fmt: skip
    if choose is not None:
        chosen = best_poses(nominal, measured, choose)
        document["best_poses"] = sorted(k + 1 for k in chosen.chosen)
    if target is not None:
        with whole_folder(target, "robot calibration") as folder:
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
            out.print(f"written to [bold]{target}[/]")
    return document


def _pose_numbers(heldout: str | None, count: int) -> list[int]:
    if heldout is None:
        return []
    words = heldout.split(",")
    if not all(word.strip().isdigit() and 1 <= int(word) <= count for word in words):
        raise InputError(f"--heldout {heldout}", f"must be numbers of poses from 1 to {count}")
    return sorted({int(word) - 1 for word in words})


def _print_scara(document: dict[str, Any]) -> None:
    rows = table(f"{document['poses']} poses, model: {document['model']}", "parameter", "nominal",
                 "calibrated", "95 % +-", "unit")  # fmt: skip
    for one in document["parameters"]:
        unit = {"m": "mm", "rad": "mrad"}[one["unit"]]
        if one["std"] is None:
            rows.add_row(one["name"], f"{1e3 * one['nominal']:.4f}", "-", "not told", unit)
            continue
        rows.add_row(one["name"], f"{1e3 * one['nominal']:.4f}", f"{1e3 * one['value']:.4f}",
                     f"{0.5e3 * (one['high'] - one['low']):.4f}", unit)  # fmt: skip
    out.print(rows)
    judged = document["heldout"]
    out.print(f"end predicted, not fitted: [bold]{judged['rms_mm']:.4f} mm[/] RMS"
              f" (nominal {judged['nominal_rms_mm']:.4f})")  # fmt: skip
    if "best_poses" in document:
        out.print("poses that tell most: " + ", ".join(map(str, document["best_poses"])))
    for text in document["combinations"]:
        out.print(f"[yellow]only together[/] {text}")
    if document["unknown"]:
        out.print("[yellow]not told[/] " + ", ".join(document["unknown"]))

"""Implement `hydrotele calibrate scara`: calibrate a planar arm with two links from measured positions."""

from pathlib import Path
from typing import Any

import hydrotele
from hydrotele.calibrate.estimation import list_identifiability
from hydrotele.calibrate.scara_calibration import (
    ScaraSpec,
    calibrate_scara,
    load_scara,
    save_scara,
    select_scara_poses,
    simulate_scara,
)
from hydrotele.cli.calibrate_hybrid_command import MAX_POSES, MAX_SEED
from hydrotele.cli.console import (
    make_table,
    print_json,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.cli.option_values import check_range
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder

MAX_SCARA_NOISE = 100.0  # mm: a larger position error is not noise for links of 0.4 and 0.3 m
_EXAMPLE = ScaraSpec(length_a=0.4, length_b=0.3)
_EXAMPLE_ERRORS = (
    0.0,
    0.8e-3,
    0.0,
    -0.5e-3,
)  # errors of the simulated arm: lengths only, as in Eq. 2


def simulate_scara_to_folder(folder: Path, poses: int, noise: float, seed: int) -> None:
    """Write simulated measurements of a planar arm with two links of nominally 0.4 m and 0.3 m.

    The first link is 0.8 mm longer and the second one 0.5 mm shorter than nominal.

    Args:
        folder: folder to write.
        poses: number of poses.
        noise: standard deviation of the measured positions [m].
        seed: random seed of poses and noise.

    Raises:
        InputError: the folder is not empty, or a number is out of range.
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
        heldout: numbers of the held-out poses, from 1, separated by commas; None to hold out each
            pose in turn.
        choose: number of most informative poses to select and list, None for none.
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

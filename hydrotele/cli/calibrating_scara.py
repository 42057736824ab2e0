"""`hydrotele calibrate scara`: the example by which calibration is explained."""

from pathlib import Path
from typing import Any

import hydrotele
from hydrotele.calibrate.estimation import told_in_words
from hydrotele.calibrate.scara import (
    ScaraFacts,
    best_poses,
    calibrate_scara,
    load_scara,
    save_scara,
    simulated_scara,
)
from hydrotele.cli.console import out, plain, print_json, table, write_json
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder

_EXAMPLE = ScaraFacts(length_a=0.4, length_b=0.3)
_ERRORS = (0.0, 0.8e-3, 0.0, -0.5e-3)  # of the simulated arm: lengths only, as in Eq. 2


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
    judged = _numbers(heldout, len(measured.joints))
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
        _print(document)
        if target is not None:
            out.print(f"written to [bold]{target}[/]")
    return document


def _numbers(heldout: str | None, count: int) -> list[int]:
    if heldout is None:
        return []
    words = heldout.split(",")
    if not all(word.strip().isdigit() and 1 <= int(word) <= count for word in words):
        raise InputError(f"--heldout {heldout}", f"must be numbers of poses from 1 to {count}")
    return sorted({int(word) - 1 for word in words})


def _print(document: dict[str, Any]) -> None:
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

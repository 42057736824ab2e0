"""Implement `hydrotele calibrate imu`: calibrate the mounting of IMUs and derive joint positions from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import hydrotele
from hydrotele.calibrate.imu_calibration import MAX_SD_RATIO, ImuCalibration, calibrate_imus, parse_pose
from hydrotele.cli.console import make_table, print_json, print_notes, stdout_console, to_json_types, write_json
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine, save_machine

_KIND = "imu calibration"  # kind of the output folder
_PARAMETERS = (
    *(f"rotation_{c}" for c in "xyz"), *(f"accelerometer_bias_{c}" for c in "xyz"), *(f"position_{c}" for c in "xyz"),
    *(f"gyro_bias_{c}" for c in "xyz"),
)  # fmt: skip


def calibrate_imu_logs(
    data: Sequence[Path], machine: str, tool: str | None, sensors: str | None, poses: Sequence[str],
    pose_sd_deg: float, slope_sd_deg: float, target: Path | None, as_json: bool,
) -> ImuCalibration:  # fmt: skip
    """Calibrate the IMUs of a machine from logs; print the result, and write machine and logs.

    Args:
        data: logs with the channels of the IMUs.
        machine: machine with the nominal mounting, as a shipped name or a folder.
        tool: tool of the machine.
        sensors: sensor set, None for that of the logs.
        poses: known poses, see `parse_pose`.
        pose_sd_deg: standard deviation of their positions [deg], for slides [mm].
        slope_sd_deg: standard deviation of the slope of the ground [deg].
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Raises:
        InputError: logs, machine, poses or target are not usable.
    """
    if target:
        check_output_folder(target, _KIND)
    nominal = load_machine(machine, tool)
    known = [parse_pose(text, float(np.radians(pose_sd_deg))) for text in poses]
    result = calibrate_imus(data, nominal, sensors, known, float(np.radians(slope_sd_deg)))
    document = imu_calibration_to_dict(result)
    if target:
        with atomic_folder(target, _KIND) as folder:
            write_json(folder / "calibration.json", document)
            save_machine(result.machine, folder / MACHINE_FILE)
            (folder / "logs").mkdir()
            for run, log in zip(result.smoothed.runs, result.logs, strict=True):
                save_log(log, folder / "logs" / f"{run.name}.parquet", missing=True)
            write_json(folder / "summary.json", {"kind": _KIND, "hydrotele": hydrotele.__version__})
    if as_json:
        print_json(document)
        return result
    print_notes(result.notes)
    _print_result(document)
    if target:
        stdout_console.print(f"written to [bold]{target}[/]: the calibrated machine is {target}/{MACHINE_FILE}, the"
                             f" logs with joint positions are in {target}/logs")  # fmt: skip
    return result


def imu_calibration_to_dict(result: ImuCalibration) -> dict[str, Any]:
    """Return a calibration of IMUs in the form that `--json` prints, in SI units.

    Rotations are rotation vectors relative to the mounting in the machine file.
    """
    found, deviation, prior = result.smoothed.parameters, result.smoothed.standard_deviations, result.prior_sd
    imus = {}
    for k, name in enumerate(result.chain.imus):
        values = [np.concatenate([part.mounting[k], part.gyro_bias[:, k].mean(axis=0)])
                  for part in (found, deviation, prior)]  # fmt: skip
        sensor = result.machine.sensors[result.sensors].mounted[name]
        turn = Rotation.from_rotvec(result.chain.sensors[k].rotation).inv() * Rotation.from_rotvec(sensor.rotation)
        imus[name] = {
            "link": sensor.link,
            "rotation": sensor.rotation,
            "rotation_from_nominal_deg": float(np.degrees(turn.magnitude())),
            "parameters": {
                name: {"value": value, "standard_deviation": sd, "identifiable": bool(sd < MAX_SD_RATIO * before)}
                for name, value, sd, before in zip(_PARAMETERS, *values, strict=True)
            },
        }  # fmt: skip
    runs = {
        run.name: {
            axis: {"noise": run.noise[a], "offset_standard_deviation": run.offset[a]}
            for a, axis in enumerate(result.chain.axes)
        } | {"relative_residual": {n: {"gyro": rms[0], "accelerometer": rms[1]}
                                   for n, rms in zip(result.chain.imus, run.residual_rms, strict=True)}}
        for run in result.smoothed.runs
    }  # fmt: skip
    slope = {"x": found.tilt[0], "y": found.tilt[1]} if prior.tilt.any() else None
    return to_json_types({"machine": result.machine.name, "sensors": result.sensors, "imus": imus, "runs": runs,
                          "axes": list(result.chain.axes), "slope": slope, "notes": list(result.notes)})  # fmt: skip


def _print_result(document: dict[str, Any]) -> None:
    table = make_table("IMUs: value +- standard deviation", "parameter", *document["imus"])
    for name in _PARAMETERS:
        scale, unit = (np.degrees(1.0), "deg") if name.startswith("rotation") else (1.0, "m/s²")
        if name.startswith("position"):
            scale, unit = 1e3, "mm"
        if name.startswith("gyro"):
            scale, unit = np.degrees(1.0), "deg/s"
        cells = []
        for imu in document["imus"].values():
            one = imu["parameters"][name]
            text = f"{scale * one['value']:.3f} +- {scale * one['standard_deviation']:.3f}"
            cells.append(text if one["identifiable"] else f"{text} (not identifiable)")
        table.add_row(f"{name} [{unit}]", *cells)
    for kind in ("gyro", "accelerometer"):
        worst = (
            max(run["relative_residual"][name][kind] for run in document["runs"].values()) for name in document["imus"]
        )
        table.add_row(f"residual RMS / noise, {kind}", *(f"{ratio:.2f}" for ratio in worst))
    stdout_console.print(table)
    table = make_table("derived joint positions: standard deviation", "run", "axis", "noise", "constant offset")
    for run, axes in document["runs"].items():
        for axis in document["axes"]:
            shown = (f"{np.degrees(axes[axis][key]):.3f} deg" for key in ("noise", "offset_standard_deviation"))
            table.add_row(run, axis, *shown)
    stdout_console.print(table)
    if document["slope"]:
        x, y = (np.degrees(document["slope"][c]) for c in "xy")
        stdout_console.print(f"slope: {x:.2f} deg about x, {y:.2f} deg about y")

"""Implement `hydrotele calibrate machine`: calibrate kinematics, then identify dynamics.

The steps are the links of the arm, the cylinder linkages, and the masses and friction. Each step
uses the machine that the previous step calibrated.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import hydrotele
from hydrotele.calibrate.linkage_identification import LinkageFit, machine_with_linkage
from hydrotele.cli.calibrate_arm_command import ArmChoices, ArmResult, arm_result_to_dict, fit_arm, write_arm_report
from hydrotele.cli.calibrate_linkage_command import fit_linkages, linkage_fit_to_dict
from hydrotele.cli.console import (
    make_table,
    print_json,
    show_stages,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.cli.identify_command import (
    IdentificationOptions,
    MechanismIdentification,
    identify_mechanism,
    write_identification,
)
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.identify.identify_document import build_identify_document
from hydrotele.logs.dataset import Dataset, load_dataset
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine, save_machine

_HELDOUT_INTERVAL = 5  # one of so many poses is held out


class MachineCalibration(NamedTuple):
    """Results of all steps of a machine calibration.

    Attributes:
        arm: links, joint axes and sensor offsets.
        linkages: pin positions and retracted lengths of the cylinders, one item per axis that moves.
        linkages_skip_reason: reason why the linkages were not calibrated, empty if they were.
        kinematic_machine: machine after the calibration of arm and linkages.
        dataset: logs of the dynamic step, loaded with that machine.
        dynamics: identified bodies and friction, and the final machine.
    """

    arm: ArmResult
    linkages: list[LinkageFit]
    linkages_skip_reason: str
    kinematic_machine: Machine
    dataset: Dataset
    dynamics: MechanismIdentification


def calibrate_machine(
    kinematics: Path, dynamics: Sequence[Path], machine: str, heldout: str | None, target: Path,
    as_json: bool,
) -> MachineCalibration:  # fmt: skip
    """Calibrate arm and cylinder linkages, then identify masses and friction with the result.

    Args:
        kinematics: folder of logs; one link moves in each log, measured by the calibrator.
        dynamics: logs of the same machine with pressures; if empty, the kinematic logs are used.
        machine: nominal machine with a calibrator, as a shipped name or a folder.
        heldout: held-out run of the dynamic logs, None for `test*`, else the last run.
        target: output folder, written completely or not at all.
        as_json: print the result as JSON instead of tables.

    Returns:
        The results of all steps.

    Raises:
        InputError: logs, machine or target are not usable.

    Source: Khoshzaban 1992, section 5.3 (p. 125), kinematic and dynamic calibration in sequence.
    """
    check_output_folder(target, "machine calibration")
    nominal = load_machine(machine)
    with show_stages(f"calibrate {nominal.name}", as_json) as progress:
        report = progress or (lambda stage, fraction: None)
        report("links of the arm", 0.0)
        arm = fit_arm(nominal, kinematics, ArmChoices(), _HELDOUT_INTERVAL)
        report("cylinder linkages", 0.2)
        made, linkages, skipped = arm.calibrated, [], ""
        try:
            linkages = fit_linkages(made, kinematics, "measured")
        except InputError as error:
            skipped = str(error)
        for found in linkages:
            made = machine_with_linkage(made, found)
        report("bodies and friction", 0.3)
        dataset = load_dataset(list(dynamics) or [kinematics], made, None, heldout)
        identified = identify_mechanism(dataset, IdentificationOptions())
    result = MachineCalibration(arm, linkages, skipped, made, dataset, identified)
    with atomic_folder(target, "machine calibration") as folder:
        _write(folder, result, list(dynamics) or [kinematics])
    if as_json:
        print_json(_calibration_document(result))
    else:
        _print(result)
        stdout_console.print(f"written to [bold]{target}[/]; the machine is {target}/identified")
    return result


def _calibration_document(result: MachineCalibration) -> dict[str, Any]:
    return to_json_types({
        "machine": result.arm.machine.name,
        "arm": arm_result_to_dict(result.arm),
        "linkages": {found.axis: linkage_fit_to_dict(found) for found in result.linkages},
        "linkages_skipped": result.linkages_skip_reason,
        "dynamics": build_identify_document(result.dynamics.identification, None, result.dynamics.consistent),
    })  # fmt: skip


def _write(folder: Path, result: MachineCalibration, data: Sequence[Path]) -> None:
    write_json(folder / "calibration.json", _calibration_document(result))
    kinematics = folder / "kinematics"
    kinematics.mkdir()
    save_machine(result.kinematic_machine, kinematics / MACHINE_FILE)
    write_arm_report(kinematics, result.arm)
    if result.linkages:
        from hydrotele.show.calibration_report import write_linkage_report

        write_linkage_report(result.linkages, kinematics / "linkages.html")
    write_identification(folder, result.dataset, result.dynamics, None, data, IdentificationOptions())
    summary = {
        "kind": "machine calibration", "machine": result.arm.machine.name,
        "heldout": result.dataset.heldout.name, "hydrotele": hydrotele.__version__,
    }  # fmt: skip
    write_json(folder / "summary.json", summary)


def _print(result: MachineCalibration) -> None:
    title = "errors on held-out data before and after calibration (lower is better)"
    shown = make_table(title, "quantity", "before", "after", "unit")
    closure = result.arm.heldout_errors
    if closure:
        shown.add_row("closure of the arm (poses)", f"{closure['rms_nominal_mm']:.2f}",
                      f"{closure['rms_identified_mm']:.2f}", "mm RMS")  # fmt: skip
    for found in result.linkages:
        shown.add_row(f"displacement of the {found.axis} cylinder",
                      f"{1e3 * found.rms_before:.2f}", f"{1e3 * found.rms:.2f}",
                      "mm RMS")  # fmt: skip
    identified = result.dynamics.identification
    for drive, held in (identified.heldout if identified else {}).items():
        shown.add_row(f"force of {drive}", f"{held.nominal_rms:.4g}", f"{held.rms:.4g}",
                      f"{held.unit} RMS")  # fmt: skip
    stdout_console.print(shown)
    if result.linkages_skip_reason:
        stdout_console.print(
            f"[yellow]note[/] the cylinder linkages were not calibrated: {result.linkages_skip_reason}"
        )
    if identified:
        stdout_console.print(f"dynamics: {identified.status}")

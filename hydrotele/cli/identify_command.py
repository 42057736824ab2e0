"""Implement `hydrotele identify` and `hydrotele excite`.

`identify` estimates the parameters of a machine or mechanism from logs and writes the identified
machine. `excite` designs the most informative trajectory and writes it as a scenario.
"""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
import yaml

import hydrotele
from hydrotele.cli.console import (
    make_table,
    print_json,
    print_result,
    show_stages,
    stderr_console,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.cli.contact_command import ContactOption, load_dataset_without_contact
from hydrotele.cli.input_logs import derive_data_name, load_machine_for_logs
from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.core.output import atomic_file, atomic_folder, check_output_folder
from hydrotele.identify.consistent_parameters import ConsistentParameters
from hydrotele.identify.estimation import Estimator
from hydrotele.identify.excitation import MachineLimits, design_motion, select_determinable_parameters
from hydrotele.identify.hydraulic_identification import HydraulicIdentification, identify_hydraulics
from hydrotele.identify.identification import identify_with_friction_shapes
from hydrotele.identify.identified_machine import build_identified_machine
from hydrotele.identify.identify_document import build_identify_document
from hydrotele.identify.joint_motion import Processing
from hydrotele.identify.mechanism import load_mechanism, load_mechanism_records
from hydrotele.identify.record import build_records, compute_force_noise
from hydrotele.identify.regressor_setup import DynamicModel, machine_setup, map_cylinder_bodies
from hydrotele.identify.result import (
    STATUS_DESCRIPTIONS,
    Identification,
    count_statuses,
    parameter_rows,
)
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import (
    MACHINE_FILE,
    load_machine,
    save_machine,
    shipped_machines,
)
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.closed_loops import load_closed_chain
from hydrotele.simulate.plant import build_plant


@dataclass(frozen=True)
class MechanismIdentification:
    """Identified bodies, friction and offsets of a machine.

    Attributes:
        identification: the identification, None if the logs contain no forces.
        consistent: nearest physically consistent parameters, None if `identification` is None.
        machine: the identified machine.
        missing_reason: reason why `identification` is None, else empty.
    """

    identification: Identification | None
    consistent: ConsistentParameters | None
    machine: Machine
    missing_reason: str = ""


@dataclass(frozen=True)
class IdentificationOptions:
    """Options of the identification.

    Attributes:
        model: `complete`, or `reduced` to the links, without the masses of the cylinders.
        pins: whether passive joints and pins have friction.
        asymmetry: whether viscous friction depends on the direction of motion.
        processing: filter and differentiation of the signals.
        estimator: estimator of the parameters.
        hydraulics: whether valves, oil and supply are also identified.
    """

    model: DynamicModel = "complete"
    pins: bool = False
    asymmetry: bool = False
    processing: Processing = dataclasses.field(default_factory=Processing)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    hydraulics: bool = False


def identify_to_folder(
    data: Sequence[Path], machine: str | None, tool: str | None, heldout: str | None,
    sensors: str | None, target: Path | None, as_json: bool, choices: IdentificationOptions,
    force: bool = False, contact: ContactOption = "mask",
) -> Path:  # fmt: skip
    """Identify masses, friction and, if requested, hydraulics of a machine from logs.

    The results are printed and written to a folder. The output folder is written completely or not at all.

    Args:
        data: log files, folders of logs, run folders.
        machine: machine model, None for that named by the logs.
        tool: tool of the machine, None for that of the logs.
        heldout: name of the held-out run, None for `test*`, else the last run.
        sensors: name of the machine's sensor set, None for that named by the logs.
        target: output folder, default `identify_<data>`.
        as_json: print `identify.json` instead of text.
        choices: options of the identification.
        force: accept logs whose metadata name another machine or tool.
        contact: `mask` to mask intervals of detected contact and loads, `ignore` to use all rows.

    Returns:
        The output folder.

    Raises:
        InputError: data, machine or target are not usable.
        typer.Exit: status 1 if the identified model predicts no held-out force better than zero force does.
    """
    target = target or Path(f"identify_{derive_data_name(data)}")
    check_output_folder(target, "identify")
    stop_profiling_clock()
    model = load_machine_for_logs(data, machine, tool)
    dataset = load_dataset_without_contact(data, model, sensors, heldout, force, contact)
    with show_stages(f"identify {model.name}", as_json) as progress:
        say = progress or (lambda said, share: None)
        say("mechanism", 0.0)
        mechanism, hydraulics = identify_mechanism(dataset, choices), None
        if choices.hydraulics:
            better = dataclasses.replace(dataset, machine=mechanism.machine)
            hydraulics = identify_hydraulics(better, progress=progress)
    if mechanism.identification is None and hydraulics is None:
        raise InputError(target, mechanism.missing_reason)
    with atomic_folder(target, "identify") as folder:
        write_identification(folder, dataset, mechanism, hydraulics, data, choices)
    print_result(
        build_identify_document(mechanism.identification, hydraulics, mechanism.consistent),
        as_json,
        lambda: _print(mechanism, hydraulics, dataset),
        target,
    )
    if mechanism.identification and not mechanism.identification.explains_force:
        raise typer.Exit(1)
    return target


def identify_mjcf_to_folder(
    data: Sequence[Path], mjcf: Path, columns: Path | None, heldout: str | None,
    target: Path | None, as_json: bool, processing: Processing, estimator: Estimator,
) -> Path:  # fmt: skip
    """Identify masses and friction of an MJCF mechanism from logs; print the results, write a folder.

    Args:
        data: log files, folders of logs.
        mjcf: MJCF file of the mechanism, whose loops are closed by `connect` and `weld`.
        columns: YAML file that assigns log columns, None if the columns have standard names.
        heldout: name of the held-out run, None for `test*`, else the last run.
        target: output folder, default `identify_<data>`.
        as_json: print `identify.json` instead of text.
        processing: filter and differentiation of the signals.
        estimator: estimator of the parameters.

    Returns:
        The output folder.

    Raises:
        InputError: data, mechanism, mapping or target are not usable.
        typer.Exit: status 1 if the identified model predicts no held-out force better than zero force does.
    """
    from hydrotele.show.identify_report import ReportSource, write_identify_report

    target = target or Path(f"identify_{derive_data_name(data)}")
    check_output_folder(target, "identify")
    mechanism = load_mechanism(mjcf, columns)
    name = mechanism.setup.chain.name
    fit, judge, said = load_mechanism_records(data, mechanism, heldout, processing.period)
    with show_stages(f"identify {name}", as_json) as progress:
        if progress:
            progress("mechanism", 0.0)
        found = identify_with_friction_shapes(
            fit, judge, mechanism.setup, processing, estimator, notes=said
        )  # fmt: skip
    with atomic_folder(target, "identify") as folder:
        document = to_json_types(build_identify_document(found))
        write_json(folder / "identify.json", document)
        learned = ReportSource(name, None, tuple(run.name for run in fit), judge.name)
        write_identify_report(learned, found, None, None, folder / "report.html")
        summary = {
            "kind": "identify", "mjcf": str(mjcf), "columns": str(columns) if columns else None,
            "data": [str(path) for path in data], "heldout": judge.name,
            "status": document["status"], "hydrotele": hydrotele.__version__,
        }  # fmt: skip
        write_json(folder / "summary.json", summary)
    print_result(build_identify_document(found), as_json, lambda: _print_mechanism(found, judge.name), target)
    if not found.explains_force:
        raise typer.Exit(1)
    return target


def identify_mechanism(dataset: Dataset, choices: IdentificationOptions) -> MechanismIdentification:
    """Identify masses, inertias, friction and force offsets of a machine from logs.

    Args:
        dataset: logs of the machine.
        choices: options of the identification.

    Returns:
        The identified parameters and the machine that has them. If the logs do not contain forces
        and `choices.hydraulics` is True, the unchanged machine with the reason.

    Raises:
        InputError: the logs do not contain forces, and `choices.hydraulics` is False.
    """
    try:
        fit, heldout, said = build_records(dataset)
    except InputError as error:
        if not choices.hydraulics:
            raise
        return MechanismIdentification(None, None, dataset.machine, str(error))
    setup = machine_setup(
        dataset.machine, load_closed_chain(dataset.machine), choices.model, pins=choices.pins,
        asymmetry=choices.asymmetry,
    )  # fmt: skip
    found = identify_with_friction_shapes(
        fit, heldout, setup, choices.processing, choices.estimator, notes=(*dataset.notes, *said)
    )  # fmt: skip
    patched, best = build_identified_machine(dataset.machine, found, map_cylinder_bodies(dataset.machine))
    return MechanismIdentification(found, best, patched)


def write_identification(
    folder: Path, dataset: Dataset, mechanism: MechanismIdentification, hydraulics: HydraulicIdentification | None,
    data: Sequence[Path], choices: IdentificationOptions,
) -> None:  # fmt: skip
    """Write the results of an identification into a folder: JSON, report and identified machine.

    Args:
        folder: existing output folder.
        dataset: logs that were used.
        mechanism: identified masses and friction.
        hydraulics: identified hydraulics, None if they were not identified.
        data: paths of the logs, stored in `summary.json`.
        choices: options of the identification.
    """
    found, patched = (
        mechanism.identification,
        hydraulics.machine if hydraulics else mechanism.machine,
    )
    document = to_json_types(build_identify_document(found, hydraulics, mechanism.consistent))
    write_json(folder / "identify.json", document)
    made = folder / "identified"
    made.mkdir()
    save_machine(patched, made / MACHINE_FILE)
    build_plant(patched).document.save(made / "machine.xml")
    from hydrotele.show.identify_report import ReportSource, write_identify_report

    stderr_console.print("writing report.html ...", style="dim")
    learned = ReportSource(
        dataset.machine.name, dataset.machine.tool, tuple(run.name for run in dataset.fit),
        dataset.heldout.name, tuple(dataset.notes),
    )  # fmt: skip
    write_identify_report(learned, found, hydraulics, mechanism.consistent, folder / "report.html")
    summary = {
        "kind": "identify",
        "machine": dataset.machine.name,
        "tool": dataset.machine.tool,
        "data": [str(path) for path in data],
        "heldout": dataset.heldout.name,
        "model": choices.model,
        "status": document["status"],
        "hydrotele": hydrotele.__version__,
    }
    write_json(folder / "summary.json", summary)


def _print(mechanism: MechanismIdentification, hydraulics: HydraulicIdentification | None, dataset: Dataset) -> None:
    if mechanism.identification:
        _print_mechanism(mechanism.identification, dataset.heldout.name)
    else:
        stdout_console.print(f"[yellow]note[/] {mechanism.missing_reason}")
    if hydraulics:
        title = "hydraulic parameters"
        rows = make_table(title, "parameter", "given", "identified", "std. dev.", "unit")
        for n in hydraulics.parameters:
            shown = (f"{n.value:.6g}", f"{n.std:.2g}") if n.is_determined else ("not identifiable", "")
            rows.add_row(n.qualified_name, f"{n.nominal:.6g}", *shown, n.unit)
        stdout_console.print(rows)
        stdout_console.print(
            f"one-step prediction errors on {dataset.heldout.name}: {hydraulics.nominal_rms_error:.3g} times"
            f" noise with the given and {hydraulics.identified_rms_error:.3g} times noise with the identified"
            f" hydraulics; {hydraulics.status}"
        )


def _print_mechanism(identification: Identification, heldout: str) -> None:
    rows = parameter_rows(identification)
    many = count_statuses(rows)
    stdout_console.print(f"[bold]{identification.status}[/]", soft_wrap=True)
    title = "identified parameters and combinations"
    shown = make_table(title, "parameter", "given", "identified", "std. dev.", "unit")
    for row in rows:
        if row.value is None or row.std is None:
            continue
        name = row.name + (" + ..." if row.combination else "")
        shown.add_row(name, f"{row.nominal:.6g}", f"{row.value:.6g}", f"{row.std:.2g}", row.unit)
    stdout_console.print(shown)
    for status, number in many.items():
        stdout_console.print(f"{number:4d} {status}: {STATUS_DESCRIPTIONS[status]}")
    judged = make_table(
        f"RMS force error on {heldout}, not fitted, below {identification.band:.3g} Hz (lower is better)",
        "drive", "given model", "identified", "noise alone", "unit", "relative",
    )  # fmt: skip
    for drive, h in identification.heldout.items():
        noise = f"{h.noise_rms:.4g}" if np.isfinite(h.noise_rms) else "-"
        judged.add_row(drive, f"{h.nominal_rms:.4g}", f"{h.rms:.4g}", noise, h.unit,
                       f"{100 * h.relative_error:.2f} %")  # fmt: skip
    stdout_console.print(judged)
    if identification.friction:
        friction = make_table("friction force at constant speed", "drive", "speed", "friction", "std. dev.", "unit")
        for f in identification.friction:
            friction.add_row(f.drive, f"{f.speed:g}", f"{f.force:.4g}", f"{f.std:.2g}", f.unit)
        stdout_console.print(friction)
    distance, limit = identification.squared_distance(identification.nominal)
    stdout_console.print(
        f"the given parameters lie {'in' if distance <= limit else 'out'}side the joint 95 %"
        f" confidence ellipsoid: squared distance {distance:.3g}, limit {limit:.3g}"
    )
    stdout_console.print(
        f"condition number {identification.estimate.condition:.3g}, computing time {identification.seconds:.1f} s"
    )
    for note in identification.notes:
        stdout_console.print(f"[yellow]note[/] {note}")


def design_excitation_file(
    machine: str, tool: str | None, sensors: str | None, target: Path, period: float,
    harmonics: int, starts: int, seed: int, cycles: float, as_json: bool,
) -> Path:  # fmt: skip
    """Design the periodic trajectory that best determines a machine's parameters; write it as a scenario.

    Args:
        machine: name or folder of the machine.
        tool: tool of the machine, None for its first tool.
        sensors: name of the machine's sensor set, None for its first.
        target: YAML file to write.
        period: period of the trajectory [s].
        harmonics: number of harmonics of the trajectory.
        starts: number of searches from random trajectories.
        seed: seed of the random trajectories.
        cycles: number of periods that the scenario runs.
        as_json: print the result as JSON.

    Returns:
        The scenario file.

    Raises:
        InputError: there is no such machine or sensor set, or no trajectory within the limits.
    """
    model = load_machine(machine, tool)
    named = sensors or next(iter(model.sensors), None)
    if named is None:
        raise InputError(machine, "has no sensors; the design needs their noise: add 'sensors'")
    name = re.sub(r"[^a-z0-9_]", "_", target.stem.lower()).lstrip("_0123456789") or "excitation"
    if target.suffix.lower() != ".yaml" or not target.parent.is_dir():
        raise InputError(target, "must be a .yaml file in an existing folder")
    place = machine if machine in shipped_machines() else str(resolve_path(machine))
    setup = machine_setup(model, load_closed_chain(model))
    noise = np.maximum(compute_force_noise(model, named), 1e-9)
    base = select_determinable_parameters(model, setup, noise, period, seed)
    with show_stages(f"excite {model.name}", as_json) as progress:
        found = design_motion(
            MachineLimits(model, setup), setup, noise, base, period=period, harmonics=harmonics,
            starts=starts, seed=seed, progress=progress,
        )  # fmt: skip
    scenario = found.to_scenario(name, model, cycles, place, sensors=named)
    with atomic_file(target, ".yaml") as part:
        text = yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)
        part.write_text(text, encoding="utf-8")
    load_scenario(target)
    if as_json:
        print_json({
            "file": str(target), "criterion": found.criterion, "parameters": found.parameters,
            "max_limit_utilisation": found.max_utilisation,
        })  # fmt: skip
    else:
        stdout_console.print(
            f"trajectory with a period of {period:g} s for {found.parameters} parameters; it uses"
            f" its most restrictive limit to {100 * found.max_utilisation:.0f} %"
        )
        stderr_console.print(f"hydrotele run {target}", style="dim")
        stdout_console.print(f"written to [bold]{target}[/]")
    return target

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
import yaml

import hydrotele
from hydrotele.cli.console import (
    notes,
    out,
    plain,
    print_json,
    print_result,
    stages,
    table,
    write_json,
)
from hydrotele.cli.opening import data_name, machine_of
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, replacing, whole_folder
from hydrotele.identify.estimation import Estimator
from hydrotele.identify.excitation import MachineLimits, design_motion, informative_base
from hydrotele.identify.hydraulic import Hydraulics, identify_hydraulics
from hydrotele.identify.identification import identify_with_shapes
from hydrotele.identify.identified_machine import Consistent, identified_machine, identify_document
from hydrotele.identify.mechanism import load_mechanism, mechanism_records
from hydrotele.identify.motion import Processing
from hydrotele.identify.record import force_noise, records
from hydrotele.identify.result import MEANING, Identification, counts, parameter_rows
from hydrotele.identify.setup import Model, cylinder_bars, machine_setup
from hydrotele.logs.dataset import Dataset, load_dataset
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import (
    MACHINE_FILE,
    load_machine,
    save_machine,
    shipped_machines,
)
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.closure import closed_chain
from hydrotele.simulate.native import stop_profiling_clock
from hydrotele.simulate.plant import build_plant


@dataclass(frozen=True)
class MechanismResult:
    """Identified bodies, friction and offsets of a machine.

    Attributes:
        found: the identification, None if the logs contain no forces.
        best: nearest physically consistent parameters, None if `found` is None.
        machine: the identified machine.
        lacking: reason why `found` is None, else empty.
    """

    found: Identification | None
    best: Consistent | None
    machine: Machine
    lacking: str = ""


@dataclass(frozen=True)
class Choices:
    """Options of the identification.

    Attributes:
        model: `complete`, or `reduced` to the links.
        pins: whether passive joints and pins have friction.
        asymmetry: whether viscous friction depends on the direction of motion.
        processing: filter and differentiation of the signals.
        estimator: estimator of the parameters.
        hydraulics: whether valves, oil and supply are also identified.
    """

    model: Model = "complete"
    pins: bool = False
    asymmetry: bool = False
    processing: Processing = dataclasses.field(default_factory=Processing)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    hydraulics: bool = False


def identify_to_folder(
    data: Sequence[Path], machine: str | None, tool: str | None, heldout: str | None,
    sensors: str | None, target: Path | None, as_json: bool, choices: Choices,
    force: bool = False,
) -> Path:  # fmt: skip
    """Identify a machine from logs and write the results to a folder.

    The output folder is written completely or not at all.

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

    Returns:
        The output folder.

    Raises:
        InputError: data, machine or target are not usable.
    """
    target = target or Path(f"identify_{data_name(data)}")
    check_target(target, "identify")
    stop_profiling_clock()
    model = machine_of(data, machine, tool)
    dataset = load_dataset(list(data), model, sensors, heldout, force=force)
    with stages(f"identify {model.name}", as_json) as progress:
        say = progress or (lambda said, share: None)
        say("mechanism", 0.0)
        mechanism, hydraulics = identify_mechanism(dataset, choices), None
        if choices.hydraulics:
            better = dataclasses.replace(dataset, machine=mechanism.machine)
            hydraulics = identify_hydraulics(better, progress=progress)
    if mechanism.found is None and hydraulics is None:
        raise InputError(target, mechanism.lacking)
    with whole_folder(target, "identify") as folder:
        write_identification(folder, dataset, mechanism, hydraulics, data, choices)
    print_result(
        identify_document(mechanism.found, hydraulics, mechanism.best),
        as_json,
        lambda: _print(mechanism, hydraulics, dataset),
        target,
    )
    return target


def identify_mjcf_to_folder(
    data: Sequence[Path], mjcf: Path, columns: Path | None, heldout: str | None,
    target: Path | None, as_json: bool, processing: Processing, estimator: Estimator,
) -> Path:  # fmt: skip
    """Identify a mechanism given as an MJCF file and write the results to a folder.

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
    """
    from hydrotele.show.identify_report import LearnedFrom, write_identify_report

    target = target or Path(f"identify_{data_name(data)}")
    check_target(target, "identify")
    mechanism = load_mechanism(mjcf, columns)
    name = mechanism.setup.chain.name
    fit, judge, said = mechanism_records(data, mechanism, heldout, processing.period)
    with stages(f"identify {name}", as_json) as progress:
        if progress:
            progress("mechanism", 0.0)
        found = identify_with_shapes(
            fit, judge, mechanism.setup, processing, estimator, notes=said
        )  # fmt: skip
    with whole_folder(target, "identify") as folder:
        document = plain(identify_document(found))
        write_json(folder / "identify.json", document)
        learned = LearnedFrom(name, None, tuple(run.name for run in fit), judge.name)
        write_identify_report(learned, found, None, None, folder / "report.html")
        summary = {
            "kind": "identify", "mjcf": str(mjcf), "columns": str(columns) if columns else None,
            "data": [str(path) for path in data], "heldout": judge.name,
            "status": document["status"], "hydrotele": hydrotele.__version__,
        }  # fmt: skip
        write_json(folder / "summary.json", summary)
    print_result(
        identify_document(found), as_json, lambda: _print_mechanism(found, judge.name), target
    )
    return target


def identify_mechanism(dataset: Dataset, choices: Choices) -> MechanismResult:
    """Identify bodies, friction and offsets of a machine.

    Args:
        dataset: logs of the machine.
        choices: options of the identification.

    Returns:
        The identified parameters and the machine that has them.

    Raises:
        InputError: the logs do not contain forces, and `choices.hydraulics` is False.
    """
    try:
        fit, heldout, said = records(dataset)
    except InputError as error:
        if not choices.hydraulics:
            raise
        return MechanismResult(None, None, dataset.machine, str(error))
    setup = machine_setup(
        dataset.machine, closed_chain(dataset.machine), choices.model, pins=choices.pins,
        asymmetry=choices.asymmetry,
    )  # fmt: skip
    found = identify_with_shapes(
        fit, heldout, setup, choices.processing, choices.estimator, notes=(*dataset.notes, *said)
    )  # fmt: skip
    patched, best = identified_machine(dataset.machine, found, cylinder_bars(dataset.machine))
    return MechanismResult(found, best, patched)


def write_identification(
    folder: Path, dataset: Dataset, mechanism: MechanismResult, hydraulics: Hydraulics | None,
    data: Sequence[Path], choices: Choices,
) -> None:  # fmt: skip
    """Write `identify.json`, `report.html`, the identified machine and `summary.json`."""
    found, patched = mechanism.found, hydraulics.machine if hydraulics else mechanism.machine
    document = plain(identify_document(found, hydraulics, mechanism.best))
    write_json(folder / "identify.json", document)
    made = folder / "identified"
    made.mkdir()
    save_machine(patched, made / MACHINE_FILE)
    build_plant(patched).document.save(made / "machine.xml")
    from hydrotele.show.identify_report import LearnedFrom, write_identify_report

    notes.print("writing report.html ...", style="dim")
    learned = LearnedFrom(
        dataset.machine.name, dataset.machine.tool, tuple(run.name for run in dataset.fit),
        dataset.heldout.name, tuple(dataset.notes),
    )  # fmt: skip
    write_identify_report(learned, found, hydraulics, mechanism.best, folder / "report.html")
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


def _print(mechanism: MechanismResult, hydraulics: Hydraulics | None, dataset: Dataset) -> None:
    if mechanism.found:
        _print_mechanism(mechanism.found, dataset.heldout.name)
    else:
        out.print(f"[yellow]note[/] {mechanism.lacking}")
    if hydraulics:
        title = "hydraulic parameters"
        rows = table(title, "parameter", "given", "identified", "std. dev.", "unit")
        for n in hydraulics.numbers:
            shown = (f"{n.value:.6g}", f"{n.std:.2g}") if n.told else ("not identifiable", "")
            rows.add_row(n.name, f"{n.nominal:.6g}", *shown, n.unit)
        out.print(rows)
        out.print(
            f"one-step prediction errors on {dataset.heldout.name}: {hydraulics.before:.3g} times"
            f" noise with the given and {hydraulics.after:.3g} times noise with the identified"
            f" hydraulics; {hydraulics.status}"
        )


def _print_mechanism(found: Identification, heldout: str) -> None:
    rows = parameter_rows(found)
    many = counts(rows)
    out.print(f"[bold]{found.status}[/]", soft_wrap=True)
    title = "identified parameters and combinations"
    shown = table(title, "parameter", "given", "identified", "std. dev.", "unit")
    for row in rows:
        if row.value is None or row.std is None:
            continue
        name = row.name + (" + ..." if row.combination else "")
        shown.add_row(name, f"{row.nominal:.6g}", f"{row.value:.6g}", f"{row.std:.2g}", row.unit)
    out.print(shown)
    for status, number in many.items():
        out.print(f"{number:4d} {status}: {MEANING[status]}")
    judged = table(
        f"RMS force error on {heldout}, not fitted, below {found.band:.3g} Hz (lower is better)",
        "drive", "given model", "identified", "noise alone", "unit", "relative",
    )  # fmt: skip
    for drive, h in found.heldout.items():
        judged.add_row(drive, f"{h.nominal_rms:.4g}", f"{h.rms:.4g}", f"{h.noise_rms:.4g}", h.unit,
                       f"{100 * h.relative:.2f} %")  # fmt: skip
    out.print(judged)
    distance, limit = found.distance(found.nominal)
    out.print(
        f"the given parameters lie {'in' if distance <= limit else 'out'}side the joint 95 %"
        f" confidence ellipsoid: squared distance {distance:.3g}, limit {limit:.3g}"
    )
    out.print(
        f"condition number {found.estimate.condition:.3g}, computing time {found.seconds:.1f} s"
    )
    for note in found.notes:
        out.print(f"[yellow]note[/] {note}")


def excite_to_file(
    machine: str, tool: str | None, sensors: str | None, target: Path, period: float,
    harmonics: int, starts: int, seed: int, cycles: float, as_json: bool,
) -> Path:  # fmt: skip
    """Design the most informative trajectory of a machine and write it as a scenario.

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
    place = machine if machine in shipped_machines() else str(Path(machine).resolve())
    setup = machine_setup(model, closed_chain(model))
    noise = np.maximum(force_noise(model, named), 1e-9)
    base = informative_base(model, setup, noise, period, seed)
    with stages(f"excite {model.name}", as_json) as progress:
        found = design_motion(
            MachineLimits(model, setup), setup, noise, base, period=period, harmonics=harmonics,
            starts=starts, seed=seed, progress=progress,
        )  # fmt: skip
    scenario = found.scenario(name, model, cycles, place, sensors=named)
    with replacing(target, ".yaml") as part:
        text = yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)
        part.write_text(text, encoding="utf-8")
    load_scenario(target)
    if as_json:
        print_json({
            "file": str(target), "criterion": found.criterion, "parameters": found.parameters,
            "largest_use_of_a_limit": found.worst,
        })  # fmt: skip
    else:
        out.print(
            f"trajectory with a period of {period:g} s for {found.parameters} parameters; it uses"
            f" its most restrictive limit to {100 * found.worst:.0f} %"
        )
        notes.print(f"hydrotele run {target}", style="dim")
        out.print(f"written to [bold]{target}[/]")
    return target

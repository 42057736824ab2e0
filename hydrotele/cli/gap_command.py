"""Implement `hydrotele gap`: find differences between a model and logs, and correct the model.

The result is a report, `gap.json`, a recording and the patched machine. The module handles
hydraulic machines as well as mechanisms without hydraulics that are given as MJCF.
"""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

import hydrotele
from hydrotele.cli.console import (
    make_table,
    print_result,
    show_stages,
    stderr_console,
    stdout_console,
    write_json,
)
from hydrotele.cli.contact_command import ContactOption, load_dataset_without_contact
from hydrotele.cli.input_logs import derive_data_name, load_machine_for_logs
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.effects import EFFECTS
from hydrotele.gap.description import effect_title, headline, verdict_words
from hydrotele.gap.interim import Interim
from hydrotele.gap.patched import add_head, has_patch, write_effects, write_patch
from hydrotele.gap.posterior import write_posterior
from hydrotele.gap.result import Gap, finite, gap_document, in_customary_units
from hydrotele.identify.joint_motion import Processing, compute_joint_motion, estimate_resolution
from hydrotele.identify.mechanism import Mechanism, load_mechanism, load_mechanism_records
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, save_machine
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.open_loop_prediction import open_loop_errors

_COLOURS = {
    "named": "blue", "partly": "magenta", "no_gap": "green", "ambiguous": "yellow",
    "unknown": "red", "learned": "magenta",
}  # fmt: skip
_COLUMNS = ("effect", "parameter", "given model", "estimate", "95 % interval", "unit")


def gap_to_folder(
    data: Sequence[Path], machine: str | None, tool: str | None, heldout: str | None,
    sensors: str | None, target: Path | None, as_json: bool, recording: bool,
    effects: Sequence[str] = (), jobs: int | None = None, force: bool = False,
    mask: Path | None = None, contact: ContactOption = "mask",
) -> Path:  # fmt: skip
    """Find the effects that explain the differences (gap) between a machine model and its logs.

    The results are printed and written to a folder, with the corrected machine. The output folder is
    written completely or not at all. Until then, the folder `TARGET.interim` holds the best answer so far.

    Args:
        data: log files, folders of logs, run folders.
        machine: machine model, None for that named by the logs.
        tool: tool of the machine, None for that of the logs.
        heldout: name of the held-out run, None for `test*`, else the last run.
        sensors: name of the machine's sensor set, None for that named by the logs.
        target: output folder, default `gap_<data>`.
        as_json: print `gap.json` instead of text.
        recording: whether to write the rerun recording.
        effects: names of the effects to test; if empty, all effects.
        jobs: number of processes, None for 2.
        force: accept logs whose metadata name another machine or tool.
        mask: CSV file of masked intervals, which are not used.
        contact: `mask` to mask intervals of detected contact and loads, `ignore` to use all rows.

    Returns:
        The output folder.

    Raises:
        InputError: data, machine, effects or target are not usable.
    """
    for name in effects:
        if name not in EFFECTS:
            raise InputError(f"--effect {name}", f"is not known; {suggest_valid_name(name, EFFECTS)}")
    target = target or Path(f"gap_{derive_data_name(data)}")
    check_output_folder(target, "gap")
    stop_profiling_clock()
    model = load_machine_for_logs(data, machine, tool)
    dataset = load_dataset_without_contact(data, model, sensors, heldout, force, contact, mask)
    with keep_interim_answer(target) as interim:
        gap = _run_search(dataset, effects, jobs, as_json, interim.keep)
        interim.finish(gap)
        with atomic_folder(target, "gap") as folder:
            write_gap_files(gap, dataset, folder, recording, data)
    print_result(gap_document(gap), as_json, lambda: _print(gap), target)
    return target


class InterimFolder:
    """The folder `TARGET.interim` of a search.

    Attributes:
        path: the folder.
        content: names of its files, empty before the first answer.
    """

    def __init__(self, path: Path) -> None:
        """Store the path; the folder is written with the first answer."""
        self.path, self.content = path, ""

    def keep(self, answer: Interim) -> None:
        """Write the best answer so far: `interim.json` and the corrected machine, `machine.yaml`."""
        self._write("interim.json", answer.document, answer.machine)

    def finish(self, gap: Gap) -> None:
        """Write the result of the search, `gap.json` and `machine.yaml`, before report and recording are made."""
        self._write("gap.json", gap_document(gap), gap.patched)

    def _write(self, name: str, document: dict, machine: Machine) -> None:
        with atomic_folder(self.path, "interim gap") as folder:
            write_json(folder / name, document)
            save_machine(machine, folder / MACHINE_FILE)
            write_json(folder / "summary.json", {"kind": "interim gap", "hydrotele": hydrotele.__version__})
        self.content = f"{name} and {MACHINE_FILE}"


@contextlib.contextmanager
def keep_interim_answer(target: Path) -> Iterator[InterimFolder]:
    """Let a search store its answers in the folder `TARGET.interim`; delete it after success.

    If the context ends with an error or with Ctrl-C, the folder stays and its path is printed on
    stderr.

    Args:
        target: final output folder of the search.

    Yields:
        The folder.

    Raises:
        InputError: the interim folder cannot be written.
    """
    place = target.with_name(f"{target.name}.interim")
    check_output_folder(place, "interim gap")
    interim = InterimFolder(place)
    try:
        yield interim
    except BaseException:
        if interim.content:
            stderr_console.print(
                f"The command did not end; its best answer so far is in {place}: {interim.content}.", soft_wrap=True
            )
        raise
    shutil.rmtree(place, ignore_errors=True)


def write_gap_files(
    gap: Gap, dataset: Dataset, folder: Path, recording: bool = True, data: Sequence[Path] = ()
) -> None:
    """Write the result of a search for model errors: `gap.json`, report, summary and recording.

    The corrected machine is written to `patched/` if it differs from the given one, and samples of the
    changed parameters to `posterior.parquet`. If the search proposes a next experiment, its scenario is
    written as well.

    Args:
        gap: result of the search.
        dataset: logs that were used.
        folder: existing output folder.
        recording: whether to write the rerun recording.
        data: paths of the logs, stored in `summary.json`.
    """
    write_json(folder / "gap.json", gap_document(gap))
    if has_patch(gap) or gap.patched.sensors != gap.machine.sensors:
        from hydrotele.simulate.plant import build_plant

        patched = folder / "patched"
        patched.mkdir()
        write_patch(gap, patched)
        build_plant(gap.patched).document.save(patched / "machine.xml")
    if gap.posterior:
        write_posterior(gap.posterior, folder)
    if scenario := (gap.next_experiment or {}).get("scenario"):
        text = yaml.safe_dump(finite(scenario), sort_keys=False)
        (folder / "next_experiment.yaml").write_text(text, encoding="utf-8")
    from hydrotele.show.gap_report import write_report

    stderr_console.print("writing report.html ...", style="dim")
    write_report(gap, folder / "report.html")
    if recording:
        from hydrotele.show.gap_recording import write_gap_recording

        stderr_console.print("writing recording.rrd ...", style="dim")
        write_gap_recording(folder / "recording.rrd", gap, dataset.heldout, dataset.axes)
    summary = {
        "kind": "gap",
        "machine": gap.machine.name,
        "tool": gap.machine.tool,
        "data": [str(path) for path in data],
        "heldout": dataset.heldout.name,
        "verdict": gap.verdict,
        "hydrotele": hydrotele.__version__,
    }
    write_json(folder / "summary.json", summary)


def gap_mjcf_to_folder(
    data: Sequence[Path], mjcf: Path, columns: Path | None, heldout: str | None,
    target: Path | None, as_json: bool, effects: Sequence[str] = (),
) -> Path:  # fmt: skip
    """Find the effects that explain the differences (gap) between an MJCF mechanism and its logs.

    The mechanism has no hydraulics. The results are printed and written to a folder.

    Args:
        data: log files, folders of logs.
        mjcf: MJCF file of the mechanism, whose loops are closed by `connect` and `weld`.
        columns: YAML file that assigns log columns, None if the columns have standard names.
        heldout: name of the held-out run, None for `test*`, else the last run.
        target: output folder, default `gap_<data>`.
        as_json: print `gap.json` instead of text.
        effects: names of the effects to test; if empty, all effects.

    Returns:
        The output folder.

    Raises:
        InputError: data, mechanism, mapping, effects or target are not usable.
    """
    from hydrotele.gap.force_find import find_force_gap
    from hydrotele.gap.patched import COLUMNS_FILE, write_mechanism
    from hydrotele.show.gap_report import write_report

    target = target or Path(f"gap_{derive_data_name(data)}")
    check_output_folder(target, "gap")
    mechanism = load_mechanism(mjcf, columns)
    fit, judge, said = load_mechanism_records(data, mechanism, heldout, keep_measured_joints=True)
    with show_stages(f"gap {mechanism.setup.chain.name}", as_json) as progress:
        gap = find_force_gap(mjcf, columns, fit, judge, progress, effects, said)
        if progress:
            progress("simulate the models with the measured forces", 0.95)
        try:
            gap = dataclasses.replace(gap, open_loop=compute_open_loop_errors(gap, data, mechanism, heldout))
        except InputError as error:
            note = f"No open-loop prediction: {error}."
            gap = dataclasses.replace(gap, notes=(*gap.notes, note))
    with atomic_folder(target, "gap") as folder:
        write_json(folder / "gap.json", gap_document(gap))
        if gap.patched is not gap.machine:
            patched = folder / "patched"
            patched.mkdir()
            write_mechanism(patched, gap.patched.mjcf, gap.patched.mapping)
            add_head(gap, patched / COLUMNS_FILE)
            write_effects(gap, patched)
        write_report(gap, folder / "report.html")
        summary = {
            "kind": "gap", "machine": gap.machine.name, "mjcf": str(mjcf),
            "columns": str(columns) if columns else None, "data": [str(path) for path in data],
            "heldout": judge.name, "verdict": gap.verdict, "hydrotele": hydrotele.__version__,
        }  # fmt: skip
        write_json(folder / "summary.json", summary)
    print_result(gap_document(gap), as_json, lambda: _print(gap), target)
    return target


def find_mechanism_files(
    machine: str | None, mjcf: Path | None, columns: Path | None
) -> tuple[Path | None, Path | None]:
    """Return MJCF and column file if the options select a mechanism without hydraulics.

    Args:
        machine: name of a machine, or of a shipped model without `machine.yaml`, which is a
            mechanism.
        mjcf: MJCF file of a mechanism.
        columns: YAML file that assigns log columns; None for `columns.yaml` of the shipped model,
            if it has one.

    Returns:
        (MJCF file, column file or None); (None, None) if the options select a machine.

    Raises:
        InputError: `columns` without a mechanism, or both a mechanism and a machine.
    """
    if mjcf is not None:
        if machine:
            raise InputError("--machine", "cannot be combined with --mjcf: give one of them")
        return mjcf, columns
    path = models_folder() / machine / f"{machine}.xml" if machine else None
    if path is None or not path.is_file() or (path.parent / MACHINE_FILE).is_file():
        if columns is not None:
            raise InputError(
                "--columns",
                "applies to mechanisms only: give --mjcf or a shipped model without machine.yaml, such as palida",
            )
        return None, None
    beside = path.parent / "columns.yaml"
    return path, columns or (beside if beside.is_file() else None)


_OPEN_LOOP_HORIZON = 0.25  # s; short, because an unstable mechanism diverges without control


def compute_open_loop_errors(
    gap: Gap, data: Sequence[Path], mechanism: Mechanism, heldout: str | None
) -> dict[str, Any]:  # fmt: skip
    """Compute position errors of open-loop simulations of the given and the corrected mechanism model.

    MuJoCo simulates each model for 0.25 s with the measured forces of the held-out run, from
    measured states at several instants of this run. The positions at the end are compared.

    Args:
        gap: result of the search for model errors of a mechanism.
        data: log files, folders of logs.
        mechanism: the given model.
        heldout: name of the held-out run, None for `test*`, else the last run.

    Returns:
        `horizon` [s], and `before` and `after`: {drive: RMS position error [rad] or [m]} of the
        given and the corrected model; `after` only if the model was corrected.

    Raises:
        InputError: forces are missing everywhere in the held-out run, or a simulation fails.
    """
    from hydrotele.gap.patched import COLUMNS_FILE, MJCF_FILE, write_mechanism

    models = {"before": mechanism}
    if gap.patched is not gap.machine:
        with tempfile.TemporaryDirectory() as folder:
            write_mechanism(Path(folder), gap.patched.mjcf, gap.patched.mapping)
            models["after"] = load_mechanism(Path(folder, MJCF_FILE), Path(folder, COLUMNS_FILE))
    out: dict[str, Any] = {"horizon": _OPEN_LOOP_HORIZON}
    for which, one in models.items():
        _, judge, _ = load_mechanism_records(data, one, heldout)
        found = estimate_resolution(judge.position, judge.period, judge.position_noise)
        motion = compute_joint_motion(judge.position, judge.period, found, Processing())
        model = gap.machine if which == "before" else gap.patched
        whole = np.stack([motion.value, motion.rate, motion.acceleration])
        out[which] = open_loop_errors(
            mujoco.MjModel.from_xml_string(model.mjcf), one.setup.chain, one.setup.given_joints, whole,
            judge.force, judge.period, _OPEN_LOOP_HORIZON,
        )  # fmt: skip
    return out


def _run_search(
    dataset: Dataset, effects: Sequence[str], jobs: int | None, quiet: bool,
    keep: Callable[[Interim], None],
) -> Gap:  # fmt: skip
    from hydrotele.gap.find import find_gap

    with show_stages(f"gap {dataset.machine.name}", quiet) as progress:
        return find_gap(
            dataset, progress, effects=tuple(effects), jobs=jobs or 2, keep=keep,
            warn=lambda text: stderr_console.print(f"[yellow]check the logs:[/] {text}", soft_wrap=True),
        )  # fmt: skip


def _print(gap: Gap) -> None:
    for error in gap.initial.errors if gap.initial else ():
        stdout_console.print(f"[yellow]check the logs:[/] {error.description}", soft_wrap=True)
    stdout_console.print(f"[bold {_COLOURS[gap.verdict]}]{headline(gap)}[/]", soft_wrap=True)
    for words in gap.unused_channels:
        stdout_console.print(f"[yellow]not used[/] {words}", soft_wrap=True)
    for words in verdict_words(gap):
        stdout_console.print(words, markup=False)
    if gap.effects:
        rows = make_table("identified effects", *_COLUMNS)
        for effect in gap.effects:
            for name, estimate in effect.parameters.items():
                s = in_customary_units(estimate, name)
                between = f"{s.low} .. {s.high}"
                rows.add_row(effect_title(effect), name, s.nominal, s.value, between, s.unit)
        rows.columns[4].no_wrap = True
        stdout_console.print(rows)
    for note in gap.notes:
        if note not in gap.unused_channels:
            stdout_console.print(f"[yellow]note[/] {note}")

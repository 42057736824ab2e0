"""Implement `hydrotele contact`, and the option `--contact` of commands that read logs."""

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hydrotele.cli.console import make_table, print_json, print_notes, stdout_console, write_json
from hydrotele.cli.input_logs import open_logs
from hydrotele.control.contact import Contact, contact_masks, detect_contact
from hydrotele.control.log_forces import BLOCK_SECONDS
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.logs.dataset import Dataset, make_dataset
from hydrotele.logs.log import Log, save_log
from hydrotele.logs.masked_intervals import MaskedInterval, find_unmasked_rows, read_mask
from hydrotele.logs.run_files import RunFiles, read_runs
from hydrotele.machine.machine import Machine

ContactOption = Literal["ignore", "mask"]


def load_dataset_without_contact(
    data: Sequence[Path], machine: Machine, sensors: str | None, heldout: str | None, force: bool,
    contact: ContactOption, mask: Path | None = None,
) -> Dataset:  # fmt: skip
    """Load logs for identification, without the intervals in which the tool is in contact or has a load.

    Args:
        data: log files, folders of logs, run folders.
        machine: the machine.
        sensors: name of the sensor set, None for that named by the logs.
        heldout: name of the held-out run, None to choose one.
        force: accept logs whose metadata name another machine or tool.
        contact: `mask` to detect and mask these intervals, `ignore` to use all rows. All rows of a machine
            without an arm with cylinders, or of logs without positions or pressures, are used.
        mask: CSV file of further masked intervals.

    Returns:
        The dataset; its notes state the masked time of each run, or why contact cannot be detected.

    Raises:
        InputError: the logs are not usable.
    """
    files = read_runs(list(data), machine, machine.log_columns, force)
    given = read_mask(mask) if mask else ()
    whole = make_dataset(files, machine, sensors, heldout, given)
    if contact == "ignore" or machine.arm is None or not machine.hydraulic_axes:
        return whole
    try:
        found = detect_contact(files, machine, sensors, given)
    except InputError as error:
        return dataclasses.replace(whole, notes=(f"Contact is not detected: {error}.", *whole.notes))
    masks = contact_masks(found, files)
    if not masks:
        return whole
    try:
        dataset = make_dataset(files, machine, sensors, heldout, (*given, *masks))
    except InputError:
        seconds = sum(mask.end - mask.begin for mask in masks)
        note = (
            f"Contact or a load is detected in {seconds:.1f} s. Too little remains without them, so all rows are used."
            " If the tool was free, the masses, areas or pressure sensors of the model are wrong."
        )
        return dataclasses.replace(whole, notes=(note, *whole.notes))
    notes = tuple(
        f"{name}: contact is detected in {row['contact_s']:.1f} s and a load on the tool in {row['loaded_s']:.1f} s"
        f" of {row['duration_s']:.1f} s; these intervals are masked (--contact ignore uses them)."
        for name, row in summarise_contact(found).items() if row["contact_s"] or row["loaded_s"]
    )  # fmt: skip
    return dataclasses.replace(dataset, notes=(*notes, *dataset.notes))


def summarise_contact(found: Sequence[Contact]) -> dict[str, dict[str, float]]:
    """Return for each run its duration, the time in contact, and the time with a load on the free tool [s]."""
    rows: dict[str, dict[str, float]] = {}
    for one in found:
        row = rows.setdefault(one.run, {"duration_s": 0.0, "contact_s": 0.0, "loaded_s": 0.0, "max_tip_force_n": 0.0})
        row["duration_s"] += float(one.time[-1] - one.time[0]) + BLOCK_SECONDS
        row["contact_s"] += sum(end - begin for begin, end in one.find_intervals(one.is_contact))
        row["loaded_s"] += sum(end - begin for begin, end in one.find_intervals(one.is_loaded))
        size = np.hypot(*(one.force[one.is_contact, one.task.index(k)] for k in ("r", "z")))
        row["max_tip_force_n"] = max(row["max_tip_force_n"], float(size.max(initial=0.0)))
    return rows


def report_contact(
    data: Sequence[Path], machine: str | None, tool: str | None, sensors: str | None, target: Path | None,
    as_json: bool, force: bool = False,
) -> None:  # fmt: skip
    """Print the time in contact of each run; write the masked intervals and logs with the tip force to a folder.

    Args:
        data: log files, folders of logs, run folders.
        machine: the machine, None for that named by the logs.
        tool: tool of the machine, None for that of the logs.
        sensors: name of the sensor set, None for that named by the logs.
        target: output folder, None to write nothing.
        as_json: print JSON instead of a table.
        force: accept logs whose metadata name another machine or tool.

    Raises:
        InputError: the logs are not usable, or contact cannot be detected in them.
    """
    if target is not None:
        check_output_folder(target, "contact")
    opened = open_logs(data, machine, tool, force)
    print_notes(opened.notes)
    found = detect_contact(opened.runs, opened.machine, sensors)
    masks = contact_masks(found, opened.runs)
    document: dict[str, Any] = {"runs": summarise_contact(found), "masked": [m._asdict() for m in masks]}
    if target is not None:
        with atomic_folder(target, "contact") as folder:
            write_json(folder / "contact.json", document)
            write_json(folder / "summary.json", {"kind": "contact", "machine": opened.machine.name})
            with open(folder / "mask.csv", "w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows(
                    [MaskedInterval._fields, *((m.run, f"{m.begin:.3f}", f"{m.end:.3f}") for m in masks)]
                )
            for run in opened.runs:
                own = [one for one in found if one.run == run.name]
                save_log(_add_channels(run, own, masks), folder / f"{run.name}.parquet")
    if as_json:
        print_json(document)
        return
    _print(document)
    if target is not None:
        stdout_console.print(f"written to [bold]{target}[/]", soft_wrap=True)


def _add_channels(run: RunFiles, found: Sequence[Contact], masks: Sequence[MaskedInterval]) -> Log:
    """Return the first log of a run with tip force, its standard deviation, load, contact and valid rows."""
    log = run.logs[0]
    columns = {name: values for name, values in log.columns.items() if np.isfinite(values).all()}
    units = {name: log.units[name] for name in columns}
    time = np.concatenate([one.time for one in found])

    def add_channel(name: str, values: Sequence[np.ndarray], unit: str) -> None:
        columns[name], units[name] = np.interp(log.time, time, np.concatenate(values)), unit

    for k, task in enumerate(found[0].task):
        unit = "N" if task in ("r", "z") else "N m"
        add_channel(f"tip_force.{task}", [one.force[:, k] for one in found], unit)
        add_channel(f"tip_force_std.{task}", [one.force_std[:, k] for one in found], unit)
    add_channel("load", [one.load for one in found], "kg")
    add_channel("load_std", [one.load_std for one in found], "kg")
    add_channel("contact", [one.probability for one in found], "1")
    columns["valid"] = find_unmasked_rows(masks, run.name, log.time + log.origin) * columns.get("valid", 1.0)
    units["valid"] = "1"
    return dataclasses.replace(log, columns=columns, units=units)


def _print(document: dict[str, Any]) -> None:
    table = make_table("Contact of the tool", "run", "duration [s]", "contact [s]", "loaded [s]", "max tip force [kN]")
    for name, row in document["runs"].items():
        values = (row["duration_s"], row["contact_s"], row["loaded_s"], 1e-3 * row["max_tip_force_n"])
        table.add_row(name, *(f"{value:.1f}" for value in values))
    stdout_console.print(table)

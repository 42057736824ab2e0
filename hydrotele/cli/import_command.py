"""Implement `hydrotele import` and `hydrotele export-log`: logs of other programs, and logs as MCAP files."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.text import Text

from hydrotele.cli.console import print_json, print_notes, stderr_console, stdout_console
from hydrotele.cli.input_logs import open_single_log
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.importers.bag_files import is_bag
from hydrotele.importers.conversion import ImportReport, import_log
from hydrotele.importers.proposal import format_mapping, propose_mapping
from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.logs.run_files import command_ranges
from hydrotele.machine.log_columns import LogColumn, log_columns_for, parse_log_column, read_log_columns
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine


def import_logs(
    logs: Sequence[Path], out: Path | None, machine: str | None, tool: str | None, mapping: Path | None,
    merge: bool, as_json: bool,
) -> None:  # fmt: skip
    """Convert logs of other programs to Parquet files.

    Args:
        logs: bags, MATLAB files, CSV or Parquet files.
        out: file, or folder for several runs; None for the name of the first log in the current folder.
        machine: machine whose `log_columns` and command ranges are used, or None.
        tool: tool of the machine.
        mapping: file with the key `log_columns`, which has precedence over the machine, or None.
        merge: whether all logs belong to one run.
        as_json: whether to print the report as JSON.

    Raises:
        InputError: a log cannot be read or written; no file of the failed run is written.
    """
    found = load_machine(machine, tool) if machine else None
    runs = [list(logs)] if merge else [[log] for log in logs]
    targets = _name_targets(runs, out)
    reports = {}
    for run, target in zip(runs, targets, strict=True):
        columns = _find_columns(run[0], found, mapping)
        metadata = {"machine": found.name, "tool": found.tool} if found else {}
        log, report = import_log(run, columns, command_ranges(found) if found else None, metadata)
        save_log(log, target, missing=True)
        reports[str(target)] = report
        if not as_json:
            _print_report(log, report, target)
    if as_json:
        print_json({name: dataclasses.asdict(report) for name, report in reports.items()})


def write_mapping(log: Path, target: Path, machine: str | None, tool: str | None) -> None:
    """Write a proposed mapping of the columns of a log to a YAML file.

    Raises:
        InputError: the log cannot be read, or the file exists.
    """
    if target.exists():
        raise InputError(target, "exists: remove it, or choose another name")
    proposals = propose_mapping(log, load_machine(machine, tool) if machine else None)
    text = format_mapping(proposals, log.name)
    with atomic_file(target, ".yaml") as part:
        part.write_text(text, encoding="utf-8")
    print(text, end="")
    said = f"written to {target}; check it, then: hydrotele import {log} --mapping {target}"
    stderr_console.print(Text(said), soft_wrap=True)


def _find_columns(log: Path, machine: Machine | None, mapping: Path | None) -> dict[str, LogColumn]:
    columns: Mapping[str, str | LogColumn] = machine.log_columns if machine else {}
    if mapping is None:
        return log_columns_for(log, columns)
    return {name: parse_log_column(entry) for name, entry in {**columns, **read_log_columns(mapping)}.items()}


def _name_targets(runs: Sequence[Sequence[Path]], out: Path | None) -> list[Path]:
    """Return the Parquet file of each run.

    Raises:
        InputError: two runs have the same name, or one file is given for several runs.
    """
    is_file = out is not None and out.suffix.lower() == ".parquet"
    if is_file and len(runs) > 1:
        raise InputError("--out", f"names one file for {len(runs)} logs: give a folder, or --merge for one run")
    if is_file:
        assert out
        return [out]
    if out is not None:
        with contextlib.suppress(FileExistsError):
            out.mkdir(parents=True)
    names = [(run[0].name if run[0].is_dir() else run[0].name.partition(".")[0]) or "log" for run in runs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError("the logs", f"two of them would be written to {twice[0]}.parquet: rename one")
    targets = [Path(out or ".") / f"{name}.parquet" for name in names]
    for run, target in zip(runs, targets, strict=True):
        if any(target.resolve() == log.resolve() for log in run):
            raise InputError(target, "is a log to be imported and would be overwritten: give --out")
    return targets


def _print_report(log: Log, report: ImportReport, target: Path) -> None:
    width = max(len(channel.channel) for channel in report.channels)
    for channel in report.channels:
        missing = f", {100 * channel.missing:.3g} % missing" if channel.missing else ""
        text = f"{channel.samples} values at {channel.rate:.4g} Hz, {channel.placement}{missing}"
        print(f"{channel.channel:<{width}}  {channel.source}: {text}")
    if report.ignored:
        listed = sorted(report.ignored.items(), key=lambda item: -item[1])
        more = f" and {len(listed) - 10} more" if len(listed) > 10 else ""
        text = ", ".join(f"{name} ({count})" for name, count in listed[:10])
        stderr_console.print(Text(f"ignored: {text}{more}"), soft_wrap=True)
    if report.unused:
        print_notes([f"the mapping names {', '.join(report.unused)}, which the log does not contain."])
    print_notes(report.notes)
    stdout_console.print(f"{len(log)} rows written to [bold]{target}[/]", soft_wrap=True)


def export_log(path: Path, mcap: Path, machine: str | None, tool: str | None, force: bool) -> None:
    """Write a log as an MCAP file.

    Args:
        path: log file, folder with one log, or run folder.
        mcap: file to write.
        machine: machine of the log, None without one.
        tool: tool of the machine.
        force: accept a log whose metadata names another machine or tool.

    Raises:
        InputError: the log cannot be read, or the file cannot be written.
    """
    from hydrotele.importers.mcap_export import write_mcap

    if is_bag(path):
        raise InputError(path, "is a bag, not a log: import it first")
    log = open_single_log(path, machine, tool, force).logs[0] if machine else load_log(path)
    count = write_mcap(log, mcap)
    stdout_console.print(f"{count} messages written to [bold]{mcap}[/]", soft_wrap=True)

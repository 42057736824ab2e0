"""Find and read the log files of runs, and check that they belong to the machine.

Supported paths are `.parquet` and `.csv` files, folders of them, run folders of `hydrotele run`
(`measured.parquet` is read, `truth.parquet` never), and folders of run folders. Files named
`<run>.<part>.parquet`, or with the same `run` metadata, form one run. They are combined only if no
two of them have the same sensor channel, because repeated runs often have the same name.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.logs.log import CommandRange, Log, find_logs, load_log
from hydrotele.machine.log_columns import LogColumn
from hydrotele.machine.machine import Machine


class RunFiles(NamedTuple):
    """Name of a run and its logs, one per file of the run."""

    name: str
    logs: tuple[Log, ...]


def read_runs(
    paths: Sequence[str | Path], machine: Machine, aliases: Mapping[str, str | LogColumn], force: bool,
    keep_truth: bool = False,
) -> tuple[RunFiles, ...]:  # fmt: skip
    """Read all logs and group them into runs.

    Args:
        paths: files and folders.
        machine: the machine that the logs must belong to.
        aliases: column name in a file -> channel.
        force: accept logs whose metadata names another machine or tool.
        keep_truth: keep channels that only a simulator knows.

    Returns:
        The runs, sorted by name.

    Raises:
        InputError: a file is invalid or from another machine, or a run exists twice.
    """
    groups: dict[str, list[Log]] = {}
    named = [pair for path in paths for pair in find_logs(Path(path))]
    if not named:
        raise InputError("the data", "no path was given: give log files or a folder with logs")
    if twice := {str(f) for i, (_, f) in enumerate(named) if f in [g for _, g in named[:i]]}:
        raise InputError(min(twice), "is given twice: give it once")
    logs = []
    for name, file in named:
        log = load_log(file, aliases=aliases, commands=command_ranges(machine))
        if not force:
            _check_machine(log, machine)
        logs.append((name, log if keep_truth else log.without_truth()))
    for name, log in logs:
        groups.setdefault(name.partition(".")[0], []).append(log)
    runs = []
    for stem, found in groups.items():
        names = [name for name, _ in logs if name.partition(".")[0] == stem]
        if len(found) == 1 or _have_distinct_channels(found):
            runs.append((stem if len(found) > 1 else names[0], tuple(found)))
        else:
            runs += [(name, (log,)) for name, log in zip(names, found, strict=True)]
    runs = _join_runs_by_metadata(runs)
    for i, (name, found) in enumerate(runs):
        for other, others in runs[:i]:
            if other == name:
                message = f"run {name!r} exists twice, also as {others[0].source}: rename one"
                raise InputError(found[0].source, message)
    return tuple(RunFiles(name, align_time_origins(found)) for name, found in sorted(runs, key=lambda run: run[0]))


def align_time_origins(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Return the logs of one run with their times shifted so that all are counted from the same instant.

    The times of a log with calendar time stamps are counted from its `origin`. The logs are shifted
    to the origin that is closest to 0. If only some of the logs have calendar time, all are
    returned unchanged.
    """
    origins = [log.origin for log in logs]
    first = min(origins, key=abs)
    if len(set(origins)) == 1 or first == 0.0:
        return tuple(logs)
    return tuple(dataclasses.replace(log, time=log.time + (log.origin - first), origin=first) for log in logs)


def command_ranges(machine: Machine) -> dict[str, CommandRange]:
    """Return the range and unit of each command channel that logs do not contain as a fraction in [-1, 1].

    Logs contain these commands for example in volts. The machine file states the ranges.

    Returns:
        Command channel -> range.
    """
    return {
        f"command.{name}": CommandRange(axis.command_unit, *axis.command_range)
        for name, axis in machine.axes.items()
        if axis.command_range != (-1.0, 1.0)
    }


def _sensor_channels(log: Log) -> set[str]:
    others = ("command.", "reference.", "valid")
    return {name for name in log.columns if not name.startswith(others)}


def _have_distinct_channels(logs: Sequence[Log]) -> bool:
    """Return whether no two logs have the same sensor channel."""
    channels = [channel for log in logs for channel in _sensor_channels(log)]
    return len(channels) == len(set(channels))


def _join_runs_by_metadata(runs: list[tuple[str, tuple[Log, ...]]]) -> list:
    groups: dict[str, list[tuple[str, tuple[Log, ...]]]] = {}
    for name, logs in runs:
        groups.setdefault(logs[0].metadata.get("run", name), []).append((name, logs))
    joined = []
    for run, members in groups.items():
        logs = tuple(log for _, found in members for log in found)
        joined += [(run, logs)] if len(members) > 1 and _have_distinct_channels(logs) else members
    return joined


def _check_machine(log: Log, machine: Machine) -> None:
    stated = log.metadata.get("machine", machine.name)
    words, own = set(stated.lower().split("_")), set(machine.name.lower().split("_"))
    if not (words <= own or own <= words):  # `volvo_ec20` is an ec20
        raise InputError(
            log.source,
            f"is a log of the machine {stated!r}, the model is {machine.name!r}: choose the model"
            " of that machine, remove the log, or use --force if only the name differs",
        )
    tool = log.metadata.get("tool", machine.tool)
    if tool != machine.tool:
        raise InputError(
            log.source,
            f"was logged with the tool {tool!r}, the model has {machine.tool!r}: load the model"
            f" with tool {tool!r}, remove the log, or use --force if only the name differs",
        )


def check_commands(run: RunFiles, machine: Machine) -> None:
    """Check that a run contains the command of every axis of a machine, in the unit of the axis' drive.

    Raises:
        InputError: a command is missing or has another unit; the message gives file and remedy.
    """
    for name, axis in machine.axes.items():
        channel, unit = f"command.{name}", axis.force.command_unit if axis.force else "1"
        holders = [log for log in run.logs if channel in log]
        if not holders:
            has = ", ".join(dict.fromkeys(c for log in run.logs for c in log.columns))
            raise InputError(
                ", ".join(log.source for log in run.logs),
                f"needs the column {channel}, the command of {name}; it has {has or 'none'}. Log"
                f" the command [{unit}]; use 0 in all rows if the axis was not driven",
            )
        for log in holders:
            if log.units[channel] != unit:
                raise InputError(
                    f"{log.source}, column {channel!r}",
                    f"is in {log.units[channel]!r}, the drive needs {unit!r}: convert the column"
                    + (
                        f", or state axes.{name}.command_unit and command_range in the machine file"
                        if axis.valve
                        else ""
                    ),
                )

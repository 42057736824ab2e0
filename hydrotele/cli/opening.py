"""Logs and their machines, as a user names them: run folders, log files, shipped machines."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hydrotele.core.errors import InputError
from hydrotele.logs.files import command_ranges
from hydrotele.logs.log import Log, load_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine

_LOGS = (".parquet", ".csv")


def log_path(path: Path, which: str = "measured") -> Path:
    """The log file that a path means: itself, or the one of that kind in a run folder.

    Raises:
        InputError: neither is there.
    """
    if path.is_dir():
        inside = path / f"{which}.parquet"
        if inside.is_file():
            return inside
        raise InputError(path, f"holds no {which}.parquet; give a log file or a run folder")
    if not path.is_file():
        raise InputError(path, "is neither a log file (.parquet, .csv) nor a run folder")
    return path


def open_log(
    path: Path, machine: str | None = None, tool: str | None = None, which: str = "measured"
) -> tuple[Machine, Log]:
    """A log with its machine.

    The machine is the one named, else the `machine.yaml` beside the log, else the shipped one that
    the log's metadata names.

    Args:
        path: log file or run folder.
        machine: name or folder of a machine, None to find it.
        tool: its tool, None for the log's if the machine has it.
        which: `measured` or `truth`, for run folders.

    Returns:
        (machine, log).

    Raises:
        InputError: the log is not usable, or no machine is known.
    """
    file = log_path(path, which)
    beside = file.parent / MACHINE_FILE
    chosen = machine or (str(beside) if beside.is_file() else None)
    if chosen:
        first = load_machine(chosen, tool)
        log = load_log(file, aliases=first.log_columns, commands=command_ranges(first))
    else:
        log = load_log(file)
        chosen = log.metadata.get("machine")
        if not chosen:
            raise InputError(file, "its metadata names no machine: give --machine")
    found = load_machine(chosen, tool)
    logged = log.metadata.get("tool")
    if tool is None and logged in found.tools:
        found = load_machine(chosen, logged)
    positions = [f"{found.position_kind(axis)}.{axis}" for axis in found.axes]
    if not any(name in log for name in positions):
        message = f"is no log of {found.name}: it has none of {', '.join(positions)}"
        raise InputError(file, message)
    return found, log


def data_name(data: Sequence[Path]) -> str:
    """Name of the data: of the folder, or of the folder that holds the files."""
    first = data[0].resolve()
    return first.name if first.is_dir() else first.parent.name or first.stem


def machine_of(data: Sequence[Path], name: str | None, tool: str | None) -> Machine:
    """The machine named, else the one beside the first log, else the one that the log names."""
    log = _first_log(data[0])
    metadata: Mapping[str, str] = {}
    if name is None and log and (log.parent / MACHINE_FILE).is_file():
        name = str(log.parent / MACHINE_FILE)
    if log and log.suffix.lower() == ".parquet":
        known = load_machine(name, tool) if name else None
        metadata = load_log(
            log, aliases=known.log_columns if known else None, maximum_dropped=1.0, missing=True,
            commands=command_ranges(known) if known else None,
        ).metadata  # fmt: skip
    name = name or metadata.get("machine")
    if not name:
        raise InputError(data[0], "its metadata names no machine: give --machine")
    found = load_machine(name, tool)
    logged = metadata.get("tool")
    return load_machine(name, logged) if tool is None and logged in found.tools else found


def _first_log(path: Path) -> Path | None:
    if not path.is_dir():
        return path if path.is_file() else None
    files = [p for p in sorted(path.rglob("*")) if p.suffix.lower() in _LOGS]
    return next((p for p in files if not p.stem.startswith((".", "truth"))), None)

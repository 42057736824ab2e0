"""Open the logs and machines named on the command line.

Logs are given as run folders, folders of logs or log files. If no machine is given, it is found
next to the log or by the metadata of the log.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.logs.files import command_ranges
from hydrotele.logs.log import Log, find_log_file, load_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine

_LOGS = (".parquet", ".csv")


def open_log(
    path: Path, machine: str | None = None, tool: str | None = None, which: str = "measured"
) -> tuple[Machine, Log]:
    """Load a log and its machine.

    If no machine is given, `machine.yaml` in the folder of the log is used, else the shipped
    machine that the metadata of the log names.

    Args:
        path: log file or run folder.
        machine: name or folder of a machine, None to find it.
        tool: tool of the machine, None for the tool of the log if the machine has it.
        which: `measured` or `truth`, for run folders.

    Returns:
        (machine, log).

    Raises:
        InputError: the log is not usable, or its machine is not known.
    """
    file = find_log_file(path, which)
    beside = file.parent / MACHINE_FILE
    chosen = machine or (str(beside) if beside.is_file() else None)
    if chosen:
        first = load_machine(chosen, tool)
        log = load_log(file, aliases=first.log_columns, commands=command_ranges(first))
    else:
        log = load_log(file)
        chosen = log.metadata.get("machine")
        if not chosen:
            raise InputError(file, "its metadata does not name a machine: give --machine")
    found = load_machine(chosen, tool)
    logged = log.metadata.get("tool")
    if tool is None and logged in found.tools:
        found = load_machine(chosen, logged)
    positions = [f"{found.position_kind(axis)}.{axis}" for axis in found.axes]
    if not any(name in log for name in positions):
        message = f"is not a log of {found.name}: it has none of {', '.join(positions)}"
        raise InputError(file, message)
    return found, log


def name_of_data(data: Sequence[Path]) -> str:
    """Return the name of the data folder, or of the folder that contains the first file."""
    first = resolve_path(data[0])
    return first.name if first.is_dir() else first.parent.name or first.stem


def find_machine(data: Sequence[Path], name: str | None, tool: str | None) -> Machine:
    """Load the machine called `name`, else that next to the first log, else that of its metadata.

    Raises:
        InputError: no machine is known, or the machine is not usable.
    """
    log = _find_first_log(data[0])
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
        raise InputError(data[0], "its metadata does not name a machine: give --machine")
    found = load_machine(name, tool)
    logged = metadata.get("tool")
    return load_machine(name, logged) if tool is None and logged in found.tools else found


def _find_first_log(path: Path) -> Path | None:
    if not path.is_dir():
        return path if path.is_file() else None
    files = [p for p in sorted(path.rglob("*")) if p.suffix.lower() in _LOGS]
    return next((p for p in files if not p.stem.startswith((".", "truth"))), None)

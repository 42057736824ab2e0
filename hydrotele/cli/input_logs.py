"""Open the logs and machines named on the command line.

Logs are given as log files, folders of logs, run folders or folders of run folders. If no machine is
given, it is found next to the log or by the metadata of the log.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.logs.dataset import MergedRuns, merge_runs
from hydrotele.logs.log import Log, find_log_in_folder, find_logs
from hydrotele.logs.run_files import RunFiles, read_runs
from hydrotele.logs.table import read_metadata
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE, load_machine

_MACHINE_SUBFOLDERS = ("patched", "identified")  # subfolders in which `gap` and `identify` write the machine


def find_corrected_machine_folder(name: str) -> str:
    """Return the subfolder with the corrected machine of a result folder of `gap` or `identify`.

    Any other name or folder is returned unchanged.
    """
    for inside in _MACHINE_SUBFOLDERS:
        if (Path(name) / inside / MACHINE_FILE).is_file():
            return str(Path(name) / inside)
    return name


class OpenedLogs(NamedTuple):
    """Logs that were accepted for a machine.

    Attributes:
        machine: the machine.
        runs: logs of each run as recorded, with all channels, also the true states of a simulation.
        merged: the runs after resampling to a uniform sample period.
    """

    machine: Machine
    runs: tuple[RunFiles, ...]
    merged: MergedRuns

    @property
    def logs(self) -> tuple[Log, ...]:
        """All logs as recorded, of all runs."""
        return tuple(log for run in self.runs for log in run.logs)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on repairs of the logs, such as interpolated samples."""
        return self.merged.notes


def open_logs(
    paths: Sequence[Path], machine: str | None = None, tool: str | None = None, force: bool = False
) -> OpenedLogs:
    """Load logs and their machine, check the logs against it, and resample them to uniform sample periods.

    Args:
        paths: log files, folders of logs, run folders.
        machine: name or folder of a machine, None for that next to the log, else that of its
            metadata.
        tool: tool of the machine, None for the tool of the log if the machine has it.
        force: accept logs whose metadata names another machine or tool.

    Raises:
        InputError: a log is not usable, or its machine is not known.
    """
    found = load_machine_for_logs(paths, machine, tool)
    runs = read_runs(paths, found, found.log_columns, force, keep_truth=True)
    return OpenedLogs(found, runs, merge_runs(runs, found))


def open_single_log(path: Path, machine: str | None = None, tool: str | None = None, force: bool = False) -> OpenedLogs:
    """Load the log of a path that contains exactly one, and its machine, and check the log against it.

    Args:
        path: log file, folder with one log, or run folder.
        machine: name or folder of a machine, None for that next to the log, else that of its
            metadata.
        tool: tool of the machine, None for the tool of the log if the machine has it.
        force: accept a log whose metadata names another machine or tool.

    Raises:
        InputError: the log is not usable, its machine is not known, or the path has several logs.
    """
    files = find_logs(path)
    if len(files) > 1:
        names = ", ".join(str(file) for _, file in files[:5])
        raise InputError(path, f"contains {len(files)} logs; give one of them: {names}")
    return open_logs([path], machine, tool, force)


def find_run_log(path: Path, which: str) -> Path:
    """Return the log file called `which`, such as `truth`, of a run folder; for other paths the path itself."""
    return find_log_in_folder(path, which) or path


def find_recording(path: Path) -> Path | None:
    """Return the recording at a path: an `.rrd` file, or the one in a result folder; None without one.

    Raises:
        InputError: the folder has several recordings, or the file does not exist.
    """
    if path.suffix.lower() == ".rrd":
        if not path.exists():
            raise InputError(path, "does not exist: give a recording, log file or run folder")
        return path
    found = sorted(path.glob("*.rrd")) if path.is_dir() else []
    if len(found) > 1:
        names = ", ".join(map(str, found[:5]))
        raise InputError(path, f"contains {len(found)} recordings; give one of them: {names}")
    return found[0] if found else None


def derive_data_name(data: Sequence[Path]) -> str:
    """Return a name for outputs: that of the first path if it is a folder, else of the folder of this file."""
    first = resolve_path(data[0])
    return first.name if first.is_dir() else first.parent.name or first.stem


def find_machine_and_tool_names(data: Sequence[Path], name: str | None) -> tuple[str | None, str | None]:
    """Return the names of machine and tool of logs, None if unknown.

    The machine is `name`, else the file `machine.yaml` next to the first log, else that of the log's
    metadata. The tool is that of the metadata.

    Raises:
        InputError: there is no log at the path, or it cannot be read.
    """
    file = find_logs(data[0])[0][1]
    metadata = read_metadata(file)
    beside = file.parent / MACHINE_FILE
    name = name or (str(beside) if beside.is_file() else metadata.get("machine"))
    return name or None, metadata.get("tool")


def load_machine_for_logs(data: Sequence[Path], name: str | None, tool: str | None) -> Machine:
    """Load the machine of logs, with the given tool or else that of the logs.

    The machine is `name`, else the file `machine.yaml` next to the first log, else that of the log's
    metadata.

    Raises:
        InputError: no machine is known, or the machine is not usable.
    """
    if not data:
        raise InputError("the data", "no path was given: give log files or a folder with logs")
    name, logged = find_machine_and_tool_names(data, name)
    if not name:
        raise InputError(data[0], "its metadata does not name a machine: give --machine")
    found = load_machine(name, tool)
    return load_machine(name, logged) if tool is None and logged in found.tools else found

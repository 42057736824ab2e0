"""Copies of user machine files in the folder of a sweep.

Changes of the originals have no effect, and other computers can receive the copies.
"""

import hashlib
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.machine.machine_file import find_machine_file, shipped_machines
from hydrotele.scenario.scenario import Scenario, find_local_machine, with_absolute_paths

INPUTS = "inputs"
Files = dict[str, bytes]


class CopiedMachine(NamedTuple):
    """A user machine, copied into the folder of a sweep.

    Attributes:
        name: path of the machine file in the sweep folder; the original path if the machine cannot
            be copied because it needs files in addition to its MJCF file.
        files: path in the sweep folder -> content; empty if the machine cannot be copied.
    """

    name: str
    files: Files


class MachineCopies:
    """Copies of the machine files of a sweep that are not shipped with the package, each read once."""

    def __init__(self) -> None:
        """Start without machines."""
        self._known: dict[Path, CopiedMachine] = {}

    def with_copied_paths(self, scenario: Scenario) -> Scenario:
        """Return the scenario with its user machines replaced by the paths of their copies.

        The paths are relative to the sweep folder, and the `folder` of the scenario becomes empty.
        The paths of other files become absolute. The files of a new machine are read.

        Raises:
            InputError: a machine file cannot be read.
        """
        scenario = with_absolute_paths(scenario)
        changes: dict = {"folder": ""}
        if own := find_local_machine(scenario):
            changes["machine"] = self._copied_machine(own).name
        model = scenario.servo.force_model
        if model and model != "nominal" and model not in shipped_machines():
            name = self._copied_machine(Path(model)).name
            changes["servo"] = scenario.servo.model_copy(update={"force_model": name})
        return scenario.model_copy(update=changes)

    def files(self) -> Files:
        """Return the files of all machines read so far, as path in the sweep folder -> content."""
        return {name: text for copied in self._known.values() for name, text in copied.files.items()}

    def files_of(self, scenario: Scenario) -> Files:
        """Return the machine files that one scenario uses, as path in the sweep folder -> content.

        The scenario is a result of `with_copied_paths`.
        """
        names = {scenario.machine, scenario.servo.force_model}
        copied = [machine for machine in self._known.values() if machine.name in names]
        return {name: text for machine in copied for name, text in machine.files.items()}

    def check_sendable(self, where: str) -> None:
        """Check that all machines can be sent to other computers.

        Args:
            where: option or file for the error message.

        Raises:
            InputError: a machine needs files in addition to its MJCF file.
        """
        for path, copied in self._known.items():
            if not copied.files:
                message = "needs files in addition to its MJCF, which cannot be sent; run without --dask"
                raise InputError(where, f"machine {path} {message}")

    def _copied_machine(self, path: Path) -> CopiedMachine:
        file = resolve_path(find_machine_file(path))
        if file not in self._known:
            self._known[file] = _copy_machine(file)
        return self._known[file]


def _copy_machine(file: Path) -> CopiedMachine:
    contents = {file.name: file.read_bytes()}
    mjcf = str(read_yaml(file)[0].get("mjcf") or "")
    if mjcf and (file.parent / mjcf).is_file():  # a resolved machine may name a shipped one
        text = (file.parent / mjcf).read_bytes()
        inside = not PurePosixPath(mjcf).is_absolute() and ".." not in PurePosixPath(mjcf).parts
        if not inside or b" file=" in text:
            return CopiedMachine(str(file), {})
        contents[mjcf] = text
    digest = hashlib.sha256(b"\0".join(part for pair in sorted(contents.items())
                                       for part in (pair[0].encode(), pair[1])))  # fmt: skip
    folder = f"{INPUTS}/{file.parent.name}-{digest.hexdigest()[:12]}"
    return CopiedMachine(f"{folder}/{file.name}", {f"{folder}/{name}": text for name, text in contents.items()})


def with_resolved_paths(scenario: Scenario, folder: Path) -> Scenario:
    """Return the scenario with machine paths that are valid in a given folder.

    The paths were relative to a sweep folder; the copies of the machines are now in `folder`.

    Args:
        scenario: a result of `MachineCopies.with_copied_paths`.
        folder: the folder that contains the copied machines.
    """
    changes: dict = {"folder": str(folder)}
    model = scenario.servo.force_model
    if model and model.startswith(f"{INPUTS}/"):
        servo = scenario.servo.model_copy(update={"force_model": str(folder / model)})
        changes["servo"] = servo
    return scenario.model_copy(update=changes)


def write_files(files: Files, folder: Path) -> None:
    """Write files (relative path -> content) under a folder, and create subfolders as needed."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)

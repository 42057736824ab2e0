"""The files of a sweep's own machines: copied into its folder, so that they can change or travel.

A scenario of a sweep names its own machines by their place in the sweep's folder, as in
`inputs/mine-0a1b2c3d/machine.yaml`; `placed` says where that folder is.
"""

import hashlib
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from hydrotele.core.datafile import read_yaml
from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import machine_path, shipped_machines
from hydrotele.scenario.scenario import Scenario, own_machine

INPUTS = "inputs"
Files = dict[str, bytes]


class Copied(NamedTuple):
    """A machine of the user's.

    Attributes:
        name: of its machine file in the sweep's folder; its own path where it cannot be copied.
        files: path in the sweep's folder -> content; empty where it cannot be copied.
    """

    name: str
    files: Files


class Inputs:
    """The machines of a sweep that are not shipped, each read once."""

    def __init__(self) -> None:
        """Begin with none."""
        self._known: dict[Path, Copied] = {}

    def named(self, scenario: Scenario) -> Scenario:
        """The scenario with its own machines named by their place in the sweep's folder.

        Raises:
            InputError: a machine's file cannot be read.
        """
        changes: dict = {"folder": ""}
        if own := own_machine(scenario):
            changes["machine"] = self._copied(own).name
        model = scenario.servo.force_model
        if model and model != "nominal" and model not in shipped_machines():
            name = self._copied(Path(model)).name
            changes["servo"] = scenario.servo.model_copy(update={"force_model": name})
        return scenario.model_copy(update=changes)

    def files(self) -> Files:
        """Path in the sweep's folder -> content, of all machines so far."""
        return {
            name: text for copied in self._known.values() for name, text in copied.files.items()
        }

    def files_of(self, scenario: Scenario) -> Files:
        """Those of the machines that one scenario of `named` names."""
        names = {scenario.machine, scenario.servo.force_model}
        copied = [machine for machine in self._known.values() if machine.name in names]
        return {name: text for machine in copied for name, text in machine.files.items()}

    def refuse_bound(self, where: str) -> None:
        """Refuse machines that other computers cannot be given.

        Raises:
            InputError: a machine needs further files.
        """
        for path, copied in self._known.items():
            if not copied.files:
                message = "needs files beside its MJCF, which cannot be sent; run it without --dask"
                raise InputError(where, f"machine {path} {message}")

    def _copied(self, path: Path) -> Copied:
        file = machine_path(path).resolve()
        if file not in self._known:
            self._known[file] = _copy(file)
        return self._known[file]


def _copy(file: Path) -> Copied:
    contents = {file.name: file.read_bytes()}
    mjcf = str(read_yaml(file)[0].get("mjcf") or "")
    if mjcf and (file.parent / mjcf).is_file():  # a resolved machine may name a shipped one
        text = (file.parent / mjcf).read_bytes()
        inside = not PurePosixPath(mjcf).is_absolute() and ".." not in PurePosixPath(mjcf).parts
        if not inside or b" file=" in text:
            return Copied(str(file), {})
        contents[mjcf] = text
    digest = hashlib.sha256(b"\0".join(part for pair in sorted(contents.items())
                                       for part in (pair[0].encode(), pair[1])))  # fmt: skip
    folder = f"{INPUTS}/{file.parent.name}-{digest.hexdigest()[:12]}"
    return Copied(
        f"{folder}/{file.name}", {f"{folder}/{name}": text for name, text in contents.items()}
    )


def placed(scenario: Scenario, folder: Path) -> Scenario:
    """A scenario of `Inputs.named` where its machines lie under a folder."""
    changes: dict = {"folder": str(folder)}
    model = scenario.servo.force_model
    if model and model.startswith(f"{INPUTS}/"):
        servo = scenario.servo.model_copy(update={"force_model": str(folder / model)})
        changes["servo"] = servo
    return scenario.model_copy(update=changes)


def unpack(files: Files, folder: Path) -> None:
    """Write files under a folder."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)

"""Create the folder of a machine from a robot description."""

import re
import tempfile
from pathlib import Path
from typing import NamedTuple

from hydrotele.convert.arm_links import arrange_links
from hydrotele.convert.machine_design import MachineDesign, design_machine
from hydrotele.convert.machine_files import write_machine_folder
from hydrotele.convert.robot_description import read_robot
from hydrotele.core.errors import InputError


class NewMachine(NamedTuple):
    """A machine that was written: its folder, the design, and the names of its files."""

    folder: Path
    design: MachineDesign
    files: list[str]


def create_machine(name: str, source: Path, package_paths: tuple[Path, ...] = ()) -> NewMachine:
    """Create a machine from a URDF, xacro or MJCF file.

    Args:
        name: name of the machine, or path of its folder, whose last part is the name.
        source: the file.
        package_paths: additional folders with ROS packages.

    Returns:
        The machine; its folder contains machine.yaml, MJCF, meshes and the scenario moves.yaml.

    Raises:
        InputError: the name or the file is not valid, the folder exists, or the robot has no joint
            for a cylinder.
    """
    folder = Path(name)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", folder.name):
        raise InputError(f"name {folder.name!r}", "must consist of lower-case letters, digits and _, a letter first")
    if folder.exists():
        raise InputError(folder, "exists already; choose another name or remove it")
    design = design_machine(arrange_links(read_robot(source, package_paths)), source)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as part:
        files = write_machine_folder(Path(part, folder.name), folder.name, source.name, design)
        Path(part, folder.name).rename(folder)
    return NewMachine(folder, design, files)

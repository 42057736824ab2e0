"""Find ROS packages and the mesh files of a robot description on this machine."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from hydrotele.core.errors import InputError

_MAX_LEVELS_UP = 6  # folders above the description that are searched: workspace/src/stack/package/urdf/parts
_PACKAGE_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")


class PackageFinder:
    """Folders of ROS packages by name.

    A package is searched next to the description and in the folders above it, then in
    `package_paths`, then in the environment variables ROS_PACKAGE_PATH and AMENT_PREFIX_PATH.
    """

    def __init__(self, description: Path, package_paths: tuple[Path, ...] = ()) -> None:
        """Search for packages from the folder of the file `description`, and in `package_paths`."""
        self.description = description
        self.above = list(description.resolve().parents)[:_MAX_LEVELS_UP]
        self.given = [path.resolve() for path in package_paths]

    def find(self, name: str) -> Path:
        """Return the folder of a package.

        Raises:
            InputError: the package is not found; the message says where it was searched.
        """
        for folder in self._candidates(name):
            if folder.is_dir():
                return folder
        searched = ", ".join(str(path) for path in [self.above[0], *self.given])
        raise InputError(
            self.description,
            f"package {name!r} is not in {searched}, the folders above, ROS_PACKAGE_PATH or AMENT_PREFIX_PATH;"
            " give --package-path FOLDER",
        )

    def _candidates(self, name: str) -> Iterator[Path]:
        for folder in [*self.given, *self.above]:
            manifest = folder / "package.xml"
            if folder.name == name or (manifest.is_file() and _read_package_name(manifest) == name):
                yield folder
            yield folder / name
            yield folder / "src" / name
        for folder in self.given:
            yield from sorted(folder.glob(f"*/{name}"))
        for entry in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
            yield Path(entry) / name
        for entry in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
            yield Path(entry) / "share" / name

    def find_file(self, address: str) -> Path | None:
        """Return the path of a mesh file, or None if it does not exist.

        Args:
            address: `package://NAME/PATH`, `file://PATH` or a path relative to the description.
                If the stated path does not exist, its last parts are searched in the folders of
                the description and above, because descriptions are often moved.
        """
        address = address.strip()
        relative = re.sub(r"^[a-z]+://", "", address)
        if address.startswith("package://"):
            name, _, relative = relative.partition("/")
            try:
                path = self.find(name) / relative
            except InputError:
                path = self.above[0] / relative
        else:
            path = self.above[0] / relative
        if path.is_file():
            return path
        parts = Path(relative).parts
        for first in range(len(parts)):
            for folder in [*self.above[:3], *self.given]:
                moved = folder.joinpath(*parts[first:])
                if moved.is_file():
                    return moved
        return None


def _read_package_name(manifest: Path) -> str:
    found = _PACKAGE_NAME.search(manifest.read_text(encoding="utf-8", errors="replace"))
    return found.group(1) if found else ""

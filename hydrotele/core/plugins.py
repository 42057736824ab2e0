"""Plug-ins: objects that other installed packages provide as entry points.

A package names them in its `pyproject.toml`, for example

    [project.entry-points."hydrotele.tasks"]
    LevelTip = "my_package.tasks:LevelTip"

The groups are `hydrotele.effects`, `hydrotele.tasks`, `hydrotele.pilots` and `hydrotele.importers`.
Effects are loaded when the library of effects is imported. A plug-in of another group is loaded when
it is used, so that a broken one does not stop commands that do not need it.
"""

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path

PLUGIN_GROUPS = ("hydrotele.effects", "hydrotele.tasks", "hydrotele.pilots", "hydrotele.importers")


class Plugin(NamedTuple):
    """An entry point of an installed package.

    Attributes:
        name: name of the entry point.
        package: name of the package.
        source: name and package, for messages.
        entry: the entry point.
    """

    name: str
    package: str
    source: str
    entry: importlib.metadata.EntryPoint

    def load(self) -> Any:
        """Import the object.

        Raises:
            InputError: the package's code raised an exception; the message names plug-in and package.
        """
        try:
            return self.entry.load()
        except (Exception, SystemExit) as error:  # any error of the package's code
            message = f"cannot be loaded: {describe_exception(error)}; update or uninstall the package"
            raise InputError(self.source, message) from error


def find_plugins(group: str) -> dict[str, Plugin]:
    """Return the plug-ins of a group by name, without loading them.

    Args:
        group: such as `hydrotele.tasks`.

    Raises:
        InputError: two packages provide plug-ins of the same name.
    """
    found: dict[str, Plugin] = {}
    for entry in importlib.metadata.entry_points(group=group):
        package = entry.dist.name if entry.dist else "?"
        plugin = Plugin(entry.name, package, f"plug-in {entry.name} of the package {package}", entry)
        known = found.get(entry.name)
        if known and known.entry.value != entry.value:
            message = f"{known.source} has the same name in the group {group}; uninstall one of the packages"
            raise InputError(plugin.source, message)
        found[entry.name] = plugin
    return found


def describe_exception(error: BaseException) -> str:
    """Return type and text of an exception."""
    return f"{type(error).__name__}: {error}"


def is_object_reference(text: str) -> bool:
    """Return whether a text has the form `module:object` or `FILE.py:object`."""
    place, colon, name = text.rpartition(":")
    return bool(colon and place) and name.replace(".", "_").isidentifier()


def load_object(reference: str, folder: str | Path = "") -> Any:
    """Import an object of a user's module or Python file.

    The code runs with all rights of the user.

    Args:
        reference: `module:object` or `FILE.py:object`.
        folder: folder to which the path of a file is relative.

    Returns:
        The object.

    Raises:
        InputError: module or file do not exist or cannot be run, or there is no such object.
    """
    place, _, name = reference.rpartition(":")
    if not is_object_reference(reference):
        raise InputError(reference, "must be module:object or FILE.py:object")
    try:
        module = _run_file(Path(folder, place)) if place.endswith(".py") else importlib.import_module(place)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # any error of the user's code
        raise InputError(reference, f"cannot be imported: {describe_exception(error)}") from error
    found: Any = module
    for part in name.split("."):
        if not hasattr(found, part):
            names = ", ".join(n for n in vars(module) if not n.startswith("_"))
            raise InputError(reference, f"{place} has no {name}; it has {names}")
        found = getattr(found, part)
    return found


def _run_file(path: Path) -> Any:
    """Run a Python file as a module, once per content and process, and return the module."""
    if not path.is_file():
        raise InputError(path, "does not exist")
    key = f"hydrotele_user_{path.stem}_{abs(hash((str(resolve_path(path)), path.read_bytes()))):x}"
    if key in sys.modules:
        return sys.modules[key]
    spec = importlib.util.spec_from_file_location(key, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[key] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[key]
        raise
    return module


def hide_triton_from_torch() -> None:
    """Let torch find no Triton if Mesa's LLVM is loaded, since a second LLVM ends the process.

    Mesa renders with MUJOCO_GL=egl on computers without a GPU; torch needs Triton on a GPU only.
    """
    maps = Path("/proc/self/maps")
    if "triton" not in sys.modules and maps.exists() and "libLLVM" in maps.read_text():
        sys.modules["triton"] = None  # pyright: ignore[reportArgumentType] - the documented way to block an import


def require_library(name: str, extra: str, purpose: str) -> Any:
    """Import an optional library.

    Args:
        name: name of the module.
        extra: extra of this package that installs it.
        purpose: what needs it, for the message.

    Raises:
        InputError: it is not installed.
    """
    loader: Callable[[str], Any] = importlib.import_module
    try:
        return loader(name)
    except ImportError:
        raise InputError(purpose, f"needs {name}: pip install 'hydrotele[{extra}]'") from None

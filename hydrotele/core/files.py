"""Read user files safely: bytes, text, JSON and XML of regular files up to a size limit.

`LIMITS` bounds the size of user input before memory is allocated for it. An environment variable
changes a limit, for example `HYDROTELE_MAX_LOG_VALUES=1e9`. The module also locates the shipped
models and scenarios, and checks and copies the asset files (meshes, textures, height fields) of an
MJCF.
"""

import contextlib
import json
import math
import os
import shutil
import stat
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

from hydrotele.core.errors import InputError

LIMITS: Mapping[str, tuple[float, str]] = MappingProxyType({
    "FILE_BYTES": (32e6, "bytes of a YAML, JSON or MJCF file"),
    "FILE_DEPTH": (100, "nested levels of lists, mappings or elements"),
    "FILE_VALUES": (2e6, "values of a YAML file, after alias expansion"),
    "LOG_VALUES": (1e8, "values of a log, rows times columns"),
    "LOG_COLUMNS": (1e4, "columns of a log"),
    "RUN_TICKS": (2e7, "controller ticks of a run"),
    "RUN_ROWS": (2e6, "logged rows of a run"),
    "MOVES": (1e4, "moves or waypoints of a pilot"),
    "HARMONICS": (1e3, "harmonics of a joint's reference"),
    "ASSET_BYTES": (256e6, "bytes of a mesh, texture or height field"),
})  # fmt: skip
"""Name -> (largest allowed amount, description of the counted quantity)."""


def get_limit(name: str) -> float:
    """Return a limit of `LIMITS`, or the value of its environment variable if that is set.

    Raises:
        InputError: the environment variable is not a positive number.
    """
    variable = f"HYDROTELE_MAX_{name}"
    stated = os.environ.get(variable)
    if stated is None:
        return LIMITS[name][0]
    try:
        value = float(stated)
    except ValueError:
        value = math.nan
    if not value > 0.0:
        raise InputError(variable, f"must be a positive number, not {stated[:40]!r}")
    return value


def describe_excess(name: str, amount: float) -> str | None:
    """Return an error text for an amount above its limit, or None if the limit is respected.

    >>> describe_excess("MOVES", 3)
    >>> describe_excess("MOVES", 20000)
    '20000 moves or waypoints of a pilot, at most 10000; HYDROTELE_MAX_MOVES=20000 allows them'
    """
    most = get_limit(name)
    if amount <= most:
        return None
    asked = f"{amount:.0f}" if amount < 1e7 else f"{amount:.4g}"
    return (f"{asked} {LIMITS[name][1]}, at most {most:g}; HYDROTELE_MAX_{name}={asked} allows them").replace(
        "e+0", "e"
    )


def check_limit(where: object, name: str, amount: float) -> None:
    """Raise an error if an amount exceeds its limit.

    Raises:
        InputError: the limit is exceeded; the message names the variable that raises it.
    """
    if said := describe_excess(name, amount):
        raise InputError(where, f"has {said}")


def read_bytes(path: str | Path, limit: str = "FILE_BYTES") -> bytes:
    """Read the content of a regular file.

    Args:
        path: the file.
        limit: name in `LIMITS` of its size limit.

    Raises:
        InputError: the path is a folder, pipe, device or socket, the file is too large, or it
            cannot be read.
    """
    with open_regular(path) as file:
        check_limit(path, limit, os.fstat(file.fileno()).st_size)
        return file.read()


@contextlib.contextmanager
def open_regular(path: str | Path) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Raises:
        InputError: the path is a folder, pipe, device or socket, or cannot be read.
    """
    try:
        if "\0" in str(path):
            raise InputError(path, "is not a valid file name")
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe does not block
        with open(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError(path, "is not a regular file but a pipe or device")
            yield file
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from None


def read_text(path: str | Path) -> str:
    """Read a regular file as UTF-8 text, without a byte order mark.

    Raises:
        InputError: as `read_bytes`, or the content is not valid UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not valid UTF-8 text: {error.reason}") from None


def read_xml(path: str | Path) -> ElementTree.Element:
    """Read a regular file as XML and return the root element.

    Raises:
        InputError: as `read_bytes`, or the content is not XML or is nested too deeply for MuJoCo.
    """
    content = read_bytes(path)
    depth = deepest = 0
    root: ElementTree.Element | None = None
    try:
        parser = ElementTree.XMLPullParser(("start", "end"))
        parser.feed(content)
        parser.close()
        events: Any = parser.read_events()
        for event, element in events:
            root = element if root is None else root
            depth += 1 if event == "start" else -1
            deepest = max(deepest, depth)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: bad encoding
        raise InputError(path, f"is not XML: {error}") from None
    if root is None:
        raise InputError(path, "is not XML: it has no element")
    check_limit(path, "FILE_DEPTH", deepest)
    return root


def parse_json(text: str | bytes) -> Any:
    """Parse JSON text.

    Raises:
        ValueError: the text is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: str | Path) -> Any:
    """Read a regular file as JSON.

    Raises:
        InputError: as `read_text`, or the content is not JSON.
    """
    try:
        return parse_json(read_text(path))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, f"is not valid JSON: {error}") from None


def _find_data_folder(name: str) -> Path:
    """Return a data folder inside the installed package, or next to the package in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for base in (package, package.parent):
        if (base / name).is_dir():
            return base / name
    raise FileNotFoundError(f"{name} is missing from this installation of hydrotele")


def models_folder() -> Path:
    """Return the folder that has one subfolder per shipped machine."""
    return _find_data_folder("models")


def scenarios_folder() -> Path:
    """Return the folder of the shipped scenarios."""
    return _find_data_folder("scenarios")


_FOLDER_ATTRIBUTES = {"texture": "texturedir"}  # element -> compiler attribute; all others use `meshdir`
_FILE_ATTRIBUTES = (
    "file",
    *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")),
)


def asset_files(tree: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str, str]]:
    """Iterate over the asset files of an MJCF: (element, attribute, path relative to the MJCF)."""
    folders: dict[str, str] = {}
    for compiler in tree.findall("compiler"):
        folders |= compiler.attrib
    for assets in tree.findall("asset"):
        for element in assets:
            kind = _FOLDER_ATTRIBUTES.get(element.tag, "meshdir")
            folder = folders.get(kind, folders.get("assetdir", ""))
            for attribute in _FILE_ATTRIBUTES:
                if file := element.get(attribute):
                    yield element, attribute, os.path.join(folder, file)


def check_assets(tree: ElementTree.Element, mjcf: Path) -> None:
    """Check that all asset files of an MJCF exist, are regular files and are not too large.

    Args:
        tree: root element of the MJCF.
        mjcf: file of the MJCF; asset paths are relative to it.

    Raises:
        InputError: a file fails the check; names the MJCF, the element and the file.
    """
    for element, attribute, file in asset_files(tree):
        where = f"{mjcf}: <{element.tag} {attribute}={element.get(attribute)!r}>"
        try:
            with open_regular(mjcf.parent / file) as opened:
                check_limit(where, "ASSET_BYTES", os.fstat(opened.fileno()).st_size)
        except InputError as error:
            raise InputError(where, error.message) from None


def copy_mjcf(mjcf: Path, target: Path, folder: str) -> bool:
    """Copy an MJCF together with its asset files, so that the copy does not depend on the original.

    Args:
        mjcf: the MJCF file.
        target: path of the copy.
        folder: name of the folder for the asset files, created next to the copy if needed.

    Returns:
        True if it was copied; False for an MJCF with `include` elements, which is not copied.

    Raises:
        InputError: a file is missing or too large.
    """
    tree = read_xml(mjcf)
    if tree.find(".//include") is not None:
        return False
    check_assets(tree, mjcf)
    files = list(asset_files(tree))
    if not files:
        shutil.copyfile(mjcf, target)
        return True
    target.with_name(folder).mkdir(exist_ok=True)
    for number, (element, attribute, file) in enumerate(files):
        source = mjcf.parent / file
        if attribute == "file" and not element.get("name"):
            element.set("name", source.stem)  # MuJoCo's default: the file name
        copy = f"{folder}/{number}_{source.name}"
        shutil.copyfile(source, target.parent / copy)
        element.set(attribute, copy)
    for compiler in tree.findall("compiler"):
        for key in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(key, None)
    ElementTree.ElementTree(tree).write(target, encoding="unicode")
    return True

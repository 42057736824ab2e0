"""Files of users: regular ones, no larger than they may be, as bytes, text or JSON.

What a user's file may ask for before it is refused, and before memory is used for it.

Each limit can be changed by an environment variable of its name, `HYDROTELE_MAX_LOG_VALUES=1e9`.

Where the shipped models and scenarios lie: inside the wheel, or beside a checkout's package.

Files that an MJCF names: meshes, textures and height fields, found beside it and copied.
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
    "FILE_DEPTH": (100, "levels of lists, mappings or elements inside each other"),
    "FILE_VALUES": (2e6, "values of a YAML file, those that aliases repeat included"),
    "LOG_VALUES": (1e8, "values of a log, rows times columns"),
    "RUN_TICKS": (2e7, "ticks of the controller in a run"),
    "RUN_ROWS": (2e6, "rows that a run logs"),
    "MOVES": (1e4, "moves or waypoints of a pilot"),
    "HARMONICS": (1e3, "harmonics of a joint's reference"),
    "ASSET_BYTES": (256e6, "bytes of a mesh, texture or height field"),
})  # fmt: skip
"""Name -> (the most that is allowed, of what)."""


def limit(name: str) -> float:
    """The most that is allowed of a name in `LIMITS`.

    Raises:
        InputError: the environment variable is no positive number.
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


def beyond(name: str, amount: float) -> str | None:
    """What to say of an amount that is beyond its limit, None where it is within.

    >>> beyond("MOVES", 3)
    >>> beyond("MOVES", 20000)
    '20000 moves or waypoints of a pilot, at most 10000; HYDROTELE_MAX_MOVES=20000 allows them'
    """
    most = limit(name)
    if amount <= most:
        return None
    asked = f"{amount:.0f}" if amount < 1e7 else f"{amount:.4g}"
    return (
        f"{asked} {LIMITS[name][1]}, at most {most:g}; HYDROTELE_MAX_{name}={asked} allows them"
    ).replace("e+0", "e")


def check_limit(where: object, name: str, amount: float) -> None:
    """Refuse an amount beyond its limit.

    Raises:
        InputError: it is; says how to allow it.
    """
    if said := beyond(name, amount):
        raise InputError(where, f"has {said}")


def read_bytes(path: str | Path, limit: str = "FILE_BYTES") -> bytes:
    """The content of a regular file.

    Args:
        path: the file.
        limit: name of its size's limit.

    Raises:
        InputError: it is a folder, pipe, device or socket, too large, or cannot be read.
    """
    with open_regular(path) as file:
        check_limit(path, limit, os.fstat(file.fileno()).st_size)
        return file.read()


@contextlib.contextmanager
def open_regular(path: str | Path) -> Iterator[BinaryIO]:
    """A regular file, open for reading.

    Raises:
        InputError: it is a folder, pipe, device or socket, or cannot be read.
    """
    try:
        if "\0" in str(path):
            raise InputError(path, "is no name of a file")
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe does not block
        with open(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError(path, "is no regular file, but a pipe or device")
            yield file
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from None


def read_text(path: str | Path) -> str:
    """The text of a regular file in UTF-8, without a byte order mark.

    Raises:
        InputError: as `read_bytes`, or it is no such text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"cannot be read as text in UTF-8: {error.reason}") from None


def read_xml(path: str | Path) -> ElementTree.Element:
    """The root of the XML in a regular file.

    Raises:
        InputError: as `read_bytes`, or it is no XML, or nested too deeply for MuJoCo to read.
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
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # of its encoding
        raise InputError(path, f"is not XML: {error}") from None
    if root is None:
        raise InputError(path, "is not XML: it holds no element")
    check_limit(path, "FILE_DEPTH", deepest)
    return root


def json_value(text: str | bytes) -> Any:
    """A JSON value.

    Raises:
        ValueError: it is no JSON, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: str | Path) -> Any:
    """The JSON value in a regular file.

    Raises:
        InputError: as `read_text`, or it is no JSON.
    """
    try:
        return json_value(read_text(path))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, f"is not valid JSON: {error}") from None


def _folder(name: str) -> Path:
    package = Path(__file__).resolve().parent.parent
    for base in (package, package.parent):
        if (base / name).is_dir():
            return base / name
    raise FileNotFoundError(f"{name} is missing from this installation of hydrotele")


def models_folder() -> Path:
    """Folder with one folder per shipped machine."""
    return _folder("models")


def scenarios_folder() -> Path:
    """Folder with the shipped scenarios."""
    return _folder("scenarios")


_FOLDERS = {"texture": "texturedir"}  # element -> compiler's attribute; others have `meshdir`
_FILES = ("file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))


def asset_files(tree: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str, str]]:
    """Every file that a document names: (element, attribute, path relative to the document)."""
    folders: dict[str, str] = {}
    for compiler in tree.findall("compiler"):
        folders |= compiler.attrib
    for assets in tree.findall("asset"):
        for element in assets:
            kind = _FOLDERS.get(element.tag, "meshdir")
            folder = folders.get(kind, folders.get("assetdir", ""))
            for attribute in _FILES:
                if file := element.get(attribute):
                    yield element, attribute, os.path.join(folder, file)


def check_assets(tree: ElementTree.Element, mjcf: Path) -> None:
    """Refuse files that are missing, no regular files, or too large, before they are read.

    Args:
        tree: the document.
        mjcf: its file, which paths are relative to.

    Raises:
        InputError: names the document, the element and the file.
    """
    for element, attribute, file in asset_files(tree):
        where = f"{mjcf}: <{element.tag} {attribute}={element.get(attribute)!r}>"
        try:
            with open_regular(mjcf.parent / file) as opened:
                check_limit(where, "ASSET_BYTES", os.fstat(opened.fileno()).st_size)
        except InputError as error:
            raise InputError(where, error.message) from None


def copy_mjcf(mjcf: Path, target: Path, folder: str) -> bool:
    """Copy a document and the files that it names, so that the copies can be handed on.

    Args:
        mjcf: the document.
        target: the copy.
        folder: name of the folder beside the copy that takes the files, where there are any.

    Returns:
        Whether it could: a document that includes others is not copied.

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
            element.set("name", source.stem)  # MuJoCo's choice, which the new name would change
        copy = f"{folder}/{number}_{source.name}"
        shutil.copyfile(source, target.parent / copy)
        element.set(attribute, copy)
    for compiler in tree.findall("compiler"):
        for key in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(key, None)
    ElementTree.ElementTree(tree).write(target, encoding="unicode")
    return True

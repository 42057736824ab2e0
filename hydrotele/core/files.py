"""Read user files safely: bytes, text, JSON and XML of regular files up to a size limit.

`LIMITS` bounds the size of user input before memory is allocated for it. An environment variable
changes a limit, for example `HYDROTELE_MAX_LOG_VALUES=1e9`. The module also locates the shipped
models and scenarios. `hydrotele.core.mjcf` reads MJCF and URDF.
"""

import contextlib
import json
import math
import os
import stat
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO
from xml.parsers import expat

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
    "ASSET_BYTES": (256e6, "bytes of the meshes, textures and height fields of an MJCF"),
    "MJCF_ELEMENTS": (1e4, "elements of an MJCF with all copies by replicate, flexcomp, composite, attach and nkey"),
    "MJCF_VALUES": (1e8, "pixels, height field points and user values of an MJCF"),
    "LINKS": (200, "links of a machine"),
})  # fmt: skip
"""Name -> (largest allowed amount, description of the counted quantity)."""


def get_limit(name: str) -> float:
    """Return the largest allowed amount of a quantity in `LIMITS`, such as "FILE_BYTES".

    The environment variable `HYDROTELE_MAX_<name>` overrides it.

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

    Args:
        where: location for the message, such as a file.
        name: key of `LIMITS`.
        amount: the amount, in the unit of the limit.

    Raises:
        InputError: the limit is exceeded; the message names the environment variable that changes it.
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
        InputError: the file cannot be read, is not XML, is nested too deeply or declares a
            document type.
    """
    return parse_xml(path, read_bytes(path), {})


def parse_xml(
    path: str | Path, content: bytes, origins: dict[ElementTree.Element, tuple[Path, int]]
) -> ElementTree.Element:
    """Parse XML and return the root element.

    Args:
        path: file of the content, for messages.
        content: the bytes of the file.
        origins: receives file and line of every element.

    Raises:
        InputError: the content is not XML, is nested too deeply or declares a document type.
    """
    parser, builder, depth, deepest, file = expat.ParserCreate(), ElementTree.TreeBuilder(), 0, 0, Path(path)

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, deepest
        depth += 1
        deepest = max(depth, deepest)
        origins[builder.start(tag, attributes)] = file, parser.CurrentLineNumber

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse_document_type(*_: Any) -> None:
        raise InputError(path, "declares a document type, which MuJoCo does not read; remove <!DOCTYPE ...>")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = refuse_document_type
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(content, True)
        check_limit(path, "FILE_DEPTH", deepest)
        return builder.close()
    except InputError:
        raise
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: unknown encoding
        raise InputError(path, f"is not XML: {error}") from None


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


def resolve_path(path: str | Path) -> Path:
    """Return the absolute path without symbolic links; a link in a loop is kept.

    `Path.resolve` raises a RuntimeError for such a link. Here the next access to the file fails, with
    an OSError that says why.

    Raises:
        InputError: the path contains a null character.
    """
    if "\0" in str(path):
        raise InputError(path, "is not a valid file name")
    return Path(os.path.realpath(path))


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

"""Files of users: regular ones, no larger than they may be, as bytes, text or JSON."""

import contextlib
import json
import os
import stat
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from hydrotele.core.errors import InputError
from hydrotele.core.limits import check_limit


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

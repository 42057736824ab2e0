"""How numerical functions are compiled: by numba, cached on disk, without checks for division by 0.

numba looks only at the file of a function to see whether its cache is good. Compiled code here
calls compiled code of other files, so the cache of each state of the sources has its own folder.
A cache is code: it lies in the user's cache folder, and no one else may write there.
"""

import contextlib
import hashlib
import os
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba import cfunc, njit
from numba.core import config as _numba_config

_CONFIG: Any = _numba_config  # its settings are made at run time
_UNUSED = 30 * 24 * 3600.0  # s, after which the cache of other sources is removed


def compiled(function):
    """Compile a function on its first call for each kind of argument, with a cache on disk.

    Where no folder for the cache can be written, it is compiled anew in every process. It runs
    without Python's lock, so that threads work side by side.
    """
    return _compile(function)


def lean(function):
    """Like `compiled`, for a function that creates no arrays and returns none.

    References to arrays are then not counted, which takes small functions half their time. A
    function that does create or return an array is refused on its first call.
    """
    return _compile(function, _nrt=False)


def inlined(function):
    """Like `lean`, for a small function whose code is put into that of every caller.

    What a caller does not use of several results, such as a slope, is then not computed, and a
    function whose arguments are constants there costs less.
    """
    return _compile(function, _nrt=False, forceinline=True)


def _compile(function, **options):
    with _caching() as cache:
        return njit(cache=cache, error_model="numpy", nogil=True, **options)(function)


def callback(signature):
    """Decorator that compiles a function for C to call, cached on disk where that is possible."""

    def decorate(function):
        with _caching() as cache:
            return cfunc(signature, cache=cache, error_model="numpy")(function)

    return decorate


def cache_folder() -> Path | None:
    """Folder of the compiled code, `$XDG_CACHE_HOME/hydrotele/...`, made for its owner only.

    None where there is none: no home, a file system without space or for reading, or a folder that
    somebody else owns or may write to.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    if not os.path.isabs(home):
        return None
    folder = Path(home, "hydrotele", f"compiled_{_digest()}")
    try:
        new = not folder.exists()
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not all(map(_private, (folder, folder.parent))) or not os.access(folder, os.W_OK):
            return None
        if new:
            _remove_unused(folder)
    except OSError:
        return None
    return folder


def _private(folder: Path) -> bool:
    found = folder.lstat()
    shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not shared


def _digest() -> str:
    """Of all sources with compiled code: one of them that changes asks for another cache."""
    package = Path(__file__).parent.parent
    texts = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    used = [text for text in texts if b"hydrotele.core.compiled" in text or b"numba" in text]
    return hashlib.sha256(b"".join(used)).hexdigest()[:16]


def _remove_unused(own: Path) -> None:
    for folder in own.parent.glob("compiled_*"):
        if folder != own and time.time() - folder.stat().st_mtime > _UNUSED:
            shutil.rmtree(folder, ignore_errors=True)


_FOLDER = cache_folder()
if _FOLDER:
    with contextlib.suppress(OSError):
        os.utime(_FOLDER)  # it is in use


@contextlib.contextmanager
def _caching() -> Iterator[bool]:
    """Whether there is a cache; functions that are decorated meanwhile find it."""
    given = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = str(_FOLDER or "")
    try:
        yield _FOLDER is not None
    finally:
        _CONFIG.CACHE_DIR = given

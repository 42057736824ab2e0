"""How numerical functions are compiled: by numba, cached on disk, without checks for division by 0.

numba looks only at the file of a function to see whether its cache is good. Compiled code here
calls compiled code of other files, so a checkout's caches are dropped when any of them changed.
"""

import hashlib
from pathlib import Path

from numba import cfunc, njit

_STAMP = "compiled.stamp"


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


def _compile(function, **options):
    try:
        return njit(cache=True, error_model="numpy", nogil=True, **options)(function)
    except RuntimeError:
        return njit(error_model="numpy", nogil=True, **options)(function)


def callback(signature):
    """Decorator that compiles a function for C to call, cached on disk where that is possible."""

    def decorate(function):
        try:
            return cfunc(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:
            return cfunc(signature, error_model="numpy")(function)

    return decorate


def _drop_stale_caches() -> None:
    """Remove numba's cache files of this package if a source with compiled code has changed.

    Where the package folder cannot be written, it was installed, and all its files change together.
    """
    package = Path(__file__).parent
    texts = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    used = [text for text in texts if b"hydrotele.compiled" in text or b"numba" in text]
    digest = hashlib.sha256(b"".join(used)).hexdigest()
    stamp = package / "__pycache__" / _STAMP
    try:
        if stamp.is_file() and stamp.read_text() == digest:
            return
        for cached in (*package.rglob("*.nbi"), *package.rglob("*.nbc")):
            cached.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest)
    except OSError:
        return


_drop_stale_caches()

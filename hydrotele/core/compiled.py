"""How numerical functions are compiled: by numba, cached on disk, without checks for division by 0.

numba looks only at the file of a function to see whether its cache is good. Compiled code here
contains functions and constants of other files, so each module has a cache folder for each state
of its own source and of all sources of the package that it imports, directly or not. A module that
changes leaves the caches of the others alone, and checkouts with the same sources share them.
A cache is code: it lies in the user's cache folder, and no one else may write there.

Compiling is slow, so one process compiles a function and others that need it meanwhile wait for
it, and callbacks for C are compiled when their address is first asked for, not when imported.
"""

import atexit
import contextlib
import fcntl
import functools
import hashlib
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import config as _numba_config
from numba.core import event
from numba.core.caching import FunctionCache, UserProvidedCacheLocator
from numba.core.ccallback import CFunc
from numba.core.sigutils import normalize_signature

from hydrotele.core.compile_progress import SECONDS_BEFORE_BAR, CompileProgress, ProgressLine
from hydrotele.core.linking import Callee, LinkedCache
from hydrotele.core.references import argument_type

_CONFIG: Any = _numba_config  # its settings are made at run time
_UNUSED = 30 * 24 * 3600.0  # s, after which the cache of other sources is removed


def compiled(function):
    """Compile a function on its first call for each kind of argument, with a cache on disk.

    Where no folder for the cache can be written, it is compiled anew in every process. It runs
    without Python's lock, so that threads work side by side.
    """
    return _compile(function)


def allocation_free(function):
    """Like `compiled`, for a function that creates no arrays and returns none.

    References to arrays are then not counted, which takes small functions half their time. A
    function that does create or return an array is refused on its first call.
    """
    return _compile(function, _nrt=False)


def inlined(function):
    """Like `allocation_free`, for a small function whose code is put into that of every caller.

    What a caller does not use of several results, such as a slope, is then not computed, and a
    function whose arguments are constants there costs less.
    """
    return _compile(function, _nrt=False, forceinline=True)


def _compile(function, **options: Any):
    """Make a dispatcher for calls from Python and one for calls from compiled functions.

    The second has no wrapper that converts Python objects, which takes a fifth of the time to
    compile, and most functions are never called from Python.
    """
    with _caching(function.__module__) as cache:
        options |= {
            "cache": cache, "error_model": "numpy", "nogil": True,
            "no_cfunc_wrapper": True,  # for calls by address, which takes a fifth of the time
        }  # fmt: skip
        compile_with: Any = njit  # whose type states only some of its options
        made = compile_with(**options)(function)
        called = compile_with(**options, no_cpython_wrapper=True)(function)
        if cache:
            made._cache, called._cache = _SharedCache(function), _CalledCache(function)
    callee = Callee(called, inline=options.get("forceinline", False))
    made.get_call_template, made.get_overload = callee.call_template, callee.overload
    type_of = made.typeof_pyval
    made.typeof_pyval = lambda value: argument_type(type_of(value))
    return made


def callback(signature):
    """Decorator that makes a `Callback` of a function, for C to call."""
    return lambda function: Callback(function, signature)


class Callback:
    """A function for C to call: compiled when first asked for, cached on disk where possible."""

    def __init__(self, function, signature) -> None:
        self._function, self._signature = function, signature

    def compile_elsewhere(self, then: str = "") -> None:
        """Begin to compile in a process beside this one, see the function of that name.

        Args:
            then: Python code that the process runs afterwards.
        """
        module, name = self._function.__module__, self._function.__name__
        compile_elsewhere(self._function, f"from {module} import {name}; {name}.address; {then}")

    @functools.cached_property
    def _compiled(self) -> Any:
        with _caching(self._function.__module__) as cache:
            signature = normalize_signature(self._signature)
            made: Any = CFunc(self._function, signature, {}, {"error_model": "numpy"})
            if cache:
                made._cache = _SharedCache(self._function)
            made.compile()
            return made

    @property
    def address(self) -> int:
        """Where its machine code begins."""
        return self._compiled.address

    @property
    def ctypes(self) -> Any:
        """The same as a ctypes function."""
        return self._compiled.ctypes


def compile_elsewhere(function, code: str) -> None:
    """Begin to compile in a process beside this one, where that is still to be done.

    Args:
        function: what is compiled, one of a module; or its `compiled` form.
        code: Python code that compiles it.
    """
    function = getattr(function, "py_func", function)
    with _caching(function.__module__) as cache:
        folder = Path(_CONFIG.CACHE_DIR)
    if not cache or code in _ELSEWHERE or any(folder.glob(_index(function))):
        return
    path = os.pathsep.join([str(_PACKAGE.parent), *filter(None, sys.path)])
    _ELSEWHERE[code] = process = subprocess.Popen(
        [sys.executable, "-P", "-c", code], env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    atexit.register(_end, process)


_ELSEWHERE: dict[str, subprocess.Popen] = {}


def _end(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


def _index(function) -> str:
    """Pattern of the file that lists what is compiled of a function."""
    return f"*{function.__name__}-{_line(function)}.*.nbi"


def cache_folder() -> Path | None:
    """Folder of the compiled code, `$XDG_CACHE_HOME/hydrotele/compiled`, made for its owner only.

    None where there is none: no home, a file system without space or for reading, or a folder that
    somebody else owns or may write to.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    if not os.path.isabs(home):
        return None
    folder = Path(home, "hydrotele", "compiled")
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not all(map(_private, (folder, folder.parent))) or not os.access(folder, os.W_OK):
            return None
    except OSError:
        return None
    return folder


def _private(folder: Path) -> bool:
    found = folder.lstat()
    shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not shared


_FOLDER = cache_folder()
_PACKAGE = Path(__file__).parent.parent
_IMPORT = re.compile(rb"^\s*(?:from|import) +(hydrotele[\w.]*)(?: +import +([^#\n]*))?", re.M)


@functools.cache
def _source(module: str) -> bytes | None:
    """Source of a module of this package; None where the name is none."""
    package, *parts = module.split(".")
    if package != _PACKAGE.name:
        return None
    place = _PACKAGE.joinpath(*parts)
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        with contextlib.suppress(OSError):
            return path.read_bytes()
    return None


@functools.cache
def _imports(module: str) -> frozenset[str]:
    """Modules of this package that a module's source imports."""
    found = set()
    for place, names in _IMPORT.findall(_source(module) or b""):
        package = place.decode()
        found.add(package)
        for name in re.findall(r"\w+", names.decode()):
            if _source(f"{package}.{name}") is not None:
                found.add(f"{package}.{name}")
    return frozenset(found)


@functools.cache
def digest(module: str) -> str:
    """Digest of a module's source, of what it imports, and of what compiles it and keeps the result.

    A change of any of them asks for another cache. A law is compiled by another module than its
    own, which need not import this one.
    """
    open_ones = [module, __name__]
    reached = set(open_ones)
    while open_ones:
        more = _imports(open_ones.pop()) - reached
        reached |= more
        open_ones += more
    text = hashlib.sha256()
    for name in sorted(reached):
        text.update(name.encode() + b"\0" + (_source(name) or b"") + b"\0")
    return text.hexdigest()[:16]


class Locator(UserProvidedCacheLocator):
    """Tells numba where compiled code lies; its folder is named after the sources' content."""

    def __init__(self, py_func, py_file):
        super().__init__(py_func, py_file)
        self._cache_path = _CONFIG.CACHE_DIR

    def get_source_stamp(self):
        """The folder is of one state of the sources, so there is nothing to compare."""
        return ""


class _SharedCache(FunctionCache):
    """A function's cache, in which one process at a time compiles what is missing."""

    _impl_class = LinkedCache
    _held: int | None = None

    def load_overload(self, sig, target_context):
        """Compiled code of a signature; None where this process has to compile it."""
        found = super().load_overload(sig, target_context)
        if found is None and self._held is None:
            self._held = _lock(self.cache_path, self._py_func)
            found = super().load_overload(sig, target_context)
            if found is not None:
                self._let_go()
        return found

    def save_overload(self, sig, data):
        """Keep compiled code, for other processes, too."""
        try:
            super().save_overload(sig, data)
        finally:
            self._let_go()

    def _let_go(self) -> None:
        _release(self._held)
        self._held = None


class _CalledCache(_SharedCache):
    """The same for code without a wrapper for Python."""

    def _index_key(self, sig, codegen):
        return *super()._index_key(sig, codegen), "called"


def _line(function) -> int:
    return function.__code__.co_firstlineno


def _lock(folder: str, function) -> int | None:
    """Lock a function against other processes; None where that cannot be had for long."""
    try:
        path = Path(folder, f"{function.__name__}-{_line(function)}.lock")
        handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError:
        return None
    began, line = time.monotonic(), ProgressLine()
    while (waited := time.monotonic() - began) < _PATIENT:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            line.clear()
            return handle
        time.sleep(0.02)
        if waited > SECONDS_BEFORE_BAR:
            name = function.__name__.strip("_")
            line.show(f"waiting for {name}, which another process compiles ({waited:.0f} s)")
    os.close(handle)
    return None


def _release(handle: int | None) -> None:
    if handle is not None:
        os.close(handle)


_PATIENT = 300.0  # s; who compiles for longer, or has failed and lives on, is not waited for


@contextlib.contextmanager
def _caching(module: str) -> Iterator[bool]:
    """Whether there is a cache; functions of a module that are decorated meanwhile find it."""
    names = ("CACHE_DIR", "CACHE_LOCATOR_CLASSES")
    given = {name: getattr(_CONFIG, name, "") for name in names}
    own = _folder_of(module) if _FOLDER and _source(module) is not None else None
    _CONFIG.CACHE_DIR = str(own or "")
    _CONFIG.CACHE_LOCATOR_CLASSES = f"{__name__}.{Locator.__name__}" if own else ""
    try:
        yield own is not None
    finally:
        for name, value in given.items():
            setattr(_CONFIG, name, value)


@functools.cache
def _folder_of(module: str) -> Path | None:
    """A module's folder in the cache, which is thereby in use; old ones of the module go."""
    assert _FOLDER
    folder = _FOLDER / f"{module}_{digest(module)}"
    try:
        if not folder.exists():
            folder.mkdir(mode=0o700)
            for old in _FOLDER.glob(f"{module}_{'?' * 16}"):
                if time.time() - old.stat().st_mtime > _UNUSED:
                    shutil.rmtree(old, ignore_errors=True)
        os.utime(folder)
    except OSError:
        return folder if folder.is_dir() else None
    return folder


def _is_cached(function) -> bool:
    """Return whether any code of a function of this package lies in the cache."""
    if not _FOLDER or _source(function.__module__) is None:
        return False
    folder = _folder_of(function.__module__)
    return folder is not None and any(folder.glob(_index(function)))


event.register("numba:compile", CompileProgress(_is_cached))

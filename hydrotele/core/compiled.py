"""Compilation of numerical functions with numba, with a cache on disk.

Compiled code contains functions and constants of several files. Each module therefore has a separate
cache folder for each version of its source and of all sources of the package that it imports,
directly or indirectly. A changed module does not invalidate the caches of unrelated modules, and checkouts with
the same sources share a cache. The cache contains executable code: it lies in the user's cache
folder, and no other user may write to it. Damaged cache files are not used (`core.code_cache`).
A wheel may contain such folders with compiled code, in the folder `compiled_code` of the package.

Only one process compiles a function; other processes that need it wait. Callbacks for C are
compiled on first use of their address, not at import. Division by zero is not checked.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from numba.core import event
from numba.core.caching import NullCache
from numba.core.sigutils import normalize_signature
from numba.core.types import Omitted

from hydrotele.core.code_cache import CodeCache, cache_file_stem
from hydrotele.core.compile_progress import CompileProgress
from hydrotele.core.linking import Callee
from hydrotele.core.target_processor import CFunction, Dispatcher
from hydrotele.core.tuple_references import argument_type

_MAX_UNUSED_AGE = 30 * 24 * 3600.0  # s, after which an unused cache of an older source version is removed


def compiled(function):
    """Compile a numerical function with numba; a decorator.

    The function is compiled on its first call with each combination of argument types, and the code is
    cached on disk. If no cache folder is writable, every process compiles the function again. The
    compiled function releases Python's global interpreter lock, so that threads run in parallel.

    Examples:
        The pressure drop [Pa] of a sharp-edged orifice with 5 mm diameter at 60 L/min:

        >>> import math
        >>> import hydrotele as ht
        >>> @ht.compiled
        ... def orifice_pressure_drop(flow, area, discharge_coefficient, density):
        ...     return 0.5 * density * (flow / (discharge_coefficient * area)) ** 2
        >>> round(orifice_pressure_drop(1.0e-3, math.pi * 0.0025**2, 0.6, 870.0) / 1e6, 2)  # MPa
        3.13
    """
    return _make_dispatcher(function, _nrt=True)  # not inherited from a caller without allocation


def compile_without_allocation(function):
    """Compile a function that neither creates nor returns arrays; a decorator like `compiled`.

    This omits reference counting of arrays, which takes half the run time of small functions. A
    function that does create or return an array raises an error on its first call.
    """
    return _make_dispatcher(function, _nrt=False)


def compile_inlined(function):
    """Compile a small function whose code is copied into every caller; a decorator.

    The function must neither create nor return arrays. Results that a caller does not use, such as a
    derivative, are then not computed, and constant arguments are folded.
    """
    return _make_dispatcher(function, _nrt=False, forceinline=True)


def _make_dispatcher(function, **options: Any):
    """Create numba's dispatcher of a function for calls from Python, with a second one for compiled callers.

    A dispatcher compiles the function for each combination of argument types. The second one is
    attached to the first. It has no wrapper that converts Python objects. The wrapper takes a fifth
    of the compile time, and most functions are never called from Python. Where the second one has
    code for the argument types that is linked by symbol, the first one compiles the wrapper only.

    Args:
        function: the Python function.
        options: options of `numba.njit`, in addition to those of all functions.

    Returns:
        The dispatcher for calls from Python.
    """
    options |= {
        "nopython": True, "error_model": "numpy", "nogil": True,
        "no_cfunc_wrapper": True,  # the unused wrapper takes a fifth of the compile time
    }  # fmt: skip
    made: Any = Dispatcher(function, targetoptions=options)
    called: Any = Dispatcher(function, targetoptions=options | {"no_cpython_wrapper": True})
    callee = Callee(called, inline=options.get("forceinline", False))
    made._cache = _function_cache(function, "python")
    called._cache = _function_cache(function, "called", is_copied=not callee.is_separate)
    for dispatcher in (made, called):
        dispatcher.get_call_template, dispatcher.get_overload = callee.call_template, callee.overload_key
    if callee.is_separate and isinstance(called._cache, CodeCache):
        forward = _make_forwarding_function(function, called)

        def choose_function(args, keywords):
            is_compiled = args in called.overloads or called._cache.contains(args, called.targetctx)
            has_defaults = any(isinstance(kind, Omitted) for kind in args)
            return forward if is_compiled and not has_defaults else function

        made._compiler._get_implementation = choose_function
    type_of = made.typeof_pyval
    made.typeof_pyval = lambda value: argument_type(type_of(value))
    return made


def _make_forwarding_function(function, target):
    """Return a Python function with the arguments of a function that returns the result of `target`.

    Args:
        function: the function, with positional arguments only.
        target: the function that is called, a global variable of the result; numba does not cache closures.
    """
    code = function.__code__
    names = ", ".join(code.co_varnames[: code.co_argcount])
    namespace = {"__target": target}
    exec(f"def forward({names}):\n    return __target({names})", namespace)
    forward = namespace["forward"]
    forward.__module__, forward.__name__ = function.__module__, function.__name__
    forward.__qualname__ = f"{function.__qualname__}_forward"
    return forward


def callback(signature):
    """Return a decorator that turns a function into a `Callback` with this numba signature, for calls from C."""
    return lambda function: Callback(function, signature)


class Callback:
    """A function that C code can call: compiled on first use, cached on disk if possible."""

    def __init__(self, function, signature) -> None:
        self._function, self._signature = function, signature

    def compile_in_background(self, follow_up_code: str = "") -> None:
        """Start to compile this callback in a background process, unless it is cached already.

        Args:
            follow_up_code: Python code that the process runs afterwards.
        """
        module, name = self._function.__module__, self._function.__name__
        compile_in_background(self._function, f"from {module} import {name}; {name}.address; {follow_up_code}")

    @functools.cached_property
    def _compiled(self) -> Any:
        made: Any = CFunction(self._function, normalize_signature(self._signature), {}, {"error_model": "numpy"})
        made._cache = _function_cache(self._function, "callback")
        made.compile()
        return made

    @property
    def address(self) -> int:
        """Address of the compiled function in memory, an integer; the first access compiles the function."""
        return self._compiled.address

    @property
    def ctypes(self) -> Any:
        """The compiled function as a ctypes function; the first access compiles it."""
        return self._compiled.ctypes


def compile_in_background(function, code: str) -> None:
    """Start to compile a function in a background process, unless it is cached already.

    Nothing is started without a cache folder, or if this program has started a process with the
    same code before. The process is killed when this program exits.

    Args:
        function: module-level function to compile, or its `compiled` form.
        code: Python code that compiles it.
    """
    function = getattr(function, "py_func", function)
    if _module_cache_folder(function.__module__) is None or code in _background_processes or _is_cached(function):
        return
    path = os.pathsep.join([str(_PACKAGE_FOLDER.parent), *filter(None, sys.path)])
    _background_processes[code] = process = subprocess.Popen(
        [sys.executable, "-P", "-c", code], env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    atexit.register(_stop_process, process)


_background_processes: dict[str, subprocess.Popen] = {}


def _stop_process(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


def _function_cache(function, form: str, is_copied: bool = False) -> NullCache:
    """Return the disk cache for the compiled code of a function.

    For a function of another package it is a cache that stores nothing.

    Args:
        function: the Python function.
        form: callers of the code: "python", "called" for compiled functions, or "callback" for C.
        is_copied: whether callers copy the code instead of linking to it.
    """
    module = function.__module__
    if _read_source(module) is None:
        return NullCache()
    return CodeCache(function, _module_cache_folder(module), form, _module_shipped_folder(module), is_copied)


def cache_folder() -> Path | None:
    """Create, if needed, and return the folder of the compiled code, `$XDG_CACHE_HOME/hydrotele/compiled`.

    `$XDG_CACHE_HOME` is `~/.cache` by default. The folder is created with access for its owner
    only. Returns None if there is no home folder, if the folder cannot be created or written, or if
    another user owns it or can write to it.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    if not os.path.isabs(home):
        return None
    folder = Path(home, "hydrotele", "compiled")
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not all(map(_is_private_folder, (folder, folder.parent))) or not os.access(folder, os.W_OK):
            return None
    except OSError:
        return None
    return folder


def _is_private_folder(folder: Path) -> bool:
    """Return whether a path is a folder that only this user owns and can write to."""
    found = folder.lstat()
    shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not shared


_CACHE_FOLDER = cache_folder()
_PACKAGE_FOLDER = Path(__file__).parent.parent
SHIPPED_FOLDER = _PACKAGE_FOLDER / "compiled_code"
"""Folder of compiled code in the package; wheels for Linux on x86-64 contain it."""
_IMPORT_PATTERN = re.compile(rb"^\s*(?:from|import) +(hydrotele[\w.]*)(?: +import +([^#\n]*))?", re.M)


@functools.cache
def _read_source(module: str) -> bytes | None:
    """Return the source code of a module of this package as bytes; None if there is no such module."""
    package, *parts = module.split(".")
    if package != _PACKAGE_FOLDER.name:
        return None
    place = _PACKAGE_FOLDER.joinpath(*parts)
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        with contextlib.suppress(OSError):
            return path.read_bytes()
    return None


@functools.cache
def _find_imports(module: str) -> frozenset[str]:
    """Return the names of the modules of this package that the source text of a module imports directly."""
    found = set()
    for place, names in _IMPORT_PATTERN.findall(_read_source(module) or b""):
        package = place.decode()
        found.add(package)
        for name in re.findall(r"\w+", names.decode()):
            if _read_source(f"{package}.{name}") is not None:
                found.add(f"{package}.{name}")
    return frozenset(found)


@functools.cache
def source_digest(module: str) -> str:
    """Return a hash of the sources of a module, of its direct and indirect imports and of `core.compiled`.

    Only modules of this package count. The hash is a part of the name of the cache folder, so that
    a changed source selects another folder. `core.compiled` and its imports are always included,
    because they determine how all functions are compiled.
    """
    open_ones = [module, __name__]
    reached = set(open_ones)
    while open_ones:
        more = _find_imports(open_ones.pop()) - reached
        reached |= more
        open_ones += more
    text = hashlib.sha256()
    for name in sorted(reached):
        text.update(name.encode() + b"\0" + (_read_source(name) or b"") + b"\0")
    return text.hexdigest()[:16]


@functools.cache
def _module_cache_folder(module: str) -> Path | None:
    """Create, if needed, and return the cache folder of a module for its present source; mark it as used.

    The modification time of a folder is the time of its last use. When a folder is created, folders
    for other sources of the module that were unused for 30 days are deleted. Returns None for
    modules of other packages, and if there is no usable folder.
    """
    if _CACHE_FOLDER is None or _read_source(module) is None:
        return None
    folder = _CACHE_FOLDER / f"{module}_{source_digest(module)}"
    try:
        if not folder.exists():
            folder.mkdir(mode=0o700)
            for old in _CACHE_FOLDER.glob(f"{module}_{'?' * 16}"):
                if time.time() - old.stat().st_mtime > _MAX_UNUSED_AGE:
                    shutil.rmtree(old, ignore_errors=True)
        os.utime(folder)
    except OSError:
        return folder if folder.is_dir() else None
    return folder


@functools.cache
def _module_shipped_folder(module: str) -> Path | None:
    """Return the folder with compiled code of a module that was shipped with the package; None if there is none."""
    folder = SHIPPED_FOLDER / f"{module}_{source_digest(module)}"
    return folder if folder.is_dir() else None


def _is_cached(function) -> bool:
    """Return whether there is stored code of a function of this package, for any argument types."""
    module = function.__module__
    if _read_source(module) is None:
        return False
    folders = _module_shipped_folder(module), _module_cache_folder(module)
    return any(any(folder.glob(f"{cache_file_stem(function)}.*.code")) for folder in folders if folder is not None)


event.register("numba:compile", CompileProgress(_is_cached))

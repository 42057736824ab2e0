"""Store compiled code on disk, one file for each function and signature, and verify it before use.

Code is looked up in the folder that the package was shipped with, then in the user's cache folder.
The shipped folder comes first, because its files refer to symbols of each other.

A file begins with a checksum of the rest. The rest contains the key of the code: signature,
processor, versions and bytecode. Damaged files, for example after a power cut, and files of another
key count as missing, so that their code never reaches LLVM. If nothing can be stored, the code is
kept in memory only.
"""

import contextlib
import fcntl
import hashlib
import logging
import os
import pickle
import secrets
import sysconfig
import time
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from hydrotele.core.compile_progress import SECONDS_BEFORE_BAR, ProgressLine
from hydrotele.core.linking import external_callees, load_callees
from hydrotele.core.target_processor import publish_runtime

CODE_VERSIONS = (
    sysconfig.get_config_var("SOABI"),  # Python's binary interface, of which all releases of 3.11 share one
    numba.__version__,  # a patch release may change generated code, pickled types or the runtime
    llvmlite.__version__,
    ".".join(numpy.__version__.split(".")[:2]),  # selects numba's implementations; arrays are read by numba's runtime
)
"""Versions on which compiled code depends."""
_MAX_LOCK_WAIT = 300.0  # s, longest wait for another process, which may have failed without exiting
_LOG = logging.getLogger("hydrotele")
_notes: set[str] = set()


def _warn_once(kind: str, text: str) -> None:
    """Log a warning text; only the first warning of each kind in a process is logged."""
    if kind not in _notes:
        _notes.add(kind)
        _LOG.warning(text)


def cache_file_stem(function) -> str:
    """Return the start of the names of a function's cache files: `<function name>-<first line number>`."""
    return f"{function.__name__}-{function.__code__.co_firstlineno}"


class CodeCache(NullCache):
    """Disk cache of the compiled code of one function; a lock ensures that only one process compiles it.

    Args:
        function: the Python function.
        folder: cache folder of the function's module; None if no folder is usable.
        form: kind of compiled code, since a function may be compiled for calls from Python, from
            compiled functions and from C.
        shipped_folder: folder with code of the function's module that was shipped with the package;
            it is only read. None if there is none.
        is_copied: whether callers copy the code, so that LLVM's code is stored, too.
    """

    def __init__(
        self, function, folder: Path | None, form: str, shipped_folder: Path | None = None, is_copied: bool = False
    ) -> None:
        self._function, self._folder, self._form = function, folder, form
        self._shipped_folder, self._is_copied = shipped_folder, is_copied
        self._lock_handle: int | None = None

    @property
    def cache_path(self) -> str | None:
        """Folder of the cache as text; None if no folder is usable."""
        return self._folder and str(self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the stored compiled code for a signature, or None if this process has to compile it.

        Before None is returned, this process locks this form of the function; `save_overload` releases the lock.
        While another process holds the lock, this call waits for its compiled code, for 300 s at
        most. Without a cache folder only shipped code is returned, and nothing is locked.
        """
        if self._folder is None and self._shipped_folder is None:
            return None
        publish_runtime()
        found = self._load(self._shipped_folder, sig, target_context) or self._load(self._folder, sig, target_context)
        if found is None and self._lock_handle is None and self._folder is not None:
            self._lock_handle = _acquire_lock(self._folder, self._function, self._form)
            found = self._load(self._folder, sig, target_context)
            if found is not None:
                self._release_lock()
        return found

    def contains(self, sig: Any, target_context: Any) -> bool:
        """Return whether there is a cache file for a signature."""
        name = self._file_name(self._code_key(sig, target_context.codegen()))
        return any(folder is not None and (folder / name).exists() for folder in (self._shipped_folder, self._folder))

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Write the compiled code of a signature to a cache file, if possible, and release the function's lock.

        Code with lifted loops or dynamic globals is not written. Without a usable folder, or if
        writing fails, a warning is logged once per process and the code stays in memory only.
        """
        try:
            if self._folder is None:
                reason = "no cache folder is writable by you alone; set XDG_CACHE_HOME to such a folder"
                _warn_once("memory", f"compiled functions are kept in memory only: {reason}")
            elif not cres.lifted and not cres.library.has_dynamic_globals:
                key = self._code_key(sig, cres.library.codegen)
                cres.library.is_copied = self._is_copied
                # Without the printed types of all variables, which take a third of the space.
                code = cres._replace(type_annotation="")._reduce()
                content = dumps((key, external_callees(cres), code))
                _write_atomically(self._folder / self._file_name(key), hashlib.sha256(content).digest() + content)
        except OSError as error:
            reason = f"{self._folder} cannot be written, {error.strerror or error}"
            _warn_once("memory", f"compiled functions are kept in memory only: {reason}")
        finally:
            self._release_lock()

    def _load(self, folder: Path | None, sig: Any, target_context: Any) -> Any:
        if folder is None:
            return None
        key = self._code_key(sig, target_context.codegen())
        content = _read_verified(folder / self._file_name(key))
        if content is None:
            return None
        stored_key, callees, code = pickle.loads(content)
        if stored_key != key or not load_callees(callees):
            return None
        return CompileResult._rebuild(target_context, *code)

    def _code_key(self, sig: Any, codegen: Any) -> tuple:
        """Return a tuple of all that determines the compiled code of a signature, as the key of its cache file.

        The tuple contains the form of the code, `CODE_VERSIONS`, signature, processor, qualified
        name, and hashes of bytecode and closure. It does not contain the sources of called
        functions; these determine the cache folder.
        """
        closure = [cell.cell_contents for cell in self._function.__closure__ or ()]
        parts = self._function.__code__.co_code, dumps(closure) if closure else b""
        digests = [hashlib.sha256(part).hexdigest() for part in parts]
        return self._form, CODE_VERSIONS, sig, codegen.magic_tuple(), self._function.__qualname__, *digests

    def _file_name(self, key: tuple) -> str:
        digest = hashlib.sha256(repr(key).encode()).hexdigest()
        return f"{cache_file_stem(self._function)}.{digest[:16]}.code"

    def _release_lock(self) -> None:
        if self._lock_handle is not None:
            os.close(self._lock_handle)
        self._lock_handle = None


def _read_verified(path: Path) -> bytes | None:
    """Return the content of a cache file after its SHA-256 checksum; None if the file is missing or damaged.

    A file is damaged if it cannot be read or its checksum is wrong; a warning is then logged.
    """
    size = hashlib.sha256().digest_size
    try:
        stored = path.read_bytes()
        if hashlib.sha256(stored[size:]).digest() == stored[:size]:
            return stored[size:]
        reason = "its checksum is wrong"
    except FileNotFoundError:
        return None
    except OSError as error:
        reason = error.strerror or str(error)
    _warn_once("damaged", f"damaged compiled code is compiled again: {path}: {reason}")
    return None


def _write_atomically(path: Path, content: bytes) -> None:
    """Write bytes to a file atomically: write a temporary file in the same folder, then rename it."""
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _acquire_lock(folder: Path, function, form: str) -> int | None:
    """Lock one form of a function's code against other processes; return the handle of the open lock file.

    While another process holds the lock, the call waits, and after 1 s shows a status line on
    stderr. Returns None after 300 s of waiting, and if the lock file cannot be opened or locked.
    """
    try:
        path = folder / f"{cache_file_stem(function)}.{form}.lock"
        handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError:
        return None
    began, line = time.monotonic(), ProgressLine()
    while (waited := time.monotonic() - began) < _MAX_LOCK_WAIT:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            line.clear()
            return handle
        except BlockingIOError:
            time.sleep(0.02)
        except OSError:
            break
        if waited > SECONDS_BEFORE_BAR:
            name = function.__name__.strip("_")
            line.show(f"waiting for another process to compile {name} ({waited:.0f} s)")
    line.clear()
    os.close(handle)
    return None

"""Effects of one's own: from a file that the user names, or from an installed package."""

import hashlib
import importlib.metadata
import importlib.util
import os
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from hydrotele.core.errors import InputError
from hydrotele.effects.effect import Effect
from hydrotele.terms.law import LAWS, defined_by

GROUP = "hydrotele.effects"
ENVIRONMENT = "HYDROTELE_EFFECTS"
"""Files of effects that child processes load, joined as in PATH."""

_read: dict[str, tuple[str, ...]] = {}  # digest of a file's text -> names of its effects


def read_effects(path: Path, library: dict[str, Effect]) -> tuple[str, ...]:
    """Run a file and add its effects; a file that was read before, or its copy, is not run again.

    Args:
        path: the file.
        library: effects by name, changed.

    Returns:
        Names of its effects.

    Raises:
        InputError: it cannot be read or run, defines nothing, or what has a name that is taken.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    if path.suffix != ".py":
        raise InputError(path, "is no Python file: effects of your own stand in a .py file")
    if digest not in _read:
        source = str(path.resolve())
        try:
            with defined_by(source):
                module = _run(path, digest)
            family = _family(module)
            if family or not any(law.source == source for law in LAWS.values()):
                _add(library, family, path)
        except InputError:
            for name in [name for name, law in LAWS.items() if law.source == source]:
                del LAWS[name]
            raise
        _read[digest] = tuple(effect.name for effect in family)
        _tell_children(path)
    return _read[digest]


def _run(path: Path, digest: str) -> ModuleType:
    name = f"hydrotele_effects_{path.stem}_{digest[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except InputError:
        raise
    except Exception as error:  # whatever the user's code raises
        del sys.modules[name]
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__)
                 if f.filename == str(path)]  # fmt: skip
        line = getattr(error, "lineno", None) or (lines[-1] if lines else None)
        where = f"{path}:{line}" if line else path
        raise InputError(where, f"cannot be run: {type(error).__name__}: {error}") from error
    return module


def _family(content: Any) -> tuple[Any, ...]:
    """Effects of a module, or of an entry point that names them itself."""
    if isinstance(content, ModuleType):
        content = getattr(content, "EFFECT", None) or getattr(content, "EFFECTS", ())
    return tuple(content) if isinstance(content, Iterable) else (content,)


def _add(library: dict[str, Effect], family: tuple[Any, ...], where: object) -> None:
    if not family:
        message = "defines neither EFFECT = Effect(...) nor EFFECTS = (...), nor a law"
        raise InputError(where, message)
    for effect in family:
        if not isinstance(effect, Effect):
            message = f"{effect!r} is no hydrotele.effects.Effect"
            raise InputError(where, message)
        if effect.name in library:
            message = f"effect {effect.name!r} exists already; choose another name"
            raise InputError(where, message)
    library.update((effect.name, effect) for effect in family)


def _tell_children(path: Path) -> None:
    """Processes that this one starts load the file, too."""
    known = os.environ.get(ENVIRONMENT, "").split(os.pathsep)
    if str(path.resolve()) not in known:
        paths = [*filter(None, known), str(path.resolve())]
        os.environ[ENVIRONMENT] = os.pathsep.join(paths)


def add_plugins(library: dict[str, Effect]) -> None:
    """Add the effects of installed packages.

    Raises:
        InputError: one of them does not load; names the package.
    """
    for entry in importlib.metadata.entry_points(group=GROUP):
        package = entry.dist.name if entry.dist else "?"
        where = f"plug-in {entry.name} of the package {package}"
        with defined_by(where):
            try:
                content = entry.load()
            except (ImportError, AttributeError) as error:
                message = f"does not load: {error}; update or uninstall the package"
                raise InputError(where, message) from error
        _add(library, _family(content), where)


def add_from_environment(library: dict[str, Effect]) -> None:
    """Add the effects of the files that the parent process has loaded."""
    for path in filter(None, os.environ.get(ENVIRONMENT, "").split(os.pathsep)):
        read_effects(Path(path), library)

"""Physical effects that a machine can have and its model can lack, a file per group.

One type for three uses: planted in a scenario, tried as a hypothesis, written into a patched
machine.

To add an effect, write one file here that defines `EFFECT = Effect(...)` (or `EFFECTS`, a tuple of
related ones); it is found by itself. Such a file says

1. the fixed name, one sentence, and the law of the model that the effect changes;
2. `locations(machine)`: where it can sit, nothing where the machine has no such part;
3. `parameters(machine, location)`: for every number its unit, its value in the machine as it is,
   and its sizes relative to the machine, with the reason for the smallest one worth naming;
4. `apply(machine, location, values)`: the changed machine, made with `changed`. With the nominal
   values it must behave as the given machine does.

Whatever the facts of `Machine` can already say is simulated, estimated, saved and loaded without
further code; what they cannot is a law of its own and a term that uses it (`hydrotele.terms`). A
file whose name begins with an underscore holds helpers. Tests of all effects
(`tests/effects/test_library.py`) take a new one along; a test of its own shows its physics.

Effects of one's own need no change of this package: `load_effects` reads a file that defines them,
and installed packages offer theirs as entry points of the group `hydrotele.effects`.
"""

import hashlib
import importlib
import importlib.metadata
import importlib.util
import math
import os
import pkgutil
import sys
import traceback
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.effects.effect import Effect, Parameter, changed, term_number, with_terms
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import LAWS, DriveState, Numbers, Term, Variable, defined_by, law

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


__all__ = [
    "EFFECTS", "DriveState", "Effect", "Numbers", "Parameter", "Term", "Variable", "apply_effect",
    "changed", "law", "load_effects", "term_number", "with_terms",
]  # fmt: skip


def _discover() -> dict[str, Effect]:
    found: dict[str, Effect] = {}
    for module in pkgutil.iter_modules(__path__):
        if module.name.startswith("_") or module.name == "effect":
            continue
        content = importlib.import_module(f"{__name__}.{module.name}")
        single = getattr(content, "EFFECT", None)
        family = getattr(content, "EFFECTS", ()) if single is None else (single,)
        if not family:
            raise RuntimeError(f"{content.__name__} defines neither EFFECT nor EFFECTS")
        for effect in family:
            if effect.name in found:
                raise RuntimeError(f"{content.__name__}: effect {effect.name} exists already")
            found[effect.name] = effect
    return found


EFFECTS: dict[str, Effect] = _discover()
"""Effects by name."""


def load_effects(path: str | Path) -> tuple[str, ...]:
    """Run a Python file that defines effects, and laws for them, and add them to the library.

    Child processes load it, too. The file runs with all rights of the user: only load files that
    you trust. Nothing else in hydrotele runs a file that it finds.

    Args:
        path: the file; it defines `EFFECT` or `EFFECTS`, and laws, or laws only.

    Returns:
        Names of its effects.

    Raises:
        InputError: it cannot be read or run, defines nothing, or what has a name that is taken.
    """
    return read_effects(Path(path), EFFECTS)


def apply_effect(
    machine: Machine, name: str, location: str, parameters: Mapping[str, float]
) -> Machine:
    """A machine that has an effect.

    Args:
        machine: the machine without it.
        name: name of the effect.
        location: where; may be left empty where there is only one place.
        parameters: parameter name -> value in the effect's unit; optional ones may be left out.

    Returns:
        The changed machine.

    Raises:
        InputError: unknown effect, location or parameter, or a value out of range; lists what is
            valid.
    """
    if name not in EFFECTS:
        own = "one of your own needs the file that defines it: --effects FILE.py"
        raise InputError(f"effect {name!r}", f"is not known; {suggest(name, EFFECTS)}; {own}")
    effect = EFFECTS[name]
    places = effect.locations(machine)
    if not location and len(places) == 1:
        location = places[0]
    if location not in places:
        message = f"cannot sit at {location!r}; {suggest(location, places)}"
        raise InputError(f"effect {name}", message)
    known = effect.parameters(machine, location)
    needed = {key for key, p in known.items() if not p.optional}
    for key in sorted((needed - parameters.keys()) | (parameters.keys() - known.keys())):
        names = ", ".join(f"{k} (may be left out)" if p.optional else k for k, p in known.items())
        what = "is missing" if key in known else "is none of them"
        raise InputError(f"effect {name}", f"has the parameters {names}; {key!r} {what}")
    for key, value in parameters.items():
        limits = known[key]
        if math.isnan(value) or not limits.low <= value <= limits.high:
            raise InputError(
                f"effect {name}: {key}",
                f"{value:g} is outside {limits.low:g} .. {limits.high:g} {limits.unit}",
            )
    return effect.apply(machine, location, parameters)


add_plugins(EFFECTS)
add_from_environment(EFFECTS)

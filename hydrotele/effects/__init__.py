"""Library of physical effects that a machine may have and its model may omit.

One `Effect` has three uses: a scenario adds it to a machine, a gap search tests it as a hypothesis,
and a patched machine contains it.

To add an effect, write one module here that defines `EFFECT = Effect(...)`, or `EFFECTS` as a tuple
of related effects. The library imports the module automatically. The module defines

1. the fixed name, a one-sentence description, and the law of the model that the effect changes;
2. `locations(machine)`: the possible locations, empty if the machine has no such part;
3. `parameters(machine, location)`: for each parameter its unit, its value in the given machine, and
   its bounds, prior standard deviation and smallest relevant change, with reasons in the docstring;
4. `apply(machine, location, values)`: the changed machine, made with `with_value`. With nominal
   values it must behave like the given machine.

An effect that only changes fields of `Machine` is simulated, estimated, saved and loaded without
further code. Any other effect needs a law and a term that uses it (`hydrotele.terms`). A module
whose name starts with an underscore holds helpers. `tests/effects/test_library.py` covers every
effect of the library; the physics of a new effect needs its own test.

Custom effects need no change to this package. `load_effects` reads a file that defines them, and
installed packages provide them as entry points of the group `hydrotele.effects`.

Examples:
    >>> import hydrotele as ht
    >>> effect = ht.EFFECTS["internal_leakage"]
    >>> effect.description
    "leakage between a drive's chambers that differs from the model"
    >>> machine = ht.load_machine("cat215", "bucket")
    >>> effect.locations(machine)
    ('swing', 'boom', 'stick', 'bucket')
    >>> parameter = effect.parameters(machine, "boom")["leakage"]
    >>> parameter.unit, parameter.nominal, parameter.upper_bound
    ('m^3/(s Pa)', 2e-12, 1.0914285714285715e-10)
"""

import hashlib
import importlib
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

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_bytes, resolve_path
from hydrotele.core.plugins import describe_exception, find_plugins
from hydrotele.effects.effect import Effect, Parameter, term_parameter, with_terms, with_value
from hydrotele.machine.machine import Machine
from hydrotele.terms.drive_state import DriveState
from hydrotele.terms.law import LAWS, LawSource, Numbers, Variable, law
from hydrotele.terms.term import Term

ENTRY_POINT_GROUP = "hydrotele.effects"
ENVIRONMENT_VARIABLE = "HYDROTELE_EFFECTS"
"""Environment variable with the effect files that child processes load, joined as in PATH."""

_loaded_effects: dict[str, tuple[str, ...]] = {}  # digest of a file's text -> names of its effects


def add_effects_from_file(path: Path, library: dict[str, Effect]) -> tuple[str, ...]:
    """Run a Python file that defines effects, and add these effects to a library.

    A file with the same content as one that was read before is not run again. The file is also
    added to the environment variable `HYDROTELE_EFFECTS`, from which child processes load their
    effects.

    Args:
        path: the file.
        library: effects by name; updated in place.

    Returns:
        Names of the effects that the file defines.

    Raises:
        InputError: the file cannot be read or run, defines neither effects nor laws, or uses an
            existing name.
    """
    digest = hashlib.sha256(read_bytes(path)).hexdigest()
    if path.suffix != ".py":
        raise InputError(path, "is not a Python file: define custom effects in a .py file")
    if digest not in _loaded_effects:
        source = str(resolve_path(path))
        try:
            with LawSource(source):
                family = _execute_file(path, digest)
            if family or not any(law.source == source for law in LAWS.values()):
                _add_to_library(library, family, path)
        except InputError:
            for name in [name for name, law in LAWS.items() if law.source == source]:
                del LAWS[name]
            raise
        _loaded_effects[digest] = tuple(effect.name for effect in family)
        _pass_file_to_child_processes(path)
    return _loaded_effects[digest]


def _execute_file(path: Path, digest: str) -> tuple[Any, ...]:
    """Run an effect file as a module and return its effects.

    Args:
        path: the file.
        digest: hash of its content, which becomes a part of the module's name.

    Raises:
        InputError: the file raised an exception; the message gives file and line.
    """
    name = f"hydrotele_effects_{path.stem}_{digest[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    _effect_files[os.path.abspath(path)] = path
    try:
        spec.loader.exec_module(module)
        return _collect_effects(module)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # any error of the user's code, also exit()
        del sys.modules[name]
        found = locate_error_in_effect_file(error) or InputError(path, describe_exception(error))
        raise InputError(found.where, f"cannot be run: {found.message}") from error


_effect_files: dict[str, Path] = {}  # absolute path of every effect file that was run -> path as given


def locate_error_in_effect_file(error: BaseException) -> InputError | None:
    """Find the line of a user's effect file that caused an exception.

    Args:
        error: exception of any kind.

    Returns:
        An error with that file and line, whose message contains the traceback lines of effect files
        only. None if no effect file raised the exception or called the function that raised it.
    """
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in _effect_files]
    message = describe_exception(error)
    if isinstance(error, SyntaxError) and error.filename in _effect_files:
        return InputError(f"{_effect_files[error.filename]}:{error.lineno}", message)
    if not frames:
        return None
    path = _effect_files[frames[-1].filename]
    return InputError(f"{path}:{frames[-1].lineno}", f"{message}\n{''.join(traceback.format_list(frames)).rstrip()}")


def _collect_effects(content: Any) -> tuple[Any, ...]:
    """Return the effects that a module defines as `EFFECT` or `EFFECTS`; an empty tuple if it has neither.

    `content` is the module. It may also be an effect or a collection of effects, as entry points
    provide them.
    """
    if isinstance(content, ModuleType):
        content = getattr(content, "EFFECT", None) or getattr(content, "EFFECTS", ())
    return tuple(content) if isinstance(content, Iterable) else (content,)


def _add_to_library(library: dict[str, Effect], family: tuple[Any, ...], where: object) -> None:
    if not family:
        message = "defines neither EFFECT = Effect(...) nor EFFECTS = (...), nor a law"
        raise InputError(where, message)
    for effect in family:
        if not isinstance(effect, Effect):
            message = f"{effect!r} is not a hydrotele.effects.Effect"
            raise InputError(where, message)
        if not isinstance(effect.name, str):
            raise InputError(where, f"the name of an effect must be text, not {effect.name!r}")
        if effect.name in library:
            message = f"effect {effect.name!r} exists already; choose another name"
            raise InputError(where, message)
    library.update((effect.name, effect) for effect in family)


def _pass_file_to_child_processes(path: Path) -> None:
    """Add an effect file to `HYDROTELE_EFFECTS`, the environment variable from which child processes load effects."""
    known = os.environ.get(ENVIRONMENT_VARIABLE, "").split(os.pathsep)
    if str(resolve_path(path)) not in known:
        paths = [*filter(None, known), str(resolve_path(path))]
        os.environ[ENVIRONMENT_VARIABLE] = os.pathsep.join(paths)


def add_plugin_effects(library: dict[str, Effect]) -> None:
    """Add the effects that installed packages provide as entry points to a library.

    Args:
        library: effects by name; updated in place.

    Raises:
        InputError: an entry point cannot be loaded; the message names the package.
    """
    for plugin in find_plugins(ENTRY_POINT_GROUP).values():
        with LawSource(plugin.source):
            content = plugin.load()
        _add_to_library(library, _collect_effects(content), plugin.source)


def add_effects_from_environment_variable(library: dict[str, Effect]) -> None:
    """Run the effect files that `HYDROTELE_EFFECTS` lists, and add their effects to a library.

    A parent process lists its files in this environment variable. `library` is updated in place.
    """
    for path in filter(None, os.environ.get(ENVIRONMENT_VARIABLE, "").split(os.pathsep)):
        add_effects_from_file(Path(path), library)


__all__ = [
    "EFFECTS", "DriveState", "Effect", "Numbers", "Parameter", "Term", "Variable", "apply_effect",
    "with_value", "law", "load_effects", "term_parameter", "with_terms",
]  # fmt: skip


def _discover_effects() -> dict[str, Effect]:
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


EFFECTS: dict[str, Effect] = _discover_effects()
"""Effects by name."""


def load_effects(path: str | Path) -> tuple[str, ...]:
    """Run a Python file that defines effects and laws, and add them to the library `EFFECTS`.

    Child processes load the file as well. The file runs with all rights of the user, so load only
    files that you trust. hydrotele runs no Python file that the user did not name.

    Args:
        path: the file; it defines `EFFECT` or `EFFECTS`, and laws, or laws only.

    Returns:
        Names of the effects that the file defines.

    Raises:
        InputError: the file cannot be read or run, defines neither effects nor laws, or uses an
            existing name.

    Examples:
        A file cannot redefine an effect of the library. `Effect` has an example of an effect.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "own.py")
        ...     _ = path.write_text("from hydrotele import EFFECTS; EFFECT = EFFECTS['payload']")
        ...     try:
        ...         ht.load_effects(path)
        ...     except ht.InputError as error:
        ...         print(error.message)
        effect 'payload' exists already; choose another name
    """
    return add_effects_from_file(Path(path), EFFECTS)


def apply_effect(machine: Machine, name: str, location: str, values: Mapping[str, float]) -> Machine:
    """Return a copy of a machine with an effect added.

    Args:
        machine: the machine without the effect.
        name: name of the effect.
        location: location of the effect; may be empty if the machine has only one location for it.
        values: parameter name -> value in the effect's unit; optional ones may be omitted.

    Returns:
        The changed machine.

    Raises:
        InputError: the effect, location or a parameter is unknown, a required parameter is missing,
            or a value is out of bounds; the message lists valid values.

    Examples:
        >>> import hydrotele as ht
        >>> machine = ht.load_machine("rig")
        >>> worn = ht.apply_effect(machine, "internal_leakage", "slide", {"leakage": 2.0e-12})
        >>> machine.axes["slide"].cylinder.leakage, worn.axes["slide"].cylinder.leakage  # m^3/(s Pa)
        (2e-13, 2e-12)

        Errors list the valid values.

        >>> try:
        ...     ht.apply_effect(machine, "internal_leakage", "boom", {"leakage": 2.0e-12})
        ... except ht.InputError as error:
        ...     print(error)
        effect internal_leakage: has no location 'boom'; valid: slide
    """
    if name not in EFFECTS:
        own = "for a custom effect, name the file that defines it: --effects FILE.py"
        raise InputError(f"effect {name!r}", f"is not known; {suggest_valid_name(name, EFFECTS)}; {own}")
    effect = EFFECTS[name]
    places = effect.locations(machine)
    if not location and len(places) == 1:
        location = places[0]
    if location not in places:
        message = f"has no location {location!r}; {suggest_valid_name(location, places)}"
        raise InputError(f"effect {name}", message)
    known = effect.parameters(machine, location)
    needed = {key for key, p in known.items() if not p.optional}
    for key in sorted((needed - values.keys()) | (values.keys() - known.keys())):
        names = ", ".join(f"{k} (optional)" if p.optional else k for k, p in known.items())
        what = "is missing" if key in known else "is not one of them"
        raise InputError(f"effect {name}", f"has the parameters {names}; {key!r} {what}")
    for key, value in values.items():
        limits = known[key]
        if math.isnan(value) or not limits.lower_bound <= value <= limits.upper_bound:
            raise InputError(
                f"effect {name}: {key}",
                f"{value:g} is outside {limits.lower_bound:g} .. {limits.upper_bound:g} {limits.unit}",
            )
    return effect.apply(machine, location, values)


add_plugin_effects(EFFECTS)
add_effects_from_environment_variable(EFFECTS)

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

import importlib
import math
import pkgutil
from collections.abc import Mapping
from pathlib import Path

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.effects._own import add_from_environment, add_plugins, read_effects
from hydrotele.effects.effect import Effect, Parameter, changed, term_number, with_terms
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import Term
from hydrotele.terms.law import DriveState, Numbers, Variable, law

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

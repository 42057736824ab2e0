"""What a law is: a small function of a drive's state, its parameters, and the library of laws.

    @law
    def quadratic_drag(s, coefficient):
        return -coefficient * s.velocity * abs(s.velocity)

The first argument is the `DriveState`, the others are the parameters under their names. numba
compiles the function when a machine that uses it is simulated, so that it may use numbers, `math`
and other compiled functions only. A parameter is a number; annotated as `Variable` it is the name
of a variable of the state and arrives as its index; annotated as `Numbers` it is a list and arrives
as an array. A value that is left out is the default of the argument.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError


class DriveState(NamedTuple):
    """Physical variables of one drive at an instant, all SI.

    Attributes:
        time: since the run's beginning [s].
        position: piston displacement or motor angle [m] or [rad].
        velocity: of the piston or motor [m/s] or [rad/s].
        spool: spool position [1]; 0 without a valve, as all that follow up to the supply. Of a
            drive with a pump of its own the pump's speed [rad/s]; files call it `pump_speed`.
        spool_rate: its rate [1/s]. Of a drive with a pump of its own the pressure in its load
            cylinder [Pa]; files call it `pressure_load`.
        pressure_head: of the head-side chamber, or port A of a motor [Pa].
        pressure_rod: of the rod-side chamber, or port B [Pa].
        pressure_supply: at the valves' inlet [Pa].
        command: to the valve or drive, as it arrives, without the terms that add to it [1], [V].
        force: of the oil on the piston, or of a force drive, before friction [N] or [N m].
        played: what the term's play lets through of its variable [its unit]; 0 without a play.
        ahead: by how much the variable is ahead of that, up to half a width to either side.
    """

    time: float
    position: float
    velocity: float
    spool: float
    spool_rate: float
    pressure_head: float
    pressure_rod: float
    pressure_supply: float
    command: float
    force: float
    played: float
    ahead: float


class Drives(NamedTuple):
    """All drives at an instant, for laws with variables of another drive than the term's own.

    Attributes:
        count: number of hydraulic drives, which come first.
        act: (>= 4 count,) spool [1], spool rate [1/s], head- and rod-side pressure [Pa] of each.
        position: (nu,) piston displacements or motor angles [m] or [rad].
        velocity: (nu,) their rates [m/s] or [rad/s].
        command: (nu,) commands as they arrive [1] or [V].
    """

    count: int
    act: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    command: np.ndarray


NO_DRIVES = Drives(0, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
"""For laws that see no other drive's variables."""

VARIABLES = {name: index for index, name in enumerate(DriveState._fields)}
"""Variable of the state, as files name it -> its index."""
VARIABLES |= {"pump_speed": VARIABLES["spool"], "pressure_load": VARIABLES["spool_rate"]}


class Variable(int):
    """Annotation of a law's argument: index of a variable, by its name in files."""


class Numbers(np.ndarray):
    """Annotation of a law's argument: a list of numbers, nested lists one after the other."""


Value = float | str | tuple[float, ...] | tuple[tuple[float, ...], ...]
Parameters = Mapping[str, Any]
_KINDS = (float, Variable, Numbers)


@dataclass(frozen=True)
class Law:
    """A law that terms can use.

    Attributes:
        name: fixed name, as in machine files.
        function: `(state, *parameters) -> float`.
        kinds: argument name -> float, Variable or Numbers, in the order of the arguments.
        defaults: values of the arguments that may be left out.
        check: called with the complete parameters; raises ValueError where they do not suit.
        translate: machine file's parameters -> the arguments; None where they are the same.
        source: file or entry point that defines it; empty for the laws of this package.
    """

    name: str
    function: Callable[..., float]
    kinds: Mapping[str, type]
    defaults: Mapping[str, Any] = field(default_factory=dict)
    check: Callable[[Parameters], None] | None = None
    translate: Callable[[Parameters], Parameters] | None = None
    source: str = ""

    def numbers(self, parameters: Parameters) -> np.ndarray:
        """Parameters as the numbers that the compiled law is called with.

        Args:
            parameters: as in a machine file.

        Returns:
            (n,) n itself, then one number per float or Variable and the range of places per
            Numbers, then the contents of these.

        Raises:
            ValueError: a parameter is missing, unknown or of the wrong kind; lists what is valid.
        """
        given = dict(self.translate(parameters)) if self.translate else dict(parameters)
        for name in given.keys() - self.kinds.keys():
            raise ValueError(f"law {self.name}: parameter {name!r}; {suggest(name, self.kinds)}")
        given = {**self.defaults, **given}
        if missing := [name for name in self.kinds if name not in given]:
            raise ValueError(f"law {self.name} needs the parameters {', '.join(missing)}, too")
        if self.check:
            self.check(given)
        size = 1 + sum(2 if kind is Numbers else 1 for kind in self.kinds.values())
        front, back = [0.0], []
        for name, kind in self.kinds.items():
            values = _values(self.name, name, kind, given[name])
            if kind is Numbers:
                front += [size + len(back), size + len(back) + len(values)]
                back += values
            else:
                front += values
        front[0] = size + len(back)
        return np.array(front + back, float)


def _values(law: str, name: str, kind: type, value: Any) -> list[float]:
    """One parameter as numbers."""
    where = f"law {law}: parameter {name}"
    if kind is Variable:
        if value not in VARIABLES:
            raise ValueError(f"{where}: {value!r} is no variable; {suggest(value, VARIABLES)}")
        return [float(VARIABLES[value])]
    try:
        flat = np.asarray(value, float)
    except (TypeError, ValueError):
        flat = np.array(math.nan)
    if not np.isfinite(flat).all() or (kind is float) != (flat.ndim == 0):
        what = "a list of finite numbers" if kind is Numbers else "a finite number"
        raise ValueError(f"{where} must be {what}, not {value!r}")
    return flat.ravel().tolist()


LAWS: dict[str, Law] = {}
"""Laws by name: those of `hydrotele.terms.laws`, and what users' files and plug-ins define."""

_reading: list[str] = []  # what defines laws at the moment: the last entry


def law(
    function: Callable[..., float] | None = None, *,
    check: Callable[[Parameters], None] | None = None,
    translate: Callable[[Parameters], Parameters] | None = None,
) -> Any:  # fmt: skip
    """Decorator that puts a law into the library under its function's name.

    Args:
        function: `(state, *parameters) -> float`; see the head of this module.
        check: see `Law`.
        translate: see `Law`.

    Returns:
        The function, unchanged, so that it can be called with a `DriveState` in Python, too.

    Raises:
        InputError: the name is taken, or an argument has no kind that a parameter can have.
    """
    if function is None:
        return lambda it: law(it, check=check, translate=translate)
    name, source = function.__name__, _reading[-1] if _reading else ""
    where = f"{source}: law {name}" if source else f"law {name}"
    if name in LAWS:
        owner = LAWS[name].source or "hydrotele"
        raise InputError(where, f"is already defined by {owner}; choose another name")
    _, *arguments = inspect.signature(function, eval_str=True).parameters.values()
    kinds = {a.name: float if a.annotation is a.empty else a.annotation for a in arguments}
    for argument, kind in kinds.items():
        if kind not in _KINDS:
            raise InputError(where, f"{argument}: {kind!r} is not float, Variable or Numbers")
    defaults = {a.name: a.default for a in arguments if a.default is not a.empty}
    LAWS[name] = Law(name, function, kinds, defaults, check, translate, source)
    return function


class defined_by:  # noqa: N801 - a context manager, named as it is read
    """Context in which laws are defined by a user's file or a plug-in."""

    def __init__(self, source: str) -> None:
        """Name the source."""
        self._source = source

    def __enter__(self) -> None:
        _reading.append(self._source)

    def __exit__(self, *_: object) -> None:
        _reading.pop()

"""The dictionary of what an unknown effect may look like: terms of the signals of one place.

Pressures come in MPa, all else in SI, so that coefficients read well.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

_SLOW = 0.05  # of the RMS of a rate: below it the direction of motion is not told
_ARRIVED = 0.2  # of its threshold: a command that moves less from row to row lets a spool stick
_MOST = 400  # places of a grid
Grid = Callable[..., list[tuple[float, ...]]]


@dataclass(frozen=True)
class Term:
    """A family of columns.

    Attributes:
        name: of the family.
        laws: laws that it can disturb.
        roles: signals that it needs, see `unknown_target.roles`.
        columns: (*signals, *parameters) -> one column (n,), or a sine and a cosine.
        formula: readable form behind the coefficient; has {role}, {0}, {1} for parameters, {phase}.
        words: what it says to a mechanic after "12 L/min more oil ...", or, if it begins with a
            capital, the whole sentence, with {said}, {more}, {gains}, {side}, {place}.
        per: unit by which the coefficient is said, such as `m/s`; empty for none.
        grid: (*signals of the fit runs) -> parameters to try; None without parameters.
        units: units of the parameters; a role's name for its unit.
        unit: unit of the coefficient if not the law's.
        silent: roles that it needs but does not depend on.
    """

    name: str
    laws: tuple[str, ...]
    roles: tuple[str, ...]
    columns: Callable[..., tuple[np.ndarray, ...]]
    formula: str
    words: str
    per: str = ""
    grid: Grid | None = None
    units: tuple[str, ...] = ()
    unit: str = ""
    silent: tuple[str, ...] = ()


def direction(v: np.ndarray) -> np.ndarray:
    """(n,) direction of a motion, -1 .. 1, smooth through zero."""
    size = float(np.sqrt(np.mean(v**2)))
    return np.tanh(v / (_SLOW * size)) if size > 0.0 else np.zeros_like(v)


def held_spool(u: np.ndarray, threshold: float) -> np.ndarray:
    """(n,) spool that rests until its command is off by a threshold, then follows till it rests."""
    out, held, moving, before = np.zeros(len(u)), u[0], False, u[0]
    for k, value in enumerate(u):
        moving = moving or abs(value - held) > threshold
        if moving:
            held, moving = value, abs(value - before) > _ARRIVED * threshold
        out[k], before = held, value
    return out


def _opening(spool: np.ndarray, overlap: np.ndarray) -> np.ndarray:
    return np.sign(spool) * np.maximum(np.abs(spool) - overlap, 0.0) / (1.0 - overlap)


def _sticking(k, u, z, threshold):
    return (k * (_opening(held_spool(u, threshold), z) - _opening(u, z)),)


def bell(x: np.ndarray, centre: float, width: float) -> np.ndarray:
    """(n,) bell of height 1."""
    return np.exp(-0.5 * ((x - centre) / width) ** 2)


def _bells(x: np.ndarray, *_) -> list[tuple[float, ...]]:
    low, high = np.quantile(x, [0.01, 0.99])
    widths = np.geomspace(0.02, 0.25, 6) * (high - low)
    return list(product(np.linspace(low, high, 25), widths)) if high > low else []


def _steps(low: float, high: float, step: float) -> np.ndarray:
    """From low to high by a step, or by a larger one where that takes too many."""
    return np.linspace(low, high, int(np.clip((high - low) / step, 1, _MOST)) + 1)


def _teeth(q: np.ndarray, *_) -> list[tuple[float, ...]]:
    span = float(np.ptp(q))
    return [(k,) for k in _steps(3.0, 150.0, 0.7 / span)] if span > 0.02 else []


def _frequencies(t: np.ndarray, *_) -> list[tuple[float, ...]]:
    return [(f,) for f in _steps(2.0 / t.max(), 1.5, 0.25 / t.max())]


def _warm_ups(t: np.ndarray, *_) -> list[tuple[float, ...]]:
    return [(tau,) for tau in np.geomspace(0.1, 2.0, 8) * t.max()]


def _differences(p: np.ndarray, o: np.ndarray, *_) -> list[tuple[float, ...]]:
    return [(d,) for d in np.quantile(np.abs(p - o), np.linspace(0.1, 0.9, 17))]


def _pressures(_: np.ndarray, o: np.ndarray) -> list[tuple[float, ...]]:
    low, high = np.quantile(o, [0.0, 0.9])
    return list(product(np.linspace(low, high, 14), (0.3, 1.0, 3.0, 6.0)))


def _thresholds(*_: np.ndarray) -> list[tuple[float, ...]]:
    return [(d,) for d in np.geomspace(0.005, 0.15, 16)]


def _waves(x: np.ndarray, k: float) -> tuple[np.ndarray, ...]:
    return np.sin(k * x), np.cos(k * x)


def _beyond(p: np.ndarray, o: np.ndarray, limit: float) -> tuple[np.ndarray]:
    return (np.sign(p - o) * np.maximum(np.abs(p - o) - limit, 0.0),)


_ALL = ("force", "flow", "supply", "sensor", "geometry")
_PLACED = ("force", "geometry")
TERMS: Sequence[Term] = (
    Term("constant", _ALL, ("t",), lambda t: (np.ones_like(t),), "", "all the time", silent=("t",)),
    Term("drift", _ALL, ("t",), lambda t: (t,), "{t}",
         "for every second that passes", "s"),
    Term("warm-up", _ALL, ("t",), lambda t, tau: (1.0 - np.exp(-t / tau),),
         "(1 - exp(-{t}/{0}))", "in the end, creeping there within {0}", grid=_warm_ups,
         units=("s",)),
    Term("beat", ("force", "flow", "supply", "sensor"), ("t",),
         lambda t, f: _waves(t, 2.0 * np.pi * f), "sin(2 pi {0} {t} + {phase})",
         "back and forth at {0}", grid=_frequencies, units=("Hz",)),
    Term("dry", ("force",), ("v",), lambda v: (direction(v),), "sign({v})",
         "against its motion at any speed"),
    Term("viscous", (*_PLACED, "flow"), ("v",), lambda v: (v,), "{v}", "for every {v_unit} of its"
         " speed", "v"),
    Term("quadratic", ("force",), ("v",), lambda v: (np.abs(v) * v,), "{v} |{v}|",
         "growing with the square of its speed", "v^2"),
    Term("bore", ("force",), ("x", "v"), lambda x, v, c, w: (direction(v) * bell(x, c, w),),
         "sign({v}) * exp(-(({x} - {0})/{1})^2/2)",
         "against its motion where it stands near {0}, within about {1} of it", grid=_bells,
         units=("x", "x")),
    Term("place", ("force", "geometry", "flow"), ("x",), lambda x, c, w: (bell(x, c, w),),
         "exp(-(({x} - {0})/{1})^2/2)", "where it stands near {0}, within about {1} of it",
         grid=_bells, units=("x", "x")),
    Term("slope", (*_PLACED, "flow"), ("x",), lambda x: (x,), "{x}",
         "for every {x_unit} of its way", "x"),
    Term("tight", ("force",), ("x", "v"), lambda x, v: (x * direction(v),), "{x} * sign({v})",
         "against its motion for every {x_unit} of its way", "x"),
    Term("weight", _PLACED, ("q",), lambda q: _waves(q, 1.0), "sin({q} + {phase})",
         "changing with its attitude as a weight does"),
    Term("teeth", ("force",), ("q",), _waves, "sin({0} {q} + {phase})",
         "in a ripple of {0} waves per turn",
         grid=_teeth, units=("1/rad",)),
    Term("inertia", ("force",), ("a",), lambda a: (a,), "{a}",
         "for every {v_unit} per second by which it speeds up", "v/s"),
    Term("seal", ("force",), ("v", "p", "o"), lambda v, p, o: (direction(v) * np.abs(p - o),),
         "sign({v}) * |{p} - {o}|", "against its motion for every MPa of load", "MPa"),
    Term("worn", ("force",), ("v", "t"), lambda v, t: (direction(v) * t,), "sign({v}) * {t}",
         "against its motion for every second that passes", "s"),
    Term("thinning", ("force",), ("v", "t"), lambda v, t: (v * t,), "{v} * {t}",
         "for every {v_unit} of its speed and every second that passes", "v s"),
    Term("flexing", ("geometry",), ("p", "o"), lambda p, o: (p - o,), "({p} - {o})",
         "for every MPa of load", "MPa"),
    Term("feed", ("flow",), ("f",), lambda f: (np.maximum(f, 0.0),), "max(0, valve flow)",
         "The valve lets {said} {more} oil into the {side} side of the {place} than the model says",
         unit="1"),
    Term("drain", ("flow",), ("f",), lambda f: (np.minimum(f, 0.0),), "min(0, valve flow)",
         "The valve lets {said} {more} oil out of the {side} side of the {place} than the model"
         " says", unit="1"),
    Term("valve", ("flow",), ("f",), lambda f: (f,), "valve flow",
         "The valve lets {said} {more} oil through at the {side} side of the {place}, both ways,"
         " than the model says", unit="1"),
    Term("pilot", ("flow",), ("f", "o"),
         lambda f, o, p, w: (np.minimum(f, 0.0) * np.clip(1.0 - (o - p) / w, 0.0, 1.0),),
         "min(0, valve flow) * clip(1 - ({o} - {0})/{1}, 0, 1)",
         "Out of the {side} side of the {place} comes {said} {more} oil than the model says while"
         " the pressure of the other side is below {0}, and ever closer to the model over the next"
         " {1}", grid=_pressures, units=("MPa", "MPa"), unit="1"),
    Term("growing valve", ("flow",), ("f", "t"), lambda f, t: (f * t,), "valve flow * {t}",
         "The valve lets {said} {more} oil through at the {side} side of the {place} with every"
         " second that passes", "s", unit="1"),
    Term("sticking", ("flow",), ("k", "u", "z"), _sticking,
         "(flow of a spool held until {u} is off by {0} - flow of one that is not)",
         "The oil at the {side} side of the {place} is off by {said} of what a spool would cause"
         " that stays put until its command is off by {0}",
         grid=_thresholds, units=("1",), unit="1", silent=("k", "z")),
    Term("late", ("flow",), ("k", "u"), lambda k, u: (k * np.gradient(u),),
         "(flow at full opening) * (change of {u} per row)",
         "The {side} side of the {place} gets {said} {more} of its full flow for every row in which"
         " the command changes by all it can", unit="1", silent=("k",)),
    Term("back pressure", ("flow",), ("b", "r"), lambda b, r: (b * (r / 1e-3) ** 2,),
         "(loss of return flow per Pa) * (all return flow/60 L/min)^2",
         "The oil from the {side} side of the {place} meets {said} {more} back pressure than the"
         " model says when all axes together return 60 L/min, growing with the square of that flow",
         unit="Pa"),
    Term("tank", ("flow",), ("b",), lambda b: (b,), "(loss of return flow per Pa)",
         "The oil from the {side} side of the {place} meets {said} {more} back pressure than the"
         " model says", unit="Pa"),
    Term("leak", ("flow",), ("p", "o"), lambda p, o: (p - o,), "({p} - {o})",
         "The {side} side of the {place} {gains} {said} for every MPa that it has more than the"
         " other side", "MPa"),
    Term("blow-by", ("flow",), ("p", "o"), _beyond,
         "sign({p} - {o}) * max(0, |{p} - {o}| - {0})",
         "The {side} side of the {place} {gains} {said} for every MPa beyond {0} that it has more"
         " than the other side", "MPa", _differences, ("MPa",)),
    Term("growing leak", ("flow",), ("p", "o", "t"), lambda p, o, t: ((p - o) * t,),
         "({p} - {o}) * {t}", "The {side} side of the {place} {gains} {said} for every MPa that it"
         " has more than the other side and every second that passes", "MPa s"),
    Term("outer leak", ("flow",), ("p",), lambda p: (p,), "{p}", "for every MPa in it", "MPa"),
    Term("soft", ("flow",), ("d",), lambda d: (d,), "(change of {p} per s)",
         "for every MPa per second by which its pressure rises", "MPa/s", silent=("d",)),
    Term("air", ("flow",), ("d", "p"), lambda d, p: (d / np.maximum(p, 0.1) ** 1.83,),
         "(change of {p} per s)/({p}/1 MPa)^1.83", "for every MPa per second by which its pressure"
         " rises at 1 MPa, and ever less at higher pressure, as gas does", "MPa/s",
         silent=("d",)),
    Term("power", ("supply",), ("s",), lambda s: (1.0 / s,), "1/{s}",
         "at 1 MPa, and ever less in proportion to one over the supply pressure", "1/MPa"),
    Term("slip", ("supply",), ("s",), lambda s: (s,), "{s}", "for every MPa of supply pressure",
         "MPa"),
    Term("scale", ("sensor",), ("p",), lambda p: (p,), "{p}", "for every MPa", "MPa"),
    Term("bow", ("sensor",), ("p",), lambda p: (p**2,), "{p}^2",
         "growing with the square of the pressure, at 1 MPa", "MPa^2"),
    Term("lag", ("sensor",), ("d",), lambda d: (d,), "(change of {p} per s)",
         "for every MPa per second by which the pressure rises", "MPa/s", silent=("d",)),
)  # fmt: skip
"""All families."""

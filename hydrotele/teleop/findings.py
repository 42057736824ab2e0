"""Everything that an analysis of a teleoperator finds, and the same as JSON."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.teleop.analysis import Analysis, analyse, stability_map
from hydrotele.teleop.case import Case
from hydrotele.teleop.confirm import Agreement, Sweep, agreement, sweep
from hydrotele.teleop.switching import Spring

Progress = Callable[[str, float], None]
_EVERY = 40  # frequency that goes into the JSON


@dataclass(frozen=True)
class Findings:
    """What was found.

    Attributes:
        name: of the case.
        case: the teleoperator with hand and task.
        analyses: of the structures.
        delays: (n,) each way of the map [s].
        factors: (m,) of the map on what comes back [1].
        maps: structure -> (m, n), true where stable.
        spring: the joystick axis with stiffness feedback, None without.
        sweeps: measured in simulation, empty where not asked for.
        agreements: the maps, simulated; empty where not asked for.
    """

    name: str
    case: Case
    analyses: tuple[Analysis, ...]
    delays: np.ndarray
    factors: np.ndarray
    maps: dict[str, np.ndarray]
    spring: Spring | None = None
    sweeps: tuple[Sweep, ...] = ()
    agreements: tuple[Agreement, ...] = ()


def find(
    name: str, case: Case, structures: tuple[str, ...], delays: np.ndarray, factors: np.ndarray,
    spring: Spring | None = None, confirm: bool = False, progress: Progress | None = None,
) -> Findings:  # fmt: skip
    """Analyse structures, and confirm them in simulation where that is asked for.

    Args:
        name: of the case.
        case: the teleoperator with hand and task.
        structures: their names.
        delays: (n,) each way of the map [s].
        factors: (m,) of the map on what comes back [1].
        spring: the joystick axis with stiffness feedback, None without.
        confirm: whether to simulate sine sweeps, with the case's delays and without, and every cell
            of the map.
        progress: told the structure and the share that is done.

    Returns:
        What was found.

    Raises:
        InputError: a structure is not known, or neither side has a mass.
    """
    analyses, maps, sweeps, agreements = [], {}, [], []
    for n, structure in enumerate(structures):
        if progress:
            progress(structure, n / len(structures))
        analyses.append(analyse(case, structure))
        if not confirm:
            maps[structure] = stability_map(case, structure, delays, factors)
            continue
        late = [case] if case.delay else []
        sweeps += [sweep(one, structure) for one in (case.with_delay(0.0), *late)]
        agreements.append(agreement(case, structure, delays, factors))
        maps[structure] = agreements[-1].predicted
    return Findings(
        name, case, tuple(analyses), delays, factors, maps, spring, tuple(sweeps), tuple(agreements)
    )


def why_unstable(one: Analysis) -> str:
    """What makes a structure unstable, in a few words."""
    free = "" if one.unstable_poles != 0 else " when free"
    many = one.unstable_poles if not free else one.unstable_free
    if many is None:
        return f"no, poles on the axis{free}"
    return f"no, {many} pole{'s' * (many != 1)}{free}"


def said_factor(margin: float) -> str:
    """A gain margin.

    >>> said_factor(0.17), said_factor(math.inf)
    ('x 0.17', 'any')
    """
    return "any" if math.isinf(margin) else f"x {margin:.3g}"


def said_delay(delay: float) -> str:
    """A delay.

    >>> said_delay(0.12345)
    '123 ms'
    """
    return "any" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def said_size(value: float) -> str:
    """A number with four digits, without an exponent.

    >>> said_size(-20026.0), said_size(0.0123456)
    ('-20030', '0.01235')
    """
    return np.format_float_positional(value, precision=4, fractional=False, trim="-")


def said_error(error: float | None) -> str:
    """A relative error.

    >>> said_error(0.0016), said_error(1e-7)
    ('0.16 %', '< 0.01 %')
    """
    if error is None:
        return "not measurable"
    return "< 0.01 %" if error < 1e-4 else f"{100.0 * error:.2g} %"


def findings_document(found: Findings) -> dict:
    """What was found as plain data; infinite where nothing within reach changes stability.

    Args:
        found: the findings.

    Returns:
        A dictionary; complex numbers are pairs of real and imaginary part.
    """
    case = found.case
    document = {
        "name": found.name,
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structures": {one.structure: _analysis(one) for one in found.analyses},
        "map": {
            "delay": found.delays, "factor": found.factors,
            "stable": {name: cells.astype(bool).tolist() for name, cells in found.maps.items()},
        },
    }  # fmt: skip
    if found.spring:
        pair = {"held": found.spring.held(case.hand), "let_go": found.spring}
        document["stiffness_feedback"] = {name: _spring(one) for name, one in pair.items()}
    if found.agreements:
        document["confirmed"] = {
            "sweeps": [_sweep(one) for one in found.sweeps],
            "agreement": {one.structure: one.share for one in found.agreements},
        }
    return document


def _analysis(one: Analysis) -> dict:
    at = slice(None, None, _EVERY)
    worst = int(np.argmax(one.scattering))
    return {
        "stable": one.stable,
        "unstable_poles": one.unstable_poles,
        "unstable_poles_free": one.unstable_free,
        "gain_margin": one.gain_margin,
        "largest_delay": one.largest_delay,
        "passive": one.passive,
        "scattering_peak": one.scattering[worst],
        "scattering_peak_frequency": one.frequencies[worst],
        "frequency": one.frequencies[at],
        "hybrid": _pairs(one.hybrid[at]),
        "transmitted": _pairs(one.transmitted[at]),
        "task": _pairs(one.task[at]),
        "scattering": one.scattering[at],
        "loop": _pairs(one.loop[at]),
    }


def _pairs(values: np.ndarray) -> list:
    return np.stack([np.real(values), np.imag(values)], axis=-1).tolist()


def _spring(one: Spring) -> dict:
    return {
        "mass": one.mass, "damping": one.damping, "least": one.least, "most": one.most,
        "margin": one.margin, "damping_asked": one.enough_damping, "worst_growth": one.growth,
    }  # fmt: skip


def _sweep(one: Sweep) -> dict:
    return {
        "structure": one.structure, "delay_forward": one.delay_forward,
        "delay_back": one.delay_back, "error": one.error, "frequency": one.frequencies,
        "expected": _pairs(one.expected), "measured": _pairs(one.measured),
    }  # fmt: skip

"""Everything that an analysis of a teleoperator finds, and the same as JSON.

What the linear case of a scenario says: stability, largest reflection and delay, the theorem.

A dead band in a loop: what share of a swing passes it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.analysis import (
    LONGEST_TRIED,
    MOST_TRIED,
    Analysis,
    Case,
    analyse,
    gain_margin,
    largest_delay,
    loop_gain,
    stability_map,
)
from hydrotele.teleop.confirm import Agreement, SineSweep, agreement, sweep
from hydrotele.teleop.linear_case import STRUCTURES, LinearCase, local_ratio
from hydrotele.teleop.robust import Robustness
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import OnTheAxis, unstable_poles

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
        robust: what every structure withstands, sampled; empty where not asked for.
        period: of that sampling [s].
    """

    name: str
    case: Case
    analyses: tuple[Analysis, ...]
    delays: np.ndarray
    factors: np.ndarray
    maps: dict[str, np.ndarray]
    spring: Spring | None = None
    sweeps: tuple[SineSweep, ...] = ()
    agreements: tuple[Agreement, ...] = ()
    robust: tuple[Robustness, ...] = ()
    period: float = 0.0


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


def why_unstable(one: Analysis, let_go: bool = False) -> str:
    """What makes a structure unstable, in a few words.

    Args:
        one: the analysis.
        let_go: of the handle let go, not in a hand.

    Returns:
        Such as `no, 2 poles`, `yes` where it is stable.
    """
    both = (one.unstable_poles, one.unstable_free)
    if let_go:
        both = (one.unstable_let_go, one.unstable_let_go_free)
    if both == (0, 0):
        return "yes"
    free = "" if both[0] != 0 else " when free"
    many = both[0] if not free else both[1]
    if many is None:
        return f"no, poles on the axis{free}"
    return f"no, {many} pole{'s' * (many != 1)}{free}"


def format_factor(margin: float) -> str:
    """A gain margin; where none was found, the largest factor that was tried.

    >>> format_factor(0.17), format_factor(math.inf)
    ('x 0.17', '> x 1000')
    """
    return f"> x {MOST_TRIED:g}" if math.isinf(margin) else f"x {margin:.3g}"


def format_delay(delay: float) -> str:
    """A delay; where none was found, the longest that was tried.

    >>> format_delay(0.12345), format_delay(math.inf)
    ('123 ms', '> 10 s')
    """
    return f"> {LONGEST_TRIED:g} s" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def format_number(value: float) -> str:
    """A number with five digits, without an exponent.

    >>> format_number(-20026.0), format_number(0.0123456)
    ('-20026', '0.012346')
    """
    return np.format_float_positional(value, precision=5, fractional=False, trim="-")


def format_error(error: float | None) -> str:
    """A relative error.

    >>> format_error(0.0016), format_error(1e-7)
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
    if found.robust:
        document["robust"] = {
            "period": found.period,
            "structures": {one.structure: _robust(one) for one in found.robust},
        }
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
        "stable_let_go": one.stable_let_go,
        "unstable_poles_let_go": one.unstable_let_go,
        "unstable_poles_let_go_free": one.unstable_let_go_free,
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


def _robust(one: Robustness) -> dict:
    names = ("held_task", "held_free", "let_go_task", "let_go_free")
    document = {
        "absolutely_stable": one.absolutely_stable,
        "llewellyn": one.llewellyn,
        "sampled": {
            name: {"stable": told.stable, "reason": told.reason}
            for name, told in zip(names, one.sampled, strict=True)
        },
        "drawn": {
            "pairs": one.worst.pairs, "unstable": one.worst.unstable,
            "unstable_let_go": one.worst.unstable_let_go, "worst_growth_rate": one.worst.rate,
            "worst_hand": vars(one.worst.hand), "worst_task": vars(one.worst.task),
        },
    }  # fmt: skip
    if one.width:
        document["z_width"] = {
            "decades": one.width.decades, "stiffest_task_held": one.width.stiffest_held,
            "stiffest_task_let_go": one.width.stiffest_let_go,
            "stiffest_tried": one.width.most_tried,
        }  # fmt: skip
    if one.released:
        document["master_let_go"] = {
            "coefficients": one.released.coefficients, "unstable_poles": one.released.unstable,
        }  # fmt: skip
    return document


def _pairs(values: np.ndarray) -> list:
    return np.stack([np.real(values), np.imag(values)], axis=-1).tolist()


def _spring(one: Spring) -> dict:
    return {
        "mass": one.mass, "damping": one.damping, "least": one.least, "most": one.most,
        "margin": one.margin, "damping_asked": one.enough_damping, "worst_growth": one.growth,
        "least_damping": one.least_damping, "stable_by": one.stable_by,
    }  # fmt: skip


def _sweep(one: SineSweep) -> dict:
    return {
        "structure": one.structure, "delay_forward": one.delay_forward,
        "delay_back": one.delay_back, "error": one.error, "frequency": one.frequencies,
        "expected": _pairs(one.expected), "measured": _pairs(one.measured),
    }  # fmt: skip


def deadband_share(deadband: float, amplitude: float) -> float:
    """Gain of a dead band for a sine about its centre, of its slope outside.

    A loop with a dead band that is unstable by its slope still rests inside; it can sustain a swing
    where this share brings its gain to the limit.

    Args:
        deadband: half of the band d, scalar [m] or [rad].
        amplitude: of the sine A, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a swing inside.

    Source: describing function of a dead zone; Gelb and Vander Velde 1968, appendix B.

    >>> round(deadband_share(1.5e-3, 5.0e-3), 3), deadband_share(2.0, 1.0)
    (0.624, 0.0)
    """
    ratio = deadband / amplitude
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio**2))


_NAMES = {
    ("direct_force", "rate"): "rate_force",
    ("direct_force", "position"): "position_force",
    ("coordinating_force", "rate"): "rate_position",
    ("coordinating_force", "position"): "position_position",
}
_CASE = "analyse a case file: hydrotele analyse teleop CASE.yaml --structure "
_UNLINEAR = {
    "four_channel": (
        "its slave moves by an observed force of the hand, which is not modelled for a machine",
        _CASE + "four_channel_{}",
    ),
    "wave_variables": (
        "its line uses a wave only as far as energy has come",
        _CASE + "wave_variables --robust",
    ),
    "passivity_control": (
        "its line damps as much as energy is missing",
        _CASE + "passivity_control --robust",
    ),
    "impedance": (
        "the stiffness that is felt is identified and changes",
        "analyse it with pilot.reflection=direct_force, or simulate it: hydrotele run",
    ),
}  # reflection: why it has no linear case, and what to do
_SEARCHED = 2.0 * np.pi * np.geomspace(0.02, 40.0, 4000)  # rad/s
_STEPS, _NEWTON = 80, 8


@dataclass(frozen=True)
class LoopFindings:
    """What was found of one structure.

    Attributes:
        structure: its name.
        own: whether it is the scenario's; else it is what a direct reflection would be instead.
        unstable_poles: with the task; None where poles lie on the axis.
        gain_margin: factor on what comes back up to which it is stable.
        largest_delay: each way [s].
        frequency: of the oscillation at the margin [Hz]; NaN without a margin.
        pole: that oscillation's pole with the gain as it is [rad/s]; NaN without a margin.
        largest_ratio: hand per machine force up to which it is stable [N/N]; NaN where no force is
            reflected.
        hand_force: at the machine's force limit with that ratio [N], [N m].
        ratio_with_deadband: the same for a swing of the handle from stop to stop, of which the dead
            band passes a part [N/N]; NaN where there is none.
    """

    structure: str
    own: bool
    unstable_poles: int | None
    gain_margin: float
    largest_delay: float
    frequency: float
    pole: complex
    largest_ratio: float
    hand_force: float
    ratio_with_deadband: float

    @property
    def stable(self) -> bool:
        """Whether no pole lies right of the axis."""
        return self.unstable_poles == 0


@dataclass(frozen=True)
class ScenarioFindings:
    """What was found of a scenario.

    Attributes:
        name: of the scenario.
        case: the linear case.
        task_source: where the task's numbers are from.
        loop: of the scenario's structure, or of direct force in its place.
        held: the joystick axis under stiffness feedback, with the hand.
        free: the same let go.
        edge_ratio: what stiffness feedback reflects at the dead band's edge [N/N].
    """

    name: str
    case: LinearCase
    task_source: str
    loop: LoopFindings
    held: Spring
    free: Spring
    edge_ratio: float


def find_loop(name: str, case: LinearCase, task_source: str) -> ScenarioFindings:
    """Analyse a scenario's linear case.

    Args:
        name: of the scenario.
        case: the case.
        task_source: where the task's numbers are from.

    Returns:
        What was found.

    Raises:
        InputError: the structure has no linear case.

    Source: Zhu 1994, chapters 3 and 4.
    """
    reflection, mode = case.pilot.reflection, case.pilot.mode
    if reflection in _UNLINEAR:
        why, instead = _UNLINEAR[reflection]
        message = f"{reflection!r} of a scenario has no linear case, because {why}"
        raise InputError("pilot.reflection", f"{message}; {instead.format(mode)}")
    own = (reflection, mode) in _NAMES
    structure = _NAMES.get((reflection, mode), f"{mode}_force")
    spring = case.spring
    return ScenarioFindings(
        name, case, task_source, structure_findings(case, structure, own), spring.held(case.held),
        spring, local_ratio(case, case.deadband),
    )  # fmt: skip


def structure_findings(case: LinearCase, structure: str, own: bool = True) -> LoopFindings:
    """Analyse one structure of a case; see `LoopFindings`.

    Raises:
        InputError: the structure is not known here.
    """
    if structure not in STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(STRUCTURES)}")
    try:
        many = unstable_poles(case.port(structure), case.hand, case.task)
    except OnTheAxis:
        many = None
    margin = gain_margin(case, structure)
    frequency, pole = _swing(case, structure, margin)
    ratio = passing = math.nan
    if structure.endswith("force"):
        ratio = margin * case.ratio
        share = deadband_share(case.deadband, case.reach)
        passing = ratio / share if structure == "rate_force" and share > 0.0 else math.nan
    return LoopFindings(
        structure, own, many, margin, largest_delay(case, structure), frequency, pole, ratio,
        ratio * case.force_limit, passing,
    )  # fmt: skip


def _swing(case: LinearCase, structure: str, margin: float) -> tuple[float, complex]:
    """Frequency [Hz] at which the loop is about to swing, and its pole at the gain as it is."""
    if not 0.0 < margin < math.inf:
        return math.nan, complex(math.nan, math.nan)

    def returned(s: complex | np.ndarray, factor: float) -> np.ndarray:
        return 1.0 + loop_gain(case.port(structure, factor), s, case.hand, case.task)

    place = int(np.argmin(np.abs(returned(1j * _SEARCHED, margin))))
    s = 1j * float(_SEARCHED[place])
    for factor in np.geomspace(margin, 1.0, _STEPS):
        for _ in range(_NEWTON):
            step = 1e-6 * abs(s)
            here = complex(returned(s, factor))
            slope = (complex(returned(s + step, factor)) - here) / step
            s -= here / slope
    return float(_SEARCHED[place]) / (2.0 * math.pi), s


def loop_document(found: ScenarioFindings) -> dict:
    """What was found as plain data, SI; infinite or NaN where there is none.

    Args:
        found: the findings.

    Returns:
        A dictionary.
    """
    case, loop, tip = found.case, found.loop, found.case.tip
    springs = {"held": found.held, "let_go": found.free}
    return {
        "name": found.name,
        "coordinate": tip.coordinate,
        "reflection": case.pilot.reflection,
        "mode": case.pilot.mode,
        "machine": {"mass": tip.mass, "hydraulic_stiffness": tip.stiffness},
        "task": {
            "mass": case.task.mass, "damping": case.task.damping,
            "stiffness": case.task.stiffness, "source": found.task_source,
        },
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structure": {
            "name": loop.structure, "of_the_scenario": loop.own, "stable": loop.stable,
            "unstable_poles": loop.unstable_poles, "gain_margin": loop.gain_margin,
            "largest_delay": loop.largest_delay, "frequency": loop.frequency,
            "pole": [loop.pole.real, loop.pole.imag], "ratio": case.ratio,
            "largest_ratio": loop.largest_ratio, "force_limit": case.force_limit,
            "hand_force_at_limit": loop.hand_force,
            "largest_ratio_with_deadband": loop.ratio_with_deadband,
        },
        "stiffness_feedback": {
            "ratio_at_deadband_edge": found.edge_ratio,
            **{
                name: {
                    "mass": one.mass, "damping": one.damping, "most": one.most,
                    "margin": one.margin, "damping_asked": one.enough_damping,
                    "worst_growth": one.growth, "least_damping": one.least_damping,
                    "stable_by": one.stable_by,
                }
                for name, one in springs.items()
            },
        },
    }  # fmt: skip

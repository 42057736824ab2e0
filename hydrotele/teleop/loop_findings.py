"""What the linear case of a scenario says: stability, largest reflection and delay, the theorem.

A dead band in a loop: what share of a swing passes it.
"""

import math
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.analysis import gain_margin, largest_delay, loop_gain
from hydrotele.teleop.linear_case import STRUCTURES, LinearCase, local_ratio
from hydrotele.teleop.stability import OnTheAxis, unstable_poles
from hydrotele.teleop.switching import Spring


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
    if reflection in ("four_channel", "impedance"):
        message = f"{reflection!r} has no linear case of a scenario; write a case file"
        raise InputError("pilot.reflection", message)
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
                    "worst_growth": one.growth,
                }
                for name, one in springs.items()
            },
        },
    }  # fmt: skip

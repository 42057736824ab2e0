"""Linear stability analysis of a teleoperated scenario, with the describing function of its dead band.

A scenario is analysed through its linear case. The describing function of a dead band gives its
effect on the loop gain.
"""

import math
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.linear_analysis import (
    find_gain_margin,
    find_max_delay,
    loop_gain,
)
from hydrotele.teleop.linear_case import STRUCTURES, LinearCase, stiffness_feedback_ratio
from hydrotele.teleop.nyquist_criterion import PoleOnAxisError, count_unstable_poles
from hydrotele.teleop.stiffness_switching import StiffnessAxis


def deadband_gain(deadband: float, amplitude: float) -> float:
    """Return the describing function of a dead band: its gain for a centred sine.

    The gain is relative to the slope outside the band.

    A loop that is unstable with the full slope still comes to rest inside the dead band. It can
    sustain an oscillation at which this factor reduces the loop gain to the stability limit.

    Args:
        deadband: half width d of the band, scalar [m] or [rad].
        amplitude: amplitude A of the sine, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a sine inside the band.

    Source: describing function of a dead zone; Gelb and Vander Velde 1968, appendix B.

    >>> round(deadband_gain(1.5e-3, 5.0e-3), 3), deadband_gain(2.0, 1.0)
    (0.624, 0.0)
    """
    ratio = deadband / amplitude
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio**2))


_STRUCTURE_NAMES = {
    ("direct_force", "rate"): "rate_force",
    ("direct_force", "position"): "position_force",
    ("coordinating_force", "rate"): "rate_position",
    ("coordinating_force", "position"): "position_position",
}
_CASE_FILE_HINT = "analyse a case file: hydrotele analyse teleop CASE.yaml --structure "
_NONLINEAR_REFLECTIONS = {
    "four_channel": (
        "its slave moves by an observed hand force, which is not modelled for a machine",
        _CASE_FILE_HINT + "four_channel_{}",
    ),
    "wave_variables": (
        "its channel transmits a wave only as far as received energy permits",
        _CASE_FILE_HINT + "wave_variables --robust",
    ),
    "passivity_control": (
        "its channel adds damping in proportion to the missing energy",
        _CASE_FILE_HINT + "passivity_control --robust",
    ),
    "impedance": (
        "the displayed stiffness is identified online and changes",
        "analyse it with pilot.reflection=direct_force, or simulate it: hydrotele run",
    ),
}  # reflection: reason why it has no linear case, and the alternative
_SEARCH_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.02, 40.0, 4000)  # rad/s
_CONTINUATION_STEPS, _NEWTON_STEPS = 80, 8


@dataclass(frozen=True)
class LoopFindings:
    """Stability results of the linear loop of a scenario with one control structure.

    Attributes:
        structure: name of the structure.
        is_scenario_structure: whether it is the scenario's structure; otherwise direct force
            reflection replaces it.
        unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
            axis.
        gain_margin: factor on the return channels (from machine to joystick) up to which the loop
            is stable.
        max_delay: maximum stable delay in each direction [s].
        frequency: frequency of the oscillation at the stability limit, that is with the return
            channels multiplied by `gain_margin` [Hz]; NaN without a finite margin.
        pole: pole of that oscillation at the present gain, in the complex plane of s [rad/s]; NaN
            without a finite margin.
        max_ratio: maximum stable ratio of reflected hand force to machine force [N/N]; NaN if the
            structure reflects no force.
        hand_force: hand force at the machine's force limit with `max_ratio` [N], [N m].
        max_ratio_with_deadband: maximum stable ratio for an oscillation of the handle from stop to
            stop, with the reduced gain of the dead band [N/N]; NaN without a dead band.
    """

    structure: str
    is_scenario_structure: bool
    unstable_poles: int | None
    gain_margin: float
    max_delay: float
    frequency: float
    pole: complex
    max_ratio: float
    hand_force: float
    max_ratio_with_deadband: float

    @property
    def is_stable(self) -> bool:
        """Whether no pole lies in the right half-plane."""
        return self.unstable_poles == 0


@dataclass(frozen=True)
class ScenarioFindings:
    """Results of the linear stability analysis of a teleoperated scenario.

    Attributes:
        name: name of the scenario.
        case: linear case of the scenario.
        task_source: source of the task's parameters.
        loop: results of the scenario's structure, or of direct force reflection in its place.
        held_spring: joystick axis under stiffness feedback, with the hand.
        released_spring: joystick axis under stiffness feedback, released.
        deadband_edge_ratio: change of hand force per change of machine force under stiffness
            feedback, with the handle at the edge of the dead band [N/N].
    """

    name: str
    case: LinearCase
    task_source: str
    loop: LoopFindings
    held_spring: StiffnessAxis
    released_spring: StiffnessAxis
    deadband_edge_ratio: float


def analyse_scenario_case(name: str, case: LinearCase, task_source: str) -> ScenarioFindings:
    """Analyse the stability of a teleoperated scenario from its linear model.

    Args:
        name: name of the scenario.
        case: linear model of hand, joystick, machine and task along one coordinate.
        task_source: text that states where the task's parameters come from.

    Returns:
        Stability of the loop, and of the joystick axis under stiffness feedback.

    Raises:
        InputError: the force reflection of the scenario has no linear model.

    Source: Zhu 1994, chapters 3 and 4.
    """
    reflection, mode = case.pilot.reflection, case.pilot.mode
    if reflection in _NONLINEAR_REFLECTIONS:
        why, instead = _NONLINEAR_REFLECTIONS[reflection]
        message = f"{reflection!r} of a scenario has no linear case, because {why}"
        raise InputError("pilot.reflection", f"{message}; {instead.format(mode)}")
    own = (reflection, mode) in _STRUCTURE_NAMES
    structure = _STRUCTURE_NAMES.get((reflection, mode), f"{mode}_force")
    spring = case.spring
    return ScenarioFindings(
        name, case, task_source, analyse_scenario_loop(case, structure, own), spring.with_hand(case.hand_impedance),
        spring, stiffness_feedback_ratio(case, case.deadband),
    )  # fmt: skip


def analyse_scenario_loop(case: LinearCase, structure: str, is_scenario_structure: bool = True) -> LoopFindings:
    """Compute poles, margins and the largest stable reflection ratio of a scenario's linear loop.

    Args:
        case: linear model of hand, joystick, machine and task.
        structure: control structure, one of `linear_case.STRUCTURES`.
        is_scenario_structure: whether the scenario uses this structure; it is only recorded.

    Returns:
        Poles, margins and ratios of the loop.

    Raises:
        InputError: the structure is not known.
    """
    if structure not in STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(STRUCTURES)}")
    try:
        many = count_unstable_poles(case.make_port(structure), case.hand, case.task)
    except PoleOnAxisError:
        many = None
    margin = find_gain_margin(case, structure)
    frequency, pole = _find_oscillation(case, structure, margin)
    ratio = passing = math.nan
    if structure.endswith("force"):
        ratio = margin * case.ratio
        share = deadband_gain(case.deadband, case.reach)
        passing = ratio / share if structure == "rate_force" and share > 0.0 else math.nan
    return LoopFindings(
        structure, is_scenario_structure, many, margin, find_max_delay(case, structure), frequency, pole, ratio,
        ratio * case.force_limit, passing,
    )  # fmt: skip


def _find_oscillation(case: LinearCase, structure: str, margin: float) -> tuple[float, complex]:
    """Return the oscillation frequency at the stability limit, and its pole at the present gain.

    At `margin` times the present gain of the return channels the loop is at its stability limit.
    From there to the present gain the pole is followed in small steps by Newton's method. Return
    frequency [Hz] and pole [rad/s]; both are NaN without a finite margin.
    """
    if not 0.0 < margin < math.inf:
        return math.nan, complex(math.nan, math.nan)

    def evaluate_characteristic_function(s: complex | np.ndarray, factor: float) -> np.ndarray:
        return 1.0 + loop_gain(case.make_port(structure, factor), s, case.hand, case.task)

    place = int(np.argmin(np.abs(evaluate_characteristic_function(1j * _SEARCH_FREQUENCIES, margin))))
    s = 1j * float(_SEARCH_FREQUENCIES[place])
    for factor in np.geomspace(margin, 1.0, _CONTINUATION_STEPS):
        for _ in range(_NEWTON_STEPS):
            step = 1e-6 * abs(s)
            here = complex(evaluate_characteristic_function(s, factor))
            slope = (complex(evaluate_characteristic_function(s + step, factor)) - here) / step
            s -= here / slope
    return float(_SEARCH_FREQUENCIES[place]) / (2.0 * math.pi), s

"""Analysis of a teleoperator's case file for several control structures, and its check by simulation.

A structure is a choice of signals that master and slave exchange, such as position forward and force
back. The analysis covers stability, margins and the stability theorem of stiffness feedback.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.linear_analysis import (
    StructureAnalysis,
    analyse_structure,
    stability_map,
)
from hydrotele.teleop.robustness import Robustness
from hydrotele.teleop.simulation_check import SineSweep, StabilityComparison, compare_stability, run_sine_sweep
from hydrotele.teleop.stiffness_switching import StiffnessAxis

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class TeleopFindings:
    """Results of the analysis of a case file with several control structures.

    Attributes:
        name: name of the case.
        case: teleoperator with hand and task.
        analyses: one analysis per structure.
        delays: (n,) delays of the map in each direction [s].
        factors: (m,) factors of the map on the return channels [1].
        maps: structure -> (m, n) map, true where the linear analysis predicts stability.
        spring: joystick axis with stiffness feedback, None without.
        sweeps: simulated sine sweeps, empty if not requested.
        agreements: predicted and simulated maps, empty if not requested.
        robustness_results: robustness of every structure, analysed with time sampling; empty if not
            requested.
        period: sampling period of the robustness results [s]; 0 without them.
    """

    name: str
    case: TeleoperatorAxis
    analyses: tuple[StructureAnalysis, ...]
    delays: np.ndarray
    factors: np.ndarray
    maps: dict[str, np.ndarray]
    spring: StiffnessAxis | None = None
    sweeps: tuple[SineSweep, ...] = ()
    agreements: tuple[StabilityComparison, ...] = ()
    robustness_results: tuple[Robustness, ...] = ()
    period: float = 0.0


def analyse_structures(
    name: str, case: TeleoperatorAxis, structures: tuple[str, ...], delays: np.ndarray, factors: np.ndarray,
    spring: StiffnessAxis | None = None, confirm: bool = False, progress: Progress | None = None,
) -> TeleopFindings:  # fmt: skip
    """Analyse several control structures of a case and, if requested, check them by simulation.

    Args:
        name: name of the case.
        case: teleoperator with hand and task.
        structures: names of the structures.
        delays: (n,) delays of the map in each direction [s].
        factors: (m,) factors of the map on the return channels [1].
        spring: joystick axis with stiffness feedback, None without.
        confirm: whether to simulate sine sweeps, with and without the case's delays, and every cell
            of the map.
        progress: called before the analysis of each structure, with its name and the fraction of
            the structures that are completed.

    Returns:
        Results of all structures.

    Raises:
        InputError: a structure is not known, or neither master nor slave has a mass.
    """
    analyses, maps, sweeps, agreements = [], {}, [], []
    for n, structure in enumerate(structures):
        if progress:
            progress(structure, n / len(structures))
        analyses.append(analyse_structure(case, structure))
        if not confirm:
            maps[structure] = stability_map(case, structure, delays, factors)
            continue
        late = [case] if case.delay else []
        sweeps += [run_sine_sweep(one, structure) for one in (case.with_delay(0.0), *late)]
        agreements.append(compare_stability(case, structure, delays, factors))
        maps[structure] = agreements[-1].predicted
    return TeleopFindings(name, case, tuple(analyses), delays, factors, maps, spring, tuple(sweeps), tuple(agreements))

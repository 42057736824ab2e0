"""Results of a teleoperation analysis as JSON data, in SI units."""

import numpy as np

from hydrotele.teleop.case_analysis import TeleopFindings
from hydrotele.teleop.linear_analysis import (
    StructureAnalysis,
)
from hydrotele.teleop.robustness import Robustness
from hydrotele.teleop.scenario_analysis import ScenarioFindings
from hydrotele.teleop.simulation_check import SineSweep
from hydrotele.teleop.stiffness_switching import StiffnessAxis

_JSON_FREQUENCY_STEP = 40  # step of the frequencies that are written to the JSON


def findings_to_dict(found: TeleopFindings) -> dict:
    """Convert the results of a case file to a dictionary for JSON.

    Margins are infinite if no tested value changes stability.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary in SI units; complex numbers are pairs of real and imaginary part.
    """
    case = found.case
    document = {
        "name": found.name,
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structures": {one.structure: _analysis_to_dict(one) for one in found.analyses},
        "map": {
            "delay": found.delays, "factor": found.factors,
            "stable": {name: cells.astype(bool).tolist() for name, cells in found.maps.items()},
        },
    }  # fmt: skip
    if found.spring:
        pair = {"held": found.spring.with_hand(case.hand), "released": found.spring}
        document["stiffness_feedback"] = {name: _spring_to_dict(one) for name, one in pair.items()}
    if found.robustness_results:
        document["robust"] = {
            "period": found.period,
            "structures": {one.structure: _robustness_to_dict(one) for one in found.robustness_results},
        }
    if found.agreements:
        document["confirmed"] = {
            "sweeps": [_sweep_to_dict(one) for one in found.sweeps],
            "agreement": {one.structure: one.agreement_fraction for one in found.agreements},
        }
    return document


def _analysis_to_dict(one: StructureAnalysis) -> dict:
    at = slice(None, None, _JSON_FREQUENCY_STEP)
    worst = int(np.argmax(one.scattering_norms))
    return {
        "stable": one.is_stable_held,
        "unstable_poles": one.unstable_poles,
        "unstable_poles_free": one.unstable_poles_free,
        "stable_released": one.is_stable_released,
        "unstable_poles_released": one.unstable_poles_released,
        "unstable_poles_released_free": one.unstable_poles_released_free,
        "gain_margin": one.gain_margin,
        "max_delay": one.max_delay,
        "passive": one.has_passive_port,
        "scattering_peak": one.scattering_norms[worst],
        "scattering_peak_frequency": one.frequencies[worst],
        "frequency": one.frequencies[at],
        "hybrid": _complex_to_pairs(one.hybrid_matrices[at]),
        "transmitted": _complex_to_pairs(one.transmitted_impedance[at]),
        "task": _complex_to_pairs(one.task_impedance[at]),
        "scattering": one.scattering_norms[at],
        "loop": _complex_to_pairs(one.loop_gains[at]),
    }


def _robustness_to_dict(one: Robustness) -> dict:
    names = ("held_task", "held_free", "released_task", "released_free")
    document = {
        "absolutely_stable": one.has_absolute_stability,
        "llewellyn": one.llewellyn,
        "sampled": {
            name: {"stable": told.is_stable, "reason": told.reason}
            for name, told in zip(names, one.sampled, strict=True)
        },
        "sampled_pairs": {
            "pairs": one.sampled_pairs.pair_count, "unstable": one.sampled_pairs.unstable_count,
            "unstable_released": one.sampled_pairs.unstable_released_count,
            "worst_growth_rate": one.sampled_pairs.worst_growth_rate,
            "worst_hand": vars(one.sampled_pairs.worst_hand), "worst_task": vars(one.sampled_pairs.worst_task),
        },
    }  # fmt: skip
    if one.z_width_result:
        document["z_width"] = {
            "decades": one.z_width_result.mean_width_decades,
            "max_stiffness_held": one.z_width_result.max_stiffness_held,
            "max_stiffness_released": one.z_width_result.max_stiffness_released,
            "max_tested_stiffness": one.z_width_result.max_tested_stiffness,
        }  # fmt: skip
    if one.released_polynomial:
        document["released_master"] = {
            "coefficients": one.released_polynomial.coefficients,
            "unstable_poles": one.released_polynomial.unstable_zeros,
        }  # fmt: skip
    return document


def _complex_to_pairs(values: np.ndarray) -> list:
    return np.stack([np.real(values), np.imag(values)], axis=-1).tolist()


def _spring_to_dict(one: StiffnessAxis) -> dict:
    return {
        "mass": one.mass, "damping": one.damping, "min_stiffness": one.min_stiffness,
        "max_stiffness": one.max_stiffness, "margin": one.stability_theorem_margin,
        "theorem_damping": one.stability_theorem_damping, "worst_growth": one.half_swing_growth,
        "min_stable_damping": one.min_stable_damping, "stable_by": one.stability_criterion,
    }  # fmt: skip


def _sweep_to_dict(one: SineSweep) -> dict:
    return {
        "structure": one.structure, "delay_forward": one.delay_forward,
        "delay_back": one.delay_back, "error": one.max_relative_error, "frequency": one.frequencies,
        "expected": _complex_to_pairs(one.expected), "measured": _complex_to_pairs(one.measured),
    }  # fmt: skip


def scenario_findings_to_dict(found: ScenarioFindings) -> dict:
    """Convert the results of a scenario's analysis to a dictionary for JSON, in SI units.

    Values that do not exist are infinite or NaN.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary.
    """
    case, loop, tip = found.case, found.loop, found.case.tip
    springs = {"held": found.held_spring, "released": found.released_spring}
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
            "name": loop.structure, "of_the_scenario": loop.is_scenario_structure, "stable": loop.is_stable,
            "unstable_poles": loop.unstable_poles, "gain_margin": loop.gain_margin,
            "max_delay": loop.max_delay, "frequency": loop.frequency,
            "pole": [loop.pole.real, loop.pole.imag], "ratio": case.ratio,
            "max_ratio": loop.max_ratio, "force_limit": case.force_limit,
            "hand_force_at_limit": loop.hand_force,
            "max_ratio_with_deadband": loop.max_ratio_with_deadband,
        },
        "stiffness_feedback": {
            "ratio_at_deadband_edge": found.deadband_edge_ratio,
            **{
                name: {
                    "mass": one.mass, "damping": one.damping, "max_stiffness": one.max_stiffness,
                    "margin": one.stability_theorem_margin, "theorem_damping": one.stability_theorem_damping,
                    "worst_growth": one.half_swing_growth, "min_stable_damping": one.min_stable_damping,
                    "stable_by": one.stability_criterion,
                }
                for name, one in springs.items()
            },
        },
    }  # fmt: skip

"""Psychophysical experiments with the simulated operator: discrimination of stiffness and force.

The method of constant stimuli with two intervals is used. In every trial the handle is a reference
and a comparison in random order. The operator moves each to a displacement, holds it, and reports
which was stiffer (or stronger). The displacement varies from trial to trial, so that neither
terminal force nor work is a cue. A cumulative normal through the responses gives the just
noticeable difference. Muscles, tremor and perception are those of the simulated runs; the
experiment uses only the responses.

Source: Tan et al. 1995, Perception & Psychophysics 57 (roving displacement).
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import copy_to_contiguous_state
from hydrotele.machine.joystick import HandImpedance
from hydrotele.teleop.manual_control import discretise_neuromuscular_lag
from hydrotele.teleop.neuromuscular_dynamics import REFLEX_DELAY, NeuromuscularState, compute_muscle_forces
from hydrotele.teleop.operator_parameters import Operator
from hydrotele.teleop.perception import PerceptionErrors, draw_perception_errors, perceive_stiffness

_LEVELS = {
    "stiffness": (-0.6, -0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45, 0.6),
    "force": (-0.2, -0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15, 0.2),
}
DISPLACEMENT_RANGE = (2.0e-3, 4.5e-3)  # m, displacements of the handle
_PERIOD, _SUBSTEPS = 0.005, 10  # control period [s], integration steps of the handle per period
_MASS, _DAMPING = 0.85, 60.0  # kg, N s/m of the joystick's handle
_DECISION_PERIOD = 0.02  # s

ComparedQuantity = Literal["stiffness", "force"]


class PsychometricFunction(NamedTuple):
    """Psychometric function of a discrimination experiment: response fraction by stimulus level.

    Attributes:
        levels: (n,) comparison stimulus over reference stimulus, minus 1.
        greater_fraction: (n,) fraction of the trials in which the comparison was reported as greater.
        trials: number of trials per level.
        jnd: just noticeable difference, relative to the reference: the standard deviation of one
            perceived stimulus (d' = 1).
        jnd_error: standard error of `jnd`.
        bias: level at which comparison and reference are perceived as equal.
    """

    levels: np.ndarray
    greater_fraction: np.ndarray
    trials: int
    jnd: float
    jnd_error: float
    bias: float


@compiled
def _simulate_exploration(muscles, hand, past, tremor, spring, load, first, felt):
    """Simulate an operator who moves a handle with stiffness `spring` and opposing force `load`.

    The operator is given by `muscles` (NeuromuscularState with the reference displacement), mass [kg]
    and damping [N s/m] of the hand, `hand` (2,), the ring buffer `past` of handle displacements and the
    tremor forces `tremor`; `first` is the index of the first tremor sample. The force of the hand on
    the handle [N] and its position [m] in every period are written to `felt` (n, 2).
    """
    mass, x, v = _MASS + hand[0], 0.0, 0.0
    step = _PERIOD / _SUBSTEPS
    handle = np.zeros(6)
    for k in range(len(felt)):
        handle[0] = x
        before = v
        compute_muscle_forces(muscles, past, tremor, handle, first + k, _PERIOD)
        for _ in range(_SUBSTEPS):
            push = muscles.force[0] - muscles.arm[0] * x
            push -= (_DAMPING + hand[1]) * v + spring * x + load
            v += step * push / mass
            x += step * v
        felt[k, 0] = spring * x + load + _DAMPING * v + _MASS * (v - before) / _PERIOD
        felt[k, 1] = x


def _make_operator_arm(operator: Operator, hand: HandImpedance, expected: float) -> NeuromuscularState:
    """Create the operator's arm and muscles at rest, for a handle of an expected stiffness [N/m].

    The experiment uses axis 0 only. The handle moves horizontally, so that the hand has no weight.
    """
    zero = np.zeros(6)
    return copy_to_contiguous_state(NeuromuscularState(
        reference=zero, spring=zero + expected, detent=np.full((3, 6), -1.0), correction=zero,
        force=zero, arm=zero + hand.stiffness, cross=np.zeros(1), max_force=zero + operator.max_force,
        weight=zero,
        gain=np.array([operator.handle_position_gain]), rest=zero, rate=zero,
        lag=discretise_neuromuscular_lag(operator.neuromuscular_frequency, 1.0, _PERIOD),
    ))  # fmt: skip


def measure_discrimination(
    operator: Operator, hand: HandImpedance, sense: ComparedQuantity = "stiffness", reference: float = 1000.0,
    trials: int = 40, seed: int = 0,
) -> PsychometricFunction:  # fmt: skip
    """Measure an operator's just noticeable difference of stiffness or force, by simulated trials.

    Args:
        operator: parameters of the operator.
        hand: parameters of the hand on the handle.
        sense: compared quantity: `stiffness` of the handle, or a constant opposing `force`.
        reference: reference stiffness [N/m] or force [N], with which all levels are compared.
        trials: number of trials per level.
        seed: seed of the trials.

    Returns:
        The psychometric function with the just noticeable difference and its error.
    """
    rng = np.random.default_rng([seed, 1995])
    ticks = round(operator.correction_interval / _PERIOD)
    tremor = operator.tremor * _make_tremor(rng, 2**12)
    every, levels = round(_DECISION_PERIOD / _PERIOD), np.array(_LEVELS[sense])
    decisions = ticks // every

    def simulate_perceived_value(value: float) -> float:
        errors = draw_perception_errors(operator, rng, decisions, _DECISION_PERIOD)
        spring, load = (value, 0.0) if sense == "stiffness" else (0.0, value)
        muscles = _make_operator_arm(operator, hand, reference if sense == "stiffness" else 0.0)
        muscles.reference[0] = rng.uniform(*DISPLACEMENT_RANGE)
        past, handle = np.zeros((1 + round(REFLEX_DELAY / _PERIOD), 6)), np.zeros((ticks, 2))
        inertia = np.array([hand.mass, hand.damping])
        first = int(rng.integers(2**11))
        _simulate_exploration(muscles, inertia, past, tremor, spring, load, first, handle)
        return _mean_perception(handle[::every], errors, sense)

    greater = np.zeros(len(levels))
    for k, level in enumerate(levels):
        for _ in range(trials):
            pair = [reference, reference * (1.0 + level)]
            if swapped := rng.random() < 0.5:
                pair.reverse()
            felt = [simulate_perceived_value(value) for value in pair]
            greater[k] += (felt[0] > felt[1]) == swapped
    bias, spread, error = fit_psychometric_function(levels, greater, trials)
    root = math.sqrt(2.0)  # the responses contain the noise of both intervals
    return PsychometricFunction(levels, greater / trials, trials, spread / root, error / root, bias)


def _mean_perception(handle: np.ndarray, errors: PerceptionErrors, sense: ComparedQuantity) -> float:
    """Return the mean perceived stiffness [N/m] or force [N] in the second half of an exploration.

    `handle` (n, 2) is force [N] and position [m] in every decision; `errors` are the operator's
    perception errors.
    """
    felt = []
    for number in range(len(errors.force) // 2, len(errors.force)):
        force, x = (float(value) for value in handle[number])
        if sense == "stiffness":
            felt.append(perceive_stiffness(force, x, errors, number))
        else:
            felt.append(force * errors.force[number])
    return float(np.mean(felt))


def _make_tremor(rng: np.random.Generator, count: int) -> np.ndarray:
    from scipy.signal import lfilter

    share = 1.0 - math.exp(-2.0 * math.pi * 8.0 * _PERIOD)
    white = rng.standard_normal((count, 6)) * math.sqrt((2.0 - share) / share)
    return np.asarray(lfilter([share], [1.0, share - 1.0], white, axis=0))


def fit_psychometric_function(
    levels: np.ndarray, greater: np.ndarray, trials: int, lapse: float = 0.01
) -> tuple[float, float, float]:  # fmt: skip
    """Fit a psychometric function, a cumulative normal, to responses by maximum likelihood.

    Args:
        levels: (n,) stimulus levels of the comparison.
        greater: (n,) number of trials in which the comparison was reported as greater.
        trials: number of trials per level.
        lapse: lower limit of the fitted probability of the response "greater", and distance of its
            upper limit from 1, for responses that do not depend on the level.

    Returns:
        Mean and standard deviation of the normal, and standard error of the standard deviation, all in
        the unit of the levels.
    """
    from scipy.optimize import minimize
    from scipy.special import ndtr

    def greater_probability(x: np.ndarray) -> np.ndarray:
        return lapse + (1.0 - 2.0 * lapse) * ndtr((levels - x[0]) / math.exp(x[1]))

    def negative_log_likelihood(x: np.ndarray) -> float:
        p = greater_probability(x)
        return -float(np.sum(greater * np.log(p) + (trials - greater) * np.log(1.0 - p)))

    found = minimize(negative_log_likelihood, np.array([0.0, math.log(0.3 * np.ptp(levels))]), method="Nelder-Mead").x
    step = 1e-3
    slopes = [_finite_difference(greater_probability, found, k, step) for k in range(2)]
    p = greater_probability(found)
    information = np.array([
        [np.sum(trials * a * b / (p * (1.0 - p))) for a in slopes] for b in slopes
    ])  # fmt: skip
    spread = math.exp(found[1])
    return float(found[0]), spread, spread * math.sqrt(np.linalg.pinv(information)[1, 1])


def _finite_difference(share: Callable, x: np.ndarray, k: int, step: float) -> np.ndarray:
    moved = np.zeros(2)
    moved[k] = step
    return (share(x + moved) - share(x - moved)) / (2.0 * step)

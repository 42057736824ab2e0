"""Identification of valves, oil, leakage and supply from commands, pressures and motion.

The parameters are those of the effect library. All are fitted together to the one-step prediction
errors of a Kalman filter on the complete model, so that no signal is differentiated and sensor
noise is modelled. Parameters that the data do not determine keep their prior: the given value with
the standard deviation of the effect.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence, Fit, invert_information, standard_deviations
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.estimate.levels import check_filter_follows
from hydrotele.estimate.track import Levels, known_levels, track_run
from hydrotele.logs.dataset import Dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine import Machine

HYDRAULIC_EFFECTS = (
    "valve_gain", "valve_deadband", "spool_lag", "internal_leakage", "bulk_modulus",
    "pump_flow_limit", "relief_pressure",
)  # fmt: skip
_MAX_ROUNDS = 6  # largest number of rounds, each with new filter gains and sensitivities
_CONVERGENCE_STD = 0.2  # standard deviations, largest change of a parameter in the last round
_STEPS_PER_ROUND = 2  # Gauss-Newton steps between new filter gains
_MAX_STD_OVER_PRIOR = 0.7  # of the prior's standard deviation: the data determine parameters known better
_NORMAL95 = 1.959964
_MAX_DURATION_S = 240.0  # s of data used: every parameter costs one filter run per Jacobian
_ERROR_CONTEXT = "hydraulic identification"


@dataclass(frozen=True)
class HydraulicParameter:
    """One identified parameter of the hydraulics.

    Attributes:
        effect: name of the effect that changes the parameter.
        location: axis, `supply` or `all`.
        parameter: name of the parameter in the effect.
        unit: SI unit.
        nominal: given value.
        value: identified value.
        std: standard deviation.
        ci95: 95 % interval.
        is_determined: whether the data determine it, with a standard deviation below 0.7 of that of the
            prior; otherwise value and std are mostly those of the prior.
    """

    effect: str
    location: str
    parameter: str
    unit: str
    nominal: float
    value: float
    std: float
    ci95: tuple[float, float]
    is_determined: bool

    @property
    def qualified_name(self) -> str:
        """Name of the effect and its location, such as `valve_gain.boom`."""
        return f"{self.effect}.{self.location}"


@dataclass(frozen=True)
class HydraulicIdentification:
    """Result of a hydraulic identification.

    Attributes:
        parameters: the identified parameters.
        machine: the given machine with the identified values of the parameters that the data determine.
        nominal_rms_error: RMS of the one-step prediction errors of the held-out run with the given machine,
            each divided by its predicted standard deviation [1]. The noise is that stated by the sensors,
            otherwise that found with the identified machine.
        identified_rms_error: the same with the identified machine.
        status: `ok`, or a sentence that names the problem and the remedy.
        seconds: computing time [s].
    """

    parameters: tuple[HydraulicParameter, ...]
    machine: Machine
    nominal_rms_error: float
    identified_rms_error: float
    status: str
    seconds: float


def identify_hydraulics(
    dataset: Dataset, jobs: int = 2, progress: Callable[[str, float], None] | None = None
) -> HydraulicIdentification:
    """Identify the parameters of valves, oil, leakage, pump and relief valve.

    All are fitted together to the one-step prediction errors of a Kalman filter and to priors, the
    given values with the standard deviations of the effects.

    Args:
        dataset: logs of the machine; the search starts from its machine.
        jobs: number of worker processes.
        progress: called with a description of the step and the finished fraction, 0 .. 1.

    Returns:
        The parameters and the identified machine.

    Raises:
        InputError: the machine has no hydraulics, or its filter cannot follow the readings.

    Source: Ljung 1999, System identification, chapter 7 (prediction-error methods); start values
    and priors: `hydrotele.effects`.
    """
    started, say = time.perf_counter(), progress or (lambda said, share: None)
    parts = hypotheses(dataset.machine, HYDRAULIC_EFFECTS)
    if not parts:
        raise InputError(_ERROR_CONTEXT, f"{dataset.machine.name} has no valves")
    data = select_exciting_segments(dataset, _MAX_DURATION_S)
    guess = Guess(tuple((h, np.zeros(h.size)) for h in parts))
    evidence = Evidence(data, data.fit, jobs)
    try:
        fit, settled = _fit_in_rounds(evidence, guess, say)
        evidence.set_base(fit.guess)
        say("intervals", 0.9)
        std = standard_deviations(evidence, fit.guess)
        levels = Levels(evidence.tracks[0].levels.noise)
    finally:
        evidence.close()
    numbers = _collect_parameters(fit.guess, std)
    machine = _apply_parameters(dataset.machine, numbers)
    sizes = [_prediction_error_rms(m, data, levels) for m in (dataset.machine, machine)]
    status = "ok" if settled else (
        "not converged: the given parameters are inaccurate or the model is incomplete; start again"
        " from the identified machine, or search for missing effects with `hydrotele gap`"
    )  # fmt: skip
    if settled and known_levels(dataset) and sizes[1] > 1.5:
        status = (
            f"prediction errors on the held-out run are {sizes[1]:.2g} times the sensor noise: the"
            " model is incomplete; search for missing effects with `hydrotele gap`"
        )
    return HydraulicIdentification(numbers, machine, sizes[0], sizes[1], status, time.perf_counter() - started)


def _fit_in_rounds(evidence: Evidence, guess: Guess, report: Callable[[str, float], None]):
    """Fit the parameters by Gauss-Newton steps in rounds, each with new Kalman filter gains.

    Returns:
        (the fit, whether the last of at most six rounds changed each parameter by less than 0.2
        standard deviations).
    """
    fit = None
    for k in range(_MAX_ROUNDS):
        report(f"round {k + 1}", 0.9 * k / _MAX_ROUNDS)
        evidence.set_base(guess)
        if fit is None:
            check_filter_follows(evidence.tracks, evidence.data.channels)
        before = evidence.base_errors
        loss = float(before @ before + guess.deviation @ guess.deviation)
        fit = evidence.fit(guess, loss, steps=_STEPS_PER_ROUND)
        spread = np.sqrt(np.diag(invert_information(fit.information)))
        moved = np.abs(fit.guess.deviation - guess.deviation) / spread
        guess = fit.guess
        if moved.max() < _CONVERGENCE_STD:
            return fit, True
    assert isinstance(fit, Fit)
    return fit, False


def _collect_parameters(guess: Guess, std: np.ndarray) -> tuple[HydraulicParameter, ...]:
    found, at = [], 0
    for hypothesis, deviation in guess.parts:
        values = hypothesis.values(deviation)
        for name, p in hypothesis.parameters.items():
            spread, value = float(std[at]) * p.prior_std, values[name]
            reach = _NORMAL95 * spread
            found.append(HydraulicParameter(
                hypothesis.name, hypothesis.location, name, p.unit, p.nominal, value, spread,
                (value - reach, value + reach), bool(std[at] < _MAX_STD_OVER_PRIOR),
            ))  # fmt: skip
            at += 1
    return tuple(found)


def _apply_parameters(machine: Machine, numbers: tuple[HydraulicParameter, ...]) -> Machine:
    """Return the machine with the identified values of those parameters that the data determine."""
    for n in numbers:
        if n.is_determined:
            machine = EFFECTS[n.effect].apply(machine, n.location, {n.parameter: n.value})
    return machine


def _prediction_error_rms(machine: Machine, data: Dataset, levels: Levels) -> float:
    """Return the RMS of a machine's one-step prediction errors of the held-out run [1].

    Each error is divided by the standard deviation that the filter predicts for it with the noise
    `levels`.
    """
    data = dataclasses.replace(data, machine=machine)
    whitened = track_run(machine, data, data.heldout, levels=levels).whitened
    return float(np.sqrt(np.nanmean(whitened**2)))

"""Hydraulic identification: valves, oil, leakage and supply from commands, pressures and motion.

The numbers are those of the library's effects, all fitted together to the one-step prediction
errors of a Kalman filter on the whole model. Nothing is differentiated, the sensors' noise has its
place, and what the data do not tell keeps its prior: the given value with a spread that the effect
states.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence, Fit, standard_deviations
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.estimate.track import Levels, known_levels, track_run
from hydrotele.logs.dataset import Dataset, busiest
from hydrotele.machine.machine import Machine

HYDRAULIC = (
    "valve_gain", "valve_deadband", "spool_lag", "internal_leakage", "bulk_modulus",
    "pump_flow_limit", "relief_pressure",
)  # fmt: skip
_ROUNDS = 6  # of new gains and slopes
_SETTLED = 0.2  # standard deviations by which a round may still move a number
_STEPS = 2  # Gauss-Newton steps between new gains
_TOLD = 0.7  # of the prior's spread; a number known no better was not told by the data
_NORMAL95 = 1.959964
_MOST = 240.0  # s of data: slopes of all numbers cost as many runs of the filter
_WHERE = "hydraulic identification"


@dataclass(frozen=True)
class HydraulicNumber:
    """One identified number of the hydraulics.

    Attributes:
        effect: name of the library's effect that changes it.
        location: axis, `supply` or `all`.
        parameter: its name in the effect.
        unit: SI.
        nominal: as given.
        value: identified.
        std: standard deviation.
        ci95: 95 % interval.
        told: whether the data tell it; otherwise value and std are mostly the prior's.
    """

    effect: str
    location: str
    parameter: str
    unit: str
    nominal: float
    value: float
    std: float
    ci95: tuple[float, float]
    told: bool

    @property
    def name(self) -> str:
        """Such as `valve_gain.boom`."""
        return f"{self.effect}.{self.location}"


@dataclass(frozen=True)
class Hydraulics:
    """Result.

    Attributes:
        numbers: the identified numbers.
        machine: the machine that has those which the data tell.
        before: RMS of the held-out run's whitened one-step prediction errors with the machine that
            the search started from [1], by the noise of the readings that the sensors state or,
            where they state none, that was found with the identified machine.
        after: the same with the identified machine.
        status: `ok`, or what is wrong and what to do about it.
        seconds: that it took.
    """

    numbers: tuple[HydraulicNumber, ...]
    machine: Machine
    before: float
    after: float
    status: str
    seconds: float


def identify_hydraulics(
    dataset: Dataset, jobs: int = 2, progress: Callable[[str, float], None] | None = None
) -> Hydraulics:
    """Identify the numbers of valves, oil, leakage, pump and relief valve.

    Args:
        dataset: logs of the machine; its machine is where the search starts.
        jobs: workers.
        progress: told what is being done and how far, 0 .. 1.

    Returns:
        The numbers and the machine that has them.

    Raises:
        InputError: the machine has no hydraulics.

    Source: Ljung 1999, System identification, chapter 7 (prediction-error methods); start values
    and priors: `hydrotele.effects`.
    """
    started, say = time.perf_counter(), progress or (lambda said, share: None)
    parts = hypotheses(dataset.machine, HYDRAULIC)
    if not parts:
        raise InputError(_WHERE, f"{dataset.machine.name} has no valves")
    data = busiest(dataset, _MOST)
    guess = Guess(tuple((h, np.zeros(h.size)) for h in parts))
    evidence = Evidence(data, data.fit, jobs)
    try:
        fit, settled = _fitted(evidence, guess, say)
        evidence.set_base(fit.guess)
        say("intervals", 0.9)
        std = standard_deviations(evidence, fit.guess)
        levels = Levels(evidence.tracks[0].levels.noise)
    finally:
        evidence.close()
    numbers = _numbers(fit.guess, std)
    machine = _machine(dataset.machine, numbers)
    sizes = [_size(m, data, levels) for m in (dataset.machine, machine)]
    status = "ok" if settled else (
        "not settled: the given numbers are far off, or the model lacks something; start again"
        " from the identified machine, or look with `hydrotele gap`"
    )  # fmt: skip
    if settled and known_levels(dataset) and sizes[1] > 1.5:
        status = (
            f"on the held-out run prediction errors are {sizes[1]:.2g} times what the sensors"
            " explain: the model lacks something; look for it with `hydrotele gap`"
        )
    return Hydraulics(numbers, machine, sizes[0], sizes[1], status, time.perf_counter() - started)


def _fitted(evidence: Evidence, guess: Guess, say: Callable[[str, float], None]):
    """Gauss-Newton with gains anew in every round; the fit and whether it settled."""
    fit = None
    for k in range(_ROUNDS):
        say(f"round {k + 1}", 0.9 * k / _ROUNDS)
        evidence.set_base(guess)
        before = evidence.base_errors
        loss = float(before @ before + guess.deviation @ guess.deviation)
        fit = evidence.fit(guess, loss, steps=_STEPS)
        spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        moved = np.abs(fit.guess.deviation - guess.deviation) / spread
        guess = fit.guess
        if moved.max() < _SETTLED:
            return fit, True
    assert isinstance(fit, Fit)
    return fit, False


def _numbers(guess: Guess, std: np.ndarray) -> tuple[HydraulicNumber, ...]:
    found, at = [], 0
    for hypothesis, deviation in guess.parts:
        values = hypothesis.values(deviation)
        for name, p in hypothesis.parameters.items():
            spread, value = float(std[at]) * p.scale, values[name]
            reach = _NORMAL95 * spread
            found.append(HydraulicNumber(
                hypothesis.name, hypothesis.location, name, p.unit, p.nominal, value, spread,
                (value - reach, value + reach), bool(std[at] < _TOLD),
            ))  # fmt: skip
            at += 1
    return tuple(found)


def _machine(machine: Machine, numbers: tuple[HydraulicNumber, ...]) -> Machine:
    """The machine with the numbers that are told; all effects here have one parameter."""
    for n in numbers:
        if n.told:
            machine = EFFECTS[n.effect].apply(machine, n.location, {n.parameter: n.value})
    return machine


def _size(machine: Machine, data: Dataset, levels: Levels) -> float:
    """RMS of whitened prediction errors along the held-out run."""
    data = dataclasses.replace(data, machine=machine)
    whitened = track_run(machine, data, data.heldout, levels=levels).whitened
    return float(np.sqrt(np.nanmean(whitened**2)))

"""Calibration by open-loop predictions before the search, and fits whose noise levels are re-estimated.

A machine file may state that its numbers are estimates: `uncertainty: {flow_table: 1.0, linkage: 0.15}`. Where no
pressure is logged, one-step predictions hardly depend on the flow of a valve over its command. Such parameters are
therefore fitted to open-loop predictions first, and the search explains what remains. The fit is kept only if
cross-validation over parts of the fitted runs has smaller errors.

The same is done for a drive with a pump of its own, with or without pressures: the motor, the oil and the friction act
for longer than one reading. All parameters that its machine file states as uncertain are fitted then.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects.effect import with_value
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, invert_information
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis, calibration, numbers
from hydrotele.estimate.output_error import (
    DIRECTIONS,
    LEAD,
    LOG,
    REMEMBERED,
    TRAVEL,
    WINDOW,
    FreeRunFit,
    fit_free_runs,
    states_uncertain_parameters,
    table_steps,
    uncertain_parameters,
)
from hydrotele.gap.result import Estimate
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.dataset_reduction import downsample
from hydrotele.machine.machine import Machine

_NORMAL95 = 1.96
_FLOW_TABLE = "flow_table"
_PUMP_WINDOW = 2.5  # s of a pump drive: a move of a stroke of some centimetres
_PUMP_REMEMBERED = 0.1  # s: the lag of its motor, see `output_error`


@dataclass(frozen=True)
class FreeCalibration:
    """A machine calibrated by free runs.

    Attributes:
        machine: with the numbers found, each as uncertain as free runs leave it.
        numbers: such as `linkage.stick.base` or `flow_table.boom.positive_50`, the opening at 50 %
            travel beyond the dead band; ratios to the given machine where no unit fits.
        note: one sentence on what stretches that were left out say.
        guess: the fitted parameters, as changes of the given machine.
        covariance: (P, P) of their normalised deviations.
    """

    machine: Machine
    numbers: dict[str, Estimate]
    note: str
    guess: Guess
    covariance: np.ndarray


def calibrate_freely(
    data: Dataset, jobs: int, tell: Callable[[str], None] = lambda text: None
) -> FreeCalibration | None:
    """Calibrate what a machine file leaves open, if it does.

    Args:
        data: the dataset; `heldout` is not seen.
        jobs: threads.
        tell: told of every round.

    Returns:
        The calibration; None where the machine states no such uncertainty, a pressure of a valve
        drive is read, runs are too short, or
        stretches that are left out are predicted no better.
    """
    guess, seconds, remembered = _open(data), WINDOW, REMEMBERED
    if any(axis.pump for axis in data.machine.axes.values()):
        seconds, remembered = _PUMP_WINDOW, _PUMP_REMEMBERED
    if guess is None or all(_seconds(run) < LEAD + 2.0 * seconds for run in data.fit):
        return None
    fit = fit_free_runs(downsample(data), guess, seconds, jobs=jobs, say=tell, remembered=remembered)
    before, after = fit.left_out
    if not np.mean(np.log(after / before)) < 0.0:
        return None
    closer = ", ".join(
        f"{channel} {100.0 * (1.0 - b / a):.0f} %" for channel, a, b in zip(data.channels, before, after, strict=True)
    )
    note = (
        "The open parameters of the machine file were calibrated on open-loop predictions first."
        f" In cross-validation over intervals of {seconds:g} s, the errors decrease by: {closer}."
    )
    numbers = _numbers(data.machine, fit)
    return FreeCalibration(_told(data.machine, fit), numbers, note, fit.guess, fit.covariance)


def _seconds(run: RunData) -> float:
    return len(run.command) * run.period


def _open(data: Dataset) -> Guess | None:
    """What is left open, at nominal; None if nothing is."""
    machine = data.machine
    if machine.uncertainty and any(axis.pump for axis in machine.axes.values()):
        group = calibration(machine)
        return Guess(((group, np.zeros(group.size)),))
    pressures = any(channel.startswith("pressure") for channel in data.channels)
    return None if pressures or not states_uncertain_parameters(machine) else uncertain_parameters(machine)


def _told(nominal: Machine, fit: FreeRunFit) -> Machine:
    """The fitted machine, whose numbers are as uncertain as the fit leaves them.

    Else one-step predictions, which know little of a number that free runs tell, take it back.
    """
    stated, place = dict(nominal.uncertainty), fit.guess.names
    sd = dict(zip(place, fit.deviation_sd, strict=True))
    first = f"{CALIBRATION}.all."
    known, found = numbers(nominal), numbers(fit.machine)
    for name in place:
        key = name.removeprefix(first)
        if name.startswith(first) and key in found:
            ratio = known[key].parameter.prior_std / found[key].parameter.prior_std
            stated[key] = found[key].share * ratio * min(float(sd[name]), 1.0)
    return with_value(fit.machine, "uncertainty", stated)


def _numbers(nominal: Machine, fit: FreeRunFit) -> dict[str, Estimate]:
    """All numbers of a fit with their intervals."""
    covariance, first, found = fit.covariance, 0, {}
    for hypothesis, deviation in fit.guess.parts:
        own = slice(first, first + hypothesis.size)
        first += hypothesis.size
        values = np.array(list(hypothesis.values(deviation).values()))
        scale = np.array([p.prior_std for p in hypothesis.parameters.values()])
        spread = covariance[own, own] * np.outer(scale, scale)
        if hypothesis.name == _FLOW_TABLE:
            keys = list(hypothesis.parameters)
            found |= _openings(nominal, hypothesis.location, keys, values, spread)
        for k, (key, p) in enumerate(hypothesis.parameters.items()):
            if hypothesis.name == _FLOW_TABLE and p.unit == LOG:
                continue
            reach = _NORMAL95 * np.sqrt(spread[k, k])
            numbers = np.array([values[k], values[k] - reach, values[k] + reach, p.nominal])
            numbers = np.clip(numbers, p.lower_bound, p.upper_bound)
            if p.unit == LOG:
                numbers = np.exp(numbers)
            value, low, high, was = map(float, numbers)
            unit = "1" if p.unit == LOG else p.unit
            place = f"{hypothesis.name}.{hypothesis.location}.{key}"
            place = key if hypothesis.name == CALIBRATION else place
            found[place] = Estimate(value, unit, low, high, was)
    return found


def _openings(
    nominal: Machine, axis: str, keys: list[str], values: np.ndarray, spread: np.ndarray
) -> dict[str, Estimate]:
    """Openings of a flow table at its knots, intervals to first order in its logarithms."""
    valve, found = nominal.axes[axis].valve, {}
    assert valve
    count = len(TRAVEL) - 1
    for way in DIRECTIONS:
        own = [keys.index(f"gain_{way}"), *(keys.index(f"{way}_{k + 1}") for k in range(count))]
        gain, *logs = values[own]
        steps = table_steps(getattr(valve, way))
        grown = steps * np.exp(gain + np.array(logs))
        openings = np.cumsum(grown)
        slope = np.column_stack([openings, np.tril(np.tile(grown, (count, 1)))])
        reach = _NORMAL95 * np.sqrt(np.diag(slope @ spread[np.ix_(own, own)] @ slope.T))
        for travel, value, own_reach, was in zip(TRAVEL[1:], openings, reach, np.cumsum(steps), strict=True):
            low, high = max(0.0, float(value - own_reach)), float(value + own_reach)
            key = f"{_FLOW_TABLE}.{axis}.{way}_{round(100 * travel)}"
            found[key] = Estimate(float(value), "1", low, high, float(was))
    return found


def calibration_of(guess: Guess) -> Hypothesis | None:
    """The calibration in a guess, or None."""
    return next((h for h, _ in guess.parts if h.name == CALIBRATION), None)


_SETTLES = 6  # rounds of levels and fit: what inputs took at first is given back bit by bit
_UNMOVED = 0.3  # standard deviations by which a number may still move
_IDLE = 3.0  # fall of the loss that is not worth another round of a calibration
_STALE = 200.0  # fall of the loss after which the slopes of a calibration are taken anew
_WORSE_SETTLING = 100.0  # rise of the loss with levels found anew after which a step is taken back
_ROOM = 3.0  # times the room to a bound that an effect gets that stands there


def fit_until_settled(
    evidence: Evidence, judged: Judged, wanted: float = np.inf, least_gain: float = 0.0
) -> tuple[Judged, Fit]:  # fmt: skip
    """Fit with levels and gains computed anew until they no longer matter.

    Args:
        evidence: the runs; the guess becomes the base.
        judged: the guess to begin with.
        wanted: a loss; what would not come down to it at the present pace is left as it is.
        least_gain: a guess whose loss the first fit lowers by less is left as it is.

    Returns:
        The guess, judged, and its last fit.
    """
    begin = judged
    fit, last, guess, kept = None, None, judged.guess, None
    group = calibration_of(guess)
    for left in reversed(range(_SETTLES)):
        evidence.set_base(judged)
        if group and kept is None:
            kept = evidence.base_slopes(evidence.slope_step)
        last = fit
        fit = evidence.fit(judged.guess, 0.0, kept=kept, step=MIDDLE if group else None)
        if last is None and _squares(evidence) + judged.guess.prior - fit.loss < least_gain:
            return evidence.set_base(judged), replace(fit, guess=judged.guess)
        moved = fit.guess.deviation - judged.guess.deviation
        spread = np.sqrt(np.diag(invert_information(fit.information)))
        guess = widened(fit.guess)
        if np.all(np.abs(moved) < _UNMOVED * spread):
            break
        before, judged = judged, evidence.judged(guess, same=True)
        fall = before.loss - judged.loss
        if not fall > -_WORSE_SETTLING:  # a likelihood full of dents, as that of teeth, misleads its slopes
            guess, fit = before.guess, last or fit
            evidence.set_base(before)
            break
        if group and fall < _IDLE:
            break
        if judged.loss - max(fall, 0.0) * left > wanted:
            return evidence.set_base(judged), fit
        kept = kept if fall < _STALE else None
    assert fit
    found = evidence.judged(guess)
    if found.loss > begin.loss:  # levels may end in another valley than those they came from
        again = evidence.judged(guess, reopened=True)
        found = min((found, again, begin), key=lambda one: one.loss)
        fit = replace(fit, guess=found.guess)
    return evidence.set_base(found), fit


def _squares(evidence: Evidence) -> float:
    """Sum of squares of the errors of a base."""
    return float(evidence.base_errors @ evidence.base_errors)


def widened(guess: Guess) -> Guess:
    """A guess in which effects that stand at a bound have three times as much room.

    A bound at zero is physical and stays. So do those of calibrated numbers: what a number takes beyond
    them may be an effect that is not tried yet.
    """
    parts = []
    for hypothesis, deviation in guess.parts:
        table, values = dict(hypothesis.parameters), hypothesis.values(deviation)
        for key, p in hypothesis.parameters.items():
            if hypothesis.name == CALIBRATION:
                continue
            if values[key] >= p.upper_bound:
                table[key] = replace(p, upper_bound=p.nominal + _ROOM * (p.upper_bound - p.nominal))
            elif values[key] <= p.lower_bound and p.lower_bound != 0.0:
                low = p.lower_bound / _ROOM if p.lower_bound > 0.0 else p.nominal - _ROOM * (p.nominal - p.lower_bound)
                table[key] = replace(p, lower_bound=low)
        if table != hypothesis.parameters:
            hypothesis = replace(hypothesis, parameters=table)
        parts.append((hypothesis, deviation))
    return Guess(tuple(parts))

"""Calibration within the search: all uncertain numbers together, and those that are effects.

Numbers that only free runs tell, calibrated before the search for effects.

A machine file that is an estimate says so: `uncertainty: {flow_table: 1.0, linkage: 0.15}`. What a
valve lets through at which command then weighs more than any effect of the library, and where no
pressure is read, one-step predictions hardly feel it. So these numbers are fitted to free runs
first, and an effect is what remains after that. The fit is kept only if it predicts stretches of
the fit runs better that are left out of it one by one.

A drive with a pump of its own is told by free runs, too, pressures or not: what its motor, its oil
and its friction do lasts longer than a reading, and where a pump stalls or a piston sticks, one-
step predictions say nothing. All numbers that its machine file calls uncertain are fitted then.

Fits whose noise levels follow: an effect's numbers and what a model lacks, found in turn.
"""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects.effect import with_value
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, invert_information, occam_penalty
from hydrotele.estimate.free_run import free_run_errors, machine_runner
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
from hydrotele.estimate.track import COARSE
from hydrotele.gap.result import Estimate
from hydrotele.gap.screening import Screened
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.dataset_reduction import downsample
from hydrotele.machine.machine import Machine

_NORMAL95 = 1.96
_WORSE = 1.05  # times the errors of free runs: less is no loss
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
        seconds: length of the free runs [s].
        guess: the fitted parameters, as changes of the given machine.
        covariance: (P, P) of their normalised deviations.
    """

    machine: Machine
    numbers: dict[str, Estimate]
    note: str
    seconds: float
    guess: Guess
    covariance: np.ndarray

    def undone_by(self, data: Dataset, machine: Machine, jobs: int) -> bool:
        """Whether another machine predicts free runs of the held-out run worse than this one.

        Worse is a larger median over the windows, in the geometric mean over the channels. What
        free runs have told must not be lost to one-step errors, which a drift may absorb.
        """

        def medians(some: Machine) -> np.ndarray:
            runner = machine_runner(some, data)(data.heldout)
            errors = free_run_errors(runner, data.heldout, (self.seconds,), to_end=False)
            return np.array([horizon.median for horizon in errors.horizons.values()])

        with ThreadPoolExecutor(jobs) as pool:
            own, other = pool.map(medians, (self.machine, machine))
        ratio = other / own
        return bool(np.any(ratio > 0.0) and not np.nanmean(np.log(ratio)) <= np.log(_WORSE))


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
    return FreeCalibration(_told(data.machine, fit), numbers, note, seconds, fit.guess, fit.covariance)


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


BEYOND = 15.0  # twice the log evidence that a number must bring to be an effect of its own
_RIGHT = 0.2  # of the stated uncertainty, by which numbers move that are right
_MOSTLY = 0.6  # of the stated uncertainty: so right are nearly all
_UNUSUAL = 3.0  # stated uncertainties: what moved by less may be a number that is calibrated
_INFORMED = 0.5  # of the stated uncertainty is left of a number that the runs tell
_SEVERAL = 8  # of them say what is usual
_ROUNDS = 2  # of levels and fit; `search.settle` does the rest
_FURTHER = (1.0, 1.5, 2.5, 4.0, 6.0)  # times where a number stopped at the end of its range
_SETTLED = 15.0  # fall of the loss that is worth another round


def calibration_of(guess: Guess) -> Hypothesis | None:
    """The calibration in a guess, or None."""
    return next((h for h, _ in guess.parts if h.name == CALIBRATION), None)


def free_of_calibration(candidates: Sequence[Hypothesis], guess: Guess) -> list[Hypothesis]:
    """Candidates that change no number that is calibrated already."""
    group = calibration_of(guess)
    if group is None:
        return list(candidates)
    return [
        c for c in candidates
        if not any(f"{c.name}.{c.location}.{key}" in group.parameters for key in c.parameters)
    ]  # fmt: skip


def calibrated(evidence: Evidence, now: Judged) -> tuple[Judged | None, float]:
    """All uncertain numbers fitted together, judged, and the score of that."""
    group = calibration(evidence.data.machine, frozenset(now.guess.names))
    if not group.parameters:
        return None, 0.0
    judged, gain, cost = now, 0.0, 0.0
    guess = now.guess.plus(group, np.zeros(group.size))
    for turn in range(_ROUNDS):
        step = evidence.step_of(guess, MIDDLE)
        coarse = evidence.step_of(guess, COARSE)
        if turn:
            slopes = evidence.base_slopes(evidence.slope_step)
        else:
            slopes = evidence.slopes(guess, evidence.errors(guess, coarse), step=coarse)
            evidence.keep_information(guess, slopes)
        fit = evidence.fit(guess, 0.0, step=step, kept=slopes, steps=3)
        before, judged = judged.loss, evidence.judged(fit.guess)
        guess, cost = fit.guess, occam_penalty(fit.information, group.size)
        gain = now.loss - judged.loss - cost
        if before - judged.loss < _SETTLED:
            break
        evidence.set_base(judged)
    evidence.set_base(now)
    return (judged, gain) if gain > 0.0 else (None, 0.0)


def _usual(deviation: np.ndarray, spread: np.ndarray) -> float:
    """By how much numbers deviate, in stated uncertainties, as those that the runs tell do.

    Never less than stated, but where nearly all of at least a few are right.

    >>> import numpy as np
    >>> _usual(np.full(20, 0.5), np.full(20, 0.1)), _usual(np.full(20, 2.0), np.full(20, 0.1)) > 2.9
    (1.0, True)
    >>> _usual(np.full(20, 0.05), np.full(20, 0.1)), _usual(np.full(20, 0.05), np.ones(20))
    (0.2, 1.0)
    """
    told = np.abs(deviation[spread < _INFORMED])
    usual = 1.4826 * float(np.median(told)) if len(told) >= _SEVERAL else 1.0
    between = (usual - _RIGHT) / _RIGHT  # the rule fades out, it does not flip
    return max(usual, float(np.clip(_RIGHT + (1.0 - _RIGHT) * between, _RIGHT, 1.0)))


def mostly_right(guess: Guess, fit: Fit) -> bool:
    """Whether a guess calibrates numbers of which nearly all that the runs tell are right."""
    first = 0
    for hypothesis, deviation in guess.parts:
        if hypothesis.name == CALIBRATION:
            spread = np.sqrt(np.diag(invert_information(fit.information)))
            return _usual(deviation, spread[first : first + hypothesis.size]) < _MOSTLY
        first += hypothesis.size
    return False


def promoted(evidence: Evidence, now: Judged, fit: Fit, candidates: Sequence[Hypothesis]) -> tuple[Guess, float] | None:
    """A guess in which the number that is moved furthest beyond the usual is an effect.

    What the others move by is what uncertain means (`_usual`). Where nearly all others are right,
    one that is not is an effect, stated uncertainty or not.

    Args:
        evidence: the runs.
        now: a guess, judged.
        fit: that led to it.
        candidates: the hypotheses.

    Returns:
        The guess, and twice the log evidence that this brings as far as it went; None if no number
        is, and none stands at an end of what it may take.
    """
    place = next((i for i, (h, _) in enumerate(now.guess.parts) if h.name == CALIBRATION), -1)
    if place < 0:
        return None
    group, deviation = now.guess.parts[place]
    table = numbers(evidence.data.machine)
    keys = list(group.parameters)
    first = sum(h.size for h, _ in now.guess.parts[:place])
    own = slice(first, first + group.size)
    usual = _usual(deviation, np.sqrt(np.diag(invert_information(fit.information)))[own])
    widths = np.ones(len(fit.information))
    widths[own] = usual
    told_by_runs = np.outer(widths, widths) * (fit.information - np.eye(len(widths)))
    covariance = invert_information(told_by_runs + np.eye(len(widths)))[own, own]
    ratios: dict[tuple[str, str], dict[int, float]] = {}
    for index, (key, d) in enumerate(zip(keys, deviation, strict=True)):
        effect = table[key].effect
        if effect is None:
            continue
        known = next((c for c in candidates if c.key == effect[:2]), None)
        if known is None or abs(d * table[key].parameter.prior_std) < known.parameters[effect[2]].min_relevant_change:
            continue
        ratio = usual * table[key].parameter.prior_std / known.parameters[effect[2]].prior_std
        ratios.setdefault(effect[:2], {})[index] = min(ratio, 1.0)
    moved = {
        effect: _gain_of_freedom(
            deviation[list(some)] / usual,
            covariance[np.ix_(list(some), list(some))],
            np.array(list(some.values())),
        )
        for effect, some in ratios.items()
    }
    ends = {e[:2] for key in _at_ends(group, deviation) if (e := table[key].effect)}
    told = {key: gain for key, gain in moved.items() if gain > BEYOND or key in ends}
    options = {key: let_out(evidence, now.guess, place, next(c for c in candidates if c.key == key)) for key in told}
    stuck = {key: _further(evidence, options[key]) for key in told if key in ends}
    if stuck and min(fall for _, fall in stuck.values()) < -BEYOND:
        key = min(stuck, key=lambda one: stuck[one][1])
        return stuck[key][0], told[key]
    key = max(told, key=told.__getitem__, default=None)
    return None if key is None or told[key] <= BEYOND else (options[key], told[key])


def _gain_of_freedom(deviation: np.ndarray, covariance: np.ndarray, ratio: np.ndarray) -> float:
    """Twice the log evidence that numbers bring with the wider prior of an effect.

    What one number may not do, others that have nearly the same consequences do in part: a lighter
    and shorter link for one whose moment of inertia is less. That counts, too: with its prior wide
    the number moves on until the others are back.

    Args:
        deviation: (k,) of the numbers, fitted with unit-normal priors.
        covariance: (k, k) of them after the fit.
        ratio: (k,) widths of these priors over those of the effect, at most 1.

    >>> import numpy as np
    >>> alone = _gain_of_freedom(np.array([4.0]), np.array([[0.01]]), np.array([0.25]))
    >>> shared = _gain_of_freedom(np.array([4.0]), np.array([[0.7]]), np.array([0.25]))
    >>> untold = _gain_of_freedom(np.array([0.0]), np.array([[1.0]]), np.array([0.25]))
    >>> round(alone, 1), round(shared, 1), abs(round(untold, 1))
    (12.4, 41.9, 0.0)
    """
    less = np.diag(1.0 - ratio**2)  # precision
    left = np.eye(len(ratio)) - less @ covariance
    gain = deviation @ np.linalg.solve(left, less @ deviation)
    return float(gain - np.linalg.slogdet(left)[1] + 2.0 * np.sum(np.log(ratio)))


def let_out(evidence: Evidence, guess: Guess, place: int, known: Hypothesis) -> Guess:
    """A guess whose calibration, at `place`, leaves the numbers of an effect to the effect."""
    group, deviation = guess.parts[place]
    table, keys = numbers(evidence.data.machine), list(group.parameters)
    start, gone = [], set()
    for key, p in known.parameters.items():
        full = f"{known.name}.{known.location}.{key}"
        start.append(0.0)
        if full in keys:
            gone.add(full)
            start[-1] = deviation[keys.index(full)] * table[full].parameter.prior_std / p.prior_std
    more = guess.plus(known, np.clip(start, known.low, known.high))
    return uncalibrated(more, evidence.data.machine, gone)


def _further(evidence: Evidence, guess: Guess) -> tuple[Guess, float]:
    """The last effect of a guess at the best of some multiples of its numbers; fall of the loss."""
    known, start = guess.parts[-1]
    step = evidence.step_of(guess, COARSE)
    options = [
        Guess((*guess.parts[:-1], (known, np.clip(factor * start, known.low, known.high)))) for factor in _FURTHER
    ]
    errors = evidence.map(lambda option: evidence.errors(option, step), options)
    losses = [float(e @ e) for e in errors]
    best = int(np.argmin(losses))
    return options[best], losses[best] - losses[0]


def ended(guess: Guess) -> bool:
    """Whether a calibrated number stands at an end of what it may take."""
    return any(_at_ends(h, d) for h, d in guess.parts if h.name == CALIBRATION)


def _at_ends(group: Hypothesis, deviation: np.ndarray) -> list[str]:
    values = group.values(deviation)
    return [
        key for key, p in group.parameters.items()
        if values[key] >= p.upper_bound or (values[key] <= p.lower_bound and p.lower_bound != 0.0)
    ]  # fmt: skip


def uncalibrated(guess: Guess, machine: Machine, keys: Collection[str]) -> Guess:
    """A guess whose calibration leaves some numbers as the given machine has them."""
    parts = list(guess.parts)
    for index, (hypothesis, deviation) in enumerate(parts):
        if hypothesis.name == CALIBRATION:
            left = [key for key in hypothesis.parameters if key not in keys]
            kept = [d for k, d in zip(hypothesis.parameters, deviation, strict=True) if k in left]
            group = calibration(machine, frozenset(numbers(machine)) - frozenset(left))
            bounds = {key: hypothesis.parameters[key] for key in left}  # perhaps widened
            parts[index] = (replace(group, parameters=bounds), np.array(kept))
    return Guess(tuple(parts))


def taken_back(guess: Guess, machine: Machine, index: int) -> Guess | None:
    """A guess whose calibration has the numbers of one of its effects; see `let_out`.

    Args:
        guess: effects beside a calibration.
        machine: the given one.
        index: of the effect.

    Returns:
        The guess without the effect; None where not all of the effect's numbers are uncertain ones
        that moved by less than `_UNUSUAL` of their stated uncertainties.
    """
    known, deviation = guess.parts[index]
    group = calibration_of(guess)
    table, moved = numbers(machine), {}
    for (key, p), d in zip(known.parameters.items(), deviation, strict=True):
        full = f"{known.name}.{known.location}.{key}"
        if group is None or full in group.parameters or full not in table:
            return None
        moved[full] = d * p.prior_std / table[full].parameter.prior_std
        if abs(moved[full]) > _UNUSUAL:
            return None
    parts = []
    for hypothesis, own in guess.without(index).parts:
        if hypothesis.name == CALIBRATION:
            moved |= dict(zip(hypothesis.parameters, own, strict=True))
            other = calibration(machine, frozenset(table) - moved.keys())
            bounds = other.parameters | hypothesis.parameters  # perhaps widened
            hypothesis = replace(other, parameters={key: bounds[key] for key in other.parameters})
            own = np.array([moved[key] for key in other.parameters])
        parts.append((hypothesis, own))
    return Guess(tuple(parts))


def given_again(guess: Guess, axes: Collection[str]) -> Guess:
    """A guess whose calibration has the numbers of some axes as the machine file states them."""
    parts = [
        (h, np.where([_place_of(key) in axes for key in h.parameters], 0.0, d))
        if h.name == CALIBRATION else (h, d)
        for h, d in guess.parts
    ]  # fmt: skip
    return Guess(tuple(parts))


def _place_of(key: str) -> str:
    """Axis or link of a calibrated number.

    >>> _place_of("mass.boom.rod"), _place_of("bulk_modulus.all")
    ('boom', 'all')
    """
    return key.split(".")[1]


FIT_STEPS = 3  # of Gauss-Newton for a candidate
_SETTLES = 6  # rounds of levels and fit: what inputs took at first is given back bit by bit
_UNMOVED = 0.3  # standard deviations by which a number may still move
_IDLE = 3.0  # fall of the loss that is not worth another round of a calibration
_STALE = 200.0  # fall of the loss after which the slopes of a calibration are taken anew
_WORSE_SETTLING = 100.0  # rise of the loss with levels found anew after which a step is taken back
_ROOM = 3.0  # times the room to a bound that an effect gets that stands there


def fitted(evidence: Evidence, now: Judged, pool: Sequence[Screened]) -> list[Fit]:
    """Each of some candidates fitted beside a guess, which is the base; the best score first."""
    evidence.base_slopes(evidence.slope_step)

    def fit(candidate: Screened) -> Fit:
        more = now.guess.plus(candidate.hypothesis, candidate.start)
        step = evidence.step_of(more, MIDDLE)
        kept = evidence.base_slopes(evidence.slope_step, parallel=False)
        before = loss_of(evidence, now.guess, step)

        def climb(start: Guess) -> Fit:
            return evidence.fit(start, before, parallel=False, step=step, kept=kept, steps=FIT_STEPS)

        found = climb(more)
        wider = widened(found.guess)
        if found.score > 0.0 and wider.parts[-1][0] != found.guess.parts[-1][0]:
            found = climb(wider)  # else what is larger than usual is taken for something else
        return found

    return sorted(evidence.map(fit, pool), key=lambda found: -found.score)


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


def polished(evidence: Evidence, judged: Judged) -> tuple[Judged, Fit]:
    """All numbers of a calibration once more, by slopes of their own.

    Rounds that gain little end a search, but may leave numbers that only their priors tell, as a
    scale of all areas and flows, some standard deviations away.
    """
    evidence.set_base(judged)
    slopes = evidence.base_slopes(evidence.slope_step)
    fit = evidence.fit(judged.guess, 0.0, kept=slopes, step=MIDDLE)
    return evidence.set_base(evidence.judged(fit.guess, same=True)), fit


def widened(guess: Guess, calibration: bool = False) -> Guess:
    """A guess in which effects that stand at a bound have three times as much room.

    A bound at zero is physical and stays. So do those of calibrated numbers unless asked for: what
    a number takes beyond them may be an effect that is not tried yet.
    """
    parts = []
    for hypothesis, deviation in guess.parts:
        table, values = dict(hypothesis.parameters), hypothesis.values(deviation)
        for key, p in hypothesis.parameters.items():
            if (hypothesis.name == CALIBRATION) != calibration:
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


def strained(guess: Guess, index: int) -> bool:
    """Whether a part stands at the edge of what is physically plausible."""
    h, d = guess.parts[index]
    if h.name == CALIBRATION:
        return False
    return bool(np.any(((d <= h.low) | (d >= h.high)) & (np.abs(d) > h.least)))


def loss_of(evidence: Evidence, guess: Guess, step: float) -> float:
    """Loss of a guess with the base's gains: its errors' squares, and the prior's part."""
    errors = evidence.errors(guess, step)
    return float(errors @ errors) + guess.prior

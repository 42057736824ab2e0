"""Calibration within the search: all uncertain numbers together, and those that are effects."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from hydrotele.estimate.calibration import CALIBRATION, calibration, numbers
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, charge
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.track import COARSE
from hydrotele.machine.machine import Machine

BEYOND = 15.0  # twice the log evidence that a number must bring to be an effect of its own
_RIGHT = 0.2  # of the stated uncertainty, by which numbers move that are right
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
            slopes = evidence.base_slopes(coarse)
        else:
            slopes = evidence.slopes(guess, evidence.errors(guess, coarse), step=coarse)
        fit = evidence.fit(guess, 0.0, step=step, kept=slopes, steps=3)
        before, judged = judged.loss, evidence.judged(fit.guess)
        guess, cost = fit.guess, charge(fit.information, group.size)
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
            spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
            return _usual(deviation, spread[first : first + hypothesis.size]) < 1.0
        first += hypothesis.size
    return False


def promoted(
    evidence: Evidence, now: Judged, fit: Fit, candidates: Sequence[Hypothesis]
) -> tuple[Guess, float] | None:
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
    spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))[first : first + group.size]
    usual = _usual(deviation, spread)
    moved: dict[tuple[str, str], float] = {}
    for key, d in zip(keys, deviation, strict=True):
        effect = table[key].effect
        if effect is None:
            continue
        known = next((c for c in candidates if c.key == effect[:2]), None)
        if known is None or abs(d * table[key].parameter.scale) < known.parameters[effect[2]].least:
            continue
        ratio = usual * table[key].parameter.scale / known.parameters[effect[2]].scale
        gain = (d / usual) ** 2 * (1.0 - min(ratio, 1.0) ** 2) + 2.0 * np.log(min(ratio, 1.0))
        moved[effect[:2]] = moved.get(effect[:2], 0.0) + gain
    ends = {e[:2] for key in _at_ends(group, deviation) if (e := table[key].effect)}
    told = {key: gain for key, gain in moved.items() if gain > BEYOND or key in ends}
    options = {
        key: _let_out(evidence, now.guess, place, next(c for c in candidates if c.key == key))
        for key in told
    }
    stuck = {key: _further(evidence, options[key]) for key in told if key in ends}
    if stuck and min(fall for _, fall in stuck.values()) < -BEYOND:
        key = min(stuck, key=lambda one: stuck[one][1])
        return stuck[key][0], told[key]
    key = max(told, key=told.__getitem__, default=None)
    return None if key is None or told[key] <= BEYOND else (options[key], told[key])


def _let_out(evidence: Evidence, guess: Guess, place: int, known: Hypothesis) -> Guess:
    """A guess whose calibration, at `place`, leaves the numbers of an effect to the effect."""
    group, deviation = guess.parts[place]
    table, keys = numbers(evidence.data.machine), list(group.parameters)
    start, gone = [], set()
    for key, p in known.parameters.items():
        full = f"{known.name}.{known.location}.{key}"
        start.append(0.0)
        if full in keys:
            gone.add(full)
            start[-1] = deviation[keys.index(full)] * table[full].parameter.scale / p.scale
    let_out = guess.plus(known, np.clip(start, known.low, known.high))
    return uncalibrated(let_out, evidence.data.machine, gone)


def _further(evidence: Evidence, guess: Guess) -> tuple[Guess, float]:
    """The last effect of a guess at the best of some multiples of its numbers; fall of the loss."""
    known, start = guess.parts[-1]
    step = evidence.step_of(guess, COARSE)
    options = [
        Guess((*guess.parts[:-1], (known, np.clip(factor * start, known.low, known.high))))
        for factor in _FURTHER
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
        if values[key] >= p.high or (values[key] <= p.low and p.low != 0.0)
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

"""Fits whose noise levels follow: an effect's numbers and what a model lacks, found in turn."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged
from hydrotele.estimate.hypothesis import Guess
from hydrotele.gap.calibrating import calibration_of
from hydrotele.gap.screening import Screened

_STEPS = 3  # of Gauss-Newton for a candidate
_SETTLES = 6  # rounds of levels and fit: what inputs took at first is given back bit by bit
_UNMOVED = 0.3  # standard deviations by which a number may still move
_IDLE = 3.0  # fall of the loss that is not worth another round of a calibration
_STALE = 200.0  # fall of the loss after which the slopes of a calibration are taken anew
_WORSE = 100.0  # rise of the loss with levels found anew after which a step is taken back
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
            return evidence.fit(start, before, parallel=False, step=step, kept=kept, steps=_STEPS)

        found = climb(more)
        wider = widened(found.guess)
        if found.score > 0.0 and wider.parts[-1][0] != found.guess.parts[-1][0]:
            found = climb(wider)  # else what is larger than usual is taken for something else
        return found

    return sorted(evidence.map(fit, pool), key=lambda found: -found.score)


def settle(
    evidence: Evidence, judged: Judged, wanted: float = np.inf
) -> tuple[Judged, Fit]:  # fmt: skip
    """Fit with levels and gains computed anew until they no longer matter.

    Args:
        evidence: the runs; the guess becomes the base.
        judged: the guess to begin with.
        wanted: a loss; what would not come down to it at the present pace is left as it is.

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
        moved = fit.guess.deviation - judged.guess.deviation
        spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        guess = widened(fit.guess)
        if np.all(np.abs(moved) < _UNMOVED * spread):
            break
        before, judged = judged, evidence.judged(guess, same=True)
        fall = before.loss - judged.loss
        if not fall > -_WORSE:  # a likelihood full of dents, as that of teeth, misleads its slopes
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
            if values[key] >= p.high:
                table[key] = replace(p, high=p.nominal + _ROOM * (p.high - p.nominal))
            elif values[key] <= p.low and p.low != 0.0:
                low = p.low / _ROOM if p.low > 0.0 else p.nominal - _ROOM * (p.nominal - p.low)
                table[key] = replace(p, low=low)
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
    return float(errors @ errors + guess.deviation @ guess.deviation)

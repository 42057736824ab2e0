"""What of a guess is needed: each effect against the guess without it."""

from collections.abc import Sequence

import numpy as np

from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, charge
from hydrotele.estimate.hypothesis import Guess
from hydrotele.gap.rivals import Rival
from hydrotele.gap.settling import settle

ENTER = 15.0  # twice the log evidence an effect must bring; 100 clean machines stay below 14.7
TOLD = 9.0  # square of an effect's deviation over its uncertainty: three standard deviations
_BEYOND_DOUBT = 300.0  # score of an effect that is named however small: an integrator of first
# order at 1 ms alone looks like a delay of 0.5 ms with a score of 267


def worth_naming(guess: Guess, index: int, score: float) -> bool:
    """Whether an effect is as large as its least size in any parameter, or beyond doubt."""
    hypothesis, deviation = guess.parts[index]
    return score >= _BEYOND_DOUBT or bool(np.any(np.abs(deviation) >= hypothesis.least))


def told(guess: Guess, fit: Fit, index: int) -> bool:
    """Whether an effect's numbers differ from the model's by more than they are uncertain.

    Where a likelihood is full of dents, as with teeth, it may fall by chance with a number moved.
    """
    hypothesis, deviation = guess.parts[index]
    first = sum(h.size for h in guess.hypotheses[:index])
    own = slice(first, first + hypothesis.size)
    covariance = np.linalg.inv(fit.information)[own, own]
    return float(deviation @ np.linalg.solve(covariance, deviation)) > TOLD


def idle(rival: Rival) -> bool:
    """Whether a rival does nothing: what is there without it was settled."""
    guess = rival.judged.guess
    return rival.fit is not None and not told(guess, rival.fit, len(guess.parts) - 1)


def without_needless(
    now: Judged, charges: Sequence[float], rivals: Sequence[Sequence[Rival]]
) -> Guess | None:
    """The guess without an effect of which a rival that does nothing can take the place."""
    for cost, others in zip(charges, rivals, strict=True):
        for rival in others:
            if idle(rival) and rival.judged.loss - now.loss - cost < ENTER:
                return rival.judged.guess.without(len(rival.judged.guess.parts) - 1)
    return None


def pruned(
    evidence: Evidence, base: Judged, now: Judged, fit: Fit | None
) -> tuple[Judged, Fit | None, tuple[Judged | None, ...]]:
    """Take out effects that the others have made needless; each effect's rest, judged."""
    while True:
        rests, scores = _rests(evidence, base, now, fit)
        if len(scores) < 2 or min(scores) >= ENTER:
            return now, fit, tuple(rests)
        worst = rests[int(np.argmin(scores))]
        assert worst
        now, fit = settle(evidence, worst)


def _rests(
    evidence: Evidence, base: Judged, now: Judged, fit: Fit | None
) -> tuple[list[Judged | None], list[float]]:
    """For each part the guess without it, fitted and judged (None for calibration); scores."""
    rests: list[Judged | None] = []
    scores: list[float] = []
    slopes = evidence.base_slopes(evidence.slope_step) if now.guess.parts else np.zeros((0, 0))
    sizes = np.cumsum([0, *(h.size for h, _ in now.guess.parts)])
    for index, (hypothesis, _) in enumerate(now.guess.parts):
        assert fit
        if hypothesis.name == CALIBRATION:
            rests.append(None)
            scores.append(np.inf)
            continue
        smaller = now.guess.without(index)
        kept = np.delete(slopes, np.s_[sizes[index] : sizes[index + 1]], axis=1)
        if smaller.parts:
            smaller = evidence.fit(smaller, 0.0, kept=kept, steps=2, step=MIDDLE).guess
        rest = evidence.judged(smaller, reopened=True) if smaller.parts else base
        cost = charge(moved_last(fit.information, now.guess, index), hypothesis.size)
        score = rest.loss - now.loss - cost
        if not (worth_naming(now.guess, index, score) and told(now.guess, fit, index)):
            score = min(score, 0.0)
        rests.append(rest)
        scores.append(score)
    return rests, scores


def moved_last(information: np.ndarray, guess: Guess, index: int) -> np.ndarray:
    """Information with the parameters of one effect moved to the end."""
    sizes = [h.size for h, _ in guess.parts]
    first = sum(sizes[:index])
    own = list(range(first, first + sizes[index]))
    order = [i for i in range(len(information)) if i not in own] + own
    return information[np.ix_(order, order)]

"""What else could stand in the place of an effect, and how likely each of them is.

What of a guess is needed: each effect against the guess without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, invert_information, occam_penalty
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.estimate.levels import undisturbed_loss
from hydrotele.gap.calibrating import (
    fit_until_settled,
    fitted,
    free_of_calibration,
    loss_of,
    strained,
)
from hydrotele.gap.residuals import believed_part
from hydrotele.gap.screening import Screened

_PLAINER = 0.2  # of an effect's probability from which a rival with fewer numbers takes its place
_SECOND = 2  # rivals that are settled like the effect itself
_RIVALS = 3  # candidates that are judged in the place of a named effect
_HOPELESS = 500.0  # loss above the effect's beyond which a rival is let go; or this share of what
_FAR = 0.3  # the effect brings
_HOPEFUL = 0.2  # of what the effect takes at the levels of the guess without it: a rival takes more
_BEHIND = 100.0  # loss above the effect's, of a rival that is not worth another round
_SAME = 0.1  # squares of whitened errors by which two guesses differ that say the same
_DRAWS = 4000  # of the Bayesian bootstrap


@dataclass(frozen=True)
class Rival:
    """Another effect in the place of a named one.

    Attributes:
        hypothesis: the effect.
        judged: the guess with it, judged.
        occam_penalty: what its parameters cost.
        fit: its last fit; None where it was not settled, for it is far behind.
    """

    hypothesis: Hypothesis
    judged: Judged
    occam_penalty: float
    fit: Fit | None = None


def weights(blocks: Sequence[np.ndarray], charges: Sequence[float], seed: int = 0) -> np.ndarray:
    """(K,) probabilities of K guesses from the blocks of their runs.

    Stretches of the runs are drawn anew with weights of their own (Bayesian bootstrap), so that a
    guess that is better in a few places only is not preferred for sure (pseudo-BMA+ of Yao et al.
    2018, Bayesian Analysis 13(3), section 3.4, with the likelihood of one-step predictions).

    Args:
        blocks: K arrays (B,) of -2 log likelihood.
        charges: what each guess's parameters cost, in the same unit.
        seed: of the draws.

    Returns:
        Probabilities that sum to 1.
    """
    table = np.stack(list(blocks))
    count = table.shape[1]
    draws = count * np.random.default_rng(seed).dirichlet(np.ones(count), _DRAWS)
    totals = draws @ (table - table.min(axis=0)).T + np.asarray(charges)
    effect_probabilities = np.exp(-0.5 * (totals - totals.min(axis=1, keepdims=True)))
    return (effect_probabilities / effect_probabilities.sum(axis=1, keepdims=True)).mean(axis=0)


def effect_probabilities(now: Judged, cost: float, rest: Judged, rivals: Sequence[Rival]) -> np.ndarray:
    """(2 + R,) probabilities of an effect, of none, and of its rivals.

    Args:
        now: with the effect.
        cost: what its parameters are charged.
        rest: without it.
        rivals: R others in its place.
    """
    return weights(
        [now.blocks(), rest.blocks(), *(r.judged.blocks() for r in rivals)],
        [cost, 0.0, *(r.occam_penalty for r in rivals)],
    )


def is_case_of(evidence: Evidence, guess: Guess, index: int, other: Hypothesis) -> bool:
    """Whether an effect with one number is a case of another, all of whose numbers are then equal.

    A dead band is a case of dead bands by direction: the other says the same, and is no rival.

    Args:
        evidence: with the guess as its base.
        guess: all effects.
        index: of the effect.
        other: the other one.
    """
    hypothesis, deviation = guess.parts[index]
    if hypothesis.size != 1 or other.size < 2 or other.location != hypothesis.location:
        return False
    (own,), (value,) = hypothesis.parameters.values(), hypothesis.values(deviation).values()
    numbers = other.parameters.values()
    if any(p.unit != own.unit or not p.lower_bound <= value <= p.upper_bound for p in numbers):
        return False
    equal = np.array([(value - p.nominal) / p.prior_std for p in numbers])
    instead = Guess(tuple((other, equal) if i == index else p for i, p in enumerate(guess.parts)))
    first = evidence.tracks[:1]
    change = evidence.errors(instead, MIDDLE, first) - evidence.errors(guess, MIDDLE, first)
    return float(change @ change) < _SAME


_HALF = 0.5  # of what more numbers cost, that they must take of the loss at the effect's levels


def brings_no_more(evidence: Evidence, now: Judged, index: int, other: Hypothesis) -> bool:
    """Whether an effect is a case of another whose further numbers bring nothing.

    Where the effect was settled the other begins with all its numbers equal, and needs no search of
    its own from the guess without the effect.

    Args:
        evidence: with the guess as its base.
        now: all effects.
        index: of the effect.
        other: the other one.
    """
    if not is_case_of(evidence, now.guess, index, other):
        return False
    hypothesis, deviation = now.guess.parts[index]
    (value,) = hypothesis.values(deviation).values()
    start = np.array([(value - p.nominal) / p.prior_std for p in other.parameters.values()])
    first = sum(h.size for h in now.guess.hypotheses[:index])
    kept = np.delete(evidence.base_slopes(evidence.slope_step), first, axis=1)
    instead = now.guess.without(index).plus(other, start)
    step = evidence.step_of(instead, MIDDLE)
    fit = evidence.fit(instead, loss_of(evidence, now.guess, step), kept=kept, steps=2, step=step)
    own = evidence.base_slopes(evidence.slope_step)[:, first]
    left = own - kept @ np.linalg.solve(kept.T @ kept + np.eye(kept.shape[1]), kept.T @ own)
    more = fit.occam_penalty - float(np.log1p(own @ left))
    return fit.gain < _HALF * more


def plain_form(hypothesis: Hypothesis, candidates: Sequence[Hypothesis]) -> Hypothesis | None:
    """The same mechanism at the same place with one number instead of several of its unit."""
    known = EFFECTS.get(hypothesis.name)
    if known is None or not known.mechanism or hypothesis.size < 2:
        return None
    units = {p.unit for p in hypothesis.parameters.values()}
    for other in candidates:
        same = other.name in EFFECTS and EFFECTS[other.name].mechanism == known.mechanism
        if same and other.location == hypothesis.location and other.size == 1:
            return other if units == {p.unit for p in other.parameters.values()} else None
    return None


def better(now: Judged, index: int, cost: float, rest: Judged, rivals: Sequence[Rival]) -> Rival | None:
    """The rival that should take an effect's place: likelier, or nearly as likely and plainer.

    By the same measure an effect keeps its place beside one with more numbers.
    """
    size = now.guess.parts[index][0].size
    table = effect_probabilities(now, cost, rest, rivals)

    def needed(rival: Rival) -> float:
        more = rival.hypothesis.size - size
        return table[0] * (1.0 if more == 0 else _PLAINER if more < 0 else 1.0 / _PLAINER)

    found = [
        (chance, rival) for chance, rival in zip(table[2:], rivals, strict=True)
        if rival.fit and chance > needed(rival)
    ]  # fmt: skip
    return max(found, key=lambda pair: pair[0])[1] if found else None


def find_rivals(
    evidence: Evidence, now: Judged, index: int, ranking: Sequence[Screened], rest: Judged
) -> tuple[Rival, ...]:
    """What else could stand in the place of an effect, fitted and judged.

    Args:
        evidence: with the guess as base.
        now: all effects.
        index: the one to replace.
        ranking: the screening in which the effect was found.
        rest: the guess without it.

    Returns:
        Rivals, the most likely first.
    """
    taken = {h.key for h, _ in now.guess.parts}
    free = {c.key for c in free_of_calibration([s.hypothesis for s in ranking], now.guess)}
    pool = [s for s in ranking if s.hypothesis.key not in taken and s.score > 0.0
            and s.hypothesis.key in free][: 2 * _RIVALS]  # fmt: skip
    pool = [s for s in pool if not brings_no_more(evidence, now, index, s.hypothesis)]
    if not pool:
        return ()
    evidence.set_base(rest)
    fits = fitted(evidence, rest, pool)
    own = loss_of(evidence, rest.guess, MIDDLE) - loss_of(evidence, now.guess, MIDDLE)
    plausible = [
        f for f in fits
        if f.score > 0.0 and f.gain > _HOPEFUL * own and not strained(f.guess, -1)
    ][:_RIVALS]  # fmt: skip
    looked = [(evidence.judged(fit.guess), fit.occam_penalty) for fit in plausible]
    looked = sorted((pair for pair in looked if np.isfinite(pair[0].loss)), key=lambda p: p[0].loss)
    found = []
    hopeless = now.loss + max(_HOPELESS, _FAR * (rest.loss - now.loss))
    for place, (judged, cost) in enumerate(looked):
        fit = None
        if place < _SECOND and judged.loss < hopeless:
            judged, fit = fit_until_settled(evidence, judged, now.loss + _BEHIND)
            cost = occam_penalty(fit.information, judged.guess.parts[-1][0].size)
        found.append(Rival(judged.guess.parts[-1][0], judged, cost, fit))
    evidence.set_base(now)
    return tuple(sorted(found, key=lambda r: r.judged.loss + r.occam_penalty))


ENTER = 15.0  # twice the log evidence an effect must bring; 100 clean machines stay below 14.7
TOLD = 9.0  # square of an effect's deviation over its uncertainty: three standard deviations
_UNBELIEVABLE = 0.05  # probability up to which an effect is not looked at further: a part of 14 %
_BEYOND_DOUBT = 300.0  # score of an effect that is named however small: an integrator of first
# order at 1 ms alone looks like a delay of 0.5 ms with a score of 267


def worth_naming(guess: Guess, index: int, score: float) -> bool:
    """Whether an effect is as large as its least size in any parameter, or beyond doubt.

    Optional numbers only shape an effect: with all others below their least sizes it is another's
    form that it makes up for, such as a gap too small to be one that softens a spring.
    """
    hypothesis, deviation = guess.parts[index]
    own = np.array([not p.optional for p in hypothesis.parameters.values()])
    if not own.all() and not np.any(np.abs(deviation[own]) >= hypothesis.least[own]):
        return False
    return score >= _BEYOND_DOUBT or bool(np.any(np.abs(deviation) >= hypothesis.least))


def part_taken(rest: Judged, judged: Judged, saved: float = 0.0) -> float:
    """Share of what a guess lacks that one with more takes of it.

    Args:
        rest: the guess.
        judged: the one with more.
        saved: what the guess costs beside its loss, and the other one does not.

    Returns:
        1 where nothing is lacking any more, see `undisturbed_loss`.
    """
    ideal = min(sum(map(undisturbed_loss, judged.tracks)), judged.loss)
    whole = rest.loss + saved
    return (whole - judged.loss) / max(whole - ideal, 1.0)


def telling(now: Judged, after: Judged, saved: float = 0.0) -> bool:
    """Whether a guess takes so much of what another one lacks that what it adds may be believed.

    What takes less is left to calibration and to laws. Effects are added largest first, so that a
    small one is weighed against what the others have left. Arguments as of `part_taken`.
    """
    return believed_part(part_taken(now, after, saved)) > _UNBELIEVABLE


def differs_significantly(guess: Guess, fit: Fit, index: int) -> bool:
    """Whether an effect's numbers differ from the model's by more than they are uncertain.

    Where a likelihood is full of dents, as with teeth, it may fall by chance with a number moved.
    """
    hypothesis, deviation = guess.parts[index]
    first = sum(h.size for h in guess.hypotheses[:index])
    own = slice(first, first + hypothesis.size)
    covariance = invert_information(fit.information)[own, own]
    return float(deviation @ np.linalg.solve(covariance, deviation)) > TOLD


def idle(rival: Rival) -> bool:
    """Whether a rival does nothing: what is there without it was settled."""
    guess = rival.judged.guess
    return rival.fit is not None and not differs_significantly(guess, rival.fit, len(guess.parts) - 1)


def without_needless(now: Judged, charges: Sequence[float], rivals: Sequence[Sequence[Rival]]) -> Guess | None:
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
        rests, scores = rests_of(evidence, base, now, fit)
        if len(scores) < 2 or min(scores) >= ENTER:
            return now, fit, tuple(rests)
        worst = rests[int(np.argmin(scores))]
        assert worst
        now, fit = fit_until_settled(evidence, worst)


def rests_of(evidence: Evidence, base: Judged, now: Judged, fit: Fit | None) -> tuple[list[Judged | None], list[float]]:
    """What a guess is without each of its parts.

    Args:
        evidence: with the guess as base.
        base: without any part.
        now: all parts.
        fit: of these.

    Returns:
        For each part the guess without it, fitted and judged (None for calibration); its score.
    """
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
        cost = occam_penalty(moved_last(fit.information, now.guess, index), hypothesis.size)
        score = rest.loss - now.loss - cost
        if not (worth_naming(now.guess, index, score) and differs_significantly(now.guess, fit, index)):
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

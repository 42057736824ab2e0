"""From the errors of the given model to named effects: screen, fit, add, prune, compare rivals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.gap.screening import Screened, screen
from hydrotele.prediction.evidence import Evidence, Fit, charge
from hydrotele.prediction.hypothesis import Guess, Hypothesis
from hydrotele.prediction.track import COARSE

ENTER = 15.0  # twice the log evidence an effect must bring; 100 clean machines stay below 14.7
MOST = 3  # effects that one search names
_ODDS = 6.0  # score by which a candidate too small to name must lead another, 20 to 1
_BEYOND_DOUBT = 300.0  # score of an effect that is named however small: an integrator of first
# order at 1 ms alone looks like a delay of 0.5 ms with a score of 267
_MIDDLE = 2.0e-3  # s, step for the fits that choose between candidates
_REFUSED = 4  # effects that may turn out to be none once gains are computed anew
_SHORT = 5  # candidates that are fitted after a screening
_RIVALS = 6  # candidates that are compared with a named effect
_HOPELESS = 500.0  # loss above the effect's after two steps, beyond which a rival is let go
_LARGE = 0.05  # mean excess per reading from which an explanation must explain its share
_SHARE = 0.1  # of the excess
_WORTH = 0.25  # of the best screened score: below it a candidate is not fitted
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Found:
    """What a search leaves.

    Attributes:
        guess: the effects.
        fit: its last fit, or None without effects.
        ranking: the first screening, best first.
        rivals: for each effect, fits in which another hypothesis takes its place, best first; the
            score counts against the guess without either.
        scores: score of each effect, counted likewise.
        weak: a candidate that was clear but smaller than worth naming, or None.
    """

    guess: Guess
    fit: Fit | None
    ranking: tuple[Screened, ...]
    rivals: tuple[tuple[Fit, ...], ...]
    scores: tuple[float, ...]
    weak: Fit | None


def search(
    evidence: Evidence, candidates: Sequence[Hypothesis], progress: Progress | None = None,
    most: int = MOST,
) -> Found:  # fmt: skip
    """Add effects as long as one brings enough, then prune, then compare rivals.

    Args:
        evidence: on the fit runs.
        candidates: the hypotheses.
        progress: called with (what is done, share done).
        most: how many effects to name at most.

    Returns:
        What was found.
    """
    tell = progress or (lambda text, share: None)
    guess, fit, weak = Guess(), None, None
    tell("filter the runs with the given model", 0.0)
    evidence.set_base(guess)
    rankings: list[list[Screened]] = []
    seen: dict[tuple[str, str], list[Screened]] = {}
    for _ in range(most + _REFUSED):
        depth = len(guess.parts)
        if depth == most:
            break
        tell(f"try every effect ({depth} named so far)", 0.9 * (1.0 - 0.6**depth) + 0.05)
        ranked = screen(evidence, guess, candidates)
        rankings.append(ranked)
        best = best_addition(evidence, guess, ranked)
        if best is None or best.score < ENTER or _beside_the_point(evidence, best):
            break
        if not worth_naming(best.guess, -1, best.score):
            weak = best
            break
        tell(f"fit {best.guess.parts[-1][0].name}", 0.9 * (1.0 - 0.6 ** (depth + 0.7)) + 0.05)
        added = best.guess.parts[-1][0]
        grown, settled, gain = _settled_gain(evidence, guess, best.guess)
        if gain < best.charge + ENTER:
            evidence.set_base(guess)
            candidates = [c for c in candidates if c.key != added.key]
            continue
        seen[added.key] = ranked
        guess, fit = grown, settled
    guess, fit = _prune(evidence, guess, fit)
    tell("compare rivals", 0.92)
    rivals, scores = [], []
    for index in range(len(guess.parts)):
        ranked = seen.get(guess.parts[index][0].key, rankings[0])
        guess, fit, own, others = _weighed(evidence, guess, fit, index, ranked)
        scores.append(own.score)
        rivals.append(others)
    return Found(guess, fit, tuple(rankings[0]), tuple(rivals), tuple(scores), weak)


def _weighed(
    evidence: Evidence, guess: Guess, fit: Fit | None, index: int, ranked: Sequence[Screened]
) -> tuple[Guess, Fit | None, Fit, tuple[Fit, ...]]:
    """A guess in which an effect has given way to a better rival, if there is one.

    Args:
        evidence: with the guess as base.
        guess: all effects.
        fit: of it.
        index: of the effect.
        ranked: the screening in which it was found.

    Returns:
        The guess, its fit, and the fits of the effect and of its rivals as of `compare`; a rival
        that settles for less than it seemed counts by that.
    """
    own, others = compare(evidence, guess, index, ranked)
    for _ in range(2 * _RIVALS):
        if not others or others[0].score <= own.score:
            break
        best = others[0]
        if not worth_naming(best.guess, -1, best.score):
            break
        other, asked = _exchanged(guess, index, best.guess), best.charge - own.charge
        grown, settled, gain = _settled_gain(evidence, guess, other)
        if gain >= asked:
            beaten = guess.parts[index][0].key
            guess, fit = grown, settled
            own, others = compare(evidence, guess, index, ranked)
            fair = [replace(one, gain=own.gain - gain) if one.guess.parts[-1][0].key == beaten
                    else one for one in others]  # fmt: skip
        else:
            evidence.set_base(guess)
            fair = [*others[1:], replace(best, gain=own.gain + gain)]
        others = tuple(sorted(fair, key=lambda one: -one.score))
    return guess, fit, own, others


def _settled_gain(evidence: Evidence, guess: Guess, other: Guess) -> tuple[Guess, Fit, float]:
    """Another guess settled, its fit, and by how much it is more likely; it is the base then.

    Kept gains can flatter a guess that moves far, so likelihoods with gains of their own decide.
    """
    before = evidence.base_loss + _prior(guess)
    grown, fit = settle(evidence, other)
    gain = before - evidence.base_loss - _prior(grown)
    return grown, fit, -np.inf if _strained(grown) else gain


def _prior(guess: Guess) -> float:
    return float(guess.deviation @ guess.deviation)


def _exchanged(guess: Guess, index: int, other: Guess) -> Guess:
    """A guess with the last part of another in one place, and the other's numbers."""
    rest, last = list(other.parts[:-1]), other.parts[-1]
    return Guess((*rest[:index], last, *rest[index:]))


def _beside_the_point(evidence: Evidence, best: Fit) -> bool:
    """Whether even the best effect leaves nearly all of a large excess of errors unexplained."""
    errors = evidence.base_errors
    excess = float(errors @ errors) - np.count_nonzero(errors)
    return bool(excess > _LARGE * len(errors) and best.gain < _SHARE * excess)


def best_addition(
    evidence: Evidence, guess: Guess, ranked: list[Screened], bar: float | None = None
) -> Fit | None:
    """The best of the first few candidates, fitted.

    Args:
        evidence: with the guess as its base.
        guess: what is already there.
        ranked: a screening, best first.
        bar: screened score below which a candidate is not fitted; by default what might still enter
            and comes near the best.

    Returns:
        The best fit, at the full step; None if no candidate is above the bar.
    """
    if bar is None:
        bar = max(0.5 * ENTER, _WORTH * ranked[0].score) if ranked else 0.0
    short = [s for s in ranked[:_SHORT] if s.score > bar]
    if not short:
        return None

    def fitted(candidate: Screened) -> Fit:
        more = guess.plus(candidate.hypothesis, candidate.start)
        step = evidence.step_of(more, _MIDDLE)
        before = _loss_of(evidence, guess, step)
        return evidence.fit(more, before, parallel=False, step=step)

    fits = evidence.map(fitted, short)
    inside = [fit for fit in fits if fit.score > ENTER and not _strained(fit.guess)]
    inside = sorted(inside or fits, key=lambda fit: -fit.score)
    as_likely = [fit for fit in inside if fit.score > inside[0].score - _ODDS]
    large = [fit for fit in as_likely if worth_naming(fit.guess, -1, fit.score)]
    best = (large or inside)[0].guess
    return evidence.fit(
        best, _loss_of(evidence, guess, evidence.step_of(best, evidence.step)), steps=2
    )


def _strained(guess: Guess) -> bool:
    """Whether any part stands at the edge of what is physically plausible."""
    return any(
        np.any(((d <= h.low) | (d >= h.high)) & (np.abs(d) > h.least)) for h, d in guess.parts
    )


def _loss_of(evidence: Evidence, guess: Guess, step: float) -> float:
    errors = evidence.errors(guess, step)
    return float(errors @ errors) + _prior(guess)


def settle(evidence: Evidence, guess: Guess) -> tuple[Guess, Fit]:
    """Fit with gains computed anew until the gains no longer matter."""
    fit = None
    for _ in range(3):
        evidence.set_base(guess)
        fit = evidence.fit(guess, 0.0)
        moved = fit.guess.deviation - guess.deviation
        guess = fit.guess
        spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        if np.all(np.abs(moved) < 0.3 * spread):
            break
    assert fit
    return guess, fit


def worth_naming(guess: Guess, index: int, score: float) -> bool:
    """Whether an effect is as large as its least size in any parameter, or beyond doubt."""
    hypothesis, deviation = guess.parts[index]
    return score >= _BEYOND_DOUBT or bool(np.any(np.abs(deviation) >= hypothesis.least))


def _prune(evidence: Evidence, guess: Guess, fit: Fit | None) -> tuple[Guess, Fit | None]:
    """Take out effects that the others have made needless."""
    while len(guess.parts) > 1 and fit:
        worst, worst_score, worst_rest = -1, np.inf, guess
        for index in range(len(guess.parts)):
            rest = evidence.fit(guess.without(index), 0.0)
            size = guess.parts[index][0].size
            score = rest.loss - fit.loss - charge(_last(fit.information, guess, index), size)
            if not worth_naming(guess, index, score):
                score = min(score, 0.0)
            if score < worst_score:
                worst, worst_score, worst_rest = index, score, rest.guess
        if worst_score >= ENTER:
            break
        del worst
        guess, fit = settle(evidence, worst_rest)
    return guess, fit


def _last(information: np.ndarray, guess: Guess, index: int) -> np.ndarray:
    """Information with the parameters of one effect moved to the end."""
    sizes = [h.size for h, _ in guess.parts]
    first = sum(sizes[:index])
    own = list(range(first, first + sizes[index]))
    order = [i for i in range(len(information)) if i not in own] + own
    return information[np.ix_(order, order)]


def compare(
    evidence: Evidence, guess: Guess, index: int, ranking: Sequence[Screened]
) -> tuple[Fit, tuple[Fit, ...]]:
    """What else could stand in the place of an effect.

    Args:
        evidence: with the guess as base.
        guess: all effects.
        index: the one to replace.
        ranking: the screening in which the effect was found.

    Returns:
        (fit of the effect, fits with the rivals that come near it, best first); scores count
        against the guess without either.
    """
    rest = guess.without(index)
    taken = {h.key for h, _ in guess.parts}
    pool = [s for s in ranking if s.hypothesis.key not in taken and s.score > 0.0][:_RIVALS]

    def glance(part: tuple[Hypothesis, np.ndarray]) -> Fit:
        return evidence.fit(rest.plus(*part), 0.0, parallel=False, steps=2, step=COARSE)

    own_part = guess.parts[index]
    glances = evidence.map(glance, [own_part, *((s.hypothesis, s.start) for s in pool)])
    close = [f.guess for f in glances[1:] if f.loss < glances[0].loss + _HOPELESS]

    def fitted(there: Guess) -> Fit:
        before = _loss_of(evidence, rest, evidence.step_of(there, evidence.step))
        return evidence.fit(there, before, parallel=False, steps=4)

    own, *fits = evidence.map(fitted, [rest.plus(*own_part), *close])
    plausible = [fit for fit in fits if not _strained(fit.guess)]
    return own, tuple(sorted(plausible, key=lambda fit: -fit.score))

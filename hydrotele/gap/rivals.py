"""What else could stand in the place of an effect, and how likely each of them is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, charge
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap.calibrating import free_of_calibration
from hydrotele.gap.screening import Screened
from hydrotele.gap.settling import fitted, settle, strained

_PLAINER = 0.2  # of an effect's probability from which a rival with fewer numbers takes its place
_SECOND = 2  # rivals that are settled like the effect itself
_RIVALS = 3  # candidates that are judged in the place of a named effect
_HOPELESS = 500.0  # loss above the effect's beyond which a rival is let go; or this share of what
_FAR = 0.5  # the effect brings
_SAME = 0.1  # squares of whitened errors by which two guesses differ that say the same
_DRAWS = 4000  # of the Bayesian bootstrap


@dataclass(frozen=True)
class Rival:
    """Another effect in the place of a named one.

    Attributes:
        hypothesis: the effect.
        judged: the guess with it, judged.
        charge: what its parameters cost.
        fit: its last fit; None where it was not settled, for it is far behind.
    """

    hypothesis: Hypothesis
    judged: Judged
    charge: float
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
    chances = np.exp(-0.5 * (totals - totals.min(axis=1, keepdims=True)))
    return (chances / chances.sum(axis=1, keepdims=True)).mean(axis=0)


def chances(now: Judged, cost: float, rest: Judged, rivals: Sequence[Rival]) -> np.ndarray:
    """(2 + R,) probabilities of an effect, of none, and of its rivals.

    Args:
        now: with the effect.
        cost: what its parameters are charged.
        rest: without it.
        rivals: R others in its place.
    """
    return weights(
        [now.blocks(), rest.blocks(), *(r.judged.blocks() for r in rivals)],
        [cost, 0.0, *(r.charge for r in rivals)],
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
    if any(p.unit != own.unit or not p.low <= value <= p.high for p in numbers):
        return False
    equal = np.array([(value - p.nominal) / p.scale for p in numbers])
    instead = Guess(tuple((other, equal) if i == index else p for i, p in enumerate(guess.parts)))
    first = evidence.tracks[:1]
    change = evidence.errors(instead, MIDDLE, first) - evidence.errors(guess, MIDDLE, first)
    return float(change @ change) < _SAME


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


def better(
    now: Judged, index: int, cost: float, rest: Judged, rivals: Sequence[Rival]
) -> Rival | None:
    """The rival that should take an effect's place: likelier, or nearly as likely and plainer."""
    size = now.guess.parts[index][0].size
    table = chances(now, cost, rest, rivals)
    found = [
        (chance, rival) for chance, rival in zip(table[2:], rivals, strict=True)
        if rival.fit and chance > (_PLAINER if rival.hypothesis.size < size else 1.0) * table[0]
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
    if not pool:
        return ()
    evidence.set_base(rest)
    fits = fitted(evidence, rest, pool)
    plausible = [f for f in fits if f.score > 0.0 and not strained(f.guess, -1)][:_RIVALS]
    looked = [(evidence.judged(fit.guess), fit.charge) for fit in plausible]
    looked = sorted((pair for pair in looked if np.isfinite(pair[0].loss)), key=lambda p: p[0].loss)
    found = []
    hopeless = now.loss + max(_HOPELESS, _FAR * (rest.loss - now.loss))
    for place, (judged, cost) in enumerate(looked):
        fit = None
        if place < _SECOND and judged.loss < hopeless:
            judged, fit = settle(evidence, judged)
            cost = charge(fit.information, judged.guess.parts[-1][0].size)
        found.append(Rival(judged.guess.parts[-1][0], judged, cost, fit))
    evidence.set_base(now)
    return tuple(sorted(found, key=lambda r: r.judged.loss + r.charge))

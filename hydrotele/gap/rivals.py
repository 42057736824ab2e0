"""The result of a search, the rivals of its effects, and the probabilities of both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.estimate.evidence import Fit, Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.levels import undisturbed_loss

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


@dataclass(frozen=True)
class Ranked:
    """An effect by the linear step.

    Attributes:
        hypothesis: the effect.
        factor: twice its log Bayes factor against the given machine.
        deviation: (p,) of its parameters.
    """

    hypothesis: Hypothesis
    factor: float
    deviation: np.ndarray


@dataclass(frozen=True)
class Found:
    """What a search leaves.

    Attributes:
        base: the given machine, judged.
        judged: the guess, judged.
        fit: its last fit, or None without effects.
        ranking: the effects compared with the given machine, best first.
        charges: what each part of the guess costs.
        without: for each part the guess without it, fitted and judged; None for the calibration.
        rivals: for each part what was tried in its place.
    """

    base: Judged
    judged: Judged
    fit: Fit | None
    ranking: tuple[Ranked, ...]
    charges: tuple[float, ...]
    without: tuple[Judged | None, ...]
    rivals: tuple[tuple[Rival, ...], ...]

    def emptied(self) -> "Found":
        """The same search that named nothing."""
        return replace(self, judged=self.base, fit=None, charges=(), without=(), rivals=())

    @property
    def guess(self) -> Guess:
        """The named effects, and the calibration if there is one."""
        return self.judged.guess


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


TOLD = 9.0  # square of an effect's deviation over its uncertainty: three standard deviations


def part_taken(rest: Judged, judged: Judged) -> float:
    """Share of what a guess lacks that one with more takes of it.

    Args:
        rest: the guess.
        judged: the one with more.

    Returns:
        1 where nothing is lacking any more, see `undisturbed_loss`.
    """
    ideal = min(sum(map(undisturbed_loss, judged.tracks)), judged.loss)
    return (rest.loss - judged.loss) / max(rest.loss - ideal, 1.0)


def moved_last(information: np.ndarray, guess: Guess, index: int) -> np.ndarray:
    """Information with the parameters of one effect moved to the end."""
    sizes = [h.size for h, _ in guess.parts]
    first = sum(sizes[:index])
    own = list(range(first, first + sizes[index]))
    order = [i for i in range(len(information)) if i not in own] + own
    return information[np.ix_(order, order)]

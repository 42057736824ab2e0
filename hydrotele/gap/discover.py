"""Laws of what no effect explains: located, estimated, fitted, and written into the machine.

The filter's unknown inputs (`estimate.inputs`) say which balance lacks something, where and when;
in their places tables over one or two physical variables of this drive or another are tried
(`law_candidates`). What predicts best parts of runs that it was not fitted to is put into the
machine, looked for again there, where the filter sees clearer, and kept if it is worth its entries
and makes free runs better. It is a term of the patched machine (`hydrotele.terms`), which every
simulator calculates.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import Guess
from hydrotele.gap.law_candidates import Lacks, Learned, candidate_laws, input_of, possible_laws
from hydrotele.gap.rivals import ENTER
from hydrotele.gap.search import lacking
from hydrotele.logs.dataset import RunData

_MOST = 3  # laws that are learned one after the other
_OTHER_FORMS = 4  # times that another form is looked for in a law's place
_AGAIN = 5  # times that a law is fitted again inside the machine
_STEPS = 3  # of Gauss-Newton for the numbers beside a law
_DETAIL = 0.05  # of what all laws brought: one that brings less is the last
_TRACE = 0.02  # of what all laws brought: where no more is lacking no further one is looked for
_AHEAD = 1.0  # s, of free runs that a law must make better; longer ones drift without readings
_FAR_AHEAD = 5.0  # s, of those that it must not make worse
_AT_NOISE = 1.1  # times the noise: errors of free runs that no further law is looked for
_LOSS = 0.1  # of what free runs gain by effects and laws that laws alone may lose
_LOST = 1.0e3  # times the noise: errors of a free run that got lost
_STEP = 2.0e-3  # s, for the fits


class OpenLoop(NamedTuple):
    """Errors of free runs in units of the noise; NaN where all runs are shorter.

    Attributes:
        usual: geometric mean over the windows of `_AHEAD` of their RMS over rows and channels, none
            below the noise: one window that diverges says little of the others, and most of them
            nothing of a law that rarely acts.
        rms: over all rows of these windows.
        far: the same of windows of `_FAR_AHEAD`.
    """

    usual: float
    rms: float
    far: float


_NOT_RUN = OpenLoop(np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Discovery:
    """The guess with its learned laws, judged, and these laws.

    `refused` more made free runs of the held-out run worse, and were taken back.
    Errors of these free runs are `ahead`, and `before` without the laws.
    """

    judged: Judged
    laws: tuple[Learned, ...]
    refused: int = 0
    ahead: OpenLoop = _NOT_RUN
    before: OpenLoop = _NOT_RUN

    def stands_for(self, other: "Discovery", allowed: float) -> bool:
        """Whether its laws tell the runs as well as another guess does that has effects, too.

        Free runs are told as well where a tenth of what the other one gains at most is lost (of the
        squares of RMS), and less than the noise or a hundredth.

        Args:
            other: with effects, and laws beside them.
            allowed: by how much it may be worse with all its laws cost, of -2 log likelihood.
        """
        costs = [d.judged.loss + sum(law.charge for law in d.laws) for d in (self, other)]
        bare, own, others = (np.square(a) for a in (self.before, self.ahead, other.ahead))
        gain = np.maximum(bare - others, 0.0)
        lost = own - others > np.minimum(_LOSS * gain, np.maximum(1.0, _LOSS**2 * gain))
        return bool(self.laws and not lost.any() and costs[0] <= costs[1] + allowed)


def discover(evidence: Evidence, judged: Judged, noise: np.ndarray) -> Discovery:
    """Learn laws of what a guess lacks, one after the other.

    The numbers of named effects stay as they are: a law is what remains after them, and must not
    take their place. Calibrated numbers may give way.

    Args:
        evidence: the runs.
        judged: the guess, judged with unknown inputs.
        noise: (c,) of the channels, the same for all guesses whose free runs are compared.

    Returns:
        The guess with the laws that are worth their parameters, as many of them as make free runs
        of the held-out run better.
    """
    begun = judged
    laws: list[Learned] = []
    named = [h.name != CALIBRATION for h in judged.guess.hypotheses]
    parts = judged.guess.parts
    held = [
        (h.held(d), np.zeros(0)) if n else (h, d) for n, (h, d) in zip(named, parts, strict=True)
    ]
    prior = sum(h.prior(d) for n, (h, d) in zip(named, parts, strict=True) if n)
    judged = replace(judged, guess=Guess(tuple(held)), loss=judged.loss - prior)
    stages, begin = [judged], judged.loss
    ahead = open_loop(evidence, evidence.runs, judged, noise)
    hopeless: set[tuple[str, str]] = set()
    for _ in range(_MOST):
        evidence.set_base(judged)
        found = None
        for candidates in candidate_laws(Lacks.of(evidence, judged), laws, hopeless):
            tried = _best_law(evidence, judged, candidates, hopeless)
            now = open_loop(evidence, evidence.runs, tried[0], noise) if tried else ahead
            if tried and better_ahead(now, ahead):
                found, ahead = tried, now
                break
        if found is None:
            break
        fall = judged.loss - found[0].loss
        judged, law = found
        laws.append(law)
        stages.append(judged)
        left, brought = lacking(judged, evidence), begin - judged.loss
        done = max(ahead.rms, ahead.far) < _AT_NOISE or left < max(ENTER, _TRACE * brought)
        if done or fall < _DETAIL * brought:
            break
    good, last, first = _held_out(evidence, stages, noise)
    refused, laws = len(laws) - good, laws[:good]
    if not laws:
        return Discovery(begun, (), refused, first, first)
    judged = stages[good]
    found = judged.guess.parts
    own = [old if n else new for n, old, new in zip(named, parts, found, strict=False)]
    guess = Guess((*own, *found[len(parts) :]))
    judged = replace(judged, guess=guess, loss=judged.loss + prior)
    return Discovery(judged, tuple(laws), refused, last, first)


def relearned(
    evidence: Evidence, judged: Judged, noise: np.ndarray, laws: Sequence[Learned]
) -> Discovery:
    """Laws that were learned beside other effects than a guess has, fitted again without these.

    Args:
        evidence: the runs.
        judged: the guess, without effects.
        noise: as of `discover`.
        laws: in the order in which they were learned.
    """
    stages, found = [judged], []
    for law in laws:
        evidence.set_base(stages[-1])
        now, fitted = _settled(evidence, stages[-1], _with_law(evidence, stages[-1], law), law)
        stages.append(now)
        found.append(fitted)
    good, last, first = _held_out(evidence, stages, noise)
    return Discovery(stages[good], tuple(found[:good]), len(found) - good, last, first)


def _held_out(
    evidence: Evidence, stages: Sequence[Judged], noise: np.ndarray
) -> tuple[int, OpenLoop, OpenLoop]:
    """How many laws make free runs of the held-out run better, these with them, and without any."""
    runs = (evidence.data.heldout,)
    first = open_loop(evidence, runs, stages[0], noise)
    for good in range(len(stages) - 1, 0, -1):
        last = open_loop(evidence, runs, stages[good], noise)
        if better_ahead(last, first):
            return good, last, first
    return 0, first, first


def _best_law(
    evidence: Evidence, judged: Judged, candidates: Sequence[Learned],
    hopeless: set[tuple[str, str]],
) -> tuple[Judged, Learned] | None:  # fmt: skip
    """The best candidate that is worth its entries, looked for again inside the machine, judged.

    Balances and axes of those that make the guess worse become `hopeless`.
    """
    best: tuple[Judged, Learned] | None = None
    for law in candidates:
        now = _with_law(evidence, judged, law)
        if now.loss > judged.loss:
            hopeless.add((law.balance, law.axis))
        if judged.loss - now.loss > ENTER and (best is None or _cost(now, law) < _cost(*best)):
            best = now, law
    for _ in range(_OTHER_FORMS if best else 0):
        assert best
        best = _settled(evidence, judged, *best)
        other = _another_form(evidence, judged, *best)
        if other is None:
            break
        best = other
    evidence.set_base(judged)
    return best


def _cost(judged: Judged, law: Learned) -> float:
    return judged.loss + law.charge


def _settled(
    evidence: Evidence, judged: Judged, now: Judged, law: Learned
) -> tuple[Judged, Learned]:
    """A law whose entries are fitted inside the machine, again and again, judged."""
    for _ in range(_AGAIN):
        again = _refitted(evidence, now, law)
        if again is None:
            break
        tried = _with_law(evidence, judged, again)
        if now.loss - tried.loss < ENTER:
            break
        now, law = tried, again
    return now, law


def _another_form(
    evidence: Evidence, judged: Judged, now: Judged, law: Learned
) -> tuple[Judged, Learned] | None:
    """The form that predicts clearly more in a law's place, if it is better in the machine, too.

    As long as no law is there, an unknown input does much of what it should tell, and hides which
    form it has: most of all what a law remembers, and from where on.
    """
    evidence.set_base(now)
    lacks = Lacks.of(evidence, now).without(law)
    at = input_of(law.balance, law.axis), law.balance
    own = lacks.regressed((*at, law.table))
    case, answer = max(possible_laws(lacks, at), key=lambda pair: pair[1].predicted)
    if answer.predicted < own.predicted + ENTER:
        return None
    other = lacks.law(case, answer, law.hypothesis)
    tried = _with_law(evidence, judged, other)
    return (tried, other) if _cost(tried, other) < _cost(now, law) - ENTER else None


def _with_law(evidence: Evidence, judged: Judged, law: Learned) -> Judged:
    """A guess with a law more, its other numbers fitted anew."""
    guess = judged.guess.plus(law.hypothesis, np.zeros(0))
    if len(guess.deviation):
        kept = evidence.base_slopes(_STEP)
        if kept.shape[1] == len(guess.deviation):
            guess = evidence.fit(guess, 0.0, step=_STEP, kept=kept, steps=_STEPS).guess
    return evidence.judged(guess)


def _refitted(evidence: Evidence, judged: Judged, law: Learned) -> Learned | None:
    """A law with what the machine that has it still lacks in its form; None for nothing.

    Where its input is no longer needed, readings tell the entries far better than beside it: what
    they have wrong adds up then. That matters in free runs.
    """
    evidence.set_base(judged)
    lacks, case = Lacks.of(evidence, judged), (input_of(law.balance, law.axis), law.balance)
    if case[0] not in lacks.sizes:
        spread = float(np.sqrt(np.mean(np.diag(law.covariance))))
        lacks = replace(lacks, sizes={**lacks.sizes, case[0]: spread})
    more = lacks.regressed((*case, law.table))
    if more.predicted < ENTER:
        return None
    found = more._replace(entries=law.entries + more.entries)
    return lacks.law((*case, law.table), found, law.hypothesis)


def better_ahead(now: OpenLoop, before: OpenLoop) -> bool:
    """Whether free runs are better, none got lost and long ones are no worse."""
    short = np.isnan(now.usual) or (now.usual < before.usual and now.rms <= before.rms)
    return bool(short and (np.isnan(now.far) or now.far <= before.far))


def open_loop(
    evidence: Evidence, runs: Sequence[RunData], judged: Judged, noise: np.ndarray
) -> OpenLoop:
    """Errors of free runs through some runs over all channels, in units of a noise (c,).

    A law is to make simulations better, not only predictions from one reading to the next.
    """
    prepare = machine_runner(judged.guess.machine(evidence.data.machine), evidence.data, _STEP)

    def sizes(run: RunData) -> np.ndarray:
        found = free_run_errors(prepare(run), run, (_AHEAD, _FAR_AHEAD), to_end=False).horizons
        near, far = (found.get(f"{seconds:g}") for seconds in (_AHEAD, _FAR_AHEAD))
        if near is None:
            return np.full(3, np.nan)
        each = np.sqrt(np.nanmean((near.each / noise) ** 2, axis=1))
        squares = [np.nanmean((h.rms / noise) ** 2) if h else np.nan for h in (near, far)]
        return np.array([np.nanmean(np.log(np.clip(each, 1.0, _LOST))), *squares])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no window is long enough, nothing is read
        usual, rms, far = np.nanmean(evidence.map(sizes, runs), axis=0)
    return OpenLoop(float(np.exp(usual)), float(np.sqrt(rms)), float(np.sqrt(far)))

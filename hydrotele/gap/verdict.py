"""Acceptance and verdict of the gap search.

They follow from three things alone: the posterior of the effects, the held-out run (predictive likelihood and open-loop
prediction), and residual tests of the final model.
"""

import dataclasses
import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.gap.description import gap_closed
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import MIN_LOG_BAYES_FACTOR, settle_noise
from hydrotele.gap.result import LIKELY, SURE, GapSize, LearnedLaw, NamedEffect, Verdict

_AHEAD = 1.0  # s, of open-loop predictions: several correlation times of the residual inputs
_STEP = 2.0e-3  # s, of their integrator
_LOST = 1.0e3  # times the noise: larger errors say no more
_NORMAL95 = 1.645  # quantile of a one-sided test at 95 %
_REACH95 = 1.96  # standard errors of a 95 % interval


class HeldOut(NamedTuple):
    """Two models compared on the held-out run, which neither was fitted to.

    Attributes:
        log_ratio: twice the log ratio of the predictive likelihoods, each with the noise levels and residual inputs
            that this run asks for; positive if the final model is better.
        open_loop: mean log ratio of the errors of open-loop predictions over 1 s, final to given model; NaN if the run
            is too short.
        deviation: standard error of that mean.
    """

    log_ratio: float
    open_loop: float
    deviation: float

    @property
    def is_worse(self) -> bool:
        """Whether the run is evidence against the final model."""
        return self.log_ratio < -MIN_LOG_BAYES_FACTOR or self.open_loop > _NORMAL95 * self.deviation

    @property
    def words(self) -> str:
        """The comparison in a sentence."""
        text = f"On the held-out run, twice the log likelihood of the changed model is {self.log_ratio:+,.0f} higher"
        if math.isfinite(self.open_loop):
            middle, reach = self.open_loop, _REACH95 * self.deviation
            ratio, low, high = (math.exp(x) for x in (middle, middle - reach, middle + reach))
            text += (
                f", and its open-loop errors over {_AHEAD:g} s are {ratio:.2f} times those of the given one"
                f" (95 % interval {low:.2f} to {high:.2f})"
            )
        return f"{text}." + (" The changes were rejected, and no effect is named." if self.is_worse else "")


def compare_held_out(evidence: Evidence, given: Judged, final: Judged) -> HeldOut:
    """Compare the given and the final model on the held-out run.

    Args:
        evidence: with the data.
        given: the given machine.
        final: the machine with effects, laws and calibrated parameters.
    """
    run = evidence.data.heldout

    def loss(judged: Judged) -> float:
        own = Evidence(evidence.data, (run,), 1, evidence.step, lacking=True)
        try:
            return settle_noise(MachineModel(own), own.judged(judged.guess)).loss - judged.guess.prior
        finally:
            own.close()

    def errors(judged: Judged) -> np.ndarray:
        """Return the log errors of open-loop windows in units of the noise of the given model; at least 0."""
        runner = machine_runner(judged.guess.machine(evidence.data.machine, run.name), evidence.data, _STEP)(run)
        found = free_run_errors(runner, run, (_AHEAD,), to_end=False).horizons.get(f"{_AHEAD:g}")
        if found is None:
            return np.zeros(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a window without readings
            sizes = np.sqrt(np.nanmean((found.each / given.tracks[0].levels.whole_noise) ** 2, axis=1))
        return np.log(np.clip(sizes, 1.0, _LOST))

    losses = evidence.map(loss, (given, final))
    windows = evidence.map(errors, (given, final))
    change = windows[1] - windows[0]
    change = change[np.isfinite(change)]
    mean = float(change.mean()) if len(change) else math.nan
    deviation = float(change.std(ddof=1)) / math.sqrt(len(change)) if len(change) > 1 else math.nan
    return HeldOut(losses[0] - losses[1], mean, deviation)


def count_unexplained(
    named: Sequence[NamedEffect],
    laws: Sequence[LearnedLaw],
    left: Mapping[str, float],
    lost: Collection[str],
    runs: Collection[str] = (),
) -> tuple[NamedEffect, ...]:
    """Return the effects with probabilities that count what remains on their axes as "none of them".

    Where a residual test fails, or a law without a known cause was learned, something acts that the library does not
    hold. An effect may imitate a part of it. Its probability is multiplied with the fraction of the gap of its axis
    that named effects close.

    Args:
        named: the effects, with probabilities among the effects of the library and none.
        laws: learned laws.
        left: axis -> fraction of its gap that remains, "" -> of all channels.
        lost: axes on which something remains, "" for channels without axis.
        runs: names of the runs, which the location of an effect in one run contains.
    """
    found = []
    for effect in named:
        part = effect.location.partition(".")[2]
        if any(part == run or part.startswith(f"{run}.") for run in runs):  # no part of a law of all runs
            found.append(effect)
            continue
        place = effect.location.partition(".")[0]
        axis = place if place in left else ""
        if not lost or (axis and axis not in lost):
            found.append(effect)
            continue
        rest = left[axis] + sum(law.share for law in laws if axis in ("", law.axis) and math.isfinite(law.share))
        known = max(0.0, 1.0 - rest)
        others = tuple(dataclasses.replace(a, probability=known * a.probability) for a in effect.alternatives)
        found.append(dataclasses.replace(effect, probability=known * effect.probability, alternatives=others))
    return tuple(sorted(found, key=lambda effect: -effect.probability))


def verdict_of(named: Sequence[NamedEffect], laws: Sequence[LearnedLaw], failed: bool, size: GapSize) -> Verdict:
    """Return the verdict.

    Args:
        named: the effects.
        laws: learned laws without a known cause.
        failed: whether a residual test of the final model fails, or changes that the fitted runs support were rejected.
        size: of the gap on the held-out run. Laws alone are `learned` if they close `SURE` of it.
    """
    likely = [e for e in named if e.mechanism_probability > LIKELY]
    if not named and not laws:
        return "unknown" if failed or size.noise_floor is None else "no_gap"
    if likely and (failed or laws):
        return "partly"
    if failed or laws:
        return "learned" if laws and not named and gap_closed(size) >= SURE else "unknown"
    return "named" if all(e.mechanism_probability >= SURE for e in named) else "ambiguous"

"""Which effects are worth a fit: every candidate by what a few steps along it change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import WIDE, Guess, Hypothesis
from hydrotele.estimate.track import COARSE, Track, first_rows

_FEW = 16  # candidates that are tried on all runs
_GLANCE = 20.0  # s of the run that fits worst on which all are tried
_ROOM = 1e-9  # deviations, between bounds that are one
_BENT = 0.5  # sides of nominal that differ by this share of their squares are no straight line


@dataclass(frozen=True)
class Screened:
    """A candidate by its signature alone.

    Attributes:
        hypothesis: the candidate.
        score: twice the log of the evidence it would bring, as far as a few steps along it show.
        gain: fall of the loss by the same token.
        start: (p,) deviation from which to fit it.
    """

    hypothesis: Hypothesis
    score: float
    gain: float
    start: np.ndarray


def screen(evidence: Evidence, guess: Guess, candidates: Sequence[Hypothesis]) -> list[Screened]:
    """Rank candidates by their signatures in the base's errors.

    All are tried on the run that fits worst, the best of them on all runs. A signature is taken
    from both sides of nominal. Where it is a straight line, the candidate is rated by the best
    deviation on it; where not, as with friction that sticks or slips, by the best of what was
    tried, too.

    Args:
        evidence: with the guess as its base.
        guess: what is already there.
        candidates: what may be added.

    Returns:
        The candidates that were tried on all runs and are not there yet, best first.
    """
    taken = {h.key for h, _ in guess.parts}
    open_ones = [h for h in candidates if h.key not in taken]
    worst = max(evidence.tracks, key=lambda t: float(np.nanmean(t.whitened**2)))
    if len(evidence.tracks) > 1 and len(open_ones) > _FEW:
        rows = round(_GLANCE / worst.run.period)
        first = _rank(evidence, guess, open_ones, (first_rows(worst, rows),))
        open_ones = [s.hypothesis for s in first[:_FEW]]
    return _rank(evidence, guess, open_ones, evidence.tracks)


@dataclass(frozen=True)
class _Ground:
    """Where candidates start: errors (E,), slopes (E, P) and deviation (P,) of what is there.

    `matrix` is the (P, P) information of these slopes with the prior's, `low` and `high` (P,) are
    the bounds of the deviation.
    """

    errors: np.ndarray
    slopes: np.ndarray
    present: np.ndarray
    matrix: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _rank(
    evidence: Evidence, guess: Guess, candidates: Sequence[Hypothesis], tracks: Sequence[Track]
) -> list[Screened]:
    def errors_of(moved: Guess, step: float) -> np.ndarray:
        return evidence.errors(moved, step, tracks)

    present = guess.deviation
    slopes = evidence.base_slopes_of(tracks) if len(present) else None
    matrix = np.zeros((0, 0)) if slopes is None else slopes.T @ slopes + np.eye(len(present))
    low = np.concatenate([np.zeros(0), *(h.low for h in guess.hypotheses)])
    high = np.concatenate([np.zeros(0), *(h.high for h in guess.hypotheses)])

    def ground_of(step: float) -> _Ground:
        errors = errors_of(guess, step)
        there = np.zeros((len(errors), 0)) if slopes is None else slopes
        return _Ground(errors, there, present, matrix, low, high)

    steps = {h.key: evidence.step_of(guess.plus(h, h.starts[-1]), COARSE) for h in candidates}
    unlike = sorted(set(steps.values()))
    grounds = dict(zip(unlike, evidence.map(ground_of, unlike), strict=True))

    def rate(hypothesis: Hypothesis) -> Screened:
        step = steps[hypothesis.key]
        ground = grounds[step]

        def shift_to(d: np.ndarray) -> np.ndarray:
            return errors_of(guess.plus(hypothesis, d), step) - ground.errors

        rated = []
        for start in hypothesis.starts:
            if np.any(start) and hypothesis.size > 1:
                rated.append(_point(hypothesis, ground, start, shift_to(start)))
            elif np.any(start):
                line = _line(hypothesis, ground, (shift_to(start) / start[0])[:, None])
                rated.append(Screened(hypothesis, line.score, line.gain, start))
            else:
                rated.append(_around_nominal(hypothesis, ground, shift_to))
        return max(rated, key=lambda s: s.score)

    return sorted(evidence.map(rate, candidates), key=lambda s: -s.score)


def _around_nominal(
    hypothesis: Hypothesis, ground: _Ground, shift_to: Callable[[np.ndarray], np.ndarray]
) -> Screened:
    """By both sides of nominal, parameter by parameter."""
    slopes, tried, bent = np.zeros((len(ground.errors), hypothesis.size)), [], False
    for k in range(hypothesis.size):
        shifts = []
        for side in hypothesis.sides(k, WIDE):
            d = np.zeros(hypothesis.size)
            d[k] = side
            shift = shift_to(d)
            shifts.append(shift / side)
            tried.append(_point(hypothesis, ground, d, shift))
        slopes[:, k] = np.mean(shifts, axis=0)
        unlike = float(np.sum((shifts[0] - shifts[-1]) ** 2))
        bent |= unlike > _BENT * float(np.sum(shifts[0] ** 2) + np.sum(shifts[-1] ** 2))
    line = _line(hypothesis, ground, slopes)
    best = max(tried, key=lambda s: s.gain)
    if not bent or best.gain <= 0.0:
        return line
    return Screened(hypothesis, max(line.score, best.score), max(line.gain, best.gain), best.start)


def _point(hypothesis: Hypothesis, ground: _Ground, d: np.ndarray, shift: np.ndarray) -> Screened:
    """As tried, what is there following."""
    now = _without_present(ground, ground.errors)
    moved = _without_present(ground, ground.errors + shift)
    along = shift / np.linalg.norm(d)
    cost = float(np.log1p(along @ along - _explained(ground, along)))
    gain = now - moved - float(d @ d)
    return Screened(hypothesis, gain - cost, gain, d)


def _without_present(ground: _Ground, errors: np.ndarray) -> float:
    """Least loss when what is there may follow, within its bounds."""
    pull = ground.slopes.T @ errors + ground.present
    fall = _least(ground.matrix, pull, ground.low - ground.present, ground.high - ground.present)[1]
    return float(errors @ errors + fall)


def _least(
    matrix: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, float]:
    """Least `x' A x + 2 b' x` within bounds on x, which hold 0: (x, that)."""
    x = -np.linalg.solve(matrix, pull)
    if np.any((x < low) | (x > high)):
        squares, axes = np.linalg.eigh(matrix)  # signatures may be alike to the last digits
        lengths = np.sqrt(np.maximum(squares, np.finfo(float).eps * squares[-1]))
        low, high = np.minimum(low, -_ROOM), np.maximum(high, _ROOM)
        root = lengths[:, None] * axes.T
        x = lsq_linear(root, -(axes.T @ pull) / lengths, (low, high), method="bvls").x
    return x, float(x @ matrix @ x + 2.0 * pull @ x)


def _explained(ground: _Ground, along: np.ndarray) -> float:
    """Part of a signature's square that what is there could take over."""
    pull = ground.slopes.T @ along
    return float(pull @ np.linalg.solve(ground.matrix, pull))


def _line(hypothesis: Hypothesis, ground: _Ground, slopes: np.ndarray) -> Screened:
    """Best deviation inside the bounds, with straight signatures, what is there following."""
    own = slopes.T @ slopes + np.eye(hypothesis.size)
    cross = ground.slopes.T @ slopes
    whole = np.block([[ground.matrix, cross], [cross.T, own]])
    pull = np.concatenate([ground.slopes.T @ ground.errors + ground.present,
                           slopes.T @ ground.errors])  # fmt: skip
    low = np.concatenate([ground.low - ground.present, hypothesis.low])
    high = np.concatenate([ground.high - ground.present, hypothesis.high])
    x, fall = _least(whole, pull, low, high)
    there = len(ground.present)
    gain = _without_present(ground, ground.errors) - float(ground.errors @ ground.errors) - fall
    cost = float(np.linalg.slogdet(whole)[1])
    if there:
        cost -= float(np.linalg.slogdet(ground.matrix)[1])
    return Screened(hypothesis, gain - cost, gain, x[there:])

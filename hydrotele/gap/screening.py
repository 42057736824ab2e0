"""Which effects are worth a fit: every candidate by what a few steps along it change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.prediction.evidence import Evidence
from hydrotele.prediction.hypothesis import WIDE, Guess, Hypothesis
from hydrotele.prediction.track import COARSE, Track, first_rows

_FEW = 16  # candidates that are tried on all runs
_GLANCE = 20.0  # s of the run that fits worst on which all are tried
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
    """Where candidates start: errors (E,), slopes (E, P) and deviation (P,) of what is there."""

    errors: np.ndarray
    slopes: np.ndarray
    present: np.ndarray


def _rank(
    evidence: Evidence, guess: Guess, candidates: Sequence[Hypothesis], tracks: Sequence[Track]
) -> list[Screened]:
    def errors_of(moved: Guess, step: float) -> np.ndarray:
        return evidence.errors(moved, step, tracks)

    present = guess.deviation
    slopes = evidence.base_slopes_of(tracks) if len(present) else None

    def ground_of(step: float) -> _Ground:
        errors = errors_of(guess, step)
        return _Ground(errors, np.zeros((len(errors), 0)) if slopes is None else slopes, present)

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
    """Least loss when what is there may follow."""
    pull = ground.slopes.T @ errors + ground.present
    matrix = ground.slopes.T @ ground.slopes + np.eye(len(pull))
    return float(errors @ errors - pull @ np.linalg.solve(matrix, pull))


def _explained(ground: _Ground, along: np.ndarray) -> float:
    """Part of a signature's square that what is there could take over."""
    pull = ground.slopes.T @ along
    matrix = ground.slopes.T @ ground.slopes + np.eye(len(pull))
    return float(pull @ np.linalg.solve(matrix, pull))


def _line(hypothesis: Hypothesis, ground: _Ground, slopes: np.ndarray) -> Screened:
    """Best deviation inside the bounds, with straight signatures, what is there following."""
    both = np.column_stack([ground.slopes, slopes])
    matrix = both.T @ both + np.eye(both.shape[1])
    right = both.T @ ground.errors + np.concatenate([ground.present, np.zeros(hypothesis.size)])
    p = ground.slopes.shape[1]
    if p:  # eliminate what is already there
        inner = np.linalg.solve(matrix[:p, :p], np.column_stack([matrix[:p, p:], right[:p]]))
        own = matrix[p:, p:] - matrix[p:, :p] @ inner[:, :-1]
        pull = right[p:] - matrix[p:, :p] @ inner[:, -1]
    else:
        own, pull = matrix, right
    d = np.clip(-np.linalg.solve(own, pull), hypothesis.low, hypothesis.high)
    for _ in range(20):  # coordinate descent in the box
        for k in range(len(d)):
            rest = pull[k] + own[k] @ d - own[k, k] * d[k]
            d[k] = np.clip(-rest / own[k, k], hypothesis.low[k], hypothesis.high[k])
    gain = float(-(d @ own @ d + 2.0 * pull @ d))
    cost = float(np.linalg.slogdet(own)[1])
    return Screened(hypothesis, gain - cost, gain, d)

"""How well the numbers of named effects are known: noise, run-to-run scatter, integrator steps."""

import numpy as np

from hydrotele.estimate.evidence import BLOCK, Evidence
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.inputs import MEMORY

_FEW = 10  # numbers up to which slopes are taken at the finest step
_CHANCE = 3.0  # chi-square per degree of freedom that two degrees exceed in 5 % of all cases
_STRETCHES = 40  # of the runs, if they are not shorter than what unknown inputs remember


def spreads(evidence: Evidence, guess: Guess, scatter: float = 1.0) -> np.ndarray:
    """Standard deviations of a guess's numbers.

    Where errors hang together over time, as those of a law of another form do, stretches of the
    runs pull at the numbers more unlike than independent noise would, and the spread follows their
    pulls (White 1982, Econometrica 50(1), section 3: the sandwich covariance). Where runs by
    themselves ask for sizes that scatter beyond chance, it is widened to that scatter (Birge 1932,
    Phys. Rev. 40, 207). What halving the integrator's step would change is added as the half-width
    of a uniform error, for neither step is the truth (Guide to the expression of uncertainty in
    measurement, 4.3.7).

    Args:
        evidence: with the guess as its base.
        guess: fitted.
        scatter: chi-square per degree of freedom of the sizes that the runs ask for.

    Returns:
        (P,) standard deviations, in typical deviations.
    """
    step = evidence.step_of(guess, evidence.step)
    few = len(guess.deviation) <= _FEW
    if few:
        slopes = evidence.slopes(guess, evidence.errors(guess, step), step=step)
    else:
        slopes = evidence.base_slopes(evidence.slope_step)
    information = slopes.T @ slopes + np.eye(slopes.shape[1])
    covariance = np.linalg.inv(information)
    noisy = np.maximum(np.diag(covariance), _sandwich(evidence, slopes, covariance))
    shift = covariance @ (slopes.T @ evidence.step_effect(guess, 0.5 * step))
    widened = scatter if scatter > _CHANCE else 1.0
    return np.sqrt(widened * noisy + shift**2 / 3.0)


def _sandwich(evidence: Evidence, slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(P,) variances from how unlike stretches of the runs pull at the numbers."""
    errors, pulls, at = evidence.base_errors, [], 0
    whole = sum(len(track.whitened) * track.run.period for track in evidence.tracks)
    seconds = float(np.clip(whole / _STRETCHES, MEMORY, BLOCK))
    for track in evidence.tracks:
        rows, channels = track.whitened.shape
        count = max(1, int(rows * track.run.period / seconds))
        edges = at + channels * np.linspace(0, rows, count + 1).astype(int)
        pull = slopes[at : at + rows * channels] * errors[at : at + rows * channels, None]
        pulls.append(np.add.reduceat(pull, edges[:-1] - at, axis=0))
        at += rows * channels
    scores = np.concatenate(pulls)
    scores = scores - scores.mean(axis=0)
    spread = scores.T @ scores * len(scores) / max(len(scores) - 1, 1)
    return np.diag(covariance @ (spread + np.eye(len(covariance))) @ covariance)

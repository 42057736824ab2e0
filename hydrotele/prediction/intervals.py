"""How well the numbers of named effects are known: noise, run-to-run scatter, integrator steps."""

import numpy as np

from hydrotele.prediction.evidence import MIDDLE, Evidence
from hydrotele.prediction.hypothesis import Guess

_FEW = 10  # numbers up to which slopes are taken at the finest step
_CHANCE = 3.0  # chi-square per degree of freedom that two degrees exceed in 5 % of all cases


def spreads(evidence: Evidence, guess: Guess, scatter: float = 1.0) -> np.ndarray:
    """Standard deviations of a guess's numbers.

    Where runs by themselves ask for sizes that scatter beyond chance, the noise's part is widened
    to that scatter (Birge 1932, Phys. Rev. 40, 207). What halving the integrator's step would
    change is added as the half-width of a uniform error, for neither step is the truth (Guide to
    the expression of uncertainty in measurement, 4.3.7).

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
        slopes = evidence.base_slopes(MIDDLE)
    information = slopes.T @ slopes + np.eye(slopes.shape[1])
    covariance = np.linalg.inv(information)
    shift = covariance @ (slopes.T @ evidence.step_effect(guess, 0.5 * step))
    widened = scatter if scatter > _CHANCE else 1.0
    return np.sqrt(widened * np.diag(covariance) + shift**2 / 3.0)

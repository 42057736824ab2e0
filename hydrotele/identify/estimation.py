"""From gathered equations to base parameters: weights, and what noisy data tell."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from hydrotele.core.errors import InputError
from hydrotele.identify.estimators import Estimate, autoregression, estimate
from hydrotele.identify.gathering import Gathered
from hydrotele.identify.identifiability import Identifiability, told_in_noise
from hydrotele.identify.reference_size import reference_sizes
from hydrotele.identify.regressor import RUBBING, Regressor
from hydrotele.identify.setup import Setup

Method = Literal["weighted", "gauss_markov", "least_squares", "instruments"]
METHODS = ("weighted", "gauss_markov", "least_squares", "instruments")
REPEATED = ("gauss_markov", "instruments")  # that compare the periods of a repeated motion
_WHERE = "identification"


@dataclass(frozen=True)
class Estimator:
    """How base parameters are estimated.

    Attributes:
        method: `weighted`: least squares in which every drive counts by its own residuals, and
            those in which dry friction may have either sign count less. `gauss_markov`: the same
            with the covariance between the drives, of repeated periods where there are any.
            `least_squares`: all equations count alike. `instruments`: weighted, with the regressor
            of another period of the motion as instruments.
        ridge: added to the squares of singular values, as a share of the largest; towards the
            given parameters.
        cut: share of the largest singular value below which directions keep the given parameters.
        pairs: of added noise by which the bias of the positions' noise is found and taken off; 0 to
            leave it. Instruments are free of it only where the regressor is linear in the noise.
    """

    method: Method = "weighted"
    ridge: float = 0.0
    cut: float = 0.0
    pairs: int = 4

    def __post_init__(self) -> None:
        """Refuse what is not known or makes no sense."""
        if self.method not in METHODS:
            raise InputError("estimator", f"{self.method!r} is not known: {', '.join(METHODS)}")
        if not (0.0 <= self.ridge < np.inf and 0.0 <= self.cut < 1.0):
            raise InputError(
                "estimator",
                f"ridge must not be negative and cut below 1: {self.ridge}, {self.cut}",
            )
        if self.method == "instruments" and (self.ridge or self.cut):
            raise InputError("estimator", "instruments know no ridge and no truncation")
        if self.pairs < 0:
            raise InputError("estimator", f"pairs of noise must be 0 or more, got {self.pairs}")


@dataclass(frozen=True)
class Weighted:
    """Weighted equations; n of them, k drives, m parameters.

    Attributes:
        table: names, units and nominal values of the parameters.
        weight: (n, k) of the equations.
        doubtful: (k, 2) variance of a drive's errors, and what doubt of a sign adds to it.
        matrix: (n, k, m), weighted.
        force: (n, k), weighted [N] or [N m].
        covariance: (k, k) of the weighted forces' errors; None to count drives by residuals.
        instruments: (n, k, m), weighted, or None.
    """

    table: Regressor
    weight: np.ndarray
    doubtful: np.ndarray
    matrix: np.ndarray
    force: np.ndarray
    covariance: np.ndarray | None = None
    instruments: np.ndarray | None = None

    def fitted(
        self, told: Identifiability, ridge: float = 0.0, cut: float = 0.0,
        order: int | None = None,
    ) -> Estimate:  # fmt: skip
        """Base parameters; what the data do not tell of the others stays as given.

        Args:
            told: the base.
            ridge: see `Estimator`.
            cut: see `Estimator`.
            order: of the errors' autoregression; None to choose it.

        Returns:
            The estimate of the combinations.
        """
        base = self.matrix[:, :, told.base]
        given = told.combination @ self.table.nominal
        rest = self.force - self.matrix @ self.table.nominal + base @ given
        aside = None if self.instruments is None else self.instruments[:, :, told.base]
        return estimate(
            base, rest, self.covariance, instruments=aside, ridge=ridge, cut=cut, prior=given,
            order=order,
        )  # fmt: skip


def weighted(
    data: Gathered, structure: Identifiability, method: Method, period: float | None
) -> Weighted:
    """Equations weighted for an estimator.

    Args:
        data: equations.
        structure: base parameters of their motion.
        method: of the estimator.
        period: of a repeated motion [s]; instruments need it.

    Returns:
        The weighted equations.

    Raises:
        InputError: a method that compares periods gets runs of one.
    """
    ones, drives = np.ones_like(data.force), data.force.shape[1]
    alike = np.tile([1.0, 0.0], (drives, 1))
    if method == "least_squares":
        return Weighted(data.table, ones, alike, data.matrix, data.force, np.eye(drives))
    plain = Weighted(data.table, ones, alike, data.matrix, data.force)
    doubtful = _doubtful(plain.fitted(structure, order=0).residual, data.doubt)
    weight = weights(doubtful, data.doubt)
    matrix, force = weight[:, :, None] * data.matrix, weight * data.force
    found = Weighted(data.table, weight, doubtful, matrix, force)
    if method == "gauss_markov":
        error = found.fitted(structure, order=0).residual
        if period:  # what repeats is the model's error, the rest is noise, twice of it
            error = (error - data.cycle_on(error, period)) / np.sqrt(2.0)
            error = error[np.isfinite(error).all(axis=1)]
        return replace(found, covariance=error.T @ error / len(error))
    if method == "instruments":
        assert period
        aside = weight[:, :, None] * np.nan_to_num(data.cycle_on(data.matrix, period))
        return replace(found, instruments=aside)
    return found


def told_by(
    data: Weighted, structure: Identifiability, setup: Setup, resting: Sequence[str],
    drives: Sequence[str],
) -> Identifiability:  # fmt: skip
    """What data tell in spite of their noise.

    Friction of drives that rest is not asked for: whatever holds them is no sliding.

    Args:
        data: weighted equations.
        structure: base parameters of their motion.
        setup: of the regressor.
        resting: drives that rest.
        drives: names of the k drives.

    Returns:
        The base parameters.

    Raises:
        InputError: nothing is told.
    """
    if not len(structure.base):
        raise InputError(_WHERE, "no parameter has an effect on the forces of this motion")
    plain = replace(data, instruments=None)  # which tell badly what the data hardly tell
    noise = _long_run(plain.fitted(structure, order=0).residual)
    table = data.table
    sizes = reference_sizes(table, setup, np.sqrt(np.mean(data.force**2, axis=0)), drives)
    held = {f"{kind}.{drive}" for kind in RUBBING for drive in resting}
    asked = np.array([name not in held for name in table.names])
    rows = (data.matrix / noise[:, None]).reshape(-1, data.matrix.shape[2])
    told = told_in_noise(rows, table.names, sizes, asked)
    if not len(told.base):
        raise InputError(_WHERE, "these data tell no parameter: log a motion with larger forces")
    return told


def weights(doubtful: np.ndarray, doubt: np.ndarray) -> np.ndarray:
    """Weights of equations in which dry friction may have either sign.

    Args:
        doubtful: (k, 2) as of `Weighted`.
        doubt: (n, k) of the signs.

    Returns:
        (n, k), 1 at most.
    """
    return np.sqrt(doubtful[:, 0] / (doubtful[:, 0] + doubtful[:, 1] * doubt**2))


def _doubtful(residual: np.ndarray, doubt: np.ndarray) -> np.ndarray:
    """How much larger doubtful errors are (k, 2), read off the residuals of a first estimate."""
    out = np.tile([1.0, 0.0], (doubt.shape[1], 1))
    for k in range(doubt.shape[1]):
        square = residual[:, k] ** 2
        grows = np.column_stack([np.ones(len(square)), doubt[:, k] ** 2])
        calm, more = nnls(grows * square.size**-0.5, square * square.size**-0.5)[0]
        if calm > 0.0:
            out[k] = calm, more
    return out


def _long_run(residual: np.ndarray) -> np.ndarray:
    """Standard deviations (k,) of independent errors that would tell slow changes as badly."""
    follow = autoregression(residual)
    fresh = residual.copy()
    for q, kept in enumerate(follow, start=1):
        fresh[q:] -= kept * residual[:-q]
    spread = np.std(fresh[len(follow) :], axis=0) / np.abs(1.0 - follow.sum(axis=0))
    return np.maximum(spread, np.std(residual, axis=0))

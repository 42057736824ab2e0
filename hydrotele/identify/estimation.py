"""Estimation of base parameters: options, weights of the equations and selection of identifiable parameters.

`weight_equations` and `find_identifiable_parameters` weight the equations and select the base parameters
that noisy data determine; all other combinations keep their nominal values.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls
from scipy.stats import norm

from hydrotele.core.errors import InputError
from hydrotele.identify.equations import StackedEquations
from hydrotele.identify.identifiability import (
    Identifiability,
    classify_noisy_parameters,
    reference_sizes,
)
from hydrotele.identify.linear_least_squares import Estimate, estimate_linear_parameters, fit_autoregression
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.multibody.regressor import FRICTION_TERMS, Regressor, is_friction_deviation

Method = Literal["weighted", "gauss_markov", "least_squares", "instruments"]
METHODS = ("weighted", "gauss_markov", "least_squares", "instruments")
METHODS_WITH_PERIOD = (
    "gauss_markov",
    "instruments",
)  # methods that compare periods of a repeated motion
_ERROR_CONTEXT = "identification"


@dataclass(frozen=True)
class Estimator:
    """Options for estimating the base parameters.

    Attributes:
        method: `weighted`: least squares in which each drive is weighted by its residuals, and
            equations with an uncertain sign of dry friction have less weight. `gauss_markov`: the
            same with the covariance between the drives, from repeated periods if there are any.
            `least_squares`: equal weights. `instruments`: weighted, with the regressor of another
            period of the motion as instruments.
        ridge: added to the squared singular values, as a fraction of the largest one squared; moves
            the estimate towards the given parameters.
        truncation: fraction of the largest singular value below which directions keep the given
            parameters.
        noise_pairs: number of pairs of a noise sample and its negative with which the bias caused by
            position noise is estimated and subtracted; 0 for no correction. Instruments avoid that bias only where
            the regressor is linear in the noise.
    """

    method: Method = "weighted"
    ridge: float = 0.0
    truncation: float = 0.0
    noise_pairs: int = 4

    def __post_init__(self) -> None:
        """Raise InputError for unknown methods and invalid values."""
        if self.method not in METHODS:
            raise InputError("estimator", f"{self.method!r} is not known: {', '.join(METHODS)}")
        if not (0.0 <= self.ridge < np.inf and 0.0 <= self.truncation < 1.0):
            raise InputError(
                "estimator",
                f"ridge must be 0 or more and truncation in [0, 1), got {self.ridge} and {self.truncation}",
            )
        if self.method == "instruments" and (self.ridge or self.truncation):
            raise InputError("estimator", "instruments cannot be combined with ridge or truncation")
        if self.noise_pairs < 0:
            raise InputError("estimator", f"noise_pairs must be 0 or more, got {self.noise_pairs}")


@dataclass(frozen=True)
class WeightedEquations:
    """Weighted equations: n rows, k drives, m parameters.

    Attributes:
        table: names, units and nominal values of the parameters.
        weights: (n, k) weights of the equations.
        error_variances: (k, 2) error variance of each drive, and the variance added by an uncertain
            friction sign.
        matrix: (n, k, m) weighted regressor.
        force: (n, k) weighted forces [N] or [N m].
        covariance: (k, k) covariance of the weighted force errors; None to weight the drives by
            their residuals.
        instruments: (n, k, m) weighted instruments, or None.
    """

    table: Regressor
    weights: np.ndarray
    error_variances: np.ndarray
    matrix: np.ndarray
    force: np.ndarray
    covariance: np.ndarray | None = None
    instruments: np.ndarray | None = None

    def estimate_base_parameters(
        self, identifiability: Identifiability, ridge: float = 0.0, truncation: float = 0.0,
        order: int | None = None,
    ) -> Estimate:  # fmt: skip
        """Estimate the base parameters by least squares, or with the instruments if there are any.

        Parameters outside the base keep their given (nominal) values.

        Args:
            identifiability: the base parameters, as combinations of all parameters.
            ridge: added to the squared singular values, as a fraction of the largest one squared.
            truncation: fraction of the largest singular value below which directions keep given values.
            order: order of the errors' autoregression; None to choose it.

        Returns:
            The estimate of the base parameters.
        """
        base = self.matrix[:, :, identifiability.base]
        given = identifiability.combination @ self.table.nominal
        rest = self.force - self.matrix @ self.table.nominal + base @ given
        aside = None if self.instruments is None else self.instruments[:, :, identifiability.base]
        return estimate_linear_parameters(
            base, rest, self.covariance, instruments=aside, ridge=ridge, truncation=truncation, prior=given,
            order=order,
        )  # fmt: skip


def weight_equations(
    data: StackedEquations, structure: Identifiability, method: Method, period: float | None
) -> WeightedEquations:
    """Weight the force equations as an estimation method requires.

    Equations with an uncertain sign of dry friction get less weight, except for `least_squares`. For
    `gauss_markov` the covariance between the drives follows from the residuals of a first fit, or with
    a period from their differences between successive periods. For `instruments` the regressor of
    another period is added.

    Args:
        data: equations.
        structure: base parameters by the null space of the regressor, for a first fit whose residuals
            determine the weights.
        method: method of the estimator.
        period: period of a repeated motion [s]; required for instruments.

    Returns:
        The weighted equations.

    Raises:
        InputError: the method compares periods, but a run is shorter than two periods.
    """
    ones, drives = np.ones_like(data.force), data.force.shape[1]
    alike = np.tile([1.0, 0.0], (drives, 1))
    if method == "least_squares":
        return WeightedEquations(data.table, ones, alike, data.matrix, data.force, np.eye(drives))
    plain = WeightedEquations(data.table, ones, alike, data.matrix, data.force)
    doubtful = estimate_error_variances(
        plain.estimate_base_parameters(structure, order=0).residual, data.friction_sign_uncertainty
    )
    weight = compute_weights(doubtful, data.friction_sign_uncertainty)
    matrix, force = weight[:, :, None] * data.matrix, weight * data.force
    found = WeightedEquations(data.table, weight, doubtful, matrix, force)
    if method == "gauss_markov":
        error = found.estimate_base_parameters(structure, order=0).residual
        if period:  # a difference of periods has no repeated model error and twice the variance
            error = (error - data.shift_by_period(error, period)) / np.sqrt(2.0)
            error = error[np.isfinite(error).all(axis=1)]
        return replace(found, covariance=error.T @ error / len(error))
    if method == "instruments":
        assert period
        aside = weight[:, :, None] * np.nan_to_num(data.shift_by_period(data.matrix, period))
        return replace(found, instruments=aside)
    return found


def find_identifiable_parameters(
    data: WeightedEquations, structure: Identifiability, setup: RegressorSetup, resting: Collection[str],
    drives: Sequence[str],
) -> Identifiability:  # fmt: skip
    """Select the base parameters that noisy data determine.

    They have standard deviations of at most half the reference size of the parameter. Friction of
    drives at rest is excluded, because they do not slide.

    Args:
        data: weighted equations.
        structure: base parameters by the null space of the regressor, for a first fit whose residuals
            give the noise.
        setup: definition of the regressor.
        resting: drives at rest.
        drives: names of the k drives.

    Returns:
        The base parameters.

    Raises:
        InputError: no parameter is identifiable.
    """
    if not len(structure.base):
        raise InputError(_ERROR_CONTEXT, "no parameter has an effect on the forces of this motion")
    plain = replace(data, instruments=None)  # inaccurate for poorly determined parameters
    noise = _long_run_std(plain.estimate_base_parameters(structure, order=0).residual)
    table = data.table
    sizes = reference_sizes(table, setup, np.sqrt(np.mean(data.force**2, axis=0)), drives)
    asked = np.array([
        name.partition(".")[2] not in resting
        or not (name.partition(".")[0] in FRICTION_TERMS or is_friction_deviation(name)) for name in table.names
    ])  # fmt: skip
    rows = (data.matrix / noise[:, None]).reshape(-1, data.matrix.shape[2])
    told = classify_noisy_parameters(rows, table.names, sizes, asked)
    if not len(told.base):
        raise InputError(
            _ERROR_CONTEXT,
            "no parameter is identifiable from these logs: log a motion with larger forces",
        )
    return told


def compute_weights(error_variances: np.ndarray, sign_uncertainty: np.ndarray) -> np.ndarray:
    """Compute weights of force equations that decrease with the uncertainty of the friction sign.

    A weight is `sqrt(v / (v + v_sign u^2))` with both variances and the uncertainty u.

    Args:
        error_variances: (k, 2) error variance of each drive, and the variance added by an uncertain
            friction sign.
        sign_uncertainty: (n, k) uncertainty of the signs of dry friction, 0 (certain) to 1 (unknown).

    Returns:
        (n, k) weights, at most 1.
    """
    return np.sqrt(error_variances[:, 0] / (error_variances[:, 0] + error_variances[:, 1] * sign_uncertainty**2))


def estimate_error_variances(residual: np.ndarray, sign_uncertainty: np.ndarray, rounds: int = 0) -> np.ndarray:
    """Estimate each drive's error variance, and the variance added by an uncertain friction sign.

    The squared residual is modelled as `v + v_sign u^2` with the uncertainty u.

    Args:
        residual: (n, k) residuals of a first estimate.
        sign_uncertainty: (n, k) uncertainty of the signs of dry friction, 0 (certain) to 1 (unknown).
        rounds: rounds of Fisher scoring towards the maximum of the normal likelihood, in which each squared residual
            has a weight by its own variance.

    Returns:
        (k, 2) both variances of each drive, by non-negative least squares on squared residuals;
        1 and 0 if the first one would be 0.
    """
    out = np.tile([1.0, 0.0], (sign_uncertainty.shape[1], 1))
    for k in range(sign_uncertainty.shape[1]):
        square = residual[:, k] ** 2
        grows = np.column_stack([np.ones(len(square)), sign_uncertainty[:, k] ** 2])
        weight = np.full(square.size, square.size**-0.5)
        for _ in range(rounds + 1):
            calm, more = nnls(grows * weight[:, None], square * weight)[0]
            if calm <= 0.0:
                break
            out[k] = calm, more
            weight = calm / (grows @ out[k]) * square.size**-0.5
    return out


def _long_run_std(residual: np.ndarray) -> np.ndarray:
    """Return the standard deviations (k,) of white noise that is as strong at low frequencies as residuals (n, k).

    They follow from an autoregressive model of the residuals and are at least the residuals' own
    standard deviations.
    """
    follow = fit_autoregression(residual)
    fresh = residual.copy()
    for q, kept in enumerate(follow, start=1):
        fresh[q:] -= kept * residual[:-q]
    spread = np.std(fresh[len(follow) :], axis=0) / np.abs(1.0 - follow.sum(axis=0))
    return np.maximum(spread, np.std(residual, axis=0))


_FALSE_RETENTION_PROBABILITY = 0.05  # probability that any candidate without effect is kept
_REDUCTION_CONTEXT = "reduction"


@dataclass(frozen=True)
class ReductionStep:
    """One step of the simplification of a model by `reduce_parameters`.

    Attributes:
        action: `start`, `drop` or `merge`.
        names: parameters that are dropped or merged.
        statistic: for `drop` the estimate over its standard deviation; for `merge` the correlation of
            the two estimates; for `start` 0.
        parameters: number of remaining parameters.
        max_std_ratio: largest ratio of a standard deviation to that of the first step, among
            parameters that are not candidates.
        misfit: weighted squared residuals over the degrees of freedom.
    """

    action: str
    names: tuple[str, ...]
    statistic: float
    parameters: int
    max_std_ratio: float
    misfit: float


@dataclass(frozen=True)
class Reduction:
    """Result of the simplification of a model by `reduce_parameters`.

    Attributes:
        steps: the steps; the first is the full model.
        groups: for each of the p remaining parameters, the names of the original parameters that it
            represents.
        value: (p,) estimates of the remaining parameters.
        std: (p,) standard deviations.
    """

    steps: tuple[ReductionStep, ...]
    groups: tuple[tuple[str, ...], ...]
    value: np.ndarray
    std: np.ndarray


def reduce_parameters(
    matrix: np.ndarray, forces: np.ndarray, covariance: np.ndarray, names: Sequence[str],
    candidates: Sequence[Sequence[str]],
) -> Reduction:  # fmt: skip
    """Simplify a model: drop insignificant candidate parameters and merge those that do not differ.

    The least significant candidate is dropped first, until all remaining ones are significant. A
    candidate is significant if its estimate over its standard deviation reaches a threshold. If no
    candidate has an effect, at least one reaches it with a probability of 5 %. Within a group, the
    two candidates with the most correlated estimates get a common parameter, unless this increases
    the weighted squared residuals by more than the squared threshold. Candidates that are not
    significant after merging are dropped as well.

    Args:
        matrix: (n, k, p) regressor of independent parameters.
        forces: (n, k) forces [N] or [N m].
        covariance: (k, k) covariance of the force errors.
        names: names of the p parameters.
        candidates: groups of names within which parameters may be merged.

    Returns:
        The reduction with all steps.

    Raises:
        InputError: a candidate is not a parameter.

    Source: Abdellatif 2008, section 2.2.
    """
    kind = {name: k for k, group in enumerate(candidates) for name in group}
    if strange := [name for name in kind if name not in names]:
        raise InputError(_REDUCTION_CONTEXT, f"{strange[0]} is not a parameter; valid: {', '.join(names)}")
    significant = float(norm.isf(0.5 * _FALSE_RETENTION_PROBABILITY / max(len(kind), 1)))
    groups: list[tuple[str, ...]] = [(name,) for name in names]
    columns = {name: matrix[:, :, k] for k, name in enumerate(names)}
    whitened = np.linalg.inv(np.linalg.cholesky(covariance))
    steps: list[ReductionStep] = []
    first: dict[tuple[str, ...], float] = {}
    separate: set[tuple[tuple[str, ...], tuple[str, ...]]] = set()

    def fit_remaining_parameters():
        stacked = np.stack([sum(columns[n] for n in group) for group in groups], axis=2)
        # the covariance is known, so residuals do not scale it
        found = estimate_linear_parameters(stacked, forces, covariance, order=0)
        normal = np.einsum("nkp,kl,nlq->pq", stacked, whitened.T @ whitened, stacked, optimize=True)
        spread = np.linalg.inv(normal)
        error = found.residual @ whitened.T
        return found.value, spread, float(np.sum(error**2)), error.size - len(groups)

    def record_step(action, which, figure, spread, misfit, free):
        std = dict(zip(groups, np.sqrt(np.diag(spread)), strict=True))
        if not first:
            first.update(std)
        wide = max((s / first[g] for g, s in std.items() if g[0] not in kind), default=1.0)
        steps.append(ReductionStep(action, which, figure, len(groups), float(wide), misfit / free))

    def drop_insignificant(now):
        while True:
            ratio = np.abs(now[0]) / np.sqrt(np.diag(now[1]))
            open_ = [k for k, g in enumerate(groups) if g[0] in kind]
            weakest = min(open_, key=lambda k: ratio[k], default=None)
            if weakest is None or ratio[weakest] >= significant:
                return now
            gone, figure = groups.pop(weakest), float(ratio[weakest])
            now = fit_remaining_parameters()
            record_step("drop", gone, figure, *now[1:])

    def merge_correlated(now):
        while True:
            std = np.sqrt(np.diag(now[1]))
            pairs = [
                (abs(now[1][a, b]) / (std[a] * std[b]), a, b)
                for a, one in enumerate(groups)
                for b, other in enumerate(groups[:a])
                if one[0] in kind and kind[one[0]] == kind.get(other[0])
                and (one, other) not in separate
            ]  # fmt: skip
            if not pairs:
                return now
            figure, a, b = max(pairs)
            before, old = list(groups), now
            groups[b] = groups[b] + groups[a]
            merged = groups[b]
            groups.pop(a)
            now = fit_remaining_parameters()
            if now[2] - old[2] > significant**2:  # the two parameters differ significantly
                separate.add((before[a], before[b]))
                groups[:], now = before, old
                continue
            record_step("merge", merged, float(figure), *now[1:])

    now = fit_remaining_parameters()
    record_step("start", tuple(names), 0.0, *now[1:])
    now = drop_insignificant(merge_correlated(drop_insignificant(now)))
    return Reduction(tuple(steps), tuple(groups), now[0], np.sqrt(np.diag(now[1])))

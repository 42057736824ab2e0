"""Nonlinear least squares for calibration: scaled parameters, priors, identifiability, intervals.

Parameters are divided by their expected sizes (scales). `scipy.optimize.least_squares` or
Levenberg-Marquardt with truncated singular values performs the search. Unidentifiable parameters
are found first and keep their start values; each identifiable combination is represented by one of
its parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.stats

from hydrotele.core.errors import InputError
from hydrotele.identify.identifiability import (
    STATUS_COMBINATION,
    STATUS_FULL,
    Identifiability,
    classify_noisy_parameters,
    classify_parameters,
)

Residual = Callable[[np.ndarray], np.ndarray]
Jacobian = Callable[[np.ndarray], np.ndarray | scipy.sparse.spmatrix]
Selection = Literal["structure", "noise", "none"]

TRUNCATION_LEVELS = (0.05, 0.01, 0.002, 4e-4, 8e-5, 1.6e-5, 3.2e-6)
"""Truncation levels relative to the largest singular value: 5 % first, lowered on convergence."""

_ERROR_SOURCE = "calibration"
_COMPLEX_STEP = 1e-30  # times a scale; complex steps have no cancellation error
_CENTRAL_STEP = np.finfo(float).eps ** (1.0 / 3.0)  # balances rounding and the third derivative
_STEP_TOLERANCE = 1e-10  # of a step in units of the scales
_MAX_HALVINGS = 12
_MAX_NOISE_ROUNDS, _NOISE_TOLERANCE = (
    30,
    1e-4,
)  # maximum rounds, relative tolerance of the noise estimate
_MIN_RESIDUAL = 1e-100  # a residual that counts as zero
_NORMAL_QUANTILE_95 = 1.959964
_NOISE_NOT_CONVERGED = "noise and prior estimates do not converge: give sigma"


@dataclass(frozen=True)
class Prior:
    """Normal prior of p parameters.

    Attributes:
        mean: (p,) means in the parameters' units.
        std: (p,) standard deviations; infinite for parameters without prior.
    """

    mean: np.ndarray
    std: np.ndarray


@dataclass(frozen=True)
class ParameterFit:
    """Result of a fit of p parameters to m equations.

    Attributes:
        names: the p parameters.
        values: (p,) fitted values; unidentifiable parameters keep their start values.
        scales: (p,) expected sizes of the parameters.
        covariance: (p, p) covariance of the values; zero for held parameters.
        held: (p,) whether a parameter kept its start value.
        residual: (m,) unweighted residuals at the solution.
        noise: standard deviation of one equation's error, estimated from the residuals.
        chi: estimated over given standard deviation; near 1 if `sigma` is correct, 1 without it.
        degrees_of_freedom: degrees of freedom, equations minus (effective) parameters.
        rank: number of fitted directions.
        iterations: number of Jacobian evaluations.
        evaluations: number of residual evaluations, without those for finite differences.
        converged: whether the search met its tolerances.
        status: how the search ended and, if it failed, the remedy.
        identifiability: identifiability of the parameters from the data without the prior.
        jacobian: (m, p) unweighted Jacobian at the solution.
        interval_quantile: quantile that converts standard deviations to 95 % intervals.
    """

    names: tuple[str, ...]
    values: np.ndarray
    scales: np.ndarray
    covariance: np.ndarray
    held: np.ndarray
    residual: np.ndarray
    noise: float
    chi: float
    degrees_of_freedom: float
    rank: int
    iterations: int
    evaluations: int
    converged: bool
    status: str
    identifiability: Identifiability
    jacobian: np.ndarray
    interval_quantile: float

    @property
    def standard_deviations(self) -> np.ndarray:
        """(p,) standard deviations of the fitted values; infinite for held parameters."""
        return np.where(self.held, np.inf, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def intervals(self) -> np.ndarray:
        """(p, 2) 95 % intervals of the fitted values; infinite for held parameters.

        If only a combination of parameters is identifiable, one of them is fitted. Its interval
        takes the others, which are held, as exact.
        """
        reach = self.interval_quantile * self.standard_deviations
        return np.column_stack([self.values - reach, self.values + reach])

    @property
    def rms(self) -> float:
        """Root mean square of the unweighted residuals at the solution."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def value(self, name: str) -> float:
        """Return the fitted value of a parameter by name."""
        return float(self.values[self.names.index(name)])


def least_squares(
    residual: Residual, start: Sequence[float] | np.ndarray, names: Sequence[str],
    scales: Sequence[float] | np.ndarray, *, sigma: float | np.ndarray | None = None,
    prior: Prior | None = None, jac: Jacobian | Literal["cs"] | None = None,
    sparsity: np.ndarray | scipy.sparse.spmatrix | None = None,
    truncation: Sequence[float] | None = None, select: Selection = "structure",
    preferred: Sequence[str] = (), max_iterations: int = 100,
) -> ParameterFit:  # fmt: skip
    """Fit p parameters to m nonlinear equations `residual(x) = noise` by weighted least squares.

    Without `sigma`, all equations have the same standard deviation, estimated from the residuals.
    With a prior, this estimate is repeated until it is consistent with the weight of the prior.

    Args:
        residual: maps (p,) parameters to (m,) residuals; must accept complex values for `jac="cs"`.
        start: (p,) start values.
        names: the p parameters.
        scales: (p,) expected sizes, positive, for example 1 mm or 1 mrad.
        sigma: standard deviation of the equations' errors, one value or (m,); None to estimate it.
        prior: prior of the parameters, or None.
        jac: function of (p,) to (m, p), dense or sparse; `cs` for complex steps; None for central
            differences.
        sparsity: (m, p), nonzero where a residual depends on a parameter, for differences.
        truncation: decreasing thresholds, relative to the largest singular value, below which
            directions of a step are omitted; each is used until convergence (`TRUNCATION_LEVELS`). None
            for SciPy's Levenberg-Marquardt search.
        select: which parameters are held at their start values. `structure`: those that even
            noise-free equations do not determine, except those with a prior; of an identifiable
            combination one parameter is fitted and the others are held. `noise`: also those whose
            effect is below the noise. `none`: no parameter.
        preferred: parameters preferred as representatives of combinations.
        max_iterations: maximum number of iterations.

    Returns:
        The fit with covariance, intervals and identifiability of the parameters.

    Raises:
        InputError: shapes do not match, scales are not positive, a residual is not finite, there
            are too few equations, or no parameter is identifiable.

    >>> x = np.linspace(0.0, 1.0, 50)
    >>> y = 2.0 + 3.0 * x
    >>> fit = least_squares(lambda p: p[0] + p[1] * x + p[2] - y, [0.0, 0.0, 0.0],
    ...                     ["a", "b", "c"], [1.0, 1.0, 1.0], jac="cs")
    >>> fit.values.round(9).tolist(), fit.identifiability.format_combination(0)
    ([2.0, 3.0, 0.0], 'a + c')

    Source: Khoshzaban 1992, 3.37-3.43 (truncation, 5 % lowered on convergence); Khalil and Gautier
    1991 (identifiable parameters); Nocedal and Wright 2006, chapter 10.
    """
    problem = _Problem(residual, start, names, scales, jac, sparsity)
    begin = problem.start
    rows, matrix = problem.residual_and_jacobian(begin)
    known = sigma is not None
    weight = _equation_weights(sigma, len(rows))
    told = _classify_structure(matrix * weight[:, None], problem, preferred)
    free = np.ones(len(begin), bool) if select == "none" else _representative_mask(told)
    if prior is not None:
        free |= np.isfinite(prior.std)
    _check_equation_count(len(rows), int(free.sum()), prior is not None, known)
    noise, searched = 1.0, _SearchState(begin)
    while True:
        search = _ScaledProblem(problem, weight / noise, prior, free)
        searched = search.solve(searched, truncation, max_iterations)
        left, end = problem.residual_and_jacobian(searched.x)
        freedom = len(left) - search.effective_parameters(end)
        chi = float(np.sqrt(np.sum((left * weight) ** 2) / max(freedom, 1e-12)))
        before, noise = noise, noise if known else max(chi, _MIN_RESIDUAL)
        weak = np.zeros(len(begin), bool)
        if select == "noise" and chi > _MIN_RESIDUAL:
            told = _classify_in_noise(end * (weight / noise)[:, None], problem, told)
            weak = free & ~_representative_mask(told)
        if weak.any():
            free = free & ~weak
            searched = replace(searched, x=np.where(weak, begin, searched.x))
        elif known or prior is None or abs(noise - before) < _NOISE_TOLERANCE * noise:
            break
        if searched.rounds >= _MAX_NOISE_ROUNDS:
            searched = replace(searched, status=_NOISE_NOT_CONVERGED, converged=False)
            break
    covariance, rank = _ScaledProblem(problem, weight / noise, prior, free).covariance(end, truncation)
    return ParameterFit(
        names=tuple(names), values=searched.x, scales=problem.scales, covariance=covariance,
        held=~free, residual=left, noise=chi * float(np.mean(1.0 / weight)),
        chi=chi if known else 1.0, degrees_of_freedom=float(freedom), rank=rank,
        iterations=searched.iterations, evaluations=searched.evaluations,
        converged=searched.converged, status=searched.status, identifiability=told, jacobian=end,
        interval_quantile=_NORMAL_QUANTILE_95 if known else float(scipy.stats.t.ppf(0.975, max(freedom, 1.0))),
    )  # fmt: skip


def classify_scaled_parameters(
    jacobian: np.ndarray, names: Sequence[str], scales: Sequence[float] | np.ndarray, *,
    sigma: float | np.ndarray | None = None, preferred: Sequence[str] = (),
) -> Identifiability:  # fmt: skip
    """Classify parameters: identifiable alone, only in a combination, or not at all.

    Without noise, a direction is unidentifiable if its singular value is below 1e-8 of the largest
    one, with columns of length 1; 1e-8 is about the square root of the rounding error. With noise,
    a parameter is identifiable if its standard deviation is below half of its expected size.
    Otherwise the measurement adds little to what was known before.

    Args:
        jacobian: (m, p) derivatives of the equations.
        names: the p parameters.
        scales: (p,) expected sizes of the parameters.
        sigma: standard deviation of the equations' errors, one value or (m,); None for no noise.
        preferred: parameters preferred as representatives of combinations.

    Returns:
        The classification; `list_identifiability` converts it to text.
    """
    matrix = np.asarray(jacobian, float)
    sizes = np.asarray(scales, float)
    exact = classify_parameters(matrix * sizes, names, ["1"] * len(sizes), preferred)
    exact = _remove_scales(exact, sizes)
    if sigma is None:
        return exact
    weighted = matrix / np.broadcast_to(np.asarray(sigma, float), matrix.shape[:1])[:, None]
    return classify_noisy_parameters(weighted, names, sizes, _representative_mask(exact))


def list_identifiability(identifiability: Identifiability) -> dict[str, list[str]]:
    """List the parameters by identifiability: identifiable alone, in combinations, or not at all.

    Args:
        identifiability: identifiability of the parameters.

    Returns:
        `identifiable`: parameters identifiable alone. `combinations`: identifiable combinations as
        text. `not_identifiable`: unidentifiable parameters.

    >>> matrix = np.array([[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 2.0, 1.0, 0.0]])
    >>> list_identifiability(classify_scaled_parameters(matrix, ["a", "b", "c", "d"], [1.0] * 4))
    {'identifiable': ['c'], 'combinations': ['a + 2 b'], 'not_identifiable': ['d']}
    """
    status = dict(zip(identifiability.names, identifiability.status, strict=True))
    return {
        "identifiable": [n for n in identifiability.names if status[n] == STATUS_FULL],
        "combinations": [
            identifiability.format_combination(row) for row, base in enumerate(identifiability.base)
            if status[identifiability.names[base]] == STATUS_COMBINATION
        ],
        "not_identifiable": [n for n in identifiability.names if status[n] not in (STATUS_FULL, STATUS_COMBINATION)],
    }  # fmt: skip


@dataclass(frozen=True)
class CombinationEstimate:
    """Estimate of one identifiable parameter or combination of parameters.

    Attributes:
        text: the combination as text, such as `a + 2 b`.
        value: estimated value.
        std: its standard deviation.
        low: lower bound of the 95 % interval.
        high: upper bound of the 95 % interval.
    """

    text: str
    value: float
    std: float
    low: float
    high: float


def estimate_combinations(fit: ParameterFit) -> tuple[CombinationEstimate, ...]:
    """Compute values and 95 % intervals of all identifiable parameters and combinations of a fit.

    A parameter that is identifiable only in a combination has no separate interval: its part of the
    combination depends on the prior, or on the held parameters.

    Args:
        fit: the fit.

    Returns:
        One combination per identifiable direction.
    """
    order = [fit.names.index(name) for name in fit.identifiability.names]
    values, covariance = fit.values[order], fit.covariance[np.ix_(order, order)]
    made = []
    for row, weights in enumerate(fit.identifiability.combination):
        value, std = float(weights @ values), float(np.sqrt(weights @ covariance @ weights))
        reach = fit.interval_quantile * std
        made.append(
            CombinationEstimate(fit.identifiability.format_combination(row), value, std, value - reach, value + reach)
        )
    return tuple(made)


@dataclass(frozen=True)
class _SearchState:
    """Parameters `x` (p,) at the end of a search, with counters of its steps and its outcome."""

    x: np.ndarray
    iterations: int = 0
    evaluations: int = 0
    converged: bool = True
    status: str = ""
    rounds: int = 0


class _Problem:
    """Residuals (m,) of a least-squares problem and their Jacobian (m, p) by all p parameters.

    The constructor raises InputError if names, start values and scales do not match.
    """

    def __init__(self, residual, start, names, scales, jac, sparsity) -> None:
        self.start, self.scales = np.array(start, float), np.array(scales, float)
        self.names, self.residual, self.jac = tuple(names), residual, jac
        self.hits = None if sparsity is None else _to_dense(sparsity) != 0.0
        p = len(self.names)
        if self.start.shape != (p,) or self.scales.shape != (p,):
            raise InputError(
                _ERROR_SOURCE,
                f"{p} names, start {self.start.shape} and scales {self.scales.shape} must match",
            )
        bad = [n for n, s in zip(names, self.scales, strict=True) if not 0.0 < s < np.inf]
        if bad:
            raise InputError(_ERROR_SOURCE, f"the scales of {', '.join(bad)} must be positive and finite")
        self.groups = np.arange(p) if self.hits is None else _group_columns(self.hits)

    def residual_vector(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals (m,) at parameters x (p,); raise InputError if one is not finite.

        Residuals of complex x (for complex-step derivatives) are returned without checks.
        """
        rows = np.asarray(self.residual(x))
        if np.iscomplexobj(x):
            return rows
        rows = np.asarray(rows, float)
        if rows.ndim != 1:
            raise InputError(_ERROR_SOURCE, f"the residual must be (m,), got {rows.shape}")
        if not np.isfinite(rows).all():
            where = int(np.flatnonzero(~np.isfinite(rows))[0])
            raise InputError(_ERROR_SOURCE, f"equation {where + 1} of {len(rows)} is not finite")
        return rows

    def residual_and_jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals (m,) and the Jacobian (m, p) at parameters x (p,)."""
        return self.residual_vector(x), self.jacobian(x)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the dense Jacobian (m, p) of the residuals at parameters x (p,).

        It is computed by the caller's function if there is one, otherwise by complex steps (`cs`)
        or central differences.
        """
        if callable(self.jac):
            return _to_dense(self.jac(x))
        if self.jac == "cs":
            columns = []
            for k, size in enumerate(self.scales):
                step = x.astype(complex)
                step[k] += 1j * _COMPLEX_STEP * size
                columns.append(np.imag(self.residual_vector(step)) / (_COMPLEX_STEP * size))
            return np.column_stack(columns)
        return self._central_differences(x)

    def _central_differences(self, x: np.ndarray) -> np.ndarray:
        """Return the Jacobian (m, p) by central differences.

        Parameters that affect no common equation are changed at the same time, which saves evaluations.
        """
        steps = _CENTRAL_STEP * np.maximum(np.abs(x), self.scales)
        columns: list[np.ndarray] = [np.empty(0)] * len(x)
        for group in range(self.groups.max() + 1):
            moved = np.where(self.groups == group, steps, 0.0)
            change = self.residual_vector(x + moved) - self.residual_vector(x - moved)
            for k in np.flatnonzero(self.groups == group):
                own = change if self.hits is None else np.where(self.hits[:, k], change, 0.0)
                columns[k] = own / (2.0 * steps[k])
        return np.column_stack(columns)


def _to_dense(matrix) -> np.ndarray:
    return np.asarray(matrix.toarray() if scipy.sparse.issparse(matrix) else matrix, float)


def _group_columns(sparsity: np.ndarray) -> np.ndarray:
    """Assign the p columns of a mask (m, p) to groups; return the group number of each column (p,).

    No two columns of a group are true in the same row.
    """
    groups: list[int] = []
    taken: list[np.ndarray] = []
    for column in sparsity.T:
        group = next((g for g, used in enumerate(taken) if not (used & column).any()), len(taken))
        if group == len(taken):
            taken.append(np.zeros(len(column), bool))
        taken[group] |= column
        groups.append(group)
    return np.array(groups)


class _ScaledProblem:
    """A least-squares problem whose unknowns are the free parameters, divided by their scales.

    Equations are weighted. Each free parameter with a prior adds one row to the residuals.
    """

    def __init__(self, problem: _Problem, weight, prior: Prior | None, free) -> None:
        self.problem, self.weight, self.free = problem, weight, np.flatnonzero(free)
        self.scales = problem.scales[self.free]
        self.prior_weight, self.mean = np.zeros(len(self.free)), np.zeros(len(self.free))
        if prior is not None:
            std, mean = np.asarray(prior.std, float), np.asarray(prior.mean, float)
            if not (std > 0.0).all():
                raise InputError(_ERROR_SOURCE, "standard deviations of the prior must be positive")
            self.prior_weight, self.mean = self.scales / std[self.free], mean[self.free]
        self.has_prior = self.prior_weight > 0.0

    def add_scaled_step(self, base: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return parameters (p,): `base` plus steps `u` of the free parameters, in units of their scales."""
        x = base.copy()
        x[self.free] += u * self.scales
        return x

    def weighted_residual(self, x: np.ndarray) -> np.ndarray:
        """Return the weighted residuals of the equations at parameters x (p,), followed by those of the priors.

        The residual of a prior is the parameter's distance from its mean in standard deviations.
        """
        away = self.prior_weight * (x[self.free] - self.mean) / self.scales
        return np.concatenate([self.problem.residual_vector(x) * self.weight, away[self.has_prior]])

    def weighted_jacobian(self, matrix: np.ndarray) -> np.ndarray:
        """Return the derivatives of `weighted_residual` by the free parameters over their scales.

        `matrix` (m, p) is the Jacobian of the unweighted equations by all parameters.
        """
        weighted = matrix[:, self.free] * self.weight[:, None] * self.scales
        return np.vstack([weighted, np.diag(self.prior_weight)[self.has_prior]])

    def effective_parameters(self, matrix: np.ndarray) -> float:
        """Return the effective number of parameters that the equations determine rather than the prior.

        It is the trace of the hat matrix (projection on the Jacobian's columns) over the rows of
        the equations, whose Jacobian is `matrix` (m, p).
        """
        whole = self.weighted_jacobian(matrix)
        q = np.linalg.qr(whole)[0][: len(matrix)]
        return float(np.sum(q**2))

    def solve(self, begin: _SearchState, truncation: Sequence[float] | None, max_steps: int) -> _SearchState:
        """Search for the minimum from the end `begin` of a previous search, and return the end of this one.

        With `truncation`, thresholds relative to the largest singular value, steps omit directions
        with smaller singular values. Without, SciPy's Levenberg-Marquardt search is used.
        """
        found = (
            _minimize_truncated(self, begin, truncation, max_steps)
            if truncation
            else _minimize_with_scipy(self, begin, max_steps)
        )
        return replace(found, rounds=begin.rounds + 1)

    def covariance(self, matrix: np.ndarray, truncation) -> tuple[np.ndarray, int]:
        """Return the covariance (p, p) of the parameters, zero for held ones, and the number of fitted directions.

        `matrix` (m, p) is the Jacobian of the equations. Directions with singular values below the
        last threshold of `truncation` are left out.
        """
        whole = self.weighted_jacobian(matrix)
        _, s, v = np.linalg.svd(whole, full_matrices=False)
        cut = truncation[-1] if truncation else len(self.free) * np.finfo(float).eps
        kept = s > cut * s[0]
        inverse = (v[kept].T / s[kept] ** 2) @ v[kept] * np.outer(self.scales, self.scales)
        covariance = np.zeros((len(self.problem.start),) * 2)
        covariance[np.ix_(self.free, self.free)] = inverse
        return covariance, int(kept.sum())


def _minimize_with_scipy(search: _ScaledProblem, begin: _SearchState, max_steps: int) -> _SearchState:
    """Run SciPy's Levenberg-Marquardt search from `begin`, and return its end.

    It is limited to `10 max_steps` evaluations of the residuals.
    """
    base, problem = begin.x, search.problem
    found = scipy.optimize.least_squares(
        lambda u: search.weighted_residual(search.add_scaled_step(base, u)), np.zeros(len(search.free)),
        jac=lambda u: search.weighted_jacobian(problem.jacobian(search.add_scaled_step(base, u))),  # type: ignore
        method="lm", ftol=1e-14, xtol=1e-12, gtol=1e-14, max_nfev=10 * max_steps,
    )  # fmt: skip
    good = found.status > 0
    said = "converged" if good else f"not converged after {max_steps} steps: increase max_iterations"
    return _SearchState(
        search.add_scaled_step(base, found.x), begin.iterations + int(found.njev),
        begin.evaluations + int(found.nfev), good, said,
    )  # fmt: skip


def _minimize_truncated(
    search: _ScaledProblem, begin: _SearchState, thresholds: Sequence[float], max_steps: int
) -> _SearchState:
    """Minimise by Gauss-Newton steps that omit directions with small singular values.

    The threshold of a small singular value starts high and is lowered after each convergence.

    A step that does not reduce the sum of squares is halved, up to 12 times. If halving fails, or a
    step is below 1e-10 of the scales, the search continues with the next threshold.

    Args:
        search: the scaled problem.
        begin: end of a previous search, the start of this one.
        thresholds: decreasing thresholds, relative to the largest singular value.
        max_steps: maximum number of steps per threshold.

    Returns:
        The end of this search.
    """
    x, problem = begin.x, search.problem
    rows = search.weighted_residual(x)
    iterations, evaluations, good = begin.iterations, begin.evaluations + 1, True
    for share in thresholds:
        for _ in range(max_steps):
            matrix = search.weighted_jacobian(problem.jacobian(x))
            iterations += 1
            u, s, v = np.linalg.svd(matrix, full_matrices=False)
            kept = s > share * s[0]
            step = -v[kept].T @ ((u.T @ rows)[kept] / s[kept])
            for _ in range(_MAX_HALVINGS):
                new = search.add_scaled_step(x, step)
                tried = search.weighted_residual(new)
                evaluations += 1
                if tried @ tried < rows @ rows:
                    break
                step = 0.5 * step
            else:
                break
            x, rows = new, tried
            if np.max(np.abs(step)) < _STEP_TOLERANCE:
                break
        else:
            good = False
    said = "converged" if good else f"not converged after {max_steps} steps: increase max_iterations"
    return _SearchState(x, iterations, evaluations, good, said)


def _equation_weights(sigma: float | np.ndarray | None, m: int) -> np.ndarray:
    sizes = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, float), (m,))
    if not (np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise InputError(_ERROR_SOURCE, "sigma must be positive")
    return 1.0 / sizes


def _representative_mask(identifiability: Identifiability) -> np.ndarray:
    """Return a mask (p,) of the parameters that are estimated, one for each identifiable combination."""
    return np.isin(np.arange(len(identifiability.names)), identifiability.base)


def _classify_structure(matrix: np.ndarray, problem: _Problem, first: Sequence[str]) -> Identifiability:
    told = classify_scaled_parameters(matrix, problem.names, problem.scales, preferred=first)
    if not len(told.base):
        raise InputError(_ERROR_SOURCE, f"none of {', '.join(problem.names)} is identifiable: vary the poses")
    return told


def _classify_in_noise(matrix: np.ndarray, problem: _Problem, identifiability: Identifiability) -> Identifiability:
    found = classify_noisy_parameters(matrix, problem.names, problem.scales, _representative_mask(identifiability))
    if not len(found.base):
        raise InputError(
            _ERROR_SOURCE, f"the effects of {', '.join(problem.names)} are all below the noise: record"
            " more poses that differ more"
        )  # fmt: skip
    return found


def _remove_scales(identifiability: Identifiability, sizes: np.ndarray) -> Identifiability:
    """Convert combinations of parameters over their `sizes` to combinations of the unscaled parameters."""
    combination = identifiability.combination * sizes[identifiability.base][:, None] / sizes
    return Identifiability(
        identifiability.names,
        identifiability.status,
        identifiability.base,
        combination,
        identifiability.condition,
        identifiability.singular_value_gap,
    )


def _check_equation_count(equations: int, unknowns: int, prior: bool, known: bool) -> None:
    needed = 1 if prior else unknowns + (0 if known else 1)
    if equations < needed:
        raise InputError(
            _ERROR_SOURCE,
            f"{equations} equations are too few for {unknowns} parameters: record more poses",
        )

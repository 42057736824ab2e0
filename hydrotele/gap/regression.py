"""Sparse Bayesian regression of prediction errors on groups of columns, with dense nuisance parameters.

The whitened prediction errors y (E,) of a model are explained by groups of columns,

    y = X_1 b_1 + ... + X_G b_G + N c + noise,    b_g ~ N(0, I) if active, else 0,    c_k ~ N(0, scale_k^2),

with unit white noise. N holds the sensitivities to the uncertain parameters of the machine file. They are
marginalised, so that the errors have the covariance `I + N diag(scale^2) N'`. A group is compared with no group by its
Bayes factor, which is exact for this model. `sum_of_single_effects` approximates the posterior of several groups.

The same errors and columns under other noise levels follow from the linearised filter, without another simulation
(`reweight_columns`).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import lsq_linear

from hydrotele.core.compiled import compiled

OWN_SCALE = 10.0
"""Prior standard deviations within which the parameters of accepted effects may move again."""
_CONVERGED = 1.0e-3  # prior standard deviations; change of all coefficients that ends the iteration


class LevelScale(NamedTuple):
    """Sizes of what stands in for missing effects, relative to the estimated ones, at which effects are compared.

    Attributes:
        residual: of the residual inputs.
        parameters: of the uncertain parameters, if they are part of the noise levels.
    """

    residual: float = 1.0
    parameters: float = 1.0


RESIDUAL_SCALES = (1.0, 0.3, 0.1, 0.03)
"""Sizes of the residual inputs, relative to the estimated ones, at which effects are compared."""


class Marginal(NamedTuple):
    """Normal equations of all groups with the nuisance parameters marginalised.

    Attributes:
        loss: -2 log density of the errors without any group, up to a constant.
        right: (P,) X' W y, with W the inverse covariance of the errors.
        blocks: per group the (p, p) diagonal block of X' W X.
    """

    loss: float
    right: np.ndarray
    blocks: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class NormalEquations:
    """Products of the columns, from which every marginal follows without the columns.

    Attributes:
        edges: (G + 1,) first column of each group, and their number P.
        squares: y'y.
        right: (P,) X'y.
        blocks: per group (p, p) X'X.
        nuisance: (K, K) N'N.
        nuisance_right: (K,) N'y.
        cross: (K, P) N'X.
    """

    edges: np.ndarray
    squares: float
    right: np.ndarray
    blocks: tuple[np.ndarray, ...]
    nuisance: np.ndarray
    nuisance_right: np.ndarray
    cross: np.ndarray

    @classmethod
    def of(cls, errors: np.ndarray, groups: Sequence[np.ndarray], nuisance: np.ndarray) -> "NormalEquations":
        """Form the products.

        Args:
            errors: (E,) y.
            groups: G arrays (E, p) of columns.
            nuisance: (E, K) N; K may be 0.

        Returns:
            The products.
        """
        edges = np.cumsum([0, *(g.shape[1] for g in groups)])
        right = np.concatenate([g.T @ errors for g in groups]) if groups else np.zeros(0)
        cross = np.hstack([nuisance.T @ g for g in groups]) if groups else np.zeros((nuisance.shape[1], 0))
        return cls(
            edges, float(errors @ errors), right, tuple(g.T @ g for g in groups),
            nuisance.T @ nuisance, nuisance.T @ errors, cross,
        )  # fmt: skip

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        """Add the products of other rows, such as those of another run."""
        return NormalEquations(
            self.edges, self.squares + other.squares, self.right + other.right,
            tuple(a + b for a, b in zip(self.blocks, other.blocks, strict=True)),
            self.nuisance + other.nuisance, self.nuisance_right + other.nuisance_right,
            self.cross + other.cross,
        )  # fmt: skip

    def marginalise(self, scales: np.ndarray) -> Marginal:
        """Marginalise the nuisance parameters.

        Args:
            scales: (K,) their prior standard deviations, in units of their columns; 0 removes one.

        Returns:
            The normal equations of the groups, by the Woodbury identity.
        """
        factor = cho_factor(np.eye(len(scales)) + scales[:, None] * self.nuisance * scales, lower=True)
        cross = scales[:, None] * self.cross
        taken = cho_solve(factor, scales * self.nuisance_right)
        removed = cho_solve(factor, cross)
        log_det = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
        blocks = tuple(
            block - cross[:, a:b].T @ removed[:, a:b]
            for block, a, b in zip(self.blocks, self.edges[:-1], self.edges[1:], strict=True)
        )
        loss = self.squares - float((scales * self.nuisance_right) @ taken) + log_det
        return Marginal(loss, self.right - cross.T @ taken, blocks)


def sum_equations(terms: Sequence[NormalEquations]) -> NormalEquations:
    """Add the products of several runs."""
    total = terms[0]
    for other in terms[1:]:
        total = total + other
    return total


def split_columns(by_run: Sequence[NormalEquations], single: Sequence[int], nuisance: Sequence[int]) -> NormalEquations:
    """Give single columns a separate coefficient in every run.

    Args:
        by_run: the products of R runs with the same columns.
        single: indices of groups with one column each.
        nuisance: indices of nuisance columns, which stay nuisance as well.

    Returns:
        The products of all runs together; the groups are those of `single`, then of `nuisance`, each with R columns.
    """
    total = sum_equations(by_run)
    right = [[t.right[t.edges[g]] for t in by_run] for g in single]
    right += [[t.nuisance_right[k] for t in by_run] for k in nuisance]
    blocks = [np.diag([t.blocks[g][0, 0] for t in by_run]) for g in single]
    blocks += [np.diag([t.nuisance[k, k] for t in by_run]) for k in nuisance]
    cross = [np.column_stack([t.cross[:, t.edges[g]] for t in by_run]) for g in single]
    cross += [np.column_stack([t.nuisance[:, k] for t in by_run]) for k in nuisance]
    edges = len(by_run) * np.arange(len(blocks) + 1)
    return dataclasses.replace(
        total, edges=edges, right=np.ravel(right), blocks=tuple(blocks),
        cross=np.hstack(cross) if cross else total.cross[:, :0],
    )  # fmt: skip


def compare_groups(
    edges: np.ndarray, right: np.ndarray, blocks: Sequence[np.ndarray], bounds: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Compare every group alone with no group.

    Args:
        edges: (G + 1,) first column of each group.
        right: (P,) X' W y.
        blocks: per group (p, p) X' W X.
        bounds: per group (p, 2) of its coefficients; none by default.

    Returns:
        (G,) twice the log Bayes factors, and the most likely coefficients (p,). Within bounds the factor is that of
        the posterior's density there, so that an effect of the wrong sign explains nothing.

    >>> factors, means = compare_groups(np.array([0, 1]), np.array([30.0]), [np.array([[9.0]])])
    >>> float(factors[0].round(3)), means[0]
    (87.697, array([3.]))
    """
    factors, means = np.empty(len(blocks)), []
    for g, block in enumerate(blocks):
        own = right[edges[g] : edges[g + 1]]
        factor = cho_factor(block + np.eye(len(block)), lower=True)
        mean = cho_solve(factor, own)
        if bounds is not None and np.any((mean < bounds[g][:, 0]) | (mean > bounds[g][:, 1])):
            root = np.tril(factor[0])
            low, high = bounds[g].T
            # bounds that hold 0, with some room: the solver needs low < high
            room = np.finfo(float).eps + np.zeros(len(mean))
            mean = lsq_linear(
                root.T, solve_triangular(root, own, lower=True), (np.minimum(low, -room), np.maximum(high, room)),
                method="bvls",
            ).x  # fmt: skip
            mean = np.clip(mean, low, high)
        gain = 2.0 * own @ mean - np.sum((np.tril(factor[0]).T @ mean) ** 2)
        factors[g] = gain - 2.0 * np.sum(np.log(np.diag(factor[0])))
        means.append(mean)
    return factors, means


def sum_of_single_effects(
    gram: np.ndarray, right: np.ndarray, edges: np.ndarray, count: int, rounds: int = 100
) -> tuple[np.ndarray, np.ndarray]:
    """Approximate the posterior of several active groups by a sum of single effects.

    Each of `count` components is one active group or none; the components are updated in turn, with the
    coefficients of the others subtracted, until they no longer change.

    Args:
        gram: (P, P) X' W X.
        right: (P,) X' W y.
        edges: (G + 1,) first column of each group.
        count: number of components.
        rounds: largest number of rounds.

    Returns:
        (count, G + 1) probabilities of the groups and, last, of none; they add up to 1 in each component.
        (count, P) posterior means of the coefficients.

    Source: Wang, Sarkar, Carbonetto and Stephens 2020, J. R. Stat. Soc. B 82(5), algorithm 1, with groups.
    """
    blocks = [gram[a:b, a:b] for a, b in zip(edges[:-1], edges[1:], strict=True)]
    means = np.zeros((count, len(right)))
    chances = np.zeros((count, len(blocks) + 1))
    for _ in range(rounds):
        before = means.copy()
        for c in range(count):
            others = means.sum(axis=0) - means[c]
            factors, single = compare_groups(edges, right - gram @ others, blocks)
            odds = 0.5 * np.append(factors - 2.0 * np.log(len(blocks)), 0.0)
            weight = np.exp(odds - odds.max())
            chances[c] = weight / weight.sum()
            means[c] = np.concatenate([p * m for p, m in zip(chances[c], single, strict=False)])
        if np.abs(means - before).max() < _CONVERGED:
            break
    return chances, means


def hat_weights(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weights (n, k) of hat functions at increasing points; each row adds up to 1.

    >>> hat_weights(np.array([0.25, 2.0]), np.array([0.0, 1.0]))
    array([[0.75, 0.25],
           [0.  , 1.  ]])
    """
    return np.stack([np.interp(values, points, row) for row in np.eye(len(points))], axis=1)


@compiled
def _reweight(slope, flow, missing, old_gain, new_gain, columns):
    rows, channels, size = slope.shape
    count = columns.shape[2]
    moved, next_ = np.zeros((size, count)), np.zeros((size, count))
    delta, changed = np.zeros((size, count)), np.zeros(count)
    for row in range(rows):
        delta[:] = 0.0
        for c in range(channels):
            if missing[row, c]:
                continue
            for p in range(count):
                changed[p] = columns[row, c, p]
            for s in range(size):
                h = slope[row, c, s]
                if h != 0.0:
                    for p in range(count):
                        changed[p] -= h * (moved[s, p] + delta[s, p])
            for s in range(size):
                old, new = old_gain[row, c, s], new_gain[row, c, s]
                if old != 0.0 or new != 0.0:
                    for p in range(count):
                        delta[s, p] += new * changed[p] - old * columns[row, c, p]
            for p in range(count):
                columns[row, c, p] = changed[p]
        for s in range(size):
            for p in range(count):
                moved[s, p] += delta[s, p]
        if row == rows - 1:
            break
        next_[:] = 0.0
        for s in range(size):
            for r in range(size):
                f = flow[row, s, r]
                if f != 0.0:
                    for p in range(count):
                        next_[r, p] += f * moved[s, p]
        moved[:] = next_


def reweight_columns(
    slope: np.ndarray, flow: np.ndarray, missing: np.ndarray, old_gain: np.ndarray, new_gain: np.ndarray,
    columns: np.ndarray,
) -> None:  # fmt: skip
    """Convert changes of the prediction errors from one filter's gains to another's, in place.

    To first order, the difference d of the two filters' states follows from the errors alone:
    `e2 = e1 - H d`, `d <- F (d + K2 e2 - K1 e1)`.

    Args:
        slope: (n, c, nz) H, d reading / d state.
        flow: (n, nz, nz) F, d next state / d state, the latter along the first index.
        missing: (n, c) whether a reading is missing.
        old_gain: (n, c, nz) K1, of the filter that the changes were computed with.
        new_gain: (n, c, nz) K2.
        columns: (n, c, p) changes of the prediction errors, not whitened [channel's unit]; overwritten.

    Source: the innovations form, Anderson and Moore 1979, Optimal Filtering, chapter 9, readings one by one.
    """
    _reweight(slope, flow, missing, old_gain, new_gain, columns)

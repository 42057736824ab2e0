"""Linear algebra of the sparse regression against brute force on small problems."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hydrotele.gap.regression import (
    NormalEquations,
    compare_groups,
    reweight_columns,
    sum_of_single_effects,
)

_ROWS, _SIZES = 60, (1, 2, 1)


@pytest.fixture
def problem():
    rng = np.random.default_rng(4)
    groups = [rng.normal(size=(_ROWS, p)) for p in _SIZES]
    nuisance = rng.normal(size=(_ROWS, 3))
    errors = groups[1] @ [0.8, -0.5] + nuisance @ [0.3, 0.0, -0.2] + rng.normal(size=_ROWS)
    return errors, groups, nuisance


def _log_density(errors, *parts):
    """Log density with the columns of every part integrated out as normal coefficients."""
    covariance = np.eye(len(errors)) + sum(part @ part.T for part in parts)
    return multivariate_normal(np.zeros(len(errors)), covariance).logpdf(errors)


@pytest.mark.parametrize("scale", [0.0, 0.1, 1.0, 3.0])
def test_bayes_factors_are_those_of_the_dense_gaussian(problem, scale):
    errors, groups, nuisance = problem
    terms = NormalEquations.of(errors, groups, nuisance)
    scales = np.array([scale, 2.0 * scale, scale])
    marginal = terms.marginalise(scales)
    factors, _ = compare_groups(terms.edges, marginal.right, marginal.blocks)
    own = nuisance * scales
    none = _log_density(errors, own)
    for group, factor in zip(groups, factors, strict=True):
        # rounding of a 60 x 60 determinant
        assert factor == pytest.approx(2.0 * (_log_density(errors, own, group) - none), abs=1e-8)
    constant = _ROWS * np.log(2.0 * np.pi)
    assert marginal.loss == pytest.approx(-2.0 * none - constant, abs=1e-8)


def test_rows_of_two_runs_add_up(problem):
    errors, groups, nuisance = problem
    half = _ROWS // 2
    parts = [
        NormalEquations.of(errors[rows], [g[rows] for g in groups], nuisance[rows])
        for rows in (slice(0, half), slice(half, None))
    ]
    whole = NormalEquations.of(errors, groups, nuisance).marginalise(np.ones(3))
    added = (parts[0] + parts[1]).marginalise(np.ones(3))
    assert added.loss == pytest.approx(whole.loss, rel=1e-12)  # rounding
    np.testing.assert_allclose(added.right, whole.right, rtol=1e-9)


def test_single_effects_match_the_enumerated_posterior():
    """Two active groups out of four: inclusion probabilities of all subsets, enumerated."""
    rng = np.random.default_rng(8)
    groups = [rng.normal(size=(200, 1)) for _ in range(4)]
    groups[1] = groups[0] + 0.7 * rng.normal(size=(200, 1))  # hard to tell from the first
    errors = 0.45 * groups[0][:, 0] + 0.3 * groups[3][:, 0] + rng.normal(size=200)
    X = np.hstack(groups)
    chances, means = sum_of_single_effects(X.T @ X, X.T @ errors, np.arange(5), 3)
    np.testing.assert_allclose(chances.sum(axis=1), 1.0, rtol=1e-12)  # rounding
    included = 1.0 - np.prod(1.0 - chances[:, :4], axis=0)
    odds, total = np.zeros(4), 0.0
    prior = 1.0 / 5.0  # of a group; "none" of a component has the same weight as all four together
    for subset in range(16):
        active = [k for k in range(4) if subset >> k & 1]
        weight = np.exp(_log_density(errors, *(groups[k] for k in active)) - _log_density(errors))
        weight *= (prior / (1.0 - prior)) ** len(active)
        total += weight
        odds[active] += weight
    # The approximation counts exclusive components instead of independent groups.
    np.testing.assert_allclose(included, odds / total, atol=0.15)
    assert means.sum(axis=0)[3] == pytest.approx(0.3, abs=0.15)  # two standard errors of 200 rows


def _filter(flow, slope, gain, readings, push):
    """Innovations of a linear filter with given gains; readings one by one."""
    state, found = np.zeros(flow.shape[1]), np.zeros(readings.shape)
    for row in range(len(readings)):
        for c in range(readings.shape[1]):
            if np.isnan(readings[row, c]):
                continue
            found[row, c] = readings[row, c] - slope[row, c] @ state
            state = state + gain[row, c] * found[row, c]
        state = flow[row].T @ state + push[row]
    return found


def test_columns_under_other_gains_are_those_of_the_other_filter():
    rng = np.random.default_rng(1)
    rows, channels, size = 40, 2, 3
    flow = 0.9 * np.tile(np.eye(size), (rows, 1, 1)) + 0.05 * rng.normal(size=(rows, size, size))
    slope = rng.normal(size=(rows, channels, size))
    gains = [0.1 * rng.normal(size=(rows, channels, size)) for _ in range(2)]
    readings = rng.normal(size=(rows, channels))
    readings[5, 1] = np.nan
    push = rng.normal(size=(rows, size))
    zero = np.zeros_like(push)
    changes = [_filter(flow, slope, g, readings, push) - _filter(flow, slope, g, readings, zero) for g in gains]
    columns = changes[0][:, :, None].copy()
    reweight_columns(slope, flow, np.isnan(readings), gains[0], gains[1], columns)
    np.testing.assert_allclose(columns[:, :, 0], changes[1], atol=1e-12)  # rounding

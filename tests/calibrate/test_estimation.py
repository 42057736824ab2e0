"""Least squares for calibration: planted truth, intervals, identifiable sets, priors."""

import numpy as np
import pytest

from hydrotele.calibrate.estimation import (
    TRUNCATION_LEVELS,
    Prior,
    classify_scaled_parameters,
    least_squares,
    list_identifiability,
)
from hydrotele.core.errors import InputError

X = np.linspace(0.0, 1.0, 40)
TRUTH = np.array([2.0, -3.0, 0.7])


def curve(p, x=X):
    return p[0] + p[1] * x + np.sin(p[2] * x)


def fit(y, **options):
    return least_squares(lambda p: curve(p) - y, [1.0, 0.0, 0.5], ["a", "b", "c"], [1.0, 1.0, 1.0], **options)


@pytest.mark.parametrize("jac", [None, "cs"])
@pytest.mark.parametrize("truncation", [None, TRUNCATION_LEVELS])
def test_planted_parameters_come_back(jac, truncation):
    found = fit(curve(TRUTH), jac=jac, truncation=truncation)
    assert found.converged
    # The problem's condition number is 4e2; differences are exact to 1e-10.
    np.testing.assert_allclose(found.values, TRUTH, atol=1e-9)


@pytest.mark.nightly
def test_intervals_cover_the_truth():
    rng = np.random.default_rng(0)
    inside = np.zeros(3)
    for _ in range(400):
        found = fit(curve(TRUTH) + 1e-3 * rng.standard_normal(len(X)), jac="cs")
        low, high = found.intervals.T
        inside += (low <= TRUTH) & (high >= TRUTH)
    # 400 trials: 95 % has a standard deviation of 1.1 %, so 3 of them are allowed.
    assert (np.abs(inside / 400 - 0.95) < 0.033).all()


def test_what_the_equations_do_not_tell_keeps_its_start():
    def residual(p):
        return p[0] + 2.0 * p[1] + p[2] * X - (1.0 + 3.0 * X)

    found = least_squares(residual, [0.5, 0.1, 0.0, 7.0], ["a", "b", "c", "d"], [1.0] * 4)
    assert found.held.tolist() == [False, True, False, True]
    np.testing.assert_allclose(found.values, [0.8, 0.1, 3.0, 7.0], atol=1e-9)
    words = list_identifiability(found.identifiability)
    assert words["identifiable"] == ["c"]
    assert words["not_identifiable"] == ["d"]
    assert words["combinations"] == ["a + 2 b"]
    assert np.isinf(found.standard_deviations[[1, 3]]).all()


def test_words_do_not_depend_on_scales():
    matrix = np.column_stack([np.ones(9), 2.0 * np.ones(9), np.arange(9.0)])
    told = classify_scaled_parameters(matrix, ["a", "b", "c"], [1e-3, 5.0, 1.0])
    assert list_identifiability(told)["combinations"] == ["a + 2 b"]


def test_weak_directions_are_held_in_noise():
    rng = np.random.default_rng(1)
    y = 1.0 + 1e-3 * rng.standard_normal(len(X))

    def residual(p):
        return p[0] + 1e-3 * p[1] * X - y

    found = least_squares(residual, [0.0, 0.0], ["a", "b"], [1.0, 0.1], select="noise")
    assert abs(found.values[0] - 1.0) < 1e-3
    # b of its size moves the equations by 1e-4, a tenth of the noise.
    assert found.held.tolist() == [False, True]
    # a is told but for the mean of what b adds.
    assert list_identifiability(found.identifiability)["combinations"] == ["a + 0.0005 b"]


def test_a_prior_pulls_by_its_weight():
    y = np.array([1.0, 1.2, 0.8, 1.0])
    found = least_squares(
        lambda p: p[0] - y,
        [0.0],
        ["a"],
        [1.0],
        sigma=0.2,
        prior=Prior(np.zeros(1), np.full(1, 0.1)),
    )
    # Precisions: 4 / 0.04 = 100 of the data about 1 and 100 of the prior about 0.
    assert found.values[0] == pytest.approx(0.5, abs=1e-9)
    assert found.standard_deviations[0] == pytest.approx(200**-0.5, rel=1e-9)


def test_differences_by_groups_are_those_one_by_one():
    blocks = np.kron(np.eye(6), np.ones((4, 1)))
    y = np.repeat(np.arange(6.0), 4)

    def residual(p):
        return np.exp(0.1 * (blocks @ p)) * (blocks @ p) - y

    names = [f"p{k}" for k in range(6)]
    plain = least_squares(residual, np.ones(6), names, np.ones(6))
    grouped = least_squares(residual, np.ones(6), names, np.ones(6), sparsity=blocks)
    np.testing.assert_allclose(plain.values, grouped.values, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scales": [1.0, 0.0, 1.0]}, "scales of b"),
        ({"start": [1.0]}, "must match"),
        ({"sigma": -1.0}, "sigma"),
    ],
)
def test_bad_arguments_are_refused(change, said):
    given = {"start": [0.0] * 3, "names": ["a", "b", "c"], "scales": [1.0] * 3} | change
    with pytest.raises(InputError, match=said):
        least_squares(lambda p: curve(p), **given)


def test_too_few_equations_are_refused():
    with pytest.raises(InputError, match="record more poses"):
        least_squares(lambda p: curve(p, X[:3]), [1.0, 0.0, 0.5], ["a", "b", "c"], [1.0] * 3)


def test_a_residual_that_is_not_finite_is_named():
    y = curve(TRUTH)
    y[6] = np.nan
    with pytest.raises(InputError, match="equation 7 of 40"):
        fit(y)

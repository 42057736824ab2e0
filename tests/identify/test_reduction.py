"""Reduction of friction parameters: planted groups are found, real differences are kept."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.identify.estimation import reduce_parameters

NAMES = ("mass", "a1", "a2", "a3", "b1", "b2", "b3")
KINDS = (("a1", "a2", "a3"), ("b1", "b2", "b3"))
COVARIANCE = np.array([[1.0, 0.6], [0.6, 1.0]])


def made(truth, seed=0, rows=2000):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, 2, len(NAMES)))
    noise = rng.standard_normal((rows, 2)) @ np.linalg.cholesky(COVARIANCE).T
    return matrix, matrix @ np.array(truth) + noise


def test_equal_ones_are_merged_and_those_without_effect_go():
    found = reduce_parameters(*made([5, 1, 1, 1, 0, 0, 0]), COVARIANCE, NAMES, KINDS)
    assert [len(g) for g in found.groups] == [1, 3]
    np.testing.assert_allclose(found.value, [5.0, 1.0], atol=4.0 * found.std.max())
    assert [s.action for s in found.steps] == ["start", *["drop"] * 3, *["merge"] * 2]
    assert 0.9 < found.steps[-1].misfit < 1.1  # the noise has the stated covariance


def test_those_that_differ_stay_apart():
    found = reduce_parameters(*made([5, 1, 1, 3, 0, 0, 2]), COVARIANCE, NAMES, KINDS)
    assert sorted(map(len, found.groups)) == [1, 1, 1, 2]


def test_a_candidate_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="c1 is not a parameter"):
        reduce_parameters(*made([1] * 7), COVARIANCE, NAMES, (("c1",),))

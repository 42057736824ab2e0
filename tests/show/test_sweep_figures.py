"""Means in the pictures of a sweep are those of the key that is drawn, not of the others."""

import numpy as np

from hydrotele.show.sweep_report import _mean_curve


def test_bins_have_their_share_of_every_other_key():
    """Each of 20 random values is run at two settings 100 apart: no bin may lean to one of them."""
    x = np.repeat(np.random.default_rng(1).uniform(0.0, 1.0, 20), 2)
    places, means = _mean_curve(True, x, 3.0 * x + np.tile([0.0, 100.0], 20))
    assert len(places) == 8
    np.testing.assert_allclose(means, 3.0 * places + 50.0, rtol=1e-12)  # rounding


def test_values_that_many_runs_share_are_no_bins():
    x = np.array([0.0] * 7 + [6.0] * 13)
    places, means = _mean_curve(True, x, x**2)
    assert places.tolist() == [0.0, 6.0] and means.tolist() == [0.0, 36.0]

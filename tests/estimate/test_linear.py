"""Linear filter and smoother against the textbook's, and their slopes against differences."""

import numpy as np
import pytest

from hydrotele.estimate.filter import multiply_symmetric, multiply_transposed
from hydrotele.estimate.levels import LinearRun, smooth

ROWS, CHANNELS, SIZE = 40, 2, 3


@pytest.fixture(scope="module")
def made():
    """A stable system of three states and two readings, with a reading missing here and there."""
    rng = np.random.default_rng(3)
    flow = 0.9 * np.eye(SIZE) + 0.1 * rng.normal(size=(ROWS, SIZE, SIZE))
    error = rng.normal(size=(ROWS, CHANNELS))
    error[::7, 0] = np.nan
    run = LinearRun(
        np.ascontiguousarray(flow), rng.normal(size=(ROWS, CHANNELS, SIZE)), error,
        np.zeros((ROWS, SIZE)), np.diag([1.0, 2.0, 0.5]), 0.05 * rng.random((ROWS, SIZE)),
    )  # fmt: skip
    return run, np.tile([0.4, 1.3], (ROWS, 1)), np.array([0.2, 0.0, 0.1])


def textbook(run, noise, drift):
    """Kalman filter with all readings of a row at once, and the Rauch-Tung-Striebel smoother.

    Returns -2 log likelihood without constant, and smoothed states before the readings' rows.
    """
    x, p, loss = np.zeros(SIZE), run.initial, 0.0
    priors, posts = [], []
    for row in range(ROWS):
        priors.append((x, p))
        there = np.isfinite(run.error[row])
        h, r = run.slope[row][there], np.diag(noise[row][there])
        s = h @ p @ h.T + r
        v = run.error[row][there] - h @ x
        loss += v @ np.linalg.solve(s, v) + np.linalg.slogdet(s)[1]
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ v, p - gain @ h @ p
        posts.append((x, p))
        f = run.flow[row].T  # kept with the state after a row along the first index
        x, p = f @ x, f @ p @ f.T + np.diag(drift + run.startle[row])
    smoothed = [posts[-1][0]]
    for row in range(ROWS - 2, -1, -1):
        (x, p), (ahead, spread) = posts[row], priors[row + 1]
        back = p @ run.flow[row] @ np.linalg.inv(spread)
        smoothed.insert(0, x + back @ (smoothed[0] - ahead))
    return loss, np.array(smoothed)


def test_likelihood_and_smoothed_states_are_the_textbooks(made):
    """The readings tell the same of a state before and after they have been taken in."""
    loss, states = textbook(*made)
    found = smooth(*made, states=True)
    assert found.loss == pytest.approx(loss, rel=1e-10)  # rounding
    np.testing.assert_allclose(found.deviation, states, atol=1e-9)


def test_disturbances_carry_one_smoothed_state_to_the_next(made):
    run = made[0]
    found = smooth(*made, states=True)
    carried = np.einsum("rst,rs->rt", run.flow[:-1], found.deviation[:-1])
    np.testing.assert_allclose(carried + found.disturbance[:-1], found.deviation[1:], atol=1e-9)
    assert np.all(found.known >= -1e-9) and np.all(found.known <= 1.0 + 1e-9)  # rounding


@pytest.mark.parametrize("which, place", [("noise", 0), ("noise", 1), ("drift", 0), ("drift", 2)])
def test_slopes_are_those_of_differences(made, which, place):
    """Central differences of 1e-5: their own error is some 1e-9 of the slope."""
    run, noise, drift = made
    found, losses, step = smooth(*made), [], 1e-5
    for sign in (1.0, -1.0):
        level = {"noise": noise.copy(), "drift": drift.copy()}
        level[which][..., place] += sign * step
        losses.append(smooth(run, level["noise"], level["drift"]).loss)
    slope = {"noise": found.noise_slope, "drift": found.drift_slope}[which][place]
    assert slope == pytest.approx((losses[0] - losses[1]) / (2.0 * step), rel=1e-5)


def test_the_slope_along_jitter_is_that_of_differences(made):
    """The variance of an instant times the square of a reading's rate adds to the reading's."""
    run, noise, drift = made
    rates = np.random.default_rng(8).random(noise.shape)
    found, step = smooth(run, noise, drift, rates=rates), 1e-5
    losses = [smooth(run, noise + sign * step * rates, drift).loss for sign in (1.0, -1.0)]
    slope = (losses[0] - losses[1]) / (2.0 * step)
    assert found.jitter_slope == pytest.approx(slope, rel=1e-5)
    assert smooth(run, noise, drift).jitter_slope == 0.0


@pytest.mark.parametrize("size", [3, 4, 10])
def test_products_in_blocks_of_four_rows_are_numpys(size):
    rng, out = np.random.default_rng(1), np.empty((size, size))
    left = np.where(rng.random((size, size)) < 0.5, rng.normal(size=(size, size)), 0.0)
    root = rng.normal(size=(size, size))
    multiply_transposed(left, root, out)
    np.testing.assert_allclose(out, left.T @ root, atol=1e-12)
    multiply_symmetric(root, np.ascontiguousarray(root.T), out)
    np.testing.assert_allclose(out, root @ root.T, atol=1e-12)
    np.testing.assert_array_equal(out, out.T)

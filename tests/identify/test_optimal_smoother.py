"""The optimal smoother against closed forms, a dense solution, its own statistics and theory."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.identify.optimal_smoother import sample_smoothing_errors, smooth_and_differentiate, transition_matrices

DT = 0.02


def chain(rows, input_std, order, seed):
    """A signal of the model itself: states (rows, order) with the input held per sample."""
    forward, _, drive = transition_matrices(order)
    scale, rng = DT ** np.arange(order), np.random.default_rng(seed)
    state, states = np.zeros(order), np.empty((rows, order))
    for j in range(rows):
        states[j] = state / scale
        state = forward @ state + drive * rng.normal() * input_std * DT**order
    return states


def sines(time):
    value = 0.6 * np.sin(time) + 0.2 * np.sin(2.3 * time + 1)
    rate = 0.6 * np.cos(time) + 0.46 * np.cos(2.3 * time + 1)
    return value, rate, -0.6 * np.sin(time) - 1.058 * np.sin(2.3 * time + 1)


@pytest.mark.parametrize("order", [3, 4])
def test_it_is_the_minimum_of_the_penalised_squares(order):
    rows, ratio, rng = 40, 0.03, np.random.default_rng(1)
    samples = np.cumsum(rng.normal(size=rows))
    samples[[0, 7, 8, 39]] = np.nan
    forward, _, drive = transition_matrices(order)
    # unknowns: the first state and all inputs; the value is linear in them
    value = np.zeros((rows, order + rows - 1))
    state = np.zeros((order, order + rows - 1))
    state[:, :order] = np.eye(order)
    for j in range(rows):
        value[j] = state[0]
        state = forward @ state
        if j < rows - 1:
            state[:, order + j] += drive
    known, weight = np.isfinite(samples), np.zeros(order + rows - 1)
    weight[order:] = 1 / np.sqrt(ratio)
    system = np.vstack([value[known], np.diag(weight)[order:]])
    right = np.concatenate([samples[known], np.zeros(rows - 1)])
    best = np.linalg.lstsq(system, right)[0]
    covariance = np.linalg.inv(system.T @ system)
    found = smooth_and_differentiate(samples, 1.0, noise=1.0, input_std=np.sqrt(ratio), order=order)
    # rounding of the dense normal equations, whose condition number is 1e7 or so
    assert found.value == pytest.approx(value @ best, abs=1e-6)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", value, covariance, value))
    assert found.value_std == pytest.approx(spread, rel=1e-6)


def test_errors_against_truth_are_far_below_the_noise():
    time = DT * np.arange(2000)
    truth, rng = sines(time), np.random.default_rng(2)
    found = smooth_and_differentiate(truth[0] + rng.uniform(-1, 1, 2000) * 1.75e-3, DT, noise=1.75e-3 / np.sqrt(3))
    inner = slice(50, -50)
    errors = [
        np.sqrt(np.mean((got - true)[inner] ** 2))
        for got, true in zip((found.value, found.rate, found.acceleration), truth, strict=True)
    ]
    assert errors[0] < 1.01e-3 / 3  # [rad] one sample has 1.01e-3
    assert errors[1] < 35.7e-3 / 8  # [rad/s] s sqrt(2) / 2 dt: what central differences have
    assert errors[2] < 6.2 / 100  # [rad/s^2] s sqrt(6) / dt^2: what second differences have
    spreads = found.value_std[inner], found.rate_std[inner], found.acceleration_std[inner]
    # sines are smoother than the white jerk that the deviations are for, never rougher
    assert all(e < 1.1 * s.mean() for e, s in zip(errors, spreads, strict=True))


@pytest.mark.parametrize("order", [3, 4])
def test_standard_deviations_cover_95_percent_of_the_errors(order):
    inside, roughness = [], []
    for seed in range(20):
        truth = chain(1000, 3.0, order, seed)
        rng = np.random.default_rng(1000 + seed)
        found = smooth_and_differentiate(truth[:, 0] + rng.normal(0, 1e-3, 1000), DT, noise=1e-3, order=order)
        roughness.append(found.input_std[0])
        for k, kind in enumerate(("value", "rate", "acceleration")):
            error = np.abs(getattr(found, kind) - truth[:, k])
            inside.append(np.mean(error < 1.96 * getattr(found, f"{kind}_std")))
    # errors hang together over some 10 samples: 20 runs hold 2000 independent ones, +-0.5 %; the
    # estimated roughness takes up to 1 % more
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)
    assert np.mean(roughness) == pytest.approx(3.0, rel=0.05)


def test_unknown_noise_is_found():
    truth = chain(4000, 2.0, 3, 5)[:, 0]
    found = smooth_and_differentiate(truth + np.random.default_rng(6).normal(0, 2e-3, 4000), DT)
    assert found.noise[0] == pytest.approx(2e-3, rel=0.05)  # 4000 samples: 1.1 % by chance
    assert found.input_std[0] == pytest.approx(2.0, rel=0.2)


def test_cross_validation_chooses_about_the_same():
    truth = chain(4000, 2.0, 3, 7)[:, 0]
    samples = truth + np.random.default_rng(8).normal(0, 2e-3, 4000)
    found = smooth_and_differentiate(samples, DT, noise=2e-3, method="validation")
    # asymptotically as good a smoother, with a flatter criterion: within a factor of 2
    assert 1.0 < found.input_std[0] < 4.0


def test_noise_falls_with_the_sample_rate_as_theory_says():
    """A continuous jerk of density q: the errors go with the noise density s^2 dt as in theory.

    The variance of derivative k goes with (s^2 dt)^((2m - 1 - 2k) / 2m), here m = 3.
    """
    spread = {}
    for dt in (0.004, 0.002):
        found = smooth_and_differentiate(
            np.zeros(4001), dt, noise=1e-3, input_std=4.0 / np.sqrt(dt)  # the same density
        )  # fmt: skip
        spread[dt] = [s[2000] for s in (found.value_std, found.rate_std, found.acceleration_std)]
    orders = np.log2(np.divide(spread[0.004], spread[0.002]))
    assert orders == pytest.approx([5 / 12, 3 / 12, 1 / 12], abs=0.01)  # dt -> 0 only


def test_missing_samples_are_bridged_with_honest_doubt():
    time = DT * np.arange(600)
    truth, rng = sines(time), np.random.default_rng(9)
    samples = truth[0] + rng.normal(0, 1e-3, 600)
    samples[200:220] = np.nan
    samples[rng.integers(0, 600, 30)] = np.nan
    found = smooth_and_differentiate(samples, DT, noise=1e-3)
    assert np.isfinite(found.acceleration).all()
    assert found.value_std[210] > 2 * found.value_std[300]
    assert abs(found.value - truth[0])[200:220].max() < 4 * found.value_std[200:220].max()
    assert not found.known[210, 0]


def test_columns_are_smoothed_each_for_itself_and_in_their_units():
    rng = np.random.default_rng(10)
    samples = np.column_stack([sines(DT * np.arange(300))[0]] * 2) + rng.normal(0, 1e-3, (300, 2))
    both = smooth_and_differentiate(samples * [1.0, 1e9], DT, noise=np.array([1e-3, 1e6]))
    one = smooth_and_differentiate(samples[:, 1], DT, noise=1e-3)
    assert both.rate.shape == (300, 2) and one.rate.shape == (300,)
    for kind in ("value", "rate", "acceleration", "value_std", "rate_std", "acceleration_std"):
        # scaling by 1e9 rounds differently, and the best roughness is found to 2 %
        assert getattr(both, kind)[:, 1] / 1e9 == pytest.approx(getattr(one, kind), rel=1e-6)
    slow = smooth_and_differentiate(samples[:, 1], 10 * DT, noise=1e-3)  # the same samples on a slower clock
    assert slow.acceleration == pytest.approx(one.acceleration / 100, rel=1e-9)
    assert slow.input_std == pytest.approx(one.input_std / 1000, rel=1e-9)


def test_drawn_errors_have_the_stated_deviations():
    samples = chain(500, 3.0, 3, 11)[:, 0] + np.random.default_rng(12).normal(0, 1e-3, 500)
    samples[100:130] = np.nan
    found = smooth_and_differentiate(samples, DT, noise=1e-3)
    draws = sample_smoothing_errors(found, 400, seed=1)[..., 0]
    assert draws.shape == (400, 3, 500)
    for k, spread in enumerate((found.value_std, found.rate_std, found.acceleration_std)):
        # 400 draws know a deviation to 3.5 %; the largest of 500 correlated ones lies near 4 sigma
        assert draws[:, k].std(axis=0) == pytest.approx(spread, rel=0.15)


def test_refuses_what_it_cannot_smooth():
    good = np.arange(20.0)
    with pytest.raises(InputError, match="at least 5"):
        smooth_and_differentiate(np.r_[good[:4], np.full(10, np.nan)], DT, noise=1.0)
    with pytest.raises(InputError, match="column 0, row 3 is infinite"):
        smooth_and_differentiate(np.where(good == 3, np.inf, good), DT, noise=1.0)
    with pytest.raises(InputError, match="period must be positive"):
        smooth_and_differentiate(good, 0.0, noise=1.0)
    with pytest.raises(InputError, match="noise must be positive"):
        smooth_and_differentiate(good, DT, noise=-1.0)
    with pytest.raises(InputError, match="without noise"):
        smooth_and_differentiate(good, DT, input_std=1.0)
    with pytest.raises(InputError, match="constant"):
        smooth_and_differentiate(np.ones(20), DT)
    with pytest.raises(InputError, match="order must be 3 or 4"):
        smooth_and_differentiate(good, DT, order=2)
    with pytest.raises(InputError, match=r"\(n,\) or \(n, k\)"):
        smooth_and_differentiate(np.zeros((3, 3, 3)), DT)

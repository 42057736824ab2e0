"""Motion from noisy positions, and the band in which it tells accelerations."""

import numpy as np
import pytest

from hydrotele.identify.joint_motion import (
    Processing,
    apply_filter_adjoint,
    compute_joint_motion,
    estimate_resolution,
)

PERIOD, NOISE = 0.02, 1e-3
TIME = PERIOD * np.arange(2500)


def moving(noise=NOISE, seed=0):
    """Two joints: one moves, one rests."""
    rng = np.random.default_rng(seed)
    wave = 0.4 * np.sin(1.3 * TIME) + 0.1 * np.sin(4.1 * TIME)
    return np.column_stack([wave, np.full(len(TIME), 0.3)]) + rng.normal(0, noise, (len(TIME), 2))


def test_a_resting_joint_does_not_set_the_band_and_gets_no_motion():
    positions, noise = moving(), np.full(2, NOISE)
    found = estimate_resolution(positions, PERIOD, noise)
    assert found.is_moving.tolist() == [True, False]
    alone = estimate_resolution(positions[:, :1], PERIOD, noise[:1])
    assert found.bandwidth == pytest.approx(alone.bandwidth)
    motion = compute_joint_motion(positions, PERIOD, found, Processing())
    # a filter would make accelerations of 1e-3 (2 pi 2)^2 = 0.2 rad/s^2 of its noise
    assert np.abs(motion.acceleration[:, 1]).max() < 0.01
    assert np.std(motion.acceleration[100:-100, 0]) > 0.5


def test_noise_and_band_are_found_where_not_stated():
    found = estimate_resolution(moving()[:, :1], PERIOD, np.array([np.nan]))
    # noise of 2500 samples is known to 1.4 %; smoothing takes some of it
    assert found.noise[0] == pytest.approx(NOISE, rel=0.06)
    stated = estimate_resolution(moving()[:, :1], PERIOD, np.array([NOISE]))
    assert found.band == pytest.approx(stated.band, rel=0.1)


@pytest.mark.parametrize("method", ["zero_phase", "raw"])
def test_stated_errors_are_as_large_as_the_real_ones(method):
    positions, noise = moving()[:, :1], np.array([NOISE])
    found, how = estimate_resolution(positions, PERIOD, noise), Processing(method)
    motion = compute_joint_motion(positions, PERIOD, found, how)
    inner = slice(50, -50)  # the filters' ends apart
    stated = (motion.value_std, motion.rate_std, motion.acceleration_std)
    for n, part in enumerate((motion.value, motion.rate, motion.acceleration)):
        true = 0.4 * 1.3**n * np.sin(1.3 * TIME + n * np.pi / 2)
        true += 0.1 * 4.1**n * np.sin(4.1 * TIME + n * np.pi / 2)
        # some 300 independent errors, and what the filters take of the signal
        real = np.std(part[inner, 0] - true[inner])
        assert stated[n][inner].mean() == pytest.approx(real, rel=0.2)


@pytest.mark.parametrize("how", [Processing(), Processing("raw"),
                                 Processing("periodic", period=5.0, harmonics=9)])  # fmt: skip
def test_the_adjoint_tells_what_every_position_adds_to_a_sum(how):
    positions, rng = moving(), np.random.default_rng(1)
    found = estimate_resolution(positions, PERIOD, np.full(2, NOISE))
    # sums over the middle, where the filters do not know of the ends; raw differences know no noise
    gain = np.zeros((3, 2, len(TIME), 2))
    gain[:, :, 500:-500] = rng.standard_normal((3, 2, len(TIME) - 1000, 2))
    moved = positions.copy()
    moved[:, 0] += 1e-3 * rng.standard_normal(len(TIME))
    motions = [compute_joint_motion(p, PERIOD, found, how) for p in (positions, moved)]
    change = [np.stack([m.value, m.rate, m.acceleration]) for m in motions]
    expected = np.einsum("xpnj,xnj->p", gain[..., :1], (change[1] - change[0])[..., :1])
    single = apply_filter_adjoint(gain, PERIOD, found, how)
    assert np.allclose(np.einsum("pnj,nj->p", single, moved - positions), expected, rtol=1e-6)
    assert not single[..., 1].any()  # a joint that rests


def test_periodic_needs_whole_cycles_and_is_sharpest():
    time = PERIOD * np.arange(2000)  # ten cycles of 4 s
    turn = 2 * np.pi / 4.0
    true = 0.3 * np.sin(turn * time) + 0.05 * np.sin(3 * turn * time)
    noisy = (true + np.random.default_rng(3).normal(0, NOISE, 2000))[:, None]
    found = estimate_resolution(noisy, PERIOD, np.array([NOISE]))
    how = Processing("periodic", period=4.0, harmonics=3)
    second = -0.3 * turn**2 * np.sin(turn * time) - 0.45 * turn**2 * np.sin(3 * turn * time)
    errors = {}
    for tried in (how, Processing("zero_phase"), Processing("raw")):
        away = compute_joint_motion(noisy, PERIOD, found, tried).acceleration[:, 0] - second
        errors[tried.method] = np.std(away[50:-50])
    # (2 pi f)^2 sigma over the bands kept: 0.75, 4 and 25 Hz, and the mean of ten cycles
    assert 5 * errors["periodic"] < errors["zero_phase"] < 0.5 * errors["raw"]

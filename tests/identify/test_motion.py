"""Motion from noisy positions, and the band in which it tells accelerations."""

import numpy as np
import pytest

from hydrotele.identify.motion import Processing, joint_motion, motion_errors, resolution

PERIOD, NOISE = 0.02, 1e-3
TIME = PERIOD * np.arange(2500)


def moving(noise=NOISE, seed=0):
    """Two joints: one moves, one rests."""
    rng = np.random.default_rng(seed)
    wave = 0.4 * np.sin(1.3 * TIME) + 0.1 * np.sin(4.1 * TIME)
    return np.column_stack([wave, np.full(len(TIME), 0.3)]) + rng.normal(0, noise, (len(TIME), 2))


def test_a_resting_joint_does_not_set_the_band_and_gets_no_motion():
    positions, noise = moving(), np.full(2, NOISE)
    found = resolution(positions, PERIOD, noise)
    assert found.moves.tolist() == [True, False]
    alone = resolution(positions[:, :1], PERIOD, noise[:1])
    assert found.bandwidth == pytest.approx(alone.bandwidth)
    motion = joint_motion(positions, PERIOD, found, Processing())
    # a filter would make accelerations of 1e-3 (2 pi 2)^2 = 0.2 rad/s^2 of its noise
    assert np.abs(motion.acceleration[:, 1]).max() < 0.01
    assert np.std(motion.acceleration[100:-100, 0]) > 0.5


def test_noise_and_band_are_found_where_not_stated():
    found = resolution(moving()[:, :1], PERIOD, np.array([np.nan]))
    # noise of 2500 samples is known to 1.4 %; smoothing takes some of it
    assert found.noise[0] == pytest.approx(NOISE, rel=0.06)
    stated = resolution(moving()[:, :1], PERIOD, np.array([NOISE]))
    assert found.band == pytest.approx(stated.band, rel=0.1)


@pytest.mark.parametrize("method", ["zero_phase", "raw"])
def test_drawn_errors_are_as_large_as_the_real_ones(method):
    positions, noise = moving()[:, :1], np.array([NOISE])
    found, how = resolution(positions, PERIOD, noise), Processing(method)
    errors = motion_errors(positions, PERIOD, found, how, 6)
    motion = joint_motion(positions, PERIOD, found, how)
    true = [
        0.4 * 1.3**n * np.sin(1.3 * TIME + n * np.pi / 2)
        + 0.1 * 4.1**n * np.sin(4.1 * TIME + n * np.pi / 2)
        for n in range(3)
    ]
    inner = slice(50, -50)  # the filters' ends apart
    for n, found_part in enumerate((motion.value, motion.rate, motion.acceleration)):
        real = np.std(found_part[inner, 0] - true[n][inner])
        # seven draws of some 300 independent errors each, and what the filters take of the signal
        assert np.std(errors[:, n, inner]) == pytest.approx(real, rel=0.25)


def test_periodic_needs_whole_cycles_and_is_sharpest():
    time = PERIOD * np.arange(2000)  # ten cycles of 4 s
    turn = 2 * np.pi / 4.0
    true = 0.3 * np.sin(turn * time) + 0.05 * np.sin(3 * turn * time)
    noisy = (true + np.random.default_rng(3).normal(0, NOISE, 2000))[:, None]
    found = resolution(noisy, PERIOD, np.array([NOISE]))
    how = Processing("periodic", period=4.0, harmonics=3)
    second = -0.3 * turn**2 * np.sin(turn * time) - 0.45 * turn**2 * np.sin(3 * turn * time)
    errors = {}
    for tried in (how, Processing("zero_phase"), Processing("raw")):
        away = joint_motion(noisy, PERIOD, found, tried).acceleration[:, 0] - second
        errors[tried.method] = np.std(away[50:-50])
    # (2 pi f)^2 sigma over the bands kept: 0.75, 4 and 25 Hz, and the mean of ten cycles
    assert 5 * errors["periodic"] < errors["zero_phase"] < 0.5 * errors["raw"]

"""A dead band's share of a swing."""

import numpy as np
import pytest

from hydrotele.teleop.scenario_analysis import deadband_gain


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.9])
def test_share_is_the_first_harmonic(ratio):
    phase = np.linspace(0.0, 2.0 * np.pi, 20001)[:-1]
    wave = np.sin(phase)
    passed = np.sign(wave) * np.maximum(np.abs(wave) - ratio, 0.0)
    first = 2.0 * np.mean(passed * wave)
    assert deadband_gain(ratio, 1.0) == pytest.approx(first, abs=1e-6)  # sum of 20000 points


def test_no_dead_band_passes_all_and_a_small_swing_nothing():
    assert deadband_gain(0.0, 1.0) == 1.0
    assert deadband_gain(1.0, 1.0) == 0.0

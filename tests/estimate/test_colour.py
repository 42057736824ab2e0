"""Coloured noise of sensors: its spectrum, its states in the filter, and how it is found."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

from hydrotele.estimate.colour import Colour, find_colour, join_transitions, measure_spectrum
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.levels import propose_colours
from hydrotele.estimate.track import Levels, track_run
from hydrotele.machine.machine_file import load_machine
from tests.small_machines import add_coloured_noise, simulate_colour, simulate_data

PERIOD = 0.02  # s
RESONANT, SLOW = Colour(0, 2.0, 0.15, 11.0), Colour(0, 2.0, 0.2)


@pytest.mark.parametrize("colour", [RESONANT, SLOW])
def test_the_spectrum_is_that_of_the_autocorrelation(colour):
    lags = PERIOD * np.arange(-2000, 2001)
    correlation = np.exp(-np.abs(lags) / colour.memory) * np.cos(2.0 * np.pi * colour.frequency * lags)
    angles = np.linspace(0.1, 3.0, 7)
    expected = [float(correlation @ np.cos(angle * lags / PERIOD)) for angle in angles]
    assert colour.spectrum(angles, PERIOD) == pytest.approx(expected, rel=1e-9)


def test_states_of_coloured_noise_keep_their_variance():
    colours = [RESONANT, dataclasses.replace(SLOW, channel=2)]
    channel, flow = join_transitions(colours, PERIOD)
    assert channel.tolist() == [0, -1, 2]
    sizes = np.diag([4.0, 4.0, 4.0])
    drift = np.diag([RESONANT.drift(PERIOD)] * 2 + [SLOW.drift(PERIOD)])
    np.testing.assert_allclose(flow @ sizes @ flow.T + drift, sizes, atol=1e-12)


@pytest.mark.parametrize("colour", [RESONANT, SLOW])
def test_a_coloured_part_is_found_beside_a_white_one(colour):
    """Of 4000 readings of a sensor that shows a known value, half of whose variance is coloured."""
    rng, white = np.random.default_rng(1), 3.0
    noise = np.sqrt(0.5 * white) * (simulate_colour(colour, PERIOD, 4000, 2) + rng.standard_normal(4000))
    spectra = measure_spectrum(noise[:, None] / white, rng.standard_normal((4000, 1)) / np.sqrt(white), PERIOD)
    found, left, gain = find_colour([spectra], 0, white, 10.0)
    assert gain > 100.0  # 4000 readings whose spectrum differs by a factor of 2 and more in a tenth of the band
    assert found.states == colour.states
    assert found.frequency == pytest.approx(colour.frequency, abs=0.3)  # a segment of 2.6 s resolves 0.4 Hz
    assert found.size**2 + left**2 == pytest.approx(white, rel=0.15)  # 4 standard deviations of its estimate
    assert found.size**2 == pytest.approx(0.5 * white, rel=0.4)


def test_white_noise_asks_for_no_coloured_part():
    """Twice the log likelihood of the five numbers that fit best stays below an effect's."""
    gains = []
    for seed in range(3):
        noise, made = np.random.default_rng(seed).standard_normal((2, 4000, 1))
        gains.append(find_colour([measure_spectrum(noise, made, PERIOD)], 0, 1.0, 3.0)[2])
    assert max(gains) < 20.0


@pytest.fixture(scope="module")
def rig():
    """The laboratory rig, whose head pressure has a resonance of 60 Hz in its readings' noise."""
    noise = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    data = simulate_data(load_machine("rig"), channels, noise, period=0.005, rows=1000, noise_stated=True)
    return add_coloured_noise(data, {"pressure_head.slide": Colour(1, 2e4, 0.04, 60.0)}, seed=3)


def test_the_filter_whitens_coloured_noise(rig):
    (run,) = rig.fit
    plain = Levels(np.array([2e-5, 2.2e4, 1e4]))
    coloured = Levels(np.array([2e-5, 1e4, 1e4]), colours=(Colour(1, 2e4, 0.04, 60.0),))
    one, other = (track_run(rig.machine, rig, run, levels=levels) for levels in (plain, coloured))
    assert other.loss < one.loss - 100.0
    correlations = [np.corrcoef(t.whitened[50:-1, 1], t.whitened[51:, 1])[0, 1] for t in (one, other)]
    assert abs(correlations[1]) < 0.1 < abs(correlations[0])  # 950 errors: 3 standard deviations


def test_coloured_noise_is_proposed_for_its_channel_and_raises_the_likelihood(rig):
    with closing(Evidence(rig, rig.fit, 1, lacking=True)) as evidence:
        given = evidence.set_base(evidence.judged(Guess()))
        levels = propose_colours(rig, given.tracks, 20.0)
        assert levels is not None
        assert [c.channel for c in levels.colours] == [1]
        assert levels.colours[0].frequency == pytest.approx(60.0, abs=2.0)
        found = evidence.judged_from(Guess(), levels)
        assert found.loss < given.loss - 100.0
        (colour,) = found.tracks[0].levels.colours
        assert colour.size == pytest.approx(2e4, rel=0.3)  # 1000 readings with a correlation time of 8 rows
        evidence.set_base(found)
        assert propose_colours(rig, found.tracks, 20.0) is None


def test_a_compact_model_is_linearised_again_when_it_becomes_the_base(rig):
    with closing(Evidence(rig, rig.fit, 1, lacking=True)) as evidence:
        given = evidence.set_base(evidence.judged(Guess()))
        (track,), (small,) = given.tracks, given.compact().tracks
        assert small.is_compact and not small.flow.size and not small.gains.gain.size and not small.columns.size
        evidence.set_base(evidence.judged_from(Guess(), Levels(np.array([4e-5, 2e4, 2e4]))))
        again = evidence.set_base(given.compact())
        assert again.loss == pytest.approx(given.loss, abs=1.0)  # Jacobians of another pass
        assert again.tracks[0].flow.shape == track.flow.shape
        np.testing.assert_allclose(again.tracks[0].states, track.states, rtol=1e-3, atol=1e-6)

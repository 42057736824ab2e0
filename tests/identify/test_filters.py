"""Zero-phase and periodic filters against closed forms, and the three smoothers side by side."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.identify.joint_motion import filter_periodic
from hydrotele.identify.optimal_smoother import smooth_and_differentiate
from hydrotele.identify.zero_phase_filter import filter_zero_phase

DT = 0.02


@pytest.mark.parametrize("frequency", [0.5, 2.0, 4.0])
def test_zero_phase_gain_is_that_of_two_butterworth_passes(frequency):
    time = DT * np.arange(4000)
    wave = 2 * np.pi * frequency
    found = filter_zero_phase(np.sin(wave * time), DT, cutoff=2.0, order=3)
    gain = 1 / (1 + (np.tan(np.pi * frequency * DT) / np.tan(np.pi * 2.0 * DT)) ** 6)
    inner = slice(1000, -1000)  # 20 s: the ends have died away below rounding
    assert found.value[inner] == pytest.approx(gain * np.sin(wave * time)[inner], abs=1e-9)
    error = (wave * DT) ** 4  # five-point differences: a 30th and a 90th of it
    rate, acceleration = wave * np.cos(wave * time), -(wave**2) * np.sin(wave * time)
    assert np.abs(found.rate - gain * rate)[inner].max() < gain * wave * error / 30 + 1e-9
    bound = gain * wave**2 * error / 90 + 1e-7
    assert np.abs(found.acceleration - gain * acceleration)[inner].max() < bound


def test_zero_phase_deviations_cover_its_noise():
    rng = np.random.default_rng(1)
    found = filter_zero_phase(rng.normal(0, 2.0, 200_000), DT, cutoff=3.0, noise=2.0)
    for kind in ("value", "rate", "acceleration"):
        # 200 000 samples at 3 Hz hold some 20 000 independent ones: 0.5 %
        spread = getattr(found, f"{kind}_std")[0]
        assert getattr(found, kind)[1000:-1000].std() == pytest.approx(spread, rel=0.02)
        inside = np.abs(getattr(found, kind)) < 1.96 * spread
        assert inside.mean() == pytest.approx(0.95, abs=0.005)
    assert np.isnan(filter_zero_phase(rng.normal(size=500), DT, cutoff=3.0).rate_std).all()


def test_zero_phase_noise_grows_with_the_cutoff_as_theory_says():
    low, high = (filter_zero_phase(np.zeros(9000), 1e-3, f, noise=1.0) for f in (2.0, 4.0))
    growth = [high.value_std / low.value_std, high.rate_std / low.rate_std,
              high.acceleration_std / low.acceleration_std]  # fmt: skip
    # white noise through a filter of one shape: f_c^(k + 1/2); 1e-3 for the bilinear bend
    assert np.log2([g[0] for g in growth]) == pytest.approx([0.5, 1.5, 2.5], abs=2e-3)


def test_zero_phase_bridges_short_gaps_and_refuses_others():
    time = DT * np.arange(1000)
    samples = np.sin(time)
    samples[[100, 101, 500]] = np.nan
    found = filter_zero_phase(samples, DT, cutoff=3.0, max_gap=2)
    assert np.abs(found.value - np.sin(time))[50:-50].max() < 1e-3  # (1.5 dt)^2 / 2 of a chord
    with pytest.raises(InputError, match="has 2 successive missing samples, at most 1 are"):
        filter_zero_phase(samples, DT, cutoff=3.0, max_gap=1)
    with pytest.raises(InputError, match="optimal smoother"):
        filter_zero_phase(samples, DT, cutoff=3.0)
    samples[-1] = np.nan
    with pytest.raises(InputError, match="at an end"):
        filter_zero_phase(samples, DT, cutoff=3.0, max_gap=5)
    with pytest.raises(InputError, match="half the sample rate, 25 Hz"):
        filter_zero_phase(np.zeros(1000), DT, cutoff=30.0)
    with pytest.raises(InputError, match="too few"):
        filter_zero_phase(np.zeros(40), DT, cutoff=1.0)


def cycles(count, rows=500):
    phase = 2 * np.pi * np.arange(count * rows) / rows
    speed = 2 * np.pi / (rows * DT)
    value = 1.0 + np.sin(phase) + 0.3 * np.cos(4 * phase)
    rate = speed * (np.cos(phase) - 1.2 * np.sin(4 * phase))
    return value, rate, speed**2 * (-np.sin(phase) - 4.8 * np.cos(4 * phase))


def test_periodic_is_exact_without_noise():
    truth = cycles(3)
    found = filter_periodic(truth[0], DT, samples_per_cycle=500, harmonics=5)
    for got, true in zip((found.value, found.rate, found.acceleration), truth, strict=True):
        assert got == pytest.approx(true, abs=1e-12 * 500)  # rounding of the transform
    assert found.value_std.max() < 1e-12


@pytest.mark.parametrize("noise", [0.1, None])
def test_periodic_deviations_cover_95_percent(noise):
    rng, inside = np.random.default_rng(3), []
    truth = cycles(4)
    samples = truth[0][:, None] + rng.normal(0, 0.1, (2000, 200))
    found = filter_periodic(samples, DT, 500, harmonics=5, noise=noise)
    for kind, true in zip(("value", "rate", "acceleration"), truth, strict=True):
        error = np.abs(getattr(found, kind) - true[:, None])
        inside.append(np.mean(error < 1.96 * getattr(found, f"{kind}_std")))
    # 200 columns with 11 free numbers each: 0.5 %
    assert inside == pytest.approx([0.95] * 3, abs=0.015)


def test_periodic_refuses_what_is_not_whole():
    with pytest.raises(InputError, match="cut the record to 500"):
        filter_periodic(np.zeros(600), DT, 500, 5)
    with pytest.raises(InputError, match="harmonics must be below 250"):
        filter_periodic(np.zeros(500), DT, 500, 250)
    with pytest.raises(InputError, match="row 3 is missing"):
        filter_periodic(np.where(np.arange(500) == 3, np.nan, 0.0), DT, 500, 5)


def test_what_knows_more_of_the_signal_differentiates_better():
    truth, rng = cycles(4), np.random.default_rng(4)
    samples = truth[0] + rng.normal(0, 2e-3, 2000)
    found = {
        "periodic": filter_periodic(samples, DT, 500, harmonics=5).acceleration,
        "optimal": smooth_and_differentiate(samples, DT, noise=2e-3).acceleration,
        "zero phase": filter_zero_phase(samples, DT, cutoff=5.0).acceleration,
        "raw": np.gradient(np.gradient(samples, DT), DT),
    }
    inner = slice(200, -200)
    errors = [np.sqrt(np.mean((a - truth[2])[inner] ** 2)) for a in found.values()]
    assert errors == sorted(errors)
    assert errors[0] < 0.2 * errors[1] and errors[1] < 0.2 * errors[3]

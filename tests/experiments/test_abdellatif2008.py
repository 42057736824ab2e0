"""The hexapod's experiments: small versions of each, and that a lack is told."""

import numpy as np
import pytest
from scipy.stats import chi2

from hydrotele.experiments import abdellatif2008 as study
from hydrotele.experiments.palida import (
    CHI2_95,
    HOME,
    RATE,
    TABLE,
    circle,
    excitation,
    excited,
    force_covariance,
    limits,
    measured,
    robot,
    square,
    track,
)


def test_table_1_is_found_and_a_wrong_member_is_seen():
    found = study.base_parameters()
    assert found.ok, found.simulated
    wrong = study.MEANING[0].replace("inertia_yy", "inertia_xx")
    assert study._combination(wrong) != study._combination(study.MEANING[0])


def test_the_motion_keeps_all_limits_and_is_better_than_random_ones():
    found = study.design()
    assert found.ok, found.simulated
    motion = excitation().motion(np.linspace(0.0, excitation().period, 500))
    assert limits().use(motion, motion).max() <= 1.0


def test_dry_friction_of_equal_joints_is_merged():
    """One set: a parameter without effect stays in one of twenty, by the test's 5 %."""
    found = study.reduced_friction(seed=0)
    passive = [g for g in found.groups if study._passive(g[0])]
    dry = sorted((len(g), g[0].startswith("coulomb")) for g in passive)
    assert dry[-2:] == [(6, True), (6, True)] and len(found.groups) in (24, 25)


def test_frequency_domain_predicts_best_and_time_domain_better_than_raw():
    for found in study.signals():
        assert found.ok, found.simulated


def test_estimates_lie_where_their_covariance_says():
    trials = [study.trial(seed) for seed in range(6)]
    found = study.table_2(trials)
    assert found.ok, found.simulated
    # sum of 6 chi^2 of 24 degrees of freedom
    assert chi2.sf(sum(t[2] for t in trials), 144) > 1e-3
    far = [(v, s, size + 50.0) for v, s, size in trials]
    assert not study.ellipsoid(far).ok
    assert not study.ellipsoid([(v, s, 1.0) for v, s, _ in trials]).ok  # too good
    assert abs(chi2.ppf(0.95, 24) - CHI2_95) < 0.005


def test_measured_noise_has_its_covariance():
    record = measured(excited(), 8, np.random.default_rng(0))
    rest = record.force - np.tile(excited().force, (8, 1))
    np.testing.assert_allclose(np.cov(rest.T), force_covariance(), rtol=0.1)  # 24 000 rows


@pytest.mark.parametrize(("path", "size"), [(circle, 0.10), (square, 0.16)])
def test_paths_have_their_size_and_speed(path, size):
    pose, rate, _ = path(0.5)
    assert np.ptp(pose[:, 0]) == pytest.approx(2 * size if path is circle else size, rel=1e-3)
    assert np.linalg.norm(rate[:, :3], axis=1).max() == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_array_equal(pose[:, 2:], np.tile(HOME[2:], (len(pose), 1)))


def test_a_model_helps_and_the_right_one_more():
    motion = circle(0.75, laps=0.25)[:, : round(1.2 * RATE)]
    prior = np.array([one.prior for one in TABLE])
    found = [track(motion, model) for model in (None, prior, robot().truth)]
    none, nominal, identified = (np.sqrt(np.mean(f.error**2)) for f in found)
    assert identified < 0.5 * nominal < 0.5 * none
    assert not any(f.warnings for f in found)


def test_bias_is_seen_where_it_is_and_not_where_it_is_not():
    rng, truth = np.random.default_rng(0), robot().truth
    spread = np.array([one.std for one in TABLE])

    def made(off):
        return [
            {(a, b): truth + spread * rng.standard_normal(24) + off[a]
             for a, b in (("least squares", "samples"), ("Gauss-Markov", "periods"))}
            for _ in range(60)
        ]  # fmt: skip

    assert study.biased(made({"least squares": 2 * spread, "Gauss-Markov": 0.0})).ok
    assert not study.biased(made({"least squares": 2 * spread, "Gauss-Markov": 2 * spread})).ok

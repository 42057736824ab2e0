"""The experiments on the hexapod: small versions of each, and that planted faults are found."""

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from hydrotele.core.errors import InputError
from hydrotele.experiments import abdellatif2008 as study
from hydrotele.experiments import abdellatif_base_parameters
from hydrotele.experiments import abdellatif_processing as processing
from hydrotele.experiments import abdellatif_trials as trials
from hydrotele.experiments.comparison import FAULT_REPETITIONS, Experiment
from hydrotele.experiments.palida import (
    CHI2_LIMIT,
    HOME_POSE,
    PUBLISHED_PARAMETERS,
    SAMPLE_RATE,
    compute_force_covariance,
    load_excitation,
    load_robot,
    make_drive_limits,
    simulate_excitation,
    simulate_measurement,
)
from hydrotele.experiments.palida_control import plan_circle, plan_square, track_path
from hydrotele.identify.linear_least_squares import estimate_linear_parameters

ITEMS = (
    "Table 1", "Table 2", "Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Fig. 5", "Fig. 6", "Fig. 7",
    "Fig. 8", "Fig. 9", "Fig. 10", "Fig. 11", "Fig. 12",
)  # fmt: skip
"""Tables and figures of the document."""


def judge_repeatedly(one: Experiment, count: int, changes=None) -> dict:
    """Rows of an experiment by name."""
    samples = [one.measure(seed, changes or {}) for seed in range(1, one.repetitions(count) + 1)]
    return {claim.name: claim.compare(samples) for claim in one.claims}


def test_every_table_and_figure_is_present():
    present = {
        *study.SERIES.items_without_result,
        *(c.item.split(",")[0] for c in study.SERIES.claims.values()),
    }
    assert set(ITEMS) <= present
    assert {item for item in present if item.startswith(("Table", "Fig"))} == set(ITEMS)


def test_every_judged_claim_can_be_broken():
    claims = study.SERIES.claims.values()
    assert len(study.SERIES.claims) == sum(len(one.claims) for one in study.SERIES.experiments)
    assert all(c.fault and c.fault_description for c in claims if c.kind in ("document", "additional"))


@pytest.mark.parametrize("one", study.SERIES.experiments, ids=lambda one: one.name)
def test_unknown_settings_are_refused(one):
    with pytest.raises(InputError, match="setting no_such_setting: is unknown; valid"):
        one.measure(1, {"no_such_setting": 1.0})


def test_null_space_rules_and_table_1_give_the_same_base_parameters():
    rows = judge_repeatedly(abdellatif_base_parameters.STRUCTURE, 1)
    assert {row.verdict for row in rows.values()} == {"agrees"}
    values = abdellatif_base_parameters.compare_base_parameter_methods(1, {}).values
    # independent of Table 1: 13 parameters per leg and 10 of the platform, for any bodies
    assert values["rank, 19 bodies"] == values["rules, 19 bodies"] == 6 * 13 + 10


@pytest.mark.parametrize(
    ("name", "changes"),
    [("base parameters", {"declare_symmetry": False}), ("base parameters", {"joint_radius": 1.01}),
     ("regrouping rules", {"platform_rule": False})],
)  # fmt: skip
def test_wrong_base_parameters_are_found(name, changes):
    assert judge_repeatedly(abdellatif_base_parameters.STRUCTURE, 1, changes)[name].verdict == "differs"


def test_moved_frame_leaves_the_kinetic_energy():
    """Parameters of a body about another frame give the same energy, to rounding."""
    rng = np.random.default_rng(0)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    offset, spin, speed = rng.normal(size=(3, 3))
    body = np.array([2.0, 0.3, -0.2, 0.5, 1.0, 0.1, -0.2, 1.5, 0.05, 1.2])
    carrier = abdellatif_base_parameters.compute_inertial_transformation(rotation, offset) @ body

    def energy(parameters, spin, speed):
        tensor = abdellatif_base_parameters._build_inertia_tensor(parameters[4:])
        return (0.5 * parameters[0] * speed @ speed + speed @ np.cross(spin, parameters[1:4])
                + 0.5 * spin @ tensor @ spin)  # fmt: skip

    at_body = rotation.T @ (speed + np.cross(spin, offset))
    expected = energy(body, rotation.T @ spin, at_body)
    assert energy(carrier, spin, speed) == pytest.approx(expected, rel=1e-12)


def test_designed_motion_keeps_all_limits_and_is_better_than_random_ones():
    (row,) = judge_repeatedly(study.DESIGN, 4).values()
    assert row.verdict == "agrees", row.simulated
    motion = load_excitation().evaluate(np.linspace(0.0, load_excitation().period, 500))
    assert make_drive_limits().compute_utilisation(motion, motion).max() <= 1.0
    (row,) = judge_repeatedly(study.DESIGN, FAULT_REPETITIONS, {"amplitude": 0.1}).values()
    assert row.verdict == "differs"


@pytest.mark.nightly
@pytest.mark.parametrize(("scatter", "left"), [(0.0, 24), (0.5, 26)])
def test_dry_friction_is_merged_where_hinges_are_equal(scatter, left):
    """Two kinds of hinges with two values each need two parameters more.

    One data set: a parameter without effect stays in one of twenty, by the 5 % of the test.
    """
    values = study.measure_friction_reduction(1, {"hinge_scatter": scatter}).values
    assert values["stop"] in (left, left + 1)
    assert scatter == 0.0 or not values["reached"]


@pytest.mark.nightly
def test_frequency_domain_predicts_best_and_time_domain_better_than_raw():
    sample = processing.compare_processing_methods(1, {})
    variances = [sample.values[f"{way} true variance"] for way in processing.METHOD_NAMES]
    assert variances[0] > variances[1] > variances[2]
    assert sample.values["periodic 2"] < processing.MAX_VISIBLE_ERROR
    shown = {panel.label for panel in sample.panels}
    for claim in processing.PROCESSING.claims:
        assert claim.panel_labels and set(claim.panel_labels) <= shown


def test_too_wide_window_is_found():
    cycle = simulate_excitation()
    record = simulate_measurement(cycle, 2, np.random.default_rng(1))
    motion = processing.compute_motion_from_lengths(record, cycle.period, "periodic", 200)
    error = motion[2, : len(cycle.force), processing.Y_AXIS] - cycle.motion[2, :, processing.Y_AXIS]
    assert np.std(error) > processing.MAX_VISIBLE_ERROR * np.std(cycle.motion[2, :, 1])


def test_normal_equations_give_the_gauss_markov_estimate():
    cycle, rng = simulate_excitation(), np.random.default_rng(1)
    rows = slice(None, None, 10)
    matrix, covariance = cycle.matrix[rows], compute_force_covariance()
    force = cycle.force[rows] + rng.normal(0.0, 10.0, (len(matrix), 6))
    equations = trials.NormalEquations(matrix)
    weight = np.linalg.inv(covariance)[None]
    value, information = equations.solve(weight, equations.correlate(force)[None])
    expected = estimate_linear_parameters(matrix, force, covariance, order=0)
    # condition of the normal equations, about 1e7, times rounding
    np.testing.assert_allclose(value[0], expected.value, rtol=1e-7)
    white = np.linalg.inv(np.linalg.cholesky(covariance)) @ matrix
    np.testing.assert_allclose(
        information[0], np.einsum("nkp,nkq->pq", white, white), rtol=1e-9, atol=1e-9
    )  # rounding of a sum over 300 rows


def test_distances_of_the_trials_have_their_distribution():
    settings = trials.TRIAL_SETTINGS | {"friction_excess": 0.0, "trials": 60}
    found = trials.simulate_trials(1, settings)
    distance = trials.compute_squared_mahalanobis(found.value - load_robot().truth, found.information)
    total = float(distance.sum())  # chi^2 with 24 degrees of freedom per trial
    assert 1e-3 < chi2.sf(total, 24 * 60) < 1.0 - 1e-3
    assert abs(chi2.ppf(0.95, 24) - CHI2_LIMIT) < 0.005  # two printed decimals


def test_only_friction_that_warms_up_brings_the_first_trial_out():
    cold = trials.compute_trial_statistics(1, {"trials": 30}).values
    assert cold["first distance"] > CHI2_LIMIT > 0.0
    # the same noise and warm friction: a chi^2 variable, of which 1 of 1000 exceeds 51.2
    assert cold["warm first distance"] < 51.2
    warm = trials.compute_trial_statistics(1, {"trials": 30, "friction_excess": 0.0}).values
    # the mean of the other 29 trials differs by what is left of the excess in the second
    assert warm["first distance"] == pytest.approx(cold["warm first distance"], rel=0.2)


def test_small_covariance_is_found():
    few = {"trials": 30}
    claims = ("history of the estimates", "all other trials within the ellipsoid")
    rows = judge_repeatedly(trials.TRIAL_SERIES, 2, few | {"claimed_noise": 0.5})
    assert {rows[name].verdict for name in claims} == {"differs"}
    assert rows["history of the estimates"].panels[0].x_label == "trial"


def test_bias_is_found_where_it_is_and_not_where_it_is_not():
    rng, covariance = np.random.default_rng(0), np.diag(np.arange(1.0, 25.0))
    errors = rng.multivariate_normal(np.zeros(24), covariance, 200)
    for shift, verdict in ((0.0, "differs"), (2.0, "agrees")):
        mean = errors.mean(axis=0) + shift * np.sqrt(np.diag(covariance) / 24.0)
        check = trials.check_bias("bias", mean, covariance, 200)
        assert check.verdict == verdict
        assert check.low <= shift <= check.high  # 95 % interval; the seed is fixed
    squared = 200 * check.high**2  # by definition of the upper bound
    distance = 200 * mean @ np.linalg.solve(covariance, mean)
    assert ncx2.cdf(distance, 24, squared) == pytest.approx(0.025, rel=1e-6)


def test_encoder_noise_that_controllers_pass_on_biases_samples_but_not_periods():
    arrays = trials.measure_bias_by_encoder_feedback(1, {}).arrays
    rms = {name: float(np.sqrt(np.mean(error**2))) for name, error in arrays.items()}
    assert rms["samples, least squares"] > 10.0 < rms["samples, Gauss-Markov"]
    # two periods instead of four, and forces with the controllers' noise
    assert rms["periods, Gauss-Markov"] < 5.0


def test_simulated_noise_has_its_covariance():
    record = simulate_measurement(simulate_excitation(), 8, np.random.default_rng(0))
    rest = record.force - np.tile(simulate_excitation().force, (8, 1))
    np.testing.assert_allclose(np.cov(rest.T), compute_force_covariance(), rtol=0.1)  # 24 000 rows


def test_printed_intervals_are_about_the_printed_estimates():
    for one in PUBLISHED_PARAMETERS:
        # the four decimals of the interval and of the estimate
        assert np.mean(one.interval) == pytest.approx(one.value, abs=1.5e-4)


@pytest.mark.parametrize(("plan", "width"), [(plan_circle, 0.20), (plan_square, 0.16)])
def test_paths_have_their_size_and_speed(plan, width):
    pose, rate, _ = plan(0.5)
    # sampling: 500 rows per metre
    assert np.ptp(pose[:, 0]) == pytest.approx(width, rel=1e-3)
    assert np.linalg.norm(rate[:, :3], axis=1).max() == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_array_equal(pose[:, 2:], np.tile(HOME_POSE[2:], (len(pose), 1)))


def test_nominal_model_helps_and_the_true_one_more():
    motion = plan_circle(0.75, laps=0.25)[:, : round(1.2 * SAMPLE_RATE)]
    prior = np.array([one.prior for one in PUBLISHED_PARAMETERS])
    found = [track_path(motion, model) for model in (None, prior, load_robot().truth)]
    none, nominal, identified = (np.sqrt(np.mean(f.error**2)) for f in found)
    assert identified < 0.5 * nominal < 0.5 * none
    assert not any(f.warnings for f in found)

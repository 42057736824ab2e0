"""Calibration of the hybrid robot: planted errors, redundancy, intervals, three methods."""

import numpy as np
import pytest

from hydrotele.calibrate.hybrid_calibration import (
    build_equations,
    calibrate_best_model,
    calibrate_hybrid_robot,
    find_redundancy,
    null_directions,
    pose_errors,
    restrict_to_fitted_parameters,
)
from hydrotele.calibrate.posterior_sampling import (
    autocorrelation_time,
    diagnose_chain,
    minimize_by_evolution,
    sample_posterior,
    split_rhat,
)
from hydrotele.core.errors import InputError
from hydrotele.experiments.wang_identification import count_independent_parameters
from hydrotele.experiments.wang_robots import (
    SENSOR_NOISE,
    compute_test_pose_errors,
    count_errors_within_intervals,
    simulate_robot,
)
from hydrotele.kinematics.hybrid_error_model import build_error_model, refined_model_parameters
from hydrotele.kinematics.hybrid_robot import load_hybrid

IWR = load_hybrid("iwr")
DOCUMENT = refined_model_parameters(build_error_model(IWR, "dh"))


def test_36_exact_errors_come_back():
    one = simulate_robot(1, 25, noise=0.0)
    done = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
    assert done.redundancy.rank == 36
    kept = one.model.parameter_indices(done.fit.names)
    assert np.allclose(done.fit.values, one.errors[kept], atol=1e-9)  # far below any sensor
    assert pose_errors(done.robot, one.measurement).position.max() < 1e-9


@pytest.mark.parametrize(("kind", "rank"), [("dh", 50), ("poe", 54)])
def test_combinations_of_all_54_exact_errors_come_back(kind, rank):
    one = simulate_robot(2, 25, kind, refined_only=False, noise=0.0)
    done = calibrate_hybrid_robot(IWR, one.measurement, kind)
    assert done.redundancy.rank == rank
    away = (done.parameter_errors - one.errors) / one.model.scales
    size = np.abs(done.fit.identifiability.combination @ one.errors)
    found = done.fit.identifiability.combination @ (done.parameter_errors - one.errors)
    # combinations are linear, errors of 1 mm and 1 mrad have products of 1e-6
    assert np.abs(found).max() < 2e-5 and size.max() > 1e-3
    if kind == "poe":
        assert np.abs(away).max() < 1e-6
    assert max(e.max() for e in compute_test_pose_errors(one, done.robot)) < 1e-8


def test_redundancy_is_told_in_words_and_by_its_directions():
    one = simulate_robot(3, 30, refined_only=False)
    eq = build_equations(one.model, one.measurement)
    told = find_redundancy(eq)
    assert (told.rank, len(told.held_names), told.null_directions.shape) == (50, 4, (4, 54))
    assert set(told.redundant_names) == {"theta4", "d4", "a4", "alpha4"} | {
        f"a{leg}{c}" for leg in range(1, 7) for c in "xyz"
    }
    assert set(told.held_names) <= {f"a{leg}{c}" for leg in range(1, 7) for c in "xyz"}
    words = "a common displacement of the universal joints A1 to A6 has the same effect"
    assert words in told.explanations[0]
    moved = eq.residuals(told.null_directions * eq.scales) - eq.residuals(np.zeros((4, 54)))
    usual = eq.residuals(np.eye(54) * eq.scales) - eq.residuals(np.zeros((54, 54)))
    # first order vanishes; products of 1 mm and 1 mrad remain, a thousandth
    assert np.linalg.norm(moved, axis=1).max() < 5e-3 * np.linalg.norm(usual, axis=1).max()


def test_without_tilt_universal_and_spherical_joints_cannot_be_told_apart():
    values = count_independent_parameters(1, {}).values
    assert (values["rank dh without tilt"], values["rank poe without tilt"]) == (32, 36)


@pytest.mark.parametrize("joint", [0, 1, 2, 3])
def test_a_joint_that_never_moves_leaves_parameters_unknown_by_name(joint):
    from hydrotele.calibrate.hybrid_measurement import measurement_from_wires
    from hydrotele.kinematics.hybrid_robot import forward_kinematics, leg_readings
    from hydrotele.kinematics.wire_measurement import wire_lengths
    from hydrotele.simulate.pose_measurements import default_wires, sample_poses

    joints, legs = sample_poses(IWR, 40, np.random.default_rng(joint))
    joints[:, joint] = joints[0, joint]
    pose, wires = forward_kinematics(IWR, joints, legs), default_wires()
    assert np.allclose(leg_readings(IWR, joints, pose), legs)
    measured = measurement_from_wires(IWR, joints, legs, wire_lengths(wires, pose), wires, SENSOR_NOISE, "still")
    done = calibrate_hybrid_robot(IWR, measured, "poe")
    assert done.redundancy.rank < 54
    assert f"joint {IWR.joints[joint]} never moves" in " ".join(done.redundancy.explanations)
    unknown = {n for n, held in zip(done.fit.names, done.fit.held, strict=True) if held}
    assert len(unknown) == 54 - done.redundancy.rank


def test_noisy_errors_shrink_from_millimetres_to_below_a_tenth_at_poses_not_used():
    for document, names in ((True, DOCUMENT), (False, None)):
        one = simulate_robot(5, 25, refined_only=document)
        done = calibrate_hybrid_robot(IWR, one.measurement, "dh", names)
        before = 1e3 * compute_test_pose_errors(one, IWR)[0]
        after = 1e3 * compute_test_pose_errors(one, done.robot)[0]
        assert np.sqrt(np.mean(before**2)) > 1.0
        assert np.sqrt(np.mean(after**2)) < 0.1  # the accuracy of Wang 2012, page 19
        assert 0.7 < done.fit.chi < 1.3  # 100 degrees of freedom: 1 +- 0.07


def test_intervals_hold_the_planted_errors():
    """12 trials of 36: 432, correlated within a trial; 95 % +- 3 % are seen in twelve."""
    inside, total = np.sum([count_errors_within_intervals(seed) for seed in range(500, 512)], axis=0)
    assert 0.90 < inside / total < 0.99


def test_without_stated_noise_it_is_estimated():
    from dataclasses import replace

    one = simulate_robot(6, 25)
    known = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
    unknown = calibrate_hybrid_robot(IWR, replace(one.measurement, noise_is_known=False), "dh", DOCUMENT)
    assert np.allclose(known.fit.values, unknown.fit.values, atol=1e-9)
    assert unknown.fit.noise == pytest.approx(known.fit.chi, rel=1e-6)


def test_left_out_poses_are_predicted_as_by_calibrations_without_them():
    one = simulate_robot(7, 20)
    done = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
    for k in (0, 11):
        without = calibrate_hybrid_robot(IWR, one.measurement.subset(np.arange(20) != k), "dh", DOCUMENT)
        error = pose_errors(without.robot, one.measurement.subset(np.array([k])))
        # second order in changes of 0.05 mm: far below 1 % of the error
        assert done.leave_one_out_errors.position[k] == pytest.approx(error.position[0], rel=0.01)


def test_a_wrong_reading_is_found_and_left_out():
    one = simulate_robot(8, 25)
    legs = one.measurement.legs.copy()
    legs[13, 2] += 0.003
    from dataclasses import replace

    done = calibrate_hybrid_robot(IWR, replace(one.measurement, legs=legs), "dh", DOCUMENT)
    assert done.inconsistent_rows == (13,)
    clean = [calibrate_hybrid_robot(IWR, simulate_robot(seed, 25).measurement, "dh", DOCUMENT).inconsistent_rows
             for seed in range(20, 26)]  # fmt: skip
    assert clean == [()] * 6


@pytest.mark.nightly
def test_the_better_model_is_chosen_where_the_frame_of_the_measurement_is_off():
    """D-H rows begin in frame 0; lines of axes need not."""
    one = simulate_robot(9, 40, "poe", refined_only=False)
    assert calibrate_best_model(IWR, one.measurement).model.kind == "poe"
    assert calibrate_best_model(IWR, simulate_robot(9, 40, "dh", refined_only=False).measurement).model.kind == "dh"


def test_too_few_poses_are_refused():
    one = simulate_robot(10, 25)
    with pytest.raises(InputError, match="8 different poses give 48 equations for 54 parameters"):
        calibrate_hybrid_robot(IWR, one.measurement.subset(np.arange(8)), "dh")
    same = one.measurement.subset(np.zeros(25, int))
    with pytest.raises(InputError, match=r"1 different poses \(25 rows, many of them the"):
        calibrate_hybrid_robot(IWR, same, "dh")


def test_what_is_no_error_of_manufacture_is_warned_of():
    from dataclasses import replace

    one = simulate_robot(13, 25)
    assert calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT).warnings == ()
    shifted = replace(one.measurement, legs=one.measurement.legs + 0.03)
    (said,) = calibrate_hybrid_robot(IWR, shifted, "dh", DOCUMENT).warnings
    assert "l1 -3" in said and "another robot" in said
    louder = replace(one.measurement, covariance=one.measurement.covariance / 25.0)
    (said,) = calibrate_hybrid_robot(IWR, louder, "dh", DOCUMENT).warnings
    assert "larger than stated" in said


@pytest.mark.nightly
def test_three_methods_agree_on_a_few_parameters():
    """Five parameters, for time; the experiments do the 36."""
    one = simulate_robot(11, 8)
    names = ("theta3", "a3", "b1x", "b6z", "l4")
    done = calibrate_hybrid_robot(IWR, one.measurement, "dh", names)
    eq, fit = restrict_to_fitted_parameters(done), done.fit
    evolved = minimize_by_evolution(eq.negative_log_likelihood, fit.values - 5e-3, fit.values + 7e-3, seed=1)
    assert evolved.converged
    assert np.abs((evolved.values - fit.values) / fit.standard_deviations).max() < 0.2  # cost within 0.01
    sample = sample_posterior(
        lambda x: -eq.negative_log_likelihood(x),
        fit.values,
        fit.covariance,
        eq.names,
        steps=3000,
        burn_in=300,
        seed=2,
    )
    assert sample.converged, sample.status
    error = 4.0 / np.sqrt(sample.effective_size)  # of means, in deviations
    assert (np.abs(sample.mean - fit.values) / fit.standard_deviations < error).all()
    # standard deviations of n independent draws scatter by 1 / sqrt(2 n)
    assert np.abs(sample.standard_deviations / fit.standard_deviations - 1.0).max() < 4.0 / np.sqrt(
        2.0 * sample.effective_size.min()
    )


def test_diagnostics_tell_a_chain_that_has_not_converged():
    rng = np.random.default_rng(12)
    good = rng.normal(size=(2000, 20, 2))
    apart = good + np.arange(20)[:, None]
    drifting = good + np.linspace(0, 5, 2000)[:, None, None]
    assert split_rhat(good).max() < 1.01
    assert split_rhat(apart).min() > 1.2 and split_rhat(drifting).min() > 1.2
    assert autocorrelation_time(good).max() < 1.2
    slow = np.zeros((4000, 20, 1))
    for k in range(1, 4000):
        slow[k] = 0.9 * slow[k - 1] + rng.normal(size=(20, 1))
    assert autocorrelation_time(slow)[0] == pytest.approx(19.0, rel=0.15)  # (1 + r) / (1 - r)
    bad = diagnose_chain(("a", "b"), apart, np.zeros((2000, 20)), 0.3, 0)
    assert not bad.converged and "draw more steps" in bad.status


def test_null_directions_of_a_combination():
    from hydrotele.calibrate.estimation import classify_scaled_parameters

    told = classify_scaled_parameters(np.array([[1.0, 2.0], [2.0, 4.0]]), ["a", "b"], [1.0, 1.0])
    (direction,) = null_directions(told)
    assert abs(direction @ [1.0, 2.0]) < 1e-12

"""Study the calibration of the hybrid robot: tables of docs/validation/kinematic_calibration.md.

Usage: python tools/studies/hybrid_calibration_study.py [--trials 200] [--part coverage ...]
"""

import argparse
import time

import numpy as np

from hydrotele.calibrate.hybrid_calibration import (
    PoseEquations,
    build_equations,
    calibrate_hybrid_robot,
    restrict_to_fitted_parameters,
    select_informative_poses,
)
from hydrotele.calibrate.hybrid_measurement import measurement_from_wires
from hydrotele.calibrate.posterior_sampling import sample_posterior
from hydrotele.experiments.wang_robots import (
    SENSOR_NOISE,
    compute_test_pose_errors,
    simulate_robot,
)
from hydrotele.kinematics.hybrid_error_model import apply_geometry_errors, build_error_model, refined_model_parameters
from hydrotele.kinematics.hybrid_robot import forward_kinematics, load_hybrid
from hydrotele.kinematics.wire_measurement import wire_lengths
from hydrotele.simulate.pose_measurements import (
    default_wires,
    sample_manufacturing_errors,
    sample_poses,
    simulate_measured_poses,
)

IWR = load_hybrid("iwr")
DOCUMENT = refined_model_parameters(build_error_model(IWR, "dh"))
PARTS = ("coverage", "all54", "noise", "poses", "choice", "posterior", "speed")


def coverage(trials: int) -> None:
    """Bias, standard deviation and 95 % intervals of the 36 parameters."""
    found, truth, deviations, inside, before, after = [], [], [], [], [], []
    for seed in range(trials):
        one = simulate_robot(3000 + seed, 25)
        fit = (done := calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)).fit
        at = one.model.parameter_indices(fit.names)
        found.append(fit.values)
        truth.append(one.errors[at])
        deviations.append(fit.standard_deviations)
        low, high = fit.intervals.T
        inside.append((one.errors[at] > low) & (one.errors[at] < high))
        before.append(compute_test_pose_errors(one, IWR)[0])
        after.append(compute_test_pose_errors(one, done.robot)[0])
    away = (np.array(found) - truth) / np.array(deviations)
    share = np.mean(inside, axis=0)
    bias = away.mean(axis=0) * np.sqrt(trials)
    print(f"{trials} trials, 36 parameters, 25 poses")
    print(
        f"95 % intervals contain {100 * np.mean(inside):.2f} % of the true errors;"
        f" per parameter {100 * share.min():.1f} to {100 * share.max():.1f} %"
    )
    print(
        f"largest ratio of bias to its standard error: {np.abs(bias).max():.2f} of 36;"
        f" ratio of standard deviation to the stated one {away.std(axis=0).min():.3f} to"
        f" {away.std(axis=0).max():.3f}"
    )
    _print_test_errors(before, after)


def _print_test_errors(before, after) -> None:
    rms = [1e3 * np.sqrt(np.mean(np.square(e), axis=1)) for e in (before, after)]
    largest = 1e3 * np.max(after, axis=1)
    print(
        f"25 test poses: RMS {np.median(rms[0]):.2f} mm before (smallest {rms[0].min():.2f}),"
        f" {np.median(rms[1]):.4f} mm after (largest trial {rms[1].max():.4f}); largest single"
        f" pose: median {np.median(largest):.4f}, of all {largest.max():.4f} mm; trials with every"
        f" pose below 0.1 mm: {100 * np.mean(largest < 0.1):.1f} %"
    )


def all54(trials: int) -> None:
    """The same with errors in all 54 parameters: the independent combinations."""
    for kind in ("dh", "poe"):
        inside, chi, before, after, ranks = [], [], [], [], set()
        for seed in range(trials):
            one = simulate_robot(4000 + seed, 25, kind, refined_only=False)
            done = calibrate_hybrid_robot(IWR, one.measurement, kind)
            fit, told = done.fit, done.fit.identifiability
            row = told.combination
            estimate = row @ fit.values
            size = np.sqrt(np.einsum("ij,jk,ik->i", row, fit.covariance, row))
            inside.append(np.abs(estimate - row @ one.errors) < fit.interval_quantile * size)
            chi.append(fit.chi)
            ranks.add(done.redundancy.rank)
            before.append(compute_test_pose_errors(one, IWR)[0])
            after.append(compute_test_pose_errors(one, done.robot)[0])
        print(
            f"{trials} trials, {kind}, 54 errors, rank {ranks}: 95 % intervals of the"
            f" combinations contain {100 * np.mean(inside):.2f} %; chi {np.mean(chi):.3f}"
        )
        _print_test_errors(before, after)


def noise(trials: int) -> None:
    """Error at poses not used against the noise of all sensors."""
    print("| noise of all sensors | RMS at test poses [mm] | largest [mm] |\n| --- | ---: | ---: |")
    for factor in (0.25, 0.5, 1.0, 2.0, 4.0):
        errors = []
        for seed in range(trials):
            one = simulate_robot(5000 + seed, 25, noise=factor)
            done = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
            errors.append(compute_test_pose_errors(one, done.robot)[0])
        print(f"| {factor:g} x | {1e3 * np.sqrt(np.mean(np.square(errors))):.4f} | {1e3 * np.max(errors):.4f} |")


def poses(trials: int) -> None:
    """Error at poses not used against the number of poses."""
    print("| poses | 36 parameters, RMS [mm] | 50 of 54, RMS [mm] | CPU time per calibration [s] |")
    print("| ---: | ---: | ---: | ---: |")
    for count in (15, 20, 25, 50, 100, 200):
        errors, whole, took = [], [], 0.0
        for seed in range(trials):
            one = simulate_robot(6000 + seed, count)
            begin = time.process_time()
            done = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
            took += time.process_time() - begin
            errors.append(compute_test_pose_errors(one, done.robot)[0])
            other = simulate_robot(6500 + seed, count, refined_only=False)
            whole.append(compute_test_pose_errors(other, calibrate_hybrid_robot(IWR, other.measurement, "dh").robot)[0])
        sizes = [1e3 * np.sqrt(np.mean(np.square(e))) for e in (errors, whole)]
        print(f"| {count} | {sizes[0]:.4f} | {sizes[1]:.4f} | {took / trials:.2f} |")


def choice(trials: int) -> None:
    """Chosen poses against random ones, 20 of 200."""
    wires, model = default_wires(), build_error_model(IWR, "dh")
    errors: dict[str, list] = {"random": [], "D": [], "O1": [], "O3": [], "O5": []}
    for seed in range(trials):
        rng = np.random.default_rng([77, seed])
        planted = sample_manufacturing_errors(model, rng)
        built = apply_geometry_errors(model, planted)
        joints, legs = sample_poses(IWR, 200, rng, wires)
        lengths = wire_lengths(wires, forward_kinematics(IWR, joints, legs))
        exact = measurement_from_wires(IWR, joints, legs, lengths, wires, SENSOR_NOISE, "candidates")
        unused = sample_poses(IWR, 50, rng, wires)
        for name, found in errors.items():
            places = (np.arange(20) if name == "random"
                      else select_informative_poses(model, exact, 20, name))  # fmt: skip
            read = simulate_measured_poses(built, joints[places], legs[places], wires, SENSOR_NOISE, rng)
            measured = measurement_from_wires(IWR, read.joints, read.legs, read.wires, wires, SENSOR_NOISE, name)
            robot = calibrate_hybrid_robot(IWR, measured, "dh").robot
            away = forward_kinematics(robot, *unused).position - forward_kinematics(built, *unused).position
            found.append(np.linalg.norm(away, axis=1))
    print("| 20 poses | RMS at 50 test poses [mm] | largest [mm] |\n| --- | ---: | ---: |")
    for name, found in errors.items():
        print(f"| {name} | {1e3 * np.sqrt(np.mean(np.square(found))):.4f} | {1e3 * np.max(found):.4f} |")


def posterior(trials: int) -> None:
    """Whether posteriors of MCMC hold the planted errors."""
    inside, agree = [], []
    for seed in range(trials):
        one = simulate_robot(7000 + seed, 25)
        done = calibrate_hybrid_robot(IWR, one.measurement, "dh", DOCUMENT)
        eq, fit = restrict_to_fitted_parameters(done), done.fit
        sample = sample_posterior(
            lambda x, eq=eq: -eq.negative_log_likelihood(x), fit.values, fit.covariance, eq.names, steps=4000,
            burn_in=500, seed=seed,
        )  # fmt: skip
        low, high = sample.intervals.T
        truth = one.errors[one.model.parameter_indices(fit.names)]
        inside.append((truth > low) & (truth < high))
        agree.append(np.abs(sample.mean - fit.values) / fit.standard_deviations)
    print(
        f"{trials} trials of MCMC: central 95 % contain {100 * np.mean(inside):.1f} % of the true"
        f" errors; means differ from least squares by at most {np.max(agree):.2f} standard"
        " deviations"
    )


def speed(trials: int) -> None:
    """Time of 1e5 likelihoods of the 54-parameter models on one core."""
    rng = np.random.default_rng(0)
    print("| model | poses | CPU time of 1e5 likelihoods on one core [s] |\n| --- | ---: | ---: |")
    for kind in ("dh", "poe"):
        for count in (25, 50, 100, 200):
            one = simulate_robot(8000, count, kind, refined_only=False)
            eq: PoseEquations = build_equations(build_error_model(IWR, kind), one.measurement)
            values = rng.normal(size=(100, 54)) * eq.scales
            eq.negative_log_likelihood(values)
            begin = time.process_time()
            for _ in range(100):
                eq.negative_log_likelihood(values)
            print(f"| {kind} | {count} | {10 * (time.process_time() - begin):.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--part", nargs="*", choices=PARTS, default=PARTS)
    chosen = parser.parse_args()
    for part in chosen.part:
        print(f"\n### {part}", flush=True)
        share = {"coverage": 1, "all54": 2, "posterior": 20}.get(part, 10)
        globals()[part](max(1, chosen.trials // share))


if __name__ == "__main__":
    main()

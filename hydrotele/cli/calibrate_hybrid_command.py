"""Implement `hydrotele calibrate hybrid`.

It calibrates a serial robot that carries a hexapod (parallel robot with six legs).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.hybrid_calibration import (
    Calibration,
    PoseErrors,
    calibrate_best_model,
    calibrate_hybrid_robot,
    pose_errors,
    restrict_to_fitted_parameters,
    select_informative_poses,
)
from hydrotele.calibrate.hybrid_measurement import (
    HELDOUT_STEM,
    POSES_STEM,
    find_robot_file,
    format_measurement_yaml,
    measurement_from_wires,
    read_measurement,
    save_measurement,
)
from hydrotele.calibrate.posterior_sampling import (
    MAX_STEPS,
    MIN_STEPS,
    EvolutionResult,
    Posterior,
    minimize_by_evolution,
    sample_posterior,
)
from hydrotele.cli.console import (
    ignore_stage,
    make_table,
    print_json,
    show_stages,
    stdout_console,
    write_json,
)
from hydrotele.cli.option_values import check_range
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.kinematics.hybrid_error_model import build_error_model, refined_model_parameters
from hydrotele.kinematics.hybrid_robot import (
    HybridRobot,
    UnreachableError,
    forward_kinematics,
    load_hybrid,
    save_hybrid,
)
from hydrotele.kinematics.wire_measurement import NoIntersectionError, wire_lengths

KIND = "hybrid calibration"
MEASUREMENT = "hybrid measurement"
CRITERIA = ("D", "O1", "O2", "O3", "O4", "O5")
MAX_SEED = 2**32 - 1  # of NumPy's RandomState, which emcee uses
MAX_ERROR_FACTOR = 50.0  # of 1 mm and 1 mrad: with larger errors the legs do not reach the poses
MAX_NOISE_FACTOR = 1000.0  # of 0.01 mm: larger noise is not that of a sensor
MAX_POSES = 100_000  # poses: 100 MB of equations
CANDIDATES = 200  # number of random poses from which the most informative are selected
SENSOR_NOISE = {
    "leg": 1e-5,
    "prismatic": 1e-5,
    "revolute": 2e-5,
    "wire": 2e-5,
}  # m, rad: models/iwr/README.md
SEARCH_BOX_SIGMAS = 8.0  # half width of the search box, in expected sizes of the manufacturing errors


def calibrate_hybrid(
    data: Path, robot: str | None, error_model: str, parameters: str, evolution: bool, mcmc_steps: int,
    seed: int, target: Path | None, as_json: bool,
) -> Calibration:  # fmt: skip
    """Calibrate a serial robot that carries a hexapod from measured poses; print and write the result.

    Args:
        data: folder with `poses.csv` or `poses.parquet`.
        robot: nominal robot, None for that of the folder, else `iwr`.
        error_model: error model: `dh` (Denavit-Hartenberg), `poe` (product of exponentials) or
            `auto` (the better one).
        parameters: parameters to fit: `all`, `document` (the 36 of Wang 2012) or names separated by
            commas.
        evolution: whether to search by differential evolution as well.
        mcmc_steps: number of MCMC steps to sample the posterior, 0 for no MCMC.
        seed: random seed of differential evolution and MCMC.
        target: output folder, None to write nothing.
        as_json: print JSON instead of text.

    Returns:
        The calibration by least squares, without the results of differential evolution and MCMC.

    Raises:
        InputError: the folder, the robot or an option is not usable.
    """
    if error_model not in ("auto", "dh", "poe"):
        raise InputError(f"--model {error_model}", "valid: auto, dh, poe")
    check_range("--seed", seed, 0, MAX_SEED, "random seed")
    if mcmc_steps:
        check_range("--posterior", mcmc_steps, MIN_STEPS, MAX_STEPS, "number of MCMC steps")
    if target:
        check_output_folder(target, KIND)
    nominal = load_hybrid(robot or find_robot_file(Path(data)) or "iwr")
    measurement, heldout = read_measurement(data, nominal)
    names = _parse_parameter_names(nominal, error_model, parameters)
    with show_stages("calibrate hybrid", as_json) as progress:
        report = progress or ignore_stage
        report("fit the robot", 0.0)
        if error_model == "auto":
            done = calibrate_best_model(nominal, measurement, names)
        else:
            done = calibrate_hybrid_robot(nominal, measurement, "dh" if error_model == "dh" else "poe", names)
        report("differential evolution", 0.3)
        evolved = _run_evolution(done, seed) if evolution else None
        report("MCMC", 0.6)
        posterior = _run_mcmc(done, mcmc_steps, seed) if mcmc_steps else None
    result = _hybrid_document(data, done, heldout, evolved, posterior)
    if target:
        with atomic_folder(target, KIND) as folder:
            _write_hybrid_files(folder, result, done, heldout, posterior)
    if as_json:
        print_json(result)
    else:
        _print_hybrid(result)
        if target:
            stdout_console.print(f"written to [bold]{target}[/]; robot.yaml there is the calibrated robot")
    return done


def _parse_parameter_names(nominal: HybridRobot, kind: str, parameters: str) -> tuple[str, ...] | None:
    if parameters == "all":
        return None
    model = build_error_model(nominal, "poe" if kind == "poe" or not nominal.specification.carriage else "dh")
    if parameters == "document":
        return refined_model_parameters(model)
    names = tuple(name.strip() for name in parameters.split(","))
    model.parameter_indices(names)
    return names


def _run_evolution(calibration: Calibration, seed: int) -> EvolutionResult:
    eq = restrict_to_fitted_parameters(calibration)
    return minimize_by_evolution(
        eq.negative_log_likelihood,
        -SEARCH_BOX_SIGMAS * eq.scales,
        SEARCH_BOX_SIGMAS * eq.scales,
        seed=seed,
    )


def _run_mcmc(calibration: Calibration, steps: int, seed: int) -> Posterior:
    eq, fit = restrict_to_fitted_parameters(calibration), calibration.fit
    free = ~fit.held
    noise = 1.0 if calibration.equations.measurement.noise_is_known else fit.noise
    return sample_posterior(
        lambda x: -eq.negative_log_likelihood(x) / noise**2, fit.values[free],
        fit.covariance[np.ix_(free, free)], eq.names, steps=steps, burn_in=steps // 4, seed=seed,
    )  # fmt: skip


def _hybrid_document(data, calibration: Calibration, heldout, evolved, posterior) -> dict[str, Any]:
    fit, model = calibration.fit, calibration.model
    held = dict(zip(fit.names, fit.held, strict=True))
    values = dict(zip(fit.names, fit.values, strict=True))
    deviations = dict(zip(fit.names, fit.standard_deviations, strict=True))
    intervals = dict(zip(fit.names, fit.intervals, strict=True))
    weak = [n for n in fit.names if not held[n] and n not in calibration.redundancy.determined_names]
    result: dict[str, Any] = {
        "robot": model.nominal.name, "data": str(data), "hydrotele": hydrotele.__version__,
        "model": model.kind, "poses": len(calibration.equations.measurement),
        "excluded_poses": list(calibration.inconsistent_rows),
        "noise": "stated" if calibration.equations.measurement.noise_is_known else "estimated",
        "chi": fit.chi, "degrees_of_freedom": fit.degrees_of_freedom, "iterations": fit.iterations,
        "converged": fit.converged, "status": fit.status, "warnings": list(calibration.warnings),
        "redundancy": {
            "parameters": len(fit.names), "rank": calibration.redundancy.rank,
            "redundant": list(calibration.redundancy.held_names),
            "involved": list(calibration.redundancy.redundant_names),
            "explanations": list(calibration.redundancy.explanations),
            "identifiable_at_noise": len(calibration.redundancy.determined_names),
            "poorly_identifiable": weak,
            "singular_values": calibration.redundancy.singular_values,
        },
        "not_identifiable": [n for n in fit.names if held[n]],
        "errors": {"before": calibration.nominal_errors.summarize(), "after": calibration.calibrated_errors.summarize(),
                   "leave_one_out": calibration.leave_one_out_errors.summarize()},
        "parameters": [
            {"name": name, "description": words, "unit": unit, "identified": not held[name],
             "value": values[name], "standard_deviation": deviations[name],
             "interval_95": intervals[name]}
            for name, words, unit in zip(model.names, model.descriptions, model.units, strict=True)
            if name in held
        ],
    }  # fmt: skip
    if heldout is not None:
        after, before = pose_errors(calibration.robot, heldout), pose_errors(model.nominal, heldout)
        result["heldout"] = _hybrid_heldout_document(len(heldout), before, after)
    free = ~fit.held
    if evolved is not None:
        away = np.abs(evolved.values - fit.values[free]) / fit.standard_deviations[free]
        result["evolution"] = {
            "generations": evolved.generations, "evaluations": evolved.evaluations,
            "converged": evolved.converged, "misfit": evolved.cost,
            "misfit_least_squares": float(
                restrict_to_fitted_parameters(calibration).negative_log_likelihood(fit.values[free][None])[0]),
            "max_difference_in_std": float(away.max()),
            "values": dict(zip(restrict_to_fitted_parameters(calibration).names, evolved.values.tolist(), strict=True)),
        }  # fmt: skip
    if posterior is not None:
        away = np.abs(posterior.mean - fit.values[free]) / fit.standard_deviations[free]
        result["posterior"] = {
            "converged": posterior.converged, "status": posterior.status,
            "steps": posterior.steps, "evaluations": posterior.evaluations,
            "acceptance": posterior.acceptance_fraction,
            "max_autocorrelation_time": posterior.autocorrelation.max(),
            "max_split_rhat": posterior.rhat.max(),
            "min_effective_size": posterior.effective_size.min(),
            "max_difference_in_std": float(away.max()),
            "parameters": [
                {"name": n, "mean": m, "standard_deviation": s, "interval_95": i,
                 "split_rhat": r, "effective_size": e}
                for n, m, s, i, r, e in zip(posterior.names, posterior.mean, posterior.standard_deviations,
                                            posterior.intervals, posterior.rhat,
                                            posterior.effective_size, strict=True)
            ],
        }  # fmt: skip
    return result


def _hybrid_heldout_document(count: int, before: PoseErrors, after: PoseErrors) -> dict[str, Any]:
    had, has = before.summarize(), after.summarize()
    return {
        "poses": count, "rms_mm": has["position_rms_mm"], "max_mm": has["position_max_mm"],
        "orientation_rms_mrad": has["orientation_rms_mrad"],
        "orientation_max_mrad": has["orientation_max_mrad"],
        "before_rms_mm": had["position_rms_mm"], "before_max_mm": had["position_max_mm"],
    }  # fmt: skip


def _write_hybrid_files(folder: Path, result, calibration: Calibration, heldout, posterior) -> None:
    from hydrotele.show.calibration_report import draw_pose_errors, draw_posterior

    write_json(folder / "calibration.json", result)
    save_hybrid(calibration.robot, folder / "robot.yaml", "calibrated by hydrotele calibrate hybrid")
    before, after, what = (
        calibration.nominal_errors,
        calibration.leave_one_out_errors,
        "poses, leave-one-out predictions",
    )
    if len(before.position) != len(after.position):
        after, what = calibration.calibrated_errors, "fitted poses"
    if heldout is not None:
        before, after = (
            pose_errors(calibration.model.nominal, heldout),
            pose_errors(calibration.robot, heldout),
        )
        what = "held-out poses"
    picture = draw_pose_errors(
        {"position [mm]": (1e3 * before.position, 1e3 * after.position),
         "orientation [mrad]": (1e3 * before.orientation, 1e3 * after.orientation)}, what,
    )  # fmt: skip
    (folder / "errors.png").write_bytes(picture)
    if posterior is not None:
        place = np.argsort(-np.abs(posterior.correlation - np.eye(len(posterior.names))).max(0))[:6]
        chosen = np.sort(place)
        sizes = [1e-3] * len(chosen)
        truth = calibration.fit.values[[calibration.fit.names.index(posterior.names[k]) for k in chosen]]
        image = draw_posterior(posterior.flat_sample[:, chosen] / sizes, [posterior.names[k] for k in chosen],
                       truth / sizes, "least squares")  # fmt: skip
        (folder / "posterior.png").write_bytes(image)
    summary = {"kind": KIND, "name": result["robot"], "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def _print_hybrid(result: dict[str, Any]) -> None:
    errors, told = result["errors"], result["redundancy"]
    shown = make_table(f"{result['robot']}: {result['poses']} poses, model {result['model']}",
                  "pose errors (lower is better)", "RMS mm", "max mm", "RMS mrad")  # fmt: skip
    rows = [("nominal", errors["before"]), ("calibrated", errors["after"]),
            ("leave-one-out prediction", errors["leave_one_out"])]  # fmt: skip
    for name, e in rows:
        shown.add_row(name, f"{e['position_rms_mm']:.3f}", f"{e['position_max_mm']:.3f}",
                      f"{e['orientation_rms_mrad']:.3f}")  # fmt: skip
    if "heldout" in result:
        h = result["heldout"]
        shown.add_row(f"{h['poses']} held-out poses, nominal", f"{h['before_rms_mm']:.3f}",
                      f"{h['before_max_mm']:.3f}", "")  # fmt: skip
        shown.add_row(f"{h['poses']} held-out poses, calibrated", f"{h['rms_mm']:.3f}",
                      f"{h['max_mm']:.3f}", f"{h['orientation_rms_mrad']:.3f}")  # fmt: skip
    stdout_console.print(shown)
    stdout_console.print(
        f"{told['parameters']} parameters, {told['rank']} independent; noise {result['noise']};"
        f" ratio of residuals to noise {result['chi']:.2f}"
    )
    for words in told["explanations"][:12]:
        stdout_console.print(f"  {words}")
    if result["not_identifiable"]:
        stdout_console.print(f"kept at their nominal values: {', '.join(result['not_identifiable'])}")
    if told["poorly_identifiable"]:
        names = ", ".join(told["poorly_identifiable"])
        stdout_console.print(f"poorly identifiable at this noise: {names}")
    if result["excluded_poses"]:
        rows_ = ", ".join(map(str, result["excluded_poses"]))
        stdout_console.print(f"excluded, because their measurements fit no calibration: rows {rows_}")
    for words in result["warnings"]:
        stdout_console.print(f"[yellow]warning[/] {words}")
    for key, name in (("evolution", "differential evolution"), ("posterior", "MCMC")):
        if key in result:
            one = result[key]
            said = one.get("status", "converged" if one["converged"] else "not converged")
            away = one["max_difference_in_std"]
            stdout_console.print(
                f"{name}: {said}; differs from least squares by at most {away:.2f} standard deviations"
            )


def simulate_hybrid_to_folder(
    target: Path, robot: str | None, poses: int, heldout: int, seed: int, noise: float,
    errors: float, parameters: str, error_model: str, choose: str = "random",
) -> None:  # fmt: skip
    """Simulate the measurement of a hexapod-carrying robot with manufacturing errors; write it to a folder.

    The true errors and the true robot are written to the subfolder `truth`.

    Args:
        target: output folder.
        robot: nominal robot, None for `iwr`.
        poses: number of poses for the calibration.
        heldout: number of held-out poses.
        seed: random seed of errors, poses and noise.
        noise: factor on the noise of all sensors.
        errors: factor on the manufacturing errors of 1 mm and 1 mrad.
        parameters: parameters with errors: `all`, `document` or names separated by commas.
        error_model: error model of the simulated errors: `auto`, `dh` or `poe`.
        choose: `random` poses, or a criterion of `select_informative_poses`.

    Raises:
        InputError: the folder cannot be written, or an option is not usable.
    """
    from hydrotele.kinematics.hybrid_error_model import apply_geometry_errors
    from hydrotele.simulate.pose_measurements import (
        default_wires,
        sample_manufacturing_errors,
        sample_poses,
        simulate_measured_poses,
    )

    if choose not in ("random", *CRITERIA):
        raise InputError(f"--choose {choose}", f"valid: random, {', '.join(CRITERIA)}")
    check_range("--seed", seed, 0, MAX_SEED, "random seed")
    check_range("--errors", errors, 0.0, MAX_ERROR_FACTOR, "factor on errors of 1 mm and 1 mrad")
    check_range("--noise", noise, 0.0, MAX_NOISE_FACTOR, "factor on the noise of the sensors")
    check_range("--poses", poses, 1, MAX_POSES, "number of poses")
    check_range("--heldout", heldout, 0, MAX_POSES, "number of poses")
    check_output_folder(target, MEASUREMENT)
    nominal = load_hybrid(robot or "iwr")
    error_model = (
        "dh"
        if error_model == "auto" and nominal.specification.carriage
        else "poe"
        if error_model == "auto"
        else error_model
    )
    names = _parse_parameter_names(nominal, error_model, parameters)
    model = build_error_model(nominal, "dh" if error_model == "dh" else "poe")
    rng, wires = np.random.default_rng(seed), default_wires()
    planted = sample_manufacturing_errors(model, rng, names, errors)
    true = apply_geometry_errors(model, planted)
    sizes = {key: noise * size for key, size in SENSOR_NOISE.items()}
    stated = sizes if noise > 0.0 else {}
    with atomic_folder(target, MEASUREMENT) as folder:
        for stem, count in ((POSES_STEM, poses), (HELDOUT_STEM, heldout)):
            if count:
                joints, legs = sample_poses(nominal, count, rng, wires)
                if stem == POSES_STEM and choose != "random":
                    joints, legs = _sample_informative_poses(model, wires, count, rng, choose)
                try:
                    read = simulate_measured_poses(true, joints, legs, wires, sizes, rng)
                except (UnreachableError, NoIntersectionError) as error:
                    raise InputError(
                        f"--errors {errors:g} --noise {noise:g}", f"{error}: reduce the errors or the noise"
                    ) from None
                save_measurement(folder, stem, nominal, read.joints, read.legs, wires=read.wires)
        (folder / "measurement.yaml").write_text(format_measurement_yaml(nominal.name, wires, stated))
        save_hybrid(nominal, folder / "robot.yaml", "nominal robot")
        (folder / "truth").mkdir()
        save_hybrid(true, folder / "truth" / "robot.yaml", "the robot that was simulated")
        text = json.dumps(dict(zip(model.names, planted.tolist(), strict=True)), indent=2)
        (folder / "truth" / "errors.json").write_text(text + "\n", encoding="utf-8")
        summary = {"kind": MEASUREMENT, "name": nominal.name, "hydrotele": hydrotele.__version__}
        write_json(folder / "summary.json", summary)
    stdout_console.print(f"written to [bold]{target}[/]: {poses} poses and {heldout} held-out poses")


def _sample_informative_poses(model, wires, count: int, rng: np.random.Generator, criterion: Any):
    """Sample random poses and return joint values and leg lengths of the `count` most informative ones.

    Args:
        model: error model of the nominal robot.
        wires: wire sensors that measure the poses.
        count: number of poses to select, out of 200 samples or more.
        rng: random generator of the samples.
        criterion: observability criterion to maximise: D or O1 to O5.
    """
    from hydrotele.simulate.pose_measurements import sample_poses

    robot = model.nominal
    joints, legs = sample_poses(robot, max(CANDIDATES, count), rng, wires)
    lengths = wire_lengths(wires, forward_kinematics(robot, joints, legs))
    candidates = measurement_from_wires(robot, joints, legs, lengths, wires, SENSOR_NOISE, "candidates")
    places = select_informative_poses(model, candidates, count, criterion)
    return joints[places], legs[places]

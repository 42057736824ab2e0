"""`hydrotele calibrate hybrid`: calibrate a serial-parallel robot, or simulate its measurement."""

import json
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.hybrid import (
    Calibration,
    Errors,
    best,
    calibrate,
    informative_poses,
    pose_errors,
    subset,
)
from hydrotele.calibrate.hybrid_data import (
    HELDOUT,
    POSES,
    measurement_of_wires,
    measurement_text,
    read_measurement,
    robot_file,
    save_measurement,
)
from hydrotele.calibrate.posterior import Evolution, Posterior, evolve, sample_posterior
from hydrotele.cli.console import notes, out, print_json, table, write_json
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.kinematics.hybrid import Hybrid, forward, load_hybrid, save_hybrid
from hydrotele.kinematics.hybrid_errors import document_parameters, error_model
from hydrotele.kinematics.wires import wire_lengths

KIND = "hybrid calibration"
MEASUREMENT = "hybrid measurement"
CRITERIA = ("D", "O1", "O2", "O3", "O4", "O5")
CANDIDATES = 200  # poses among which the best are chosen
NOISE = {"leg": 1e-5, "slide": 1e-5, "turn": 2e-5, "wire": 2e-5}  # m, rad: models/iwr/README.md
BOX = 8.0  # sizes of the errors of manufacture, that differential evolution searches


def calibrate_hybrid(
    data: Path, robot: str | None, kind: str, parameters: str, evolution: bool, steps: int,
    seed: int, target: Path | None, as_json: bool,
) -> Calibration:  # fmt: skip
    """Calibrate a hybrid robot from a folder of measurements; print and write the result.

    Args:
        data: the folder.
        robot: nominal robot; None for the folder's own, or `iwr`.
        kind: `auto`, `dh` or `poe`.
        parameters: `all`, `document` or names with commas.
        evolution: search by differential evolution, too.
        steps: of MCMC; 0 for none.
        seed: of both.
        target: folder to write; None for none.
        as_json: print JSON.

    Returns:
        The calibration.

    Raises:
        InputError: the folder, the robot or a choice is not usable.
    """
    if kind not in ("auto", "dh", "poe"):
        raise InputError(f"--model {kind}", "valid: auto, dh, poe")
    if target:
        check_target(target, KIND)
    nominal = load_hybrid(robot or robot_file(Path(data)) or "iwr")
    measurement, heldout = read_measurement(data, nominal)
    names = _names(nominal, kind, parameters)
    if kind == "auto":
        done = best(nominal, measurement, names)
    else:
        done = calibrate(nominal, measurement, "dh" if kind == "dh" else "poe", names)
    evolved = _evolved(done, seed) if evolution else None
    posterior = _posterior(done, steps, seed) if steps else None
    result = _result(data, done, heldout, evolved, posterior)
    if target:
        with whole_folder(target, KIND) as folder:
            _write(folder, result, done, heldout, posterior)
    if as_json:
        print_json(result)
    else:
        _print(result)
        if target:
            out.print(f"written to [bold]{target}[/]; robot.yaml there is the calibrated robot")
    return done


def _names(nominal: Hybrid, kind: str, parameters: str) -> tuple[str, ...] | None:
    if parameters == "all":
        return None
    model = error_model(nominal, "poe" if kind == "poe" or not nominal.facts.carriage else "dh")
    if parameters == "document":
        return document_parameters(model)
    names = tuple(name.strip() for name in parameters.split(","))
    model.index(names)
    return names


def _evolved(done: Calibration, seed: int) -> Evolution:
    eq = subset(done)
    notes.print("differential evolution ...", style="dim")
    return evolve(eq.misfit, -BOX * eq.scales, BOX * eq.scales, seed=seed)


def _posterior(done: Calibration, steps: int, seed: int) -> Posterior:
    eq, fit = subset(done), done.fit
    notes.print("MCMC ...", style="dim")
    free = ~fit.held
    noise = 1.0 if done.equations.measurement.stated else fit.noise
    return sample_posterior(
        lambda x: -eq.misfit(x) / noise**2, fit.values[free],
        fit.covariance[np.ix_(free, free)], eq.names, steps=steps, burn=steps // 4, seed=seed,
    )  # fmt: skip


def _result(data, done: Calibration, heldout, evolved, posterior) -> dict[str, Any]:
    fit, model = done.fit, done.model
    held = dict(zip(fit.names, fit.held, strict=True))
    values = dict(zip(fit.names, fit.values, strict=True))
    deviations = dict(zip(fit.names, fit.deviations, strict=True))
    intervals = dict(zip(fit.names, fit.intervals, strict=True))
    weak = [n for n in fit.names if not held[n] and n not in done.redundancy.told]
    result: dict[str, Any] = {
        "robot": model.nominal.name, "data": str(data), "hydrotele": hydrotele.__version__,
        "model": model.kind, "poses": len(done.equations.measurement),
        "poses_left_out_as_wrong": list(done.wrong),
        "noise": "stated" if done.equations.measurement.stated else "estimated",
        "chi": fit.chi, "degrees_of_freedom": fit.freedom, "iterations": fit.iterations,
        "converged": fit.converged, "status": fit.status, "warnings": list(done.warnings),
        "redundancy": {
            "parameters": len(fit.names), "rank": done.redundancy.rank,
            "redundant": list(done.redundancy.held), "take_part": list(done.redundancy.takes_part),
            "words": list(done.redundancy.words), "told_at_this_noise": len(done.redundancy.told),
            "hidden_by_the_noise": weak,
            "singular_values": done.redundancy.singular,
        },
        "unknown": [n for n in fit.names if held[n]],
        "errors": {"before": done.before.summary(), "after": done.after.summary(),
                   "left_out": done.left_out.summary()},
        "parameters": [
            {"name": name, "words": words, "unit": unit, "identified": not held[name],
             "value": values[name], "standard_deviation": deviations[name],
             "interval_95": intervals[name]}
            for name, words, unit in zip(model.names, model.words, model.units, strict=True)
            if name in held
        ],
    }  # fmt: skip
    if heldout is not None:
        after, before = pose_errors(done.robot, heldout), pose_errors(model.nominal, heldout)
        result["heldout"] = _heldout(len(heldout), before, after)
    free = ~fit.held
    if evolved is not None:
        away = np.abs(evolved.values - fit.values[free]) / fit.deviations[free]
        result["evolution"] = {
            "generations": evolved.generations, "evaluations": evolved.evaluations,
            "converged": evolved.converged, "misfit": evolved.cost,
            "misfit_least_squares": float(subset(done).misfit(fit.values[free][None])[0]),
            "largest_difference_in_deviations": float(away.max()),
            "values": dict(zip(subset(done).names, evolved.values.tolist(), strict=True)),
        }  # fmt: skip
    if posterior is not None:
        away = np.abs(posterior.mean - fit.values[free]) / fit.deviations[free]
        result["posterior"] = {
            "converged": posterior.converged, "status": posterior.status,
            "steps": posterior.steps, "evaluations": posterior.evaluations,
            "acceptance": posterior.acceptance,
            "largest_autocorrelation_time": posterior.autocorrelation.max(),
            "largest_split_rhat": posterior.rhat.max(),
            "least_effective_size": posterior.effective.min(),
            "largest_difference_in_deviations": float(away.max()),
            "parameters": [
                {"name": n, "mean": m, "standard_deviation": s, "interval_95": i,
                 "split_rhat": r, "effective_size": e}
                for n, m, s, i, r, e in zip(posterior.names, posterior.mean, posterior.deviations,
                                            posterior.intervals, posterior.rhat,
                                            posterior.effective, strict=True)
            ],
        }  # fmt: skip
    return result


def _heldout(count: int, before: Errors, after: Errors) -> dict[str, Any]:
    had, has = before.summary(), after.summary()
    return {
        "poses": count, "rms_mm": has["position_rms_mm"], "max_mm": has["position_max_mm"],
        "orientation_rms_mrad": has["orientation_rms_mrad"],
        "orientation_max_mrad": has["orientation_max_mrad"],
        "before_rms_mm": had["position_rms_mm"], "before_max_mm": had["position_max_mm"],
    }  # fmt: skip


def _write(folder: Path, result, done: Calibration, heldout, posterior) -> None:
    from hydrotele.show.calibration_report import corner, error_bars

    write_json(folder / "calibration.json", result)
    save_hybrid(done.robot, folder / "robot.yaml", "calibrated by hydrotele calibrate hybrid")
    before, after, what = done.before, done.left_out, "poses, each predicted without itself"
    if len(before.position) != len(after.position):
        after, what = done.after, "poses of the calibration"
    if heldout is not None:
        before, after = pose_errors(done.model.nominal, heldout), pose_errors(done.robot, heldout)
        what = "poses not used"
    picture = error_bars(
        {"position [mm]": (1e3 * before.position, 1e3 * after.position),
         "orientation [mrad]": (1e3 * before.orientation, 1e3 * after.orientation)}, what,
    )  # fmt: skip
    (folder / "errors.png").write_bytes(picture)
    if posterior is not None:
        place = np.argsort(-np.abs(posterior.correlation - np.eye(len(posterior.names))).max(0))[:6]
        chosen = np.sort(place)
        sizes = [1e-3] * len(chosen)
        truth = done.fit.values[[done.fit.names.index(posterior.names[k]) for k in chosen]]
        image = corner(posterior.flat[:, chosen] / sizes, [posterior.names[k] for k in chosen],
                       truth / sizes, "least squares")  # fmt: skip
        (folder / "posterior.png").write_bytes(image)
    summary = {"kind": KIND, "name": result["robot"], "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def _print(result: dict[str, Any]) -> None:
    errors, told = result["errors"], result["redundancy"]
    shown = table(f"{result['robot']}: {result['poses']} poses, model {result['model']}",
                  "errors of the pose", "RMS mm", "max mm", "RMS mrad")  # fmt: skip
    rows = [("nominal", errors["before"]), ("calibrated", errors["after"]),
            ("each pose predicted without itself", errors["left_out"])]  # fmt: skip
    for name, e in rows:
        shown.add_row(name, f"{e['position_rms_mm']:.3f}", f"{e['position_max_mm']:.3f}",
                      f"{e['orientation_rms_mrad']:.3f}")  # fmt: skip
    if "heldout" in result:
        h = result["heldout"]
        shown.add_row(f"{h['poses']} poses not used, nominal", f"{h['before_rms_mm']:.3f}",
                      f"{h['before_max_mm']:.3f}", "")  # fmt: skip
        shown.add_row(f"{h['poses']} poses not used, calibrated", f"{h['rms_mm']:.3f}",
                      f"{h['max_mm']:.3f}", f"{h['orientation_rms_mrad']:.3f}")  # fmt: skip
    out.print(shown)
    out.print(
        f"{told['parameters']} parameters, {told['rank']} independent; noise {result['noise']},"
        f" chi {result['chi']:.2f}"
    )
    for words in told["words"][:12]:
        out.print(f"  {words}")
    if result["unknown"]:
        out.print(f"keep their nominal values: {', '.join(result['unknown'])}")
    if told["hidden_by_the_noise"]:
        out.print(f"hardly told at this noise: {', '.join(told['hidden_by_the_noise'])}")
    if result["poses_left_out_as_wrong"]:
        rows_ = ", ".join(map(str, result["poses_left_out_as_wrong"]))
        out.print(f"left out, as their readings fit no calibration: rows {rows_}")
    for words in result["warnings"]:
        out.print(f"[yellow]warning[/] {words}")
    for key, name in (("evolution", "differential evolution"), ("posterior", "MCMC")):
        if key in result:
            one = result[key]
            said = one.get("status", "converged" if one["converged"] else "not converged")
            away = one["largest_difference_in_deviations"]
            out.print(f"{name}: {said}; least squares differs by at most {away:.2f} deviations")


def simulate_hybrid(
    target: Path, robot: str | None, poses: int, heldout: int, seed: int, noise: float,
    errors: float, parameters: str, kind: str, choose: str = "random",
) -> None:  # fmt: skip
    """Write a simulated measurement of a robot with errors of manufacture, and its truth apart.

    Args:
        target: folder to write.
        robot: nominal; None for `iwr`.
        poses: to calibrate from.
        heldout: poses to judge on.
        seed: of errors, poses and noise.
        noise: factor on the noise of all sensors.
        errors: factor on the errors of manufacture of 1 mm and 1 mrad.
        parameters: `all`, `document` or names: which have errors.
        kind: error model of the planted errors, `dh` or `poe`.
        choose: `random` poses, or a criterion of `informative_poses`.

    Raises:
        InputError: the folder cannot be written, or a choice is not usable.
    """
    from hydrotele.kinematics.hybrid_errors import corrected
    from hydrotele.simulate.hybrid import (
        manufactured_errors,
        measured_poses,
        random_poses,
        shipped_wires,
    )

    if choose not in ("random", *CRITERIA):
        raise InputError(f"--choose {choose}", f"valid: random, {', '.join(CRITERIA)}")
    check_target(target, MEASUREMENT)
    nominal = load_hybrid(robot or "iwr")
    kind = "dh" if kind == "auto" and nominal.facts.carriage else "poe" if kind == "auto" else kind
    names = _names(nominal, kind, parameters)
    model = error_model(nominal, "dh" if kind == "dh" else "poe")
    rng, wires = np.random.default_rng(seed), shipped_wires()
    planted = manufactured_errors(model, rng, names, errors)
    true = corrected(model, planted)
    sizes = {key: noise * size for key, size in NOISE.items()}
    stated = sizes if noise > 0.0 else {}
    with whole_folder(target, MEASUREMENT) as folder:
        for stem, count in ((POSES, poses), (HELDOUT, heldout)):
            if count:
                joints, legs = random_poses(nominal, count, rng, wires)
                if stem == POSES and choose != "random":
                    joints, legs = _chosen(model, wires, count, rng, choose)
                read = measured_poses(true, joints, legs, wires, sizes, rng)
                save_measurement(folder, stem, nominal, read.joints, read.legs, wires=read.wires)
        (folder / "measurement.yaml").write_text(measurement_text(nominal.name, wires, stated))
        save_hybrid(nominal, folder / "robot.yaml", "nominal robot")
        (folder / "truth").mkdir()
        save_hybrid(true, folder / "truth" / "robot.yaml", "the robot that was simulated")
        text = json.dumps(dict(zip(model.names, planted.tolist(), strict=True)), indent=2)
        (folder / "truth" / "errors.json").write_text(text + "\n", encoding="utf-8")
        summary = {"kind": MEASUREMENT, "name": nominal.name, "hydrotele": hydrotele.__version__}
        write_json(folder / "summary.json", summary)
    out.print(f"written to [bold]{target}[/]: {poses} poses and {heldout} to judge on")


def _chosen(model, wires, count: int, rng: np.random.Generator, criterion: Any):
    """Commands of the most informative poses among random ones: joints and leg readings."""
    from hydrotele.simulate.hybrid import random_poses

    robot = model.nominal
    joints, legs = random_poses(robot, max(CANDIDATES, count), rng, wires)
    lengths = wire_lengths(wires, forward(robot, joints, legs))
    candidates = measurement_of_wires(robot, joints, legs, lengths, wires, NOISE, "candidates")
    places = informative_poses(model, candidates, count, criterion)
    return joints[places], legs[places]

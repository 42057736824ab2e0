"""Simulate the calibration of the machine in Khoshzaban 1992, section 3.8.

A calibrator, a passive arm with angle sensors, closes the chain from the tool to the chassis. In
each stage one link moves, and the others are held. The nominal machine is the true one, as in the
thesis: "we consider the nominal model to behave like the actual system" (p. 67). The calibrator's
joints 5 and 6 bend when the stick is retracted (p. 69); the thesis does not give the size. As in
the thesis, poses whose readings differ visibly from the nominal model are excluded before the arm
is identified again.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hydrotele.calibrate.arm_identification import ArmFit, identify_arm, initial_parameters
from hydrotele.calibrate.arm_poses import Poses, add_held_link_drift
from hydrotele.calibrate.bad_data import identify_without_bad_data, predict_reading_from_others
from hydrotele.calibrate.calibration_loop import (
    CalibrationLoop,
    build_loop,
    closure_error,
    frame_after_links,
    link_chain,
)
from hydrotele.calibrate.link_sweeps import SweepPoses, generate_sweep_poses
from hydrotele.calibrate.linkage_identification import (
    PARAMETER_NAMES,
    AxisStrokes,
    compute_angles_from_calibrator,
    identify_linkage,
    linkage_parameters,
)
from hydrotele.experiments.calibrator_readings import (
    MAX_RESOLVER_ERROR,
    compute_retraction_bends,
    find_true_parameters,
    perturb_loop,
    sample_sweeps,
    simulate_readings,
)
from hydrotele.experiments.comparison import Changes, Panel, Sample, merge_settings
from hydrotele.experiments.khoshzaban_arm import (
    IDENTIFIABLE_PARAMETERS,
    LENGTH_PARAMETERS,
    SIMULATED_STAGES,
    STAGE_PARAMETERS,
    TWIST_PARAMETERS,
    compute_rms,
)
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.serial_chain import chain_poses
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine

SETTINGS = {
    "drift": True, "accuracy": MAX_RESOLVER_ERROR, "bend": (2.0, 6.0),
    "bent": ("grapple", "calibrator_yoke"), "removal": True, "tape": 0.005, "transducer": 0.002,
    "built": 0.0, "poses": 1.0,
}  # fmt: skip
"""Settings of `measure_calibration_errors` and `measure_bend_detection`.

- `drift`: whether held links drift.
- `accuracy`: largest error of the angle sensors [rad].
- `bend`: range of the bends at the largest stick angle [deg]. Assumed: Fig. 20 (p. 68), whose axes
  span 30 deg, shows a large one.
- `bent`: joints that bend.
- `removal`: whether bent poses are excluded.
- `tape`: standard deviation of the tape measure [m], assumed.
- `transducer`: largest error of the linear transducers (p. 21) [m].
- `built`: standard deviation of the true machine's lengths from nominal [m]; its angles have
  1 deg per 30 mm.
- `poses`: fraction of the document's number of poses.
"""

NO_FAULTS = {"bend": (0.0, 0.0), "drift": False}
"""Changes that leave sensor noise as the only error."""

END_POINT_LINKS = {"stick": 3, "grapple": 5}
"""End point -> number of links up to it."""

SIDES = ("manipulator", "calibrator")
MIN_VISIBLE_DIFFERENCE = np.radians(1.0)
"""Difference at the yoke above which a pose is excluded [rad]; the axes of Khoshzaban 1992, Fig. 20 span 30 deg."""

_TAPED_DISTANCES = 19  # number of taped distances, p. 65


class ArmModel(NamedTuple):
    """Kinematic parameters of machine and calibrator, from which the positions of end points are computed.

    Attributes:
        values: (N, 5) offset [rad], alpha [rad], a [m], d [m], beta [rad] of each link.
        ball: (3,) position of the calibrator's ball joint in frame 0, that of the chassis [m].
        pitch: angle at which joint 4, which has no sensor, is held [rad].
    """

    values: np.ndarray
    ball: np.ndarray
    pitch: float


class Calibration(NamedTuple):
    """Data and results of a calibration with and without the poses of bent joints.

    Attributes:
        loop: nominal chain.
        true_loop: true chain.
        true_poses: true poses of every stage.
        bent_poses: (M,) whether calibrator joints bend in each pose of the stage in which the stick moves.
        stages: readings of every stage, with the drift of held links.
        kept_stages: readings without the excluded poses.
        fits: results `identified` (all poses) and `reidentified` (kept poses); empty before the
            identification.
    """

    loop: CalibrationLoop
    true_loop: CalibrationLoop
    true_poses: list[SweepPoses]
    bent_poses: np.ndarray
    stages: list[Poses]
    kept_stages: list[Poses]
    fits: Mapping[str, ArmFit] = {}


def simulate_stages(seed: int, settings: Mapping[str, Any], rng: np.random.Generator) -> Calibration:
    """Simulate the readings of all calibration stages, and exclude poses in which joints visibly bend.

    Args:
        seed: seed of the poses.
        settings: values of `SETTINGS`.
        rng: random generator of manufacturing errors, sweeps, bends and sensor errors.

    Returns:
        True poses and readings, without results.
    """
    loop = build_loop(load_machine("calibrator"))
    built = settings["built"]
    true = perturb_loop(loop, rng, built, built / 0.03) if built else loop
    sweeps = sample_sweeps(rng, settings["drift"], settings["poses"])
    clean = [generate_sweep_poses(true, link, sweeps[link], seed) for link in IDENTIFIABLE_PARAMETERS]
    low, high = np.radians(settings["bend"])
    sizes = {joint: rng.uniform(low, high) * rng.choice([-1.0, 1.0]) for joint in settings["bent"]}
    stages, inside = [], np.zeros(0, bool)
    for one in clean:
        extra, bent = compute_retraction_bends(true, one, sizes)
        readings = simulate_readings(true, one, rng, settings["accuracy"], extra)
        stages.append(add_held_link_drift(loop, readings))
        inside = bent if one.link == "stick" else inside
    kept = [exclude_bent_poses(loop, one) for one in stages] if settings["removal"] else stages
    return Calibration(loop, true, clean, inside, stages, kept)


def identify_with_and_without_bends(calibration: Calibration) -> dict[str, ArmFit]:
    """Return the arm identified from all poses (`identified`) and from the kept poses (`reidentified`).

    Kept poses are those that `exclude_bent_poses` leaves. The drift of held links is not modelled.
    """
    used = {"identified": calibration.stages, "reidentified": calibration.kept_stages}
    return {
        name: identify_arm(calibration.loop, [replace(s, drift=None) for s in poses], weighted=False,
                           parameters_by_link=STAGE_PARAMETERS)
        for name, poses in used.items()
    }  # fmt: skip


def exclude_bent_poses(loop: CalibrationLoop, stage: Poses) -> Poses:
    """Return a stage without the poses in which the readings differ by 1 deg or more from the nominal model.

    The closure error is the distance between the ball and the end of the chain at the measured angles. A
    pose is excluded if this error reaches the displacement of the ball that a yoke rotation of 1 deg
    causes. The stage in which joint 4 moves, which has no sensor, is returned unchanged.

    Args:
        loop: nominal chain.
        stage: readings while one link moves.
    """
    if stage.link not in SIMULATED_STAGES:
        return stage
    theta = _compute_joint_angles(loop, ArmModel(loop.values, loop.ball, float(loop.home[3])), stage)
    gap = np.linalg.norm(closure_error(loop, theta)[0], axis=1)
    place, _ = frame_after_links(loop, END_POINT_LINKS["grapple"], theta)
    return stage.select(gap < MIN_VISIBLE_DIFFERENCE * np.linalg.norm(loop.ball - place, axis=1))


def measure_calibration_errors(seed: int, changes: Changes) -> Sample:
    """Calibrate a machine with and without the poses in which joints visibly bend; return the errors of both.

    The bending is a simulated fault: the measured angles of calibrator joints change if the stick is
    retracted.

    Args:
        seed: seed of sweeps, bends and sensor errors.
        changes: changes of `SETTINGS`: drift, sensor errors, bends and other conditions.

    Returns:
        Errors of identified parameters, of end-point positions, of their distances to the ball, and of
        the cylinder triangles, for the models `identified` (all poses) and `reidentified` (without bent
        poses), and curves of these quantities.
    """
    chosen = merge_settings(SETTINGS, changes)
    rng = np.random.default_rng([38, seed])
    done = simulate_stages(seed, chosen, rng)
    done = done._replace(fits=identify_with_and_without_bends(done))
    values, panels = {}, []
    for name, fit in done.fits.items():
        values |= _compute_parameter_errors(done, name, fit)
    for part in (_compare_calibrator_readings(done), _compare_end_points(done),
                 _compare_distances(done, chosen["tape"], rng),
                 _identify_cylinder_triangles(done, chosen, rng)):  # fmt: skip
        values |= part.values
        panels += part.panels
    return Sample(values, tuple(panels))


def measure_bend_detection(seed: int, changes: Changes) -> Sample:
    """Find poses with bent joints by the closure equations alone, and by comparison with the nominal model.

    Args:
        seed: seed of sweeps, bends and sensor errors.
        changes: changes of `SETTINGS`: drift, sensor errors, bends and other conditions.

    Returns:
        With the equations alone: `overlap` of detected and truly bent poses of the stick's stage
        (intersection over union), and `blamed`: 1 if at least one joint is detected and all detected
        joints truly bend, else 0. With the nominal model: `left out`, the fraction of the truly bent
        poses that are excluded.
    """
    chosen = merge_settings(SETTINGS, changes)
    done = simulate_stages(seed, chosen, np.random.default_rng([38, seed]))
    cleaned = identify_without_bad_data(done.loop, done.stages)
    marked, joints = np.zeros(len(done.bent_poses), bool), set()
    for region in cleaned.regions:
        joints.add(region.joint)
        if region.link == "stick":
            marked[region.first : region.last + 1] = True
    kept = next(one for one in done.kept_stages if one.link == "stick")
    left_out = np.zeros(len(done.bent_poses), bool)
    if kept.rows is not None:
        left_out[:] = True
        left_out[kept.rows] = False
    both = (marked & done.bent_poses).sum() / max(1, (marked | done.bent_poses).sum())
    return Sample({
        "overlap": float(both), "blamed": float(bool(joints) and joints <= set(chosen["bent"])),
        "left out": float(left_out[done.bent_poses].mean()),
    })  # fmt: skip


def _compute_parameter_errors(calibration: Calibration, model: str, fit: ArmFit) -> dict[str, float]:
    """Return the parameter errors of one fit (identified minus true) [m] or [rad].

    RMS values of alpha, beta, all twists and all lengths, and the solver iterations of each stage are
    returned as well. `model` is the prefix of all names, `identified` or `reidentified`.
    """
    truth = dict(zip(fit.names, find_true_parameters(calibration.true_loop, calibration.loop, fit.names,
    calibration.true_poses),
                     strict=True))  # fmt: skip
    ball = calibration.true_loop.ball
    truth |= {"p_xy.swing": float(np.hypot(*ball[:2])), "p_z.swing": float(ball[2])}
    errors = {name: fit.value(name) - truth[name] for name in fit.names}
    found = {f"{model}.error.{name}": value for name, value in errors.items()}
    for kind in ("alpha", "beta"):
        found[f"{model}.{kind}"] = compute_rms([errors[name] for name in TWIST_PARAMETERS if name.startswith(kind)])
    found[f"{model}.lengths"] = compute_rms([errors[name] for name in LENGTH_PARAMETERS])
    found[f"{model}.twists"] = compute_rms([errors[name] for name in TWIST_PARAMETERS])
    for stage in fit.stages:
        found[f"{model}.iterations.{stage.link}"] = float(stage.iterations)
    return found


def _compare_calibrator_readings(calibration: Calibration) -> Sample:
    """Compare each calibrator reading with that predicted from the other sensors, while the stick moves.

    The prediction uses the nominal model. RMS differences [deg] are returned for poses in which joints
    truly bend (`inside.JOINT`) and for all others (`outside.JOINT`), for joints 5 to 8. Panels show
    readings and predictions.
    """
    loop, inside = calibration.loop, calibration.bent_poses
    stage = next(one for one in calibration.stages if one.link == "stick")
    predicted = predict_reading_from_others(loop, stage, _compute_nominal_stage_parameters(loop, stage))
    difference = np.degrees(stage.theta - predicted)
    pose = np.arange(len(stage), dtype=float)
    values, panels = (
        {},
        [
            Panel(
                "stick angle [deg]",
                pose,
                {"stick": np.degrees(stage.manipulator["stick"])},
                "pose [1]",
                discrete=True,
            )
        ],
    )
    for k, name in enumerate(loop.links[loop.powered_count :]):
        values[f"inside.{5 + k}"] = compute_rms(difference[inside, k])
        values[f"outside.{5 + k}"] = compute_rms(difference[~inside, k])
        panels.append(Panel(
            f"joint {5 + k}, {name} [deg]", pose,
            {"sensor": np.degrees(stage.theta[:, k]), "predicted": np.degrees(predicted[:, k])},
            "pose [1]", discrete=True, errors={"sensor minus prediction": difference[:, k]},
            error_label="difference [deg]",
        ))  # fmt: skip
    return Sample(values, tuple(panels))


def _compute_nominal_stage_parameters(loop: CalibrationLoop, stage: Poses) -> dict[str, float]:
    """Return the nominal parameters of one stage, with the ball's distance and height from the moving joint.

    Distance `p_xy` and height `p_z` follow from the nominal chain and the median readings of the held
    manipulator joints between chassis and moving link.
    """
    theta = loop.home[None].copy()
    place = loop.links.index(stage.link)
    for k, link in enumerate(loop.links[:place]):
        theta[0, k] = float(np.median(stage.manipulator[link])) + loop.values[k, 0]
    origin, turn = frame_after_links(loop, place, theta)
    ball = turn[0].T @ (loop.ball - origin[0])
    numbers = initial_parameters(loop, [stage])
    return numbers | {f"p_xy.{stage.link}": float(np.hypot(*ball[:2])),
                      f"p_z.{stage.link}": float(ball[2])}  # fmt: skip


def _select_arm_model(calibration: Calibration, name: str) -> ArmModel:
    if name == "nominal":
        return ArmModel(calibration.loop.values, calibration.loop.ball, float(calibration.loop.home[3]))
    fit = calibration.fits[name]
    return ArmModel(fit.loop.values, fit.loop.ball, fit.value("held.pitch"))


def _compute_joint_angles(loop: CalibrationLoop, model: ArmModel, stage: Poses) -> np.ndarray:
    """Return the joint angles (M, N) of M poses: the readings of all sensors plus their offsets [rad].

    Joint 4 (pitch) has no sensor; its angle is the constant one of `model`. The offsets of the calibrator's
    sensors are those of `model`, those of the manipulator's sensors are those of `loop`, the nominal chain.
    """
    theta = np.empty((len(stage), len(loop)))
    for k, link in enumerate(loop.links[: loop.powered_count]):
        unsensed = link == "pitch"
        theta[:, k] = model.pitch if unsensed else stage.manipulator[link] + loop.values[k, 0]
    theta[:, loop.powered_count :] = stage.theta + model.values[loop.powered_count :, 0]
    return theta


def compute_end_position(model: ArmModel, theta: np.ndarray, side: str, links: int) -> np.ndarray:
    """Return the position of an end point relative to the calibrator's ball joint.

    Args:
        model: kinematic parameters.
        theta: (M, N) joint angles [rad].
        side: joints from which the position is computed. `manipulator`: those between chassis and end
            point; the position is in frame 0. `calibrator`: those between end point and ball joint; the
            position is in the frame of the calibrator's last link.
        links: number of links from the chassis to the end point.

    Returns:
        (M, 3) [m].
    """
    if side == "manipulator":
        return chain_poses(link_chain(model.values[:links]), theta[:, :links]).position - model.ball
    origin, turn = chain_poses(link_chain(model.values[links:]), theta[:, links:])
    return np.einsum("mji,mj->mi", turn, -origin)


def _compare_end_points(calibration: Calibration) -> Sample:
    """Compare the end-point positions of both identified models with those of the nominal one.

    RMS distances [m] are returned as `MODEL.position.SIDE.END` for the models `identified` and
    `reidentified`, for the ends of stick and grapple, computed from the joints of manipulator or
    calibrator. Panels show the coordinates of the re-identified and the nominal model.
    """
    nominal, values, panels = _select_arm_model(calibration, "nominal"), {}, []
    used = {"identified": calibration.stages, "reidentified": calibration.kept_stages}
    for name, stages in used.items():
        model = _select_arm_model(calibration, name)
        stages = [stage for stage in stages if stage.link in SIMULATED_STAGES]
        for end, links in END_POINT_LINKS.items():
            for side in SIDES:
                both = [np.concatenate([
                    compute_end_position(m, _compute_joint_angles(calibration.loop, m, stage), side,
                    links) for stage in stages
                ]) for m in (nominal, model)]  # fmt: skip
                error = both[1] - both[0]
                size = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
                values[f"{name}.position.{side}.{end}"] = size
                if name == "reidentified" and side == "manipulator":
                    pose = np.arange(len(error), dtype=float)
                    panels += [
                        Panel(f"{end}'s end, {axis} [m]", pose,
                              {"nominal": both[0][:, k], "re-identified": both[1][:, k]},
                              "pose [1]", discrete=True,
                              errors={"re-identified minus nominal": error[:, k]},
                              error_label="difference [m]")
                        for k, axis in enumerate("xyz")
                    ]  # fmt: skip
    return Sample(values, tuple(panels))


def _compare_distances(calibration: Calibration, tape: float, rng: np.random.Generator) -> Sample:
    """Compare distances from end points to the ball, computed by each model, with a simulated tape measure.

    The tape has normal errors with the standard deviation `tape` [m]. The models are the nominal one and
    those identified with and without the bent poses. RMS errors [m] and variances accounted for [%] are
    returned as `MODEL.SIDE.END.rms` and `.vaf`. For the stick's end from the manipulator's joints, the RMS
    errors of the poses with distances above and below the median are `far` and `near`.
    """
    pairs = [(one, stage) for one, stage in zip(calibration.true_poses, calibration.stages, strict=True)
             if stage.link in SIMULATED_STAGES]  # fmt: skip
    truth = np.concatenate([one.theta for one, _ in pairs])
    chosen = np.linspace(0, len(truth) - 1, _TAPED_DISTANCES).astype(int)
    actual = ArmModel(calibration.true_loop.values, calibration.true_loop.ball, 0.0)
    values, curves = {}, {}
    for end, links in END_POINT_LINKS.items():
        taped = np.linalg.norm(compute_end_position(actual, truth[chosen], "manipulator", links), axis=1)
        taped = taped + tape * rng.standard_normal(_TAPED_DISTANCES)
        for name in ("nominal", "identified", "reidentified"):
            model = _select_arm_model(calibration, name)
            theta = np.concatenate([_compute_joint_angles(calibration.loop, model, stage) for _, stage in pairs])[
                chosen
            ]
            for side in SIDES:
                ours = np.linalg.norm(compute_end_position(model, theta, side, links), axis=1)
                error = ours - taped
                key = f"{name}.{side}.{end}"
                values[f"{key}.rms"] = compute_rms(error)
                values[f"{key}.vaf"] = 100.0 * float(1.0 - np.mean(error**2) / np.var(taped))
                if (end, side) == ("stick", "manipulator"):
                    curves |= {"measurement": taped, name: ours}
                    far = taped > np.median(taped)
                    values[f"{key}.far"] = compute_rms(error[far])
                    values[f"{key}.near"] = compute_rms(error[~far])
    kept = {n: curves[n] for n in ("measurement", "nominal", "identified")}
    panel = Panel("stick's end to the ball [m]", np.arange(1.0, _TAPED_DISTANCES + 1.0), kept, "pose [1]",
                  discrete=True, errors={n: kept[n] - kept["measurement"] for n in list(kept)[1:]},
                  error_label="error [m]")  # fmt: skip
    return Sample(values, (panel,))


def _identify_cylinder_triangles(
    calibration: Calibration, settings: Mapping[str, Any], rng: np.random.Generator
) -> Sample:
    """Identify the triangles of the boom and stick cylinders from measured and from computed joint angles.

    A triangle consists of a joint and the two pins of its cylinder. Computed angles follow from the
    calibrator's readings and the re-identified arm. The result contains, for measured (`measured`) and
    computed (`identified`) angles, the identified minus the nominal parameters, and the RMS error [m]
    and the variance accounted for [%] of the piston displacement. `AXIS.angle` is the standard deviation
    of the error of computed angles [deg].
    """
    machine, values, panels = load_machine("calibrator"), {}, []
    transducer, accuracy = settings["transducer"], settings["accuracy"]
    sigma = max(accuracy, 1e-9) / np.sqrt(3.0), max(transducer, 1e-9) / np.sqrt(3.0)
    for axis in ("boom", "stick"):
        stage = next(one for one in calibration.kept_stages if one.link == axis)
        clean = next(one for one in calibration.true_poses if one.link == axis)
        place = calibration.loop.links.index(axis)
        rows = np.arange(len(clean.theta)) if stage.rows is None else stage.rows
        angle = (clean.theta[rows, place] - calibration.true_loop.values[place, 0]) * calibration.loop.signs[place]
        length = _compute_true_displacement(machine, axis, angle)
        length = length + rng.uniform(-transducer, transducer, len(length))
        measured = stage.manipulator[axis] * calibration.loop.signs[place]
        computed = compute_angles_from_calibrator(calibration.fits["reidentified"], stage)
        residuals = {}
        for kind, strokes in (
            ("measured", AxisStrokes(axis, measured, length, *sigma)),
            ("identified", AxisStrokes(axis, computed, length, *sigma, angle_source="identified")),
        ):
            found = identify_linkage(machine, strokes)
            change = linkage_parameters(found) - found.nominal
            values |= {f"{axis}.{kind}.{n}": float(v) for n, v in zip(PARAMETER_NAMES, change, strict=True)}
            values |= {f"{axis}.{kind}.rms": found.rms, f"{axis}.{kind}.vaf": found.vaf}
            residuals[kind] = 1e3 * found.residual
        error = np.degrees(computed - angle)
        values[f"{axis}.angle"] = float(np.std(error))
        panels.append(Panel(f"{axis}: error of the displacement [mm]",
                            np.arange(len(length), dtype=float), residuals, "pose [1]",
                            discrete=True))  # fmt: skip
    return Sample(values, tuple(panels))


def _compute_true_displacement(machine: Machine, axis: str, angle: np.ndarray) -> np.ndarray:
    """Return the piston displacement of the machine's cylinder at joint angles [m]."""
    linkage, cylinder = axis_linkage(machine, axis), machine.axes[axis].cylinder
    assert cylinder
    return np.asarray(linkage.length(angle)) - cylinder.closed_length

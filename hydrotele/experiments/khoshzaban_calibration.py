"""Simulate the calibration of the machine in Khoshzaban 1992, section 3.8.

The nominal machine is the true one, as in the thesis: "we consider the nominal model to behave like
the actual system" (p. 67). The calibrator's joints 5 and 6 bend when the stick is retracted (p.
69); the thesis does not give the size. As in the thesis, poses whose readings differ visibly from
the nominal model are excluded before the arm is identified again.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hydrotele.calibrate.arm import ArmFit, identify_arm, start_numbers
from hydrotele.calibrate.arm_poses import Poses, with_drift
from hydrotele.calibrate.bad_data import identify_without_bad_data, predicted_readings
from hydrotele.calibrate.design import Clean, sweep_poses
from hydrotele.calibrate.linkage import (
    NAMES,
    Strokes,
    identified_angles,
    identify_linkage,
    values_of,
)
from hydrotele.calibrate.loop import Loop, closure, frame_of, link_chain, loop_of
from hydrotele.experiments.calibrator_readings import (
    RESOLVER,
    bend_pulled_in_joints,
    draw_sweeps,
    perturb_loop,
    simulate_readings,
    true_numbers,
)
from hydrotele.experiments.comparison import Changes, Panel, Sample
from hydrotele.experiments.khoshzaban_arm import (
    IDENTIFIED,
    LENGTHS,
    LISTS,
    MOVED,
    TWISTS,
    choose_settings,
    root_mean_square,
)
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.kinematics.serial_chain import forward
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine

SETTINGS = {
    "drift": True, "accuracy": RESOLVER, "bend": (2.0, 6.0),
    "bent": ("grapple", "calibrator_yoke"), "removal": True, "tape": 0.005, "transducer": 0.002,
    "built": 0.0, "poses": 1.0,
}  # fmt: skip
"""Settings of `measure_calibration` and `measure_search`.

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

ENDS = {"stick": 3, "grapple": 5}
"""End point -> number of links up to it."""

SIDES = ("manipulator", "calibrator")
VISIBLE = np.radians(1.0)
"""Difference at the yoke above which a pose is excluded [rad]; the axes of Fig. 20 span 30 deg."""

_TAPED = 19  # number of taped distances, p. 65


class Model(NamedTuple):
    """Kinematic parameters that determine the end points.

    Attributes:
        values: (N, 5) rows of `Loop.values`.
        ball: (3,) position of the ball [m].
        pitch: angle at which joint 4 is held [rad].
    """

    values: np.ndarray
    ball: np.ndarray
    pitch: float


class Calibration(NamedTuple):
    """Data and results of a calibration with and without the poses of bent joints.

    Attributes:
        loop: nominal chain.
        true: true chain.
        clean: true poses of every stage.
        inside: (M,) whether joints bend in each pose of the stick's stage.
        stages: readings of every stage, with the drift of held links.
        kept: readings without the excluded poses.
        fits: results `identified` (all poses) and `reidentified` (kept poses); empty before the
            identification.
    """

    loop: Loop
    true: Loop
    clean: list[Clean]
    inside: np.ndarray
    stages: list[Poses]
    kept: list[Poses]
    fits: Mapping[str, ArmFit] = {}


def simulate_stages(seed: int, chosen: Mapping[str, Any], rng: np.random.Generator) -> Calibration:
    """Simulate the readings of all calibration stages and exclude visibly bent poses."""
    loop = loop_of(load_machine("calibrator"))
    built = chosen["built"]
    true = perturb_loop(loop, rng, built, built / 0.03) if built else loop
    sweeps = draw_sweeps(rng, chosen["drift"], chosen["poses"])
    clean = [sweep_poses(true, link, sweeps[link], seed) for link in LISTS]
    low, high = np.radians(chosen["bend"])
    sizes = {joint: rng.uniform(low, high) * rng.choice([-1.0, 1.0]) for joint in chosen["bent"]}
    stages, inside = [], np.zeros(0, bool)
    for one in clean:
        extra, bent = bend_pulled_in_joints(true, one, sizes)
        readings = simulate_readings(true, one, rng, chosen["accuracy"], extra)
        stages.append(with_drift(loop, readings))
        inside = bent if one.link == "stick" else inside
    kept = [leave_out_visible(loop, one) for one in stages] if chosen["removal"] else stages
    return Calibration(loop, true, clean, inside, stages, kept)


def identify_twice(done: Calibration) -> dict[str, ArmFit]:
    """Identify the arm once from all poses and once from the kept poses."""
    used = {"identified": done.stages, "reidentified": done.kept}
    return {
        name: identify_arm(done.loop, [replace(s, drift=None) for s in poses], weighted=False,
                           chosen=IDENTIFIED)
        for name, poses in used.items()
    }  # fmt: skip


def leave_out_visible(loop: Loop, stage: Poses) -> Poses:
    """Exclude poses in which the readings differ by 1 deg or more from the nominal model.

    A pose is excluded if the closure error of the chain exceeds the displacement of the ball that a
    yoke rotation of 1 deg causes. All poses of joint 4, which has no sensor, are kept.
    """
    if stage.link not in MOVED:
        return stage
    theta = _angles(loop, Model(loop.values, loop.ball, float(loop.home[3])), stage)
    gap = np.linalg.norm(closure(loop, theta)[0], axis=1)
    place, _ = frame_of(loop, ENDS["grapple"], theta)
    return stage.only(gap < VISIBLE * np.linalg.norm(loop.ball - place, axis=1))


def measure_calibration(seed: int, changes: Changes) -> Sample:
    """Calibrate the machine with and without bent poses, and compare the results.

    Args:
        seed: seed of sweeps, bends and sensor errors.
        changes: changes of `SETTINGS`.

    Returns:
        Errors of parameters, end points, distances and cylinder triangles, with their curves.
    """
    chosen = choose_settings(SETTINGS, changes)
    rng = np.random.default_rng([38, seed])
    done = simulate_stages(seed, chosen, rng)
    done = done._replace(fits=identify_twice(done))
    values, panels = {}, []
    for name, fit in done.fits.items():
        values |= _parameter_errors(done, name, fit)
    for part in (_compare_sensors(done), _compare_ends(done),
                 _compare_distances(done, chosen["tape"], rng),
                 _identify_minor_links(done, chosen, rng)):  # fmt: skip
        values |= part.values
        panels += part.panels
    return Sample(values, tuple(panels))


def measure_search(seed: int, changes: Changes) -> Sample:
    """Detect bent joints from the closure equations alone, and with the nominal model.

    Args:
        seed: seed of sweeps, bends and sensor errors.
        changes: changes of `SETTINGS`.

    Returns:
        `overlap` of detected and bent poses (intersection over union), `blamed` (whether only bent
        joints are detected), and the fraction `left out` of the bent poses.
    """
    chosen = choose_settings(SETTINGS, changes)
    done = simulate_stages(seed, chosen, np.random.default_rng([38, seed]))
    cleaned = identify_without_bad_data(done.loop, done.stages)
    marked, joints = np.zeros(len(done.inside), bool), set()
    for region in cleaned.regions:
        joints.add(region.joint)
        if region.link == "stick":
            marked[region.first : region.last + 1] = True
    kept = next(one for one in done.kept if one.link == "stick")
    left_out = np.zeros(len(done.inside), bool)
    if kept.rows is not None:
        left_out[:] = True
        left_out[kept.rows] = False
    both = (marked & done.inside).sum() / max(1, (marked | done.inside).sum())
    return Sample({
        "overlap": float(both), "blamed": float(bool(joints) and joints <= set(chosen["bent"])),
        "left out": float(left_out[done.inside].mean()),
    })  # fmt: skip


def _parameter_errors(done: Calibration, model: str, fit: ArmFit) -> dict[str, float]:
    """Return the errors of the identified parameters and the iterations of the stages."""
    truth = dict(zip(fit.names, true_numbers(done.true, done.loop, fit.names, done.clean),
                     strict=True))  # fmt: skip
    ball = done.true.ball
    truth |= {"p_xy.swing": float(np.hypot(*ball[:2])), "p_z.swing": float(ball[2])}
    errors = {name: fit.value(name) - truth[name] for name in fit.names}
    found = {f"{model}.error.{name}": value for name, value in errors.items()}
    for kind in ("alpha", "beta"):
        found[f"{model}.{kind}"] = root_mean_square(
            [errors[name] for name in TWISTS if name.startswith(kind)]
        )
    found[f"{model}.lengths"] = root_mean_square([errors[name] for name in LENGTHS])
    found[f"{model}.twists"] = root_mean_square([errors[name] for name in TWISTS])
    for stage in fit.stages:
        found[f"{model}.iterations.{stage.link}"] = float(stage.iterations)
    return found


def _compare_sensors(done: Calibration) -> Sample:
    """Compare the calibrator's readings with those predicted from the manipulator's sensors."""
    loop, inside = done.loop, done.inside
    stage = next(one for one in done.stages if one.link == "stick")
    predicted = predicted_readings(loop, stage, _nominal_numbers(loop, stage))
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
    for k, name in enumerate(loop.links[loop.moved :]):
        values[f"inside.{5 + k}"] = root_mean_square(difference[inside, k])
        values[f"outside.{5 + k}"] = root_mean_square(difference[~inside, k])
        panels.append(Panel(
            f"joint {5 + k}, {name} [deg]", pose,
            {"sensor": np.degrees(stage.theta[:, k]), "predicted": np.degrees(predicted[:, k])},
            "pose [1]", discrete=True, errors={"sensor minus prediction": difference[:, k]},
            error_label="difference [deg]",
        ))  # fmt: skip
    return Sample(values, tuple(panels))


def _nominal_numbers(loop: Loop, stage: Poses) -> dict[str, float]:
    """Return a stage's parameters from the nominal chain and the manipulator's sensors."""
    theta = loop.home[None].copy()
    place = loop.links.index(stage.link)
    for k, link in enumerate(loop.links[:place]):
        theta[0, k] = float(np.median(stage.manipulator[link])) + loop.values[k, 0]
    origin, turn = frame_of(loop, place, theta)
    ball = turn[0].T @ (loop.ball - origin[0])
    numbers = start_numbers(loop, [stage])
    return numbers | {f"p_xy.{stage.link}": float(np.hypot(*ball[:2])),
                      f"p_z.{stage.link}": float(ball[2])}  # fmt: skip


def _model_of(done: Calibration, name: str) -> Model:
    if name == "nominal":
        return Model(done.loop.values, done.loop.ball, float(done.loop.home[3]))
    fit = done.fits[name]
    return Model(fit.loop.values, fit.loop.ball, fit.value("held.pitch"))


def _angles(loop: Loop, model: Model, stage: Poses) -> np.ndarray:
    """Return (M, N) joint angles from all sensors with a model's offsets [rad].

    Joint 4 has no sensor; its angle is that of the model.
    """
    theta = np.empty((len(stage), len(loop)))
    for k, link in enumerate(loop.links[: loop.moved]):
        unsensed = link == "pitch"
        theta[:, k] = model.pitch if unsensed else stage.manipulator[link] + loop.values[k, 0]
    theta[:, loop.moved :] = stage.theta + model.values[loop.moved :, 0]
    return theta


def end_place(model: Model, theta: np.ndarray, side: str, links: int) -> np.ndarray:
    """Return the position of an end point relative to the ball.

    Args:
        model: kinematic parameters.
        theta: (M, N) joint angles [rad].
        side: `manipulator`: position in frame 0, computed from the first joints. `calibrator`:
            position in the last link's frame, computed from the last joints.
        links: number of links up to the end point.

    Returns:
        (M, 3) [m].
    """
    if side == "manipulator":
        return forward(link_chain(model.values[:links]), theta[:, :links]).position - model.ball
    origin, turn = forward(link_chain(model.values[links:]), theta[:, links:])
    return np.einsum("mji,mj->mi", turn, -origin)


def _compare_ends(done: Calibration) -> Sample:
    """Compare the end points of the identified models with those of the nominal model."""
    nominal, values, panels = _model_of(done, "nominal"), {}, []
    used = {"identified": done.stages, "reidentified": done.kept}
    for name, stages in used.items():
        model = _model_of(done, name)
        stages = [stage for stage in stages if stage.link in MOVED]
        for end, links in ENDS.items():
            for side in SIDES:
                both = [np.concatenate([
                    end_place(m, _angles(done.loop, m, stage), side, links) for stage in stages
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


def _compare_distances(done: Calibration, tape: float, rng: np.random.Generator) -> Sample:
    """Compare computed distances between end points and ball with tape measurements."""
    pairs = [(one, stage) for one, stage in zip(done.clean, done.stages, strict=True)
             if stage.link in MOVED]  # fmt: skip
    truth = np.concatenate([one.theta for one, _ in pairs])
    chosen = np.linspace(0, len(truth) - 1, _TAPED).astype(int)
    actual = Model(done.true.values, done.true.ball, 0.0)
    values, curves = {}, {}
    for end, links in ENDS.items():
        taped = np.linalg.norm(end_place(actual, truth[chosen], "manipulator", links), axis=1)
        taped = taped + tape * rng.standard_normal(_TAPED)
        for name in ("nominal", "identified", "reidentified"):
            model = _model_of(done, name)
            theta = np.concatenate([_angles(done.loop, model, stage) for _, stage in pairs])[chosen]
            for side in SIDES:
                ours = np.linalg.norm(end_place(model, theta, side, links), axis=1)
                error = ours - taped
                key = f"{name}.{side}.{end}"
                values[f"{key}.rms"] = root_mean_square(error)
                values[f"{key}.vaf"] = 100.0 * float(1.0 - np.mean(error**2) / np.var(taped))
                if (end, side) == ("stick", "manipulator"):
                    curves |= {"measurement": taped, name: ours}
                    far = taped > np.median(taped)
                    values[f"{key}.far"] = root_mean_square(error[far])
                    values[f"{key}.near"] = root_mean_square(error[~far])
    kept = {n: curves[n] for n in ("measurement", "nominal", "identified")}
    panel = Panel("stick's end to the ball [m]", np.arange(1.0, _TAPED + 1.0), kept, "pose [1]",
                  discrete=True, errors={n: kept[n] - kept["measurement"] for n in list(kept)[1:]},
                  error_label="error [m]")  # fmt: skip
    return Sample(values, (panel,))


def _identify_minor_links(
    done: Calibration, chosen: Mapping[str, Any], rng: np.random.Generator
) -> Sample:
    """Identify the cylinder triangles from measured angles and from the re-identified arm."""
    machine, values, panels = load_machine("calibrator"), {}, []
    transducer, accuracy = chosen["transducer"], chosen["accuracy"]
    sigma = max(accuracy, 1e-9) / np.sqrt(3.0), max(transducer, 1e-9) / np.sqrt(3.0)
    for axis in ("boom", "stick"):
        stage = next(one for one in done.kept if one.link == axis)
        clean = next(one for one in done.clean if one.link == axis)
        place = done.loop.links.index(axis)
        rows = np.arange(len(clean.theta)) if stage.rows is None else stage.rows
        angle = (clean.theta[rows, place] - done.true.values[place, 0]) * done.loop.signs[place]
        length = _true_displacement(machine, axis, angle)
        length = length + rng.uniform(-transducer, transducer, len(length))
        measured = stage.manipulator[axis] * done.loop.signs[place]
        computed = identified_angles(done.fits["reidentified"], stage)
        residuals = {}
        for kind, strokes in (
            ("measured", Strokes(axis, measured, length, *sigma)),
            ("identified", Strokes(axis, computed, length, *sigma, angles="identified")),
        ):
            found = identify_linkage(machine, strokes)
            change = values_of(found) - found.nominal
            values |= {f"{axis}.{kind}.{n}": float(v) for n, v in zip(NAMES, change, strict=True)}
            values |= {f"{axis}.{kind}.rms": found.rms, f"{axis}.{kind}.vaf": found.vaf}
            residuals[kind] = 1e3 * found.residual
        error = np.degrees(computed - angle)
        values[f"{axis}.angle"] = float(np.std(error))
        panels.append(Panel(f"{axis}: error of the displacement [mm]",
                            np.arange(len(length), dtype=float), residuals, "pose [1]",
                            discrete=True))  # fmt: skip
    return Sample(values, tuple(panels))


def _true_displacement(machine: Machine, axis: str, angle: np.ndarray) -> np.ndarray:
    """Return the piston displacement of the machine's cylinder triangle at joint angles [m]."""
    linkage, cylinder = axis_linkage(machine, axis), machine.axes[axis].cylinder
    assert cylinder
    return np.asarray(linkage.length(angle)) - cylinder.closed_length

"""Wang 2012, chapters 4 and 5: least-squares calibrations and the 3-2-1 wire measurement.

Simulated robots have errors in the 36 parameters of the refined D-H model or in all 54 parameters.
They are calibrated from platform poses that six wires measure.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.calibrate.hybrid_calibration import calibrate_hybrid_robot
from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.experiments.wang_models import MAX_ROUNDING
from hydrotele.experiments.wang_robots import (
    REQUIRED_ACCURACY,
    SENSOR_NOISE,
    SimulatedRobot,
    compute_rms,
    compute_test_pose_errors,
    make_caption_claim,
    simulate_robot,
)
from hydrotele.kinematics.hybrid_error_model import refined_model_parameters
from hydrotele.kinematics.hybrid_robot import (
    HybridRobot,
    forward_kinematics,
    inverse_kinematics,
    leg_readings,
    load_hybrid,
    pose_difference,
)
from hydrotele.kinematics.wire_measurement import pose_covariance, pose_from_wires, wire_lengths
from hydrotele.simulate.pose_measurements import default_wires, sample_poses

ACCURACY_REASON = "high accuracy (±0.1 mm), page 19, RMS"

POSE_LABEL = "pose [1]"


def _draw_errors(label: str, before: np.ndarray, after: np.ndarray) -> Panel:
    """Return a panel of errors per pose before and after calibration, in thousandths of their units.

    The errors after calibration are also drawn on a separate axis.
    """
    return Panel(
        label, np.arange(1, len(before) + 1), {"before": 1e3 * before, "after": 1e3 * after},
        POSE_LABEL, discrete=True, errors={"after": 1e3 * after}, error_label=label,
    )  # fmt: skip


def _check_accuracy(quantity: str, samples: Sequence[Sample], name: str):
    return check_mean(quantity, 1e3 * collect_values(samples, name), (-np.inf, 1e3 * REQUIRED_ACCURACY),
                      ACCURACY_REASON, unit="mm")  # fmt: skip


def _describe_before_and_after(samples: Sequence[Sample], name: str, unit: str = "mm") -> str:
    return (
        f"{format_values(samples, f'{name} before', 1e3, 2)} {unit} before,"
        f" {format_values(samples, f'{name} after', 1e3, 3)} {unit} after calibration"
    )


def measure_refined_model(seed: int, changes: Changes) -> Sample:
    """Calibrate the 36 parameters of the IWR robot's refined D-H model by least squares from 25 poses.

    Args:
        seed: seed of the robot and the noise.
        changes: `document`: whether only the 36 parameters have errors, or all 54; `noise`: factor of
            the sensor noise; `stated_noise`: factor of the noise assumed in the fit; `exact_noise`:
            noise factor of a second measurement, 0 by default.

    Returns:
        RMS position errors at 25 test poses `before` and `after` calibration and if all 54 parameters
        are calibrated (`with 54`) [m]; `largest` error after it [m]; fraction of true errors `inside`
        their 95 % intervals; `exact`: largest parameter error from the second measurement [m] or [rad].
    """
    settings = merge_settings({"document": True, "noise": 1.0, "stated_noise": 1.0, "exact_noise": 0.0}, changes)
    nominal = load_hybrid("iwr")
    simulated = simulate_robot(1000 + seed, 25, refined_only=settings["document"], noise=settings["noise"])
    measurement = simulated.measurement
    covariance = measurement.covariance * settings["stated_noise"] ** 2
    measurement = replace(measurement, covariance=covariance)
    names = refined_model_parameters(simulated.model)
    done = calibrate_hybrid_robot(nominal, measurement, "dh", names)
    truth = simulated.errors[simulated.model.parameter_indices(done.fit.names)]
    low, high = done.fit.intervals.T
    exact = simulate_robot(1000 + seed, 25, noise=settings["exact_noise"])
    recovered = calibrate_hybrid_robot(nominal, exact.measurement, "dh", names).fit
    before = compute_test_pose_errors(simulated, nominal)[0]
    after = compute_test_pose_errors(simulated, done.robot)[0]
    complete = calibrate_hybrid_robot(nominal, measurement, "dh").robot
    return Sample(
        {"position before": compute_rms(before), "position after": compute_rms(after),
         "largest": float(after.max()),
         "with 54": compute_rms(compute_test_pose_errors(simulated, complete)[0]),
         "inside": float(np.mean((truth > low) & (truth < high))),
         "exact": float(np.abs(
             recovered.values - exact.errors[exact.model.parameter_indices(recovered.names)]).max())},
        (_draw_errors("position error at test poses [mm]", before, after),),
    )  # fmt: skip


def _evaluate_redundancy(samples: Sequence[Sample]) -> Evaluation:
    pairs = np.array([(s.values["with 54"], s.values["position after"]) for s in samples])
    return Evaluation(
        (check_bootstrapped_statistic("RMS error at test poses with the 54 parameters over that with the 36",
                         pairs, lambda rows: float(np.sqrt(
                             np.mean(rows[:, 0] ** 2) / np.mean(rows[:, 1] ** 2))),
                         (1.0, np.inf), '"deteriorate"'),),
        note="only the 36 parameters have errors; 50 of the 54 are identified",
    )  # fmt: skip


def _evaluate_accurate_model(samples: Sequence[Sample]) -> Evaluation:
    within = [sample.values["largest"] < REQUIRED_ACCURACY for sample in samples]
    return Evaluation(
        (_check_accuracy("RMS position error at 25 test poses", samples, "position after"),
         check_fraction("fraction of the robots with all 25 poses within 0.1 mm", within, (0.5, 1.0),
                        "more than half of the robots; the publication had one")),
        "The sensor noise is an assumption; errors are proportional to it.",
        f"RMS before calibration {format_values(samples, 'position before', 1e3, 2)} mm",
    )  # fmt: skip


def _evaluate_intervals(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation((check_mean(
        "fraction of the assumed errors within their 95 % intervals", 100.0 * collect_values(samples, "inside"),
        (92.0, 98.0), "95 % expected; 92 and 98 % result from standard deviations that are 11 % too small or 19 %"
        " too large",
        unit="%"),))  # fmt: skip


def _evaluate_exact_readings(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation((check_mean(
        "largest error of an identified parameter", collect_values(samples, "exact"),
        (-np.inf, MAX_ROUNDING), "rounding", unit="m or rad"),))  # fmt: skip


def measure_poe_model(seed: int, changes: Changes) -> Sample:
    """Calibrate all 54 parameters of the IWR robot's product-of-exponentials (POE) model from 25 poses.

    Args:
        seed: seed of the robot and the noise.
        changes: `noise`: factor of the sensor noise.

    Returns:
        `rank` of the Jacobian. RMS position errors before and after calibration at the measured poses,
        and after it at `test` poses [m]. `better`: fraction of measured poses with smaller errors after
        calibration. RMS of the true errors (`assumed PART`) and of identified minus true errors
        (`missed PART`) of carriage and hexapod [m] or [rad].
    """
    settings = merge_settings({"noise": 1.0}, changes)
    nominal = load_hybrid("iwr")
    simulated = simulate_robot(900 + seed, 25, "poe", refined_only=False, noise=settings["noise"])
    done = calibrate_hybrid_robot(nominal, simulated.measurement, "poe")
    test = compute_test_pose_errors(simulated, done.robot)[0]
    truth, found = simulated.errors, done.parameter_errors
    count = simulated.model.carriage_parameter_count
    values = {
        "rank": done.redundancy.rank,
        "position before": compute_rms(done.nominal_errors.position),
        "position after": compute_rms(done.calibrated_errors.position),
        "test": compute_rms(test),
        "better": float(np.mean(done.calibrated_errors.position < done.nominal_errors.position)),
    }
    for part, at in (("carriage", slice(0, count)), ("hexapod", slice(count, None))):
        values[f"assumed {part}"] = compute_rms(truth[at])
        values[f"missed {part}"] = compute_rms((found - truth)[at])
    axes = simulated.model.nominal.specification.axes
    arrays = {"axes": np.array([(*row.direction, *row.point) for row in axes])}
    panel = _draw_errors("position error [mm]", done.nominal_errors.position, done.calibrated_errors.position)
    return Sample(values, (panel,), arrays)


def _evaluate_poe_model(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (check_mean("number of independent parameters among the 54", collect_values(samples, "rank"), (54.0, 54.0),
                    "all: complete and minimal"),
         _check_accuracy("RMS position error at 25 test poses", samples, "test")),
        "The sensor noise is an assumption; errors are proportional to it.",
        f"RMS at the measured poses {_describe_before_and_after(samples, 'position')}",
    )  # fmt: skip


def _make_part_description(part: str):
    def describe_part_errors(samples: Sequence[Sample]) -> str:
        return (f"RMS of the assumed errors {format_values(samples, f'assumed {part}', 1e3, 2)}, of"
                f" identified minus assumed {format_values(samples, f'missed {part}', 1e3, 2)}"
                " (mm or mrad)")  # fmt: skip

    return describe_part_errors


def _describe_axes(samples: Sequence[Sample]) -> str:
    rows = [f"({', '.join(f'{v:.0f}' for v in row[:3])}) through"
            f" ({', '.join(f'{1e3 * v:.0f}' for v in row[3:])}) mm"
            for row in samples[0].arrays["axes"]]  # fmt: skip
    return f"axes of the carriage at joint positions 0: {'; '.join(rows)}; lengths are assumptions"


def measure_wire_calibration(seed: int, changes: Changes) -> Sample:
    """Calibrate a robot IWR with errors in all 54 parameters from 20 poses measured with wires.

    Args:
        seed: seed of the robot and the noise.
        changes: `noise`: factor of the sensor noise.

    Returns:
        Before and after calibration: largest `leg` error [m], and RMS errors of `position` [m] and
        `orientation` [rad] at the measured poses. `test`: RMS position error at test poses after
        calibration [m]. `reached`: RMS error of true positions that the inverse kinematics of the model
        commands [m]. RMS true (`assumed`) and remaining (`missed`) parameter errors, and `rank`.
    """
    settings = merge_settings({"noise": 1.0}, changes)
    nominal = load_hybrid("iwr")
    simulated = simulate_robot(1300 + seed, 20, refined_only=False, noise=settings["noise"])
    m = simulated.measurement
    done = calibrate_hybrid_robot(nominal, m, "dh")
    legs = [np.abs(leg_readings(robot, m.joints, m.pose) - m.legs).max(axis=1)
            for robot in (nominal, done.robot)]  # fmt: skip
    test = compute_test_pose_errors(simulated, done.robot)[0]
    reached = [_compute_reached_position_errors(simulated, robot) for robot in (nominal, done.robot)]
    truth, found = simulated.errors, done.parameter_errors
    values = {
        "leg before": float(legs[0].max()),
        "leg after": float(legs[1].max()),
        "test": compute_rms(test),
        "reached before": compute_rms(reached[0]),
        "reached after": compute_rms(reached[1]),
        "assumed": compute_rms(truth),
        "missed": compute_rms(found - truth),
        "rank": done.redundancy.rank,
        "least legs": float(m.legs.min()),
        "most legs": float(m.legs.max()),
    }
    for name, errors in (("before", done.nominal_errors), ("after", done.calibrated_errors)):
        values[f"position {name}"] = compute_rms(errors.position)
        values[f"orientation {name}"] = compute_rms(errors.orientation)
    panels = (
        _draw_errors("largest leg error [mm]", *legs),
        _draw_errors(
            "orientation error [mrad]",
            done.nominal_errors.orientation,
            done.calibrated_errors.orientation,
        ),
        _draw_errors("position error [mm]", done.nominal_errors.position, done.calibrated_errors.position),
        _draw_errors("error of the reached position [mm]", *reached),
    )
    return Sample(values, panels)


def _compute_reached_position_errors(simulated: SimulatedRobot, robot: HybridRobot) -> np.ndarray:
    """Return the position errors of the true robot when a model's inverse kinematics commands its legs.

    The desired poses are those that the nominal robot reaches with the test commands.

    Args:
        simulated: true robot with its M test commands.
        robot: model that computes the commands.

    Returns:
        (M,) distances of reached and desired positions [m].
    """
    joints, legs = simulated.test_commands
    desired = forward_kinematics(load_hybrid("iwr"), joints, legs)
    reached = forward_kinematics(simulated.robot, joints, inverse_kinematics(robot, desired, joints))
    return np.linalg.norm(pose_difference(reached, desired)[:, :3], axis=1)


def _evaluate_whole_robot(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (_check_accuracy("RMS position error at 25 test poses", samples, "test"),),
        "The sensor noise is an assumption; errors are proportional to it.",
        f"20 platform poses; {format_values(samples, 'rank', digits=0)} of 54 parameters are"
        " identified, the others are redundant",
    )  # fmt: skip


def _evaluate_controller_correction(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (_check_accuracy("RMS error of the reached position", samples, "reached after"),),
        "The sensor noise is an assumption; errors are proportional to it.",
        f"25 desired poses, commanded by the inverse kinematics; RMS"
        f" {format_values(samples, 'reached before', 1e3, 2)} mm with the nominal robot",
    )  # fmt: skip


def _make_range_description(name: str, words: str):
    def describe_range(samples: Sequence[Sample]) -> str:
        low, high = (format_values(samples[:1], f"{end} {name}", digits=2)
                     for end in ("least", "most"))  # fmt: skip
        return f"{words} {low} to {high} (m or rad), first robot"

    return describe_range


def measure_wire_pose_errors(seed: int, changes: Changes) -> Sample:
    """Measure the errors of platform poses that are computed from exact and from noisy wire lengths.

    Args:
        seed: seed of poses and noise.
        changes: `noise`: factor of the wires' noise.

    Returns:
        `exact`: largest error of a pose coordinate with exact lengths [m] or [rad]. With noisy lengths:
        `squares`, the squared pose error weighted by the inverse propagated covariance, over its
        expectation 6; median errors of `position` [m] and `orientation` [rad].
    """
    settings = merge_settings({"noise": 1.0}, changes)
    robot, wires, rng = load_hybrid("iwr"), default_wires(), np.random.default_rng(seed)
    joints, legs = sample_poses(robot, 100, rng, wires)
    pose = forward_kinematics(robot, joints, legs)
    lengths = wire_lengths(wires, pose)
    exact = np.abs(pose_difference(pose_from_wires(wires, lengths, pose), pose)).max()
    sigma = SENSOR_NOISE["wire"]
    covariance = pose_covariance(wires, pose, sigma)
    noisy = lengths + settings["noise"] * sigma * rng.normal(size=lengths.shape)
    away = pose_difference(pose_from_wires(wires, noisy, pose), pose)
    squares = np.einsum("ni,nij,nj->n", away, np.linalg.inv(covariance), away)
    position, turn = (float(np.median(np.linalg.norm(away[:, k : k + 3], axis=1))) for k in (0, 3))
    return Sample({
        "exact": float(exact), "squares": float(np.mean(squares) / 6.0), "position": position,
        "orientation": turn,
        "least joints": float(joints.min()), "most joints": float(joints.max()),
        "shortest": float(lengths.min()), "longest": float(lengths.max()),
    })  # fmt: skip


def _evaluate_wire_poses(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (check_mean("largest error of a pose from exact lengths", collect_values(samples, "exact"),
                    (-np.inf, MAX_ROUNDING), "rounding", unit="m or rad"),
         check_mean("squared pose error over its expectation from the propagated covariance",
                    collect_values(samples, "squares"), (0.9, 1.1),
                    "1 expected; 10 % of the square are 5 % of the standard deviation")),
    )  # fmt: skip


def _describe_wire_poses(samples: Sequence[Sample]) -> str:
    first = samples[0].values
    return (
        f"wires of {first['shortest']:.2f} to {first['longest']:.2f} m with errors of"
        f" {1e3 * SENSOR_NOISE['wire']:g} mm (standard deviation) give the pose to"
        f" {format_values(samples, 'position', 1e3, 3)} mm and"
        f" {format_values(samples, 'orientation', 1e3, 3)} mrad (medians)"
    )


def _describe_wire_points(samples: Sequence[Sample]) -> str:
    wires = default_wires()
    anchors = "; ".join(str(tuple(round(1e3 * v) for v in point)) for point in wires.anchors)
    points = "; ".join(str(tuple(round(1e3 * v) for v in point)) for point in wires.points)
    return f"anchors {anchors} mm; platform points {points} mm; all are assumptions"


WIRE_POSES = Experiment(
    "3-2-1 wires", measure_wire_pose_errors,
    (
        make_caption_claim(
            "poses and carriage displacements", "Table 2 (p. 43)",
            '"Randomly generated end-effector poses and carriage-joint displacements (unit: mm for'
            ' lengths and rad. for angles)"', _make_range_description("joints", "carriage joints from"),
        ),
        Claim(
            "3-2-1 wires: pose by three spheres",
            "Six wire lengths give the pose, with errors that agree with the propagated"
            " covariance.",
            "section 5.1", "additional", _evaluate_wire_poses, {"noise": 1.5},
            "the wires' noise is 1.5 times the assumed one",
        ),
        make_caption_claim(
            "hexagon and end-effector points", "Table 10 (p. 69)",
            '"The hexagon vertex coordinate values with respect to the reference frame and three'
            ' end-effector points coordinate values with respect to the moving platform"',
            _describe_wire_points,
        ),
        make_caption_claim(
            "wire lengths and calculated poses", "Table 12 (p. 70)",
            '"Measured wire lengths in the Solidworks model and the corresponding calculated'
            ' end-effector poses based on the 3-2-1 pose estimation method"', _describe_wire_poses,
        ),
    ),
)  # fmt: skip

REFINED_MODEL = Experiment(
    "36 parameters by least squares", measure_refined_model,
    (
        Claim(
            "redundant parameters deteriorate the identification",
            '"the redundant parameters have to be eliminated since they would deteriorate the'
            ' identification result"', "section 2.1 (p. 24)", "document", _evaluate_redundancy,
            {"document": False}, "the robot has errors in all 54 parameters instead of only in the 36", panel_labels=(),
        ),
        Claim(
            "accurate kinematic model",
            '"the identified parameter errors are substituted into the error model to obtain an'
            ' accurate kinematic model"; "high accuracy (±0.1 mm) for the assembly robot"',
            "section 1.1 (p. 21, 19)", "document", _evaluate_accurate_model, {"noise": 10.0},
            "ten times the sensor noise",
        ),
        make_caption_claim(
            "36 parameters, without measurement noise", "Table 4 (p. 53)",
            '"Nominal values, assumed errors, identified posterior mean values, and standard'
            ' deviations for the refined 36-parameter model (without measurement noise)"',
            lambda samples: "least squares returns every assumed error to"
            f" {max(s.values['exact'] for s in samples):.1e} m or rad",
        ),
        Claim(
            "exact measurements return the 36 assumed errors",
            "Without noise the 36 identified errors equal the assumed ones.", "section 4.2.2",
            "additional", _evaluate_exact_readings, {"exact_noise": 0.01},
            "1 % of the sensor noise is added", panel_labels=(),
        ),
        Claim(
            "intervals of the 36 parameters",
            "95 % of the assumed errors are within the 95 % intervals of least squares.",
            "section 4.2.3", "additional", _evaluate_intervals, {"stated_noise": 0.5},
            "the covariance assumes half of the true noise", panel_labels=(),
        ),
    ),
)  # fmt: skip

POE_MODEL = Experiment(
    "POE model: 25 poses", measure_poe_model,
    (
        Claim(
            "POE model of the hybrid robot",
            '"Extending the product-of-exponentials (POE) modeling and calibration method from a'
            ' serial robot to a redundant serial-parallel hybrid robot"; "high accuracy (±0.1 mm)'
            ' for the assembly robot"', "section 1.3 (p. 22), section 1.1 (p. 19)", "document",
            _evaluate_poe_model, {"noise": 10.0}, "ten times the sensor noise",
        ),
        make_caption_claim("kinematic parameters of the POE model", "Table 6 (p. 56)",
                      '"Kinematic parameters in the reference configuration"', _describe_axes),
        make_caption_claim(
            "POE model: carriage", "Table 7 (p. 57)",
            '"Nominal and identified parameters of carriage"', _make_part_description("carriage"),
        ),
        make_caption_claim("POE model: hexapod", "Table 8 (p. 57)",
                      '"Nominal and identified parameters of the Hexa-WH (unit: mm)"',
                      _make_part_description("hexapod")),
        make_caption_claim(
            "POE model: 25 poses before and after", "Table 9, Figs 20 and 21 (p. 60, 61)",
            '"Results of 25 end-effector poses before and after calibration"; "Position errors'
            ' before calibration in the 25 end-effector pose configurations."; "Position errors'
            ' after calibration in the 25 end-effector pose configurations."',
            lambda samples: f"position RMS {_describe_before_and_after(samples, 'position')}",
            lambda samples: (samples[0].panels, None),
        ),
    ),
)  # fmt: skip

WIRE_CALIBRATION = Experiment(
    "20 poses with wires", measure_wire_calibration,
    (
        Claim(
            "the whole robot from platform poses",
            '"the two hybrid parts do not need to be calibrated separately but can be regarded as a'
            ' whole, and then the pose measurement of the end-effector can fulfill the calibration'
            ' purpose effectively"; "high accuracy (±0.1 mm) for the assembly robot"',
            "section 2.1 (p. 25), section 1.1 (p. 19)", "document", _evaluate_whole_robot,
            {"noise": 10.0}, "ten times the sensor noise", panel_labels=(),
        ),
        Claim(
            "correction in the controller",
            '"to compensate them in the robot controller so as to make the error model match the'
            ' real robot as closely as possible"; "high accuracy (±0.1 mm) for the assembly robot"',
            "section 1.1 (p. 20, 19)", "document", _evaluate_controller_correction, {"noise": 10.0},
            "ten times the sensor noise", panel_labels=("error of the reached position [mm]",),
        ),
        make_caption_claim("actuated-joint displacements", "Table 11 (p. 69)",
                      '"Measured actuated-joint displacements in the Solidworks environment"',
                      _make_range_description("legs", "legs from")),
        make_caption_claim(
            "identified parameters of the hybrid robot", "Table 13 (p. 72)",
            '"Nominal and identified parameters of the hybrid IWR robot (unit: mm)"',
            lambda samples: f"RMS of the assumed errors {format_values(samples, 'assumed', 1e3, 2)}"
            " mm or mrad; of identified minus assumed"
            f" {format_values(samples, 'missed', 1e3, 2)}, since A_i and the last link are"
            " identifiable only in combinations",
        ),
        make_caption_claim(
            "legs before and after calibration", "Table 14, Figs 25 and 26 (p. 73, 74)",
            '"Leg errors before calibration in 20 pose configurations."; "Leg errors after'
            ' calibration in 20 pose configurations."',
            lambda samples: f"largest leg error {_describe_before_and_after(samples, 'leg')}",
            lambda samples: (samples[0].panels[:1], None),
        ),
        make_caption_claim(
            "orientation before and after calibration", "Table 15, Figs 27 and 28 (p. 75, 76)",
            '"Orientation errors before calibration in 20 pose configurations."; "Orientaion errors'
            ' after calibration in 20 pose configurations."',
            lambda samples: f"RMS {_describe_before_and_after(samples, 'orientation', 'mrad')}",
            lambda samples: (samples[0].panels[1:2], None),
        ),
        make_caption_claim(
            "position before and after calibration", "Table 15, Figs 29 and 30 (p. 75, 77)",
            '"Position errors before calibration in 20 pose configurations."; "Position errors'
            ' after calibration in 20 pose configurations"',
            lambda samples: f"RMS {_describe_before_and_after(samples, 'position')}",
            lambda samples: (samples[0].panels[2:3], None),
        ),
    ),
)  # fmt: skip

EXPERIMENTS = (REFINED_MODEL, POE_MODEL, WIRE_POSES, WIRE_CALIBRATION)
"""Experiments in the order of the document."""

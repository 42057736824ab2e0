"""Proposals of Khoshzaban 1992 for further work.

The module examines the spatial linkage of a cylinder with ball joints (section 3.4.4) and a noise
model of flexible calibrator joints (section 5.3).
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.calibrate.arm_identification import identify_arm
from hydrotele.calibrate.calibration_loop import build_loop
from hydrotele.calibrate.flexibility import refit_with_flexibility
from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, generate_sweep_poses
from hydrotele.experiments.calibrator_readings import (
    MAX_RESOLVER_ERROR,
    sample_gravity_bends,
    simulate_readings,
)
from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Sample, merge_settings
from hydrotele.experiments.khoshzaban_arm import LENGTH_PARAMETERS, SIMULATED_STAGES
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_mean,
    collect_values,
)
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.linkages import TwoBar
from hydrotele.machine.machine_file import load_machine

_DIFFERENCE_STEP = 1.0e-6  # step of central differences [m] or [rad]
_RANK_TOLERANCE = 1.0e-6  # relative to the largest singular value; rounding of the differences is 1e-9

LINKAGE_SETTINGS = {"axial_offset": 0.05}
"""Distance of the two pins of the boom's cylinder along the joint's axis [m]."""


def count_undetermined_parameters(seed: int, changes: Changes) -> Sample:
    """Count the geometric parameters of a cylinder with ball joints that its sensors do not determine.

    The sensors are the piston displacement and zero, one or two angles of the cylinder at its base
    joint: in the plane normal to the joint axis, and out of this plane. Each angle sensor has an
    unknown offset. The count is the rank deficiency of the Jacobian.

    Args:
        seed: not used.
        changes: `axial_offset`: distance of the two pins along the joint axis [m].

    Returns:
        Number of undetermined parameters with the displacement alone (`length`), with `one_angle` and
        with `two_angles`, and the smallest number of angle sensors `needed` to determine all (3 if two
        do not suffice).
    """
    chosen = merge_settings(LINKAGE_SETTINGS, changes)
    machine = load_machine("cat215", "none")
    linkage, cylinder = axis_linkage(machine, "boom"), machine.axes["boom"].cylinder
    assert isinstance(linkage, TwoBar) and cylinder
    theta = np.linspace(-0.6, 0.9, 60)
    offset = float(chosen["axial_offset"])
    plane = [linkage.angle_offset, linkage.lower, linkage.upper, cylinder.closed_length]
    sensors = {"length": (0,), "one_angle": (0, 1), "two_angles": (0, 1, 2)}
    values = {}
    for name, rows in sensors.items():
        start = np.array([*plane, *([offset] if offset else []), *(0.0 for _ in rows[1:])])

        def predict_readings(x, rows=rows):
            angle, lower, upper, closed = x[:4]
            apart = x[4] if offset else 0.0
            bar = TwoBar(lower, upper, angle, linkage.direction, apart)
            length = np.asarray(bar.length(theta))
            included = linkage.direction * theta + angle
            readings = [
                length - closed,
                np.arctan2(upper * np.sin(included), lower - upper * np.cos(included)),
                np.arcsin(apart / length),
            ]
            zeros = (0.0, *x[len(x) - len(rows) + 1 :])
            return np.concatenate([readings[k] + z for k, z in zip(rows, zeros, strict=True)])

        columns = []
        for k in range(len(start)):
            step = np.zeros(len(start))
            step[k] = _DIFFERENCE_STEP
            columns.append((predict_readings(start + step) - predict_readings(start - step)) / (2.0 * _DIFFERENCE_STEP))
        jacobian = np.array(columns).T
        jacobian /= np.linalg.norm(jacobian, axis=0)
        size = np.linalg.svd(jacobian, compute_uv=False)
        values[name] = float(len(start) - np.sum(size > _RANK_TOLERANCE * size[0]))
    needed = next((k for k, name in enumerate(sensors) if values[name] == 0.0), len(sensors))
    return Sample(values | {"needed": float(needed)})


def evaluate_needed_angle_sensors(samples: Sequence[Sample]) -> Evaluation:
    """Check that two angle sensors are needed to identify a cylinder with ball joints (Khoshzaban 1992, p. 43)."""
    v = samples[0].values
    check = check_deterministic_value(
        "angle sensors needed in addition to the displacement", v["needed"], (2.0, 2.0),
        "the document's number", published=2.0,
    )  # fmt: skip
    return Evaluation(
        (check,),
        "the length depends on the distance h of the pins along the axis only through"
        " l_l^2 + l_u^2 + h^2 and l_l l_u; one angle of the cylinder gives the ratio l_u / l_l,"
        " which determines all of them",
        f"undetermined parameters: {v['length']:.0f} with the displacement alone,"
        f" {v['one_angle']:.0f} with one angle at the cylinder's base joint,"
        f" {v['two_angles']:.0f} with two",
    )


FLEXIBILITY_SETTINGS = {"bend": 1.0, "bent_share": 0.35, "estimated": True}
"""Standard deviation of the errors of bent joints [deg], fraction of the poses in which they bend,
and whether the noise model is estimated."""


def identify_with_flexibility_model(seed: int, changes: Changes) -> Sample:
    """Identify a simulated arm with bent joints, without and with a noise model of flexible joints.

    Args:
        seed: seed of poses, bends and sensor errors.
        changes: `bend`: standard deviation of the errors of bent joints [deg]; `bent_share`:
            fraction of the poses in which they bend; `estimated`: whether the noise model is
            estimated.

    Returns:
        For the fits without (`plain`) and with (`modelled`) noise model: mean squared length error [m^2],
        and fraction of the 95 % intervals that contain the true parameter (`covered`). `grapple` and
        `yoke`: estimated standard deviations of these joints' bends at full load [deg].
    """
    chosen = merge_settings(FLEXIBILITY_SETTINGS, changes)
    loop = build_loop(load_machine("calibrator"))
    rng = np.random.default_rng([124, seed])
    stages = []
    for link in SIMULATED_STAGES:
        clean = generate_sweep_poses(loop, link, DRIFT_FREE_SWEEPS[link], seed)
        bend = sample_gravity_bends(loop, clean, rng, chosen["bend"], chosen["bent_share"], False)
        stages.append(simulate_readings(loop, clean, rng, MAX_RESOLVER_ERROR, bend))
    plain = identify_arm(loop, stages)
    better, flexibility = plain, np.zeros(2)
    if chosen["estimated"]:
        better, found = refit_with_flexibility(loop, stages, plain, lambda s: identify_arm(loop, s))
        flexibility = np.degrees(found.at_full_load[:2])
    values = {"grapple": float(flexibility[0]), "yoke": float(flexibility[1])}
    for name, fit in (("plain", plain), ("modelled", better)):
        truth = {n: loop.value(n) for n in fit.names if n in loop.parameter_names}
        lengths = [fit.value(n) - truth[n] for n in LENGTH_PARAMETERS if n in truth]
        values[f"{name}_square"] = float(np.mean(np.square(lengths)))
        deviations = dict(zip(fit.names, fit.standard_deviations, strict=True))
        inside = [abs(fit.value(n) - t) < 1.96 * deviations[n] for n, t in truth.items()]
        values[f"{name}_covered"] = float(np.mean(inside))
    return Sample(values)


def evaluate_flexibility(samples: Sequence[Sample]) -> Evaluation:
    """Check that the noise model of flexible joints reduces length errors and gives correct 95 % intervals.

    The RMS length error must decrease by at least 5 %. At least 85 % of the intervals must contain the
    true parameter.
    """
    squares = np.column_stack([collect_values(samples, f"{n}_square") for n in ("modelled", "plain")])
    ratio = check_bootstrapped_statistic(
        "RMS error of the lengths, with over without the noise model", squares,
        lambda rows: float(np.sqrt(rows[:, 0].mean() / rows[:, 1].mean())), (0.0, 0.95),
        "improves: errors at least 5 % smaller",
    )  # fmt: skip
    covered = check_mean(
        "fraction of the 95 % intervals that contain the truth",
        collect_values(samples, "modelled_covered"), (0.85, 1.0),
        "95 % minus 10 %, because the simulated joints bend by another law than the modelled ones",
    )  # fmt: skip
    plain = float(np.mean(collect_values(samples, "plain_covered")))
    return Evaluation(
        (ratio, covered),
        note=f"without the noise model {100 * plain:.0f} % of the intervals contain it; estimated"
        f" flexibility at full load {np.mean(collect_values(samples, 'grapple')):.2f} deg (grapple) and"
        f" {np.mean(collect_values(samples, 'yoke')):.2f} deg (yoke): standard deviation of the joint's bend when the"
        " ball joint is horizontally as far away as the links beyond the joint can reach",
    )


EXPERIMENTS = (
    Experiment("spatial linkage", count_undetermined_parameters, (
        Claim(
            "cylinder with ball joints",
            "If joints A and C are 3-DOF ball joints, the triangle becomes a spatial closed chain,"
            " and two more joint angle sensors are required to identify the geometric parameters",
            "p. 43, section 3.4.4, Fig. 12",
            "document",
            evaluate_needed_angle_sensors,
            {"axial_offset": 0.0},
            "pins in one plane: no angle sensor is needed",
        ),
    ), fixed_repetitions=1),
    Experiment("flexible joints", identify_with_flexibility_model, (
        Claim(
            "noise model of flexible joints",
            "A noise model of joint flexibility, which the thesis proposes for further work, is"
            " estimated with the parameters of the arm and improves them",
            "p. 124, section 5.3",
            "additional",
            evaluate_flexibility,
            {"estimated": False},
            "the noise model is not estimated",
        ),
    )),
)  # fmt: skip

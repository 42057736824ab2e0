"""Arm behind a calibrator: chain, identification, bad data, linkages, calibrated machine."""

import dataclasses

import numpy as np
import pytest

from hydrotele.calibrate.arm_identification import identify_arm, identify_jointly
from hydrotele.calibrate.arm_poses import add_held_link_drift
from hydrotele.calibrate.bad_data import identify_without_bad_data
from hydrotele.calibrate.calibration_loop import ball_position_and_derivatives, build_loop, closure_error
from hydrotele.calibrate.calibrator_logs import extract_strokes, find_moving_link, read_calibration_logs
from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, generate_sweep_poses
from hydrotele.calibrate.linkage_identification import (
    AxisStrokes,
    identify_linkage,
    linkage_parameters,
    machine_with_linkage,
)
from hydrotele.calibrate.machine_correction import calibrated_machine, update_machine_geometry
from hydrotele.core.errors import InputError
from hydrotele.experiments.calibrator_readings import (
    find_true_parameters,
    perturb_loop,
    simulate_readings,
)
from hydrotele.experiments.khoshzaban_arm import IDENTIFIABLE_PARAMETERS
from hydrotele.experiments.khoshzaban_machine import TABLE_2
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.linkages import TwoBar
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine_file import load_machine

MACHINE = load_machine("calibrator")
LOOP = build_loop(MACHINE)
TRUE = perturb_loop(LOOP, np.random.default_rng(11))
POSES = 120


@pytest.fixture(scope="module")
def clean():
    """True poses of every link, held links fixed."""
    return [generate_sweep_poses(TRUE, n, s._replace(poses=POSES)) for n, s in DRIFT_FREE_SWEEPS.items()]


@pytest.fixture(scope="module")
def exact(clean):
    """Identified from readings without error."""
    return identify_arm(LOOP, [simulate_readings(TRUE, one, None) for one in clean])


def test_chain_is_table_2():
    """Pins and axes of the MuJoCo model give the thesis' numbers, to their last digit."""
    ours = [(0.0, -LOOP.ball[0], -LOOP.ball[2], 0.0)]
    ours += [(np.degrees(v[1]), v[2], v[3], np.degrees(v[4])) for v in LOOP.values]
    np.testing.assert_allclose(ours, TABLE_2, atol=5e-4)


def test_derivatives_are_those_of_finite_differences():
    """By every parameter of every link, 1e-6 of a step of 1e-6."""
    theta = TRUE.home[None, 2:] + 0.1
    place, by = ball_position_and_derivatives(TRUE, 1, theta)
    for k in range(len(TRUE) - 1):
        for c in range(5):
            values, turned = TRUE.values.copy(), theta.copy()
            if c == 0 and k == 0:
                continue  # a turn of the joint itself
            if c == 0:
                turned[:, k - 1] += 1e-6
            values[1 + k, c] += 1e-6
            moved, _ = ball_position_and_derivatives(dataclasses.replace(TRUE, values=values), 1, turned)
            np.testing.assert_allclose((moved - place) / 1e-6, by[:, :, k, c], atol=2e-5)


def test_poses_close_the_chain(clean):
    for one in clean:
        assert np.abs(closure_error(TRUE, one.theta)[0]).max() < 1e-9


def test_without_error_exact(clean, exact):
    """Rounding only: 1e-9 is asked."""
    truth = find_true_parameters(TRUE, LOOP, exact.names, clean)
    assert np.abs(exact.values - truth).max() < 1e-9
    joint = identify_jointly(exact, [simulate_readings(TRUE, one, None) for one in clean])
    assert np.abs(joint.values - truth).max() < 1e-9


def test_identifiable_sets_are_those_of_the_thesis(exact):
    """K section 3.6.4, besides the ball's distance and height."""
    for stage in exact.stages:
        found = {name for name in stage.names if not name.startswith("p_")}
        assert found == IDENTIFIABLE_PARAMETERS[stage.link], stage.link
        assert f"d.{stage.link}" in stage.hold_reasons


@pytest.mark.nightly
def test_errors_are_as_large_as_said_and_joint_knows_more(clean):
    """28 parameters: RMS of normalised errors of six seeds near 1, within the scatter of 168."""
    scores, fits = [], None
    for seed in range(6):
        stages = [simulate_readings(TRUE, one, np.random.default_rng(seed)) for one in clean]
        one = identify_arm(LOOP, stages)
        fits = one, identify_jointly(one, stages)
        truth = find_true_parameters(TRUE, LOOP, one.names, clean)
        scores.append([(fit.values - truth) / fit.standard_deviations for fit in fits])
    rms = np.sqrt(np.mean(np.square(scores), axis=(0, 2)))
    assert np.all((0.7 < rms) & (rms < 1.3)), rms
    ratio = fits[1].standard_deviations / fits[0].standard_deviations
    assert ratio.max() < 1.02  # the same readings at another estimate change a deviation slightly
    base = [fits[0].names.index(n) for n in ("p_xy.swing", "a.swing", "alpha.swing", "p_z.swing")]
    assert np.all(ratio[base] < 1.0)


def test_corruption_is_found_and_left_out(clean):
    rng = np.random.default_rng(4)
    stages = [add_held_link_drift(LOOP, simulate_readings(TRUE, one, rng)) for one in clean]
    assert identify_without_bad_data(LOOP, stages).regions == []
    wrong = stages[1].theta.copy()
    wrong[40:70, 1] += np.radians(2.5)
    stages[1] = dataclasses.replace(stages[1], theta=wrong)
    found = identify_without_bad_data(LOOP, stages)
    assert [(r.link, r.joint) for r in found.regions] == [("stick", "calibrator_yoke")]
    region = found.regions[0]
    assert abs(region.first - 40) <= 3 and abs(region.last - 69) <= 3
    assert region.size == pytest.approx(np.radians(2.5), rel=0.1)
    names = [n for n in found.fit.names if n.endswith((".stick", ".boom", ".swing"))]
    truth = find_true_parameters(TRUE, LOOP, names, clean)
    size = np.array([found.fit.standard_deviations[found.fit.names.index(n)] for n in names])
    bad, good = (
        np.sqrt(np.mean(((np.array([fit.value(n) for n in names]) - truth) / size) ** 2))
        for fit in (identify_arm(LOOP, stages), found.fit)
    )
    assert bad > 3.0 * good


def test_calibrated_machine_has_the_chain(clean, exact):
    """Lengths and twists in links and axes, offsets in the sensors."""
    made = calibrated_machine(MACHINE, exact, [simulate_readings(TRUE, one, None) for one in clean])
    again = build_loop(made)
    np.testing.assert_allclose(again.values[:3, 1:], TRUE.values[:3, 1:], atol=1e-9)
    np.testing.assert_allclose(again.ball, TRUE.ball, atol=1e-9)
    offset = made.sensor_errors["angle.calibrator_yoke"].offset
    assert offset == pytest.approx(LOOP.value("offset.calibrator_yoke")
                                   - TRUE.value("offset.calibrator_yoke"), abs=1e-9)  # fmt: skip
    same = build_loop(update_machine_geometry(MACHINE, LOOP, LOOP))
    np.testing.assert_allclose(same.values, LOOP.values, atol=1e-12)


@pytest.mark.parametrize("axis", ["boom", "stick"])
def test_linkage_of_another_triangle_is_recovered(axis):
    """Exact readings: all four numbers; the machine then has them."""
    linkage, cylinder = axis_linkage(MACHINE, axis), MACHINE.axes[axis].cylinder
    assert isinstance(linkage, TwoBar) and cylinder
    true = dataclasses.replace(linkage, lower=linkage.lower * 1.02, upper=linkage.upper * 0.99,
                               angle_offset=linkage.angle_offset + 0.02)  # fmt: skip
    low, high = MACHINE.joints[axis].range
    angle = np.linspace(low + 0.1, high - 0.1, 200)
    length = true.length(angle) - cylinder.closed_length - 0.01
    found = identify_linkage(MACHINE, AxisStrokes(axis, angle, length, 1e-6, 1e-6))
    np.testing.assert_allclose(
        linkage_parameters(found),
        [true.angle_offset, true.lower, cylinder.closed_length + 0.01, true.upper], atol=1e-6,
    )  # fmt: skip
    assert found.rms < 1e-8 and found.vaf > 99.9999
    again = axis_linkage(machine_with_linkage(MACHINE, found), axis)
    assert again.lower == pytest.approx(true.lower, abs=1e-6)
    assert again.angle_offset == pytest.approx(true.angle_offset, abs=1e-6)


def log_of(count=200, **columns):
    """A log of the calibrator with angle channels."""
    time = np.arange(count) / 50.0
    values = {f"angle.{n}": 0.1 * np.sin(time) for n in LOOP.links[LOOP.powered_count :]}
    values |= {name.replace("_of_", "."): value for name, value in columns.items()}
    return Log(time, values, dict.fromkeys(values, "rad"), {"machine": "calibrator"}, "logs/x.csv")


def test_which_link_moved():
    time = np.arange(200) / 50.0
    assert find_moving_link(log_of(angle_of_boom=0.2 * time, angle_of_stick=0.0 * time), LOOP) == "boom"
    with pytest.raises(InputError, match="moves more than one link"):
        find_moving_link(log_of(angle_of_boom=0.2 * time, angle_of_stick=0.3 * time), LOOP)
    with pytest.raises(InputError, match="does not say which link moves"):
        find_moving_link(log_of(), LOOP)


def test_unusable_data_say_why(clean):
    """Too few poses, only one pose, another machine, NaN, nothing moves."""
    stages = [simulate_readings(TRUE, one, None) for one in clean]
    with pytest.raises(InputError, match="3 poses of pitch are too few for 4 parameters: record 4 or more"):
        identify_arm(LOOP, [stages[0].select(np.arange(3) * 40)])
    with pytest.raises(InputError, match="contains only one pose of pitch"):
        identify_arm(LOOP, [stages[0].select(np.zeros(50, int))])
    bad = stages[0].theta.copy()
    bad[7, 2] = np.nan
    with pytest.raises(InputError, match=r"column angle.calibrator_twist, row 8: is not a number"):
        identify_arm(LOOP, [dataclasses.replace(stages[0], theta=bad)])
    with pytest.raises(InputError, match="keep one of them"):
        identify_arm(LOOP, [stages[0], stages[0]])
    still = AxisStrokes("boom", np.full(50, 0.3), np.full(50, 0.4), 1e-3, 1e-3)
    with pytest.raises(InputError, match="l_l, l_c and l_u are not identifiable"):
        identify_linkage(MACHINE, still)
    assert extract_strokes(log_of(), MACHINE, ["boom"]) == []


def test_a_log_of_another_machine_is_refused(tmp_path):
    save_log(dataclasses.replace(log_of(), metadata={"machine": "ec20"}), tmp_path / "sweep.parquet")
    with pytest.raises(InputError, match="is a log of machine ec20, not of calibrator: give --machine ec20"):
        read_calibration_logs(tmp_path, MACHINE)


def test_a_machine_without_a_calibrator_is_refused():
    with pytest.raises(InputError, match="has no sensed_joints"):
        build_loop(load_machine("cat215"))

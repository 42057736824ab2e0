"""Hybrid robots: inverse and forward kinematics, error models, wires, against independent forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hydrotele.core.errors import InputError
from hydrotele.kinematics.hybrid_error_model import (
    apply_geometry_errors,
    build_error_model,
    first_order_carriage_pose,
    predict_leg_readings,
    refined_model_parameters,
)
from hydrotele.kinematics.hybrid_robot import (
    REVOLUTE,
    PlatformPose,
    UnreachableError,
    batch_readings,
    carriage_pose,
    convert_to_axes,
    euler_to_rotation,
    forward_kinematics,
    forward_kinematics_by_evolution,
    home_pose,
    inverse_kinematics,
    leg_jacobian,
    leg_readings,
    load_hybrid,
    pose_difference,
    save_hybrid,
)
from hydrotele.kinematics.wire_measurement import (
    NoIntersectionError,
    pose_covariance,
    pose_from_wires,
    wire_jacobian,
    wire_lengths,
)
from hydrotele.simulate.pose_measurements import default_wires, sample_poses

IWR = load_hybrid("iwr")
ROUNDING = 1e-12  # m and rad: 1e4 times the rounding of numbers of 1 m


def poses(count=20, seed=1):
    rng = np.random.default_rng(seed)
    joints, legs = sample_poses(IWR, count, rng)
    return joints, legs, forward_kinematics(IWR, joints, legs)


def test_carriage_is_the_product_of_elementary_motions():
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) of every row of Wang's Table 1, multiplied one by one."""
    joints, _, _ = poses()
    for q, found in zip(joints, carriage_pose(IWR, joints), strict=True):
        rotation, place = Rotation.identity(), np.zeros(3)
        for row, kind, value in zip(IWR.specification.carriage, IWR.kinds, q, strict=True):
            theta, d = row.theta, row.d
            theta, d = (theta + value, d) if kind == REVOLUTE else (theta, d + value)
            rotation = rotation * Rotation.from_rotvec([0, 0, theta])
            place = place + rotation.apply([row.a, 0, d])
            rotation = rotation * Rotation.from_rotvec([row.alpha, 0, 0])
        assert np.allclose(found[:3, :3], rotation.as_matrix(), atol=ROUNDING)
        assert np.allclose(found[:3, 3], place, atol=ROUNDING)


def test_forward_undoes_inverse_by_newton_and_by_differential_evolution():
    joints, legs, pose = poses()
    assert np.allclose(inverse_kinematics(IWR, pose, joints), legs, atol=ROUNDING)
    one = PlatformPose(pose.rotation[0], pose.position[0])
    evolved = forward_kinematics_by_evolution(IWR, joints[0], legs[0], seed=3)
    assert np.abs(pose_difference(evolved, one)).max() < 1e-6  # a hundredth of 0.1 mm


def test_leg_jacobian_is_the_derivative():
    joints, _, pose = poses(5)
    jacobian, step = leg_jacobian(IWR, joints, pose), 1e-6
    for k in range(6):
        ends = []
        for sign in (step, -step):
            move = np.zeros(6)
            move[k] = sign
            turn = Rotation.from_rotvec(move[3:]).as_matrix()
            ends.append(leg_readings(IWR, joints, PlatformPose(turn @ pose.rotation,
                                                       pose.position + move[:3])))  # fmt: skip
        assert np.allclose((ends[0] - ends[1]) / (2 * step), jacobian[..., k], atol=1e-8)  # step^2


def test_axes_and_dh_rows_are_one_robot(tmp_path):
    joints, legs, pose = poses()
    assert np.allclose(leg_readings(convert_to_axes(IWR), joints, pose), legs, atol=ROUNDING)
    for robot in (IWR, convert_to_axes(IWR)):
        save_hybrid(robot, tmp_path / "robot.yaml")
        again = load_hybrid(tmp_path)
        assert np.allclose(leg_readings(again, joints, pose), legs, atol=ROUNDING)


def test_what_cannot_be_reached_says_so():
    joints, legs, pose = poses(3)
    with pytest.raises(UnreachableError, match=r"a leg would read .* its range is 0.62 to 0.98 m"):
        inverse_kinematics(IWR, PlatformPose(pose.rotation, pose.position + 0.5), joints)
    with pytest.raises(UnreachableError):
        forward_kinematics(IWR, joints, legs * [0.3, 1, 1, 1, 1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"carriage": []}, "give either"),
        ({"leg_offsets_mm": [0, 0, 0]}, "leg_offsets"),
        ({"leg_lengths": 3}, "unknown key 'leg_lengths'"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, change, message):
    import yaml

    from hydrotele.core.files import models_folder

    data = yaml.safe_load((models_folder() / "iwr" / "iwr.yaml").read_text()) | change
    path = tmp_path / "other.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=message):
        load_hybrid(path)
    with pytest.raises(InputError, match="valid: iwr"):
        load_hybrid("iwrr")


@pytest.mark.parametrize("kind", ["dh", "poe"])
def test_errors_in_batches_are_those_of_the_robot_as_built(kind):
    """54 parameters of both models; the batch is what a corrected robot of its own computes."""
    joints, _, pose = poses()
    model = build_error_model(IWR, kind)
    assert len(model.names) == len(set(model.names)) == 54
    assert model.carriage_parameter_count == 12
    rng = np.random.default_rng(2)
    errors = rng.normal(size=(3, 54)) * model.scales
    batch = predict_leg_readings(model, errors, joints, pose.rotation, pose.position)
    for one, found in zip(errors, batch, strict=True):
        built = apply_geometry_errors(model, one)
        assert np.allclose(leg_readings(built, joints, pose), found, atol=ROUNDING)
    zero = predict_leg_readings(model, np.zeros(54), joints, pose.rotation, pose.position)
    assert np.allclose(zero[0], leg_readings(IWR, joints, pose), atol=ROUNDING)


def test_cost_is_linear_in_poses_by_construction():
    """Readings of many poses are those of each alone."""
    joints, _, pose = poses(6)
    parts = (IWR.constants[None], IWR.kinds, IWR.universal[None], IWR.spherical[None],
             IWR.offsets[None])  # fmt: skip
    whole = batch_readings(*parts, joints, pose.rotation, pose.position)
    for k in range(6):
        at = slice(k, k + 1)
        alone = batch_readings(*parts, joints[at], pose.rotation[at], pose.position[at])
        assert np.array_equal(whole[:, at], alone)


def test_first_order_model_is_the_derivative_of_the_exact_one():
    """Wang Eqs 12 to 26: what is left is of second order, a quarter at half the errors."""
    joints, _, _ = poses()
    model = build_error_model(IWR, "dh")
    errors = np.random.default_rng(4).normal(size=54) * model.scales
    left = []
    for share in (1.0, 0.5):
        exact = carriage_pose(apply_geometry_errors(model, share * errors), joints)
        straight = first_order_carriage_pose(IWR, share * errors[:12], joints)
        left.append(np.abs(exact - straight).max())
    assert left[0] / left[1] == pytest.approx(4.0, rel=0.02)  # third order: 1 mrad of the second


def test_the_document_s_36_are_the_54_without_universal_joints():
    names = refined_model_parameters(build_error_model(IWR, "dh"))
    assert len(names) == 36
    assert {"a4", "theta4", "b1x", "b6z"} <= set(names)  # Fig. 18
    assert not {f"a{leg}{c}" for leg in range(1, 7) for c in "xyz"} & set(names)


def test_wires_give_the_pose_and_its_covariance():
    wires = default_wires()
    rng = np.random.default_rng(5)
    pose = forward_kinematics(IWR, *sample_poses(IWR, 30, rng, wires))
    lengths = wire_lengths(wires, pose)
    near = PlatformPose(pose.rotation @ euler_to_rotation([0.05, 0.05, 0.05]), pose.position + 0.05)
    found = pose_from_wires(wires, lengths, near)
    assert np.abs(pose_difference(found, pose)).max() < 1e-9  # m: roots of squares lose half a digit
    step = 1e-6
    moved = PlatformPose(pose.rotation, pose.position + [step, 0, 0])
    change = (wire_lengths(wires, moved) - lengths) / step
    assert np.allclose(change, wire_jacobian(wires, pose)[..., 0], atol=1e-5)  # step over 1 m
    sigma, squares = 2e-5, []
    inverse_ = np.linalg.inv(pose_covariance(wires, pose, sigma))
    for _ in range(40):
        noisy = lengths + sigma * rng.normal(size=lengths.shape)
        away = pose_difference(pose_from_wires(wires, noisy, pose), pose)
        squares.append(np.einsum("ni,nij,nj->n", away, inverse_, away) / 6.0)
    # 1200 values of chi-squared of 6 over 6: a mean of 1 +- 0.017
    assert np.mean(squares) == pytest.approx(1.0, abs=0.07)
    with pytest.raises(NoIntersectionError, match="pose 1"):
        pose_from_wires(wires, 0.1 * lengths, pose)


def test_home_is_where_the_file_says():
    pose = home_pose(IWR, np.zeros(4))
    carriage = carriage_pose(IWR, np.zeros(4))
    local = carriage[:3, :3].T @ (pose.position - carriage[:3, 3])
    assert np.allclose(local, [0.0, 0.0, 0.77], atol=ROUNDING)

"""The IWR as a closed-chain MuJoCo model: file, numbers, kinematics, and that it steps."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.files import models_folder
from hydrotele.kinematics.hybrid_error_model import apply_geometry_errors, build_error_model
from hydrotele.kinematics.hybrid_robot import (
    PlatformPose,
    UnreachableError,
    forward_kinematics,
    load_hybrid,
    pose_difference,
)
from hydrotele.simulate.closed_loops import compute_loop_closure_error
from hydrotele.simulate.hybrid_mechanism import build_hybrid_mechanism, solve_mechanism_pose
from hydrotele.simulate.pose_measurements import sample_manufacturing_errors, sample_poses

IWR = load_hybrid("iwr")
FILE = models_folder() / "iwr" / "iwr.xml"


def robots():
    model = build_error_model(IWR, "dh")
    return IWR, apply_geometry_errors(model, sample_manufacturing_errors(model, np.random.default_rng(7)))


def test_file_is_what_the_numbers_make():
    """iwr.xml holds six digits, so that its places are within 1e-6 m of iwr.yaml's."""
    filed, made = mujoco.MjModel.from_xml_path(str(FILE)), build_hybrid_mechanism(IWR).compile()
    assert (filed.nv, filed.neq, filed.nu) == (made.nv, made.neq, made.nu) == (25, 5, 10)
    for field in ("body_pos", "jnt_pos", "jnt_axis", "site_pos", "body_mass", "jnt_range"):
        assert np.allclose(getattr(filed, field), getattr(made, field), atol=2e-6), field
    assert np.allclose(filed.eq_solref, made.eq_solref)


@pytest.mark.parametrize("place", [0, 1])
def test_closed_chain_agrees_with_newton_for_the_nominal_and_a_built_robot(place):
    robot = robots()[place]
    model = build_hybrid_mechanism(robot).compile()
    data = mujoco.MjData(model)
    joints, legs = sample_poses(IWR, 5, np.random.default_rng(8))
    pose = forward_kinematics(robot, joints, legs)
    for k in range(5):
        found = solve_mechanism_pose(model, data, robot, joints[k], legs[k])
        away = pose_difference(found, PlatformPose(pose.rotation[k], pose.position[k]))
        assert np.abs(away).max() < 1e-9  # m and rad: both close to 1e-12


def test_impossible_lengths_do_not_close():
    model = build_hybrid_mechanism(IWR).compile()
    legs = np.array([0.3, 1.2, 0.3, 1.2, 0.3, 1.2])
    with pytest.raises(UnreachableError):
        solve_mechanism_pose(model, mujoco.MjData(model), IWR, np.zeros(4), legs)


def test_it_steps_with_noise_without_warnings_and_its_loops_stay_closed():
    model = mujoco.MjModel.from_xml_path(str(FILE))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(9)
    speed = np.zeros(model.nu)
    for step in range(2000):
        if step % 100 == 0:
            speed = 0.05 * rng.normal(size=model.nu)  # m/s and rad/s: of a robot that machines
        data.ctrl[:] += 1e-3 * speed
        mujoco.mj_step(model, data)
    assert data.warning.number.sum() == 0
    mujoco.mj_kinematics(model, data)
    assert compute_loop_closure_error(model, data) < 1e-5  # m: a tenth of the accuracy that the robot is for

"""Poses from logs: pins stay closed, and every body is where MuJoCo has it."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.show.logged_poses import body_poses, extract_joint_motion, point_trajectory
from hydrotele.simulate.closed_loops import close_along_motion, close_loops, compute_loop_closure_error
from hydrotele.simulate.mechanism import compile_mechanism


@pytest.fixture(scope="module")
def model(machine):
    """The model with its looks."""
    return compile_mechanism(machine)


@pytest.mark.nightly
def test_following_closes_all_pins_on_the_branch_of_close_loops(machine, model, log):
    joints, data = extract_joint_motion(machine, log), mujoco.MjData(model)
    assert set(joints) == {"swing", "boom", "stick", "bucket"}
    poses = close_along_motion(machine, model, data, joints)
    assert poses.shape == (len(log), model.nq)
    for row in (0, 20, len(log) - 1):
        data.qpos[:] = poses[row]
        mujoco.mj_kinematics(model, data)
        # 1e-9 m per component is where Newton stops
        assert compute_loop_closure_error(model, data) < 2e-9
        close_loops(machine, model, data, {name: v[row] for name, v in joints.items()})
        # the two stop at 1e-9 and 1e-12 m; joints move metres per radian, near a dead centre more
        assert poses[row] == pytest.approx(data.qpos, abs=1e-7)


def test_poses_are_those_of_mujoco(machine, model, log):
    joints, data = extract_joint_motion(machine, log), mujoco.MjData(model)
    poses = body_poses(machine, model, joints)
    row = 31
    close_loops(machine, model, data, {name: v[row] for name, v in joints.items()})
    mujoco.mj_kinematics(model, data)
    assert poses.position[row] == pytest.approx(data.xpos, abs=1e-6)
    cosine = np.abs(np.einsum("ij,ij->i", poses.quaternion[row], data.xquat))  # q and -q are one
    assert cosine == pytest.approx(1.0, abs=1e-9)
    tip = point_trajectory(poses, machine.arm.tip.link, machine.arm.tip.position)[row]
    body = data.body(machine.arm.tip.link)
    expected = body.xpos + body.xmat.reshape(3, 3) @ machine.arm.tip.position
    assert tip == pytest.approx(expected, abs=1e-6)


def test_without_joints_the_machine_is_at_home(machine, model):
    poses = body_poses(machine, model, {})
    assert poses.position.shape == (1, model.nbody, 3)


def test_an_impossible_pose_names_its_row(stuck):
    with pytest.raises(InputError, match="row 1: .*do not close.*bucket"):
        body_poses(stuck, compile_mechanism(stuck), {"bucket": np.array([-1.2, 1.0])})


def test_a_jump_does_not_change_the_branch(machine, model):
    data = mujoco.MjData(model)
    jump = close_along_motion(machine, model, data, {"bucket": np.array([-2.3, 0.2, -2.3])})
    slow = close_along_motion(machine, model, data, {"bucket": np.linspace(-2.3, 0.2, 100)})
    assert jump[[0, 1, 2]] == pytest.approx(slow[[0, -1, 0]], abs=1e-7)  # as above


def test_a_following_joint_cannot_be_set(machine, model):
    with pytest.raises(InputError, match="boom_rod: cannot be set; the independent joints are"):
        body_poses(machine, model, {"boom_rod": np.zeros(2)})

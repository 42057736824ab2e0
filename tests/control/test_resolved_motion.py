"""Resolved motion one step at a time: poses, edges, and machines that have no arm."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.control.arm_kinematics import arm_axes, arm_specification, pose_to_joints
from hydrotele.control.resolved_motion import ResolvedMotion, step_references_by_rate
from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import forward_kinematics
from hydrotele.kinematics.arm_dimensions import arm_geometry
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.pilots import Pose

BUCKET = load_machine("cat215", "bucket")
GEOMETRY = arm_geometry(BUCKET)
HOME = {"swing": 0.0, "boom": 0.45, "stick": -1.6, "bucket": -1.2}
RATE = st.floats(-1.0, 1.0)


def begin(**joints):
    return ResolvedMotion.from_joints(BUCKET, HOME | joints)


def test_begins_where_it_stands():
    motion = begin()
    assert motion.axes == ("swing", "boom", "stick", "bucket") and not motion.is_blocked
    assert motion.joints == tuple(HOME.values())
    assert motion.pose == pytest.approx(forward_kinematics(GEOMETRY, motion.joints), abs=1e-15)


@given(rate=st.tuples(RATE, RATE, RATE, RATE))
def test_one_step_moves_the_pose_by_rate_times_time(rate):
    """And the joint speeds are those of the joints: 1e-3 of 1 m/s over a step of 1 ms."""
    motion, joints, speeds = begin().step_by_rate(rate, 1e-3)
    assert not motion.is_blocked
    moved = np.subtract(forward_kinematics(GEOMETRY, list(joints.values())), begin().pose)
    np.testing.assert_allclose(moved, np.multiply(rate, 1e-3), atol=1e-12)
    way = np.subtract(list(joints.values()), list(HOME.values())) / 1e-3
    np.testing.assert_allclose(way, list(speeds.values()), atol=2e-3 * (1 + np.abs(way).max()))


@given(turns=st.integers(-5, 5), angle=st.floats(-3.0, 3.0))
def test_swing_is_not_wrapped(turns, angle):
    """A machine that has slewed round twice does not slew back to move on."""
    swing = angle + turns * math.tau
    motion, joints, _ = begin(swing=swing).step_by_rate((0, 0.1, 0, 0), 0.1)
    assert joints["swing"] == pytest.approx(swing + 0.01, abs=1e-9)


def test_blocked_step_changes_nothing_but_the_flag():
    before = begin()
    after, joints, speeds = before.step_to_pose((30.0, 0.0, 0.0, -1.5), (1.0, 0, 0, 0))
    assert after.is_blocked and after.pose == before.pose and after.joints == before.joints
    assert joints == HOME and set(speeds.values()) == {0.0}


def test_blocked_goes_on_only_from_where_it_stands():
    """A command that comes back elsewhere would make the reference jump."""
    held, _, _ = begin().step_to_pose((30.0, 0.0, 0.0, -1.5), (0, 0, 0, 0))
    r, theta, z, attitude = held.pose
    elsewhere, joints, _ = held.step_to_pose((r - 0.5, theta, z, attitude), (0, 0, 0, 0))
    assert elsewhere.is_blocked and joints == HOME
    near, _, _ = held.step_to_pose((r - 0.01, theta, z, attitude), (0, 0, 0, 0))
    assert not near.is_blocked and near.pose[0] == r - 0.01
    free, _, _ = begin().step_to_pose((r - 0.5, theta, z, attitude), (0, 0, 0, 0))
    assert not free.is_blocked  # a command that was never blocked may ask for any step


def test_joint_limits_block():
    """The stick's range ends before the arm is straight."""
    motion, steps = begin(), 0
    while not motion.is_blocked and steps < 20000:
        motion, joints, _ = motion.step_by_rate((0.5, 0, 0, 0), 0.005)
        steps += 1
    assert motion.is_blocked and steps > 100
    for axis, value in joints.items():
        low, high = BUCKET.joints[axis].range or (-9, 9)
        assert low <= value <= high


def test_pose_to_joints():
    joints = pose_to_joints(BUCKET, Pose(r=5.5, z=1.0, theta=0.4, attitude=-1.7), HOME)
    pose = forward_kinematics(GEOMETRY, list(joints.values()))
    np.testing.assert_allclose(pose, [5.5, 0.4, 1.0, -1.7], atol=1e-12)
    kept = pose_to_joints(BUCKET, Pose(r=5.5, z=1.0), HOME)
    assert sum(kept[a] for a in ("boom", "stick", "bucket")) == pytest.approx(0.45 - 1.6 - 1.2)
    with pytest.raises(InputError, match=r"a\.b: .*reachable is"):
        pose_to_joints(BUCKET, Pose(r=50.0, z=1.0), HOME, "a.b")
    with pytest.raises(InputError, match="needs bucket at .* deg, but its joint range is"):
        pose_to_joints(BUCKET, Pose(r=5.5, z=1.0, attitude=2.5), HOME)


@pytest.mark.parametrize("name", ["rig", "emps", "ec20"])
def test_machine_without_an_arm(name):
    with pytest.raises(InputError, match=f"{name}: has no arm"):
        arm_axes(load_machine(name))


def test_arm_with_a_joint_that_nothing_drives():
    axes = {k: v for k, v in BUCKET.axes.items() if k != "stick"}
    with pytest.raises(InputError, match=r"\['stick'\] are not driven"):
        arm_axes(BUCKET.model_copy(update={"axes": axes}))


def test_inverse_jacobian_follows_the_rate_and_stops_at_the_edge():
    """Euler's steps of 2.5 mm leave 0.1 mm of 0.5 m beside the line; one step at the edge."""
    g, axes, ranges = arm_specification(BUCKET)
    q = np.array([(HOME | {"swing": 0.0})[axis] for axis in axes])
    pose, speed, rate = np.zeros(5), np.zeros(len(q)), np.array([0.0, 0.0, 0.5, 0.0, 0.0])
    compute_tip_pose(g, q, pose)
    start = pose.copy()
    for _ in range(200):
        assert not step_references_by_rate(g, ranges, q.copy(), rate, 0.005, pose, q, speed)
    np.testing.assert_allclose(pose[:4], start[:4] + [0.0, 0.0, 0.5, 0.0], atol=2e-3)
    rate[:] = 1.0, 0.0, 0.0, 0.0, 0.0
    held = [step_references_by_rate(g, ranges, q.copy(), rate, 0.005, pose, q, speed) for _ in range(2000)]
    assert held[-1] and np.all(speed == 0.0)
    assert np.all((ranges[:, 0] <= q) & (q <= ranges[:, 1]))
    assert step_references_by_rate(g, ranges, np.full(len(q), np.nan), -rate, 0.005, pose, q, speed)
    assert not step_references_by_rate(g, ranges, q.copy(), -rate, 0.005, pose, q, speed)

"""Serial robots: files in three formats agree, corrections survive writing, resolved motion."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import chain_poses
from hydrotele.kinematics.serial_robot import (
    apply_calibrated_parameters,
    compute_ball_poses,
    correction_derivatives,
    correction_names,
    expand_mimic_joints,
    frame_from_rpy,
    robot_chain,
    rotation_to_rpy,
    solve_joints_for_ball,
)
from hydrotele.kinematics.serial_robot_files import load_robot, robot_to_yaml, shipped_robots, write_origins_to_urdf

URDF = """<robot name="two">
  <link name="world"/><link name="base"/><link name="arm"/><link name="hand"/><link name="ball"/>
  <link name="finger"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
    <origin xyz="0 0 0.1" rpy="0 0 0.3"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.2" rpy="0.4 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="push" type="prismatic"><parent link="arm"/><child link="hand"/>
    <origin xyz="0.3 0 0" rpy="0 0.2 0"/><axis xyz="1 1 0"/></joint>
  <joint name="tool" type="fixed"><parent link="hand"/><child link="ball"/>
    <origin xyz="0.05 0 0.02"/></joint>
  <joint name="grip" type="prismatic"><parent link="hand"/><child link="finger"/>
    <origin xyz="0 0 0"/><axis xyz="0 0 1"/></joint>
</robot>
"""
MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <body pos="0 0 0.1" euler="0 0 0.3"><body pos="0 0 0.2" euler="0.4 0 0">
    <joint name="turn" axis="0 1 0"/><geom size="0.1"/>
    <body pos="0.3 0 0" euler="0 0.2 0"><joint name="push" type="slide" axis="1 1 0"/>
      <geom size="0.1"/><site name="ball" pos="0.05 0 0.02"/></body></body></body>
</worldbody></mujoco>
"""
Q = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2))


@pytest.fixture
def files(tmp_path):
    (tmp_path / "two.urdf").write_text(URDF)
    (tmp_path / "two.xml").write_text(MJCF)
    return tmp_path


def by_hand(q):
    turn = np.eye(4)
    turn[:3, :3] = frame_from_rpy((0, 0, 0), (0, q[0], 0))[:3, :3]
    slide = frame_from_rpy(q[1] * np.array([1, 1, 0]) / 2**0.5)
    parts = [frame_from_rpy((0, 0, 0.1), (0, 0, 0.3)), frame_from_rpy((0, 0, 0.2), (0.4, 0, 0)), turn,
             frame_from_rpy((0.3, 0, 0), (0, 0.2, 0)), slide, frame_from_rpy((0.05, 0, 0.02))]  # fmt: skip
    return np.linalg.multi_dot(parts)[:3, 3]


@pytest.mark.parametrize("name", ["two.urdf", "two.xml"])
def test_urdf_and_mjcf_are_the_same_chain(files, name):
    robot = load_robot(files / name, 2)
    assert robot.joint_names == ("turn", "push")
    expected = [by_hand(q) for q in Q]
    np.testing.assert_allclose(compute_ball_poses(robot, Q).position, expected, atol=1e-12)


def test_corrections_are_the_chain_with_errors_and_survive_files(files):
    robot = load_robot(files / "two.urdf", 2)
    chain = robot_chain(robot)
    values = chain.nominal_values + np.random.default_rng(1).normal(0.0, 0.01, len(chain.nominal_values))
    expected = chain_poses(chain, Q, values).position
    made = apply_calibrated_parameters(robot, dict(zip(chain.parameters, values, strict=True)), {})
    np.testing.assert_allclose(compute_ball_poses(made, Q).position, expected, atol=1e-12)
    (files / "new.yaml").write_text(robot_to_yaml(made, "test"))
    (files / "new.urdf").write_text(write_origins_to_urdf(made, URDF))
    for name in ("new.yaml", "new.urdf"):
        again = load_robot(files / name, 2)
        np.testing.assert_allclose(compute_ball_poses(again, Q).position, expected, atol=1e-12)


@pytest.mark.parametrize("name", shipped_robots())
def test_shipped_robots_reach_places_by_resolved_motion(name):
    robot = load_robot(name)
    rng = np.random.default_rng(2)
    joints = rng.uniform(-1.5, 1.5, (20, len(robot.joints)))
    target = compute_ball_poses(robot, joints).position + rng.normal(0.0, 0.01, (20, 3))
    reached = solve_joints_for_ball(robot, target, joints)
    # Targets a centimetre away may lie out of reach at full stretch only.
    assert np.median(reached.remaining_distance) < 1e-9


def test_resolved_motion_with_the_corrections_ends_where_it_should():
    nominal = load_robot("panda")
    rng = np.random.default_rng(3)
    chain = robot_chain(nominal)
    values = chain.nominal_values + rng.normal(0.0, 1e-3, len(chain.nominal_values))
    sag = {name: 3e-4 for name in correction_names(nominal, True, False)}
    true = apply_calibrated_parameters(nominal, dict(zip(chain.parameters, values, strict=True)), sag)
    start = np.tile([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8], (9, 1))
    target = compute_ball_poses(nominal, start).position + rng.normal(0.0, 0.05, (9, 3))
    missed = {
        name: np.linalg.norm(
            compute_ball_poses(true, solve_joints_for_ball(robot, target, start).joints).position - target,
            axis=1,
        ).max()
        for name, robot in {"nominal": nominal, "calibrated": true}.items()
    }
    assert missed["calibrated"] < 1e-9
    assert missed["nominal"] > 1e-3


def test_sag_is_the_weight_times_its_lever():
    robot = load_robot("ur5e")
    joints = np.zeros((1, 6))
    names = [n for n in correction_names(robot, True, False) if n == "sag.joint2.tool"]
    # At zero the arm is stretched along -x: 0.425 + 0.3922 m and the ball 0.0 beyond in x.
    lever = abs(compute_ball_poses(robot, joints).position[0, 0])
    assert abs(correction_derivatives(robot, joints, names)[0, 1, 0]) == pytest.approx(9.81 * lever, rel=1e-9)


@pytest.mark.parametrize("rpy", [(0.1, -0.4, 2.0), (0.3, np.pi / 2, 0.0), (-0.2, -np.pi / 2, 0.0)])
def test_angles_of_a_rotation(rpy):
    rotation = frame_from_rpy((0, 0, 0), rpy)[:3, :3]
    again = frame_from_rpy((0, 0, 0), tuple(rotation_to_rpy(rotation)))[:3, :3]
    np.testing.assert_allclose(again, rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [("<robot", "is not XML"), ("<sdf/>", "is not a robot file"),
     ("<robot/>", "no moving joint"), (URDF.replace("0 0 0.2", "0 0 x"), "three numbers")],
)  # fmt: skip
def test_bad_files_are_refused(tmp_path, text, said):
    (tmp_path / "bad.urdf").write_text(text)
    with pytest.raises(InputError, match=said):
        load_robot(tmp_path / "bad.urdf")


PALLETISER = """<robot name="pal">
  <joint name="swing" type="revolute"><parent link="l0"/><child link="l1"/><axis xyz="0 0 1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="l1"/><child link="l2"/>
    <origin xyz="0.1 0 0.2"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="revolute"><parent link="l2"/><child link="l3"/>
    <origin xyz="0 0 0.6"/><axis xyz="0 1 0"/></joint>
  <joint name="level" type="revolute"><parent link="l3"/><child link="l4"/>
    <origin xyz="0.6 0 0"/><axis xyz="0 1 0"/><mimic joint="elbow" multiplier="-2" offset="0.1"/></joint>
  <joint name="wrist" type="revolute"><parent link="l4"/><child link="l5"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="t" type="fixed"><parent link="l5"/><child link="tool0"/><origin xyz="0.12 0 -0.1"/></joint>
</robot>
"""
COUPLED = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="elbow" axis="0 1 0" ref="0.3"/>
  <geom size="0.1"/><body pos="0.6 0 0"><joint name="level" axis="0 1 0"/><geom size="0.1"/>
  <body name="wheel"><joint name="roll"/><geom size="0.1"/></body><site name="tool0" pos="0.1 0 0"/></body></body>
</worldbody><equality>{}</equality></mujoco>
"""


def test_a_joint_that_mimics_another_needs_no_reading(tmp_path):
    (tmp_path / "pal.urdf").write_text(PALLETISER)
    robot = load_robot(tmp_path / "pal.urdf", 4)
    assert robot.independent_joint_names == ("swing", "shoulder", "elbow", "wrist")
    four = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 4))
    five = np.insert(four, 3, -2.0 * four[:, 2] + 0.1, axis=1)
    np.testing.assert_allclose(expand_mimic_joints(robot, four), five, atol=1e-15)
    assert expand_mimic_joints(load_robot(tmp_path / "pal.urdf", 5), five) is five
    target = compute_ball_poses(robot, five).position + 0.01
    reached = solve_joints_for_ball(robot, target, five)
    assert reached.remaining_distance.max() < 1e-9
    np.testing.assert_allclose(reached.joints[:, 3], -2.0 * reached.joints[:, 2] + 0.1, atol=1e-12)
    (tmp_path / "new.yaml").write_text(robot_to_yaml(robot, "test"))
    again = load_robot(tmp_path / "new.yaml", 4)
    np.testing.assert_allclose(
        compute_ball_poses(again, five).position, compute_ball_poses(robot, five).position, atol=1e-12
    )


def test_an_equality_of_an_mjcf_couples_joints_or_is_refused(tmp_path):
    path = tmp_path / "coupled.xml"
    path.write_text(COUPLED.format('<joint joint1="level" joint2="elbow" polycoef="0.1 -2 0 0 0"/>'))
    robot = load_robot(path, 1)
    # MuJoCo's constraint is level - 0 = 0.1 - 2 (elbow - 0.3).
    np.testing.assert_allclose(expand_mimic_joints(robot, np.array([[0.5]])), [[0.5, 0.1 - 2.0 * 0.2]])
    path.write_text(COUPLED.format('<joint name="e" joint1="level" joint2="elbow" polycoef="0 1 1 0 0"/>'))
    with pytest.raises(InputError, match="the equality constraint e determines the joints level; only a linear"):
        load_robot(path, 1)
    path.write_text(COUPLED.format('<connect name="e" body1="wheel" body2="world" anchor="0 0 0"/>'))
    with pytest.raises(InputError, match="constraint e determines the joints elbow, level; only a linear"):
        load_robot(path, 2)


REFUSED_ROBOTS = {
    "a column less than the named tool has joints": (
        PALLETISER.replace('<mimic joint="elbow" multiplier="-2" offset="0.1"/>', ""), 4,
        "has 5 moving joints up to the ball (swing, shoulder, elbow, level, wrist), but the data have 4 columns",
    ),
    "too few columns beside a mimic": (
        PALLETISER, 3,
        "has 5 moving joints up to the ball (swing, shoulder, elbow, level, wrist), but the data have 3 columns;"
        " 4 columns suffice, because the others follow by mimic: swing, shoulder, elbow, wrist",
    ),
    "a chain is not cut": (URDF.replace("ball", "plate").replace("hand", "cross"), 1,
                           "has 3 moving joints up to the ball (turn, push, grip), but the data have 1 columns"),
    "joint name": (PALLETISER.replace('"shoulder"', '"swing"'), 5,
                   "has two joints with the name 'swing'; give every joint its own name"),
    "child": (PALLETISER.replace('<child link="l3"/>', '<child link="l2"/>'), 5,
              "link 'l2' is the child of two joints, shoulder and elbow; a URDF is a tree"),
    "mimic of a joint elsewhere": (
        PALLETISER.replace('mimic joint="elbow"', 'mimic joint="t"'), 4,
        "joint level mimics joint 't', which does not move the ball; name a moving joint between base and ball",
    ),
    "mimic of itself": (PALLETISER.replace('mimic joint="elbow"', 'mimic joint="level"'), 4,
                        "joint level mimics itself"),
    "multiplier": (PALLETISER.replace('"-2"', '"x"'), 4, "joint level: mimic multiplier='x' must be a number"),
    "kind": (PALLETISER.replace('"wrist" type="revolute"', '"wrist" type="planar"'), 4,
             "joint wrist: the type 'planar' is not supported; valid: fixed, revolute, continuous, prismatic"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED_ROBOTS)
def test_a_urdf_that_leaves_the_joints_open_is_refused_by_name(tmp_path, kind):
    text, columns, message = REFUSED_ROBOTS[kind]
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_robot(path, columns)
    assert (refused.value.where, refused.value.message) == (str(path), message)

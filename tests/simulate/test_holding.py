"""The holding law: what a grab takes, what it leaves, and the weld that holds it."""

import math

import mujoco
import numpy as np
import pytest

from hydrotele.simulate.gripping import RELEASED, TAKEN, UNCHANGED, WELD_SIZE, grip_parameters, grip_step

CENTRE, HALF = (0.7, 0.0, 0.1), (0.1, 0.3, 0.2)
GRIP = grip_parameters(1.2, 1.0, 1, math.radians(20.0), CENTRE, HALF, 0, (-1.5, 1.5))
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
ACROSS = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])  # own x axis along the grab's y


def turned(axis, angle, quaternion):
    about, out = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(about, np.array(axis, float), angle)
    mujoco.mju_mulQuat(out, about, quaternion)
    return out


def step(position=CENTRE, quaternion=ACROSS, angle=1.25, held=False):
    row = np.full(WELD_SIZE, np.nan)
    said = grip_step(GRIP, np.zeros(3), LEVEL, np.array(position), quaternion, angle, held, row)
    return said, row


def test_a_log_in_the_pocket_is_taken():
    said, row = step()
    assert said == TAKEN
    np.testing.assert_allclose(row, [0, 0, 0, *CENTRE, *ACROSS, 1.0], atol=1e-15)


@pytest.mark.parametrize(
    "off",
    [
        {"angle": 1.19},
        {"position": (0.81, 0.0, 0.1)},
        {"position": (0.59, 0.0, 0.1)},
        {"position": (0.7, 0.0, 0.31)},
        {"position": (0.7, 0.0, -0.11)},
        {"position": (0.7, 1.51, 0.1)},
        {"position": (0.7, -1.51, 0.1)},
        {"quaternion": LEVEL},
        {"quaternion": turned((0, 0, 1), math.radians(21.0), ACROSS)},
        {"quaternion": turned((1, 0, 0), math.radians(-21.0), ACROSS)},
        {"angle": math.nan},
    ],
)
def test_what_is_not_in_the_pocket_is_left(off):
    said, row = step(**off)
    assert said == UNCHANGED and np.isnan(row).all()


@pytest.mark.parametrize(
    "within",
    [
        {"position": (0.79, 0.0, 0.1)},
        {"position": (0.7, 1.49, 0.1)},
        {"quaternion": turned((0, 0, 1), math.radians(19.0), ACROSS)},
        {"quaternion": turned((0, 0, 1), math.pi, ACROSS)},  # the other end first
        {"quaternion": turned((0, 1, 0), 2.0, ACROSS)},  # rolled
    ],
)
def test_what_is_just_within_it_is_taken(within):
    assert step(**within)[0] == TAKEN


def test_a_log_held_far_from_its_middle_must_pass_through_the_pocket():
    """Askew by 10 deg and held 1 m from its middle, its axis is 0.18 m from there."""
    askew = turned((0, 0, 1), math.radians(10.0), ACROSS)
    along = np.array([-math.sin(math.radians(10.0)), math.cos(math.radians(10.0)), 0.0])
    assert step(np.array(CENTRE) + along, askew)[0] == TAKEN
    assert step(np.array(CENTRE) + [0.0, 1.0, 0.0], askew)[0] == UNCHANGED


def test_held_until_the_jaw_opens():
    """Between the two angles nothing changes either way, and where it is does not matter."""
    assert step(angle=1.1)[0] == UNCHANGED
    assert step(position=(9.0, 9.0, 9.0), angle=1.1, held=True)[0] == UNCHANGED
    assert step(angle=0.99, held=True)[0] == RELEASED


def test_the_weld_keeps_the_pose_in_which_it_was_taken():
    """MuJoCo finds no error in the weld of a thing taken in an arbitrary pose of both."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <body name="hand"><freejoint/><geom size="0.1"/></body>
      <body name="thing"><freejoint/><geom size="0.1"/></body></worldbody>
      <equality><weld body1="hand" body2="thing" active="false"/></equality></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:7] = [1.0, 2.0, 3.0, *turned((0.6, 0.0, 0.8), 0.7, LEVEL)]
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, data.qpos[3:7])
    thing = turned((0, 1, 0), 0.1, ACROSS)
    data.qpos[7:10] = data.qpos[:3] + turn.reshape(3, 3) @ [0.75, 0.4, 0.0]
    mujoco.mju_mulQuat(data.qpos[10:14], data.qpos[3:7], thing)
    mujoco.mj_forward(model, data)
    hand, body = model.body("hand").id, model.body("thing").id
    said = grip_step(
        GRIP, data.xpos[hand], data.xquat[hand], data.xpos[body], data.xquat[body], 1.3, False,
        model.eq_data[0],
    )  # fmt: skip
    data.eq_active[0] = said == TAKEN
    mujoco.mj_forward(model, data)
    assert data.nefc == 6
    assert np.abs(data.efc_pos).max() < 1e-12

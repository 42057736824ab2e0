"""Chains with ball and free joints, connects and welds, against MuJoCo's constrained dynamics."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import cardan_angles, load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import make_regressor
from tests.multibody.test_inverse_dynamics import CRANK

MIDDLE = (0.02, -0.03, 0.8)  # m, of the platform


def random_mass(body, rng):
    half = 0.2 * rng.normal(size=(3, 3))
    second = half @ half.T
    inertia = np.trace(second) * np.eye(3) - second
    body.mass, body.ipos, body.explicitinertial = rng.uniform(1, 4), rng.uniform(-0.1, 0.1, 3), True
    body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]


def hexapod(platform="free"):
    """Six legs of cross, tube and rod, connected to a platform: 19 bodies, 24 coordinates."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(3)
    top = spec.worldbody.add_body(name="platform", pos=MIDDLE)
    random_mass(top, rng)
    if platform == "free":
        top.add_freejoint(name="platform")
    else:  # the same by three slides and a ball
        for axis in np.eye(3):
            top.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        top.add_joint(name="platform", type=mujoco.mjtJoint.mjJNT_BALL)
    for k in range(6):
        middle, side = 2 * np.pi * (k // 2) / 3, (-1) ** k
        foot = 0.6 * np.array([np.cos(middle + 0.2 * side), np.sin(middle + 0.2 * side), 0.0])
        pin = 0.3 * np.array([np.cos(middle + 0.8 * side), np.sin(middle + 0.8 * side), 0.0])
        way = pin + MIDDLE - foot
        length = np.linalg.norm(way)
        across = np.cross((0.0, 1.0, 0.0), way)
        across /= np.linalg.norm(across)
        turn, quaternion = (
            np.array([across, np.cross(way / length, across), way / length]).T,
            np.empty(4),
        )
        mujoco.mju_mat2Quat(quaternion, turn.ravel())
        cross = spec.worldbody.add_body(name=f"cross{k}", pos=foot, quat=quaternion)
        cross.add_joint(name=f"first{k}", axis=(1, 0, 0))
        tube = cross.add_body(name=f"tube{k}")
        tube.add_joint(name=f"second{k}", axis=(0, 1, 0))
        rod = tube.add_body(name=f"rod{k}", pos=(0, 0, length))
        rod.add_joint(name=f"leg{k}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1))
        for body in (cross, tube, rod):
            random_mass(body, rng)
        spec.add_equality(
            name=f"pin{k}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=f"rod{k}", name2="platform", data=np.zeros(mujoco.mjNEQDATA),
        )  # fmt: skip
        spec.add_actuator(
            name=f"leg{k}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"leg{k}"
        )  # fmt: skip
    return spec.compile()


def legs(n=301, step=2e-3):
    """Motion (n, 6) of the legs from rest lengths, with its derivatives."""
    t, k = step * np.arange(n)[:, None], np.arange(6)
    w, size = 2.0 + 0.3 * k, 0.04
    return (
        size * (np.sin(w * t + k) - np.sin(k)),
        size * w * np.cos(w * t + k),
        -size * w**2 * np.sin(w * t + k),
    )


def in_mujoco(model, chain, row):
    """`qpos` of MuJoCo for positions (v,) of a chain whose one free or ball joint is `platform`."""
    qpos, here = np.zeros(model.nq), chain.qpos_indices >= 0
    qpos[chain.qpos_indices[here]] = row[here]
    angles = {name: row[chain.index(f"platform_r{name}")] for name in "xyz"}
    joint = model.joint("platform")
    place, quaternion, one = joint.qposadr[0], np.array([1.0, 0, 0, 0]), np.empty(4)
    if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
        qpos[place : place + 3] = [row[chain.index(f"platform_{name}")] for name in "xyz"]
        place += 3
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        mujoco.mju_axisAngle2Quat(one, axis, angles[name])
        mujoco.mju_mulQuat(quaternion, quaternion.copy(), one)
    qpos[place : place + 4] = quaternion
    return qpos


@pytest.mark.parametrize("platform", ["free", "ball"])
def test_leg_forces_of_a_hexapod_are_those_of_mujoco_with_multipliers(platform):
    """`M a + h = S' F + J' l` with MuJoCo's own M, h and J, for a motion with closed loops."""
    model, step = hexapod(platform), 2e-3
    chain = load_chain(model)
    assert len(chain.bodies) == 19 and len(chain.joints) == 24 and len(chain.closures) == 6
    found = project_on_drives(chain, chain.drives, *legs())
    forces = found.body_projection @ chain.inertia.ravel()
    whole = make_regressor(chain, found, offsets=False)
    np.testing.assert_allclose(whole.matrix @ whole.nominal, forces, rtol=1e-12)
    selector = np.zeros((model.nv, 6))
    selector[[model.joint(name).dofadr[0] for name in chain.drives], range(6)] = 1.0
    quiet = model.__copy__()
    for part in ("CONTACT", "ACTUATION", "LIMIT"):
        quiet.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    quiet.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data, mass = mujoco.MjData(quiet), np.zeros((model.nv, model.nv))
    for row in (1, 100, 250):
        pose = [in_mujoco(model, chain, found.position[i]) for i in (row - 1, row, row + 1)]
        before, after = np.zeros(model.nv), np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, before, step, pose[0], pose[1])
        mujoco.mj_differentiatePos(model, after, step, pose[1], pose[2])
        data.qpos[:], data.qvel[:] = pose[1], 0.5 * (before + after)
        mujoco.mj_forward(quiet, data)
        assert np.abs(data.efc_pos).max() < 1e-10
        mujoco.mj_fullM(quiet, data, mass)
        jacobian = data.efc_J.reshape(-1, model.nv)
        need = mass @ (after - before) / step + data.qfrc_bias
        solved, *_ = np.linalg.lstsq(np.column_stack([selector, jacobian.T]), need, rcond=None)
        # differences over 2 ms of a motion below 3.5 rad/s in frequency: (w h)^2 / 6 = 1e-5
        np.testing.assert_allclose(solved[:6], forces[row], atol=1e-4 * np.abs(forces[row]).max())


WELDED = CRANK.replace(
    '<inertial pos="0 0 0.05" mass="3" diaginertia="0.03 0.03 0.03"/>',
    '<inertial pos="0 0 0.05" mass="3" diaginertia="0.03 0.03 0.03"/>'
    '<body name="eye" euler="0.3 0.2 0.1"><joint name="eye" axis="AXIS"/>'
    '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/></body>',
)


def test_a_weld_to_a_body_that_turns_in_the_pin_is_the_connect():
    """A crank whose rod is welded to a pin on the slider, with sites or bodies, and its twin."""
    turn = np.empty(4)
    mujoco.mju_euler2Quat(turn, np.array([0.3, 0.2, 0.1]), "xyz")
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, turn)
    axis = matrix.reshape(3, 3).T @ (0.0, 1.0, 0.0)
    text = WELDED.replace("AXIS", " ".join(f"{a:.17g}" for a in axis))
    by_bodies = text.replace(
        '<connect body1="rod" body2="slider" anchor="0.8 0 0"/>',
        '<weld body1="eye" body2="rod" anchor="0.8 0 0"/>',
    )
    t = np.linspace(0.0, 2.0, 200)[:, None]
    size, w, k = np.array([0.5, 0.3, 0.4]), np.array([1.1, 1.7, 1.4]), np.arange(3)
    motion = (
        size * np.sin(w * t + k), size * w * np.cos(w * t + k), -size * w**2 * np.sin(w * t + k)
    )  # fmt: skip
    found = []
    for xml in (CRANK, by_bodies):
        model = mujoco.MjModel.from_xml_string(xml)
        chain = load_chain(model)
        moved = project_on_drives(chain, ("yaw", "lift", "crank"), *motion, drives=("yaw", "lift", "crank"))
        data = mujoco.MjData(model)
        data.qpos[:] = moved.position[100]
        mujoco.mj_forward(model, data)
        assert np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max() < 1e-9
        found.append(moved.body_projection @ chain.inertia.ravel())
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-6)  # the pin's own mass


def test_what_lies_beside_a_mechanism_has_no_joints_in_its_chain():
    xml = CRANK.replace(
        "<worldbody>",
        "<worldbody><body name='stone' pos='3 0 0'><joint type='free' damping='1'/><geom size='0.1'/></body>",
    )
    chain, plain = (load_chain(mujoco.MjModel.from_xml_string(x)) for x in (xml, CRANK))
    assert chain.joints == plain.joints and "stone" in chain.bodies
    model = mujoco.MjModel.from_xml_string(xml)
    for name, place in zip(chain.joints, chain.qpos_indices, strict=True):
        assert place == model.joint(name).qposadr[0]


def test_refusals():
    damped = "<mujoco><worldbody><body><joint name='a' type='ball' damping='1'/><geom size='1'/>"
    with pytest.raises(InputError, match="joint a: only hinges and slides may have damping"):
        load_chain(mujoco.MjModel.from_xml_string(damped + "</body></worldbody></mujoco>"))
    coupled = CRANK.replace("<equality>", "<equality><joint name='x' joint1='yaw' joint2='crank'/>")
    with pytest.raises(InputError, match="constraint x is neither `connect` nor `weld`"):
        load_chain(mujoco.MjModel.from_xml_string(coupled))


def test_cardan_angles_return():
    rng = np.random.default_rng(1)
    for a, b, c in rng.uniform(-1.5, 1.5, (50, 3)):
        turns, turn = np.empty(9), np.eye(3)
        for axis, angle in zip(np.eye(3), (a, b, c), strict=True):
            quaternion = np.empty(4)
            mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
            mujoco.mju_quat2Mat(turns, quaternion)
            turn = turn @ turns.reshape(3, 3)
        np.testing.assert_allclose(cardan_angles(turn), (a, b, c), atol=1e-12)

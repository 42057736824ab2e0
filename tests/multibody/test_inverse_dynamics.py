"""Chains read from MJCF, against Pinocchio on the tree and MuJoCo's inverse dynamics on loops."""

import dataclasses

import mujoco
import numpy as np
import pinocchio
import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.simulate.plant import build_plant, rest_state

# Franka Panda, joint by joint: orientation of the frame [rad], its place [m]
PANDA = (
    ((0, 0, 0), (0, 0, 0.333)),
    ((-np.pi / 2, 0, 0), (0, 0, 0)),
    ((np.pi / 2, 0, 0), (0, -0.316, 0)),
    ((np.pi / 2, 0, 0), (0.0825, 0, 0)),
    ((-np.pi / 2, 0, 0), (-0.0825, 0.384, 0)),
    ((np.pi / 2, 0, 0), (0, 0, 0)),
    ((np.pi / 2, 0, 0), (0.088, 0, 0)),
)
# A slider-crank out of the plane of its joints' first axis, with two joints in one body.
CRANK = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0.4 -0.3 -9.7"/>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="0.2 0.1 -0.3">
      <joint name="yaw" axis="0 0 1" pos="0.05 0 0"/>
      <joint name="lift" type="slide" axis="0 0.6 0.8"/>
      <inertial pos="0.1 0.2 -0.1" mass="5" fullinertia="0.5 0.6 0.7 0.05 -0.02 0.03"/>
      <body name="crank" pos="0 0.3 0.1">
        <joint name="crank" axis="0 1 0" ref="0.1"/>
        <inertial pos="0.1 0 0.02" mass="2" fullinertia="0.05 0.06 0.07 0.005 0 0.003"/>
        <body name="rod" pos="0.3 0 0">
          <joint name="rod" axis="0 1 0"/>
          <inertial pos="0.4 0.01 0" mass="1" fullinertia="0.02 0.06 0.07 0 0.001 0"/>
        </body>
      </body>
      <body name="slider" pos="1.1 0.3 0.1">
        <joint name="slider" type="slide" axis="1 0 0"/>
        <inertial pos="0 0 0.05" mass="3" diaginertia="0.03 0.03 0.03"/>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="rod" body2="slider" anchor="0.8 0 0"/></equality>
</mujoco>
"""


def panda():
    """The Panda with made-up masses, none of them special."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(1)
    body = spec.worldbody
    for k, (rpy, xyz) in enumerate(PANDA):
        quaternion = np.empty(4)
        mujoco.mju_euler2Quat(quaternion, np.array(rpy, float), "XYZ")
        half = rng.normal(size=(3, 3))
        second = half @ half.T
        inertia = np.trace(second) * np.eye(3) - second
        body = body.add_body(
            name=f"link{k + 1}", pos=xyz, quat=quaternion, mass=rng.uniform(1, 4),
            ipos=rng.uniform(-0.1, 0.1, 3), explicitinertial=True,
            fullinertia=[*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]],
        )  # fmt: skip
        body.add_joint(name=f"joint{k + 1}", axis=(0, 0, 1))
    return spec.compile()


def opened(chain):
    """The chain's tree, without its closures."""
    tree = chain.tree
    tree = tree._replace(
        closure_bodies=tree.closure_bodies[:0],
        closure_points=tree.closure_points[:0],
        first_equation=tree.first_equation[:1],
    )
    return dataclasses.replace(chain, tree=tree)


def in_pinocchio(model):
    """Pinocchio's model of the same tree, and the body of each of its joints."""
    twin = pinocchio.Model()
    twin.gravity.linear = model.opt.gravity.copy()
    places, bodies = {0: (0, pinocchio.SE3.Identity())}, []
    for b in range(1, model.nbody):
        joint, frame = places[model.body_parentid[b]]
        turn = pinocchio.Quaternion(*model.body_quat[b]).toRotationMatrix()
        frame = frame * pinocchio.SE3(turn, model.body_pos[b])
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            hinge = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            kind = (
                pinocchio.JointModelRevoluteUnaligned if hinge
                else pinocchio.JointModelPrismaticUnaligned
            )  # fmt: skip
            anchor = pinocchio.SE3(np.eye(3), model.jnt_pos[j])
            joint = twin.addJoint(joint, kind(*model.jnt_axis[j]), frame * anchor, f"joint{j}")
            bodies.append(-1)
            frame = anchor.inverse()
        if model.body_jntnum[b]:
            bodies[-1] = b
        places[b] = (joint, frame)
    return twin, bodies


ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # of Pinocchio's parameters: xx, xy, yy, xz, yz, zz


def moved(offset):
    """Matrix (10, 10): parameters about one origin -> about another, at an offset from it."""
    shift = np.eye(4)
    shift[:3, 3] = -offset
    out = np.zeros((10, 10))
    for k, unit in enumerate(np.eye(10)):
        about = np.zeros((3, 3))
        about[np.triu_indices(3)] = unit[4:]
        about += np.triu(about, 1).T
        pseudo = np.zeros((4, 4))  # second moments, first moments, mass
        pseudo[:3, :3] = 0.5 * np.trace(about) * np.eye(3) - about
        pseudo[:3, 3] = pseudo[3, :3] = unit[1:4]
        pseudo[3, 3] = unit[0]
        there = shift @ pseudo @ shift.T
        about = np.trace(there[:3, :3]) * np.eye(3) - there[:3, :3]
        out[:, k] = [there[3, 3], *there[:3, 3], *about[np.triu_indices(3)]]
    return out


MODELS = {"panda": panda(), "crank": mujoco.MjModel.from_xml_string(CRANK)}


@pytest.mark.parametrize("name", MODELS)
def test_the_regressor_of_a_tree_is_that_of_pinocchio(name):
    model = MODELS[name]
    chain = opened(load_chain(model))
    rng, v = np.random.default_rng(2), model.nv
    motion = [rng.uniform(-1.5, 1.5, (20, v)) for _ in range(3)]
    found = project_on_drives(chain, chain.joints, *motion, drives=chain.joints)
    twin, bodies = in_pinocchio(model)
    data = twin.createData()
    for row in range(20):
        q, rate, acceleration = (part[row] for part in motion)
        theirs = pinocchio.computeJointTorqueRegressor(twin, data, q - model.qpos0, rate, acceleration)
        for joint, body in enumerate(bodies):
            if body < 0:
                continue
            # theirs is about the anchor of the body's last joint, ours about the body's origin
            last = model.body_jntadr[body] + model.body_jntnum[body] - 1
            block = theirs[:, 10 * joint : 10 * joint + 10][:, ORDER]
            ours = found.body_projection[row][:, 10 * (body - 1) : 10 * body]
            expected = block @ moved(model.jnt_pos[last])
            np.testing.assert_allclose(ours, expected, atol=1e-9 * np.abs(expected).max())


def inverse(model, chain, found, row):
    """MuJoCo's own joint forces (v,) of the open tree for a projected row."""
    model = model.__copy__()
    for part in ("EQUALITY", "LIMIT", "CONTACT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = found.position[row], found.rate[row]
    data.qacc[:] = found.acceleration[row]
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()


CLOSED = {
    "none": ("cat215", ("swing", "boom", "stick")),
    "bucket": ("cat215", ("swing", "boom", "stick", "bucket")),
    "crank": (None, ("yaw", "lift", "crank")),
}


def closed(name):
    """Model, chain, names and a smooth motion (n, k) with its derivatives."""
    machine, given = CLOSED[name]
    if machine:
        plant = build_plant(load_machine("cat215", name))
        model = plant.model
        middle, width = np.array([0.1, 0.3, -1.6, -1.0]), np.array([0.8, 0.3, 0.5, 0.4])
        chain = dataclasses.replace(load_chain(model), start=rest_state(plant).qpos.copy())
    else:
        model = MODELS["crank"]
        chain = dataclasses.replace(load_chain(model), drives=given)
        middle, width = np.array([0.2, 0.1, 0.5]), np.array([0.5, 0.3, 0.4])
    k = len(given)
    t, rate = 0.02 * np.arange(400)[:, None], np.array([1.1, 1.7, 1.4, 2.1])[:k]
    middle, width = middle[:k], width[:k]
    q = middle + width * np.sin(rate * t + np.arange(k))
    qd = width * rate * np.cos(rate * t + np.arange(k))
    return model, chain, given, q, qd, -(rate**2) * (q - middle)


@pytest.mark.parametrize("name", CLOSED)
def test_drive_forces_of_closed_loops_are_those_of_mujoco(name):
    """Its inverse dynamics knows only the tree; virtual work carries it to the drives."""
    model, chain, given, *motion = closed(name)
    found = project_on_drives(chain, given, *motion)
    forces = found.body_projection @ chain.inertia.ravel()
    for row in range(0, 400, 37):
        joints = inverse(model, chain, found, row) - chain.damping * found.rate[row]
        joints -= chain.armature * found.acceleration[row]
        expected = found.joint_projection[row] @ joints
        np.testing.assert_allclose(forces[row], expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", CLOSED)
def test_the_motion_of_hidden_joints_closes_the_loops_and_is_its_own_derivative(name):
    model, chain, given, *motion = closed(name)
    found, step = project_on_drives(chain, given, *motion), 0.02
    data = mujoco.MjData(model)
    for row in (0, 150, 399):
        data.qpos[:] = found.position[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeConstraint(model, data)
        assert np.abs(data.efc_pos[: 3 * model.neq]).max() < 1e-10
    # fourth-order differences over 20 ms; the motion's fifth derivative is below 30
    for part, of in ((found.rate, found.position), (found.acceleration, found.rate)):
        slope = (of[:-4] - 8 * of[1:-3] + 8 * of[3:-1] - of[4:]) / (12 * step)
        assert np.abs(slope - part[2:-2]).max() < 1e-4 * max(1.0, np.abs(part).max())


def test_virtual_work_of_joints_and_pins():
    """Friction in a joint or a closure takes from the drives the power that it burns."""
    _, chain, given, *motion = closed("bucket")
    found = project_on_drives(chain, given, *motion)
    drives = [chain.index(name) for name in chain.drives]
    burnt = np.einsum("nkc,nk->nc", found.closure_projection, found.rate[:, drives])
    np.testing.assert_allclose(burnt, found.closure_rate**2, atol=1e-9)
    spent = np.einsum("nkv,nk->nv", found.joint_projection, found.rate[:, drives])
    np.testing.assert_allclose(spent, found.rate, atol=1e-9)


def test_refusals_say_what_is_wrong():
    _, chain, given, q, v, a = closed("none")
    with pytest.raises(InputError, match="row 3 has no position, rate or acceleration"):
        project_on_drives(chain, given, np.where(np.arange(400)[:, None] == 3, np.nan, q), v, a)
    with pytest.raises(InputError, match="2 joints are given but 3 have a drive"):
        project_on_drives(chain, given[:2], q[:, :2], v[:, :2], a[:, :2])
    with pytest.raises(InputError, match="cat215 has no joint bom"):
        project_on_drives(chain, ("swing", "bom", "stick"), q, v, a)
    _, linkage, four, *motion = closed("bucket")
    motion[0][7, 3] = 1.5  # rad; the four-bar linkage ends at 0.25
    with pytest.raises(InputError, match="row 7: the loops of cat215 cannot be closed"):
        project_on_drives(linkage, four, *motion)
    with pytest.raises(InputError, match="neither given nor determined by a closure: boom_rod|stick_tube"):
        project_on_drives(opened(chain), given, q, v, a)

"""The bucket of the CAT 215 in soil: the force is held over 5 ms, the machine steps at 1 kHz."""

import math

import mujoco
import numpy as np
import pytest

from hydrotele.kinematics.arm_dimensions import arm_geometry
from hydrotele.kinematics.task_space import arm_parameters, compute_tip_pose, solve_joint_angles, task_jacobian
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.soil.parameters import (
    CARRIED_VOLUME,
    CAT215,
    FORCE_R,
    FORCE_Z,
    GRAVITY,
    MASS,
    RESULT_SIZE,
    SOILS,
    make_bucket_state,
    make_level_profile,
    pack_soil_parameters,
    total_soil_mass,
)
from hydrotele.soil.step import EdgeMotion, compute_bucket_wrench, step_soil

AXES = ("swing", "boom", "stick", "bucket")
DEGREE = math.pi / 180.0


@pytest.fixture(scope="module")
def plant():
    return build_plant(load_machine("cat215", "bucket"), ground=False)


def dig(plant, steps, seconds=2.5, draw=1.2):
    """Stick and bucket open-loop through firm soil with the force held over some physics steps."""
    model = plant.model
    g = arm_parameters(arm_geometry(plant.machine))
    order = [plant.axes.index(name) for name in AXES]
    q, pose, jacobian = np.zeros(4), np.zeros(5), np.zeros((4, 4))
    solve_joint_angles(g, np.array([6.3, 0.0, -0.12, -88.0 * DEGREE, 0.0]), 0.0, q)
    joints = [plant.machine.axes[name].joint for name in AXES]
    data = rest_state(plant, dict(zip(joints, q.tolist(), strict=True)))
    data.ctrl[:] = 0.0
    n = pack_soil_parameters(SOILS["firm"], CAT215, 3.0, 0.05)
    (surface, loose), state, out = (
        make_level_profile(140),
        make_bucket_state(),
        np.zeros(RESULT_SIZE),
    )
    body, wrench, rows = model.body("bucket").id, np.zeros(6), []
    mass = total_soil_mass(n, surface, loose, state)
    period = steps * model.opt.timestep
    for k in range(round(seconds / period)):
        compute_tip_pose(g, data.qpos[plant.qpos[order]], pose)
        task_jacobian(g, data.qpos[plant.qpos[order]], jacobian)
        rate = jacobian @ data.qvel[plant.dof[order]]
        motion = EdgeMotion(pose[0], pose[2], rate[0], rate[2], pose[3])
        step_soil(n, surface, loose, state, motion, period, out)
        edge = np.array([pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1]), pose[2]])
        compute_bucket_wrench(out, edge, pose[1], data.xipos[body], wrench)
        data.xfrc_applied[body] = wrench
        data.ctrl[plant.axes.index("stick")] = 0.25 if k * period < draw else 0.0
        mujoco.mj_step(model, data, nstep=steps)
        rows.append((pose[0], pose[2], out[FORCE_R], out[FORCE_Z]))
    assert total_soil_mass(n, surface, loose, state) == pytest.approx(mass, abs=1e-9)
    return np.array(rows), state, surface


def test_digging_machine_does_not_chatter(plant):
    rows, state, surface = dig(plant, 5)
    fine, fine_state, _ = dig(plant, 1)
    assert rows[0, 0] - rows[-1, 0] > 0.2  # m, drawn in
    assert 1.5e4 < rows[:, 2].max() < 8e4  # N
    assert state[CARRIED_VOLUME] > 0.02
    assert surface.min() < -0.05
    # Held over 5 ms or renewed every 1 ms, the machine goes the same way.
    assert rows[:, :2] == pytest.approx(fine[::5, :2], abs=5e-3)
    assert state[CARRIED_VOLUME] == pytest.approx(fine_state[CARRIED_VOLUME], rel=0.05)
    # At the end the valves are closed: the soil holds the bucket, and nothing moves.
    still = rows[-60:]
    assert np.ptp(still[:, :2], axis=0).max() < 2e-3
    assert np.abs(np.diff(still[:, 2])).max() < 0.02 * rows[:, 2].max()


def test_wrench_does_the_work_of_its_parts(plant):
    """Its power over any motion of the body is that of force, moment and weight in the plane."""
    model, data = plant.model, rest_state(plant)
    g = arm_parameters(arm_geometry(plant.machine))
    order = [plant.axes.index(name) for name in AXES]
    pose, jacobian = np.zeros(5), np.zeros((4, 4))
    q = data.qpos[plant.qpos[order]]
    compute_tip_pose(g, q, pose)
    task_jacobian(g, q, jacobian)
    mujoco.mj_forward(model, data)
    body = model.body("bucket").id
    out = np.array([3e4, -1e4, 5e3, 400.0, 0.5, 0.2])
    edge = np.array([pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1]), pose[2]])
    wrench = np.zeros(6)
    compute_bucket_wrench(out, edge, pose[1], data.xipos[body], wrench)
    force, torque = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, force, torque, body)
    found = (wrench[:3] @ force + wrench[3:] @ torque)[plant.dof[order]]
    load = out[MASS] * GRAVITY
    expected = jacobian[0] * out[0] + jacobian[2] * (out[1] - load)
    expected += jacobian[3] * (out[2] - load * out[4])
    # The moment's axis is across the edge's azimuth, a degree off that of the arm's pins.
    assert found[1:] == pytest.approx(expected[1:], rel=2e-3, abs=50.0)
    assert abs(found[0] - expected[0]) < 2e2

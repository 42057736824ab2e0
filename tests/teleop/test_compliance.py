"""A levitated handle in MuJoCo: step responses about the chosen centre, hovering, currents."""

import mujoco
import numpy as np
import pytest

from hydrotele.errors import InputError
from hydrotele.teleop.coils import three_stations
from hydrotele.teleop.compliance import Axes, Flotor, Motion, compliance_wrench

# joystick.yaml: mass, centre of mass and inertia of the flotor, its handle, and its sensors
FLOTOR = Flotor(0.85, np.array([0.0, 0.0, 0.02]), np.diag([1.2e-3, 1.2e-3, 1.5e-3]))
HANDLE = np.array([0.0, 0.0, 0.12])
FINE, FINE_TURN = 1e-6, np.deg2rad(0.001)
AXES = Axes(np.full(6, 25.0), np.full(6, 0.8))
COILS = three_stations(0.05, 8.0, 4.0)
STEP, PERIOD = 2.5e-4, 5e-3
MJCF = """<mujoco><option timestep="0.00025"/><worldbody><body name="flotor"><freejoint/>
<inertial pos="0 0 0.02" mass="0.85" diaginertia="0.0012 0.0012 0.0015"/>
</body></worldbody></mujoco>"""


def flown(target, turned, seconds=0.6):
    """Displacement of the handle and rotation vector (n, 6), and the largest current.

    Control runs at 200 Hz on positions as fine as the sensors', noisy by one step, and velocities
    from differences.
    """
    rng = np.random.default_rng(8)
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    out, largest, before = [], 0.0, None
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(
        quaternion, turned / max(np.linalg.norm(turned), 1e-12), float(np.linalg.norm(turned))
    )
    for n in range(round(seconds / STEP)):
        if n % round(PERIOD / STEP) == 0:
            place = FINE * np.round(data.qpos[:3] / FINE + rng.uniform(-1, 1, 3))
            vector = np.zeros(3)
            mujoco.mju_quat2Vel(vector, data.qpos[3:7], 1.0)
            vector = FINE_TURN * np.round(vector / FINE_TURN + rng.uniform(-1, 1, 3))
            q = np.zeros(4)
            size = np.linalg.norm(vector)
            mujoco.mju_axisAngle2Quat(q, vector / max(size, 1e-12), float(size))
            now = np.concatenate([place, vector])
            speed = np.zeros(6) if before is None else (now - before) / PERIOD
            before = now
            motion = Motion(place, q, speed[:3], speed[3:])
            wrench = compliance_wrench(FLOTOR, AXES, HANDLE, motion, HANDLE + target, quaternion)
            found = COILS.currents(wrench)
            assert not found.limited
            largest = max(largest, float(np.abs(found.value).max()))
            made = COILS.wrench(found.value)
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, data.qpos[3:7])
            turn = turn.reshape(3, 3)
            data.qfrc_applied[:3], data.qfrc_applied[3:] = turn @ made[:3], made[3:]
        mujoco.mj_step(model, data)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, data.qpos[3:7])
        vector = np.zeros(3)
        mujoco.mju_quat2Vel(vector, data.qpos[3:7], 1.0)
        moved = data.qpos[:3] + turn.reshape(3, 3) @ HANDLE - HANDLE
        out.append(np.concatenate([moved, vector]))
    return np.array(out), largest


def designed(time, frequency=25.0, ratio=0.8):
    """Unit step response of a second-order system."""
    damped = frequency * np.sqrt(1.0 - ratio**2)
    wave = np.cos(damped * time) + ratio * frequency / damped * np.sin(damped * time)
    return 1.0 - np.exp(-ratio * frequency * time) * wave


@pytest.mark.parametrize("axis", range(6))
def test_every_axis_steps_as_designed_and_leaves_the_others_alone(axis):
    size = 2e-3 if axis < 3 else np.deg2rad(3.0)
    step = np.zeros(6)
    step[axis] = size
    found, current = flown(step[:3], step[3:])
    time = STEP * np.arange(1, len(found) + 1)
    # a control that holds for 5 ms and differences that are 5 ms old count as 5 ms of delay
    assert np.abs(found[:, axis] / size - designed(time)).max() < 0.05
    others = found / ([2e-3] * 3 + [np.deg2rad(3.0)] * 3)
    assert np.abs(np.delete(others, axis, axis=1)).max() < 0.02
    assert current < 4.0


def test_it_hovers_within_ten_micrometres():
    """After it was lifted by 0.3 mm, with the noise of its sensors."""
    lift = np.array([0.0, 0.0, 3e-4])
    found, _ = flown(lift, np.zeros(3), 3.0)
    held = found[round(1.0 / STEP) :, :3] - lift
    assert 1e-8 < np.abs(held).max() < 1e-5


def test_bodies_and_axes_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="no body"):
        Flotor(0.85, np.zeros(3), np.diag([1e-3, 1e-3, 5e-3]))
    with pytest.raises(InputError, match="six positive"):
        Axes(np.full(6, 25.0), np.zeros(6))

"""Remote centre of compliance: accelerations are those asked for, on any body; refusals.

Step responses and hovering of the shipped joystick are in `test_levitation`.
"""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.teleop.compliance import AxisDynamics, Flotor, FlotorMotion, compliance_wrench

BODY = Flotor(
    0.85,
    np.array([0.003, -0.004, 0.02]),
    np.array([[1.2e-3, 1e-4, 0.0], [1e-4, 1.1e-3, -5e-5], [0.0, -5e-5, 1.5e-3]]),
)
HANDLE = np.array([0.01, 0.0, 0.12])
AXES = AxisDynamics(np.array([25.0, 20.0, 30.0, 25.0, 35.0, 15.0]), np.full(6, 0.8))
MJCF = """<mujoco><worldbody><body name="flotor"><freejoint/>
<inertial pos="0.003 -0.004 0.02" mass="0.85"
 fullinertia="0.0012 0.0011 0.0015 0.0001 0 -0.00005"/></body></worldbody></mujoco>"""


def test_every_axis_accelerates_as_its_own_second_order_system():
    """In MuJoCo, moving and turned: the handle's acceleration and that of the quaternion."""
    rng = np.random.default_rng(2)
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    for _ in range(20):
        quaternion = np.array([1.0, *rng.uniform(-0.1, 0.1, 3)])
        data.qpos[:3], data.qpos[3:] = (
            rng.uniform(-0.01, 0.01, 3),
            quaternion / np.linalg.norm(quaternion),
        )
        data.qvel[:] = rng.uniform(-1.0, 1.0, 6) * ([0.1] * 3 + [1.0] * 3)
        motion = FlotorMotion(data.qpos[:3], data.qpos[3:], data.qvel[:3], data.qvel[3:])
        target, turned = rng.uniform(-0.01, 0.01, 3), np.array([1.0, 0.0, 0.0, 0.0])
        wrench = compliance_wrench(BODY, AXES, HANDLE, motion, target, turned)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, data.qpos[3:])
        turn = turn.reshape(3, 3)
        data.qfrc_applied[:3], data.qfrc_applied[3:] = turn @ wrench[:3], wrench[3:]
        mujoco.mj_forward(model, data)
        w, about = data.qvel[3:], data.qacc[3:]
        handle = data.qpos[:3] + turn @ HANDLE
        speed = data.qvel[:3] + turn @ np.cross(w, HANDLE)
        swing = np.cross(about, HANDLE) + np.cross(w, np.cross(w, HANDLE))
        spring, damper = AXES.frequency**2, 2.0 * AXES.damping_ratio * AXES.frequency
        asked = spring[:3] * (target - handle) - damper[:3] * speed
        # rounding of forces of 10 N over masses of 1 kg and inertias of 1e-3 kg m^2
        np.testing.assert_allclose(data.qacc[:3] + turn @ swing, asked, atol=1e-10)
        q0, q = data.qpos[3], data.qpos[4:]
        rate = 0.5 * (q0 * w + np.cross(q, w))
        change = 0.5 * (q0 * about + np.cross(q, about) - 0.25 * (w @ w) * 2.0 * q)
        np.testing.assert_allclose(change, -spring[3:] * q - damper[3:] * rate, atol=1e-9)


def test_bodies_and_axes_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="not physical"):
        Flotor(0.85, np.zeros(3), np.diag([1e-3, 1e-3, 5e-3]))
    with pytest.raises(InputError, match="six positive"):
        AxisDynamics(np.full(6, 25.0), np.zeros(6))

"""The arm's closed forms: round trips, both branches, reach, Jacobians, and Zhu's own equations."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hydrotele.kinematics.arm import (
    ArmGeometry,
    UnreachableError,
    cartesian_jacobian,
    forward_kinematics,
    forward_kinematics_cartesian,
    inverse_kinematics,
    jacobian,
)
from tests.kinematics.workspace import radial_interval, reach

CAT215 = ArmGeometry(
    base_radius=0.340,
    lateral_offset=-0.110,
    boom_pin_height=1.90,
    boom_length=5.180,
    stick_length=1.800,
    tool_offset=(1.35, 0.2),
)
BARE = ArmGeometry(
    base_radius=0.340,
    lateral_offset=-0.110,
    boom_length=5.180,
    stick_length=1.800,
    tool_offset=(0.3, -0.4),
    has_tool_joint=False,
)

BARE_STICK = ArmGeometry(
    base_radius=0.340,
    lateral_offset=0.0,
    boom_length=5.180,
    stick_length=1.800,
    has_tool_joint=False,
)


def angles(low, high):
    """Angles in degrees, drawn as radians."""
    return st.floats(math.radians(low), math.radians(high))


SWING, TOOL = angles(-720, 720), angles(-200, 60)
MACHINE_Q = st.tuples(angles(-180, 180), angles(-42, 58.9), angles(-155, -25), angles(-160, 20))
GEOMETRY = st.builds(
    ArmGeometry,
    base_radius=st.floats(0.0, 0.6),
    lateral_offset=st.floats(-0.3, 0.3),
    boom_pin_height=st.floats(0.0, 2.5),
    boom_length=st.floats(2.0, 7.0),
    stick_length=st.floats(0.8, 4.0),
    tool_offset=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    has_tool_joint=st.booleans(),
)


def central_difference(function, q, step=1e-5):
    """Derivative of a vector function, columns by coordinate."""
    columns = []
    for i in range(len(q)):
        up, down = list(q), list(q)
        up[i] += step
        down[i] -= step
        columns.append((np.array(function(up)) - np.array(function(down))) / (2 * step))
    return np.array(columns).T


def plane_x(geometry, q):
    """Distance of the controlled point ahead of the swing axis in the arm plane."""
    return forward_kinematics_cartesian(geometry, (0.0, *q[1:]))[0]


@given(MACHINE_Q)
def test_round_trip_within_the_joint_limits(q):
    """1e-10 is asked of the room; the CAT 215 never comes nearer to full stretch than 25 deg."""
    np.testing.assert_allclose(inverse_kinematics(CAT215, forward_kinematics(CAT215, q)), q, rtol=0, atol=1e-10)


def test_round_trip_on_a_grid_of_the_whole_workspace():
    """All of the elbow-up half plane but 1e-4 rad at full stretch and fold, see `inverse_kinematics`."""
    bends = -np.radians(np.concatenate([np.geomspace(0.0058, 90, 60), 180 - np.geomspace(0.0058, 89, 60)]))
    for boom in np.radians(np.arange(-85, 86, 5.0)):
        for bend in bends:
            q = (2.5, float(boom), float(bend), -0.7)
            if plane_x(CAT215, q) > 0.3:
                np.testing.assert_allclose(
                    inverse_kinematics(CAT215, forward_kinematics(CAT215, q)), q, rtol=0, atol=1e-10
                )


@pytest.mark.parametrize("bend", [1e-5, 1e-6, 1e-7, 1e-8, 0.0])
def test_at_full_stretch_only_the_rounding_of_the_pose_is_lost(bend):
    """Length falls by a2 a3 / (2 (a2 + a3)) bend^2; 3e-15 m of rounding is worth that much bend."""
    q = (0.0, 0.2, -bend, 0.0)
    curvature = 5.18 * 1.8 / 6.98
    lost = 3e-15 / curvature / max(bend, math.sqrt(3e-15 / curvature))
    np.testing.assert_allclose(
        inverse_kinematics(CAT215, forward_kinematics(CAT215, q))[2], q[2], rtol=0, atol=2 * lost
    )


@given(GEOMETRY, SWING, angles(-85, 85), angles(0.1, 179.9), TOOL, st.sampled_from([1, -1]))
def test_round_trip_of_any_arm_on_both_branches(geometry, swing, boom, bend, tool, elbow):
    """1e-10 needs 0.1 deg of bend and 0.1 m before the swing axis, where theta turns fast."""
    offset = 0.0
    if not geometry.has_tool_joint:
        along, up = geometry.tool_offset
        assume(math.hypot(geometry.stick_length + along, up) > 0.3)
        offset = math.atan2(up, geometry.stick_length + along)
    q = (swing, boom, -elbow * bend - offset, tool)[: 3 + geometry.has_tool_joint]
    assume(plane_x(geometry, q) > 0.1)
    pose = forward_kinematics(geometry, q)
    np.testing.assert_allclose(inverse_kinematics(geometry, pose, elbow), q, rtol=0, atol=1e-10)
    other = inverse_kinematics(geometry, pose, -elbow)
    np.testing.assert_allclose(forward_kinematics(geometry, other), pose, rtol=0, atol=1e-11)  # rounding x 1e3
    assert abs(other[2] - q[2]) > 1e-3


@given(MACHINE_Q)
def test_inverse_is_zhus(q):
    """Eqs 2.3-2.4 as printed, his d2 being minus the y of the arm plane; acos costs digits."""
    a1, a2, a3, d2 = 0.340, 5.180, 1.800, 0.110
    arm = ArmGeometry(base_radius=a1, lateral_offset=-d2, boom_length=a2, stick_length=a3)
    r_e, theta_e, z_e, phi = forward_kinematics(arm, q)
    r = math.sqrt(r_e**2 - d2**2)
    alpha = math.acos((a2**2 + a3**2 - z_e**2 - (r - a1) ** 2) / (2 * a2 * a3))
    theta_2 = math.atan2(z_e, r - a1)
    theta_2 += math.atan2(a3 * math.sin(alpha), a2 - a3 * math.cos(alpha))
    theta_3 = -(math.pi - alpha)
    zhu = theta_e + math.atan2(d2, r), theta_2, theta_3, phi - theta_2 - theta_3
    np.testing.assert_allclose(inverse_kinematics(arm, (r_e, theta_e, z_e, phi)), zhu, rtol=0, atol=1e-12)


def test_out_of_reach_says_distance_and_interval():
    """The message carries the distance asked and both ends of the reachable interval."""
    with pytest.raises(UnreachableError, match=r"7\.66 m from the boom pin.*\[3\.38, 6\.98\]"):
        inverse_kinematics(BARE_STICK, (8.0, 0.0, 0.0))
    with pytest.raises(UnreachableError, match=r"radius 0\.05 m requested"):
        inverse_kinematics(CAT215, (0.05, 0.0, 0.0, 0.0))
    with pytest.raises(UnreachableError):
        inverse_kinematics(CAT215, (math.nan, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="3 numbers, got 4"):
        inverse_kinematics(BARE, (5.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="4 joints, got 3"):
        forward_kinematics(CAT215, (0.0, 0.0, 0.0))


@given(GEOMETRY, st.floats(0.0, 12.0), st.floats(-10.0, 10.0), angles(-180, 180))
def test_reach_agrees_with_inverse(geometry, r, z, phi):
    """Margin positive: solved. Margin below the rounding allowance of 1e-12 m: refused."""
    pose = (r, 0.3, z, phi)[: 3 + geometry.has_tool_joint]
    margin = reach(geometry, pose)
    if margin >= 0:
        q = inverse_kinematics(geometry, pose)
        assume(margin > 1e-6)  # the round trip of a nearly stretched arm is tested above
        np.testing.assert_allclose(forward_kinematics(geometry, q), pose, rtol=0, atol=1e-9)
    elif margin < -2e-12:
        with pytest.raises(UnreachableError):
            inverse_kinematics(geometry, pose)


@given(GEOMETRY, st.floats(-4.0, 6.0), angles(-180, 180))
def test_radial_interval_ends_where_reach_is_zero(geometry, z, phi):
    """Just inside there is reach, outside the far end none; 1e-6 m is above rounding."""
    try:
        near, far = radial_interval(geometry, z, phi)
    except UnreachableError:
        return
    assume(far - near > 1e-3 and near > abs(geometry.lateral_offset) + 0.01)
    tail = (0.0, z, phi)[: 2 + geometry.has_tool_joint]
    assert reach(geometry, (near + 1e-6, *tail)) >= -1e-9
    assert reach(geometry, (far - 1e-6, *tail)) >= 0
    assert reach(geometry, (far + 1e-6, *tail)) < 0


@given(GEOMETRY, SWING, angles(-85, 85), angles(-179, 179), TOOL)
def test_jacobians_are_the_derivatives(geometry, swing, boom, stick, tool):
    """Step 1e-5: truncation h^2/6 f''' below 1e-7 for x > 0.5 m, rounding of 720 deg below 1e-9."""
    q = (swing, boom, stick, tool)[: 3 + geometry.has_tool_joint]
    assume(plane_x(geometry, q) > 0.5)
    for function, derivative in (
        (forward_kinematics, jacobian),
        (forward_kinematics_cartesian, cartesian_jacobian),
    ):
        numeric = central_difference(lambda p, f=function: f(geometry, p), q)
        np.testing.assert_allclose(derivative(geometry, q), numeric, rtol=0, atol=1e-7)


def serial_arm(geometry):
    """The same arm as MuJoCo bodies; a hinge about -y raises the outboard end."""
    hinge = '<joint axis="0 -1 0"/><geom size="0.1" mass="1"/>'
    along, up = geometry.tool_offset
    tool = f'<site name="end" pos="{along} 0 {up}"/>'
    if geometry.has_tool_joint:
        tool = f'<body pos="{geometry.stick_length} 0 0">{hinge}{tool}</body>'
    else:
        tool = f'<site name="end" pos="{geometry.stick_length + along} 0 {up}"/>'
    boom_pin = f"{geometry.base_radius} {geometry.lateral_offset} {geometry.boom_pin_height}"
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><compiler autolimits="true"/><worldbody>
      <body><joint axis="0 0 1"/><geom size="0.1" mass="1"/>
        <body pos="{boom_pin}">{hinge}
          <body pos="{geometry.boom_length} 0 0">{hinge}{tool}</body></body></body>
    </worldbody></mujoco>""")


@pytest.mark.parametrize("geometry", [CAT215, BARE])
def test_forward_and_jacobian_are_mujocos(geometry):
    """Two exact evaluations of one chain: 1e-12 is 100 roundings of lengths up to 10 m."""
    model = serial_arm(geometry)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(200):
        q = rng.uniform([-3, -0.7, -2.7, -2.8], [3, 1.0, -0.4, 0.4])[: model.nv]
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        moving = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, moving, None, 0)
        end = data.site_xpos[0]
        np.testing.assert_allclose(forward_kinematics_cartesian(geometry, q), end, rtol=0, atol=1e-12)
        np.testing.assert_allclose(cartesian_jacobian(geometry, q), moving, rtol=0, atol=1e-12)
        r = math.hypot(end[0], end[1])
        cylindrical = np.array([end[0] * moving[0] + end[1] * moving[1], end[0] * moving[1] - end[1] * moving[0]])
        np.testing.assert_allclose(
            jacobian(geometry, q)[:3],
            np.vstack([cylindrical[0] / r, cylindrical[1] / r**2, moving[2]]),
            rtol=0,
            atol=1e-12,
        )


@given(MACHINE_Q, st.tuples(*[st.floats(-1e5, 1e5)] * 3))
def test_the_transpose_does_the_same_work(q, force):
    """A force gives the same torques through both Jacobians, resolved along r, theta and z."""
    x, y, _ = forward_kinematics_cartesian(CAT215, q)
    r = math.hypot(x, y)
    in_cylinder = np.array([(x * force[0] + y * force[1]) / r, x * force[1] - y * force[0], force[2]])
    np.testing.assert_allclose(
        cartesian_jacobian(CAT215, q).T @ np.array(force),
        jacobian(CAT215, q)[:3].T @ in_cylinder,
        rtol=0,
        atol=1e-8,  # 1e6 N m times 1e-16 times some tens of operations
    )

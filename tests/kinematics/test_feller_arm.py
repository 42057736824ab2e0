"""The feller-buncher's arm against Denavit-Hartenberg matrices, both inverses, and the edge."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hydrotele.kinematics.feller_arm import (
    FellerGeometry,
    FellerPose,
    forward_kinematics,
    inverse_kinematics,
    inverse_kinematics_for_direction,
    jacobian,
    tool_direction,
)

ARM = FellerGeometry(
    base_radius=0.30, base_height=2.20, boom_length=5.90, stick_length=2.95, tilt_length=0.55,
    head_radius=0.35, head_depth=0.60,
)  # fmt: skip
ANGLES = st.tuples(
    st.floats(-3.0, 3.0), st.floats(-0.6, 1.2), st.floats(-2.6, -0.3), st.floats(-1.2, 1.5),
    st.floats(-1.4, 1.4),
)  # fmt: skip


def frame_of(q):
    """Frame of the tool by Zhu's Table 2.2: theta, alpha, a, d of every joint."""
    table = [(q[0], 90, 0.30, 2.20), (q[1], 0, 5.90, 0.0), (q[2], 0, 2.95, 0.0),
             (q[3], 90, 0.55, 0.0), (q[4], 90, 0.35, 0.60)]  # fmt: skip
    whole = np.eye(4)
    for theta, alpha, a, d in table:
        c, s, ca, sa = math.cos(theta), math.sin(theta), *_turn(alpha)
        whole = whole @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return whole


def _turn(degrees):
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def same(one, other):
    """Whether two sets of joint angles are the same up to whole turns."""
    return np.allclose(np.exp(1j * np.array(one)), np.exp(1j * np.array(other)), atol=1e-6)


@settings(max_examples=200, deadline=None)
@given(ANGLES)
def test_forward_is_the_product_of_the_matrices(q):
    frame, pose = frame_of(q), forward_kinematics(ARM, q)
    assert np.allclose(pose[:3], frame[:3, 3], atol=1e-12)
    assert np.allclose(tool_direction(q), frame[:3, 0], atol=1e-12)


@settings(max_examples=300, deadline=None)
@given(ANGLES)
def test_both_inverses_find_the_joint_angles(q):
    pose = forward_kinematics(ARM, q)
    c, s = math.cos(q[0]), math.sin(q[0])
    # an arm that reaches back over its own axis is the solution that is discarded
    assume(pose.x * c + pose.y * s > 0.01)
    found = inverse_kinematics(ARM, pose)
    assert not found.is_clamped and same(found.q, q)
    several = inverse_kinematics_for_direction(ARM, pose[:3], tool_direction(q))
    assert 1 <= len(several) <= 4 and any(same(one.q, q) for one in several)
    for one in several:  # every one of them is a solution, not only the one that was put in
        assert np.allclose(forward_kinematics(ARM, one.q)[:3], pose[:3], atol=1e-8)
        assert np.allclose(tool_direction(one.q), tool_direction(q), atol=1e-8)
    assert all(not same(a.q, b.q) for i, a in enumerate(several) for b in several[:i])


@settings(max_examples=100, deadline=None)
@given(ANGLES)
def test_the_jacobian_is_the_derivative(q):
    step, table = 1e-6, jacobian(ARM, q)
    for j in range(5):
        more, less = np.array(q), np.array(q)
        more[j] += step
        less[j] -= step
        slope = (np.array(forward_kinematics(ARM, more)) - np.array(forward_kinematics(ARM, less))) / (2 * step)
        assert np.allclose(table[:, j], slope, atol=1e-7)


def test_four_solutions_and_none():
    q = (0.3, 0.9, -2.0, 0.4, 0.5)
    pose = forward_kinematics(ARM, q)
    assert len(inverse_kinematics_for_direction(ARM, pose[:3], tool_direction(q))) >= 2
    above = inverse_kinematics_for_direction(ARM, (0.4, 0.1, 6.5), (1.0, 0.2, 0.3))
    assert len(above) == 4
    assert inverse_kinematics_for_direction(ARM, (30.0, 0.0, 0.0), (1.0, 0.0, 0.0)) == ()
    with pytest.raises(ValueError, match="no length"):
        inverse_kinematics_for_direction(ARM, (5.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_a_direction_across_the_plane_leaves_the_attitude_open():
    found = inverse_kinematics_for_direction(ARM, (6.0, 0.35, 2.0), (0.0, 1.0, 0.0))
    assert found
    for one in found:
        assert np.allclose(forward_kinematics(ARM, one.q)[:3], (6.0, 0.35, 2.0), atol=1e-8)
        assert np.allclose(tool_direction(one.q), (0.0, 1.0, 0.0), atol=1e-8)


def test_beyond_reach_the_arm_is_stretched_and_says_so_without_a_jump():
    """Straight out through the edge of the workspace, 1 mm at a time."""
    joints, flags = [], []
    for x in np.arange(8.5, 11.5, 0.001):
        found = inverse_kinematics(ARM, FellerPose(x, 1.0, 3.0, -0.2, 0.3))
        joints.append(found.q)
        flags.append(found.is_clamped)
    first = flags.index(True)
    assert 0 < first and all(flags[first:])
    # at the edge a joint moves with the root of the distance: sqrt(2 * 1 mm / 2 m) = 0.03
    assert np.abs(np.diff(joints, axis=0)).max() < 0.06
    assert all(q[2] == 0.0 for q in joints[first + 1 :])
    for row in (0, first - 1):
        assert forward_kinematics(ARM, joints[row])[:3] == pytest.approx((8.5 + 0.001 * row, 1.0, 3.0))


def test_a_tool_over_the_swing_axis_is_clamped():
    """Nearer to the axis than the head holds the tool beside the plane."""
    found = inverse_kinematics(ARM, FellerPose(0.01, 0.0, 5.0, 0.0, 1.0))
    assert found.is_clamped and np.isfinite(found.q).all()


def test_what_is_no_arm_is_refused():
    numbers = {f: getattr(ARM, f) for f in ARM.__dataclass_fields__}
    for wrong in ({"boom_length": 0.0}, {"stick_length": -1.0}, {"head_depth": math.nan}):
        with pytest.raises(ValueError, match="must be"):
            FellerGeometry(**{**numbers, **wrong})

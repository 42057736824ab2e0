"""Compiled task coordinates against the closed forms of both arms and finite differences."""

import numpy as np
import pytest

from hydrotele.kinematics import arm, feller_arm
from hydrotele.kinematics.task_space import (
    OUT_OF_REACH,
    REACHED,
    SINGULAR,
    arm_parameters,
    compute_joint_rates,
    compute_tip_pose,
    solve_joint_angles,
    task_jacobian,
)

FELLER = feller_arm.FellerGeometry(
    base_radius=0.3, base_height=2.2, boom_length=5.9, stick_length=2.95, tilt_length=0.55,
    head_radius=0.35, head_depth=0.6,
)  # fmt: skip
BARE = arm.ArmGeometry(
    base_radius=0.34, lateral_offset=-0.11, boom_pin_height=1.9, boom_length=5.18,
    stick_length=1.8, tool_offset=(0.2, 0.1), has_tool_joint=False,
)  # fmt: skip
DIGGER = arm.ArmGeometry(
    base_radius=0.34, lateral_offset=-0.11, boom_pin_height=1.9, boom_length=5.18,
    stick_length=1.8, tool_offset=(1.35, 0.05),
)  # fmt: skip
SIZES = {"feller": (FELLER, 5), "digger": (DIGGER, 4), "bare": (BARE, 3)}


def angles(k, count=40):
    rng = np.random.default_rng(7)
    low, high = np.array([-3, -0.5, -2.5, -2, -1.2]), np.array([3, 1.0, -0.5, 0.5, 1.2])
    return rng.uniform(low, high, (count, 5))[:, :k].copy()


def forward(geometry, q):
    pose = np.zeros(5)
    compute_tip_pose(arm_parameters(geometry), q, pose)
    return pose


@pytest.mark.parametrize("name", SIZES)
def test_it_is_the_closed_form_of_the_arm(name):
    geometry, k = SIZES[name]
    for q in angles(k):
        pose = forward(geometry, q)
        if name == "feller":
            x, y, z, attitude, head = feller_arm.forward_kinematics(geometry, q)
            turn = np.remainder(pose[1] - np.arctan2(y, x) + np.pi, 2 * np.pi) - np.pi
            wanted = np.array([np.hypot(x, y), pose[1] - turn, z, attitude, head])
        else:
            wanted = np.array(arm.forward_kinematics(geometry, q))
        assert np.abs(pose[:k] - wanted).max() < 1e-12  # rounding of lengths of 10 m


@pytest.mark.parametrize("name", SIZES)
def test_inverse_and_rates_go_back(name):
    geometry, k = SIZES[name]
    g, back, out, table = arm_parameters(geometry), np.zeros(k), np.zeros(k), np.zeros((k, k))
    for q in angles(k):
        pose = forward(geometry, q)
        assert solve_joint_angles(g, pose, q[0], back) == REACHED
        assert np.abs(back - q).max() < 1e-9  # the elbow's sine is at least 0.4 here
        task_jacobian(g, q, table)
        for j in range(k):
            step = 1e-6 * np.eye(k)[j]
            slope = (forward(geometry, q + step) - forward(geometry, q - step))[:k] / 2e-6
            assert np.abs(slope - table[:, j]).max() < 1e-8  # central differences of 1e-6
        rate = np.zeros(5)
        rate[:k] = np.array([0.4, -0.2, 0.3, 0.1, -0.3])[:k]
        assert compute_joint_rates(g, q, pose, rate, out) == REACHED
        assert np.abs(table @ out - rate[:k]).max() < 1e-10


def test_beyond_reach_nothing_is_written_and_a_straight_elbow_is_told():
    g, q = arm_parameters(DIGGER), np.full(4, 7.0)
    for r in (30.0, 0.05, np.nan):
        assert solve_joint_angles(g, np.array([r, 0.0, 1.0, 0.0, 0.0]), 0.0, q) == OUT_OF_REACH
        assert np.all(q == 7.0)
    straight = np.array([0.0, 0.3, 0.0, -0.5])
    assert compute_joint_rates(g, straight, forward(DIGGER, straight), np.ones(5), q) == SINGULAR


def test_swing_takes_the_turn_nearest_to_now():
    g, q = arm_parameters(DIGGER), np.zeros(4)
    pose = forward(DIGGER, np.array([3.1, 0.3, -1.2, 0.1]))
    solve_joint_angles(g, pose, 3.1 + 4 * np.pi, q)
    assert abs(q[0] - 3.1 - 4 * np.pi) < 1e-9

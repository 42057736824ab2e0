"""Serial chains: derivatives against complex steps, D-H against its matrices, exponentials."""

import numpy as np
import pytest
import scipy.linalg

from hydrotele.kinematics.serial_chain import (
    DhRow,
    Element,
    SerialChain,
    chain_from_dh,
    chain_from_frames,
    chain_poses,
    chain_poses_and_derivatives,
    joint_axes,
    product_of_exponentials,
    twist_exponential,
)

ROWS = [
    DhRow(d=0.33, alpha=-1.57, a=0.02),
    DhRow(theta=0.1, a=0.4, beta=0.01),
    DhRow(a=0.3, alpha=1.2, d=0.1, prismatic=True),
    DhRow(d=0.2, alpha=0.4),
]
CHAIN = chain_from_dh(ROWS, ["a", "b", "c", "d"], tool=(0.01, 0.02, 0.1))
Q = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 4))


def dh_matrix(row, q):
    theta, d = row.theta + (0.0 if row.prismatic else q), row.d + (q if row.prismatic else 0.0)
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(row.alpha), np.sin(row.alpha)
    made = np.array(
        [[c, -s * ca, s * sa, row.a * c], [s, c * ca, -c * sa, row.a * s], [0, sa, ca, d],
         [0, 0, 0, 1]]
    )  # fmt: skip
    cb, sb = np.cos(row.beta or 0.0), np.sin(row.beta or 0.0)
    return made @ np.array([[cb, 0, sb, 0], [0, 1, 0, 0], [-sb, 0, cb, 0], [0, 0, 0, 1]])


def test_denavit_hartenberg_is_the_textbook_matrix():
    poses = chain_poses(CHAIN, Q)
    for q, position, rotation in zip(Q, *poses, strict=True):
        whole = np.linalg.multi_dot([dh_matrix(r, v) for r, v in zip(ROWS, q, strict=True)])
        np.testing.assert_allclose(rotation, whole[:3, :3], atol=1e-14)
        np.testing.assert_allclose(position, whole[:3, :3] @ [0.01, 0.02, 0.1] + whole[:3, 3], atol=1e-14)


@pytest.mark.parametrize("form", ["dh", "frames"])
def test_derivatives_are_those_of_complex_steps(form):
    rng = np.random.default_rng(1)
    frames = [twist_exponential(rng.uniform(-1.0, 1.0, 6)) for _ in range(5)]
    chain = CHAIN if form == "dh" else chain_from_frames(
        frames, ["rz", "ry", "tx", "rz"], ["a", "b", "c", "d"], (0.0, 0.0, 0.1)
    )  # fmt: skip
    values = chain.nominal_values + rng.uniform(-0.1, 0.1, len(chain.nominal_values))
    exact = chain_poses_and_derivatives(chain, Q, values)
    for k in range(len(values)):
        step = values.astype(complex)
        step[k] += 1e-30j
        poses = chain_poses(chain, Q, step)
        moved, turned = poses.position.imag / 1e-30, poses.rotation.imag / 1e-30
        np.testing.assert_allclose(exact.position_by_parameter[:, :, k], moved, atol=1e-13)
        spin = turned @ np.swapaxes(exact.rotation, 1, 2)
        vector = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        np.testing.assert_allclose(exact.rotation_by_parameter[:, :, k], vector, atol=1e-13)
    for k in range(4):
        step = Q.astype(complex)
        step[:, k] += 1e-30j
        moved = chain_poses(chain, step, values).position.imag / 1e-30
        np.testing.assert_allclose(exact.position_by_joint[:, :, k], moved, atol=1e-13)


def test_joint_derivatives_follow_from_the_axes():
    points, ways = joint_axes(CHAIN, Q)
    exact = chain_poses_and_derivatives(CHAIN, Q)
    for k in (0, 1, 3):
        arm = exact.position - points[:, k]
        np.testing.assert_allclose(exact.position_by_joint[:, :, k], np.cross(ways[:, k], arm), atol=1e-13)


def test_exponential_is_the_matrix_exponential():
    rng = np.random.default_rng(2)
    for size in (1e-9, 1e-4, 1.0, 3.0):
        twist = size * rng.standard_normal(6)
        v, (x, y, z) = twist[:3], twist[3:]
        matrix = np.zeros((4, 4))
        matrix[:3] = np.column_stack([[[0, -z, y], [z, 0, -x], [-y, x, 0]], v])
        np.testing.assert_allclose(twist_exponential(twist), scipy.linalg.expm(matrix), atol=1e-13)


def test_product_of_exponentials_is_the_chain():
    points, ways = joint_axes(CHAIN, np.zeros((1, 4)))
    home = np.eye(4)
    at_home = chain_poses(CHAIN, np.zeros((1, 4)))
    home[:3, :3], home[:3, 3] = at_home.rotation[0], at_home.position[0]
    twists = np.column_stack([np.cross(points[0], ways[0]), ways[0]])
    twists[2] = np.concatenate([ways[0, 2], np.zeros(3)])
    found = product_of_exponentials(twists, home, Q)
    expected = chain_poses(CHAIN, Q)
    np.testing.assert_allclose(found[:, :3, 3], expected.position, atol=1e-13)
    np.testing.assert_allclose(found[:, :3, :3], expected.rotation, atol=1e-13)


def test_a_chain_refuses_double_names_and_idle_joints():
    with pytest.raises(ValueError, match="parameter names must be unique: x"):
        SerialChain(("a",), (Element("rz", "x", joint=0), Element("tx", "x")))
    with pytest.raises(ValueError, match="each of the 2 joints"):
        SerialChain(("a", "b"), (Element("rz", joint=0),))

"""Kinematics of closed chains: inverse and forward agree, all assemblies, Jacobians."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.multibody import closures
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.closed_chain_kinematics import find_assemblies, joint_jacobian, solve_joint_positions

POSE = tuple(f"platform_{c}" for c in ("x", "y", "z", "rx", "ry", "rz"))


@pytest.fixture(scope="module")
def chain():
    return load_chain(models_folder() / "palida" / "palida.xml")


def poses(n, seed=0):
    """Smooth motion (n, 6) about the middle of the workspace."""
    rng, t = np.random.default_rng(seed), np.linspace(0.0, 2.0 * np.pi, n)[:, None]
    size = np.array([0.06, 0.06, 0.05, 0.2, 0.2, 0.3])
    return np.array([0, 0, 0.55, 0, 0, 0]) + size * np.sin(t + rng.uniform(0, 6, 6))


def test_leg_lengths_are_distances_and_lead_back_to_the_pose(chain):
    x = poses(200)
    q = solve_joint_positions(chain, POSE, x)
    legs = q[:, [chain.index(d) for d in chain.drives]]
    back = solve_joint_positions(chain, chain.drives, legs)
    np.testing.assert_allclose(back, q, atol=1e-9)  # closures to 1e-11, condition below 100
    np.testing.assert_allclose(back[:, [chain.index(p) for p in POSE]], x, atol=1e-9)


@pytest.mark.nightly
def test_a_jump_is_followed_to_the_nearest_assembly(chain):
    """Rows far apart, in no order: leg lengths that Newton's method from before may not reach."""
    x = poses(30, seed=4)[np.random.default_rng(1).permutation(30)]
    legs = solve_joint_positions(chain, POSE, x)[:, [chain.index(d) for d in chain.drives]]
    q = solve_joint_positions(chain, chain.drives, legs)
    again = solve_joint_positions(chain, POSE, q[:, [chain.index(p) for p in POSE]], start=q[0])
    np.testing.assert_allclose(again[:, [chain.index(d) for d in chain.drives]], legs, atol=1e-9)


def test_all_assemblies_have_the_leg_lengths(chain):
    x = poses(1, seed=2)
    q = solve_joint_positions(chain, POSE, x)[0]
    legs = q[[chain.index(d) for d in chain.drives]]
    found = find_assemblies(chain, chain.drives, legs, body="platform", starts=200)
    assert len(found) >= 4  # up to 40 exist
    at = [chain.index(d) for d in chain.drives]
    np.testing.assert_allclose(found[:, at], np.tile(legs, (len(found), 1)), atol=1e-12)
    pose = found[:, [chain.index(p) for p in POSE]]
    assert np.abs(pose - x).max(axis=1).min() < 1e-8  # the one that it was made from is among them


def test_jacobian_is_the_derivative_and_its_inverse_goes_back(chain):
    x, step = poses(5, seed=3)[2], 1e-6
    at = [chain.index(d) for d in chain.drives]
    q = solve_joint_positions(chain, POSE, x[None])[0]
    inverse = joint_jacobian(chain, q, chain.drives, POSE)
    for k in range(6):
        pair = x + step * np.outer([-1.0, 1.0], np.eye(6)[k])
        low, high = solve_joint_positions(chain, POSE, pair, start=q)[:, at]
        # central difference: 1e-11 of the closures over 2e-6
        np.testing.assert_allclose(inverse[:, k], (high - low) / (2 * step), atol=1e-5)
    forward = joint_jacobian(chain, q, POSE, chain.drives)
    np.testing.assert_allclose(forward @ inverse, np.eye(6), atol=1e-9)


def test_refusals(chain):
    with pytest.raises(InputError, match=r"\(n, 6\)"):
        solve_joint_positions(chain, POSE, np.zeros((3, 5)))
    with pytest.raises(InputError, match="row 0"):
        solve_joint_positions(chain, POSE, np.full((1, 6), np.nan))
    with pytest.raises(InputError, match="row 0: the loops of palida cannot be closed"):
        solve_joint_positions(chain, chain.drives, np.full((1, 6), 0.05))


def test_a_pendulum_compiles_what_machines_need(chain):
    closures.precompile_loop_residuals()
    count = len(closures.evaluate_loop_residuals.signatures)  # one kind of arguments, for all trees
    closures.close_loops_from(chain.tree, np.array(chain.start), np.arange(3), 1e-9, 1.0)
    assert len(closures.evaluate_loop_residuals.signatures) == count == 1

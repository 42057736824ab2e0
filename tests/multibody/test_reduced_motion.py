"""Motion of every frame against finite differences of the motion before it."""

import numpy as np
import pytest

from hydrotele.estimate.reduced_model import place
from hydrotele.multibody.reduced_dynamics import (
    ACCELERATION,
    DRIFT,
    LENGTH,
    LENGTH_BIAS,
    LENGTH_RATE,
    LENGTH_ROW,
    ORIGIN,
    RATE,
    ROTATION,
    SPIN,
    SPIN_RATE,
    VELOCITY,
    Q,
)
from hydrotele.multibody.reduced_mechanism import COORDINATE_END, JOINT

MACHINES = ("cat215/none", "cat215/bucket", "cat215/grapple", "ec20", "rig", "emps")
STEP = 1e-5  # [s]: truncation 1e-10 of the third derivative, cancellation 1e-11 of the value
CLOSE = 1e-8  # of rates and accelerations up to 10 m/s^2


def copies(space):
    m = space.motion
    return m.frame.copy(), m.bar.copy(), m.joint.copy(), m.jacobian.copy(), m.basis.copy()


@pytest.fixture
def passing(machine_of, reduced_of, move_at_random):
    """A machine's motion before, at and after a state, along constant independent rates."""

    def passing(name):
        model, space, z = reduced_of(machine_of(name))
        move_at_random(model, z, 3)
        n, found = len(model.mech.independent), []
        for time in (-STEP, 0.0, STEP):
            there = z.copy()
            there[:n] += time * z[n : 2 * n]
            place(model, space, there)
            found.append(copies(space))
        return model.mech, found

    return passing


def slope(before, after):
    return (after - before) / (2 * STEP)


def crossed(spin):
    x, y, z = spin
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@pytest.mark.parametrize("name", MACHINES)
def test_velocities_are_slopes_of_places(name, passing):
    mech, ((before, *_), (frame, *_), (after, *_)) = passing(name)
    found = slope(before, after)[:, ORIGIN : ORIGIN + 3]
    np.testing.assert_allclose(found, frame[:, VELOCITY : VELOCITY + 3], atol=CLOSE)
    for i in range(mech.body_count):
        turn = frame[i, ROTATION : ROTATION + 9].reshape(3, 3)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-13)  # rounding
        found = slope(before, after)[i, ROTATION : ROTATION + 9].reshape(3, 3)
        expected = crossed(frame[i, SPIN : SPIN + 3]) @ turn
        np.testing.assert_allclose(found, expected, atol=CLOSE)


@pytest.mark.parametrize("name", MACHINES)
def test_velocities_are_jacobian_times_rates(name, passing):
    _, (_, (frame, bar, joint, jacobian, _), _) = passing(name)
    found = np.einsum("fkr,k->fr", jacobian, joint[RATE])
    np.testing.assert_allclose(found[:, :3], frame[:, VELOCITY : VELOCITY + 3], atol=1e-12)
    np.testing.assert_allclose(found[:, 3:], frame[:, SPIN : SPIN + 3], atol=1e-12)
    found = bar[:, LENGTH_ROW:] @ joint[RATE]
    np.testing.assert_allclose(found, bar[:, LENGTH_RATE], atol=1e-12)  # rounding of 10 m/s


@pytest.mark.parametrize("name", MACHINES)
def test_accelerations_are_slopes_of_velocities(name, passing):
    """Along constant independent rates; the bound coordinates accelerate by DRIFT."""
    mech, ((before, *_), (frame, _, joint, jacobian, _), (after, *_)) = passing(name)
    more = np.einsum("fkr,k->fr", jacobian, joint[DRIFT])
    found = slope(before, after)[:, VELOCITY : VELOCITY + 3]
    expected = frame[:, ACCELERATION : ACCELERATION + 3] + mech.gravity + more[:, :3]
    np.testing.assert_allclose(found, expected, atol=CLOSE)
    found = slope(before, after)[:, SPIN : SPIN + 3]
    np.testing.assert_allclose(found, frame[:, SPIN_RATE : SPIN_RATE + 3] + more[:, 3:], atol=CLOSE)


@pytest.mark.parametrize("name", ["cat215/none", "cat215/bucket", "ec20"])
def test_lengths_of_bars(name, passing):
    _, ((_, before, *_), (frame, bar, joint, *_), (_, after, *_)) = passing(name)
    found = slope(before, after)
    np.testing.assert_allclose(found[:, LENGTH], bar[:, LENGTH_RATE], atol=CLOSE)
    expected = bar[:, LENGTH_BIAS] + bar[:, LENGTH_ROW:] @ joint[DRIFT]
    np.testing.assert_allclose(found[:, LENGTH_RATE], expected, atol=CLOSE)


def test_bound_coordinates_follow(passing):
    _, ((*_, before, _, _), (_, _, joint, _, basis), (*_, after, _, _)) = passing("cat215/bucket")
    np.testing.assert_allclose(slope(before, after)[Q], joint[RATE], atol=CLOSE)
    np.testing.assert_allclose(slope(before, after)[RATE], joint[DRIFT], atol=CLOSE)
    assert np.abs(joint[DRIFT]).max() > 0.01, "the linkage does turn its links unevenly"
    assert np.linalg.matrix_rank(basis) == basis.shape[1]


def test_frames_do_not_move_with_coordinates_outside_their_reach(passing):
    mech, (_, (*_, jacobian, _), _) = passing("cat215/bucket")
    for i, reach in enumerate(mech.tree[:, COORDINATE_END]):
        assert not jacobian[i, reach:].any()
        if reach:
            assert jacobian[i, reach - 1].any()


def test_a_far_place_is_reached_on_the_same_branch(machine_of, reduced_of):
    """A linkage put far away at once stands as if it had been led there; a lost one recovers."""
    model, space, z = reduced_of(machine_of("cat215/bucket"))
    tool, home = int(model.mech.drive[-1, JOINT]), z.copy()
    at = int(np.flatnonzero(model.mech.independent == tool)[0])
    for angle in np.linspace(home[at], -0.2, 40):
        z[at] = angle
        place(model, space, z)
    led = space.motion.joint[Q].copy()
    place(model, space, home)
    place(model, space, z)
    np.testing.assert_allclose(space.motion.joint[Q], led, atol=1e-11)  # closed to 1e-12 m
    space.motion.joint[Q] = np.nan
    place(model, space, z)
    np.testing.assert_allclose(space.motion.joint[Q], led, atol=1e-11)

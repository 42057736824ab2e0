"""Three beams on three diodes: the pose comes back, as finely as stated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import load_joystick
from hydrotele.teleop.compliance import quaternion_to_matrix, relative_quaternion
from hydrotele.teleop.levitation import quaternion_to_rotation_vector, rotation_vector_to_quaternion
from hydrotele.teleop.optical_sensing import diode_readings, pose_resolution, solve_flotor_pose

JOYSTICK = load_joystick()
FAR, STEP = JOYSTICK.diodes.distance, JOYSTICK.diodes.step


def turned(vector):
    out = np.empty((3, 3))
    quaternion_to_matrix(rotation_vector_to_quaternion(np.asarray(vector, float)), out)
    return out


def apart(first, then):
    """Angle between two rotation matrices [rad]."""
    cosine = (np.trace(first.T @ then) - 1.0) / 2.0
    return float(np.linalg.norm((first.T @ then - then.T @ first)[[2, 0, 1], [1, 2, 0]]) / 2.0), cosine


PLACE = st.tuples(*[st.floats(-0.02, 0.02)] * 3)  # 5 mm at the handle and 7 deg on 0.12 m
TURN = st.tuples(*[st.floats(-0.07, 0.07)] * 3)


@given(PLACE, TURN)
def test_the_pose_comes_back_from_its_readings(place, vector):
    turn = turned(vector)
    found, back = solve_flotor_pose(diode_readings(np.array(place), turn, FAR), FAR)
    # Newton ends below 1e-12 m and rad
    np.testing.assert_allclose(found, place, atol=1e-11)
    assert apart(turn, back)[0] < 1e-11


@pytest.mark.nightly
def test_steps_of_the_diodes_give_the_stated_resolution():
    """Errors of 500 poses within the stops, against those of rounding to 1 um and 0.001 deg.

    Rounding to a step leaves the root of a twelfth of it. Sampling error of a spread: 3 %; away
    from the centre beams are up to a quarter longer.
    """
    rng, errors = np.random.default_rng(1), []
    for _ in range(500):
        place, vector = rng.uniform(-5e-3, 5e-3, 3), rng.uniform(-0.07, 0.07, 3)
        turn = turned(vector)
        readings = STEP * np.rint(diode_readings(place, turn, FAR) / STEP)
        found, back = solve_flotor_pose(readings, FAR)
        skew = (back @ turn.T - turn @ back.T)[[2, 0, 1], [1, 2, 0]] / 2.0
        errors.append(np.concatenate([found - place, skew]))
    spread = np.std(errors, axis=0)
    sensing = JOYSTICK.sensing
    stated = np.array([sensing.translation] * 3 + [sensing.rotation] * 3) / np.sqrt(12.0)
    assert (spread < stated).all(), spread / stated
    np.testing.assert_allclose(spread, pose_resolution(FAR, STEP), rtol=0.25)


def test_beams_that_miss_and_readings_that_fit_no_pose():
    with pytest.raises(InputError, match="misses"):
        diode_readings(np.array([-0.2, 0.0, 0.0]), np.eye(3), FAR)
    with pytest.raises(InputError):
        solve_flotor_pose(np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0]), FAR)
    place, turn = solve_flotor_pose(np.array([np.nan, 0, 0, 0, 0, 0]), FAR)
    assert np.isnan(place).all() and np.isnan(turn).all()


def test_rotation_between_takes_the_shorter_way():
    first = rotation_vector_to_quaternion(np.array([0.0, 0.1, 0.0]))
    scalar, vector = relative_quaternion(first, -rotation_vector_to_quaternion(np.array([0.0, 0.3, 0.0])))
    back = quaternion_to_rotation_vector(np.array([scalar, *vector]))
    np.testing.assert_allclose(back, [0.0, 0.2, 0.0], atol=1e-12)

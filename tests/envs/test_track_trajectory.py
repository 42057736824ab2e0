"""References of trajectory tracking: smooth, from rest, within what the machine can do."""

import numpy as np
import pytest

from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.track_trajectory import compute_axis_reference


@pytest.fixture(scope="module")
def core() -> TaskCore:
    core = TaskCore(TASKS["TrackTrajectory"], Options(variants=8), 64)
    core.reset(np.arange(64))
    return core


def course(core: TaskCore, number: int, axis: int, times: np.ndarray) -> np.ndarray:
    """(n, 2) reference and rate."""
    goal = core.episodes["goal"][number]
    return np.array([compute_axis_reference.py_func(goal, axis, time) for time in times])


@pytest.mark.nightly
def test_rates_are_derivatives_and_it_begins_at_rest_where_the_arm_stands(core):
    times = np.arange(0.0, 6.0, 1.0e-4)
    for axis in range(3):
        place, rate = course(core, 0, axis, times).T
        assert place[0] == core.episodes["joint"][0, axis] and rate[0] == 0.0
        # central differences of 0.1 ms are good to 1e-8 where the third derivative is below 1; the
        # acceleration jumps where fading in ends, at 2 s
        smooth = np.abs(times - 2.0) > 2.0e-4
        smooth[[0, -1]] = False
        assert np.allclose(np.gradient(place, times)[smooth], rate[smooth], atol=1e-7)


def test_references_stay_in_range_and_leave_the_drives_some_speed(core):
    facts, times = core.parameters, np.arange(0.0, 32.0, 0.05)
    for number in range(64):
        for axis in range(3):
            place, rate = course(core, number, axis, times).T
            low, high = facts["ranges"][axis]
            assert low < place.min() and place.max() < high
            # 0.7 of the full rate, and what fading in adds in the first two seconds
            assert np.abs(rate[times >= 2.0]).max() <= 0.7 * facts["fastest"][axis]


def test_the_reward_is_that_of_the_tip_error(core):
    core.step(np.zeros((64, 3)))
    error = core.measures[:, 0]
    assert np.allclose(core.reward, np.maximum(-1.0, 1.0 - error / 0.1), atol=1e-12)
    assert error.max() > 0.0

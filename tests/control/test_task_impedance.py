"""A planted task is recovered from what filters leave of force and place."""

import numpy as np
import pytest

from hydrotele.control.state_filter import filter_signal, filter_step_matrix
from hydrotele.control.task_impedance import TaskImpedance

PERIOD, BANDS = 0.02, (3.0, 1.5)
STIFFNESS, DAMPING = 8.0e5, 4.0e4


def planted(late: bool):
    """Pressing to and fro on a spring and damper for 12 s, then leaving it."""
    time = PERIOD * np.arange(700)
    place = -0.03 - 0.01 * np.sin(2 * np.pi * 0.3 * time) - 0.004 * np.sin(2 * np.pi * 0.7 * time)
    force = -(STIFFNESS * place + DAMPING * np.gradient(place, PERIOD))
    if late:
        for band in BANDS:
            force = filter_signal(filter_step_matrix(band, PERIOD), force)[:, 0]
    force[600:] = 0.0
    task = TaskImpedance(2, PERIOD, BANDS, force_is_filtered=late)
    for row in range(600):
        task.update(np.array([0.0, force[row]]), np.array([0.0, place[row]]))
    return task, force, place


@pytest.mark.parametrize("late", [True, False])
def test_planted_task_is_recovered(late):
    """0.5 %: the rate is planted by differences of 20 ms."""
    task, _, _ = planted(late)
    assert task.stiffness[1] == pytest.approx(STIFFNESS, rel=5e-3)
    assert task.damping[1] == pytest.approx(DAMPING, rel=5e-3)
    assert task.stiffness[0] == 0.0
    assert task.mass[1] < 0.01 * STIFFNESS  # there is none; 1 % of the force at 1 rad/s


@pytest.mark.parametrize("late", [True, False])
def test_planted_mass_is_recovered(late):
    """Zhu 1994, 3.73-3.74: M, B and K from force, place, rate and acceleration.

    1 %: rate and acceleration are planted by differences of 20 ms.
    """
    mass, time = 4.0e4, PERIOD * np.arange(600)
    turns = 2.0 * np.pi * np.array([[0.3], [0.7], [1.1]])
    size = np.array([[0.01], [0.004], [0.002]])
    place = -0.04 - (size * np.sin(turns * time)).sum(axis=0)
    rate = -(size * turns * np.cos(turns * time)).sum(axis=0)
    change = (size * turns**2 * np.sin(turns * time)).sum(axis=0)
    force = -(STIFFNESS * place + DAMPING * rate + mass * change)
    if late:
        for band in BANDS:
            force = filter_signal(filter_step_matrix(band, PERIOD), force)[:, 0]
    task = TaskImpedance(1, PERIOD, BANDS, force_is_filtered=late)
    for row in range(600):
        task.update(force[[row]], place[[row]])
    assert task.mass[0] == pytest.approx(mass, rel=1e-2)
    assert task.damping[0] == pytest.approx(DAMPING, rel=1e-2)
    assert task.stiffness[0] == pytest.approx(STIFFNESS, rel=1e-2)


def test_no_task_without_contact_and_no_harm_from_nonsense():
    task, force, place = planted(late=True)
    known = task.stiffness.copy()
    task.update(np.array([np.nan, 1e4]), np.zeros(2))
    np.testing.assert_array_equal(task.stiffness, known)
    task.update(np.zeros(2), np.zeros(2))
    assert np.all(task.stiffness == 0.0) and np.all(task.damping == 0.0)

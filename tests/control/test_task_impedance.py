"""A planted task is recovered from what filters leave of force and place."""

import numpy as np
import pytest

from hydrotele.control.state_filter import filter_table, filtered
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
            force = filtered(filter_table(band, PERIOD), force)[:, 0]
    force[600:] = 0.0
    task = TaskImpedance(2, PERIOD, BANDS, late=late)
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


def test_no_task_without_contact_and_no_harm_from_nonsense():
    task, force, place = planted(late=True)
    known = task.stiffness.copy()
    task.update(np.array([np.nan, 1e4]), np.zeros(2))
    np.testing.assert_array_equal(task.stiffness, known)
    task.update(np.zeros(2), np.zeros(2))
    assert np.all(task.stiffness == 0.0) and np.all(task.damping == 0.0)

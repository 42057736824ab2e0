"""End-point force: known forces come back, readings that fail do no harm."""

import numpy as np
import pytest

from hydrotele.errors import InputError
from hydrotele.machine_file import load_machine
from hydrotele.operate.endpoint_force import EndpointForce


def test_a_pendulum_without_drive_is_refused():
    machine = load_machine("cat215", "grapple")
    with pytest.raises(InputError, match="grapple_pitch, grapple_roll"):
        EndpointForce(machine, tuple(machine.axes))


@pytest.mark.parametrize("kind", ["static", "dynamic"])
def test_a_lost_reading_holds_the_last_force(kind):
    machine = load_machine("cat215", "bucket")
    felt = EndpointForce(machine, tuple(machine.axes), kind)
    joint = np.array([0.0, 0.45, -1.6, -1.2])
    head, rod = np.full(4, 4e6), np.full(4, 2e6)
    assert not np.any(felt.update(np.full(4, np.nan), head, rod)) and not felt.healthy
    before = felt.update(joint, head, rod).copy()
    assert felt.healthy and np.abs(before).min() > 100.0
    head[1] = np.nan
    np.testing.assert_allclose(felt.update(joint, head, rod), before, rtol=1e-9)  # rounding
    assert not felt.healthy

"""Plants shared by the physics tests: compiling one takes longer than most tests."""

import functools

import pytest

from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant


@pytest.fixture(scope="session")
def plant_of():
    """Plant of the CAT 215 by tool, timestep [s] and ground; the model must not be changed."""

    @functools.cache
    def plant(tool="none", timestep=1.0e-3, ground=False):
        return build_plant(load_machine("cat215", tool), timestep, ground)

    return plant

"""Machines shared by the tests of the reduced dynamics, and states to try them in."""

import functools

import numpy as np
import pytest

from hydrotele.estimate.reduced_model import model_space, reduced_model, state_names, state_size
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.reduced_mechanism import HOME


@pytest.fixture(scope="session")
def machine_of():
    """Machine by name or `name/tool`."""

    @functools.cache
    def machine(name):
        return load_machine(*name.split("/"))

    return machine


@pytest.fixture(scope="session")
def reduced_of():
    """(model, space, state) of a machine: standing at home, valves closed, 4 MPa everywhere."""

    def reduced(machine, channels=()):
        model = reduced_model(machine, tuple(channels))
        z, free = np.zeros(state_size(model)), model.mech.independent
        z[: len(free)] = model.mech.joint[HOME][free]
        for s, name in enumerate(state_names(machine)):
            z[s] = 4e6 if name.startswith("pressure") else z[s]
        return model, model_space(model), z

    return reduced


@pytest.fixture(scope="session")
def move_at_random():
    """Put a state near home and in motion, by seed."""

    def move(model, z, seed):
        rng, n = np.random.default_rng(seed), len(model.mech.independent)
        first = n + len(model.transmission)
        z[:n] += rng.uniform(-0.2, 0.2, n)
        z[first : first + n] = rng.uniform(-0.8, 0.8, n)

    return move

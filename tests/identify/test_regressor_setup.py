"""Parameters that are alike or absent."""

from dataclasses import replace

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.identify.mechanism import load_mechanism
from hydrotele.identify.regressor_setup import machine_setup, mechanism_setup
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.simulate.closed_loops import load_closed_chain

FOLDER = models_folder() / "palida"


def test_merged_columns_give_the_same_forces():
    own = load_mechanism(FOLDER / "palida.xml", FOLDER / "columns.yaml").setup
    whole = replace(own, equal_groups=(), zero_parameters=())
    rng = np.random.default_rng(0)
    pose = np.array([0, 0, 0.55, 0, 0, 0]) + 0.05 * rng.normal(size=(5, 6))
    found = project_on_drives(own.chain, own.given_joints, pose, rng.normal(size=(5, 6)), rng.normal(size=(5, 6)))
    some, every = own.compute_regressor(found), whole.compute_regressor(found)
    assert len(some.names) == 35 and len(every.names) > 200
    # the legs of the model are the same, and what is absent is 0 there
    np.testing.assert_allclose(some.matrix @ some.nominal, every.matrix @ every.nominal, atol=1e-9)


def test_what_is_not_there_is_refused():
    chain = load_chain(FOLDER / "palida.xml")
    still = np.zeros((1, 6))
    for setup, message in (
        (
            mechanism_setup(chain, equal_groups=[("ring_1", "wing")]),
            "equal_parameters: wing has no parameters",
        ),
        (
            mechanism_setup(chain, zero_parameters=["mass.wing"]),
            "zero_parameters: mass.wing is not a parameter",
        ),
    ):
        legs = chain.start[[chain.index(d) for d in chain.drives]][None]
        found = project_on_drives(chain, chain.drives, legs, still, still)
        with pytest.raises(InputError, match=message):
            setup.compute_regressor(found)


def test_ball_joints_carry_no_moment_about_a_cylinders_axis():
    machine = load_machine("cat215")
    chain = load_closed_chain(machine)
    pose = np.array([[0.1, 0.4, -1.5]])
    columns = {}
    for ball_joints in (True, False):
        setup = machine_setup(machine, chain, ball_joints=ball_joints)
        # the swing accelerates alone, so that tubes and rods are turned about their axes
        table = setup.compute_regressor(setup.project_motion_on_drives(pose, 0.0 * pose, np.array([[1.0, 0.0, 0.0]])))
        column = [n.endswith("_tube") and n.startswith("inertia_xx") for n in table.names]
        columns[ball_joints] = table.matrix[0, 0, np.flatnonzero(column)]
    assert np.all(np.abs(columns[True]) < 1e-15), "rounding"
    assert np.all(columns[False] > 0.01), "the square of the sine of the cylinder's slope"


def test_a_body_without_moment_that_is_not_there_is_refused():
    chain = load_chain(FOLDER / "palida.xml")
    own = replace(mechanism_setup(chain), moment_free={"wing": (1.0, 0.0, 0.0)})
    legs = chain.start[[chain.index(d) for d in chain.drives]][None]
    with pytest.raises(InputError, match="has no body wing"):
        own.project_motion_on_drives(legs, 0.0 * legs, 0.0 * legs)

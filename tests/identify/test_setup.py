"""Parameters that are alike or absent."""

from dataclasses import replace

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.identify.mechanism import load_mechanism
from hydrotele.identify.setup import mechanism_setup
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project

FOLDER = models_folder() / "palida"


def test_merged_columns_give_the_same_forces():
    own = load_mechanism(FOLDER / "palida.xml", FOLDER / "columns.yaml").setup
    whole = replace(own, alike=(), absent=())
    rng = np.random.default_rng(0)
    pose = np.array([0, 0, 0.55, 0, 0, 0]) + 0.05 * rng.normal(size=(5, 6))
    found = project(own.chain, own.given, pose, rng.normal(size=(5, 6)), rng.normal(size=(5, 6)))
    some, every = own.table(found), whole.table(found)
    assert len(some.names) == 35 and len(every.names) > 200
    # the legs of the model are the same, and what is absent is 0 there
    np.testing.assert_allclose(some.matrix @ some.nominal, every.matrix @ every.nominal, atol=1e-9)


def test_what_is_not_there_is_refused():
    chain = load_chain(FOLDER / "palida.xml")
    still = np.zeros((1, 6))
    for setup, message in (
        (mechanism_setup(chain, alike=[("ring_1", "wing")]), "belong to wing"),
        (mechanism_setup(chain, absent=["mass.wing"]), "mass.wing is stated absent"),
    ):
        legs = chain.start[[chain.index(d) for d in chain.drives]][None]
        found = project(chain, chain.drives, legs, still, still)
        with pytest.raises(InputError, match=message):
            setup.table(found)

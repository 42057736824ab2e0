"""What a regressor tells: known ranks, and combinations that carry all there is to know."""

import dataclasses

import numpy as np
import pytest

from hydrotele.identify.identifiability import (
    STATUS_COMBINATION,
    STATUS_FULL,
    STATUS_UNIDENTIFIABLE,
    classify_parameters,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import FrictionTerm, make_regressor, passive_friction_terms
from hydrotele.simulate.plant import build_plant, rest_state
from tests.multibody.test_inverse_dynamics import panda


def random_motion(middle, width, rows, seed):
    """Positions, rates and accelerations that have nothing to do with each other."""
    rng = np.random.default_rng(seed)
    return [
        offset + rng.uniform(-1, 1, (rows, len(middle))) * size
        for offset, size in ((np.array(middle), width), (0.0, 1.0), (0.0, 2.0))
    ]


def test_the_panda_has_43_base_parameters():
    """Gaz et al. 2019; 64 with Coulomb, viscous friction and offset of seven joints."""
    chain = load_chain(panda())
    motion = random_motion(np.zeros(7), 2.0, 60, 3)
    motion[0] = np.sort(motion[0], axis=0)
    found = project_on_drives(chain, chain.joints, *motion, drives=chain.joints)
    for rubbing, offsets, rank in (
        ((), False, 43),
        ([FrictionTerm(j) for j in chain.joints], True, 64),
    ):
        table = make_regressor(chain, found, drives=chain.joints, friction=rubbing, offsets=offsets)
        told = classify_parameters(table.matrix.reshape(-1, len(table.names)), table.names, table.units)
        assert len(told.base) == rank
        assert told.singular_value_gap[0] > 1e3 * told.singular_value_gap[1], "the rank must not be a matter of taste"
    assert told.status[told.names.index("mass.link1")] == STATUS_UNIDENTIFIABLE
    assert told.status[told.names.index("offset.joint4")] == STATUS_FULL


@pytest.fixture(scope="module")
def complete():
    """The complete model of Khoshzaban 1992: 82 parameters of seven bodies, pins and drives."""
    plant = build_plant(load_machine("cat215"))
    chain = dataclasses.replace(load_chain(plant.model), start=rest_state(plant).qpos.copy())
    t = 0.02 * np.arange(1664)[:, None]
    rate = np.array([0.9, 0.7, 1.1]) * np.array([[1.0], [2.3], [3.7]])[:, None]
    width = np.array([0.5, 0.25, 0.3]) / np.array([[1.0], [2.0], [3.0]])[:, None]
    phase = np.arange(9.0).reshape(3, 1, 3)
    motion = [
        np.array([0.0, 0.3, -1.6]) + (width * np.sin(rate * t + phase)).sum(0),
        (width * rate * np.cos(rate * t + phase)).sum(0),
        -(width * rate**2 * np.sin(rate * t + phase)).sum(0),
    ]
    found = project_on_drives(chain, ("swing", "boom", "stick"), *motion)
    drives = [FrictionTerm(joint, {"coulomb": 0.0}) for joint in chain.drives]
    return make_regressor(
        chain, found, bodies=[b for b in chain.bodies if b != "chassis"],
        friction=[*drives, *passive_friction_terms(chain)],
    )  # fmt: skip


@pytest.mark.nightly
def test_counts_of_the_complete_model(complete):
    """Of cylinders that end in pins; Khoshzaban's Table 13 has ball joints."""
    told = classify_parameters(complete.matrix.reshape(-1, 82), complete.names, complete.units)
    assert told.status_counts == {STATUS_UNIDENTIFIABLE: 9, STATUS_COMBINATION: 53, STATUS_FULL: 20}
    assert told.singular_value_gap[0] > 1e5 * told.singular_value_gap[1]
    lost = [n for n, s in zip(told.names, told.status, strict=True) if s == STATUS_UNIDENTIFIABLE]
    assert lost == [n for n in complete.names if n.endswith(".swing")][:9], "all but Izz"
    (text,) = [told.format_combination(k) for k, b in enumerate(told.base) if told.names[b] == "moment_x.boom"]
    # lever arms of the pins along the boom, as drawn
    arms = {"5.18 mass.stick", "5.18 mass.stick_rod", "2.95961 mass.stick_tube"}
    assert set(text.split(" + ")) == {"moment_x.boom", "1.59727 mass.boom_rod", *arms}


def test_base_parameters_carry_all_there_is(complete):
    flat = complete.matrix.reshape(-1, 82)
    told = classify_parameters(flat, complete.names, complete.units)
    some = np.random.default_rng(0).normal(size=82) * 1e3
    forces = flat @ some
    by_base = flat[:, told.base] @ (told.combination @ some)
    np.testing.assert_allclose(by_base, forces, atol=1e-9 * np.abs(forces).max())


def test_a_wanted_parameter_stands_for_its_combination(complete):
    flat = complete.matrix.reshape(-1, 82)
    told = classify_parameters(flat, complete.names, complete.units, preferred=("inertia_zz.boom",))
    assert "inertia_zz.boom" in [complete.names[k] for k in told.base]
    assert len(told.base) == 45


def test_no_motion_tells_gravity_only():
    plant = build_plant(load_machine("cat215"))
    chain = dataclasses.replace(load_chain(plant.model), start=rest_state(plant).qpos.copy())
    still = np.tile([[0.0, 0.3, -1.6]], (50, 1))
    found = project_on_drives(chain, ("swing", "boom", "stick"), still, 0 * still, 0 * still)
    table = make_regressor(chain, found, friction=[FrictionTerm(j) for j in chain.drives])
    told = classify_parameters(table.matrix.reshape(-1, len(table.names)), table.names, table.units)
    # one pose: a torque of the swing, a force of each cylinder
    assert len(told.base) == 3
    assert told.status_counts[STATUS_FULL] == 1  # the swing's offset; gravity does not reach it

"""Machines made of identified numbers: they can exist, and they explain what was identified."""

import dataclasses

import numpy as np
import pytest

from hydrotele.effects.effect import with_value
from hydrotele.identify.consistent_parameters import AllowedDeformation, find_consistent_parameters
from hydrotele.identify.identifiability import classify_parameters
from hydrotele.identify.identified_machine import build_identified_machine
from hydrotele.identify.linear_least_squares import Estimate
from hydrotele.identify.regressor_setup import machine_setup, map_cylinder_bodies
from hydrotele.identify.result import (
    HeldOutForces,
    Identification,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import BODY_PARAMETERS, make_regressor
from hydrotele.simulate.plant import build_plant, rest_state


def chain_of(machine):
    plant = build_plant(machine)
    return dataclasses.replace(load_chain(plant.model), start=rest_state(plant).qpos.copy())


def table_of(machine, seed=0):
    """Regressor of a wide motion, and what it tells."""
    setup, rng = machine_setup(machine, chain_of(machine)), np.random.default_rng(seed)
    middle, width = np.array([0.0, 0.3, -1.6]), np.array([1.0, 0.25, 0.4])
    steps = np.linspace(0, 1, 90)[:, None]
    motion = [
        middle + width * np.sin(9 * steps + rng.uniform(0, 6, 3)),
        rng.uniform(-0.5, 0.5, (90, 3)), rng.uniform(-1.0, 1.0, (90, 3)),
    ]  # fmt: skip
    found = project_on_drives(setup.chain, setup.given_joints, *motion)
    table = make_regressor(
        setup.chain,
        found,
        bodies=setup.bodies,
        friction=setup.friction_terms,
        offsets=setup.offsets,
    )
    told = classify_parameters(table.matrix.reshape(-1, len(table.names)), table.names, table.units)
    return table, told


def as_found(table, told, value, share=1e-3):
    """An identification that found certain base parameters, each known to a share of itself."""
    base = told.combination @ value
    spread = share * np.maximum(np.abs(base), 1.0)
    estimate = Estimate(
        base,
        np.diag(spread**2),
        np.zeros((1, 1)),
        np.zeros((len(base), 1, 1)),
        1.0,
        np.eye(1),
        np.eye(len(base)),
        len(base),
    )
    nothing = HeldOutForces("", (), *(np.zeros((0,)) for _ in range(4)))
    return Identification(
        table.names, table.units, table.nominal, value, told, told, estimate,
        np.zeros(len(base)), {}, nothing, 1.0, {}, "ok", (), 0.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def truth():
    """A machine with other bodies and friction than the CAT 215."""
    machine = load_machine("cat215")
    for path, value in (
        ("links.boom.mass", 2100.0), ("links.stick.com", (1.0, 0.0, 0.16)),
        ("links.stick.inertia", (12.0, 60.0, 55.0)), ("axes.boom.cylinder.rod.mass", 130.0),
        ("axes.swing.motor.friction.coulomb", 5200.0),
        ("axes.stick.cylinder.friction.viscous", 3100.0),
        ("axes.boom.cylinder.friction.stribeck_extra", 1100.0),
    ):  # fmt: skip
        machine = with_value(machine, path, value)
    return machine


@pytest.mark.nightly
def test_a_machine_of_the_family_is_found_again(truth):
    table, told = table_of(load_machine("cat215"))
    other, _ = table_of(truth)
    found = as_found(table, told, other.nominal)
    machine, best = build_identified_machine(load_machine("cat215"), found, map_cylinder_bodies(truth))
    # the prior pulls by less than a standard deviation in every direction
    assert best.squared_distance < len(told.base)
    again, _ = table_of(machine)
    np.testing.assert_allclose(again.nominal, best.value, rtol=1e-9, atol=1e-6)
    base, true = told.combination @ again.nominal, told.combination @ other.nominal
    assert np.abs((base - true) / found.estimate.std).max() < 2.0
    friction = machine.axes["swing"].motor.friction
    assert friction.coulomb == pytest.approx(5200.0, rel=2e-3)
    assert machine.axes["boom"].cylinder.friction.stribeck_extra == pytest.approx(1100, rel=2e-3)


@pytest.mark.nightly
def test_impossible_numbers_become_the_nearest_possible_ones():
    table, told = table_of(load_machine("cat215"))
    value = table.nominal.copy()
    names = list(table.names)
    value[names.index("inertia_yy.stick")] = -300.0  # no body has this
    value[names.index("coulomb.swing")] = -500.0  # nor does friction drive
    best = find_consistent_parameters(as_found(table, told, value, 0.01))
    for body in ("boom", "stick", "boom_tube"):
        p = best.value[[names.index(f"{kind}.{body}") for kind in BODY_PARAMETERS]]
        inertia = np.array([[p[4], p[5], p[6]], [p[5], p[7], p[8]], [p[6], p[8], p[9]]])
        pseudo = np.empty((4, 4))
        pseudo[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        pseudo[:3, 3] = pseudo[3, :3] = p[1:4]
        pseudo[3, 3] = p[0]
        assert np.linalg.eigvalsh(pseudo).min() > 0.0, body
    assert best.value[names.index("coulomb.swing")] >= 0.0
    assert best.squared_distance > len(told.base), "it must say that the estimate itself cannot be"


@pytest.mark.nightly
def test_freedom_keeps_axes_and_lines():
    table, told = table_of(load_machine("cat215"))
    value = table.nominal.copy()
    names = list(table.names)
    value[names.index("moment_x.stick")] *= 1.2
    freedom = {"stick": AllowedDeformation(can_rotate_axes=False, shift_direction=np.array([1.0, 0.0, 0.0]))}
    best = find_consistent_parameters(as_found(table, told, value), freedom)
    p = best.value[[names.index(f"{kind}.stick") for kind in BODY_PARAMETERS]]
    com = p[1:4] / p[0]
    products = p[[5, 6, 8]] + p[0] * np.array([com[0] * com[1], com[0] * com[2], com[1] * com[2]])
    np.testing.assert_allclose(products, 0.0, atol=1e-6 * p[9])
    assert com[1] == pytest.approx(0.0, abs=1e-9)

"""Static model: the machine's masses come out of pressures and angles of slow moves."""

import math

import numpy as np
import pytest

from hydrotele.control.gravity_model import (
    extract_slow_motion,
    fit_gravity_to_masses,
    gravity_regressor,
    identify_gravity,
)
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.closed_loops import holding_forces
from hydrotele.simulate.plant import build_plant, rest_state

CAT = load_machine("cat215", "bucket")
G = 9.81


@pytest.fixture(scope="module")
def slow_log():
    return run_scenario(load_scenario("slow_moves")).measured


def test_parameters_of_the_stick_follow_from_its_mass_and_its_cylinder():
    """By hand: half of what tube and rod weigh together hangs on each of their pins; rounding."""
    stick = 688 * np.array([0.90, 0.10])
    way = math.radians(145.0)
    pin = 100 * 0.72 * np.array([math.cos(way), math.sin(way)])
    (along, up), found = G * (stick + pin), fit_gravity_to_masses(load_machine("cat215"))
    assert found.names == ("C2", "S2", "C23", "S23")
    assert found.value[2:] == pytest.approx([along, -up], rel=1e-9)
    assert found.residual.max() < 1e-6


@pytest.mark.parametrize("joints", [(0.3, 0.1, -1.0, -0.5), (0.0, 0.8, -2.3, -1.8)])
def test_torques_are_those_that_hold_the_machine(joints):
    """Within 0.2 kN m of 100: the bucket's cylinder and links are not of the model's form."""
    plant = build_plant(CAT, ground=False)
    data = rest_state(plant, dict(zip(plant.axes, joints, strict=True)))
    forces = holding_forces(CAT, plant.model, data)
    act = data.act.reshape(-1, 4)
    time = np.arange(60) * 0.02
    columns = {f"angle.{a}": np.full(60, q) for a, q in zip(plant.axes, joints, strict=True)}
    for i, a in enumerate(plant.axes):
        columns |= {f"pressure_head.{a}": np.full(60, act[i, 2])}
        columns |= {f"pressure_rod.{a}": np.full(60, act[i, 3])}
    units = {n: "rad" if n.startswith("angle") else "Pa" for n in columns}
    moves = extract_slow_motion(CAT, Log(time, columns, units))
    gravity = fit_gravity_to_masses(CAT)
    modelled = gravity_regressor(np.array(joints)) @ gravity.value
    np.testing.assert_allclose(moves.torque[-1], modelled, atol=200.0)
    assert np.any(np.abs(forces) > 1e4)


@pytest.mark.nightly
def test_slow_moves_with_real_sensors_give_the_parameters(slow_log):
    """Within 1 % of the largest, 1.4 kN m: inertia of the slow moves is left, 0.9 kN m."""
    true, found = fit_gravity_to_masses(CAT), identify_gravity(CAT, slow_log)
    assert np.abs(found.value - true.value).max() < 0.01 * np.abs(true.value).max()
    plain = identify_gravity(CAT, slow_log, friction=False)
    assert np.linalg.norm(plain.residual) > 1.4 * np.linalg.norm(found.residual)
    assert np.abs(plain.value - true.value).max() < 0.02 * np.abs(true.value).max()


@pytest.mark.nightly
def test_the_recursion_converges(slow_log):
    """After half of the moves nothing changes by more than 1 % of the largest parameter."""
    found = identify_gravity(CAT, slow_log)
    half = len(found.history) // 2
    change = np.abs(found.history[half:] - found.value).max()
    assert change < 0.01 * np.abs(found.value).max()
    assert np.abs(found.history[10] - found.value).max() > change
    assert np.array_equal(found.history[-1], found.value)


def test_the_head_of_a_feller_buncher_has_a_seventh_parameter():
    """Rows are the gradient of the energy: the same rows from differences; 1e-8 of 1."""
    q, step = np.array([0.2, 0.5, -1.1, 0.3, 0.7]), 1e-6

    def energy(q):
        angle = np.cumsum(q[1:4])
        pairs = np.column_stack([np.sin(angle), -np.cos(angle)]).ravel()
        return np.append(pairs, math.cos(q[4]) * math.sin(angle[2]))

    slopes = [(energy(q + step * e) - energy(q - step * e)) / (2 * step) for e in np.eye(5)]
    np.testing.assert_allclose(gravity_regressor(q), slopes, atol=1e-8)


def test_a_short_log_is_refused(slow_log):
    short = Log(
        slow_log.time[:100],
        {name: values[:100] for name, values in slow_log.columns.items()},
        slow_log.units,
    )
    with pytest.raises(InputError, match="10 s of slow motion"):
        identify_gravity(CAT, short)


def test_outliers_of_a_dead_pressure_sensor_are_removed(slow_log):
    """A boom sensor that reads nothing for 3 s; without outliers within 1 % as without failure."""
    columns = dict(slow_log.columns)
    dead = (slow_log.time > 40.0) & (slow_log.time < 43.0)
    columns["pressure_head.boom"] = np.where(dead, 0.0, columns["pressure_head.boom"])
    bad, true = Log(slow_log.time, columns, slow_log.units), fit_gravity_to_masses(CAT).value
    kept, removed = identify_gravity(CAT, bad), identify_gravity(CAT, bad, remove_outliers=True)
    assert np.abs(removed.value - true).max() < 0.01 * np.abs(true).max()
    assert np.abs(removed.value - true).max() < np.abs(kept.value - true).max()
    assert len(kept.outlier_indices) == 0 and set(range(201, 214)) <= set(removed.outlier_indices.tolist())

"""Excitation: within the limits, better than where it began, and a scenario that runs."""

import numpy as np
import pytest
import yaml

from hydrotele.identify.excitation import (
    Excitation,
    MachineLimits,
    compute_information,
    design_motion,
    select_determinable_parameters,
)
from hydrotele.identify.record import compute_force_noise
from hydrotele.identify.regressor_setup import machine_setup
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.closed_loops import load_closed_chain


@pytest.fixture(scope="module")
def rig():
    machine = load_machine("rig")
    setup = machine_setup(machine, load_closed_chain(machine))
    sensors = next(iter(machine.sensors))
    return machine, setup, np.maximum(compute_force_noise(machine, sensors), 1.0)


def test_motion_is_its_own_derivative():
    rng = np.random.default_rng(0)
    mean, sin, cos = rng.normal(size=2), *rng.normal(size=(2, 2, 3))
    e = Excitation(("a", "b"), 7.0, mean, sin, cos, 0.0, 0.0, 0)
    time, step = np.linspace(0, 7, 50), 1e-5
    before, now, after = (e.evaluate(time + d) for d in (-step, 0.0, step))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), now[1], atol=1e-8)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * step), now[2], atol=1e-8)
    np.testing.assert_allclose(e.evaluate(time + 7.0), now, atol=1e-9)


@pytest.mark.nightly
def test_a_cylinder_on_rails_is_driven_within_its_limits_and_tells_more(rig, tmp_path):
    machine, setup, noise = rig
    places = select_determinable_parameters(machine, setup, noise, 6.0)
    assert len(places) >= 3  # mass, Coulomb and viscous friction
    short = dict(period=6.0, harmonics=3, starts=1)
    limits = MachineLimits(machine, setup)
    rough, good = (design_motion(limits, setup, noise, places, iterations=n, **short) for n in (1, 40))
    assert good.criterion > rough.criterion + 0.3
    assert 0.5 < good.max_utilisation <= 1.0
    time = np.linspace(0, 6, 200)
    position = good.evaluate(time)[0][:, 0]
    low, high = machine.joints[machine.axes[good.axes[0]].joint].range
    assert low < position.min() and position.max() < high
    info = compute_information(setup, good.evaluate(time), noise, places)
    assert np.linalg.eigvalsh(info).min() > 0.0
    file = tmp_path / "designed.yaml"
    file.write_text(yaml.safe_dump(good.to_scenario("designed", machine, 1.0)))
    run = run_scenario(load_scenario(file))
    reached = run.measured[f"position.{good.axes[0]}"]
    wanted = good.evaluate(run.measured.time)[0][:, 0]
    late = run.measured.time > 3.0  # the fade-in is a quarter of a period
    # a valve-controlled mass lags by some 10 % of its motion at most if no limit is in its way
    assert np.std((reached - wanted)[late]) < 0.15 * np.std(wanted)

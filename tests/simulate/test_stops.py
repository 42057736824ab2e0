"""End stops in MuJoCo: the joint limit is the spring and the damper that the machine states."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hydrotele.machine.drives import EndStop
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, rest_state

EMPS = load_machine("emps")
DRIVE = EMPS.axes["slide"].force
assert DRIVE
MASS, HIGH = 95.11, 0.28


def carriage(stiffness, damping, timestep):
    """The EMPS axis without friction, with a stop of its own: a free mass on a slide."""
    facts = EMPS.model_dump()
    facts["axes"]["slide"]["force"]["friction"] = {}
    facts["axes"]["slide"]["force"]["offset"] = 0.0
    facts["axes"]["slide"]["end_stop"] = EndStop(stiffness=stiffness, damping=damping).model_dump()
    return build_plant(type(EMPS).model_validate(facts), timestep)


@pytest.mark.parametrize("stiffness", [1e4, 3e5, 1e7])
def test_a_force_presses_it_in_by_the_force_over_the_stiffness(stiffness):
    plant = carriage(stiffness, 2.0 * np.sqrt(stiffness * MASS), 1e-3)
    data = rest_state(plant, {"slide": 0.279})
    for _ in range(4000):
        data.ctrl[0] = 5.0
        mujoco.mj_step(plant.model, data)
    # the solver stops at a relative 1e-8 of the cost; MuJoCo's impedance ends at 0.9999
    assert data.qpos[0] - HIGH == pytest.approx(5.0 * DRIVE.gain / stiffness, rel=1e-3)


def hit(plant, speed, end):
    """Positions and velocity at `end` after a carriage hits its stop with a speed."""
    data = rest_state(plant, {"slide": HIGH - 1e-3})
    data.qvel[0], deepest = speed, 0.0
    for _ in range(round(end / plant.model.opt.timestep)):
        mujoco.mj_step(plant.model, data)
        deepest = max(deepest, data.qpos[0] - HIGH)
    return deepest, data.qvel[0]


@pytest.mark.nightly
def test_a_hit_converges_to_the_differential_equation_with_first_order():
    stiffness, damping, speed = 4e6, 4e3, 0.3

    def rhs(t, y):
        push = max(0.0, stiffness * y[0] + damping * y[1]) if y[0] > 0.0 else 0.0
        return [y[1], -push / MASS]

    exact = solve_ivp(rhs, (0, 0.04), [-1e-3, speed], max_step=2e-6, rtol=1e-9)
    want = exact.y[0].max(), exact.y[1, -1]
    assert want[1] < -0.5 * speed, "it comes back"
    errors = []
    for timestep in (4e-4, 2e-4, 1e-4, 5e-5):
        found = hit(carriage(stiffness, damping, timestep), speed, 0.04)
        errors.append(np.abs(np.subtract(found, want)) / np.abs(want))
    errors = np.array(errors)
    # implicit Euler: the error halves with the step; the moment of contact shifts within one step,
    # which scatters single ratios, so that three halvings are judged together
    assert np.all(errors[-1] < 0.25 * errors[0]), errors
    assert np.all(errors[-1] < 0.02), errors


def test_a_stop_that_no_step_resolves_is_stable():
    plant = carriage(1e11, 1e6, 1e-3)
    deepest, velocity = hit(plant, 2.0, 1.0)
    assert deepest < 2.0 * 1e-3, "no farther than one step flies"
    assert abs(velocity) <= 2.0


def test_a_cylinder_has_one_stop_and_the_exported_mjcf_has_it_too():
    plant = build_plant(load_machine("cat215", "none"))
    limited = {plant.model.joint(i).name for i in np.flatnonzero(plant.model.jnt_limited)}
    assert limited == {"boom_rod", "stick_rod"}
    again = mujoco.MjModel.from_xml_string(plant.mjcf)
    for name in limited:
        i, k = plant.model.joint(name).id, again.joint(name).id
        np.testing.assert_allclose(again.jnt_solref[k], plant.model.jnt_solref[i], rtol=1e-12)
        np.testing.assert_allclose(again.jnt_solimp[k], plant.model.jnt_solimp[i], rtol=1e-12)
        np.testing.assert_allclose(again.jnt_range[k], plant.model.jnt_range[i], rtol=1e-12)

"""The coils' map against MuJoCo, and what saturation does."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import load_joystick
from hydrotele.simulate.joystick import SimulatedFlotor, coil_force_factors, heat_step
from hydrotele.teleop.coils import (
    Coils,
    make_three_station_coils,
    relative_heating,
    time_to_overheat,
)

COILS = make_three_station_coils(0.05, 8.0, 4.0)
WRENCH = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6)


def test_the_map_is_what_mujoco_makes_of_forces_at_the_coils():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='flotor'><freejoint/>"
        "<inertial pos='0 0 0' mass='0.85' diaginertia='0.0012 0.0012 0.0015'/>"
        "</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    currents, total = np.array([1.0, -0.5, 0.3, 2.0, -1.5, 0.7]), np.zeros(6)
    for place, way, current in zip(COILS.position, COILS.direction, currents, strict=True):
        mujoco.mj_applyFT(model, data, 8.0 * current * way, np.zeros(3), place, 1, total)
    assert COILS.compute_wrench(currents) == pytest.approx(total, abs=1e-12)


@given(WRENCH)
def test_currents_make_the_wrench_or_a_smaller_one_of_its_direction(wrench):
    wanted = np.array(wrench) * [1, 1, 1, 0.05, 0.05, 0.05]
    found = COILS.compute_currents(wanted)
    assert np.abs(found.value).max() <= 4.0 * (1 + 1e-12)
    made = COILS.compute_wrench(found.value)
    if not found.is_limited:
        assert np.allclose(made, wanted, atol=1e-9)
    else:
        assert np.allclose(made * np.linalg.norm(wanted), wanted * np.linalg.norm(made), atol=1e-6)
        assert np.linalg.norm(made) <= np.linalg.norm(wanted) * (1 + 1e-12)


def test_the_weight_of_the_flotor_takes_a_tenth_of_the_current():
    found = COILS.compute_currents(np.array([0.0, 0.0, 0.85 * 9.81, 0.0, 0.0, 0.0]))
    assert not found.is_limited and np.abs(found.value).max() == pytest.approx(0.3474, abs=1e-3)


def test_a_wrench_that_is_no_number_gets_no_current():
    found = COILS.compute_currents(np.array([1.0, np.nan, 0.0, 0.0, 0.0, 0.0]))
    assert found.is_limited and not found.value.any()


def test_coils_that_cannot_make_every_wrench_are_refused():
    up = np.tile([0.0, 0.0, 1.0], (6, 1))
    place = np.random.default_rng(0).uniform(-0.05, 0.05, (6, 3))
    with pytest.raises(InputError, match="every force"):
        Coils(place, up, 8.0, 4.0)
    with pytest.raises(InputError, match="length 1"):
        Coils(place, 2.0 * up, 8.0, 4.0)
    with pytest.raises(InputError, match="six positions"):
        Coils(place[:3], up[:3], 8.0, 4.0)
    with pytest.raises(InputError, match="positive"):
        make_three_station_coils(0.05, 0.0, 4.0)


def test_coils_heat_as_the_exact_solution_does():
    heat, currents = np.zeros(6), np.array([0.0, 1.0, 2.0, 3.0, -4.0, 4.0])
    for _ in range(1200):
        heat_step(heat, currents, 2.0, 60.0, 0.025)
    # 30 s of held currents; the steps are exact, so only rounding of 1200 sums is left
    assert heat == pytest.approx((currents / 2.0) ** 2 * -np.expm1(-0.5), rel=1e-10)


def test_heating_and_the_time_that_is_left():
    currents = np.full(6, 3.0)
    assert relative_heating(currents, 2.0) == pytest.approx(2.25)
    assert time_to_overheat(np.full(6, 2.0), 2.0, 60.0) == np.inf
    left, heat = time_to_overheat(currents, 2.0, 60.0), np.zeros(6)
    heat_step(heat, currents, 2.0, 60.0, left)
    assert heat == pytest.approx(np.ones(6))


def test_a_detent_keeps_the_coils_cool_where_one_slope_would_not():
    """Zhu 1994, 6.3: a stiff joystick heats; Table 6.11's detent of the feller-buncher's x."""
    joystick = load_joystick()
    c, x = joystick.coils, 4.5e-3
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    gains = joystick.gains["feller"]["x"]
    assert gains.detent
    slope = gains.nominal_stiffness * x
    notch = gains.nominal_stiffness * gains.deadband - gains.detent.drop
    notch += gains.detent.slope * (x - gains.deadband)
    hot = []
    for force in (slope, notch):
        wrench = np.array([force, 0.0, 9.81 * joystick.flotor.mass, 0.0, 0.0, 0.0])
        wrench[4] = force * joystick.flotor.handle[2]
        hot.append(relative_heating(coils.compute_currents(wrench).value, c.continuous_current))
    assert hot[0] > 2.0 and hot[1] < 1.0


def test_the_field_is_that_of_the_middle_there_and_even_about_it():
    coils = make_three_station_coils(0.05, 8.0, 4.0).position
    assert coil_force_factors(coils, np.zeros(3), np.eye(3), 5e-3, 0.2).tolist() == [1.0] * 6
    moved = coil_force_factors(coils, np.array([3e-3, 0.0, 4e-3]), np.eye(3), 5e-3, 0.2)
    assert moved == pytest.approx(np.full(6, 0.8))
    back = coil_force_factors(coils, np.array([-3e-3, 0.0, -4e-3]), np.eye(3), 5e-3, 0.2)
    assert back == pytest.approx(moved)
    c, s = np.cos(0.02), np.sin(0.02)
    turned = coil_force_factors(coils, np.zeros(3), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), 5e-3, 0.2)
    assert turned == pytest.approx(np.full(6, 1.0 - 0.2 * (2 * 0.05 * np.sin(0.01) / 5e-3) ** 2))


def test_hot_coils_get_less_until_they_have_cooled():
    flotor, full = SimulatedFlotor(load_joystick(), hand=False), np.full(6, 4.0)
    c = flotor.facts.coils
    steps = 0
    while flotor.current_limit == c.max_current:
        flotor.step(full, np.zeros(6))
        steps += 1
    expected = time_to_overheat(full, c.continuous_current, c.thermal_time)
    assert steps * flotor.period == pytest.approx(expected, abs=flotor.period)
    assert flotor.current_limit == c.continuous_current and flotor.max_relative_temperature_rise >= 1.0
    steps = 0
    while flotor.current_limit < c.max_current:
        flotor.step(np.zeros(6), np.zeros(6))
        steps += 1
    assert steps * flotor.period == pytest.approx(-c.thermal_time * np.log(0.9), abs=0.02)


def test_a_coil_that_leaves_its_field_pushes_less():
    joystick = load_joystick()
    coils = joystick.coils.model_copy(update={"edge_loss": 0.2})
    flotor = SimulatedFlotor(joystick.model_copy(update={"coils": coils}), hand=False)
    flotor.set_pose(np.array([5e-3, 0, 0, 0, 0, 0]))
    flotor.step(np.zeros(6), np.zeros(6))
    assert np.abs(flotor.model.actuator_gear).max(axis=1) == pytest.approx(np.full(6, 6.4))

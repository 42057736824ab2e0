"""The laws of valve, orifice, ports, friction and spool against their definitions."""

import doctest
import inspect
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from hydrotele.hydraulics import circuit, supply, valve
from hydrotele.hydraulics import laws as hydraulics
from hydrotele.hydraulics.laws import (
    friction_force,
    orifice_flow,
    relief_and_makeup_flow,
    spool_step,
    valve_opening,
)

PLACES = {"user", "u", "i", "first", "count", "scratch"}  # memory and indices carry no unit
PORT = (32.0e6, 1.0e-9, 0.3e6, 5.0e-9)


def laws(module):
    """Compiled functions that a module defines itself."""
    return {
        name: law
        for name, law in vars(module).items()
        if hasattr(law, "py_func") and law.py_func.__module__ == module.__name__ and not name.startswith("_")
    }


LAWS = {f"{m.__name__}.{n}": f for m in (hydraulics, valve, supply, circuit) for n, f in laws(m).items()}


def section(text, title):
    found = re.search(rf"^    {title}:(.*?)(?=^    \S|\Z)", text, re.S | re.M)
    assert found, f"no section {title}"
    return found.group(1)


@pytest.mark.parametrize("name", LAWS)
def test_docstring_names_every_argument_with_its_unit(name):
    text, law = LAWS[name].__doc__, LAWS[name]
    entries = re.findall(r"^        (\w+): (.*?)(?=^        \w+: |\Z)", section(text, "Args"),
                         re.S | re.M)  # fmt: skip
    assert [entry[0] for entry in entries] == list(inspect.signature(law.py_func).parameters)
    for argument, meaning in entries:
        assert argument in PLACES or re.search(r"\[[^\]]+\]", meaning), f"{argument} has no unit"
    assert re.search(r"\[[^\]]+\]|Nothing|\(s, s'\)", section(text, "Returns"))
    assert "Source:" in text


def test_doctests_run():
    examples = failures = 0
    for name, law in LAWS.items():
        for test in doctest.DocTestFinder().find(law.py_func, name, globs=dict(law.py_func.__globals__)):
            result = doctest.DocTestRunner().run(test)
            examples, failures = examples + result.attempted, failures + result.failed
    assert failures == 0
    assert examples >= len(laws(hydraulics)), "every law of hydraulics.py shows an example"


@given(st.floats(-3, 3), st.floats(0, 0.9))
def test_valve_opening_has_a_dead_band_and_unit_slope_to_one(spool, deadband):
    o = valve_opening(spool, deadband)
    assert valve_opening(-spool, deadband) == -o
    if abs(spool) <= deadband:
        assert o == 0.0
    else:
        # rounding: the difference |s| - db keeps 1e-16 of s, divided by 1 - db >= 0.1
        assert o * (1 - deadband) + math.copysign(deadband, spool) == pytest.approx(spool, abs=1e-14)


def test_valve_is_fully_open_at_full_command():
    assert valve_opening(1.0, 0.04) == 1.0
    assert valve_opening(math.nextafter(0.04, 1), 0.04) < 1e-15, "continuous at the dead band"


@given(st.floats(-30e6, 30e6), st.floats(1e-8, 1e-5), st.floats(1e3, 1e6))
def test_orifice_slope_is_the_derivative(drop, gain, smoothing):
    flow, slope = orifice_flow(drop, gain, smoothing)
    step = 1e-4 * math.hypot(drop, smoothing)
    above, below = (orifice_flow(drop + s, gain, smoothing)[0] for s in (step, -step))
    # central difference: truncation (step/scale)^2 = 1e-8 and cancellation 1e-16 / 1e-4
    assert slope == pytest.approx((above - below) / (2 * step), rel=1e-7)
    assert slope > 0
    assert orifice_flow(-drop, gain, smoothing)[0] == -flow


@given(st.floats(1e5, 30e6), st.floats(1e-8, 1e-5))
def test_orifice_is_the_square_root_law_far_from_zero(drop, gain):
    smoothing = 5.0e4
    flow, _ = orifice_flow(drop, gain, smoothing)
    deficit = 1.0 - flow / (gain * math.sqrt(drop))
    # 0 <= 1 - (1 + e^2)^(-1/4) <= e^2 / 4 with e = d / dp; 1e-15 for rounding
    assert -1e-15 <= deficit <= 0.25 * (smoothing / drop) ** 2 + 1e-15


def test_orifice_passes_the_rated_flow_at_the_rated_drop():
    flow, _ = orifice_flow(7.0e6, 6.0e-3 / math.sqrt(7.0e6), 5.0e4)
    assert flow == pytest.approx(6.0e-3, rel=1.3e-5)  # (d / dp)^2 / 4 = 1.28e-5


@given(st.floats(-5e6, 40e6))
def test_port_flow_drives_the_pressure_back_into_the_band(pressure):
    flow, slope = relief_and_makeup_flow(pressure, *PORT)
    relief, k_relief, tank, k_makeup = PORT
    expected = -k_relief * max(0.0, pressure - relief) + k_makeup * max(0.0, tank - pressure)
    assert flow == expected
    step = 1.0  # Pa: the law is linear on both sides, so the difference quotient is exact
    if min(abs(pressure - relief), abs(pressure - tank)) > 2 * step:
        upper, lower = (
            relief_and_makeup_flow(pressure + step, *PORT)[0],
            relief_and_makeup_flow(pressure - step, *PORT)[0],
        )
        assert slope == pytest.approx((upper - lower) / (2 * step), abs=1e-15)  # 1e-2 / 1e16 / 1 Pa


def test_port_flow_is_continuous_where_the_valves_open():
    assert relief_and_makeup_flow(32.0e6, *PORT)[0] == 0.0
    assert relief_and_makeup_flow(0.3e6, *PORT)[0] == 0.0


@given(st.floats(-2, 2))
def test_friction_is_odd_and_dissipates(velocity):
    numbers = (3000.0, 1500.0, 0.02, 6000.0, 0.005)
    force = friction_force(velocity, *numbers)
    assert force == -friction_force(-velocity, *numbers)
    assert force * velocity >= 0.0
    assert abs(force) <= 4500.0 + 6000.0 * abs(velocity)


def test_friction_in_its_three_limits():
    numbers = (3000.0, 1500.0, 0.02, 6000.0, 0.005)
    # at rest a damper (F_c + F_s) / v_0 + b; the next term of tanh is (v / v_0)^2 / 3 = 1.3e-9,
    # that of the Stribeck curve (v / v_s)^2 / 4
    v = 1e-6 * 0.02
    assert friction_force(v, *numbers) / v == pytest.approx(4500 / 0.005 + 6000, rel=1e-8)
    # sliding: exp(-25) = 1.4e-11 of F_s and 1 - tanh(20) are all that is left
    assert friction_force(0.1, *numbers) == pytest.approx(3000 + 600, rel=1e-10)
    # the Stribeck curve falls: breakaway peak above the sliding force
    peak = max(friction_force(x, *numbers) for x in np.linspace(0.001, 0.02, 50))
    assert peak > friction_force(0.04, *numbers) + 500


def test_friction_without_stribeck_is_coulomb_and_viscous():
    assert friction_force(0.3, 4000.0, 0.0, 0.05, 2000.0, 0.005) == 4600.0


@given(
    st.floats(-1, 1), st.floats(-50, 50), st.floats(-1, 1), st.floats(5, 300), st.floats(0.3, 1),
    st.floats(0.01, 3),
)  # fmt: skip
def test_spool_step_is_the_matrix_exponential(spool, rate, command, bandwidth, damping, angle):
    dt = angle / bandwidth
    state = np.array([[0, 1], [-(bandwidth**2), -2 * damping * bandwidth]])
    error, exact_rate = expm(state * dt) @ [spool - command, rate]
    s, r = spool_step(spool, rate, command, bandwidth, damping, dt)
    parts = 1 + int(angle / 0.5)
    # Taylor remainder: 5th derivatives of the transition matrix in w t are below 5 for z <= 1, and
    # their sum over both states below 10; the parts add up; 1e-12 for rounding in both
    bound = parts * 10 * (angle / parts) ** 5 / 120 + 1e-12
    scale = abs(spool - command) + abs(rate) / bandwidth
    assert abs(s - command - error) <= bound * max(scale, 1e-3)
    assert abs(r - exact_rate) <= bandwidth * bound * max(scale, 1e-3)


def test_spool_step_error_at_the_usual_step_is_as_documented():
    w, z, dt = 2 * math.pi * 8, 0.9, 1.0e-3
    exact = 1.0 - (expm(np.array([[0, 1], [-w * w, -2 * z * w]]) * dt) @ [1.0, 0.0])[0]
    assert 0 < abs(spool_step(0.0, 0.0, 1.0, w, z, dt)[0] - exact) < (w * dt) ** 5 / 30


def test_spool_comes_to_rest_at_the_command():
    s, rate = 0.0, 0.0
    for _ in range(1000):
        s, rate = spool_step(s, rate, 0.7, 50.0, 0.9, 1e-3)
    assert s == pytest.approx(0.7, abs=1e-15)  # exp(-45) is gone; the fixed point is exact
    assert rate == pytest.approx(0.0, abs=1e-12)

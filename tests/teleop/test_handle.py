"""Laws of the joystick's axes, the energy at a port, and recursive estimation."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.core.errors import InputError
from tools.studies.handle_laws import Detent, StiffnessFeedback

# Zhu 1994, Tables 6.7 and 6.8, the excavator's x: stiffness 300 .. 4000 N/m at up to 50 kN
AXIS = StiffnessFeedback(600.0, 300.0, 4000.0, (4000.0 - 600.0) / 50e3, 60.0, 50e3, 1.5e-3)


@given(st.floats(-5e-3, 5e-3), st.floats(allow_nan=True, allow_infinity=True))
def test_stiffness_keeps_its_bounds_whatever_the_sensor_says(x, contact):
    assert 300.0 <= AXIS.stiffness(x, contact) <= 4000.0
    assert AXIS.force(x, 0.0, contact) * x <= 0.0


def test_contact_stiffens_against_the_command_and_softens_along_it():
    assert AXIS.stiffness(3e-3, 0.0) == 600.0
    assert AXIS.stiffness(3e-3, 20e3) == pytest.approx(600.0 + 0.068 * 20e3)
    assert AXIS.stiffness(-3e-3, -20e3) == AXIS.stiffness(3e-3, 20e3)
    assert AXIS.stiffness(3e-3, -20e3) == 300.0
    assert AXIS.stiffness(3e-3, 80e3) == 4000.0  # the force is limited to 50 kN
    assert AXIS.force(3e-3, 0.1, 0.0) == pytest.approx(-600.0 * 3e-3 - 6.0)
    assert [AXIS.command(x) for x in (1e-3, 2e-3, -2e-3)] == pytest.approx([0.0, 5e-4, -5e-4])


@pytest.mark.parametrize(
    "wrong",
    [{"least": 700.0}, {"most": 100.0}, {"damping": -1.0}, {"ratio": float("nan")},
     {"deadband": -1e-3}],
)  # fmt: skip
def test_gains_without_sense_are_refused(wrong):
    with pytest.raises(InputError):
        dataclasses.replace(AXIS, **wrong)


def test_a_detent_never_pushes_outwards():
    notch = Detent(deadband=1.5e-3, drop=2.0, inside=4e3, outside=300.0)
    assert all(notch.force(x) * x <= 0.0 for x in np.linspace(-5e-3, 5e-3, 201))
    with pytest.raises(InputError, match="pushed outwards"):
        Detent(deadband=1e-3, drop=5.0, inside=4e3, outside=300.0)
    with pytest.raises(InputError, match="negative"):
        Detent(deadband=1e-3, drop=-1.0, inside=4e3, outside=300.0)


def test_recursion_ends_where_least_squares_does():
    rng = np.random.default_rng(3)
    rows, truth = rng.standard_normal((400, 3)), np.array([2.0, -1.0, 0.5])
    forces = rows @ truth + 0.1 * rng.standard_normal(400)
    found = RecursiveLeastSquares(np.zeros(3), np.full(3, 1e4))
    for row, force in zip(rows, forces, strict=True):
        found.update(row, force)
    expected = np.linalg.lstsq(rows, forces, rcond=None)[0]
    # the start counts with 1e-8 of an equation
    np.testing.assert_allclose(found.value, expected, atol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(rows.T @ rows), rtol=1e-4, atol=1e-7)


def test_a_task_that_changes_is_followed_and_rest_does_no_harm():
    """An impedance [M, B, K] that hardens at once, then 50 s without motion."""
    rng = np.random.default_rng(4)
    found = RecursiveLeastSquares(np.zeros(3), np.array([10.0, 100.0, 1e4]), forgetting=0.995, reset_ratio=8.0)
    soft, hard = np.array([1.0, 20.0, 500.0]), np.array([1.0, 60.0, 5000.0])
    for k in range(3000):
        t = 0.005 * k
        x = 0.01 * np.array([
            -(9.0 * np.sin(3 * t) + 49.0 * np.sin(7 * t)), 3 * np.cos(3 * t) + 7 * np.cos(7 * t),
            np.sin(3 * t) + np.sin(7 * t),
        ])  # fmt: skip
        truth = soft if k < 1500 else hard
        found.update(x, float(x @ truth) + 0.01 * rng.standard_normal())
        if k == 1499:
            assert found.value == pytest.approx(soft, rel=0.05) and found.resets == 0
    assert found.resets >= 1 and found.value == pytest.approx(hard, rel=0.05)
    before = found.value.copy()
    for _ in range(10_000):
        found.update(np.zeros(3), 0.01 * rng.standard_normal())
    assert np.isfinite(found.covariance).all() and np.array_equal(found.value, before)
    assert np.trace(found.covariance) <= 1.0001 * (100.0 + 1e4 + 1e8)
    assert np.isnan(found.update(np.array([1.0, np.nan, 0.0]), 1.0))
    assert np.array_equal(found.value, before)


@pytest.mark.parametrize(
    "options", [{"forgetting": 0.0}, {"forgetting": 1.1}, {"reset_ratio": 1.0}, {"spread": [1.0, 0.0]}]
)
def test_recursion_refuses_nonsense(options):
    spread = options.pop("spread", [1.0, 1.0])
    with pytest.raises(InputError):
        RecursiveLeastSquares(np.zeros(2), np.array(spread), **options)

"""A calibrator that bends, and sensors with tilted or loose couplings."""

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.simulate.sensor_models import simulate_readings

MACHINE = load_machine("calibrator")
ELBOW = "angle.calibrator_elbow"


def shown(effect, parameter, value, angle):
    """What the elbow's sensor without noise shows."""
    machine = apply_effect(MACHINE, effect, "calibrator_elbow", {parameter: value})
    return simulate_readings(machine, None, 1, {ELBOW: angle})[ELBOW]


def test_tilted_coupling_errs_twice_a_turn():
    """tan(shown) = tan(angle) cos(tilt): right at quarter turns, tilt^2 / 4 wrong between."""
    angle = np.linspace(-7.0, 7.0, 1001)
    error = shown("sensor_misalignment", "tilt", 0.1, angle) - angle
    assert np.abs(error).max() == pytest.approx(0.1**2 / 4.0, rel=0.01)
    np.testing.assert_allclose(error, -(0.1**2) / 4.0 * np.sin(2.0 * angle), atol=2e-5)


def test_loose_coupling_lags_half_its_play():
    angle = np.concatenate([np.linspace(0.0, 1.0, 100), np.linspace(1.0, 0.0, 100)])
    seen = shown("sensor_backlash", "gap", 0.02, angle)
    np.testing.assert_allclose(seen[10:100], angle[10:100] - 0.01, atol=1e-12)
    np.testing.assert_allclose(seen[110:], angle[110:] + 0.01, atol=1e-12)


def test_bending_adds_two_stiff_hinges_across_the_joint():
    machine = apply_effect(MACHINE, "joint_bending", "calibrator_yoke", {"compliance": 5e-5})
    plain, bent = (build_plant(m, ground=False) for m in (MACHINE, machine))
    assert bent.model.nv == plain.model.nv + 2
    added = [bent.model.joint(f"hydrotele_calibrator_yoke_bend_{x}") for x in "ab"]
    assert all(float(joint.stiffness[0]) == pytest.approx(2.0e4) for joint in added)
    assert all(abs(float(joint.axis @ (0.0, 1.0, 0.0))) < 1e-12 for joint in added)
    assert np.isfinite(rest_state(bent).qpos).all()

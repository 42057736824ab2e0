"""Damping that a sampled joystick holds: closed forms, and MuJoCo under the joystick's control."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.teleop.axis_table import DAMPING, NOMINAL_STIFFNESS
from hydrotele.teleop.master import build_master, step_master
from hydrotele.teleop.sampled_stability import (
    HandleBody,
    make_spinning_body,
    make_tilting_body,
    max_sampled_handle_eigenvalue,
    max_stable_handle_damping,
    min_stable_handle_inertia,
)

JOYSTICK = load_joystick()
PERIOD = 1.0 / JOYSTICK.control_rate


@pytest.mark.daily("0.005-0.001", "0.005-0.008")
@pytest.mark.parametrize("inertia", [1e-3, 8e-3])
@pytest.mark.parametrize("period", [1e-3, 5e-3])
def test_without_a_spring_the_limit_is_twice_the_inertia_by_the_period(inertia, period):
    """V' = v - a (v + v_before), a = B T / 2 J: z^2 - (1 - a) z + a = 0, stable for a < 1."""
    assert max_stable_handle_damping(inertia, 0.0, period) == pytest.approx(2.0 * inertia / period, rel=1e-6)
    assert min_stable_handle_inertia(3.0, 0.0, period) == pytest.approx(1.5 * period, rel=1e-6)


@pytest.mark.nightly
def test_limits_and_inertias_are_inverse_to_each_other():
    inertia = min_stable_handle_inertia(3.0, 6.0, PERIOD)
    assert max_stable_handle_damping(inertia * 1.001, 6.0, PERIOD) == pytest.approx(3.0, rel=0.01)


def test_fine_sampling_is_a_spring_and_damper():
    decay = max_sampled_handle_eigenvalue(make_spinning_body(1.5e-3), np.array([6.0]), np.array([0.05]), 1e-5)
    # poles of J s^2 + B s + K have the real part -B / 2 J
    assert np.log(decay) / 1e-5 == pytest.approx(-0.05 / 3e-3, rel=2e-3)


def test_a_body_without_mass_is_refused():
    with pytest.raises(InputError, match="mass must be positive"):
        max_sampled_handle_eigenvalue(HandleBody(*np.zeros((3, 1, 1))), np.ones(1), np.ones(1), PERIOD)


def test_the_published_rotational_damping_shakes_every_flotor_of_this_size():
    """Zhu 1994, Tables 6.7 and 6.9: 0.03 and 0.04 in 100 N m/rad/s, control at 200 Hz (5.3)."""
    f, h = JOYSTICK.flotor, JOYSTICK.hand
    arm = f.com[2] - f.handle[2]
    hand = (h.mass, h.damping, h.stiffness, h.rotation_damping, h.rotation_stiffness)
    for stiff, turn, damping in ((600.0, 6.0, 3.0), (4000.0, 45.0, 4.0)):
        springs, dampers = np.array([stiff, turn]), np.array([60.0, damping])
        body = make_tilting_body(f.mass, arm, f.inertia[0], hand)
        assert max_sampled_handle_eigenvalue(body, springs, dampers, PERIOD) > 1.2
        assert max_sampled_handle_eigenvalue(body, springs, dampers, 1e-3) < 1.0  # 1 kHz would hold it
        # as gyration of 0.85 kg: beyond 90 mm, nearly twice the radius of the coils
        assert np.sqrt(min_stable_handle_inertia(damping, turn, PERIOD) / f.mass) > 0.09


def growth(axis: int, stiffness: float, damping: float, joystick) -> float:
    """How the turning of a handle without a hand grows over a second, by MuJoCo as in a run."""
    pilot = TeleopPilot.model_validate({"kind": "teleop", "operator": {"kind": "follow"}, "reflection": "none"})
    numbers, state = build_master(joystick, pilot, ("r", "theta", "z"))
    numbers.axis[axis, NOMINAL_STIFFNESS], numbers.axis[axis, DAMPING] = stiffness, damping
    numbers.resolution[:] = 0.0  # readings without steps, so that growth is seen from the beginning
    flotor, pose = SimulatedFlotor(joystick, hand=False), np.zeros(6)
    pose[axis] = 1e-7  # so that coils are not at their limit in the end
    flotor.set_pose(pose)
    turns = []
    for k in range(60):
        step_master(numbers, flotor.data.qpos, np.zeros((8, 3)), 1.0, PERIOD, k == 0, state)
        turns.append(state.handle[axis])
        flotor.step(state.currents, np.zeros(6))
    late, early = np.abs(turns[40:60]).max(), np.abs(turns[5:25]).max()
    return float((late / early) ** (1.0 / 35.0))


@pytest.mark.parametrize("damping", [0.05, 0.25, 0.45, 0.70])
def test_mujoco_grows_or_decays_as_the_eigenvalues_say(damping):
    """Turning about the handle's own axis, rz, where nothing else is coupled."""
    stiffness, axis = 6.0, AXES.index("rz")
    inertia = JOYSTICK.flotor.inertia[2]
    expected = max_sampled_handle_eigenvalue(
        make_spinning_body(inertia), np.array([stiffness]), np.array([damping]), PERIOD
    )
    found = growth(axis, stiffness, damping, JOYSTICK)
    assert (found < 1.0) == (expected < 1.0)
    # rates read off 20 ms maxima of an oscillation
    assert found == pytest.approx(expected, abs=0.06)

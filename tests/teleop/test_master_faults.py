"""The master's control on the simulated joystick: faults, detent, too large demands."""

import numpy as np
import pytest

from hydrotele.machine.joystick import load_joystick
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.teleop.coils import make_three_station_coils
from hydrotele.teleop.compliance import held_flotor_wrench
from hydrotele.teleop.master import build_master, step_master
from tools.studies.handle_laws import Detent

JOYSTICK = load_joystick()
COORDINATES = ("r", "theta", "z")
PERIOD, QUIET = 5e-3, np.zeros((8, 3))


def at(x=0.0, y=0.0, z=0.0):
    return np.array([x, y, z, 1.0, 0.0, 0.0, 0.0])


def seated(**keys):
    """Numbers and state of a master."""
    pilot = TeleopPilot.model_validate({"kind": "teleop", "operator": {"kind": "follow"}, "reflection": "none", **keys})
    return build_master(JOYSTICK, pilot, COORDINATES)


def test_a_reading_that_is_no_number_switches_the_coils_off():
    numbers, s = seated(reflection="four_channel")
    step_master(numbers, at(3e-3), QUIET, 1.0, PERIOD, True, s)
    step_master(numbers, at(3e-3), QUIET, 1.0, PERIOD, False, s)
    assert np.abs(s.currents).max() > 0.1 and s.limited[0] == 1.0
    step_master(numbers, at(np.nan), QUIET, 1.0, PERIOD, False, s)
    assert not s.currents.any() and not s.handle.any() and s.limited[0] == 0.0
    for _ in range(3):
        step_master(numbers, at(3e-3), QUIET, 1.0, PERIOD, False, s)
        assert all(np.isfinite(part).all() for part in s)
    # from rest: there was no jump from the centre to 3 mm in 5 ms
    assert not s.speed.any() and s.limited[0] == 1.0


@pytest.mark.parametrize("kind", ["stiffness", "direct_force", "coordinating_force", "four_channel", "impedance"])
def test_a_packet_that_is_no_number_leaves_the_spring(kind):
    numbers, s = seated(reflection=kind)
    for _ in range(3):
        step_master(numbers, at(3e-3), np.full((8, 3), np.nan), 1.0, PERIOD, False, s)
    assert np.isfinite(s.currents).all() and np.abs(s.currents).max() < 4.0
    # 600 N/m; between K_min and K_max where the stiffness itself was no number
    assert -4000.0 * 3e-3 <= s.push[0] <= -300.0 * 3e-3
    step_master(numbers, at(3e-3), QUIET, 1.0, PERIOD, False, s)
    assert all(np.isfinite(part).all() for part in s)


def test_a_frozen_reading_pushes_as_before_and_no_harder():
    """Frozen at 3 mm: the coils keep the 1.8 N of there; a hand of 250 N/m is held at 7 mm of it.

    So the coils stay within their gap and the currents as they were; the handle tilts about the
    stop. The master cannot know: a hand may rest. What stands alone knows by its noise
    (`teleop.levitation`).
    """
    numbers, s = seated()
    flotor, muscles = SimulatedFlotor(JOYSTICK), np.zeros(6)
    muscles[2] = 9.81 * JOYSTICK.hand.mass
    for k in range(400):
        step_master(numbers, at(3e-3), QUIET, 1.0, PERIOD, k == 0, s)
        flotor.step(s.currents, muscles)
    assert s.push[0] == pytest.approx(-1.8) and np.abs(s.currents).max() < 1.0
    x, z, turned = flotor.data.qpos[0], flotor.data.qpos[2], 2.0 * np.arcsin(flotor.data.qpos[5])
    assert abs(x - 0.12 * np.sin(turned)) < 5.1e-3 and abs(z) < 1e-3
    assert not np.any(flotor.data.warning.number)


def test_a_demand_beyond_the_coils_keeps_its_direction():
    numbers, s = seated()
    s.extra[:] = [300.0, -200.0, 100.0, 5.0, 0.0, -8.0]
    step_master(numbers, at(), QUIET, 1.0, PERIOD, True, s)
    assert np.abs(s.currents).max() == pytest.approx(4.0) and 0.0 < s.limited[0] < 1.0
    c, wanted = JOYSTICK.coils, np.empty(6)
    held_flotor_wrench(
        numbers.mass[0],
        numbers.centre_of_mass,
        numbers.handle,
        s.push,
        np.eye(3),
        numbers.gravity,
        wanted,
    )
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    np.testing.assert_allclose(coils.compute_wrench(s.currents), s.limited[0] * wanted, rtol=1e-9)


@pytest.mark.parametrize("axis, far", [(0, 3e-3), (3, 0.041)])
def test_the_detent_is_felt_as_it_was_designed(axis, far):
    """The handle is led through its notch by a clamp; the clamp's force is that of the law.

    A step of the reading, 1 um or 0.001 deg, is 4 mN or 0.8 mN m of the spring and, within 5 ms,
    12 mN or 0.9 mN m of the damping.
    """
    numbers, s = seated(gains="feller", detent=True)
    gains = JOYSTICK.gains["feller"]["x" if axis == 0 else "rx"]
    law = Detent(gains.deadband, gains.detent.drop, gains.nominal_stiffness, gains.detent.slope)
    flotor, joint = SimulatedFlotor(JOYSTICK, hand=False), 0 if axis == 0 else 3
    flotor.model.jnt_stiffness[:] = [2e4] * 3 + [200.0]
    flotor.model.dof_damping[:] = [100.0] * 3 + [2.0] * 3
    fine = 16e-3 if axis == 0 else 1.7e-3
    for place in np.linspace(-far, far, 13) * 1.01:  # away from the very edge
        spring = flotor.model.qpos_spring
        spring[:7] = at(place) if axis == 0 else [0, 0, 0, np.cos(place / 2), np.sin(place / 2), 0, 0]
        for k in range(120):
            step_master(numbers, flotor.data.qpos, QUIET, 1.0, PERIOD, k == 0, s)
            flotor.step(s.currents, np.zeros(6))
        clamp = flotor.data.qfrc_passive[joint]
        now = flotor.data.qpos[0] if axis == 0 else 2.0 * np.arcsin(flotor.data.qpos[4])
        assert clamp == pytest.approx(-law.force(now), abs=fine), place

"""What the nominal CAT 215 is like, as NOMINAL_MODEL.md says after another implementation."""

import mujoco
import numpy as np
import pytest
import scipy.linalg

from hydrotele.hydraulics.circuit import Slot
from hydrotele.simulate.closed_loops import independent_dofs, motion_basis
from hydrotele.simulate.plant import rest_state

SWING, BOOM, STICK = range(3)
HOME = {"boom": 0.45, "stick": -1.6}


def simulate(plant, command, seconds, joints=HOME, model=None):
    """Joint velocities (n, 3), pressures (n, 3, 2), piston velocities (n, 3), final joints."""
    model, data = model or plant.model, rest_state(plant, joints)
    velocity, pressure, piston = [], [], []
    for k in range(round(seconds / model.opt.timestep)):
        data.ctrl[:] = command(k * model.opt.timestep)
        mujoco.mj_step(model, data)
        velocity.append(data.qvel[plant.dof])
        pressure.append(data.act.reshape(-1, 4)[:, 2:].copy())
        piston.append(data.actuator_velocity.copy())
    final = dict(zip(plant.axes, data.qpos[plant.qpos], strict=True))
    return np.array(velocity), np.array(pressure), np.array(piston), final


def frequency(signal, band):
    """Strongest frequency [Hz] of a 1 kHz signal inside a band."""
    n = len(signal)
    line = np.polyval(np.polyfit(np.arange(n), signal, 1), np.arange(n))
    spectrum = np.abs(np.fft.rfft((signal - line) * np.hanning(n), 16 * n))
    grid = np.fft.rfftfreq(16 * n, 1e-3)
    spectrum[(grid < band[0]) | (grid > band[1])] = 0
    return grid[spectrum.argmax()]


def locked_frequencies(plant, joints):
    """Natural frequencies [Hz] with closed valves: oil springs on the closed-chain mass matrix."""
    data = rest_state(plant, joints)
    mujoco.mj_forward(plant.model, data)
    basis = motion_basis(plant.machine, plant.model, data)
    weighted = np.zeros(basis.T.shape)
    for row, motion in zip(weighted, basis.T, strict=True):
        mujoco.mj_mulM(plant.model, data, row, motion)
    rows = plant.model.actuator_user
    x = np.where(rows[:, Slot.KIND] == 1, data.actuator_length, 0.0)
    stroke = np.where(rows[:, Slot.KIND] == 1, rows[:, Slot.STROKE], 0.0)
    head, rod = rows[:, Slot.AREA_HEAD], rows[:, Slot.AREA_ROD]
    volumes = rows[:, Slot.VOLUME_HEAD] + head * x, rows[:, Slot.VOLUME_ROD] + rod * (stroke - x)
    spring = rows[:, Slot.BULK_MODULUS] * (head**2 / volumes[0] + rod**2 / volumes[1])
    lever = basis[plant.model.jnt_dofadr[plant.model.actuator_trnid[:, 0]]]
    stiffness = lever.T @ (spring[:, None] * lever)
    squares, modes = scipy.linalg.eigh(stiffness, weighted @ basis)
    of_axis = np.abs(modes).argmax(axis=0)
    assert list(independent_dofs(plant.machine, plant.model)) == list(plant.dof)
    return {int(a): np.sqrt(s) / 2 / np.pi for a, s in zip(of_axis, squares, strict=True)}


@pytest.mark.parametrize("joints", [HOME, {"boom": 0.0, "stick": -1.6}, {"boom": 0.45, "stick": -2.4}])
def test_boom_rings_for_over_four_seconds_after_its_valve_closes(plant_of, joints):
    plant, closed = plant_of(), 0.4
    velocity, _, _, final = simulate(plant, lambda t: (0, 0.5 * (t < closed), 0), closed + 5.0, joints)
    ringing = velocity[round(1000 * closed) + 400 :, BOOM]  # the spool has closed
    found = frequency(ringing[:3000], (1, 10))
    assert 2.5 < found < 3.1
    # 1 %: the grid of the spectrum is 0.02 Hz; gravity and damping shift less than that
    assert found == pytest.approx(locked_frequencies(plant, final)[BOOM], rel=0.01)
    assert np.abs(ringing[3600:4000]).max() > 0.05 * np.abs(ringing[:400]).max()  # 4 s after closing


def test_swing_rings_at_its_oil_spring(plant_of):
    plant, closed = plant_of(), 0.6
    velocity, _, _, final = simulate(plant, lambda t: (1.0 * (t < closed), 0, 0), closed + 1.5)
    found = frequency(velocity[round(1000 * closed) + 200 :, SWING], (1, 10))
    assert 2.5 < found < 3.1
    # 2 %: it is gone after 1.3 s, so the grid of the spectrum is 0.05 Hz
    assert found == pytest.approx(locked_frequencies(plant, final)[SWING], rel=0.02)


def test_lowering_under_power_puts_20_mpa_into_both_boom_chambers(plant_of):
    _, pressure, _, _ = simulate(plant_of(), lambda t: (0, -0.5, 0), 1.6, {"boom": 0.8, "stick": -1.6})
    steady = pressure[600:, BOOM].mean(axis=0)
    assert np.all((steady > 18e6) & (steady < 22e6))  # "about 20 MPa"


def test_stick_excites_itself_on_the_falling_friction_curve(plant_of):
    plant = plant_of()
    _, _, piston, _ = simulate(plant, lambda t: (0, 0, -0.12), 3.0)
    slow = piston[1500:, STICK]
    assert slow.mean() == pytest.approx(-0.03, abs=0.005)
    assert frequency(slow, (5, 60)) == pytest.approx(21, abs=1)
    assert slow.std() > 0.01, "a limit cycle, not a remainder of the start"
    smooth = plant.model.__copy__()
    smooth.actuator_user[:, Slot.STRIBECK] = 0.0
    _, _, piston, _ = simulate(plant, lambda t: (0, 0, -0.12), 3.0, model=smooth)
    assert piston[2500:, STICK].std() < 1e-3, "without the Stribeck curve the stick runs smoothly"
    _, _, piston, _ = simulate(plant, lambda t: (0, 0, -0.15), 3.0)
    assert piston[2500:, STICK].std() < 1e-3, "and so it does above the falling part"

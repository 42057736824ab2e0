"""The force regressor against inverse dynamics: MuJoCo's, and that of a body thrown by hand."""

import dataclasses

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects.effect import with_value
from hydrotele.hydraulics.laws import friction_force
from hydrotele.identify.identifiability import classify_parameters, reference_sizes
from hydrotele.identify.linear_least_squares import estimate_linear_parameters
from hydrotele.identify.regressor_setup import drive_friction_terms, machine_setup
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import FrictionTerm, make_regressor, passive_friction_terms
from hydrotele.simulate.closed_loops import independent_dofs, motion_basis
from hydrotele.simulate.plant import build_plant, rest_state

POSES = {
    "none": ((0.2, 0.45, -1.6), (-1.0, -0.5, -0.7), (2.0, 0.8, -2.5)),
    "bucket": ((0.2, 0.45, -1.6, -1.2), (-1.0, -0.4, -0.8, -2.0), (2.0, 0.8, -2.4, -0.2)),
}


def mujoco_forces(plant, pose, qd, qdd):
    """Forces that MuJoCo's own inverse dynamics of the open tree asks of the drives."""
    joints = [plant.machine.axes[name].joint for name in plant.axes]
    data = rest_state(plant, dict(zip(joints, pose, strict=True)))
    model, dofs = plant.model.__copy__(), independent_dofs(plant.machine, plant.model)
    for part in ("EQUALITY", "LIMIT", "CONTACT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    places = [list(plant.dof).index(dof) for dof in dofs]
    qd, qdd = np.array(qd)[places], np.array(qdd)[places]
    basis = motion_basis(plant.machine, model, data)
    tree, step, sides = mujoco.MjData(model), 1e-5, []
    for sign in (1, -1):  # [s]: truncation 1e-10 and cancellation 1e-11 of the basis' rate
        tree.qpos[:] = data.qpos
        mujoco.mj_integratePos(model, tree.qpos, basis @ qd, sign * step)
        sides.append(motion_basis(plant.machine, model, tree))
    tree.qpos[:], tree.qvel[:] = data.qpos, basis @ qd
    tree.qacc[:] = basis @ qdd + (sides[0] - sides[1]) / (2 * step) @ qd
    mujoco.mj_inverse(model, tree)
    moments = np.zeros((model.nu, model.nv))
    moments[np.arange(model.nu), model.jnt_dofadr[model.actuator_trnid[:, 0]]] = 1.0
    load, rows = basis.T @ tree.qfrc_inverse, moments @ basis
    return np.linalg.solve(rows.T, load), rows @ qd


def friction_of(machine, velocities):
    found = []
    for axis, velocity in zip(machine.hydraulic_axes.values(), velocities, strict=True):
        f = axis.drive.friction
        found.append(
            friction_force(velocity, f.coulomb, f.stribeck_extra, f.stribeck_velocity, f.viscous,
                     f.smoothing_velocity, f.coulomb_asymmetry, f.viscous_asymmetry)
        )  # fmt: skip
    return np.array(found)


def closed_chain(machine):
    plant = build_plant(machine)
    return dataclasses.replace(load_chain(plant.model), start=rest_state(plant).qpos.copy()), plant


def of_machine(machine, positions, rates, accelerations, **more):
    """Regressor of a machine with the friction of its drives."""
    chain, plant = closed_chain(machine)
    given = tuple(machine.axes[name].joint for name in plant.axes)
    found = project_on_drives(chain, given, positions, rates, accelerations)
    return make_regressor(chain, found, friction=drive_friction_terms(machine, chain), **more)


@pytest.mark.parametrize("tool", POSES)
def test_regressor_times_parameters_is_the_inverse_dynamics_of_mujoco(tool):
    machine = load_machine("cat215", tool)
    machine = with_value(machine, "axes.boom.cylinder.friction.coulomb_asymmetry", 0.3)
    machine = with_value(machine, "axes.stick.cylinder.friction.viscous_asymmetry", -0.2)
    plant, rng = build_plant(machine), np.random.default_rng(4)
    width = len(POSES[tool][0])
    rates, accelerations = rng.uniform(-0.8, 0.8, (3, width)), rng.uniform(-3, 3, (3, width))
    found = of_machine(machine, np.array(POSES[tool]), rates, accelerations)
    assert found.matrix.shape == (3, width, len(found.names))
    for k, pose in enumerate(POSES[tool]):
        forces, velocities = mujoco_forces(plant, pose, rates[k], accelerations[k])
        expected = forces + friction_of(machine, velocities)
        # MuJoCo's side knows the basis' rate to 1e-10 by differences; forces are 1e4 .. 1e5 N
        error = found.matrix[k] @ found.nominal - expected
        assert np.abs(error).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.nightly
def test_noise_free_forces_of_mujoco_tell_every_combination_exactly():
    """Complete model: forces by MuJoCo's inverse dynamics, not by our own regressor."""
    machine, rng, rows = load_machine("cat215"), np.random.default_rng(5), 120
    plant = build_plant(machine)
    low, high = np.array([-1.0, -0.4, -2.4]), np.array([1.0, 0.9, -0.7])
    poses, rates = rng.uniform(low, high, (rows, 3)), rng.uniform(-0.6, 0.6, (rows, 3))
    accelerations = rng.uniform(-2, 2, (rows, 3))
    found = of_machine(machine, poses, rates, accelerations)
    forces = []
    for pose, rate, acceleration in zip(poses, rates, accelerations, strict=True):
        force, velocities = mujoco_forces(plant, pose, rate, acceleration)
        forces.append(force + friction_of(machine, velocities))
    flat = found.matrix.reshape(-1, found.matrix.shape[2])
    told = classify_parameters(flat, found.names, found.units)
    assert len(told.base) > 40
    base = estimate_linear_parameters(found.matrix[:, :, told.base], np.array(forces), order=0)
    truth = told.combination @ found.nominal
    # relative to the body's own mass, radius and inertia: many of the true numbers are 0
    setup = machine_setup(machine, closed_chain(machine)[0])
    size = reference_sizes(found, setup, np.sqrt(np.mean(np.square(forces), axis=0)))[told.base]
    error = np.abs(base.value - truth)
    assert error.max() > 0.0 and np.all(error <= 1e-6 * np.maximum(np.abs(truth), size))


def test_columns_are_named_with_their_units_and_values():
    found = of_machine(load_machine("cat215"), *(np.zeros((2, 3)) + v for v in (0.3, 0.0, 0.0)))
    table = dict(zip(found.names, zip(found.units, found.nominal, strict=True), strict=True))
    # eight bodies; a motor; two cylinders with Stribeck friction; offsets
    assert len(found.names) == len(set(found.names)) == len(found.units) == 8 * 10 + 2 + 2 * 3 + 3
    assert table["mass.boom"] == ("kg", pytest.approx(1830.0))
    assert table["moment_x.boom"] == ("kg m", pytest.approx(1830 * 2.3))
    assert table["inertia_yy.boom"] == ("kg m^2", pytest.approx(5720 + 1830 * (2.3**2 + 0.2**2)))
    assert table["inertia_xz.boom"] == ("kg m^2", pytest.approx(-1830 * 2.3 * 0.2))
    assert table["moment_x.stick_rod"] == ("kg m", pytest.approx(-50.0))
    assert table["coulomb.swing"] == ("N m", 4000.0)
    assert table["viscous.stick_rod"] == ("N s/m", 4000.0)
    assert table["offset.boom_rod"] == ("N", 0.0)


def test_any_parameters_can_be_told_from_a_machine_that_has_them():
    """A machine with other masses: its own regressor's forces come from the first one's matrix."""
    first, rng = load_machine("cat215"), np.random.default_rng(0)
    other = with_value(with_value(first, "links.stick.mass", 900.0), "links.boom.com", (2.0, 0.1, 0.3))
    other = with_value(other, "axes.boom.cylinder.rod.mass", 170.0)
    motion = [rng.uniform(-0.5, 0.5, (20, 3)) + shift for shift in ((0, 0.3, -1.5), 0, 0)]
    one, two = of_machine(first, *motion), of_machine(other, *motion)
    assert np.abs(one.nominal - two.nominal).max() > 100
    np.testing.assert_allclose(one.matrix, two.matrix, atol=1e-9, rtol=1e-9)  # geometry only


def test_the_inertia_of_a_drive_is_a_column():
    machine = load_machine("cat215")
    motion = np.array([[0.0, 0.4, -1.5]]), np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]])
    found = of_machine(machine, *motion, drive_inertia=("swing",))
    column = found.matrix[0, :, found.names.index("drive_inertia.swing")]
    assert column == pytest.approx([2.0, 0.0, 0.0])


def test_a_plain_slide_needs_mass_times_acceleration_friction_and_offset():
    machine = load_machine("emps")
    rates, accelerations = np.array([[0.1], [-0.1]]), np.array([[2.0], [1.0]])
    found = of_machine(machine, np.zeros((2, 1)), rates, accelerations)
    (axis,), (link,) = machine.axes.values(), machine.links.values()
    f = axis.force.friction
    dry = f.coulomb * np.sign(rates) * (1 + f.coulomb_asymmetry * np.sign(rates))
    wet = f.viscous * rates * (1 + f.viscous_asymmetry * np.sign(rates))
    expected = link.mass * accelerations + dry + wet
    assert found.matrix @ found.nominal == pytest.approx(expected, rel=1e-9)
    offset = found.matrix[:, 0, found.names.index(f"offset.{axis.joint}")]
    assert np.array_equal(offset, [1.0, 1.0])


def test_friction_of_a_pin_resists_whichever_way_it_turns():
    """Its torque is carried to the cylinder by the angle that a metre of stroke turns the pin."""
    machine = load_machine("cat215")
    chain, _ = closed_chain(machine)
    pose = np.array([[0.0, 0.4, -1.5]])
    for sign in (1.0, -1.0):
        found = project_on_drives(chain, chain.joints[:3], pose, sign * np.array([[0, 0.2, 0]]), 0 * pose)
        table = make_regressor(chain, found, bodies=(), friction=passive_friction_terms(chain), offsets=False)
        boom_pin = table.matrix[0, :, table.names.index("coulomb.boom_pin")]
        speed = found.rate[0, chain.index("boom_rod")]
        assert boom_pin[1] == pytest.approx(found.closure_rate[0, 0] / speed)
        assert np.sign(boom_pin[1]) == np.sign(speed)
    assert set(table.names) == {
        f"coulomb.{p}" for p in
        ("boom", "stick", "boom_tube", "stick_tube", "boom_pin", "stick_pin")
    }  # fmt: skip


def test_refuses_what_it_cannot_tell():
    chain, _ = closed_chain(load_machine("cat215"))
    found = project_on_drives(chain, chain.joints[:3], *(np.zeros((1, 3)) + v for v in (0.3, 0.0, 0.0)))
    with pytest.raises(InputError, match="cat215 has no body bucket"):
        make_regressor(chain, found, bodies=("bucket",))
    with pytest.raises(InputError, match="friction has no sticky"):
        make_regressor(chain, found, friction=[FrictionTerm("boom", {"sticky": 0.0})])
    with pytest.raises(InputError, match="closure, which has no sides"):
        make_regressor(chain, found, friction=[FrictionTerm("boom_pin", {"viscous_asymmetry": 0.0})])
    grapple, plant = closed_chain(load_machine("cat215", "grapple"))
    given = tuple(plant.machine.axes[a].joint for a in plant.axes)
    with pytest.raises(InputError, match="closure: grapple_pitch, grapple_roll"):
        project_on_drives(grapple, given, *np.zeros((3, 2, len(given))))

"""Masses, geometry, tilt and friction change exactly the forces and places that they should."""

import math

import mujoco
import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.closed_loops import holding_forces, independent_dofs, motion_basis
from hydrotele.simulate.plant import build_plant, rest_state

G = 9.81


def at_rest(machine, joints=None):
    plant = build_plant(machine, ground=False)
    data = rest_state(plant, joints)
    mujoco.mj_forward(plant.model, data)
    return plant, data


def holding(machine, joints=None):
    """Axis -> force of its drive that holds the machine."""
    plant, data = at_rest(machine, joints)
    return dict(zip(plant.axes, holding_forces(machine, plant.model, data), strict=True))


def inertia(machine, joints=None):
    """Mass matrix of the independent joints, closed loops included."""
    plant, data = at_rest(machine, joints)
    full = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, data, full)
    basis = motion_basis(machine, plant.model, data)
    order = [list(independent_dofs(machine, plant.model)).index(d) for d in plant.dof]
    return (basis.T @ full @ basis)[np.ix_(order, order)]


def rates(machine, joints=None):
    """(n, n) drive velocity of each axis per rate of each axis' joint."""
    plant, data = at_rest(machine, joints)
    basis = motion_basis(machine, plant.model, data)
    order = [list(independent_dofs(machine, plant.model)).index(d) for d in plant.dof]
    return basis[plant.drive_dof][:, order]


@pytest.mark.parametrize("tool", ["none", "bucket"])
def test_payload_is_a_mass_welded_to_the_tip(tool):
    """Mass matrix of the loaded machine: that of the empty one plus `m J^T J` of the tip.

    1e-6 of the largest added entry: the radius of gyration of 1 mm that a body must have.
    """
    machine, mass = load_machine("cat215", tool), 1234.5
    loaded = apply_effect(machine, "payload", "tool", {"mass": mass})
    plant, data = at_rest(machine)
    full = np.zeros((plant.model.nv, plant.model.nv))
    jac = np.zeros((3, plant.model.nv))
    mujoco.mj_jacSite(plant.model, data, jac, None, plant.model.site("hydrotele_tip").id)
    mujoco.mj_fullM(plant.model, data, full)
    heavy, rest = at_rest(loaded)
    heavier = np.zeros_like(full)
    mujoco.mj_fullM(heavy.model, rest, heavier)
    added = mass * jac.T @ jac
    np.testing.assert_allclose(heavier - full, added, atol=1e-6 * added.max())


def test_payload_is_carried_by_the_chambers():
    """Extra force of the boom cylinder times its speed = weight times the tip's speed upwards."""
    machine, mass = load_machine("cat215", "none"), 250.0
    plant, data = at_rest(machine)
    loaded, heavy = at_rest(apply_effect(machine, "payload", "", {"mass": mass}))
    jac = np.zeros((3, plant.model.nv))
    mujoco.mj_jacSite(plant.model, data, jac, None, plant.model.site("hydrotele_tip").id)
    up = (jac @ motion_basis(machine, plant.model, data))[2]
    boom = plant.axes.index("boom")
    free = list(independent_dofs(machine, plant.model)).index(plant.dof[boom])
    cylinder = machine.axes["boom"].cylinder
    change = heavy.act - data.act
    force = cylinder.area_head * change[4 * boom + 2] - cylinder.area_rod * change[4 * boom + 3]
    speed = rates(machine)[boom, boom]
    assert force * speed == pytest.approx(mass * G * up[free], rel=1e-9)
    assert loaded.axes == plant.axes


def test_payloads_add_up_and_nothing_is_nothing():
    machine = load_machine("cat215")
    once = apply_effect(machine, "payload", "", {"mass": 500.0})
    first = apply_effect(machine, "payload", "", {"mass": 200.0})
    assert apply_effect(first, "payload", "", {"mass": 300.0}) == once
    assert apply_effect(machine, "payload", "", {"mass": 5e-324}) == machine


def test_tilt_turns_gravity():
    """Rolled by phi, the boom carries cos(phi) of its load and the swing m g r sin(phi)."""
    machine, roll = load_machine("cat215"), 0.15
    level = holding(machine)
    tilted = holding(apply_effect(machine, "base_tilt", "base", {"roll": roll, "pitch": 0.0}))
    for axis in ("boom", "stick"):
        assert tilted[axis] == pytest.approx(math.cos(roll) * level[axis], rel=1e-9)
    plant, data = at_rest(machine)
    model = plant.model
    moment = sum(model.body_mass[b] * data.xipos[b, 0] for b in range(1, model.nbody))
    assert tilted["swing"] == pytest.approx(G * math.sin(roll) * moment, rel=1e-9)
    assert level["swing"] == pytest.approx(0.0, abs=1e-6)


def test_a_nose_down_base_pulls_forwards():
    """Virtual work of every body's weight, taken along the tilted vertical."""
    machine, pitch = load_machine("ec20"), 0.1
    tilted = apply_effect(machine, "base_tilt", "", {"roll": 0.0, "pitch": pitch})
    down = np.array([math.sin(pitch), 0.0, -math.cos(pitch)])
    np.testing.assert_allclose(tilted.gravity, G * down, atol=1e-12)
    plant, data = at_rest(machine)
    basis = motion_basis(machine, plant.model, data)
    work, jac = np.zeros(basis.shape[1]), np.zeros((3, plant.model.nv))
    for body in range(1, plant.model.nbody):
        mujoco.mj_jacBodyCom(plant.model, data, jac, None, body)
        work -= plant.model.body_mass[body] * G * down @ jac @ basis
    force, speed = holding(tilted), rates(machine)
    order = [list(independent_dofs(machine, plant.model)).index(d) for d in plant.dof]
    held = np.array([force[a] for a in plant.axes]) @ speed
    np.testing.assert_allclose(held, work[order], rtol=1e-9)


def test_com_offset_and_inertia_error_change_what_the_joint_turns():
    machine = load_machine("cat215")
    boom, dx, dz = machine.links["boom"], 0.2, -0.1
    moved = apply_effect(machine, "com_offset", "boom", {"x": dx, "z": dz})
    angle = machine.home["boom"]
    lever = dx * math.cos(angle) - dz * math.sin(angle)  # how much farther out the weight hangs
    extra = (holding(moved)["boom"] - holding(machine)["boom"]) * rates(machine)[1, 1]
    assert extra == pytest.approx(boom.mass * G * lever, rel=1e-9)
    x, _, z = boom.com
    grown = boom.mass * ((x + dx) ** 2 + (z + dz) ** 2 - x**2 - z**2)
    assert (inertia(moved) - inertia(machine))[1, 1] == pytest.approx(grown, rel=1e-9)
    spun = apply_effect(machine, "inertia_error", "boom", {"ratio": 1.3})
    change = (inertia(spun) - inertia(machine))[1, 1]
    assert change == pytest.approx(0.3 * boom.inertia[1], rel=1e-9)


def test_a_longer_boom_carries_its_stick_farther_out():
    machine, length = load_machine("cat215"), 0.2
    longer = apply_effect(machine, "link_length", "boom", {"length": length})
    (plant, data), (other, moved) = at_rest(machine), at_rest(longer)
    way = np.array([math.cos(machine.home["boom"]), 0, math.sin(machine.home["boom"])])
    shift = moved.site("hydrotele_tip").xpos - data.site("hydrotele_tip").xpos
    np.testing.assert_allclose(shift, length * way, atol=1e-12)
    np.testing.assert_allclose(
        moved.qpos[other.rod_qpos[1:]], data.qpos[plant.rod_qpos[1:]], atol=1e-12
    )  # both cylinders keep their geometry
    x, y, z = machine.links["boom"].com
    assert longer.links["boom"].com == pytest.approx((x * (1 + length / 5.18), y, z))
    assert longer.links["boom"].mass == machine.links["boom"].mass


def test_a_longer_stick_takes_its_linkage_and_load_along():
    machine = load_machine("cat215", "bucket")
    longer = apply_effect(machine, "link_length", "stick", {"length": 0.1})
    (plant, data), (other, moved) = at_rest(machine), at_rest(longer)
    np.testing.assert_allclose(moved.qpos[other.rod_qpos[1:]], data.qpos[plant.rod_qpos[1:]], atol=1e-9)
    loaded = apply_effect(load_machine("cat215"), "payload", "", {"mass": 100.0})
    loaded = apply_effect(loaded, "link_length", "stick", {"length": 0.1})
    assert loaded.links["payload"].position == loaded.arm.tip.position == pytest.approx((1.9, 0, 0))


def test_pin_offset_moves_the_base_pin():
    machine, (dx, dz) = load_machine("cat215"), (0.02, -0.01)
    moved = apply_effect(machine, "pin_offset", "boom", {"x": dx, "z": dz})
    (_, data), (other, shifted) = at_rest(machine), at_rest(moved)
    rod, base = data.site("hydrotele_boom_pin_b").xpos, data.body("boom_tube").xpos
    length = np.linalg.norm(rod - base - np.array([dx, 0, dz]))
    x = shifted.qpos[other.rod_qpos[1]]
    assert x == pytest.approx(length - machine.axes["boom"].cylinder.closed_length, abs=1e-9)


def friction_at(machine, axis, speed):
    """Force that friction takes from a drive at a speed of it."""
    plant = build_plant(machine, ground=False)
    data, i = rest_state(plant), plant.axes.index(axis)
    plant.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    forces = []
    for v in (0.0, speed):
        data.qvel[:] = 0.0
        data.qvel[plant.drive_dof[i]] = v
        mujoco.mj_fwdPosition(plant.model, data)
        mujoco.mj_fwdVelocity(plant.model, data)
        data.ctrl[:] = 0.0
        mujoco.mj_fwdActuation(plant.model, data)
        chambers = 0.0
        if i < plant.hydraulic:
            head, rod = machine.axes[axis].hydraulic_drive.effective_areas
            p = data.act + plant.model.opt.timestep * data.act_dot
            chambers = head * p[4 * i + 2] - rod * p[4 * i + 3]
        forces.append(data.actuator_force[i] - chambers)
    return forces[0] - forces[1]


@pytest.mark.daily("cat215-stick")
@pytest.mark.parametrize(("name", "axis"), [("cat215", "swing"), ("cat215", "stick"),
                                            ("emps", "slide"), ("rig", "slide")])  # fmt: skip
def test_friction_is_that_of_the_law(name, axis):
    machine, v = load_machine(name), 0.3
    plain = friction_at(machine, axis, v)
    present = machine.axes[axis].drive.friction
    more = apply_effect(machine, "coulomb_friction", axis, {"coulomb": 1.5 * present.coulomb})
    assert friction_at(more, axis, v) - plain == pytest.approx(0.5 * present.coulomb, rel=1e-6)
    thick = apply_effect(machine, "viscous_friction", axis, {"viscous": 1.5 * present.viscous})
    assert friction_at(thick, axis, v) - plain == pytest.approx(0.5 * present.viscous * v, rel=1e-6)
    extra = present.stribeck_extra + 10.0
    stuck = apply_effect(machine, "stribeck_friction", axis, {"stribeck_extra": extra})
    slow = present.stribeck_velocity
    change = friction_at(stuck, axis, slow) - friction_at(machine, axis, slow)
    wanted = 10.0 * math.exp(-1) * math.tanh(slow / present.smoothing_velocity)
    assert change == pytest.approx(wanted, rel=1e-6)
    given = {"coulomb_asymmetry": 0.2, "viscous_asymmetry": -0.1}
    uneven = apply_effect(machine, "friction_asymmetry", axis, given)
    dry, wet = present.coulomb, present.viscous * v
    assert friction_at(uneven, axis, v) == pytest.approx(1.2 * dry + 0.9 * wet, rel=1e-6)
    assert friction_at(uneven, axis, -v) == pytest.approx(-0.8 * dry - 1.1 * wet, rel=1e-6)


def test_units_follow_the_drive():
    from hydrotele.effects import EFFECTS

    machine, emps = load_machine("cat215"), load_machine("emps")
    units = {
        ("viscous_friction", "swing"): ["N m s/rad"], ("viscous_friction", "boom"): ["N s/m"],
        ("coulomb_friction", "swing"): ["N m"], ("coulomb_friction", "boom"): ["N"],
        ("joint_flexibility", "swing"): ["rad/(N m)", "kg m^2", "1"],
        ("joint_flexibility", "boom"): ["m/N", "kg", "1"],
        ("angle_offset", "boom"): ["rad"],
    }  # fmt: skip
    for (name, place), expected in units.items():
        assert [p.unit for p in EFFECTS[name].parameters(machine, place).values()] == expected
    assert EFFECTS["coulomb_friction"].parameters(emps, "slide")["coulomb"].unit == "N"
    assert EFFECTS["angle_offset"].parameters(emps, "slide")["offset"].unit == "m"

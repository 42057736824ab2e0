"""Mass matrix and bias forces are those of MuJoCo and of Pinocchio, which know other methods."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from hydrotele.estimate.reduced_model import place
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.reduced_dynamics import BIAS, DRIFT, RATE, Q, compute_mass_and_bias
from hydrotele.multibody.reduced_mechanism import INERTIA, MASS, coordinate_names
from hydrotele.simulate.closed_loops import independent_dofs, load_closed_chain, motion_basis
from hydrotele.simulate.plant import build_plant, rest_state

MACHINES = ("cat215/none", "cat215/bucket", "cat215/grapple", "cat325", "ec20", "rig", "emps")
DIFFERENCE = 1e-5  # [s] of central differences: truncation 1e-10, cancellation 1e-11


def reduced_forces(model, space, z):
    """(mass matrix, bias forces) in independent coordinates."""
    place(model, space, z)
    compute_mass_and_bias(model.mech, space.motion)
    m = space.motion
    bias = m.joint[BIAS] + m.mass @ m.joint[DRIFT]
    return m.basis.T @ m.mass @ m.basis, m.basis.T @ bias


def mujoco_forces(machine, model, z):
    """The same from MuJoCo's open tree, with the closures' basis of `simulate.closed_loops`."""
    plant, names = build_plant(machine, ground=False), coordinate_names(machine)
    free = [names[i] for i in model.mech.independent]
    n, own = len(free), plant.model
    dofs = independent_dofs(machine, own)
    order = [free.index(own.joint(own.dof_jntid[dof]).name) for dof in dofs]
    rates = z[n : 2 * n][order]

    def basis_at(time):
        positions = dict(zip(free, z[:n] + time * z[n : 2 * n], strict=True))
        data = rest_state(plant, positions)
        return data, motion_basis(machine, own, data)

    data, basis = basis_at(0.0)
    slope = (basis_at(DIFFERENCE)[1] - basis_at(-DIFFERENCE)[1]) / (2 * DIFFERENCE)
    data.qvel[:] = basis @ rates
    mujoco.mj_forward(own, data)
    full = np.zeros((own.nv, own.nv))
    mujoco.mj_fullM(own, data, full)
    back = np.argsort(order)
    bias = basis.T @ (data.qfrc_bias + full @ (slope @ rates))
    return (basis.T @ full @ basis)[np.ix_(back, back)], bias[back]


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("seed", range(4))
def test_mass_matrix_and_bias_are_those_of_mujoco(name, seed, machine_of, reduced_of, move_at_random):
    machine = machine_of(name)
    model, space, z = reduced_of(machine)
    move_at_random(model, z, seed)
    mass, bias = reduced_forces(model, space, z)
    expected_mass, expected_bias = mujoco_forces(machine, model, z)
    # loops are closed to 1e-12 m on both sides, links are some m long
    np.testing.assert_allclose(mass, expected_mass, rtol=0, atol=1e-11 * np.abs(mass).max())
    # MuJoCo's side knows the rate of the basis by differences only
    largest = max(np.abs(expected_bias).max(), np.abs(mass).max())
    np.testing.assert_allclose(bias, expected_bias, rtol=0, atol=1e-8 * largest)


@pytest.mark.parametrize("name", MACHINES)
def test_reduced_coordinates_and_the_chain_ask_for_the_same_forces(name, machine_of, reduced_of, move_at_random):
    """The two implementations of a closed chain, `reduced_mechanism` and `inverse_dynamics`."""
    machine = machine_of(name)
    model, space, z = reduced_of(machine)
    names = coordinate_names(machine)
    free = tuple(names[i] for i in model.mech.independent)
    n, rng = len(free), np.random.default_rng(5)
    move_at_random(model, z, 5)
    rates, accelerations = z[n : 2 * n], rng.uniform(-1.0, 1.0, n)
    mass, bias = reduced_forces(model, space, z)
    chain = load_closed_chain(machine, dict(zip(free, z[:n], strict=True)))
    found = project_on_drives(chain, free, z[None, :n], rates[None], accelerations[None], drives=free)
    for k, joint in enumerate(names):
        j, m = chain.index(joint), space.motion.joint
        assert found.position[0, j] == pytest.approx(m[Q, k], abs=1e-9)
        assert found.rate[0, j] == pytest.approx(m[RATE, k], abs=1e-9)
        moved = m[DRIFT, k] + space.motion.basis[k] @ accelerations
        assert found.acceleration[0, j] == pytest.approx(moved, abs=1e-8)
    expected = found.body_projection[0] @ chain.inertia.ravel()
    largest = max(np.abs(expected).max(), np.abs(mass).max())
    # loops are closed to 1e-11 m and 1e-12 m
    np.testing.assert_allclose(mass @ accelerations + bias, expected, atol=1e-9 * largest)


def spanning_tree(machine):
    """Links of a machine in Pinocchio, without cylinders and closures; joints as in the tree."""
    model, places = pin.Model(), {"world": (0, pin.SE3.Identity())}
    model.gravity.linear = np.array(machine.gravity)
    while len(places) <= len(machine.links):
        for name, link in machine.links.items():
            if name in places or link.parent not in places:
                continue
            parent, frame = places[link.parent]
            frame = frame * pin.SE3(np.eye(3), np.array(link.position, float))
            if link.joint:
                kinds = {
                    "hinge": pin.JointModelRevoluteUnaligned,
                    "slide": pin.JointModelPrismaticUnaligned,
                }
                kind = kinds[link.joint.type](np.array(link.joint.axis, float))
                parent = model.addJoint(parent, kind, frame, link.joint.name)
                frame = pin.SE3.Identity()
            body = pin.Inertia(link.mass, np.array(link.com, float), np.diag(link.inertia))
            model.appendBodyToJoint(parent, body, frame)
            places[name] = parent, frame
    return model


@pytest.mark.parametrize("name", MACHINES)
def test_spanning_tree_is_that_of_pinocchio(name, machine_of, reduced_of, move_at_random):
    machine = machine_of(name)
    model, space, z = reduced_of(machine)
    move_at_random(model, z, 7)
    shape = model.mech.shape.copy()
    shape[1 + model.mech.link_count :, INERTIA : INERTIA + 3] = 0.0
    shape[1 + model.mech.link_count :, MASS] = 0.0  # cylinders without mass
    place(model, space, z)
    compute_mass_and_bias(model.mech._replace(shape=shape), space.motion)
    tree = spanning_tree(machine)
    data, joint = tree.createData(), space.motion.joint
    order = [list(tree.names)[1:].index(name) for name in coordinate_names(machine)]
    q, rates = np.zeros(tree.nq), np.zeros(tree.nv)
    q[order], rates[order] = joint[Q], joint[RATE]
    mass = pin.crba(tree, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    bias = pin.nonLinearEffects(tree, data, q, rates)
    expected = mass[np.ix_(order, order)]
    # two exact methods: rounding of some hundred operations
    assert np.abs(space.motion.mass - expected).max() < 1e-12 * np.abs(mass).max()
    assert np.abs(joint[BIAS] - bias[order]).max() < 1e-12 * max(np.abs(bias).max(), mass.max())

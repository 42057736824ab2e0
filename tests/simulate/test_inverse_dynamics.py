"""Closed-chain dynamics three ways: MuJoCo's tree, its constraint solver, and Pinocchio."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from hydrotele.simulate.closed_loops import independent_dofs, motion_basis
from hydrotele.simulate.plant import rest_state

POSES = {
    "none": ((0.2, 0.45, -1.6), (-1.0, -0.5, -0.7), (2.0, 0.8, -2.5)),
    "bucket": ((0.2, 0.45, -1.6, -1.2), (-1.0, -0.4, -0.8, -2.0), (2.0, 0.8, -2.4, -0.2)),
}
CASES = [(tool, pose) for tool, poses in POSES.items() for pose in poses]


def cylinder_forces(plant, data, qdd):
    """Actuator forces for independent accelerations, from `mj_inverse` on the open tree.

    `F^T (moment N) = (N^T tau)^T` with `tau` of the tree whose pins are taken out.
    """
    model, dofs = plant.model.__copy__(), independent_dofs(plant.machine, plant.model)
    for part in ("EQUALITY", "LIMIT", "CONTACT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    tree, basis = mujoco.MjData(model), motion_basis(plant.machine, model, data)
    step = 1e-5  # s: central difference, truncation 1e-10 and cancellation 1e-11 of N' qd
    sides = []
    for sign in (1, -1):
        tree.qpos[:] = data.qpos
        mujoco.mj_integratePos(model, tree.qpos, data.qvel, sign * step)
        sides.append(motion_basis(plant.machine, model, tree))
    qd = data.qvel[dofs]
    tree.qpos[:], tree.qvel[:] = data.qpos, basis @ qd
    tree.qacc[:] = basis @ qdd + (sides[0] - sides[1]) / (2 * step) @ qd
    mujoco.mj_inverse(model, tree)
    load = basis.T @ tree.qfrc_inverse
    return np.linalg.solve((moments(plant, data) @ basis).T, load)


def moments(plant, data):
    """Actuator moments (nu, nv): rods and motors act straight on their joints."""
    table = np.zeros((plant.model.nu, plant.model.nv))
    for i, joint in enumerate(plant.model.actuator_trnid[:, 0]):
        table[i, plant.model.jnt_dofadr[joint]] = 1.0
    return table


def moving(plant, pose, qd):
    names = [plant.machine.axes[n].joint for n in plant.axes]
    data = rest_state(plant, dict(zip(names, pose, strict=True)))
    dofs = independent_dofs(plant.machine, plant.model)
    assert list(dofs) == sorted(plant.dof), "driven and independent joints are the same"
    data.qvel[:] = motion_basis(plant.machine, plant.model, data) @ qd
    return data


class Tree:
    """The same machine in Pinocchio, built from the Machine alone: spanning tree and its pins."""

    def __init__(self, machine):
        self.model, self.at, self.pins = pin.Model(), {"world": (0, pin.SE3.Identity())}, []
        self.model.gravity.linear = np.array(machine.gravity)
        waiting = dict(machine.links)
        while waiting:
            name = next(n for n, link in waiting.items() if link.parent in self.at)
            link = waiting.pop(name)
            self._add(name, link.parent, link.position, link.joint, link)
        for name, axis in machine.axes.items():
            if not (cylinder := axis.cylinder):
                continue
            base, tube, rod = cylinder.base_pin, cylinder.tube, cylinder.rod
            at_tube = self._joint(f"{name}_tube", base.link, base.position, (0, -1, 0), "hinge")
            self._mass(at_tube, tube.mass, (tube.com, 0, 0), tube.inertia)
            out = (cylinder.closed_length, 0, 0)
            at_rod = self._joint(f"{name}_rod", f"{name}_tube", out, (1, 0, 0), "slide")
            self._mass(at_rod, rod.mass, (-rod.com, 0, 0), rod.inertia)
            self._pin((f"{name}_rod", (0, 0, 0)), (cylinder.rod_pin.link, cylinder.rod_pin.position))
        for closure in machine.closures.values():
            self._pin(*((end.link, end.position) for end in (closure.a, closure.b)))
        self.data = self.model.createData()

    def _add(self, name, parent, position, joint, link):
        if joint is None:
            at, frame = self.at[parent]
            self.at[name] = (at, frame * pin.SE3(np.eye(3), np.array(position)))
            where = self.at[name]
        else:
            where = self._joint(name, parent, position, joint.axis, joint.type, joint.name)
        self._mass(where, link.mass, link.com, link.inertia)

    def _joint(self, name, parent, position, axis, kind, joint=None):
        at, frame = self.at[parent]
        hinge, slide = pin.JointModelRevoluteUnaligned, pin.JointModelPrismaticUnaligned
        model = (hinge if kind == "hinge" else slide)(np.array(axis, float))
        place = frame * pin.SE3(np.eye(3), np.array(position, float))
        index = self.model.addJoint(at, model, place, joint or name)
        self.at[name] = (index, pin.SE3.Identity())
        return self.at[name]

    def _mass(self, where, mass, com, inertia):
        body = pin.Inertia(mass, np.array(com, float), np.diag(inertia))
        self.model.appendBodyToJoint(where[0], body, where[1])

    def _pin(self, *ends):
        frames = []
        for link, position in ends:
            at, frame = self.at[link]
            place = frame * pin.SE3(np.eye(3), np.array(position, float))
            name = f"pin{self.model.nframes}"
            frames.append(self.model.addFrame(pin.Frame(name, at, place, pin.FrameType.OP_FRAME)))
        self.pins.append(frames)

    def order(self, model):
        """Places in MuJoCo's qvel of Pinocchio's joints."""
        return [model.joint(name).dofadr[0] for name in list(self.model.names)[1:]]

    def actuator_forces(self, q, qd, qdd, free, driven):
        """Virtual work on the spanning tree with the pins as exact constraints.

        `free`: independent joints, `driven`: joints with a drive; (forces, pin gap, pin speed).
        """
        model, data, world = self.model, self.data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        tied = np.setdiff1d(np.arange(model.nv), free)
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, qd, np.zeros(model.nv))
        pin.updateFramePlacements(model, data)
        gap, jacobian, drift = [], [], []
        for a, b in self.pins:
            gap.append(data.oMf[a].translation - data.oMf[b].translation)
            ja, jb = (pin.getFrameJacobian(model, data, f, world)[:3] for f in (a, b))
            jacobian.append(ja - jb)
            # at zero joint acceleration: the centripetal part
            da, db = (pin.getFrameClassicalAcceleration(model, data, f, world) for f in (a, b))
            drift.append(da.linear - db.linear)
        gap, jacobian, drift = np.concatenate(gap), np.concatenate(jacobian), np.concatenate(drift)
        basis, acceleration = np.zeros((model.nv, len(free))), np.zeros(model.nv)
        basis[free] = np.eye(len(free))
        basis[tied] = -np.linalg.lstsq(jacobian[:, tied], jacobian[:, free], rcond=1e-10)[0]
        acceleration[free] = qdd
        rest = drift + jacobian[:, free] @ qdd
        acceleration[tied] = -np.linalg.lstsq(jacobian[:, tied], rest, rcond=1e-10)[0]
        torque = pin.rnea(model, data, q, qd, acceleration)
        forces = np.linalg.solve(basis[driven].T, basis.T @ torque)
        return forces, np.abs(gap).max(), np.abs(jacobian @ qd).max()


def random_motion(seed, n):
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.8, 0.8, n), rng.uniform(-3.0, 3.0, n)


@pytest.mark.parametrize(("tool", "pose"), CASES)
def test_tree_and_pinocchio_give_the_same_cylinder_forces(plant_of, tool, pose):
    plant = plant_of(tool)
    qd, qdd = random_motion(1, len(pose))
    data = moving(plant, pose, qd)
    tree = Tree(plant.machine)
    order = tree.order(plant.model)
    free = [order.index(dof) for dof in independent_dofs(plant.machine, plant.model)]
    driven = [order.index(np.flatnonzero(row)[0]) for row in moments(plant, data)]
    forces, gap, speed = tree.actuator_forces(data.qpos[order], data.qvel[order], qdd, free, driven)
    assert gap < 1e-11, "both see the same closed loops"  # [m], closed to 1e-12 by MuJoCo
    assert speed < 1e-11  # [m/s]
    # N' by central differences is known to 1e-10 (see cylinder_forces); forces are 1e4 .. 1e5 N
    expected = cylinder_forces(plant, data, qdd)
    assert np.abs(forces - expected).max() < 1e-8 * np.abs(forces).max()
    assert np.abs(forces).max() > 1e4


@pytest.mark.parametrize(("tool", "pose"), CASES)
def test_constraint_solver_gives_the_acceleration_of_those_forces(plant_of, tool, pose):
    plant = plant_of(tool)
    qdd = random_motion(2, len(pose))[1]
    data, model = moving(plant, pose, np.zeros(len(pose))), plant.model.__copy__()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    forces, errors = cylinder_forces(plant, data, qdd), []
    for impedance in (0.999, 0.9999):
        model.eq_solimp[:, :2] = impedance
        data.qfrc_applied[:] = forces @ moments(plant, data)
        mujoco.mj_forward(model, data)
        assert data.nefc == 3 * model.neq
        found = cylinder_forces(plant, data, data.qacc[independent_dofs(plant.machine, model)])
        errors.append(np.abs(found - forces).max() / np.abs(forces).max())
    # pins of impedance d leave 1 - d of what they must carry undone; nothing else is left, as the
    # proportion shows (at rest: the solver has no centripetal terms of the pins, see below)
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(10, rel=0.01)


@pytest.mark.daily("bucket")
@pytest.mark.parametrize("tool", POSES)
def test_forces_that_moved_the_machine_are_found_from_its_motion(plant_of, tool):
    deviations = [motion_deviation(plant_of(tool, dt), POSES[tool][0]) for dt in (1e-3, 5e-4)]
    # The solver knows the pins' centripetal accelerations only through their opening (some um),
    # with a lag of two steps: an error of first order.
    assert deviations[0] < 1e-5
    assert 0.4 < deviations[1] / deviations[0] < 0.6


def motion_deviation(plant, pose):
    """Largest relative difference of applied forces and those computed back from the motion."""
    data = moving(plant, pose, random_motion(3, len(pose))[0])
    model, dofs = plant.model.__copy__(), independent_dofs(plant.machine, plant.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    timestep, worst = model.opt.timestep, 0.0
    held, now = cylinder_forces(plant, data, np.zeros(len(pose))), mujoco.MjData(model)
    for k in range(round(0.3 / timestep)):
        forces = held * (1 + 0.2 * np.sin(10 * k * timestep + np.arange(len(pose))))
        data.qfrc_applied[:] = forces @ moments(plant, data)
        now.qpos[:], now.qvel[:] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
        if k * timestep > 0.05 and k % 10 == 0:  # the pins have taken up their load
            qdd = (data.qvel[dofs] - now.qvel[dofs]) / timestep
            error = cylinder_forces(plant, now, qdd) - forces
            worst = max(worst, np.abs(error).max() / np.abs(held).max())
    return worst

"""Closed forms of a machine file against MuJoCo's kinematics of the plant built from it."""

import functools
import math

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import forward_kinematics, inverse_kinematics, jacobian
from hydrotele.kinematics.arm_dimensions import arm_geometry
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine_file import load_machine, shipped_machines
from hydrotele.simulate.closed_loops import independent_dofs, motion_basis
from hydrotele.simulate.plant import build_plant, rest_state

MACHINES = {
    f"{name}-{tool}": load_machine(name, tool) for name in shipped_machines() for tool in load_machine(name).tools
}
# A tool adds the joints of the tool only: daily each machine with one tool, and the CAT 215, whose
# bucket hangs on a four-bar, with two.
DAILY = {next(n for n in MACHINES if n.startswith(f"{name}-")) for name in shipped_machines()}
DAILY |= {"cat215-none", "cat215-bucket"}


def nightly_unless_daily(name, *more):
    """A test case of a machine."""
    return pytest.param(name, *more, marks=[] if name in DAILY else pytest.mark.nightly)


DRIVES = [nightly_unless_daily(n, axis) for n, machine in MACHINES.items() for axis in machine.axes]
ARMS = [nightly_unless_daily(n) for n, m in MACHINES.items() if m.arm and not m.arm.head]


@functools.cache
def plant_of(name):
    """The plant of a machine in `MACHINES`."""
    return build_plant(MACHINES[name], ground=False)


@functools.cache
def poses(name, axis, count=9):
    """(joint position, assembled data) over the part of a joint's range that its stroke allows."""
    plant, found = plant_of(name), []
    facts, linkage = plant.machine.axes[axis], axis_linkage(plant.machine, axis)
    low, high = plant.machine.joints[facts.joint].range or (-math.pi, math.pi)
    for q in np.linspace(low, high, count + 2)[1:-1]:
        if facts.cylinder:
            x = linkage.length(q) - facts.cylinder.closed_length
            if not 0.0 <= x <= facts.cylinder.stroke:
                continue
        found.append((float(q), rest_state(plant, {facts.joint: float(q)})))
    return found


@pytest.mark.parametrize(("name", "axis"), DRIVES)
def test_length_is_the_distance_of_the_pins(name, axis):
    """1e-9 m: loops are closed to 1e-12 m, arms of a four-bar multiply that."""
    plant = plant_of(name)
    linkage, cylinder = axis_linkage(plant.machine, axis), plant.machine.axes[axis].cylinder
    seen = 0
    for q, data in poses(name, axis):
        mujoco.mj_forward(plant.model, data)
        if cylinder:
            way = data.site(f"hydrotele_{axis}_pin_b").xpos - data.body(f"{axis}_tube").xpos
            assert linkage.length(q) == pytest.approx(np.linalg.norm(way), abs=1e-9)
            x = data.joint(f"{axis}_rod").qpos[0]
            assert linkage.length(q) - cylinder.closed_length == pytest.approx(x, abs=1e-9)
        else:
            assert linkage.length(q) == q
        seen += 1
    assert seen >= 5  # most of the range can be reached


@pytest.mark.parametrize(("name", "axis"), DRIVES)
def test_rate_is_the_velocity_ratio(name, axis):
    """Against MuJoCo's constraint Jacobians (1e-9) and central differences (1e-6, h^2 of 1e-4)."""
    plant = plant_of(name)
    linkage, joint = axis_linkage(plant.machine, axis), plant.machine.axes[axis].joint
    for q, data in poses(name, axis):
        numeric = (linkage.length(q + 1e-4) - linkage.length(q - 1e-4)) / 2e-4
        assert linkage.rate(q) == pytest.approx(numeric, abs=1e-6)
        if plant.machine.axes[axis].cylinder is None:
            continue
        basis = motion_basis(plant.machine, plant.model, data)
        column = independent_dofs(plant.machine, plant.model).tolist()
        column = column.index(plant.model.joint(joint).dofadr[0])
        ratio = basis[plant.model.joint(f"{axis}_rod").dofadr[0], column]
        assert linkage.rate(q) == pytest.approx(ratio, abs=1e-9)


@pytest.mark.parametrize(("name", "axis"), DRIVES)
def test_angle_takes_length_back(name, axis):
    """1e-10 where the linkage is not near its dead centre, as the project asks."""
    plant = plant_of(name)
    linkage = axis_linkage(plant.machine, axis)
    for q, _ in poses(name, axis):
        if abs(linkage.rate(q)) > 0.05:
            assert linkage.angle(linkage.length(q)) == pytest.approx(q, abs=1e-10)


@pytest.mark.parametrize(("name", "axis"), DRIVES)
def test_linkage_takes_arrays(name, axis):
    plant = plant_of(name)
    linkage = axis_linkage(plant.machine, axis)
    q = np.array([p for p, _ in poses(name, axis)])
    for law in (linkage.length, linkage.rate):
        assert np.array_equal(law(q), [law(float(v)) for v in q])


@functools.cache
def arm_samples(name, count=15):
    """Seeded joint positions of the arm, inside its ranges, that assemble."""
    plant, found = plant_of(name), []
    machine, rng = plant.machine, np.random.default_rng(5)
    arm = machine.arm
    names = [j for j in (arm.swing, arm.boom, arm.stick, arm.tool) if j]
    for _ in range(count):
        q = [float(rng.uniform(*(machine.joints[n].range or (-3, 3)))) for n in names]
        try:
            found.append((names, q, rest_state(plant, dict(zip(names, q, strict=True)))))
        except InputError:  # beyond a stroke
            continue
    return found


@pytest.mark.parametrize("name", ARMS)
def test_arm_puts_the_tip_where_mujoco_does(name):
    """1e-10 m: rounding of some ten sines on 10 m."""
    plant, seen = plant_of(name), 0
    geometry = arm_geometry(plant.machine)
    for _, q, data in arm_samples(name):
        mujoco.mj_kinematics(plant.model, data)
        x, y, z = data.site("hydrotele_tip").xpos
        pose = forward_kinematics(geometry, q)
        assert pose[0] == pytest.approx(math.hypot(x, y), abs=1e-10)
        assert math.remainder(pose[1] - math.atan2(y, x), math.tau) == pytest.approx(0, abs=1e-10)
        assert pose[2] == pytest.approx(z, abs=1e-10)
        if geometry.has_tool_joint:
            along = data.site("hydrotele_tip").xmat.reshape(3, 3)[:, 0]
            assert math.sin(pose[3]) == pytest.approx(along[2], abs=1e-10)
        back = inverse_kinematics(geometry, pose)
        turn = math.remainder(back[0] - q[0], math.tau)
        np.testing.assert_allclose([turn, *np.subtract(back, q)[1:]], 0, atol=1e-7)
        seen += 1
    assert seen > 5


@pytest.mark.parametrize("name", ARMS)
def test_arm_jacobian_is_mujocos(name):
    """Tip velocity along r, around, up, against mj_jacSite; 1e-9 of metres."""
    plant = plant_of(name)
    geometry, model = arm_geometry(plant.machine), plant.model
    for names, q, data in arm_samples(name):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jac = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jac, None, model.site("hydrotele_tip").id)
        jac = jac[:, [model.joint(n).dofadr[0] for n in names]]
        x, y, _ = data.site("hydrotele_tip").xpos
        r = math.hypot(x, y)
        rows = [(x * jac[0] + y * jac[1]) / r, (x * jac[1] - y * jac[0]) / r**2, jac[2]]
        np.testing.assert_allclose(np.array(jacobian(geometry, q))[:3], rows, atol=1e-9)


def test_machines_without_an_arm_say_so():
    with pytest.raises(InputError, match="has no arm: give arm.swing"):
        arm_geometry(load_machine("rig"))


def test_cylinder_on_the_wrong_links_says_so():
    machine = load_machine("cat215")
    boom = machine.axes["boom"]
    pin = boom.cylinder.rod_pin.model_copy(update={"link": "stick"})
    cylinder = boom.cylinder.model_copy(update={"rod_pin": pin})
    axes = machine.axes | {"boom": boom.model_copy(update={"cylinder": cylinder})}
    with pytest.raises(InputError, match="axes.boom.cylinder: pins must be on swing and boom"):
        axis_linkage(machine.model_copy(update={"axes": axes}), "boom")

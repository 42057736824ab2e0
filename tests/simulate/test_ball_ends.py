"""Cylinders whose pins lie in no common plane end in ball joints (Khoshzaban 1992, p. 43)."""

import mujoco
import numpy as np
import pytest

from hydrotele.effects.effect import with_value
from hydrotele.kinematics.drive_linkage import axis_linkage, has_ball_ends
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.reduced_mechanism import make_reduced_mechanism
from hydrotele.simulate.closed_loops import close_loops, compute_loop_closure_error, holding_forces
from hydrotele.simulate.mechanism import compile_mechanism, tilt_joint_name

TILT = np.radians(1.0)


@pytest.fixture(scope="module")
def tilted():
    """The excavator with a boom joint whose axis is one degree off the cylinder's pins."""
    axis = (float(np.sin(TILT)), -float(np.cos(TILT)), 0.0)
    return with_value(load_machine("cat215", "none"), "links.boom.joint.axis", axis)


@pytest.fixture(scope="module")
def placed(tilted):
    model = compile_mechanism(tilted, ground=False, visuals=False)
    return model, mujoco.MjData(model)


def test_only_the_cylinder_of_the_tilted_joint_has_ball_ends(tilted, placed):
    assert [name for name in ("boom", "stick") if has_ball_ends(tilted, name)] == ["boom"]
    joints = [placed[0].joint(k).name for k in range(placed[0].njnt)]
    assert tilt_joint_name("boom") in joints and tilt_joint_name("stick") not in joints


@pytest.mark.parametrize("angle", [-0.3, 0.2, 0.7])
def test_length_is_that_of_the_closed_chain(tilted, placed, angle):
    """The loop closes to rounding, with the pin-to-pin length of the spatial triangle."""
    model, data = placed
    close_loops(tilted, model, data, {"boom": angle})
    assert compute_loop_closure_error(model, data) < 1e-9
    linkage, cylinder = axis_linkage(tilted, "boom"), tilted.axes["boom"].cylinder
    rod = data.qpos[model.joint("boom_rod").qposadr[0]]
    assert rod + cylinder.closed_length == pytest.approx(linkage.length(angle), abs=1e-9)
    assert linkage.angle(linkage.length(angle)) == pytest.approx(angle, abs=1e-9)
    step = 1e-6
    slope = (linkage.length(angle + step) - linkage.length(angle - step)) / (2 * step)
    assert linkage.rate(angle) == pytest.approx(slope, rel=1e-8)  # rounding of the difference


def test_holding_force_follows_from_virtual_work(tilted, placed):
    """Force times moment arm is the slope of the potential energy, in which the tilt counts."""
    model, data = placed

    def energy(angle):
        close_loops(tilted, model, data, {"boom": angle})
        mujoco.mj_energyPos(model, data)
        return data.energy[0]

    step = 1e-4
    slope = (energy(0.3 + step) - energy(0.3 - step)) / (2 * step)
    close_loops(tilted, model, data, {"boom": 0.3})
    mujoco.mj_forward(model, data)
    force = holding_forces(tilted, model, data)[model.actuator("boom").id]
    # 1e-6: truncation of the difference, step^2
    assert force * axis_linkage(tilted, "boom").rate(0.3) == pytest.approx(slope, rel=1e-6)


def test_reduced_model_has_the_same_tables(tilted):
    """The reduced model takes the length from the pins in space and needs no further joint."""
    assert (
        make_reduced_mechanism(tilted).tree.shape == make_reduced_mechanism(load_machine("cat215", "none")).tree.shape
    )

"""Stiffness and damping of end stops, written into the joint limits of a compiled machine.

A limit of MuJoCo is a soft constraint whose force solves `(A + R) f = a_ref - a_0` with the inverse
inertia A felt there. With `R = 1 / (h b)`, `a_ref = -v / h - k r / (h b)` and `b = c + h k` that is
`f = -k r' - c v'` with depth r' and velocity v' at the end of the step h: a spring k and a damper c
by the implicit Euler rule, stable however light the load and stiff the stop.
"""

import mujoco
import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.simulate.drive_side import load_joint

_IMPEDANCE = 1.0e-4, 0.9999  # range of d that MuJoCo keeps to
_TRANSITION = (0.001, 0.5, 2.0)  # of the impedance, which is the same at every depth


def stop_joints(machine: Machine) -> dict[str, str]:
    """Axis -> name of the joint whose limits are the ends of its travel."""
    return {name: load_joint(machine, name) for name in machine.axes if machine.end_stop(name)}


def set_stops(machine: Machine, model: mujoco.MjModel) -> None:
    """Give the limits of a compiled machine the stiffness and damping of its end stops.

    MuJoCo computes `R = (1 - d) / d A_0` from the impedance d and the inverse inertia A_0 at its
    reference pose, and `a_ref = -B v - K d r` from `solref = (-K d^2, -B d)`.

    Args:
        machine: the machine.
        model: its model; `jnt_solref` and `jnt_solimp` are written.

    Source: MuJoCo documentation, "Computation", constraint model.
    """
    h = model.opt.timestep
    for axis, name in stop_joints(machine).items():
        stop, joint = machine.end_stop(axis), model.joint(name).id
        assert stop
        both = stop.damping + h * stop.stiffness
        weight = model.dof_invweight0[model.jnt_dofadr[joint]]
        d = float(np.clip(weight / (weight + 1.0 / (h * both)), *_IMPEDANCE))
        model.jnt_solref[joint] = -stop.stiffness / (h * both) * d, -d / h
        model.jnt_solimp[joint] = d, d, *_TRANSITION


def write_stops(root, machine: Machine, model: mujoco.MjModel) -> None:
    """Write what `set_stops` gave a model into the MJCF document of the same machine."""
    for name in stop_joints(machine).values():
        joint, numbers = root.find("joint", name), model.joint(name).id
        joint.solreflimit = model.jnt_solref[numbers]
        joint.solimplimit = model.jnt_solimp[numbers]

"""Bristles of presliding friction in a compiled machine: what inertia they hold at home.

An explicit step follows a drive on its bristles only as long as these are not too stiff for the
inertia that it moves; `presliding.bristle_rate` limits them by the number that is written here.
"""

import mujoco
import numpy as np

from hydrotele.hydraulics.circuit import Slot
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine.machine import Machine
from hydrotele.simulate.closure import close_loops, motion_basis
from hydrotele.simulate.drive_side import drive_joint


def set_bristles(machine: Machine, model: mujoco.MjModel) -> None:
    """Tell a compiled machine what its drives with presliding friction move.

    Args:
        machine: the machine.
        model: its model; `actuator_user` is written where there are bristles.

    Raises:
        InputError: the linkages do not close at home.

    Source: `(J M^-1 J')^-1` of a drive's Jacobian J, in independent coordinates; the drive side's
        own inertia where there is a transmission.
    """
    order = actuator_order(machine)
    axes = [machine.axes[name] for name in order]
    if not any(axis.drive.friction.presliding for axis in axes):
        return
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    close_loops(machine, model, data, {})
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fullM(model, data, mass)
    basis = motion_basis(machine, model, data)
    yielding = np.linalg.inv(basis.T @ mass @ basis)
    for i, (name, axis) in enumerate(zip(order, axes, strict=True)):
        if axis.drive.friction.presliding:
            lever = basis[model.joint(drive_joint(machine, name)).dofadr[0]]
            moved = 1.0 / float(lever @ yielding @ lever)
            own = axis.transmission.inertia if axis.transmission else moved
            model.actuator_user[i, Slot.BRISTLE_INERTIA] = own


def write_bristles(root, machine: Machine, model: mujoco.MjModel) -> None:
    """Write what `set_bristles` gave a model into the MJCF document of the same machine."""
    for i, name in enumerate(actuator_order(machine)):
        if machine.axes[name].drive.friction.presliding:
            root.find("actuator", name).user = model.actuator_user[i]

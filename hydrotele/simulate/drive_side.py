"""Drive sides: what a transmission adds to the MJCF, and where it stands and moves at rest.

The drive gets a coordinate of its own beside the load's, in the same parent: a rotor about the
joint's axis, a slide along it, or a piston in the tube. Its inertia is the armature of that
coordinate, so that it turns with its parent without weight. A fixed tendon, drive minus load, with
a dead band as wide as the backlash is the spring and the damper between the two.
"""

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine

_SPECK = (1.0e-6, (1.0e-9, 1.0e-9, 1.0e-9))  # kg, kg m^2: MuJoCo takes no moving body without mass
_SLACK = 1.0e-9  # m or rad of deflection under a static load so small that it stays inside the gap


def drive_joint(machine: Machine, axis: str) -> str:
    """Name of the joint that the actuator of an axis acts on."""
    return f"{axis}_drive" if machine.axes[axis].transmission else load_joint(machine, axis)


def load_joint(machine: Machine, axis: str) -> str:
    """Name of the joint on the load side: the rod's slide of a cylinder, else the axis' joint."""
    facts = machine.axes[axis]
    return f"{axis}_rod" if facts.cylinder else facts.joint


def flexible_axes(machine: Machine) -> list[str]:
    """Names of the axes with a transmission."""
    return [name for name, axis in machine.axes.items() if axis.transmission]


def write_drive_side(root, machine: Machine, axis: str) -> None:
    """Add the drive side of an axis with a transmission to an MJCF that has the load side.

    Args:
        root: the MJCF document.
        machine: the machine.
        axis: name of the axis.

    Raises:
        InputError: a link has the name that the drive side needs.
    """
    facts = machine.axes[axis].transmission
    assert facts
    name, load = drive_joint(machine, axis), root.find("joint", load_joint(machine, axis))
    if root.find("body", name) is not None or root.find("joint", name) is not None:
        message = f"is the name of the drive side of axis {axis}; rename the link"
        raise InputError(f"links.{name}", message)
    beside = load.parent
    body = beside.parent.add("body", name=name, pos=beside.pos)
    for turn in ("quat", "euler", "axisangle", "xyaxes", "zaxis"):
        setattr(body, turn, getattr(beside, turn))
    mass, inertia = _SPECK
    body.add("inertial", mass=mass, pos=(0, 0, 0), diaginertia=inertia)
    body.add(
        "joint", name=name, type=load.type or "hinge", axis=load.axis, armature=facts.inertia,
        limited="false",
    )  # fmt: skip
    gap = facts.backlash / 2.0
    tendon = root.tendon.add(
        "fixed", name=name, stiffness=facts.stiffness, damping=facts.damping,
        springlength=(-gap, gap),
    )  # fmt: skip
    tendon.add("joint", joint=name, coef=1.0)
    tendon.add("joint", joint=load.name, coef=-1.0)


def lock_drives(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put every drive side where its load stands, with the spring at rest; `qpos` is written."""
    for axis in flexible_axes(machine):
        drive, load = drive_joint(machine, axis), load_joint(machine, axis)
        data.qpos[model.joint(drive).qposadr[0]] = data.qpos[model.joint(load).qposadr[0]]


def drive_and_load_dofs(machine: Machine, model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Places in `qvel` of the drive sides, and of the load sides that they belong to."""
    axes = flexible_axes(machine)
    drives = [int(model.joint(drive_joint(machine, a)).dofadr[0]) for a in axes]
    loads = [int(model.joint(load_joint(machine, a)).dofadr[0]) for a in axes]
    return drives, loads


def wind_up(
    machine: Machine, model: mujoco.MjModel, data: mujoco.MjData, force: dict[str, float]
) -> None:
    """Wind the transmissions up until they carry static forces.

    Args:
        machine: the machine.
        model: its model.
        data: `qpos` of the drive sides is written, beside their loads.
        force: axis -> force that its drive gives [N] or [N m]; none leaves it in the middle of
            its gap.
    """
    for axis in flexible_axes(machine):
        facts = machine.axes[axis].transmission
        assert facts
        deflection = force[axis] / facts.stiffness
        if abs(deflection) > _SLACK:
            deflection += np.sign(deflection) * facts.backlash / 2.0
        drive = model.joint(drive_joint(machine, axis)).qposadr[0]
        load = model.joint(load_joint(machine, axis)).qposadr[0]
        data.qpos[drive] = data.qpos[load] + deflection

"""The drive side of a transmission that an effect adds: how heavy it is, how stiff it may be."""

import math

import numpy as np

from hydrotele.effects._sizes import outboard_links
from hydrotele.effects.effect import changed
from hydrotele.machine.drives import Transmission
from hydrotele.machine.machine import Machine

_SHARE = 0.03  # of the load's inertia: rotor and gears of a slewing drive, seen at the ring
_CONTACT = 2.0 * math.pi * 40.0  # rad/s of the drive on closed teeth: six steps of 1 ms a radian
_FASTEST = 2.0 * math.pi * 150.0  # rad/s of the drive on spring and oil: 1 ms is half its limit
_DAMPING = 0.3  # damping ratio of the drive on its spring: oil and rubbing teeth


def rigid_drive(machine: Machine, axis: str) -> Transmission:
    """Transmission of a rigid drive that is about to get a gap or a spring.

    Its inertia is the rod's mass, or 3 % of what a motor turns at home; its spring is so stiff that
    a step of 1 ms just resolves it well (40 Hz).
    """
    cylinder = machine.axes[axis].cylinder
    inertia = cylinder.rod.mass if cylinder else _SHARE * load_inertia(machine, axis)
    stiffness = inertia * _CONTACT**2
    return Transmission(
        inertia=inertia, stiffness=stiffness, damping=damper(inertia, stiffness), backlash=0.0
    )


def damper(inertia: float, stiffness: float) -> float:
    """Damping of the spring [N s/m] or [N m s/rad]."""
    return 2.0 * _DAMPING * math.sqrt(stiffness * inertia)


def resolved_inertia(machine: Machine, axis: str, inertia: float, stiffness: float) -> float:
    """Inertia with which spring and oil can be stepped with 1 ms: more of it where they are hard.

    The oil is stiffest with the piston at its end: `beta (A^2 / V)` of both chambers.
    """
    drive, cylinder = machine.axes[axis].hydraulic_drive, machine.axes[axis].cylinder
    assert machine.supply
    head, rod = drive.areas
    far = drive.dead_volume + (rod * cylinder.stroke if cylinder else 0.0)
    oil = machine.supply.bulk_modulus * (head**2 / drive.dead_volume + rod**2 / far)
    return max(inertia, (stiffness + oil) / _FASTEST**2)


def with_transmission(machine: Machine, axis: str, transmission: Transmission) -> Machine:
    """Machine with a transmission in an axis; what a motor's drive side weighs leaves the link.

    So the whole moment of inertia about a motor's axis stays what it was, as long as the link has
    that much to give.
    """
    facts = machine.axes[axis]
    before = facts.transmission.inertia if facts.transmission else 0.0
    machine = changed(machine, f"axes.{axis}.transmission", transmission)
    if facts.cylinder:
        return machine
    name = machine.link_of(facts.joint)
    link, direction = machine.links[name], int(np.argmax(np.abs(machine.joints[facts.joint].axis)))
    inertia = list(link.inertia)
    inertia[direction] -= transmission.inertia - before
    a, b, c = sorted(inertia)
    if a <= 0.0 or a + b < c:
        return machine
    return changed(machine, f"links.{name}.inertia", tuple(inertia))


def load_inertia(machine: Machine, axis: str) -> float:
    """What the joint of an axis turns [kg m^2] or pushes [kg] at home, without cylinders."""
    joint = machine.axes[axis].joint
    first = machine.link_of(joint)
    carried = outboard_links(machine, first)
    if machine.joints[joint].type == "slide":
        return sum(machine.links[name].mass for name in carried)
    frames = {name: _frame(machine, name) for name in carried}
    origin, turn = frames[first]
    way = turn @ np.array(machine.joints[joint].axis)
    total = 0.0
    for name, (position, rotation) in frames.items():
        link = machine.links[name]
        arm = position + rotation @ np.array(link.com) - origin
        total += link.mass * float(arm @ arm - (arm @ way) ** 2)
        total += float(np.array(link.inertia) @ (rotation.T @ way) ** 2)
    return total


def _frame(machine: Machine, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) [m] and rotation (3, 3) of a link at home in the world."""
    if name == "world":
        return np.zeros(3), np.eye(3)
    link = machine.links[name]
    position, rotation = _frame(machine, link.parent)
    position = position + rotation @ np.array(link.position)
    if link.joint:
        value, axis = machine.home.get(link.joint.name, 0.0), np.array(link.joint.axis)
        if link.joint.type == "slide":
            return position + rotation @ axis * value, rotation
        rotation = rotation @ _turn(axis, value)
    return position, rotation


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

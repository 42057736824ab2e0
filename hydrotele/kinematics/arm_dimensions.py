"""Dimensions of a machine's arm for the closed-form kinematics, and the position of its tip."""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import ArmGeometry
from hydrotele.kinematics.drive_linkage import GEOMETRY_TOLERANCE, xz_coordinates
from hydrotele.kinematics.feller_arm import FellerGeometry
from hydrotele.machine.machine import Machine


def arm_geometry(machine: Machine) -> ArmGeometry:
    """Return the dimensions of an excavator's arm from its machine, with heights above the ground.

    Args:
        machine: a machine with an `arm`.

    Returns:
        Lengths and offsets, as `kinematics.arm` needs them.

    Raises:
        InputError: the machine has no arm, or an arm with a head, for which `feller_geometry`
            applies.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm: give arm.swing, boom, stick, tip")
    if arm.head:
        raise InputError(
            f"machine {machine.name}",
            f"has a head ({arm.head}) on its tool: use feller_geometry and kinematics.feller_arm"
            " for its arm of five joints",
        )
    joints = (arm.swing, arm.boom, arm.stick)
    swing, boom, stick = (machine.links[machine.link_of(j)] for j in joints)
    if arm.tool:
        tool_pin = machine.links[machine.link_of(arm.tool)].position
        offset = xz_coordinates(arm.tip.position)
    else:
        tool_pin, offset = arm.tip.position, (0.0, 0.0)
    base = np.add(swing.position, boom.position)
    return ArmGeometry(
        base_radius=float(base[0]),
        lateral_offset=float(base[1] + stick.position[1] + tool_pin[1]),
        boom_pin_height=float(base[2]),
        boom_length=math.hypot(*xz_coordinates(stick.position)),
        stick_length=math.hypot(*xz_coordinates(tool_pin)),
        tool_offset=offset,
        has_tool_joint=arm.tool is not None,
    )


def is_planar_arm(machine: Machine) -> bool:
    """Return whether a machine's swing joint has the axis z, and boom and stick joint -y, each in its link's frame.

    `kinematics.arm` requires these axes. The machine must have an `arm`; its tool joint is not
    checked.
    """
    assert machine.arm
    wanted = ((0, 0, 1), (0, -1, 0), (0, -1, 0))
    joints = (machine.arm.swing, machine.arm.boom, machine.arm.stick)
    return all(
        np.abs(np.subtract(machine.joints[name].axis, axis)).max() < GEOMETRY_TOLERANCE
        for name, axis in zip(joints, wanted, strict=True)
    )


def tip_position(machine: Machine, joints: np.ndarray) -> np.ndarray:
    """Compute the position of the arm's tip in the world from swing, boom and stick angle.

    Args:
        machine: a machine with an `arm`.
        joints: (3,) swing, boom and stick [rad]; other joints are at zero.

    Returns:
        (3,) position in the world [m].
    """
    assert machine.arm
    names = (machine.arm.swing, machine.arm.boom, machine.arm.stick)
    angles = dict(zip(names, joints, strict=True))
    place, link = np.array(machine.arm.tip.position), machine.arm.tip.link
    while link != "world":
        facts = machine.links[link]
        if facts.joint and facts.joint.name in angles:
            way, angle = np.array(facts.joint.axis), angles[facts.joint.name]
            along = way * (way @ place)
            across = np.cross(way, place)
            place = along + (place - along) * math.cos(angle) + across * math.sin(angle)
        place, link = place + np.array(facts.position), facts.parent
    return place


def solve_joints_for_tip(machine: Machine, tip: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Compute the swing, boom and stick angle that bring the tip to a position, by Newton's method.

    The joint axes may have any direction. The method takes at most 8 steps; convergence is not
    checked.

    Args:
        machine: a machine with an `arm` of three joints.
        tip: (3,) position of the tip in the world [m].
        start: (3,) swing, boom and stick angle near the solution [rad].

    Returns:
        (3,) angles [rad].
    """
    joints, step = np.array(start, float), 1.0e-6
    for _ in range(8):
        gap = tip_position(machine, joints) - tip
        if np.abs(gap).max() < GEOMETRY_TOLERANCE:
            break
        slope = np.column_stack([
            (tip_position(machine, joints + step * e) - tip_position(machine, joints - step * e))
            / (2.0 * step) for e in np.eye(3)
        ])  # fmt: skip
        joints -= np.linalg.lstsq(slope, gap, rcond=None)[0]
    return joints


def feller_geometry(machine: Machine) -> FellerGeometry:
    """Return the dimensions of a feller-buncher's arm, with heights above the ground.

    Args:
        machine: a machine with an `arm` that has a head.

    Returns:
        Lengths, as `kinematics.feller_arm` needs them.

    Raises:
        InputError: the arm has no head, or its joints do not have the form of
            `kinematics.feller_arm`: all pins in one plane through the swing axis, the links along x,
            the head's axis along -z of the tilt link.
    """
    arm = machine.arm
    if arm is None or arm.head is None or arm.tool is None:
        raise InputError(f"machine {machine.name}", "has no arm with a head: give arm.head")
    joints = (arm.swing, arm.boom, arm.stick, arm.tool, arm.head)
    swing, boom, stick, tilt, head = (machine.links[machine.link_of(j)] for j in joints)
    base, tip = np.add(swing.position, boom.position), arm.tip.position
    aside = [base[1], tip[1], *(v for link in (stick, tilt, head) for v in link.position[1:])]
    _check_feller(machine, joints, aside)
    return FellerGeometry(
        base_radius=float(base[0]),
        base_height=float(base[2]),
        boom_length=stick.position[0],
        stick_length=tilt.position[0],
        tilt_length=head.position[0],
        head_radius=tip[0],
        head_depth=-tip[2],
    )


def _check_feller(machine: Machine, joints: Sequence[str], aside: Sequence[float]) -> None:
    """Raise InputError if an arm does not have the form of `kinematics.feller_arm`.

    Checked are the joint axes, that each joint carries the next, that the tip is on the head, and
    that all coordinates in `aside` are 0 [m]. `joints` are the names of swing, boom, stick, tool
    and head joint.
    """
    where = f"machine {machine.name}: arm"
    axes = ((0, 0, 1), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, 0, -1))
    for name, axis in zip(joints, axes, strict=True):
        if np.abs(np.subtract(machine.joints[name].axis, axis)).max() > GEOMETRY_TOLERANCE:
            raise InputError(where, f"{name} must rotate about {axis} of its link")
    chain = [machine.links[machine.link_of(name)].parent for name in joints[1:]]
    if chain != [machine.link_of(name) for name in joints[:-1]]:
        raise InputError(where, "each joint must carry the next: swing, boom, stick, tool, head")
    if machine.arm and machine.arm.tip.link != machine.link_of(joints[-1]):
        raise InputError(where, f"its tip must be on the head, not on {machine.arm.tip.link}")
    if np.abs(aside).max() > GEOMETRY_TOLERANCE:
        raise InputError(where, "each pin must be in the plane y = 0, on the x axis of the link before")

"""Closed-form geometry of a machine: arm dimensions and the linkage between drive and joint."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import ArmGeometry
from hydrotele.kinematics.five_dof import FellerGeometry
from hydrotele.kinematics.linkages import FourBar, LoopOpenError, TwoBar, two_bar_from_points
from hydrotele.machine.drives import Axis
from hydrotele.machine.machine import Machine

_STROKE_TOLERANCE = 2.0e-3  # m: tolerance of the stroke, because joint ranges are given in whole degrees
_GEOMETRY_TOLERANCE = 1.0e-9  # m or 1: rounding of a 10 m machine, far below any relevant length


@dataclass(frozen=True)
class DirectDrive:
    """A drive that acts on its joint directly: drive and joint coordinate are equal."""

    def length(self, theta: Any) -> Any:
        """Return the drive coordinate, [rad] or [m], same shape as theta."""
        return theta

    def rate(self, theta: Any) -> Any:
        """Return d(drive)/d(joint) = 1, same shape as theta."""
        return 0.0 * theta + 1.0

    def angle(self, length: Any) -> Any:
        """Return the joint coordinate, [rad] or [m], same shape as length."""
        return length


@dataclass(frozen=True)
class SliderLinkage:
    """A cylinder on a prismatic joint: length = sqrt((x + along)^2 + across^2).

    Attributes:
        along: distance of the pins along the joint axis at joint position 0 [m].
        across: distance of the pins perpendicular to the axis [m].
    """

    along: float
    across: float

    def length(self, theta: Any) -> Any:
        """Return the pin-to-pin length [m] at joint position theta [m], any shape."""
        return np.hypot(theta + self.along, self.across)

    def rate(self, theta: Any) -> Any:
        """Return d(length)/d(position) [-], any shape."""
        return (theta + self.along) / self.length(theta)

    def angle(self, length: Any) -> Any:
        """Return the joint position [m] at a length [m], on the extended side, any shape."""
        return np.sqrt(length**2 - self.across**2) - self.along


DriveLinkage = TwoBar | FourBar | SliderLinkage | DirectDrive


def axis_linkage(machine: Machine, name: str) -> DriveLinkage:
    """Build the linkage that relates an axis' drive coordinate to its joint angle.

    Args:
        machine: the machine.
        name: axis name.

    Returns:
        Two-bar, four-bar or slider, with the pin-to-pin length by joint coordinate, its derivative,
        and the inverse; `DirectDrive` for motors and force drives.

    Raises:
        InputError: the pins of the cylinder are not on the two links that the joint connects.
    """
    axis = machine.axes[name]
    if axis.cylinder is None:
        return DirectDrive()
    if axis.four_bar:
        return _build_four_bar(machine, axis)
    upper = machine.link_of(axis.joint)
    link = machine.links[upper]
    pins = {axis.cylinder.base_pin.link: axis.cylinder.base_pin.position}
    pins[axis.cylinder.rod_pin.link] = axis.cylinder.rod_pin.position
    if set(pins) != {upper, link.parent} or link.joint is None:
        raise InputError(
            f"machine {machine.name}: axes.{name}.cylinder",
            f"pins must be on {link.parent} and {upper}, or give a four_bar",
        )
    base = np.subtract(pins[link.parent], link.position)
    rod = np.array(pins[upper])
    axis_way = np.array(link.joint.axis)
    if link.joint.type == "slide":
        way = rod - base
        along = float(way @ axis_way)
        return SliderLinkage(along, float(np.linalg.norm(way - along * axis_way)))
    first = np.array([1.0, 0.0, 0.0]) if abs(axis_way[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first -= axis_way * (first @ axis_way)
    first /= np.linalg.norm(first)
    second = np.cross(axis_way, first)
    return two_bar_from_points(
        (float(base @ first), float(base @ second)),
        (float(rod @ first), float(rod @ second)),
        machine.home.get(axis.joint, 0.0),
        float((rod - base) @ axis_way),
    )


def has_ball_ends(machine: Machine, name: str) -> bool:
    """Return whether an axis' cylinder needs ball joints at its ends instead of pins.

    A cylinder between pins parallel to the joint's axis moves in a plane perpendicular to it. Pins
    with an offset along the axis would bend the cylinder, so it has ball ends.

    Source: Khoshzaban 1992, section 3.4.4 (p. 43).
    """
    axis = machine.axes[name]
    if axis.cylinder is None or axis.four_bar:
        return False
    linkage = axis_linkage(machine, name)
    return isinstance(linkage, TwoBar) and abs(linkage.axial_offset) > _GEOMETRY_TOLERANCE


def joint_range_at_drive(machine: Machine, name: str) -> tuple[float, float] | None:
    """Convert the range of an axis' joint to the range of its drive, such as piston displacement.

    Args:
        machine: the machine.
        name: axis name.

    Returns:
        (low, high) piston displacement [m], or joint coordinate [rad] or [m] of a drive without a
        cylinder. None if the joint has no range, or the linkage has no closed form or is not
        monotonic within the range.
    """
    axis = machine.axes[name]
    limits = machine.joints[axis.joint].range
    if limits is None or axis.cylinder is None:
        return limits
    try:
        linkage = axis_linkage(machine, name)
    except InputError:
        return None
    try:
        if linkage.rate(limits[0]) * linkage.rate(limits[1]) <= 0.0:
            return None
        first, second = (float(linkage.length(q)) - axis.cylinder.closed_length for q in limits)
    except LoopOpenError:  # the linkage cannot reach the ends of the range
        return None
    return min(first, second), max(first, second)


def drive_travel(machine: Machine, name: str) -> tuple[float, float] | None:
    """Return the limits of an axis' drive: its stroke, restricted to its joint's range.

    Args:
        machine: the machine.
        name: axis name.

    Returns:
        (low, high) of the drive's coordinate [m] or [rad]; None if it is unlimited.
    """
    cylinder, limits = machine.axes[name].cylinder, joint_range_at_drive(machine, name)
    if cylinder is None:
        return limits
    low, high = limits or (0.0, cylinder.stroke)
    return max(0.0, low), min(cylinder.stroke, high)


def _build_four_bar(machine: Machine, axis: Axis) -> FourBar:
    assert axis.four_bar and axis.cylinder
    output = machine.link_of(axis.joint)
    rocker, coupler = machine.links[axis.four_bar.rocker], machine.links[axis.four_bar.coupler]
    arm = next(
        end.position
        for closure in machine.closures.values()
        for end, other in ((closure.a, closure.b), (closure.b, closure.a))
        if end.link == output and other.link == axis.four_bar.coupler
    )
    arm_of_coupler = next(
        end.position
        for closure in machine.closures.values()
        for end in (closure.a, closure.b)
        if end.link == axis.four_bar.coupler
    )
    return FourBar(
        output_pivot=_xz_coordinates(machine.links[output].position),
        rocker_pivot=_xz_coordinates(rocker.position),
        cylinder_base=_xz_coordinates(axis.cylinder.base_pin.position),
        rocker=math.hypot(*_xz_coordinates(coupler.position)),
        coupler=math.hypot(*_xz_coordinates(arm_of_coupler)),
        output_arm=_xz_coordinates(arm),
        working_angle=machine.home.get(axis.joint, 0.0),
    )


def _xz_coordinates(point) -> tuple[float, float]:
    return point[0], point[2]


def pin_axis(machine: Machine, name: str) -> tuple[float, float, float]:
    """Return the direction of a cylinder's pins in the frame of the link at its base pin.

    Args:
        machine: the machine.
        name: axis name.

    Returns:
        Unit vector (3,): the axis of the joint that the cylinder drives; -y for a slide.
    """
    joint = machine.joints[machine.axes[name].joint]
    return joint.axis if joint.type == "hinge" else (0.0, -1.0, 0.0)


def check_strokes(machine: Machine) -> None:
    """Raise InputError if a cylinder's stroke does not span the range of its joint.

    Args:
        machine: the machine; joints without a range are not checked.

    Raises:
        InputError: a stroke is too short; the message names axis, joint position, piston
            displacement and stroke.
    """
    for name, axis in machine.axes.items():
        limits = machine.joints[axis.joint].range
        if axis.cylinder is None or limits is None:
            continue
        linkage = axis_linkage(machine, name)
        for end in limits:
            x = float(linkage.length(end)) - axis.cylinder.closed_length
            if not -_STROKE_TOLERANCE <= x <= axis.cylinder.stroke + _STROKE_TOLERANCE:
                raise InputError(
                    f"machine {machine.name}: axes.{name}.cylinder",
                    f"at {axis.joint} = {end:.4g} its piston would be at {x:.4g} m, outside its"
                    f" stroke 0 .. {axis.cylinder.stroke:g} m",
                )


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
            f"has a head ({arm.head}) on its tool: use feller_geometry and kinematics.five_dof"
            " for its arm of five joints",
        )
    joints = (arm.swing, arm.boom, arm.stick)
    swing, boom, stick = (machine.links[machine.link_of(j)] for j in joints)
    if arm.tool:
        tool_pin = machine.links[machine.link_of(arm.tool)].position
        offset = _xz_coordinates(arm.tip.position)
    else:
        tool_pin, offset = arm.tip.position, (0.0, 0.0)
    base = np.add(swing.position, boom.position)
    return ArmGeometry(
        base_radius=float(base[0]),
        lateral_offset=float(base[1] + stick.position[1] + tool_pin[1]),
        boom_pin_height=float(base[2]),
        boom_length=math.hypot(*_xz_coordinates(stick.position)),
        stick_length=math.hypot(*_xz_coordinates(tool_pin)),
        tool_offset=offset,
        has_tool_joint=arm.tool is not None,
    )


def is_planar_arm(machine: Machine) -> bool:
    """Return whether swing rotates about z, and boom and stick about -y, as `kinematics.arm` requires."""
    assert machine.arm
    wanted = ((0, 0, 1), (0, -1, 0), (0, -1, 0))
    joints = (machine.arm.swing, machine.arm.boom, machine.arm.stick)
    return all(
        np.abs(np.subtract(machine.joints[name].axis, axis)).max() < _GEOMETRY_TOLERANCE
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
    """Compute swing, boom and stick angle for a tip position, for any joint axes, by Newton's method.

    It takes at most 8 steps; convergence is not checked.

    Args:
        machine: a machine with an `arm` of three joints.
        tip: (3,) position of the tip [m].
        start: (3,) swing, boom and stick near the solution [rad].

    Returns:
        (3,) angles [rad].
    """
    joints, step = np.array(start, float), 1.0e-6
    for _ in range(8):
        gap = tip_position(machine, joints) - tip
        if np.abs(gap).max() < _GEOMETRY_TOLERANCE:
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
        Lengths, as `kinematics.five_dof` needs them.

    Raises:
        InputError: the arm has no head, or its joints do not have the form of
            `kinematics.five_dof`: all pins in one plane through the swing axis, the links along x,
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
    """Raise InputError if an arm's pins or axes do not fit the closed form for a feller-buncher's arm.

    `aside` are the pin coordinates that must be 0 [m].
    """
    where = f"machine {machine.name}: arm"
    axes = ((0, 0, 1), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, 0, -1))
    for name, axis in zip(joints, axes, strict=True):
        if np.abs(np.subtract(machine.joints[name].axis, axis)).max() > _GEOMETRY_TOLERANCE:
            raise InputError(where, f"{name} must rotate about {axis} of its link")
    chain = [machine.links[machine.link_of(name)].parent for name in joints[1:]]
    if chain != [machine.link_of(name) for name in joints[:-1]]:
        raise InputError(where, "each joint must carry the next: swing, boom, stick, tool, head")
    if machine.arm and machine.arm.tip.link != machine.link_of(joints[-1]):
        raise InputError(where, f"its tip must be on the head, not on {machine.arm.tip.link}")
    if np.abs(aside).max() > _GEOMETRY_TOLERANCE:
        raise InputError(where, "each pin must be in the plane y = 0, on the x axis of the link before")

"""Linkage between the drive and the joint of a machine's axis.

Direct drive, cylinder on a slide, two-bar or four-bar.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.linkages import FourBar, LoopOpenError, TwoBar, two_bar_from_points
from hydrotele.machine.drives import Axis
from hydrotele.machine.machine import Machine

_STROKE_TOLERANCE = 2.0e-3  # m: tolerance of the stroke, because joint ranges are given in whole degrees
GEOMETRY_TOLERANCE = 1.0e-9  # m or 1: rounding of a 10 m machine, far below any relevant length


@dataclass(frozen=True)
class DirectDrive:
    """A drive that acts on its joint directly: drive and joint coordinate are equal."""

    def length(self, theta: Any) -> Any:
        """Return the drive coordinate, which equals the joint coordinate theta, [rad] or [m]."""
        return theta

    def rate(self, theta: Any) -> Any:
        """Return the derivative of the drive by the joint coordinate: 1, in the shape of theta."""
        return 0.0 * theta + 1.0

    def angle(self, length: Any) -> Any:
        """Return the joint coordinate, which equals the drive coordinate `length`, [rad] or [m]."""
        return length


@dataclass(frozen=True)
class SliderLinkage:
    """A cylinder on a prismatic joint: length = sqrt((x + along)^2 + across^2).

    Attributes:
        along: distance from base pin to rod pin along the joint axis at joint position 0, with sign
            [m].
        across: distance of the pins perpendicular to the joint axis [m].
    """

    along: float
    across: float

    def length(self, theta: Any) -> Any:
        """Return the pin-to-pin length [m] at joint position theta [m], any shape."""
        return np.hypot(theta + self.along, self.across)

    def rate(self, theta: Any) -> Any:
        """Return the derivative of the pin-to-pin length by the joint position theta [-], any shape."""
        return (theta + self.along) / self.length(theta)

    def angle(self, length: Any) -> Any:
        """Return the joint position [m] at a pin-to-pin length [m], any shape.

        Of two solutions it is the larger one, at which the cylinder extends with the joint
        position.
        """
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

    It does if it drives a hinge directly and its two pins are offset along the joint's axis. Such a
    cylinder does not stay in a plane perpendicular to the axis, and pins would bend it. Cylinders
    of slides and four-bars do not.

    Source: Khoshzaban 1992, section 3.4.4 (p. 43).
    """
    axis = machine.axes[name]
    if axis.cylinder is None or axis.four_bar:
        return False
    linkage = axis_linkage(machine, name)
    return isinstance(linkage, TwoBar) and abs(linkage.axial_offset) > GEOMETRY_TOLERANCE


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
        (low, high) of the drive's coordinate [m] or [rad], for a cylinder the piston displacement.
        None for a drive without cylinder whose joint has no range.
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
        output_pivot=xz_coordinates(machine.links[output].position),
        rocker_pivot=xz_coordinates(rocker.position),
        cylinder_base=xz_coordinates(axis.cylinder.base_pin.position),
        rocker=math.hypot(*xz_coordinates(coupler.position)),
        coupler=math.hypot(*xz_coordinates(arm_of_coupler)),
        output_arm=xz_coordinates(arm),
        working_angle=machine.home.get(axis.joint, 0.0),
    )


def xz_coordinates(point) -> tuple[float, float]:
    """Return the coordinates x and z of a point (x, y, z)."""
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
    """Raise InputError if a cylinder's stroke does not span the range of its joint, with 2 mm tolerance.

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

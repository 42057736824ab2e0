"""Kinematics of cylinder linkages: joint angle to pin-to-pin cylinder length and back.

`TwoBar` is a cylinder across one joint. `FourBar` is a cylinder that rotates a bucket through
rocker and coupler. Both have `length(theta)` [m], `rate(theta)` = d(length)/d(theta) [m/rad] and
`angle(length)` [rad]. The plane is x-z with z up; angles are counter-clockwise in this plane, so
that a positive angle raises the outboard end. Angles and lengths are floats (math module, fast) or
arrays of any shape (NumPy); the result has the same shape.

By virtual work a cylinder force F [N], positive when it pushes, causes the joint torque
F * rate(theta) [N m], and the cylinder moves with the velocity rate(theta) * d(theta)/dt.
The triangle formulas subtract lengths before they multiply, so that nearly flat triangles cause no
cancellation errors.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import NamedTuple

import numpy as np

Scalar = float | np.ndarray
Point = tuple[Scalar, Scalar]


class LoopOpenError(ValueError):
    """The pins of a linkage cannot be joined at the requested angle or length."""


def math_module(value: Scalar) -> ModuleType:
    """Return the module with the functions for a value: numpy for an array, the faster math for a float.

    Args:
        value: any shape [any unit].

    Returns:
        The module numpy or math; both have sin, cos, sqrt, atan2 and floor.

    >>> math_module(1.0).__name__, math_module(np.ones(2)).__name__
    ('math', 'numpy')
    """
    return np if isinstance(value, np.ndarray) else math


def subtract_points(a: Point, b: Point) -> Point:
    """Return the vector from point b to point a in the plane.

    Args:
        a: (x, z), coordinates of any one shape [m].
        b: (x, z), coordinates of any one shape [m].

    Returns:
        (x, z) of the difference [m].

    >>> subtract_points((3.0, 1.0), (1.0, 2.0))
    (2.0, -1.0)
    """
    return a[0] - b[0], a[1] - b[1]


def cross_product(a: Point, b: Point) -> Scalar:
    """Return the cross product a_x b_z - a_z b_x, positive if b is to the left of a.

    Args:
        a: (x, z), coordinates of any one shape [m].
        b: (x, z), coordinates of any one shape [m].

    Returns:
        The product, shape of the coordinates [m^2].

    >>> cross_product((1.0, 0.0), (0.0, 2.0))
    2.0
    """
    return a[0] * b[1] - a[1] * b[0]


def apex_angle(left: float, right: float, opposite: Scalar) -> Scalar:
    """Return the angle between two sides of a triangle.

    tan(B/2)^2 = (c^2 - (a - b)^2) / ((a + b)^2 - c^2).

    Args:
        left: length a of one side [m], > 0.
        right: length b of the other side [m], > 0.
        opposite: length c of the side opposite the angle, any shape [m], in [|a - b|, a + b].

    Returns:
        Angle B, shape of opposite [rad], in [0, pi].

    Raises:
        LoopOpenError: a length is outside [|a - b|, a + b].

    >>> round(math.degrees(apex_angle(3.0, 4.0, 5.0)), 9)
    90.0
    """
    low, high = abs(left - right), left + right
    opposite = clip_to_reachable_length(opposite, low, high, "pin-to-pin length")
    m = math_module(opposite)
    sine, cosine = (opposite - low) * (opposite + low), (high - opposite) * (high + opposite)
    return 2 * m.atan2(m.sqrt(sine), m.sqrt(cosine))


def intersect_bars(first_pin: Point, second_pin: Point, first_bar: Scalar, second_bar: Scalar, side: int) -> Point:
    """Return the pin that joins two bars, an intersection of the circles about `first_pin` and `second_pin`.

    With D = |second_pin - first_pin|, the pin is at (n^2 - f^2 + D^2) / (2 D) along the line from `first_pin` to
    `second_pin`, at the distance 2 A / D from it, with the triangle's area A (Heron).

    Args:
        first_pin: (x, z), coordinates of any one shape [m].
        second_pin: (x, z), coordinates of any one shape [m], different from `first_pin`.
        first_bar: length n of the bar from `first_pin`, any one shape [m], > 0.
        second_bar: length f of the bar from `second_pin`, any one shape [m], > 0.
        side: +1 for the pin to the left of the line from `first_pin` to `second_pin`, -1 to the right [-].

    Returns:
        (x, z) of the shared pin [m].

    Raises:
        LoopOpenError: the bars are too short, or too unequal, to meet.

    >>> [round(v, 9) for v in intersect_bars((0.0, 0.0), (5.0, 0.0), 3.0, 4.0, 1)]
    [1.8, 2.4]
    """
    way_x, way_z = subtract_points(second_pin, first_pin)
    square = way_x * way_x + way_z * way_z
    m = math_module(square)
    low, high = abs(first_bar - second_bar), first_bar + second_bar
    distance = clip_to_reachable_length(m.sqrt(square), low, high, "distance of the pins that two bars join")
    flat = (distance - low) * (distance + low) * (high - distance) * (high + distance)
    along = 0.5 * (1 + (first_bar - second_bar) * high / square)
    beside = side * math_module(flat).sqrt(flat) / (2 * square)
    return first_pin[0] + along * way_x - beside * way_z, first_pin[1] + along * way_z + beside * way_x


def clip_to_reachable_length(value: Scalar, low: Scalar, high: Scalar, quantity: str) -> Scalar:
    """Clip a length to the range that two bars allow; raise an error if it exceeds that by 1e-12 m.

    Args:
        value: requested length, any shape [m].
        low: minimum length that the bars allow, scalar or shape of value [m].
        high: maximum length that the bars allow, scalar or shape of value [m].
        quantity: name of the length for the message [-].

    Returns:
        The length, within [low, high] [m].

    Raises:
        LoopOpenError: a length is outside [low, high] or NaN.

    >>> clip_to_reachable_length(2.0 + 1e-15, 1.0, 2.0, "cylinder length")
    2.0
    """
    inside = (value >= low - 1e-12) & (value <= high + 1e-12)
    if not isinstance(inside, np.ndarray):
        if inside:
            return min(max(value, low), high)
    elif inside.all():
        return np.clip(value, low, high)
    first = ~np.atleast_1d(inside)
    value, low, high = (np.broadcast_to(v, first.shape)[first][0] for v in (value, low, high))
    raise LoopOpenError(f"{quantity} {value:.6g} m requested, the bars allow [{low:.6g}, {high:.6g}] m")


@dataclass(frozen=True)
class TwoBar:
    """A cylinder across one joint with included angle B = direction * theta + angle_offset.

    If the pins are in one plane perpendicular to the joint's axis, the linkage is a plane triangle.
    Otherwise the cylinder has ball ends and the triangle is spatial: both pins move on circles
    about the axis, in planes at the distance `axial_offset`.

    Valid for B in (0, pi); at 0 and pi the moment arm is zero and the cylinder cannot hold.
    Source: Khoshzaban 1992 Eq. 3.26 and section 3.4.4 (p. 43), Zhu 1994 Eq. 6.13.

    Attributes:
        lower: joint axis to cylinder pin on the inboard link [m], > 0.
        upper: joint axis to cylinder pin on the outboard link [m], > 0.
        angle_offset: included angle at theta = 0 [rad].
        direction: +1 if the cylinder extends as theta increases, -1 if it retracts [-].
        axial_offset: distance of the pins along the joint's axis [m].
    """

    lower: float
    upper: float
    angle_offset: float
    direction: int = 1
    axial_offset: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for bars without length or an invalid direction."""
        if self.lower <= 0 or self.upper <= 0:
            raise ValueError(f"two-bar lengths must be positive, got lower={self.lower} upper={self.upper}")
        if self.direction not in (1, -1):
            raise ValueError(f"two-bar direction must be +1 or -1, got {self.direction}")

    def length(self, theta: Scalar) -> Scalar:
        """Return the cylinder's pin-to-pin length c = sqrt((a - b)^2 + h^2 + 4 a b sin(B/2)^2).

        a and b are `lower` and `upper`, h is `axial_offset`, B the included angle at theta.

        Args:
            theta: joint angle, any shape [rad].

        Returns:
            Pin-to-pin length, shape of theta [m].

        >>> boom = TwoBar(0.625, 2.000, math.radians(78.6), 1)
        >>> round(boom.length(math.radians(27.8)), 6)
        2.257538
        """
        m = math_module(theta)
        chord = 2 * m.sin(0.5 * (self.direction * theta + self.angle_offset))
        constant = (self.lower - self.upper) ** 2 + self.axial_offset**2
        return m.sqrt(constant + self.lower * self.upper * chord**2)

    def rate(self, theta: Scalar) -> Scalar:
        """Return the moment arm dc/dtheta = direction a b sin(B) / c of the cylinder (Zhu 1994, Eq. 6.13).

        a and b are `lower` and `upper`, B the included angle, c the pin-to-pin length.

        Args:
            theta: joint angle, any shape [rad].

        Returns:
            Moment arm, shape of theta [m/rad]; positive if the cylinder extends as theta increases.

        >>> round(TwoBar(0.625, 2.000, math.radians(78.6), 1).rate(math.radians(27.8)), 6)
        0.531173
        """
        m = math_module(theta)
        included = self.direction * theta + self.angle_offset
        return self.direction * self.lower * self.upper * m.sin(included) / self.length(theta)

    def angle(self, length: Scalar) -> Scalar:
        """Return the joint angle theta = direction (B - angle_offset) at a pin-to-pin length.

        The included angle B is in [0, pi]: tan(B/2)^2 = (p^2 - (a - b)^2) / ((a + b)^2 - p^2) with the
        length p = sqrt(c^2 - h^2) in the plane perpendicular to the axis. a and b are `lower` and `upper`, h
        is `axial_offset`.

        Args:
            length: pin-to-pin length c, any shape [m], with p in [|a - b|, a + b].

        Returns:
            Joint angle, shape of length [rad].

        Raises:
            LoopOpenError: a length is outside [|a - b|, a + b].

        >>> boom = TwoBar(0.625, 2.000, math.radians(78.6), 1)
        >>> round(math.degrees(boom.angle(2.2575379)), 4)
        27.8
        """
        if self.axial_offset:
            square = length * length - self.axial_offset**2
            length = math_module(length).sqrt(np.maximum(square, 0.0))
        return self.direction * (apex_angle(self.lower, self.upper, length) - self.angle_offset)


def two_bar_from_points(
    base_pin: Point, rod_pin: Point, working_angle: float = 0.0, axial_offset: float = 0.0
) -> TwoBar:
    """Build a two-bar linkage (cylinder across a joint) from the positions of its two pins.

    The included angle is B = |polar(rod) + theta - polar(base)| with the polar angles of the pins and
    the joint angle theta. The sign of the difference at the working angle gives the direction: whether
    the cylinder extends or retracts as theta increases.

    Args:
        base_pin: (x, z) of one cylinder pin in the inboard link's axes, from the joint [m].
        rod_pin: (x, z) of the other cylinder pin in the outboard link's axes, from the joint [m].
        working_angle: any joint angle inside the working range [rad].
        axial_offset: distance of the pins along the joint's axis [m].

    Returns:
        The linkage, with B in (0, pi) at the working angle.

    Raises:
        ValueError: the joint and both pins are collinear at the working angle, so that the
            direction is undetermined.

    >>> two_bar_from_points((-2.0, 0.0), (0.0, 0.5), working_angle=-0.5)
    TwoBar(lower=2.0, upper=0.5, angle_offset=1.5707963267948966, direction=-1, axial_offset=0.0)
    """
    offset = math.atan2(rod_pin[1], rod_pin[0]) - math.atan2(base_pin[1], base_pin[0])
    included = math.remainder(offset + working_angle, math.tau)
    if abs(math.sin(included)) < 1e-9:
        raise ValueError(f"joint and cylinder pins are in line at working angle {working_angle}, give another")
    direction = 1 if included > 0 else -1
    return TwoBar(
        math.hypot(*base_pin),
        math.hypot(*rod_pin),
        direction * (included - working_angle),
        direction,
        axial_offset,
    )


class FourBarPose(NamedTuple):
    """Angles and cylinder length of a four-bar.

    Attributes:
        rocker_angle: direction from rocker pivot to rod pin in the ground link's frame [rad].
        coupler_angle: direction from the output link's pin to the rod pin in the ground link's
            frame [rad].
        length: pin-to-pin length of the cylinder [m].
    """

    rocker_angle: Scalar
    coupler_angle: Scalar
    length: Scalar


@dataclass(frozen=True)
class FourBar:
    """A cylinder that rotates the output link (bucket) through a rocker and a coupler.

    The rod pin R joins cylinder, rocker and coupler. Every point is (x, z) [m]: x along the link, z
    up. At the output angle theta = 0 the output frame is parallel to the ground link's frame (Zhu
    1994 Fig. 6.36, Table 6.5).

    Attributes:
        output_pivot: O, pivot of the output link, in the ground link's frame.
        rocker_pivot: P, in the ground link's frame.
        cylinder_base: B, in the ground link's frame.
        rocker: length P to R [m], > 0.
        coupler: length Q to R [m], > 0.
        output_arm: Q relative to O in the output link's frame.
        assembly: +1 if R is to the left of the line from P to Q, -1 if to the right [-].
        working_angle: any output angle inside the working range [rad]; selects the branches of
            `angle`.
    """

    output_pivot: tuple[float, float]
    rocker_pivot: tuple[float, float]
    cylinder_base: tuple[float, float]
    rocker: float
    coupler: float
    output_arm: tuple[float, float]
    assembly: int = 1
    working_angle: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for bars without length or an invalid assembly."""
        if self.rocker <= 0 or self.coupler <= 0 or math.hypot(*self.output_arm) <= 0:
            raise ValueError("four-bar rocker, coupler and output arm must have a positive length")
        if self.assembly not in (1, -1):
            raise ValueError(f"four-bar assembly must be +1 or -1, got {self.assembly}")

    def pin_positions(self, theta: Scalar) -> tuple[Point, Point]:
        """Return pin Q of the output link and rod pin R, by intersecting circles about P and Q.

        Args:
            theta: output angle, any shape [rad].

        Returns:
            Q and R, each (x, z) in the ground link's frame [m], every coordinate with the shape of
            theta.

        Raises:
            LoopOpenError: rocker and coupler cannot meet at a requested angle.

        >>> bucket = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35))
        >>> q, r = bucket.pin_positions(-1.0)
        >>> [round(v, 4) for v in (*q, *r)]
        [1.9865, 0.3574, 1.5992, 0.641]
        """
        m = math_module(theta)
        cosine, sine = m.cos(theta), m.sin(theta)
        (ox, oz), (ax, az) = self.output_pivot, self.output_arm
        q = (ox + ax * cosine - az * sine, oz + ax * sine + az * cosine)
        return q, intersect_bars(self.rocker_pivot, q, self.rocker, self.coupler, self.assembly)

    def pose(self, theta: Scalar) -> FourBarPose:
        """Compute rocker angle, coupler angle and cylinder length at an angle of the output link.

        Args:
            theta: output angle, any shape [rad].

        Returns:
            rocker_angle [rad], coupler_angle [rad], length [m], each with the shape of theta.

        Raises:
            LoopOpenError: rocker and coupler cannot meet at a requested angle.

        >>> bucket = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35))
        >>> [round(v, 4) for v in bucket.pose(-1.0)]
        [1.3895, 2.5095, 1.7555]
        """
        m = math_module(theta)
        q, r = self.pin_positions(theta)
        rocker, coupler = subtract_points(r, self.rocker_pivot), subtract_points(r, q)
        rod = subtract_points(r, self.cylinder_base)
        return FourBarPose(
            m.atan2(rocker[1], rocker[0]),
            m.atan2(coupler[1], coupler[0]),
            m.sqrt(rod[0] ** 2 + rod[1] ** 2),
        )

    def length(self, theta: Scalar) -> Scalar:
        """Return the cylinder's pin-to-pin length c, the distance of rod pin R and cylinder base B.

        Args:
            theta: output angle, any shape [rad].

        Returns:
            Pin-to-pin length, shape of theta [m].

        Raises:
            LoopOpenError: rocker and coupler cannot meet at a requested angle.

        >>> bucket = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35))
        >>> round(bucket.length(-1.0), 4)
        1.7555
        """
        return self.pose(theta).length

    def rate(self, theta: Scalar) -> Scalar:
        """Return the moment arm dc/dtheta = ratio ((R - P) x (R - B)) / c of cylinder on output link.

        R is the rod pin, P the rocker pivot, B the cylinder base, Q and O the output link's pin and
        pivot. ratio = d(rocker angle)/dtheta = ((Q - O) x (R - Q)) / ((R - P) x (R - Q)), because the
        coupler keeps its length.

        Args:
            theta: output angle, any shape [rad].

        Returns:
            Moment arm, shape of theta [m/rad]; infinite if rocker and coupler are collinear (a dead
            point).

        Raises:
            LoopOpenError: rocker and coupler cannot meet at a requested angle.

        >>> bucket = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35))
        >>> round(bucket.rate(-1.0), 4)
        -0.4015
        """
        q, r = self.pin_positions(theta)
        arm, coupler = subtract_points(q, self.output_pivot), subtract_points(r, q)
        rocker, rod = subtract_points(r, self.rocker_pivot), subtract_points(r, self.cylinder_base)
        ratio = cross_product(arm, coupler) / cross_product(rocker, coupler)
        return ratio * cross_product(rocker, rod) / math_module(theta).sqrt(rod[0] ** 2 + rod[1] ** 2)

    def angle(self, length: Scalar) -> Scalar:
        """Return the angle of the output link at a pin-to-pin length of the cylinder.

        The triangle of cylinder base, rocker pivot and rod pin gives the rod pin; that of output
        pivot, rod pin and output pin gives the output pin.

        Of the two solutions of each triangle, the one on the branch of the working angle is used.

        Args:
            length: pin-to-pin length, any shape [m].

        Returns:
            Output angle, shape of length [rad], within pi of the working angle.

        Raises:
            LoopOpenError: the rocker cannot reach the length, the output arm cannot reach the rocker, or
                rocker and coupler would have passed their dead point.

        >>> bucket = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35))
        >>> round(bucket.angle(bucket.length(-1.0)), 9)
        -1.0
        """
        m = math_module(length)
        rod_side, arm_side = self._branch_signs
        ground = math.dist(self.rocker_pivot, self.cylinder_base)
        clip_to_reachable_length(length, abs(ground - self.rocker), ground + self.rocker, "cylinder length")
        r = intersect_bars(self.rocker_pivot, self.cylinder_base, self.rocker, length, rod_side)
        q = intersect_bars(self.output_pivot, r, math.hypot(*self.output_arm), self.coupler, arm_side)
        turned = (
            cross_product(subtract_points(q, self.rocker_pivot), subtract_points(r, self.rocker_pivot)) * self.assembly
        )
        if np.any(turned < -1e-12):
            raise LoopOpenError(f"cylinder length {length} m: rocker and coupler pass their dead point")
        arm = subtract_points(q, self.output_pivot)
        theta = m.atan2(arm[1], arm[0]) - math.atan2(self.output_arm[1], self.output_arm[0])
        return theta - math.tau * m.floor((theta - self.working_angle) / math.tau + 0.5)

    @cached_property
    def _branch_signs(self) -> tuple[int, int]:
        q, r = self.pin_positions(float(self.working_angle))
        rod = cross_product(
            subtract_points(self.cylinder_base, self.rocker_pivot),
            subtract_points(r, self.rocker_pivot),
        )
        arm = cross_product(subtract_points(r, self.output_pivot), subtract_points(q, self.output_pivot))
        return (1 if rod > 0 else -1), (1 if arm > 0 else -1)


Linkage = TwoBar | FourBar

__all__ = ["FourBar", "FourBarPose", "Linkage", "LoopOpenError", "TwoBar", "two_bar_from_points"]

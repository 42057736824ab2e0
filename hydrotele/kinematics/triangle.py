"""Plane triangles of bars: the formulas under every cylinder linkage, for floats and for arrays.

They take differences of lengths before they multiply, so that nothing is lost where a triangle is
nearly flat.
"""

import math
from types import ModuleType

import numpy as np

Scalar = float | np.ndarray
Point = tuple[Scalar, Scalar]


class LoopOpen(ValueError):
    """The pins of a linkage cannot be joined at the angle or the length asked."""


def library(value: Scalar) -> ModuleType:
    """Module whose functions fit the value: NumPy for an array, the faster math for a float.

    Args:
        value: any shape [any unit].

    Returns:
        The module numpy or math; both have sin, cos, sqrt, atan2 and floor under these names (NumPy
        2).

    >>> library(1.0).__name__, library(np.ones(2)).__name__
    ('math', 'numpy')
    """
    return np if isinstance(value, np.ndarray) else math


def minus(a: Point, b: Point) -> Point:
    """Vector a - b in the plane.

    Args:
        a: (x, z), coordinates of any one shape [m].
        b: (x, z), coordinates of any one shape [m].

    Returns:
        (x, z) of the difference [m].

    >>> minus((3.0, 1.0), (1.0, 2.0))
    (2.0, -1.0)
    """
    return a[0] - b[0], a[1] - b[1]


def cross(a: Point, b: Point) -> Scalar:
    """Cross product a_x b_z - a_z b_x: positive if b lies to the left (counter-clockwise) of a.

    Args:
        a: (x, z), coordinates of any one shape [m].
        b: (x, z), coordinates of any one shape [m].

    Returns:
        The product, shape of the coordinates [m^2].

    >>> cross((1.0, 0.0), (0.0, 2.0))
    2.0
    """
    return a[0] * b[1] - a[1] * b[0]


def apex_angle(left: float, right: float, opposite: Scalar) -> Scalar:
    """Angle between two sides of a triangle, tan(B/2)^2 = (c^2 - (a - b)^2) / ((a + b)^2 - c^2).

    Args:
        left: length a of one side [m], > 0.
        right: length b of the other side [m], > 0.
        opposite: length c of the side opposite the angle, any shape [m], in [|a - b|, a + b].

    Returns:
        Angle B, shape of opposite [rad], in [0, pi].

    Raises:
        LoopOpen: a length lies outside [|a - b|, a + b].

    >>> round(math.degrees(apex_angle(3.0, 4.0, 5.0)), 9)
    90.0
    """
    low, high = abs(left - right), left + right
    opposite = closing(opposite, low, high, "pin-to-pin length")
    m = library(opposite)
    sine, cosine = (opposite - low) * (opposite + low), (high - opposite) * (high + opposite)
    return 2 * m.atan2(m.sqrt(sine), m.sqrt(cosine))


def third_pin(near: Point, far: Point, near_bar: Scalar, far_bar: Scalar, side: int) -> Point:
    """Pin that two bars share: the circles about `near` and `far` cut each other there.

    With D = |far - near|, the pin lies (n^2 - f^2 + D^2) / (2 D) along the way and twice the
    triangle's area (Heron) / D beside it.

    Args:
        near: (x, z), coordinates of any one shape [m].
        far: (x, z), coordinates of any one shape [m], not at `near`.
        near_bar: length n of the bar from `near`, any one shape [m], > 0.
        far_bar: length f of the bar from `far`, any one shape [m], > 0.
        side: +1 for the pin to the left of the way from `near` to `far`, -1 to the right [-].

    Returns:
        (x, z) of the shared pin [m].

    Raises:
        LoopOpen: the bars are too short, or too unequal, to meet.

    >>> [round(v, 9) for v in third_pin((0.0, 0.0), (5.0, 0.0), 3.0, 4.0, 1)]
    [1.8, 2.4]
    """
    way_x, way_z = minus(far, near)
    square = way_x * way_x + way_z * way_z
    m = library(square)
    low, high = abs(near_bar - far_bar), near_bar + far_bar
    distance = closing(m.sqrt(square), low, high, "distance of the pins that two bars join")
    flat = (distance - low) * (distance + low) * (high - distance) * (high + distance)
    along = 0.5 * (1 + (near_bar - far_bar) * high / square)
    beside = side * library(flat).sqrt(flat) / (2 * square)
    return near[0] + along * way_x - beside * way_z, near[1] + along * way_z + beside * way_x


def closing(value: Scalar, low: Scalar, high: Scalar, what: str) -> Scalar:
    """Pass a length on if the bars allow it; 1e-12 m too much is rounding and is cut off.

    Args:
        value: length asked, any shape [m].
        low: shortest length the bars allow, scalar or shape of value [m].
        high: longest length the bars allow, scalar or shape of value [m].
        what: name of the length for the message [-].

    Returns:
        The length, within [low, high] [m].

    Raises:
        LoopOpen: a length lies outside [low, high] or is no number.

    >>> closing(2.0 + 1e-15, 1.0, 2.0, "cylinder length")
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
    raise LoopOpen(f"{what} {value:.6g} m asked, the bars allow [{low:.6g}, {high:.6g}] m")

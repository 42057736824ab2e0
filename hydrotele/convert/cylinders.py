"""Place cylinders of typical proportions on the links of an arm, and size them.

Lengths are proportions of shipped machines (CAT 215, CAT 325, EC20): a cylinder has a long arm of
0.4 boom lengths on one side of the joint and a short arm of 0.3 times that on the other, and its
arms enclose a right angle at the middle of the joint's range.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from hydrotele.convert.arm_links import MovingLink, StatedCylinder
from hydrotele.kinematics.linkages import FourBar, LoopOpenError

_LONG_ARM = 0.40  # of the boom length: EC20 0.53, CAT 215 0.39, CAT 325 0.39
_ARM_RATIO = 0.31  # short over long arm: 0.29 .. 0.40
_APEX = math.radians(92.0)  # between the arms at the middle of the range
_MIN_APEX, _MAX_APEX = math.radians(14.0), math.radians(166.0)  # lever arms of a quarter of the short arm
_MAX_TWO_BAR_RANGE = _MAX_APEX - _MIN_APEX
_STROKE_MARGIN = 0.02  # of the stroke beyond the joint's range, at each end
_DEAD_LENGTH = 0.15  # m per m of boom length: pins, piston and gland of a cylinder beyond its stroke
_MIN_DEAD_FRACTION = 0.10  # of the closed length


@dataclass
class PlacedCylinder:
    """Pins (3,) of a cylinder in the frames of their links, and its lengths [m].

    Attributes:
        base_link: link with the base pin.
        base_pin: in the frame of `base_link`.
        rod_link: link with the rod pin.
        rod_pin: in the frame of `rod_link`.
        closed_length: pin to pin, retracted.
        stroke: travel of the rod.
        source: whether the description contains the cylinder.
        lever: smallest lever arm about the joint [m], 1 for a slide.
    """

    base_link: str
    base_pin: np.ndarray
    rod_link: str
    rod_pin: np.ndarray
    closed_length: float
    stroke: float
    source: Literal["stated", "estimated"]
    lever: float


@dataclass
class PlacedFourBar:
    """A cylinder that moves the tool by a rocker and a coupler; points in the frames of their links.

    Attributes:
        cylinder: the cylinder; its rod link is the rocker.
        rocker_pivot: (3,) on the base link.
        coupler_pin: (3,) on the rocker, where rod and coupler meet.
        coupler_length: distance between the pins of the coupler [m].
        tool_pin: (3,) on the tool.
        linkage: the planar linkage.
    """

    cylinder: PlacedCylinder
    rocker_pivot: np.ndarray
    coupler_pin: np.ndarray
    coupler_length: float
    tool_pin: np.ndarray
    linkage: FourBar


def _direction(angle: float) -> np.ndarray:
    return np.array([math.cos(angle), 0.0, math.sin(angle)])


def _slice_heights(link: MovingLink, x: float, half_width: float) -> tuple[float, float] | None:
    """Return lowest and highest z of a link's shapes near a coordinate x [m]; None without shapes there."""
    shapes = [shape for shape in link.visuals or link.collisions]
    if not shapes:
        return None
    points = np.vstack([_surface_points(shape) for shape in shapes])
    near = points[np.abs(points[:, 0] - x) < half_width]
    return (float(near[:, 2].min()), float(near[:, 2].max())) if len(near) else None


def _surface_points(shape) -> np.ndarray:
    """Return vertices and points along the edges of a shape, (n, 3)."""
    points = shape.points()
    if shape.kind != "mesh" or not len(shape.faces):
        centre = points.mean(axis=0)
        return np.vstack([points + (centre - points) * share for share in (0.0, 0.25, 0.5, 0.75)])
    edges = np.vstack([shape.faces[:, [0, 1]], shape.faces[:, [1, 2]], shape.faces[:, [2, 0]]])
    start, stop = points[edges[:, 0]], points[edges[:, 1]]
    return np.vstack([start + (stop - start) * share for share in np.linspace(0.0, 0.9, 10)])


def place_on_hinge(
    parent: MovingLink | None, link: MovingLink, boom_length: float, count: int
) -> PlacedCylinder | None:
    """Place a cylinder on a hinge of the arm's plane.

    A boom is lifted from below: the long arm is on the boom, at half its height for a cylinder on
    each side, otherwise below it. Other links are moved from above the link before, and the long arm
    is there, on its upper side.

    Args:
        parent: link that carries the hinge, None for the base.
        link: link that the hinge moves.
        boom_length: length of the longest arm link [m].
        count: number of parallel cylinders.

    Returns:
        The cylinder, or None if the range of the hinge is too large for it.
    """
    if link.range is None or link.range[1] - link.range[0] > _MAX_TWO_BAR_RANGE:
        return None
    middle = 0.5 * (link.range[0] + link.range[1])
    long = _LONG_ARM * boom_length
    if link.role == "boom":
        long = min(long, 0.6 * link.length) if link.length > 0.2 * boom_length else long
        heights = _slice_heights(link, long, 0.06 * boom_length)
        below = (heights[0] if heights else -0.035 * boom_length) - 0.015 * boom_length
        height = below if count == 1 else 0.5 * sum(heights) if heights else 0.0
        rod = np.array([long, 0.0, height])
        base = _ARM_RATIO * long * _direction(math.atan2(height, long) + middle - _APEX)
    else:
        assert parent is not None
        reach = min(long, 0.8 * float(np.linalg.norm(link.position)) or long)
        heights = _slice_heights(parent, link.position[0] - reach, 0.06 * boom_length)
        top = heights[1] + 0.02 * boom_length if heights else link.position[2] + 0.06 * boom_length
        base = np.array([-reach, 0.0, max(top - link.position[2], 0.02 * boom_length)])
        toward = math.atan2(base[2], base[0])
        short = _ARM_RATIO * reach
        rod = short * _direction(toward - middle - _APEX)
        tail = _find_tail(link, short)
        if tail is not None:
            apex = [toward - q - math.atan2(tail[2], tail[0]) for q in link.range]
            apex = [math.remainder(a, 2.0 * math.pi) % (2.0 * math.pi) for a in apex]
            if all(_MIN_APEX < a < _MAX_APEX for a in apex):
                rod = tail
    return _finish(link, base, rod, "estimated", None)


def _find_tail(link: MovingLink, short: float) -> np.ndarray | None:
    """Return the pin of a link's tail lever: its farthest point behind the joint, less an eye radius.

    None if the link has no tail between 0.4 and 1.6 times the short arm.
    """
    shapes = link.visuals or link.collisions
    if not shapes:
        return None
    points = np.vstack([shape.points() for shape in shapes])
    behind = points[points[:, 0] < 0.2 * short]
    if not len(behind):
        return None
    distances = np.hypot(behind[:, 0], behind[:, 2])
    farthest = behind[np.argmax(distances)]
    length = 0.9 * float(distances.max())
    if not 0.4 * short <= length <= 1.6 * short:
        return None
    return length * _direction(math.atan2(farthest[2], farthest[0]))


def place_on_slide(parent: MovingLink | None, link: MovingLink, boom_length: float) -> PlacedCylinder:
    """Place a cylinder along a slide, above the link that carries it.

    Args:
        parent: link that carries the slide, None for the base.
        link: link that slides.
        boom_length: length of the longest arm link [m].
    """
    low, high = link.range or (0.0, 0.5 * boom_length)
    side = np.cross(link.axis, [0.0, 1.0, 0.0])
    side = side if np.linalg.norm(side) > 0.1 else np.array([0.0, 0.0, 1.0])
    side *= 0.06 * boom_length / np.linalg.norm(side)
    travel = high - low
    closed = 1.2 * travel + 0.04 * boom_length
    base = side - (closed - low - _STROKE_MARGIN * travel) * link.axis
    behind = -float((base + link.position) @ link.axis) if parent is not None else 0.0
    forward = min(max(behind, 0.0), max(link.length, 0.1 * travel)) * link.axis  # so that the base pin is on the parent
    rod, base = side + forward, base + forward
    placed = _finish(link, base, rod, "estimated", None)
    assert placed is not None
    return placed


def place_stated(link: MovingLink, parent: MovingLink | None, stated: StatedCylinder) -> PlacedCylinder | None:
    """Return the cylinder that the description contains; None if it cannot move its joint through the range."""
    base = stated.base_pin - link.position
    offset = (stated.rod_pin - base) @ link.axis if link.kind == "hinge" else 0.0
    rod = stated.rod_pin - offset * link.axis  # into the plane of the base pin
    return _finish(link, base, rod, "stated", stated.stroke)


def _pin_length(link: MovingLink, base: np.ndarray, rod: np.ndarray, q: float) -> float:
    if link.kind == "slide":
        return float(np.linalg.norm(rod + q * link.axis - base))
    from hydrotele.convert.robot_description import rotation_about

    return float(np.linalg.norm(rotation_about(link.axis, q) @ rod - base))


def _finish(
    link: MovingLink, base: np.ndarray, rod: np.ndarray, source: Literal["stated", "estimated"], stroke: float | None
) -> PlacedCylinder | None:
    """Return the cylinder between two pins, with `base` relative to the joint; None if it passes a dead point."""
    low, high = link.range or (0.0, 0.0)
    if not high > low:
        return None
    lengths = [_pin_length(link, base, rod, q) for q in np.linspace(low, high, 41)]
    steps = np.diff(lengths)
    if np.any(steps * steps[0] <= 0.0):
        return None
    travel = max(lengths) - min(lengths)
    closed = min(lengths) - _STROKE_MARGIN * travel
    needed = (1.0 + 2.0 * _STROKE_MARGIN) * travel
    if stroke is not None and needed < stroke < 1.5 * needed:
        closed, needed = min(closed, max(lengths) + _STROKE_MARGIN * travel - stroke), stroke
    if needed > (1.0 - _MIN_DEAD_FRACTION) * closed:
        return None
    lever = float(np.abs(steps).min()) / ((high - low) / 40)
    return PlacedCylinder(link.parent, base + link.position, link.name, rod, closed, needed, source, lever)


def place_four_bar(parent: MovingLink, link: MovingLink, boom_length: float) -> PlacedFourBar | None:
    """Place rocker, coupler and cylinder of a tool, near the proportions of the CAT 215's bucket.

    The bars are those nearest to the typical ones with which the linkage reaches the ends of the
    tool's range, with transmission angles of at least 15 deg and a cylinder whose stroke fits.

    Args:
        parent: the stick.
        link: the tool.
        boom_length: length of the longest arm link [m].

    Returns:
        The linkage, or None if none was found.
    """
    if link.range is None or link.range[1] - link.range[0] > math.radians(190.0):
        return None
    stick = float(np.linalg.norm(link.position))
    scale = min(boom_length / 5.18, stick / 1.8)
    low, high = link.range
    angles = np.linspace(low, high, 25)
    # ground bar, its direction, rocker, coupler, tool arm, its direction at the middle of the range
    typical = np.array([0.325, 2.795, 0.549, 0.485, 0.405, 2.09 - 1.07])
    heights = _slice_heights(parent, 0.05 * stick, 0.08 * stick)
    top = (heights[1] if heights else 0.0) + 0.05 * scale
    base = np.array([0.05 * stick, link.position[1], max(top, 0.15 * scale)])
    pivot = link.position

    def build(values: np.ndarray) -> FourBar:
        ground, way, rocker, coupler, arm, middle = values
        place = pivot + ground * scale * _direction(way)
        tool = arm * scale * _direction(middle - 0.5 * (low + high))
        return FourBar(
            output_pivot=(pivot[0], pivot[2]), rocker_pivot=(place[0], place[2]), cylinder_base=(base[0], base[2]),
            rocker=rocker * scale, coupler=coupler * scale, output_arm=(tool[0], tool[2]),
            working_angle=0.5 * (low + high),
        )  # fmt: skip

    def lengths(values: np.ndarray) -> np.ndarray | None:
        try:
            bar = build(values)
            return np.array([bar.length(float(angle)) for angle in angles])
        except (LoopOpenError, ValueError):
            return None

    def cost(values: np.ndarray) -> float:
        if np.any(values[[0, 2, 3, 4]] < 0.1):
            return 1e3
        distance = float(np.sum(((values - typical) / np.array([0.2, 0.3, 0.2, 0.2, 0.15, 0.4])) ** 2))
        spread = _loop_violation(values, low, high)
        found = lengths(values) if spread == 0.0 else None
        if found is None:
            return 100.0 + 100.0 * spread + distance
        steps = np.diff(found)
        uneven = float(np.maximum(0.15 * np.abs(steps).mean() - steps * np.sign(steps.sum()), 0.0).max())
        travel = abs(found[-1] - found[0])
        excess = max(0.0, travel - 0.82 * float(found.min()))
        return distance + 2.0e3 * uneven / scale + 50.0 * excess / scale

    best = minimize(cost, typical, method="Nelder-Mead", options={"maxiter": 1500, "xatol": 1e-4, "fatol": 1e-4})
    found = lengths(best.x)
    if found is None or best.fun > 100.0:
        return None
    steps = np.diff(found)
    if np.any(steps * steps[0] <= 0.0):
        return None
    travel = abs(float(found[-1] - found[0]))
    closed, stroke = float(found.min()) - _STROKE_MARGIN * travel, (1.0 + 2.0 * _STROKE_MARGIN) * travel
    if stroke >= (1.0 - _MIN_DEAD_FRACTION) * closed:
        return None
    ground, way, rocker, coupler, arm, middle = best.x
    lever = float(np.abs(steps).min()) / (angles[1] - angles[0])
    cylinder = PlacedCylinder(
        parent.name, base, "", np.array([rocker * scale, 0, 0]), closed, stroke, "estimated", lever
    )
    return PlacedFourBar(
        cylinder, pivot + ground * scale * _direction(way), np.array([rocker * scale, 0.0, 0.0]), coupler * scale,
        arm * scale * _direction(middle - 0.5 * (low + high)), build(best.x),
    )  # fmt: skip


def _loop_violation(values: np.ndarray, low: float, high: float) -> float:
    """Return how far a four-bar is from closing with transmission angles of 15 deg over the tool's range [rad]."""
    ground, way, rocker, coupler, arm, middle = values
    worst = 0.0
    for q in np.linspace(low, high, 9):
        arm_direction = middle - 0.5 * (low + high) + q
        gap = math.hypot(
            arm * math.cos(arm_direction) - ground * math.cos(way),
            arm * math.sin(arm_direction) - ground * math.sin(way),
        )
        cosine = (rocker**2 + coupler**2 - gap**2) / (2.0 * rocker * coupler)
        worst = max(worst, abs(cosine) - math.cos(math.radians(15.0)))
    return worst

"""Closed-form kinematics of a feller-buncher arm: swing, boom, stick, tilt and head.

World z is up, x forward. Swing rotates about +z. Boom, stick and tilt move in a vertical plane
through the swing axis and are positive if they raise the outboard end, each measured from the link
before. The head rotates about an axis in that plane, perpendicular to the tilt link and pointing to
its lower side. At head angle 0 the tool's X axis is along the tilt link; a positive angle rotates
it to the right of the plane.

A pose consists of the coordinates that the five joints can choose: position (x, y, z) of the tool
[m], attitude of the tilt link above the horizontal, the sum of boom, stick and tilt angles [rad],
and head angle [rad]. The tool's yaw follows from them.

Source: Zhu 1994, section 2.3 and Table 2.2.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

_REACH_TOLERANCE = 1e-9  # [m] or [1], tolerance for poses computed by `forward_kinematics`
_MAX_PERPENDICULAR_SINE = 1e-9  # sine below which a direction counts as perpendicular to the arm's plane


@dataclass(frozen=True, kw_only=True)
class FellerGeometry:
    """Denavit-Hartenberg lengths of the arm [m].

    Attributes:
        base_radius: distance of the boom pin ahead of the swing axis, a1.
        base_height: height of the boom pin above the origin, d1.
        boom_length: boom pin to stick pin, a2, > 0.
        stick_length: stick pin to tilt pin, a3, > 0.
        tilt_length: tilt pin to head axis, a4.
        head_radius: head axis to tool, along the tool's X axis, a5.
        head_depth: tilt link to tool, along the head's axis, d5.
    """

    base_radius: float
    base_height: float
    boom_length: float
    stick_length: float
    tilt_length: float
    head_radius: float
    head_depth: float

    def __post_init__(self) -> None:
        """Raise ValueError if a length is not finite, or boom or stick length is not positive."""
        if not all(math.isfinite(getattr(self, one.name)) for one in fields(self)):
            raise ValueError(f"lengths must be finite: {self}")
        if not (self.boom_length > 0 and self.stick_length > 0):
            raise ValueError(f"boom_length {self.boom_length} and stick_length {self.stick_length} must be > 0")


class FellerPose(NamedTuple):
    """Pose of the tool: position [m], attitude of the tilt link [rad], head angle [rad]."""

    x: float
    y: float
    z: float
    attitude: float
    head: float


class JointSolution(NamedTuple):
    """Joint angles for a pose.

    Attributes:
        q: swing, boom, stick, tilt, head [rad].
        is_clamped: whether the pose was out of reach, so that `q` belongs to a reachable pose
            nearby. The tilt pin is then moved along the line from the boom pin, or the tool is too
            close to the swing axis.
    """

    q: tuple[float, float, float, float, float]
    is_clamped: bool


def forward_kinematics(geometry: FellerGeometry, q: Sequence[float]) -> FellerPose:
    """Compute the pose of a feller-buncher's tool from the five joint angles.

    Args:
        geometry: the arm.
        q: swing, boom, stick, tilt, head (5,) [rad].

    Returns:
        The pose; angles are not wrapped.

    >>> arm = FellerGeometry(base_radius=0.3, base_height=2.2, boom_length=5.9, stick_length=2.95,
    ...                      tilt_length=0.55, head_radius=0.35, head_depth=0.6)
    >>> [round(v, 6) for v in forward_kinematics(arm, (0.0, math.pi / 2, -math.pi / 2, 0.0, 0.0))]
    [4.15, 0.0, 7.5, 0.0, 0.0]
    """
    swing, boom, stick, tilt, head = q
    g, elbow = geometry, boom + stick
    attitude = elbow + tilt
    out = g.tilt_length + g.head_radius * math.cos(head)
    r = (
        g.base_radius + g.boom_length * math.cos(boom) + g.stick_length * math.cos(elbow)
        + out * math.cos(attitude) + g.head_depth * math.sin(attitude)
    )  # fmt: skip
    z = (
        g.base_height + g.boom_length * math.sin(boom) + g.stick_length * math.sin(elbow)
        + out * math.sin(attitude) - g.head_depth * math.cos(attitude)
    )  # fmt: skip
    aside = g.head_radius * math.sin(head)  # to the right
    c, s = math.cos(swing), math.sin(swing)
    return FellerPose(r * c + aside * s, r * s - aside * c, z, attitude, head)


def tool_direction(q: Sequence[float]) -> np.ndarray:
    """Return the direction (3,) of the tool's X axis for joint angles (5,) [rad]."""
    swing, head, attitude = q[0], q[4], q[1] + q[2] + q[3]
    ahead = math.cos(head) * math.cos(attitude)
    c, s, aside = math.cos(swing), math.sin(swing), math.sin(head)
    return np.array([
        ahead * c + aside * s, ahead * s - aside * c, math.cos(head) * math.sin(attitude)
    ])  # fmt: skip


def inverse_kinematics(geometry: FellerGeometry, pose: FellerPose) -> JointSolution:
    """Compute the joint angles for a tool position, attitude and head angle, with a stick angle of 0 or below.

    The tool is offset from the arm's plane by head radius times sine of the head angle; the swing
    angle takes this into account. The solution in which the arm reaches backwards over its own
    swing axis is discarded. An unreachable pose is replaced by the nearest reachable pose, which
    depends continuously on the requested one.

    Args:
        geometry: the arm.
        pose: pose of the tool.

    Returns:
        The joint angles, and whether they were clamped. Swing is within +-pi.

    Source: Zhu 1994, 2.11-2.25 (first approach).
    """
    aside = geometry.head_radius * math.sin(pose.head)
    far = math.hypot(pose.x, pose.y)
    near = far < abs(aside) - _REACH_TOLERANCE
    swing = math.atan2(pose.y, pose.x) + math.asin(max(-1.0, min(1.0, aside / max(far, 1e-300))))
    r = math.sqrt(max(far**2 - aside**2, 0.0))
    found = _inverse_in_plane(geometry, r, pose.z, pose.attitude, pose.head)
    boom, stick, tilt = found.q[1:4]
    return JointSolution((_wrap_angle(swing), boom, stick, tilt, pose.head), near or found.is_clamped)


def inverse_kinematics_for_direction(
    geometry: FellerGeometry, position: Sequence[float], direction: Sequence[float]
) -> tuple[JointSolution, ...]:
    """Compute all joint angles for a tool position and a direction of the tool's X axis.

    There are two azimuths, with the arm reaching ahead or back over its own axis, and two head
    angles for each. The stick angle is 0 or below.

    Args:
        geometry: the arm.
        position: position of the tool (3,) [m].
        direction: direction of the tool's X axis (3,), of any nonzero length.

    Returns:
        The reachable solutions, those that reach ahead first; may be empty. If the direction is
        perpendicular to the arm's plane, the attitude is arbitrary and set to 0.

    Raises:
        ValueError: the direction has no length.

    Source: Zhu 1994, 2.26-2.50 (second approach).
    """
    m, p = np.asarray(direction, float), np.asarray(position, float)
    length = float(np.linalg.norm(m))
    if not length > 0.0:
        raise ValueError("the direction has no length")
    m = m / length
    root = p - geometry.head_radius * m  # on the head's axis, in the arm's plane
    found = []
    for turn in (0.0, math.pi):
        swing = math.atan2(root[1], root[0]) + turn
        c, s = math.cos(swing), math.sin(swing)
        r, ahead, aside = root[0] * c + root[1] * s, m[0] * c + m[1] * s, m[0] * s - m[1] * c
        for side in (1.0, -1.0):
            across = side * math.hypot(ahead, m[2])
            head = math.atan2(aside, across)
            attitude = math.atan2(side * m[2], side * ahead) if abs(across) > _MAX_PERPENDICULAR_SINE else 0.0
            bare = geometry.head_radius * math.cos(head)
            plane = _inverse_in_plane(
                geometry, r + bare * math.cos(attitude), root[2] + bare * math.sin(attitude),
                attitude, head,
            )  # fmt: skip
            if not plane.is_clamped:
                found.append(JointSolution((_wrap_angle(swing), *plane.q[1:4], head), False))
    return tuple(found)


def jacobian(geometry: FellerGeometry, q: Sequence[float]) -> np.ndarray:
    """Compute the derivatives (5, 5) of the tool's pose (x, y, z, attitude, head) by the joint angles.

    Args:
        geometry: the arm.
        q: joint angles (5,) [rad].

    Returns:
        The derivatives [m/rad] and [1].
    """
    swing, boom, stick, tilt, head = q
    pose, g = forward_kinematics(geometry, q), geometry
    c, s, attitude = math.cos(swing), math.sin(swing), boom + stick + tilt
    out = g.tilt_length + g.head_radius * math.cos(head)
    last = (
        -out * math.sin(attitude) + g.head_depth * math.cos(attitude),
        out * math.cos(attitude) + g.head_depth * math.sin(attitude),
    )
    lever = [last]
    for length, angle in ((g.stick_length, boom + stick), (g.boom_length, boom)):
        dr, dz = lever[-1]
        lever.append((dr - length * math.sin(angle), dz + length * math.cos(angle)))
    table = np.zeros((5, 5))
    table[:3, 0] = -pose.y, pose.x, 0.0
    for column, (dr, dz) in zip((3, 2, 1), lever, strict=True):
        table[:3, column] = dr * c, dr * s, dz
    bent, aside = -g.head_radius * math.sin(head), g.head_radius * math.cos(head)
    dr, dz = bent * math.cos(attitude), bent * math.sin(attitude)
    table[:3, 4] = dr * c + aside * s, dr * s - aside * c, dz
    table[3, 1:4] = 1.0
    table[4, 4] = 1.0
    return table


def _inverse_in_plane(geometry: FellerGeometry, r: float, z: float, attitude: float, head: float) -> JointSolution:
    """Compute boom, stick and tilt angle for a tool position and attitude in the arm's plane.

    `r` and `z` are distance ahead of the swing axis and height [m]. The result has swing 0, the
    given head angle, and a stick angle of 0 or below. If the position is out of reach, the tilt pin
    is moved to the nearest reachable point on its line to the boom pin, and `is_clamped` is set.
    """
    g = geometry
    out = g.tilt_length + g.head_radius * math.cos(head)
    across = r - g.base_radius - out * math.cos(attitude) - g.head_depth * math.sin(attitude)
    up = z - g.base_height - out * math.sin(attitude) + g.head_depth * math.cos(attitude)
    a, b, far = g.boom_length, g.stick_length, math.hypot(across, up)
    reach = min(max(far, abs(a - b)), a + b)
    inner = (reach**2 - a**2 - b**2) / (2.0 * a * b)
    stick = -math.acos(max(-1.0, min(1.0, inner)))
    boom = math.atan2(up, across) - math.atan2(b * math.sin(stick), a + b * math.cos(stick))
    clamped = abs(reach - far) > _REACH_TOLERANCE
    return JointSolution((0.0, boom, stick, attitude - boom - stick, head), clamped)


def _wrap_angle(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)

"""Closed-form kinematics of an excavator arm: forward, inverse and Jacobians.

World z is up, x forward. Swing is positive about +z. Boom, stick and tool are positive if they
raise the outboard end; the boom is measured from the horizontal, the stick from the boom, the tool
from the stick. The arm moves in a vertical plane at the distance `lateral_offset` from the swing
axis, so that the azimuth of the controlled point depends on its radius.

A pose is (r, theta, z, phi): radius [m], azimuth [rad] and height [m] of the controlled point and
attitude of the tool [rad], the sum of boom, stick and tool angles. An arm without a tool joint has
q = (swing, boom, stick) and pose (r, theta, z). All functions use plain floats and the math module,
because the controller calls them 200 times per second.

Source: Zhu 1994, section 2.2, Eqs 2.2-2.6. Zhu's d2 is -lateral_offset: his z axis of the boom
joint points to the right.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_REACH_TOLERANCE = 1e-12  # [m], so that a stretched pose computed by `forward_kinematics` can be inverted


class UnreachableError(ValueError):
    """No joint angles bring the controlled point to the requested pose."""


@dataclass(frozen=True, kw_only=True)
class ArmGeometry:
    """Dimensions of the arm, from the swing axis outwards.

    Attributes:
        base_radius: distance of the boom pin ahead of the swing axis, a1 [m].
        lateral_offset: y of the arm plane in the swing frame, d2 with sign, left positive [m].
        boom_length: boom pin to stick pin, a2 [m], > 0.
        stick_length: stick pin to tool pin, a3 [m], > 0.
        boom_pin_height: height of the boom pin above the origin of z [m]; 0 puts the origin at the
            boom pin.
        tool_offset: controlled point in the frame of the last link, from the tool pin, (along, up)
            [m].
        has_tool_joint: whether the tool rotates on the stick; if not, its frame is parallel to the
            stick's.
    """

    base_radius: float
    lateral_offset: float
    boom_length: float
    stick_length: float
    boom_pin_height: float = 0.0
    tool_offset: tuple[float, float] = (0.0, 0.0)
    has_tool_joint: bool = True

    def __post_init__(self) -> None:
        """Raise ValueError for links without length."""
        if not (self.boom_length > 0 and self.stick_length > 0):
            raise ValueError(f"boom_length {self.boom_length} and stick_length {self.stick_length} must be > 0")


def forward_kinematics(geometry: ArmGeometry, q: Sequence[float]) -> tuple[float, ...]:
    """Compute the arm's pose from its joint angles, in cylindrical coordinates about the swing axis.

    x = a1 + a2 cos(q2) + a3 cos(q2 + q3) + tool, z likewise with sines; r = sqrt(x^2 + d2^2),
    theta = q1 + atan2(d2, x), phi = q2 + q3 + q4. `ArmGeometry` gives the lengths a1, a2, a3 and the
    lateral offset d2.

    Args:
        geometry: the arm.
        q: swing, boom, stick and, with a tool joint, tool angle, (4,) or (3,) [rad].

    Returns:
        r [m], theta [rad], z [m] and, with a tool joint, phi [rad]. theta and phi are not wrapped.

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=-0.110, boom_length=5.180, stick_length=1.800
    ... )
    >>> [round(v, 4) for v in forward_kinematics(cat215, (0.0, math.radians(27.8), math.radians(-80.6), 0.0))]
    [6.0114, -0.0183, 0.9821, -0.9215]
    """
    x, z = _plane_point_and_derivatives(geometry, q)[0]
    r, theta = math.hypot(x, geometry.lateral_offset), q[0] + math.atan2(geometry.lateral_offset, x)
    z += geometry.boom_pin_height
    return (r, theta, z, q[1] + q[2] + q[3]) if geometry.has_tool_joint else (r, theta, z)


def forward_kinematics_cartesian(geometry: ArmGeometry, q: Sequence[float]) -> tuple[float, float, float]:
    """Compute the Cartesian position of the arm's controlled point from its joint angles (Zhu 1994, Eq. 2.2).

    (x, y) = Rot(q1) (x of the arm plane, d2), with the lateral offset d2 of this plane.

    Args:
        geometry: the arm.
        q: swing, boom, stick and, with a tool joint, tool angle, (4,) or (3,) [rad].

    Returns:
        x forward, y left, z up in the frame in which the swing is zero [m].

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=-0.110, boom_length=5.180, stick_length=1.800
    ... )
    >>> [round(v, 4) for v in forward_kinematics_cartesian(cat215, (math.pi / 2, 0.0, -math.pi / 2, 0.0))]
    [0.11, 5.52, -1.8]
    """
    x, z = _plane_point_and_derivatives(geometry, q)[0]
    cosine, sine, y = math.cos(q[0]), math.sin(q[0]), geometry.lateral_offset
    return cosine * x - sine * y, sine * x + cosine * y, z + geometry.boom_pin_height


def inverse_kinematics(geometry: ArmGeometry, pose: Sequence[float], elbow: int = 1) -> tuple[float, ...]:
    """Compute the joint angles of an excavator arm for a pose (Zhu 1994, Eqs 2.3-2.6).

    x = sqrt(r^2 - d2^2), q1 = theta - atan2(d2, x), with the lateral offset d2 of the arm's plane. The
    tool offset, rotated by phi, is subtracted. l is the distance from boom pin to tool pin, a2 the boom
    length and a3 the stick length. With A = (a2 + a3)^2 - l^2, B = l^2 - (a2 - a3)^2:
    q3 = -atan2(2 sqrt(A B), B - A), q2 = direction of the tool pin minus direction of
    (a2 + a3 cos(q3), a3 sin(q3)), q4 = phi - q2 - q3. Without a tool joint the stick and the fixed
    tool are one straight bar from the stick pin to the controlled point.

    The error is below 1e-10 rad if boom and stick are more than 1e-4 rad from collinear and the
    point is at least 0.1 m ahead of the swing axis. The error is a property of the pose: rounding r
    or z by 1e-15 m changes the elbow by 1e-15 / sin(q3), 1e-8 rad at full stretch.

    Args:
        geometry: the arm.
        pose: r [m], theta [rad], z [m] and, with a tool joint, phi [rad]; the controlled point is
            ahead of the swing axis.
        elbow: +1 for the elbow above the line from boom pin to tool pin, as machines are built; -1
            for below [-].

    Returns:
        Swing, boom, stick and, with a tool joint, tool angle [rad]; boom within (-pi, pi], swing
        and tool not wrapped.

    Raises:
        UnreachableError: the pose is out of reach; the message gives the requested distance and the
            reachable interval.

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=-0.110, boom_length=5.180, stick_length=1.800
    ... )
    >>> [round(v, 9) for v in inverse_kinematics(cat215, forward_kinematics(cat215, (0.5, 0.4, -1.2, -0.3)))]
    [0.5, 0.4, -1.2, -0.3]
    """
    x, z, outer, bend = outer_bar_end(geometry, pose)
    inner = geometry.boom_length
    distance = math.hypot(x, z)
    folded, stretched = abs(inner - outer), inner + outer
    if not folded - _REACH_TOLERANCE <= distance <= stretched + _REACH_TOLERANCE:
        raise UnreachableError(
            f"the tool pin would be {distance:.6g} m from the boom pin, reachable is [{folded:.6g}, {stretched:.6g}] m"
        )
    flexed = max(0.0, stretched - distance) * (stretched + distance)
    extended = max(0.0, distance - folded) * (distance + folded)
    sine, cosine = -elbow * 2 * math.sqrt(flexed * extended), extended - flexed
    along, up = 4 * inner * inner + cosine, sine  # sine and cosine carry the factor 4 inner outer
    boom = math.atan2(z * along - x * up, x * along + z * up)
    stick = math.atan2(sine, cosine) - bend
    swing = pose[1] - math.atan2(geometry.lateral_offset, _plane_x(geometry, pose[0]))
    arm = swing, boom, stick
    return (*arm, pose[3] - boom - stick) if geometry.has_tool_joint else arm


def jacobian(geometry: ArmGeometry, q: Sequence[float]) -> np.ndarray:
    """Compute the derivatives of the arm's cylindrical pose (r, theta, z, phi) by its joint angles.

    dr = (x/r) dx, dtheta = dq1 - (d2/r^2) dx; dz and dphi are the derivatives of z and phi. x is the
    distance ahead of the swing axis in the arm's plane, and d2 the lateral offset of this plane.

    Args:
        geometry: the arm.
        q: swing, boom, stick and, with a tool joint, tool angle, (4,) or (3,) [rad].

    Returns:
        d(r, theta, z, phi)/dq, (4, 4), or d(r, theta, z)/dq, (3, 3); rows in [m/rad], [1], [m/rad],
        [1].

    Raises:
        ZeroDivisionError: the controlled point is on the swing axis, where theta is undefined.

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=-0.110, boom_length=5.180, stick_length=1.800
    ... )
    >>> jacobian(cat215, (0.0, 0.0, -math.pi / 2, 0.0)).round(4)[:, 1]
    array([1.7996, 0.0065, 5.18  , 1.    ])
    """
    (x, _), dx, dz = _plane_point_and_derivatives(geometry, q)
    square = x * x + geometry.lateral_offset * geometry.lateral_offset
    radial, turning = x / math.sqrt(square), -geometry.lateral_offset / square
    rows = [[0.0, *(radial * v for v in dx)], [1.0, *(turning * v for v in dx)], [0.0, *dz]]
    return np.array([*rows, [0.0, 1.0, 1.0, 1.0]] if geometry.has_tool_joint else rows)


def cartesian_jacobian(geometry: ArmGeometry, q: Sequence[float]) -> np.ndarray:
    """Compute the derivatives of the arm's Cartesian position by its joint angles.

    The transpose maps a force on the controlled point to joint torques.

    Args:
        geometry: the arm.
        q: swing, boom, stick and, with a tool joint, tool angle, (4,) or (3,) [rad].

    Returns:
        d(x, y, z)/dq, (3, 4), or (3, 3) without a tool joint [m/rad].

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=-0.110, boom_length=5.180, stick_length=1.800
    ... )
    >>> cartesian_jacobian(cat215, (0.0, 0.0, -math.pi / 2, 0.0)).round(4)[:, :2]
    array([[0.11, 1.8 ],
           [5.52, 0.  ],
           [0.  , 5.18]])
    """
    (x, _), dx, dz = _plane_point_and_derivatives(geometry, q)
    cosine, sine, y = math.cos(q[0]), math.sin(q[0]), geometry.lateral_offset
    return np.array(
        [
            [-sine * x - cosine * y, *(cosine * v for v in dx)],
            [cosine * x - sine * y, *(sine * v for v in dx)],
            [0.0, *dz],
        ]
    )


def _plane_point_and_derivatives(
    geometry: ArmGeometry, q: Sequence[float]
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Compute the controlled point in the arm's vertical plane, and its derivatives by the joint angles.

    Returns:
        ((x, z), dx/dq, dz/dq). x is the distance ahead of the swing axis and z the height above the
        boom pin [m]. The derivatives are by the angles q[1:], without the swing [m/rad].

    Raises:
        ValueError: the number of angles is not that of the arm's joints.
    """
    if len(q) != 3 + geometry.has_tool_joint:
        raise ValueError(f"this arm has {3 + geometry.has_tool_joint} joints, got {len(q)} angles")
    along, up = geometry.tool_offset
    stick = q[1] + q[2]
    boom_x, boom_z = geometry.boom_length * math.cos(q[1]), geometry.boom_length * math.sin(q[1])
    cosine, sine = math.cos(stick), math.sin(stick)
    stick_x, stick_z = geometry.stick_length * cosine, geometry.stick_length * sine
    if not geometry.has_tool_joint:
        outer_x = stick_x + along * cosine - up * sine
        outer_z = stick_z + along * sine + up * cosine
        x, z = boom_x + outer_x, boom_z + outer_z
        return (geometry.base_radius + x, z), (-z, -outer_z), (x, outer_x)
    cosine, sine = math.cos(stick + q[3]), math.sin(stick + q[3])
    tool_x, tool_z = along * cosine - up * sine, along * sine + up * cosine
    outer_x, outer_z = stick_x + tool_x, stick_z + tool_z
    x, z = boom_x + outer_x, boom_z + outer_z
    return (geometry.base_radius + x, z), (-z, -outer_z, -tool_z), (x, outer_x, tool_x)


def outer_bar_end(geometry: ArmGeometry, pose: Sequence[float]) -> tuple[float, float, float, float]:
    """Compute where the outer bar of an arm must end for a pose, and the length of this bar.

    With a tool joint, the outer bar is the stick and ends at the tool pin. Without one, it is the
    straight line from the stick pin to the controlled point.

    Args:
        geometry: the arm.
        pose: r [m], theta [rad], z [m] and, with a tool joint, phi [rad].

    Returns:
        (x, z, length, angle): x ahead of and z above the boom pin, in the arm plane, at which the
        bar must end [m]; length of the bar [m]; angle from the stick to the bar [rad].

    Raises:
        UnreachableError: the radius is less than the lateral offset of the arm plane.

    >>> arm = ArmGeometry(base_radius=0.3, lateral_offset=0.0, boom_length=5.2, stick_length=1.8)
    >>> outer_bar_end(arm, (5.3, 0.0, 1.0, 0.0))
    (5.0, 1.0, 1.8, 0.0)
    """
    if len(pose) != 3 + geometry.has_tool_joint:
        raise ValueError(f"this arm's pose has {3 + geometry.has_tool_joint} numbers, got {len(pose)}")
    x = _plane_x(geometry, pose[0]) - geometry.base_radius
    z = pose[2] - geometry.boom_pin_height
    along, up = geometry.tool_offset
    if not geometry.has_tool_joint:
        straight = geometry.stick_length + along
        return x, z, math.hypot(straight, up), math.atan2(up, straight)
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    x, z = x - along * cosine + up * sine, z - along * sine - up * cosine
    return x, z, geometry.stick_length, 0.0


def _plane_x(geometry: ArmGeometry, r: float) -> float:
    """Return the distance x ahead of the swing axis, in the arm plane, of a point at radius r [m].

    Raises:
        UnreachableError: the radius is less than the lateral offset of the arm plane.
    """
    side = abs(geometry.lateral_offset)
    if not r >= side:
        raise UnreachableError(
            f"radius {r:.6g} m requested, the arm plane passes the swing axis at {side:.6g} m: "
            f"reachable is [{side:.6g}, inf) m"
        )
    return math.sqrt((r - side) * (r + side))

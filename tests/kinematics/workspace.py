"""How far the arm reaches: the margin of a pose, and the radii that a height allows."""

import math
from collections.abc import Sequence

from hydrotele.kinematics.arm import ArmGeometry, UnreachableError, outer_bar_end


def reach(geometry: ArmGeometry, pose: Sequence[float]) -> float:
    """Margin of a pose to the nearest edge of the reach of the bare geometry; never raises.

    min(r - |d2|, l - |a2 - a3|, a2 + a3 - l), with l the distance from boom pin to tool pin.
    `inverse` raises below -1e-12.

    Args:
        geometry: the arm.
        pose: r [m], theta [rad], z [m] and, with a tool joint, phi [rad].

    Returns:
        Margin [m], negative out of reach; NaN for a pose with NaN.

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=0.0, boom_length=5.180, stick_length=1.800
    ... )
    >>> round(reach(cat215, (7.0, 0.0, 0.0, 0.0)), 9), round(reach(cat215, (8.0, 0.0, 0.0, 0.0)), 9)
    (0.32, -0.68)
    """
    beside = pose[0] - abs(geometry.lateral_offset)
    if not beside >= 0:
        return beside
    x, z, outer, _ = outer_bar_end(geometry, pose)
    distance = math.hypot(x, z)
    return min(
        distance - abs(geometry.boom_length - outer),
        geometry.boom_length + outer - distance,
        beside,
    )


def radial_interval(geometry: ArmGeometry, z: float, phi: float = 0.0) -> tuple[float, float]:
    """Radii that the controlled point can have at a height, ahead of the boom pin.

    With x, w the tool pin as seen from the boom pin: (a2 - a3)^2 - w^2 <= x^2 <= (a2 + a3)^2 - w^2.
    Joint limits are not looked at.

    Args:
        geometry: the arm.
        z: height of the controlled point [m].
        phi: attitude of the tool [rad]; without a tool joint it has no effect.

    Returns:
        Least and greatest radius r [m].

    Raises:
        Unreachable: no radius is reachable at this height ahead of the swing axis.

    >>> cat215 = ArmGeometry(
    ...     base_radius=0.340, lateral_offset=0.0, boom_length=5.180, stick_length=1.800
    ... )
    >>> [round(v, 9) for v in radial_interval(cat215, 0.0)]
    [3.72, 7.32]
    """
    side = geometry.lateral_offset
    pin_x, height, outer, _ = outer_bar_end(geometry, (abs(side), 0.0, z, phi)[: 3 + geometry.has_tool_joint])
    stretched = geometry.boom_length + outer
    if not abs(height) <= stretched:
        raise UnreachableError(
            f"the tool pin would be {height:.6g} m above the boom pin, "
            f"reachable is [{-stretched:.6g}, {stretched:.6g}] m"
        )
    ahead = -pin_x  # x of the controlled point when the tool pin is straight above the boom pin
    near = ahead + math.sqrt(max(0.0, (geometry.boom_length - outer) ** 2 - height**2))
    far = ahead + math.sqrt((stretched - height) * (stretched + height))
    if far < 0:
        raise UnreachableError(f"at height {z:.6g} m the point would be at most {far:.6g} m ahead of the swing axis")
    return math.hypot(max(near, 0.0), side), math.hypot(far, side)

"""Pose measurement by the 3-2-1 wire method: six wires to three points of a platform.

Three wires end at the first point, two at the second, one at the third. The first point is the
intersection of three spheres. With the known distances between the points, the second and the third
point are also intersections of three spheres. Each intersection has two solutions, mirrored in the
plane of the centres; the one near an expected pose is used.

Source: Wang 2012, chapter 5 (3-2-1 wire-based pose estimation, three spheres' intersection). The
chapter is not in the available text; the equations are those of trilateration by Manolakis 1996
and Thomas and Ros 2005.
"""

from typing import Annotated

import numpy as np
from pydantic import Field

from hydrotele.core.datafile import StrictModel, Vector
from hydrotele.kinematics.hybrid_robot import PlatformPose

_POINT_OF_WIRE = (0, 0, 0, 1, 1, 2)  # platform point of each wire


class WireGeometry(StrictModel):
    """Geometry of six wires.

    Attributes:
        anchors: fixed ends of the wires in frame 0 [m]: three for the first point, two for the
            second, one for the third.
        points: the three points in the moving platform's frame [m].
    """

    anchors: Annotated[tuple[Vector, ...], Field(min_length=6, max_length=6)]
    points: Annotated[tuple[Vector, ...], Field(min_length=3, max_length=3)]


class NoIntersectionError(ValueError):
    """The wires with the given lengths have no common end point, because they are too short or too long."""


def wire_lengths(wires: WireGeometry, pose: PlatformPose) -> np.ndarray:
    """Compute the lengths of the six measuring wires at poses of the platform.

    Args:
        wires: geometry of the wires.
        pose: (...) poses of the moving platform.

    Returns:
        (..., 6) lengths [m].
    """
    ends = np.einsum("...ij,kj->...ki", pose.rotation, np.array(wires.points)[list(_POINT_OF_WIRE)])
    return np.linalg.norm(ends + pose.position[..., None, :] - np.array(wires.anchors), axis=-1)


def trilaterate(centres: np.ndarray, radii: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Compute the point at given distances from three centres (intersection of three spheres).

    In the frame with x from centre 1 to 2 and y in the centres' plane, with d = |c2 - c1| and
    centre 3 at (i, j): x = (r1^2 - r2^2 + d^2) / 2d, y = (r1^2 - r3^2 + i^2 + j^2) / 2j - i x / j,
    z^2 = r1^2 - x^2 - y^2.

    Args:
        centres: (..., 3, 3) centres, one per row [m].
        radii: (..., 3) radii [m].
        near: (..., 3) approximate position, which selects one of the two solutions [m].

    Returns:
        (..., 3) intersections [m].

    Raises:
        NoIntersectionError: the spheres do not meet.

    >>> c = np.eye(3) * 2.0
    >>> trilaterate(c, np.linalg.norm(c - 1.0, axis=-1), np.array([0.9, 1.0, 1.0])).round(12)
    array([1., 1., 1.])
    """
    one, two, three = np.moveaxis(np.asarray(centres, float), -2, 0)
    r1, r2, r3 = np.moveaxis(np.asarray(radii, float), -1, 0)
    d = np.linalg.norm(two - one, axis=-1)
    ex = (two - one) / d[..., None]
    i = np.sum(ex * (three - one), axis=-1)
    ey = three - one - i[..., None] * ex
    j = np.linalg.norm(ey, axis=-1)
    ey = ey / j[..., None]
    ez = np.cross(ex, ey)
    x = (r1**2 - r2**2 + d**2) / (2.0 * d)
    y = (r1**2 - r3**2 + i**2 + j**2) / (2.0 * j) - i * x / j
    square = r1**2 - x**2 - y**2
    if not (square > 0.0).all():
        where = np.flatnonzero(~(np.ravel(square) > 0.0))
        raise NoIntersectionError(f"the wires do not meet at pose {where[0] + 1}")
    flat = one + x[..., None] * ex + y[..., None] * ey
    side = np.sign(np.sum((near - flat) * ez, axis=-1))
    return flat + (np.where(side < 0.0, -1.0, 1.0) * np.sqrt(square))[..., None] * ez


def pose_from_wires(wires: WireGeometry, lengths: np.ndarray, near: PlatformPose) -> PlatformPose:
    """Compute the pose of the platform from the lengths of the six wires.

    Args:
        wires: geometry of the wires.
        lengths: (..., 6) lengths [m].
        near: (...) expected poses, such as those of the nominal kinematics. Each sphere
            intersection has two solutions; the one near the expected pose is used.

    Returns:
        (...) poses of the platform in frame 0.

    Raises:
        NoIntersectionError: no pose has these wire lengths.
    """
    lengths = np.asarray(lengths, float)
    anchors, points = np.array(wires.anchors), np.array(wires.points)
    shape = lengths.shape[:-1]
    expected = np.einsum("...ij,kj->...ki", near.rotation, points) + near.position[..., None, :]
    of_first = np.broadcast_to(anchors[:3], (*shape, 3, 3))
    first = trilaterate(of_first, lengths[..., :3], expected[..., 0, :])
    side = np.linalg.norm(points[:, None] - points, axis=-1)
    two = np.broadcast_to(anchors[3:5], (*shape, 2, 3))
    centres = np.concatenate([two, first[..., None, :]], axis=-2)
    radii = np.concatenate([lengths[..., 3:5], np.full((*shape, 1), side[0, 1])], axis=-1)
    second = trilaterate(centres, radii, expected[..., 1, :])
    centres = np.stack([np.broadcast_to(anchors[5], (*shape, 3)), first, second], axis=-2)
    sides = np.broadcast_to([side[0, 2], side[1, 2]], (*shape, 2))
    radii = np.concatenate([lengths[..., 5:], sides], axis=-1)
    third = trilaterate(centres, radii, expected[..., 2, :])
    rotation = _axes_from_points(first, second, third) @ np.swapaxes(_axes_from_points(*points), -1, -2)
    return PlatformPose(rotation, first - np.einsum("...ij,j->...i", rotation, points[0]))


def _axes_from_points(first, second, third) -> np.ndarray:
    """Build the axes (..., 3, 3) of a frame from three points: x from first to second, z normal to the plane."""
    x = second - first
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = np.cross(x, third - first)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def wire_jacobian(wires: WireGeometry, pose: PlatformPose) -> np.ndarray:
    """Compute the derivatives of wire lengths by the platform's position [m] and rotation vector [rad].

    Args:
        wires: geometry of the wires.
        pose: (...) poses of the moving platform.

    Returns:
        (..., 6, 6): row k is (u_k, (R p_k) x u_k): u_k is the unit vector of wire k from its anchor to
        its platform point, p_k this point in the platform frame, R the rotation of the platform.
    """
    arms = np.einsum("...ij,kj->...ki", pose.rotation, np.array(wires.points)[list(_POINT_OF_WIRE)])
    away = arms + pose.position[..., None, :] - np.array(wires.anchors)
    unit = away / np.linalg.norm(away, axis=-1, keepdims=True)
    return np.concatenate([unit, np.cross(arms, unit)], axis=-1)


def pose_covariance(wires: WireGeometry, pose: PlatformPose, sigma: float) -> np.ndarray:
    """Compute the covariance of platform poses due to independent errors of the wire lengths.

    It is J^-1 sigma^2 J^-T with the derivatives J of the wire lengths by the pose, because the pose reproduces all
    six lengths.

    Args:
        wires: geometry of the wires.
        pose: (...) measured poses.
        sigma: standard deviation of a wire's length [m].

    Returns:
        (..., 6, 6) covariance of position [m] and rotation vector [rad] in frame 0.
    """
    inverse = np.linalg.inv(wire_jacobian(wires, pose))
    return sigma**2 * inverse @ np.swapaxes(inverse, -1, -2)

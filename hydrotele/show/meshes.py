"""Triangle meshes [m] of primitive shapes.

Each primitive is centred at the origin with its axis along z, and its triangles are wound so that
normals point outwards.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Mesh(NamedTuple):
    """Triangle mesh.

    Attributes:
        vertices: (v, 3) [m].
        normals: (v, 3) unit vectors.
        triangles: (t, 3) indices into `vertices`.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray


def make_box_mesh(half_sizes) -> Mesh:
    """Create the triangle mesh of a box with half edge lengths (3,) [m] and flat faces.

    >>> make_box_mesh((1, 2, 3)).vertices.max(axis=0).tolist()
    [1.0, 2.0, 3.0]
    """
    vertices, normals, triangles = [], [], []
    for axis in range(3):
        u, v = np.roll(np.eye(3), axis, axis=1)[1:]
        for sign in (1.0, -1.0):
            out = sign * np.roll(np.eye(3), axis, axis=1)[0]
            corners = [out - u - v, out + u - v, out + u + v, out - u + v]
            start = len(vertices)
            order = (0, 1, 2, 0, 2, 3) if sign > 0 else (0, 2, 1, 0, 3, 2)
            vertices += corners
            normals += [out] * 4
            triangles += [[start + k for k in order[:3]], [start + k for k in order[3:]]]
    return Mesh(np.array(vertices) * np.asarray(half_sizes), np.array(normals), np.array(triangles))


def revolution_mesh(radii, heights, profile_normals, segments: int = 24) -> Mesh:
    """Create the triangle mesh of a surface of revolution about z from the points of its profile.

    Args:
        radii: (k,) radii of the profile points [m], from the lower to the upper end.
        heights: (k,) heights of the profile points [m].
        profile_normals: (k, 2) radial and axial component of the normal at each profile point. A sharp
            edge consists of two equal points with different normals.
        segments: number of segments around the axis.

    Returns:
        Mesh with k (segments + 1) vertices.
    """
    around = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    radii, heights, profile_normals = (np.asarray(a, float) for a in (radii, heights, profile_normals))
    vertices = np.empty((len(radii), segments + 1, 3))
    vertices[..., :2] = radii[:, None, None] * ring
    vertices[..., 2] = heights[:, None]
    normals = np.empty_like(vertices)
    normals[..., :2] = profile_normals[:, 0, None, None] * ring
    normals[..., 2] = profile_normals[:, 1, None]
    low = np.arange(len(radii) - 1)[:, None] * (segments + 1) + np.arange(segments)
    high = low + segments + 1
    quads = np.stack([low, low + 1, high + 1, low, high + 1, high], axis=-1).reshape(-1, 3)
    mesh = Mesh(vertices.reshape(-1, 3), normals.reshape(-1, 3), quads)
    return mesh._replace(triangles=quads[_doubled_triangle_areas(mesh) > 0.0])


def make_cylinder_mesh(radius: float, half_length: float, segments: int = 24) -> Mesh:
    """Create the triangle mesh of a closed cylinder along z, with radius and half length [m]."""
    r, h = radius, half_length
    return revolution_mesh(
        (0, r, r, r, r, 0),
        (-h, -h, -h, h, h, h),
        ((0, -1), (0, -1), (1, 0), (1, 0), (0, 1), (0, 1)),
        segments,
    )


def make_capsule_mesh(radius: float, half_length: float, segments: int = 16) -> Mesh:
    """Create the triangle mesh of a capsule along z, a cylinder with two hemispheres.

    Args:
        radius: radius of cylinder and hemispheres [m].
        half_length: half length of the cylinder without the hemispheres [m].
        segments: number of segments around the axis.
    """
    rise = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 2)
    rise = np.sort(np.append(rise, (0.0, 0.0)))
    slopes = np.stack([np.cos(rise), np.sin(rise)], axis=1)
    upper = np.arange(len(rise)) >= len(rise) // 2
    heights = radius * slopes[:, 1] + np.where(upper, half_length, -half_length)
    return revolution_mesh(radius * slopes[:, 0], heights, slopes, segments)


def make_ellipsoid_mesh(radii, segments: int = 24) -> Mesh:
    """Create the triangle mesh of an ellipsoid with radii (3,) [m] along x, y and z."""
    ball = make_capsule_mesh(1.0, 0.0, segments)
    normals = ball.normals / np.asarray(radii)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(ball.vertices * np.asarray(radii), normals, ball.triangles)


def make_flat_triangle_mesh(corners: np.ndarray) -> Mesh:
    """Create a mesh with flat shading from the corners of t triangles (t, 3 corners, 3) [m].

    The corners of a triangle are counter-clockwise as seen from outside.
    """
    corners = np.asarray(corners, float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), np.repeat(normals, 3, axis=0), triangles)


def make_chequered_square(half_size: float, count: int) -> tuple[Mesh, np.ndarray]:
    """Create the mesh of a chequered square of count x count tiles in the plane z = 0.

    Args:
        half_size: half of the side length [m].
        count: number of tiles along a side.

    Returns:
        (mesh, (v,) chequerboard colour of each vertex, 0 or 1).
    """
    edges = np.linspace(-half_size, half_size, count + 1)
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    corners = [
        np.stack([edges[i + a], edges[j + b], np.zeros((count, count))], axis=-1)
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1))
    ]
    mesh = make_flat_triangle_mesh(np.stack(corners, axis=2).reshape(-1, 3, 3))
    return mesh, np.repeat(((i + j) % 2).ravel(), 6)


def transform_mesh(mesh: Mesh, position, rotation) -> Mesh:
    """Return a mesh rotated by `rotation` (3, 3), then translated by `position` (3,) [m]."""
    rotation = np.asarray(rotation).reshape(3, 3)
    return Mesh(
        mesh.vertices @ rotation.T + np.asarray(position),
        mesh.normals @ rotation.T,
        mesh.triangles,
    )


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Combine several meshes into one mesh."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.triangles + s for mesh, s in zip(meshes, starts, strict=True)]),
    )


def _doubled_triangle_areas(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)

"""Balls, lines and arrows that are drawn into a scene and are no part of a model."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

_GLOW = 0.4
_Geom = mujoco.mjtGeom


class Marker(NamedTuple):
    """One shape.

    Attributes:
        shape: of MuJoCo.
        start: (3,) its middle, or where it begins [m].
        end: (3,) where it ends [m]; None for a shape that has a middle.
        size: (3,) of MuJoCo's shape, or (1,) radius of a line [m].
        colour: (4,) red, green, blue, opacity, 0 .. 1.
        rotation: (9,) of a shape that has a middle.
        glow: its own light, 0 .. 1, so that it is seen in shadows.
    """

    shape: int
    start: np.ndarray
    end: np.ndarray | None
    size: np.ndarray
    colour: tuple[float, float, float, float]
    rotation: np.ndarray = np.eye(3).ravel()
    glow: float = _GLOW


def ball(middle, radius: float, colour) -> Marker:
    """Give a ball around a point [m]."""
    return Marker(_Geom.mjGEOM_SPHERE, np.array(middle), None, np.full(3, radius), colour)


def line(start, end, radius: float, colour) -> Marker:
    """Give a round line from point to point [m]."""
    return Marker(_Geom.mjGEOM_CAPSULE, np.array(start), np.array(end), np.array([radius]), colour)


def arrow(start, end, radius: float, colour) -> Marker:
    """Give an arrow from point to point [m]."""
    return Marker(_Geom.mjGEOM_ARROW, np.array(start), np.array(end), np.array([radius]), colour)


def box(middle, half_sizes, colour, rotation: np.ndarray | None = None) -> Marker:
    """Give a box around a point [m], turned by (3, 3)."""
    turn = np.eye(3) if rotation is None else rotation
    return Marker(
        _Geom.mjGEOM_BOX, np.array(middle), None, np.array(half_sizes), colour, turn.ravel()
    )


def polyline(points, radius: float, colour) -> list[Marker]:
    """Lines through points (n, 3) [m]."""
    return [line(a, b, radius, colour) for a, b in zip(points[:-1], points[1:], strict=True)]


def write_markers(scene: mujoco.MjvScene, markers: Sequence[Marker]) -> None:
    """Add shapes to a scene; those that find no room are left out.

    Args:
        scene: of MuJoCo, brought up to date.
        markers: the shapes.
    """
    for marker in markers[: scene.maxgeom - scene.ngeom]:
        geom = scene.geoms[scene.ngeom]
        colour = np.array(marker.colour, np.float32)
        size = np.resize(np.asarray(marker.size, float), 3)
        mujoco.mjv_initGeom(geom, marker.shape, size, marker.start, marker.rotation, colour)
        if marker.end is not None:
            width = float(marker.size[0])
            mujoco.mjv_connector(geom, marker.shape, width, marker.start, marker.end)
        geom.category, geom.emission = mujoco.mjtCatBit.mjCAT_DECOR.value, marker.glow
        scene.ngeom += 1

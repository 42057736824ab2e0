"""Shapes of the soil that a bucket digs: the trench, the heaps and the soil in the bucket.

Logs do not contain the soil. `soil_history` computes it from the logged motion of the bucket with
the model of the simulation. The shapes are boxes for images and meshes for recordings.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SoilGround
from hydrotele.show.logged_poses import Poses, point_trajectory
from hydrotele.show.meshes import Mesh, make_flat_triangle_mesh
from hydrotele.show.offscreen_renderer import Marker, make_box_marker
from hydrotele.simulate.soil_bed import SoilBed
from hydrotele.soil.parameters import CARRIED_VOLUME, INNER_WIDTH, REPOSE

BANK_COLOUR, LOOSE_COLOUR = np.array([92.0, 64.0, 38.0]), np.array([158.0, 120.0, 76.0])
_GROUND_COLOUR = np.array([139.0, 126.0, 108.0])
_GROUND_HALF_SIZE = 40.0  # m
_LOAD_SLICES = 24  # boxes that fill the bucket
MIN_LOOSE_THICKNESS = 1.0e-3  # m, thickness up to which loose soil is not drawn
_MIN_DRAWN_AREA = 1.0e-3  # m^2, area of the side view up to which soil in the bucket is not drawn
_BISECTIONS = 12  # halve the interval of the fill level to below 1 mm


class SoilShape(NamedTuple):
    """Soil at one time.

    Attributes:
        surface: (m,) heights of the surface along the strip of soil that the bucket digs [m].
        loose: (m,) thickness of the loose soil below this surface [m].
        load: (k, 2) corners of the side view of the soil in the bucket, in the frame of the bucket
            (x from pin to edge, z up at attitude 0) [m]; empty if there is none.
    """

    surface: np.ndarray
    loose: np.ndarray
    load: np.ndarray


class SoilHistory(NamedTuple):
    """Soil at the rows of a log.

    Attributes:
        bed: the strip of soil after the last row. Azimuth and radii of the strip and the geometry
            of the bucket are read from it.
        shapes: soil at each row.
        axes: (3, 3) directions ahead, left and up of the bucket in the frame of its link, as rows.
    """

    bed: SoilBed
    shapes: list[SoilShape]
    axes: np.ndarray


def soil_history(machine: Machine, ground: SoilGround, log: Log, poses: Poses) -> SoilHistory:
    """Simulate the soil that a bucket digs, at every row of a log, from the logged motion of the bucket.

    Args:
        machine: machine with a bucket.
        ground: the soil.
        log: log of the machine.
        poses: poses of its bodies at the rows of the log.

    Returns:
        Heights of the strip of soil and content of the bucket at every row.

    Raises:
        InputError: the machine has no bucket.
    """
    bed, arm = SoilBed(machine, ground), machine.arm
    assert arm is not None  # the machine has a bucket
    edges = point_trajectory(poses, arm.tip.link, arm.tip.position)
    pins = point_trajectory(poses, arm.tip.link, (0.0, 0.0, 0.0))
    ahead = (edges - pins) / np.linalg.norm(edges - pins, axis=1, keepdims=True)
    velocity = np.gradient(edges, log.time, axis=0)
    shapes = []
    for row, period in enumerate(np.diff(log.time, prepend=2.0 * log.time[0] - log.time[1])):
        bed.step(edges[row], velocity[row], ahead[row], float(period))
        c, s = math.cos(bed.azimuth), math.sin(bed.azimuth)
        attitude = math.atan2(ahead[row, 2], c * ahead[row, 0] + s * ahead[row, 1])
        shapes.append(SoilShape(bed.surface.copy(), bed.loose.copy(), _bucket_load_outline(bed, attitude)))
    forward = np.array(arm.tip.position) / np.linalg.norm(arm.tip.position)
    joint = machine.joints[arm.tool].axis if arm.tool else (0.0, 1.0, 0.0)
    left = np.array(joint) * _lateral_axis_sign(poses, arm.tip.link, np.array(joint), bed.azimuth)
    return SoilHistory(bed, shapes, np.stack([forward, left, np.cross(forward, left)]))


def _lateral_axis_sign(poses: Poses, link: str, axis: np.ndarray, azimuth: float) -> float:
    """Return 1 if an axis of a link points to the left of the vertical plane of the arm, else -1.

    Args:
        poses: poses of the machine; the first is used.
        link: name of the link.
        axis: (3,) axis in the frame of the link.
        azimuth: direction of the plane of the arm [rad].
    """
    tip = point_trajectory(poses, link, axis)[0] - point_trajectory(poses, link, (0.0, 0.0, 0.0))[0]
    return 1.0 if tip @ [-math.sin(azimuth), math.cos(azimuth), 0.0] > 0.0 else -1.0


def _bucket_load_outline(bed: SoilBed, attitude: float) -> np.ndarray:
    """Compute the side view of the soil in a bucket, which fills the bucket up to a level surface.

    The area of the side view is the carried volume divided by the inner width of the bucket.

    Args:
        bed: soil and bucket.
        attitude: angle of the line from pin to edge above the horizontal [rad].

    Returns:
        (k, 2) corners in the frame of the bucket [m]; (0, 2) if the bucket is nearly empty.
    """
    area = bed.state[CARRIED_VOLUME] / bed.parameters[INNER_WIDTH]
    if area < _MIN_DRAWN_AREA:
        return np.empty((0, 2))
    outline = np.array(bed.bucket.outline)
    top = 0.5 * (outline[0] + outline[-1])
    chord = outline[0] - outline[-1]
    heap = 0.5 * np.linalg.norm(chord) * bed.parameters[REPOSE]
    inside = outline.mean(axis=0) - top
    normal = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
    full = np.vstack([outline, top - math.copysign(heap, inside @ normal) * normal])  # with the heap on the mouth
    up = np.array([math.sin(attitude), math.cos(attitude)])
    low, high = (full @ up).min(), (full @ up).max()
    for _ in range(_BISECTIONS):
        level = 0.5 * (low + high)
        low, high = (low, level) if _polygon_area(_keep_polygon_below(full, up, level)) > area else (level, high)
    return _keep_polygon_below(full, up, high)


def _keep_polygon_below(polygon: np.ndarray, up: np.ndarray, level: float) -> np.ndarray:
    """Return the part of a polygon (k, 2) whose projection onto the unit vector `up` is at most `level`."""
    corners = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        over_a, over_b = a @ up - level, b @ up - level
        if over_a <= 0.0:
            corners.append(a)
        if (over_a <= 0.0) != (over_b <= 0.0):
            corners.append(a + over_a / (over_a - over_b) * (b - a))
    return np.array(corners).reshape(-1, 2)


def _polygon_area(corners: np.ndarray) -> float:
    x, z = corners.T
    return 0.5 * abs(float(x @ np.roll(z, -1) - z @ np.roll(x, -1)))


def trench_mesh(bed: SoilBed, shape: SoilShape) -> tuple[Mesh, np.ndarray]:
    """Create the mesh of a dug strip of soil: its surface, and side walls to the ground at height 0.

    Returns:
        (mesh in the world frame, (v, 3) colours 0 .. 255).
    """
    half, cell = 0.5 * bed.bucket.width, bed.cell_radii[1] - bed.cell_radii[0]
    borders = np.append(bed.cell_radii - 0.5 * cell, bed.cell_radii[-1] + 0.5 * cell)
    heights = np.interp(borders, bed.cell_radii, shape.surface)
    low_r, high_r, low_z, high_z = borders[:-1], borders[1:], heights[:-1], heights[1:]

    def make_cell_triangles(*corners: tuple) -> np.ndarray:
        """Return the triangles of one quadrilateral per cell; corners are (radius, side, height) [m] in order."""
        points = [np.stack(np.broadcast_arrays(*corner, low_r)[:3], axis=-1) for corner in corners]
        return np.stack([points[k] for k in (0, 1, 2, 0, 2, 3)], axis=1)

    top = make_cell_triangles(
        (low_r, -half, low_z), (high_r, -half, high_z), (high_r, half, high_z), (low_r, half, low_z)
    )
    right = make_cell_triangles(
        (low_r, -half, low_z), (low_r, -half, 0.0), (high_r, -half, 0.0), (high_r, -half, high_z)
    )
    left = make_cell_triangles((low_r, half, low_z), (high_r, half, high_z), (high_r, half, 0.0), (low_r, half, 0.0))
    colours = np.where(shape.loose[:, None] > MIN_LOOSE_THICKNESS, LOOSE_COLOUR, BANK_COLOUR)
    triangles = np.concatenate([top, right, left]).reshape(-1, 3, 3)
    c, s = math.cos(bed.azimuth), math.sin(bed.azimuth)
    mesh = make_flat_triangle_mesh(triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    return mesh, np.repeat(np.concatenate([colours, 0.8 * colours, 0.8 * colours]), 6, axis=0)


def make_bucket_load_mesh(history: SoilHistory, row: int) -> Mesh | None:
    """Create the mesh of the soil in the bucket at a row of the log, in the frame of the bucket's link.

    Returns:
        The mesh [m]; None if the bucket is empty.
    """
    corners, axes = history.shapes[row].load, history.axes
    if len(corners) < 3:
        return None
    half = 0.5 * history.bed.bucket.inner_width
    sides = [corners[:, :1] * axes[0] + corners[:, 1:] * axes[2] + way * half * axes[1] for way in (-1.0, 1.0)]
    near, far = sides
    middle = [side.mean(axis=0) for side in sides]
    triangles = []
    for k in range(len(corners)):
        n = (k + 1) % len(corners)
        triangles += [(near[k], near[n], far[n]), (near[k], far[n], far[k])]
        triangles += [(middle[0], near[n], near[k]), (middle[1], far[k], far[n])]
    return make_flat_triangle_mesh(np.array(triangles))


def make_ground_around_trench(bed: SoilBed, half_size: float, tile: float) -> tuple[Mesh, np.ndarray]:
    """Create the mesh of a chequered ground at height 0 with a gap for the strip of soil.

    Args:
        bed: the strip of soil.
        half_size: half of the side length of the ground [m].
        tile: side length of a tile [m].

    Returns:
        (mesh in the world frame, (v,) chequerboard colour of each vertex, 0 or 1).
    """
    half, cell = 0.5 * bed.bucket.width, bed.cell_radii[1] - bed.cell_radii[0]
    ends = bed.cell_radii[0] - 0.5 * cell, bed.cell_radii[-1] + 0.5 * cell
    grid = np.arange(-half_size, half_size + 0.5 * tile, tile)
    xs, ys = np.union1d(grid, ends), np.union1d(grid, (-half, half))
    triangles, parity = [], []
    for x0, x1 in zip(xs[:-1], xs[1:], strict=True):
        for y0, y1 in zip(ys[:-1], ys[1:], strict=True):
            x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
            if ends[0] < x < ends[1] and abs(y) < half:
                continue
            a, b, c, d = (x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)
            triangles += [(a, b, c), (a, c, d)]
            parity.append((math.floor(x / tile) + math.floor(y / tile)) % 2)
    c, s = math.cos(bed.azimuth), math.sin(bed.azimuth)
    turned = np.array(triangles) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_flat_triangle_mesh(turned), np.repeat(parity, 6)


def soil_markers(history: SoilHistory, row: int, poses: Poses, machine: Machine) -> list[Marker]:
    """Create boxes for a rendered image: ground, strip of soil and soil in the bucket at a row of a log.

    Args:
        history: soil at the rows of a log.
        row: index of the row.
        poses: poses of the machine at the rows.
        machine: machine with a bucket.

    Returns:
        The boxes, in the world frame.
    """
    bed, shape = history.bed, history.shapes[row]
    c, s = math.cos(bed.azimuth), math.sin(bed.azimuth)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    half, cell = 0.5 * bed.bucket.width, bed.cell_radii[1] - bed.cell_radii[0]
    start, end = bed.cell_radii[0] - 0.5 * cell, bed.cell_radii[-1] + 0.5 * cell
    bottom = min(0.0, float(bed.surface.min())) - 0.1
    far, aside = _GROUND_HALF_SIZE, 0.5 * (_GROUND_HALF_SIZE - half)
    ground = [
        (-far, start, 0.0, far), (end, far, 0.0, far),
        (start, end, half + aside, aside), (start, end, -half - aside, aside),
    ]  # fmt: skip

    def make_slab_marker(
        low_r: float, high_r: float, side: float, width: float, low: float, high: float, colour
    ) -> Marker:
        middle = turn @ [0.5 * (low_r + high_r), side, 0.5 * (low + high)]
        sizes = (0.5 * (high_r - low_r), width, 0.5 * (high - low))
        return make_box_marker(middle, sizes, (*(colour / 255.0), 1.0), turn)._replace(emission=0.0)

    markers = [
        make_slab_marker(low, high, side, width, bottom, 0.0, _GROUND_COLOUR) for low, high, side, width in ground
    ]
    for r, surface, loose in zip(bed.cell_radii, shape.surface, shape.loose, strict=True):
        low, high = r - 0.5 * cell, r + 0.5 * cell
        markers.append(make_slab_marker(low, high, 0.0, half, bottom, surface - loose, BANK_COLOUR))
        if loose > MIN_LOOSE_THICKNESS:
            markers.append(make_slab_marker(low, high, 0.0, half, surface - loose, surface, LOOSE_COLOUR))
    return markers + _make_bucket_load_markers(history, row, poses, machine)


def _make_bucket_load_markers(history: SoilHistory, row: int, poses: Poses, machine: Machine) -> list[Marker]:
    """Create thin boxes that fill the side view of the soil in the bucket at a row, in the world frame."""
    corners = history.shapes[row].load
    if len(corners) < 3 or machine.arm is None:
        return []
    body = poses.bodies.index(machine.arm.tip.link)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, poses.quaternion[row, body])
    frame = rotation.reshape(3, 3) @ history.axes.T  # columns: ahead, left and up of the bucket
    half, colour = 0.5 * history.bed.bucket.inner_width, (*(LOOSE_COLOUR / 255.0), 1.0)
    edges, markers = np.linspace(corners[:, 0].min(), corners[:, 0].max(), _LOAD_SLICES + 1), []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        column = _keep_polygon_below(
            _keep_polygon_below(corners, np.array([1.0, 0.0]), high), np.array([-1.0, 0.0]), -low
        )
        bottom, top = column[:, 1].min(), column[:, 1].max()
        middle = poses.position[row, body] + frame @ [0.5 * (low + high), 0.0, 0.5 * (bottom + top)]
        sizes = (0.5 * (high - low), half, 0.5 * (top - bottom))
        markers.append(make_box_marker(middle, sizes, colour, frame)._replace(emission=0.0))
    return markers

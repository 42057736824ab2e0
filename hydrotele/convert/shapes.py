"""Shapes of robot links: primitives and triangle meshes, their convex hulls and mass properties."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hydrotele.core.errors import InputError

MAX_FACES = 60_000  # triangles of one mesh; larger meshes slow down the viewer and are simplified
MAX_MESH_MB = 300.0
ShapeKind = Literal["box", "cylinder", "capsule", "sphere", "mesh"]
_MAX_COLOURS = 6  # of one textured mesh, each a geom
_MIN_COLOUR_FRACTION = 0.01  # of the faces
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


@dataclass(frozen=True)
class Shape:
    """A shape of a link, in the frame of the link.

    Attributes:
        kind: `box` (half sizes), `cylinder` and `capsule` (radius, half length along z), `sphere`
            (radius) or `mesh`.
        size: (3,) dimensions as stated for `kind` [m]; unused values are 0.
        rotation: (3, 3) orientation of the shape in the link's frame.
        position: (3,) position of the shape in the link's frame [m].
        rgba: colour; empty if the file states none.
        vertices: (n, 3) vertices of a mesh [m].
        faces: (m, 3) vertex indices of the triangles of a mesh.
    """

    kind: ShapeKind
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rgba: tuple[float, ...] = ()
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))

    def transform(self, rotation: np.ndarray, position: np.ndarray) -> "Shape":
        """Return the shape rotated by `rotation` (3, 3), then displaced by `position` (3,)."""
        return replace(self, rotation=rotation @ self.rotation, position=rotation @ self.position + position)

    def points(self) -> np.ndarray:
        """Return points (n, 3) in the link's frame [m] whose convex hull is that of the shape."""
        a, b, c = self.size
        if self.kind == "mesh":
            local = self.vertices
        elif self.kind == "box":
            local = np.array([[x, y, z] for x in (-a, a) for y in (-b, b) for z in (-c, c)])
        elif self.kind == "sphere":
            heights = np.array([-0.9, -0.4, 0.4, 0.9])
            local = np.vstack([_circle(a * np.sqrt(1 - h * h), a * h) for h in heights])
        else:
            local = np.vstack([_circle(a, -b), _circle(a, b)])
        return local @ self.rotation.T + self.position


def _circle(radius: float, height: float) -> np.ndarray:
    return np.column_stack([radius * np.cos(_CIRCLE), radius * np.sin(_CIRCLE), np.full_like(_CIRCLE, height)])


class Solid(NamedTuple):
    """A convex solid of density 1.

    Attributes:
        volume: volume [m^3].
        centre: (3,) centre of volume [m].
        inertia: (3, 3) second moments about the centre, the inertia at density 1 [m^5].
        vertices: (n, 3) vertices of the hull [m].
        faces: (m, 3) triangles of the hull.
    """

    volume: float
    centre: np.ndarray
    inertia: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray


def convex_solid(points: np.ndarray) -> Solid | None:
    """Return the convex hull of points (n, 3) [m] as a solid; None if the points are in one plane."""
    if len(points) < 4:
        return None
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    middle = points[hull.vertices].mean(axis=0)
    number = np.full(len(points), -1)
    number[hull.vertices] = np.arange(len(hull.vertices))
    vertices, faces = points[hull.vertices], number[hull.simplices]
    a, b, c = (vertices[faces[:, k]] - middle for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    volumes = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0
    volume = float(volumes.sum())
    if volume < 1e-9:
        return None
    centre = ((a + b + c) / 4.0 * volumes[:, None]).sum(axis=0) / volume
    corners = np.stack([a, b, c, np.zeros_like(a)]) - centre
    total = corners.sum(axis=0)
    moments = np.einsum("k,nki,nkj->ij", volumes, corners, corners) + np.einsum("k,ki,kj->ij", volumes, total, total)
    moments /= 20.0
    inertia = np.trace(moments) * np.eye(3) - moments
    return Solid(volume, centre + middle, inertia, vertices, faces)


def distance_outside_hull(points: np.ndarray, place: np.ndarray) -> float:
    """Return how far a place (3,) is beyond the nearest violated face of the hull of points (n, 3); 0 inside [m].

    0 as well if the points have no hull.
    """
    try:
        equations = ConvexHull(points).equations
    except (QhullError, ValueError, IndexError):
        return 0.0
    return max(0.0, float((equations[:, :3] @ place + equations[:, 3]).max()))


def read_mesh(path: Path, scale: np.ndarray, rgba: tuple[float, ...] | None) -> list[Shape]:
    """Read a mesh file (STL, OBJ or DAE) as one shape per colour.

    Args:
        path: the file.
        scale: (3,) factors of the coordinates.
        rgba: colour for all parts; None for those of the file. A texture becomes a few colours.

    Returns:
        The shapes, in metres.

    Raises:
        InputError: the file cannot be read, or the package `trimesh` or `pycollada` is missing.
    """
    if path.stat().st_size > MAX_MESH_MB * 1e6:
        raise InputError(path, f"is larger than {MAX_MESH_MB:g} MB; simplify the mesh")
    trimesh = import_optional("trimesh", path)
    if path.suffix.lower() == ".dae":
        import_optional("collada", path)
    try:
        scene = trimesh.load_scene(path)
        parts = [part for part in scene.dump() if hasattr(part, "faces") and len(part.faces)]
    except Exception as error:  # the readers of trimesh raise many types
        raise InputError(path, f"cannot be read as a mesh: {error}") from None
    shapes = []
    for part in parts:
        vertices, faces = np.asarray(part.vertices, float) * scale, np.asarray(part.faces, int)
        if np.prod(scale) < 0.0:
            faces = faces[:, ::-1]
        if not np.isfinite(vertices).all():
            raise InputError(path, "has vertices that are not finite")
        for colour, chosen in [(rgba, faces)] if rgba else _split_by_colour(part, faces):
            used, inverse = np.unique(chosen, return_inverse=True)
            corners, triangles = simplify_mesh(vertices[used], inverse.reshape(-1, 3))
            if len(np.unique(triangles)) >= 4:  # MuJoCo needs four
                shapes.append(Shape("mesh", vertices=corners, faces=triangles, rgba=colour))
    return shapes


def import_optional(name: str, where: object) -> Any:
    """Import an optional package of the extra `urdf`; raise InputError with the remedy if it is missing."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(where, f"needs the package {name}: pip install 'hydrotele[urdf]'") from None


def _split_by_colour(part, faces: np.ndarray) -> list[tuple[tuple[float, ...], np.ndarray]]:
    """Return the colours of a mesh of trimesh with the faces (m, 3) of each; () for a mesh without colour.

    The colours of a texture at the centres of the faces are sorted into at most `_MAX_COLOURS` clusters.
    """
    from scipy.cluster.vq import kmeans2

    material = getattr(part.visual, "material", None)
    image, uv = getattr(material, "image", None), getattr(part.visual, "uv", None)
    image = image or getattr(material, "baseColorTexture", None)
    if image is not None and uv is not None and len(uv) == len(part.vertices):
        pixels = np.asarray(image.convert("RGB"), float) / 255.0
        place = np.asarray(uv, float)[np.asarray(part.faces)].mean(axis=1) % 1.0
        rows = ((1.0 - place[:, 1]) * (pixels.shape[0] - 1)).astype(int)
        colours = pixels[rows, (place[:, 0] * (pixels.shape[1] - 1)).astype(int)]
        count = min(_MAX_COLOURS, len(np.unique(colours, axis=0)))
        centres, label = kmeans2(colours, count, minit="++", rng=0)
        sizes = np.bincount(label, minlength=count)
        label = np.where(sizes[label] < _MIN_COLOUR_FRACTION * len(faces), np.argmax(sizes), label)
        return [((*map(float, centres[k]), 1.0), faces[label == k]) for k in range(count) if np.any(label == k)]
    try:
        colour = np.asarray(material.main_color if material is not None else part.visual.main_color, float) / 255.0
    except (AttributeError, ValueError, TypeError):
        return [((), faces)]
    if not part.visual.defined or len(colour) != 4 or colour[3] == 0.0 or np.all(colour == 1.0):
        return [((), faces)]  # readers set white where a file states no colour or its texture is missing
    return [(tuple(map(float, colour)), faces)]


def simplify_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices of a mesh in cells of a grid until it has at most `MAX_FACES` triangles.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.

    Returns:
        Vertices and faces; a smaller mesh is returned unchanged.
    """
    size = np.ptp(vertices, axis=0).max() if len(vertices) else 0.0
    cells = 512.0
    while len(faces) > MAX_FACES and cells > 8.0:
        _, first, cell = np.unique(np.round(vertices * (cells / size)), axis=0, return_index=True, return_inverse=True)
        faces, vertices = np.ravel(cell)[faces], vertices[first]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        cells /= 1.5
    return vertices, faces


def write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write triangles as a binary STL file: vertices (n, 3) [m], faces (m, 3)."""
    record = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corners"] = vertices[faces]
    with path.open("wb") as file:
        file.write(b"\0" * 80 + np.uint32(len(faces)).tobytes())
        file.write(record.tobytes())

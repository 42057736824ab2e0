"""The shapes of a machine's bodies as a few coloured meshes, from the MuJoCo model."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.show import shapes
from hydrotele.show.shapes import Mesh

_HIDDEN_GROUP = 3  # MuJoCo viewers hide geoms from this group on: shapes that only collide
_DEFAULT_COLOUR = (0.5, 0.5, 0.5, 1.0)  # mjModel's, which gives way to a material

_Geom = mujoco.mjtGeom
_PRIMITIVES: Mapping[int, Callable[[np.ndarray], Mesh]] = {
    int(_Geom.mjGEOM_BOX): lambda size: shapes.box(size),
    int(_Geom.mjGEOM_CYLINDER): lambda size: shapes.cylinder(size[0], size[1], _around(size[0])),
    int(_Geom.mjGEOM_CAPSULE): lambda size: shapes.capsule(size[0], size[1], _around(size[0])),
    int(_Geom.mjGEOM_SPHERE): lambda size: shapes.ellipsoid((size[0],) * 3),
    int(_Geom.mjGEOM_ELLIPSOID): lambda size: shapes.ellipsoid(size),
}


class Look(NamedTuple):
    """What is seen of a body, in one mesh.

    Attributes:
        body: number of the body.
        opacity: 0 .. 1, the same for all of the mesh.
        mesh: in the body's frame [m].
        colours: (v, 3) uint8 sRGB, one per vertex.
    """

    body: int
    opacity: float
    mesh: Mesh
    colours: np.ndarray


def body_looks(model: mujoco.MjModel) -> list[Look]:
    """One mesh per body and opacity, all geoms that a viewer shows; without endless planes.

    Args:
        model: a model compiled with its looks.

    Returns:
        The meshes, in body order.
    """
    parts: dict[tuple[int, float], list[tuple[Mesh, np.ndarray]]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= _HIDDEN_GROUP or (mesh := _geom_mesh(model, geom)) is None:
            continue
        colour = geom_colour(model, geom)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        placed = shapes.moved(mesh, model.geom_pos[geom], rotation)
        painted = np.tile(np.round(255 * colour[:3]).astype(np.uint8), (len(mesh.vertices), 1))
        key = int(model.geom_bodyid[geom]), round(float(colour[3]), 3)
        parts.setdefault(key, []).append((placed, painted))
    looks = []
    for (body, opacity), some in sorted(parts.items()):
        meshes, painted = zip(*some, strict=True)
        looks.append(Look(body, opacity, shapes.joined(meshes), np.concatenate(painted)))
    return looks


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Colour (4,) of a geom, 0 .. 1: its own where it has one, else that of its material."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material < 0 or not np.allclose(own, _DEFAULT_COLOUR):
        return own
    return model.mat_rgba[material]


def bounds(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest corner (3,) [m] of a box around all that is seen, without planes.

    Args:
        model: the model.
        data: a configuration with up-to-date kinematics.
    """
    seen = (model.geom_type != _Geom.mjGEOM_PLANE) & (model.geom_group < _HIDDEN_GROUP)
    if not seen.any():
        return model.stat.center - model.stat.extent, model.stat.center + model.stat.extent
    places, reach = data.geom_xpos[seen], model.geom_rbound[seen, None]
    low, high = (places - reach).min(axis=0), (places + reach).max(axis=0)
    height = ground_height(model)
    if height is not None:
        low[2] = max(low[2], height)
    return low, high


def ground_height(model: mujoco.MjModel) -> float | None:
    """Height [m] of the first plane fixed to the world, or None."""
    planes = (model.geom_type == _Geom.mjGEOM_PLANE) & (model.geom_bodyid == 0)
    return float(model.geom_pos[planes][0, 2]) if planes.any() else None


def _around(radius: float) -> int:
    """Number of flat pieces around: pipes of a few centimetres need fewer than drums."""
    return 10 if radius < 0.06 else 24


def _geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh | None:
    kind = int(model.geom_type[geom])
    if kind == _Geom.mjGEOM_MESH:
        return _file_mesh(model, int(model.geom_dataid[geom]))
    if kind in _PRIMITIVES:
        return _PRIMITIVES[kind](model.geom_size[geom])
    return None


def _file_mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    """A mesh asset; each triangle keeps its own corners, because normals are indexed apart."""
    first = model.mesh_faceadr[mesh]
    faces = slice(first, first + model.mesh_facenum[mesh])
    corners = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[faces]]
    normals = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[faces]]
    return shapes.flat(corners)._replace(normals=normals.reshape(-1, 3))

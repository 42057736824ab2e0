"""Convert the visual geometry of a MuJoCo model to a few coloured triangle meshes, and compute its bounds [m]."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.show import meshes as shapes
from hydrotele.show.meshes import Mesh

_HIDDEN_GROUP = 3  # MuJoCo viewers hide geoms of this group and above: collision shapes
_DEFAULT_COLOUR = (0.5, 0.5, 0.5, 1.0)  # default of MuJoCo; the colour of a material overrides it
_Geom = mujoco.mjtGeom
_PRIMITIVES: Mapping[int, Callable[[np.ndarray], Mesh]] = {
    int(_Geom.mjGEOM_BOX): lambda size: shapes.make_box_mesh(size),
    int(_Geom.mjGEOM_CYLINDER): lambda size: shapes.make_cylinder_mesh(
        size[0], size[1], _choose_segment_count(size[0])
    ),
    int(_Geom.mjGEOM_CAPSULE): lambda size: shapes.make_capsule_mesh(size[0], size[1], _choose_segment_count(size[0])),
    int(_Geom.mjGEOM_SPHERE): lambda size: shapes.make_ellipsoid_mesh((size[0],) * 3),
    int(_Geom.mjGEOM_ELLIPSOID): lambda size: shapes.make_ellipsoid_mesh(size),
}


class BodyMesh(NamedTuple):
    """Visual geometry of a body with one opacity, as one mesh.

    Attributes:
        body: index of the body.
        opacity: opacity of the mesh, 0 .. 1.
        mesh: mesh in the body frame [m].
        colours: (v, 3) sRGB colour of each vertex, uint8.
    """

    body: int
    opacity: float
    mesh: Mesh
    colours: np.ndarray


def body_meshes(model: mujoco.MjModel) -> list[BodyMesh]:
    """Return one mesh per body and opacity, from all visible geoms except infinite planes.

    Args:
        model: model that was compiled with visual geometry.

    Returns:
        Meshes in the order of the bodies.
    """
    parts: dict[tuple[int, float], list[tuple[Mesh, np.ndarray]]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= _HIDDEN_GROUP or (mesh := _geom_mesh(model, geom)) is None:
            continue
        colour = geom_colour(model, geom)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        placed = shapes.transform_mesh(mesh, model.geom_pos[geom], rotation)
        painted = np.tile(np.round(255 * colour[:3]).astype(np.uint8), (len(mesh.vertices), 1))
        key = int(model.geom_bodyid[geom]), round(float(colour[3]), 3)
        parts.setdefault(key, []).append((placed, painted))
    looks = []
    for (body, opacity), some in sorted(parts.items()):
        meshes, painted = zip(*some, strict=True)
        looks.append(BodyMesh(body, opacity, shapes.join_meshes(meshes), np.concatenate(painted)))
    return looks


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour (4,) of a geom, 0 .. 1: its own colour, else that of its material."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material < 0 or not np.allclose(own, _DEFAULT_COLOUR):
        return own
    return model.mat_rgba[material]


def visible_bounds(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Return two opposite corners of a box around all visible geoms except planes, in the world frame.

    The box contains the bounding spheres of the geoms, but does not extend below the ground plane.

    Args:
        model: the model.
        data: state with updated kinematics.

    Returns:
        (lowest corner (3,), highest corner (3,)) [m].
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
    """Return the height [m] of the first plane that is fixed to the world, or None without one."""
    planes = (model.geom_type == _Geom.mjGEOM_PLANE) & (model.geom_bodyid == 0)
    return float(model.geom_pos[planes][0, 2]) if planes.any() else None


def _choose_segment_count(radius: float) -> int:
    """Return the number of segments around the axis of a round mesh: 10 for a radius below 0.06 m, else 24."""
    return 10 if radius < 0.06 else 24


def _geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh | None:
    kind = int(model.geom_type[geom])
    if kind == _Geom.mjGEOM_MESH:
        return _mesh_asset(model, int(model.geom_dataid[geom]))
    if kind in _PRIMITIVES:
        return _PRIMITIVES[kind](model.geom_size[geom])
    return None


def _mesh_asset(model: mujoco.MjModel, mesh: int) -> Mesh:
    """Convert a mesh asset of a MuJoCo model, given by its index, to a mesh with flat triangles.

    Triangles share no vertices, because MuJoCo indexes the normals separately.
    """
    first = model.mesh_faceadr[mesh]
    faces = slice(first, first + model.mesh_facenum[mesh])
    corners = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[faces]]
    normals = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[faces]]
    return shapes.make_flat_triangle_mesh(corners)._replace(normals=normals.reshape(-1, 3))

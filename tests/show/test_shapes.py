"""Meshes enclose the right volume, and look outwards."""

import mujoco
import numpy as np
import pytest

from hydrotele.show import meshes as shapes
from hydrotele.show.visual_geometry import body_meshes, geom_colour

_BODIES = {
    "box": (shapes.make_box_mesh((0.5, 1.0, 1.5)), 6.0),
    "cylinder": (shapes.make_cylinder_mesh(0.5, 2.0, segments=200), np.pi),
    "capsule": (shapes.make_capsule_mesh(0.5, 1.0, segments=200), np.pi / 2 + np.pi / 6),
    "ellipsoid": (shapes.make_ellipsoid_mesh((1.0, 2.0, 3.0), segments=200), 8.0 * np.pi),
}


def _corners(mesh):
    return (mesh.vertices[mesh.triangles[:, k]] for k in range(3))


def _volume(mesh):
    a, b, c = _corners(mesh)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


@pytest.mark.parametrize("mesh, volume", _BODIES.values(), ids=_BODIES.keys())
def test_closed_shapes_have_their_volume(mesh, volume):
    # 200 flat pieces around lose (2 pi / 200)^2 / 6 of a circle's area; a ball loses it twice
    assert _volume(mesh) == pytest.approx(volume, rel=1e-3)


@pytest.mark.parametrize("mesh", [m for m, _ in _BODIES.values()], ids=_BODIES.keys())
def test_triangles_are_wound_like_their_normals(mesh):
    a, b, c = _corners(mesh)
    outwards = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", outwards, mesh.normals[mesh.triangles].mean(axis=1)) > 0).all()
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0, abs=1e-12)


def test_joined_meshes_keep_their_parts():
    one, other = shapes.make_box_mesh((1, 1, 1)), shapes.make_cylinder_mesh(1.0, 1.0)
    turned = shapes.transform_mesh(other, (5.0, 0.0, 0.0), np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]))
    both = shapes.join_meshes([one, turned])
    assert _volume(both) == pytest.approx(_volume(one) + _volume(other), rel=1e-12)


MJCF = """<mujoco><asset><material name="red" rgba="1 0 0 1"/>
<mesh name="tetrahedron" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
<geom type="plane" size="1 1 1"/>
<body name="a" pos="1 2 3"><freejoint/>
<geom type="box" size="1 1 1" pos="0 0 1" material="red"/>
<geom type="sphere" size="0.5" rgba="0 0 1 1"/>
<geom type="mesh" mesh="tetrahedron" rgba="0 1 0 0.5"/>
<geom type="box" size="9 9 9" group="3"/></body></worldbody></mujoco>"""


def test_a_body_becomes_one_mesh_per_opacity():
    model = mujoco.MjModel.from_xml_string(MJCF)
    glass, solid = body_meshes(model)
    assert (glass.body, glass.opacity, solid.body, solid.opacity) == (1, 0.5, 1, 1.0)
    assert _volume(glass.mesh) == pytest.approx(1 / 6, rel=1e-6)  # float32 in the model
    assert (glass.colours == (0, 255, 0)).all()
    # the box is of 24 vertices and 2 m high; the collision box of 18 m is left out
    assert solid.mesh.vertices[:, 2].max() == pytest.approx(2.0)
    assert np.unique(solid.colours, axis=0).tolist() == [[0, 0, 255], [255, 0, 0]]
    assert (solid.colours == (255, 0, 0)).all(axis=1).sum() == 24


def test_mesh_geoms_stand_where_mujoco_puts_them():
    model = mujoco.MjModel.from_xml_string(MJCF)
    glass, _ = body_meshes(model)
    low, high = glass.mesh.vertices.min(axis=0), glass.mesh.vertices.max(axis=0)
    # MuJoCo moves a mesh to its centre of mass and turns it; in the body's frame it is as written
    assert low == pytest.approx([0, 0, 0], abs=1e-6) and high == pytest.approx([1, 1, 1], abs=1e-6)


def test_own_colour_comes_before_the_material():
    model = mujoco.MjModel.from_xml_string(MJCF)
    assert geom_colour(model, 1).tolist() == [1, 0, 0, 1]
    assert geom_colour(model, 2).tolist() == [0, 0, 1, 1]

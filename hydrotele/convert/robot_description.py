"""Read the links, joints, shapes and inertias of a robot from a URDF, xacro or MJCF file.

Frames and units are those of a URDF: each link has the frame of its joint, lengths in metres,
angles in radians.
"""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.convert.robot_packages import PackageFinder
from hydrotele.convert.shapes import Shape, ShapeKind, import_optional, read_mesh
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text

JointKind = Literal["hinge", "slide", "fixed"]


_JOINT_KINDS: dict[str, JointKind] = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}


class Inertial(NamedTuple):
    """Stated mass [kg], centre of mass (3,) [m] and inertia (3, 3) about it [kg m^2], in the link's frame."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


@dataclass
class RobotLink:
    """A link with the joint that connects it to its parent.

    Attributes:
        name: name in the file.
        parent: name of the parent link, None for the root.
        rotation: (3, 3) orientation of the link's frame in the parent's frame at joint position 0.
        position: (3,) origin of the link's frame in the parent's frame [m].
        joint: name of the joint.
        kind: kind of the joint.
        axis: (3,) unit vector in the link's frame.
        range: limits of the joint [rad] or [m]; None if it has none.
        is_driven: False if the file states that no actuator acts on the joint.
        mimics: name of the joint that this joint follows.
        inertial: stated inertia, if any.
        visuals: visible shapes.
        collisions: shapes for contacts.
    """

    name: str
    parent: str | None = None
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    joint: str = ""
    kind: JointKind = "fixed"
    axis: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    range: tuple[float, float] | None = None
    is_driven: bool = True
    mimics: str | None = None
    inertial: Inertial | None = None
    visuals: list[Shape] = field(default_factory=list)
    collisions: list[Shape] = field(default_factory=list)


class RobotClosure(NamedTuple):
    """Two links whose points (3,) [m], each in the frame of its link, coincide."""

    link: str
    point: np.ndarray
    other: str
    other_point: np.ndarray


@dataclass
class Robot:
    """A robot: links by name, parents first, closures of kinematic loops, and notes on the reading."""

    name: str
    links: dict[str, RobotLink]
    closures: list[RobotClosure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_robot(path: Path, package_paths: tuple[Path, ...] = ()) -> Robot:
    """Read a robot from a URDF, xacro or MJCF file; the root element decides.

    Args:
        path: the file.
        package_paths: additional folders with ROS packages.

    Raises:
        InputError: the file is none of these, or is not valid, or a package that it needs is missing.
    """
    if not path.is_file():
        raise InputError(path, "no such file; give a URDF, xacro or MJCF file")
    try:
        text = read_text(path)
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not an XML file: {error}; give a URDF, xacro or MJCF file") from None
    if root.tag == "mujoco":
        return _read_mjcf_robot(path)
    if root.tag != "robot":
        raise InputError(path, f"has the root element <{root.tag}>; a URDF has <robot>, an MJCF <mujoco>")
    packages = PackageFinder(path, package_paths)
    if "www.ros.org/wiki/xacro" in text or "ros.org/wiki/xacro" in text or path.suffix == ".xacro":
        root = _expand_xacro(path, packages)
    return _UrdfReader(path, packages).read(root)


def _expand_xacro(path: Path, packages: PackageFinder) -> ElementTree.Element:
    """Evaluate a xacro file; raise InputError if it is not valid or the package `xacro` is missing."""
    xacro = import_optional("xacro", path)
    arguments = import_optional("xacro.substitution_args", path)
    original = arguments._eval_find
    arguments._eval_find = lambda name: str(packages.find(name))
    try:
        return ElementTree.fromstring(xacro.process_file(str(path)).toxml())
    except InputError:
        raise
    except Exception as error:  # xacro raises many types
        cause = error.__cause__ or getattr(error, "exc", None)
        said = " ".join(str(cause if isinstance(cause, InputError) else error).split())
        raise InputError(path, f"xacro cannot evaluate it: {said or type(error).__name__}") from None
    finally:
        arguments._eval_find = original


class _UrdfReader:
    """Converts the elements of one URDF."""

    def __init__(self, path: Path, packages: PackageFinder) -> None:
        self.path, self.packages = path, packages
        self.notes: list[str] = []
        self.meshes: dict[tuple, list[Shape]] = {}
        self.missing: list[str] = []

    def read(self, root: ElementTree.Element) -> Robot:
        colours = {}
        for material in root.findall("material"):
            if (colour := material.find("color")) is not None:
                colours[material.get("name")] = self._numbers(colour, "rgba", 4, (0.6, 0.6, 0.6, 1.0))
        links: dict[str, RobotLink] = {}
        for element in root.findall("link"):
            name = element.get("name") or ""
            if not name or name in links:
                raise InputError(self.path, f"link {name!r} {'is given twice' if name else 'has no name'}")
            links[name] = self._read_link(element, name, colours)
        for element in root.findall("joint"):
            if element.find("parent") is not None:  # others are those of transmissions
                self._read_joint(element, links)
        if not links:
            raise InputError(self.path, "has no link")
        self._mark_undriven(root, links)
        ordered = self._order(links)
        if self.missing:
            names = list(dict.fromkeys(self.missing))
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            self.notes.append(
                f"meshes not found or empty: {', '.join(names[:3])}{more}; collision shapes are shown instead"
            )
        return Robot(root.get("name") or self.path.stem, ordered, [], self.notes)

    def _read_link(self, element, name: str, colours: dict) -> RobotLink:
        link = RobotLink(name)
        for visual in element.findall("visual"):
            material = visual.find("material")
            rgba = None
            if material is not None:
                colour = material.find("color")
                own = self._numbers(colour, "rgba", 4, (0.6, 0.6, 0.6, 1.0)) if colour is not None else None
                rgba = own or colours.get(material.get("name"))
            link.visuals += self._read_shapes(visual, rgba)
        for collision in element.findall("collision"):
            link.collisions += self._read_shapes(collision, None)
        link.visuals = link.visuals or list(link.collisions)  # meshes that are missing
        if (inertial := element.find("inertial")) is not None:
            rotation, centre = self._pose(inertial)
            mass, inertia = inertial.find("mass"), inertial.find("inertia")
            moments = {key: self._number(inertia, key, 0.0) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")}
            xx, yy, zz, xy, xz, yz = moments.values()
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            link.inertial = Inertial(self._number(mass, "value", 0.0), centre, rotation @ matrix @ rotation.T)
        return link

    def _read_shapes(self, element, rgba: tuple[float, ...] | None) -> list[Shape]:
        geometry = element.find("geometry")
        rotation, position = self._pose(element)
        shapes: list[Shape] = []
        for item in geometry if geometry is not None else ():
            colour = rgba or ()
            if item.tag == "box":
                x, y, z = self._numbers(item, "size", 3, (0.0, 0.0, 0.0))
                shapes.append(Shape("box", (x / 2, y / 2, z / 2), rgba=colour))
            elif item.tag in ("cylinder", "capsule"):
                size = (self._number(item, "radius", 0.0), self._number(item, "length", 0.0) / 2, 0.0)
                shapes.append(Shape(item.tag, size, rgba=colour))
            elif item.tag == "sphere":
                shapes.append(Shape("sphere", (self._number(item, "radius", 0.0), 0.0, 0.0), rgba=colour))
            elif item.tag == "mesh":
                shapes += self._read_mesh(item, rgba)
        return [shape.transform(rotation, position) for shape in shapes]

    def _read_mesh(self, item, rgba: tuple[float, ...] | None) -> list[Shape]:
        address = item.get("filename", "")
        path = self.packages.find_file(address)
        if path is None:
            self.missing.append(address)
            return []
        scale = self._numbers(item, "scale", 3, (1.0, 1.0, 1.0))
        key = (path, scale, rgba)
        if key not in self.meshes:
            self.meshes[key] = read_mesh(path, np.array(scale), rgba)
        if not self.meshes[key]:
            self.missing.append(address)
        return self.meshes[key]

    def _read_joint(self, element, links: dict[str, RobotLink]) -> None:
        name, kind = element.get("name", ""), element.get("type", "")
        ends = [element.find(tag) for tag in ("parent", "child")]
        parent, child = (end.get("link", "") if end is not None else "" for end in ends)
        for end in (parent, child):
            if end not in links:
                raise InputError(self.path, f"joint {name!r} refers to the unknown link {end!r}")
        link = links[child]
        if link.parent is not None:
            raise InputError(self.path, f"link {child!r} has two parents, {link.parent!r} and {parent!r}")
        link.parent, link.joint = parent, name
        link.rotation, link.position = self._pose(element)
        link.kind = _JOINT_KINDS.get(kind, "fixed")
        if kind in ("floating", "planar"):
            self.notes.append(f"joint {name} is {kind}; the machine stands on the ground, the joint is locked")
        elif kind not in ("fixed", "revolute", "continuous", "prismatic"):
            raise InputError(self.path, f"joint {name!r} has the unknown type {kind!r}")
        axis = np.array(self._numbers(element.find("axis"), "xyz", 3, (1.0, 0.0, 0.0)))
        length = float(np.linalg.norm(axis))
        if link.kind != "fixed" and not length > 0.0:
            raise InputError(self.path, f"joint {name!r} has an axis of length 0")
        link.axis = axis / length if length else axis
        limit = element.find("limit")
        if limit is not None and kind in ("revolute", "prismatic"):
            low, high = self._number(limit, "lower", 0.0), self._number(limit, "upper", 0.0)
            link.range = (low, high) if low < high else None
            if low == high:  # a joint without travel, often a placeholder of a follower
                link.kind = "fixed"
        if (mimic := element.find("mimic")) is not None:
            link.mimics = mimic.get("joint")

    def _mark_undriven(self, root, links: dict[str, RobotLink]) -> None:
        """Mark joints without transmission or command interface, if the file states any of them."""
        driven = {j.get("name") for part in root.findall("transmission") for j in part.iter("joint")}
        for joint in root.iterfind("ros2_control/joint"):
            if joint.find("command_interface") is not None:
                driven.add(joint.get("name"))
        if driven:
            for link in links.values():
                link.is_driven = link.joint in driven

    def _order(self, links: dict[str, RobotLink]) -> dict[str, RobotLink]:
        roots = [name for name, link in links.items() if link.parent is None]
        if not roots:
            raise InputError(self.path, "has no root link: the joints form a cycle")
        if len(roots) > 1:
            sizes = {root: _count_descendants(links, root) for root in roots}
            roots.sort(key=lambda root: -sizes[root])
            self.notes.append(f"several root links; only {roots[0]} is used, without {', '.join(roots[1:])}")
        ordered, waiting = {}, [roots[0]]
        while waiting:
            name = waiting.pop(0)
            ordered[name] = links[name]
            waiting += [child for child, link in links.items() if link.parent == name]
        return ordered

    def _pose(self, element) -> tuple[np.ndarray, np.ndarray]:
        origin = element.find("origin")
        roll, pitch, yaw = self._numbers(origin, "rpy", 3, (0.0, 0.0, 0.0))
        return rotation_rpy(roll, pitch, yaw), np.array(self._numbers(origin, "xyz", 3, (0.0, 0.0, 0.0)))

    def _numbers(self, element, key: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        text = None if element is None else element.get(key)
        if element is None or text is None:
            return default
        try:
            values = tuple(float(word) for word in text.split())
        except ValueError:
            values = ()
        if len(values) != count or not all(map(math.isfinite, values)):
            raise InputError(self.path, f"<{element.tag} {key}={text!r}> must be {count} numbers")
        return values

    def _number(self, element, key: str, default: float) -> float:
        return self._numbers(element, key, 1, (default,))[0]


def _count_descendants(links: dict[str, RobotLink], root: str) -> int:
    children = [name for name, link in links.items() if link.parent == root]
    return 1 + sum(_count_descendants(links, child) for child in children)


def rotation_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of a URDF."""
    return (
        rotation_about(np.array([0.0, 0.0, 1.0]), yaw)
        @ rotation_about(np.array([0.0, 1.0, 0.0]), pitch)
        @ rotation_about(np.array([1.0, 0.0, 0.0]), roll)
    )


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix about a unit vector (3,) by an angle [rad] (Rodrigues)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew


def _read_mjcf_robot(path: Path) -> Robot:
    """Read a robot from an MJCF; bodies with several joints become chains of links."""
    import mujoco

    from hydrotele.core.mjcf import load_model

    model = load_model(path)
    notes: list[str] = []
    links = {"world": RobotLink("world")}
    names = ["world"]
    actuated = {int(joint) for kind, joint in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
                if kind == mujoco.mjtTrn.mjTRN_JOINT}  # fmt: skip
    for body in range(1, model.nbody):
        name = model.body(body).name or f"body_{body}"
        parent, rotation, position = (
            names[model.body_parentid[body]],
            _matrix(model.body_quat[body]),
            model.body_pos[body],
        )
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        offset = np.zeros(3)
        link = RobotLink(name, parent, rotation, position.copy())
        for number, joint in enumerate(range(first, first + count)):
            last = number == count - 1
            link = RobotLink(
                name if last else f"{name}_{number}", parent, rotation, position + rotation @ model.jnt_pos[joint]
            )
            kind = mujoco.mjtJoint(model.jnt_type[joint])
            link.joint = model.joint(joint).name or f"{link.name}_joint"
            if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                link.kind = "hinge" if kind == mujoco.mjtJoint.mjJNT_HINGE else "slide"
                link.axis = model.jnt_axis[joint].copy()
                limits = model.jnt_range[joint]  # also of a joint whose cylinder is limited in its place
                link.range = (float(limits[0]), float(limits[1])) if limits[0] < limits[1] else None
                link.is_driven = joint in actuated or not actuated
            else:
                notes.append(f"joint {link.joint} is free or a ball; it is locked")
            links[link.name] = link
            offset = model.jnt_pos[joint].copy()
            parent, rotation, position = link.name, np.eye(3), -offset
        if not count:
            links[name] = link
        if model.body_mass[body] > 0.0:
            turned = _matrix(model.body_iquat[body])
            inertia = turned @ np.diag(model.body_inertia[body]) @ turned.T
            link.inertial = Inertial(float(model.body_mass[body]), model.body_ipos[body] - offset, inertia)
        names.append(name)
    offsets = {name: _joint_offset(model, body) for body, name in enumerate(names)}
    for geom in range(model.ngeom):
        name = names[model.geom_bodyid[geom]]
        if (shape := _mjcf_shape(model, geom)) is None:
            continue
        shape = shape.transform(np.eye(3), -offsets[name])
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            links[name].collisions.append(shape)
        if model.geom_group[geom] < 3:
            links[name].visuals.append(shape)
    closures = []
    for k in range(model.neq):
        if model.eq_type[k] != mujoco.mjtEq.mjEQ_CONNECT:
            notes.append(f"equality constraint {model.equality(k).name or k} is not a connect; it is left out")
        elif model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
            sites = model.eq_obj1id[k], model.eq_obj2id[k]
            one, two = (names[model.site_bodyid[s]] for s in sites)
            places = [model.site_pos[s] - offsets[n] for s, n in zip(sites, (one, two), strict=True)]
            closures.append(RobotClosure(one, places[0], two, places[1]))
        else:
            one, two = names[model.eq_obj1id[k]], names[model.eq_obj2id[k]]
            places = model.eq_data[k, :3] - offsets[one], model.eq_data[k, 3:6] - offsets[two]
            closures.append(RobotClosure(one, places[0], two, places[1]))
    return Robot(path.stem, links, closures, notes)


def _joint_offset(model, body: int) -> np.ndarray:
    """Return the position of the last joint of a body in its frame, which becomes the origin of the link."""
    count = model.body_jntnum[body]
    return model.jnt_pos[model.body_jntadr[body] + count - 1].copy() if count else np.zeros(3)


def _matrix(quat) -> np.ndarray:
    import mujoco

    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quat)
    return flat.reshape(3, 3)


def _mjcf_shape(model, geom: int) -> Shape | None:
    import mujoco

    kinds: dict[mujoco.mjtGeom, ShapeKind] = {
        mujoco.mjtGeom.mjGEOM_BOX: "box", mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
        mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule", mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
        mujoco.mjtGeom.mjGEOM_MESH: "mesh",
    }  # fmt: skip
    kind = kinds.get(mujoco.mjtGeom(model.geom_type[geom]))
    if kind is None:  # planes and height fields belong to the scene
        return None
    rgba = model.geom_rgba[geom]
    if (material := model.geom_matid[geom]) >= 0:
        rgba = model.mat_rgba[material]
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), int)
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.array(model.mesh_vert[start : start + count], float)
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = np.array(model.mesh_face[start : start + count], int)
    return Shape(
        kind, tuple(model.geom_size[geom]), _matrix(model.geom_quat[geom]), model.geom_pos[geom].copy(),
        tuple(map(float, rgba)), vertices, faces,
    )  # fmt: skip

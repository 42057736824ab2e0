"""Arrange the links of a robot as those of a machine: moving links, arm, frames and angles.

A link of a machine has a position but no orientation: at machine angle 0 all frames are parallel to the
world, z up and x forward. Joints of the arm's plane have the axis -y, so that a positive angle
raises the outboard end, and at angle 0 each of these links points forward. Hence a machine angle is
`sign * (robot angle - offset)`.
"""

import math
import os
import re
from dataclasses import dataclass, field, replace

import numpy as np

from hydrotele.convert.robot_description import Inertial, Robot, RobotLink, rotation_about
from hydrotele.convert.shapes import Shape, distance_outside_hull
from hydrotele.core.errors import InputError

_UP = np.array([0.0, 0.0, 1.0])
_PARALLEL = 0.999  # cosine above which two axes count as parallel: 2.5 deg
_AXIS_ROUNDING = 2.0e-3  # components of an axis that are smaller are rounding errors of angles such as 1.57
_FRAME_SIZE = 0.02  # m, a link without mass and without a larger shape is only a frame
_FRAME_MASS = 0.01  # kg
_MAX_PIN_GAP = 0.1  # of the size of a link, from a rod's eye to the hull of the link that it moves
_CYLINDER_NAMES = re.compile(r"cyl|piston|rod(?!a)|ram\b|jack|barrel", re.IGNORECASE)


@dataclass
class MovingLink:
    """A link of the machine with its joint, in the frames of the machine.

    Attributes:
        name: name of the link in the machine.
        joint: name of the joint and of its axis in the machine.
        parent: name of the parent link, `world` for the base.
        position: (3,) origin of the link in the parent's frame [m].
        kind: `hinge` or `slide`.
        axis: (3,) unit vector of the joint.
        range: limits of the machine angle [rad] or displacement [m].
        role: `swing`, `boom`, `stick`, `tool`, `plane` (another hinge of the arm's plane),
            `telescope`, `rotator`, or `passive` (without drive).
        source_joint: name of the joint in the file.
        sign: sign of the machine angle relative to the robot's.
        offset: robot angle at machine angle 0 [rad].
        end: (3,) end of the link in its frame: the next joint, or the tip [m].
        visuals: visible shapes in the link's frame.
        collisions: shapes for contacts in the link's frame.
        inertials: stated inertias of the link and of those fixed to it, in the link's frame.
    """

    name: str
    joint: str
    parent: str
    position: np.ndarray
    kind: str
    axis: np.ndarray
    range: tuple[float, float] | None
    role: str
    source_joint: str
    sign: float = 1.0
    offset: float = 0.0
    end: np.ndarray = field(default_factory=lambda: np.zeros(3))
    visuals: list[Shape] = field(default_factory=list)
    collisions: list[Shape] = field(default_factory=list)
    inertials: list[Inertial] = field(default_factory=list)

    @property
    def length(self) -> float:
        """Distance from the joint to the end of the link [m]."""
        return float(np.linalg.norm(self.end))


@dataclass
class StatedCylinder:
    """A cylinder that the description contains, by joint: pins in the frames of the links, travel [m].

    Attributes:
        joint: machine joint that the cylinder moves.
        base_link: name of the link with the base pin.
        base_pin: (3,) in the frame of that link [m].
        rod_pin: (3,) in the frame of the link that the joint moves [m].
        stroke: travel of the rod, None if the file states none.
    """

    joint: str
    base_link: str
    base_pin: np.ndarray
    rod_pin: np.ndarray
    stroke: float | None


@dataclass
class MachineTree:
    """The moving links, parents first, the shapes of the fixed base, and notes.

    Attributes:
        links: moving links by machine name.
        base_visuals: visible shapes of the base in the world frame.
        base_collisions: shapes of the base for contacts.
        cylinders: cylinders of the description by machine joint.
        tip: name of the last link and (3,) the tip in its frame [m].
        notes: what was changed, and why.
    """

    links: dict[str, MovingLink]
    base_visuals: list[Shape]
    base_collisions: list[Shape]
    cylinders: dict[str, StatedCylinder]
    tip: tuple[str, np.ndarray]
    notes: list[str]

    def with_role(self, role: str) -> MovingLink | None:
        """Return the first link with a role, or None."""
        return next((link for link in self.links.values() if link.role == role), None)

    @property
    def plane_links(self) -> list[MovingLink]:
        """Links that are hinged in the plane of the arm, from boom to tool."""
        return [link for link in self.links.values() if link.role in ("boom", "stick", "plane", "tool")]


def machine_name(text: str, taken: set[str], endings: str = "") -> str:
    """Return a valid name (lower case, digits, underscore) that is not in `taken`, and add it there.

    `endings` is a pattern of words that are removed at the end, such as `_link`.
    """
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    name = re.sub(endings, "", name) or name if endings else name
    if not name or not name[0].isalpha():
        name = f"link_{name}".rstrip("_")
    if name == "world":
        name = "world_link"
    unique, number = name, 2
    while unique in taken:
        unique, number = f"{name}_{number}", number + 1
    taken.add(unique)
    return unique


def arrange_links(robot: Robot) -> MachineTree:
    """Arrange the links of a robot as those of a machine.

    Raises:
        InputError: no joint of the robot can move.
    """
    locked = _frames_and_followers(robot, notes := robot.notes)
    branches = _cylinder_branches(robot, locked)
    skipped = {name for tube, rod in branches for name in (tube, rod)}
    skipped |= _mark_moved_by_cylinders(robot, branches)
    path = _longest_path(robot, locked | skipped)
    if not path:
        raise InputError(robot.name, "has no joint that moves; a machine needs at least one")
    below = _descendants(robot, path[-1])
    others = [
        name for name, link in robot.links.items()
        if link.kind != "fixed" and name not in locked | skipped | set(path) | below
    ]  # fmt: skip
    locked |= set(others)
    if others:
        notes.append(f"not part of the arm and locked at 0: {', '.join(robot.links[name].joint for name in others)}")
    return _Arranger(robot, locked, skipped, path, notes).arrange(branches)


def _common_prefix(names: list[str]) -> str:
    """Return the prefix that all names share, up to the last `/` or `_` in it, such as that of a namespace."""
    found = re.match(r".*[/_]", os.path.commonprefix(names))
    return found.group() if found and len(names) > 1 else ""


def _frames_and_followers(robot: Robot, notes: list[str]) -> set[str]:
    """Return the links whose joints are locked because they follow others, or carry nothing."""
    has_shapes = any(link.visuals for link in robot.links.values())
    locked: set[str] = set()
    for name in reversed(robot.links):
        link = robot.links[name]
        if link.kind == "fixed":
            continue
        children = [child for child, other in robot.links.items() if other.parent == name]
        if link.mimics:
            locked.add(name)
            notes.append(f"joint {link.joint} follows {link.mimics}, which machines cannot express; it is locked at 0")
            continue
        points = [shape.points() for shape in link.visuals + link.collisions]
        size = float(np.ptp(np.vstack(points), axis=0).max()) if points else 0.0
        mass = link.inertial.mass if link.inertial else 0.0
        empty = size < _FRAME_SIZE and mass < _FRAME_MASS and (has_shapes or link.inertial is not None)
        if empty and all(robot.links[child].kind == "fixed" or child in locked for child in children):
            locked.add(name)
            notes.append(f"joint {link.joint} moves no body; {name} is used as a frame")
    return locked


def _cylinder_branches(robot: Robot, locked: set[str]) -> list[tuple[str, str]]:
    """Return (tube, rod) of each cylinder in the description: a hinged tube with a sliding rod at its end."""
    closed = {closure.link for closure in robot.closures} | {closure.other for closure in robot.closures}
    branches = []
    for rod, link in robot.links.items():
        tube = robot.links.get(link.parent or "")
        if link.kind != "slide" or tube is None or tube.kind != "hinge" or tube.parent is None:
            continue
        moving = [n for n, o in robot.links.items() if o.parent == rod and o.kind != "fixed" and n not in locked]
        words = f"{rod} {tube.name} {link.joint} {tube.joint}"
        if not moving and (rod in closed or _CYLINDER_NAMES.search(words)):
            branches.append((tube.name, rod))
    return branches


def _mark_moved_by_cylinders(robot: Robot, branches: list[tuple[str, str]]) -> set[str]:
    """Mark the links that rods are closed to as driven, and return the bars between a rod and a tool.

    Bars are links that carry nothing but other bars, and are closed to the rod at one end and to
    another link at the other: rocker and coupler of a four-bar linkage, which is estimated anew.
    """
    others: dict[str, set[str]] = {}
    for closure in robot.closures:
        others.setdefault(closure.link, set()).add(closure.other)
        others.setdefault(closure.other, set()).add(closure.link)
    bars: set[str] = set()
    for _, rod in branches:
        for end in others.get(rod, ()):
            closed = {end} | _descendants(robot, end)
            beyond = set().union(*(others.get(name, set()) for name in closed)) - closed - {rod}
            beyond -= {name for branch in branches for name in branch}
            if beyond:
                bars |= closed
                robot.notes.append(f"linkage {', '.join(sorted(closed))} of a cylinder is estimated anew")
            for name in beyond or {end}:
                robot.links[name].is_driven = True
    return bars


def _longest_path(robot: Robot, excluded: set[str]) -> list[str]:
    """Return the moving links of the longest chain from the root, by distance and slide travel."""
    best: tuple[float, list[str]] = (-1.0, [])
    for leaf in robot.links:
        chain, length, name = [], 0.0, leaf
        while name is not None:
            link = robot.links[name]
            if link.kind != "fixed" and name not in excluded:
                chain.insert(0, name)
            if link.kind == "slide" and link.range:
                length += link.range[1] - link.range[0]
            length += float(np.linalg.norm(link.position)) if name not in excluded and chain else 0.0
            name = link.parent
        if chain and len(chain) + length > best[0] and not excluded & {leaf}:
            best = (len(chain) + length, chain)
    return best[1]


def _descendants(robot: Robot, root: str) -> set[str]:
    found = {root}
    for name, link in robot.links.items():
        if link.parent in found:
            found.add(name)
    return found - {root}


def _clean_axis(axis: np.ndarray) -> np.ndarray:
    cleaned = np.where(np.abs(axis) < _AXIS_ROUNDING, 0.0, axis)
    return cleaned / np.linalg.norm(cleaned)


class _Arranger:
    """Computes roles, reference pose and frames of one robot."""

    def __init__(self, robot: Robot, locked: set[str], skipped: set[str], path: list[str], notes: list[str]):
        self.robot, self.locked, self.skipped, self.path, self.notes = robot, locked, skipped, path, notes
        self.reference: dict[str, float] = {}  # robot angle at machine angle 0
        self.signs: dict[str, float] = {}
        self.roles: dict[str, str] = {}
        self.names: dict[str, str] = {}  # names of links in the machine
        moving = [link for name, link in robot.links.items() if self.moves(name)]
        self.prefixes = _common_prefix([link.name for link in moving]), _common_prefix([link.joint for link in moving])
        self.base = np.eye(3)  # orientation of the robot's root in the world
        self.rotations, self.origins = self._forward_kinematics()

    def moves(self, name: str) -> bool:
        link = self.robot.links[name]
        return link.kind != "fixed" and name not in self.locked | self.skipped

    def _forward_kinematics(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return orientation (3, 3) and origin (3,) of every link in the world at the reference pose."""
        rotations, origins = {}, {}
        for name, link in self.robot.links.items():
            if link.parent is None:
                rotations[name], origins[name] = self.base, np.zeros(3)
                continue
            above = rotations[link.parent]
            origins[name] = origins[link.parent] + above @ link.position
            rotations[name] = above @ link.rotation
            if angle := self.reference.get(name, 0.0):
                rotations[name] = rotations[name] @ rotation_about(link.axis, angle)
        return rotations, origins

    def world_axis(self, name: str) -> np.ndarray:
        return self.rotations[name] @ self.robot.links[name].axis

    def arrange(self, branches: list[tuple[str, str]]) -> MachineTree:
        zero_rotations, zero_origins = self.rotations, self.origins
        self._assign_roles()
        plane = [name for name in self.path if self.roles[name] in ("boom", "stick", "plane", "tool")]
        if plane:
            self._stretch(plane)
        self.rotations, self.origins = self._forward_kinematics()
        stated = {}
        for tube, rod in branches:
            self._read_cylinder(tube, rod, zero_rotations, zero_origins, stated)
        tree = self._build()
        for name, cylinder in stated.items():
            base = "world" if cylinder.base_link == "world" else self.names[cylinder.base_link]
            tree.cylinders[tree.links[self.names[name]].joint] = replace(cylinder, base_link=base)
        return tree

    def _assign_roles(self) -> None:
        path, links = self.path, self.robot.links
        rest = list(path)
        if links[path[0]].kind == "hinge" and abs(self.world_axis(path[0]) @ _UP) > _PARALLEL and len(path) > 1:
            self.roles[path[0]] = "swing"
            self.signs[path[0]] = math.copysign(1.0, self.world_axis(path[0]) @ _UP)
            rest = path[1:]
        level = [n for n in rest if links[n].kind == "hinge" and abs(self.world_axis(n) @ _UP) < 0.05]
        plane: list[str] = []
        if level:
            way = self.world_axis(level[0])
            plane = [n for n in level if abs(self.world_axis(n) @ way) > _PARALLEL and links[n].is_driven]
        words = ["boom", "stick", *["plane"] * 8]
        for name, word in zip(plane, words, strict=False):
            self.roles[name] = word
        if len(plane) > 2:
            self.roles[plane[-1]] = "tool"
        for name, link in links.items():
            if self.moves(name) and name not in self.roles:
                role = "telescope" if link.kind == "slide" else "rotator"
                self.roles[name] = role if link.is_driven else "passive"

    def _stretch(self, plane: list[str]) -> None:
        """Set the reference pose in which the links of the plane point forward, and turn the base so that it is +x."""
        links = self.robot.links
        across = self.world_axis(plane[0])
        ends = {name: self._end_of(name) for name in plane}
        way = ends[plane[0]] - self.origins[plane[0]]
        limits = links[plane[0]].range or (0.0, 0.0)
        way = rotation_about(across, 0.5 * sum(limits)) @ way
        forward = np.cross(across, _UP)
        if way @ forward < 0.0:
            forward = -forward
        yaw = -math.atan2(forward[1], forward[0])
        before = 0.0
        for name in plane:
            axis = self.world_axis(name)
            raises = 1.0 if axis @ np.cross(forward, _UP) > 0.0 else -1.0  # the axis -y raises
            vector = ends[name] - self.origins[name]
            absolute = math.atan2(vector @ _UP, vector @ forward)
            angle = raises * (before - absolute)
            low, high = links[name].range or (0.0, 0.0)
            middle = 0.5 * (low + high)
            angle += 2.0 * math.pi * round((middle - angle) / (2.0 * math.pi))
            self.reference[name], self.signs[name] = angle, raises
            before = absolute
        self.base = rotation_about(_UP, yaw)

    def _end_of(self, name: str) -> np.ndarray:
        """Return the end of a link at the present pose in the world: the next joint of the path, or the tip."""
        number = self.path.index(name)
        for following in self.path[number + 1 :]:
            if np.linalg.norm(self.origins[following] - self.origins[name]) > _FRAME_SIZE:
                return self.origins[following]
        below = [n for n in _descendants(self.robot, name) if not self.moves(n)]
        frames = [self.origins[n] for n in below if not self.robot.links[n].visuals or n in self.locked]
        frames = [place for place in frames if np.linalg.norm(place - self.origins[name]) > _FRAME_SIZE]
        points = [self._world_points(n) for n in [name, *below]]
        cloud = np.vstack([p for p in points if len(p)] or [np.zeros((0, 3))])
        if frames:
            return max(frames, key=lambda place: float(np.linalg.norm(place - self.origins[name])))
        if len(cloud):
            axis = self.world_axis(name)
            away = cloud - self.origins[name]
            away -= np.outer(away @ axis, axis)
            return self.origins[name] + away[np.argmax(np.linalg.norm(away, axis=1))]
        stated = self.robot.links[name].inertial
        if stated is not None and np.linalg.norm(stated.centre) > _FRAME_SIZE:
            return self.origins[name] + 2.0 * self.rotations[name] @ stated.centre
        above = self.robot.links[name].parent
        way = self.origins[name] - self.origins[above] if above else np.array([1.0, 0.0, 0.0])
        return self.origins[name] + 0.4 * (way if np.linalg.norm(way) > _FRAME_SIZE else np.array([1.0, 0.0, 0.0]))

    def _world_points(self, name: str) -> np.ndarray:
        link = self.robot.links[name]
        clouds = [shape.points() for shape in link.visuals or link.collisions]
        if not clouds:
            return np.zeros((0, 3))
        return np.vstack(clouds) @ self.rotations[name].T + self.origins[name]

    def _carrier(self, name: str | None) -> str | None:
        """Return the moving link to which a link is fixed, the link itself if it moves, or None for the base."""
        while name is not None and not self.moves(name):
            name = self.robot.links[name].parent
        return name

    def _read_cylinder(self, tube: str, rod: str, rotations, origins, stated: dict) -> None:
        """Add the cylinder of a tube and a rod, whose pins are read at robot pose 0, to `stated` by joint."""
        links = self.robot.links
        base = self._carrier(links[tube].parent)
        after = self.path[self.path.index(base) + 1 if base in self.path else 0 :]
        pin = None
        for one, place, other, other_place in self.robot.closures:
            for rod_end, far, far_place in ((one, other, other_place), (other, one, place)):
                if rod_end == rod:
                    pin, after = (
                        origins[far] + rotations[far] @ far_place,
                        [n for n in after if n == self._carrier(far)],
                    )
        if pin is not None and not after:
            return  # of a four-bar linkage, which is estimated anew
        if not after or self.roles.get(after[0]) == "swing":
            self.notes.append(f"cylinder {tube} moves no joint of the arm; it is left out")
            return
        moved = after[0]
        if pin is None:
            pin = self._rod_eye(tube, rod, rotations, origins)
            points = [shape.points() @ rotations[moved].T + origins[moved] for shape in links[moved].visuals]
            cloud = np.vstack(points) if points else np.zeros((0, 3))
            if distance_outside_hull(cloud, pin) > _MAX_PIN_GAP * float(np.ptp(cloud, axis=0).max(initial=0.0)):
                self.notes.append(f"rod {rod} does not reach {moved} at joint angle 0; its cylinder is estimated")
                return
        limits = links[rod].range
        base_place = origins[tube]
        base_rotation = self.rotations[base] if base else self.base
        base_zero = (rotations[base], origins[base]) if base else (np.eye(3), np.zeros(3))
        base_pin = base_rotation @ (base_zero[0].T @ (base_place - base_zero[1]))
        rod_pin = self.rotations[moved] @ (rotations[moved].T @ (pin - origins[moved]))
        stroke = limits[1] - limits[0] if limits else None
        stated[moved] = StatedCylinder(moved, base or "world", base_pin, rod_pin, stroke)

    def _rod_eye(self, tube: str, rod: str, rotations, origins) -> np.ndarray:
        """Return the far end of a rod's shape, less its radius, or its frame's origin without a shape."""
        link = self.robot.links[rod]
        points = [shape.points() for shape in link.visuals]
        if not points:
            return origins[rod]
        cloud = np.vstack(points) @ rotations[rod].T + origins[rod]
        way = rotations[rod] @ link.axis
        middle = cloud.mean(axis=0)
        if (middle - origins[tube]) @ way < 0.0:
            way = -way
        along = (cloud - origins[tube]) @ way
        radius = 0.5 * float(np.linalg.norm((cloud - origins[tube]) - np.outer(along, way), axis=1).max())
        return origins[tube] + way * (float(along.max()) - radius)

    def _build(self) -> MachineTree:
        links = self.robot.links
        taken: set[str] = set()
        names = self.names
        joints: set[str] = set()
        built: dict[str, MovingLink] = {}
        base_visuals: list[Shape] = []
        base_collisions: list[Shape] = []
        ends = {name: self._end_of(name) for name in self.path}
        for name, link in links.items():
            if name in self.skipped or self._is_below_skipped(name):
                continue
            carrier = self._carrier(name)
            if name == carrier:
                self._add_moving_link(name, names, taken, joints, built, ends)
            if carrier is None:
                rotation, origin = self.rotations[name], self.origins[name]
                base_visuals += [shape.transform(rotation, origin) for shape in link.visuals]
                base_collisions += [shape.transform(rotation, origin) for shape in link.collisions]
                continue
            target, rotation = built[names[carrier]], self.rotations[name]
            origin = self.origins[name] - self.origins[carrier]
            target.visuals += [shape.transform(rotation, origin) for shape in link.visuals]
            target.collisions += [shape.transform(rotation, origin) for shape in link.collisions]
            if link.inertial is not None:
                mass, centre, inertia = link.inertial
                target.inertials.append(Inertial(mass, rotation @ centre + origin, rotation @ inertia @ rotation.T))
        last = self.path[-1]
        tip = (names[last], ends[last] - self.origins[last])
        tree = MachineTree(built, base_visuals, base_collisions, {}, tip, self.notes)
        return tree

    def _is_below_skipped(self, name: str) -> bool:
        above: str | None = name
        while above is not None:
            if above in self.skipped:
                return True
            above = self.robot.links[above].parent
        return False

    def _add_moving_link(self, name, names, taken, joints, built, ends) -> None:
        link: RobotLink = self.robot.links[name]
        above = self._carrier(link.parent)
        names[name] = machine_name(name.removeprefix(self.prefixes[0]), taken, r"_(link|frame)$")
        joint = machine_name(link.joint.removeprefix(self.prefixes[1]), joints, r"_(joint|axis)$")
        origin = self.origins[above] if above else np.zeros(3)
        sign, offset = self.signs.get(name, 1.0), self.reference.get(name, 0.0)
        limits = link.range
        if limits:
            low, high = sorted(sign * (limit - offset) for limit in limits)
            limits = (low, high)
        built[names[name]] = MovingLink(
            names[name], joint, names[above] if above else "world", self.origins[name] - origin, link.kind,
            _clean_axis(sign * self.world_axis(name)), limits, self.roles[name], link.joint, sign, offset,
            ends.get(name, self.origins[name]) - self.origins[name],
        )  # fmt: skip

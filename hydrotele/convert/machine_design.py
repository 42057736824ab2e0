"""Choose drives, masses, hydraulics and home pose of a machine from its arranged links."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.convert.arm_links import MachineTree, MovingLink
from hydrotele.convert.cylinders import (
    PlacedCylinder,
    PlacedFourBar,
    place_four_bar,
    place_on_hinge,
    place_on_slide,
    place_stated,
)
from hydrotele.convert.estimates import BodyEstimate, HydraulicClass, estimate_body, hydraulic_class, machine_mass
from hydrotele.convert.robot_description import rotation_about
from hydrotele.core.errors import InputError

MAX_AXES = 8  # valves of one supply
_AREA_OF_ROLE = {"boom": 1.0, "stick": 0.7, "plane": 0.6, "tool": 0.5, "telescope": 0.25}  # of the boom's
_HOLDING_PRESSURE_FRACTION = 0.6  # of the relief pressure that may hold the arm stretched
_MAX_ENLARGEMENT = 4.0  # of an estimated area
_GRAVITY = 9.81
_MAX_SIZE_RATIO = 20.0  # size of a link over the longest arm link
_CLEARANCE = 0.1  # m between the moving links and the ground at home
_ROTATOR_DISPLACEMENT = 0.085  # of the swing motor's, CAT 215 with grapple


class Drive(NamedTuple):
    """Drive of a joint: a cylinder, a cylinder with a four-bar, or a motor.

    Attributes:
        cylinder: the cylinder, None for a motor.
        four_bar: linkage of the cylinder, if any.
        area: head-side area [m^2].
        displacement: of a motor [m^3/rad].
        count: number of equal parallel cylinders.
    """

    cylinder: PlacedCylinder | None = None
    four_bar: PlacedFourBar | None = None
    area: float = 0.0
    displacement: float = 0.0
    count: int = 1


@dataclass
class MachineDesign:
    """A complete machine before it is written.

    Attributes:
        tree: the links.
        length: length of the longest arm link [m], the class of the machine.
        bodies: mass properties by link.
        drives: drives by joint.
        hydraulics: typical hydraulics.
        home: joint positions at home.
        notes: what was changed or assumed.
    """

    tree: MachineTree
    length: float
    bodies: dict[str, BodyEstimate]
    drives: dict[str, Drive]
    hydraulics: HydraulicClass
    home: dict[str, float]
    notes: list[str]

    def driven_links(self) -> list[MovingLink]:
        """Return the links whose joints have drives, parents first."""
        return [link for link in self.tree.links.values() if link.joint in self.drives]


def design_machine(tree: MachineTree, where: object) -> MachineDesign:
    """Choose drives, masses and home pose of a machine.

    Args:
        tree: arranged links; it is raised so that its base stands on the ground.
        where: file, for messages.

    Raises:
        InputError: no joint can be moved by a cylinder.
    """
    notes = tree.notes
    plane = tree.plane_links
    slides = [link for link in tree.links.values() if link.kind == "slide"]
    lengths = [link.length for link in plane] or [link.length for link in tree.links.values()]
    lengths += [link.range[1] - link.range[0] for link in slides if link.range]
    longest = max(lengths)
    if longest < 1e-3:
        raise InputError(where, "all joints are at one point; are the origins of the joints missing?")
    _check_sizes(tree, longest, where)
    _stand_on_ground(tree, longest)
    bodies = {name: estimate_body(link, longest) for name, link in tree.links.items()}
    hydraulics = hydraulic_class(longest)
    drives: dict[str, Drive] = {}
    for link in tree.links.values():
        if link.role == "passive":
            notes.append(f"joint {link.source_joint} has no actuator in the file; it moves freely")
        elif len(drives) == MAX_AXES:
            link.role = "passive"
            notes.append(f"joint {link.source_joint} is the ninth or later; it moves freely")
        elif drive := _choose_drive(tree, link, longest, hydraulics, notes):
            drives[link.joint] = drive
    if not any(drive.cylinder for drive in drives.values()):
        raise InputError(
            where,
            "has no joint that a cylinder can move (a slide, or a hinge with less than 152 deg of travel);"
            " for a robot without hydraulics use `hydrotele identify --mjcf` and `hydrotele gap --mjcf`",
        )
    design = MachineDesign(tree, longest, bodies, drives, hydraulics, {}, notes)
    design.home = _choose_home(design)
    _enlarge_weak_drives(design)
    for name, body in bodies.items():
        if body.reason:
            notes.append(f"mass and inertia of {name} replaced by an estimate, {body.mass:.3g} kg: {body.reason}")
    notes.append(f"class: longest arm link {longest:.3g} m, typical machine mass {machine_mass(longest) / 1e3:.2g} t")
    return design


def _check_sizes(tree: MachineTree, longest: float, where: object) -> None:
    """Raise InputError if the shapes of a link are much larger than the arm, as meshes in millimetres are."""
    for name, link in tree.links.items():
        points = [shape.points() for shape in link.visuals]
        size = float(np.ptp(np.vstack(points), axis=0).max()) if points else 0.0
        if size > _MAX_SIZE_RATIO * longest:
            message = f"the shapes of {name} are {size:.3g} m long, the arm's links at most {longest:.3g} m;"
            raise InputError(where, f'{message} give meshes in millimetres scale="0.001 0.001 0.001"')


def _stand_on_ground(tree: MachineTree, longest: float) -> None:
    """Shift base and first links vertically so that the base stands on the ground z = 0."""
    points = [shape.points() for shape in tree.base_visuals + tree.base_collisions]
    first = [link for link in tree.links.values() if link.parent == "world"]
    if points:
        shift = -float(np.vstack(points)[:, 2].min())
    else:  # a base without shapes; the slew ring of an excavator is 0.2 boom lengths above ground
        shift = max(0.0, 0.2 * longest - float(first[0].position[2]))
    for link in first:
        link.position = link.position + [0.0, 0.0, shift]
    lift = np.array([0.0, 0.0, shift])
    tree.base_visuals = [shape.transform(np.eye(3), lift) for shape in tree.base_visuals]
    tree.base_collisions = [shape.transform(np.eye(3), lift) for shape in tree.base_collisions]
    for cylinder in tree.cylinders.values():
        if cylinder.base_link == "world":
            cylinder.base_pin = cylinder.base_pin + lift


def _choose_drive(
    tree: MachineTree, link: MovingLink, longest: float, hydraulics: HydraulicClass, notes: list[str]
) -> Drive | None:
    """Return the drive of a joint; None if it gets none, with a note."""
    parent = tree.links.get(link.parent)
    area = hydraulics.area * _AREA_OF_ROLE.get(link.role, 0.25)
    if link.role == "swing":
        return Drive(displacement=hydraulics.swing_displacement)
    count = 2 if link.role == "boom" and longest > 3.0 else 1  # larger machines have a cylinder on each side
    if stated := tree.cylinders.get(link.joint):
        if cylinder := place_stated(link, parent, stated):
            return Drive(cylinder, area=area)
        notes.append(f"the cylinder of {link.source_joint} in the file cannot move it through its range; estimated")
    if link.kind == "slide":
        if abs(link.axis[1]) > 0.05:
            link.role = "passive"
            notes.append(f"slide {link.source_joint} moves sideways, where no cylinder is placed; it moves freely")
            return None
        if link.range is None:
            notes.append(f"slide {link.source_joint} has no limits; half a boom length is assumed")
            link.range = (0.0, 0.5 * longest)
        return Drive(place_on_slide(parent, link, longest), area=area)
    if link.role in ("boom", "stick", "plane", "tool"):
        if link.role == "tool" and parent and parent.role in ("stick", "plane"):
            if four_bar := place_four_bar(parent, link, longest):
                return Drive(four_bar.cylinder, four_bar, area)
        if cylinder := place_on_hinge(parent, link, longest, count):
            return Drive(cylinder, area=area, count=count)
        reason = "has no limits" if link.range is None else f"turns by {math.degrees(np.ptp(link.range)):.0f} deg"
        notes.append(f"joint {link.source_joint} {reason}, too much for a cylinder; it gets a motor")
    return Drive(displacement=_ROTATOR_DISPLACEMENT * hydraulics.swing_displacement)


def joint_poses(tree: MachineTree, angles: dict[str, float]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return orientation (3, 3) and origin (3,) of each link in the world at joint positions."""
    poses = {"world": (np.eye(3), np.zeros(3))}
    for name, link in tree.links.items():
        rotation, origin = poses[link.parent]
        origin, q = origin + rotation @ link.position, angles.get(link.joint, 0.0)
        if link.kind == "slide":
            origin = origin + rotation @ link.axis * q
        else:
            rotation = rotation @ rotation_about(link.axis, q)
        poses[name] = rotation, origin
    return poses


def _lowest_point(design: MachineDesign, angles: dict[str, float]) -> float:
    lowest = math.inf
    for name, (rotation, origin) in joint_poses(design.tree, angles).items():
        link = design.tree.links.get(name)
        if link is None or link.role == "swing":
            continue
        points = [shape.points() for shape in link.visuals] or [np.vstack([np.zeros(3), link.end])]
        lowest = min(lowest, float((np.vstack(points) @ rotation.T + origin)[:, 2].min()))
    return lowest


def _choose_home(design: MachineDesign) -> dict[str, float]:
    """Return a working pose: boom 25 deg, stick -90 deg, others in the middle of their ranges.

    Boom and stick are raised until nothing touches the ground.
    """
    tree = design.tree
    home: dict[str, float] = {}

    def clip(link: MovingLink, value: float) -> float:
        if link.range is None:
            return value
        low, high = link.range
        margin = 0.1 * (high - low)
        return min(max(value, low + margin), high - margin)

    pitch = 0.0
    for link in tree.links.values():
        low, high = link.range or (0.0, 0.0)
        middle = 0.5 * (low + high)
        wish = {"boom": math.radians(25.0), "stick": math.radians(-90.0), "swing": 0.0}.get(link.role, middle)
        if link.role == "telescope":
            wish = low + 0.25 * (high - low)
        if link.role == "passive" and link.kind == "hinge" and abs(link.axis[1]) > 0.9:
            centre = design.bodies[link.name].centre
            wish = -math.copysign(1.0, link.axis[1]) * (-0.5 * math.pi - math.atan2(centre[2], centre[0]) - pitch)
            wish = math.remainder(wish, 2.0 * math.pi)
        home[link.joint] = clip(link, wish)
        if link.kind == "hinge" and abs(link.axis[1]) > 0.9:
            pitch -= math.copysign(1.0, link.axis[1]) * home[link.joint]
    raised = [link for link in tree.plane_links if link.range] or []
    for link in [link for link in raised if link.role in ("boom", "stick")]:
        for _ in range(20):
            if _lowest_point(design, home) > _CLEARANCE:
                break
            home[link.joint] = clip(link, home[link.joint] + math.radians(4.0))
    for link in tree.links.values():
        home[link.joint] = round(home[link.joint], 4)
    return home


def _enlarge_weak_drives(design: MachineDesign) -> None:
    """Enlarge estimated areas and motors so that they hold the stretched arm with a fraction of the relief pressure."""
    tree = design.tree
    stretched = dict(design.home)
    for link in tree.plane_links:
        low, high = link.range or (0.0, 0.0)
        stretched[link.joint] = min(max(0.0, low), high)
    poses = joint_poses(tree, stretched)
    pressure = _HOLDING_PRESSURE_FRACTION * design.hydraulics.relief_pressure
    for link in tree.links.values():
        drive = design.drives.get(link.joint)
        if drive is None or link.kind == "slide" or link.role == "swing":
            continue
        pivot, torque = poses[link.name][1], 0.0
        for name in _links_beyond(tree, link.name):
            rotation, origin = poses[name]
            body = design.bodies[name]
            torque += body.mass * _GRAVITY * float(np.linalg.norm((origin + rotation @ body.centre - pivot)[:2]))
        if drive.cylinder:
            needed = torque / (pressure * max(_typical_lever(link, drive.cylinder), 1e-3))
            enlarged = drive._replace(area=min(max(drive.area, needed), _MAX_ENLARGEMENT * drive.area))
        else:
            enlarged = drive._replace(displacement=max(drive.displacement, torque / pressure))
        design.drives[link.joint] = enlarged


def _typical_lever(link: MovingLink, cylinder: PlacedCylinder) -> float:
    assert link.range
    return cylinder.stroke / (link.range[1] - link.range[0])


def _links_beyond(tree: MachineTree, name: str) -> list[str]:
    found = [name]
    for other, link in tree.links.items():
        if link.parent in found:
            found.append(other)
    return found

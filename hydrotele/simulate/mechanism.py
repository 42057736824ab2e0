"""Assemble the MuJoCo model (MJCF) of a Machine with `dm_control.mjcf`.

The machine's MJCF defines the body tree and the shapes; all parameters come from the Machine. Each
cylinder becomes a tube (hinged to its base pin), a rod (sliding in the tube; the position of the
slide is the piston displacement x) and a `connect` constraint at the rod pin. Visual geometry is
omitted from the physics model, because hundreds of geoms without contact double the cost of a step.
Masses are never derived from geoms. The names of all added elements have the prefix `hydrotele_`,
which prevents collisions with names in user files.

A transmission adds a separate coordinate for the drive, with the same parent body as the load: a
rotor about the joint's axis, a slide along it, or a piston in the tube. The drive's inertia is the
armature of this coordinate, so that it adds no weight. A fixed tendon (drive minus load) is the
spring and damper between both; its dead band is the backlash.
"""

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.datafile import Vector
from hydrotele.core.errors import InputError
from hydrotele.core.mjcf import read_mjcf, translate_mujoco_errors
from hydrotele.hydraulics.actuator_layout import (
    SLOT_COUNT,
    Slot,
    actuator_parameters,
    machine_terms_table,
)
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.kinematics.drive_linkage import drive_travel, has_ball_ends, joint_range_at_drive, pin_axis
from hydrotele.machine.drives import Axis, Cylinder, Pin
from hydrotele.machine.machine import Link, Machine
from hydrotele.scenario.surrounding_objects import SurroundingObject
from hydrotele.simulate.surroundings import write_surroundings

NAME_PREFIX = "hydrotele_"
"""Prefix of the names of all elements that are not named in user files."""

GROUND_NAME = f"{NAME_PREFIX}ground"
"""Name of the geom, texture and material of the ground."""

TIP_SITE = f"{NAME_PREFIX}tip"
"""Name of the site at the arm's tip."""


def pin_site_name(closure: str, end: str) -> str:
    """Return the name of the MuJoCo site at one end (`a` or `b`) of a pin joint that closes a loop.

    The rod pin of a cylinder has the closure name `<axis>_pin`.
    """
    return f"{NAME_PREFIX}{closure}_{end}"


class Mjcf(NamedTuple):
    """A complete MJCF document.

    Attributes:
        name: name of the machine.
        text: the XML text; asset files are named without folder.
        assets: name -> content of every asset file.
    """

    name: str
    text: str
    assets: Mapping[str, bytes]

    def compile(self) -> mujoco.MjModel:
        """Compile the document to a MuJoCo model.

        Raises:
            InputError: MuJoCo cannot compile it.
        """
        with translate_mujoco_errors(f"machine {self.name}"):
            return mujoco.MjModel.from_xml_string(self.text, dict(self.assets))

    def save(self, path: Path, final_path: Path | None = None) -> None:
        """Write the document to a file, and its assets to the folder `<stem>_assets` next to it.

        Args:
            path: file to write.
            final_path: path to which the caller will move the file, if `path` is temporary; its
                stem then names the asset folder.
        """
        folder = (final_path or path).with_suffix("").name + "_assets"
        text = self.text
        for name, content in self.assets.items():
            path.with_name(folder).mkdir(exist_ok=True)
            path.with_name(folder).joinpath(name).write_bytes(content)
            text = text.replace(f'="{name}"', f'="{folder}/{name}"')
        path.write_text(text, encoding="utf-8")


Element = ElementTree.Element


def remove_visual_geometry(root: Element) -> None:
    """Remove geoms without contact, unused assets, materials, cameras and lights, in place.

    Args:
        root: the `mujoco` element of an MJCF file.
    """
    world = root.find("worldbody")
    if world is None:
        return
    touching = _contacts_by_class(root)
    _remove_visual_elements(world, "main", touching)
    kept = {(kind, geom.get(kind)) for geom in world.iter("geom") for kind in ("mesh", "hfield")}
    for asset in root.findall("asset"):
        for element in list(asset):
            if (element.tag, _asset_name(element)) not in kept:
                asset.remove(element)
    for geom in root.iter("geom"):  # in bodies and in default classes
        geom.attrib.pop("material", None)


def _asset_name(element: Element) -> str:
    """Return the name of an asset; without a `name` attribute it is the stem of its file."""
    return element.get("name") or PurePosixPath(element.get("file", "")).stem


def name_geoms(root: Element) -> None:
    """Give every unnamed geom of an MJCF tree a name derived from its body, in place.

    The reason is speed: `dm_control` searches the whole document for each unnamed element that it writes.
    """
    for body in root.iter("body"):
        for number, geom in enumerate(body.findall("geom")):
            if not geom.get("name"):
                geom.set("name", f"{body.get('name', 'body')}_look{number}")


def _contacts_by_class(root: Element) -> dict[str, bool]:
    """Return for each default class of an MJCF whether its geoms can have contacts by default."""
    table: dict[str, bool] = {}

    def visit_default_class(element: Element, name: str, contype: int, conaffinity: int) -> None:
        geom = element.find("geom")
        if geom is not None:
            contype = int(geom.get("contype", contype))
            conaffinity = int(geom.get("conaffinity", conaffinity))
        table[name] = bool(contype or conaffinity)
        for child in element.findall("default"):
            visit_default_class(child, child.get("class", "main"), contype, conaffinity)

    for top in root.findall("default"):
        visit_default_class(top, top.get("class", "main"), 1, 1)
    table.setdefault("main", True)
    return table


def _remove_visual_elements(body: Element, inherited: str, touching: dict[str, bool]) -> None:
    """Remove geoms without contact, cameras and lights from a body and its children, in place.

    `inherited` is the default class of the parent body, and `touching` the result of
    `_contacts_by_class`.
    """
    childclass = body.get("childclass", inherited)
    for element in list(body):
        if element.tag == "geom":
            default = touching.get(element.get("class", childclass), True)
            stated = [element.get(key) for key in ("contype", "conaffinity")]
            own = any(value not in (None, "0") for value in stated)
            if not (own or (default and stated != ["0", "0"])):
                body.remove(element)
        elif element.tag in ("camera", "light"):
            body.remove(element)
        elif element.tag in ("body", "frame"):
            _remove_visual_elements(element, childclass, touching)


with warnings.catch_warnings():  # glfw warns if there is no screen; none is needed here
    warnings.simplefilter("ignore")
    from dm_control import mjcf

# With MuJoCo's default softness the pins of a 10 t machine open by decimetres. A time constant of
# two steps is the smallest that MuJoCo allows; the softness then vanishes with the step.
_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2)
_BEND_DAMPING = 0.01  # s: the bending vibration of a few hertz decays after a few periods
_CONTACT_SOLREF = (0.02, 1.0)  # s, 1: firm soil; impact forces grow inversely with the time
_SOIL_FRICTION = (0.3, 0.02, 0.001)  # steel sliding on loam: friction angle of some 17 deg


def assemble_mjcf(
    machine: Machine,
    timestep: float = 1.0e-3,
    ground: bool = True,
    visuals: bool = True,
    surroundings: tuple[SurroundingObject, ...] = (),
) -> mjcf.RootElement:
    """Build the MJCF of a machine, with scene, closures and actuators.

    Args:
        machine: the machine, with one tool.
        timestep: physics step [s].
        ground: whether the ground can be touched.
        visuals: whether to include visual geometry.
        surroundings: objects around the machine.

    Returns:
        The MJCF document; `mjcf_document` converts it to text.

    Raises:
        InputError: the machine's MJCF cannot be read, or a link's parent body is missing in it.
    """
    root = _read_mjcf(machine, visuals)
    try:
        return _add_machine_elements(root, machine, timestep, ground, visuals, surroundings)
    except InputError:
        raise
    except ValueError as error:  # dm_control: duplicate name or invalid value
        raise InputError(f"machine {machine.name}", f"cannot be assembled: {error}") from None


def _add_machine_elements(
    root, machine: Machine, timestep: float, ground: bool, looks: bool,
    surroundings: tuple[SurroundingObject, ...],
) -> mjcf.RootElement:  # fmt: skip
    """Add the elements of the machine file, the surroundings and the scene to the MJCF and return it.

    Also remove the bodies of unused tools. `looks` is whether to add visual geometry. Raise
    InputError for elements of the MJCF that belong in the machine file.
    """
    root.model = machine.name
    for name in machine.removed_bodies:
        if body := root.find("body", name):
            body.remove()
    _reject_foreign_elements(root, machine)
    _set_options(root, machine, timestep)
    for name, link in machine.links.items():
        _write_link(root, name, link)
    for name, axis in machine.axes.items():
        if axis.cylinder:
            _write_cylinder(root, name, axis.cylinder, pin_axis(machine, name), timestep)
            if has_ball_ends(machine, name):
                _add_tube_tilt_hinge(root, name)
            _write_travel(root, machine, name)
    for name in axes_with_transmission(machine):
        add_transmission_drive_side(root, machine, name)
    for name, closure in machine.closures.items():
        _add_pin(root, name, closure.a, closure.b, timestep)
    if machine.arm:
        tip = machine.arm.tip
        body = _find_body(root, tip.link)
        add_element(body, "site", name=TIP_SITE, pos=tip.position, size=(0.03,), group=4)
    _write_actuators(root, machine)
    if machine.terms:
        _write_terms(root, machine_terms_table(machine))
    _write_scene(root, ground, looks)
    write_surroundings(root, machine, surroundings, looks)
    return root


_MAX_NUMERIC_SIZE = 500  # largest size of a `numeric` element; larger ones overflow MuJoCo's stack


def _write_terms(root, table: np.ndarray) -> None:
    """Add the table of terms (additional force and flow laws) to the MJCF as custom `numeric` elements.

    A long table is split over consecutive elements, which MuJoCo stores contiguously.
    """
    for part, first in enumerate(range(0, len(table), _MAX_NUMERIC_SIZE), start=1):
        data = table[first : first + _MAX_NUMERIC_SIZE]
        name = "hydrotele_terms" + (f"_{part}" if part > 1 else "")
        add_element(root.custom, "numeric", name=name, size=len(data), data=data)


def add_element(parent, kind: str, **attributes):
    """Add an element of a kind, such as `site`, to a parent element of an MJCF document, and return it.

    This hides the run-time classes of `dm_control` from type checkers.
    """
    return parent.add(kind, **attributes)


def mjcf_document(root: mjcf.RootElement) -> Mjcf:
    """Convert the MJCF document to text, together with its asset files."""
    return Mjcf(root.model, root.to_xml_string(precision=17), root.get_assets())


def compile_mechanism(
    machine: Machine,
    timestep: float = 1.0e-3,
    ground: bool = True,
    visuals: bool = True,
    surroundings: tuple[SurroundingObject, ...] = (),
) -> mujoco.MjModel:
    """Build the MJCF of a machine and compile it.

    Args:
        machine: the machine, with one tool.
        timestep: physics step [s].
        ground: whether the ground can be touched.
        visuals: whether to include visual geometry.
        surroundings: objects around the machine.

    Returns:
        A new model. `plant.build_plant` adds stiffness and damping of the end stops and the inertias of bristle states.

    Raises:
        InputError: the machine's MJCF cannot be assembled.
    """
    return mjcf_document(assemble_mjcf(machine, timestep, ground, visuals, surroundings)).compile()


def _read_mjcf(machine: Machine, looks: bool) -> mjcf.RootElement:
    """Load the machine's MJCF with attached files, or create an empty document if it has no MJCF.

    Visual geometry is removed unless `looks`. Raise InputError if the file cannot be read.
    """
    if not machine.mjcf:
        return mjcf.RootElement(model=machine.name)
    path = Path(machine.folder, machine.mjcf)
    try:
        tree = read_mjcf(path).root
        for body, file in machine.attached.items():
            _attach_bodies(tree, body, Path(machine.folder, file))
        name_geoms(tree)
        if not looks:
            remove_visual_geometry(tree)
        text = ElementTree.tostring(tree, encoding="unicode")
        return mjcf.from_xml_string(text, model_dir=str(path.parent))
    except InputError:
        raise
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise InputError(path, f"is not an MJCF that dm_control can read: {error}") from None


def _attach_bodies(tree: Element, body: str, file: Path) -> None:
    """Attach the bodies of the MJCF file `file`, without its assets, to the body named `body`, in place.

    Raise InputError if the tree has no such body, or the file no worldbody.
    """
    place = next((element for element in tree.iter("body") if element.get("name") == body), None)
    world = read_mjcf(file).root.find("worldbody")
    if place is None or world is None:
        raise InputError(file, f"cannot be attached to {body!r}: no such body, or no worldbody in the file")
    place.extend(world.findall("body"))


def _reject_foreign_elements(root, machine: Machine) -> None:
    """Raise InputError if the MJCF has elements that belong in the machine file.

    These are actuators, equality constraints, keyframes and joints that machine.yaml does not name.
    """
    known = set(machine.joints)
    for name, axis in machine.axes.items():
        known |= {f"{name}_tube", f"{name}_rod", tilt_joint_name(name)} if axis.cylinder else set()
    for name, link in machine.links.items():
        body = root.find("body", name)
        if body is not None and link.joint is None:
            known |= {joint.name for joint in body.joint}  # locked by the machine file
    joints = [j.name or "a joint without name" for j in root.find_all("joint")]
    strange = {
        "actuators": [a.name for a in root.find_all("actuator")],
        "equality constraints": [e.name for e in root.find_all("equality")],
        "keyframes": [k.name for k in root.find_all("key")],
        "joints that are not in machine.yaml": [j for j in joints if j not in known],
    }
    for what, names in strange.items():
        if names:
            listed = ", ".join(str(name) for name in names[:5])
            message = f"has {what} ({listed}); describe them in machine.yaml or remove them"
            raise InputError(Path(machine.folder, str(machine.mjcf)), message)


def _set_options(root, machine: Machine, timestep: float) -> None:
    """Set the compiler, integrator and solver options of the MJCF, including time step and gravity."""
    root.compiler.angle = root.compiler.angle or "degree"  # degree: MuJoCo's default
    root.compiler.autolimits = True
    del root.compiler.boundmass, root.compiler.boundinertia  # a forgotten inertia is an error
    root.option.timestep = timestep
    root.option.gravity = machine.gravity
    root.option.integrator = "Euler"
    root.option.jacobian = "dense"
    root.option.solver = "Newton"
    root.option.iterations = 20
    root.option.tolerance = 1.0e-8
    root.option.cone = "pyramidal"
    root.size.nuser_actuator = SLOT_COUNT
    root.option.flag.island = "disable"  # one machine is one island; the search costs 10 %


def _find_body(root, name: str):
    """Return a body of the document, or the worldbody for `world`."""
    return root.worldbody if name == "world" else root.find("body", name)


def _write_link(root, name: str, link: Link) -> None:
    """Write inertia, position and joint of a link to its MJCF body; create the body if it is missing.

    A link without joint loses the joints of its body. A joint with bending compliance adds two
    hinges with springs, perpendicular to its axis. Raise InputError if the parent has no body.
    """
    body = root.find("body", name)
    if body is None:
        parent = _find_body(root, link.parent)
        if parent is None:
            raise InputError(f"links.{name}", f"its parent {link.parent!r} has no body in the MJCF")
        body = parent.add("body", name=name)
    body.pos = link.position
    _set_inertial(body, link.mass, link.com, link.inertia)
    if link.joint is None:
        for joint in list(body.joint):
            joint.remove()
        return
    joint = root.find("joint", link.joint.name)
    if joint is None:
        joint = body.add("joint", name=link.joint.name)
    joint.type, joint.axis, joint.damping = link.joint.type, link.joint.axis, link.joint.damping
    if link.joint.range:
        turn = link.joint.type == "hinge" and root.compiler.angle == "degree"
        joint.range = np.degrees(link.joint.range) if turn else link.joint.range
    if link.joint.bending:
        stiffness = 1.0 / link.joint.bending
        for letter, across in zip("ab", _perpendicular_axes(link.joint.axis), strict=True):
            body.add(
                "joint", name=f"{NAME_PREFIX}{link.joint.name}_bend_{letter}", type="hinge", axis=across,
                stiffness=stiffness, damping=_BEND_DAMPING * stiffness, limited="false",
            )  # fmt: skip


def _perpendicular_axes(axis: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that are perpendicular to an axis and to each other."""
    way = np.array(axis)
    first = np.cross(way, np.eye(3)[int(np.argmin(np.abs(way)))])
    first /= np.linalg.norm(first)
    return first, np.cross(way, first)


def _set_inertial(body, mass, com, inertia) -> None:
    if body.inertial is not None:
        body.inertial.remove()
    body.add("inertial", mass=mass, pos=com, diaginertia=inertia)


def _write_cylinder(root, name: str, cylinder: Cylinder, pins: Vector, timestep: float) -> None:
    """Write tube, rod and rod-pin constraint of a cylinder to the MJCF; create missing bodies.

    `pins` is the direction of the pin axes in the frame of the link at the base pin.
    """
    tube = root.find("body", f"{name}_tube")
    if tube is None:
        base = _find_body(root, cylinder.base_pin.link)
        tube = base.add("body", name=f"{name}_tube")
        tube.add("joint", name=f"{name}_tube", type="hinge", axis=pins)
    tube.pos = cylinder.base_pin.position
    _set_inertial(tube, cylinder.tube.mass, (cylinder.tube.com, 0, 0), cylinder.tube.inertia)
    rod = root.find("body", f"{name}_rod")
    if rod is None:
        rod = tube.add("body", name=f"{name}_rod")
        rod.add("joint", name=f"{name}_rod", type="slide", axis=(1, 0, 0))
    rod.pos = (cylinder.closed_length, 0.0, 0.0)
    _set_inertial(rod, cylinder.rod.mass, (-cylinder.rod.com, 0, 0), cylinder.rod.inertia)
    rod_end = Pin(link=f"{name}_rod", position=(0.0, 0.0, 0.0))
    _add_pin(root, f"{name}_pin", rod_end, cylinder.rod_pin, timestep)


def _add_tube_tilt_hinge(root, name: str) -> None:
    """Add a second hinge at the base of a tube with ball ends, so that it can also tilt sideways.

    Its axis is perpendicular to the first hinge and to the tube.
    """
    if root.find("joint", tilt_joint_name(name)) is None:
        first = root.find("joint", f"{name}_tube")
        across = np.cross((1.0, 0.0, 0.0), first.axis)
        root.find("body", f"{name}_tube").add(
            "joint", name=tilt_joint_name(name), type="hinge", axis=across / np.linalg.norm(across)
        )


def tilt_joint_name(axis: str) -> str:
    """Return the name of the joint that tilts a tube with ball ends out of its plane of motion."""
    return f"{axis}_tube_tilt"


def _write_travel(root, machine: Machine, name: str) -> None:
    """Set the travel limits of a cylinder axis at the rod slide.

    If the range of the joint that the cylinder moves is also enforced by these limits, the joint itself gets
    no limit, because two end stops would share the load.
    """
    root.find("joint", f"{name}_rod").range = drive_travel(machine, name)
    if joint_range_at_drive(machine, name):
        root.find("joint", machine.axes[name].joint).limited = "false"


def _add_pin(root, name: str, a: Pin, b: Pin, timestep: float) -> None:
    """Add the sites of both halves of a pin, on the links of a and b, and the `connect` constraint."""
    for end, pin in (("a", a), ("b", b)):
        _find_body(root, pin.link).add("site", name=pin_site_name(name, end), pos=pin.position, size=(0.03,), group=4)
    root.equality.add(
        "connect", name=name, site1=pin_site_name(name, "a"), site2=pin_site_name(name, "b"),
        solref=(2.0 * timestep, 1.0), solimp=_IMPEDANCE,
    )  # fmt: skip


def _write_actuators(root, machine: Machine) -> None:
    """Add one MuJoCo actuator per axis, with its hydraulic and friction parameters as user data."""
    for name, numbers in actuator_parameters(machine).items():
        axis: Axis = machine.axes[name]
        actuator = root.actuator.add(
            "general", name=name, user=numbers, biastype="user",
            joint=drive_joint_name(machine, name),
        )  # fmt: skip
        if axis.is_hydraulic:
            last = name == list(machine.hydraulic_axes)[-1]  # owns the additional states
            remembered = int(numbers[Slot.EXTRA_STATES]) if last else 0
            actuator.dyntype, actuator.actdim = "user", ACTIVATIONS_PER_AXIS + remembered
            actuator.gainprm = (0.0,)
            actuator.ctrlrange = (-1.0, 1.0)
        elif axis.force:
            actuator.gainprm = (axis.force.gain,)
            actuator.ctrlrange = (-axis.force.command_limit, axis.force.command_limit)
            if axis.force.friction.has_presliding:
                actuator.dyntype, actuator.actdim, actuator.actearly = "user", 2, True


def _write_scene(root, ground: bool, looks: bool) -> None:
    """Add the ground plane, and with `looks` also sky, light and the ground's texture.

    With `ground`, the ground can be touched. Without `ground` and `looks` nothing is added.
    """
    touch = {"contype": 1, "conaffinity": 2} if ground else {"contype": 0, "conaffinity": 0}
    if ground or looks:
        root.worldbody.add(
            "geom", name=GROUND_NAME, type="plane", size=(40, 40, 1), friction=_SOIL_FRICTION,
            solref=_CONTACT_SOLREF, priority=1, **touch,
        )  # fmt: skip
    if not looks:
        return
    root.visual.headlight.ambient = (0.35, 0.35, 0.35)
    root.visual.headlight.diffuse = (0.45, 0.45, 0.45)
    getattr(root.visual, "global").offwidth = 1920
    getattr(root.visual, "global").offheight = 1200
    root.asset.add(
        "texture", name=f"{NAME_PREFIX}sky", type="skybox", builtin="gradient", rgb1=(0.62, 0.75, 0.88),
        rgb2=(0.92, 0.94, 0.96), width=256, height=256,
    )  # fmt: skip
    root.asset.add(
        "texture", name=GROUND_NAME, type="2d", builtin="checker", rgb1=(0.52, 0.47, 0.40),
        rgb2=(0.56, 0.51, 0.44), width=256, height=256,
    )  # fmt: skip
    root.asset.add("material", name=GROUND_NAME, texture=GROUND_NAME, texrepeat=(40, 40), reflectance=0)
    root.find("geom", GROUND_NAME).material = GROUND_NAME
    root.worldbody.add(
        "light", name=f"{NAME_PREFIX}sun", pos=(4, 8, 14), dir=(-0.25, -0.5, -1), directional=True,
        castshadow=True, diffuse=(0.6, 0.6, 0.55),
    )  # fmt: skip


_MIN_INERTIAL = (
    1.0e-6,
    (1.0e-9, 1.0e-9, 1.0e-9),
)  # kg, kg m^2: MuJoCo rejects moving bodies without mass
_MIN_DEFLECTION = 1.0e-9  # m or rad: smaller static deflections count as no load inside the backlash


def drive_joint_name(machine: Machine, axis: str) -> str:
    """Return the name of the joint that the actuator of an axis acts on.

    It is the drive side `<axis>_drive` of a transmission; without a transmission it is the
    load-side joint.
    """
    return f"{axis}_drive" if machine.axes[axis].transmission else load_joint_name(machine, axis)


def load_joint_name(machine: Machine, axis: str) -> str:
    """Return the name of the load-side joint: the rod slide of a cylinder axis, else the axis' joint."""
    facts = machine.axes[axis]
    return f"{axis}_rod" if facts.cylinder else facts.joint


def axes_with_transmission(machine: Machine) -> list[str]:
    """Return the names of the axes with a transmission, which is a spring and damper between drive and load."""
    return [name for name, axis in machine.axes.items() if axis.transmission]


def add_transmission_drive_side(root, machine: Machine, axis: str) -> None:
    """Add the drive side of an axis with a transmission to an MJCF that contains the load side.

    Args:
        root: the MJCF document.
        machine: the machine.
        axis: name of the axis.

    Raises:
        InputError: a link already has the name of the drive side.
    """
    facts = machine.axes[axis].transmission
    assert facts
    name, load = drive_joint_name(machine, axis), root.find("joint", load_joint_name(machine, axis))
    if root.find("body", name) is not None or root.find("joint", name) is not None:
        message = f"is the name of the drive side of axis {axis}; rename the link"
        raise InputError(f"links.{name}", message)
    beside = load.parent
    body = beside.parent.add("body", name=name, pos=beside.pos)
    for turn in ("quat", "euler", "axisangle", "xyaxes", "zaxis"):
        setattr(body, turn, getattr(beside, turn))
    mass, inertia = _MIN_INERTIAL
    body.add("inertial", mass=mass, pos=(0, 0, 0), diaginertia=inertia)
    body.add(
        "joint", name=name, type=load.type or "hinge", axis=load.axis, armature=facts.inertia,
        limited="false",
    )  # fmt: skip
    gap = facts.backlash / 2.0
    tendon = root.tendon.add(
        "fixed", name=name, stiffness=facts.stiffness, damping=facts.damping,
        springlength=(-gap, gap),
    )  # fmt: skip
    tendon.add("joint", joint=name, coef=1.0)
    tendon.add("joint", joint=load.name, coef=-1.0)


def set_drives_to_load_positions(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set the position of every drive side in `qpos` to that of its load, so that no transmission is deflected."""
    for axis in axes_with_transmission(machine):
        drive, load = drive_joint_name(machine, axis), load_joint_name(machine, axis)
        data.qpos[model.joint(drive).qposadr[0]] = data.qpos[model.joint(load).qposadr[0]]


def drive_and_load_dofs(machine: Machine, model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Return the indices in `qvel` of the drive sides of all transmissions, and of their load sides."""
    axes = axes_with_transmission(machine)
    drives = [int(model.joint(drive_joint_name(machine, a)).dofadr[0]) for a in axes]
    loads = [int(model.joint(load_joint_name(machine, a)).dofadr[0]) for a in axes]
    return drives, loads


def preload_transmissions(
    machine: Machine, model: mujoco.MjModel, data: mujoco.MjData, force: dict[str, float]
) -> None:
    """Set the drive sides in `qpos` so that the springs of all transmissions carry static forces.

    Args:
        machine: the machine.
        model: its model.
        data: `qpos` of the drive sides is written.
        force: axis -> force of its drive [N] or [N m]; with zero force the drive stays in the
            middle of the backlash.
    """
    for axis in axes_with_transmission(machine):
        facts = machine.axes[axis].transmission
        assert facts
        deflection = force[axis] / facts.stiffness
        if abs(deflection) > _MIN_DEFLECTION:
            deflection += np.sign(deflection) * facts.backlash / 2.0
        drive = model.joint(drive_joint_name(machine, axis)).qposadr[0]
        load = model.joint(load_joint_name(machine, axis)).qposadr[0]
        data.qpos[drive] = data.qpos[load] + deflection

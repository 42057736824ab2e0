"""Types and helpers for defining effects: physical effects that the model of a machine may omit.

`Effect` and `Parameter` describe an effect, its locations and its parameters. Helper functions list
the axes of a machine at which an effect may occur. Others compute reference values, such as the
largest force, from which the bounds of parameters follow. `with_terms` and `term_parameter` write and
read terms: additional force, flow or command laws that an effect adds to the equations of a drive.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Balance, Term

ModelPart = Literal["force", "flow", "valve", "supply", "geometry", "timing", "sensor"]
Values = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter of an effect at one location of one machine.

    Attributes:
        unit: SI unit.
        nominal: value in the given machine, without the effect.
        lower_bound: smallest physically plausible value.
        upper_bound: largest physically plausible value.
        prior_std: typical deviation from nominal, used as the standard deviation of the prior.
        min_relevant_change: smallest deviation from nominal that is reported as an effect.
        start_values: start values of a search, for effects that vanish at the nominal value or whose
            gradient there is not informative; empty if nominal is a good start value.
        optional: whether the parameter may be omitted when the effect is added to a machine.
            A search that screens many effects omits it, too. An omitted parameter has its nominal value.

    Examples:
        Bounds and prior of the friction of a cylinder. A change below `min_relevant_change` is not reported.

        >>> import hydrotele as ht
        >>> friction = ht.EFFECTS["coulomb_friction"].parameters(ht.load_machine("rig"), "slide")["coulomb"]
        >>> friction.unit, friction.nominal, friction.lower_bound
        ('N', 150.0, 0.0)
        >>> round(friction.upper_bound), round(friction.prior_std), round(friction.min_relevant_change, 1)  # N
        (1557, 352, 17.6)
    """

    unit: str
    nominal: float
    lower_bound: float
    upper_bound: float
    prior_std: float
    min_relevant_change: float
    start_values: tuple[float, ...] = ()
    optional: bool = False


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical effect that a machine may have and its model may omit.

    Attributes:
        name: fixed name, used in reports and files.
        description: short description of the effect.
        model_part: the part of the model that it changes.
        locations: function machine -> names of the possible locations.
        parameters: function (machine, location) -> parameter name -> Parameter.
        apply: function (machine, location, parameter name -> value) -> machine with the effect.
            With nominal values the returned machine behaves like the given one.
        mechanism: common name of effects that describe one physical cause in different forms, such as the
            delay and the lag of one sensor; empty if there is no other form.

    Examples:
        A custom effect, the mass of a link that differs from the model:

        >>> import hydrotele as ht
        >>> from hydrotele.effects import Effect, Parameter, with_value
        >>> def list_links(machine):
        ...     return tuple(machine.links)
        >>> def describe_mass(machine, link):
        ...     mass = machine.links[link].mass
        ...     return {"mass": Parameter("kg", mass, 0.5 * mass, 2.0 * mass, 0.1 * mass, 0.01 * mass)}
        >>> def set_mass(machine, link, values):
        ...     return with_value(machine, f"links.{link}.mass", values["mass"])
        >>> effect = Effect("link_mass", "mass of a link", "force", list_links, describe_mass, set_mass)
        >>> machine = ht.load_machine("rig")
        >>> effect.locations(machine), effect.parameters(machine, "carriage")["mass"].upper_bound
        (('carriage',), 400.0)
        >>> effect.apply(machine, "carriage", {"mass": 230.0}).links["carriage"].mass
        230.0
    """

    name: str
    description: str
    model_part: ModelPart
    locations: Callable[[Machine], tuple[str, ...]]
    parameters: Callable[[Machine, str], dict[str, Parameter]]
    apply: Callable[[Machine, str, Values], Machine]
    mechanism: str = ""


def with_value(machine: Machine, path: str, value: Any) -> Machine:
    """Return a copy of a machine with the value at a dotted path replaced, without checking the value.

    A path is for example `axes.boom.valve.deadband`. The value is not checked, because an effect may
    replace several values one after another, and the machines in between need not be valid.

    Raises:
        InputError: the path does not exist; the message lists the valid paths.
    """
    return machine.replace(path, value, validate=False)


_MAX_LATERAL_OFFSET_RATIO = 1.0e-3  # offset over length up to which a cylinder counts as parallel to its slide
_FULL_TRAVEL_TIME_S = 2.0  # s for the full range of a force drive, which has no flow rating; an estimate


def all_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of all driven axes of a machine."""
    return tuple(machine.axes)


def valve_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drive is controlled by a valve."""
    return tuple(machine.valve_axes)


def hydraulic_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drive has pressure chambers, fed through a valve or by the axis' own pump."""
    return tuple(machine.hydraulic_axes)


def cylinder_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes that a hydraulic cylinder drives."""
    return tuple(name for name, axis in machine.axes.items() if axis.cylinder)


def nonparallel_cylinder_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the cylinder axes whose length depends on the positions of the pins.

    These are all cylinder axes except those whose cylinder is parallel to the sliding joint that it
    drives. The length of such a cylinder is the joint position plus a constant, and lateral pin
    offsets have no effect.
    """
    return tuple(name for name in cylinder_axes(machine) if not _is_parallel_to_slide(machine, name))


def lateral_directions(machine: Machine, axis: str) -> str:
    """Return the two coordinates other than the one closest to the joint axis of a hinge, such as "xz" for y.

    Offsets of a cylinder's pin in these directions change the relation between cylinder length and
    joint position. For a sliding joint, which is taken to move in the plane of x and z, the result
    is "xz".
    """
    joint = machine.joints[machine.axes[axis].joint]
    way = joint.axis if joint.type == "hinge" else (0.0, 1.0, 0.0)
    return "xyz".replace("xyz"[int(np.argmax(np.abs(way)))], "")


def _is_parallel_to_slide(machine: Machine, axis: str) -> bool:
    facts = machine.axes[axis]
    joint, cylinder = machine.joints[facts.joint], facts.cylinder
    name = machine.link_of(facts.joint)
    link = machine.links[name]
    if joint.type != "slide" or not cylinder:
        return False
    if (cylinder.base_pin.link, cylinder.rod_pin.link) != (link.parent, name):
        return False
    rod_pin = np.array(link.position) + cylinder.rod_pin.position
    line = rod_pin - np.array(cylinder.base_pin.position)
    across = np.linalg.norm(np.cross(line, joint.axis)) / np.linalg.norm(joint.axis)
    return bool(across < _MAX_LATERAL_OFFSET_RATIO * np.linalg.norm(line))


def hinge_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes with a revolute joint."""
    return tuple(name for name in machine.axes if machine.position_kind(name) == "angle")


def drive_kind(machine: Machine, axis: str) -> str:
    """Return the name of the field of `machine.axes[axis]` that holds its drive: `cylinder`, `motor` or `force`."""
    facts = machine.axes[axis]
    return "cylinder" if facts.cylinder else "motor" if facts.motor else "force"


def is_rotary_drive(machine: Machine, axis: str) -> bool:
    """Return whether the drive of an axis is rotary, so that its force is a torque [N m]."""
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


def force_unit(machine: Machine, axis: str) -> str:
    """Return the unit of the drive's force: "N m" for a rotary drive, otherwise "N"."""
    return "N m" if is_rotary_drive(machine, axis) else "N"


def speed_unit(machine: Machine, axis: str) -> str:
    """Return the unit of the drive's velocity: "rad/s" for a rotary drive, otherwise "m/s"."""
    return "rad/s" if is_rotary_drive(machine, axis) else "m/s"


def max_drive_force(machine: Machine, axis: str) -> float:
    """Return the largest force or torque of a drive [N] or [N m].

    For a cylinder it is the highest feed pressure times the head area, and for a hydraulic motor that
    pressure times the displacement per radian. For a force drive it is the force at full command.
    """
    facts = machine.axes[axis]
    if facts.force:
        return abs(facts.force.gain) * facts.force.command_limit
    return machine.max_feed_pressure(axis) * facts.hydraulic_drive.effective_areas[0]


def typical_speed(machine: Machine, axis: str) -> float:
    """Return the speed of a drive at the rated flow of its valve or pump [m/s] or [rad/s].

    A force drive has no flow rating; it is assumed to travel the range of its joint in two seconds.
    A joint without a range counts as 1 rad or 1 m.
    """
    facts = machine.axes[axis]
    if facts.is_hydraulic:
        return facts.rated_flow / facts.hydraulic_drive.effective_areas[0]
    low, high = machine.joints[facts.joint].range or (-0.5, 0.5)
    return (high - low) / _FULL_TRAVEL_TIME_S


def outboard_links(machine: Machine, link: str) -> list[str]:
    """Return the names of a link and of all links that it carries, directly or indirectly."""
    found = [link]
    for name in found:  # the list grows during the loop
        found += [n for n, other in machine.links.items() if other.parent == name]
    return found


def outboard_child(machine: Machine, link: str) -> str | None:
    """Return the name of the next link outwards; None for the link with the arm's tip, or without children.

    It is the child link that carries the arm's tip, directly or through other links. If none does,
    it is the child whose frame origin is farthest from that of the given link.
    """
    if machine.arm and machine.arm.tip.link != "world":
        step = machine.arm.tip.link
        while step != "world":
            parent = machine.links[step].parent
            if parent == link:
                return step
            step = parent
        if machine.arm.tip.link == link:
            return None
    children = [n for n, other in machine.links.items() if other.parent == link]
    return max(children, key=lambda n: float(np.linalg.norm(machine.links[n].position)), default=None)


def next_joint_or_tip_position(machine: Machine, link: str) -> np.ndarray | None:
    """Return the origin of the next link outwards (see `outboard_child`), in the frame of the given link (3,) [m].

    For the link with the arm's tip it is the position of the tip. None if no link follows.
    """
    if machine.arm and machine.arm.tip.link == link:
        return np.array(machine.arm.tip.position)
    child = outboard_child(machine, link)
    return None if child is None else np.array(machine.links[child].position)


def link_size(machine: Machine, link: str) -> float:
    """Return the size of a link [m], at least 1 mm.

    It is the larger of two distances from the origin of the link's frame: to the next link's origin
    (or the arm's tip), and to the centre of mass.
    """
    point = next_joint_or_tip_position(machine, link)
    far = 0.0 if point is None else float(np.linalg.norm(point))
    return max(far, float(np.linalg.norm(machine.links[link].com)), 1.0e-3)


def term_parameter(machine: Machine, name: str, axis: str, balance: Balance, parameter: str, default: float) -> float:
    """Return a parameter of the term that an effect added to the equations of a drive.

    Args:
        machine: the machine.
        name: name of the effect.
        axis: axis of the drive.
        balance: equation that contains the term, such as "force", "flow_rod" or "command".
        parameter: name of the parameter of the term's law.
        default: value to return if there is no such term.

    Returns:
        The value of the parameter.
    """
    for term in machine.terms:
        if (term.name, term.axis, term.balance) == (name, axis, balance):
            value = term.parameters[parameter]
            assert isinstance(value, float)
            return value
    return default


def with_terms(machine: Machine, name: str, terms: Iterable[Term], axes: Iterable[str] | None = None) -> Machine:
    """Return a copy of a machine in which the terms of an effect are replaced.

    Args:
        machine: the machine.
        name: name of the effect.
        terms: the new terms; empty to remove the effect.
        axes: axes whose terms are replaced; None for all axes.

    Returns:
        The changed machine.

    Examples:
        A force against the motion of the rig's slide that grows with the square of the speed:

        >>> import hydrotele as ht
        >>> from hydrotele.effects import Term
        >>> machine = ht.load_machine("rig")
        >>> drag = Term(
        ...     name="drag", axis="slide", balance="force", law="quadratic_drag", parameters={"coefficient": 2.0e4}
        ... )
        >>> slower = with_terms(machine, "drag", [drag])
        >>> [term.name for term in machine.terms], [term.name for term in slower.terms]
        ([], ['drag'])
        >>> term_parameter(slower, "drag", "slide", "force", "coefficient", 0.0)
        20000.0
    """
    where = set(machine.axes if axes is None else axes)
    kept = [term for term in machine.terms if term.name != name or term.axis not in where]
    return machine.model_copy(update={"terms": (*kept, *terms)})

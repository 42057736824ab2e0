"""What an effect is: a name, a sentence, places, parameters, and the change of the Machine.

Sizes of a machine that make the sizes of an effect relative to it.

Terms that an effect puts into a machine, found again by the effect's name.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.terms.law import Balance, Term

Law = Literal["force", "flow", "valve", "supply", "geometry", "timing", "sensor"]
Values = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number of an effect at one place of one machine.

    Attributes:
        unit: SI unit.
        nominal: its value in the machine as it is, without the effect.
        low: smallest physically plausible value.
        high: largest physically plausible value.
        scale: typical size of a deviation from nominal, the width of its prior.
        least: deviation below which the effect is not worth naming.
        starts: values from which a search starts where the effect vanishes at nominal, or where
            its slope there tells little; empty where nominal is a good start.
        optional: whether it may be left out where the effect is planted, and is so where it is
            looked for among others: it then keeps its nominal value.
    """

    unit: str
    nominal: float
    low: float
    high: float
    scale: float
    least: float
    starts: tuple[float, ...] = ()
    optional: bool = False


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical effect that a machine can have and its model can lack.

    Attributes:
        name: fixed name, as in reports and files.
        sentence: what it is, one sentence.
        law: the law of the model that it changes.
        locations: machine -> names of the places where it can sit.
        parameters: (machine, location) -> parameter name -> Parameter.
        apply: (machine, location, parameter name -> value) -> machine that has it. With all values
            nominal it returns a machine that behaves as the given one.
        mechanism: what other effects have in common with it that are the same thing in another
            form, such as a delay and a lag of one sensor; empty for what stands alone.
    """

    name: str
    sentence: str
    law: Law
    locations: Callable[[Machine], tuple[str, ...]]
    parameters: Callable[[Machine, str], dict[str, Parameter]]
    apply: Callable[[Machine, str, Values], Machine]
    mechanism: str = ""


def changed(machine: Machine, path: str, value: Any) -> Machine:
    """Copy of a machine with one number replaced, at a dotted path such as `supply.pump_flow`."""
    return _replace(machine, path.split("."), value)


def _replace(node: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    if isinstance(node, dict):
        return {**node, path[0]: _replace(node[path[0]], path[1:], value)}
    return node.model_copy(update={path[0]: _replace(getattr(node, path[0]), path[1:], value)})


_IN_LINE = 1.0e-3  # of its length, by which a cylinder may lie off the slide that it pushes
_FULL_TRAVEL = 2.0  # s that a force-driven slide takes through its range: no flow rating says it


def axes(machine: Machine) -> tuple[str, ...]:
    """Names of all axes."""
    return tuple(machine.axes)


def valves(machine: Machine) -> tuple[str, ...]:
    """Names of the axes with a valve."""
    return tuple(machine.valve_axes)


def hydraulics(machine: Machine) -> tuple[str, ...]:
    """Names of the axes with chambers: behind a valve, or behind a pump of their own."""
    return tuple(machine.hydraulic_axes)


def cylinders(machine: Machine) -> tuple[str, ...]:
    """Names of the axes with a cylinder."""
    return tuple(name for name, axis in machine.axes.items() if axis.cylinder)


def linkages(machine: Machine) -> tuple[str, ...]:
    """Names of the axes whose cylinder does not lie along the slide that it pushes.

    Along a slide a length is a position, and where the pins sit across it changes nothing.
    """
    return tuple(name for name in cylinders(machine) if not _along_slide(machine, name))


def across(machine: Machine, axis: str) -> str:
    """The two directions across an axis' joint, in which pins may sit elsewhere: such as `xz`."""
    joint = machine.joints[machine.axes[axis].joint]
    way = joint.axis if joint.type == "hinge" else (0.0, 1.0, 0.0)
    return "xyz".replace("xyz"[int(np.argmax(np.abs(way)))], "")


def _along_slide(machine: Machine, axis: str) -> bool:
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
    return bool(across < _IN_LINE * np.linalg.norm(line))


def hinges(machine: Machine) -> tuple[str, ...]:
    """Names of the axes whose joint turns."""
    return tuple(name for name in machine.axes if machine.position_kind(name) == "angle")


def drive_kind(machine: Machine, axis: str) -> str:
    """Which field of the axis holds its drive: `cylinder`, `motor` or `force`."""
    facts = machine.axes[axis]
    return "cylinder" if facts.cylinder else "motor" if facts.motor else "force"


def drive_turns(machine: Machine, axis: str) -> bool:
    """Whether the drive itself turns, so that its forces are torques."""
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


def force_unit(machine: Machine, axis: str) -> str:
    """Unit of the drive's force."""
    return "N m" if drive_turns(machine, axis) else "N"


def speed_unit(machine: Machine, axis: str) -> str:
    """Unit of the drive's velocity."""
    return "rad/s" if drive_turns(machine, axis) else "m/s"


def largest_force(machine: Machine, axis: str) -> float:
    """Force of a drive at the highest pressure, or at full command [N] or [N m]."""
    facts = machine.axes[axis]
    if facts.force:
        return abs(facts.force.gain) * facts.force.command_limit
    return machine.highest_pressure(axis) * facts.hydraulic_drive.areas[0]


def usual_speed(machine: Machine, axis: str) -> float:
    """Speed of a drive at the rated flow of its valve or pump [m/s] or [rad/s].

    A force drive has no such rating: it is taken to pass its range in two seconds.
    """
    facts = machine.axes[axis]
    if facts.hydraulic:
        return facts.rated_flow / facts.hydraulic_drive.areas[0]
    low, high = machine.joints[facts.joint].range or (-0.5, 0.5)
    return (high - low) / _FULL_TRAVEL


def outboard_links(machine: Machine, link: str) -> list[str]:
    """A link and everything that it carries."""
    found = [link]
    for name in found:  # grows on the way
        found += [n for n, other in machine.links.items() if other.parent == name]
    return found


def outboard_child(machine: Machine, link: str) -> str | None:
    """The link that continues the arm: the one towards its tip, else the farthest child."""
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
    return max(
        children, key=lambda n: float(np.linalg.norm(machine.links[n].position)), default=None
    )


def outboard_point(machine: Machine, link: str) -> np.ndarray | None:
    """Where the arm goes on, in the link's frame, (3,) [m]; the arm's tip for its last link."""
    if machine.arm and machine.arm.tip.link == link:
        return np.array(machine.arm.tip.position)
    child = outboard_child(machine, link)
    return None if child is None else np.array(machine.links[child].position)


def link_size(machine: Machine, link: str) -> float:
    """Distance from a link's joint to where the arm goes on, or to its mass [m]."""
    point = outboard_point(machine, link)
    far = 0.0 if point is None else float(np.linalg.norm(point))
    return max(far, float(np.linalg.norm(machine.links[link].com)), 1.0e-3)


def term_number(
    machine: Machine, name: str, axis: str, balance: Balance, parameter: str, absent: float
) -> float:
    """A parameter of the term that an effect put onto a drive.

    Args:
        machine: the machine.
        name: of the effect.
        axis: of the drive.
        balance: of the term.
        parameter: of its law.
        absent: what to return where there is no such term.

    Returns:
        Its value.
    """
    for term in machine.terms:
        if (term.name, term.axis, term.balance) == (name, axis, balance):
            value = term.parameters[parameter]
            assert isinstance(value, float)
            return value
    return absent


def with_terms(
    machine: Machine, name: str, terms: Iterable[Term], axes: Iterable[str] | None = None
) -> Machine:
    """A machine whose terms of a name are these, in place of those of that name.

    Args:
        machine: the machine.
        name: of the effect.
        terms: the new ones, none to take the effect out.
        axes: of which terms are replaced; None for all.

    Returns:
        The changed machine.
    """
    where = set(machine.axes if axes is None else axes)
    kept = [term for term in machine.terms if term.name != name or term.axis not in where]
    return machine.model_copy(update={"terms": (*kept, *terms)})

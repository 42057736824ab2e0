"""Effects of mass: centre of mass and moments of inertia of a link, and a payload at the tip."""

import numpy as np

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    hinge_axes,
    link_size,
    outboard_links,
    with_value,
)
from hydrotele.machine.machine import Link, Machine

_COORDINATES = "xyz"


def _is_vertical_base_axis(machine: Machine, axis: str) -> bool:
    """Return whether an axis moves a link attached to the world, about a line parallel to gravity (within 18 degrees).

    Weight then causes no torque about the axis.
    """
    link = machine.links[machine.link_of(machine.axes[axis].joint)]
    assert link.joint
    gravity = np.array(machine.gravity)
    along = abs(np.dot(link.joint.axis, gravity))
    return link.parent == "world" and along > 0.95 * float(np.linalg.norm(gravity))


def _com_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values (0), bounds and priors of the offsets of a link's centre of mass.

    There is one offset per coordinate of the link's frame, in metres, except along the joint axis,
    which does not change the motion of the joint. Bounds and priors are fractions of the size of
    the link. The smallest relevant offset is 0.5 % of it, about 25 mm of a boom, which changes the
    pressure in its cylinder by 40 kPa. For a vertical base axis, where weight causes no torque, it
    is 3 %.
    """
    size = link_size(machine, machine.link_of(machine.axes[location].joint))
    least = (0.03 if _is_vertical_base_axis(machine, location) else 0.005) * size
    number = Parameter("m", 0.0, -0.3 * size, 0.3 * size, max(0.05 * size, 2 * least), least)
    axis = np.abs(machine.joints[machine.axes[location].joint].axis)
    return {name: number for k, name in enumerate(_COORDINATES) if k != int(np.argmax(axis))}


def _move_com(machine: Machine, location: str, values: Values) -> Machine:
    link = machine.link_of(machine.axes[location].joint)
    offsets = [values.get(letter, 0.0) for letter in _COORDINATES]
    com = tuple(c + d for c, d in zip(machine.links[link].com, offsets, strict=True))
    return with_value(machine, f"links.{link}.com", com)


def _inertia_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (1), bounds and prior of the ratio of true to given moments of inertia.

    A model from drawings is accurate to about 20 %. The smallest relevant change is 5 %, a typical
    rounding. The wide bounds allow for attachments, ballast, or a wrong unit in the drawings.
    """
    return {"ratio": Parameter("1", 1.0, 0.05, 20.0, 0.2, 0.05, start_values=(1.0, 6.0))}


def _scale_inertia(machine: Machine, location: str, values: Values) -> Machine:
    link = machine.link_of(machine.axes[location].joint)
    inertia = tuple(moment * values["ratio"] for moment in machine.links[link].inertia)
    return with_value(machine, f"links.{link}.inertia", inertia)


LINK_MASS_EFFECTS = (
    Effect(
        "com_offset", "centre of mass of a link that differs from the model", "force", hinge_axes, _com_parameters,
        _move_com,
    ),
    Effect(
        "inertia_error",
        "moments of inertia of a link about its centre of mass that differ from the model",
        "force", hinge_axes, _inertia_parameters, _scale_inertia,
    ),
)  # fmt: skip


PAYLOAD = "payload"
"""Name of the link that carries the load."""

_MIN_PAYLOAD_KG = 1.0e-3  # kg: a smaller payload is omitted, since MuJoCo accepts no body without mass
_GYRATION_RADIUS_M = 1.0e-3  # m, radius of gyration of a point mass, since MuJoCo needs some inertia


def _payload_locations(machine: Machine) -> tuple[str, ...]:
    return ("tool",) if machine.arm else ()


def _payload_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (0), bounds and prior of the mass of a payload at the arm's tip.

    The mass cannot be negative: the effect does not correct a tool that is too heavy in the machine file.
    Bounds and prior are fractions of the mass that the boom joint moves. The smallest relevant payload
    is 0.6 % of it, such as 15 kg for 2.5 t; seal friction hides smaller ones.
    """
    assert machine.arm
    arm = outboard_links(machine, machine.link_of(machine.arm.boom))
    moved = sum(machine.links[name].mass for name in arm if name != PAYLOAD)
    return {"mass": Parameter("kg", 0.0, 0.0, 1.2 * moved, 0.1 * moved, 0.006 * moved)}


def _set_payload(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a point mass of `mass` [kg] welded to the arm's tip, added to an existing payload.

    A mass below 1 g changes nothing.
    """
    assert machine.arm
    tip, mass = machine.arm.tip, values["mass"]
    if mass < _MIN_PAYLOAD_KG:
        return machine
    if PAYLOAD in machine.links:
        mass += machine.links[PAYLOAD].mass
    size = mass * _GYRATION_RADIUS_M**2
    load = Link(parent=tip.link, position=tip.position, mass=mass, inertia=(size, size, size))
    return machine.model_copy(update={"links": {**machine.links, PAYLOAD: load}})


TIP_PAYLOAD = Effect(
    "payload",
    "a point mass at the arm's tip",
    "force",
    _payload_locations,
    _payload_parameters,
    _set_payload,
)

EFFECTS = (*LINK_MASS_EFFECTS, TIP_PAYLOAD)

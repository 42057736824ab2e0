"""A link that is longer or shorter than in the model.

A cylinder whose base pin sits elsewhere than in the model.

A machine that does not stand level.
"""

import math

import numpy as np

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    across,
    changed,
    hinges,
    linkages,
    outboard_child,
    outboard_point,
)
from hydrotele.machine.machine import Machine


def _locations(machine: Machine) -> tuple[str, ...]:
    """Turning links that go on across their axis: a boom and a stick, not a slewing house."""
    places = []
    for axis in hinges(machine):
        joint = machine.axes[axis].joint
        point = outboard_point(machine, machine.link_of(joint))
        if point is None or not point.any():
            continue
        along = abs(np.dot(machine.joints[joint].axis, point)) / np.linalg.norm(point)
        if along < 0.5:
            places.append(axis)
    return tuple(places)


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """A thousandth, 5 mm of a boom, is what welded structures are built to."""
    point = outboard_point(machine, machine.link_of(machine.axes[location].joint))
    assert point is not None
    size = float(np.linalg.norm(point))
    return {"length": Parameter("m", 0.0, -0.1 * size, 0.1 * size, 0.01 * size, 0.001 * size)}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Move what sits at the outboard joint by `length` along the line from the link's own joint.

    That is the next link (on the last link the arm's tip and what is welded there), the base pin of
    the cylinder that moves the next link where it sits on this one, and a four-bar's rocker on this
    link. Every other pin keeps its distance from the link's own joint. The link's centre of mass
    stretches along the same line in proportion; mass and moments of inertia stay.
    """
    length = values["length"]
    name = machine.link_of(machine.axes[location].joint)
    point = outboard_point(machine, name)
    if point is None or length == 0.0:
        return machine
    size = float(np.linalg.norm(point))
    way = point / size
    com = np.array(machine.links[name].com)
    stretched = com + way * np.dot(com, way) * length / size
    machine = changed(machine, f"links.{name}.com", _vector(stretched))
    if machine.arm and machine.arm.tip.link == name:
        return _with_tip(machine, name, way * length)
    child = outboard_child(machine, name)
    assert child
    moved = {f"links.{child}.position": machine.links[child].position}
    joint = machine.links[child].joint
    for other, axis in machine.axes.items():
        if joint is None or axis.joint != joint.name or not axis.cylinder:
            continue
        if axis.cylinder.base_pin.link == name:
            path = f"axes.{other}.cylinder.base_pin.position"
            moved[path] = axis.cylinder.base_pin.position
        if axis.four_bar and machine.links[axis.four_bar.rocker].parent == name:
            rocker = axis.four_bar.rocker
            moved[f"links.{rocker}.position"] = machine.links[rocker].position
    for path, position in moved.items():
        machine = _moved(machine, path, position, way * length)
    return machine


def _with_tip(machine: Machine, name: str, shift: np.ndarray) -> Machine:
    """Move the arm's tip on the last link, and a payload that is welded there."""
    assert machine.arm
    tip = machine.arm.tip.position
    for other, link in machine.links.items():
        if link.parent == name and link.joint is None and link.position == tip:
            machine = _moved(machine, f"links.{other}.position", tip, shift)
    return _moved(machine, "arm.tip.position", tip, shift)


def _moved(machine: Machine, path: str, position, shift: np.ndarray) -> Machine:
    return changed(machine, path, _vector(np.array(position) + shift))


def _vector(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


LINK_LENGTH = Effect(
    "link_length", "a link is longer or shorter", "geometry", _locations, _parameters, _apply
)


def _parameters_pin_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """A thousandth of the closed length, 1.5 mm, is the play of a worn pin."""
    cylinder = machine.axes[location].cylinder
    assert cylinder
    size = cylinder.closed_length
    offset = Parameter("m", 0.0, -0.05 * size, 0.05 * size, 0.005 * size, 0.001 * size)
    return dict.fromkeys(across(machine, location), offset)


def _apply_pin_offset(machine: Machine, location: str, values: Values) -> Machine:
    """The base pin moves in its link's frame; the closed length, hence x at a length, stays."""
    cylinder = machine.axes[location].cylinder
    assert cylinder
    way = zip("xyz", cylinder.base_pin.position, strict=True)
    position = tuple(place + values.get(name, 0.0) for name, place in way)
    return changed(machine, f"axes.{location}.cylinder.base_pin.position", position)


PIN_OFFSET = Effect(
    "pin_offset", "the base pin of a cylinder sits elsewhere", "geometry", linkages,
    _parameters_pin_offset,
    _apply_pin_offset,
)  # fmt: skip


def _place(machine: Machine) -> tuple[str, ...]:
    return ("base",) if any(machine.gravity) else ()


def _parameters_base_tilt(machine: Machine, location: str) -> dict[str, Parameter]:
    """Ground is level to a few degrees; 3 mrad is what a builder's level shows."""
    tilt = Parameter("rad", 0.0, -0.2, 0.2, 0.03, 0.003)
    return {"roll": tilt, "pitch": tilt}


def _apply_base_tilt(machine: Machine, location: str, values: Values) -> Machine:
    """Gravity in the frame of a base turned by pitch about y and then by roll about its own x.

    Positive pitch lowers the front (x), positive roll lowers the right-hand side (-y).
    """
    roll, pitch = values["roll"], values["pitch"]
    c, s = math.cos(roll), math.sin(roll)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    if roll == 0.0 and pitch == 0.0:
        return machine
    gravity = (about_y @ about_x).T @ np.array(machine.gravity)
    return changed(machine, "gravity", tuple(float(g) for g in gravity))


BASE_TILT = Effect(
    "base_tilt",
    "the base does not stand level",
    "force",
    _place,
    _parameters_base_tilt,
    _apply_base_tilt,
)

EFFECTS = (LINK_LENGTH, PIN_OFFSET, BASE_TILT)

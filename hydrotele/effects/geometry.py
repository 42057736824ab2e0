"""Effects of geometry: link length, position of a cylinder's base pin, and tilt of the base."""

import math

import numpy as np

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    hinge_axes,
    lateral_directions,
    next_joint_or_tip_position,
    nonparallel_cylinder_axes,
    outboard_child,
    with_value,
)
from hydrotele.machine.machine import Machine


def _link_length_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the revolute axes whose link extends sideways from the joint axis.

    The line from the link's joint to the next joint, or to the arm's tip, is more than 60 degrees
    from the joint axis. This applies to boom and stick, but not to swing.
    """
    places = []
    for axis in hinge_axes(machine):
        joint = machine.axes[axis].joint
        point = next_joint_or_tip_position(machine, machine.link_of(joint))
        if point is None or not point.any():
            continue
        along = abs(np.dot(machine.joints[joint].axis, point)) / np.linalg.norm(point)
        if along < 0.5:
            places.append(axis)
    return tuple(places)


def _link_length_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (0), bounds and prior of the change of a link's length.

    The smallest relevant change is a thousandth of the length, the accuracy of welded structures.
    """
    point = next_joint_or_tip_position(machine, machine.link_of(machine.axes[location].joint))
    assert point is not None
    size = float(np.linalg.norm(point))
    return {"length": Parameter("m", 0.0, -0.1 * size, 0.1 * size, 0.01 * size, 0.001 * size)}


def _set_link_length(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a link longer by `length` [m], along the line from its joint to the next.

    The moved parts are the next link, the base pin of the next link's cylinder if it is on this
    link, and a four-bar rocker on this link. For the last link they are the arm's tip and a payload
    welded there. All other pins keep their distance from the link's own joint. The link's centre of
    mass moves along the same line in proportion; mass and moments of inertia do not change.
    """
    length = values["length"]
    name = machine.link_of(machine.axes[location].joint)
    point = next_joint_or_tip_position(machine, name)
    if point is None or length == 0.0:
        return machine
    size = float(np.linalg.norm(point))
    way = point / size
    com = np.array(machine.links[name].com)
    stretched = com + way * np.dot(com, way) * length / size
    machine = with_value(machine, f"links.{name}.com", _to_float_tuple(stretched))
    if machine.arm and machine.arm.tip.link == name:
        return _move_tip(machine, name, way * length)
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
        machine = _move_position(machine, path, position, way * length)
    return machine


def _move_tip(machine: Machine, name: str, shift: np.ndarray) -> Machine:
    """Return the machine with the arm's tip, and links welded at the tip such as a payload, shifted.

    Args:
        machine: the machine.
        name: link with the tip.
        shift: (3,) displacement in the frame of that link [m].
    """
    assert machine.arm
    tip = machine.arm.tip.position
    for other, link in machine.links.items():
        if link.parent == name and link.joint is None and link.position == tip:
            machine = _move_position(machine, f"links.{other}.position", tip, shift)
    return _move_position(machine, "arm.tip.position", tip, shift)


def _move_position(machine: Machine, path: str, position, shift: np.ndarray) -> Machine:
    return with_value(machine, path, _to_float_tuple(np.array(position) + shift))


def _to_float_tuple(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


LINK_LENGTH = Effect(
    "link_length",
    "link length that differs from the model",
    "geometry",
    _link_length_axes,
    _link_length_parameters,
    _set_link_length,
)


def _pin_offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values (0), bounds and priors of the offsets of a cylinder's base pin.

    There is one offset for each coordinate perpendicular to the joint axis. The smallest relevant
    offset is a thousandth of the cylinder's closed length, the play of a worn pin.
    """
    cylinder = machine.axes[location].cylinder
    assert cylinder
    size = cylinder.closed_length
    offset = Parameter("m", 0.0, -0.05 * size, 0.05 * size, 0.005 * size, 0.001 * size)
    return dict.fromkeys(lateral_directions(machine, location), offset)


def _set_pin_offset(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a cylinder's base pin moved in the frame of its link.

    The closed length of the cylinder does not change.
    """
    cylinder = machine.axes[location].cylinder
    assert cylinder
    way = zip("xyz", cylinder.base_pin.position, strict=True)
    position = tuple(place + values.get(name, 0.0) for name, place in way)
    return with_value(machine, f"axes.{location}.cylinder.base_pin.position", position)


PIN_OFFSET = Effect(
    "pin_offset", "position of a cylinder's base pin that differs from the model", "geometry",
    nonparallel_cylinder_axes,
    _pin_offset_parameters,
    _set_pin_offset,
)  # fmt: skip


def _base_tilt_locations(machine: Machine) -> tuple[str, ...]:
    return ("base",) if any(machine.gravity) else ()


def _base_tilt_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values (0), bounds and priors of the tilt angles `roll` and `pitch` of the machine's base.

    Ground is level to a few degrees. The smallest relevant angle is 3 mrad, which a spirit level
    resolves.
    """
    tilt = Parameter("rad", 0.0, -0.2, 0.2, 0.03, 0.003)
    return {"roll": tilt, "pitch": tilt}


def _set_base_tilt(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with gravity rotated into the frame of a tilted base.

    The base is rotated by `pitch` about y, then by `roll` about its own x axis. Positive pitch lowers
    the front (x), positive roll lowers the right-hand side (-y).
    """
    roll, pitch = values["roll"], values["pitch"]
    c, s = math.cos(roll), math.sin(roll)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    if roll == 0.0 and pitch == 0.0:
        return machine
    gravity = (about_y @ about_x).T @ np.array(machine.gravity)
    return with_value(machine, "gravity", tuple(float(g) for g in gravity))


BASE_TILT = Effect(
    "base_tilt",
    "tilt of the base",
    "force",
    _base_tilt_locations,
    _base_tilt_parameters,
    _set_base_tilt,
)

EFFECTS = (LINK_LENGTH, PIN_OFFSET, BASE_TILT)

"""Mechanism of a machine as arrays for `reduced_dynamics`.

The links form a tree, cylinders are bars between two pins, and closures close the loops.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.kinematics.drive_linkage import pin_axis
from hydrotele.machine.machine import Machine, find_dependent_joints

WELD, HINGE, SLIDE, TUBE, ROD, PIN = range(6)
_JOINT_KINDS = {"hinge": HINGE, "slide": SLIDE}

PARENT, KIND, COORDINATE, COORDINATE_END = range(4)  # columns of `tree`
POSITION, AXIS, COM, INERTIA, MASS, CLOSED_LENGTH, SHAPE_SIZE = (
    0,
    3,
    6,
    9,
    12,
    13,
    14,
)  # columns of `shape`
DAMPING, HOME = range(2)  # rows of `joint`
BAR, JOINT = range(2)  # columns of `drive`


class ReducedMechanism(NamedTuple):
    """Mechanism of a machine as arrays for compiled code.

    Frame 0 is the world. Frames 1 .. l are the links, followed by tube and rod of every bar, and by
    both pins of every closure.

    Attributes:
        tree: (f, 4) columns PARENT (for a tube the link at its base pin, for a rod the link at its
            rod pin), KIND, COORDINATE (tree coordinate of the joint, -1 without joint) and
            COORDINATE_END (only tree coordinates with a smaller index move the frame).
        shape: (f, SHAPE_SIZE) columns POSITION in the parent frame [m] (for tube and rod, of their
            pins), AXIS of the joint (for tube and rod, of their pins, in the axes of the parent of
            the tube), COM [m] and INERTIA about it [kg m^2] in the frame's axes, MASS [kg], and
            CLOSED_LENGTH, for a tube the pin-to-pin length at piston displacement 0 [m].
        link_count: l, number of links.
        bar_count: number of bars.
        joint: (2, N) rows DAMPING [N m s/rad] or [N s/m] and HOME [rad] or [m] of the tree
            coordinates.
        independent: (n,) indices of the independent tree coordinates.
        dependent: (N - n,) indices of the dependent tree coordinates, which the closures determine.
        gravity: (3,) [m/s^2].
        drive: (nu, 2) columns BAR, -1 if the drive acts directly on its joint, and JOINT, the tree
            coordinate.
    """

    tree: np.ndarray
    shape: np.ndarray
    link_count: int
    bar_count: int
    joint: np.ndarray
    independent: np.ndarray
    dependent: np.ndarray
    gravity: np.ndarray
    drive: np.ndarray

    @property
    def body_count(self) -> int:
        """Number of bodies: world, links, tubes and rods, whose frames come first."""
        return 1 + self.link_count + 2 * self.bar_count


def body_names(machine: Machine) -> list[str]:
    """Return the names of the bodies of a reduced mechanism: world, links, `<axis>_tube`, `<axis>_rod`.

    The order is that of the frames.
    """
    bars = [n for n in actuator_order(machine) if machine.axes[n].cylinder]
    return ["world", *_sort_links(machine), *(f"{n}_{p}" for n in bars for p in ("tube", "rod"))]


def coordinate_names(machine: Machine) -> list[str]:
    """Return the names of a machine's joints in the order of the coordinates of its reduced mechanism."""
    links = (machine.links[name] for name in _sort_links(machine))
    return [link.joint.name for link in links if link.joint]


def make_reduced_mechanism(machine: Machine) -> ReducedMechanism:
    """Convert the mechanism of a machine to arrays for compiled code.

    Args:
        machine: the machine. The pins of a cylinder are parallel to the joint that it moves, as in
            the MuJoCo plant.

    Returns:
        The mechanism.
    """
    order, joints = _sort_links(machine), coordinate_names(machine)
    index = {"world": 0, **{name: 1 + i for i, name in enumerate(order)}}
    tree, shape = [(-1, WELD, -1)], [_shape_row()]
    for name in order:
        link = machine.links[name]
        kind = _JOINT_KINDS[link.joint.type] if link.joint else WELD
        coordinate = joints.index(link.joint.name) if link.joint else -1
        tree.append((index[link.parent], kind, coordinate))
        axis = link.joint.axis if link.joint else (0.0, 0.0, 1.0)
        shape.append(_shape_row(link.position, axis, link.com, link.inertia, link.mass))
    drives = actuator_order(machine)
    bars = [name for name in drives if machine.axes[name].cylinder]
    for name in bars:
        c, pins = machine.axes[name].cylinder, pin_axis(machine, name)
        assert c
        ends = (TUBE, c.base_pin, c.tube, c.tube.com), (ROD, c.rod_pin, c.rod, -c.rod.com)
        for kind, pin, bar, com in ends:
            tree.append((index[pin.link], kind, -1))
            row = _shape_row(pin.position, pins, (com, 0, 0), bar.inertia, bar.mass)
            shape.append(row)
        shape[-2][CLOSED_LENGTH] = c.closed_length
    for pin in (pin for closure in machine.closures.values() for pin in (closure.a, closure.b)):
        tree.append((index[pin.link], PIN, -1))
        shape.append(_shape_row(pin.position))
    following = find_dependent_joints(machine)
    return ReducedMechanism(
        tree=_append_coordinate_end(np.array(tree, int)),
        shape=np.array(shape),
        link_count=len(order),
        bar_count=len(bars),
        joint=np.array(
            [
                [machine.joints[name].damping for name in joints],
                [machine.home.get(name, 0.0) for name in joints],
            ],
            float,
        ),
        independent=np.array([i for i, name in enumerate(joints) if name not in following], int),
        dependent=np.array([i for i, name in enumerate(joints) if name in following], int),
        gravity=np.array(machine.gravity, float),
        drive=np.array(
            [(bars.index(name) if name in bars else -1, joints.index(machine.axes[name].joint)) for name in drives],
            int,
        ).reshape(-1, 2),
    )


def _shape_row(position=(0, 0, 0), axis=(0, 0, 1), com=(0, 0, 0), inertia=(0, 0, 0), mass=0.0):
    return np.array([*position, *axis, *com, *inertia, mass, 0.0], float)


def _append_coordinate_end(tree: np.ndarray) -> np.ndarray:
    """Return `tree` (f, 3) with the column COORDINATE_END: one plus the last coordinate that moves the frame.

    Tube and rod of a bar both get the larger of their two values.
    """
    reach = np.zeros(len(tree), int)
    for i, (parent, _, coordinate) in enumerate(tree[1:], start=1):
        reach[i] = max(reach[parent], coordinate + 1)
    for tube in np.flatnonzero(tree[:, KIND] == TUBE):
        reach[tube : tube + 2] = max(reach[tube : tube + 2])
    return np.column_stack([tree, reach])


def _sort_links(machine: Machine) -> list[str]:
    """Return the names of the links, every parent before its children."""
    order: list[str] = []
    while len(order) < len(machine.links):
        order += [
            name
            for name, link in machine.links.items()
            if name not in order and (link.parent == "world" or link.parent in order)
        ]
    return order

"""A Machine's mechanism in reduced coordinates, as tables: links, bars, pins of closures, drives.

A Kalman filter and a tip balance evaluate it at every step, which `inverse_dynamics` is too slow
for: links alone are in the tree, cylinders are bars between two pins, and nothing allocates. It
knows a Machine's closures only; the two are tested against each other.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.kinematics.from_machine import pin_axis
from hydrotele.machine.machine import Machine, following_joints

WELD, HINGE, SLIDE, TUBE, ROD, PIN = range(6)
_KINDS = {"hinge": HINGE, "slide": SLIDE}

PARENT, KIND, COORDINATE, REACH = range(4)  # columns of `tree`
POSITION, AXIS, COM, INERTIA, MASS, CLOSED, SHAPE = 0, 3, 6, 9, 12, 13, 14  # columns of `shape`
DAMPING, HOME = range(2)  # rows of `joint`
BAR, JOINT = range(2)  # columns of `drive`


class ReducedMechanism(NamedTuple):
    """Frames 0 = world, 1 .. l = links, tube and rod of every bar, both pins of every closure.

    Attributes:
        tree: (f, 4) of every frame: PARENT (a tube's is the link at its base pin, a rod's the one
            at its rod pin), KIND, tree COORDINATE of its joint (-1 without one), REACH (only tree
            coordinates below it move the frame).
        shape: (f, SHAPE) of every frame: POSITION in its parent's [m] (of tube and rod: their
            pins), AXIS of its joint (of tube and rod: of their pins, in the axes of the tube's
            parent), COM [m] and INERTIA about it [kg m^2] in its own axes, MASS [kg], CLOSED (of a
            tube) pin-to-pin length at piston displacement 0 [m].
        links: l, number of links.
        bars: number of bars.
        joint: (2, N) of every tree coordinate: DAMPING [N m s/rad] or [N s/m], HOME [rad] or [m].
        free: (n,) tree coordinates that are independent.
        bound: (N - n,) tree coordinates that the closures determine.
        gravity: (3,) [m/s^2].
        drive: (nu, 2) of every drive: BAR, -1 if it acts on its joint itself, and JOINT, the tree
            coordinate.
    """

    tree: np.ndarray
    shape: np.ndarray
    links: int
    bars: int
    joint: np.ndarray
    free: np.ndarray
    bound: np.ndarray
    gravity: np.ndarray
    drive: np.ndarray

    @property
    def bodies(self) -> int:
        """Number of frames with a mass, and the world, which come first."""
        return 1 + self.links + 2 * self.bars


def body_names(machine: Machine) -> list[str]:
    """Names of the bodies of `mechanism(machine)`: world, links, `<axis>_tube`, `<axis>_rod`."""
    bars = [n for n in actuator_order(machine) if machine.axes[n].cylinder]
    return ["world", *_tree_order(machine), *(f"{n}_{p}" for n in bars for p in ("tube", "rod"))]


def coordinate_names(machine: Machine) -> list[str]:
    """Names of the joints in the order of the tree coordinates."""
    links = (machine.links[name] for name in _tree_order(machine))
    return [link.joint.name for link in links if link.joint]


def mechanism(machine: Machine) -> ReducedMechanism:
    """Tables of a machine's mechanism.

    Args:
        machine: the machine. The pins of a cylinder are parallel to the joint that it turns, as in
            the MuJoCo plant.

    Returns:
        The tables.
    """
    order, joints = _tree_order(machine), coordinate_names(machine)
    index = {"world": 0, **{name: 1 + i for i, name in enumerate(order)}}
    tree, shape = [(-1, WELD, -1)], [_row()]
    for name in order:
        link = machine.links[name]
        kind = _KINDS[link.joint.type] if link.joint else WELD
        coordinate = joints.index(link.joint.name) if link.joint else -1
        tree.append((index[link.parent], kind, coordinate))
        axis = link.joint.axis if link.joint else (0.0, 0.0, 1.0)
        shape.append(_row(link.position, axis, link.com, link.inertia, link.mass))
    drives = actuator_order(machine)
    bars = [name for name in drives if machine.axes[name].cylinder]
    for name in bars:
        c, pins = machine.axes[name].cylinder, pin_axis(machine, name)
        assert c
        ends = (TUBE, c.base_pin, c.tube, c.tube.com), (ROD, c.rod_pin, c.rod, -c.rod.com)
        for kind, pin, bar, com in ends:
            tree.append((index[pin.link], kind, -1))
            row = _row(pin.position, pins, (com, 0, 0), bar.inertia, bar.mass)
            shape.append(row)
        shape[-2][CLOSED] = c.closed_length
    for pin in (pin for closure in machine.closures.values() for pin in (closure.a, closure.b)):
        tree.append((index[pin.link], PIN, -1))
        shape.append(_row(pin.position))
    following = following_joints(machine)
    return ReducedMechanism(
        tree=_with_reach(np.array(tree, int)),
        shape=np.array(shape),
        links=len(order),
        bars=len(bars),
        joint=np.array(
            [
                [machine.joints[name].damping for name in joints],
                [machine.home.get(name, 0.0) for name in joints],
            ],
            float,
        ),
        free=np.array([i for i, name in enumerate(joints) if name not in following], int),
        bound=np.array([i for i, name in enumerate(joints) if name in following], int),
        gravity=np.array(machine.gravity, float),
        drive=np.array(
            [
                (bars.index(name) if name in bars else -1, joints.index(machine.axes[name].joint))
                for name in drives
            ],
            int,
        ).reshape(-1, 2),
    )


def _row(position=(0, 0, 0), axis=(0, 0, 1), com=(0, 0, 0), inertia=(0, 0, 0), mass=0.0):
    return np.array([*position, *axis, *com, *inertia, mass, 0.0], float)


def _with_reach(tree: np.ndarray) -> np.ndarray:
    """`tree` with the column REACH; bars share that of their ends, parents come first."""
    reach = np.zeros(len(tree), int)
    for i, (parent, _, coordinate) in enumerate(tree[1:], start=1):
        reach[i] = max(reach[parent], coordinate + 1)
    for tube in np.flatnonzero(tree[:, KIND] == TUBE):
        reach[tube : tube + 2] = max(reach[tube : tube + 2])
    return np.column_stack([tree, reach])


def _tree_order(machine: Machine) -> list[str]:
    """Links with every parent before its children."""
    order: list[str] = []
    while len(order) < len(machine.links):
        order += [
            name
            for name, link in machine.links.items()
            if name not in order and (link.parent == "world" or link.parent in order)
        ]
    return order

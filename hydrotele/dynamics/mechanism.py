"""The mechanical part of a Machine as flat arrays: links, cylinder bars, closures, drives."""

from typing import NamedTuple

import numpy as np

from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.kinematics.loops import following_joints
from hydrotele.machine import Machine

WELD, HINGE, SLIDE = 0, 1, 2
_KINDS = {"hinge": HINGE, "slide": SLIDE}


class Mechanism(NamedTuple):
    """Bodies 0 = world, 1 .. l = links, then tube and rod of every bar; N tree coordinates.

    Attributes:
        parent: (1 + l,) body of the parent, -1 for the world.
        kind: (1 + l,) WELD, HINGE or SLIDE.
        coordinate: (1 + l,) tree coordinate of the joint, -1 without one.
        position: (1 + l, 3) of the link's frame in its parent's [m].
        axis: (1 + l, 3) of the joint.
        damping: (N,) of the joints [N m s/rad] or [N s/m].
        mass: (b,) of all bodies [kg].
        com: (b, 3) in the body's frame [m].
        inertia: (b, 3) about the centre of mass, axes of the body's frame [kg m^2].
        bar_links: (bars, 2) bodies of base pin and rod pin.
        bar_pins: (bars, 2, 3) the pins in their bodies' frames [m].
        bar_closed: (bars,) pin-to-pin length at piston displacement 0 [m].
        closure_links: (closures, 2) bodies.
        closure_points: (closures, 2, 3) the points in their bodies' frames [m].
        free: (n,) tree coordinates that are independent.
        bound: (N - n,) tree coordinates that the closures determine.
        home: (N,) tree coordinates at home [rad] or [m].
        gravity: (3,) [m/s^2].
        drive_bar: (nu,) bar of every drive, -1 if it acts on its joint itself.
        drive_joint: (nu,) tree coordinate of every drive's joint.

    """

    parent: np.ndarray
    kind: np.ndarray
    coordinate: np.ndarray
    position: np.ndarray
    axis: np.ndarray
    damping: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    bar_links: np.ndarray
    bar_pins: np.ndarray
    bar_closed: np.ndarray
    closure_links: np.ndarray
    closure_points: np.ndarray
    free: np.ndarray
    bound: np.ndarray
    home: np.ndarray
    gravity: np.ndarray
    drive_bar: np.ndarray
    drive_joint: np.ndarray


def body_names(machine: Machine) -> list[str]:
    """Names of the bodies of `mechanism(machine)`: world, links, `<axis>_tube`, `<axis>_rod`."""
    bars = [n for n in actuator_order(machine) if machine.axes[n].cylinder]
    return ["world", *_tree_order(machine), *(f"{n}_{p}" for n in bars for p in ("tube", "rod"))]


def coordinate_names(machine: Machine) -> list[str]:
    """Names of the joints in the order of the tree coordinates."""
    links = (machine.links[name] for name in _tree_order(machine))
    return [link.joint.name for link in links if link.joint]


def mechanism(machine: Machine) -> Mechanism:
    """Arrays of a machine's mechanism.

    Args:
        machine: the machine. The pins of a cylinder are normal to its base link's x-z plane, as in
            the MuJoCo plant.

    Returns:
        The arrays.
    """
    order = _tree_order(machine)
    index = {"world": 0, **{name: 1 + i for i, name in enumerate(order)}}
    joints = coordinate_names(machine)
    links = [machine.links[name] for name in order]
    bars = [n for n in actuator_order(machine) if machine.axes[n].cylinder]
    cylinders = [c for n in bars if (c := machine.axes[n].cylinder)]
    following = following_joints(machine)
    kinds = [_KINDS[link.joint.type] if link.joint else WELD for link in links]
    drives = actuator_order(machine)
    ends = [(c.base_pin, c.rod_pin) for c in cylinders]
    closures = [(c.a, c.b) for c in machine.closures.values()]
    return Mechanism(
        parent=np.array([-1, *(index[link.parent] for link in links)]),
        kind=np.array([WELD, *kinds]),
        coordinate=np.array(
            [-1, *(joints.index(link.joint.name) if link.joint else -1 for link in links)]
        ),
        position=_table([(0, 0, 0), *(link.position for link in links)]),
        axis=_table([(0, 0, 1), *(k.joint.axis if k.joint else (0, 0, 1) for k in links)]),
        damping=np.array([link.joint.damping for link in links if link.joint], float),
        mass=np.array([0, *(k.mass for k in links), *(m for c in cylinders for m in _masses(c))]),
        com=_table(
            [(0, 0, 0), *(k.com for k in links), *(m for c in cylinders for m in _centres(c))]
        ),
        inertia=_table(
            [
                (0, 0, 0),
                *(k.inertia for k in links),
                *(m for c in cylinders for m in (c.tube.inertia, c.rod.inertia)),
            ]
        ),
        bar_links=np.array([[index[p.link] for p in pair] for pair in ends], int).reshape(-1, 2),
        bar_pins=np.array([[p.position for p in pair] for pair in ends], float).reshape(-1, 2, 3),
        bar_closed=np.array([c.closed_length for c in cylinders], float),
        closure_links=np.array([[index[p.link] for p in c] for c in closures], int).reshape(-1, 2),
        closure_points=np.array([[p.position for p in c] for c in closures], float).reshape(
            -1, 2, 3
        ),
        free=np.array([i for i, name in enumerate(joints) if name not in following], int),
        bound=np.array([i for i, name in enumerate(joints) if name in following], int),
        home=np.array([machine.home.get(name, 0.0) for name in joints], float),
        gravity=np.array(machine.gravity, float),
        drive_bar=np.array([bars.index(n) if n in bars else -1 for n in drives], int),
        drive_joint=np.array([joints.index(machine.axes[n].joint) for n in drives], int),
    )


def _masses(cylinder):
    return cylinder.tube.mass, cylinder.rod.mass


def _centres(cylinder):
    return (cylinder.tube.com, 0, 0), (-cylinder.rod.com, 0, 0)


def _table(rows) -> np.ndarray:
    return np.array(rows, float).reshape(-1, 3)


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

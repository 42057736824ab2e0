"""Estimates of masses and hydraulics from the size of a machine, and tests of stated masses.

The machine class is the length of the longest link of the arm, usually the boom. The laws are fitted
to shipped machines and public data sheets of excavators from 2 t (boom of 1.9 m) to 25 t (5.9 m);
each holds within a third. They are estimates for a first run, not data of a certain machine.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.convert.arm_links import MovingLink
from hydrotele.convert.robot_description import Inertial
from hydrotele.convert.shapes import Solid, convex_solid

REFERENCE_LENGTH = 1.9  # m, boom of a 2 t excavator, to which all laws below refer
_MACHINE_MASS = (2000.0, 2.1)  # kg and exponent of the length ratio
_UPPER_STRUCTURE_FRACTION = 0.40  # of the machine mass
_ARM_FRACTION = 0.09  # mass of the longest arm link; other arm links have the same mass per length
_TOOL_FRACTION = 0.04
_STEEL = 7850.0  # kg/m^3
_MIN_DENSITY = 60.0  # kg/m^3 of the convex hull: thin plates around air
_MAX_GYRATION_RATIO = 0.6  # largest radius of gyration over the longest dimension; 0.58 if all mass is at the ends
_MIN_GYRATION_RATIO = 0.02
_MAX_CLASS_RATIO = 4.0  # a mass that differs more from its class is not believed without a shape


class BodyEstimate(NamedTuple):
    """Mass [kg], centre (3,) [m] and principal moments (3,) [kg m^2] of a link, and why they replace stated ones.

    `reason` is empty if the stated values are kept.
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    reason: str


class HydraulicClass(NamedTuple):
    """Typical hydraulics of a machine class.

    Attributes:
        area: head-side area of the boom cylinders together [m^2].
        flow: pump flow [m^3/s].
        relief_pressure: [Pa].
        swing_displacement: of the swing motor with its gear [m^3/rad].
    """

    area: float
    flow: float
    relief_pressure: float
    swing_displacement: float


def hydraulic_class(length: float) -> HydraulicClass:
    """Return the typical hydraulics of a machine whose longest arm link has a length [m].

    Areas and flows grow with the square of the length, torques with its cube. Sources: bores of
    EC20, CAT 215, CAT 325, ZX120 and ZX200 (33 .. 226 cm^2), their pump flows and swing torques.
    """
    ratio = length / REFERENCE_LENGTH
    return HydraulicClass(33.0e-4 * ratio**1.8, 50.0 / 6.0e4 * ratio**2, 30.0e6, 85.0e-6 * ratio**3)


def machine_mass(length: float) -> float:
    """Return the typical mass [kg] of a machine whose longest arm link has a length [m]."""
    return _MACHINE_MASS[0] * (length / REFERENCE_LENGTH) ** _MACHINE_MASS[1]


def estimate_body(link: MovingLink, longest: float) -> BodyEstimate:
    """Return the mass properties of a link: the stated ones if they are plausible, otherwise estimates.

    Args:
        link: the link, with shapes and stated inertias.
        longest: length of the longest arm link [m].

    Returns:
        Mass, centre and moments in the axes of the link.
    """
    solid = _solid(link)
    stated = _combine(link.inertials)
    reason = find_implausibility(stated, solid, _class_mass(link, longest))
    if not reason:
        assert stated
        moments, products = np.diag(stated.inertia), np.abs(stated.inertia - np.diag(np.diag(stated.inertia)))
        if products.max() > 0.05 * moments.max():
            link_moments = _make_consistent(moments)
            return BodyEstimate(stated.mass, stated.centre, link_moments, "")
        return BodyEstimate(stated.mass, stated.centre, _make_consistent(moments), "")
    mass = _class_mass(link, longest)
    if solid is None:
        solid = convex_solid(_class_points(link, longest))
        assert solid
    else:
        mass = min(mass, 0.6 * _STEEL * solid.volume)
    centre = solid.centre.copy()
    moments = np.diag(solid.inertia) * mass / solid.volume
    return BodyEstimate(mass, centre, _make_consistent(moments), reason)


def _class_mass(link: MovingLink, longest: float) -> float:
    whole = machine_mass(longest)
    if link.role == "swing":
        return _UPPER_STRUCTURE_FRACTION * whole
    if link.role in ("tool", "rotator"):
        return _TOOL_FRACTION * whole
    if link.role == "passive":
        return 0.2 * _TOOL_FRACTION * whole
    return _ARM_FRACTION * whole * max(link.length, 0.05 * longest) / longest


def _solid(link: MovingLink) -> Solid | None:
    shapes = link.visuals or link.collisions
    return convex_solid(np.vstack([shape.points() for shape in shapes])) if shapes else None


def _class_points(link: MovingLink, longest: float) -> np.ndarray:
    """Return the corners (8, 3) of a typical link without shapes: the upper structure, or a bar to the link's end."""
    if link.role == "swing":
        low, high = np.array([-0.45, -0.25, 0.0]) * longest, np.array([0.2, 0.25, 0.35]) * longest
        return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    end = link.end if link.length > 0.05 * longest else np.array([0.1 * longest, 0.0, 0.0])
    wide = 0.08 * float(np.linalg.norm(end))
    corners = [np.array([0.0, y, z]) for y in (-wide, wide) for z in (-wide, wide)]
    sides = corners if abs(end[0]) >= abs(end[2]) else [corner[[2, 1, 0]] for corner in corners]
    return np.array(sides + [side + end for side in sides])


def _combine(parts: list[Inertial]) -> Inertial | None:
    """Return the inertia of several bodies that are fixed to each other; None without a mass."""
    mass = sum(part.mass for part in parts)
    if not parts or not mass > 0.0:
        return None
    centre = np.add.reduce([part.mass * part.centre for part in parts]) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        away = part.centre - centre
        inertia += part.inertia + part.mass * (away @ away * np.eye(3) - np.outer(away, away))
    return Inertial(mass, centre, inertia)


def find_implausibility(stated: Inertial | None, solid: Solid | None, class_mass: float) -> str:
    """Return why a stated inertia is not plausible, or an empty text.

    Args:
        stated: mass, centre and inertia of the file, if any.
        solid: convex hull of the link's shapes, if any.
        class_mass: typical mass of such a link [kg].
    """
    if stated is None:
        return "no mass stated"
    mass = stated.mass
    if solid is not None:
        density = mass / solid.volume
        if not _MIN_DENSITY <= density <= _STEEL:
            return f"{mass:g} kg in a hull of {solid.volume:.3g} m^3"
        if not class_mass / _MAX_CLASS_RATIO <= mass and density < 2.0 * _MIN_DENSITY:
            return f"{mass:g} kg, typical is {class_mass:.0f} kg"
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        slack = 0.05 * (high - low).max()
        if np.any(stated.centre < low - slack) or np.any(stated.centre > high + slack):
            return "centre of mass outside the shape"
        size = float(np.linalg.norm(high - low))
    else:
        if not class_mass / _MAX_CLASS_RATIO <= mass <= _MAX_CLASS_RATIO * class_mass:
            return f"{mass:g} kg, typical is {class_mass:.0f} kg"
        size = math.inf
    moments = np.linalg.eigvalsh(stated.inertia)
    if moments[0] <= 0.0 or moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
        return f"impossible inertia {', '.join(f'{m:g}' for m in moments)} kg m^2"
    gyration = math.sqrt(moments[2] / mass)
    if gyration > _MAX_GYRATION_RATIO * size or (math.isfinite(size) and gyration < _MIN_GYRATION_RATIO * size):
        return f"inertia {moments[2]:g} kg m^2 does not fit {mass:g} kg of this size"
    return ""


def _make_consistent(moments: np.ndarray) -> np.ndarray:
    """Return positive moments (3,) that fulfil the triangle inequality; the smallest change of the largest one."""
    moments = np.maximum(moments, 1e-6)
    largest = int(np.argmax(moments))
    moments[largest] = min(moments[largest], moments.sum() - moments[largest])
    return moments

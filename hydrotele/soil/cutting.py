"""Forces of soil on a blade: Coulomb's wedge ahead of it, Prandtl's zones under it.

A blade drawn through soil shears off a wedge along a plane that rises from its edge. Forces on that
wedge (weight, cohesion and friction on the plane, adhesion and friction on the blade) give the
Fundamental Equation of Earthmoving (Reece 1964; McKyes and Ali 1977; McKyes 1985)
`P = w (g d^2 N_g + c d N_c + c_a d N_ca) + Q N_q`, P inclined by delta against the blade's normal.
The plane is the one with the least N_g. Luengo, Singh and Cannon (1998) tilt it by the slope of the
surface and load it with the weight Q of what the bucket has swept up. All angles in radians.
"""

import math

from hydrotele.core.compiled import lean

STEEPEST_RAKE = 0.5 * math.pi  # a wedge of soil sticks to a steeper blade and is the blade then
FLATTEST_RAKE = math.radians(15.0)
WIDEST_FAN = math.radians(150.0)  # rake + delta + phi beyond which Coulomb's plane fails
STEEPEST_SLOPE = 0.6  # of the friction angle
_LEAST_SQUARE = 0.05  # keeps the wedge from jamming where blade and surface are nearly parallel


@lean
def failure_plane(rake, slope, friction, tool_friction):
    """Angle between surface and the plane on which the wedge shears off: that of least N_g.

    Setting the derivative of `N_g(cot beta)` to zero leaves a quadratic equation.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, positive where it rises ahead of the blade, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].

    Returns:
        beta, scalar [rad], within 5 .. 85 deg.

    Source: McKyes 1985, chapter 3; Coulomb's passive wedge.

    >>> import math
    >>> smooth_wall = failure_plane(math.pi / 2, 0.0, math.radians(30), 0.0)
    >>> round(math.degrees(smooth_wall), 6)  # 45 - phi / 2
    30.0
    """
    fan = rake + tool_friction + friction
    square = (math.sin(tool_friction + friction) * math.sin(rake + tool_friction - slope)) / (
        math.sin(rake) * math.sin(friction + slope)
    )
    root = math.sqrt(max(square, _LEAST_SQUARE))
    plane = math.atan2(math.sin(fan), root - math.cos(fan))
    return min(max(plane, math.radians(5.0)), math.radians(85.0))


@lean
def wedge_weight_factor(rake, slope, friction, tool_friction, plane):
    """N_g: force on the blade by the weight of the wedge, per specific weight, width and depth^2.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].
        plane: beta, scalar [rad].

    Returns:
        N_g, scalar [1]; depth counts at right angles to the surface.

    Source: McKyes 1985, chapter 3; Luengo et al. 1998.

    >>> import math
    >>> phi = math.radians(30)
    >>> N = wedge_weight_factor(math.pi / 2, 0.0, phi, 0.0, math.radians(30))
    >>> round(2.0 * N, 6)  # Rankine's tan^2(45 + phi / 2)
    3.0
    """
    top = 1.0 / math.tan(rake) + 1.0 / math.tan(plane)
    return 0.5 * top * surcharge_factor(rake, slope, friction, tool_friction, plane)


@lean
def surcharge_factor(rake, slope, friction, tool_friction, plane):
    """N_q: force on the blade per weight that rests on the wedge.

    Args:
        rake: between blade and surface, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].
        plane: beta, scalar [rad].

    Returns:
        N_q, scalar [1].

    Source: Luengo et al. 1998.
    """
    return math.sin(plane + friction + slope) / math.sin(rake + tool_friction + friction + plane)


@lean
def cohesion_factor(rake, friction, tool_friction, plane):
    """N_c: force on the blade by cohesion on the plane, per cohesion, width and depth.

    Args:
        rake: between blade and surface, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].
        plane: beta, scalar [rad].

    Returns:
        N_c, scalar [1].

    Source: McKyes 1985, chapter 3, simplified.
    """
    fan = rake + tool_friction + friction + plane
    return math.cos(friction) / (math.sin(plane) * math.sin(fan))


@lean
def adhesion_factor(rake, friction, tool_friction, plane):
    """N_ca: force on the blade by adhesion to it, per adhesion, width and depth.

    Args:
        rake: between blade and surface, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].
        plane: beta, scalar [rad].

    Returns:
        N_ca, scalar [1]; the adhesion itself, along the blade, comes on top.

    Source: McKyes 1985, chapter 3, simplified.
    """
    fan = rake + tool_friction + friction + plane
    return -math.cos(rake + friction + plane) / (math.sin(rake) * math.sin(fan))


@lean
def bearing_pressure(overburden, cohesion, friction, tilt):
    """Pressure at which soil yields under a smooth face that is pushed into it.

    `p + c cot phi = (q + c cot phi) tan^2(45 deg + phi/2) e^(2 theta tan phi)`: a level face turns
    the principal stresses by theta = 90 deg (Prandtl and Reissner's strip footing, N_q = 18.4 for
    30 deg), an upright one not at all (Rankine's passive wall).

    Args:
        overburden: q, beside the face, scalar [Pa].
        cohesion: c, scalar [Pa].
        friction: phi, above 0, scalar [rad].
        tilt: of the face against the surface, 0 .. pi/2, scalar [rad].

    Returns:
        p, scalar [Pa].

    Source: Prandtl 1920, Reissner 1924; tilted faces Sokolovskii 1960. The weight below the face
    (N_gamma) is left out, which is small for narrow edges and on the safe side.
    """
    sine, t = math.sin(friction), math.tan(friction)
    factor = (1.0 + sine) / (1.0 - sine) * math.exp(2.0 * (0.5 * math.pi - tilt) * t)
    return (overburden + cohesion / t) * factor - cohesion / t


@lean
def acting_rake(rake, slope, friction, tool_friction):
    """Rake against the surface that the wedge feels, kept where the equation holds.

    A wedge of soil sticks to a blade that is steeper than upright, or too steep for its friction
    (Hettiaratchi and Reece 1975), and acts as the blade; below 15 deg the blade acts as at 15 deg.

    Args:
        rake: of the blade against the horizontal, scalar [rad].
        slope: of the surface, scalar [rad].
        friction: phi, scalar [rad].
        tool_friction: delta, scalar [rad].

    Returns:
        rake, scalar [rad].

    Source: see above.
    """
    steepest = min(STEEPEST_RAKE, WIDEST_FAN - friction - tool_friction)
    return min(max(rake + slope, FLATTEST_RAKE), steepest)


@lean
def acting_slope(slope, friction):
    """Slope of the surface, kept where a plane can form.

    Args:
        slope: of the surface, scalar [rad].
        friction: phi, scalar [rad].

    Returns:
        slope within 0.6 phi of level, scalar [rad].

    Source: Coulomb's forces grow without bound as the slope nears phi.
    """
    limit = STEEPEST_SLOPE * friction
    return min(max(slope, -limit), limit)

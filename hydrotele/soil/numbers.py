"""Soil, bucket and profile as one flat array, and the places of a bucket's state."""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.soil.facts import GRAVITY, Soil
from hydrotele.soil.shape import Bucket, outline_from_edge

(
    DENSITY, COHESION, FRICTION, TOOL_FRICTION, ADHESION, SWELL, REPOSE, CUT_SLOPE, STIFFNESS,
    DAMPING, WIDTH, INNER_WIDTH, EDGE, FLOOR_ANGLE, FLOOR_LENGTH, HEEL_X, HEEL_Z, START, CELL,
    SIZE, GRAVITY_AT, CORNERS,
) = range(22)  # fmt: skip
OUTLINE = 22

(
    CARRIED, FACE, TIP, FLOOR, HEEL, SLIDE, LAST_R, LAST_Z, LAST_HEEL_R, LAST_HEEL_Z, FRONT, PLACED,
    LOW, HIGH, LOST, DEPTH,
) = range(16)  # fmt: skip
STATE = 16
"""Places of a bucket's state: loose volume carried [m^3]; deflections of the soil against face,
edge, floor, heel and along the heel [m]; last places of edge and heel [m]; where the cut ends [m];
whether it was placed; first and last cell that may still slide; loose volume that left the profile
[m^3]; depth of the edge [m]."""

(FORCE_R, FORCE_Z, MOMENT, MASS, MASS_R, MASS_Z) = range(6)
OUT = 6
"""Places of what a step gives: force of the soil on the bucket at its edge, outwards and up [N];
moment about the edge, positive raises the outboard end [N m]; mass carried [kg] and where its
centre lies from the edge, outwards and up [m]."""


def soil_numbers(soil: Soil, bucket: Bucket, start: float, cell: float) -> np.ndarray:
    """Pack what does not change.

    Args:
        soil: the soil.
        bucket: the bucket.
        start: radius at which the profile begins [m].
        cell: length of its cells [m].

    Returns:
        (k,) numbers for the compiled functions of this room, SI.

    Raises:
        InputError: the cells or the bucket cannot be used.
    """
    if not 0.01 <= cell <= 0.5:
        raise InputError("soil profile", f"cells of {cell} m; 0.01 to 0.5 m are allowed")
    if not (math.isfinite(start) and start >= 0.0):
        raise InputError("soil profile", f"begins at a radius of {start} m; it must be at least 0")
    outline = outline_from_edge(bucket)
    edge_x, edge_z = bucket.outline[0]
    return np.array([
        soil.density, soil.cohesion, soil.friction, soil.tool_friction, soil.adhesion, soil.swell,
        math.tan(soil.repose), math.tan(soil.cut_slope), soil.stiffness,
        soil.stiffness * soil.damping_time, bucket.width, bucket.inner_width, bucket.edge,
        bucket.floor_angle, bucket.floor_length, bucket.heel[0] - edge_x, bucket.heel[1] - edge_z,
        start, cell, np.hypot(*outline.T).max(), GRAVITY, len(outline), *outline.ravel(),
    ])  # fmt: skip


def bucket_state() -> np.ndarray:
    """State (STATE,) of an empty bucket that has not been placed yet: zeros.

    The first step places it. Zeros written into it later begin anew.
    """
    return np.zeros(STATE)


def level_profile(count: int, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A level profile of undisturbed soil.

    Args:
        count: number of cells.
        height: of the surface [m].

    Returns:
        (surface, loose): (count,) height of the surface [m] and how much of it on top is loose [m].

    Raises:
        InputError: there are fewer than 8 cells.
    """
    if count < 8:
        raise InputError("soil profile", f"has {count} cells; at least 8 are needed")
    return np.full(count, float(height)), np.zeros(count)


def soil_mass(numbers: np.ndarray, surface: np.ndarray, loose: np.ndarray,
              state: np.ndarray) -> float:  # fmt: skip
    """Mass of all soil: of the profile above height 0, in the bucket, and lost off its ends [kg].

    It does not change in `soil_step`, but for rounding.
    """
    n = numbers
    thickness = np.sum(surface - loose) + np.sum(loose) / n[SWELL]
    volume = thickness * n[CELL] * n[WIDTH] + (state[CARRIED] + state[LOST]) / n[SWELL]
    return float(volume * n[DENSITY])

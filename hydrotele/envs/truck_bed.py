"""Bed of a truck that the bucket fills, and the release of soil from a bucket in the air.

The load of the bed is a profile along the truck: one height per cell, uniform across the bed. Soil
falls from the bucket at once. Soil that does not fall into the bed is spilled, and so is soil on top
of a full bed. The load does not push on the bucket; walls and floor do, by contacts of MuJoCo.
"""

import math

from hydrotele.core.compiled import compiled
from hydrotele.scenario.surrounding_objects import DumpTruck
from hydrotele.soil.parameters import (
    CARRIED_VOLUME,
    DENSITY,
    DEPTH,
    FACE,
    FLOOR,
    FORCE_R,
    FORCE_Z,
    HEEL,
    INNER_WIDTH,
    IS_INITIALISED,
    MASS,
    MASS_R,
    MASS_Z,
    MOMENT,
    REPOSE,
    SLIDE,
    SWELL,
    TIP,
)
from hydrotele.soil.step import MIN_SPILL_RATE, SPILL_TIME, compute_bucket_capacity

TRUCK = DumpTruck(position=(0.0, 5.5), direction=math.pi / 2.0, wall_height=0.6)
"""The truck: a two-axle dump truck of 18 t, left of the machine, rear towards it. Its bed holds 5.5 m^3 struck."""
LOAD_CELL_COUNT = 40
LOAD_CELL_LENGTH = TRUCK.length / LOAD_CELL_COUNT  # m
RAIL_HEIGHT = TRUCK.floor_height + TRUCK.wall_height  # m, height over which the bucket is lifted
_X, _Y = TRUCK.position
_LENGTH, _WIDTH, _WALL = TRUCK.length, TRUCK.width, TRUCK.wall_height
_AHEAD_X, _AHEAD_Y = math.cos(TRUCK.direction), math.sin(TRUCK.direction)
_SLIDE_SWEEPS = 2  # sweeps of sliding soil per call


@compiled
def position_in_bed(x, y):
    """Return the position of a point relative to the centre of the bed.

    Args:
        x: of the point in the world frame, scalar [m].
        y: likewise [m].

    Returns:
        (distance ahead along the truck, distance to the left), scalars [m].

    Source: this module.
    """
    dx, dy = x - _X, y - _Y
    return _AHEAD_X * dx + _AHEAD_Y * dy, _AHEAD_X * dy - _AHEAD_Y * dx


@compiled
def loaded_volume(load):
    """Return the loose volume in the bed, scalar [m^3].

    Args:
        load: (LOAD_CELL_COUNT,) heights above the floor of the bed [m].

    Source: this module.
    """
    total = 0.0
    for i in range(LOAD_CELL_COUNT):
        total += load[i]
    return total * LOAD_CELL_LENGTH * _WIDTH


@compiled
def release_soil_in_air(n, state, attitude, period, out):
    """Let the soil that a bucket in the air cannot hold fall out during one control period.

    Contacts of the bucket with the ground are forgotten.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        state: (STATE_SIZE,) state of the bucket, changed.
        attitude: of the bucket, scalar [rad].
        period: control period, scalar [s].
        out: (RESULT_SIZE,) written like the result of `step_soil`, without force.

    Returns:
        (loose volume that falls [m^3], outward distance from the edge at which it falls [m]), scalars.

    Source: as in `soil.step.step_soil`.
    """
    for i in (IS_INITIALISED, FACE, TIP, FLOOR, HEEL, SLIDE, DEPTH):
        state[i] = 0.0
    compute_bucket_capacity(n, attitude, 0.0, out)
    most, centre_r, centre_z, rim = out[0], out[1], out[2], out[3]
    falls, excess = 0.0, state[CARRIED_VOLUME] - most
    if excess > 0.0:
        falls = min(excess, (excess / SPILL_TIME + MIN_SPILL_RATE) * period)
        state[CARRIED_VOLUME] -= falls
    out[FORCE_R], out[FORCE_Z], out[MOMENT] = 0.0, 0.0, 0.0
    out[MASS] = state[CARRIED_VOLUME] / n[SWELL] * n[DENSITY]
    out[MASS_R], out[MASS_Z] = centre_r, centre_z
    return falls, rim


@compiled
def drop_into_bed(n, load, x, y, volume):
    """Add soil that falls from the bucket to the load of the bed.

    The soil falls in a slab as wide as the interior of the bucket; the part of the slab outside
    the bed is spilled.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        load: (LOAD_CELL_COUNT,) heights above the floor of the bed, changed [m].
        x: centre of the slab in the world frame, scalar [m].
        y: likewise [m].
        volume: loose volume, scalar [m^3].

    Returns:
        Loose volume that is spilled, scalar [m^3].

    Source: conservation of volume.
    """
    ahead, left = position_in_bed(x, y)
    half, side = 0.5 * n[INNER_WIDTH], 0.5 * _WIDTH
    inside = max(0.0, min(left + half, side) - max(left - half, -side)) / n[INNER_WIDTH]
    cell = int(math.floor((ahead + 0.5 * _LENGTH) / LOAD_CELL_LENGTH))
    spilled = volume
    for i in (cell - 1, cell):
        if 0 <= i < LOAD_CELL_COUNT:
            part = 0.5 * inside * volume
            load[i] += part / (LOAD_CELL_LENGTH * _WIDTH)
            spilled -= part
    return spilled


@compiled
def level_load(n, load):
    """Let the load of the bed slide to the angle of repose, and spill what lies too high.

    Across the bed, the load rises from the top of the walls at the angle of repose to a ridge in
    the middle. At front wall and tailgate it rises likewise from their tops.

    Args:
        n: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        load: (LOAD_CELL_COUNT,) mean heights above the floor of the bed, changed [m].

    Returns:
        Loose volume that is spilled, scalar [m^3].

    Source: conservation of volume; loose soil rests at the angle of repose.
    """
    steepest, ridge = n[REPOSE] * LOAD_CELL_LENGTH, _WALL + 0.25 * n[REPOSE] * _WIDTH
    for _ in range(_SLIDE_SWEEPS):
        for k in range(2 * (LOAD_CELL_COUNT - 1)):
            i = k if k < LOAD_CELL_COUNT - 1 else 2 * LOAD_CELL_COUNT - 3 - k
            step = load[i] - load[i + 1]
            if abs(step) > steepest:
                moved = 0.5 * (step - math.copysign(steepest, step))
                load[i] -= moved
                load[i + 1] += moved
    over = 0.0
    for i in range(LOAD_CELL_COUNT):
        end = min(i, LOAD_CELL_COUNT - 1 - i) + 0.5
        excess = load[i] - min(ridge, _WALL + end * steepest)
        if excess > 0.0:
            load[i] -= excess
            over += excess
    return over * LOAD_CELL_LENGTH * _WIDTH

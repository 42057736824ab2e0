"""The bed of soil under a bucket: kept in an episode's terrain, its force on the simulation.

`World.terrain` holds everything that one episode's soil remembers, in slices: the profile, the
bucket's state, what the last step gave, and the numbers of the soil itself, which episodes may
have different ones of. The profile lies in the vertical plane of the arm and turns with it.
"""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.task import task_jacobian
from hydrotele.soil.facts import OUT, OUTLINE, STATE, WIDTH, Soil, soil_numbers
from hydrotele.soil.shape import CAT215, Bucket
from hydrotele.soil.step import soil_step
from hydrotele.soil.wrench import bucket_wrench
from hydrotele.tasks.memory import NUMBERS

START, CELL, CELLS = 2.5, 0.05, 140  # m, m: the profile reaches to 9.5 m
SOILS_MOST = 3
_SHARED = OUTLINE + 2 * len(CAT215.outline)  # numbers of soil, bucket and profile
_LOOSE = CELLS  # places in the terrain
_BUCKET = _LOOSE + CELLS
_RESULT = _BUCKET + STATE
_SOIL = _RESULT + OUT
TERRAIN = _SOIL + _SHARED


def bed_numbers(soils: Sequence[Soil], bucket: Bucket = CAT215) -> np.ndarray:
    """Numbers of a task with a bed of soil.

    Args:
        soils: that episodes may have.
        bucket: that digs.

    Returns:
        (at most NUMBERS,) those of the first soil with bucket and profile, then what differs.

    Raises:
        InputError: there are no soils or more than three, or the bucket has other corners.
    """
    rows = [soil_numbers(soil, bucket, START, CELL) for soil in soils]
    if not 1 <= len(rows) <= SOILS_MOST or len(rows[0]) != _SHARED:
        raise InputError("bed of soil", f"takes 1 to {SOILS_MOST} soils and the CAT 215's bucket")
    return np.concatenate([rows[0], *(row[:WIDTH] for row in rows[1:])])


@compiled
def surface_of(w):
    """Heights of the profile (CELLS,), live [m].

    Args:
        w: World.

    Returns:
        (CELLS,).

    Source: this module.
    """
    return w.terrain[:CELLS]


@compiled
def loose_of(w):
    """How much of the profile is loose (CELLS,), live [m].

    Args:
        w: World.

    Returns:
        (CELLS,).

    Source: this module.
    """
    return w.terrain[_LOOSE:_BUCKET]


@compiled
def bucket_of(w):
    """State of the bucket (STATE,), live; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (STATE,).

    Source: this module.
    """
    return w.terrain[_BUCKET:_RESULT]


@compiled
def result_of(w):
    """What the last step gave (OUT,), live; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (OUT,).

    Source: this module.
    """
    return w.terrain[_RESULT:_SOIL]


@compiled
def soil_of(w):
    """Numbers of the episode's soil, live; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (k,).

    Source: this module.
    """
    return w.terrain[_SOIL:TERRAIN]


@compiled
def lay_bed(f, w, soil):
    """Begin with level undisturbed soil at height 0 and an empty bucket.

    Args:
        f: record of FACTS; its numbers are those of `bed_numbers`.
        w: World; `terrain` is written.
        soil: number of the soil, scalar [1].

    Returns:
        Nothing.

    Source: this module.
    """
    w.terrain[:] = 0.0
    numbers = soil_of(w)
    for i in range(_SHARED):
        numbers[i] = f.numbers[i]
    if soil > 0:
        first = _SHARED + (soil - 1) * WIDTH
        for i in range(WIDTH):
            numbers[i] = f.numbers[first + i]


@compiled
def edge_rates(f, e, w, rates):
    """Speeds of the bucket's edge, outwards and up, by the nominal arm.

    Only the damping of the soil's springs reads them, for which a variant's arm, some centimetres
    longer, is the same.

    Args:
        f: record of FACTS.
        e: record of MEMORY.
        w: World.
        rates: (2,) written [m/s].

    Returns:
        Nothing.

    Source: `kinematics.task.task_jacobian`.
    """
    k = f.arm_axes
    jacobian = np.empty((k, k))
    task_jacobian(f.arm, e.position[:k], jacobian)
    rates[0], rates[1] = 0.0, 0.0
    for j in range(k):
        speed = w.qvel[f.dof[j]]
        rates[0] += jacobian[0, j] * speed
        rates[1] += jacobian[2, j] * speed


@compiled
def tick_bed(f, e, w):
    """Move soil and bucket on by one control period; the force acts in the next one.

    Args:
        f: record of FACTS.
        e: record of MEMORY.
        w: World after a physics step; `terrain` and the tip's body in `xfrc` are written.

    Returns:
        Nothing.

    Source: `soil.step`, `soil.wrench`; places are MuJoCo's own, so that every variant's geometry
        is exact.
    """
    body = f.tip_body
    theta = math.atan2(w.tip[1], w.tip[0])
    c, s = math.cos(theta), math.sin(theta)
    ahead = w.xmat[9 * body : 9 * body + 9]  # its first column points from the pin to the edge
    attitude = math.atan2(ahead[6], c * ahead[0] + s * ahead[3])
    rates = np.empty(2)
    edge_rates(f, e, w, rates)
    out = result_of(w)
    soil_step(
        soil_of(w), surface_of(w), loose_of(w), bucket_of(w), math.hypot(w.tip[0], w.tip[1]),
        w.tip[2], rates[0], rates[1], attitude, f.period, out,
    )  # fmt: skip
    bucket_wrench(
        out, w.tip, theta, w.xipos[3 * body : 3 * body + 3], w.xfrc[6 * body : 6 * body + 6]
    )


assert _SHARED + (SOILS_MOST - 1) * WIDTH <= NUMBERS

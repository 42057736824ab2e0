"""Bed of soil of an episode, in the vertical plane of the arm; the bed rotates with the arm.

`SimulationView.terrain` has slices for the profile, the bucket state, the result of the last step
and the soil parameters. The step applies the soil force to the bucket.
"""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import MAX_ARM_AXES, arm_values
from hydrotele.kinematics.task_space import task_jacobian
from hydrotele.soil.parameters import (
    CAT215,
    OUTLINE_START,
    RESULT_SIZE,
    STATE_SIZE,
    WIDTH,
    Bucket,
    Soil,
    pack_soil_parameters,
)
from hydrotele.soil.step import EdgeMotion, compute_bucket_wrench, step_soil

PROFILE_START, CELL_LENGTH, CELL_COUNT = 2.5, 0.05, 140  # m, m, 1: the profile extends to 9.5 m
MAX_SOILS = 3  # maximum number of soils of a task
SOIL_PARAMETER_COUNT = OUTLINE_START + 2 * len(CAT215.outline)  # parameters of soil, bucket and profile
_LOOSE_OFFSET = CELL_COUNT  # offsets in the terrain
_BUCKET_OFFSET = _LOOSE_OFFSET + CELL_COUNT
_RESULT_OFFSET = _BUCKET_OFFSET + STATE_SIZE
_SOIL_OFFSET = _RESULT_OFFSET + RESULT_SIZE
TERRAIN_SIZE = _SOIL_OFFSET + SOIL_PARAMETER_COUNT


def pack_soil_bed_parameters(soils: Sequence[Soil], bucket: Bucket = CAT215) -> np.ndarray:
    """Pack the parameters of bucket, soil profile and one to three soils as task parameters.

    Args:
        soils: the soils from which an episode draws one.
        bucket: the bucket that digs.

    Returns:
        (at most MAX_PARAMETERS,) parameters of the first soil with bucket and profile, then the soil
        parameters of the other soils.

    Raises:
        InputError: there are no soils or more than three, or the outline of the bucket has another
            number of corners than that of the CAT 215.
    """
    rows = [pack_soil_parameters(soil, bucket, PROFILE_START, CELL_LENGTH) for soil in soils]
    if not 1 <= len(rows) <= MAX_SOILS or len(rows[0]) != SOIL_PARAMETER_COUNT:
        message = f"needs 1 to {MAX_SOILS} soils and a bucket with the corners of the CAT 215's"
        raise InputError("bed of soil", message)
    return np.concatenate([rows[0], *(row[:WIDTH] for row in rows[1:])])


@compiled
def soil_surface_view(w):
    """Return a view of the surface heights of the profile.

    Args:
        w: SimulationView.

    Returns:
        (CELL_COUNT,) [m].

    Source: this module.
    """
    return w.terrain[:CELL_COUNT]


@compiled
def loose_thickness_view(w):
    """Return a view of the thickness of the loose soil on the profile.

    Args:
        w: SimulationView.

    Returns:
        (CELL_COUNT,) [m].

    Source: this module.
    """
    return w.terrain[_LOOSE_OFFSET:_BUCKET_OFFSET]


@compiled
def bucket_state_view(w):
    """Return a view of the soil state of the bucket, indexed by CARRIED_VOLUME to DEPTH of `soil.parameters`.

    Args:
        w: SimulationView.

    Returns:
        (STATE_SIZE,).

    Source: this module.
    """
    return w.terrain[_BUCKET_OFFSET:_RESULT_OFFSET]


@compiled
def soil_result_view(w):
    """Return a view of the result of the last soil step: force, moment, and mass carried with its centre.

    Args:
        w: SimulationView.

    Returns:
        (RESULT_SIZE,).

    Source: this module.
    """
    return w.terrain[_RESULT_OFFSET:_SOIL_OFFSET]


@compiled
def soil_parameters_view(w):
    """Return a view of the episode's parameters of soil, bucket and profile, from `pack_soil_parameters`.

    Args:
        w: SimulationView.

    Returns:
        (k,).

    Source: this module.
    """
    return w.terrain[_SOIL_OFFSET:TERRAIN_SIZE]


@compiled
def init_soil_bed(f, w, soil):
    """Initialise the terrain with level undisturbed soil at height 0, an empty bucket and the parameters of one soil.

    Args:
        f: record of TASK_PARAMETERS; its parameters are those of `pack_soil_bed_parameters`.
        w: SimulationView; `terrain` is written.
        soil: index of the soil in the list given to `pack_soil_bed_parameters`, scalar [1].

    Returns:
        Nothing.

    Source: this module.
    """
    w.terrain[:] = 0.0
    numbers = soil_parameters_view(w)
    for i in range(SOIL_PARAMETER_COUNT):
        numbers[i] = f.parameters[i]
    if soil > 0:
        first = SOIL_PARAMETER_COUNT + (soil - 1) * WIDTH
        for i in range(WIDTH):
            numbers[i] = f.parameters[first + i]


@compiled
def compute_bucket_edge_velocity(f, e, w, rates):
    """Compute the velocity of the bucket's edge in the plane of the arm with the nominal kinematics.

    A variant of the machine may have a slightly different geometry. This is acceptable, since the
    velocity only determines the damping of the soil.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE, with the true axis positions.
        w: SimulationView, with the joint velocities.
        rates: (2,) written: outward and upward velocity [m/s].

    Returns:
        Nothing.

    Source: `kinematics.task_space.task_jacobian`.
    """
    k = f.arm_axes
    jacobian = np.empty((k, k))
    task_jacobian(f.arm, arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes]), jacobian)
    rates[0], rates[1] = 0.0, 0.0
    for j in range(k):
        speed = w.qvel[f.dof[f.driven_axis[j]]]
        rates[0] += jacobian[0, j] * speed
        rates[1] += jacobian[2, j] * speed


@compiled
def step_soil_bed(f, e, w):
    """Advance soil profile and bucket contents by one control period, and apply the soil force to the bucket.

    The force, with the weight of the soil carried, acts during the next control period.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView after a physics step; `terrain` and the row of the tip's body in `xfrc` are
            written.

    Returns:
        Nothing.

    Source: `soil.step.step_soil`, `compute_bucket_wrench`. Positions come from MuJoCo, so that the geometry
        of every variant is exact.
    """
    body = f.tip_body
    theta = math.atan2(w.tip[1], w.tip[0])
    c, s = math.cos(theta), math.sin(theta)
    ahead = w.xmat[9 * body : 9 * body + 9]  # first column points from the pin to the edge
    attitude = math.atan2(ahead[6], c * ahead[0] + s * ahead[3])
    rates = np.empty(2)
    compute_bucket_edge_velocity(f, e, w, rates)
    out = soil_result_view(w)
    edge = EdgeMotion(math.hypot(w.tip[0], w.tip[1]), w.tip[2], rates[0], rates[1], attitude)
    step_soil(
        soil_parameters_view(w),
        soil_surface_view(w),
        loose_thickness_view(w),
        bucket_state_view(w),
        edge,
        f.period,
        out,
    )
    compute_bucket_wrench(out, w.tip, theta, w.xipos[3 * body : 3 * body + 3], w.xfrc[6 * body : 6 * body + 6])

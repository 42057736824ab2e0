"""The task `Grade`: cut a low bank of soil with mounds down to a plane and carry the soil away.

The module also couples the soil model to the simulation. `World.terrain` stores the soil state of
one episode in slices: the profile, the state of the bucket, the result of the last step and the
soil parameters, which may differ between episodes. The profile lies in the vertical plane of the
arm and rotates with it.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import ARM, PARAMETERS, uniform, uniform_between
from hydrotele.envs.task import Task, draw_start
from hydrotele.envs.world import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_CODE,
    TICK,
    Field,
    episodes,
    observed,
    parameters_at,
    reach,
    rewarded,
    world,
)
from hydrotele.kinematics.task import task_forward, task_jacobian
from hydrotele.machine.machine import Machine
from hydrotele.soil.facts import (
    CAT215,
    FORCE_R,
    FORCE_Z,
    MASS,
    OUT,
    OUTLINE,
    SOILS,
    STATE,
    WIDTH,
    Bucket,
    Soil,
    soil_parameters,
)
from hydrotele.soil.step import EdgeMotion, bucket_wrench, soil_step
from hydrotele.soil.terrain import surface_height

START, CELL, CELLS = 2.5, 0.05, 140  # m, m, 1: the profile extends to 9.5 m
SOILS_MOST = 3  # maximum number of soils of a task
_SHARED = OUTLINE + 2 * len(CAT215.outline)  # parameters of soil, bucket and profile
_LOOSE = CELLS  # offsets in the terrain
_BUCKET = _LOOSE + CELLS
_RESULT = _BUCKET + STATE
_SOIL = _RESULT + OUT
TERRAIN = _SOIL + _SHARED


def bed_parameters(soils: Sequence[Soil], bucket: Bucket = CAT215) -> np.ndarray:
    """Return the task parameters of a bed of soil.

    Args:
        soils: the soils from which an episode draws one.
        bucket: the bucket that digs.

    Returns:
        (at most PARAMETERS,) parameters of the first soil with bucket and profile, then the soil
        parameters of the other soils.

    Raises:
        InputError: there are no soils or more than three, or the outline of the bucket has another
            number of corners than that of the CAT 215.
    """
    rows = [soil_parameters(soil, bucket, START, CELL) for soil in soils]
    if not 1 <= len(rows) <= SOILS_MOST or len(rows[0]) != _SHARED:
        message = f"needs 1 to {SOILS_MOST} soils and a bucket with the corners of the CAT 215's"
        raise InputError("bed of soil", message)
    return np.concatenate([rows[0], *(row[:WIDTH] for row in rows[1:])])


@compiled
def surface_of(w):
    """Return a view of the surface heights of the profile.

    Args:
        w: World.

    Returns:
        (CELLS,) [m].

    Source: this module.
    """
    return w.terrain[:CELLS]


@compiled
def loose_of(w):
    """Return a view of the thickness of the loose soil on the profile.

    Args:
        w: World.

    Returns:
        (CELLS,) [m].

    Source: this module.
    """
    return w.terrain[_LOOSE:_BUCKET]


@compiled
def bucket_of(w):
    """Return a view of the bucket state; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (STATE,).

    Source: this module.
    """
    return w.terrain[_BUCKET:_RESULT]


@compiled
def result_of(w):
    """Return a view of the result of the last soil step; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (OUT,).

    Source: this module.
    """
    return w.terrain[_RESULT:_SOIL]


@compiled
def soil_of(w):
    """Return a view of the soil parameters of the episode; see `soil.facts`.

    Args:
        w: World.

    Returns:
        (k,).

    Source: this module.
    """
    return w.terrain[_SOIL:TERRAIN]


@compiled
def lay_bed(f, w, soil):
    """Initialise the terrain with level undisturbed soil at height 0 and an empty bucket.

    Args:
        f: record of TASK_PARAMETERS; its parameters are those of `bed_parameters`.
        w: World; `terrain` is written.
        soil: index of the soil, scalar [1].

    Returns:
        Nothing.

    Source: this module.
    """
    w.terrain[:] = 0.0
    numbers = soil_of(w)
    for i in range(_SHARED):
        numbers[i] = f.parameters[i]
    if soil > 0:
        first = _SHARED + (soil - 1) * WIDTH
        for i in range(WIDTH):
            numbers[i] = f.parameters[first + i]


@compiled
def edge_rates(f, e, w, rates):
    """Compute the velocity of the bucket's edge, outwards and up, with the nominal kinematics.

    Only the damping of the soil uses it, which tolerates the slightly different geometry of a
    variant.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
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
    """Advance soil and bucket by one control period; the force acts during the next period.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World after a physics step; `terrain` and the row of the tip's body in `xfrc` are
            written.

    Returns:
        Nothing.

    Source: `soil.step.soil_step`, `bucket_wrench`. Positions come from MuJoCo, so that the geometry
        of every variant is exact.
    """
    body = f.tip_body
    theta = math.atan2(w.tip[1], w.tip[0])
    c, s = math.cos(theta), math.sin(theta)
    ahead = w.xmat[9 * body : 9 * body + 9]  # first column points from the pin to the edge
    attitude = math.atan2(ahead[6], c * ahead[0] + s * ahead[3])
    rates = np.empty(2)
    edge_rates(f, e, w, rates)
    out = result_of(w)
    edge = EdgeMotion(math.hypot(w.tip[0], w.tip[1]), w.tip[2], rates[0], rates[1], attitude)
    soil_step(soil_of(w), surface_of(w), loose_of(w), bucket_of(w), edge, f.period, out)
    bucket_wrench(
        out, w.tip, theta, w.xipos[3 * body : 3 * body + 3], w.xfrc[6 * body : 6 * body + 6]
    )


assert _SHARED + (SOILS_MOST - 1) * WIDTH <= PARAMETERS


NEAR, FAR = 3.8, 5.8  # m, radii between which the ground is graded
POINTS = 20  # number of profile sections whose mean is observed
MIDDLE = 0.5 * (NEAR + FAR)  # m, radius at which the height of the plane is given
GRADED = 0.03  # m, maximum RMS error of graded ground
HOLD = 1.0  # s for which the error must stay below it
DEEPEST = 0.5  # m below the plane at which the episode fails
SCALE = 0.01  # m of error reduction for a reward of 1
TIME_COST = 0.05  # reward per s
SUCCESS, FAILURE = 5.0, -5.0  # rewards at the end
SCANNER = 0.01  # m, maximum error of a measured section mean, assumed
SCALES = 30.0  # kg, maximum error of the measured mass carried, assumed
_LEVEL = (0.15, 0.45)  # m, height of the ground above the machine's tracks
_SLOPE = 0.06  # rad, maximum slope of the plane
_DOWN = (0.02, 0.08)  # m, depth of the plane below the ground
_HIGH, _LOW = (0.12, 0.30), (0.0, 0.10)  # m, heights of two mounds
_LONG = (0.7, 1.3)  # m, half lengths of the mounds
_MOST = 4000.0  # kg, upper bound of the observed mass carried
PLANE, TILT, ERROR, HELD, SOIL = range(5)  # indices in `goal`
FIRST, LAST = round((NEAR - START) / CELL), round((FAR - START) / CELL)  # cells
_EACH = (LAST - FIRST) // POINTS  # cells per section
assert 0 <= FIRST < LAST <= CELLS and _EACH * POINTS == LAST - FIRST


def grade_radii() -> list[float]:
    """Return the centre radii of the profile sections whose means are observed [m]."""
    return [NEAR + (FAR - NEAR) * (p + 0.5) / POINTS for p in range(POINTS)]


def grade_fields(machine: Machine, axes: tuple[str, ...]) -> list[Field]:
    """Return the fields that `observe_grade` writes: profile errors, edge height, mass, plane."""
    far = reach(machine)
    fields = [Field(f"profile_error.{p}", "m", -1.0, 2.0) for p in range(POINTS)]
    return [
        *fields,
        Field("edge_height", "m", -2.0, far),
        Field("carried_mass", "kg", -SCALES, _MOST),
        Field("plane_height", "m", -1.0, 1.0),
        Field("plane_slope", "rad", -0.1, 0.1),
    ]


@compiled
def plane_height(g, r):
    """Return the height of the target plane at a radius.

    Args:
        g: (GOAL,) goal of the episode.
        r: radius, scalar [m].

    Returns:
        height, scalar [m].

    Source: this module.
    """
    return g[PLANE] + math.tan(g[TILT]) * (r - MIDDLE)


@compiled
def profile_error(g, surface, first, last):
    """Return the mean and RMS height of the ground above the target plane in a range of cells.

    Args:
        g: (GOAL,) goal of the episode.
        surface: (CELLS,) heights [m].
        first: index of the first cell, scalar [1].
        last: index after the last cell, scalar [1].

    Returns:
        (mean, root mean square), scalars [m].

    Source: this module.
    """
    total, square = 0.0, 0.0
    for i in range(first, last):
        over = surface[i] - plane_height(g, START + (i + 0.5) * CELL)
        total += over
        square += over * over
    return total / (last - first), math.sqrt(square / (last - first))


@compiled
def _heap(surface, middle, half, height):
    """Add a mound with a raised-cosine shape to the surface."""
    for i in range(len(surface)):
        place = (START + (i + 0.5) * CELL - middle) / half
        if abs(place) < 1.0:
            surface[i] += 0.5 * height * (1.0 + math.cos(math.pi * place))


@compiled
def begin_grade(f, e, w):
    """Draw the soil, the ground with two mounds, and the target plane.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World; `terrain` and the first `measures` are written.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    soils = int(f.parameters[len(f.parameters) - 1])
    soil = int(uniform(e) * soils)
    g[SOIL] = soil
    lay_bed(f, w, soil)
    ground = uniform_between(e, _LEVEL[0], _LEVEL[1])
    g[TILT] = uniform_between(e, -_SLOPE, _SLOPE)
    g[PLANE] = ground
    surface = surface_of(w)
    for i in range(CELLS):
        surface[i] = plane_height(g, START + (i + 0.5) * CELL)
    g[PLANE] = ground - uniform_between(e, _DOWN[0], _DOWN[1])
    half = uniform_between(e, _LONG[0], _LONG[1])
    _heap(
        surface,
        uniform_between(e, NEAR + 0.3, FAR - 0.3),
        half,
        uniform_between(e, _HIGH[0], _HIGH[1]),
    )
    half = uniform_between(e, _LONG[0], _LONG[1])
    _heap(surface, uniform_between(e, NEAR, FAR), half, uniform_between(e, _LOW[0], _LOW[1]))
    g[ERROR], g[HELD] = profile_error(g, surface, FIRST, LAST)[1], 0.0
    w.measures[0], w.measures[3] = g[ERROR], g[SOIL]


@compiled
def observe_grade(f, e, w, out, at):
    """Write the profile errors, the height of the edge above the ground, the mass and the plane.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World.
        out: (observations,) float32, written from index `at` on.
        at: scalar.

    Returns:
        Nothing.

    Source: `grade_fields`; the position of the edge follows from the measured joint angles.
    """
    g, surface = e.goal, surface_of(w)
    pose = np.empty(ARM)
    task_forward(f.arm, e.joint[: f.arm_axes], pose)
    scan, scales = (SCANNER, SCALES) if f.noisy else (0.0, 0.0)
    for p in range(POINTS):
        first = FIRST + p * _EACH
        mean = profile_error(g, surface, first, first + _EACH)[0]
        out[at + p] = mean + (uniform_between(e, -scan, scan) if f.noisy else 0.0)
    height = surface_height(soil_of(w), surface, pose[0])
    out[at + POINTS] = pose[2] - height - (uniform_between(e, -scan, scan) if f.noisy else 0.0)
    load = result_of(w)[MASS]
    out[at + POINTS + 1] = load + (uniform_between(e, -scales, scales) if f.noisy else 0.0)
    out[at + POINTS + 2] = g[PLANE]
    out[at + POINTS + 3] = g[TILT]


@compiled
def reward_grade(f, e, w):
    """Compute the reward from the decrease of the profile error, minus a time cost.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World; `measures` receives the RMS error [m], mass carried [kg], soil force [N], index of
            the soil, and, as 0 or 1, whether the ground is graded and whether it was spoiled.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: this module.
    """
    g, out = e.goal, result_of(w)
    dt = f.ticks * f.period
    error = profile_error(g, surface_of(w), FIRST, LAST)[1]
    reward = (g[ERROR] - error) / SCALE - TIME_COST * dt
    g[ERROR] = error
    g[HELD] = g[HELD] + dt if error < GRADED else 0.0
    graded = g[HELD] >= HOLD - 0.5 * dt
    spoiled = w.tip[2] < plane_height(g, math.hypot(w.tip[0], w.tip[1])) - DEEPEST
    w.measures[0] = error
    w.measures[1] = out[MASS]
    w.measures[2] = math.hypot(out[FORCE_R], out[FORCE_Z])
    w.measures[3] = g[SOIL]
    w.measures[4] = 1.0 if graded else 0.0
    w.measures[5] = 1.0 if spoiled else 0.0
    if spoiled:
        return reward + FAILURE, True
    return (reward + SUCCESS, True) if graded else (reward, False)


GRADE_SOILS = ("soft", "sandy_loam", "firm")
"""Names of the soils, in the order of their indices."""

_LEAST_POSE = (5.6, -0.5, 1.25, math.radians(-110.0))  # r [m], theta [rad], z [m], attitude [rad]
_LARGEST_POSE = (6.4, 0.5, 1.5, math.radians(-90.0))


def _start(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Draw a start with the bucket above the far end of the ground, ready to dig."""
    return draw_start(machine, rng, _LEAST_POSE, _LARGEST_POSE)


def _parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Return the parameters of the bed of soil; the last one is the number of soils."""
    bed = bed_parameters([SOILS[name] for name in GRADE_SOILS]).tolist()
    return (*bed, *[0.0] * (PARAMETERS - 1 - len(bed)), float(len(GRADE_SOILS)))


GRADE = Task(
    name="Grade",
    kind="grade",
    sentence=(
        "An excavator cuts a low bank of soft, loamy or firm soil down to a plane of given height"
        " and slope, 3.8 to 5.8 m in front of it, and carries the soil away. The swing is locked;"
        " its action has no effect."
    ),
    reward=(
        "The reward is 1 for every 0.01 m by which the RMS error of the profile decreases, minus"
        " 0.05 per second. An error below 0.03 m for 1 s ends the episode with a reward of 5; an"
        " edge 0.5 m below the plane ends it with -5."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=60.0,
    start=_start,
    fields=grade_fields,
    measures=(
        ("profile_rms", "m"), ("carried_mass", "kg"), ("soil_force", "N"), ("soil", "1"),
        ("success", "1"), ("spoiled", "1"),
    ),
    parameters=_parameters,
    terrain=TERRAIN,
    pose_rates=(0.5, 0.3, 0.4, 0.5, 0.25),
    swing_locked=True,
)  # fmt: skip
"""Grade the ground to a plane."""


@callback(TASK_CODE)
def code(part, m, d, number, argument, out):
    """Run one part of the task in native code; see `world`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_grade(f, e, w)
    elif part == TICK:
        tick_bed(f, e, w)
    elif part == OBSERVE:
        observe_grade(f, e, w, observed(f, out), 0)
    elif part == REWARD:
        return rewarded(e, reward_grade(f, e, w))
    return 0.0

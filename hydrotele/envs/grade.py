"""Grading: a low bank of soil with mounds is cut down to a plane, and the soil carried away.

What `Grade` is.

The bed of soil under a bucket: kept in an episode's terrain, its force on the simulation.

`World.terrain` holds everything that one episode's soil remembers, in slices: the profile, the
bucket's state, what the last step gave, and the numbers of the soil itself, which episodes may
have different ones of. The profile lies in the vertical plane of the arm and turns with it.
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

START, CELL, CELLS = 2.5, 0.05, 140  # m, m: the profile reaches to 9.5 m
SOILS_MOST = 3
_SHARED = OUTLINE + 2 * len(CAT215.outline)  # numbers of soil, bucket and profile
_LOOSE = CELLS  # places in the terrain
_BUCKET = _LOOSE + CELLS
_RESULT = _BUCKET + STATE
_SOIL = _RESULT + OUT
TERRAIN = _SOIL + _SHARED


def bed_parameters(soils: Sequence[Soil], bucket: Bucket = CAT215) -> np.ndarray:
    """Numbers of a task with a bed of soil.

    Args:
        soils: that episodes may have.
        bucket: that digs.

    Returns:
        (at most PARAMETERS,) those of the first soil with bucket and profile, then what differs.

    Raises:
        InputError: there are no soils or more than three, or the bucket has other corners.
    """
    rows = [soil_parameters(soil, bucket, START, CELL) for soil in soils]
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
        f: record of TASK_PARAMETERS; its parameters are those of `bed_parameters`.
        w: World; `terrain` is written.
        soil: number of the soil, scalar [1].

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
    """Speeds of the bucket's edge, outwards and up, by the nominal arm.

    Only the damping of the soil's springs reads them, for which a variant's arm, some centimetres
    longer, is the same.

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
    """Move soil and bucket on by one control period; the force acts in the next one.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World after a physics step; `terrain` and the tip's body in `xfrc` are written.

    Returns:
        Nothing.

    Source: `soil.step.soil_step`, `bucket_wrench`; places are MuJoCo's own, so that every
        variant's geometry is exact.
    """
    body = f.tip_body
    theta = math.atan2(w.tip[1], w.tip[0])
    c, s = math.cos(theta), math.sin(theta)
    ahead = w.xmat[9 * body : 9 * body + 9]  # its first column points from the pin to the edge
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
POINTS = 20  # means of the profile that are observed
MIDDLE = 0.5 * (NEAR + FAR)  # m, where the height of the plane is told
GRADED = 0.03  # m of error that counts as graded
HOLD = 1.0  # s for which it must
DEEPEST = 0.5  # m below the plane, at which the episode has failed
SCALE = 0.01  # m of error less that pays 1
TIME_COST = 0.05  # per s
SUCCESS, FAILURE = 5.0, -5.0  # rewards at the end
SCANNER = 0.01  # m, largest error of a mean of the profile as read, assumed
SCALES = 30.0  # kg, of the mass carried as read, assumed
_LEVEL = (0.15, 0.45)  # m, heights of the ground over what the machine stands on
_SLOPE = 0.06  # rad
_DOWN = (0.02, 0.08)  # m from the ground to the plane
_HIGH, _LOW = (0.12, 0.30), (0.0, 0.10)  # m, heights of two mounds
_LONG = (0.7, 1.3)  # m, half their lengths
_MOST = 4000.0  # kg
PLANE, TILT, ERROR, HELD, SOIL = range(5)  # places in the goal
FIRST, LAST = round((NEAR - START) / CELL), round((FAR - START) / CELL)  # cells
_EACH = (LAST - FIRST) // POINTS  # cells of a point
assert 0 <= FIRST < LAST <= CELLS and _EACH * POINTS == LAST - FIRST


def grade_radii() -> list[float]:
    """Radii of the middles of the parts whose means are observed [m]."""
    return [NEAR + (FAR - NEAR) * (p + 0.5) / POINTS for p in range(POINTS)]


def grade_fields(machine: Machine, axes: tuple[str, ...]) -> list[Field]:
    """What `observe_grade` writes: errors of the profile, the edge over it, load, plane."""
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
    """Height that the ground shall have at a radius.

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
    """Mean and root mean square of the ground's height over the plane in some cells.

    Args:
        g: (GOAL,) goal of the episode.
        surface: (CELLS,) heights [m].
        first: cell, scalar [1].
        last: the cell after the last one, scalar [1].

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
    """Add a mound in the form of a raised cosine."""
    for i in range(len(surface)):
        place = (START + (i + 0.5) * CELL - middle) / half
        if abs(place) < 1.0:
            surface[i] += 0.5 * height * (1.0 + math.cos(math.pi * place))


@compiled
def begin_grade(f, e, w):
    """Draw the soil, the ground and the plane.

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
    """Write errors of the profile, the edge over it, the mass carried and the plane.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World.
        out: (observations,) float32, written from `at` on.
        at: scalar.

    Returns:
        Nothing.

    Source: `grade_fields`; the edge is where the sensors say.
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
    """Pay every centimetre that the ground comes nearer to the plane; time costs.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World; `measures` gets the error [m], mass carried [kg], force of the soil [N], number
            of the soil, whether the ground is graded, whether it was spoiled.

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
"""Names of the soils that episodes have, in the order of their numbers."""

_LEAST_POSE = (5.6, -0.5, 1.25, math.radians(-110.0))  # r [m], theta [rad], z [m], attitude [rad]
_LARGEST_POSE = (6.4, 0.5, 1.5, math.radians(-90.0))


def _start(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """The bucket over the far end of the stretch, ready to dig, above the highest ground."""
    return draw_start(machine, rng, _LEAST_POSE, _LARGEST_POSE)


def _parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Soils, bucket and profile; the last one is the number of soils."""
    bed = bed_parameters([SOILS[name] for name in GRADE_SOILS]).tolist()
    return (*bed, *[0.0] * (PARAMETERS - 1 - len(bed)), float(len(GRADE_SOILS)))


GRADE = Task(
    name="Grade",
    kind="grade",
    sentence=(
        "An excavator's bucket cuts a low bank of soft, loamy or firm soil down to a plane of given"
        " height and slope, 3.8 to 5.8 m before it, and carries the soil away; the swing is"
        " locked, its action does nothing."
    ),
    reward=(
        "1 for every 0.01 m by which the root mean square error of the profile shrinks, less 0.05"
        " per second; 5 for an error below 0.03 m for a second, -5 for the edge 0.5 m below the"
        " plane, and both end the episode."
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
"""Ground graded to a plane."""


@callback(TASK_CODE)
def code(part, m, d, number, argument, out):
    """The task in native code, see `world`."""
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

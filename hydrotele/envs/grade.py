"""The task `Grade`: cut a low bank of soil with mounds down to a plane and carry the soil away."""

import math

import mujoco
import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import MAX_ARM_AXES, MAX_PARAMETERS, arm_values, draw_uniform, draw_uniform_between
from hydrotele.envs.observation import ObservationField, max_reach
from hydrotele.envs.soil_bed import (
    CELL_COUNT,
    CELL_LENGTH,
    MAX_SOILS,
    PROFILE_START,
    SOIL_PARAMETER_COUNT,
    TERRAIN_SIZE,
    init_soil_bed,
    pack_soil_bed_parameters,
    soil_parameters_view,
    soil_result_view,
    soil_surface_view,
    step_soil_bed,
)
from hydrotele.envs.task import Task, sample_start_positions
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    POTENTIAL,
    REWARD,
    TASK_SIGNATURE,
    TICK,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.simulate.soil_bed import machine_bucket
from hydrotele.soil.parameters import (
    FORCE_R,
    FORCE_Z,
    MASS,
    SOILS,
    WIDTH,
)
from hydrotele.soil.terrain import surface_height

assert SOIL_PARAMETER_COUNT + (MAX_SOILS - 1) * WIDTH <= MAX_PARAMETERS


MIN_RADIUS, MAX_RADIUS = 3.8, 5.8  # m, radii between which the ground is graded
SECTION_COUNT = 20  # number of profile sections whose mean is observed
MEAN_RADIUS = 0.5 * (MIN_RADIUS + MAX_RADIUS)  # m, radius at which the height of the plane is given
MAX_GRADED_ERROR = 0.03  # m, maximum RMS error of graded ground
HOLD_TIME = 1.0  # s for which the error must stay below it
FAILURE_DEPTH = 0.5  # m below the plane at which the episode fails
ERROR_PER_REWARD = 0.01  # m of error reduction for a reward of 1
TIME_COST = 0.05  # reward per s
SUCCESS_REWARD, FAILURE_REWARD = 5.0, -5.0  # rewards at the end
MAX_SCANNER_ERROR = 0.01  # m, maximum error of a measured section mean, assumed
MAX_MASS_ERROR = 30.0  # kg, maximum error of the measured mass carried, assumed
_GROUND_HEIGHTS = (0.15, 0.45)  # m, height of the ground above the machine's tracks
_MAX_SLOPE = 0.06  # rad, maximum slope of the plane
_PLANE_DEPTHS = (0.02, 0.08)  # m, depth of the plane below the ground
_HIGH_MOUND_HEIGHTS, _LOW_MOUND_HEIGHTS = (0.12, 0.30), (0.0, 0.10)  # m, heights of two mounds
_MOUND_HALF_LENGTHS = (0.7, 1.3)  # m, half lengths of the mounds
_MAX_MASS = 4000.0  # kg, upper bound of the observed mass carried
PLANE_HEIGHT, PLANE_SLOPE, LAST_ERROR, TIME_HELD, SOIL_INDEX = range(5)  # indices in `goal`
FIRST_CELL, END_CELL = (
    round((MIN_RADIUS - PROFILE_START) / CELL_LENGTH),
    round((MAX_RADIUS - PROFILE_START) / CELL_LENGTH),
)  # cells
_CELLS_PER_SECTION = (END_CELL - FIRST_CELL) // SECTION_COUNT  # cells per section
assert 0 <= FIRST_CELL < END_CELL <= CELL_COUNT and _CELLS_PER_SECTION * SECTION_COUNT == END_CELL - FIRST_CELL


def profile_section_radii() -> list[float]:
    """Return the centre radii of the profile sections whose means are observed [m]."""
    return [MIN_RADIUS + (MAX_RADIUS - MIN_RADIUS) * (p + 0.5) / SECTION_COUNT for p in range(SECTION_COUNT)]


def list_grade_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_grade_observation` writes.

    They are the mean height of the ground above the target plane in each profile section, the
    height of the bucket's edge above the ground, the mass carried, and height and slope of the
    plane.
    """
    far = max_reach(machine)
    fields = [ObservationField(f"profile_error.{p}", "m", -1.0, 2.0) for p in range(SECTION_COUNT)]
    return [
        *fields,
        ObservationField("edge_height", "m", -2.0, far),
        ObservationField("carried_mass", "kg", -MAX_MASS_ERROR, _MAX_MASS),
        ObservationField("plane_height", "m", -1.0, 1.0),
        ObservationField("plane_slope", "rad", -0.1, 0.1),
    ]


@compiled
def target_plane_height(g, r):
    """Return the height of the target plane above the level of the tracks, at a radius from the swing axis.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        r: radius, scalar [m].

    Returns:
        height, scalar [m].

    Source: this module.
    """
    return g[PLANE_HEIGHT] + math.tan(g[PLANE_SLOPE]) * (r - MEAN_RADIUS)


@compiled
def compute_profile_error(g, surface, first, last):
    """Return the mean and RMS height of the ground above the target plane in a range of cells.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        surface: (CELL_COUNT,) heights of the ground [m].
        first: index of the first cell, scalar [1].
        last: index after the last cell, scalar [1].

    Returns:
        (mean, root mean square), scalars [m].

    Source: this module.
    """
    total, square = 0.0, 0.0
    for i in range(first, last):
        over = surface[i] - target_plane_height(g, PROFILE_START + (i + 0.5) * CELL_LENGTH)
        total += over
        square += over * over
    return total / (last - first), math.sqrt(square / (last - first))


@compiled
def _add_mound(surface, middle, half, height):
    """Add a raised-cosine mound, `half` on either side of the radius `middle`, to the surface heights [m]."""
    for i in range(len(surface)):
        place = (PROFILE_START + (i + 0.5) * CELL_LENGTH - middle) / half
        if abs(place) < 1.0:
            surface[i] += 0.5 * height * (1.0 + math.cos(math.pi * place))


@compiled
def draw_grade_episode(f, e, w):
    """Draw the goal and terrain of an episode: kind of soil, ground with two mounds, and target plane below it.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; soil index, target plane and RMS error of the profile are
            written to `goal`.
        w: SimulationView; `terrain` and, in `measures`, RMS error and soil index are written.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    soils = int(f.parameters[len(f.parameters) - 1])
    soil = int(draw_uniform(e) * soils)
    g[SOIL_INDEX] = soil
    init_soil_bed(f, w, soil)
    ground = draw_uniform_between(e, _GROUND_HEIGHTS[0], _GROUND_HEIGHTS[1])
    g[PLANE_SLOPE] = draw_uniform_between(e, -_MAX_SLOPE, _MAX_SLOPE)
    g[PLANE_HEIGHT] = ground
    surface = soil_surface_view(w)
    for i in range(CELL_COUNT):
        surface[i] = target_plane_height(g, PROFILE_START + (i + 0.5) * CELL_LENGTH)
    g[PLANE_HEIGHT] = ground - draw_uniform_between(e, _PLANE_DEPTHS[0], _PLANE_DEPTHS[1])
    half = draw_uniform_between(e, _MOUND_HALF_LENGTHS[0], _MOUND_HALF_LENGTHS[1])
    _add_mound(
        surface,
        draw_uniform_between(e, MIN_RADIUS + 0.3, MAX_RADIUS - 0.3),
        half,
        draw_uniform_between(e, _HIGH_MOUND_HEIGHTS[0], _HIGH_MOUND_HEIGHTS[1]),
    )
    half = draw_uniform_between(e, _MOUND_HALF_LENGTHS[0], _MOUND_HALF_LENGTHS[1])
    _add_mound(
        surface,
        draw_uniform_between(e, MIN_RADIUS, MAX_RADIUS),
        half,
        draw_uniform_between(e, _LOW_MOUND_HEIGHTS[0], _LOW_MOUND_HEIGHTS[1]),
    )
    g[LAST_ERROR], g[TIME_HELD] = compute_profile_error(g, surface, FIRST_CELL, END_CELL)[1], 0.0
    w.measures[0], w.measures[3] = g[LAST_ERROR], g[SOIL_INDEX]


@compiled
def write_grade_observation(f, e, w, out, at):
    """Write profile errors, height of the edge above ground, mass carried and target plane to the observation.

    The profile errors are the mean heights of the ground above the plane, per section. If the
    sensors have random errors, uniform errors are added to all these values but the plane.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `random` is advanced if errors are drawn.
        w: SimulationView.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_grade_observation_fields`; the position of the edge follows from the measured joint angles.
    """
    g, surface = e.goal, soil_surface_view(w)
    pose = np.empty(MAX_ARM_AXES)
    compute_tip_pose(f.arm, arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)
    scan, scales = (MAX_SCANNER_ERROR, MAX_MASS_ERROR) if f.noisy else (0.0, 0.0)
    for p in range(SECTION_COUNT):
        first = FIRST_CELL + p * _CELLS_PER_SECTION
        mean = compute_profile_error(g, surface, first, first + _CELLS_PER_SECTION)[0]
        out[at + p] = mean + (draw_uniform_between(e, -scan, scan) if f.noisy else 0.0)
    height = surface_height(soil_parameters_view(w), surface, pose[0])
    out[at + SECTION_COUNT] = pose[2] - height - (draw_uniform_between(e, -scan, scan) if f.noisy else 0.0)
    load = soil_result_view(w)[MASS]
    out[at + SECTION_COUNT + 1] = load + (draw_uniform_between(e, -scales, scales) if f.noisy else 0.0)
    out[at + SECTION_COUNT + 2] = g[PLANE_HEIGHT]
    out[at + SECTION_COUNT + 3] = g[PLANE_SLOPE]


@compiled
def compute_grade_reward(f, e, w):
    """Compute the reward of a step: 1 per 0.01 m by which the RMS profile error decreases, minus 0.05 per second.

    An error below MAX_GRADED_ERROR for HOLD_TIME adds 5 and ends the episode (success). An edge
    more than FAILURE_DEPTH below the target plane adds -5 and ends it (spoiled).

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` receives the RMS error [m] and the time for which it has
            been below MAX_GRADED_ERROR [s].
        w: SimulationView; `measures` receives the RMS error [m], mass carried [kg], soil force [N] and index
            of the soil, then success and spoiled as 0 or 1.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: this module.
    """
    g, out = e.goal, soil_result_view(w)
    dt = f.ticks * f.period
    error = compute_profile_error(g, soil_surface_view(w), FIRST_CELL, END_CELL)[1]
    reward = (g[LAST_ERROR] - error) / ERROR_PER_REWARD - TIME_COST * dt
    g[LAST_ERROR] = error
    g[TIME_HELD] = g[TIME_HELD] + dt if error < MAX_GRADED_ERROR else 0.0
    graded = g[TIME_HELD] >= HOLD_TIME - 0.5 * dt
    spoiled = w.tip[2] < target_plane_height(g, math.hypot(w.tip[0], w.tip[1])) - FAILURE_DEPTH
    w.measures[0] = error
    w.measures[1] = out[MASS]
    w.measures[2] = math.hypot(out[FORCE_R], out[FORCE_Z])
    w.measures[3] = g[SOIL_INDEX]
    w.measures[4] = 1.0 if graded else 0.0
    w.measures[5] = 1.0 if spoiled else 0.0
    if spoiled:
        return reward + FAILURE_REWARD, True
    return (reward + SUCCESS_REWARD, True) if graded else (reward, False)


@compiled
def compute_grade_potential(f, e, w):
    """Return the potential of the bucket's position: the success reward, discounted until the edge reaches the soil.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView.

    Returns:
        The potential, scalar: 5 gamma^n. In n steps, radius and height of the edge reach the point of the graded
        ground that is highest above the plane, one after the other at the rates of full actions.

    Source: this module.
    """
    surface, highest, best = soil_surface_view(w), FIRST_CELL, -np.inf
    for i in range(FIRST_CELL, END_CELL):
        over = surface[i] - target_plane_height(e.goal, PROFILE_START + (i + 0.5) * CELL_LENGTH)
        if over > best:
            highest, best = i, over
    radius = PROFILE_START + (highest + 0.5) * CELL_LENGTH
    time = abs(math.hypot(e.tip[0], e.tip[1]) - radius) / f.fastest_pose[0]
    time += abs(e.tip[2] - surface[highest]) / f.fastest_pose[2]
    return SUCCESS_REWARD * f.shaping ** (time / (f.ticks * f.period))


GRADE_SOILS = ("soft", "sandy_loam", "firm")
"""Names of the soils, in the order of their indices."""

_MIN_START_POSE = (
    5.6,
    -0.5,
    1.25,
    math.radians(-110.0),
)  # r [m], theta [rad], z [m], attitude [rad]
_MAX_START_POSE = (6.4, 0.5, 1.5, math.radians(-90.0))


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, arm axis -> [rad], with the bucket above the far end of the ground."""
    return sample_start_positions(machine, rng, _MIN_START_POSE, _MAX_START_POSE)


def _make_soil_bed_parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Return the MAX_PARAMETERS task parameters: bucket, profile and soils, and last the number of soils.

    Unused values between them are 0.
    """
    bed = pack_soil_bed_parameters([SOILS[name] for name in GRADE_SOILS], machine_bucket(machine)).tolist()
    return (*bed, *[0.0] * (MAX_PARAMETERS - 1 - len(bed)), float(len(GRADE_SOILS)))


GRADE = Task(
    name="Grade",
    kind="grade",
    needs=("swing", "boom", "stick", "tool"),
    description=(
        "An excavator cuts a low bank of soft, loamy or firm soil down to a plane of given height"
        " and slope and carries the soil away. The plane lies 3.8 to 5.8 m in front of it. The swing"
        " is locked; its action has no effect."
    ),
    reward=(
        "The reward is 1 for every 0.01 m by which the RMS error of the ground profile decreases, minus"
        " 0.05 per second. An error below 0.03 m for 1 s ends the episode with an additional reward of 5 (success);"
        " a bucket edge 0.5 m below the plane ends it with -5 (spoiled)."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=60.0,
    start=_sample_start_positions,
    fields=list_grade_observation_fields,
    measures=(
        ("profile_rms", "m"), ("carried_mass", "kg"), ("soil_force", "N"), ("soil", "1"),
        ("success", "1"), ("spoiled", "1"),
    ),
    parameters=_make_soil_bed_parameters,
    terrain_size=TERRAIN_SIZE,
    pose_rates=(0.5, 0.3, 0.4, 0.5, 0.25),
    swing_locked=True,
)  # fmt: skip
"""Grade the ground to a plane."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `Grade` for the simulation `number`, in native code.

    `part` is BEGIN (draw soil and target plane of a new episode), TICK (advance the soil by a
    control period), OBSERVE (write the task's values to the observation, from the address `out`
    on), REWARD (return the reward and store whether the episode ends) or POTENTIAL (return the
    potential). `m`, `d` and `argument` are the addresses of mjModel, mjData and TASK_PARAMETERS. The
    result is 0 for the other parts; see `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_grade_episode(f, e, w)
    elif part == TICK:
        step_soil_bed(f, e, w)
    elif part == OBSERVE:
        write_grade_observation(f, e, w, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_grade_reward(f, e, w))
    elif part == POTENTIAL:
        return compute_grade_potential(f, e, w)
    return 0.0

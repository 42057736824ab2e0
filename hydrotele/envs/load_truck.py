"""The task `LoadTruck`: dig soil from a bank, swing, dump it into the bed of a truck, and return.

The bank is a strip of soil as wide as the bucket, at an azimuth that is drawn for every episode.
The truck stands to the left of the machine. Next to the strip the ground has the undisturbed height
of the bank; it only resists a bucket that swings sideways through it.
"""

import dataclasses
import math

import mujoco
import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.core.memory import float64_view, struct_field_view
from hydrotele.envs.episode import MAX_ARM_AXES, MAX_PARAMETERS, arm_values, draw_uniform, draw_uniform_between
from hydrotele.envs.observation import ObservationField, max_reach
from hydrotele.envs.soil_bed import (
    CELL_COUNT,
    CELL_LENGTH,
    MAX_SOILS,
    PROFILE_START,
    SOIL_PARAMETER_COUNT,
    TERRAIN_SIZE,
    bucket_state_view,
    init_soil_bed,
    loose_thickness_view,
    pack_soil_bed_parameters,
    soil_parameters_view,
    soil_result_view,
    soil_surface_view,
    step_soil_bed,
)
from hydrotele.envs.task import Task, sample_start_positions, wrap_angle
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_SIGNATURE,
    TICK,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.envs.truck_bed import (
    LOAD_CELL_COUNT,
    RAIL_HEIGHT,
    TRUCK,
    drop_into_bed,
    level_load,
    loaded_volume,
    position_in_bed,
    release_soil_in_air,
)
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, Slot
from hydrotele.hydraulics.supply import FEED, SCRATCH_SIZE, solve_state_supplies
from hydrotele.hydraulics.valve import inlet_flow
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.soil.parameters import (
    CARRIED_VOLUME,
    COHESION,
    DENSITY,
    FRICTION,
    GRAVITY,
    HEEL_X,
    HEEL_Z,
    LOST_VOLUME,
    MASS,
    SOILS,
    SWELL,
    WIDTH,
)
from hydrotele.soil.step import compute_bucket_wrench, update_elastic_plastic_force
from hydrotele.soil.terrain import surface_height

PHASES = ("cycle", "dig", "haul", "dump", "return")
CYCLE, DIG, HAUL, DUMP, RETURN = range(5)
"""Indices of the phases. An episode of `cycle` consists of repeated cycles, any other of one phase."""

FIRST_RADIUS, LAST_RADIUS = 4.5, 8.5  # m, radii between which the profile of the bank is observed
SECTION_COUNT = 20  # number of profile sections whose mean height is observed
LOAD_SECTION_COUNT = 10  # number of sections of the load whose mean height is observed
FULL_LOAD = 5.0  # m^3, loose volume that fills the truck
FULL_BUCKET = 0.45  # m^3, loose volume that counts as a full bucket
DIG_RADIUS, DIG_HEIGHT = 6.6, 0.5  # m, radius, and height above the bank, of the place where digging starts
VOLUME_REWARD = 10.0  # reward per m^3 in the truck
SPILL_COST = 10.0  # per m^3
ENERGY_COST = 1.0e-6  # per J
TIME_COST = 0.1  # per s
CONTACT_COST = 1.0e-4  # per N s of the force on the truck
DUG_VALUE, HAULED_VALUE = 0.3, 0.4  # of the reward per m^3: for soil in the bucket, and above the truck
RETURN_VALUE = 2.0  # potential of an empty bucket at the bank, relative to one far away
VALUE_DISTANCE = 9.0  # m, distance over which these values grow
MAX_TRUCK_FORCE = 1.0e5  # N, force on the truck that ends the episode
SUCCESS_REWARD, DAMAGE_REWARD = 10.0, -20.0  # rewards at the end
MIN_CLEARANCE = 0.3  # m above the bank of a bucket that has finished digging
EMPTY_VOLUME = 0.02  # m^3, volume below which a bucket counts as empty
MAX_RETURN_DISTANCE = 0.8  # m from the place where digging starts
MIN_KEPT_SHARE = 0.8  # share of the load of the bucket that must reach truck or bed
MAX_SCANNER_ERROR, MAX_MASS_ERROR = 0.01, 30.0  # m, kg, maximum errors of measured heights and mass, assumed
_MAX_MASS = 4000.0  # kg, upper bound of the observed mass carried
_AZIMUTHS = (-0.35, 0.35)  # rad, azimuth of the bank
_BANK_HEIGHTS, _BANK_FEET = (0.5, 1.0), (3.6, 4.2)  # m, height of the bank, radius of its foot
_BANK_SLOPE = 1.2  # of its face: 50 deg
BANK_HALF_ANGLE = 0.6  # rad, half width of the bank as seen from the swing axis
_DUG_DEPTHS, _DUG_HALF_LENGTH, _DUG_RADII = (0.0, 0.8), 1.2, (5.8, 7.0)  # m, previous trench of single phases
_CARRIED_VOLUMES = (0.5, 0.8)  # m^3 carried at the start of the phases haul and dump
_BUCKET_LENGTH = 1.2  # m, length of the side of the bucket on which the ground pushes
_SECTION_CELLS = round((LAST_RADIUS - FIRST_RADIUS) / CELL_LENGTH) // SECTION_COUNT
_FIRST_CELL = round((FIRST_RADIUS - PROFILE_START) / CELL_LENGTH)
_LOAD_SECTION_CELLS = LOAD_CELL_COUNT // LOAD_SECTION_COUNT
LOAD_TERRAIN_SIZE = TERRAIN_SIZE + LOAD_CELL_COUNT
_TOUCH, _PHASE, _SOIL_COUNT = MAX_PARAMETERS - 3, MAX_PARAMETERS - 2, MAX_PARAMETERS - 1  # in `parameters`
assert SOIL_PARAMETER_COUNT + (MAX_SOILS - 1) * WIDTH <= _TOUCH
(
    BANK_AZIMUTH, BANK_HEIGHT, BANK_FOOT, SIDE_DEFLECTION, LAST_SIDE, ENERGY, SPILLED, START_SOIL, START_CARRIED,
    CONTACT_IMPULSE, MAX_FORCE, POTENTIAL, LOADS, LAST_LOADED, LAST_SPILLED, LAST_ENERGY, WAS_FULL,
) = range(17)  # fmt: skip
"""Indices in `goal`."""
TRUCK_X, TRUCK_Y = TRUCK.position
TRUCK_LENGTH, TRUCK_WIDTH = TRUCK.length, TRUCK.width
_SMOOTHING = int(Slot.ORIFICE_SMOOTHING)


def list_load_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_load_observation` writes.

    They are the direction to the bank and to the truck as seen from the bucket's edge, the mean
    height of the bank in each section, the height of the edge above the bank, the mass carried, and
    the mean height of the load in each section of the truck's bed.
    """
    far = max_reach(machine)
    return [
        ObservationField("bank_bearing", "rad", -math.pi, math.pi),
        ObservationField("truck_bearing", "rad", -math.pi, math.pi),
        *(ObservationField(f"bank_height.{p}", "m", -5.0, 3.0) for p in range(SECTION_COUNT)),
        ObservationField("edge_height", "m", -5.0, far),
        ObservationField("carried_mass", "kg", -MAX_MASS_ERROR, _MAX_MASS),
        *(ObservationField(f"load_height.{p}", "m", -0.1, 2.0) for p in range(LOAD_SECTION_COUNT)),
    ]


def profile_section_radii() -> np.ndarray:
    """Return the centre radii (SECTION_COUNT,) of the sections of the bank that are observed [m]."""
    return FIRST_RADIUS + (LAST_RADIUS - FIRST_RADIUS) * (np.arange(SECTION_COUNT) + 0.5) / SECTION_COUNT


@compiled
def load_view(w):
    """Return a view (LOAD_CELL_COUNT,) of the heights of the load above the floor of the truck's bed [m]."""
    return w.terrain[TERRAIN_SIZE:LOAD_TERRAIN_SIZE]


@compiled
def undisturbed_height(g, r):
    """Return the height of the undisturbed bank at a radius, scalar [m].

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        r: radius, scalar [m].

    Source: this module.
    """
    return min(g[BANK_HEIGHT], max(0.0, _BANK_SLOPE * (r - g[BANK_FOOT])))


@compiled
def loose_soil_volume(w):
    """Return the volume of the soil in the strip above height 0, as loose soil, scalar [m^3]."""
    n, surface, loose = soil_parameters_view(w), soil_surface_view(w), loose_thickness_view(w)
    total = 0.0
    for i in range(CELL_COUNT):
        total += n[SWELL] * (surface[i] - loose[i]) + loose[i]
    return total * CELL_LENGTH * n[WIDTH]


@compiled
def draw_load_episode(f, e, w):
    """Draw the soil and the bank of an episode; in single phases also a previous trench and the load of the bucket.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: SimulationView; `terrain` is written.

    Returns:
        Nothing.

    Source: this module.
    """
    g, phase = e.goal, int(f.parameters[_PHASE])
    g[:] = 0.0
    init_soil_bed(f, w, int(draw_uniform(e) * int(f.parameters[_SOIL_COUNT])))
    load_view(w)[:] = 0.0
    g[BANK_AZIMUTH] = draw_uniform_between(e, _AZIMUTHS[0], _AZIMUTHS[1])
    g[BANK_HEIGHT] = draw_uniform_between(e, _BANK_HEIGHTS[0], _BANK_HEIGHTS[1])
    g[BANK_FOOT] = draw_uniform_between(e, _BANK_FEET[0], _BANK_FEET[1])
    depth = draw_uniform_between(e, _DUG_DEPTHS[0], _DUG_DEPTHS[1])
    middle = draw_uniform_between(e, _DUG_RADII[0], _DUG_RADII[1])
    carried = draw_uniform_between(e, _CARRIED_VOLUMES[0], _CARRIED_VOLUMES[1])
    surface = soil_surface_view(w)
    for i in range(CELL_COUNT):
        r = PROFILE_START + (i + 0.5) * CELL_LENGTH
        surface[i] = undisturbed_height(g, r)
        place = (r - middle) / _DUG_HALF_LENGTH
        if phase != CYCLE and abs(place) < 1.0:
            surface[i] -= 0.5 * depth * (1.0 + math.cos(math.pi * place))
    if phase == HAUL or phase == DUMP:
        n = soil_parameters_view(w)
        g[START_CARRIED] = bucket_state_view(w)[CARRIED_VOLUME] = carried
        soil_result_view(w)[MASS] = carried / n[SWELL] * n[DENSITY]
    g[START_SOIL] = loose_soil_volume(w)
    g[POTENTIAL] = np.nan  # until the first step: body positions are not known before


@compiled
def _bucket_attitude(f, w, theta):
    """Return the angle of the line from the bucket's pin to its edge above the horizontal, scalar [rad]."""
    ahead = w.xmat[9 * f.tip_body : 9 * f.tip_body + 9]
    return math.atan2(ahead[6], math.cos(theta) * ahead[0] + math.sin(theta) * ahead[3])


@compiled
def _lowest_point(n, r, z, attitude):
    """Return the radius and the height [m] of the lower one of the bucket's edge and heel."""
    c, s = math.cos(attitude), math.sin(attitude)
    heel_z = z + n[HEEL_X] * s + n[HEEL_Z] * c
    return (r + n[HEEL_X] * c - n[HEEL_Z] * s, heel_z) if heel_z < z else (r, z)


@compiled
def _push_from_the_side(f, e, w, theta, attitude):
    """Add the force of the undisturbed ground against the sideways motion of a bucket in it.

    The force is elastic-plastic, at most Rankine's passive pressure on the buried side of the
    bucket, and acts at the edge.
    """
    g, n = e.goal, soil_parameters_view(w)
    r = math.hypot(w.tip[0], w.tip[1])
    bearing = wrap_angle(theta - g[BANK_AZIMUTH])
    side = r * bearing
    shift, g[LAST_SIDE] = side - g[LAST_SIDE], side
    low_r, low = _lowest_point(n, r, w.tip[2], attitude)
    ground = undisturbed_height(g, low_r) if abs(bearing) < BANK_HALF_ANGLE else 0.0
    depth = ground - low
    if depth <= 0.0 or abs(shift) > 0.5:
        g[SIDE_DEFLECTION] = 0.0
        return
    passive = math.tan(0.25 * math.pi + 0.5 * n[FRICTION])
    most = 0.5 * n[DENSITY] * GRAVITY * depth * passive * passive + 2.0 * n[COHESION] * passive
    most *= depth * _BUCKET_LENGTH
    push = -update_elastic_plastic_force(n, g, SIDE_DEFLECTION, shift, shift / f.period, -most, most)
    wrench, centre = w.xfrc[6 * f.tip_body : 6 * f.tip_body + 6], w.xipos[3 * f.tip_body : 3 * f.tip_body + 3]
    fx, fy = -math.sin(theta) * push, math.cos(theta) * push
    x, y, z = w.tip[0] - centre[0], w.tip[1] - centre[1], w.tip[2] - centre[2]
    wrench[0] += fx
    wrench[1] += fy
    wrench[3] -= z * fy
    wrench[4] += z * fx
    wrench[5] += x * fy - y * fx


@compiled
def supplied_power(f, e, w):
    """Return the hydraulic power that the valves take from the pumps, scalar [W].

    It is the sum of the flow into each valve times the pressure of its supply. Flow over the relief
    valve does not count.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView.

    Source: `hydraulics.supply.solve_state_supplies`.
    """
    user = float64_view(f.users + 8 * e.variant * f.axes * SLOT_COUNT, f.axes * SLOT_COUNT)
    scratch, power = np.empty(SCRATCH_SIZE), 0.0
    solve_state_supplies(user, 0, f.hydraulic, w.act, scratch)
    for i in range(f.hydraulic):
        drop = scratch[FEED + i] - scratch[4 * i + 1]
        if scratch[4 * i] > 0.0 and drop > 0.0:
            smoothing = user[i * SLOT_COUNT + _SMOOTHING]
            power += scratch[FEED + i] * inlet_flow(drop, scratch[4 * i], smoothing, scratch[4 * i + 2])[0]
    return power


@compiled
def move_soil(f, e, w):
    """Advance bank, bucket and load of the truck by one control period, and apply the soil's force to the bucket.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; spilled volume, energy and force on the truck are written to
            `goal`.
        w: SimulationView after a physics step; `terrain` and the row of the tip's body in `xfrc` are
            written.

    Returns:
        Nothing.

    Source: `envs.soil_bed`, `envs.truck_bed`. A bucket whose edge is further from the middle of the strip
        than its width is in the air, as in `simulate.soil_bed`.
    """
    g, n, state, load = e.goal, soil_parameters_view(w), bucket_state_view(w), load_view(w)
    theta, r = math.atan2(w.tip[1], w.tip[0]), math.hypot(w.tip[0], w.tip[1])
    attitude = _bucket_attitude(f, w, theta)
    bearing = wrap_angle(theta - g[BANK_AZIMUTH])
    if abs(bearing) < 0.5 * math.pi and abs(r * math.sin(bearing)) <= n[WIDTH]:
        lost = state[LOST_VOLUME]
        step_soil_bed(f, e, w)
        g[SPILLED] += state[LOST_VOLUME] - lost
    else:
        out = soil_result_view(w)
        falls, rim = release_soil_in_air(n, state, attitude, f.period, out)
        if falls > 0.0:
            share = (r + rim) / r
            g[SPILLED] += drop_into_bed(n, load, share * w.tip[0], share * w.tip[1], falls)
        body = f.tip_body
        compute_bucket_wrench(out, w.tip, theta, w.xipos[3 * body : 3 * body + 3], w.xfrc[6 * body : 6 * body + 6])
    g[SPILLED] += level_load(n, load)
    _push_from_the_side(f, e, w, theta, attitude)
    g[ENERGY] += f.period * supplied_power(f, e, w)
    force = struct_field_view(w.data, f.at_sensordata, int(f.parameters[_TOUCH]) + 1)[int(f.parameters[_TOUCH])]
    g[CONTACT_IMPULSE] += f.period * force
    g[MAX_FORCE] = max(g[MAX_FORCE], force)


@compiled
def write_load_observation(f, e, w, out, at):
    """Write the task's values to the observation.

    If the sensors have random errors, uniform errors are added to all heights and to the mass.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `random` is advanced if errors are drawn.
        w: SimulationView.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_load_observation_fields`; the position of the edge follows from the measured joint angles.
    """
    g, surface, load, pose = e.goal, soil_surface_view(w), load_view(w), np.empty(MAX_ARM_AXES)
    compute_tip_pose(f.arm, arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)
    scan, scales = (MAX_SCANNER_ERROR, MAX_MASS_ERROR) if f.noisy else (0.0, 0.0)
    out[at] = wrap_angle(g[BANK_AZIMUTH] - pose[1])
    out[at + 1] = wrap_angle(math.atan2(TRUCK_Y, TRUCK_X) - pose[1])
    at += 2
    for p in range(SECTION_COUNT):
        mean = surface[_FIRST_CELL + p * _SECTION_CELLS : _FIRST_CELL + (p + 1) * _SECTION_CELLS].mean()
        out[at + p] = mean + _draw_error(f, e, scan)
    at += SECTION_COUNT
    out[at] = pose[2] - surface_height(soil_parameters_view(w), surface, pose[0]) + _draw_error(f, e, scan)
    out[at + 1] = soil_result_view(w)[MASS] + _draw_error(f, e, scales)
    at += 2
    for p in range(LOAD_SECTION_COUNT):
        mean = load[p * _LOAD_SECTION_CELLS : (p + 1) * _LOAD_SECTION_CELLS].mean()
        out[at + p] = mean + _draw_error(f, e, scan)


@compiled
def _draw_error(f, e, bound):
    return draw_uniform_between(e, -bound, bound) if f.noisy else 0.0


@compiled
def _distance_to_dig(g, w, surface):
    """Return the distance of the bucket's edge from the place above the bank where digging starts, scalar [m]."""
    x, y = DIG_RADIUS * math.cos(g[BANK_AZIMUTH]), DIG_RADIUS * math.sin(g[BANK_AZIMUTH])
    height = surface[int((DIG_RADIUS - PROFILE_START) / CELL_LENGTH)] + DIG_HEIGHT
    return math.sqrt((w.tip[0] - x) ** 2 + (w.tip[1] - y) ** 2 + (w.tip[2] - height) ** 2)


@compiled
def _potential(g, w, surface, carried):
    """Return the potential of the state: value of the soil in the bucket, or of an empty bucket near the bank."""
    x, y, z = w.tip[0] - TRUCK_X, w.tip[1] - TRUCK_Y, w.tip[2] - RAIL_HEIGHT - 1.0
    hauled = 1.0 - min(1.0, math.sqrt(x * x + y * y + z * z) / VALUE_DISTANCE)
    away = min(1.0, _distance_to_dig(g, w, surface) / VALUE_DISTANCE)
    free = 1.0 - min(1.0, carried / FULL_BUCKET)
    return VOLUME_REWARD * carried * (DUG_VALUE + HAULED_VALUE * hauled) - RETURN_VALUE * free * away


@compiled
def _is_phase_done(f, e, w, carried, loaded):
    """Return (whether the phase of the episode is over, whether it succeeded)."""
    g, n, surface, phase = e.goal, soil_parameters_view(w), soil_surface_view(w), int(f.parameters[_PHASE])
    if phase == CYCLE:
        return loaded >= FULL_LOAD, loaded >= FULL_LOAD
    theta, r = math.atan2(w.tip[1], w.tip[0]), math.hypot(w.tip[0], w.tip[1])
    low_r, low = _lowest_point(n, r, w.tip[2], _bucket_attitude(f, w, theta))
    if phase == DIG:
        ground = max(surface_height(n, surface, r), surface_height(n, surface, low_r))
        done = carried >= FULL_BUCKET and low > ground + MIN_CLEARANCE
        return done, done
    if phase == HAUL:
        pin = 3 * f.tip_body
        ahead, left = position_in_bed(0.5 * (w.tip[0] + w.xpos[pin]), 0.5 * (w.tip[1] + w.xpos[pin + 1]))
        above = abs(ahead) < 0.5 * TRUCK_LENGTH and abs(left) < 0.5 * (TRUCK_WIDTH - n[WIDTH])
        done = above and low > RAIL_HEIGHT
        return done, done and carried >= MIN_KEPT_SHARE * g[START_CARRIED]
    if phase == DUMP:
        return carried < EMPTY_VOLUME, carried < EMPTY_VOLUME and loaded >= MIN_KEPT_SHARE * g[START_CARRIED]
    done = _distance_to_dig(g, w, surface) < MAX_RETURN_DISTANCE
    return done, done


@compiled
def compute_load_reward(f, e, w):
    """Compute the reward of a step, see `LOAD_TRUCK.reward`.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; the sums of the last step are written to `goal`.
        w: SimulationView; `measures` receives the loose volumes in truck and bucket, spilled and
            removed from the bank [m^3], the energy [J], the largest force on the truck in this step [N],
            the number of loads, and the success.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: this module; potential-based shaping as in Ng, Harada and Russell 1999, with discount 1.
    """
    g, surface = e.goal, soil_surface_view(w)
    carried, loaded = bucket_state_view(w)[CARRIED_VOLUME], loaded_volume(load_view(w))
    potential = _potential(g, w, surface, carried)
    if math.isnan(g[POTENTIAL]):
        g[POTENTIAL] = potential
    reward = potential - g[POTENTIAL] + VOLUME_REWARD * (loaded - g[LAST_LOADED])
    reward -= SPILL_COST * (g[SPILLED] - g[LAST_SPILLED]) + ENERGY_COST * (g[ENERGY] - g[LAST_ENERGY])
    reward -= TIME_COST * f.ticks * f.period + CONTACT_COST * g[CONTACT_IMPULSE]
    force = g[MAX_FORCE]
    if carried > 0.5 * FULL_BUCKET:
        g[WAS_FULL] = 1.0
    elif carried < EMPTY_VOLUME and g[WAS_FULL] > 0.0:
        g[LOADS] += 1.0
        g[WAS_FULL] = 0.0
    g[POTENTIAL], g[LAST_LOADED], g[LAST_SPILLED], g[LAST_ENERGY] = potential, loaded, g[SPILLED], g[ENERGY]
    g[CONTACT_IMPULSE], g[MAX_FORCE] = 0.0, 0.0
    over, success = _is_phase_done(f, e, w, carried, loaded)
    w.measures[0], w.measures[1], w.measures[2] = loaded, carried, g[SPILLED]
    w.measures[3] = g[START_SOIL] - loose_soil_volume(w)
    w.measures[4], w.measures[5], w.measures[6] = g[ENERGY], force, g[LOADS]
    damaged = force > MAX_TRUCK_FORCE
    w.measures[7] = 1.0 if success and not damaged else 0.0
    if damaged:
        return reward + DAMAGE_REWARD, True
    return (reward + SUCCESS_REWARD if success else reward), over


LOAD_SOILS = ("soft", "sandy_loam", "firm")
"""Names of the soils, in the order of their indices."""

_DEGREE = math.pi / 180.0
_START_POSES = {
    "bank": ((5.6, -0.5, 1.6, -90 * _DEGREE), (6.4, 0.5, 2.2, -75 * _DEGREE)),
    "loaded": ((4.6, -0.4, 1.8, -168 * _DEGREE), (5.0, 0.4, 2.3, -160 * _DEGREE)),
    "above_truck": ((4.6, 1.48, 2.9, -168 * _DEGREE), (4.9, 1.66, 3.1, -160 * _DEGREE)),
    "emptied": ((5.6, 1.48, 2.7, -80 * _DEGREE), (6.2, 1.66, 3.1, -70 * _DEGREE)),
}
"""Name -> lower and upper bounds of the pose at the start: r [m], theta [rad], z [m], attitude [rad]."""
_PHASE_STARTS = {"cycle": "bank", "dig": "bank", "haul": "loaded", "dump": "above_truck", "return": "emptied"}
_PHASE_DURATIONS = {"dig": 15.0, "haul": 12.0, "dump": 8.0, "return": 12.0}  # s


def _make_phase(phase: str) -> dict:
    """Return the fields of the task for a phase: start pose and task parameters."""
    low, high = _START_POSES[_PHASE_STARTS[phase]]

    def start(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
        return sample_start_positions(machine, rng, low, high)

    def parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
        bed = pack_soil_bed_parameters([SOILS[name] for name in LOAD_SOILS]).tolist()
        touch = float(model.sensor("truck_0").adr[0])
        return (*bed, *[0.0] * (_TOUCH - len(bed)), touch, float(PHASES.index(phase)), float(len(LOAD_SOILS)))

    return {"start": start, "parameters": parameters}


_CYCLE_TASK = Task(
    name="LoadTruck",
    kind="load",
    needs=("swing", "boom", "stick", "tool"),
    description=(
        "An excavator fills a truck with soft, loamy or firm soil. It digs in a bank 0.5 to 1 m high, lifts the"
        " bucket, swings by 70 to 110 deg, dumps into the bed with walls 1.9 m high, and returns. The truck is full"
        " with 5 m3 of loose soil. An episode is the whole work (`phase=\"cycle\"`, the default) or a single phase:"
        " `dig`, `haul`, `dump` or `return`."
    ),
    reward=(
        "The reward is 10 per m3 in the truck. Every m3 spilled costs 10, every MJ of hydraulic energy 1, every"
        " second 0.1, and every 10 kN s of force on the truck 1. In addition, progress is rewarded"
        " (always, whatever the option `shaping`): the reward contains the change of a value of the state. This value"
        " is 3 per m3 in the bucket and rises to 7 per m3 above the truck; for an empty bucket it is -2 far from the"
        " bank and 0 at the bank. Success ends the episode with an additional reward of"
        " 10. In `cycle`, success is a full truck; in `dig`, it is 0.45 m3 in the bucket, lifted 0.3 m above the bank."
        " In `haul`, it is the bucket above the bed with 80 % of its load; in `dump`, an empty bucket with 80 % of its"
        " load in the truck; in `return`, the bucket edge above the bank. A force above 100 kN on the truck ends the"
        " episode with -20."
    ),
    machine="cat215",
    tool="bucket",
    action="joint_rate",
    duration=240.0,
    fields=list_load_observation_fields,
    measures=(
        ("loaded_volume", "m3"), ("carried_volume", "m3"), ("spilled_volume", "m3"), ("removed_volume", "m3"),
        ("energy", "J"), ("truck_force", "N"), ("loads", "1"), ("success", "1"),
    ),
    surroundings=lambda *_: (TRUCK,),
    terrain_size=LOAD_TERRAIN_SIZE,
    pose_rates=(1.2, 0.6, 1.0, 0.8, 0.25),
    **_make_phase("cycle"),
)  # fmt: skip
LOAD_TRUCK = dataclasses.replace(
    _CYCLE_TASK,
    phases={
        "cycle": _CYCLE_TASK,
        **{
            phase: dataclasses.replace(_CYCLE_TASK, duration=duration, **_make_phase(phase))
            for phase, duration in _PHASE_DURATIONS.items()
        },
    },
)
"""Fill the truck; its `phases` are tasks of a single phase."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `LoadTruck` for the simulation `number`, in native code.

    `part` is BEGIN (draw the bank of a new episode), TICK (advance the soil by a control period),
    OBSERVE (write the task's values to the observation, from the address `out` on) or REWARD
    (return the reward and store whether the episode ends). `m`, `d` and `argument` are the
    addresses of mjModel, mjData and TASK_PARAMETERS. The result is 0 except for REWARD; see
    `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_load_episode(f, e, w)
    elif part == TICK:
        move_soil(f, e, w)
    elif part == OBSERVE:
        write_load_observation(f, e, w, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_load_reward(f, e, w))
    return 0.0

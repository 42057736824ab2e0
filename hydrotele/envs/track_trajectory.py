"""The task `TrackTrajectory`: all axes track Fourier references.

Every episode draws three harmonics per axis with a common period, faded in from rest. The
amplitudes are scaled so that the rates stay within a fraction of the drive rates, and the positions
within the joint ranges.
"""

import math

import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import MAX_ARM_AXES, MAX_AXES, draw_uniform, draw_uniform_between
from hydrotele.envs.observation import ObservationField, make_position_observation_field, make_rate_observation_field
from hydrotele.envs.task import Task, compute_tracking_potential
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    POTENTIAL,
    REWARD,
    TASK_SIGNATURE,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine

PREVIEW_TIMES = (0.1, 0.2, 0.4)  # s, look-ahead times of the observed reference
ERROR_PER_REWARD = 0.1  # m of error that costs a reward of 1
_HARMONIC_COUNT = 3  # number of harmonics per axis
_FADE_TIME = 2.0  # s, fade-in time
_MIN_PERIOD, _MAX_PERIOD = 8.0, 16.0  # s, range of the period
_MIN_RATE_FRACTION, _MAX_RATE_FRACTION = (
    0.3,
    0.7,
)  # range of the maximum rate, as a fraction of the drive rate
_MAX_RANGE_FRACTION = 0.9  # maximum amplitude as a fraction of the distance to the joint limit
_DEFAULT_RANGE = 1.5  # rad or m, the same distance for an axis without limits
_FREQUENCY = 0
_BASE = 1
_SINE = _BASE + MAX_AXES
_COSINE = _SINE + _HARMONIC_COUNT * MAX_AXES


def list_track_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_track_observation` writes.

    They are the references of all driven axes, their rates, and the references 0.1, 0.2 and 0.4 s
    ahead.
    """
    fields = [make_position_observation_field(machine, name, "reference") for name in axes]
    fields += [make_rate_observation_field(machine, name, "reference_rate") for name in axes]
    for ahead in PREVIEW_TIMES:
        label = f"reference_in_{ahead * 1000:.0f}_ms"
        fields += [make_position_observation_field(machine, name, label) for name in axes]
    return fields


@compiled
def draw_track_references(f, e):
    """Draw the goal of an episode: random Fourier references of the driven axes.

    The three harmonics of each axis have random amplitudes and phases, and all axes have the same
    random period. The amplitudes of an axis are scaled so that its reference stays in the joint
    range and below a random fraction, 0.3 to 0.7, of its rate at full action.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; frequency, start positions and Fourier coefficients are written
            to `goal`.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    g[_FREQUENCY] = 2.0 * math.pi / draw_uniform_between(e, _MIN_PERIOD, _MAX_PERIOD)
    for a in range(f.axes_driven):
        i = f.driven_axis[a]
        g[_BASE + i] = e.reference[i]
        fastest = draw_uniform_between(e, _MIN_RATE_FRACTION, _MAX_RATE_FRACTION) * f.fastest[i] * f.difficulty
        total, rate = 0.0, 0.0
        for h in range(_HARMONIC_COUNT):
            place = _HARMONIC_COUNT * i + h
            size, phase = draw_uniform(e), draw_uniform_between(e, -math.pi, math.pi)
            g[_SINE + place], g[_COSINE + place] = size * math.cos(phase), size * math.sin(phase)
            total += size
            rate += size * (h + 1) * g[_FREQUENCY]
        low, high = f.ranges[i, 0] - g[_BASE + i], f.ranges[i, 1] - g[_BASE + i]
        room = max(0.0, _MAX_RANGE_FRACTION * min(-low, high, _DEFAULT_RANGE))
        # relative to its start, a sine reaches up to twice its amplitude on one side
        scale = min(fastest / rate, 0.5 * room / total * f.difficulty)
        for h in range(_HARMONIC_COUNT):
            g[_SINE + _HARMONIC_COUNT * i + h] *= scale
            g[_COSINE + _HARMONIC_COUNT * i + h] *= scale


@compiled
def compute_axis_reference(g, i, time):
    """Return the reference position of an axis at a time, and its rate.

    The reference is the start position plus a Fourier series, which is faded in over the first 2 s.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        i: index of the axis, scalar.
        time: time since the start of the episode, scalar [s].

    Returns:
        (position [rad] or [m], rate [rad/s] or [m/s]), scalars.

    Source: this module.
    """
    wave, rate = 0.0, 0.0
    first_sine, first_cosine = math.sin(g[_FREQUENCY] * time), math.cos(g[_FREQUENCY] * time)
    sine, cosine = first_sine, first_cosine
    for h in range(_HARMONIC_COUNT):
        along, across = g[_SINE + _HARMONIC_COUNT * i + h], g[_COSINE + _HARMONIC_COUNT * i + h]
        wave += along * sine + across * (cosine - 1.0)
        rate += (h + 1) * g[_FREQUENCY] * (along * cosine - across * sine)
        sine, cosine = (
            sine * first_cosine + cosine * first_sine,
            cosine * first_cosine - sine * first_sine,
        )
    if time >= _FADE_TIME:
        return g[_BASE + i] + wave, rate
    part = max(0.0, time / _FADE_TIME)
    share = part * part * (3.0 - 2.0 * part)
    growth = 6.0 * part * (1.0 - part) / _FADE_TIME
    return g[_BASE + i] + share * wave, share * rate + growth * wave


@compiled
def write_track_observation(f, e, out, at):
    """Write the references of all driven axes, their rates and the references ahead to the observation.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_track_observation_fields`.
    """
    now, n = e.tick * f.period, f.axes_driven
    for a in range(n):
        i = f.driven_axis[a]
        out[at + a], out[at + n + a] = compute_axis_reference(e.goal, i, now)
        for p in range(len(PREVIEW_TIMES)):
            out[at + (2 + p) * n + a] = compute_axis_reference(e.goal, i, now + PREVIEW_TIMES[p])[0]


@compiled
def compute_track_error(f, e):
    """Return the distance of the true tip position from the one that follows from the axis references, scalar [m].

    `f` and `e` are records of TASK_PARAMETERS and EPISODE_STATE. The kinematics are the nominal ones.
    """
    now = e.tick * f.period
    q, pose = np.empty(MAX_ARM_AXES)[: f.arm_axes], np.empty(MAX_ARM_AXES)
    for a in range(f.arm_axes):
        q[a] = compute_axis_reference(e.goal, f.driven_axis[a], now)[0]
    compute_tip_pose(f.arm, q, pose)
    x, y = pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1])
    square = (e.tip[0] - x) ** 2 + (e.tip[1] - y) ** 2 + (e.tip[2] - pose[2]) ** 2
    return math.sqrt(square)


@compiled
def compute_track_reward(f, e, w):
    """Compute the reward of a step: 1 minus 1 for every 0.1 m of tip error, at least -1.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView; `measures` receives the tip error [m].

    Returns:
        (reward, False), scalars; False because this task never ends an episode early.

    Source: `compute_track_error`.
    """
    error = compute_track_error(f, e)
    w.measures[0] = error
    return max(-1.0, 1.0 - error / ERROR_PER_REWARD), False


@compiled
def compute_track_potential(f, e):
    """Return the potential of the true tip error, see `compute_tracking_potential`.

    `f` and `e` are records of TASK_PARAMETERS and EPISODE_STATE.
    """
    return compute_tracking_potential(f, compute_track_error(f, e))


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `TrackTrajectory` for the simulation `number`, in native code.

    `part` is BEGIN (draw the references of a new episode), TICK (do nothing), OBSERVE (write
    the task's values to the observation, from the address `out` on), REWARD (return the reward
    and store whether the episode ends) or POTENTIAL (return the potential). `m`, `d` and `argument`
    are the addresses of mjModel, mjData and TASK_PARAMETERS. The result is 0 for the other parts;
    see `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_track_references(f, e)
    elif part == OBSERVE:
        write_track_observation(f, e, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_track_reward(f, e, w))
    elif part == POTENTIAL:
        return compute_track_potential(f, e)
    return 0.0


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, axis -> [rad] or [m], uniform in the middle 40 % of the joint range.

    An axis without joint limits counts as one with the range -0.5 to 0.5.
    """
    places = {}
    for name, axis in machine.axes.items():
        low, high = machine.joints[axis.joint].range or (-0.5, 0.5)
        places[name] = float(low + (high - low) * rng.uniform(0.3, 0.7))
    return places


TRACK_TRAJECTORY = Task(
    name="TrackTrajectory",
    kind="track",
    description="All axes of an excavator without a tool follow periodic references, sums of three harmonics.",
    reward="The reward of a step is 1 without error and at least -1. It decreases by 1 for every 0.1 m of tip error.",
    machine="cat215",
    tool="none",
    start=_sample_start_positions,
    fields=list_track_observation_fields,
    measures=(("tip_error", "m"),),
)

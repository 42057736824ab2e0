"""The task `TrackTrajectory`: all axes track Fourier references.

Every episode draws three harmonics per axis with a common period, faded in from rest. The
amplitudes are scaled so that the rates stay within a fraction of the drive rates, and the positions
within the joint ranges.
"""

import math

import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import ARM, AXES, uniform, uniform_between
from hydrotele.envs.world import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_CODE,
    Field,
    episodes,
    observed,
    parameters_at,
    position_field,
    rate_field,
    rewarded,
    world,
)
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.machine import Machine

PREVIEWS = (0.1, 0.2, 0.4)  # s, look-ahead times of the observed reference
SCALE = 0.1  # m of error that costs a reward of 1
_HARMONICS = 3  # number of harmonics per axis
_FADE = 2.0  # s, fade-in time
_SHORT, _LONG = 8.0, 16.0  # s, range of the period
_SLOW, _FAST = 0.3, 0.7  # range of the maximum rate, as a fraction of the drive rate
_ROOM = 0.9  # maximum amplitude as a fraction of the distance to the joint limit
_FREE = 1.5  # rad or m, the same distance for an axis without limits
_FREQUENCY = 0
_BASE = 1
_SINE = _BASE + AXES
_COSINE = _SINE + _HARMONICS * AXES


def track_fields(machine: Machine, axes: tuple[str, ...]) -> list[Field]:
    """Return the fields that `observe_track` writes: references, their rates and previews."""
    fields = [position_field(machine, name, "reference") for name in axes]
    fields += [rate_field(machine, name, "reference_rate") for name in axes]
    for ahead in PREVIEWS:
        label = f"reference_in_{ahead * 1000:.0f}_ms"
        fields += [position_field(machine, name, label) for name in axes]
    return fields


@compiled
def begin_track(f, e):
    """Draw references that the machine can follow.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    g[_FREQUENCY] = 2.0 * math.pi / uniform_between(e, _SHORT, _LONG)
    for a in range(f.axes_driven):
        i = f.driven_axis[a]
        g[_BASE + i] = e.reference[i]
        fastest = uniform_between(e, _SLOW, _FAST) * f.fastest[i]
        total, rate = 0.0, 0.0
        for h in range(_HARMONICS):
            place = _HARMONICS * i + h
            size, phase = uniform(e), uniform_between(e, -math.pi, math.pi)
            g[_SINE + place], g[_COSINE + place] = size * math.cos(phase), size * math.sin(phase)
            total += size
            rate += size * (h + 1) * g[_FREQUENCY]
        low, high = f.ranges[i, 0] - g[_BASE + i], f.ranges[i, 1] - g[_BASE + i]
        room = max(0.0, _ROOM * min(-low, high, _FREE))
        # relative to its start, a sine reaches up to twice its amplitude on one side
        scale = min(fastest / rate, 0.5 * room / total)
        for h in range(_HARMONICS):
            g[_SINE + _HARMONICS * i + h] *= scale
            g[_COSINE + _HARMONICS * i + h] *= scale


@compiled
def track_reference(g, i, time):
    """Return the reference position of an axis and its rate.

    Args:
        g: (GOAL,) goal of the episode.
        i: index of the axis, scalar.
        time: since the start, scalar [s].

    Returns:
        (position [rad] or [m], rate [rad/s] or [m/s]), scalars.

    Source: this module.
    """
    wave, rate = 0.0, 0.0
    first_sine, first_cosine = math.sin(g[_FREQUENCY] * time), math.cos(g[_FREQUENCY] * time)
    sine, cosine = first_sine, first_cosine
    for h in range(_HARMONICS):
        along, across = g[_SINE + _HARMONICS * i + h], g[_COSINE + _HARMONICS * i + h]
        wave += along * sine + across * (cosine - 1.0)
        rate += (h + 1) * g[_FREQUENCY] * (along * cosine - across * sine)
        sine, cosine = (
            sine * first_cosine + cosine * first_sine,
            cosine * first_cosine - sine * first_sine,
        )
    if time >= _FADE:
        return g[_BASE + i] + wave, rate
    part = max(0.0, time / _FADE)
    share = part * part * (3.0 - 2.0 * part)
    growth = 6.0 * part * (1.0 - part) / _FADE
    return g[_BASE + i] + share * wave, share * rate + growth * wave


@compiled
def observe_track(f, e, out, at):
    """Write the references, their rates and the references ahead.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: scalar.

    Returns:
        Nothing.

    Source: `track_fields`.
    """
    now, n = e.tick * f.period, f.axes_driven
    for a in range(n):
        i = f.driven_axis[a]
        out[at + a], out[at + n + a] = track_reference(e.goal, i, now)
        for p in range(len(PREVIEWS)):
            out[at + (2 + p) * n + a] = track_reference(e.goal, i, now + PREVIEWS[p])[0]


@compiled
def reward_track(f, e, w):
    """Compute the reward: 1 minus 1 for every 0.1 m of tip error, at least -1.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World; `measures` receives the distance of the tip from its reference [m].

    Returns:
        (reward, False), scalars.

    Source: this module.
    """
    now = e.tick * f.period
    q, pose = np.empty(f.arm_axes), np.empty(ARM)
    for i in range(f.arm_axes):
        q[i] = track_reference(e.goal, i, now)[0]
    task_forward(f.arm, q, pose)
    x, y = pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1])
    square = (e.tip[0] - x) ** 2 + (e.tip[1] - y) ** 2 + (e.tip[2] - pose[2]) ** 2
    error = math.sqrt(square)
    w.measures[0] = error
    return max(-1.0, 1.0 - error / SCALE), False


@callback(TASK_CODE)
def code(part, m, d, number, argument, out):
    """Run one part of the task in native code; see `world`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_track(f, e)
    elif part == OBSERVE:
        observe_track(f, e, observed(f, out), 0)
    elif part == REWARD:
        return rewarded(e, reward_track(f, e, w))
    return 0.0

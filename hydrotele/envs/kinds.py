"""The tasks in native code by their names.

A task is a file of its own with compiled functions for a new episode, a control period, what it
observes and its reward; here each has its code in one piece, see `world`.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import numpy as np
from numba import carray

from hydrotele.core.compiled import Callback, callback, compiled
from hydrotele.core.memory import pointer
from hydrotele.envs.force import begin_force, observe_force, reward_force, tick_force
from hydrotele.envs.grade import begin_grade, observe_grade, reward_grade, tick_bed
from hydrotele.envs.line import begin_line, observe_line, reward_line
from hydrotele.envs.place import begin_place, observe_place, reward_place, tick_grapple
from hydrotele.envs.reach import begin_reach, observe_reach, reward_reach
from hydrotele.envs.track import begin_track, observe_track, reward_track
from hydrotele.envs.world import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_CODE,
    TICK,
    episodes,
    parameters_at,
    world,
)


@compiled
def _observation(f, out):
    """Room for what a task observes, and perhaps more."""
    return carray(pointer(out), (f.observations,), np.float32)


@compiled
def _rewarded(e, outcome):
    """Keep whether an episode ends; the reward."""
    reward, done = outcome
    e.over = 1 if done else 0
    return reward


@callback(TASK_CODE)
def track(part, m, d, number, argument, out):
    """Code of the task of `envs.track`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_track(f, e)
    elif part == OBSERVE:
        observe_track(f, e, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_track(f, e, w))
    return 0.0


@callback(TASK_CODE)
def line(part, m, d, number, argument, out):
    """Code of the task of `envs.line`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_line(f, e)
    elif part == OBSERVE:
        observe_line(f, e, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_line(f, e, w))
    return 0.0


@callback(TASK_CODE)
def force(part, m, d, number, argument, out):
    """Code of the task of `envs.force`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_force(f, e, w)
    elif part == TICK:
        tick_force(f, e, w)
    elif part == OBSERVE:
        observe_force(f, e, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_force(f, e, w))
    return 0.0


@callback(TASK_CODE)
def reach(part, m, d, number, argument, out):
    """Code of the task of `envs.reach`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_reach(f, e)
    elif part == OBSERVE:
        observe_reach(f, e, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_reach(f, e, w))
    return 0.0


@callback(TASK_CODE)
def grade(part, m, d, number, argument, out):
    """Code of the task of `envs.grade`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_grade(f, e, w)
    elif part == TICK:
        tick_bed(f, e, w)
    elif part == OBSERVE:
        observe_grade(f, e, w, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_grade(f, e, w))
    return 0.0


@callback(TASK_CODE)
def place(part, m, d, number, argument, out):
    """Code of the task of `envs.place`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_place(f, e, w)
    elif part == TICK:
        tick_grapple(f, e, w)
    elif part == OBSERVE:
        observe_place(f, e, w, _observation(f, out), 0)
    elif part == REWARD:
        return _rewarded(e, reward_place(f, e, w))
    return 0.0


KINDS: dict[str, Callback] = {
    "track": track, "line": line, "force": force, "reach": reach, "grade": grade, "place": place,
}  # fmt: skip
"""Kind of task -> its code."""

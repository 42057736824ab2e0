"""The tasks in native code by their number: a goal, each control period, observation, reward.

A task is a file of its own with four compiled functions of the same names and arguments; its number
is its place in KINDS.
"""

from hydrotele.core.compiled import compiled
from hydrotele.envs.force import begin_force, observe_force, reward_force, tick_force
from hydrotele.envs.grade import begin_grade, observe_grade, reward_grade, tick_bed
from hydrotele.envs.line import begin_line, observe_line, reward_line
from hydrotele.envs.observation import observe_machine
from hydrotele.envs.place import begin_place, observe_place, reward_place, tick_grapple
from hydrotele.envs.reach import begin_reach, observe_reach, reward_reach
from hydrotele.envs.track import begin_track, observe_track, reward_track

KINDS = ("track", "line", "force", "reach", "grade", "place")
_TRACK, _LINE, _FORCE, _REACH, _GRADE, _PLACE = range(6)


@compiled
def begin_task(f, e, w):
    """Draw the goal of a new episode.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World.

    Returns:
        Nothing.

    Source: the task's own file.
    """
    if f.kind == _TRACK:
        begin_track(f, e)
    elif f.kind == _LINE:
        begin_line(f, e)
    elif f.kind == _FORCE:
        begin_force(f, e, w)
    elif f.kind == _REACH:
        begin_reach(f, e)
    elif f.kind == _GRADE:
        begin_grade(f, e, w)
    elif f.kind == _PLACE:
        begin_place(f, e, w)


@compiled
def tick_task(f, e, w):
    """What a task does after a control period: forces of the ground, a grapple that takes a log.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World.

    Returns:
        Nothing.

    Source: the task's own file.
    """
    if f.kind == _FORCE:
        tick_force(f, e, w)
    elif f.kind == _GRADE:
        tick_bed(f, e, w)
    elif f.kind == _PLACE:
        tick_grapple(f, e, w)


@compiled
def observe_task(f, e, w, out):
    """Write the observation: of the machine, then of the task.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World.
        out: (observations,) float32, written.

    Returns:
        Nothing.

    Source: `observation.machine_fields` and the task's own file.
    """
    at = observe_machine(f, e, out)
    if f.kind == _TRACK:
        observe_track(f, e, out, at)
    elif f.kind == _LINE:
        observe_line(f, e, out, at)
    elif f.kind == _FORCE:
        observe_force(f, e, out, at)
    elif f.kind == _REACH:
        observe_reach(f, e, out, at)
    elif f.kind == _GRADE:
        observe_grade(f, e, w, out, at)
    elif f.kind == _PLACE:
        observe_place(f, e, w, out, at)


@compiled
def reward_task(f, e, w):
    """Reward of the step that is over, and whether the task is.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World; `measures` is written.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: the task's own file.
    """
    if f.kind == _TRACK:
        return reward_track(f, e, w)
    if f.kind == _LINE:
        return reward_line(f, e, w)
    if f.kind == _FORCE:
        return reward_force(f, e, w)
    if f.kind == _REACH:
        return reward_reach(f, e, w)
    if f.kind == _GRADE:
        return reward_grade(f, e, w)
    if f.kind == _PLACE:
        return reward_place(f, e, w)
    return 0.0, False

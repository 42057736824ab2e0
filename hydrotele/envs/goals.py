"""What an agent is asked to do, as markers in pictures: one function per kind of task.

A function gets the running task and the number of the episode and reads the goal from its memory.
"""

import math
from collections.abc import Callable

import numpy as np

from hydrotele.kinematics.task import task_forward
from hydrotele.show.markers import Marker, ball, line, polyline
from hydrotele.tasks.core import TaskCore
from hydrotele.tasks.memory import ARM
from hydrotele.tasks.track import track_reference

_GOAL = (0.10, 0.75, 0.25, 1.0)  # what is asked for
_AHEAD = (0.15, 0.45, 0.95, 1.0)  # where that goes
_OFF = (0.90, 0.15, 0.10, 1.0)  # what is wrong
_WAY, _PIECES = 3.0, 30  # s of a reference that are shown ahead, lines that show it


def goal_markers(core: TaskCore, number: int) -> list[Marker]:
    """Shapes that show the goal of an episode; none for a kind of task that is not here.

    Args:
        core: the running task.
        number: of the episode.

    Returns:
        The shapes, in the world.
    """
    draw = _GOALS.get(core.setup.task.kind)
    return draw(core, number) if draw else []


def place_of_pose(pose: np.ndarray) -> np.ndarray:
    """Place (3,) [m] of the tip with a pose r, theta, z, ..."""
    return np.array([pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1]), pose[2]])


def _track(core: TaskCore, number: int) -> list[Marker]:
    """The tip on its reference, its way ahead, and how far off it is."""
    memory, k = core.memory[number], core.setup.arm_axes
    now = float(memory["tick"]) * core.setup.clock.period

    def place(time: float) -> np.ndarray:
        joints, pose = np.empty(k), np.empty(ARM)
        for axis in range(k):
            joints[axis] = track_reference(memory["goal"], axis, time)[0]
        task_forward(core.facts["arm"], joints, pose)
        return place_of_pose(pose)

    way = np.array([place(now + ahead) for ahead in np.linspace(0.0, _WAY, _PIECES + 1)])
    off = line(memory["tip"], way[0], 0.03, _OFF)
    return [ball(way[0], 0.12, _GOAL), off, *polyline(way, 0.025, _AHEAD)]


_GOALS: dict[str, Callable[[TaskCore, int], list[Marker]]] = {"track": _track}

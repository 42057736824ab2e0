"""What an agent is asked to do, as markers in pictures.

What a task lets its agent observe of the goal is drawn by the names of the fields: `wanted.r`,
`wanted.theta` and so on are a pose of the tip, `wanted_in_200_ms.r` its way ahead, `wanted_force`
and `force` are arrows at the tip, `goal.r` and so on is where a log shall lie. A kind of task that
has more to show has a function here.
"""

import math
from collections.abc import Callable

import numpy as np

from hydrotele.kinematics.task import task_forward
from hydrotele.show.markers import Marker, arrow, ball, line, polyline
from hydrotele.surroundings import LogOnGround
from hydrotele.tasks.core import TaskCore
from hydrotele.tasks.memory import ARM
from hydrotele.tasks.track import track_reference

_GOAL = (0.10, 0.75, 0.25, 1.0)  # what is asked for
_AHEAD = (0.15, 0.45, 0.95, 1.0)  # where that goes
_OFF = (0.90, 0.15, 0.10, 1.0)  # what is wrong
_BALL, _THICK, _THIN = 0.14, 0.04, 0.035  # m
_WAY, _PIECES = 3.0, 30  # s of a reference that are shown ahead, lines that show it
_POINTER = 0.9  # m, of the direction of a tool
_METRES = 1.0 / 15.0e3  # m per N of an arrow
_GHOST = (*_GOAL[:3], 0.45)
_ASIDE = 0.35  # m between the arrows of a force and of the one wanted


def goal_markers(core: TaskCore, number: int) -> list[Marker]:
    """Shapes that show the goal of an episode.

    Args:
        core: the running task.
        number: of the episode.

    Returns:
        The shapes, in the world.
    """
    return _GOALS.get(core.setup.task.kind, observed_goal)(core, number)


def place_of_pose(r: float, theta: float, z: float) -> np.ndarray:
    """Place (3,) [m] of a tip at a radius [m], angle [rad] and height [m]."""
    return np.array([r * math.cos(theta), r * math.sin(theta), z])


def observed_goal(core: TaskCore, number: int) -> list[Marker]:
    """What the observation says of a pose and of a force that are wanted; nothing without."""
    row = dict(zip((f.name for f in core.setup.fields), core.observation[number], strict=True))
    tip, markers = core.memory["tip"][number], []
    if "wanted.r" in row:
        place = place_of_pose(row["wanted.r"], row["wanted.theta"], row["wanted.z"])
        markers += [ball(place, _BALL, _GOAL), line(tip, place, _THICK, _OFF)]
        if "wanted.attitude" in row:
            turn = row["wanted.attitude"]
            along = place_of_pose(math.cos(turn), row["wanted.theta"], math.sin(turn))
            markers.append(line(place - _POINTER * along, place, _THICK, _GOAL))
        soon = [name.partition(".")[0] for name in row if name.startswith("wanted_in_")]
        ahead = [place_of_pose(row[f"{name}.r"], row[f"{name}.theta"], row[f"{name}.z"])
                 for name in dict.fromkeys(soon)]  # fmt: skip
        markers += polyline(np.array([place, *ahead]), _THIN, _AHEAD)
    if "wanted_force" in row:
        for name, colour, aside in (("wanted_force", _GOAL, _ASIDE), ("force", _OFF, -_ASIDE)):
            foot = tip + (0.0, aside, 0.0)
            top = foot + (0.0, 0.0, max(0.0, row[name]) * _METRES)
            markers.append(arrow(top, foot, 2.0 * _THICK, colour))
    variant = int(core.memory["variant"][number])
    for log in core.setup.variants.surroundings[variant]:
        if isinstance(log, LogOnGround) and "goal.r" in row:
            yaw = 0.5 * math.atan2(row["goal.sin_2_yaw"], row["goal.cos_2_yaw"])
            half = 0.5 * log.length * np.array([math.cos(yaw), math.sin(yaw), 0.0])
            radius = 0.5 * log.diameter
            place = place_of_pose(row["goal.r"], row["goal.theta"], radius)
            markers.append(line(place - half, place + half, radius, _GHOST))
    return markers


def _track(core: TaskCore, number: int) -> list[Marker]:
    """The tip on its reference, its way ahead, and how far off it is."""
    memory, k = core.memory[number], core.setup.arm_axes
    now = float(memory["tick"]) * core.setup.clock.period

    def place(time: float) -> np.ndarray:
        joints, pose = np.empty(k), np.empty(ARM)
        for axis in range(k):
            joints[axis] = track_reference(memory["goal"], axis, time)[0]
        task_forward(core.facts["arm"], joints, pose)
        return place_of_pose(*pose[:3])

    way = np.array([place(now + ahead) for ahead in np.linspace(0.0, _WAY, _PIECES + 1)])
    off = line(memory["tip"], way[0], _THICK, _OFF)
    return [ball(way[0], _BALL, _GOAL), off, *polyline(way, _THIN, _AHEAD)]


_GOALS: dict[str, Callable[[TaskCore, int], list[Marker]]] = {"track": _track}

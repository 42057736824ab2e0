"""What an agent is asked to do, as markers in pictures: one function per kind of task.

A function gets the running task and the number of the episode and reads the goal from its memory.

A bed of soil as boxes along the arm's plane, the bank darker than what lies loose on it.
"""

import math
from collections.abc import Callable

import numpy as np

from hydrotele.kinematics.task import SIDE, task_forward
from hydrotele.show.markers import Marker, arrow, ball, box, line, polyline
from hydrotele.soil.shape import CAT215
from hydrotele.tasks.bed import CELL, CELLS, START
from hydrotele.tasks.core import TaskCore
from hydrotele.tasks.force import FORCE_READ, force_wanted
from hydrotele.tasks.grade import FAR, NEAR, plane_height
from hydrotele.tasks.grapple import HALF_LENGTH, RADIUS
from hydrotele.tasks.line import SETTLE, line_pose
from hydrotele.tasks.memory import ARM
from hydrotele.tasks.place import GOAL_PLACE
from hydrotele.tasks.track import track_reference

_BANK, _LOOSE = (0.36, 0.25, 0.15, 1.0), (0.62, 0.47, 0.30, 1.0)
_THIN_SOIL = 1e-3  # m of loose soil that is not drawn


def _turn(core: TaskCore, number: int) -> np.ndarray:
    """(3, 3) rotation of the house, and with it of the arm's plane."""
    swing = float(core.memory["position"][number][0])
    c, s = math.cos(swing), math.sin(swing)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def bed_markers(core: TaskCore, number: int) -> list[Marker]:
    """Cells of the profile of an episode's soil.

    Args:
        core: the running task, with a bed of soil.
        number: of the episode.

    Returns:
        The boxes, in the world.
    """
    terrain, turn = core.terrain[number], _turn(core, number)
    surface, loose = terrain[:CELLS], terrain[CELLS : 2 * CELLS]
    side, half = float(core.facts["arm"][SIDE]), 0.5 * CAT215.width
    bottom = min(0.0, float(np.min(surface)) - _THIN_SOIL)  # what the machine stands on

    def cell(i: int, low: float, high: float, colour) -> Marker:
        middle = turn @ [START + (i + 0.5) * CELL, side, 0.5 * (low + high)]
        return box(middle, (0.5 * CELL, half, 0.5 * (high - low)), colour, turn)

    bank = surface - loose
    boxes = [cell(i, bottom, float(bank[i]), _BANK) for i in range(CELLS)]
    heaps = [i for i in range(CELLS) if loose[i] > _THIN_SOIL]
    return boxes + [cell(i, float(bank[i]), float(surface[i]), _LOOSE) for i in heaps]


def plane_markers(core: TaskCore, number: int, colour) -> list[Marker]:
    """Edges of the plane that the soil shall have in the stretch to grade, beside the soil.

    Args:
        core: the running task.
        number: of the episode.
        colour: (4,) of the lines.

    Returns:
        The lines, in the world.
    """
    goal, turn = core.memory["goal"][number], _turn(core, number)
    side, out = float(core.facts["arm"][SIDE]), 0.5 * CAT215.width + 0.03
    corners = [
        turn @ [r, side + y, plane_height.py_func(goal, r)]
        for r, y in ((NEAR, -out), (FAR, -out), (FAR, out), (NEAR, out), (NEAR, -out))
    ]
    return polyline(np.array(corners), 0.02, colour)


_GOAL = (0.10, 0.75, 0.25, 1.0)  # what is asked for
_AHEAD = (0.15, 0.45, 0.95, 1.0)  # where that goes
_OFF = (0.90, 0.15, 0.10, 1.0)  # what is wrong
_WAY, _PIECES = 3.0, 30  # s of a reference that are shown ahead, lines that show it
_BALL, _THICK, _THIN = 0.15, 0.045, 0.035  # m
_METRES = 7.0e-5  # m of an arrow per N
_BESIDE = 0.3  # m between the arrows of two forces
_POINTER = 0.8  # m, of an attitude


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
    off = line(memory["tip"], way[0], _THICK, _OFF)
    return [ball(way[0], _BALL, _GOAL), off, *polyline(way, _THIN, _AHEAD)]


def _line(core: TaskCore, number: int) -> list[Marker]:
    """The line, the place of the tip on it, and how far off the tip is."""
    memory = core.memory[number]
    now, pose, rate = float(memory["tick"]) * core.setup.clock.period, np.zeros(ARM), np.zeros(ARM)

    def place(time: float) -> np.ndarray:
        line_pose(memory["goal"], time, pose, rate)
        return place_of_pose(pose)

    end = core.setup.clock.horizon * core.setup.clock.ticks * core.setup.clock.period
    way = np.array([place(time) for time in np.linspace(SETTLE, end, _PIECES + 1)])
    wanted = place(now)
    off = line(memory["tip"], wanted, _THICK, _OFF)
    return [ball(wanted, _BALL, _GOAL), off, *polyline(way, _THIN, _AHEAD)]


def _force(core: TaskCore, number: int) -> list[Marker]:
    """Arrows on the plate before the tip: the force wanted, and that which the load cell read."""
    memory, side = core.memory[number], np.array([0.0, 0.5 * _BESIDE, 0.0])
    goal, foot = memory["goal"], memory["tip"] - np.array([0.6, 0.0, 0.0])
    now = float(memory["tick"]) * core.setup.clock.period
    wanted, _ = force_wanted(goal, now)
    up = np.array([0.0, 0.0, _METRES])
    pushes = ((wanted, -side, _GOAL), (float(goal[FORCE_READ]), side, _OFF))
    return [
        arrow(foot + way + max(0.0, force) * up, foot + way, 1.5 * _THICK, colour)
        for force, way, colour in pushes
    ]


def _reach(core: TaskCore, number: int) -> list[Marker]:
    """The place wanted, how far off the tip is, and the attitude wanted."""
    memory = core.memory[number]
    pose = memory["goal"][:ARM]
    wanted, level = place_of_pose(pose), math.cos(pose[3])
    ahead = np.array([level * math.cos(pose[1]), level * math.sin(pose[1]), math.sin(pose[3])])
    pointer = line(wanted - _POINTER * ahead, wanted, _THICK, _AHEAD)
    return [ball(wanted, _BALL, _GOAL), line(memory["tip"], wanted, _THICK, _OFF), pointer]


def _grade(core: TaskCore, number: int) -> list[Marker]:
    """The soil, and the plane that it shall have."""
    return [*bed_markers(core, number), *plane_markers(core, number, _GOAL)]


def _place(core: TaskCore, number: int) -> list[Marker]:
    """The log's middle line where it shall lie, and its rim on the ground."""
    x, y, yaw = core.memory[number]["goal"][GOAL_PLACE]
    radius, half = core.facts["numbers"][RADIUS], core.facts["numbers"][HALF_LENGTH]
    way = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    aside = radius * np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    middle = np.array([x, y, 0.02])
    ends = [middle + half * a * way + b * aside for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    rim = polyline(np.array([*ends, ends[0]]), 0.03, _GOAL)
    return [*rim, line(middle - half * way, middle + half * way, 0.03, _GOAL)]


_GOALS: dict[str, Callable[[TaskCore, int], list[Marker]]] = {
    "track": _track,
    "line": _line,
    "force": _force,
    "reach": _reach,
    "grade": _grade,
    "place": _place,
}

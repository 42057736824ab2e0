"""A bed of soil as boxes along the arm's plane, the bank darker than what lies loose on it."""

import math

import numpy as np

from hydrotele.kinematics.task import SIDE
from hydrotele.show.markers import Marker, box, polyline
from hydrotele.soil.shape import CAT215
from hydrotele.tasks.bed import CELL, CELLS, START
from hydrotele.tasks.core import TaskCore
from hydrotele.tasks.grade import FAR, NEAR, plane_height

_BANK, _LOOSE = (0.36, 0.25, 0.15, 1.0), (0.62, 0.47, 0.30, 1.0)
_THIN = 1e-3  # m of loose soil that is not drawn


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
    bottom = min(0.0, float(np.min(surface)) - _THIN)  # what the machine stands on

    def cell(i: int, low: float, high: float, colour) -> Marker:
        middle = turn @ [START + (i + 0.5) * CELL, side, 0.5 * (low + high)]
        return box(middle, (0.5 * CELL, half, 0.5 * (high - low)), colour, turn)

    bank = surface - loose
    boxes = [cell(i, bottom, float(bank[i]), _BANK) for i in range(CELLS)]
    heaps = [i for i in range(CELLS) if loose[i] > _THIN]
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

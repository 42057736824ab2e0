"""When a grab holds a thing: its jaw has closed and the thing lies in the pocket between the jaws.

Friction of wood on steel is not the point here. What is held is welded to the grab's body in the
pose in which it was taken, so that taking it gives no jerk. The law is compiled and works on flat
arrays, for the control loop and for native loops that step many machines.
"""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.core.compiled import lean

CLOSED, OPEN, LINE, STRAIGHT, CENTRE, HALF, OWN, BEFORE, BEHIND = 0, 1, 2, 3, 4, 7, 10, 11, 12
GRIP = 13
ROW = 11  # numbers of a weld in `eq_data`
LET_GO, UNCHANGED, TAKEN = -1, 0, 1


def grip_numbers(
    closed: float, open: float, line: int, straight: float, centre: Sequence[float],
    half: Sequence[float], own: int, reach: tuple[float, float] = (-math.inf, math.inf),
) -> np.ndarray:  # fmt: skip
    """The numbers of `grip_step`.

    Args:
        closed: the jaw holds beyond this angle [rad].
        open: it lets go below this one [rad], at most `closed`.
        line: axis of the grab's frame (0, 1, 2) along which things lie in its pocket.
        straight: largest angle between this axis and the thing's [rad].
        centre: (3,) middle of the pocket, a box in the grab's frame [m].
        half: (3,) half its sizes [m]; that along `line` does not count.
        own: axis of the thing's frame (0, 1, 2) along which it is long.
        reach: where along this axis it can be held, seen from its origin [m].

    Returns:
        (GRIP,) numbers.
    """
    return np.array([closed, open, line, math.cos(straight), *centre, *half, own, *reach], float)


@lean
def grip_step(grip, hand_position, hand_quaternion, position, quaternion, angle, held, row):
    """Whether a grab takes or lets go of a thing, and how it is then welded to it.

    A thing is taken if the jaw is closed and the thing's axis passes through the middle of the
    pocket, across the jaws: within the box there, turned by no more than the given angle and within
    the thing's length.

    Args:
        grip: (GRIP,) of `grip_numbers`.
        hand_position: (3,) of the grab's body, `xpos` [m].
        hand_quaternion: (4,) `xquat`.
        position: (3,) of the thing's body [m].
        quaternion: (4,) of the thing's body.
        angle: of the jaw [rad].
        held: whether the thing is held.
        row: (>= ROW,) `eq_data` of the weld with the grab as `body1` and the thing as `body2`;
            written when it is taken.

    Returns:
        TAKEN, LET_GO or UNCHANGED.
    """
    if held:
        return LET_GO if angle < grip[OPEN] else UNCHANGED
    if not angle >= grip[CLOSED]:
        return UNCHANGED
    w, x, y, z = hand_quaternion[0], hand_quaternion[1], hand_quaternion[2], hand_quaternion[3]
    a, b, c, d = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    line, own = int(grip[LINE]), int(grip[OWN])
    to_x, to_y, to_z = _turned(
        w, -x, -y, -z, position[0] - hand_position[0], position[1] - hand_position[1],
        position[2] - hand_position[2],
    )  # fmt: skip
    # the thing's quaternion in the grab's frame
    e = w * a + x * b + y * c + z * d
    f = w * b - x * a - y * d + z * c
    g = w * c + x * d - y * a - z * b
    h = w * d - x * c + y * b - z * a
    way_x, way_y, way_z = _turned(
        e, f, g, h, 1.0 if own == 0 else 0.0, 1.0 if own == 1 else 0.0, 1.0 if own == 2 else 0.0
    )
    along = way_x if line == 0 else (way_y if line == 1 else way_z)
    if abs(along) < max(grip[STRAIGHT], 1.0e-6):
        return UNCHANGED
    level = to_x if line == 0 else (to_y if line == 1 else to_z)
    far = (grip[CENTRE + line] - level) / along
    if not grip[BEFORE] <= far <= grip[BEHIND]:
        return UNCHANGED
    for k in range(3):
        at = (
            to_x + far * way_x if k == 0 else (to_y + far * way_y if k == 1 else to_z + far * way_z)
        )
        if k != line and not abs(at - grip[CENTRE + k]) < grip[HALF + k]:
            return UNCHANGED
    row[0], row[1], row[2] = 0.0, 0.0, 0.0  # the point that is held: the thing's origin
    row[3], row[4], row[5] = to_x, to_y, to_z
    row[6], row[7], row[8], row[9] = e, f, g, h
    row[10] = 1.0  # m: torque per force of the weld, MuJoCo's default
    return TAKEN


@lean
def _turned(w, x, y, z, vx, vy, vz):
    """A vector turned by a unit quaternion."""
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )

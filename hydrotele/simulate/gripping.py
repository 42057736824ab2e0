"""Gripping of an object by a grab.

The jaw is closed and the object lies in its pocket. Instead of friction, a weld constraint holds
the object in its current pose, so that there is no jerk.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from hydrotele.core.compiled import compile_without_allocation
from hydrotele.scenario.surrounding_objects import LogOnGround

(
    CLOSE_ANGLE,
    OPEN_ANGLE,
    POCKET_AXIS,
    MIN_COSINE,
    POCKET_CENTRE,
    POCKET_HALF_SIZE,
    OBJECT_AXIS,
    REACH_START,
    REACH_STOP,
) = 0, 1, 2, 3, 4, 7, 10, 11, 12
GRIP_SIZE = 13
WELD_SIZE = 11  # number of values of a weld in `eq_data`
RELEASED, UNCHANGED, TAKEN = -1, 0, 1


def grip_parameters(
    close_angle: float, open_angle: float, pocket_axis: int, max_angle: float, pocket_centre: Sequence[float],
    pocket_half_size: Sequence[float], object_axis: int, reach: tuple[float, float] = (-math.inf, math.inf),
) -> np.ndarray:  # fmt: skip
    """Return the conditions under which a grab takes or releases an object, as an array for `grip_step`.

    Args:
        close_angle: jaw angle above which an object is taken [rad].
        open_angle: jaw angle below which the object is released [rad], at most `close_angle`.
        pocket_axis: axis of the grab's frame (0, 1, 2) along which objects lie in the pocket.
        max_angle: largest angle between this axis and the object's long axis [rad].
        pocket_centre: (3,) centre of the pocket, a box in the grab's frame [m].
        pocket_half_size: (3,) half sizes of the pocket [m]; the one along `pocket_axis` is ignored.
        object_axis: long axis of the object in its own frame (0, 1, 2).
        reach: (low, high) coordinates along the object's long axis, from the object's origin,
            between which it can be held [m].

    Returns:
        (GRIP_SIZE,) parameters.
    """
    return np.array(
        [
            close_angle,
            open_angle,
            pocket_axis,
            math.cos(max_angle),
            *pocket_centre,
            *pocket_half_size,
            object_axis,
            *reach,
        ],
        float,
    )


@compile_without_allocation
def grip_step(grip, hand_position, hand_quaternion, position, quaternion, angle, held, row):
    """Decide whether a grab takes or releases an object, and set the weld that holds it.

    An object is taken if the jaw angle is at least the closing angle and the object's long axis
    crosses the middle plane of the pocket inside the box, within the angle limit and within the
    object's reach. A held object is released if the jaw angle is below the opening angle.

    Args:
        grip: (GRIP_SIZE,) result of `grip_parameters`.
        hand_position: (3,) position of the grab's body, `xpos` [m].
        hand_quaternion: (4,) its orientation, `xquat`.
        position: (3,) position of the object's body [m].
        quaternion: (4,) orientation of the object's body.
        angle: angle of the jaw [rad].
        held: whether the object is held.
        row: (>= WELD_SIZE,) `eq_data` of the weld with the grab as `body1` and the object as
            `body2`; written when the object is taken.

    Returns:
        TAKEN, RELEASED or UNCHANGED.
    """
    if held:
        return RELEASED if angle < grip[OPEN_ANGLE] else UNCHANGED
    if not angle >= grip[CLOSE_ANGLE]:
        return UNCHANGED
    w, x, y, z = hand_quaternion[0], hand_quaternion[1], hand_quaternion[2], hand_quaternion[3]
    a, b, c, d = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    line, own = int(grip[POCKET_AXIS]), int(grip[OBJECT_AXIS])
    to_x, to_y, to_z = _rotate_vector(
        w, -x, -y, -z, position[0] - hand_position[0], position[1] - hand_position[1],
        position[2] - hand_position[2],
    )  # fmt: skip
    # the object's quaternion in the grab's frame
    e = w * a + x * b + y * c + z * d
    f = w * b - x * a - y * d + z * c
    g = w * c + x * d - y * a - z * b
    h = w * d - x * c + y * b - z * a
    way_x, way_y, way_z = _rotate_vector(
        e, f, g, h, 1.0 if own == 0 else 0.0, 1.0 if own == 1 else 0.0, 1.0 if own == 2 else 0.0
    )
    along = way_x if line == 0 else (way_y if line == 1 else way_z)
    if abs(along) < max(grip[MIN_COSINE], 1.0e-6):
        return UNCHANGED
    level = to_x if line == 0 else (to_y if line == 1 else to_z)
    far = (grip[POCKET_CENTRE + line] - level) / along
    if not grip[REACH_START] <= far <= grip[REACH_STOP]:
        return UNCHANGED
    for k in range(3):
        at = to_x + far * way_x if k == 0 else (to_y + far * way_y if k == 1 else to_z + far * way_z)
        if k != line and not abs(at - grip[POCKET_CENTRE + k]) < grip[POCKET_HALF_SIZE + k]:
            return UNCHANGED
    row[0], row[1], row[2] = 0.0, 0.0, 0.0  # the anchor: the object's origin
    row[3], row[4], row[5] = to_x, to_y, to_z
    row[6], row[7], row[8], row[9] = e, f, g, h
    row[10] = 1.0  # m: torque per force of the weld, MuJoCo's default
    return TAKEN


@compile_without_allocation
def _rotate_vector(w, x, y, z, vx, vy, vz):
    """Return the vector (vx, vy, vz), rotated by the unit quaternion (w, x, y, z)."""
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


_MAX_LOG_ANGLE = math.radians(20.0)  # rad: largest angle between a log and the jaws' axis
_LOG_END_LENGTH = 0.3  # m: length at a log's end at which it cannot be held


def timber_log_grip_parameters(model: mujoco.MjModel, log: LogOnGround) -> np.ndarray:
    """Return the conditions under which a grab takes or releases a timber log, for `grip_step`.

    The log may be inclined to the pocket by 20 deg. It cannot be held within 0.3 m of its ends.

    Args:
        model: model of the machine. The box site `<grab>_pocket` is the space between the jaws:
            logs lie along its y axis, with a jaw on either side in z. In x it extends from the head
            to the tips of the jaws.
        log: the log.

    Returns:
        (GRIP_SIZE,) parameters.
    """
    site, radius = model.site(f"{log.grab}_pocket"), log.diameter / 2.0
    low, high = site.pos - site.size + (radius, 0, radius), site.pos + site.size - (0, 0, radius)
    reach = log.length / 2.0 - _LOG_END_LENGTH
    return grip_parameters(
        log.closed_angle,
        log.open_angle,
        1,
        _MAX_LOG_ANGLE,
        0.5 * (low + high),
        0.5 * (high - low),
        0,
        (-reach, reach),
    )

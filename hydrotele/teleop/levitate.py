"""Control of a joystick that stands alone: sensed pose to coil currents, once per period.

Every axis is the second-order system that was designed, about a remote centre of compliance at the
handle. With a hand on it `teleop.master` puts springs at the handle instead.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.machine.joystick import Joystick
from hydrotele.teleop.coils import Coils, three_stations
from hydrotele.teleop.compliance import (
    Axes,
    Flotor,
    Motion,
    compliance_wrench,
    rotation_between,
    turn_matrix,
)

FROZEN = 0.1  # s: a reading with noise is never the same for twenty periods
_NONE = np.zeros(6)


@dataclass(frozen=True)
class Levitation:
    """Numbers of the control.

    Attributes:
        body: what the control takes the flotor for, in the coils' frame.
        axes: the designed second-order systems.
        coils: the coils.
        handle: (3,) centre of compliance in the coils' frame [m].
        period: of the control [s].
        frozen: time for which a reading may stay the same to the last digit [s].
    """

    body: Flotor
    axes: Axes
    coils: Coils
    handle: np.ndarray
    period: float
    frozen: float = FROZEN


class Remembered(NamedTuple):
    """What the control keeps from period to period.

    Attributes:
        place: (3,) last reading of the coils' frame [m]; NaN where there was none.
        quaternion: (4,) its orientation, scalar first.
        same: time for which the reading has not changed [s].
    """

    place: np.ndarray
    quaternion: np.ndarray
    same: float


class Levitated(NamedTuple):
    """What the coils get.

    Attributes:
        currents: (6,) [A].
        limited: whether they had to be made smaller.
        blind: whether they are off because the reading is no number, or frozen.
    """

    currents: np.ndarray
    limited: bool
    blind: bool


def levitation(
    joystick: Joystick, body: Flotor | None = None, frozen: float = FROZEN
) -> Levitation:
    """Control of a joystick.

    Args:
        joystick: the joystick.
        body: what the control takes the flotor for; the true numbers by default.
        frozen: time for which a reading may stay the same to the last digit [s].

    Returns:
        The numbers.

    Raises:
        InputError: numbers that make no sense.
    """
    f, c, alone = joystick.flotor, joystick.coils, joystick.alone
    own = Flotor(f.mass, np.array(f.com), np.diag(f.inertia))
    return Levitation(
        body=body or own,
        axes=Axes(np.array(alone.frequency), np.array(alone.ratio)),
        coils=three_stations(c.radius, c.force_per_ampere, c.max_current),
        handle=np.array(f.handle),
        period=1.0 / joystick.control_rate,
        frozen=frozen,
    )


def nothing_remembered() -> Remembered:
    """What the control knows before its first reading."""
    return Remembered(np.full(3, np.nan), np.full(4, np.nan), 0.0)


def levitation_step(
    control: Levitation, before: Remembered, place: np.ndarray, quaternion: np.ndarray,
    target: np.ndarray, turned: np.ndarray,
) -> tuple[Remembered, Levitated]:  # fmt: skip
    """One period: velocities by differences, wrench, currents.

    A reading that is no number, or has been the same for longer than noise allows, switches the
    coils off, so that nobody is pushed by what is not measured; the flotor then sinks onto its
    stops. With good readings it rises again, from rest.

    Args:
        control: the numbers.
        before: what was remembered.
        place: (3,) reading of the coils' frame, from the handle's centre [m].
        quaternion: (4,) reading of its orientation, scalar first.
        target: (3,) where the handle should be, from its centre [m].
        turned: (4,) orientation that the flotor should have, scalar first.

    Returns:
        What to remember, and the currents.

    Source: Zhu 1994, 5.1.3.
    """
    if not (np.isfinite(place).all() and np.isfinite(quaternion).all()):
        return nothing_remembered(), Levitated(_NONE, True, True)
    same = np.array_equal(place, before.place) and np.array_equal(quaternion, before.quaternion)
    after = Remembered(place, quaternion, before.same + control.period if same else 0.0)
    if after.same > control.frozen:
        return after, Levitated(_NONE, True, True)
    velocity, rate = np.zeros(3), np.zeros(3)
    if np.isfinite(before.place).all():
        velocity = (place - before.place) / control.period
        rate = 2.0 * rotation_between(before.quaternion, quaternion)[1] / control.period
    motion = Motion(place, quaternion, velocity, rate)
    wrench = compliance_wrench(control.body, control.axes, control.handle, motion, target, turned)
    found = control.coils.currents(wrench)
    return after, Levitated(found.value, found.limited, False)


def coils_from_handle(handle: np.ndarray, place: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Place of the coils' frame (3,) [m].

    Args:
        handle: (3,) the handle's point in the coils' frame [m].
        place: (3,) of the handle [m].
        quaternion: (4,) scalar first.
    """
    turn = np.empty((3, 3))
    turn_matrix(quaternion, turn)
    return place - turn @ handle

"""Lorentz coils of a magnetically levitated joystick: map currents to a wrench, and the inverse.

A coil in the field of its magnets pushes the flotor in a fixed direction, with a force that is
proportional to its current. Six coils produce any force f and torque tau on the flotor, the moving
part of the joystick: `[f; tau] = M I` with the currents I.

The currents heat the coils, which limits them over minutes. Detents reduce this heating: Zhu 1994,
6.3, "a stiff joystick could easily cause heating problem".
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError

_WHERE = "coils"
_MAX_CONDITION_NUMBER = 1e6  # condition number above which six coils do not span all wrenches


class CoilCurrents(NamedTuple):
    """Coil currents for a requested wrench.

    Attributes:
        value: (6,) currents [A].
        is_limited: whether the wrench was reduced because a current exceeded its limit.
    """

    value: np.ndarray
    is_limited: bool


@dataclass(frozen=True)
class Coils:
    """Position, direction and limits of the six coils that are fixed to the flotor.

    Attributes:
        position: (6, 3) centres of the coils in the flotor's frame [m].
        direction: (6, 3) unit vectors of the coil forces in the flotor's frame.
        force_per_ampere: force per current of every coil [N/A].
        max_current: limit of the magnitude of each coil's current [A].
    """

    position: np.ndarray
    direction: np.ndarray
    force_per_ampere: float
    max_current: float

    def __post_init__(self) -> None:
        """Raise InputError unless there are six coils with six independent wrenches."""
        shapes = (np.shape(self.position), np.shape(self.direction))
        if shapes != ((6, 3), (6, 3)):
            raise InputError(_WHERE, f"expected six positions and directions, got shapes {shapes}")
        if not np.allclose(np.linalg.norm(self.direction, axis=1), 1.0, atol=1e-9):
            raise InputError(_WHERE, "directions must have length 1")
        if not (self.force_per_ampere > 0.0 and self.max_current > 0.0):
            raise InputError(
                _WHERE, "force per ampere and maximum current must be positive:"
                f" {self.force_per_ampere} N/A, {self.max_current} A",
            )  # fmt: skip
        if not self.condition < _MAX_CONDITION_NUMBER:
            raise InputError(_WHERE, "these coils cannot produce every force and torque")

    @property
    def wrench_map(self) -> np.ndarray:
        """Matrix (6, 6) that maps coil currents [A] to force [N] and torque [N m] on the flotor.

        Both are in the axes of the flotor's frame; the torque is about its origin.
        """
        force = self.force_per_ampere * np.asarray(self.direction, float)
        return np.vstack([force.T, np.cross(self.position, force).T])

    @property
    def condition(self) -> float:
        """Condition number of `wrench_map`, with torques divided by the coils' mean distance.

        A large number means that some force or torque needs very large currents.
        """
        arm = float(np.mean(np.linalg.norm(self.position, axis=1)))
        scale = np.array([1.0, 1.0, 1.0, *([1.0 / max(arm, 1e-12)] * 3)])
        return float(np.linalg.cond(scale[:, None] * self.wrench_map))

    def compute_wrench(self, currents: np.ndarray) -> np.ndarray:
        """Return the force [N] and torque [N m] (6,) that currents (6,) [A] produce.

        Each current is first limited to `max_current`.
        """
        limit = self.max_current
        return self.wrench_map @ np.clip(np.asarray(currents, float), -limit, limit)

    def compute_currents(self, wrench: np.ndarray) -> CoilCurrents:
        """Compute the coil currents that produce a force and torque on the flotor.

        A wrench above the limits is scaled down as a whole, so that it keeps its direction. Coils
        that saturate one by one would twist the operator's hand.

        Args:
            wrench: (6,) force [N] and torque about the frame's origin [N m].

        Returns:
            The currents, and whether the wrench was scaled down. For a wrench that is not finite
            the currents are zero and count as scaled down.

        Source: Zhu 1994, chapter 5 (force to coil currents).
        """
        wanted = np.asarray(wrench, float)
        if not np.isfinite(wanted).all():
            return CoilCurrents(np.zeros(6), True)
        value = np.linalg.solve(self.wrench_map, wanted)
        over = float(np.abs(value).max() / self.max_current)
        return CoilCurrents(value / over, True) if over > 1.0 else CoilCurrents(value, False)


def make_three_station_coils(radius: float, force_per_ampere: float, max_current: float) -> Coils:
    """Create the six coils of three stations at 120 degrees, one vertical and one tangential each.

    With torques divided by the radius, the condition number is the square root of 2.

    Args:
        radius: radius of the stations [m].
        force_per_ampere: force per current of every coil [N/A].
        max_current: limit of every coil [A].

    Returns:
        The coils.

    >>> round(make_three_station_coils(0.05, 8.0, 4.0).condition, 6)
    1.414214
    """
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    c, s, none = np.cos(angles), np.sin(angles), np.zeros(3)
    places = radius * np.column_stack([c, s, none])
    up, around = np.tile([0.0, 0.0, 1.0], (3, 1)), np.column_stack([-s, c, none])
    return Coils(np.vstack([places, places]), np.vstack([up, around]), force_per_ampere, max_current)


def relative_heating(currents: np.ndarray, max_continuous_current: float) -> float:
    """Return the steady-state temperature rise of the hottest coil, relative to its permitted rise.

    Args:
        currents: (6,) constant or root-mean-square currents [A].
        max_continuous_current: maximum continuous current [A].

    Returns:
        Ratio [1]; above 1 the coils overheat.

    >>> relative_heating(np.array([0.0, 3.0, -4.0, 0.0, 0.0, 0.0]), 2.0)
    4.0
    """
    return float(np.max(np.square(np.asarray(currents, float) / max_continuous_current)))


def time_to_overheat(currents: np.ndarray, max_continuous_current: float, time_constant: float) -> float:
    """Return the time after which cold coils reach their permitted temperature at given currents.

    Args:
        currents: (6,) constant currents [A].
        max_continuous_current: maximum continuous current [A].
        time_constant: thermal time constant of the winding [s].

    Returns:
        Time [s]; infinite if they can carry the currents continuously.

    Source: first-order heating as in `simulate.joystick.heat_step`.

    >>> round(time_to_overheat(np.full(6, 4.0), 2.0, 60.0), 3)
    17.261
    """
    end = relative_heating(currents, max_continuous_current)
    return float(-time_constant * np.log1p(-1.0 / end)) if end > 1.0 else float("inf")

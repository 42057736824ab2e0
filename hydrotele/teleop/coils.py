"""Lorentz coils of a magnetically levitated joystick: currents to wrench, and back within limits.

A coil in its magnets' field pushes the flotor in a fixed direction, as hard as its current. Six of
them make any force and torque: `[f; tau] = M I`.

Currents heat the coils, which is what limits them over minutes, and what detents are for: Zhu 1994,
6.3, "a stiff joystick could easily cause heating problem".
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError

_WHERE = "coils"
_SINGULAR = 1e6  # condition beyond which six coils do not make six directions


class Currents(NamedTuple):
    """Coil currents (6,) [A], and whether the wrench asked for had to be made smaller."""

    value: np.ndarray
    limited: bool


@dataclass(frozen=True)
class Coils:
    """Six coils fixed to the flotor.

    Attributes:
        position: (6, 3) of the coils' centres in the flotor's frame [m].
        direction: (6, 3) unit vectors along which they push.
        force_per_ampere: [N/A].
        max_current: of each coil, either way [A].
    """

    position: np.ndarray
    direction: np.ndarray
    force_per_ampere: float
    max_current: float

    def __post_init__(self) -> None:
        """Refuse other than six coils that make six independent wrenches."""
        shapes = (np.shape(self.position), np.shape(self.direction))
        if shapes != ((6, 3), (6, 3)):
            raise InputError(_WHERE, f"six positions and directions are needed, got {shapes}")
        if not np.allclose(np.linalg.norm(self.direction, axis=1), 1.0, atol=1e-9):
            raise InputError(_WHERE, "directions must have length 1")
        if not (self.force_per_ampere > 0.0 and self.max_current > 0.0):
            raise InputError(
                _WHERE, "force per ampere and largest current must be positive:"
                f" {self.force_per_ampere} N/A, {self.max_current} A",
            )  # fmt: skip
        if not self.condition < _SINGULAR:
            raise InputError(_WHERE, "these coils do not make every force and torque")

    @property
    def wrench_map(self) -> np.ndarray:
        """M (6, 6): force [N] and torque about the frame's origin [N m] per ampere."""
        force = self.force_per_ampere * np.asarray(self.direction, float)
        return np.vstack([force.T, np.cross(self.position, force).T])

    @property
    def condition(self) -> float:
        """Condition of the map, with torques counted as forces on the coils' mean distance."""
        arm = float(np.mean(np.linalg.norm(self.position, axis=1)))
        scale = np.array([1.0, 1.0, 1.0, *([1.0 / max(arm, 1e-12)] * 3)])
        return float(np.linalg.cond(scale[:, None] * self.wrench_map))

    def wrench(self, currents: np.ndarray) -> np.ndarray:
        """Force and torque (6,) [N], [N m] of currents (6,) [A], cut at what coils can take."""
        limit = self.max_current
        return self.wrench_map @ np.clip(np.asarray(currents, float), -limit, limit)

    def currents(self, wrench: np.ndarray) -> Currents:
        """Currents for a force and torque.

        One that is too large is made smaller as a whole, so that it keeps its direction: coils that
        saturate one by one would twist the hand.

        Args:
            wrench: (6,) force [N] and torque about the frame's origin [N m].

        Returns:
            The currents, and whether the wrench was made smaller. Of a wrench that is not finite
            there are none.

        Source: Zhu 1994, chapter 5 (force to coil currents).
        """
        wanted = np.asarray(wrench, float)
        if not np.isfinite(wanted).all():
            return Currents(np.zeros(6), True)
        value = np.linalg.solve(self.wrench_map, wanted)
        over = float(np.abs(value).max() / self.max_current)
        return Currents(value / over, True) if over > 1.0 else Currents(value, False)


def three_stations(radius: float, force_per_ampere: float, max_current: float) -> Coils:
    """Three stations at 120 degrees, each with a coil that pushes up and one that pushes around.

    With torques counted on the radius its condition is the root of 2.

    Args:
        radius: of the stations [m].
        force_per_ampere: of every coil [N/A].
        max_current: of every coil [A].

    Returns:
        The coils.

    >>> round(three_stations(0.05, 8.0, 4.0).condition, 6)
    1.414214
    """
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    c, s, none = np.cos(angles), np.sin(angles), np.zeros(3)
    places = radius * np.column_stack([c, s, none])
    up, around = np.tile([0.0, 0.0, 1.0], (3, 1)), np.column_stack([-s, c, none])
    return Coils(
        np.vstack([places, places]), np.vstack([up, around]), force_per_ampere, max_current
    )


def heating(currents: np.ndarray, continuous: float) -> float:
    """Rise of the hottest coil's temperature in the end, over what it may have for ever.

    Args:
        currents: (6,) held, or root mean squares [A].
        continuous: largest current for ever [A].

    Returns:
        [1]; beyond 1 the coils must be let cool.

    >>> heating(np.array([0.0, 3.0, -4.0, 0.0, 0.0, 0.0]), 2.0)
    4.0
    """
    return float(np.max(np.square(np.asarray(currents, float) / continuous)))


def seconds_until_hot(currents: np.ndarray, continuous: float, time_constant: float) -> float:
    """Time that cold coils bear currents.

    Args:
        currents: (6,) held [A].
        continuous: largest current for ever [A].
        time_constant: of the winding [s].

    Returns:
        [s]; infinite if they bear them for ever.

    Source: `simulate.joystick.heat_step`.

    >>> round(seconds_until_hot(np.full(6, 4.0), 2.0, 60.0), 3)
    17.261
    """
    end = heating(currents, continuous)
    return float(-time_constant * np.log1p(-1.0 / end)) if end > 1.0 else float("inf")

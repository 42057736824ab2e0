"""Worst case of stiffness feedback: a spring that is soft outwards and stiff inwards.

If a spring's stiffness may change at any time between two bounds, this switching adds the most
energy to the motion. At every point it turns the phase-plane path outwards as far as possible. A
joystick that is stable with it is stable with every contact and delay within the bounds, for the
given mass, damper and spring of the hand. Other hands need a separate analysis.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.teleop.two_port import Impedance, stability_theorem_margin

_STEP_RATIO = 0.01  # integration steps per time constant of the fastest mode
_MIN_MOTION_RATIO = 1e-9  # minimum speed or displacement, relative to the start of a half swing
_MAX_STEPS = 10_000_000


@dataclass(frozen=True)
class StiffnessAxis:
    """A joystick axis whose stiffness follows a force within bounds (stiffness feedback).

    Attributes:
        mass: mass M of the moving part [kg].
        damping: damping B [N s/m].
        nominal_stiffness: stiffness without contact [N/m].
        min_stiffness: lower bound K_min of the stiffness [N/m].
        max_stiffness: upper bound K_max of the stiffness [N/m].
    """

    mass: float
    damping: float
    nominal_stiffness: float
    min_stiffness: float
    max_stiffness: float

    def __post_init__(self) -> None:
        """Raise InputError unless mass, damping and stiffness range are valid."""
        if not (self.mass > 0.0 and self.damping >= 0.0):
            raise InputError("stiffness", "mass must be positive, damping not negative")
        if not 0.0 <= self.min_stiffness <= self.nominal_stiffness <= self.max_stiffness:
            raise InputError(
                "stiffness", "must be ordered, 0 <= min_stiffness <= nominal_stiffness <= max_stiffness:"
                f" {self.min_stiffness:g}, {self.nominal_stiffness:g}, {self.max_stiffness:g}",
            )  # fmt: skip

    def with_hand(self, hand: Impedance) -> "StiffnessAxis":
        """Return a copy of the axis with the mass, damping and stiffness of a hand added."""
        stiff = hand.stiffness
        return StiffnessAxis(
            self.mass + hand.mass, self.damping + hand.damping, self.nominal_stiffness + stiff,
            self.min_stiffness + stiff, self.max_stiffness + stiff,
        )  # fmt: skip

    @property
    def stability_theorem_margin(self) -> float:
        """Margin `B^2 - 4 M K_max` of the stability theorem of stiffness feedback [(N s/m)^2].

        The axis is stable with every change of the stiffness between K_min and K_max if the margin,
        B and K_min are positive. The condition is sufficient, not necessary (Zhu 1994, 4.14).
        """
        return stability_theorem_margin(self.mass, self.damping, self.max_stiffness)

    @property
    def stability_criterion(self) -> str:
        """Name of the criterion that proves stability: `theorem`, `switching bound`, or `nothing`.

        Theorem 4-2 (Zhu 1994) requires `B > 0`, `K_min > 0` and `B^2 > 4 M K_max`. The switching bound
        requires that the motion under the worst switching decays, which is necessary and
        sufficient.
        """
        if self.min_stiffness > 0.0 and self.damping > 0.0 and self.stability_theorem_margin > 0.0:
            return "theorem"
        return "switching bound" if self.min_stiffness > 0.0 and self.half_swing_growth < 1.0 else "nothing"

    @property
    def min_stable_damping(self) -> float:
        """Damping at which motion under the worst stiffness switching keeps its size [N s/m].

        With more damping the motion decays. The value is infinite if the minimum stiffness is 0,
        and 0 if minimum and maximum stiffness are equal.
        """
        if self.min_stiffness <= 0.0:
            return math.inf
        if self.min_stiffness == self.max_stiffness:
            return 0.0

        def growth_minus_one(damping: float) -> float:
            return worst_switching_growth(self.mass, damping, self.min_stiffness, self.max_stiffness) - 1.0

        most = self.stability_theorem_damping
        found: float = brentq(growth_minus_one, 0.0, most, xtol=1e-3 * most)  # pyright: ignore - not full
        return found

    @property
    def half_swing_growth(self) -> float:
        """Factor by which the worst stiffness switching changes the speed in half a swing [1]; stable below 1."""
        return worst_switching_growth(self.mass, self.damping, self.min_stiffness, self.max_stiffness)

    @property
    def stability_theorem_damping(self) -> float:
        """Damping above which the stability theorem holds, `2 sqrt(M K_max)` [N s/m]."""
        return 2.0 * math.sqrt(self.mass * self.max_stiffness)


def worst_switching_growth(mass: float, damping: float, min_stiffness: float, max_stiffness: float) -> float:
    """Return the growth of a spring's speed over half a swing, under the worst stiffness switching.

    The stiffness is lowest while the mass moves outwards, and highest while it returns. The motion is
    linear between switches, so that every half swing grows by the same factor. Below 1 the axis comes
    to rest for any change of the stiffness.

    Args:
        mass: mass of the axis [kg].
        damping: damping of the axis [N s/m].
        min_stiffness: stiffness outwards, the lower bound K_min [N/m].
        max_stiffness: stiffness inwards, the upper bound K_max [N/m].

    Returns:
        Speed through the centre relative to that half a swing earlier [1]; 0 if it does not return
        to the centre, infinite if it never turns.

    Source: Zhu 1994, 4.2 (the switching that drives a spring unstable).

    >>> round(worst_switching_growth(1.0, 0.0, 100.0, 400.0), 3)
    2.0
    >>> worst_switching_growth(1.0, 41.0, 20.0, 400.0)
    0.0
    """
    if min_stiffness == 0.0 and damping == 0.0:
        return math.inf
    rate = max(damping / mass, math.sqrt(max_stiffness / mass))
    return float(_simulate_half_swing(damping / mass, min_stiffness / mass, max_stiffness / mass, _STEP_RATIO / rate))


def compute_switching_growth_map(mass: float, least: float, dampings: np.ndarray, stiffest: np.ndarray) -> np.ndarray:
    """Compute the growth of an oscillation's speed on a grid of damping and maximum stiffness.

    The stiffness switches between its bounds in the worst way: the lower bound while the mass moves
    away from the centre, the upper bound while it returns.

    Args:
        mass: mass of the axis [kg].
        least: lower bound K_min of the stiffness [N/m].
        dampings: (n,) dampings [N s/m].
        stiffest: (m,) upper bounds K_max of the stiffness [N/m], none below K_min.

    Returns:
        (m, n) growth of the speed over half a swing [1]; the axis is stable below 1.
    """
    return np.array([[worst_switching_growth(mass, b, least, k) for b in dampings] for k in stiffest])


@compiled
def _simulate_half_swing(damping, least, most, step):
    x, v = 0.0, 1.0
    for _ in range(_MAX_STEPS):
        if v <= _MIN_MOTION_RATIO:
            break
        x, v = _runge_kutta(x, v, damping, least, step)
    peak, v = x, min(v, 0.0)
    for _ in range(_MAX_STEPS):
        if x <= 0.0:
            return -v
        if x < _MIN_MOTION_RATIO * peak:
            break
        x, v = _runge_kutta(x, v, damping, most, step)
    return 0.0


@compiled
def _runge_kutta(x, v, damping, stiffness, step):
    a = -damping * v - stiffness * x
    x2, v2 = x + 0.5 * step * v, v + 0.5 * step * a
    a2 = -damping * v2 - stiffness * x2
    x3, v3 = x + 0.5 * step * v2, v + 0.5 * step * a2
    a3 = -damping * v3 - stiffness * x3
    x4, v4 = x + step * v3, v + step * a3
    a4 = -damping * v4 - stiffness * x4
    return (
        x + step / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4),
        v + step / 6.0 * (a + 2.0 * a2 + 2.0 * a3 + a4),
    )

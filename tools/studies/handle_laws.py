"""Force laws of a joystick axis: stiffness feedback, and a detent at the edge of the dead band."""

import math
from dataclasses import dataclass

from hydrotele.core.errors import InputError

_WHERE = "joystick axis"


@dataclass(frozen=True)
class StiffnessFeedback:
    """A spring that stiffens with the force at the machine, in one axis of the joystick.

    Units are those of the axis: N, m or N m, rad.

    Attributes:
        nominal: stiffness without contact, K_nom.
        least: K_min, at least 0.
        most: K_max.
        ratio: of stiffness to contact force, K_r.
        damping: K_d.
        force_limit: contact force beyond which it counts no more.
        deadband: displacement in which no command goes out.
    """

    nominal: float
    least: float
    most: float
    ratio: float
    damping: float
    force_limit: float
    deadband: float = 0.0

    def __post_init__(self) -> None:
        """Refuse stiffnesses out of order and negative sizes."""
        numbers = (self.nominal, self.least, self.most, self.ratio, self.damping)
        if not all(map(math.isfinite, (*numbers, self.force_limit, self.deadband))):
            raise InputError(_WHERE, f"gains must be finite: {self}")
        if not 0.0 <= self.least <= self.nominal <= self.most:
            raise InputError(
                _WHERE, "stiffnesses must be ordered, 0 <= least <= nominal <= most:"
                f" {self.least:g}, {self.nominal:g}, {self.most:g}",
            )  # fmt: skip
        if min(self.damping, self.force_limit, self.deadband, self.ratio) < 0.0:
            raise InputError(_WHERE, f"damping, ratio, limit and dead band must be >= 0: {self}")

    def stiffness(self, displacement: float, contact: float) -> float:
        """Stiffness of the spring.

        Args:
            displacement: of the handle.
            contact: force that the machine feels, positive against a positive command; one that is
                not a number, of a sensor that failed, counts as none.

        Returns:
            `K_nom + K_r f sgn(x)`, within its bounds.

        Source: Zhu 1994, 4.1 and Fig. 4.24.
        """
        force = contact if math.isfinite(contact) else 0.0
        force = max(-self.force_limit, min(self.force_limit, force))
        way = 0.0 if displacement == 0.0 else math.copysign(1.0, displacement)
        return max(self.least, min(self.most, self.nominal + self.ratio * force * way))

    def force(self, displacement: float, velocity: float, contact: float) -> float:
        """Force on the hand, back to the centre.

        Args:
            displacement: of the handle.
            velocity: of the handle.
            contact: as of `stiffness`.

        Returns:
            `-K x - K_d v`.
        """
        return -self.stiffness(displacement, contact) * displacement - self.damping * velocity

    def command(self, displacement: float) -> float:
        """Displacement beyond the dead band: what the machine is told."""
        beyond = abs(displacement) - self.deadband
        return math.copysign(max(beyond, 0.0), displacement)


@dataclass(frozen=True)
class Detent:
    """A spring with a notch: firm in the dead band, a drop at its edge, softer outside.

    Attributes:
        deadband: half of the notch [m] or [rad].
        drop: of the force at its edge [N] or [N m]; at most what the spring has there.
        inside: stiffness in the notch [N/m] or [N m/rad].
        outside: stiffness beyond it.
    """

    deadband: float
    drop: float
    inside: float
    outside: float

    def __post_init__(self) -> None:
        """Refuse what would push the handle away from the centre."""
        if not min(self.deadband, self.drop, self.inside, self.outside) >= 0.0:
            raise InputError(_WHERE, f"a detent has no negative numbers: {self}")
        if self.drop > self.inside * self.deadband:
            raise InputError(
                _WHERE, f"a drop of {self.drop:g} is more than the {self.inside * self.deadband:g}"
                " that the spring has at the edge: the handle would be pushed outwards",
            )  # fmt: skip

    def force(self, displacement: float) -> float:
        """Spring force on the hand, back to the centre [N] or [N m].

        Source: Zhu 1994, Fig. 6.51 and Table 6.11.

        >>> notch = Detent(deadband=1.5e-3, drop=2.0, inside=4e3, outside=300.0)
        >>> [round(notch.force(x), 3) for x in (1e-3, 1.5e-3, 1.6e-3, -1.6e-3)]
        [-4.0, -6.0, -4.03, 4.03]
        """
        beyond = abs(displacement) - self.deadband
        if beyond <= 0.0:
            return -self.inside * displacement
        size = self.inside * self.deadband - self.drop + self.outside * beyond
        return -math.copysign(size, displacement)

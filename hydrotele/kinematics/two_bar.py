"""A cylinder across one joint: joint angle to pin-to-pin length and back."""

import math
from dataclasses import dataclass

from hydrotele.kinematics.triangle import Point, Scalar, apex_angle, library


@dataclass(frozen=True)
class TwoBar:
    """A cylinder across one joint with included angle B = direction * theta + angle_offset.

    Valid for B in (0, pi); at 0 and pi the moment arm is zero and the cylinder cannot hold.
    Source: Khoshzaban 1992 Eq. 3.26, Zhu 1994 Eq. 6.13.

    Attributes:
        lower: joint to cylinder pin on the inboard link [m], > 0.
        upper: joint to cylinder pin on the outboard link [m], > 0.
        angle_offset: included angle at theta = 0 [rad].
        direction: +1 if the cylinder extends as theta grows, -1 if it retracts [-].
    """

    lower: float
    upper: float
    angle_offset: float
    direction: int = 1

    def __post_init__(self) -> None:
        """Refuse bars without length and a direction that is no sign."""
        if self.lower <= 0 or self.upper <= 0:
            raise ValueError(
                f"two-bar lengths must be positive, got lower={self.lower} upper={self.upper}"
            )
        if self.direction not in (1, -1):
            raise ValueError(f"two-bar direction must be +1 or -1, got {self.direction}")

    def length(self, theta: Scalar) -> Scalar:
        """Pin-to-pin length c = sqrt((a - b)^2 + 4 a b sin(B/2)^2), the cosine law (K Eq. 3.26).

        Args:
            theta: joint angle, any shape [rad].

        Returns:
            Pin-to-pin length, shape of theta [m].

        >>> boom = TwoBar(0.625, 2.000, math.radians(78.6), 1)
        >>> round(boom.length(math.radians(27.8)), 6)
        2.257538
        """
        m = library(theta)
        chord = 2 * m.sin(0.5 * (self.direction * theta + self.angle_offset))
        return m.sqrt((self.lower - self.upper) ** 2 + self.lower * self.upper * chord**2)

    def rate(self, theta: Scalar) -> Scalar:
        """Signed moment arm dc/dtheta = direction a b sin(B) / c (Zhu Eq. 6.13).

        Args:
            theta: joint angle, any shape [rad].

        Returns:
            Moment arm, shape of theta [m/rad]; positive if the cylinder extends as theta grows.

        >>> round(TwoBar(0.625, 2.000, math.radians(78.6), 1).rate(math.radians(27.8)), 6)
        0.531173
        """
        m = library(theta)
        included = self.direction * theta + self.angle_offset
        return self.direction * self.lower * self.upper * m.sin(included) / self.length(theta)

    def angle(self, length: Scalar) -> Scalar:
        """Joint angle, theta = direction (B - angle_offset), on the branch B in [0, pi].

        tan(B/2)^2 = (c^2 - (a - b)^2) / ((a + b)^2 - c^2), which needs no arc cosine.

        Args:
            length: pin-to-pin length, any shape [m], in [|a - b|, a + b].

        Returns:
            Joint angle, shape of length [rad].

        Raises:
            LoopOpen: a length lies outside [|a - b|, a + b].

        >>> boom = TwoBar(0.625, 2.000, math.radians(78.6), 1)
        >>> round(math.degrees(boom.angle(2.2575379)), 4)
        27.8
        """
        return self.direction * (apex_angle(self.lower, self.upper, length) - self.angle_offset)


def two_bar_from_points(base_pin: Point, rod_pin: Point, working_angle: float = 0.0) -> TwoBar:
    """Two-bar linkage from its two cylinder pins, seen from the joint.

    B = |polar(rod) + theta - polar(base)|; the sign of the difference at the working angle is the
    direction.

    Args:
        base_pin: (x, z) of one cylinder pin in the inboard link's axes, from the joint [m].
        rod_pin: (x, z) of the other cylinder pin in the outboard link's axes, from the joint [m].
        working_angle: any joint angle inside the working range [rad].

    Returns:
        The linkage, with B in (0, pi) at the working angle.

    Raises:
        ValueError: the joint and both pins are in line at the working angle, so the direction is
            open.

    >>> two_bar_from_points((-2.0, 0.0), (0.0, 0.5), working_angle=-0.5)
    TwoBar(lower=2.0, upper=0.5, angle_offset=1.5707963267948966, direction=-1)
    """
    offset = math.atan2(rod_pin[1], rod_pin[0]) - math.atan2(base_pin[1], base_pin[0])
    included = math.remainder(offset + working_angle, math.tau)
    if abs(math.sin(included)) < 1e-9:
        raise ValueError(
            f"joint and cylinder pins are in line at working angle {working_angle}, give another"
        )
    direction = 1 if included > 0 else -1
    return TwoBar(
        math.hypot(*base_pin),
        math.hypot(*rod_pin),
        direction * (included - working_angle),
        direction,
    )

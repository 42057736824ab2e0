"""Facts of what is around a machine: plates to press on, trees, logs. All SI, frozen."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive, Vector


class Plate(Facts):
    """A plate on a spring and a damper: a task of known stiffness.

    `position` [m] is the middle of its face, `normal` the way that the face looks (z up, x back
    towards the machine is -x); half sizes [m], mass [kg], stiffness [N/m], damping [N s/m].
    """

    kind: Literal["plate"] = "plate"
    position: Vector
    normal: Literal["x", "-x", "y", "-y", "z"] = "z"
    size: tuple[Positive, Positive] = (1.0, 1.0)
    mass: Positive = 300.0
    stiffness: Positive = 1.0e6
    damping: NonNegative = 3.0e4


class StandingTree(Facts):
    """A standing tree that a disc saw cuts from its stump and a grab arm then holds.

    `position` [m] on the ground; `kerf` [m] is the height at which it can be cut, `energy` [J/m^3]
    what cutting takes. `saw` and `grab` are axes of the machine; a grab beyond `closed` [rad] holds
    a stem that stands in its pocket.
    """

    kind: Literal["tree"] = "tree"
    position: tuple[float, float]
    diameter: Positive = 0.34
    height: Positive = 9.0
    density: Positive = 750.0
    kerf: Positive = 0.30
    energy: Positive = 2.0e7
    saw: Name = "saw"
    grab: Name = "grab"
    closed: float = 1.0


class LogOnGround(Facts):
    """A log on the ground that a grapple picks up and puts down.

    `position` [m] of its middle, `direction` [rad] of its axis in the horizontal plane, 0 along x;
    diameter and length [m], density [kg/m^3]. `grab` is the machine's axis that closes the jaw: the
    log is held beyond `closed` [rad] where it lies in the pocket, and let go below `open` [rad].
    """

    kind: Literal["log"] = "log"
    position: tuple[float, float]
    direction: float = 0.0
    diameter: Positive = 0.35
    length: Positive = 4.0
    density: Positive = 830.0
    grab: Name = "claw"
    closed: float = 1.2
    open: float = 1.0

    @model_validator(mode="after")
    def _check(self):
        if self.open > self.closed:
            raise ValueError(f"open {self.open:g} rad must not exceed closed {self.closed:g} rad")
        if self.length < 2.0 * self.diameter:
            raise ValueError(
                f"length {self.length:g} m must be at least twice the diameter {self.diameter:g} m"
            )
        return self

    @property
    def mass(self) -> float:
        """[kg]."""
        return self.density * math.pi * self.diameter**2 / 4.0 * self.length


SurroundingObject = Annotated[Plate | StandingTree | LogOnGround, Field(discriminator="kind")]

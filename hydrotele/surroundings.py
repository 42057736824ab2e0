"""Facts of what stands around a machine: plates to press on, trees to fell. All SI, frozen."""

from typing import Annotated, Literal

from pydantic import Field

from hydrotele.datafile import Facts, Name, NonNegative, Positive, Vector


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


class Tree(Facts):
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


Thing = Annotated[Plate | Tree, Field(discriminator="kind")]

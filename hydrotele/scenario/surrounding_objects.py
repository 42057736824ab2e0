"""Specification of the objects around a machine: plate, standing tree, log on the ground, soil, and truck."""

import math
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    Vector,
)
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log


class Plate(StrictModel):
    """A plate on a spring and a damper that the tool can press against: an environment of known stiffness.

    `position` [m] is the centre of its face and `normal` the outward normal of the face (z is up,
    -x points back to the machine). `size` holds the two half sizes of the face [m]. `mass` [kg] is that
    of the plate; `stiffness` [N/m] and `damping` [N s/m] are those of its spring and damper.
    """

    kind: Literal["plate"] = "plate"
    position: Vector
    normal: Literal["x", "-x", "y", "-y", "z"] = "z"
    size: tuple[PositiveFloat, PositiveFloat] = (1.0, 1.0)
    mass: PositiveFloat = 300.0
    stiffness: PositiveFloat = 1.0e6
    damping: NonNegativeFloat = 3.0e4


class StandingTree(StrictModel):
    """A standing tree that a disc saw cuts from its stump and a grab arm then holds.

    `position` [m] is the point (x, y) on the ground where the tree stands. `diameter` and `height` [m]
    and `density` [kg/m^3] are those of the stem. `cut_height` [m] is the height of the cut above
    ground, and `cutting_energy` [J/m^3] the energy per cut volume. `saw` and `grab` name the machine
    axes of disc saw and grab arm. A grab angle above `closed_angle` [rad] holds a stem that is in the
    grab's pocket.
    """

    renamed = {"kerf": "cut_height", "energy": "cutting_energy", "closed": "closed_angle"}

    kind: Literal["tree"] = "tree"
    position: tuple[float, float]
    diameter: PositiveFloat = 0.34
    height: PositiveFloat = 9.0
    density: PositiveFloat = 750.0
    cut_height: PositiveFloat = 0.30
    cutting_energy: PositiveFloat = 2.0e7
    saw: Name = "saw"
    grab: Name = "grab"
    closed_angle: float = 1.0


class LogOnGround(StrictModel):
    """A log on the ground that a grapple picks up and puts down.

    `position` [m] is the point (x, y) of the log's centre, and `direction` [rad] the angle of the log's
    axis in the horizontal plane, 0 along x. `diameter` and `length` are in [m], `density` in [kg/m^3].
    `grab` is the axis of the machine that closes the jaw. A log in the grapple's pocket is gripped at
    a jaw angle above `closed_angle` [rad] and released below `open_angle` [rad].
    """

    renamed = {"closed": "closed_angle", "open": "open_angle"}

    kind: Literal["log"] = "log"
    position: tuple[float, float]
    direction: float = 0.0
    diameter: PositiveFloat = 0.35
    length: PositiveFloat = 4.0
    density: PositiveFloat = 830.0
    grab: Name = "claw"
    closed_angle: float = 1.2
    open_angle: float = 1.0

    @model_validator(mode="after")
    def _check(self):
        if self.open_angle > self.closed_angle:
            raise ValueError(
                f"open_angle {self.open_angle:g} rad must not exceed closed_angle {self.closed_angle:g} rad"
            )
        if self.length < 2.0 * self.diameter:
            raise ValueError(f"length {self.length:g} m must be at least twice the diameter {self.diameter:g} m")
        return self

    @property
    def mass(self) -> float:
        """Mass of the log [kg]."""
        return self.density * math.pi * self.diameter**2 / 4.0 * self.length


class SoilGround(StrictModel):
    """Ground that the bucket of the machine can dig up: a strip of soil in the plane of the arm.

    `soil` selects the soil's strength parameters by name. For all other links of the machine the
    ground is firm.
    """

    kind: Literal["soil"] = "soil"
    soil: Literal["soft", "sandy_loam", "firm"] = "sandy_loam"


class DumpTruck(StrictModel):
    """A standing two-axle dump truck with a rigid open bed, against which the tool can strike.

    `position` [m] is the point (x, y) under the centre of the bed, and `direction` [rad] the angle of
    the truck's forward axis in the horizontal plane, 0 along x. `length` and `width` are inner
    dimensions of the bed, `floor_height` is the height of its floor above ground and `wall_height` that of its
    walls above the floor [m].
    """

    kind: Literal["truck"] = "truck"
    position: tuple[float, float]
    direction: float = 0.0
    length: PositiveFloat = 4.0
    width: PositiveFloat = 2.3
    floor_height: PositiveFloat = 1.3
    wall_height: PositiveFloat = 0.7


SurroundingObject = Annotated[Plate | StandingTree | LogOnGround | SoilGround | DumpTruck, Field(discriminator="kind")]


def read_soil_from_log(log: Log) -> tuple[SoilGround, ...]:
    """Return the soil that the bucket could dig in a logged run, as stored in the log's metadata.

    The result is a tuple of one soil, or an empty tuple if the run had no soil.

    Raises:
        InputError: the log's soil metadata are not valid.
    """
    if "soil" not in log.metadata:
        return ()
    try:
        return (SoilGround.model_validate_json(log.metadata["soil"]),)
    except ValidationError as error:
        raise InputError(f"{log.source}: metadata soil", f"is invalid: {error.errors()[0]['msg']}") from None

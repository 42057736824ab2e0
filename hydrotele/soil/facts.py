"""Facts of a soil, SI, and three soils to start with."""

import math
from typing import Annotated, Self

import pydantic
from pydantic import Field

from hydrotele.core.datafile import Facts

GRAVITY = 9.81  # m/s^2


class Soil(Facts):
    """A soil that follows Mohr and Coulomb, with what happens to it once it is loosened.

    Attributes:
        density: in the bank, undisturbed and moist [kg/m^3].
        cohesion: c [Pa].
        friction: angle of internal friction phi [rad].
        tool_friction: angle of friction on steel delta, at most phi [rad].
        adhesion: to steel c_a, at most the cohesion [Pa].
        swell: loose volume over bank volume [1].
        repose: angle at which loosened soil comes to rest [rad].
        cut_slope: steepest face that stands in the bank for a while [rad].
        stiffness: force per displacement before a surface has mobilised the soil [N/m].
        damping_time: of that spring [s]; at least half the time between steps keeps a force that
            is held over a step from feeding energy into a machine.
    """

    density: Annotated[float, Field(ge=800.0, le=2600.0)] = 1700.0
    cohesion: Annotated[float, Field(ge=0.0, le=2.0e5)] = 4.8e3
    friction: Annotated[float, Field(ge=math.radians(5.0), le=math.radians(45.0))] = 0.51
    tool_friction: Annotated[float, Field(ge=0.0, le=math.radians(40.0))] = 0.35
    adhesion: Annotated[float, Field(ge=0.0, le=1.0e5)] = 500.0
    swell: Annotated[float, Field(ge=1.0, le=2.0)] = 1.24
    repose: Annotated[float, Field(ge=math.radians(15.0), le=math.radians(50.0))] = 0.61
    cut_slope: Annotated[float, Field(ge=math.radians(30.0), le=math.radians(85.0))] = 1.31
    stiffness: Annotated[float, Field(ge=1.0e5, le=1.0e7)] = 3.0e6
    damping_time: Annotated[float, Field(ge=0.0, le=0.05)] = 0.01

    @pydantic.model_validator(mode="after")
    def _steel_is_smoother_than_soil(self) -> Self:
        if self.tool_friction > self.friction:
            raise ValueError("tool_friction exceeds friction: soil would fail before it slides")
        if self.adhesion > self.cohesion:
            raise ValueError("adhesion exceeds cohesion: soil would fail before it lets go")
        if self.cut_slope < self.repose:
            raise ValueError(
                "cut_slope is below repose: soil in the bank stands steeper than loose"
            )
        return self


SOILS = {
    "soft": Soil(
        density=1540.0, cohesion=1.72e3, friction=math.radians(29.0),
        tool_friction=math.radians(19.0), adhesion=200.0, swell=1.24, repose=math.radians(32.0),
        cut_slope=math.radians(65.0),
    ),
    "sandy_loam": Soil(),
    "firm": Soil(
        density=1900.0, cohesion=20.0e3, friction=math.radians(30.0),
        tool_friction=math.radians(20.0), adhesion=2.0e3, swell=1.26, repose=math.radians(37.0),
        cut_slope=math.radians(80.0),
    ),
}  # fmt: skip
"""Typical soils to start with. The numbers are as remembered of the books named here, not looked
up again: replace them by those of your ground. Soft: cohesion and friction of the sandy loam with
15 % moisture in Wong, Theory of Ground Vehicles, Table 2.3; density and swell of loam (bank 1540,
loose 1245 kg/m^3) in the Caterpillar Performance Handbook, Weights of Materials. Sandy loam,
moist: cohesion of the one with 11 % moisture there (4.83 kPa) with a friction between those of the
two. Firm: density and swell of packed earth in the Handbook (1900, 1510 kg/m^3); cohesion and
friction of a stiff sandy clay are assumed. Friction on steel is two thirds of that inside, as for
steel against sand in Terzaghi and Peck; adhesion is a tenth of the cohesion, assumed. Stiffness:
passive pressure is mobilised after some 2 % of the height of a wall (Clough and Duncan 1991), here
4 mm in 0.2 m for 12 kN."""

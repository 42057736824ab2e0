r"""Parameters of soil and bucket in SI units, their flat array, and the state of a bucket.

The module provides three typical soils and the bucket of the CAT 215. `pack_soil_parameters` packs soil,
bucket and profile into a flat array for compiled functions; constants name its indices and those of
the bucket state and of the result of a step.

Side view of the bucket:

```
             o pin        Attitude a: angle of the line pin -> edge to the horizontal, positive
             |\           with the edge raised. The mouth lies along that line and faces
             | \          (sin a, -cos a): towards the machine at -90 deg (shown here: digging),
       mouth |  ) shell   straight up at -180 deg (curled in: carrying), straight down at 0
             | /          (dumping).
             |/ rake
 machine <-- +-------     edge
```

The machine is on the left, and the radius increases to the right. The floor runs from the edge back
into the shell, at the angle `floor_angle` to the mouth. Seen from the edge it rises outwards at
`rake = a + 180 deg - floor_angle`. This is the rake of a blade that is drawn towards the machine:
90 deg is an upright wall, 0 a level floor that only slides, and below 0 the heel is deeper than the
edge.

| attitude [deg] | rake | |
| ---: | ---: | --- |
| -45 | 93 | upright blade; all soil falls out |
| -75 | 63 | enters the ground |
| -90 | 48 | cuts; holds only soil that the ground ahead supports |
| -110 | 28 | cuts at a flat angle, starts to hold soil |
| -138 | 0 | floor level: grading; holds nearly a struck load |
| -170 .. -190 | -32 .. | carries a heaped load |
"""

import math
from typing import Annotated, NamedTuple, Self

import numpy as np
import pydantic
from pydantic import Field

from hydrotele.core.datafile import StrictModel
from hydrotele.core.errors import InputError


class Bucket(NamedTuple):
    """Side view of a bucket in its own frame: x from pin to edge, z up [m].

    Attributes:
        outline: ((x, z), ...) corners of the interior, from the edge along floor and shell to the
            rim next to the pin; the mouth closes it.
        heel: (x, z) of the lowest point of the curled-in bucket.
        floor_angle: angle between mouth and floor at the edge [rad].
        floor_length: length of the flat floor [m].
        width: width of the cut [m].
        inner_width: width of the interior [m].
        edge: thickness of the cutting edge [m].
    """

    outline: tuple[tuple[float, float], ...]
    heel: tuple[float, float]
    floor_angle: float
    floor_length: float
    width: float
    inner_width: float
    edge: float


CAT215 = Bucket(
    outline=(
        (1.35, 0.0), (0.74, 0.55), (0.57, 0.635), (0.40, 0.64), (0.25, 0.57), (0.14, 0.44),
        (0.085, 0.28), (0.10, 0.06),
    ),
    heel=(0.57, 0.65),
    floor_angle=0.7389,
    floor_length=0.85,
    width=1.2,
    inner_width=1.168,
    edge=0.03,
)  # fmt: skip
"""Bucket of the CAT 215, from the side plates, floor and teeth in models/cat215/cat215.xml; the
edge thickness is assumed. It holds 0.59 m^3 struck and 0.91 m^3 heaped at 35 deg."""


def outline_relative_to_edge(bucket: Bucket) -> np.ndarray:
    """Return the corners (m, 2) of the bucket's interior in the side view, relative to the cutting edge [m].

    The columns are x, from the pin towards the edge, and z, up.

    Raises:
        InputError: the outline has too few or too many corners.
    """
    outline = np.array(bucket.outline, float)
    if not 3 <= len(outline) <= 16:
        raise InputError("bucket", f"its outline has {len(outline)} corners; 3 to 16 are allowed")
    return outline - outline[0]


GRAVITY = 9.81  # m/s^2


class Soil(StrictModel):
    """A Mohr-Coulomb soil, with parameters of its loosened state.

    Attributes:
        density: density in the bank, undisturbed and moist [kg/m^3].
        cohesion: c [Pa].
        friction: angle of internal friction phi [rad].
        tool_friction: angle of friction on steel delta, at most phi [rad].
        adhesion: adhesion to steel c_a, at most the cohesion [Pa].
        swell: ratio of loose volume to bank volume [1].
        repose: angle of repose of loosened soil [rad].
        cut_slope: maximum slope at which a cut face of the bank stands temporarily [rad].
        stiffness: force per displacement before a surface has mobilised the soil [N/m].
        damping_time: ratio of damping to stiffness [s]; at least half the time step, so that a
            force that is held over a step adds no energy to a machine.
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
    def _check_consistency(self) -> Self:
        if self.tool_friction > self.friction:
            raise ValueError("tool_friction exceeds friction: soil would fail before it slides")
        if self.adhesion > self.cohesion:
            raise ValueError("adhesion exceeds cohesion: soil would fail before it lets go")
        if self.cut_slope < self.repose:
            raise ValueError("cut_slope is below repose: the bank stands at a steeper slope than loose soil")
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
"""Typical soils. The values have not been checked against the cited books; replace them by those of
your ground. Soft: cohesion and friction of the sandy loam with 15 % moisture in Wong, Theory of
Ground Vehicles, Table 2.3; density and swell of loam (bank 1540, loose 1245 kg/m^3) in the
Caterpillar Performance Handbook, Weights of Materials. Sandy loam, moist: cohesion of the sandy
loam with 11 % moisture in Wong (4.83 kPa), with a friction angle between those of the two. Firm:
density and swell of packed earth in the Handbook (1900, 1510 kg/m^3); cohesion and friction of a
stiff sandy clay are assumed. Friction on steel is two thirds of the internal friction, as for steel
on sand in Terzaghi and Peck; adhesion is assumed to be a tenth of the cohesion. Stiffness: passive
pressure is mobilised after about 2 % of the height of a wall (Clough and Duncan 1991), here 4 mm in
0.2 m for 12 kN."""


(
    DENSITY, COHESION, FRICTION, TOOL_FRICTION, ADHESION, SWELL, REPOSE, CUT_SLOPE, STIFFNESS,
    DAMPING, WIDTH, INNER_WIDTH, EDGE_THICKNESS, FLOOR_ANGLE, FLOOR_LENGTH, HEEL_X, HEEL_Z, PROFILE_START, CELL_LENGTH,
    BUCKET_SIZE, GRAVITY_INDEX, CORNER_COUNT,
) = range(22)  # fmt: skip
OUTLINE_START = 22

(
    CARRIED_VOLUME, FACE, TIP, FLOOR, HEEL, SLIDE, LAST_R, LAST_Z, LAST_HEEL_R, LAST_HEEL_Z, CUT_FRONT, IS_INITIALISED,
    FIRST_SLIDING_CELL, LAST_SLIDING_CELL, LOST_VOLUME, DEPTH,
) = range(16)  # fmt: skip
STATE_SIZE = 16
"""Indices of the bucket state: loose volume carried [m^3]; deflections of the soil against face,
edge, floor, heel and along the heel [m]; previous positions of edge and heel [m]; radius to which
soil has been cut [m]; whether the state is initialised; first and last cell that may still slide;
loose volume that left the profile [m^3]; depth of the edge [m]."""

(FORCE_R, FORCE_Z, MOMENT, MASS, MASS_R, MASS_Z) = range(6)
RESULT_SIZE = 6
"""Indices of the result of a step: force of the soil on the bucket at its edge, outwards and up
[N]; moment about the edge, positive if it raises the outboard end [N m]; mass carried [kg] and its
centre relative to the edge, outwards and up [m]."""


def pack_soil_parameters(soil: Soil, bucket: Bucket, start: float, cell: float) -> np.ndarray:
    """Pack the parameters of soil, bucket and profile into an array for compiled functions.

    Args:
        soil: the soil.
        bucket: the bucket.
        start: radius at which the profile starts [m].
        cell: length of a cell [m].

    Returns:
        (k,) parameters in SI units; the constants DENSITY to CORNER_COUNT are their indices.

    Raises:
        InputError: the cell length, the start or the outline of the bucket is out of range.
    """
    if not 0.01 <= cell <= 0.5:
        raise InputError("soil profile", f"cells of {cell} m; 0.01 to 0.5 m are allowed")
    if not (math.isfinite(start) and start >= 0.0):
        raise InputError("soil profile", f"starts at a radius of {start} m; it must be at least 0")
    outline = outline_relative_to_edge(bucket)
    edge_x, edge_z = bucket.outline[0]
    return np.array([
        soil.density, soil.cohesion, soil.friction, soil.tool_friction, soil.adhesion, soil.swell,
        math.tan(soil.repose), math.tan(soil.cut_slope), soil.stiffness,
        soil.stiffness * soil.damping_time, bucket.width, bucket.inner_width, bucket.edge,
        bucket.floor_angle, bucket.floor_length, bucket.heel[0] - edge_x, bucket.heel[1] - edge_z,
        start, cell, np.hypot(*outline.T).max(), GRAVITY, len(outline), *outline.ravel(),
    ])  # fmt: skip


def make_bucket_state() -> np.ndarray:
    """Return the initial soil state (STATE_SIZE,) of an empty bucket: all zeros.

    The first call of `step_soil` with this state stores the position of the bucket. To start again
    with an empty bucket, set the array to zeros.
    """
    return np.zeros(STATE_SIZE)


def make_level_profile(count: int, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a level profile of undisturbed soil.

    Args:
        count: number of cells.
        height: height of the surface [m].

    Returns:
        (surface, loose): (count,) height of the surface [m], and thickness of the loose layer on
        top [m].

    Raises:
        InputError: there are fewer than 8 cells.
    """
    if count < 8:
        raise InputError("soil profile", f"has {count} cells; at least 8 are needed")
    return np.full(count, float(height)), np.zeros(count)


def total_soil_mass(parameters: np.ndarray, surface: np.ndarray, loose: np.ndarray,
              state: np.ndarray) -> float:  # fmt: skip
    """Return the total soil mass [kg], which `step_soil` conserves up to rounding.

    It consists of the soil on the ground above height 0 (negative below), in the bucket, and fallen
    off the ends of the profile. Loose soil has the bank density divided by the swell ratio.

    Args:
        parameters: (k,) parameters of soil, bucket and profile from `pack_soil_parameters`.
        surface: (m,) height of the profile [m].
        loose: (m,) thickness of the loose layer [m].
        state: (STATE_SIZE,) state of the bucket.
    """
    n = parameters
    thickness = np.sum(surface - loose) + np.sum(loose) / n[SWELL]
    volume = thickness * n[CELL_LENGTH] * n[WIDTH] + (state[CARRIED_VOLUME] + state[LOST_VOLUME]) / n[SWELL]
    return float(volume * n[DENSITY])

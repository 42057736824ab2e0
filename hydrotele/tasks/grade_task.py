"""What `Grade` is."""

import math

import mujoco
import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.soil.facts import SOILS
from hydrotele.tasks.bed import TERRAIN, bed_numbers
from hydrotele.tasks.grade import grade_fields
from hydrotele.tasks.memory import NUMBERS
from hydrotele.tasks.starts import draw_start
from hydrotele.tasks.task import Task

GRADE_SOILS = ("soft", "sandy_loam", "firm")
"""Names of the soils that episodes have, in the order of their numbers."""

_LOW = (5.6, -0.5, 1.25, math.radians(-110.0))  # r [m], theta [rad], z [m], attitude [rad]
_HIGH = (6.4, 0.5, 1.5, math.radians(-90.0))


def _start(machine: Machine, chance: np.random.Generator) -> dict[str, float]:
    """The bucket over the far end of the stretch, ready to dig, above the highest ground."""
    return draw_start(machine, chance, _LOW, _HIGH)


def _numbers(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Soils, bucket and profile; the last one is the number of soils."""
    bed = bed_numbers([SOILS[name] for name in GRADE_SOILS]).tolist()
    return (*bed, *[0.0] * (NUMBERS - 1 - len(bed)), float(len(GRADE_SOILS)))


GRADE = Task(
    name="Grade",
    kind="grade",
    sentence=(
        "An excavator's bucket cuts a low bank of soft, loamy or firm soil down to a plane of given"
        " height and slope, 3.8 to 5.8 m before it, and carries the soil away; the swing is"
        " locked, its action does nothing."
    ),
    reward=(
        "1 for every 0.01 m by which the root mean square error of the profile shrinks, less 0.05"
        " per second; 5 for an error below 0.03 m for a second, -5 for the edge 0.5 m below the"
        " plane, and both end the episode."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=60.0,
    start=_start,
    fields=grade_fields,
    measures=(
        ("profile_rms", "m"), ("carried_mass", "kg"), ("soil_force", "N"), ("soil", "1"),
        ("success", "1"), ("spoiled", "1"),
    ),
    numbers=_numbers,
    terrain=TERRAIN,
    pose_rates=(0.5, 0.3, 0.4, 0.5, 0.25),
    swing_locked=True,
)  # fmt: skip
"""Ground graded to a plane."""

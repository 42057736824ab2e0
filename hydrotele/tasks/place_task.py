"""What `PlaceLog` is."""

import math

import mujoco
import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surroundings import LogOnGround
from hydrotele.tasks.grapple import grapple_numbers
from hydrotele.tasks.place import place_fields
from hydrotele.tasks.starts import draw_start
from hydrotele.tasks.task import Task

LOG_TO_PLACE = LogOnGround(position=(5.5, 0.0), direction=math.pi / 2.0)
"""The log; every episode lays it down elsewhere."""

_LOW, _HIGH = (4.5, -0.5, 2.2), (6.5, 0.5, 2.8)  # m, rad, m: the stick's pin at the start


def _start(machine: Machine, chance: np.random.Generator) -> dict[str, float]:
    """The open grapple hangs plumb, higher than a log on the ground."""
    joints = draw_start(machine, chance, _LOW, _HIGH)
    plumb = -0.5 * math.pi - joints["boom"] - joints["stick"]
    turned = float(chance.uniform(-0.5, 0.5) * math.pi)
    return {**joints, "grapple_pitch": plumb, "grapple": turned, "claw": 0.0}


def _numbers(machine: Machine, model: mujoco.MjModel) -> np.ndarray:
    return grapple_numbers(machine, model, LOG_TO_PLACE)


PLACE_LOG = Task(
    name="PlaceLog",
    kind="place",
    sentence=(
        "An excavator takes a log from the ground with a grapple that swings freely and lays it"
        " down elsewhere, turned as asked. Where log and goal lie is known exactly, also with real"
        " sensors."
    ),
    reward=(
        "1 for every metre nearer: of the grapple to the log until it is held (a radian askew"
        " counts as 0.5 m), of the log to its goal (a radian of yaw counts as 1 m); 5 for the first"
        " taking; less 0.005 for every step and 0.02 for every radian that the grapple is off"
        " plumb in it. 20 once the log has lain within 0.3 m and 15 deg of its goal, let go, for"
        " 0.5 s, or -20 when it lies out of reach; both end the episode."
    ),
    machine="cat215",
    tool="grapple_claw",
    more_axes=("grapple", "claw"),
    action="resolved_motion",
    duration=60.0,
    start=_start,
    fields=place_fields,
    measures=(
        ("log_distance", "m"), ("yaw_error", "rad"), ("held", "1"), ("success", "1"),
        ("swing_angle", "rad"),
    ),
    surroundings=lambda *_: (LOG_TO_PLACE,),
    ground=True,
    numbers=_numbers,
    writes=("eq_data",),
    # with the usual 4 /s a late, sticky valve lets the boom swing, and the grapple with it
    servo=Servo(position_gain=2.5, axis_gains={"boom": 2.0}),
)  # fmt: skip
"""A log picked up and laid down with the CAT 215's claw."""

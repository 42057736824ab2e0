"""What `StraightLine` is."""

import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.tasks.line import line_fields
from hydrotele.tasks.starts import draw_start
from hydrotele.tasks.task import Task


def _start(machine: Machine, chance: np.random.Generator) -> dict[str, float]:
    """The bucket in the air before the machine, about as in Zhu 1994, Figs 6.45-6.48."""
    return draw_start(machine, chance, (4.8, -0.5, 0.4, -1.9), (6.5, 0.5, 2.4, -1.2))


STRAIGHT_LINE = Task(
    name="StraightLine",
    kind="line",
    sentence=(
        "The tip of an excavator's bucket goes along a straight line of 1 to 3 m at 0.2 to 0.6 m/s,"
        " its attitude kept."
    ),
    reward=(
        "1 on the line and in time, less 1 for every 0.1 m beside the line, every 0.2 m behind or"
        " ahead and every 0.2 rad of attitude, at least -1."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=16.5,  # of the longest and slowest line, and a little more
    start=_start,
    fields=line_fields,
    measures=(("cross_track_error", "m"), ("along_track_error", "m"), ("attitude_error", "rad")),
    servo=Servo(axis_gains={"boom": 2.0}),  # with more, a boom near its end swings on its oil
    pose_rates=(0.9, 0.3, 0.9, 0.4, 0.25),  # half as much again as the fastest line
)
"""A straight line of the tip."""

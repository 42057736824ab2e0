"""What `ReachFeller` is."""

import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.tasks.reach import reach_fields
from hydrotele.tasks.starts import draw_start
from hydrotele.tasks.task import Task


def _start(machine: Machine, chance: np.random.Generator) -> dict[str, float]:
    """The head in the air before the machine, about level."""
    return draw_start(
        machine, chance, (5.0, -0.5, 0.8, -0.4, -0.3), (8.0, 0.5, 3.0, 0.4, 0.3)
    )  # fmt: skip


REACH_FELLER = Task(
    name="ReachFeller",
    kind="reach",
    sentence="A feller-buncher brings its head to a pose with all five axes and keeps it there.",
    reward=(
        "1 for every metre nearer (a radian of attitude or head counts as one), less 0.01 for every"
        " step, and 10 once it was within 0.05 m and 0.03 rad for 0.5 s, which ends the episode."
    ),
    machine="cat325",
    tool=None,
    duration=20.0,
    start=_start,
    fields=reach_fields,
    measures=(("distance", "m"), ("attitude_error", "rad"), ("success", "1")),
    servo=Servo(axis_gains={"swing": 1.0, "boom": 2.0}),  # heavy on soft oil
    pose_rates=(0.5, 0.2, 0.5, 0.2, 0.2),
)
"""A pose of a feller-buncher's head."""

"""The tasks."""

import numpy as np

from hydrotele.envs.force import HOLD_FORCE
from hydrotele.envs.grade import GRADE
from hydrotele.envs.line import STRAIGHT_LINE
from hydrotele.envs.place import PLACE_LOG
from hydrotele.envs.reach import REACH_FELLER
from hydrotele.envs.task import Task
from hydrotele.envs.track import track_fields
from hydrotele.machine.machine import Machine


def _about_home(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Axes somewhere in the middle part of their ranges; the swing anywhere in front."""
    places = {}
    for name, axis in machine.axes.items():
        low, high = machine.joints[axis.joint].range or (-0.5, 0.5)
        places[name] = float(low + (high - low) * rng.uniform(0.3, 0.7))
    return places


TASKS = {
    task.name: task
    for task in (
        Task(
            name="TrackTrajectory",
            kind="track",
            sentence="All axes of an excavator follow Fourier references, without tool.",
            reward="1 on the trajectory, less 1 for every 0.1 m that the tip is off, at least -1.",
            machine="cat215",
            tool="none",
            start=_about_home,
            fields=track_fields,
            measures=(("tip_error", "m"),),
        ),
        STRAIGHT_LINE,
        HOLD_FORCE,
        REACH_FELLER,
        GRADE,
        PLACE_LOG,
    )
}
"""Tasks by name."""

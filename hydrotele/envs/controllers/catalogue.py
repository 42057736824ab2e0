"""Controllers by name, the reference of each task by the task's name."""

from collections.abc import Callable

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller, Random, Zero
from hydrotele.envs.controllers.grade import grade_controller
from hydrotele.envs.controllers.place import place_controller
from hydrotele.envs.controllers.tip import line_controller, press_controller, reach_controller
from hydrotele.envs.controllers.track import track_controller
from hydrotele.envs.facts import Setup

REFERENCES: dict[str, Callable[[Setup], Controller]] = {
    "TrackTrajectory": track_controller,
    "Grade": grade_controller,
    "StraightLine": line_controller,
    "HoldForce": press_controller,
    "ReachFeller": reach_controller,
    "PlaceLog": place_controller,
}
"""Task -> what a good engineer would write for it, for every kind of actions that suits it."""

CONTROLLERS = ("reference", "zero", "random")


def make_controller(name: str, setup: Setup) -> Controller:
    """A controller of a task.

    Args:
        name: `reference`, `zero` or `random`.
        setup: the task as it was chosen.

    Returns:
        The controller, to `begin`.

    Raises:
        InputError: there is no such controller.
    """
    if name == "zero":
        return Zero(setup)
    if name == "random":
        return Random(setup)
    if name != "reference":
        raise InputError(f"controller {name!r}", suggest(name, CONTROLLERS))
    if setup.task.name not in REFERENCES:
        raise InputError(f"task {setup.task.name}", "has no reference controller yet")
    return REFERENCES[setup.task.name](setup)

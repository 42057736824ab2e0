"""Reference controllers by name, and a search for controller gains."""

from collections.abc import Callable, Mapping

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller, Random, Zero
from hydrotele.envs.controllers.grade import grade_controller
from hydrotele.envs.controllers.place import place_controller
from hydrotele.envs.controllers.track import (
    line_controller,
    press_controller,
    reach_controller,
    track_controller,
)
from hydrotele.envs.facts import TaskSetup

REFERENCES: dict[str, Callable[[TaskSetup], Controller]] = {
    "TrackTrajectory": track_controller,
    "Grade": grade_controller,
    "StraightLine": line_controller,
    "HoldForce": press_controller,
    "ReachFeller": reach_controller,
    "PlaceLog": place_controller,
}
"""Task name -> function that makes its reference controller for the chosen kind of actions."""

CONTROLLERS = ("reference", "zero", "random")


def make_controller(name: str, setup: TaskSetup) -> Controller:
    """Make a controller for a task.

    Args:
        name: `reference`, `zero` or `random`.
        setup: the task with its options.

    Returns:
        The controller; call `begin` before use.

    Raises:
        InputError: the controller does not exist, or the task has no reference controller.
    """
    if name == "zero":
        return Zero(setup)
    if name == "random":
        return Random(setup)
    if name != "reference":
        raise InputError(f"controller {name!r}", suggest(name, CONTROLLERS))
    if setup.task.name not in REFERENCES:
        raise InputError(f"task {setup.task.name}", "has no reference controller")
    return REFERENCES[setup.task.name](setup)


def tune(
    value: Callable[[dict[str, float]], float], start: Mapping[str, float], factor: float = 1.5,
    rounds: int = 2, gain: float = 0.0, most: Mapping[str, float] | None = None,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """Improve controller gains by a coordinate search.

    Args:
        value: function that returns the score of a set of gains, larger is better; it must always
            use the same episodes.
        start: initial gains, all positive.
        factor: factor by which a gain is changed, repeatedly while the score improves.
        rounds: number of passes through all gains.
        gain: minimum improvement of the score that a change must bring.
        most: upper bounds of the gains.

    Returns:
        (gains, their score).
    """
    best, score = dict(start), value(dict(start))
    for _ in range(rounds):
        for name in start:
            for step in (factor, 1.0 / factor):
                moved = False
                while True:
                    trial = min(best[name] * step, (most or {}).get(name, float("inf")))
                    found = value({**best, name: trial}) if trial != best[name] else score
                    if found <= score + gain:
                        break
                    best[name], score, moved = trial, found, True
                if moved:
                    break
    return best, score

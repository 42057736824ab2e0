"""Reference controllers by name, and the search for their gains."""

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
"""Task -> what a good engineer would write for it, for every kind of actions that suits it."""

CONTROLLERS = ("reference", "zero", "random")


def make_controller(name: str, setup: TaskSetup) -> Controller:
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


def tune(
    value: Callable[[dict[str, float]], float], start: Mapping[str, float], factor: float = 1.5,
    rounds: int = 2, gain: float = 0.0, most: Mapping[str, float] | None = None,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """Better gains by a search along one of them at a time.

    Args:
        value: of a set of gains, the more the better; always on the same episodes.
        start: gains to begin with, all positive.
        factor: by which a gain is changed, again as long as that helps.
        rounds: through all gains.
        gain: in value that a change must bring.
        most: largest sensible values.

    Returns:
        (gains, their value).
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

"""Reference controllers by name, and a search for controller gains."""

from collections.abc import Callable, Mapping

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller, RandomController, ZeroController
from hydrotele.envs.controllers.grade import make_grade_controller
from hydrotele.envs.controllers.load_truck import make_load_controller
from hydrotele.envs.controllers.place_log import make_place_controller
from hydrotele.envs.controllers.tracking import (
    make_line_controller,
    make_press_controller,
    make_reach_controller,
    make_track_controller,
)
from hydrotele.envs.task_setup import TaskSetup

REFERENCE_CONTROLLERS: dict[str, Callable[[TaskSetup], Controller]] = {
    "TrackTrajectory": make_track_controller,
    "Grade": make_grade_controller,
    "StraightLine": make_line_controller,
    "HoldForce": make_press_controller,
    "ReachFeller": make_reach_controller,
    "PlaceLog": make_place_controller,
    "LoadTruck": make_load_controller,
}
"""Task name -> function that makes its reference controller for the chosen kind of actions."""

CONTROLLER_NAMES = ("reference", "zero", "random")


def make_controller(name: str, setup: TaskSetup) -> Controller:
    """Make a controller for a task.

    Args:
        name: `reference` for the entry of the task in REFERENCE_CONTROLLERS, `zero` for zero
            actions, or `random` for uniform random actions.
        setup: the task with its options.

    Returns:
        The controller; call `begin` before use.

    Raises:
        InputError: the controller does not exist, or the task has no reference controller.

    Examples:
        The reference controller keeps the tip error of an episode small; zero actions do not.

        >>> import gymnasium
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> import hydrotele.envs
        >>> env = gymnasium.make("hydrotele/TrackTrajectory-v0", variants=1, duration=4.0)
        >>> for name in "reference", "zero":
        ...     controller = ht.make_controller(name, env.unwrapped.core.setup)
        ...     controller.begin(1)
        ...     (observation, info), errors, over = env.reset(seed=1), [], False
        ...     while not over:
        ...         observation, _, terminated, over, info = env.step(controller(observation[None])[0])
        ...         errors.append(info["tip_error"])
        ...     print(name, bool(np.sqrt(np.mean(np.square(errors))) < 0.1))  # RMS tip error below 0.1 m
        reference True
        zero False
    """
    if name == "zero":
        return ZeroController(setup)
    if name == "random":
        return RandomController(setup)
    if name != "reference":
        raise InputError(f"controller {name!r}", suggest_valid_name(name, CONTROLLER_NAMES))
    if setup.task.name not in REFERENCE_CONTROLLERS:
        raise InputError(f"task {setup.task.name}", "has no reference controller")
    return REFERENCE_CONTROLLERS[setup.task.name](setup)


def tune_gains(
    evaluate: Callable[[dict[str, float]], float], initial_gains: Mapping[str, float], factor: float = 1.5,
    passes: int = 2, min_improvement: float = 0.0, upper_bounds: Mapping[str, float] | None = None,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """Improve controller gains by a coordinate search for the highest score.

    One gain after the other is multiplied by `factor` as long as the score improves. If the first
    multiplication does not improve the score, the gain is divided by `factor` instead, likewise.

    Args:
        evaluate: function that returns the score of a set of gains, larger is better; it must always
            use the same episodes.
        initial_gains: initial gains, all positive.
        factor: factor by which a gain is changed in a trial.
        passes: number of passes through all gains.
        min_improvement: a trial is accepted only if it improves the score by more than this.
        upper_bounds: upper bounds of the gains.

    Returns:
        (best gains, their score).
    """
    best, score = dict(initial_gains), evaluate(dict(initial_gains))
    for _ in range(passes):
        for name in initial_gains:
            for step in (factor, 1.0 / factor):
                moved = False
                while True:
                    trial = min(best[name] * step, (upper_bounds or {}).get(name, float("inf")))
                    found = evaluate({**best, name: trial}) if trial != best[name] else score
                    if found <= score + min_improvement:
                        break
                    best[name], score, moved = trial, found, True
                if moved:
                    break
    return best, score

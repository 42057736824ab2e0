"""Record episodes of a task as a Minari data set (the extra `minari`), from a controller, a policy or logs."""

import warnings
from collections.abc import Iterable
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.policy_scores import make_environment_id
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine


class Episode(NamedTuple):
    """One recorded episode of t steps.

    Attributes:
        seed: seed of the episode.
        observations: (t + 1, o), with the last observation.
        actions: (t, a).
        rewards: (t,).
        terminated: whether a condition of the task ended the episode.
        truncated: whether its duration, or the log, ended it.
    """

    seed: int
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool
    truncated: bool


class RecordedActions:
    """A controller that returns a given sequence of actions (t, a)."""

    def __init__(self, actions: np.ndarray) -> None:
        """Store the actions."""
        self._actions = actions

    def begin(self, count: int) -> None:
        """Start at the first action; `count` is not used."""
        self._step = 0

    def reset(self, mask: np.ndarray) -> None:
        """Do nothing: there is one sequence."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the next action (1, a)."""
        self._step += 1
        return self._actions[None, self._step - 1]


def record_episode(env: gymnasium.Env, controller: Controller, seed: int) -> Episode:
    """Run a controller or policy for one episode of an environment.

    Args:
        env: the environment.
        controller: controller or policy.
        seed: seed of the episode.

    Returns:
        The episode.
    """
    observation, _ = env.reset(seed=seed)
    controller.begin(1)
    observations, actions, rewards, terminated, truncated = [observation], [], [], False, False
    while not (terminated or truncated):
        action = np.clip(np.asarray(controller(observation[None]), np.float32)[0], -1.0, 1.0)
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(reward)
    return Episode(seed, np.array(observations), np.array(actions), np.array(rewards), terminated, truncated)


def make_environment_of_log(task: str, options: dict[str, Any], log: Log) -> tuple[gymnasium.Env, RecordedActions]:
    """Make an environment that starts in the first pose of a log, and the actions that repeat its valve commands.

    Args:
        task: name of a shipped task.
        options: options of the environment; action, start, duration and variants are set here.
        log: a log with position and command of every driven axis of the task.

    Returns:
        (environment, actions); the episode ends with the log.

    Raises:
        InputError: the task is not known, a channel is missing, or an option is not valid.
    """
    name = make_environment_id(task).removeprefix("hydrotele/").rpartition("-v")[0]
    if name not in TASKS:
        raise InputError(f"task {task!r}", f"logs can be recorded for {', '.join(TASKS)}")
    machine = load_machine(TASKS[name].machine, TASKS[name].tool)
    rate, duration = float(options.get("control_rate", 50.0)), float(log.time[-1] - log.time[0])
    start = {}
    for axis in machine.axes:
        if (channel := f"{machine.position_kind(axis)}.{axis}") not in log:
            continue
        start[axis] = float(log[channel][0])
    env = gymnasium.make(
        make_environment_id(task), **options, action="valve", variants=1, duration=int(duration * rate) / rate,
        start=start,
    )  # fmt: skip
    core: Any = env.unwrapped.core  # pyright: ignore[reportAttributeAccessIssue]
    missing = [f"command.{axis}" for axis in core.setup.axes if f"command.{axis}" not in log]
    missing += [axis for axis in core.setup.axes if axis not in start]
    if missing:
        env.close()
        raise InputError(
            log.source, f"has no {', '.join(missing)}: the task {name} drives {', '.join(core.setup.axes)}"
        )
    edges = log.time[0] + np.arange(core.setup.clock.horizon + 1) / rate
    limits = core.parameters["limit"][core.parameters["driven_axis"][: len(core.setup.axes)]]
    commands = [average_over_steps(log.time, log[f"command.{axis}"], edges) for axis in core.setup.axes]
    return env, RecordedActions(np.stack(commands, axis=1) / limits)


def average_over_steps(time: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the mean in every step of a signal that is constant from each row to the next.

    Args:
        time: (n,) times of the rows [s].
        values: (n,) values.
        edges: (t + 1,) limits of the steps [s], within the times of the rows.

    Returns:
        (t,) means.

    >>> average_over_steps(np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 0.0]), np.array([0.0, 0.5, 1.5, 2.0]))
    array([1., 2., 3.])
    """
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    return np.diff(np.interp(edges, time, integral)) / np.diff(edges)


def write_dataset(
    name: str, env: gymnasium.Env, episodes: Iterable[Episode], algorithm: str, replace: bool = False
) -> Any:
    """Write episodes as a Minari data set.

    Args:
        name: name of the data set, such as `track/driven-v0`.
        env: environment of the episodes; the data set stores its specification.
        episodes: the episodes.
        algorithm: what acted, such as `reference`.
        replace: whether to delete an existing data set of this name.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        InputError: minari is not installed, the name is not valid, or the data set exists.
    """
    minari = _import_minari()
    from minari.data_collector.episode_buffer import EpisodeBuffer  # pyright: ignore[reportMissingImports]

    check_dataset_name(name, replace)
    buffers = [_make_buffer(EpisodeBuffer, number, episode) for number, episode in enumerate(episodes)]
    if name in minari.list_local_datasets():
        minari.delete_dataset(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # minari wants an e-mail address and a second environment
        return minari.create_dataset_from_buffers(
            name, buffers, env=env, algorithm_name=algorithm, requirements=["hydrotele"], data_format="arrow",
            description=f"{env.spec and env.spec.id} by {algorithm}",
        )  # fmt: skip


def check_dataset_name(name: str, replace: bool) -> None:
    """Check the name of a new data set, before the episodes are run.

    Raises:
        InputError: minari is not installed, the name is not valid, or a data set of this name exists and
            `replace` is False.
    """
    minari = _import_minari()
    from minari.dataset.minari_dataset import parse_dataset_id  # pyright: ignore[reportMissingImports]

    try:
        parse_dataset_id(name)
    except ValueError as error:
        raise InputError(f"data set {name!r}", f"{error}; a name is for example track/driven-v0") from None
    if not replace and name in minari.list_local_datasets():
        raise InputError(f"data set {name!r}", "exists already: give another name, or --force to replace it")


def _import_minari() -> Any:
    try:
        import minari  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the data set", "needs minari: pip install 'hydrotele[minari]'") from None
    return minari


def _make_buffer(kind: Any, number: int, episode: Episode) -> Any:
    ends = np.zeros((2, len(episode.rewards)), bool)
    ends[0, -1], ends[1, -1] = episode.terminated, episode.truncated
    return kind(
        id=number, seed=episode.seed, observations=episode.observations, actions=episode.actions,
        rewards=episode.rewards, terminations=ends[0], truncations=ends[1],
    )  # fmt: skip

"""Implement `hydrotele record`: record episodes of a control task as a Minari data set."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hydrotele.cli.console import print_json, print_notes, show_stages, stdout_console
from hydrotele.cli.train_command import parse_environment_options
from hydrotele.core.errors import InputError


class RecordOptions(NamedTuple):
    """Options of `hydrotele record`, see `cli.train_options.record`."""

    task: str
    dataset: str
    controller: str
    policy: Path | None
    logs: list[Path]
    episodes: int
    seed: int
    settings: list[str]
    force: bool
    json: bool


def record_dataset(options: RecordOptions) -> None:
    """Record episodes of a task, write them as a data set, and print a summary.

    Raises:
        InputError: the task, an option, the policy or a log is not valid, minari is not installed, or the
            data set exists.
    """
    policy = _load_policy(options.policy) if options.policy else None
    from hydrotele.envs.offline_dataset import check_dataset_name, write_dataset

    if policy and options.logs:
        raise InputError("--policy", "cannot be combined with --log")
    check_dataset_name(options.dataset, options.force)
    if options.logs:
        env, episodes, actor = _record_logs(options)
    else:
        env, episodes, actor = _record_controller(options, policy)
    try:
        made = write_dataset(options.dataset, env, episodes, actor, options.force)
    finally:
        env.close()
    returns = [float(np.sum(episode.rewards)) for episode in episodes]
    result = {
        "dataset": options.dataset, "task": options.task, "actor": actor, "episodes": made.total_episodes,
        "steps": made.total_steps, "mean_return": float(np.mean(returns)), "folder": str(made.storage.data_path.parent),
    }  # fmt: skip
    if options.json:
        print_json(result)
        return
    stdout_console.print(
        f"{result['episodes']} episodes, {result['steps']} steps of {options.task} by {actor}, mean return"
        f" {result['mean_return']:.1f}; minari.load_dataset({options.dataset!r}) reads [bold]{result['folder']}[/]",
        soft_wrap=True,
    )


def _load_policy(path: Path) -> Any:
    from hydrotele.envs.policy_training import load_policy

    return load_policy(path)


def _record_controller(options: RecordOptions, policy: Any) -> tuple[Any, list[Any], str]:
    """Run the episodes of a controller or policy; return the environment, the episodes and the actor's name."""
    import gymnasium

    import hydrotele.envs  # noqa: F401 - registers the environments
    from hydrotele.envs.controllers.catalogue import make_controller
    from hydrotele.envs.offline_dataset import record_episode
    from hydrotele.envs.policy_scores import make_environment_id

    try:
        env = gymnasium.make(make_environment_id(options.task), **parse_environment_options(options.settings))
    except gymnasium.error.Error as error:
        raise InputError(f"task {options.task!r}", str(error)) from None
    setup = env.unwrapped.core.setup  # pyright: ignore[reportAttributeAccessIssue]
    actor = policy or make_controller(options.controller, setup)
    episodes = []
    with show_stages(f"record {options.task}", False) as report:
        for number in range(options.episodes):
            assert report is not None
            report(f"episode {number + 1} of {options.episodes}", number / options.episodes)
            episodes.append(record_episode(env, actor, options.seed + number))
    return env, episodes, options.policy.stem if options.policy else options.controller


def _record_logs(options: RecordOptions) -> tuple[Any, list[Any], str]:
    """Repeat the commands of logs in the task; return the last environment, the episodes and the actor's name."""
    from hydrotele.cli.input_logs import open_single_log
    from hydrotele.envs.offline_dataset import make_environment_of_log, record_episode

    settings, env, episodes = parse_environment_options(options.settings), None, []
    for number, path in enumerate(options.logs):
        opened = open_single_log(path, force=options.force)
        print_notes(opened.notes)
        if env:
            env.close()
        env, actions = make_environment_of_log(options.task, settings, opened.logs[0])
        episodes.append(record_episode(env, actions, options.seed + number))
    return env, episodes, "log"

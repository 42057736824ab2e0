"""Implement `hydrotele train`: train a policy for a control task and compare it with controllers."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hydrotele.cli.console import (
    announce_output,
    catch_first_interrupt,
    make_table,
    print_json,
    show_stages,
    stderr_console,
    stdout_console,
    write_json,
)
from hydrotele.cli.option_values import parse_overrides
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file

_DEFAULT_MINUTES = 30.0
_SCORE_SEED = 10**6  # seed of the first episode of the final comparison; training episodes have others


class TrainOptions(NamedTuple):
    """Options of `hydrotele train`, see `cli.train_options.train`."""

    task: str | None
    out: Path | None
    minutes: float | None
    steps: int | None
    seed: int
    envs: int
    threads: int
    settings: list[str]
    shaping: bool
    curriculum: bool
    device: str | None
    episodes: int
    resume: bool
    video: bool
    json: bool


def parse_environment_options(settings: list[str]) -> dict[str, Any]:
    """Return the options of an environment from `key=value` strings, with values in YAML.

    Raises:
        InputError: a string has another form, or its value is not valid YAML.
    """
    options = {}
    for key, text in parse_overrides(settings).items():
        try:
            options[key] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise InputError(f"--set {key}={text}", "the value is not valid YAML") from None
    return options


def train_to_folder(options: TrainOptions) -> None:
    """Train a policy, compare it with controllers, and write everything into a folder.

    Raises:
        InputError: the task or an option is not valid, stable-baselines3 is not installed, or the folder
            contains something else.
    """
    from hydrotele.envs import policy_training
    from hydrotele.envs.learning_curve import plot_learning_curve
    from hydrotele.envs.policy_scores import estimate_share, evaluate_policies, make_baselines, make_vector_environment

    state, folder = _make_state(options)
    plan = state.plan
    folder.mkdir(parents=True, exist_ok=True)
    with catch_first_interrupt() as interrupted, show_stages(f"train {plan.task}", False) as report:
        assert report is not None
        model = policy_training.train_policy(state, folder, report, interrupted)
    policy = policy_training.PolicyController(model)
    stderr_console.print(f"comparing on {options.episodes} episodes ...", style="dim")
    env = make_vector_environment(plan.task, options.episodes, plan.threads, **plan.options)
    try:
        scores = evaluate_policies(env, {"policy": policy, **make_baselines(env)}, _SCORE_SEED)
    finally:
        env.close()
    levels = {name: float(score.returns.mean()) for name, score in scores.items()}
    result: dict[str, Any] = {
        "task": plan.task, "options": plan.options, "steps": state.steps, "seconds": state.seconds,
        "processor_seconds": state.processor_seconds, "episodes": options.episodes,
        "scores": {name: score.summarise() for name, score in scores.items()},
        "folder": str(folder),
    }  # fmt: skip
    if "reference" in scores:
        share, low, high = estimate_share(scores)
        result["share_of_reference_advantage"] = {"value": share, "low": low, "high": high}
    with atomic_file(folder / "scores.json", ".json") as part:
        write_json(part, result)
    plot_learning_curve(state, {name: level for name, level in levels.items() if name != "policy"},
                        folder / "learning_curve.png")  # fmt: skip
    if options.video:
        from hydrotele.envs.episode_video import write_episode_video

        with announce_output("video", folder / "episode.mp4", options.json):
            write_episode_video(plan.task, plan.options, policy, folder / "episode.mp4", _SCORE_SEED)
    if options.json:
        print_json(result)
        return
    _print_scores(result)
    stdout_console.print(f"written to [bold]{folder}[/]", soft_wrap=True)


def _make_state(options: TrainOptions) -> Any:
    """Return a new state of a training, or that of the folder with --resume, and the folder."""
    from hydrotele.envs.learning_curve import STATE_FILE, TrainingPlan, TrainingState, complete_plan
    from hydrotele.envs.policy_scores import make_environment_id

    if options.minutes is not None and options.steps is not None:
        raise InputError("--steps", "replaces --minutes: give one of them")
    if options.resume:
        if options.out is None:
            raise InputError("--resume", "needs the folder of the training: give --out FOLDER")
        state = TrainingState.load(options.out)
        if options.task and make_environment_id(options.task) != state.plan.task:
            raise InputError(options.out, f"has a training of {state.plan.task}, not of {options.task}")
        if options.settings:
            raise InputError("--set", "cannot change a training that is continued: omit it")
        if options.minutes is not None or options.steps is not None:
            state.plan = dataclasses.replace(state.plan, minutes=options.minutes, steps=options.steps)
        return state, options.out
    if options.task is None:
        raise InputError("TASK", "is missing: give the name of a task, such as TrackTrajectory")
    name = make_environment_id(options.task)
    folder = options.out or Path("runs", "train_" + name.rpartition("/")[2].partition("-v")[0])
    if (folder / STATE_FILE).exists():
        raise InputError(folder, "has a training already: continue it with --resume, or give another --out")
    minutes = None if options.steps is not None else options.minutes or _DEFAULT_MINUTES
    plan = TrainingPlan(
        task=name, options=parse_environment_options(options.settings), minutes=minutes, steps=options.steps,
        seed=options.seed, num_envs=options.envs, threads=options.threads, shaping=options.shaping,
        curriculum=options.curriculum, device=options.device,
    )  # fmt: skip
    return TrainingState(complete_plan(plan)), folder


def _print_scores(result: dict[str, Any]) -> None:
    table = make_table(
        f"{result['task']}, {result['episodes']} episodes after {result['steps']:,} steps",
        "controller", "return", "success",
    )  # fmt: skip
    for name, row in result["scores"].items():
        success = "" if row["success"] is None else f"{row['success']:.2f}"
        table.add_row(name, f"{row['return']:.1f} ± {row['standard_error']:.1f}", success)
    stdout_console.print(table)
    if share := result.get("share_of_reference_advantage"):
        stdout_console.print(
            f"share of the reference controller's advantage over zero actions: {share['value']:.2f}"
            f" (95 % interval {share['low']:.2f} to {share['high']:.2f})"
        )

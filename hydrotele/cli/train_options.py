"""Define the options of `hydrotele train` and `hydrotele record`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from hydrotele.cli.number_options import MAX_PROCESSES

TRAIN_EPILOG = """\b
Examples:  hydrotele train TrackTrajectory --out learned
           hydrotele train StraightLine --minutes 10 --seed 3 --set sensors=real --video
           hydrotele train ReachFeller --steps 2000000 --out reach   |   hydrotele train --resume --out reach

\b
PPO of stable-baselines3: pip install 'hydrotele[learn]'. The policy acts alone, from the observation.
The output folder has policy.zip (stable_baselines3.PPO.load; its input is the observation),
learning_curve.csv and .png, training.json, scores.json and scores.md. Ctrl-C ends the training and keeps
the policy; --resume continues it.

\b
Options of the environment (--set) are those of gymnasium.make: action, sensors, control_rate,
duration, effects, randomise, variants, ... --no-shaping leaves the reward as it is. Without
--no-curriculum, the goals grow during the first 40 % of the training. --device cpu trains on the reduced
model, which has no contact and is faster; the policy is always evaluated on MuJoCo.
"""

RECORD_EPILOG = """\b
Examples:  hydrotele record TrackTrajectory --episodes 20 --dataset track/reference-v0
           hydrotele record StraightLine --controller random --dataset line/random-v0
           hydrotele record TrackTrajectory --policy learned/policy.zip --dataset track/learned-v0
           hydrotele record TrackTrajectory --log runs/drive --dataset track/driven-v0

\b
Needs pip install 'hydrotele[minari]'. minari.load_dataset(NAME) reads the data set; its folder is that of
the variable MINARI_DATASETS_PATH, or ~/.minari/datasets.

\b
A log (of drive, run, or a real machine) gives one episode: the task starts in the first pose of the log,
and its valve commands are the actions. The goal is drawn with --seed; observations and rewards are
those of the simulated task.
"""

TaskArgument = Annotated[str, typer.Argument(help="Task, such as TrackTrajectory, or a gymnasium id.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Option of the environment KEY=VALUE (YAML). Repeatable.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]


def train(
    task: Annotated[str | None, typer.Argument(help="Task, such as TrackTrajectory, or a gymnasium id.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/train_TASK.")] = None,
    minutes: Annotated[
        float | None, typer.Option(min=1e-3, help="Duration of the training [min]; default: 30.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps, instead of --minutes.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of networks and episodes.")] = 0,
    envs: Annotated[int, typer.Option(min=1, max=4096, help="Parallel environments.")] = 64,
    threads: Annotated[int, typer.Option(min=0, max=MAX_PROCESSES, help="Threads; 0: one per core.")] = 0,
    set_: SetOption = None,
    shaping: Annotated[bool, typer.Option(help="Add the potential-based term to the reward.")] = True,
    curriculum: Annotated[bool, typer.Option(help="Let the goals grow from 0.2 of their size.")] = True,
    device: Annotated[Literal["cpu"] | None, typer.Option(help="Train on the reduced model instead of MuJoCo.")] = None,
    episodes: Annotated[int, typer.Option(min=2, max=4096, help="Episodes of the final comparison.")] = 64,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the training in the output folder.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Write an episode as episode.mp4.")] = False,
    json: JsonOption = False,
) -> None:
    """Train a policy for a control task with PPO; compare it with the reference controller."""
    from hydrotele.cli.train_command import TrainOptions, train_to_folder

    train_to_folder(TrainOptions(
        task, out, minutes, steps, seed, envs, threads, set_ or [], shaping, curriculum, device, episodes, resume,
        video, json,
    ))  # fmt: skip


def record(
    task: TaskArgument,
    dataset: Annotated[str, typer.Option("--dataset", help="Name of the data set, such as track/driven-v0.")],
    controller: Annotated[
        Literal["reference", "zero", "random"], typer.Option(help="Controller that acts.")
    ] = "reference",
    policy: Annotated[
        Path | None, typer.Option(help="Policy of `train` or stable-baselines3 (.zip) that acts.")
    ] = None,
    log: Annotated[
        list[Path] | None, typer.Option("--log", help="Log or run folder whose commands act. Repeatable.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, max=4096, help="Episodes of a controller or policy.")] = 10,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the first episode.")] = 0,
    set_: SetOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing data set of this name.")] = False,
    json: JsonOption = False,
) -> None:
    """Record episodes of a control task as a Minari data set, from a controller, a policy or logs."""
    from hydrotele.cli.record_command import RecordOptions, record_dataset

    record_dataset(RecordOptions(task, dataset, controller, policy, log or [], episodes, seed, set_ or [], force, json))

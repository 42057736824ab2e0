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
The command needs pip install 'hydrotele[learn]' (PPO of stable-baselines3). The policy computes the
actions alone, without the reference controller. The output folder contains policy.zip (for
stable_baselines3.PPO.load), learning_curve.csv and .png, training.json, scores.json and scores.md.
Ctrl-C ends the training and keeps the policy; --resume continues it.

\b
Options of the environment (--set) are those of gymnasium.make: action, sensors, control_rate,
duration, effects, randomise, variants, ... With the default
--curriculum, the goals grow during the first 40 % of the training. With
--device cpu only the training uses the reduced model; the scores are those on MuJoCo.
"""

RECORD_EPILOG = """\b
Examples:  hydrotele record TrackTrajectory --episodes 20 --dataset track/reference-v0
           hydrotele record StraightLine --controller random --dataset line/random-v0
           hydrotele record TrackTrajectory --policy learned/policy.zip --dataset track/learned-v0
           hydrotele record TrackTrajectory --log runs/drive --dataset track/driven-v0

\b
The command needs pip install 'hydrotele[minari]'. minari.load_dataset(NAME) reads the data set; its folder is that of
the variable MINARI_DATASETS_PATH, or ~/.minari/datasets.

\b
A log (of drive, run, or a real machine) gives one episode. The task starts in the first pose of the
log, and the valve commands of the log are the actions. --seed selects the goal at random.
Observations and rewards are those of the simulated task.
"""

TaskArgument = Annotated[str, typer.Argument(help="Name of a task, such as TrackTrajectory, or a gymnasium id.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Option of the environment: KEY=VALUE, the value in YAML. Can be given several times."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]


def train(
    task: Annotated[
        str | None, typer.Argument(help="Name of a task, such as TrackTrajectory, or a gymnasium id.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/train_TASK.")] = None,
    minutes: Annotated[
        float | None, typer.Option(min=1e-3, help="Duration of the training [min]. Default: 30.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Length of the training as a number of environment steps, instead of --minutes."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Seed of the random numbers (networks and episodes).")
    ] = 0,
    envs: Annotated[int, typer.Option(min=1, max=4096, help="Number of parallel environments.")] = 64,
    threads: Annotated[
        int, typer.Option(min=0, max=MAX_PROCESSES, help="Number of threads; 0 means one per core.")
    ] = 0,
    set_: SetOption = None,
    shaping: Annotated[
        bool,
        typer.Option(help="Add a potential-based term to the reward, which rewards progress towards the goal."),
    ] = True,
    curriculum: Annotated[
        bool, typer.Option(help="Start the training with goals of 0.2 of their size, and let them grow.")
    ] = True,
    device: Annotated[
        Literal["cpu"] | None,
        typer.Option(help="Train on the reduced model, which is faster and has no contact, instead of MuJoCo."),
    ] = None,
    episodes: Annotated[int, typer.Option(min=2, max=4096, help="Number of episodes of the final comparison.")] = 64,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the training in the output folder.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Write a video of one episode, episode.mp4.")] = False,
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
    dataset: Annotated[str, typer.Option("--dataset", help="Name of the new data set, such as track/driven-v0.")],
    controller: Annotated[
        Literal["reference", "zero", "random"],
        typer.Option(
            help="Controller that computes the actions: reference (that of the task), zero (no command) or random."
        ),
    ] = "reference",
    policy: Annotated[
        Path | None,
        typer.Option(
            help="Policy that computes the actions instead: output of `train`, or of stable-baselines3 (.zip)."
        ),
    ] = None,
    log: Annotated[
        list[Path] | None,
        typer.Option(
            "--log", help="Log or run folder whose commands are the actions instead. Can be given several times."
        ),
    ] = None,
    episodes: Annotated[
        int, typer.Option(min=1, max=4096, help="Number of episodes, for a controller or a policy.")
    ] = 10,
    seed: Annotated[
        int,
        typer.Option(min=0, max=2**31 - 1, help="Seed of the first episode; each further episode has the next seed."),
    ] = 0,
    set_: SetOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing data set of this name.")] = False,
    json: JsonOption = False,
) -> None:
    """Record episodes of a control task as a Minari data set, from a controller, a policy or logs."""
    from hydrotele.cli.record_command import RecordOptions, record_dataset

    record_dataset(RecordOptions(task, dataset, controller, policy, log or [], episodes, seed, set_ or [], force, json))

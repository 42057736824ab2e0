"""Plan and progress of the training of a policy, and its learning curve as CSV and PNG."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file

POLICY_FILE, STATE_FILE, CURVE_FILE = "policy.zip", "training.json", "learning_curve.csv"

RECIPES: dict[str, dict[str, Any]] = {
    "TrackTrajectory": {"action": "joint_rate", "control_rate": 25.0},
    "ReachFeller": {"action": "resolved_motion", "control_rate": 10.0},
    "Grade": {"control_rate": 10.0},  # the discount factor of 0.98 then spans 5 s, a stroke of the bucket
    "PlaceLog": {"control_rate": 10.0},
    "LoadTruck": {"control_rate": 10.0},
}
"""Task name -> options of the environment with which a policy is trained by default."""
DEFAULT_RECIPE: dict[str, Any] = {"control_rate": 25.0}


@dataclasses.dataclass(frozen=True)
class TrainingPlan:
    """What is trained and how.

    Attributes:
        task: gymnasium id of the environment.
        options: options of the environment; those of the task's recipe are filled in by `complete_plan`.
        minutes: duration of the training [min], None if `steps` is given.
        steps: number of environment steps, None if `minutes` is given.
        seed: seed of networks and episodes; with `steps` and one thread of torch, the same seed gives
            the same policy.
        num_envs: number of parallel environments.
        threads: number of threads that step them, 0 for one per core.
        shaping: whether the reward has the potential-based term.
        curriculum: whether the goals grow from 0.2 of their size to the full size.
        gamma: discount factor of an environment step.
        rollout_steps: steps of every environment between two updates of the policy.
        timestep: physics step of the training [s]; the policy is evaluated with that of the task.
        batch: samples of a gradient step.
        epochs: passes through the samples in an update.
        width: width of the two hidden layers.
        first_log_std: logarithm of the standard deviation of the first actions.
        device: None to train on MuJoCo, "cpu" to train on the reduced model; the policy is evaluated on MuJoCo.
    """

    task: str
    options: dict[str, Any]
    minutes: float | None = 30.0
    steps: int | None = None
    seed: int = 0
    num_envs: int = 64
    threads: int = 0
    shaping: bool = True
    curriculum: bool = True
    gamma: float = 0.98
    timestep: float = 2.5e-3
    rollout_steps: int = 64
    batch: int = 512
    epochs: int = 10
    width: int = 64
    first_log_std: float = -0.5
    device: str | None = None


@dataclasses.dataclass
class TrainingState:
    """Progress of a training, saved in the folder of the policy.

    Attributes:
        plan: the plan.
        steps: environment steps so far.
        seconds: duration so far [s].
        curve: rows (steps, seconds, difficulty, mean return of training episodes, mean return and share
            of successful episodes of the evaluation; NaN where there is none).
        processor_seconds: processor time so far [s], with the evaluations.
        reward_scale: variance, mean and count of the discounted returns, which scale the rewards.
    """

    plan: TrainingPlan
    steps: int = 0
    seconds: float = 0.0
    curve: list[list[float]] = dataclasses.field(default_factory=list)
    processor_seconds: float = 0.0
    reward_scale: tuple[float, float, float] | None = None

    def save(self, folder: Path) -> None:
        """Write the state and the learning curve into a folder."""
        with atomic_file(folder / STATE_FILE, ".json") as part:
            part.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n", encoding="utf-8")
        rows = ["steps,seconds,difficulty,training_return,return,success"]
        rows += [",".join(f"{value:.6g}" for value in row) for row in self.curve]
        with atomic_file(folder / CURVE_FILE, ".csv") as part:
            part.write_text("\n".join(rows) + "\n", encoding="utf-8")

    @staticmethod
    def load(folder: Path) -> "TrainingState":
        """Read the state from a folder.

        Raises:
            InputError: the folder has no training, or its file is damaged.
        """
        try:
            kept = json.loads((folder / STATE_FILE).read_text(encoding="utf-8"))
            return TrainingState(**{**kept, "plan": TrainingPlan(**kept["plan"])})
        except OSError:
            raise InputError(folder, f"has no {STATE_FILE} of a training to continue") from None
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(folder / STATE_FILE, f"is not the state of a training: {error}") from None


def complete_plan(plan: TrainingPlan) -> TrainingPlan:
    """Return the plan with the options of the task's recipe, where the user has given none."""
    name = plan.task.rpartition("/")[2].partition("-v")[0]
    return dataclasses.replace(plan, options={**RECIPES.get(name, DEFAULT_RECIPE), **plan.options})


def plot_learning_curve(state: TrainingState, levels: Mapping[str, float], path: Path) -> None:
    """Write the learning curve as a PNG image.

    Args:
        state: progress of the training.
        levels: name -> mean return of a controller, drawn as a horizontal line.
        path: PNG file.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    rows = np.array(state.curve)
    axes.plot(rows[:, 0], rows[:, 4], "o-", ms=3, label="policy, full goals")
    for number, (name, value) in enumerate(levels.items()):
        axes.axhline(value, color=f"C{number + 1}", ls="--", label=name)
    axes.set(xlabel="environment steps [1]", ylabel="mean return of an episode [1]", title=state.plan.task)
    axes.legend()
    axes.grid(alpha=0.3)
    with atomic_file(path, ".png") as part:
        figure.savefig(part, dpi=100)

"""Train a neural network for a control task with PPO and compare it with the reference controller.

Both see the same sensors at the same rate and are scored on episodes and machines that neither has
met. Needs the extra `learn`. Writes policy.zip, normalisation.npz, training.json
and scores.md into FOLDER.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hydrotele.envs.controllers.catalogue import make_controller, tune_gains
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.controllers.tracking import TrackByValves
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore, make_task_setup
from hydrotele.envs.evaluation import Scores, evaluate_controller, tabulate_scores
from hydrotele.envs.stable_baselines import AgentInterface
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.task_setup import TaskSetup
from hydrotele.envs.variants import typical_variation
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.scenario import Servo

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecNormalize
except ImportError:
    sys.exit("tools/studies/learn.py needs stable-baselines3: pip install 'hydrotele[learn]'")

from hydrotele.envs.stable_baselines import StableVecEnv

TRAINED, JUDGED = 1, 2  # variant_seed: machines that are learned on, and those that decide
FIRST = 10**6  # seed of the first episode that decides; training counts up from --seed

Gains = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a task is learned.

    Attributes:
        options: of the environment, `randomise` apart.
        randomised: whether machines are of the usual spread.
        law: the controller to beat, from its gains.
        gains: of that law, tuned by `--tune` on the machines that are learned on.
        most: largest sensible gains.
        figure: the task's own error, that decides beside the return.
        corrects: whether the network corrects that law, or acts on its own.
        share: of a full action that its own is at most.
        history: steps that it sees.
        seconds: of an episode while learning, None for the task's.
        gamma: discount of a step.
        spread: of its first actions, as a logarithm.
    """

    options: dict[str, Any]
    law: Callable[[TaskSetup, Gains], Controller]
    gains: Gains
    figure: str
    most: Gains = dataclasses.field(default_factory=dict)
    randomised: bool = True
    corrects: bool = True
    share: float = 0.3
    history: int = 3
    seconds: float | None = None
    gamma: float = 0.97
    spread: float = -1.5


def track_law(setup: TaskSetup, gains: Gains) -> Controller:
    servo = Servo(
        position_gain=gains["position"], axis_gains={"swing": gains["swing"]},
        pressure_feedback=gains["pressure"], load_time=gains["load_time"],
        deadband_compensation=gains["deadband"],
    )  # fmt: skip
    return TrackByValves(setup, servo, gains["integral"], gains["lead"])


RECIPES = {
    "TrackTrajectory": Recipe(
        {"action": "valve", "sensors": "real", "control_rate": 25.0},
        track_law,
        {"position": 6.75, "swing": 4.5, "lead": 0.135, "integral": 10.0, "pressure": 13.5,
         "load_time": 2.222, "deadband": 1.0},
        "tip_error RMS",
        most={"deadband": 1.0, "lead": 0.3},
        seconds=10.0,
    ),
}  # fmt: skip


class Learned:
    """A policy from its files, as a controller."""

    def __init__(self, folder: Path, view: AgentInterface) -> None:
        self._policy = PPO.load(folder / "policy.zip", device="cpu").policy
        kept = np.load(folder / "normalisation.npz")
        self._mean, self._scale, self._most = kept["mean"], kept["scale"], float(kept["most"])
        self._view = view
        self.begin, self.reset = view.begin, view.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        seen = (self._view.make_agent_observation(observation) - self._mean) / self._scale
        seen = np.clip(seen, -self._most, self._most).astype(np.float32)
        return self._view.make_environment_action(self._policy.predict(seen, deterministic=True)[0])


class Clock(BaseCallback):
    """Ends learning after some time, lets the step size fall with it, tells how it goes."""

    def __init__(self, minutes: float, size: float) -> None:
        super().__init__()
        self._whole, self._size, self._told = 60.0 * minutes, size, 0.0

    def _on_training_start(self) -> None:
        self._start = time.monotonic()

    def left(self) -> float:
        """Share of the time that is left."""
        return max(0.0, 1.0 - (time.monotonic() - self._start) / self._whole)

    def _on_step(self) -> bool:
        return self.left() > 0.0

    def _on_rollout_end(self) -> None:
        for group in self.model.policy.optimizer.param_groups:
            group["lr"] = self._size * max(0.02, self.left())
        spent = (1.0 - self.left()) * self._whole
        if spent - self._told >= 30.0 and self.model.ep_info_buffer:
            self._told = spent
            total = np.mean([episode["r"] for episode in self.model.ep_info_buffer])
            spread = float(self.model.policy.log_std.detach().exp().mean())
            print(f"{spent:5.0f} s {self.num_timesteps:9d} steps: return {total:.1f} with noise of"
                  f" {spread:.3f}", file=sys.stderr, flush=True)  # fmt: skip


class TimedPPO(PPO):
    """PPO whose step size is set by the clock."""

    def _update_learning_rate(self, optimizers) -> None:
        pass


def choices(name: str, variants: int) -> dict[str, Any]:
    """Options of the environment."""
    recipe, task = RECIPES[name], TASKS[name]
    machine = load_machine(task.machine, task.tool)
    spread = typical_variation(machine) if recipe.randomised else ()
    return {**recipe.options, "randomise": spread, "variants": variants}


def make_view(name: str, setup: TaskSetup) -> AgentInterface:
    recipe = RECIPES[name]
    law = recipe.law(setup, recipe.gains) if recipe.corrects else None
    return AgentInterface(setup, recipe.history, law, recipe.share)


def train(name: str, asked: argparse.Namespace) -> None:
    """Learn, and write the policy."""
    recipe, task = RECIPES[name], TASKS[name]
    taken = {**choices(name, asked.variants), "variant_seed": TRAINED, "duration": recipe.seconds}
    setup = make_task_setup(task, Options(**taken))
    plain = StableVecEnv(name, asked.envs, asked.threads, make_view(name, setup), **taken)
    plain.seed(asked.seed)
    env = VecNormalize(plain, gamma=recipe.gamma)
    network = {"net_arch": [asked.width, asked.width], "log_std_init": recipe.spread}
    model = TimedPPO(
        "MlpPolicy", env, n_steps=asked.steps, batch_size=asked.batch, n_epochs=asked.epochs,
        gamma=recipe.gamma, gae_lambda=0.9, policy_kwargs=network, seed=asked.seed, device="cpu",
    )  # fmt: skip
    model.learn(10**12, Clock(asked.minutes, asked.size))
    asked.out.mkdir(parents=True, exist_ok=True)
    model.save(asked.out / "policy.zip")
    scale = np.sqrt(env.obs_rms.var + env.epsilon)
    np.savez(asked.out / "normalisation.npz", mean=env.obs_rms.mean, scale=scale, most=env.clip_obs)
    facts = {"steps": model.num_timesteps, "minutes": asked.minutes, "seed": asked.seed}
    (asked.out / "training.json").write_text(json.dumps(facts), encoding="utf-8")
    plain.close()


def judge(name: str, asked: argparse.Namespace) -> list[tuple[str, Scores]]:
    """Scores of all controllers on episodes and machines that none has met."""
    recipe, task = RECIPES[name], TASKS[name]
    taken = Options(**choices(name, asked.episodes), variant_seed=JUDGED)  # most have their own
    core = TaskCore(task, taken, min(asked.episodes, 128), asked.threads, DISABLED)
    controllers = {
        "learned": Learned(asked.out, make_view(name, core.setup)),
        "reference, tuned on the same machines": recipe.law(core.setup, recipe.gains),
        "reference with default gains": make_controller("reference", core.setup),
        "zero": make_controller("zero", core.setup),
    }
    return [(k, evaluate_controller(core, c, asked.episodes, FIRST)) for k, c in controllers.items()]


def tuned(name: str, asked: argparse.Namespace) -> Gains:
    """Gains of the law, tuned on the machines that are learned on."""
    recipe = RECIPES[name]
    taken = {**choices(name, asked.variants), "variant_seed": TRAINED, "duration": recipe.seconds}
    core = TaskCore(TASKS[name], Options(**taken), asked.envs, asked.threads, DISABLED)

    def value(gains: Gains) -> float:
        found = evaluate_controller(core, recipe.law(core.setup, gains), asked.envs, asked.seed).mean("return")
        said = ", ".join(f"{key} {number:.4g}" for key, number in gains.items())
        print(f"{found:8.2f}  {said}", file=sys.stderr, flush=True)
        return found

    return tune_gains(value, recipe.gains, upper_bounds=recipe.most)[0]


def difference(scores: list[tuple[str, Scores]], figure: str) -> str:
    """How much the first differs from the second on the same episodes, in standard errors."""
    ours, theirs = (score.results[figure] for _, score in scores[:2])
    gap = ours - theirs
    error = gap.std(ddof=1) / np.sqrt(len(gap))
    return f"{figure}: {gap.mean():+.4g}, {abs(gap.mean()) / error:.1f} standard errors"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("task", choices=RECIPES)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--tune", action="store_true", help="tune the reference's gains, no more")
    parser.add_argument("--judge", action="store_true", help="score the policy in FOLDER, no more")
    for key, value in {
        "minutes": 15.0, "seed": 0, "envs": 64, "threads": 2, "variants": 64, "episodes": 256,
        "steps": 128, "batch": 2048, "epochs": 5, "size": 3e-4, "width": 64,
    }.items():  # fmt: skip
        parser.add_argument(f"--{key}", type=type(value), default=value, help=f"{value}")
    asked = parser.parse_args()
    torch.set_num_threads(1)  # networks are small, and waiting threads take time from the physics
    if asked.tune:
        print(tuned(asked.task, asked))
        return
    if not asked.judge:
        train(asked.task, asked)
    scores = judge(asked.task, asked)
    figures = ["return", RECIPES[asked.task].figure]
    lines = [
        tabulate_scores(scores, figures),
        "",
        "Difference in the same episodes, learned controller minus tuned reference, also in standard errors (above 3"
        " the difference is certain):\n",
    ]
    lines += [f"- {difference(scores, figure)}" for figure in figures]
    text = "\n".join(lines)
    print(text)
    (asked.out / "scores.md").write_text(f"{head(asked)}\n\n{text}\n", encoding="utf-8")


def head(asked: argparse.Namespace) -> str:
    """Return the title, command and description for the file of scores."""
    recipe = RECIPES[asked.task]
    facts = json.loads((asked.out / "training.json").read_text(encoding="utf-8"))
    command = f"python tools/studies/learn.py {asked.task} --minutes {facts['minutes']:g}"
    does = "acts without the reference controller"
    if recipe.corrects:
        does = f"corrects the tuned reference by at most {recipe.share:g} of a full action"
    options = ", ".join(f"{key} {value}" for key, value in recipe.options.items())
    machines = (
        "Machines have random effects (`typical_variation`: valves, friction, oil, delay, payload); training and test"
        " machines differ."
        if recipe.randomised
        else "The machine is nominal."
    )
    gains = ", ".join(f"{key} {value:g}" for key, value in recipe.gains.items())
    return (
        f"# Learned and tuned controllers: {asked.task}\n\n"
        "Does reinforcement learning give a better controller than a hand-written one? A learned controller is compared"
        " with a tuned reference controller on episodes that neither of them used before. The table and the two lines"
        " below it show the result.\n\n"
        f"`{command} --seed {facts['seed']}`\n\n"
        f"- The network, trained with PPO in {facts['steps']:,} steps, {does}. Its input is the"
        f" last {recipe.history} steps.\n"
        f"- Both controllers have {options}. {machines}\n"
        f"- The reference was tuned on the training machines (`--tune`): {gains}. These are gains of the "
        "joint servo ([source](../../hydrotele/scenario/scenario.py), `Servo`) in 1/s (`position`, "
        "`swing`, `pressure`), s (`lead`, `load_time`) and 1/s^2 (`integral`). `deadband` is the "
        "compensated fraction of the valve's dead band. `swing` replaces "
        "`position` for the swing, `integral` is an added integral term.\n"
        f"- Cells are mean ± standard error of {asked.episodes} episodes. A larger return (sum of rewards) and a"
        " smaller tip error are better. `zero` takes no action."
    )


if __name__ == "__main__":
    main()

"""Train a policy with skrl's PPO on thousands of machines of the reduced model, and evaluate it on MuJoCo.

    python tools/studies/train_on_device.py TrackTrajectory --device cuda --envs 4096 --minutes 5 --out trained
    python tools/studies/train_on_device.py TrackTrajectory --device cpu --envs 256 --steps 200000 --out trained

Observations, actions and rewards stay on the device: PyTorch reads the arrays of the environments through DLPack.
Needs `hydrotele[learn]` and skrl, with `--device cuda` also `hydrotele[gpu]`. The policy is written as TorchScript
(`policy.pt`), which `hydrotele run SCENARIO --policy` reads.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch.base import Wrapper
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model

import hydrotele.envs  # noqa: F401 - registers the environments
from hydrotele.batch import as_dlpack
from hydrotele.envs.learning_curve import DEFAULT_RECIPE, RECIPES
from hydrotele.envs.policy_scores import estimate_share, evaluate_policies, make_baselines, make_vector_environment
from hydrotele.envs.policy_training import NormalisingExtractor, PolicyController
from hydrotele.envs.stable_baselines import find_reference_and_measured_columns
from hydrotele.envs.variants import typical_variation

GAMMA, ROLLOUT_STEPS, WIDTH = 0.98, 32, 128
FIRST_DIFFICULTY, GROWTH_END = 0.2, 0.4  # size of the goals at the start; share of the training until full size
WARM_UP_STEPS = 32  # environment steps with random actions for the statistics of the observations


class TensorEnv(Wrapper):
    """Vector environment of hydrotele whose observations, rewards and ends are tensors of its device."""

    def __init__(self, env: Any, device: str) -> None:
        """Wrap an environment of `gymnasium.make_vec` with `device="cpu"` or `"cuda"`."""
        super().__init__(env)
        self.core = env.unwrapped.core
        self._tensor_device = torch.device(device)

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return self._tensor_device

    @property
    def observation_space(self) -> gymnasium.Space:
        """Space of one observation."""
        return self._env.unwrapped.single_observation_space

    @property
    def action_space(self) -> gymnasium.Space:
        """Space of one action."""
        return self._env.unwrapped.single_action_space

    def _column(self, values: Any) -> torch.Tensor:
        return torch.from_dlpack(as_dlpack(values)).float().view(-1, 1)

    def reset(self, seed: int | None = None) -> tuple[torch.Tensor, dict]:
        """Begin all episodes."""
        observation, _ = self._env.reset(seed=seed)
        return torch.from_dlpack(as_dlpack(observation)).clone(), {}

    def step(self, actions: torch.Tensor) -> tuple:
        """Advance all episodes; the tensors are copies on the device, because the next step overwrites the arrays."""
        given = actions.detach().float().contiguous()
        result = self._env.step(given if self.device.type == "cuda" else given.numpy())
        observation = torch.from_dlpack(as_dlpack(result[0])).clone()
        reward, terminated, truncated = (self._column(values) for values in result[1:4])
        return observation, reward, terminated.bool(), truncated.bool(), {}

    def state(self) -> None:
        """Return None: there is no state besides the observation."""

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: environments on the reduced model have no images."""

    def close(self) -> None:
        """Free the environments."""
        self._env.close()


def make_network(env: TensorEnv, outputs: int) -> tuple[torch.nn.Module, NormalisingExtractor]:
    """Return a network from the observation to `outputs` values, and its first layer."""
    columns = find_reference_and_measured_columns(env.core.setup)
    first = NormalisingExtractor(env.observation_space, *(tuple(c.tolist()) for c in columns))
    layers = [torch.nn.Linear(first.features_dim, WIDTH), torch.nn.Tanh(), torch.nn.Linear(WIDTH, WIDTH)]
    return torch.nn.Sequential(first, *layers, torch.nn.Tanh(), torch.nn.Linear(WIDTH, outputs)), first


class Policy(GaussianMixin, Model):
    """Normal distribution of the actions with a mean from the network."""

    def __init__(self, env: TensorEnv) -> None:
        """Make the network for the spaces of an environment."""
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space, device=env.device)
        GaussianMixin.__init__(self, clip_actions=False, clip_log_std=True, min_log_std=-3.0, max_log_std=0.5)
        self.net, self.first = make_network(env, self.num_actions)
        torch.nn.init.orthogonal_(self.net[-1].weight, 0.01)
        self.log_std = torch.nn.Parameter(torch.full((self.num_actions,), -0.5))

    def compute(self, inputs: dict, role: str = "") -> tuple[torch.Tensor, dict]:
        """Return mean and standard deviation of the actions."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Value of an observation."""

    def __init__(self, env: TensorEnv) -> None:
        """Make the network for the observations of an environment."""
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space, device=env.device)
        DeterministicMixin.__init__(self, clip_actions=False)
        self.net, self.first = make_network(env, 1)

    def compute(self, inputs: dict, role: str = "") -> tuple[torch.Tensor, dict]:
        """Return the value."""
        return self.net(inputs["observations"]), {}


def make_agent(env: TensorEnv) -> PPO:
    """Return skrl's PPO with new networks."""
    models = {"policy": Policy(env).to(env.device), "value": Value(env).to(env.device)}
    settings = PPO_CFG(
        rollouts=ROLLOUT_STEPS, learning_epochs=8, mini_batches=max(4, env.num_envs * ROLLOUT_STEPS // 2048),
        discount_factor=GAMMA, gae_lambda=0.9, learning_rate=5e-4, grad_norm_clip=0.5, time_limit_bootstrap=True,
    )  # fmt: skip
    settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
    agent = PPO(
        models=models, memory=RandomMemory(memory_size=ROLLOUT_STEPS, num_envs=env.num_envs, device=env.device),
        cfg=settings, observation_space=env.observation_space, action_space=env.action_space, device=env.device,
    )  # fmt: skip
    agent.init()
    return agent


def update_statistics(env: TensorEnv, agent: PPO) -> torch.Tensor:
    """Take some steps with random actions, set the scales of the networks' inputs, and return the observation."""
    observation, _ = env.reset(seed=0)
    seen = [observation]
    for _ in range(WARM_UP_STEPS):
        seen.append(env.step(2.0 * torch.rand(env.num_envs, *env.action_space.shape, device=env.device) - 1.0)[0])
    for model in (agent.policy, agent.value):
        model.first.update_statistics(torch.stack(seen))
    return seen[-1]


def train(env: TensorEnv, agent: PPO, asked: argparse.Namespace) -> dict[str, float]:
    """Train until the steps or the time are used up; return steps and durations [s]."""
    observation, begin, used, count, total = update_statistics(env, agent), time.perf_counter(), 0.0, 0, 0.0
    used = time.process_time()
    scale = torch.tensor(1.0, device=env.device)  # of the rewards: that of the first rollout's returns
    agent.enable_training_mode(True)
    while True:
        elapsed = time.perf_counter() - begin
        done = count * env.num_envs / asked.steps if asked.steps else elapsed / (60.0 * asked.minutes)
        if done >= 1.0:
            break
        env.core.set_difficulty(FIRST_DIFFICULTY + (1.0 - FIRST_DIFFICULTY) * min(1.0, done / GROWTH_END))
        for group in agent.optimizer.param_groups:
            group["lr"] = 5e-4 * (1.0 - done)
        for _ in range(ROLLOUT_STEPS):
            with torch.no_grad():
                actions, _ = agent.act(observation, None, timestep=count, timesteps=10**9)
                following, reward, terminated, truncated, infos = env.step(actions)
                if count < ROLLOUT_STEPS:
                    scale = torch.maximum(scale, reward.abs().max() / (1.0 - GAMMA) / 10.0)
                total += reward.mean()
                agent.record_transition(
                    observations=observation, states=None, actions=actions, rewards=reward / scale,
                    next_observations=following, next_states=None, terminated=terminated, truncated=truncated,
                    infos=infos, timestep=count, timesteps=10**9,
                )  # fmt: skip
            agent.post_interaction(timestep=count, timesteps=10**9)
            observation, count = following, count + 1
        if count // ROLLOUT_STEPS % 20 == 0:
            mean = float(total) / (20 * ROLLOUT_STEPS)
            print(f"{done:4.0%}  {count * env.num_envs:>12,} steps  mean reward {mean:8.4f}", flush=True)
            total = 0.0
    return {
        "steps": count * env.num_envs, "seconds": round(time.perf_counter() - begin, 1),
        "processor_seconds": round(time.process_time() - used, 1),
    }  # fmt: skip


class _MeanAction:
    """Deterministic actions with the method of stable-baselines3, for `PolicyController`."""

    def __init__(self, net: torch.nn.Module) -> None:
        self._net = net.cpu().eval()

    def predict(self, observation: np.ndarray, deterministic: bool = True) -> tuple[np.ndarray, None]:
        with torch.no_grad():
            return self._net(torch.as_tensor(observation)).clamp(-1.0, 1.0).numpy(), None


def main() -> None:
    """Train, evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=["TrackTrajectory", "StraightLine", "ReachFeller"])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--steps", type=int, help="environment steps, instead of --minutes")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU; 0: one per core")
    parser.add_argument("--randomise", action="store_true", help="machines with the typical variation of parameters")
    parser.add_argument("--episodes", type=int, default=64, help="of the evaluation on MuJoCo")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(asked.seed)
    options = dict(RECIPES.get(asked.task, DEFAULT_RECIPE))
    plain = make_vector_environment(asked.task, asked.episodes, asked.threads, **options)
    if asked.randomise:
        varied = typical_variation(plain.unwrapped.core.setup.machine)  # pyright: ignore[reportAttributeAccessIssue]
        options |= {"randomise": varied, "variants": 64}
        plain = make_vector_environment(asked.task, asked.episodes, asked.threads, **options)
    made = make_vector_environment(
        asked.task, asked.envs, asked.threads, device=asked.device, shaping=GAMMA, timestep=2.5e-3, **options
    )
    env = TensorEnv(made, asked.device)
    agent = make_agent(env)
    result: dict[str, Any] = {"task": asked.task, "device": asked.device, "envs": asked.envs, "seed": asked.seed}
    result |= train(env, agent, asked)
    net = _MeanAction(agent.policy.net)
    torch.jit.trace(net._net, torch.zeros(1, *env.observation_space.shape)).save(str(asked.out / "policy.pt"))
    scores = evaluate_policies(plain, {"policy": PolicyController(net), **make_baselines(plain)}, asked.seed + 10**6)
    result["share"] = estimate_share(scores)
    result["scores"] = {name: score.summarise() for name, score in scores.items()}
    (asked.out / "result.json").write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps({key: value for key, value in result.items() if key != "scores"}))
    for name, score in result["scores"].items():
        print(f"{name:10} return {score['return']:8.1f} ± {score['standard_error']:.1f}   {score['final']}")


if __name__ == "__main__":
    main()

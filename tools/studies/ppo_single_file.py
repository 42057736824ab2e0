"""Train a policy with PPO in a single file, in the style of CleanRL: torch and `gymnasium.make_vec` only.

The batch of environments is one object that native code steps. Observations and rewards are normalised by
gymnasium's wrappers. After an episode has ended, the next step only resets its environment (`NextStep`,
the default of gymnasium): this step is not learned from.
"""

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward

import hydrotele.envs  # noqa: F401 - registers the environments

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="hydrotele/StraightLine-v0")
parser.add_argument("--steps", type=int, default=1_000_000)
parser.add_argument("--envs", type=int, default=64)
parser.add_argument("--rollout", type=int, default=64)
parser.add_argument("--seed", type=int, default=0)
asked = parser.parse_args()
GAMMA, LAMBDA, CLIP, EPOCHS, BATCHES, RATE = 0.98, 0.9, 0.2, 10, 16, 1e-3

torch.manual_seed(asked.seed)
torch.set_num_threads(1)
envs = gymnasium.make_vec(asked.task, asked.envs, "vector_entry_point", control_rate=25.0, shaping=GAMMA)
envs = NormalizeReward(NormalizeObservation(envs), gamma=GAMMA)
size, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]


def make_network(outputs: int) -> torch.nn.Sequential:
    return torch.nn.Sequential(
        torch.nn.Linear(size, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(),
        torch.nn.Linear(64, outputs),
    )  # fmt: skip


actor, critic, log_std = make_network(actions), make_network(1), torch.nn.Parameter(torch.full((actions,), -0.5))
optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], RATE)


def make_distribution(observation: torch.Tensor) -> torch.distributions.Independent:
    return torch.distributions.Independent(torch.distributions.Normal(actor(observation), log_std.exp()), 1)


def as_tensor(values) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float32)


observation, _ = envs.reset(seed=asked.seed)
is_reset = np.zeros(asked.envs, bool)  # whether the next step resets an environment
for update in range(max(1, asked.steps // (asked.envs * asked.rollout))):
    rows: list[tuple[torch.Tensor, ...]] = []
    for _ in range(asked.rollout):
        seen = as_tensor(observation)
        with torch.no_grad():
            action = make_distribution(seen).sample()
            chance, value = make_distribution(seen).log_prob(action), critic(seen)[:, 0]
        observation, reward, terminated, truncated, _ = envs.step(action.clamp(-1.0, 1.0).numpy())
        columns = reward, terminated, terminated | truncated, ~is_reset
        rows.append((seen, action, chance, value, *map(as_tensor, columns)))
        is_reset = terminated | truncated
    with torch.no_grad():
        next_value = critic(as_tensor(observation))[:, 0]
    stacked = [torch.stack(column) for column in zip(*rows, strict=True)]
    seen, action, chance, value, reward, terminated, over, valid = stacked
    advantage, last = torch.zeros_like(reward), torch.zeros(asked.envs)
    for step in reversed(range(asked.rollout)):
        difference = reward[step] + GAMMA * next_value * (1.0 - terminated[step]) - value[step]
        advantage[step] = last = difference + GAMMA * LAMBDA * (1.0 - over[step]) * last
        next_value = value[step]
    rows_used = valid.bool()
    seen, action, chance = seen[rows_used], action[rows_used], chance[rows_used]
    goal, advantage = (advantage + value)[rows_used], advantage[rows_used]
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(seen)).chunk(BATCHES):
            gain = advantage[chosen]
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            ratio = (make_distribution(seen[chosen]).log_prob(action[chosen]) - chance[chosen]).exp()
            loss = -torch.minimum(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain).mean()
            loss = loss + 0.5 * (critic(seen[chosen])[:, 0] - goal[chosen]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters(), log_std], 0.5)
            optimiser.step()
    steps = (update + 1) * asked.envs * asked.rollout
    print(f"{steps} steps, mean normalised reward {reward.mean():.3f}, action spread {log_std.exp().mean():.2f}")
envs.close()

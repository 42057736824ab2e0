"""Score policies and controllers on complete episodes of a registered environment, with confidence intervals.

Only the vector interface of gymnasium is used, so that every registered task can be scored.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.evaluation import SUCCESS

_RESAMPLES = 2000  # resamples of the bootstrap


@dataclasses.dataclass(frozen=True)
class PolicyScores:
    """Results of m episodes.

    Attributes:
        returns: (m,) sums of rewards.
        lengths: (m,) environment steps.
        success: (m,) 1 for successful episodes, 0 for others; None if the task has no such measure.
        final: name -> (m,) value of every other number in `info` at the end of the episode.
    """

    returns: np.ndarray
    lengths: np.ndarray
    success: np.ndarray | None
    final: dict[str, np.ndarray]

    def summarise(self) -> dict[str, Any]:
        """Return mean return with its standard error, mean length and final numbers, and the success rate."""
        count = len(self.returns)
        return {
            "return": float(self.returns.mean()),
            "standard_error": float(self.returns.std(ddof=1) / np.sqrt(count)) if count > 1 else None,
            "length": float(self.lengths.mean()),
            "success": None if self.success is None else float(self.success.mean()),
            "final": {name: float(values.mean()) for name, values in self.final.items()},
        }


def make_environment_id(task: str) -> str:
    """Return the gymnasium id of a task; a name without a namespace is that of a shipped task.

    >>> make_environment_id("ReachFeller"), make_environment_id("mine/Task-v1")
    ('hydrotele/ReachFeller-v0', 'mine/Task-v1')
    """
    return task if "/" in task else f"hydrotele/{task}-v0"


def make_vector_environment(task: str, num_envs: int, threads: int = 0, **options: Any) -> VectorEnv:
    """Make a batch of environments in which an episode that ends is followed by the next in the same step.

    Args:
        task: name of a shipped task, or gymnasium id.
        num_envs: number of environments.
        threads: number of threads, 0 for one per core.
        **options: options of the environment.

    Returns:
        The environments.

    Raises:
        InputError: the environment does not exist, or an option is not valid.
    """
    try:
        return gymnasium.make_vec(
            make_environment_id(task), num_envs, "vector_entry_point", threads=threads,
            autoreset_mode="SameStep", **options,
        )  # fmt: skip
    except gymnasium.error.Error as error:
        raise InputError(f"task {task!r}", str(error)) from None


def make_baselines(env: VectorEnv) -> dict[str, Controller]:
    """Return the controllers that a policy is compared with: zero actions and, if the task has one, the reference."""
    setup = env.unwrapped.core.setup  # pyright: ignore[reportAttributeAccessIssue]
    found = {"zero": make_controller("zero", setup)}
    try:
        found["reference"] = make_controller("reference", setup)
    except InputError:
        pass  # the task has none, or none for these actions
    return found


def evaluate_policies(env: VectorEnv, policies: Mapping[str, Controller], seed: int) -> dict[str, PolicyScores]:
    """Run every policy for one episode per environment; all policies have the same episodes.

    Args:
        env: environments from `make_vector_environment`.
        policies: name -> policy or controller.
        seed: seed of the first episode; the next ones have the following integers.

    Returns:
        Name -> scores.
    """
    return {name: _run_episodes(env, policy, seed) for name, policy in policies.items()}


def _run_episodes(env: VectorEnv, policy: Controller, seed: int) -> PolicyScores:
    n = env.num_envs
    returns, lengths, alive = np.zeros(n), np.zeros(n, int), np.ones(n, bool)
    final: dict[str, np.ndarray] = {}
    observation, _ = env.reset(seed=seed)
    policy.begin(n)
    while alive.any():
        observation, reward, terminated, truncated, info = env.step(np.asarray(policy(observation), np.float32))
        over = terminated | truncated
        returns += np.where(alive, reward, 0.0)
        lengths += alive
        ended = alive & over
        if ended.any():
            policy.reset(over)
            for name, values in info["final_info"].items():
                if not name.startswith("_") and np.asarray(values).dtype.kind in "fiub":
                    final.setdefault(name, np.zeros(n))[ended] = values[ended]
        alive &= ~over
    return PolicyScores(returns, lengths, final.pop(SUCCESS, None), final)


def estimate_share(scores: Mapping[str, PolicyScores], name: str = "policy") -> tuple[float, float, float]:
    """Return the share of the reference controller's advantage over zero actions that a policy has.

    Args:
        scores: scores of the policy, `reference` and `zero` on the same episodes.
        name: name of the policy.

    Returns:
        (share, lower and upper end of its 95 % interval [1]): (policy - zero) / (reference - zero) of the
        mean returns; the interval is that of a bootstrap over episodes.

    >>> made = {name: PolicyScores(np.full(9, value), np.ones(9), None, {}) for name, value in
    ...         {"policy": 3.0, "zero": 1.0, "reference": 5.0}.items()}
    >>> estimate_share(made)
    (0.5, 0.5, 0.5)
    """
    values = np.array([scores[key].returns for key in (name, "zero", "reference")])
    rng = np.random.default_rng(0)
    chosen = rng.integers(values.shape[1], size=(_RESAMPLES, values.shape[1]))
    means = values[:, chosen].mean(axis=2)
    low, high = np.percentile((means[0] - means[1]) / (means[2] - means[1]), [2.5, 97.5])
    policy, zero, reference = values.mean(axis=1)
    return float((policy - zero) / (reference - zero)), float(low), float(high)

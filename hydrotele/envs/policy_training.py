"""Train a policy for a task with PPO of stable-baselines3 (the extra `learn`), and compare it with controllers.

The policy acts alone: no controller takes part. Its file is a plain stable-baselines3 file whose input
is the observation of the environment, since the network itself normalises it (`NormalisingExtractor`).
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.envs.learning_curve import POLICY_FILE, TrainingPlan, TrainingState
from hydrotele.envs.policy_scores import evaluate_policies, make_vector_environment
from hydrotele.envs.stable_baselines import StableVecEnv, find_reference_and_measured_columns

try:
    import torch  # pyright: ignore - an extra
    from stable_baselines3 import PPO  # pyright: ignore
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor  # pyright: ignore
    from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore
except ImportError:
    _MISSING: Any = None
    torch = PPO = BaseCallback = BaseFeaturesExtractor = VecNormalize = _MISSING

_Extractor: Any = BaseFeaturesExtractor or object
_Callback: Any = BaseCallback or object
_Algorithm: Any = PPO or object

StageReport = Callable[[str, float], None]

_FEATURE_LIMIT = 10.0  # largest normalised input of the network
_FINEST_ERROR = 0.01  # errors smaller than this fraction of their RMS value are resolved linearly
_LEARNING_RATE, _MIN_RATE_FRACTION = 1.0e-3, 0.05  # step size at the start, and its fraction at the end
_EVALUATIONS = 20  # evaluations of the policy during training
_CURVE_EPISODES, _CURVE_SEED = 16, 2 * 10**6  # episodes of such an evaluation, seed of the first one
_WARM_UP_STEPS = 50  # steps with random actions that give the first normalisation
_FIRST_DIFFICULTY, _CURRICULUM_FRACTION = 0.2, 0.4  # goals at the start; part of the training until full size


def ignore_report(text: str, fraction: float) -> None:
    """Do nothing."""


class NormalisingExtractor(_Extractor):
    """First layer of a policy: append the reference errors to the observation and normalise both.

    A network hardly resolves millimetres in the difference of two positions that vary by metres, so
    the errors e (reference minus measured value) are additional inputs. They appear twice: normalised like the
    observation, and as asinh(e / s) / asinh(rms(e) / s) with s = 0.01 rms(e), which resolves errors that are
    small compared with those at the start of an episode. Mean and variance are part of the policy and are
    saved with it.
    """

    def __init__(self, observation_space: Box, reference: tuple[int, ...] = (), measured: tuple[int, ...] = ()):
        """Allocate the statistics.

        Args:
            observation_space: space of the observation (o,).
            reference: columns (m,) of references.
            measured: columns (m,) of the measured values of the same quantities.
        """
        size = observation_space.shape[0] + len(reference)
        super().__init__(observation_space, size + len(reference))
        self.register_buffer("reference", torch.tensor(reference, dtype=torch.long))
        self.register_buffer("measured", torch.tensor(measured, dtype=torch.long))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def _append_errors(self, observations: Any) -> Any:
        errors = observations[..., self.reference] - observations[..., self.measured]
        return torch.cat([observations, errors], dim=-1)

    def forward(self, observations: Any) -> Any:
        """Return the features (n, o + 2 m) of observations (n, o)."""
        values = self._append_errors(observations)
        normalised = (values - self.mean) / torch.sqrt(self.variance + 1e-8)
        errors = slice(observations.shape[-1], None)
        scales = _FINEST_ERROR * torch.sqrt(self.variance[errors] + self.mean[errors] ** 2 + 1e-8)
        compressed = torch.asinh(values[..., errors] / scales) / math.asinh(1.0 / _FINEST_ERROR)
        return torch.cat([normalised.clamp(-_FEATURE_LIMIT, _FEATURE_LIMIT), compressed], dim=-1).float()

    def update_statistics(self, observations: np.ndarray) -> None:
        """Add observations (..., o) to the mean and the variance of the features."""
        values = self._append_errors(torch.as_tensor(observations, dtype=torch.float64)).flatten(0, -2)
        count, mean, variance = len(values), values.mean(0), values.var(0, correction=0)
        total, change = self.count + count, mean - self.mean
        self.variance = (self.variance * self.count + variance * count + change**2 * self.count * count / total) / total
        self.mean, self.count = self.mean + change * count / total, total


class PolicyController:
    """A policy of stable-baselines3 as a controller: deterministic actions from observations."""

    def __init__(self, model: Any) -> None:
        """Store the algorithm object or policy, which has the method `predict`."""
        self._model = model

    def begin(self, count: int) -> None:
        """Do nothing: the policy has no state."""

    def reset(self, mask: np.ndarray) -> None:
        """Do nothing: the policy has no state."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (n, a) for observations (n, o)."""
        return self._model.predict(observation, deterministic=True)[0]


class _ScheduledPPO(_Algorithm):
    """PPO whose step size is set by the callback, since it may depend on the time that is left."""

    def _update_learning_rate(self, optimizers) -> None:
        pass


class _Supervisor(_Callback):
    """Schedule step size and difficulty, update the normalisation, evaluate, save, and stop in time."""

    def __init__(self, state: TrainingState, folder: Path, env: Any, report: StageReport, is_stopped: Any) -> None:
        super().__init__()
        self._state, self._folder, self._env = state, folder, env
        self._report, self._is_stopped = report, is_stopped
        self._next_evaluation = 0.0
        self._evaluation = make_vector_environment(
            state.plan.task, _CURVE_EPISODES, state.plan.threads, **state.plan.options
        )

    def _on_training_start(self) -> None:
        self._begin, self._first_steps = time.monotonic() - self._state.seconds, self._state.steps
        self._processor_begin = time.process_time() - self._state.processor_seconds
        self._next_evaluation = self._fraction()

    def _fraction(self) -> float:
        """Return the completed fraction of the training."""
        plan = self._state.plan
        if plan.steps is not None:
            return min(1.0, self._count_steps() / plan.steps)
        assert plan.minutes is not None
        return min(1.0, (time.monotonic() - self._begin) / (60.0 * plan.minutes))

    def _count_steps(self) -> int:
        return self._first_steps + self.num_timesteps

    def _on_step(self) -> bool:
        return self._fraction() < 1.0 and not self._is_stopped()

    def _on_rollout_start(self) -> None:
        done = self._fraction()
        for group in self.model.policy.optimizer.param_groups:
            group["lr"] = _LEARNING_RATE * max(_MIN_RATE_FRACTION, 1.0 - done)
        buffer = self.model.rollout_buffer
        if buffer.full:  # only between an update and the next rollout: both use the same normalisation
            self.model.policy.features_extractor.update_statistics(buffer.observations)
        if self._state.plan.curriculum:
            growth = min(1.0, done / _CURRICULUM_FRACTION)
            self._env.venv.set_difficulty(_FIRST_DIFFICULTY + (1.0 - _FIRST_DIFFICULTY) * growth)
        if done >= self._next_evaluation:
            self._next_evaluation = done + 1.0 / _EVALUATIONS
            self.save()
        self._report(f"{self._count_steps():,} steps, return {self._training_return():.1f}", done)

    def _training_return(self) -> float:
        kept = self.model.ep_info_buffer
        return float(np.mean([episode["r"] for episode in kept])) if kept else float("nan")

    def save(self) -> None:
        """Evaluate the policy, and write it with the state of the training."""
        state = self._state
        scores = evaluate_policies(self._evaluation, {"policy": PolicyController(self.model)}, _CURVE_SEED)["policy"]
        success = float(np.mean(scores.success)) if scores.success is not None else float("nan")
        state.steps, state.seconds = self._count_steps(), time.monotonic() - self._begin
        state.processor_seconds = time.process_time() - self._processor_begin
        difficulty = self._env.venv.difficulty
        state.curve.append([
            state.steps, state.seconds, difficulty, self._training_return(), float(np.mean(scores.returns)), success,
        ])  # fmt: skip
        scale = self._env.ret_rms
        state.reward_scale = float(scale.var), float(scale.mean), float(scale.count)
        with atomic_file(self._folder / POLICY_FILE, ".zip") as part:
            self.model.save(part)
        state.save(self._folder)

    def close(self) -> None:
        self._evaluation.close()


def train_policy(
    state: TrainingState, folder: Path, report: StageReport = ignore_report,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Any:  # fmt: skip
    """Train a policy, or continue its training, and write it with its learning curve into a folder.

    Args:
        state: a new state, or that of `TrainingState.load`.
        folder: existing folder; for a continued training, with the policy.
        report: called with a text and the completed fraction.
        is_stopped: called after every step; returns whether to end the training.

    Returns:
        The algorithm object of stable-baselines3.

    Raises:
        InputError: stable-baselines3 is not installed, or an option of the environment is not valid.
    """
    plan = state.plan
    if torch is None:
        raise InputError("training", "needs stable-baselines3: pip install 'hydrotele[learn]'")
    torch.set_num_threads(1)  # networks are small, and waiting threads take time from the physics
    taken = {"timestep": plan.timestep, **plan.options, "shaping": plan.gamma if plan.shaping else 0.0}
    taken |= {} if plan.device is None else {"device": plan.device}
    plain = StableVecEnv(plan.task, plan.num_envs, plan.threads, **taken)
    env = VecNormalize(plain, norm_obs=False, gamma=plan.gamma)
    try:
        if state.steps:
            model = _ScheduledPPO.load(folder / POLICY_FILE, env, device="cpu")
            assert state.reward_scale is not None
            env.ret_rms.var, env.ret_rms.mean, env.ret_rms.count = (np.float64(v) for v in state.reward_scale)
        else:
            model = _make_model(plan, plain, env)
        plain.seed(plan.seed + state.steps)
        plain.desynchronise(plan.seed)
        supervisor = _Supervisor(state, folder, env, report, is_stopped)
        try:
            model.learn(10**12, supervisor)
            supervisor.save()
        finally:
            supervisor.close()
    finally:
        env.close()
    return model


def _make_model(plan: TrainingPlan, plain: StableVecEnv, env: Any) -> Any:
    reference, measured = find_reference_and_measured_columns(plain.core.setup)
    extractor = {"reference": tuple(reference.tolist()), "measured": tuple(measured.tolist())}
    network = {
        "net_arch": [plan.width, plan.width], "log_std_init": plan.first_log_std,
        "features_extractor_class": NormalisingExtractor, "features_extractor_kwargs": extractor,
    }  # fmt: skip
    model = _ScheduledPPO(
        "MlpPolicy", env, n_steps=plan.rollout_steps, batch_size=plan.batch, n_epochs=plan.epochs,
        gamma=plan.gamma, gae_lambda=0.9, policy_kwargs=network, seed=plan.seed, device="cpu",
    )  # fmt: skip
    rng = np.random.default_rng(plan.seed)
    seen = [plain.reset()]
    shape = (plan.num_envs, *plain.action_space.shape)
    for _ in range(_WARM_UP_STEPS):
        seen.append(plain.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32))[0])
    model.policy.features_extractor.update_statistics(np.array(seen))
    return model


def load_policy(path: Path) -> PolicyController:
    """Read a policy of `train_policy`, or any PPO policy of stable-baselines3 whose input is the observation.

    Args:
        path: file of the policy (.zip).

    Returns:
        The policy as a controller.

    Raises:
        InputError: stable-baselines3 is not installed, or the file is missing or is no such policy.
    """
    if torch is None:
        raise InputError(path, "needs stable-baselines3: pip install 'hydrotele[learn]'")
    try:
        return PolicyController(_ScheduledPPO.load(path, device="cpu"))
    except (OSError, ValueError, KeyError, AttributeError, RuntimeError) as error:
        raise InputError(path, f"is not a policy of stable-baselines3: {error}") from None

"""Batched environments for stable-baselines3 (the extra `learn`).

`StableVecEnv` steps all environments in one native call. `AgentInterface` transforms observations and
actions for learning. It appends the reference errors, since a network hardly resolves millimetres
in the difference of two positions that vary by metres. It stacks the last steps, since the dynamics
of a machine show only over time. The agent may correct the action of a reference controller.
"""

import copy
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from hydrotele.core.errors import InputError
from hydrotele.core.plugins import hide_triton_from_torch
from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.policy_scores import make_vector_environment
from hydrotele.envs.task_setup import TaskSetup

_FOLLOWERS = {"log": ("tip",), "goal": ("log", "tip")}  # field -> fields that have to follow it


def find_reference_and_measured_columns(setup: TaskSetup) -> tuple[np.ndarray, np.ndarray]:
    """Return the observation columns of references and of the present measured values of the same quantities.

    References of a later time (`reference_in_..._ms`) are included. A log is a reference for the tip, and its
    goal pose one for the log and the tip. A reference without a measured value in the observation is omitted.

    Args:
        setup: the task with its options.

    Returns:
        (columns (m,) of references, columns (m,) of the corresponding measured values).
    """
    places = {field.name: number for number, field in enumerate(setup.fields)}
    asked, measured = [], []
    for number, field in enumerate(setup.fields):
        what, _, where = field.name.partition(".")
        start, _, rest = what.partition("_")
        if start == "reference":
            twins = (rest,) if rest in ("rate", "force") else ("angle", "position", "length", "tip")
        else:
            twins = _FOLLOWERS.get(what, ())
        for twin in twins:
            name = f"{twin}.{where}" if where else twin
            if name in places:
                asked.append(number)
                measured.append(places[name])
    return np.array(asked, int), np.array(measured, int)


class AgentInterface:
    """Transform observations and actions between n environments and an agent.

    The agent observes the last steps with their reference errors (reference minus measured value).
    Its action is scaled and, if there is a controller, added to the action of the controller.

    Attributes:
        observation_size: number of values in the observation of the agent.
    """

    def __init__(
        self,
        setup: TaskSetup,
        history: int = 3,
        controller: Controller | None = None,
        max_fraction: float = 1.0,
    ) -> None:
        """Store the settings and determine the size of the agent's observation.

        Args:
            setup: the task with its options.
            history: number of environment steps in an observation of the agent, including the
                current one.
            controller: a controller whose actions the agent corrects, None for an agent alone.
            max_fraction: factor on the actions of the agent, the largest fraction of a full action
                that it can command or add.
        """
        self._controller, self._max_fraction, self._history = controller, max_fraction, history
        self._reference_columns, self._measured_columns = find_reference_and_measured_columns(setup)
        self._actions = len(setup.axes)
        self._step_size = len(setup.fields) + len(self._reference_columns)
        self.observation_size = history * self._step_size + (self._actions if controller else 0)

    def begin(self, count: int) -> None:
        """Allocate the history of `count` parallel episodes, and the state of the controller."""
        self._stacked_steps = np.zeros((count, self._history, self._step_size), np.float32)
        self._base_action = np.zeros((count, self._actions), np.float32)
        self._is_new = np.ones(count, bool)
        if self._controller:
            self._controller.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Restart the history of the episodes selected by the boolean mask (n,), and reset the controller.

        The history is filled with the next observation.
        """
        self._is_new |= mask
        if self._controller:
            self._controller.reset(mask)

    def _append_reference_errors(self, observation: np.ndarray) -> np.ndarray:
        errors = observation[:, self._reference_columns] - observation[:, self._measured_columns]
        return np.concatenate([observation, errors], axis=1)

    def _build_agent_observation(self, past: np.ndarray, base: np.ndarray) -> np.ndarray:
        flat = past.reshape(len(past), -1)
        return np.concatenate([flat, base], axis=1) if self._controller else flat.copy()

    def make_agent_observation(self, observation: np.ndarray) -> np.ndarray:
        """Append environment observations (n, o) to the history and return the agent's observation (n, size).

        It holds the last steps, newest first, with their reference errors and, with a controller,
        the action that the controller computes now.
        """
        now = self._append_reference_errors(observation)
        self._stacked_steps[:, 1:] = self._stacked_steps[:, :-1]
        self._stacked_steps[:, 0] = now
        self._stacked_steps[self._is_new] = now[self._is_new, None]
        self._is_new[:] = False
        if self._controller:
            self._base_action[:] = np.clip(self._controller(observation), -1.0, 1.0)
        return self._build_agent_observation(self._stacked_steps, self._base_action)

    def make_final_agent_observation(self, observation: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the agent's observation (m, size) of the last step of episodes that ended.

        `observation` (n, o) holds the final observations of the environments, and `chosen` (m,) the
        indices of the episodes. The history is not changed. The controller is not evaluated, since
        its state belongs to the next episode already: its last action is used.
        """
        now = self._append_reference_errors(observation[chosen])[:, None]
        past = np.concatenate([now, self._stacked_steps[chosen, :-1]], axis=1)
        return self._build_agent_observation(past, self._base_action[chosen])

    def make_environment_action(self, action: np.ndarray) -> np.ndarray:
        """Return the environment actions (n, a) for the actions of the agent (n, a).

        The agent's actions are clipped to +-1 and multiplied by the maximum fraction. With a
        controller, its last action is added and the sum is clipped to +-1.
        """
        own = self._max_fraction * np.clip(action, -1.0, 1.0)
        return np.clip(self._base_action + own, -1.0, 1.0) if self._controller else own


hide_triton_from_torch()
try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore - an extra
except ImportError:
    VecEnv = None

_VecEnvBase: Any = VecEnv or object


class StableVecEnv(_VecEnvBase):
    """A stable-baselines3 VecEnv with n environments of a task.

    Attributes:
        env: the vector environment of gymnasium.
        core: the running task.
        view: transform between environment and agent, None for plain observations and actions.
    """

    def __init__(
        self, task: Any, num_envs: int, threads: int = 0, view: AgentInterface | None = None,
        **options: Any,
    ) -> None:  # fmt: skip
        """Create the environments: compile the machine variants and define the spaces.

        Args:
            task: name of a task, class or object of `PythonTask`, or gymnasium id of an environment with a
                `vector_entry_point`.
            num_envs: number of environments n.
            threads: number of threads that step the environments; 0 for one per core.
            view: transform between environment and agent, made from the same task and options.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: stable-baselines3 is not installed, or an option does not exist or is not
                valid.
        """
        if VecEnv is None:
            message = "needs stable-baselines3: pip install 'hydrotele[learn]'"
            raise InputError("StableVecEnv", message)
        self.env: Any = make_vector_environment(task, num_envs, threads, **options)
        self.core, self.view = self.env.unwrapped.core, view
        self.render_mode = None
        space = self.env.single_observation_space
        if view:
            space = Box(-np.inf, np.inf, (view.observation_size,), np.float32)
        super().__init__(num_envs, space, self.env.single_action_space)
        self._infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._finished = np.zeros(0, int)
        self._desynchronising_seed: int | None = None
        self._return, self._length = np.zeros(num_envs), np.zeros(num_envs, int)

    @property
    def difficulty(self) -> float:
        """Size of the goals of new episodes, from 0.01 to 1 (those of the task)."""
        return float(self.core.parameters["difficulty"])

    def set_difficulty(self, difficulty: float) -> None:
        """Set the size of the goals of new episodes, see `difficulty` of `hydrotele.envs.task.Options`."""
        self.core.set_difficulty(difficulty)

    def desynchronise(self, seed: int) -> None:
        """Let the first episodes after the next `reset` end at random times.

        Otherwise the episodes of a batch begin at the same time and are always in the same phase.
        """
        self._desynchronising_seed = seed

    def reset(self) -> np.ndarray:
        """Start an episode in every environment, with the seed given to the method `seed` before, or a random one.

        Returns:
            (n, o) observations, those of the agent if there is a `view`.
        """
        observation, _ = self.env.reset(seed=list(self._seeds))
        self._reset_seeds()
        self._return[:], self._length[:] = 0.0, 0
        if self._desynchronising_seed is not None:
            steps = np.random.default_rng(self._desynchronising_seed).integers(
                self.core.setup.clock.horizon, size=self.num_envs
            )
            self.core.episodes["step"] = steps
            self._desynchronising_seed = None
        if self.view:
            self.view.begin(self.num_envs)
            return self.view.make_agent_observation(observation)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (n, a) for `step_wait`.

        Raises:
            ValueError: the number of actions differs from the number of environments.
        """
        if np.ndim(actions) != 2 or len(actions) != self.num_envs:
            raise ValueError(f"needs {self.num_envs} rows of actions, got {np.shape(actions)}")
        self._pending_actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all environments by one step; those whose episode ends start a new one in the same step.

        Returns:
            (observations (n, o), rewards (n,), dones (n,), infos). The info of an environment whose
            episode ended holds `terminal_observation`, `TimeLimit.truncated`, `episode` and the
            task measures; the others are empty.
        """
        view, action = self.view, self._pending_actions
        observation, reward, terminated, truncated, info = self.env.step(
            view.make_environment_action(action) if view else action
        )
        self._return += reward
        self._length += 1
        over = terminated | truncated
        for number in self._finished:
            self._infos[number] = {}
        ended = self._finished = np.flatnonzero(over)
        if len(ended):
            last = np.array(observation)
            last[ended] = np.stack(info["final_obs"][ended])
            self._write_final_infos(
                ended, view.make_final_agent_observation(last, ended) if view else last[ended], truncated,
                info["final_info"],
            )  # fmt: skip
            if view:
                view.reset(over)
        seen = view.make_agent_observation(observation) if view else observation
        return seen, reward.astype(np.float32), over, self._infos

    def _write_final_infos(self, ended: np.ndarray, last: np.ndarray, truncated: np.ndarray, final: dict) -> None:
        """Write the infos of the episodes that ended: task measures, last observation, return and length.

        `ended` (m,) are the indices of the environments, `last` (m, ...) the final observations and `final` the
        final infos. Return and length of these environments are set to 0 for the next episode.
        """
        names = [name for name in final if not name.startswith("_")]
        for row, i in enumerate(ended):
            figures = {name: final[name][i].item() for name in names}
            total, length = float(self._return[i]), int(self._length[i])
            self._infos[i] = {
                **figures, "terminal_observation": last[row],
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {"r": total, "l": length, "t": 0.0},
            }  # fmt: skip
        self._return[ended], self._length[ended] = 0.0, 0

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the complete state with the history of the agent and the state of its controller."""
        return {
            "core": self.core.get_state(), "view": copy.deepcopy(self.view), "return": self._return.copy(),
            "length": self._length.copy(),
        }  # fmt: skip

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state of `get_state`; the next steps give the same bits as they did after it.

        Raises:
            InputError: the state belongs to another environment, or has another number of episodes.
        """
        self.core.set_state(state["core"])
        self.view = copy.deepcopy(state["view"])
        self._return[:], self._length[:] = state["return"], state["length"]

    def close(self) -> None:
        """Free the memory of the simulations."""
        self.env.close()

    def _count_indices(self, indices: Any) -> int:
        return self.num_envs if indices is None else len(np.atleast_1d(indices))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return a list with the attribute of this object, repeated for each environment in `indices` (None: all)."""
        return [getattr(self, attr_name)] * self._count_indices(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise InputError: an attribute of a single environment of the batch cannot be set."""
        raise InputError(attr_name, "cannot be set: all environments of a batch share it")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any):
        """Raise InputError: a method of a single environment of the batch cannot be called."""
        raise InputError(method_name, "cannot be called: the environments are one object")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return a list with False for each environment in `indices` (None: all): wrappers are not supported."""
        return [False] * self._count_indices(indices)

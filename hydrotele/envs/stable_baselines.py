"""The batched environments for stable-baselines3 (the extra `learn`): no Python per environment."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.agent import AgentView
from hydrotele.envs.episode import SAME_STEP
from hydrotele.envs.making import action_space, make_core, observation_space

try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore - an extra
except ImportError:
    VecEnv = None

_Base: Any = VecEnv or object


class StableVecEnv(_Base):
    """n environments of a task as a VecEnv.

    Attributes:
        core: the running task.
        view: what the agent sees and does, None for the plain observation and actions.
    """

    def __init__(
        self, task: str, num_envs: int, threads: int = 0, view: AgentView | None = None,
        **options: Any,
    ) -> None:  # fmt: skip
        """Compile the machines.

        Args:
            task: name of the task.
            num_envs: number of environments n.
            threads: that step them; 0 for one per core.
            view: between environment and agent, made from the same task and options.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: stable-baselines3 is not installed; an option is not known or does not suit.
        """
        if VecEnv is None:
            message = "needs stable-baselines3: pip install 'hydrotele[learn]'"
            raise InputError("StableVecEnv", message)
        self.core, self.view = make_core(task, options, num_envs, threads, SAME_STEP), view
        self.render_mode = None
        space = observation_space(self.core)
        if view:
            space = Box(-np.inf, np.inf, (view.size,), np.float32)
        super().__init__(num_envs, space, action_space(self.core))
        self._infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._ended = np.zeros(0, int)
        self._return, self._length = np.zeros(num_envs), np.zeros(num_envs, int)

    def reset(self) -> np.ndarray:
        """Begin episodes; seeds are those given to `seed`.

        Returns:
            (n, o).
        """
        drawn = np.random.default_rng().integers(2**62, size=self.num_envs)
        given = zip(self._seeds, drawn, strict=True)
        self.core.reset(np.array([d if seed is None else seed for seed, d in given]))
        self._reset_seeds()
        self._return[:], self._length[:] = 0.0, 0
        if self.view:
            self.view.begin(self.num_envs)
            return self.view.see(self.core.observation)
        return self.core.observation.copy()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (n, a) for `step_wait`.

        Raises:
            ValueError: there are not as many actions as environments.
        """
        if np.ndim(actions) != 2 or len(actions) != self.num_envs:
            raise ValueError(f"{self.num_envs} actions are wanted, not {np.shape(actions)}")
        self._given = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Go on by one step; environments whose episode ended begin a new one.

        Returns:
            (observations (n, o), rewards (n,), ends of episodes (n,), infos): the dicts of
            environments that go on are empty, the others hold `terminal_observation`,
            `TimeLimit.truncated`, `episode` and the task's figures.
        """
        core, view = self.core, self.view
        core.step(view.act(self._given) if view else self._given)
        self._return += core.reward
        self._length += 1
        over = (core.terminated | core.truncated) != 0
        ended = np.flatnonzero(over)
        for number in self._ended:
            self._infos[number] = {}
        self._ended = ended
        if len(ended):
            self._end(ended, view.last(core.final, ended) if view else core.final[ended])
            if view:
                view.reset(over)
        seen = view.see(core.observation) if view else core.observation.copy()
        return seen, core.reward.astype(np.float32), over, self._infos

    def _end(self, ended: np.ndarray, last: np.ndarray) -> None:
        """Say how episodes ended."""
        names = [name for name, _ in self.core.setup.task.measures]
        for row, i in enumerate(ended):
            figures = dict(zip(names, self.core.final_measures[i].tolist(), strict=False))
            total, length = float(self._return[i]), int(self._length[i])
            self._infos[i] = {
                **figures, "terminal_observation": last[row],
                "TimeLimit.truncated": bool(self.core.truncated[i]),
                "episode": {"r": total, "l": length, "t": 0.0},
            }  # fmt: skip
        self._return[ended], self._length[ended] = 0.0, 0

    def close(self) -> None:
        """Give the simulations' memory back."""
        self.core.close()

    def _many(self, indices: Any) -> int:
        return self.num_envs if indices is None else len(np.atleast_1d(indices))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute of this object for every environment."""
        return [getattr(self, attr_name)] * self._many(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: the environments are one object."""
        raise InputError(attr_name, "the environments of a batch share it and it cannot be set")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any):
        """Refused: the environments are one object."""
        raise InputError(method_name, "the environments of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No environment is wrapped."""
        return [False] * self._many(indices)

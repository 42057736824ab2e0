"""Thousands of environments stepped by one native call on a pool of threads."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hydrotele.envs.making import (
    AUTORESET,
    action_space,
    check_mode,
    info_of,
    make_core,
    observation_space,
    with_rate,
)
from hydrotele.envs.stage import Camera, Stage


class MachineVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """n environments of a task; each is, bit for bit, the single one of its seed.

    Attributes:
        core: the running task.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self, task: str, num_envs: int = 1, render_mode: str | None = None, threads: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, width: int = 640,
        height: int = 480, camera: Camera = None, shown: int | None = None, **options: Any,
    ) -> None:  # fmt: skip
        """Compile the machines.

        Args:
            task: name of the task.
            num_envs: number of environments n.
            render_mode: None or `rgb_array`.
            threads: that step them; 0 for one per core. Results do not depend on it.
            autoreset_mode: of gymnasium.
            width: of pictures [pixel].
            height: of pictures [pixel].
            camera: a camera of the machine; without, one that shows all that its arm reaches.
            shown: number of environments, the first ones, that pictures are made of; without, all.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: an option is not known or does not suit.
        """
        check_mode(render_mode, self.metadata["render_modes"])
        mode = AutoresetMode(autoreset_mode)
        self.core = make_core(task, options, num_envs, threads, AUTORESET[mode.value])
        self.metadata = {**with_rate(self.metadata, self.core), "autoreset_mode": mode}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = observation_space(self.core)
        self.single_action_space = action_space(self.core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._mode, self._begun = mode, False
        self._view: tuple[int, int, Camera] = width, height, camera
        self._stage: Stage | None = None
        self._shown = num_envs if shown is None else min(shown, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of the first environment, the others count up; or one each.
            options: `reset_mask` (n,) bool says which ones; all without.

        Returns:
            (observations (n, o), infos).

        Raises:
            ValueError: seeds or mask have a wrong length, or a seed is not usable.
            RuntimeError: the first reset leaves some out.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = self._chosen(options)
        seeds = self._seeds(seed)
        if seeds is not None and chosen is not None:
            seeds = seeds[chosen]
        self.core.reset(seeds, chosen)
        return self.core.observation.copy(), self._infos(chosen)

    def _chosen(self, options: dict[str, Any] | None) -> np.ndarray | None:
        if not options or "reset_mask" not in options:
            return None
        mask = options["reset_mask"]
        if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.any()
                and mask.shape == (self.num_envs,)):  # fmt: skip
            raise ValueError(f"reset_mask must be ({self.num_envs},) bool with a True in it")
        return np.flatnonzero(mask)

    def _seeds(self, seed: int | list[int | None] | None) -> np.ndarray | None:
        if seed is None and self._begun:
            return None
        self._begun = True
        if isinstance(seed, (int, np.integer)):
            return np.array([int(seed) + k for k in range(self.num_envs)])
        drawn = self.np_random.integers(2**62, size=self.num_envs)
        if seed is None:
            return drawn
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} environments")
        return np.array([d if s is None else s for s, d in zip(seed, drawn, strict=True)])

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Go on by one step; environments whose episode ended begin a new one.

        Args:
            actions: (n, a); beyond +-1 they count as full.

        Returns:
            (observations (n, o), rewards (n,), terminations (n,), truncations (n,), infos).

        Raises:
            ValueError: the actions have another shape, or are not finite numbers.
        """
        core = self.core
        if np.shape(actions) != core.action.shape:
            raise ValueError(f"actions are {core.action.shape}, not {np.shape(actions)}")
        core.step(actions)
        infos = self._infos(None)
        over = (core.terminated | core.truncated).astype(bool)
        if self._mode is AutoresetMode.SAME_STEP and over.any():
            infos = self._with_final(infos, over)
        return (
            core.observation.copy(), core.reward.copy(), core.terminated.astype(bool),
            core.truncated.astype(bool), infos,
        )  # fmt: skip

    def _infos(self, chosen: np.ndarray | None) -> dict[str, Any]:
        there = np.zeros(self.num_envs, bool)
        there[slice(None) if chosen is None else chosen] = True
        return _masked(info_of(self.core), there)

    def _with_final(self, infos: dict[str, Any], over: np.ndarray) -> dict[str, Any]:
        """What the last steps of episodes ended with, beside the first of the new ones."""
        observations = np.full(self.num_envs, None, dtype=object)
        for number in np.flatnonzero(over):
            observations[number] = self.core.final[number].copy()
        last = _masked(info_of(self.core, final=True), over)
        final = {"final_obs": observations, "final_info": last}
        return infos | _masked(final, over)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw machines and their goals, one after the other.

        Returns:
            `shown` pictures (height, width, 3) uint8, or None without `render_mode`.

        Raises:
            InputError: there is no such camera, or no OpenGL works (says what to do).
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() shows nothing without render_mode='rgb_array'")
            return None
        if self._stage is None:
            self._stage = Stage(self.core)
        return tuple(self._stage.picture(n, *self._view) for n in range(self._shown))

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulations' memory back."""
        if self._stage:
            self._stage.close()
            self._stage = None
        self.core.close()


def _masked(infos: dict[str, Any], there: np.ndarray) -> dict[str, Any]:
    """The same with gymnasium's masks beside: whose figures they are."""
    return infos | {f"_{name}": there.copy() for name in infos}

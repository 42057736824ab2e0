"""One environment for gymnasium."""

from typing import Any

import gymnasium
import numpy as np

from hydrotele.envs.making import action_space, info_of, make_core, observation_space
from hydrotele.tasks.memory import DISABLED


class MachineEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A control task on a simulated machine.

    Attributes:
        core: the running task: machine, axes, fields of the observation with units, variants.
        observation_space: (o,) float32 in SI; what each number is: `core.setup.fields`.
        action_space: (a,) float32 from -1 to 1; what each number moves: `core.coordinates`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        """Compile the machine.

        Args:
            task: name of the task, as in `hydrotele/<Name>-v0`.
            render_mode: None, `rgb_array` or `human`.
            **options: fields of `hydrotele.tasks.task.Options`.

        Raises:
            InputError: an option is not known or does not suit.
        """
        self.core = make_core(task, options, 1, 1, DISABLED)
        self.render_mode = render_mode
        self.observation_space = observation_space(self.core)
        self.action_space = action_space(self.core)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode: a variant, and a goal, drawn from the seed or what came of it.

        Args:
            seed: integer >= 0; without one, random numbers go on.
            options: none.

        Returns:
            (observation (o,), info).
        """
        super().reset(seed=seed)
        if seed is None and not self._begun:
            seed = int(self.np_random.integers(2**62))
        self._begun = True
        self.core.reset(None if seed is None else np.array([seed]))
        return self.core.observation[0].copy(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Go on by one step.

        Args:
            action: (a,); beyond +-1 it counts as full.

        Returns:
            (observation (o,), reward, terminated, truncated, info).

        Raises:
            ValueError: the action has another shape, or is not a finite number.
        """
        core = self.core
        core.step(action)
        return (
            core.observation[0].copy(), float(core.reward[0]), bool(core.terminated[0]),
            bool(core.truncated[0]), self._info(),
        )  # fmt: skip

    def _info(self) -> dict[str, Any]:
        return {name: values[0] for name, values in info_of(self.core).items()}

    def close(self) -> None:
        """Give the simulation's memory back."""
        self.core.close()

"""Run n parallel episodes of a task on the reduced model on a CUDA device.

Actions, observations, rewards and the ends of episodes are arrays of the device. A step launches one kernel; nothing
is copied to the processor and nothing waits for the device.
"""

from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.envs.episode import RESET, make_seed_states
from hydrotele.envs.reduced_core import ReducedCore
from hydrotele.envs.saved_state import SavedState, restore_state, save_state
from hydrotele.envs.task import Options, Task


class DeviceCore(ReducedCore):
    """n parallel episodes of a task on the reduced model on a CUDA device; see `ReducedCore`.

    Attributes:
        episodes: (n,) records of EPISODE_STATE, an array of the device like the other arrays of `TaskCore`.
    """

    is_on_device = True

    def __init__(
        self, task: Task, options: Options, count: int = 1, threads: int = 1, autoreset: int = 0,
        precision: str | None = None,
    ) -> None:  # fmt: skip
        """Make the machines and the kernels; the arguments are those of `ReducedCore`."""
        super().__init__(task, options, count, threads, autoreset, "cuda", precision)
        if self.batch.count != count:
            raise InputError("num_envs", f"must be at least {self.batch.count}, the number of variants")

    def reset(self, seeds: np.ndarray | None = None, chosen: np.ndarray | None = None) -> None:
        """Start new episodes in all simulations or in the chosen ones; see `TaskCore.reset`."""
        numbers = np.arange(self.count) if chosen is None else np.asarray(chosen, np.int64)
        begun = self._is_started.copy()
        begun[numbers] = True
        if not begun.all():
            raise RuntimeError("the first reset must begin all episodes: give it no mask")
        if seeds is None and not self._is_started.all():
            raise RuntimeError("the first reset needs seeds")
        self._is_started = begun
        random, batch = np.zeros(0, np.uint64) if seeds is None else make_seed_states(seeds), self.batch
        batch.launch(self._functions.begin_one, batch.task_arrays, batch.model, batch.machines, random, numbers)

    def step(self, action: Any) -> None:
        """Advance all episodes by one environment step.

        Args:
            action: (n, a) array of the device or of the CPU; values outside +-1 are clipped. They are not checked:
                an episode whose state is not finite ends as terminated.

        Raises:
            ValueError: the shape is wrong.
            RuntimeError: the episodes have not been reset.
        """
        if not self._is_started.all():
            raise RuntimeError("reset before the first step")
        if np.shape(action) not in (wanted := self.action.shape, wanted[1:]):
            raise ValueError(f"the action must have shape {wanted}, not {np.shape(action)}")
        self.batch.assign(self.action, action)
        self.batch.step(None, self.setup.clock.ticks)

    def set_difficulty(self, difficulty: float) -> None:
        """Set the size of the goals of new episodes on the device."""
        super().set_difficulty(difficulty)
        self.batch.assign(self.batch.task_arrays.parameters, self.parameters.reshape(1))

    def _run_call(self, call: int, chosen: np.ndarray | None) -> None:
        """Raise RuntimeError: `reset` and `step` launch kernels themselves."""
        raise RuntimeError(f"call {'reset' if call == RESET else 'step'}")

    def _state_arrays(self) -> dict[str, Any]:
        """Return copies of the arrays of the state in the memory of the CPU."""
        live = super()._state_arrays()
        return {n: a if isinstance(a, np.ndarray) else self.batch.to_host(a) for n, a in live.items()}

    def get_state(self, index: np.ndarray | int | None = None) -> SavedState:
        """Return a copy of the complete state of the episodes `index` (None: all), in the memory of the CPU."""
        return save_state(self._environment, self._state_arrays(), index)

    def set_state(self, state: SavedState, index: np.ndarray | int | None = None) -> None:
        """Continue from a saved state; see `TaskCore.set_state`."""
        arrays, live = self._state_arrays(), super()._state_arrays()
        restore_state(self._environment, arrays, state, index)
        for name, array in live.items():
            if not isinstance(array, np.ndarray):
                self.batch.assign(array, arrays[name])

"""Rate commands that make positions track references, with feedback of a modelled position."""

import numpy as np

from hydrotele.envs.controllers.controller import (
    environment_step_time,
)
from hydrotele.envs.task_setup import TaskSetup


class RateFeedback:
    """Compute rate commands that make positions track references, with feedback of a modelled position.

    Control loops of the environment track the commanded rates. They are slow, so the measured position
    cannot be fed back with a high gain. The model integrates the commanded rates without lag, so its
    position can. It is corrected slowly towards the measured position.
    """

    def __init__(self, setup: TaskSetup, fastest: np.ndarray, accelerations: np.ndarray, gains) -> None:
        """Store control period, rate limits and gains.

        Args:
            setup: the task with its options.
            fastest: (k,) rates at full action.
            accelerations: (k,) acceleration limits.
            gains: position gain of the model, gain of its correction towards the measured position
                [1/s].
        """
        self._tracking_gain, self._correction_gain = gains
        self._fastest, self._dt = fastest, environment_step_time(setup)
        self._period, self._ticks = setup.clock.period, setup.clock.ticks
        self._max_rate_change = accelerations * self._period

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        shape = (count, len(self._fastest))
        self._model_position, self._model_rate = np.zeros(shape), np.zeros(shape)
        self._is_new = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Reset the controller state of the episodes selected by the boolean mask (n,)."""
        self._is_new |= mask

    def compute_rate_commands(self, measured: np.ndarray, place: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the rate commands, scaled to +-1.

        Args:
            measured: (n, k) measured positions.
            place: (n, k) reference positions.
            rate: (n, k) reference rates.

        Returns:
            (n, k) commands.
        """
        self._model_position[self._is_new] = measured[self._is_new]
        self._model_rate[self._is_new], self._is_new[:] = 0.0, False
        self._model_position += self._correction_gain * self._dt * (measured - self._model_position)
        wanted = (rate + self._tracking_gain * (place - self._model_position)) / self._fastest
        action = np.clip(wanted, -1.0, 1.0)
        for _ in range(self._ticks):
            self._model_rate += np.clip(
                action * self._fastest - self._model_rate,
                -self._max_rate_change,
                self._max_rate_change,
            )
            self._model_position += self._period * self._model_rate
        return action

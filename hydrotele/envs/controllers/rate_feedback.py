"""Rate commands that make positions track references, with feedback of a modelled position."""

import numpy as np

from hydrotele.envs.controllers.controller import (
    environment_step_time,
)
from hydrotele.envs.task_setup import TaskSetup


class RateFeedback:
    """Compute rate commands that make positions track references, with feedback of a modelled position.

    The command is the reference rate plus a gain times the difference between reference position
    and modelled position. The model integrates the commanded rates with the acceleration limits of
    the environment. It has no lag, so this gain can be high. The control loops of the environment
    are too slow for a high gain on the measured position, which only corrects the modelled position
    slowly.
    """

    def __init__(self, setup: TaskSetup, fastest: np.ndarray, accelerations: np.ndarray, gains) -> None:
        """Store control period, rate limits and gains.

        Args:
            setup: the task with its options.
            fastest: (k,) rates at full action [rad/s] or [m/s].
            accelerations: (k,) acceleration limits of the modelled rates [rad/s^2] or [m/s^2].
            gains: (gain of reference minus modelled position, gain of measured minus modelled
                position by which the model is corrected) [1/s].
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
        """Mark the episodes of the boolean mask (n,) as new; their model restarts at the next measured position."""
        self._is_new |= mask

    def compute_rate_commands(self, measured: np.ndarray, place: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the rate commands as fractions of the rates at full action, and advance the model by one step.

        Args:
            measured: (n, k) measured positions [rad] or [m].
            place: (n, k) reference positions [rad] or [m].
            rate: (n, k) reference rates [rad/s] or [m/s].

        Returns:
            (n, k) commands, clipped to +-1.
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

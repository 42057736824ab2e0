"""A force on a plate of unknown stiffness: come down slowly, then let the error set the speed."""

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.tasks.controllers.controller import Controller, columns
from hydrotele.tasks.facts import Setup

_TOUCH = 1.5e3  # N: what the load cell does not read by error
_APPROACH, _MOST = 0.08, 0.10  # m/s
_GAIN = 2.0e-6  # m/s per N: two per second on 1e6 N/m


class Press:
    """The rate of the tip's height from the error of the force; nothing is remembered."""

    def __init__(self, setup: Setup) -> None:
        """Find the columns.

        Raises:
            InputError: actions are not rates of the tip.
        """
        if setup.options.action != "resolved_motion":
            raise InputError(f"action {setup.options.action!r}", "presses by resolved_motion only")
        self._force = columns(setup, "force", [""])[0]
        self._wanted = columns(setup, "wanted_force", [""])[0]
        self._fastest, self._actions = setup.task.pose_rates[2], len(setup.axes)

    def begin(self, count: int) -> None:
        """Nothing to remember."""

    def reset(self, mask: np.ndarray) -> None:
        """Nothing to forget."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, o)."""
        force, wanted = observation[:, self._force], observation[:, self._wanted]
        speed = np.clip(_GAIN * (force - wanted), -_MOST, _MOST)
        actions = np.zeros((len(observation), self._actions))
        actions[:, 2] = np.where(force < _TOUCH, -_APPROACH, speed) / self._fastest
        return actions


def press_controller(setup: Setup) -> Controller:
    """Controller of HoldForce, whose actions must be rates of the tip."""
    return Press(setup)

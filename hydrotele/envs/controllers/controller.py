"""What a controller is, the two that know nothing, and how one finds its columns."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.envs.facts import TaskSetup


class Controller(Protocol):
    """Actions from observations, for n episodes side by side."""

    def begin(self, count: int) -> None:
        """Make room for `count` episodes and start them."""
        ...

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes that are over.

        Args:
            mask: (n,) bool, which ones.
        """
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions of this step.

        Args:
            observation: (n, o).

        Returns:
            (n, a), full at +-1.
        """
        ...


class Zero:
    """Never acts: valves closed, or no rate."""

    def __init__(self, setup: TaskSetup) -> None:
        """Remember the number of actions."""
        self._actions = len(setup.axes)

    def begin(self, count: int) -> None:
        """Nothing to remember."""

    def reset(self, mask: np.ndarray) -> None:
        """Nothing to forget."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Zeros (n, a) for observations (n, o)."""
        return np.zeros((len(observation), self._actions), np.float32)


class Random:
    """Uniform actions, drawn anew in every step, as an agent that has learned nothing."""

    def __init__(self, setup: TaskSetup, seed: int = 0) -> None:
        """Remember the number of actions."""
        self._actions, self._seed = len(setup.axes), seed

    def begin(self, count: int) -> None:
        """Start the random numbers."""
        self._chance = np.random.default_rng(self._seed)

    def reset(self, mask: np.ndarray) -> None:
        """Random numbers go on."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Numbers (n, a) from -1 to 1 for observations (n, o)."""
        return self._chance.uniform(-1.0, 1.0, (len(observation), self._actions))


def step_time(setup: TaskSetup) -> float:
    """Time from one action to the next [s]."""
    return setup.clock.ticks * setup.clock.period


def columns(setup: TaskSetup, what: str, where: Iterable[str]) -> np.ndarray:
    """Columns of the observation with the fields `what.where`.

    Args:
        setup: the task as it was chosen.
        what: first part of the fields' names.
        where: second parts, in the order of the columns.

    Returns:
        (m,) integers, for `observation[:, columns]`.

    Raises:
        InputError: the observation lacks one of them.
    """
    places = {field.name: number for number, field in enumerate(setup.fields)}
    names = [f"{what}.{part}" if part else what for part in where]
    if missing := [name for name in names if name not in places]:
        raise InputError(f"observation {missing[0]!r}", f"the task has {', '.join(places)}")
    return np.array([places[name] for name in names], int)


def position_columns(setup: TaskSetup) -> np.ndarray:
    """Columns (k,) of the driven axes' measured positions."""
    return np.concatenate([
        columns(setup, setup.machine.position_kind(axis), [axis]) for axis in setup.axes
    ])  # fmt: skip

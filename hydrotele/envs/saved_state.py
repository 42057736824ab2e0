"""Complete state of running episodes, to return to it later: for planning, model predictive control and tests."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError


@dataclass(frozen=True)
class SavedState:
    """Complete state of n episodes, from `get_state` of an environment.

    It contains positions, velocities, spools, pressures, the solver's warm start, servo, references,
    delay lines, sensor histories, soil, random generators, goal, counters and the last results. It
    consists of arrays and can be pickled. `state[i]` and `state[[i, j]]` select episodes.

    Attributes:
        environment: task, machine and options of the environment, for the check in `set_state`.
        arrays: name -> (n, ...) values.
    """

    environment: str
    arrays: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.arrays["episodes"])

    def __getitem__(self, rows) -> "SavedState":
        """Return the state of one episode (an integer) or of several (indices, a mask or a slice)."""
        chosen = np.arange(len(self))[rows]
        return SavedState(self.environment, {n: a[np.atleast_1d(chosen)] for n, a in self.arrays.items()})

    def __repr__(self) -> str:
        """Return number of episodes and size."""
        return f"SavedState({len(self)} episodes, {sum(a.nbytes for a in self.arrays.values())} bytes)"


def save_state(environment: str, live: Mapping[str, np.ndarray], index) -> SavedState:
    """Copy the rows `index` (None: all) of the live arrays of an environment."""
    rows = slice(None) if index is None else np.atleast_1d(index)
    return SavedState(environment, {name: array[rows].copy() for name, array in live.items()})


def restore_state(environment: str, live: Mapping[str, np.ndarray], state: SavedState, index) -> None:
    """Write a saved state to the rows `index` (None: all) of the live arrays of an environment.

    A state of one episode is written to all these rows.

    Raises:
        InputError: the state belongs to another task, machine or set of options, or has another number
            of episodes.
    """
    if not isinstance(state, SavedState):
        raise InputError("set_state", f"needs the result of get_state, not {type(state).__name__}")
    if state.environment != environment:
        raise InputError("set_state", _describe_difference(state.environment, environment))
    rows = np.arange(len(live["episodes"])) if index is None else np.atleast_1d(index)
    if len(state) not in (1, len(rows)):
        raise InputError("set_state", f"the state has {len(state)} episodes, but {len(rows)} are to be set")
    for name, array in live.items():
        array[rows] = state.arrays[name]


def _describe_difference(given: str, own: str) -> str:
    parts = zip(given.split("\n"), own.split("\n"), strict=False)
    saved, here = next(((a, b) for a, b in parts if a != b), ("", ""))
    return f"the state belongs to another environment: {saved[:200]}; this one has {here[:200]}"

"""What a learning agent sees and does: errors beside readings, a little history, a law to correct.

A network hardly sees millimetres in the difference of two positions that vary by metres, so the
differences are given to it. What a machine is like shows only over time, so it sees the last steps.
"""

import numpy as np

from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.facts import TaskSetup

_ASKED = ("reference", "wanted")  # first words of fields that say what is asked for


def difference_columns(setup: TaskSetup) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of columns: what is asked for, and what is measured of the same.

    Args:
        setup: the task as it was chosen.

    Returns:
        (columns of the fields `reference...` and `wanted...`, columns of what is measured of them).
    """
    places = {field.name: number for number, field in enumerate(setup.fields)}
    asked, measured = [], []
    for number, field in enumerate(setup.fields):
        what, _, where = field.name.partition(".")
        start, _, rest = what.partition("_")
        if start not in _ASKED:
            continue
        twins = (rest,) if rest in ("rate", "force") else ("angle", "length", "tip")
        for twin in twins:
            name = f"{twin}.{where}" if where else twin
            if name in places:
                asked.append(number)
                measured.append(places[name])
    return np.array(asked, int), np.array(measured, int)


class AgentView:
    """Between an environment and an agent, for n episodes side by side.

    Attributes:
        size: numbers that the agent sees.
    """

    def __init__(
        self, setup: TaskSetup, history: int = 3, law: Controller | None = None, share: float = 1.0
    ) -> None:
        """Choose what the agent sees and does.

        Args:
            setup: the task as it was chosen.
            history: steps that it sees, this one too.
            law: a controller whose actions it corrects, none for an agent on its own.
            share: of a full action that its own is at most.
        """
        self._law, self._share, self._history = law, share, history
        self._asked, self._measured = difference_columns(setup)
        self._actions = len(setup.axes)
        self._width = len(setup.fields) + len(self._asked)
        self.size = history * self._width + (self._actions if law else 0)

    def begin(self, count: int) -> None:
        """Start `count` episodes."""
        self._past = np.zeros((count, self._history, self._width), np.float32)
        self._base = np.zeros((count, self._actions), np.float32)
        self._fresh = np.ones(count, bool)
        if self._law:
            self._law.begin(count)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes of mask (n,)."""
        self._fresh |= mask
        if self._law:
            self._law.reset(mask)

    def _now(self, observation: np.ndarray) -> np.ndarray:
        errors = observation[:, self._asked] - observation[:, self._measured]
        return np.concatenate([observation, errors], axis=1)

    def _shown(self, past: np.ndarray, base: np.ndarray) -> np.ndarray:
        flat = past.reshape(len(past), -1)
        return np.concatenate([flat, base], axis=1) if self._law else flat.copy()

    def see(self, observation: np.ndarray) -> np.ndarray:
        """What the agent sees, (n, size), at observations (n, o) of the step that comes."""
        now = self._now(observation)
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = now
        self._past[self._fresh] = now[self._fresh, None]
        self._fresh[:] = False
        if self._law:
            self._base[:] = np.clip(self._law(observation), -1.0, 1.0)
        return self._shown(self._past, self._base)

    def last(self, observation: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """What it would see, (m, size), at the last observations (n, o) of `chosen` (m,) episodes.

        The law is not asked again: its state goes on with the next episode.
        """
        now = self._now(observation[chosen])[:, None]
        past = np.concatenate([now, self._past[chosen, :-1]], axis=1)
        return self._shown(past, self._base[chosen])

    def act(self, action: np.ndarray) -> np.ndarray:
        """Actions (n, a) of the environment for the agent's (n, a)."""
        own = self._share * np.clip(action, -1.0, 1.0)
        return np.clip(self._base + own, -1.0, 1.0) if self._law else own

"""Keys of the viewer's window.

The viewer tells only that a key goes down, not that it comes up: so every press moves an axis on by
a part of its way, where it stays until the space bar centres everything.
"""

from collections import deque

from hydrotele.devices.reading import (
    CENTRE_KEY,
    KEYS,
    NUDGE,
    QUIT_KEY,
    SWITCH_KEYS,
    Reading,
    Switches,
)
from hydrotele.machine.joystick import AXES


class Keyboard:
    """The keyboard; `press` may be called by another thread."""

    def __init__(self, further: int) -> None:
        """Everything is centred.

        Args:
            further: number of axes that the joystick does not move.
        """
        self._pressed: deque[int] = deque()
        self._axes: dict[str, float] = dict.fromkeys(AXES, 0.0)
        self._switches = Switches(further)
        self._quit = False

    def press(self, code: int) -> None:
        """Take note of a key that goes down, by its GLFW code."""
        self._pressed.append(code)

    def read(self, time: float) -> Reading:
        """What the keys ask for now."""
        while self._pressed:
            self._take(self._pressed.popleft())
        return Reading(tuple(self._axes.values()), tuple(self._switches.commands), self._quit)

    def _take(self, code: int) -> None:
        if code in KEYS:
            _, axis, way = KEYS[code]
            self._axes[axis] = min(1.0, max(-1.0, self._axes[axis] + way * NUDGE))
        elif code in SWITCH_KEYS:
            _, number, way = SWITCH_KEYS[code]
            (self._switches.up if way > 0.0 else self._switches.down)(number)
        elif code == CENTRE_KEY:
            self._axes = dict.fromkeys(AXES, 0.0)
            self._switches.off()
        elif code == QUIT_KEY:
            self._quit = True

    def close(self) -> None:
        """Nothing is to be let go of."""

"""What a device says, whichever it is: six axes, commands of further axes, and when to end."""

from typing import NamedTuple, Protocol

_FINE = 2  # decimals of an axis: finer than a hand, and short to write down


class Reading(NamedTuple):
    """What a device asks for now.

    Attributes:
        axes: x, y, z, rx, ry, rz of the handle, -1 .. 1 of its way.
        commands: of the axes that the joystick does not move, -1 .. 1, in the machine's order.
        quit: whether the drive is over.
        said: what its user should know: unplugged, back again.
    """

    axes: tuple[float, ...] = (0.0,) * 6
    commands: tuple[float, ...] = ()
    quit: bool = False
    said: str = ""


class Device(Protocol):
    """A device that is open."""

    def read(self, time: float) -> Reading:
        """What it asks for now, `time` [s] after the start of the run."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


def outside(value: float, dead: float) -> float:
    """An axis without its dead zone, whole at the end of its way.

    Args:
        value: as the device says, -1 .. 1.
        dead: dead zone.

    Returns:
        0 inside the dead zone; -1 .. 1, in hundredths.

    >>> outside(0.1, 0.12), outside(-1.2, 0.12), outside(0.56, 0.12)
    (0.0, -1.0, 0.5)
    """
    beyond = min(1.0, abs(value)) - dead
    if not beyond > 0.0:
        return 0.0
    size = round(beyond / (1.0 - dead), _FINE)
    return size if value > 0.0 else -size


class Switches:
    """Commands of further axes, that buttons switch between -1, 0 and 1.

    Attributes:
        commands: of every axis.
    """

    def __init__(self, count: int) -> None:
        """All off.

        Args:
            count: number of axes.
        """
        self.commands = [0.0] * count

    def up(self, number: int) -> None:
        """One step up: from -1 to 0, or from 0 to 1."""
        self._set(number, lambda now: min(1.0, now + 1.0))

    def down(self, number: int) -> None:
        """One step down."""
        self._set(number, lambda now: max(-1.0, now - 1.0))

    def turn(self, number: int) -> None:
        """The next of 0, 1, 0, -1: where one button has to do."""
        if number < len(self.commands):
            now = self.commands[number]
            self._next = -self._next if now else self._next
            self.commands[number] = 0.0 if now else self._next

    def off(self) -> None:
        """All off."""
        self.commands = [0.0] * len(self.commands)

    _next = 1.0

    def _set(self, number: int, step) -> None:
        if number < len(self.commands):
            self.commands[number] = step(self.commands[number])

"""What a device says, whichever it is: six axes, commands of further axes, and when to end.

Which axis, key or button of a device does what: the one place for it.

The handle's axes are x out, y left, z up, rx (head), ry (tool, positive curls in), rz.
"""

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


NUDGE = 0.25  # of the handle's way, for one press of a key

# GLFW codes of keys that MuJoCo's viewer leaves alone -> (name, axis of the handle, way)
KEYS = {
    265: ("Up", "x", 1.0),
    264: ("Down", "x", -1.0),
    263: ("Left", "y", 1.0),
    262: ("Right", "y", -1.0),
    266: ("Page Up", "z", 1.0),
    267: ("Page Down", "z", -1.0),
    269: ("End", "ry", 1.0),
    268: ("Home", "ry", -1.0),
    260: ("Insert", "rx", 1.0),
    261: ("Delete", "rx", -1.0),
}
# GLFW code -> (name, number of the further axis, way)
SWITCH_KEYS = {
    54: ("6", 0, -1.0),
    55: ("7", 0, 1.0),
    56: ("8", 1, -1.0),
    57: ("9", 1, 1.0),
}
CENTRE_KEY, QUIT_KEY = 32, 299  # space, F10


class Layout(NamedTuple):
    """How a device that SDL sees as a joystick is used.

    Attributes:
        axes: (axis of the handle, number of the device's axis, way).
        pairs: (axis of the handle, button that pulls it up, button that pulls it down).
        dead: dead zone of every axis.
        hat: whether its hat switches: up and down the first further axis, right and left the
            second.
        turns: buttons that switch a further axis, by its number, on, off and back.
        stop: button that switches all off; -1 without.
        quit: button that ends; -1 without.
    """

    axes: tuple[tuple[str, int, float], ...]
    pairs: tuple[tuple[str, int, int], ...]
    dead: float
    hat: bool
    turns: tuple[int, ...]
    stop: int
    quit: int


LAYOUTS = {
    # sticks as Linux numbers them for Xbox and PlayStation pads; 4, 5: shoulders, 1: B, 7: Start
    "gamepad": Layout(
        axes=(("x", 1, -1.0), ("y", 0, -1.0), ("z", 4, -1.0), ("ry", 3, -1.0)),
        pairs=(("rx", 4, 5),),
        dead=0.12,
        hat=True,
        turns=(),
        stop=1,
        quit=7,
    ),
    # right, towards the user, down, pitch, roll, yaw
    "spacemouse": Layout(
        axes=(
            ("x", 1, -1.0),
            ("y", 0, -1.0),
            ("z", 2, -1.0),
            ("rx", 4, 1.0),
            ("ry", 3, -1.0),
            ("rz", 5, -1.0),
        ),
        pairs=(),
        dead=0.1,
        hat=False,
        turns=(0, 1),
        stop=-1,
        quit=-1,
    ),
}
SPACEMOUSE_NAMES = ("space", "3dconnexion")

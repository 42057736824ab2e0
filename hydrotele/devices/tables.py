"""Which axis, key or button of a device does what: the one place for it.

The handle's axes are x out, y left, z up, rx (head), ry (tool, positive curls in), rz.
"""

from typing import NamedTuple

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

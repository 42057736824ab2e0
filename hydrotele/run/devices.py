"""Input devices for interactive driving: keyboard, gamepad, SpaceMouse, or a script file.

A device replaces the joystick of the machine's operator. It returns six axes of the joystick's handle:
x outwards, y to the left, z up, and the rotations rx (the head), ry (the tool; positive curls it in)
and rz. It also returns commands of machine axes that the joystick does not move ("additional
axes"), and whether to stop. The viewer window reports only key presses, not releases. Each press
therefore moves an axis by a fraction of its range, and the space bar centres all axes. Gamepad and
SpaceMouse are read with pygame (the extra `drive`) through SDL, which treats both as joysticks.

A script file is CSV or YAML. CSV has a header (`time`, any of x, y, z, rx, ry, rz, and additional
axes of the machine) and one row per time [s], valid from that time on. YAML has `time`, `axes`,
`commands`, and `interpolate: linear` to interpolate the handle between rows. Handle values are
-1 .. 1 of its range; the others are commands. The drive stops at the last time.
"""

import bisect
import csv
import os
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    StrictModel,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.machine.joystick import AXES
from hydrotele.scenario.teleoperation import JoystickAxis

AXIS_DECIMALS = 2  # decimals of an axis value: finer than an operator can set, and short in a file


class Reading(NamedTuple):
    """Current input of a device.

    Attributes:
        axes: x, y, z, rx, ry, rz of the handle, -1 .. 1 of its travel.
        commands: commands of the machine axes that the joystick does not move, -1 .. 1, in the order
            of the machine.
        quit: whether to stop the drive.
        user_message: message for the user, for example that the device was unplugged; empty without one.
    """

    axes: tuple[float, ...] = (0.0,) * 6
    commands: tuple[float, ...] = ()
    quit: bool = False
    user_message: str = ""


class Device(Protocol):
    """An open input device; the interface of all devices in this module."""

    def read(self, time: float) -> Reading:
        """Return the current input of the user at a time of the run [s]."""
        ...

    def close(self) -> None:
        """Release the device."""
        ...


def remove_dead_zone(value: float, dead_zone: float) -> float:
    """Remove the dead zone around the centre from an axis value; full deflection still gives 1 or -1.

    Args:
        value: raw axis value of the device, -1 .. 1.
        dead_zone: half width of the dead zone, in the same scale.

    Returns:
        0 inside the dead zone, otherwise -1 .. 1, rounded to hundredths.

    >>> remove_dead_zone(0.1, 0.12), remove_dead_zone(-1.2, 0.12), remove_dead_zone(0.56, 0.12)
    (0.0, -1.0, 0.5)
    """
    beyond = min(1.0, abs(value)) - dead_zone
    if not beyond > 0.0:
        return 0.0
    size = round(beyond / (1.0 - dead_zone), AXIS_DECIMALS)
    return size if value > 0.0 else -size


class SwitchedCommands:
    """Commands of additional axes that buttons switch between -1, 0 and 1.

    Attributes:
        commands: one command per axis.
    """

    def __init__(self, count: int) -> None:
        """Set all commands to 0.

        Args:
            count: number of axes.
        """
        self.commands = [0.0] * count
        self._next_directions = [1.0] * count

    def raise_command(self, number: int) -> None:
        """Increase the command of the axis with this index by one step: -1 to 0, or 0 to 1."""
        self._change_command(number, lambda now: min(1.0, now + 1.0))

    def lower_command(self, number: int) -> None:
        """Decrease the command of the axis with this index by one step: 1 to 0, or 0 to -1."""
        self._change_command(number, lambda now: max(-1.0, now - 1.0))

    def cycle_command(self, number: int) -> None:
        """Advance the command of the axis with this index in the cycle 0, 1, 0, -1.

        One button then suffices for the axis.
        """
        if number < len(self.commands):
            now = self.commands[number]
            if now:
                self._next_directions[number] = -now
            self.commands[number] = 0.0 if now else self._next_directions[number]

    def zero_all_commands(self) -> None:
        """Set all commands to 0."""
        self.commands = [0.0] * len(self.commands)

    def _change_command(self, number: int, step) -> None:
        if number < len(self.commands):
            self.commands[number] = step(self.commands[number])


KEY_STEP = 0.25  # fraction of the handle's travel per key press

# GLFW codes of keys that the MuJoCo viewer does not use -> (name, handle axis, direction)
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
# GLFW code -> (name, number of the additional axis, direction)
SWITCH_KEYS = {
    54: ("6", 0, -1.0),
    55: ("7", 0, 1.0),
    56: ("8", 1, -1.0),
    57: ("9", 1, 1.0),
}
CENTRE_KEY, QUIT_KEY = 32, 299  # space, F10


class Layout(NamedTuple):
    """Assignment of the axes and buttons of an SDL joystick device.

    Attributes:
        axes: (handle axis, device axis number, direction 1 or -1).
        button_pairs: (handle axis, button for +1, button for -1).
        dead_zone: dead zone of every axis, 0 .. 1.
        uses_hat: whether the hat switches the additional axes: up and down the first, right and left
            the second.
        cycle_buttons: button per additional axis that cycles its command through 0, 1, 0, -1.
        stop_button: button that sets all additional commands to 0; -1 for none.
        quit_button: button that stops the drive; -1 for none.
    """

    axes: tuple[tuple[str, int, float], ...]
    button_pairs: tuple[tuple[str, int, int], ...]
    dead_zone: float
    uses_hat: bool
    cycle_buttons: tuple[int, ...]
    stop_button: int
    quit_button: int


LAYOUTS = {
    # sticks as Linux numbers them for Xbox and PlayStation pads; 4, 5: shoulders, 1: B, 7: Start
    "gamepad": Layout(
        axes=(("x", 1, -1.0), ("y", 0, -1.0), ("z", 4, -1.0), ("ry", 3, -1.0)),
        button_pairs=(("rx", 4, 5),),
        dead_zone=0.12,
        uses_hat=True,
        cycle_buttons=(),
        stop_button=1,
        quit_button=7,
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
        button_pairs=(),
        dead_zone=0.1,
        uses_hat=False,
        cycle_buttons=(0, 1),
        stop_button=-1,
        quit_button=-1,
    ),
}
SPACEMOUSE_NAMES = ("space", "3dconnexion")


class Keyboard:
    """Keyboard as an input device; another thread, such as the viewer's, may report key presses."""

    def __init__(self, n_additional_axes: int) -> None:
        """Start with all axes centred.

        Args:
            n_additional_axes: number of axes that the joystick does not move.
        """
        self._pending_keys: deque[int] = deque()
        self._axes: dict[str, float] = dict.fromkeys(AXES, 0.0)
        self._switches = SwitchedCommands(n_additional_axes)
        self._quit = False

    def press(self, code: int) -> None:
        """Store a key press, given by its GLFW key code, until the next `read`."""
        self._pending_keys.append(code)

    def read(self, time: float) -> Reading:
        """Process the key presses since the last call and return the current input; `time` is not used."""
        while self._pending_keys:
            self._apply_key(self._pending_keys.popleft())
        return Reading(tuple(self._axes.values()), tuple(self._switches.commands), self._quit)

    def _apply_key(self, code: int) -> None:
        if code in KEYS:
            _, axis, way = KEYS[code]
            self._axes[axis] = min(1.0, max(-1.0, self._axes[axis] + way * KEY_STEP))
        elif code in SWITCH_KEYS:
            _, number, way = SWITCH_KEYS[code]
            (self._switches.raise_command if way > 0.0 else self._switches.lower_command)(number)
        elif code == CENTRE_KEY:
            self._axes = dict.fromkeys(AXES, 0.0)
            self._switches.zero_all_commands()
        elif code == QUIT_KEY:
            self._quit = True

    def close(self) -> None:
        """Do nothing; a keyboard holds no resources."""


class JoystickDevice:
    """A gamepad or SpaceMouse, which may be unplugged and reconnected during a run."""

    def __init__(self, kind: str, sticks: Any, further: int) -> None:
        """Use the first connected device of a kind.

        Args:
            kind: key of `LAYOUTS`.
            sticks: the connected devices: an `SdlJoysticks`, or an object with the same methods.
            further: number of axes that the joystick does not move.

        Raises:
            InputError: no device of this kind is connected.
        """
        self._kind, self._sticks, self._layout = kind, sticks, LAYOUTS[kind]
        self._stick = sticks.find(kind)
        if self._stick is None:
            sticks.close()
            message = "is not connected: connect it, or choose --device keyboard"
            raise InputError(f"--device {kind}", message)
        self._switches, self._pressed_buttons = SwitchedCommands(further), set()

    def read(self, time: float) -> Reading:
        """Return the current input, with a message if the device was unplugged or connected again.

        While it is unplugged, the handle is centred. `time` is not used.
        """
        said = ""
        if self._sticks.poll_connections():
            before, self._stick = self._stick, self._sticks.find(self._kind)
            if self._stick is None and before is not None:
                said = f"the {self._kind} is unplugged: the handle returns to its centre"
                self._switches.zero_all_commands()
                self._pressed_buttons = set()
            elif before is None and self._stick is not None:
                said = f"the {self._kind} is connected again"
        if self._stick is None:
            return Reading(commands=tuple(self._switches.commands), user_message=said)
        axes = _read_handle_axes(self._stick, self._layout)
        over = self._apply_buttons(_read_pressed_buttons(self._stick, self._layout))
        return Reading(axes, tuple(self._switches.commands), over, said)

    def _apply_buttons(self, held: set[str]) -> bool:
        """Change the switched commands by newly pressed buttons.

        The stop button, or all cycle buttons together, set the commands to 0.

        Args:
            held: buttons that are pressed now, and directions of the hat.

        Returns:
            Whether the quit button is newly pressed.
        """
        fresh, self._pressed_buttons = held - self._pressed_buttons, held
        switches, layout = self._switches, self._layout
        for way, act, number in (
            ("up", switches.raise_command, 0),
            ("down", switches.lower_command, 0),
            ("right", switches.raise_command, 1),
            ("left", switches.lower_command, 1),
        ):
            if way in fresh:
                act(number)
        for number, button in enumerate(layout.cycle_buttons):
            if str(button) in fresh:
                switches.cycle_command(number)
        together = len(layout.cycle_buttons) > 1 and {str(b) for b in layout.cycle_buttons} <= held
        if str(layout.stop_button) in fresh or together:
            switches.zero_all_commands()
        return str(layout.quit_button) in fresh

    def close(self) -> None:
        """Shut SDL down."""
        self._sticks.close()


def _read_handle_axes(stick: Any, layout: Layout) -> tuple[float, ...]:
    values: dict[str, float] = dict.fromkeys(AXES, 0.0)
    for name, number, way in layout.axes:
        if number < stick.get_numaxes():
            values[name] = way * remove_dead_zone(stick.get_axis(number), layout.dead_zone) + 0.0
    for name, up, down in layout.button_pairs:
        if max(up, down) < stick.get_numbuttons():
            values[name] = float(bool(stick.get_button(up)) - bool(stick.get_button(down)))
    return tuple(values.values())


def _read_pressed_buttons(stick: Any, layout: Layout) -> set[str]:
    """Return the numbers of the pressed buttons as text, and the directions of the hat (small cross)."""
    held = {str(b) for b in range(stick.get_numbuttons()) if stick.get_button(b)}
    if layout.uses_hat and stick.get_numhats():
        x, y = stick.get_hat(0)
        held |= {{1: "right", -1: "left"}[x]} if x else set()
        held |= {{1: "up", -1: "down"}[y]} if y else set()
    return held


class SdlJoysticks:
    """Joystick devices that SDL detects, accessed through pygame."""

    def __init__(self, kind: str) -> None:
        """Initialise SDL.

        Args:
            kind: name of the requested device, for the error message.

        Raises:
            InputError: pygame is not installed.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events without a window
        try:
            import pygame  # pyright: ignore[reportMissingImports] - an extra
        except ImportError:
            message = "needs pygame: pip install 'hydrotele[drive]' or pip install pygame"
            raise InputError(f"--device {kind}", message) from None
        self._pygame = pygame
        pygame.display.init()  # SDL delivers events only with an initialised display
        pygame.joystick.init()

    def poll_connections(self) -> bool:
        """Update the device states; return whether a device was plugged in or removed since the last call."""
        kinds = (self._pygame.JOYDEVICEADDED, self._pygame.JOYDEVICEREMOVED)
        return any(event.type in kinds for event in self._pygame.event.get())

    def find(self, kind: str) -> Any:
        """Return the first connected device of a kind as a pygame joystick, or None.

        For the kind `spacemouse` the name of the device must contain `space` or `3dconnexion`; any
        other device counts as a `gamepad`.
        """
        for number in range(self._pygame.joystick.get_count()):
            stick = self._pygame.joystick.Joystick(number)
            named = any(part in stick.get_name().lower() for part in SPACEMOUSE_NAMES)
            if named == (kind == "spacemouse"):
                return stick
        return None

    def close(self) -> None:
        """Shut SDL down."""
        self._pygame.quit()


_UnitRangeFloat = Annotated[float, Field(ge=-1, le=1)]


class Script(StrictModel):
    """Input over time: values of the handle `axes` and `commands` of additional axes.

    `time` [s] holds the times of the rows. All values are -1 .. 1. `interpolate` says whether the
    handle values are held or interpolated linearly between rows; commands are always held.
    """

    time: list[NonNegativeFloat]
    axes: dict[JoystickAxis, list[_UnitRangeFloat]] = {}
    commands: dict[Name, list[_UnitRangeFloat]] = {}
    interpolate: Literal["hold", "linear"] = "hold"

    @model_validator(mode="after")
    def _check(self):
        rising = all(a < b for a, b in zip(self.time, self.time[1:], strict=False))
        if not self.time or self.time[0] != 0.0 or not rising:
            raise ValueError("time must start at 0 and increase")
        for name, values in [*self.axes.items(), *self.commands.items()]:
            if len(values) != len(self.time):
                raise ValueError(f"{name} has {len(values)} values, time has {len(self.time)}")
        return self


class ScriptedDevice:
    """An input device that plays the input of a script file."""

    def __init__(self, script: Script, further: tuple[str, ...], where: str) -> None:
        """Check the axes of the script.

        Args:
            script: the input over time.
            further: axes that the joystick does not move.
            where: file of the script, for error messages.

        Raises:
            InputError: the script commands an axis that is not in `further`.
        """
        for name in script.commands:
            if name not in further:
                message = f"{name!r} is not one of the axes without a joystick axis"
                raise InputError(where, f"{message}; {suggest_valid_name(name, further)}")
        self._script, self._further = script, further

    def read(self, time: float) -> Reading:
        """Return the input of the script at a time of the run [s]; it stops the drive at the last time."""
        script = self._script
        row = max(0, bisect.bisect_right(script.time, time + 1e-9) - 1)
        commands = [script.commands[n][row] if n in script.commands else 0.0 for n in self._further]
        axes = [self._axis_value(script.axes.get(name), row, time) for name in AXES]
        return Reading(tuple(axes), tuple(commands), time + 1e-9 >= script.time[-1])

    def _axis_value(self, values: list[float] | None, row: int, time: float) -> float:
        if values is None:
            return 0.0
        if self._script.interpolate == "linear":
            return float(np.interp(time, self._script.time, values))
        return values[row]

    def close(self) -> None:
        """Do nothing; a script holds no resources."""


def load_script(path: str | Path) -> Script:
    """Read a script file: the input of a device over time.

    Args:
        path: a CSV or YAML file.

    Returns:
        The script.

    Raises:
        InputError: the file is invalid; the message names file, line and column.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file; give a .csv or .yaml file after scripted:")
    if path.suffix.lower() in (".yaml", ".yml"):
        data, lines = read_yaml(path)
        return validate_data(Script, data, str(path), lines)
    if path.suffix.lower() == ".csv":
        return _read_csv_script(path)
    raise InputError(path, "must be a .csv or a .yaml file")


def _read_csv_script(path: Path) -> Script:
    try:
        rows = list(csv.reader(read_text(path).splitlines()))
    except csv.Error as error:
        raise InputError(path, f"cannot be read: {error}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    if "time" not in names:
        raise InputError(f"{path}, line 1", f"has no column 'time'; valid: time, {', '.join(AXES)}")
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{path}, line 1", f"repeats the columns {', '.join(sorted(twice))}")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(names):
            raise InputError(f"{path}, line {line}", f"has {len(row)} cells, not {len(names)}")
        for name, cell in zip(names, row, strict=True):
            columns[name].append(_parse_cell(cell, f"{path}, line {line}, column {name!r}", name))
        _check_time_increases(columns["time"], f"{path}, line {line}, column 'time'")
    data = {
        "time": columns.pop("time"),
        "axes": {name: v for name, v in columns.items() if name in AXES},
        "commands": {name: v for name, v in columns.items() if name not in AXES},
    }
    return validate_data(Script, data, str(path), {})


def _parse_cell(cell: str, where: str, name: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise InputError(where, f"{cell.strip()!r} is not a number") from None
    if name != "time" and not -1.0 <= value <= 1.0:
        raise InputError(where, f"{value:g} is not between -1 and 1")
    return value


def _check_time_increases(time: list[float], where: str) -> None:
    if len(time) == 1 and time[0] != 0.0:
        raise InputError(where, f"time must start at 0, not at {time[0]:g}")
    if len(time) > 1 and not time[-1] > time[-2]:
        raise InputError(where, f"time must increase: {time[-1]:g} follows {time[-2]:g}")


SCRIPT_PREFIX = "scripted:"
# Values of --device, for error messages. `hydrotele drive` opens a haptic device itself.
DEVICE_NAMES = ("keyboard", *LAYOUTS, f"{SCRIPT_PREFIX}FILE", "haptic:HOST:PORT")


def open_device(name: str, additional_axes: tuple[str, ...]) -> Device:
    """Open an input device by name.

    Args:
        name: `keyboard`, `gamepad`, `spacemouse` or `scripted:FILE`.
        additional_axes: axes that the joystick does not move, in the order of the machine.

    Returns:
        The device.

    Raises:
        InputError: the name is unknown, the device is not connected, or a package is missing.
    """
    if name == "keyboard":
        return Keyboard(len(additional_axes))
    if name in LAYOUTS:
        return JoystickDevice(name, SdlJoysticks(name), len(additional_axes))
    if name.startswith(SCRIPT_PREFIX):
        path = name.removeprefix(SCRIPT_PREFIX)
        return ScriptedDevice(load_script(path), additional_axes, path)
    raise InputError(f"--device {name}", f"is not a known device; {suggest_valid_name(name, DEVICE_NAMES)}")

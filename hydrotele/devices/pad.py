"""Gamepad and SpaceMouse through SDL, which sees both as joysticks (pygame, the extra `drive`)."""

import os
from typing import Any

from hydrotele.core.errors import InputError
from hydrotele.devices.reading import LAYOUTS, SPACEMOUSE_NAMES, Layout, Reading, Switches, outside
from hydrotele.machine.joystick import AXES


class Pad:
    """A device that is plugged in, and may be unplugged and plugged in again."""

    def __init__(self, kind: str, sticks: Any, further: int) -> None:
        """Take the first device of its kind.

        Args:
            kind: key of `LAYOUTS`.
            sticks: has `find(kind)`, a stick of pygame's or None, `changed()`, whether one was
                plugged in or out since the last call, and `close()`.
            further: number of axes that the joystick does not move.

        Raises:
            InputError: there is none.
        """
        self._kind, self._sticks, self._layout = kind, sticks, LAYOUTS[kind]
        self._stick = sticks.find(kind)
        if self._stick is None:
            sticks.close()
            message = "is not connected: plug it in, or choose --device keyboard"
            raise InputError(f"--device {kind}", message)
        self._switches, self._held = Switches(further), set()

    def read(self, time: float) -> Reading:
        """What it asks for now; nothing while it is unplugged."""
        said = ""
        if self._sticks.changed():
            before, self._stick = self._stick, self._sticks.find(self._kind)
            if self._stick is None and before is not None:
                said = f"the {self._kind} is unplugged: the handle goes to its centre"
                self._switches.off()
                self._held = set()
            elif before is None and self._stick is not None:
                said = f"the {self._kind} is back"
        if self._stick is None:
            return Reading(commands=tuple(self._switches.commands), said=said)
        axes = _axes(self._stick, self._layout)
        over = self._press(_held(self._stick, self._layout))
        return Reading(axes, tuple(self._switches.commands), over, said)

    def _press(self, held: set[str]) -> bool:
        """Switch what has just been pressed; whether it was the button that ends."""
        fresh, self._held = held - self._held, held
        switches, layout = self._switches, self._layout
        for way, act, number in (
            ("up", switches.up, 0),
            ("down", switches.down, 0),
            ("right", switches.up, 1),
            ("left", switches.down, 1),
        ):
            if way in fresh:
                act(number)
        for number, button in enumerate(layout.turns):
            if str(button) in fresh:
                switches.turn(number)
        together = len(layout.turns) > 1 and {str(b) for b in layout.turns} <= held
        if str(layout.stop) in fresh or together:
            switches.off()
        return str(layout.quit) in fresh

    def close(self) -> None:
        """Let go of SDL."""
        self._sticks.close()


def _axes(stick: Any, layout: Layout) -> tuple[float, ...]:
    values: dict[str, float] = dict.fromkeys(AXES, 0.0)
    for name, number, way in layout.axes:
        if number < stick.get_numaxes():
            values[name] = way * outside(stick.get_axis(number), layout.dead) + 0.0
    for name, up, down in layout.pairs:
        if max(up, down) < stick.get_numbuttons():
            values[name] = float(bool(stick.get_button(up)) - bool(stick.get_button(down)))
    return tuple(values.values())


def _held(stick: Any, layout: Layout) -> set[str]:
    """Numbers of the buttons that are down, and ways of the hat."""
    held = {str(b) for b in range(stick.get_numbuttons()) if stick.get_button(b)}
    if layout.hat and stick.get_numhats():
        x, y = stick.get_hat(0)
        held |= {{1: "right", -1: "left"}[x]} if x else set()
        held |= {{1: "up", -1: "down"}[y]} if y else set()
    return held


class Sticks:
    """All that SDL sees, through pygame."""

    def __init__(self, kind: str) -> None:
        """Start SDL.

        Args:
            kind: for the message.

        Raises:
            InputError: pygame is not installed.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # its window is not wanted
        try:
            import pygame  # pyright: ignore[reportMissingImports] - an extra
        except ImportError:
            message = "needs pygame: pip install 'hydrotele[drive]' or pip install pygame"
            raise InputError(f"--device {kind}", message) from None
        self._pygame = pygame
        pygame.display.init()  # SDL's events come with it
        pygame.joystick.init()

    def changed(self) -> bool:
        """Whether something was plugged in or out; fetches the sticks' state, too."""
        kinds = (self._pygame.JOYDEVICEADDED, self._pygame.JOYDEVICEREMOVED)
        return any(event.type in kinds for event in self._pygame.event.get())

    def find(self, kind: str) -> Any:
        """The first stick of a kind, None without."""
        for number in range(self._pygame.joystick.get_count()):
            stick = self._pygame.joystick.Joystick(number)
            named = any(part in stick.get_name().lower() for part in SPACEMOUSE_NAMES)
            if named == (kind == "spacemouse"):
                return stick
        return None

    def close(self) -> None:
        """Stop SDL."""
        self._pygame.quit()

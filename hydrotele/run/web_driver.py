"""Input device of `hydrotele drive --web`: the web page of the user who drives.

Any number of pages may be open, and one of them drives: the page that pressed Start first. It sends
its input many times per second. If it stops sending for `INPUT_TIMEOUT`, all commands go to zero. If
it closes, or sends nothing for `DRIVER_TIMEOUT`, another page can take over with Start.

The page and the simulation use this module from different threads.
"""

import threading
import time as clock
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from hydrotele.core.datafile import StrictModel
from hydrotele.run.devices import AXIS_DECIMALS, Reading, SwitchedCommands

INPUT_TIMEOUT = 0.5  # s without a message of the driver's page after which all commands are zero
DRIVER_TIMEOUT = 5.0  # s without a message of the driver's page after which another page can drive

_UnitRangeFloat = Annotated[float, Field(ge=-1, le=1)]
_HandleAxes = Annotated[list[_UnitRangeFloat], Field(min_length=6, max_length=6)]


class InputMessage(StrictModel):
    """Position of the handle: x, y, z, rx, ry, rz, -1 .. 1 of its travel.

    `sent` is a number of the page; the newest one is returned to the page, which so measures the
    delay.
    """

    kind: Literal["input"]
    axes: _HandleAxes
    sent: float = 0.0


class SwitchMessage(StrictModel):
    """Request to raise or lower the command of the additional axis with this index by one step."""

    kind: Literal["switch"]
    axis: Annotated[int, Field(ge=0)]
    direction: Literal[-1, 1]


class ActionMessage(StrictModel):
    """Request to start, stop, reset or finish the drive, or to set all commands to zero."""

    kind: Literal["start", "stop", "reset", "finish", "zero"]


_MESSAGE: TypeAdapter[InputMessage | SwitchMessage | ActionMessage] = TypeAdapter(
    Annotated[InputMessage | SwitchMessage | ActionMessage, Field(discriminator="kind")]
)


class WebDriver:
    """Input of the page that drives, and its requests to start, stop, reset and finish.

    Attributes:
        is_running: whether the simulation runs.
        is_reset_requested: whether the machine must return to its initial state.
        is_finished: whether the drive must end.
    """

    def __init__(self, n_additional_axes: int, now: Callable[[], float] = clock.monotonic) -> None:
        """Start without a driver, with a stopped simulation.

        Args:
            n_additional_axes: number of axes that the joystick does not move.
            now: function that returns the wall-clock time [s].
        """
        self.is_running = self.is_reset_requested = self.is_finished = False
        self._now, self._lock = now, threading.Lock()
        self._driver: int | None = None
        self._last_input, self._last_sent = 0.0, 0.0
        self._axes, self._switches = (0.0,) * 6, SwitchedCommands(n_additional_axes)
        self._is_silent = True

    def process_message(self, page: int, text: str | bytes) -> str:
        """Process a message of a page.

        Args:
            page: number of the page.
            text: the message as JSON.

        Returns:
            The reason why the message has no effect; empty if it has.

        Raises:
            ValueError: the message is malformed.
        """
        message = _MESSAGE.validate_json(text)
        with self._lock:
            driver = self._present_driver()
            if message.kind == "start" and driver in (None, page):
                self._driver, self.is_running, self._last_input = page, True, self._now()
                return ""
            if driver != page:
                return "press Start to drive" if driver is None else "another page drives"
            self._last_input = self._now()
            if isinstance(message, InputMessage):
                self._axes = tuple(round(value, AXIS_DECIMALS) + 0.0 for value in message.axes)
                self._last_sent = message.sent
            elif isinstance(message, SwitchMessage):
                switches = self._switches
                (switches.raise_command if message.direction > 0 else switches.lower_command)(message.axis)
            else:
                self._zero_commands()
                self.is_running = self.is_running and message.kind not in ("stop", "reset")
                self.is_reset_requested |= message.kind == "reset"
                self.is_finished |= message.kind == "finish"
        return ""

    def remove_page(self, page: int) -> None:
        """Remove a closed page; if it was driving, all commands go to zero."""
        with self._lock:
            if page == self._driver:
                self._driver = None
                self._zero_commands()

    def describe_page(self, page: int) -> dict[str, str | float | bool]:
        """Return what a page must know about the drive.

        Returns:
            `role` (`driver`, `watcher` of another page, or `free` if nobody drives), `running`,
            `finished`, and the number `sent` of the driver's newest input.
        """
        with self._lock:
            driver = self._present_driver()
            role = "free" if driver is None else "driver" if driver == page else "watcher"
            return {
                "role": role, "running": self.is_running, "finished": self.is_finished,
                "sent": self._last_sent if role == "driver" else 0.0,
            }  # fmt: skip

    def read(self, time: float) -> Reading:
        """Return the input of the driver's page; zero without a driver or a recent message. `time` is not used."""
        with self._lock:
            is_silent = self._driver is None or self._now() - self._last_input > INPUT_TIMEOUT
            news = ""
            if is_silent:
                self._zero_commands()
                if not self._is_silent:
                    news = f"the driver's page sends nothing for {INPUT_TIMEOUT:g} s: all commands are zero"
                    news = news if self._driver is not None else "no page drives: all commands are zero"
            self._is_silent = is_silent
            return Reading(self._axes, tuple(self._switches.commands), self.is_finished, news)

    def close(self) -> None:
        """Do nothing; the page is closed by its server."""

    def _present_driver(self) -> int | None:
        """Return the page that drives; None if there is none or its page has sent nothing for `DRIVER_TIMEOUT`."""
        if self._now() - self._last_input > DRIVER_TIMEOUT:
            self._driver = None
        return self._driver

    def _zero_commands(self) -> None:
        self._axes = (0.0,) * 6
        self._switches.zero_all_commands()

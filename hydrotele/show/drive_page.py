"""Web page of `hydrotele drive --web`: machine, joysticks, forces and pressures in a browser.

The page `drive_page.html` reads keyboard, gamepad and on-screen joysticks, because viser passes on
neither key releases nor gamepads. It embeds viser's page, which draws the machine and the pressures.
"""

import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydrotele.run.interactive_run import Pacer, Status
from hydrotele.run.session import Session
from hydrotele.run.web_driver import INPUT_TIMEOUT, WebDriver
from hydrotele.show.web_scene import WebScene
from hydrotele.show.web_server import PageHandlers, WebServer
from hydrotele.simulate.mechanism import compile_mechanism

_PAGE_RATE = 60.0  # Hz, rate of the displayed poses and forces
_MESSAGE_TIME = 5.0  # s
_WAIT = 0.02  # s between two checks whether a stopped drive continues
_FAREWELL_TIME = 0.3  # s before the server stops, so that every page receives the last status


class ResetRequested(Exception):
    """The driver wants the machine in its initial state; the run so far is discarded."""


class DrivePage:
    """Web page that displays a drive and controls it."""

    def __init__(self, host: str, port: int, driver: WebDriver, scenario: str, target: Path) -> None:
        """Start the web server.

        Args:
            host: address of the network interface; 127.0.0.1 accepts only this computer.
            port: port, 0 for any free one.
            driver: input device that the page controls.
            scenario: name of the scenario.
            target: output folder, for the page.

        Raises:
            InputError: the address cannot be used, or viser is not installed.
        """
        self._driver, self._scene, self._due = driver, None, 0.0
        self._description = {"scenario": scenario, "target": str(target), "timeout": INPUT_TIMEOUT}
        self._status: dict[str, Any] = {"scene": False}
        self._message, self._message_end = "", 0.0
        page = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
        handlers = PageHandlers(driver.process_message, self._page_status, driver.remove_page)
        self._server = WebServer(host, port, page, handlers)
        self.url = self._server.url

    def update(
        self, session: Session, status: Callable[[], Status], pacer: Pacer, is_interrupted: Callable[[], bool]
    ) -> None:
        """Display the state of a drive after a control tick; wait as long as the driver has stopped it.

        Args:
            session: the running simulation.
            status: function that returns the values to display.
            pacer: timer of the drive, which restarts after a stop.
            is_interrupted: function that returns whether the drive must end.

        Raises:
            ResetRequested: the driver wants the machine in its initial state.
        """
        driver, now = self._driver, clock.monotonic()
        if now >= self._due or not driver.is_running:
            self._due = now + 1.0 / _PAGE_RATE
            self._display(session, status())
        if driver.is_running and not driver.is_reset_requested:
            return
        while not (driver.is_running or driver.is_reset_requested or driver.is_finished or is_interrupted()):
            clock.sleep(_WAIT)
        pacer.restart()
        if driver.is_reset_requested:
            driver.is_reset_requested = False
            raise ResetRequested

    def show_message(self, text: str) -> None:
        """Display a message on all pages for 5 s."""
        self._message, self._message_end = text, clock.monotonic() + _MESSAGE_TIME

    def close(self) -> None:
        """Display that the drive has ended, and stop the server."""
        self._driver.is_finished = True
        clock.sleep(_FAREWELL_TIME)
        self._server.close()
        if self._scene:
            self._scene.close()

    def _display(self, session: Session, status: Status) -> None:
        plant = session.plant
        if self._scene is None:
            model = compile_mechanism(plant.machine, ground=plant.ground, surroundings=plant.surroundings)
            self._scene = WebScene(model, plant.axes[: plant.hydraulic])
            self._server.scene_port = self._scene.port
        self._scene.show(session.data.qpos, plant.pressures(session.data), session.time)
        station = session.station
        assert station
        self._status = {
            "scene": True,
            "machine": plant.machine.name,
            "time": status.time,
            "duration": session.scenario.duration,
            "coordinates": list(station.coordinates),
            "hand_force": [round(float(force), 3) for force in status.hand_force],
            "commands": {name: round(value, 3) for name, value in status.commands.items()},
            "rows": [row for row in status.rows() if row[0] in ("handle", "tip", "contact")],
        }

    def _page_status(self, page: int) -> dict[str, Any]:
        message = self._message if clock.monotonic() < self._message_end else ""
        return {**self._description, **self._status, **self._driver.describe_page(page), "message": message}

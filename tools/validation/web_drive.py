"""Measure `hydrotele drive --web` in Chromium: frame rates, delay from key to valve, processor time.

    python tools/validation/web_drive.py                        # table as Markdown
    python tools/validation/web_drive.py --no-scene             # without drawing, which is slow without a GPU
    python tools/validation/web_drive.py --pictures FOLDER      # also wide.png and narrow.png

Needs the extras `web` and `test`, and Chromium. All clocks are those of this computer:

key to input    from the browser's time stamp of the key to the control tick that reads the new handle position
key to valve    to the first change of the boom's valve command by `MIN_CHANGE`. It contains the motion of the
                simulated arm and handle through the dead band of the handle.
poses           pose messages per second that arrive at a page while the machine moves
drawn frames    frames per second that Chromium draws; depends on the graphics processor
"""

import argparse
import json
import shutil
import tempfile
import threading
import time
from pathlib import Path
from time import time as wall_time

import numpy as np
import viser
from playwright.sync_api import Page, sync_playwright
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hydrotele.run.interactive_run import Pacer, drive_scenario
from hydrotele.run.run import load_simulated_machine
from hydrotele.run.web_driver import WebDriver
from hydrotele.scenario.scenario import load_scenario
from hydrotele.show.drive_page import DrivePage

SCENARIO = Path(__file__).resolve().parents[2] / "hydrotele" / "cli" / "drive_cat215.yaml"
MIN_CHANGE = 0.005  # of the command range; at rest with ideal sensors, the command varies by 0.0006
HOLD, PAUSE = 0.4, 3.0  # s, duration of a key press and of the rest before it
PERCENTILES = (5, 50, 95)
ARGUMENTS = ("--no-sandbox", "--enable-unsafe-swiftshader")
RECORD_KEYS = """
window.keys = [];
addEventListener('keydown', event => keys.push(performance.timeOrigin + event.timeStamp), true);
"""
COUNT_FRAMES = """seconds => new Promise(done => {
    const start = performance.now(); let frames = 0;
    const count = now => { frames += 1; if (now - start < 1000 * seconds) requestAnimationFrame(count);
                           else done(1000 * frames / (now - start)); };
    requestAnimationFrame(count);
})"""


class Recorder(WebDriver):
    """A web driver that records when the simulation reads a new handle position, and the boom's valve commands."""

    def __init__(self):
        super().__init__(0)
        self.inputs, self.ticks, self.commands = [], [], []
        self._before = (0.0,) * 6

    def read(self, time):
        reading = super().read(time)
        if reading.axes != self._before:
            self.inputs.append(wall_time())
            self._before = reading.axes
        return reading

    def record_tick(self, session):
        self.ticks.append(wall_time())
        self.commands.append(session.commands_at(session.tick - 1)[session.plant.axes.index("boom")])


def main():
    options = read_options()
    scenario = load_scenario(str(SCENARIO), {"duration": "600", "sensors": "ideal"})
    driver, pacer, failures = Recorder(), Pacer(), []
    page = DrivePage("127.0.0.1", 0, driver, scenario.name, Path(tempfile.gettempdir()))
    measured = {}

    def visit():
        try:
            measured.update(measure_page(page.url, driver, options))
        except Exception as error:
            failures.append(error)
        driver.is_finished = True

    visitor = threading.Thread(target=visit)
    visitor.start()

    def watch(session, status, now):
        page.update(session, status, pacer, lambda: False)
        driver.record_tick(session)
        return True

    try:
        drive_scenario(scenario, load_simulated_machine(scenario), driver, pacer, watch, lambda text: None)
    finally:
        driver.is_finished = True
        page.close()
        visitor.join()
        if failures:
            raise failures[0]
    print_table(measured, driver, pacer)


def measure_page(url: str, driver: Recorder, options: argparse.Namespace) -> dict:
    result = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 800}, bypass_csp=True)
        if options.no_scene:
            page.route("**/view*", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
        page.add_init_script(RECORD_KEYS)
        page.goto(url)
        page.wait_for_function("status !== null && status.scene", timeout=120_000)
        if not options.no_scene:
            page.frame_locator("#scene").locator("canvas").first.wait_for(timeout=120_000)
            time.sleep(5.0)
        start(page)
        result["round trips"] = press_keys(page, options.presses)
        result["keys"] = page.evaluate("keys.splice(0)")[: options.presses]
        if not options.no_scene:
            start(page)
            page.keyboard.down("KeyI")
            result["frames"] = page.frames[1].evaluate(COUNT_FRAMES, options.seconds)
            if options.pictures:
                save_pictures(page, options.pictures)
        browser.close()
    result["poses"], result["processor"] = count_pose_messages(url, options.seconds)
    return result


def start(page: Page):
    page.wait_for_function("status.role !== 'watcher'")
    page.evaluate("isDriver() && status.running || document.getElementById('run').click()")  # needs no drawn frame
    page.wait_for_function("isDriver() && status.running")


def press_keys(page: Page, count: int) -> list[float]:
    """Raise and lower the bucket in turn; return the round trips of the inputs [ms]."""
    trips = []
    random = np.random.default_rng(1)
    for number in range(count):
        time.sleep(PAUSE + 0.1 * random.random())
        key = "KeyI" if number % 2 == 0 else "KeyK"
        page.keyboard.down(key)
        time.sleep(HOLD)
        trips.append(page.evaluate("roundTrip"))
        page.keyboard.up(key)
    return [trip for trip in trips if trip is not None]


def count_pose_messages(url: str, seconds: float) -> tuple[float, float]:
    """Return the pose messages per second of a page of a moving machine, and the processor time per second.

    Both pages are WebSockets here. The processor time is that of simulation, server and these pages.
    """
    address, protocol = url.replace("http", "ws"), Subprotocol(f"viser-v{viser.__version__}")
    with (
        connect(address + "control", close_timeout=0.5) as page,
        connect(address + "scene", subprotocols=[protocol], max_size=None, close_timeout=0.5) as scene,
    ):
        page.send('{"kind": "start"}')
        count, begun, counting = 0, time.monotonic(), False
        while (now := time.monotonic() - begun) < 2.0 + seconds:
            if not counting and now > 2.0:  # the scene has arrived
                count, counting, processor = 0, True, time.process_time()
            raised = 1 if now % 4.0 < 2.0 else -1
            page.send(json.dumps({"kind": "input", "axes": [0, 0, raised, 0, 0, 0]}))
            scene.recv(timeout=5.0)
            count += 1
        return count / seconds, (time.process_time() - processor) / seconds


def save_pictures(page: Page, folder: Path):
    folder.mkdir(parents=True, exist_ok=True)
    close_notes(page)
    page.screenshot(path=folder / "wide.png")
    assert page.context.browser
    narrow = page.context.browser.new_page(viewport={"width": 390, "height": 800}, bypass_csp=True)
    narrow.goto(page.url)
    narrow.frame_locator("#scene").get_by_text("pressures").first.wait_for(timeout=120_000)
    narrow.wait_for_timeout(8000)
    close_notes(narrow)
    narrow.screenshot(path=folder / "narrow.png")
    narrow.close()


def close_notes(page: Page):
    """Close viser's note on drawing without a graphics processor."""
    buttons = page.frames[1].locator("button.mantine-Notification-closeButton")
    for number in range(buttons.count()):
        buttons.nth(number).evaluate("button => button.click()")
    page.wait_for_timeout(2000)


def print_table(measured: dict, driver: Recorder, pacer: Pacer):
    keys = np.array(measured["keys"]) / 1e3
    ticks, commands, inputs = np.array(driver.ticks), np.array(driver.commands), np.array(driver.inputs)
    to_input = [inputs[inputs > key].min(initial=np.inf) - key for key in keys]
    to_valve = []
    for number, key in enumerate(keys):
        first, direction = int(np.searchsorted(ticks, key)), (-1.0) ** number
        change = direction * (commands[first : first + 400] - commands[first - 1])
        place = np.flatnonzero(change > MIN_CHANGE)
        to_valve.append(ticks[first + place[0]] - key if len(place) else np.inf)
    print("| quantity | 5 % | median | 95 % | unit |\n| --- | ---: | ---: | ---: | --- |")
    rows = {"key to input": to_input, "key to valve": to_valve}
    for name, values in rows.items():
        print_row(f"{name}, {len(values)} presses", 1e3 * np.array(values))
    name = "round trip that the page displays: from sending an input to processing the answer in the page"
    print_row(name, np.array(measured["round trips"]))
    print(f"\nmachine poses that the server sends: {measured['poses']:.1f} per second")
    if "frames" in measured:
        print(f"frames that the browser draws: {measured['frames']:.1f} per second")
    print(f"processor time of simulation, server and two pages: {measured['processor']:.2f} s per second")
    print(f"pauses: {pacer.pauses}, {pacer.total_delay:.2f} s")


def print_row(name: str, milliseconds: np.ndarray):
    low, middle, high = np.percentile(milliseconds, PERCENTILES)
    print(f"| {name} | {low:.0f} | {middle:.0f} | {high:.0f} | ms |")


def find_chromium() -> str:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    return found or parser().error("there is no Chromium")


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--presses", type=int, default=30, help="number of key presses")
    made.add_argument("--seconds", type=float, default=10.0, help="duration of the measurement of a rate [s]")
    made.add_argument("--no-scene", action="store_true", help="do not draw the machine")
    made.add_argument("--pictures", type=Path, help="folder for pictures of the page")
    return made


def read_options() -> argparse.Namespace:
    options = parser().parse_args()
    if options.pictures and options.no_scene:
        parser().error("--pictures needs the scene")
    return options


if __name__ == "__main__":
    main()

"""`hydrotele drive --web`: the page in Chromium, its server without a browser, and wrong options."""

import contextlib
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from hydrotele.cli.drive_command import DriveOptions, drive_to_folder
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.logs.log import load_log
from hydrotele.run.web_driver import INPUT_TIMEOUT
from hydrotele.show.web_server import PageHandlers, WebServer

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WAIT = 60_000  # ms; the computer of a test may be slow
EMPTY_PAGE = "<!doctype html><title>no scene</title>"
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


class Drive:
    """A drive with a web page, in a thread."""

    def __init__(self, target: Path, **changes):
        self.target, self.port, self.error = target, free_port(), None
        usual = DriveOptions(
            None, {}, "keyboard", target, True, 1200.0, 1.0, False, True, web=("127.0.0.1", self.port)
        )  # fmt: skip
        self._options = usual._replace(**changes)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self.port}/"
        for _ in range(600):
            with contextlib.suppress(OSError), urllib.request.urlopen(self.url):
                return
            assert self._thread.is_alive(), self.error
            time.sleep(0.1)

    def _run(self):
        try:
            drive_to_folder(self._options)
        except Exception as error:
            self.error = error

    def control(self, **options):
        """Connect like a page."""
        return connect(f"ws://127.0.0.1:{self.port}/control", close_timeout=0.5, **options)

    def finish(self):
        """End the drive as any page could, and wait until its folder is written."""
        with contextlib.suppress(OSError, ConnectionClosed), self.control() as page:
            take_controls(page)
            time.sleep(0.5)  # a log needs ten rows
            page.send('{"kind": "finish"}')
            time.sleep(0.2)
        self._thread.join(60.0)
        assert not self._thread.is_alive() and self.error is None


def take_controls(page):
    """Press Start until the page drives; the server may not have removed the last page yet."""
    deadline = time.monotonic() + 20.0
    while json.loads(page.recv(timeout=5.0))["role"] != "driver":
        page.send('{"kind": "start"}')
        assert time.monotonic() < deadline


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive whose machine lies in a folder with spaces in its name."""
    folder = tmp_path_factory.mktemp("my drives")
    shutil.copytree(models_folder() / "cat215", folder / "my machine")
    overrides = {"machine": json.dumps(str(folder / "my machine")), "tool": "bucket"}
    made = Drive(folder / "out of the browser", overrides=overrides)
    yield made
    made.finish()


@pytest.fixture
def open_page(browser, drive):
    """Open pages of the drive without their 3D scene, which is slow without a graphics processor."""
    pages, errors = [], []

    def opened(width=1000, height=700, script=""):
        page = browser.new_page(viewport={"width": width, "height": height}, bypass_csp=True)
        page.set_default_timeout(WAIT)
        page.on("pageerror", lambda error: errors.append(error))
        page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        page.route("**/view*", lambda route: route.fulfill(body=EMPTY_PAGE, content_type="text/html"))
        page.add_init_script(script)
        page.goto(drive.url)
        page.wait_for_function("status !== null && status.scene")
        pages.append(page)
        return page

    yield opened
    for page in pages:
        page.close()
    assert not errors


def start(page):
    page.wait_for_function("status.role !== 'watcher'")
    page.click("#run")
    page.wait_for_function("status.role === 'driver' && status.running")


def handle_is_centred(page):
    page.wait_for_function("Math.abs(parseFloat(status.rows[0][1].split(' z ')[1])) < 0.5")  # mm


def handle_is_raised(page):
    """Wait for the handle; a page that was too slow to send and lost its machine starts again."""
    again = "status.role === 'free' ? (document.querySelector('#run').click(), false)"
    page.wait_for_function(f"{again} : parseFloat(status.rows[0][1].split(' z ')[1]) > 3", polling=500)


@needs_chromium
def test_keys_joysticks_and_gamepad_move_the_handle(open_page):
    page = open_page(
        script="""
        window.pad = { connected: true, axes: [0, 0, 0, 0], buttons: Array(17).fill({ pressed: false }) };
        navigator.getGamepads = () => [null, window.pad];
        """
    )
    assert page.is_disabled("#reset") and "press Start" in page.inner_text("#note")
    start(page)
    for key in ("PageUp", "KeyI"):
        page.keyboard.down(key)
        handle_is_raised(page)
        page.keyboard.up(key)
        handle_is_centred(page)
    box = page.locator(".pad").nth(1).bounding_box()
    page.mouse.move(box["x"] + 56, box["y"] + 56)
    page.mouse.down()
    page.mouse.move(box["x"] + 56, box["y"] - 300)
    assert page.evaluate("handle()") == [0, 0, 1, 0, 0, 0]
    handle_is_raised(page)
    page.mouse.up()
    handle_is_centred(page)
    page.evaluate("pad.axes[3] = -1")
    handle_is_raised(page)
    page.evaluate("pad.axes[3] = -0.1")  # inside the dead zone
    handle_is_centred(page)
    # Start of the gamepad, pressed and released until the run stops: a busy page may miss a press
    press = "{ pad.buttons[9] = { pressed: !pad.buttons[9].pressed }; return !status.running; }"
    page.wait_for_function(f"() => {press}", polling=2000)


@needs_chromium
def test_second_page_watches_and_a_closed_page_leaves_the_machine_without_commands(open_page):
    first, second = open_page(), open_page()
    start(first)
    second.wait_for_function("status.role === 'watcher'")
    second.wait_for_function("document.querySelector('#note').innerText.includes('only watches')")
    assert second.is_disabled("#run")
    second.keyboard.down("KeyI")
    row = second.evaluate("new Promise(done => setTimeout(() => done(status.rows[0][1]), 800))")
    assert re.search(r"z [+-]0\.", row)  # mm
    second.keyboard.up("KeyI")
    first.keyboard.down("KeyI")
    handle_is_raised(second)
    first.close()
    second.wait_for_function("status.role === 'free' && status.running")
    handle_is_centred(second)
    assert second.inner_text("#run") == "Drive"
    start(second)
    second.reload()  # a page that was loaded again is another page
    second.wait_for_function("status !== null && status.scene")
    start(second)


@needs_chromium
def test_commands_go_to_zero_when_the_page_stops_sending_and_when_it_loses_the_focus(open_page):
    page = open_page()
    start(page)
    page.keyboard.down("KeyI")
    handle_is_raised(page)
    page.evaluate("send = () => {}")
    handle_is_centred(page)
    assert f"{INPUT_TIMEOUT:g} s" in page.evaluate("status.message")
    other = open_page()
    other.wait_for_function("status.role === 'free'")  # after DRIVER_TIMEOUT
    start(other)
    other.keyboard.down("KeyI")
    handle_is_raised(other)
    other.evaluate("window.dispatchEvent(new Event('blur'))")
    handle_is_centred(other)
    other.keyboard.up("KeyI")


@needs_chromium
def test_reset_asks_once_more_and_returns_the_machine_to_its_initial_state(open_page):
    page = open_page()
    start(page)
    page.wait_for_function("status.time > 1")
    page.click("#reset")
    assert page.inner_text("#reset").startswith("Discard")
    page.click("#reset")
    page.wait_for_function("!status.running && status.time < 0.1")
    start(page)
    page.wait_for_function("status.time > 0.3")


@needs_chromium
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 780), (320, 568), (844, 390)])
def test_all_controls_are_on_the_screen(open_page, width, height):
    page = open_page(width, height)
    for element in page.query_selector_all("button, .pad, #bars, #note"):
        box = element.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= width, element
        assert box["y"] >= 0 and box["y"] + box["height"] <= height, element
    assert page.locator("main").bounding_box()["height"] > 100  # pixels left for the machine


@needs_chromium
@pytest.mark.nightly  # draws for half a minute without a graphics processor
def test_scene_is_drawn_without_errors_and_keys_do_not_move_its_camera(browser, drive):
    page = browser.new_page(viewport={"width": 360, "height": 480}, bypass_csp=True)
    page.set_default_timeout(WAIT)
    errors = []
    page.on("pageerror", lambda error: errors.append(error))
    page.goto(drive.url)
    page.wait_for_selector("#scene")
    scene = page.frame_locator("#scene")
    scene.locator("canvas").first.wait_for()
    scene.get_by_text("pressures").first.wait_for()
    page.wait_for_function("status.role === 'free'")
    page.evaluate("document.getElementById('run').click()")
    page.wait_for_function("status.role === 'driver' && status.running")
    page.evaluate(
        """() => {
        const view = document.getElementById('scene').contentWindow;
        window.seen = 0;
        view.document.addEventListener('keydown', () => { window.seen += 1; });
        for (const code of ['KeyI', 'Enter']) view.document.body.dispatchEvent(
            new KeyboardEvent('keydown', { code, key: code, bubbles: true, cancelable: true }));
        }"""
    )
    assert page.evaluate("window.seen") == 1  # viser gets Enter, not the key of the joystick
    handle_is_raised(page)
    page.close()
    assert not errors


def test_foreign_sites_malformed_messages_and_slow_pages_do_no_harm(drive):
    """No browser is needed. A site in the user's browser could otherwise drive the machine."""
    for headers in ({"Origin": "http://example.org"}, {"Host": "example.org"}):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(drive.url, headers=headers))
    for path in ("control", "scene"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{drive.port}/{path}", origin=Origin("http://example.org"))
    for path in ("else", "../etc/passwd", "%2e%2e/etc/passwd", "view/x"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(drive.url + path)
    with drive.control() as watcher, drive.control() as slow:
        for text in ("{", b"\x00\xff", "[1]", "x" * 100_000):
            with drive.control() as page, pytest.raises(ConnectionClosed):
                page.send('{"kind": "start"}')
                page.send(text)
                while True:
                    page.recv(timeout=10.0)
        with drive.control() as flood:
            take_controls(flood)
            for _ in range(1000):
                flood.send('{"kind": "zero"}')
            deadline = time.monotonic() + 20.0
            while json.loads(watcher.recv(timeout=5.0))["role"] != "watcher":
                assert time.monotonic() < deadline
        assert slow.recv(timeout=5.0)  # has not read so far


def test_ctrl_c_ends_the_command_and_writes_the_run(tmp_path):
    """The page is a WebSocket here. Standard output holds nothing but the JSON."""
    target, port = tmp_path / "out", free_port()
    command = f"drive --web --port {port} --no-review --json --set control_rate=200 --out".split()
    process = subprocess.Popen(
        [sys.executable, "-m", "hydrotele", *command, str(target)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stderr and f"open http://127.0.0.1:{port}/" in process.stderr.readline().decode()
    with pytest.raises(InputError, match="in use"):
        WebServer("127.0.0.1", port, "", PageHandlers(lambda *_: "", lambda _: {}, lambda _: None))
    with connect(f"ws://127.0.0.1:{port}/control", close_timeout=0.5) as page:
        while not json.loads(page.recv(timeout=60.0))["scene"]:
            pass
        page.send('{"kind": "start"}')
        while json.loads(page.recv(timeout=5.0))["time"] < 1.5:
            page.send('{"kind": "input", "axes": [0, 0, 1, 0, 0, 0]}')
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=180.0)
    assert process.returncode == 0 and b"Traceback" not in errors
    summary = json.loads((target / "summary.json").read_text())
    assert json.loads(output) == {**summary, "folder": str(target)} and summary["kind"] == "run"
    assert {"pauses", "paused_seconds", "teleoperation"} <= summary.keys()
    log = load_log(target / "measured.parquet")
    assert log["tip_pose.z"][-1] - log["tip_pose.z"][0] > 0.05 and np.ptp(log["angle.boom"]) > np.radians(0.5)
    assert "follow" in (target / "scenario.yaml").read_text()  # the operator that repeats the input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "gamepad"}, "reads keyboard and gamepad"),
        ({"device": "haptic:127.0.0.1:5610"}, "reads keyboard and gamepad"),
        ({"latency": True}, "omit --web"),
        ({"speed": 0.0}, "must be positive"),
        ({"web": ("203.0.113.7", 0)}, "no address of this computer"),
        ({"web": ("no such host.invalid", 0)}, "no address of this computer"),
        ({"scenario": "zhu_up"}, "no joystick"),
    ],
)
def test_wrong_options_are_named(tmp_path, changes, message):
    usual = DriveOptions(None, {}, "keyboard", tmp_path / "out", True, 1.0, 1.0, False, True, web=("127.0.0.1", 0))
    with pytest.raises(InputError, match=message):
        drive_to_folder(usual._replace(**changes))
    assert not (tmp_path / "out").exists()

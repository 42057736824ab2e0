"""The page that drives, the pages that watch, and what happens when a page is silent."""

import json

import pytest

from hydrotele.run.web_driver import DRIVER_TIMEOUT, INPUT_TIMEOUT, WebDriver


class Clock:
    def __init__(self):
        self.time = 50.0

    def __call__(self):
        return self.time


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def driver(clock):
    return WebDriver(2, clock)


def send(driver, page, kind, **content):
    return driver.process_message(page, json.dumps({"kind": kind, **content}))


def push(driver, page, x):
    return send(driver, page, "input", axes=[x, 0, 0, 0, 0, 0], sent=7.0)


def test_first_page_that_starts_drives_and_the_others_watch(driver):
    assert push(driver, 1, 0.5) == "press Start to drive" and driver.read(0.0).axes[0] == 0.0
    assert send(driver, 1, "start") == "" and driver.is_running
    assert push(driver, 1, 0.5) == ""
    for kind in ("start", "stop", "reset", "finish", "zero"):
        assert send(driver, 2, kind) == "another page drives"
    assert push(driver, 2, -1.0) == "another page drives"
    assert driver.read(0.0).axes == (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert driver.is_running and not driver.is_finished and not driver.is_reset_requested
    assert [driver.describe_page(page)["role"] for page in (1, 2)] == ["driver", "watcher"]
    assert [driver.describe_page(page)["sent"] for page in (1, 2)] == [7.0, 0.0]


def test_commands_go_to_zero_when_the_page_is_silent(driver, clock):
    send(driver, 1, "start")
    send(driver, 1, "switch", axis=1, direction=1)
    push(driver, 1, 1.0)
    clock.time += 0.99 * INPUT_TIMEOUT
    reading = driver.read(0.0)
    assert reading.axes[0] == 1.0 and reading.commands == (0.0, 1.0) and not reading.user_message
    clock.time += 0.02 * INPUT_TIMEOUT
    reading = driver.read(0.0)
    assert reading.axes == (0.0,) * 6 and reading.commands == (0.0, 0.0) and "0.5 s" in reading.user_message
    assert not driver.read(0.0).user_message  # said once
    push(driver, 1, 0.25)
    reading = driver.read(0.0)  # a switched command stays off until it is switched again
    assert reading.axes[0] == 0.25 and reading.commands == (0.0, 0.0)


def test_another_page_takes_over_when_the_driver_is_gone_or_silent(driver, clock):
    send(driver, 1, "start")
    push(driver, 1, 1.0)
    driver.remove_page(2)  # a watcher
    assert driver.read(0.0).axes[0] == 1.0
    driver.remove_page(1)
    assert driver.read(0.0).axes[0] == 0.0
    assert driver.describe_page(2) == {"role": "free", "running": True, "finished": False, "sent": 0.0}
    assert send(driver, 2, "start") == ""
    clock.time += 1.01 * DRIVER_TIMEOUT
    assert send(driver, 3, "start") == "" and send(driver, 2, "stop") == "another page drives"


def test_stop_reset_and_finish(driver):
    send(driver, 1, "start")
    push(driver, 1, 1.0)
    send(driver, 1, "switch", axis=0, direction=-1)
    send(driver, 1, "stop")
    assert not driver.is_running and driver.read(0.0)[:2] == ((0.0,) * 6, (0.0, 0.0))
    send(driver, 1, "start")
    send(driver, 1, "reset")
    assert not driver.is_running and driver.is_reset_requested
    assert not driver.read(0.0).quit
    send(driver, 1, "finish")
    assert driver.read(0.0).quit
    driver.close()


@pytest.mark.parametrize(
    "text",
    [
        "", "null", "[]", "{", "\x00", b"\xff\xfe", '{"kind": "fly"}', '{"kind": "start", "page": 2}',
        '{"kind": "input"}', '{"kind": "input", "axes": [0, 0, 0]}', '{"kind": "input", "axes": [0, 0, 0, 0, 0, 1.01]}',
        '{"kind": "input", "axes": [0, 0, 0, 0, 0, NaN]}', '{"kind": "input", "axes": [0, 0, 0, 0, 0, 1e999]}',
        '{"kind": "switch", "axis": -1, "direction": 1}', '{"kind": "switch", "axis": 0, "direction": 2}',
        '{"kind": "switch", "axis": 1e99, "direction": 1}', "[" * 10_000,
    ],
)  # fmt: skip
def test_malformed_message_is_refused_and_changes_nothing(driver, text):
    send(driver, 1, "start")
    push(driver, 1, 0.5)
    with pytest.raises(ValueError):
        driver.process_message(1, text)
    assert driver.read(0.0).axes[0] == 0.5


def test_switch_of_an_axis_that_does_not_exist_has_no_effect(driver):
    send(driver, 1, "start")
    assert send(driver, 1, "switch", axis=5, direction=1) == "" and driver.read(0.0).commands == (0.0, 0.0)

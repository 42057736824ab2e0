"""Driving with a haptic device: addresses, and a drive beside a device in another process."""

import json

import numpy as np
import pytest

from hydrotele.cli.drive_command import DriveOptions, drive_to_folder
from hydrotele.core.errors import InputError
from hydrotele.haptics.server import DEFAULT_PORT
from hydrotele.logs.log import load_log
from hydrotele.run.interactive_run import parse_haptic_address
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

WISHES = DriveOptions(None, {}, "keyboard", None, False, None, 1.0, False, True)


def test_addresses():
    assert parse_haptic_address("haptic") == ("127.0.0.1", DEFAULT_PORT)
    assert parse_haptic_address("haptic:lab") == ("lab", DEFAULT_PORT)
    assert parse_haptic_address("haptic:10.0.0.7:6000") == ("10.0.0.7", 6000)
    for wrong in ("haptic:", "haptic::6000", "haptic:a:b", "haptic:a:0", "haptic:a:70000",
                  "haptic:a:1:2", "haptics"):  # fmt: skip
        with pytest.raises(InputError, match="must be haptic, haptic:HOST or haptic:HOST:PORT"):
            parse_haptic_address(wrong)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "haptic", "speed": 0.0}, "which runs in real time"),
        ({"device": "gamepad", "latency": True}, "has no force output: omit --device"),
    ],
)
def test_what_does_not_go_together(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        drive_to_folder(WISHES._replace(target=tmp_path / "run", **changes))


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Three seconds beside a simulated device of its own; its person moves in the last two."""
    folder = tmp_path_factory.mktemp("haptic") / "run"
    drive_to_folder(WISHES._replace(target=folder, latency=True, duration=3.0))
    return folder


@pytest.mark.nightly
def test_the_device_moves_the_machine_and_latency_is_told(driven):
    log = load_log(driven / "measured.parquet")
    assert np.abs(log["handle.x"]).max() > 1.5e-3  # beyond the dead band
    assert np.ptp(log["tip_pose.r"]) > 5e-3
    summary = json.loads((driven / "summary.json").read_text())
    line, machine = summary["haptic"]["channel"], summary["haptic"]["machine"]
    assert machine["ticks"] == 3000 and machine["control_rate"] == 1000.0
    computer = summary["haptic"]["computer"]
    assert computer["seconds"] == 1.0 and computer["ticks"] == 1000 and "stolen_seconds" in computer
    assert line["poses"] > 0 and line["malformed"] == 0 and line["late"] == 0
    for name in ("answer", "loop", "interval"):
        assert set(line[name]["percentiles_us"]) == {"p50", "p90", "p99", "p99.9", "max"}


@pytest.mark.nightly
def test_the_scenario_that_is_written_makes_a_run_like_it(driven):
    again = run_scenario(load_scenario(driven / "scenario.yaml"))
    before, after = load_log(driven / "measured.parquet"), again.measured
    # The simulated hand takes some 0.1 s to follow, at up to 10 mm/s of the handle: 1 mm.
    assert after["handle.x"] == pytest.approx(before["handle.x"], abs=1e-3)

"""Driving live: time is kept, what a device asks for happens, and the run repeats itself."""

import json
import signal

import numpy as np
import pytest

from hydrotele.cli.drive_command import DriveOptions, catch_first_interrupt, drive_to_folder
from hydrotele.core.errors import InputError
from hydrotele.logs.log import load_log
from hydrotele.run.devices import Reading
from hydrotele.run.interactive_run import MAX_LATENESS, Pacer, axes_not_moved_by_joystick, drive_scenario
from hydrotele.run.run import load_simulated_machine, run_scenario
from hydrotele.scenario.scenario import load_scenario

OUT = "time,x,y\n0,0,0\n0.3,0.8,0\n2.3,0,0.6\n3.4,0,0\n4,0,0\n"


class Clock:
    """A wall clock that only moves when somebody waits or works."""

    def __init__(self):
        self.time, self.slept = 100.0, []

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.time += seconds


def wishes(out, **changes):
    usual = DriveOptions(None, {}, "keyboard", out, False, None, 0.0, False, True)
    return usual._replace(**changes)


class Script:
    """A device of a few lines: what to read by time; ends when there is no more."""

    def __init__(self, *rows):
        self._rows = rows

    def read(self, time):
        done = [reading for at, reading in self._rows if at <= time + 1e-9]
        return done[-1]

    def close(self):
        pass


def test_pacer_waits_for_the_clock():
    clock = Clock()
    pacer = Pacer(1.0, clock.now, clock.sleep)
    for tick in range(1, 201):
        clock.time += 0.001  # of computing
        assert pacer.wait_for_tick(0.005 * tick) == 0.0
    assert clock.time == pytest.approx(100.001 + 0.995)
    assert pacer.pauses == 0 and pacer.total_delay == 0.0


def test_pacer_makes_up_for_a_hiccup_but_not_for_more():
    clock = Clock()
    pacer = Pacer(1.0, clock.now, clock.sleep)
    pacer.wait_for_tick(0.0)
    clock.time += 0.9 * MAX_LATENESS
    assert pacer.wait_for_tick(0.005) == 0.0 and pacer.pauses == 0
    pacer.wait_for_tick(0.9 * MAX_LATENESS)
    assert not clock.slept  # has caught up just now
    clock.time += 2.0
    set_back = pacer.wait_for_tick(0.9 * MAX_LATENESS + 0.005)
    assert set_back == pytest.approx(2.0 - 0.005) == pacer.total_delay and pacer.pauses == 1
    pacer.wait_for_tick(0.9 * MAX_LATENESS + 0.105)
    assert clock.slept == [pytest.approx(0.1)]  # no race to make up for the two seconds


@pytest.mark.parametrize(("speed", "expected"), [(2.0, 0.5), (0.5, 2.0), (0.0, 0.0)])
def test_pacer_at_another_speed(speed, expected):
    clock = Clock()
    pacer = Pacer(speed, clock.now, clock.sleep)
    pacer.wait_for_tick(0.0)
    pacer.wait_for_tick(1.0)
    assert sum(clock.slept) == pytest.approx(expected)


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A scripted drive, made once: half out, then half left."""
    folder = tmp_path_factory.mktemp("drives")
    (folder / "out.csv").write_text(OUT)
    drive_to_folder(wishes(folder / "a", device=f"scripted:{folder / 'out.csv'}"))
    return folder


def test_drive_moves_the_machine_as_asked(driven):
    """The tip goes with the speeds of the joystick: 0.5 m/s and 0.3 rad/s at the stop."""
    log = load_log(driven / "a" / "measured.parquet")
    r, theta, z = (log[f"tip_pose.{name}"] for name in ("r", "theta", "z"))
    # Two seconds at 0.4 m/s; the handle needs a quarter second and starts up at 1 m/s^2.
    assert 0.5 < r[-1] - r[0] < 0.85
    assert 0.1 < theta[-1] - theta[0] < 0.3
    assert abs(z[-1] - z[0]) < 0.05
    assert np.abs(log["handle.z"]).max() < 1.5e-3 < np.abs(log["handle.x"]).max()  # dead band


def test_folder_is_that_of_a_run(driven):
    names = {path.name for path in (driven / "a").iterdir()}
    assert names == {"machine.xml", "machine.yaml", "measured.parquet", "scenario.yaml",
                     "summary.json", "truth.parquet"}  # fmt: skip
    summary = json.loads((driven / "a" / "summary.json").read_text())
    assert summary["kind"] == "run" and summary["simulated_seconds"] == 4.0
    assert summary["pauses"] == 0 and summary["paused_seconds"] == 0.0
    assert summary["balance"]["seconds"] == 4.0
    for name in ("measured", "truth"):
        log = load_log(driven / "a" / f"{name}.parquet")
        assert len(log) == 200 and all(len(column) == 200 for column in log.columns.values())


@pytest.mark.nightly
def test_same_script_same_bits_and_the_scenario_repeats_it(driven):
    drive_to_folder(wishes(driven / "b", device=f"scripted:{driven / 'out.csv'}"))
    again = run_scenario(load_scenario(driven / "a" / "scenario.yaml"))
    for name, log in (("measured", again.measured), ("truth", again.truth)):
        first = load_log(driven / "a" / f"{name}.parquet")
        second = load_log(driven / "b" / f"{name}.parquet")
        assert log.columns.keys() == first.columns.keys() == second.columns.keys()
        for channel, values in first.columns.items():
            assert values.tobytes() == second[channel].tobytes() == log[channel].tobytes(), channel


def test_buttons_of_the_feller_and_their_repetition():
    """The saw spins up, the grab closes; the notes and the repeating scenario know of it."""
    scenario = load_scenario("fell_tree", {"duration": "3"})
    machine = load_simulated_machine(scenario)
    assert axes_not_moved_by_joystick(machine) == {"grab": 1.0, "saw": 1.0}
    device = Script(
        (0.0, Reading(commands=(0.0, 0.0))),
        (0.1, Reading(commands=(0.0, 1.0))),
        (
            1.14,
            Reading(commands=(0.8, 1.0), user_message="hello"),
        ),  # tick 228: 228 * 0.005 is not 1.14
        (1.16, Reading(commands=(0.8, 1.0))),
        (2.0, Reading(commands=(0.8, 1.0), quit=True)),
    )
    said, shown = [], []

    def watch(session, status, now):
        if session.tick == 390:
            shown.append(dict(status().rows()))
        return True

    run = drive_scenario(scenario, machine, device, Pacer(0.0), watch, said.append)
    assert run.scenario.duration == 2.0 and "hello" in said
    assert run.measured["command.saw"][4] == 0.0 and run.measured["command.saw"][6] == 1.0
    assert run.measured["angle.grab"][-1] > run.measured["angle.grab"][57] + 0.05
    assert shown[0]["saw"] == "+1" and shown[0]["grab"] == "+0.8" and shown[0]["time"] == "1.9 s"
    again = run_scenario(run.scenario)
    assert all(v.tobytes() == again.truth[c].tobytes() for c, v in run.truth.columns.items())


def test_slow_computer_pauses_and_says_so():
    """Every tick takes 0.1 s of a made-up clock."""
    clock, said = Clock(), []

    def watch(session, status, now):
        clock.time += 0.1
        return True

    scenario = load_scenario("steer", {"duration": "0.5"})
    device = Script((0.0, Reading()))
    pacer = Pacer(1.0, clock.now, clock.sleep)
    run = drive_scenario(scenario, load_simulated_machine(scenario), device, pacer, watch, said.append)
    assert run.summary["pauses"] > 10
    assert run.summary["paused_seconds"] == pytest.approx(99 * 0.095, abs=MAX_LATENESS)
    assert len(run.measured) == 25 and not clock.slept
    told = [sentence for sentence in said if sentence.startswith("computer too slow")]
    assert 3 <= len(told) <= 6  # of 10 s, every two


def test_first_interrupt_ends_the_drive_and_the_second_everything():
    before = signal.getsignal(signal.SIGINT)  # a job in the background of a shell ignores it
    with pytest.raises(KeyboardInterrupt), catch_first_interrupt() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupted_drive_writes_a_whole_folder(tmp_path, monkeypatch):
    """Ctrl-C at 0.51 s of simulated time: whole rows, complete folder."""
    real = Pacer.wait_for_tick

    def wait_for_tick(self, simulated):
        if abs(simulated - 0.51) < 1e-9:
            signal.raise_signal(signal.SIGINT)
        return real(self, simulated)

    monkeypatch.setattr(Pacer, "wait_for_tick", wait_for_tick)
    (tmp_path / "s.yaml").write_text("time: [0, 100]\n")
    drive_to_folder(wishes(tmp_path / "run", device=f"scripted:{tmp_path / 's.yaml'}"))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["simulated_seconds"] == pytest.approx(0.52)
    assert len(load_log(tmp_path / "run" / "measured.parquet")) == 26


def test_drive_that_ends_at_once_writes_nothing(tmp_path):
    (tmp_path / "s.yaml").write_text("time: [0, 0.1]\n")
    with pytest.raises(InputError, match="too short for a log"):
        drive_to_folder(wishes(tmp_path / "run", device=f"scripted:{tmp_path / 's.yaml'}"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "needs the viewer window to read keys"),
        ({"device": "mouse"}, "is not a known device; did you mean 'spacemouse'"),
        ({"device": "scripted:none.csv"}, "no such file"),
        ({"scenario": "zhu_up", "device": "scripted:S"}, "pilot kind lines has no joystick"),
        ({"device": "scripted:S", "overrides": {"machine": "rig"}}, "arm"),
        ({"device": "scripted:S", "duration": -1.0}, "duration"),
        ({"device": "scripted:S", "duration": 0.0}, "duration"),
        ({"device": "scripted:S", "overrides": {"machine": "cat216"}}, "did you mean 'cat215'"),
    ],
)
def test_errors_of_the_user(changes, message, tmp_path):
    (tmp_path / "s.csv").write_text(OUT)
    if changes.get("device") == "scripted:S":
        changes = changes | {"device": f"scripted:{tmp_path / 's.csv'}"}
    with pytest.raises(InputError, match=message):
        drive_to_folder(wishes(tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists()


def test_no_screen_is_no_hang(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="there is no screen.*--no-viewer"):
        drive_to_folder(wishes(tmp_path / "run", viewer=True))


def test_live_scenario_cannot_be_run_alone():
    scenario = load_scenario("steer", {"pilot.operator": "{kind: live}"})
    with pytest.raises(InputError, match="hydrotele drive"):
        run_scenario(scenario)


@pytest.mark.daily("cat325-None")
@pytest.mark.parametrize(("machine", "tool"), [("cat325", None), ("cat215", "grapple")])
def test_usual_scenario_of_other_machines_and_tools(machine, tool, tmp_path):
    (tmp_path / "s.yaml").write_text("time: [0, 0.4]\naxes: {z: [1, 1]}\n")
    overrides = {"machine": machine} | ({"tool": tool} if tool else {})
    device = f"scripted:{tmp_path / 's.yaml'}"
    drive_to_folder(wishes(tmp_path / "run", device=device, overrides=overrides))
    log = load_log(tmp_path / "run" / "truth.parquet")
    assert log.metadata["machine"] == machine and log["truth.velocity.boom"][-1] > 0.01

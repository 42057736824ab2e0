"""Deadlines on a clock that the test moves, and what is said of times."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest

from hydrotele.cli.haptic_device_command import describe_computer_timing
from hydrotele.haptics import timing
from hydrotele.haptics.timing import (
    HISTOGRAM_EDGES_US,
    RealTimePacer,
    measure_missed_deadlines,
    read_steal_time,
    reduce_timing_jitter,
    summarise_durations,
)

MS = 1_000_000


class Clock:
    """A clock that moves when somebody works, sleeps or looks at it."""

    def __init__(self):
        self.time, self.slept = 10**12, []

    def now(self):
        self.time += 100  # looking takes 0.1 us
        return self.time

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.time += round(1e9 * seconds)


@pytest.fixture
def clock():
    return Clock()


def test_ticks_end_at_absolute_times(clock):
    pacer = RealTimePacer(1000, now=clock.now, sleep=clock.sleep)
    pacer.wait_for_tick(0.0)
    begin = clock.time
    for tick in range(1, 501):
        clock.time += 300_000 if tick % 2 else 600_000
        assert pacer.wait_for_tick(1e-3 * tick) == 0.0
    # Every wait ends within two looks at the clock of its time, and errors do not add up.
    assert clock.time - begin == pytest.approx(500 * MS, abs=1000)
    assert pacer.missed == 0 and max(clock.slept) < 1e-3


def test_a_missed_deadline_is_counted_and_made_up_for(clock):
    pacer = RealTimePacer(1000, now=clock.now, sleep=clock.sleep)
    pacer.wait_for_tick(0.0)
    clock.time += 3 * MS + MS // 2  # of work for the first tick
    for tick in range(1, 8):
        pacer.wait_for_tick(1e-3 * tick)
        clock.time += MS // 2
    # Ticks 1 to 6 end at 3.5, 4, 4.5, 5, 5.5, 6 ms or a little more; only the seventh is in time.
    assert pacer.missed == 6 and pacer.ticks == 8 and pacer.pauses == 0
    late = pacer.delays()
    assert len(late) == 6 and late[0] == pytest.approx(2.5 * MS, abs=2000)
    assert np.all(np.diff(late) < 0)


def test_simulated_time_stands_still_after_a_long_stop(clock):
    pacer = RealTimePacer(1000, max_delay=0.1, now=clock.now, sleep=clock.sleep)
    pacer.wait_for_tick(0.0)
    clock.time += 1000 * MS
    assert pacer.wait_for_tick(1e-3) == pytest.approx(0.999, abs=1e-5)
    assert pacer.pauses == 1 and pacer.total_delay == pytest.approx(0.999, abs=1e-5)
    clock.time += MS // 2
    assert pacer.wait_for_tick(2e-3) == 0.0 and pacer.missed == 1


def test_a_loop_without_work_counts_what_the_computer_takes(clock):
    """Every hundredth sleep lasts 3 ms too long: the next two deadlines have then passed."""
    usual, calls = clock.sleep, [0]

    def stalled(seconds):
        calls[0] += 1
        usual(seconds + (3e-3 if calls[0] % 100 == 0 else 0.0))

    assert measure_missed_deadlines(2.0, 1000.0, now=clock.now, sleep=usual)["missed"] == 0
    found = measure_missed_deadlines(2.0, 1000.0, now=clock.now, sleep=stalled)
    assert found["ticks"] == 2000 and found["missed"] == 2 * (calls[0] // 100) > 30
    # 3 ms after the 0.12 ms before a deadline in which it stays awake, and a tick of 1 ms later
    assert found["lateness"]["percentiles_us"]["max"] == pytest.approx(1880.0, abs=2.0)


def test_stolen_time_is_the_kernels(tmp_path):
    import os

    stat = tmp_path / "stat"
    stat.write_text("cpu  10 0 20 400 0 0 3 250 0 0\ncpu0 5 0 10 200 0 0 1 125 0 0\n")
    assert read_steal_time(stat) == pytest.approx(250.0 / os.sysconf("SC_CLK_TCK"))
    stat.write_text("cpu  10 0 20 400\n")  # before Linux 2.6.11
    assert read_steal_time(stat) is None and read_steal_time(tmp_path / "none") is None


@pytest.mark.parametrize(
    ("alone", "own", "said"),
    [(5, 5, []), (50, 80, ["limit of 0.1 %"]), (5, 40, ["remainder of the 0.4 %"])],
)
def test_report_says_whose_the_missed_deadlines_are(alone, own, said):
    computer = {"seconds": 10.0, "ticks": 10000, "missed": alone,
                "lateness": summarise_durations(np.full(alone, 2_000_000))}  # fmt: skip
    found = describe_computer_timing({"ticks": 10000, "missed": own}, computer)
    assert len(found) == len(said)
    for sentence, words in zip(found, said, strict=True):
        assert words in sentence
    stolen = describe_computer_timing({"ticks": 1, "missed": 0},
                                {"stolen_seconds": 0.4, "stolen_share": 0.02})  # fmt: skip
    assert stolen == ["processor time taken by the host: 0.4 s, 2 % of all cores"]


@pytest.mark.nightly
def test_garbage_is_collected_again_afterwards():
    assert gc.isenabled()
    with reduce_timing_jitter(0) as priority:
        assert not gc.isenabled() and not priority
    assert gc.isenabled() and gc.get_freeze_count() == 0


def test_a_process_without_garbage_collection_keeps_it_off():
    gc.disable()
    try:
        with reduce_timing_jitter(0):
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


@pytest.mark.skipif(not Path("/proc/self/timerslack_ns").exists(), reason="Linux only")
def test_timers_are_exact_meanwhile_only():
    slack = Path("/proc/self/timerslack_ns")
    before = slack.read_text()
    with reduce_timing_jitter(0):
        assert int(slack.read_text()) == 1000
    assert slack.read_text() == before


@pytest.mark.nightly
def test_idle_processors_are_kept_awake_meanwhile(tmp_path, monkeypatch):
    wake = tmp_path / "wake"
    wake.touch()
    monkeypatch.setattr(timing, "_WAKE_LATENCY_FILE", wake)
    with reduce_timing_jitter(0):
        assert wake.read_bytes() == bytes(4)  # 0 us, as an int32
        held = {os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")}
        assert str(wake.resolve()) in held  # the kernel forgets the wish when it is closed
    after = {os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")}
    assert str(wake.resolve()) not in after


@pytest.mark.nightly
def test_a_system_that_keeps_none_awake_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "_WAKE_LATENCY_FILE", tmp_path / "wake")
    with reduce_timing_jitter(0):
        assert not gc.isenabled()
    assert gc.isenabled() and not (tmp_path / "wake").exists()


def test_summary_of_times():
    found = summarise_durations(1000 * np.arange(1, 1001))  # 1 us to 1 ms
    assert found["percentiles_us"]["p50"] == pytest.approx(500.5)
    assert found["percentiles_us"]["max"] == 1000.0
    assert sum(found["histogram"]["count"]) == found["count"] == 1000
    assert len(found["histogram"]["count"]) == len(HISTOGRAM_EDGES_US) + 1
    assert summarise_durations(np.zeros(0))["count"] == 0

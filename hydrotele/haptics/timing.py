"""Tools to keep a period of 1 ms: absolute deadlines, real-time priority, missed-tick statistics.

A process with a deadline every millisecond sleeps until shortly before it and then busy-waits,
since a sleeping process wakes about 50 us late. Python's garbage collector is off during this time.
Where the system permits it, idle processors are kept awake: a processor that sleeps, or that a
virtual machine has returned to its host, wakes up to milliseconds late.
Two measurements show the limits of the computer: the deadlines that an empty loop misses, and the
time that the host takes from a virtual machine.
"""

import contextlib
import ctypes
import gc
import os
import time as clock
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

BUSY_WAIT_TIME = 120e-6  # s before a deadline during which a process busy-waits
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)
HISTOGRAM_EDGES_US = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # us, of histograms
_PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 29, 41  # options of prctl
_WAKE_LATENCY_FILE = Path("/dev/cpu_dma_latency")  # limits the processors' wake-up latency while it is open
_STAT_FILE, _STEAL_COLUMN = Path("/proc/stat"), 8  # index of a word in its first line: proc(5)


def summarise_durations(nanoseconds: np.ndarray) -> dict:
    """Return percentiles and histogram of durations.

    Args:
        nanoseconds: (n,) durations [ns].

    Returns:
        `count`, `percentiles_us` [us] by name, and `histogram` with the edges between its bins [us]
        and the number of durations in each bin. The first bin holds durations below the first edge,
        the last one those above the last edge.

    >>> summarise_durations(np.array([5_000, 15_000, 9_000_000]))["histogram"]["count"]
    [1, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    """
    micro = np.asarray(nanoseconds, float) / 1e3
    if not len(micro):
        return {
            "count": 0,
            "percentiles_us": {},
            "histogram": {"edges_us": HISTOGRAM_EDGES_US, "count": []},
        }
    values = np.percentile(micro, PERCENTILES)
    names = [f"p{p:g}" if p < 100.0 else "max" for p in PERCENTILES]
    counts = np.histogram(micro, [-np.inf, *HISTOGRAM_EDGES_US, np.inf])[0]
    return {
        "count": len(micro),
        "percentiles_us": {n: round(float(v), 1) for n, v in zip(names, values, strict=True)},
        "histogram": {"edges_us": list(HISTOGRAM_EDGES_US), "count": counts.tolist()},
    }


class RealTimePacer:
    """Pacer that keeps simulated time in step with the wall clock, with a deadline for every tick.

    After a small delay the next ticks run without waiting until the delay is caught up. After a
    delay of more than `max_delay` all later deadlines are shifted by it instead (a pause).

    Attributes:
        pauses: number of times that the deadlines were shifted.
        total_delay: total time by which the deadlines were shifted [s].
        missed: number of ticks that missed their deadline.
        ticks: total number of ticks.
        priority: whether real-time priority was granted.
    """

    def __init__(
        self, max_ticks: int, priority_level: int = 0, max_delay: float = 0.25,
        now: Callable[[], int] = clock.monotonic_ns, sleep: Callable[[float], None] = clock.sleep,
    ) -> None:  # fmt: skip
        """Prepare the deadlines; time starts with the first call of `wait_for_tick`, after compilation.

        Args:
            max_ticks: maximum number of ticks whose delay is recorded.
            priority_level: real-time priority from the first tick on, see `reduce_timing_jitter`; 0 requests none.
            max_delay: delay above which the deadlines are shifted [s].
            now: function that returns the time [ns].
            sleep: function that waits for a time [s].
        """
        self._now, self._sleep, self._patience = now, sleep, max_delay
        self._start: int | None = None
        self._level, self._priority_stack, self.priority = (
            priority_level,
            contextlib.ExitStack(),
            False,
        )
        self._lateness = np.zeros(max_ticks, np.int64)
        self.pauses, self.total_delay, self.missed, self.ticks = 0, 0.0, 0, 0

    def now(self) -> float:
        """Return the time of the clock [s]."""
        return self._now() * 1e-9

    def wait_for_tick(self, simulated: float) -> float:
        """Wait until the wall clock reaches the simulated time, after the work of a tick is done.

        The first call starts the clock and does not wait. A call after the deadline returns at once
        and counts the tick as missed.

        Args:
            simulated: time that has been simulated [s]; it defines the tick's deadline.

        Returns:
            Time by which this call shifted the deadlines [s]; 0 unless the delay exceeds
            `max_delay`.
        """
        due, now = round(simulated * 1e9), self._now()
        if self._start is None:
            if self._level:
                self.priority = self._priority_stack.enter_context(reduce_timing_jitter(self._level))
                now = self._now()
            self._start = now - due
        early = self._start + due - now
        if self.ticks < len(self._lateness):
            self._lateness[self.ticks] = max(0, -early)
        self.ticks += 1
        if early < 0:
            self.missed += 1
            if early < -1e9 * self._patience:
                self._start -= early
                self.pauses += 1
                self.total_delay -= 1e-9 * early
                return -1e-9 * early
            return 0.0
        if early > 1e9 * BUSY_WAIT_TIME:
            self._sleep(1e-9 * early - BUSY_WAIT_TIME)
        while self._now() < self._start + due:
            pass
        return 0.0

    def close(self) -> None:
        """Return the process to normal scheduling priority and normal garbage collection."""
        self._priority_stack.close()

    def delays(self) -> np.ndarray:
        """Return by how much the ticks that missed their deadline were late, (n,) [ns].

        Only the first `max_ticks` ticks are recorded.
        """
        late = self._lateness[: self.ticks]
        return late[late > 0]


def measure_missed_deadlines(
    seconds: float, rate: float, level: int = 0, now: Callable[[], int] = clock.monotonic_ns,
    sleep: Callable[[float], None] = clock.sleep,
) -> dict:  # fmt: skip
    """Measure how many deadlines a loop without work misses, and by how much, as a baseline of the computer.

    Args:
        seconds: duration [s].
        rate: rate of the deadlines [Hz].
        level: real-time priority, see `reduce_timing_jitter`.
        now: function that returns the time [ns].
        sleep: function that waits for a time [s].

    Returns:
        Dictionary: seconds, ticks, missed, lateness (see `summarise_durations`), and whether priority
        was granted.
    """
    ticks = max(1, round(seconds * rate))
    pacer = RealTimePacer(ticks, level, now=now, sleep=sleep)
    try:
        for tick in range(ticks):
            pacer.wait_for_tick(tick / rate)
    finally:
        pacer.close()
    return {"seconds": seconds, "ticks": pacer.ticks, "missed": pacer.missed,
            "lateness": summarise_durations(pacer.delays()), "priority": pacer.priority}  # fmt: skip


def read_steal_time(stat: Path = _STAT_FILE) -> float | None:
    """Return the processor time that the host has taken from this virtual machine since it booted.

    Args:
        stat: file with the kernel's statistics, in clock ticks.

    Returns:
        Sum over all processors [s]; None if the system does not report it.

    Source: proc(5), "steal" of /proc/stat.
    """
    try:
        with stat.open(encoding="ascii") as file:
            words = file.readline().split()
        return int(words[_STEAL_COLUMN]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError, AttributeError):  # not Linux, or an old kernel
        return None


def read_load_averages() -> list[float] | None:
    """Return the computer's load averages over 1, 5 and 15 minutes, None if unknown."""
    try:
        return [round(v, 2) for v in os.getloadavg()]
    except OSError:
        return None


def request_realtime_priority(level: int) -> bool:
    """Request real-time priority (first-in first-out scheduling) for the calling thread.

    Args:
        level: priority of the first-in first-out scheduler, 1 to 99.

    Returns:
        Whether it was granted.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
    except (AttributeError, OSError):  # scheduler not available, or not permitted
        return False
    return True


@contextlib.contextmanager
def reduce_timing_jitter(level: int) -> Iterator[bool]:
    """Reduce timing jitter inside a `with` block.

    The block runs without garbage collection, with exact sleeps, small pages and real-time
    priority. Priority and a short processor wake-up time are set only where the system permits
    them. Huge pages are off: the first access to one clears 2 MB, which takes milliseconds.
    Afterwards normal priority, the system's timer slack and huge pages are restored, and garbage
    collection if it was on before.

    Args:
        level: see `request_realtime_priority`; 0 requests none.

    Yields:
        Whether priority was granted.

    Source: Linux, Documentation/power/pm_qos_interface.
    """
    _set_process_option(_PR_SET_TIMERSLACK, 1000)  # exact timers: by default the system wakes a thread up to 50 us late
    _set_process_option(_PR_SET_THP_DISABLE, 1)
    collects = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    given = level > 0 and request_realtime_priority(level)
    awake = contextlib.ExitStack()
    with contextlib.suppress(OSError):  # not available, or not permitted
        awake.enter_context(_WAKE_LATENCY_FILE.open("r+b", buffering=0)).write(bytes(4))
    try:
        yield given
    finally:
        awake.close()
        if given:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        _set_process_option(_PR_SET_TIMERSLACK, 0)  # 0 selects the system's default
        _set_process_option(_PR_SET_THP_DISABLE, 0)
        if collects:
            gc.enable()
        gc.unfreeze()


def _set_process_option(option: int, value: int) -> None:
    """Set an option of this process or thread with Linux's prctl(2); do nothing on other systems."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)

"""Keeping a period of a millisecond: absolute deadlines, priority, and what was missed.

A process that has a deadline every millisecond sleeps until shortly before it and spins over the
rest, since a sleeping process wakes some 50 us late. Python's garbage collector is off meanwhile,
and idle processors stay awake where the system permits it: one that sleeps, or that a virtual
machine has handed back to its host, wakes up to milliseconds late.
What a loop without work misses, and the time that a virtual machine's host takes from it, tell what
the computer can hold at all.
"""

import contextlib
import ctypes
import gc
import os
import time as clock
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

SPIN = 120e-6  # s before a deadline in which a process stays awake
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)
EDGES = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # us, of histograms
_SLACK, _NO_HUGE_PAGES = 29, 41  # PR_SET_TIMERSLACK and PR_SET_THP_DISABLE of prctl
_WAKE = Path("/dev/cpu_dma_latency")  # how long processors may take to wake, while it is open
_STAT, _STEAL = Path("/proc/stat"), 8  # word of its first line: proc(5)


def summary_of(nanoseconds: np.ndarray) -> dict:
    """Percentiles and histogram of times.

    Args:
        nanoseconds: (n,) [ns].

    Returns:
        count, percentiles [us] by name, and a histogram: [us] of the upper edges, and the counts,
        one more for what is beyond.

    >>> summary_of(np.array([5_000, 15_000, 9_000_000]))["histogram"]["count"]
    [1, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    """
    micro = np.asarray(nanoseconds, float) / 1e3
    if not len(micro):
        return {"count": 0, "percentiles_us": {}, "histogram": {"edges_us": EDGES, "count": []}}
    values = np.percentile(micro, PERCENTILES)
    names = [f"p{p:g}" if p < 100.0 else "largest" for p in PERCENTILES]
    counts = np.histogram(micro, [-np.inf, *EDGES, np.inf])[0]
    return {
        "count": len(micro),
        "percentiles_us": {n: round(float(v), 1) for n, v in zip(names, values, strict=True)},
        "histogram": {"edges_us": list(EDGES), "count": counts.tolist()},
    }


class Deadlines:
    """Keeps simulated time to the wall clock with a deadline for every tick.

    What is late is made up for; where that is more than `patience`, simulated time stands still.

    Attributes:
        pauses: how often simulated time was stopped.
        late: seconds for which it stood still, in all.
        missed: ticks that were not done in time.
        ticks: ticks in all.
        priority: whether the system gave it.
    """

    def __init__(
        self, most: int, level: int = 0, patience: float = 0.25,
        now: Callable[[], int] = clock.monotonic_ns, sleep: Callable[[float], None] = clock.sleep,
    ) -> None:  # fmt: skip
        """Begin when `wait` is called first: what is compiled and opened before is in no hurry.

        Args:
            most: number of ticks for which there is room.
            level: of priority from then on, see `steady`; 0 asks for none.
            patience: by which simulated time may be late before it is stopped [s].
            now: a clock [ns].
            sleep: waits for a time [s].
        """
        self._now, self._sleep, self._patience = now, sleep, patience
        self._begin: int | None = None
        self._level, self._steady, self.priority = level, contextlib.ExitStack(), False
        self._lateness = np.zeros(most, np.int64)
        self.pauses, self.late, self.missed, self.ticks = 0, 0.0, 0, 0

    def now(self) -> float:
        """The clock [s]."""
        return self._now() * 1e-9

    def wait(self, simulated: float) -> float:
        """Wait for the deadline of a tick whose work is done.

        Args:
            simulated: time that has been simulated [s].

        Returns:
            By how much simulated time was just set back [s]; 0 if it keeps up.
        """
        due, now = round(simulated * 1e9), self._now()
        if self._begin is None:
            if self._level:
                self.priority = self._steady.enter_context(steady(self._level))
                now = self._now()
            self._begin = now - due
        early = self._begin + due - now
        if self.ticks < len(self._lateness):
            self._lateness[self.ticks] = max(0, -early)
        self.ticks += 1
        if early < 0:
            self.missed += 1
            if early < -1e9 * self._patience:
                self._begin -= early
                self.pauses += 1
                self.late -= 1e-9 * early
                return -1e-9 * early
            return 0.0
        if early > 1e9 * SPIN:
            self._sleep(1e-9 * early - SPIN)
        while self._now() < self._begin + due:
            pass
        return 0.0

    def close(self) -> None:
        """Give the priority back."""
        self._steady.close()

    def lateness(self) -> np.ndarray:
        """(n,) by how much the ticks that missed their deadline were late [ns]."""
        late = self._lateness[: self.ticks]
        return late[late > 0]


def computer_alone(
    seconds: float, rate: float, level: int = 0, now: Callable[[], int] = clock.monotonic_ns,
    sleep: Callable[[float], None] = clock.sleep,
) -> dict:  # fmt: skip
    """Deadlines that a loop without work misses: what the computer and its system take.

    Args:
        seconds: for which it runs [s].
        rate: of its deadlines [Hz].
        level: of priority, see `steady`.
        now: a clock [ns].
        sleep: waits for a time [s].

    Returns:
        seconds, ticks, missed, late (see `summary_of`), and priority.
    """
    ticks = max(1, round(seconds * rate))
    pacer = Deadlines(ticks, level, now=now, sleep=sleep)
    try:
        for tick in range(ticks):
            pacer.wait(tick / rate)
    finally:
        pacer.close()
    return {"seconds": seconds, "ticks": pacer.ticks, "missed": pacer.missed,
            "late": summary_of(pacer.lateness()), "priority": pacer.priority}  # fmt: skip


def stolen_time(stat: Path = _STAT) -> float | None:
    """Processor time that the host of a virtual machine has taken from it since it was started.

    Args:
        stat: the kernel's figures, in ticks of the system.

    Returns:
        Sum over all processors [s]; None where the system does not tell.

    Source: proc(5), "steal" of /proc/stat.
    """
    try:
        with stat.open(encoding="ascii") as file:
            words = file.readline().split()
        return int(words[_STEAL]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError, AttributeError):  # no Linux, or an old one
        return None


def load_of_machine() -> list[float] | None:
    """Mean number of processes that want a core, over 1, 5 and 15 minutes; None where unknown."""
    try:
        return [round(v, 2) for v in os.getloadavg()]
    except OSError:
        return None


def ask_for_priority(level: int) -> bool:
    """Run the calling thread before all ordinary ones, where the system permits it.

    Args:
        level: of the first-in first-out scheduler, 1 to 99.

    Returns:
        Whether it does.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
    except (AttributeError, OSError):  # no such scheduler, or not permitted
        return False
    return True


@contextlib.contextmanager
def steady(level: int) -> Iterator[bool]:
    """No garbage collection, exact sleeps, small pages; where permitted, priority and no deep idle.

    The first touch of a huge page of a long array, such as a log's, makes 2 MB of it: that takes
    milliseconds.

    Args:
        level: see `ask_for_priority`; 0 asks for none.

    Yields:
        Whether there is priority.

    Source: Linux, Documentation/power/pm_qos_interface.
    """
    _control(_SLACK, 1000)  # the system wakes this thread when it is time, not 50 us later
    _control(_NO_HUGE_PAGES, 1)
    gc.collect()
    gc.freeze()
    gc.disable()
    given = level > 0 and ask_for_priority(level)
    awake = contextlib.ExitStack()
    with contextlib.suppress(OSError):  # no such system, or not permitted
        awake.enter_context(_WAKE.open("r+b", buffering=0)).write(bytes(4))
    try:
        yield given
    finally:
        awake.close()
        if given:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        _control(_NO_HUGE_PAGES, 0)
        gc.enable()
        gc.unfreeze()


def _control(option: int, value: int) -> None:
    """Set an option of this process or thread, where the system knows it (Linux, prctl(2))."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)

"""Processes of this computer that do runs: a killed one costs its run, not the sweep.

`concurrent.futures` gives up all runs when one process dies and cannot say which was its own.
"""

import contextlib
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Generator, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from typing import Any

from hydrotele.core.errors import InputError
from hydrotele.sweep.running import Outcome, Task, failed, perform

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_READY = "ready"


class _Worker:
    """A process and the run that it does."""

    def __init__(self, context) -> None:
        """Start the process; it says _READY when it can work."""
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _starting():
            self.process.start()
        theirs.close()  # so that its end shows here
        self.ready, self.task = False, None

    def give(self, task: Task) -> None:
        """Let it do a run; a dead one is found out by the next wait."""
        self.task = task
        with contextlib.suppress(OSError):
            self.connection.send(task)

    def stop(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def outcomes(tasks: Iterable[Task], jobs: int) -> Generator[Outcome]:
    """Do runs in processes of their own, with one thread each.

    Args:
        tasks: the runs; taken as workers become free.
        jobs: number of processes.

    Yields:
        The outcomes, in the order in which they are done. A run whose process dies has failed.

    Raises:
        InputError: the processes do not start.
    """
    context = multiprocessing.get_context("spawn")  # forked compiled code and threads do not mix
    waiting = iter(tasks)
    workers: list[_Worker] = []
    try:
        for task in waiting:
            workers.append(_Worker(context))
            workers[-1].give(task)
            if len(workers) == jobs:
                break
        while busy := {w.connection: w for w in workers if w.task}:
            for connection in wait(list(busy)):
                worker = busy[connection]
                said = _heard(worker)
                if said == _READY:
                    worker.ready = True
                    continue
                if said is None:
                    said = _dead(worker)
                    workers[workers.index(worker)] = worker = _Worker(context)
                worker.task = None
                yield said
                if (task := next(waiting, None)) is not None:
                    worker.give(task)
    finally:
        for worker in workers:
            worker.stop()


def _heard(worker: _Worker) -> Any:
    """What a worker says, None where it is dead."""
    try:
        return worker.connection.recv()
    except Exception:  # it may have died in the middle of a word
        return None


def _dead(worker: _Worker) -> Outcome:
    """The outcome of the run whose process died."""
    worker.stop()
    code = worker.process.exitcode or 0
    how = signal.Signals(-code).name if code < 0 else f"exit status {code}"
    if not worker.ready:
        raise InputError("--jobs", f"a process for the runs did not start ({how})")
    assert worker.task
    memory = "; is there enough memory?" if code == -signal.SIGKILL else ""
    return failed(worker.task.run, f"its process was ended by {how}{memory}")


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """What a process inherits: one thread, and no ear for Ctrl-C, which this process answers."""
    old = {name: os.environ.get(name) for name in _THREADS}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in old.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _work(connection: Connection) -> None:
    """Do runs until the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(connection, tasks), daemon=True).start()
    connection.send(_READY)
    while True:
        connection.send(perform(tasks.get()))


def _listen(connection: Connection, tasks: queue.SimpleQueue) -> None:
    """Take tasks; end this process, whatever it computes, when the parent is gone."""
    try:
        while True:
            tasks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(1)

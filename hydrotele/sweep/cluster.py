"""Runs on a dask cluster: the scheduler gives those of a lost worker to another one."""

import logging
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from hydrotele.core.errors import InputError
from hydrotele.sweep.running import Outcome, Task, failed, perform

_WAIT = 30  # s for the scheduler and the first worker
_WHERE = "--dask"


def cluster_outcomes(tasks: Iterable[Task], address: str) -> Generator[Outcome]:
    """Do runs on a cluster, a few more at a time than it has threads.

    Args:
        tasks: the runs; taken as workers become free.
        address: of the scheduler, or the file that it wrote.

    Yields:
        The outcomes, in the order in which they are done. A run that several workers were lost with
        has failed.

    Raises:
        InputError: dask is not installed, the cluster does not answer or lacks hydrotele.
    """
    try:
        from dask import distributed
    except ImportError:
        message = "needs dask.distributed: pip install 'hydrotele[cluster]'"
        raise InputError(_WHERE, message) from None
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":  # what counts is said here
            logging.getLogger(name).setLevel(logging.CRITICAL)
    there = "scheduler_file" if Path(address).is_file() else "address"
    facts: dict[str, Any] = {there: address, "timeout": f"{_WAIT}s", "set_as_default": False}
    try:
        client = distributed.Client(**facts)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(_WHERE, f"no scheduler answers at {address}: {error}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_WAIT)
        except TimeoutError:
            message = f"the scheduler at {address} has no workers; start some with dask worker"
            raise InputError(_WHERE, message) from None
        yield from _outcomes(client, distributed, iter(tasks))


def _outcomes(client, distributed, waiting: Iterator[Task]) -> Iterator[Outcome]:
    ahead = 2 * max(sum(client.nthreads().values()), 1) + 8
    runs = {}

    def submit(task: Task):
        future = client.submit(perform, task, pure=False, key=f"hydrotele-{task.run}-{id(runs)}")
        runs[future.key] = task.run
        return future

    first = [submit(task) for task in islice(waiting, ahead)]
    done = distributed.as_completed(first, loop=client.loop)
    for future in done:
        run = runs.pop(future.key)
        yield _outcome(distributed, future, run)
        if (task := next(waiting, None)) is not None:
            done.add(submit(task))


def _outcome(distributed, future, run: int) -> Outcome:
    """The outcome of a task of the cluster.

    Raises:
        InputError: it is the cluster that failed.
    """
    if future.status == "finished":
        return future.result()
    error = None if future.status in ("cancelled", "lost") else future.exception()
    if isinstance(error, distributed.KilledWorker):
        return failed(run, "the workers that did it were lost one after the other")
    if isinstance(error, ImportError):
        message = f"its workers need the same hydrotele as this computer: {error}"
        raise InputError(_WHERE, message)
    said = f"{type(error).__name__}: {error}" if error else "its scheduler may be gone"
    kept = "finished runs are kept, the same command goes on"
    raise InputError(_WHERE, f"the cluster gave up run {run}: {said}; {kept}")

"""Execute a sweep: check every point, execute the missing runs, and write the table.

An interrupted sweep continues in its folder; only one process at a time may use the folder. The
table has one row per run and states the unit of every column that has one.

Runs execute in processes of this computer or on a dask cluster. A killed local process fails only
its own run; dask reassigns the runs of a lost worker. Local runs do not use `concurrent.futures`,
which aborts all runs when one process dies. They do not use dask's `LocalCluster`, which would
restart a run that kills its process and needs the extra `cluster`.
"""

import contextlib
import csv
import fcntl
import json
import logging
import multiprocessing
import os
import queue
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from importlib.metadata import version
from itertools import islice
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

import yaml

import hydrotele
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_json, resolve_path
from hydrotele.core.output import atomic_file, atomic_folder, check_output_folder
from hydrotele.run.machine_copies import with_resolved_paths, write_files
from hydrotele.run.sweep_file import Point, SweepFile, iterate_points
from hydrotele.run.sweep_journal import FAILED, JOURNAL, OK, Journal, JournalEntry
from hydrotele.run.sweep_scenarios import (
    CheckedSweep,
    SweepBase,
    check_points,
    hash_scenario,
    make_point_scenario,
    read_base_scenario,
)
from hydrotele.run.sweep_table import SweepTable, make_table, save_table
from hydrotele.run.sweep_task import (
    Outcome,
    RunTask,
    WriteRun,
    check_figures,
    execute_task,
    failed_outcome,
    possible_number_names,
)
from hydrotele.scenario.scenario import save_scenario

_CLUSTER_TIMEOUT = 30  # s, timeout for the scheduler and the first worker
_DASK_OPTION = "--dask"


def run_on_cluster(tasks: Iterable[RunTask], address: str) -> Generator[Outcome]:
    """Execute runs on a dask cluster; more runs than it has threads are submitted at a time.

    Args:
        tasks: the runs; taken as workers become free.
        address: address of the scheduler, or the scheduler file.

    Yields:
        The outcomes in order of completion. A run fails if several workers were lost with it.

    Raises:
        InputError: dask is not installed, the cluster does not respond, or its workers have no
            compatible hydrotele.
    """
    try:
        from dask import distributed
    except ImportError:
        message = "needs dask.distributed: pip install 'hydrotele[cluster]'"
        raise InputError(_DASK_OPTION, message) from None
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":  # errors are reported below
            logging.getLogger(name).setLevel(logging.CRITICAL)
    there = "scheduler_file" if Path(address).is_file() else "address"
    facts: dict[str, Any] = {
        there: address,
        "timeout": f"{_CLUSTER_TIMEOUT}s",
        "set_as_default": False,
    }
    try:
        client = distributed.Client(**facts)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(_DASK_OPTION, f"no scheduler responds at {address}: {error}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_CLUSTER_TIMEOUT)
        except TimeoutError:
            message = f"the scheduler at {address} has no workers; start some with dask worker"
            raise InputError(_DASK_OPTION, message) from None
        yield from _run_on_client(client, distributed, iter(tasks))


def _run_on_client(client, distributed, waiting: Iterator[RunTask]) -> Iterator[Outcome]:
    ahead = 2 * max(sum(client.nthreads().values()), 1) + 8
    runs = {}

    def submit(task: RunTask):
        future = client.submit(execute_task, task, pure=False, key=f"hydrotele-{task.run}-{id(runs)}")
        runs[future.key] = task.run
        return future

    first = [submit(task) for task in islice(waiting, ahead)]
    done = distributed.as_completed(first, loop=client.loop)
    for future in done:
        run = runs.pop(future.key)
        yield _future_outcome(distributed, future, run)
        if (task := next(waiting, None)) is not None:
            done.add(submit(task))


def _future_outcome(distributed, future, run: int) -> Outcome:
    """Return the outcome of a run whose dask task has ended, also if its workers were lost.

    Args:
        distributed: the module dask.distributed.
        future: the task.
        run: number of the run.

    Raises:
        InputError: the cluster failed, not the run.
    """
    if future.status == "finished":
        return future.result()
    error = None if future.status in ("cancelled", "lost") else future.exception()
    if isinstance(error, distributed.KilledWorker):
        return failed_outcome(run, "all workers that executed it were lost")
    if isinstance(error, ImportError):
        message = f"its workers need the same hydrotele as this computer: {error}"
        raise InputError(_DASK_OPTION, message)
    said = f"{type(error).__name__}: {error}" if error else "its scheduler may be gone"
    kept = "finished runs are kept, the same command continues the sweep"
    raise InputError(_DASK_OPTION, f"the cluster aborted run {run}: {said}; {kept}")


KIND = "sweep"
SCRATCH = ".scratch"
_KEYS_WITHOUT_EFFECT = (
    "name",
    "description",
    "figures",
    "scenario",
)  # the digest covers the scenario content
_RESULT_PACKAGES = (
    "mujoco",
    "dm-control",
    "numpy",
    "scipy",
    "numba",
)  # packages that affect results


def result_versions() -> dict[str, str]:
    """Return package name -> version of hydrotele and of the packages that affect results of runs."""
    return {
        "hydrotele": hydrotele.__version__,
        **{name: version(name) for name in _RESULT_PACKAGES},
    }


def sweep_identity(base: SweepBase, checked: CheckedSweep) -> dict[str, Any]:
    """Return the data that must be equal for a sweep to continue in an existing folder.

    They are the entries of the sweep file that affect results, a hash of all scenarios, and the
    package versions.
    """
    facts = base.file.sweep.model_dump(mode="json", exclude=set(_KEYS_WITHOUT_EFFECT))
    return {"sweep": facts, "scenarios": checked.digest, "versions": result_versions()}


@contextlib.contextmanager
def open_sweep_folder(target: Path, base: SweepBase, checked: CheckedSweep, fresh: bool) -> Iterator[None]:
    """Create the folder of a sweep or continue an existing one, with exclusive access while the context is open.

    A new folder gets copies of the user machines and `summary.json`. In each case, hidden leftovers
    of killed processes are deleted, and `sweep.yaml` and a scratch folder are written. The scratch
    folder is deleted at the end.

    Args:
        target: the folder.
        base: the sweep.
        checked: result of `check_points`.
        fresh: whether to delete the content of an earlier sweep.

    Raises:
        InputError: the folder has other content or another sweep, or another process uses it.
    """
    check_output_folder(target, KIND)
    asked = sweep_identity(base, checked)
    if fresh and target.is_dir():
        with _lock_folder(target):
            pass
    if fresh or not (target / "summary.json").is_file():
        with atomic_folder(target, KIND) as folder:
            write_files(base.machine_copies.files(), folder)
            write_summary(folder, base, {"identity": asked})
    if not os.access(target, os.W_OK | os.X_OK):
        raise InputError(target, "cannot be written to; choose another --out")
    with _lock_folder(target):
        there = read_json(target / "summary.json").get("identity", {})
        if found := list(_describe_differences(there, asked)):
            more = f", and {len(found) - 4} more" if len(found) > 4 else ""
            message = "; ".join(found[:4]) + more + "; use --fresh, or choose another --out"
            raise InputError(target, f"contains another sweep: {message}")
        for left in target.glob(".*"):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()
        (target / SCRATCH).mkdir()
        with atomic_file(target / "sweep.yaml", ".yaml") as part:
            part.write_text(_resolved_yaml(base))
        try:
            yield
        finally:
            shutil.rmtree(target / SCRATCH, ignore_errors=True)


def write_summary(folder: Path, base: SweepBase, facts: dict[str, Any]) -> None:
    """Write `summary.json` of a sweep folder: kind, name, number of runs, and the entries `facts`."""
    summary = {"kind": KIND, "name": base.file.name, "runs": base.file.sweep.runs, **facts}
    with atomic_file(folder / "summary.json", ".json") as part:
        part.write_text(json.dumps(summary, indent=2) + "\n")


def _resolved_yaml(base: SweepBase) -> str:
    """Return the sweep with all defaults as YAML text that `load_sweep` reads from any folder."""
    scenario = base.file.find_scenario()
    named = scenario == base.file.sweep.scenario and not Path(scenario).suffix
    facts = base.file.sweep.model_dump(mode="json", exclude_none=True)
    facts |= {"name": base.file.name}
    facts |= {"scenario": scenario if named else str(resolve_path(scenario))}
    return yaml.safe_dump(facts, sort_keys=False, allow_unicode=True)


@contextlib.contextmanager
def _lock_folder(target: Path) -> Iterator[None]:
    """Lock a sweep folder against other processes while the context is open.

    The operating system releases the lock if the process dies.

    Raises:
        InputError: another process has locked it.
    """
    handle = os.open(target, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise InputError(target, "is in use by another hydrotele sweep; wait for it") from None
    try:
        yield
    finally:
        os.close(handle)


def _describe_differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    """Yield the differences between two results of `sweep_identity` as texts.

    A changed hash of the scenarios is named only if nothing else differs.
    """
    before, after = (_flatten({k: i.get(k) for k in ("sweep", "versions")}) for i in (old, new))
    found = False
    for key in dict.fromkeys([*before, *after]):
        if before.get(key) != after.get(key):
            found = True
            was, now = (json.dumps(d[key]) if key in d else "nothing" for d in (before, after))
            yield f"{key.partition('.')[2]} was {was}, is {now}"
    if not found and old.get("scenarios") != new.get("scenarios"):
        yield "the base scenario, one of its files, or the order of the keys has changed"


def _flatten(data: dict[str, Any], above: str = "") -> dict[str, Any]:
    result = {}
    for key, value in data.items():
        if isinstance(value, dict):
            result |= _flatten(value, f"{above}{key}.")
        elif value is not None:
            result[f"{above}{key}"] = value
    return result


_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
_READY = "ready"


class _Worker:
    """A worker process and its current run."""

    def __init__(self, context) -> None:
        """Start the process; it sends `_READY` when it can accept runs."""
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_worker_main, args=(theirs,), daemon=True)
        with _child_process_environment():
            self.process.start()
        theirs.close()  # otherwise the death of the process is not detected
        self.ready, self.task = False, None

    def send_task(self, task: RunTask) -> None:
        """Send a run to the process.

        If the process is dead, nothing is raised; the next wait for its answer detects it.
        """
        self.task = task
        with contextlib.suppress(OSError):
            self.connection.send(task)

    def stop(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run_in_processes(tasks: Iterable[RunTask], jobs: int) -> Generator[Outcome]:
    """Execute runs in worker processes with one thread each.

    Args:
        tasks: the runs; taken as workers become free.
        jobs: number of processes.

    Yields:
        The outcomes in order of completion. A run fails if its process dies.

    Raises:
        InputError: the processes do not start.
    """
    context = multiprocessing.get_context("spawn")  # fork is unsafe with compiled code and threads
    waiting = iter(tasks)
    workers: list[_Worker] = []
    try:
        for task in waiting:
            workers.append(_Worker(context))
            workers[-1].send_task(task)
            if len(workers) == jobs:
                break
        while busy := {w.connection: w for w in workers if w.task}:
            for connection in wait(list(busy)):
                worker = busy[connection]
                said = _receive(worker)
                if said == _READY:
                    worker.ready = True
                    continue
                if said is None:
                    said = _dead_worker_outcome(worker)
                    workers[workers.index(worker)] = worker = _Worker(context)
                worker.task = None
                yield said
                if (task := next(waiting, None)) is not None:
                    worker.send_task(task)
    finally:
        for worker in workers:
            worker.stop()


def _receive(worker: _Worker) -> Any:
    """Return the next message of a worker process (an outcome, or ready), None if it is dead."""
    try:
        return worker.connection.recv()
    except Exception:  # the process may have died while it sent a message
        return None


def _dead_worker_outcome(worker: _Worker) -> Outcome:
    """Return the outcome of the run whose worker process died, with the signal or exit status.

    Raises:
        InputError: the process died before it could accept a run.
    """
    worker.stop()
    code = worker.process.exitcode or 0
    how = signal.Signals(-code).name if code < 0 else f"exit status {code}"
    if not worker.ready:
        raise InputError("--jobs", f"a worker process did not start ({how})")
    assert worker.task
    memory = "; is there enough memory?" if code == -signal.SIGKILL else ""
    return failed_outcome(worker.task.run, f"its process was killed ({how}){memory}")


@contextlib.contextmanager
def _child_process_environment() -> Iterator[None]:
    """Set up an environment in which a child process uses one thread and ignores Ctrl-C.

    Processes started while the context is open inherit it. The calling process handles Ctrl-C for
    them; its own settings are restored at the end.
    """
    old = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in old.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _worker_main(connection: Connection) -> None:
    """Announce readiness, then execute runs received over a connection and send back the outcomes.

    The process ends when its parent process ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tasks: queue.SimpleQueue[RunTask] = queue.SimpleQueue()
    threading.Thread(target=_receive_tasks, args=(connection, tasks), daemon=True).start()
    connection.send(_READY)
    while True:
        connection.send(execute_task(tasks.get()))


def _receive_tasks(connection: Connection, tasks: queue.SimpleQueue) -> None:
    """Put received runs into a queue; exit this process immediately when the parent process ends."""
    try:
        while True:
            tasks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(1)


Progress = Callable[[str, int, int, int], None]


class SweepSettings(NamedTuple):
    """Execution settings of a sweep; they do not affect the results.

    Attributes:
        jobs: number of local processes, None for one per core.
        dask: address or file of a dask scheduler; if given, replaces the local processes.
        fresh: delete the content of an earlier sweep in the folder.
        retry_failed: repeat failed runs.
        write_run_files: function that writes a run into a folder, for sweeps with `logs: true`.
    """

    jobs: int | None = None
    dask: str | None = None
    fresh: bool = False
    retry_failed: bool = False
    write_run_files: WriteRun | None = None


class SweepResult(NamedTuple):
    """Result of a sweep.

    Attributes:
        table: table with one row per run.
        failed: journal entries of the failed runs.
        n_executed: number of runs executed by this call.
    """

    table: SweepTable
    failed: list[JournalEntry]
    n_executed: int


def run_sweep(
    file: SweepFile,
    target: Path,
    sweep_settings: SweepSettings | None = None,
    progress: Progress | None = None,
) -> SweepResult:
    """Execute the missing runs of a sweep and write its table.

    Args:
        file: result of `load_sweep`.
        target: folder of the sweep; an interrupted sweep in it is continued.
        sweep_settings: execution settings.
        progress: called with the stage ("check" or "run"), the number finished, the total number,
            and the number of failed runs.

    Returns:
        The result; its table is also in `table.parquet`.

    Raises:
        InputError: a point is invalid, the folder contains another sweep, or the cluster failed.
        KeyboardInterrupt: on Ctrl-C; finished runs are kept.
    """
    sweep_settings, base = sweep_settings or SweepSettings(), read_base_scenario(file)
    checked = check_points(base, progress and (lambda done, total: progress("check", done, total, 0)))
    possible = possible_number_names(checked.axes, checked.teleoperated)
    check_figures(file.sweep.figures, possible, file.format_location("figures"))
    if sweep_settings.dask:
        base.machine_copies.check_sendable("--dask")
    with open_sweep_folder(target, base, checked, sweep_settings.fresh):
        with closing(Journal(target / JOURNAL)) as journal:
            missing = _find_missing_runs(base, journal, sweep_settings.retry_failed)
            _execute_runs(base, target, journal, missing, sweep_settings, checked, progress)
        entries = {run: journal.entries[run] for run in sorted(journal.entries)}
        failures = [entry for entry in entries.values() if entry.status == FAILED]
        table = make_table(file.sweep, checked.seed, entries, checked.units)
        save_table(table, file.name, target / "table.parquet")
        _save_timings(entries, target / "timings.csv")
        counts = {"ok": len(entries) - len(failures), "failed": len(failures)}
        write_summary(target, base, {"identity": sweep_identity(base, checked), **counts})
    return SweepResult(table, failures, len(missing))


def _find_missing_runs(base: SweepBase, journal: Journal, retry_failed: bool) -> dict[int, Point]:
    """Return run number -> point, for the runs of a sweep that are still to be executed.

    These are the runs that the journal does not contain.

    Args:
        base: the sweep.
        journal: journal of the finished runs.
        retry_failed: include the runs that failed.
    """
    if retry_failed:
        done = {run for run, entry in journal.entries.items() if entry.status == OK}
    else:
        done = set(journal.entries)
    return {point.run: point for point in iterate_points(base.file.sweep) if point.run not in done}


def _execute_runs(
    base: SweepBase, target: Path, journal: Journal, missing: dict[int, Point], how: SweepSettings,
    checked: CheckedSweep, progress: Progress | None,
) -> None:  # fmt: skip
    """Execute the missing runs of a sweep; write each to the journal, and its folder if logs are kept.

    Args:
        base: the sweep.
        target: folder of the sweep.
        journal: its open journal.
        missing: run number -> point of the runs to execute.
        how: execution settings.
        checked: result of `check_points`.
        progress: called after each run, see `run_sweep`.
    """
    total, done = base.file.sweep.runs, base.file.sweep.runs - len(missing)
    failed = sum(e.status == FAILED for r, e in journal.entries.items() if r not in missing)
    tasks = (_make_task(base, target, how, checked, point) for point in missing.values())
    jobs = min(how.jobs or os.cpu_count() or 1, max(len(missing), 1))
    found = run_on_cluster(tasks, how.dask) if how.dask and missing else run_in_processes(tasks, jobs)
    if progress:
        progress("run", done, total, failed)
    with closing(found):
        for outcome in found:
            _check_versions(outcome)
            if outcome.files:
                _write_run_folder(base, target, missing[outcome.entry.run], outcome)
            journal.add(outcome.entry)
            done, failed = done + 1, failed + (outcome.entry.status == FAILED)
            if progress:
                progress("run", done, total, failed)


def _make_task(base: SweepBase, target: Path, how: SweepSettings, checked: CheckedSweep, point: Point) -> RunTask:
    scenario = make_point_scenario(base, point)
    if hash_scenario(scenario) != checked.fingerprints[point.run - 1]:
        message = "one of its files changed during the sweep; the finished runs are kept"
        raise InputError(base.scenario.path, message)
    keep = how.write_run_files if base.file.sweep.logs else None
    if how.dask:
        return RunTask(point.run, scenario, None, base.machine_copies.files_of(scenario), keep, None)
    folder = resolve_path(target)
    return RunTask(point.run, scenario, str(folder), {}, keep, str(folder / SCRATCH))


def _check_versions(outcome: Outcome) -> None:
    """Check that the worker of a run had the same software versions as this process.

    Raises:
        InputError: a version differs, so that results would not be comparable.
    """
    ours = result_versions()
    for name, theirs in outcome.versions.items():
        if ours.get(name, theirs) != theirs:
            raise InputError("--dask", f"a worker has {name} {theirs}, this computer {ours[name]}")


def _write_run_folder(base: SweepBase, target: Path, point: Point, outcome: Outcome) -> None:
    """Write the files of a run and its scenario to the folder `runs/NUMBER` of a sweep: all or none."""
    name = f"{point.run:0{max(4, len(str(base.file.sweep.runs)))}d}"
    with atomic_folder(target / "runs" / name, "run") as folder:
        for file, content in outcome.files.items():
            (folder / file).write_bytes(content)
        # the scenario written by a worker contains machine paths of that computer
        save_scenario(
            with_resolved_paths(make_point_scenario(base, point), resolve_path(target)),
            folder / "scenario.yaml",
        )


def _save_timings(entries: dict[int, JournalEntry], path: Path) -> None:
    """Write run number and computing time [s] of every run to a CSV file.

    The times are not in the table of the sweep, because they differ between equal runs.
    """
    with atomic_file(path, ".csv") as part, open(part, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["run", "wall [s]"])
        for entry in entries.values():
            rows.writerow([entry.run, entry.wall_seconds])

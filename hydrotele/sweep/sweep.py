"""Do a sweep: check every point, do the runs that are missing, write table and report."""

import csv
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.output import replacing, whole_folder
from hydrotele.scenario.scenario import save_scenario
from hydrotele.sweep.checking import (
    Base,
    Checked,
    check_points,
    fingerprint,
    open_base,
    scenario_of,
)
from hydrotele.sweep.cluster import cluster_outcomes
from hydrotele.sweep.facts import SweepFile
from hydrotele.sweep.folder import SCRATCH, identity, sweep_folder, versions, write_summary
from hydrotele.sweep.inputs import placed
from hydrotele.sweep.journal import FAILED, JOURNAL, OK, Entry, Journal
from hydrotele.sweep.numbers import check_figures, possible_numbers
from hydrotele.sweep.points import Point, points
from hydrotele.sweep.running import Keep, Outcome, Task
from hydrotele.sweep.table import Table, make_table, save_table
from hydrotele.sweep.workers import outcomes

Progress = Callable[[str, int, int, int], None]


class How(NamedTuple):
    """How the runs of a sweep are done; nothing here changes a result.

    Attributes:
        jobs: processes of this computer, None for one per core.
        dask: scheduler of a cluster instead of them: address or scheduler file.
        fresh: throw away what an earlier sweep left in the folder.
        retry_failed: do failed runs again.
        keep: writes a run into a folder, where the sweep asks for logs.
    """

    jobs: int | None = None
    dask: str | None = None
    fresh: bool = False
    retry_failed: bool = False
    keep: Keep | None = None


class Swept(NamedTuple):
    """A finished sweep.

    Attributes:
        table: a row per run.
        failed: entries of the runs that failed.
        done: number of runs that were done now, not before.
    """

    table: Table
    failed: list[Entry]
    done: int


def run_sweep(
    file: SweepFile, target: Path, how: How | None = None, progress: Progress | None = None
) -> Swept:
    """Do the runs of a sweep that are not done yet; write its table.

    Args:
        file: the sweep, of `load_sweep`.
        target: its folder; what an interrupted sweep left there is gone on with.
        how: where and how the runs are done.
        progress: called with what is done ("check" or "run"), how many are, of how many, and how
            many failed.

    Returns:
        The table, also in `table.parquet`.

    Raises:
        InputError: a point is wrong, the folder is not this sweep's, or the cluster does not work.
        KeyboardInterrupt: on Ctrl-C; finished runs are kept.
    """
    how, base = how or How(), open_base(file)
    checked = check_points(
        base, progress and (lambda done, total: progress("check", done, total, 0))
    )
    possible = possible_numbers(checked.axes, checked.teleoperated)
    check_figures(file.sweep.figures, possible, file.place("figures"))
    if how.dask:
        base.inputs.refuse_bound("--dask")
    with sweep_folder(target, base, checked, how.fresh):
        with closing(Journal(target / JOURNAL)) as journal:
            missing = _missing(base, journal, how.retry_failed)
            _do(base, target, journal, missing, how, checked, progress)
        entries = {run: journal.entries[run] for run in sorted(journal.entries)}
        failures = [entry for entry in entries.values() if entry.status == FAILED]
        table = make_table(file.sweep, checked.seed, entries, checked.units)
        save_table(table, file.name, target / "table.parquet")
        _save_timings(entries, target / "timings.csv")
        counts = {"ok": len(entries) - len(failures), "failed": len(failures)}
        write_summary(target, base, {"identity": identity(base, checked), **counts})
    return Swept(table, failures, len(missing))


def _missing(base: Base, journal: Journal, retry_failed: bool) -> dict[int, Point]:
    """The runs to do, by number."""
    if retry_failed:
        done = {run for run, entry in journal.entries.items() if entry.status == OK}
    else:
        done = set(journal.entries)
    return {point.run: point for point in points(base.file.sweep) if point.run not in done}


def _do(
    base: Base, target: Path, journal: Journal, missing: dict[int, Point], how: How,
    checked: Checked, progress: Progress | None,
) -> None:  # fmt: skip
    """Do the missing runs and write each into the journal."""
    total, done = base.file.sweep.runs, base.file.sweep.runs - len(missing)
    failed = sum(e.status == FAILED for r, e in journal.entries.items() if r not in missing)
    tasks = (_task(base, target, how, checked, point) for point in missing.values())
    jobs = min(how.jobs or os.cpu_count() or 1, max(len(missing), 1))
    found = cluster_outcomes(tasks, how.dask) if how.dask and missing else outcomes(tasks, jobs)
    if progress:
        progress("run", done, total, failed)
    with closing(found):
        for outcome in found:
            _check_versions(outcome)
            if outcome.files:
                _keep(base, target, missing[outcome.entry.run], outcome)
            journal.add(outcome.entry)
            done, failed = done + 1, failed + (outcome.entry.status == FAILED)
            if progress:
                progress("run", done, total, failed)


def _task(base: Base, target: Path, how: How, checked: Checked, point: Point) -> Task:
    scenario = scenario_of(base, point)
    if fingerprint(scenario) != checked.fingerprints[point.run - 1]:
        message = "a file that it names changed while the sweep ran; the finished runs are kept"
        raise InputError(base.scenario.path, message)
    keep = how.keep if base.file.sweep.logs else None
    if how.dask:
        return Task(point.run, scenario, None, base.inputs.files_of(scenario), keep, None)
    folder = target.resolve()
    return Task(point.run, scenario, str(folder), {}, keep, str(folder / SCRATCH))


def _check_versions(outcome: Outcome) -> None:
    """Refuse a result of other software: numbers of one table come from one."""
    ours = versions()
    for name, theirs in outcome.versions.items():
        if ours.get(name, theirs) != theirs:
            raise InputError("--dask", f"a worker has {name} {theirs}, this computer {ours[name]}")


def _keep(base: Base, target: Path, point: Point, outcome: Outcome) -> None:
    """Write the folder of a run, whole or not at all."""
    name = f"{point.run:0{max(4, len(str(base.file.sweep.runs)))}d}"
    with whole_folder(target / "runs" / name, "run") as folder:
        for file, content in outcome.files.items():
            (folder / file).write_bytes(content)
        # A worker's own names its machine where only it has it.
        save_scenario(placed(scenario_of(base, point), target.resolve()), folder / "scenario.yaml")


def _save_timings(entries: dict[int, Entry], path: Path) -> None:
    """Write what differs between runs of equal content, beside the table."""
    with replacing(path, ".csv") as part, open(part, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["run", "wall [s]"])
        for entry in entries.values():
            rows.writerow([entry.run, entry.wall_seconds])

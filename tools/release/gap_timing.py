"""Measure the time and memory that gap finding takes.

    python tools/release/gap_timing.py ../shared/measured [--jobs 2]
    python tools/release/gap_timing.py ../shared/measured --method regression --cases open_08 open_04 [--jobs 2]

With `--method search`, the default, runs of several lengths and two machines are compared: the runs of open_04 (clean)
and open_05 (dead band) are cut to 10, 20 and 40 s. All in one process, so that a slow machine slows all alike; compiled
code is loaded before.

With `--method regression`, each case is searched in a process of its own, after a search that loads the compiled code.
Printed are elapsed time, processor time and peak memory of each case, the size of its matrices, and the stages of the
first case.
"""

import argparse
import dataclasses
import multiprocessing
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from hydrotele.estimate.hypothesis import calibration, hypotheses, limit_to_domain
from hydrotele.gap.dictionary import list_versions
from hydrotele.gap.find import find_gap
from hydrotele.gap.machine_model import LINEAR_STEP_SECONDS
from hydrotele.logs.dataset import Dataset, RunData, load_dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine_file import load_machine

LENGTHS = (10.0, 20.0, 40.0)  # s
_WARM_UP = 20.0  # s of all fitted runs


class Timing(NamedTuple):
    """Time and memory of one search.

    Attributes:
        verdict: of the search.
        elapsed: [s].
        processor: time of all threads [s].
        memory: largest resident memory of the process [GB].
        rows: errors of the linear step, runs times rows times channels.
        columns: of the effects and of the uncertain parameters.
        stages: text of each progress report -> (elapsed, processor) time until the next one [s].
    """

    verdict: str
    elapsed: float
    processor: float
    memory: float
    rows: int
    columns: tuple[int, int]
    stages: dict[str, tuple[float, float]]


def shortened(data: Dataset, seconds: float) -> Dataset:
    """The dataset with the first seconds of every run."""

    def cut(run: RunData) -> RunData:
        rows = slice(0, round(seconds / run.period))
        log = dataclasses.replace(
            run.log, time=run.log.time[rows], columns={c: run.log[c][rows] for c in run.log.columns}
        )
        return dataclasses.replace(
            run, command=run.command[rows], command_known=run.command_known[rows],
            reading=run.reading[rows], log=log,
        )  # fmt: skip

    fit = tuple(cut(run) for run in data.fit)
    return dataclasses.replace(data, fit=fit, heldout=cut(data.heldout))


def time_regression(folder: Path, jobs: int) -> Timing:
    """Search a case with `--method regression` and measure time and memory of this process."""
    data = load_dataset([folder], load_machine("cat215"))
    find_gap(select_exciting_segments(data, _WARM_UP), effects=["internal_leakage"], jobs=jobs, method="regression")
    reports: list[tuple[str, float, float]] = []

    def report(text: str, share: float) -> None:
        reports.append((text.partition(";")[0], time.perf_counter(), time.process_time()))

    begin = time.perf_counter(), time.process_time()
    gap = find_gap(data, report, jobs=jobs, method="regression")
    end = time.perf_counter(), time.process_time()
    stages: dict[str, tuple[float, float]] = {}
    for (text, *start), (_, *stop) in zip(reports, [*reports[1:], ("", *end)], strict=True):
        before = stages.get(text, (0.0, 0.0))
        stages[text] = before[0] + stop[0] - start[0], before[1] + stop[1] - start[1]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # Linux states kB
    rows = sum(min(len(r.command), round(LINEAR_STEP_SECONDS / r.period)) for r in data.fit) * len(data.channels)
    candidates, _ = limit_to_domain(hypotheses(data.machine), data.machine)
    columns = sum(v.steps.shape[1] for c in candidates for v in list_versions(c))
    sizes = columns, calibration(data.machine).size
    return Timing(gap.verdict, end[0] - begin[0], end[1] - begin[1], memory, rows, sizes, stages)


def print_regression(folder: Path, cases: Sequence[str], jobs: int) -> None:
    """Print the tables of `--method regression`."""
    print("| case | verdict | elapsed [s] | processor time [s] | peak memory [GB] | errors x columns |")
    print("| --- | --- | --- | --- | --- | --- |")
    found = []
    for case in cases:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            t = pool.apply(time_regression, (folder / case, jobs))
        found.append(t)
        print(
            f"| {case} | {t.verdict} | {t.elapsed:.0f} | {t.processor:.0f} | {t.memory:.1f} |"
            f" {t.rows} x ({t.columns[0]} + {t.columns[1]}) |", flush=True,
        )  # fmt: skip
    print(f"\n| stage of {cases[0]} | elapsed [s] | processor time [s] |\n| --- | --- | --- |")
    for text, (elapsed, processor) in found[0].stages.items():
        print(f"| {text} | {elapsed:.1f} | {processor:.1f} |")


def print_search(folder: Path, jobs: int) -> None:
    """Print the table of `--method search`."""
    machine = load_machine("cat215")
    sets = {case: load_dataset(folder / case, machine) for case in ("open_04", "open_05")}
    find_gap(shortened(sets["open_05"], 10.0), effects=["valve_deadband"], jobs=jobs)
    print("| four runs of | verdict | time [s] | time per second of run [s] |")
    print("| --- | --- | --- | --- |")
    for data in sets.values():
        for seconds in LENGTHS:
            gap = find_gap(shortened(data, seconds), jobs=jobs)
            took, rate = gap.seconds, gap.seconds / (4.0 * seconds)
            print(f"| {seconds:.0f} s | {gap.verdict} | {took:.1f} | {rate:.2f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--method", choices=("search", "regression"), default="search")
    parser.add_argument("--cases", nargs="+", default=["open_08", "open_01", "open_04", "open_07", "open_10"])
    args = parser.parse_args()
    if args.method == "search":
        print_search(args.folder, args.jobs)
    else:
        print_regression(args.folder, args.cases, args.jobs)

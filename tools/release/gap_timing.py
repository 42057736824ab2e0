"""Measure the time and memory that gap finding takes.

    python tools/release/gap_timing.py ../shared/measured [--cases open_08 open_04] [--jobs 2]

Each case is searched in a process of its own, after a search that loads the compiled code. Printed are elapsed time,
processor time and peak memory of each case, the size of its matrices, and the stages of the first case.
"""

import argparse
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
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine_file import load_machine

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


def time_case(folder: Path, jobs: int) -> Timing:
    """Search a case and measure time and memory of this process."""
    data = load_dataset([folder], load_machine("cat215"))
    find_gap(select_exciting_segments(data, _WARM_UP), effects=["internal_leakage"], jobs=jobs)
    reports: list[tuple[str, float, float]] = []

    def report(text: str, share: float) -> None:
        reports.append((text.partition(";")[0], time.perf_counter(), time.process_time()))

    begin = time.perf_counter(), time.process_time()
    gap = find_gap(data, report, jobs=jobs)
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


def print_tables(folder: Path, cases: Sequence[str], jobs: int) -> None:
    """Search the cases and print the tables."""
    print("| case | verdict | elapsed [s] | processor time [s] | peak memory [GB] | errors x columns |")
    print("| --- | --- | --- | --- | --- | --- |")
    found = []
    for case in cases:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            t = pool.apply(time_case, (folder / case, jobs))
        found.append(t)
        print(
            f"| {case} | {t.verdict} | {t.elapsed:.0f} | {t.processor:.0f} | {t.memory:.1f} |"
            f" {t.rows} x ({t.columns[0]} + {t.columns[1]}) |", flush=True,
        )  # fmt: skip
    print(f"\n| stage of {cases[0]} | elapsed [s] | processor time [s] |\n| --- | --- | --- |")
    for text, (elapsed, processor) in found[0].stages.items():
        print(f"| {text} | {elapsed:.1f} | {processor:.1f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cases", nargs="+", default=["open_08", "open_01", "open_04", "open_07", "open_10"])
    args = parser.parse_args()
    print_tables(args.folder, args.cases, args.jobs)

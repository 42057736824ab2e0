"""Measure the time that gap finding takes, for runs of several lengths and two machines.

    python tools/release/gap_timing.py ../shared/measured [--jobs 2]

Cuts the runs of open_04 (clean) and open_05 (dead band) to 10, 20 and 40 s. All in one process, so
that a slow machine slows all alike; compiled code is loaded before.
"""

import argparse
import dataclasses
from pathlib import Path

from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import Dataset, RunData, load_dataset
from hydrotele.machine.machine_file import load_machine

LENGTHS = (10.0, 20.0, 40.0)  # s


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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    machine = load_machine("cat215")
    sets = {case: load_dataset(args.folder / case, machine) for case in ("open_04", "open_05")}
    find_gap(shortened(sets["open_05"], 10.0), effects=["valve_deadband"], jobs=args.jobs)
    print("| four runs of | verdict | time [s] | time per second of run [s] |")
    print("| --- | --- | --- | --- |")
    for data in sets.values():
        for seconds in LENGTHS:
            gap = find_gap(shortened(data, seconds), jobs=args.jobs)
            took, rate = gap.seconds, gap.seconds / (4.0 * seconds)
            print(f"| {seconds:.0f} s | {gap.verdict} | {took:.1f} | {rate:.2f} |", flush=True)

"""Compare a document's verdicts among numbers of repetitions.

    python tools/studies/experiment_seeds.py NAME [--counts 10 20 40] [--jobs 2] [--out FILE]
        [--folder DIR]

NAME is a document, such as zhu1994. Repetitions of a smaller number are the first of the larger
one. --folder holds what `hydrotele experiments NAME` writes, if its number of repetitions is among
the counts. Exit status 1 where a row changes between `agrees` and `differs`.
"""

import argparse
import importlib
import sys
from pathlib import Path

from hydrotele.cli.experiments_command import write_comparison_files
from hydrotele.experiments.comparison import Series, compare_by_repetition_count

_MARKS = {"input": " (input)", "additional": " (not in the publication)", "caption": " (caption only)"}


def import_series(name: str) -> Series:
    """Return the series of a document, such as `zhu1994`."""
    return importlib.import_module(f"hydrotele.experiments.{name}").SERIES


def report_progress(name: str, fraction: float) -> None:
    """Print the finished fraction to the standard error stream."""
    print(f"{100 * fraction:3.0f} % {name}", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name")
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", help="Markdown file to write")
    parser.add_argument("--folder", type=Path, help="folder for table, report and figures")
    arguments = parser.parse_args()

    series, counts = import_series(arguments.name), arguments.counts
    found = compare_by_repetition_count(series, counts, arguments.jobs, report_progress)
    if arguments.folder and series.repetitions in counts:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        write_comparison_files(arguments.folder, series, series.repetitions, found[series.repetitions])
    words = " ".join(map(str, counts))
    lines = [
        f"# Verdicts of {arguments.name} by number of repetitions", "",
        f"`python tools/studies/experiment_seeds.py {arguments.name} --counts {words}`", "",
        "| row | " + " | ".join(f"{count} repetitions" for count in counts) + " |",
        "| --- |" + " --- |" * len(counts),
    ]  # fmt: skip
    changed = []
    for rows in zip(*(found[count] for count in counts), strict=True):
        verdicts = [row.verdict for row in rows]
        lines.append(f"| {rows[0].name}{_MARKS.get(rows[0].kind, '')} | " + " | ".join(verdicts) + " |")
        if {"agrees", "differs"} <= set(verdicts):
            changed.append(rows[0].name)
    lines += ["", f"{len(changed)} rows change between agrees and differs.", ""]
    text = "\n".join(lines)
    print(text)
    if arguments.out:
        with open(arguments.out, "w", encoding="utf-8") as file:
            file.write(text)
    if changed:
        sys.exit(f"the verdict changes: {', '.join(changed)}")


if __name__ == "__main__":
    main()

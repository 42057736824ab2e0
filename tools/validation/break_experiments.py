"""Judge every criterion of a document by runs with a deliberate fault.

    python tools/validation/break_experiments.py NAME [--only "ROW,ROW"] [--jobs 2] [--out FILE]

NAME is a document, such as zhu1994. A row that does not say `differs` has a criterion that cannot
fail in the way that it should: exit status 1.
"""

import argparse
import sys

from hydrotele.experiments.comparison import run_with_faults
from tools.studies.experiment_seeds import import_series, report_progress

_PAGES = {"abdellatif2008": "parallel_robot"}  # page of the comparison, if its name differs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name")
    parser.add_argument("--only", default="", help="rows, separated by commas; all by default")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", help="Markdown file to write")
    arguments = parser.parse_args()

    series = import_series(arguments.name)
    names = [name.strip() for name in arguments.only.split(",") if name.strip()]
    unknown = set(names) - set(series.claims)
    if unknown:
        parser.error(f"no row {unknown.pop()!r}; valid: {', '.join(series.claims)}")
    judged = run_with_faults(series, names, arguments.jobs, report_progress)

    lines = [
        f"# Broken runs of {arguments.name}", "",
        f"`python tools/validation/break_experiments.py {arguments.name}`", "",
        f"Rows of the [comparison]({_PAGES.get(arguments.name, arguments.name)}.md) are repeated with a planted"
        " fault, up to six times. A criterion works if the verdict is *differs*. For a row that differs",
        "without the fault as well, the run only shows that the fault does not make it agree. Names and fixed texts in"
        " the third column are those of the row",
        "without the fault; where they contradict the fault, the fault applies.", "",
        "`inf`: an event that does not occur, no limit, or different numbers of parameters. `nan`: the quantity does"
        " not exist in a repetition, or cannot be",
        "defined because the repetitions have no scatter. A very large number: the scatter or the denominator is"
        " almost zero with the fault, or an estimate",
        "diverges in single repetitions.", "",
        "| row | fault | simulated with the fault | verdict |", "| --- | --- | --- | --- |",
    ]  # fmt: skip
    for claim, row in judged:
        cells = (claim.name, claim.fault_description, row.simulated, row.verdict)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    failed = [claim.name for claim, row in judged if row.verdict != "differs"]
    lines += ["", f"{len(judged) - len(failed)} of {len(judged)} rows say differs.", ""]
    unbroken = [name for name, claim in series.claims.items() if claim.fault is None]
    if unbroken and not names:
        lines += [f"No fault was planted for these rows: {', '.join(unbroken)}.", ""]
    unavailable = [row.name for row in series.unavailable]
    if unavailable and not names:
        lines += [f"These rows cannot be computed and have no criterion: {', '.join(unavailable)}.", ""]
    text = "\n".join(lines)
    print(text)
    if arguments.out:
        with open(arguments.out, "w", encoding="utf-8") as file:
            file.write(text)
    if failed:
        sys.exit(f"no difference found: {', '.join(failed)}")


if __name__ == "__main__":
    main()

"""Test every criterion of a published experiment by runs with a planted (deliberate) fault.

    python tools/validation/break_experiments.py NAME [--only "ROW,ROW"] [--jobs 2] [--out FILE]

NAME is a document, such as zhu1994. A row that does not say `differs` has a criterion that cannot
fail in the way that it should: exit status 1.
"""

import argparse
import sys

from hydrotele.experiments.comparison import Series, run_with_faults
from tools.studies.experiment_seeds import import_series, report_progress

_PAGES = {"abdellatif2008": "parallel_robot"}  # page of the comparison, if its name differs
_DOCUMENTS = {
    "abdellatif2008": "Abdellatif 2008", "khoshzaban1992": "Khoshzaban 1992", "wang2012": "Wang 2012",
    "zhu1994": "Zhu 1994",
}  # fmt: skip


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

    failed = [claim.name for claim, row in judged if row.verdict != "differs"]
    lines = format_introduction(arguments.name, len(judged), len(failed))
    for claim, row in judged:
        cells = (claim.name, claim.fault_description, row.format_simulated_cell(),
                 row.format_criterion_cell(only_ranges=True), row.verdict)  # fmt: skip
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    lines += ["", *([] if names else list_rows_without_fault(series))]
    text = "\n".join(lines)
    print(text)
    if arguments.out:
        with open(arguments.out, "w", encoding="utf-8") as file:
            file.write(text)
    if failed:
        sys.exit(f"no difference found: {', '.join(failed)}")


def format_introduction(name: str, count: int, failures: int) -> list[str]:
    """Return the lines of the page before its first row: title, result, and how to read the table.

    Args:
        name: name of the publication, such as `zhu1994`.
        count: number of rows with a fault.
        failures: number of these rows whose verdict is not `differs`.
    """
    document = _DOCUMENTS.get(name, name)
    return [
        f"# Planted faults: {document}", "",
        f"This page shows that the criteria of the [comparison with {document}]({_PAGES.get(name, name)}.md) can fail."
        " A criterion is a range of simulated values that agree with",
        "a published result. A criterion that every simulation meets proves nothing. Therefore each experiment is"
        " repeated with a planted fault: one deliberate error in",
        "the simulation, such as a wrong length. The verdict of the row must then be *differs*.", "",
        f"Result: {count - failures} of {count} rows say *differs*{'' if failures else ', as required'}. Command:"
        f" `python tools/validation/break_experiments.py {name}`.", "",
        "How to read the table:", "",
        "- Row: name of the row in the comparison, which states the published result and explains the symbols.",
        "- Fault: what is changed in the simulation, for this row only.",
        "- Simulated with the fault: the quantities that the criterion needs. Brackets `[a, b]` are 95 % intervals over"
        " up to six repetitions with different random numbers;",
        "  parentheses `(a to b)` are the smallest and largest value of the repetitions. Text after \"In addition\""
        " does not affect the verdict.",
        "- Range that agrees: accepted values of each quantity; the comparison gives the reasons. \"Outside\" lists the"
        " quantities whose intervals are completely outside their",
        "  range; \"partly outside\" those whose intervals are partly inside and partly outside.",
        "- Verdict: *differs* if at least one quantity is outside, or is not a finite number (`inf`, `nan`).",
        "- A row may differ in the comparison, too. Its fault then shows only that the fault does not make it agree.",
        "- Names of quantities are those of the comparison, where there is no fault. A name may therefore contradict"
        " the fault; what was simulated is what the column \"fault\" says.",
        "- `inf`: an event that does not occur, no limit, or different numbers of parameters. `nan`: the quantity does"
        " not exist in a repetition, or has no definition, because",
        "  the repetitions have no scatter.",
        "- \"Distance\" is the published value minus the mean of the repetitions, over their standard deviation.",
        "- Very large numbers, such as a distance of 1e+14 standard deviations, have no physical meaning: the fault"
        " makes the scatter or denominator almost zero, or an",
        "  estimate diverges. Only the verdict counts.", "",
        "| row | fault | simulated with the fault | range that agrees | verdict |", "| --- | --- | --- | --- | --- |",
    ]  # fmt: skip


def list_rows_without_fault(series: Series) -> list[str]:
    """Return lines that list the rows of a publication that have no planted fault, by reason."""
    claims = series.claims
    groups = {
        "No fault was planted for these rows, which check inputs of the model":
            [name for name, claim in claims.items() if claim.fault is None and claim.kind != "caption"],
        "These rows have no criterion, because only a caption of the result is available":
            [name for name, claim in claims.items() if claim.kind == "caption"],
        "These rows have no criterion, because they cannot be computed": [row.name for row in series.unavailable],
    }  # fmt: skip
    return [line for words, names in groups.items() if names for line in (f"{words}: {'; '.join(names)}.", "")]


if __name__ == "__main__":
    main()

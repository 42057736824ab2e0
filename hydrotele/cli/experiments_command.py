"""Implement `hydrotele experiments`: repeat the experiments of a publication in simulation.

Each published result is compared with the simulated one. The comparison is written as a Markdown
table, as JSON and as an HTML report with figures.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path

import hydrotele
from hydrotele.cli.console import (
    print_result,
    show_stages,
    stderr_console,
    stdout_console,
    write_json,
)
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.experiments.comparison import Comparison, Series, run_series, summarize_verdicts

PUBLICATIONS = ("abdellatif2008", "khoshzaban1992", "wang2012", "zhu1994")
"""Names of the publications: modules of `hydrotele.experiments` that define `SERIES`."""

_COLOURS = {"agrees": "green", "differs": "red", "undecided": "yellow"}


def load_experiment_series(name: str) -> Series:
    """Import and return the experiments and claims of a publication by its name, such as `zhu1994`.

    Raises:
        InputError: there is no publication of this name.
    """
    if name not in PUBLICATIONS:
        raise InputError(f"experiments {name!r}", f"valid: {', '.join(PUBLICATIONS)}")
    return importlib.import_module(f"hydrotele.experiments.{name}").SERIES


def experiments_to_folder(
    name: str, target: Path | None, seeds: int | None, jobs: int | None, as_json: bool
) -> list[Comparison]:
    """Repeat the experiments of a publication in simulation; write a table, a report and figures.

    The output folder is written completely or not at all.

    Args:
        name: name of the publication, one of `PUBLICATIONS`.
        target: output folder, default `runs/<name>`, or none with `as_json`.
        seeds: number of repetitions (operators or trials), default that of the publication.
        jobs: number of processes, default one per core.
        as_json: print the comparisons as JSON instead of text.

    Returns:
        The comparisons, one per published result.

    Raises:
        InputError: there is no publication of this name, or the target is not usable.
    """
    series = load_experiment_series(name)
    seeds = seeds or series.repetitions
    target = target or (None if as_json else Path("runs") / name)
    if target:
        check_output_folder(target, "experiments")
    with show_stages(f"experiments {name}", as_json) as progress:
        rows = run_series(series, seeds, jobs, progress)
    if target:
        with atomic_folder(target, "experiments") as folder:
            write_comparison_files(folder, series, seeds, rows)
    print_result([row.row() for row in rows], as_json, lambda: _print(rows), target)
    return rows


def write_comparison_files(folder: Path, series: Series, seeds: int, rows: list[Comparison]) -> None:
    """Write table, report, figures and `experiments.json` of a publication into a folder."""
    from hydrotele.show.experiment_report import write_experiment_report

    stderr_console.print("writing report.html and figures ...", style="dim")
    write_json(folder / "experiments.json", [row.row() for row in rows])
    write_experiment_report(series.title, rows, series.items_without_result, folder)
    text = f"`hydrotele experiments {series.name} --seeds {seeds}`: {summarize_verdicts(rows)}.\n\n"
    text += format_markdown(rows, series)
    (folder / "table.md").write_text(f"# Experiments of {series.title}\n\n{text}", "utf-8")
    summary = {"kind": "experiments", "name": series.name, "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def format_markdown(rows: Sequence[Comparison], series: Series) -> str:
    """Format the comparisons as Markdown: results, model inputs, and items without a result."""
    lines = _table([row for row in rows if row.kind != "input"])
    inputs = [row for row in rows if row.kind == "input"]
    if inputs:
        lines += ["", "## Published values used as inputs of the model", "",
                  "The model was built from these values. The rows check that it contains them; they are not counted.",
                  "", *_table(inputs)]  # fmt: skip
    if series.items_without_result:
        lines += ["", "## Tables and figures without a result", ""]
        lines += [f"- {item}: {content}" for item, content in series.items_without_result.items()]
    return "\n".join(lines) + "\n"


def _table(rows: Sequence[Comparison]) -> list[str]:
    lines = [
        "| result (place in the document) | published | simulated [95 % interval] | verdict"
        " | range that agrees (its source); explanation |",
        "| --- | --- | --- | --- | --- |",
    ]
    marks = {"additional": "; not in the publication", "caption": "; caption only"}
    for row in rows:
        cells = (f"{row.name} ({row.item}{marks.get(row.kind, '')})", row.published,
                 row.format_simulated_cell(), row.verdict, row.format_criterion_cell())  # fmt: skip
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    return lines


def _print(rows: Sequence[Comparison]) -> None:
    for row in rows:
        colour = _COLOURS.get(row.verdict, "dim")
        stdout_console.print(f"[{colour}]{row.verdict}[/] [bold]{row.name}[/] ({row.item})")
        for label, text in (
            ("stated here" if row.kind == "additional" else "published", row.published),
            ("simulated", row.simulated), ("agrees if", row.criterion),
            ("reason", row.explanation),
        ):  # fmt: skip
            if text:
                stdout_console.print(f"  {label}: {text}", markup=False)
    stdout_console.print(summarize_verdicts(rows)[:1].upper() + summarize_verdicts(rows)[1:])

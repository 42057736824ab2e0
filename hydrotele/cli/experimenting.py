"""`hydrotele experiments`: published experiments repeated, beside what was published."""

from pathlib import Path

import hydrotele
from hydrotele.cli.console import notes, out, print_result, stages, write_json
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.experiments.abdellatif2008 import abdellatif2008
from hydrotele.experiments.finding import Finding, tally
from hydrotele.experiments.khoshzaban1992 import khoshzaban1992
from hydrotele.experiments.wang2012 import wang2012
from hydrotele.experiments.zhu1994 import zhu1994

SERIES = {
    "abdellatif2008": (abdellatif2008, 100),
    "khoshzaban1992": (khoshzaban1992, 20),
    "wang2012": (wang2012, 20),
    "zhu1994": (zhu1994, 20),
}
"""Name -> (function, usual number of repetitions)."""


def experiments_to_folder(
    name: str, target: Path | None, seeds: int | None, jobs: int | None, as_json: bool
) -> list[Finding]:
    """Run a series of experiments; write the table and the curves, whole or not at all.

    Args:
        name: of the series.
        target: folder, default `runs/<name>`; with `as_json` none.
        seeds: operators or trials of repeated experiments; as many as usual by default.
        jobs: processes; as many as there are cores by default.
        as_json: print the findings as JSON instead of words.

    Returns:
        The findings.

    Raises:
        InputError: no such series, or the target is not usable.
    """
    if name not in SERIES:
        raise InputError(f"experiments {name!r}", f"valid: {', '.join(SERIES)}")
    series, usual = SERIES[name]
    seeds = seeds or usual
    target = target or (None if as_json else Path("runs") / name)
    if target:
        check_target(target, "experiments")
    with stages(f"experiments {name}", as_json) as progress:
        findings = series(seeds, jobs, progress)
    if target:
        with whole_folder(target, "experiments") as folder:
            _write(folder, name, seeds, findings)
    print_result([finding.row() for finding in findings], as_json, lambda: _print(findings), target)
    return findings


def _write(folder: Path, name: str, seeds: int, findings: list[Finding]) -> None:
    from hydrotele.show.experiment_report import write_experiment_report

    notes.print("writing report.html ...", style="dim")
    rows = [finding.row() for finding in findings]
    write_json(folder / "experiments.json", rows)
    write_experiment_report(name, findings, folder / "report.html")
    head = f"# Experiments of {name}\n\n`hydrotele experiments {name} --seeds {seeds}`\n\n"
    (folder / "table.md").write_text(head + markdown_table(findings), encoding="utf-8")
    summary = {"kind": "experiments", "name": name, "hydrotele": hydrotele.__version__}
    write_json(folder / "summary.json", summary)


def markdown_table(findings: list[Finding]) -> str:
    """The findings as a Markdown table, with whose statement each is where that is told."""
    if any(one.basis for one in findings):
        return _long_table(findings)
    lines = ["| experiment | published | simulated | same |", "| --- | --- | --- | --- |"]
    for one in findings:
        name = f"{one.name} ({one.source})"
        lines.append(f"| {name} | {one.published} | {one.simulated} | {_word(one)} |")
    return "\n".join(lines) + "\n"


def _long_table(findings: list[Finding]) -> str:
    lines = [
        "| experiment | where | whose | stated | simulated | same | explanation |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in findings:
        stated = f'"{one.published}"' if one.basis == "document" else one.published
        cells = (one.name, one.source, one.basis, stated, one.simulated, _word(one),
                 one.explanation)  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _word(finding: Finding) -> str:
    return "yes" if finding.ok else "no"


def _print(findings: list[Finding]) -> None:
    for one in findings:
        mark = "[green]same[/]" if one.ok else "[red]differs[/]"
        out.print(f"{mark} [bold]{one.name}[/] ({one.source})")
        out.print(
            f"  {'ours' if one.basis == 'ours' else 'published'}: {one.published}", markup=False
        )
        out.print(f"  simulated: {one.simulated}", markup=False)
        if one.explanation:
            out.print(f"  explanation: {one.explanation}", markup=False)
    out.print(tally(findings))

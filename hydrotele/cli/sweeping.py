"""`hydrotele sweep`: a sweep file into a folder with a table and a report."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import typer

from hydrotele.cli.console import notes, out, print_json, table
from hydrotele.cli.running import write_run
from hydrotele.run.sweep import Progress, SweepResult, SweepSettings, run_sweep
from hydrotele.run.sweep_facts import SweepFile, load_sweep
from hydrotele.run.sweep_runs import JOURNAL, Entry, finished
from hydrotele.run.sweep_table import default_figures, spread_statistics
from hydrotele.show.sweep_report import Study, write_sweep_report

_ALL_FAILED = 3
_LISTED = 10


class SweepOptions(NamedTuple):
    """What the command line asks for, beside the file and the folder."""

    jobs: int | None
    dask: str | None
    fresh: bool
    retry_failed: bool
    strict: bool
    json: bool


def sweep_to_folder(name: str, target: Path | None, wishes: SweepOptions) -> None:
    """Do a sweep and say what came out.

    Args:
        name: sweep file, or name of a shipped sweep.
        target: folder, default `runs/<name>`.
        wishes: the rest of the command line.

    Raises:
        InputError: the file, a point of it, the folder or the cluster cannot be used.
        typer.Exit: interrupted (130), or runs failed (3) where that counts.
    """
    file = load_sweep(name)
    target = target or Path("runs", file.name)
    how = SweepSettings(wishes.jobs, wishes.dask, wishes.fresh, wishes.retry_failed, write_run)
    try:
        with _bar(file.name, wishes.json) as progress:
            swept = run_sweep(file, target, how, progress)
    except (KeyboardInterrupt, SystemExit) as stop:
        done = finished(target / JOURNAL)
        said = f"{done} of {file.sweep.runs} runs are done and kept in {target}"
        notes.print(f"stopped: {said}; the same command goes on", markup=False, soft_wrap=True)
        code = stop.code if isinstance(stop, SystemExit) else 130
        raise typer.Exit(code if isinstance(code, int) else 1) from None
    figures = list(file.sweep.figures) or default_figures(swept.table)
    study = _study(file, swept, figures)
    if not wishes.json:
        notes.print("writing report.html ...", style="dim")
    write_sweep_report(study, target)
    _say(file, target, swept, figures, wishes.json)
    failed = len(swept.failed)
    if failed and (wishes.strict or failed == file.sweep.runs):
        raise typer.Exit(_ALL_FAILED)


def _study(file: SweepFile, swept: SweepResult, figures: list[str]) -> Study:
    """What the report shows."""
    sampled = tuple(file.sweep.sample.keys) if file.sweep.sample else ()
    logarithmic = [k for k in sampled if file.sweep.sample.keys[k].log_uniform]  # pyright: ignore - it has one
    return Study(
        file.name, file.sweep.description, file.sweep.scenario, swept.table.columns,
        swept.table.units, tuple(file.sweep.grid), sampled, tuple(logarithmic), tuple(figures),
        [(entry.run, entry.reason) for entry in swept.failed],
    )  # fmt: skip


def _say(
    file: SweepFile, target: Path, swept: SweepResult, figures: list[str], as_json: bool
) -> None:
    found = spread_statistics(swept.table, figures)
    if as_json:
        print_json({
            "kind": "sweep", "name": file.name, "folder": str(target), "runs": file.sweep.runs,
            "done_now": swept.done, "failed": len(swept.failed),
            "failures": [{"run": e.run, "reason": e.reason, **_values(swept, e)}
                         for e in swept.failed],
            "figures": found,
        })  # fmt: skip
        return
    title = f"{file.name}: {file.sweep.runs} runs"
    shown = table(title, "", "unit", "smallest (run)", "median", "largest (run)")
    shown.columns[0].overflow = "fold"
    for name, f in found.items():
        ends = (f"{f[end]:.4g} ({f[f'{end}_run']})" for end in ("min", "max"))
        shown.add_row(name, f["unit"], next(ends), f"{f['median']:.4g}", next(ends))
    if found:
        out.print(shown)
    elif len(swept.failed) < file.sweep.runs:
        out.print("the runs do not differ in any number")
    if swept.failed:
        out.print(f"[red]{len(swept.failed)} of {file.sweep.runs} runs failed[/]")
    for entry in swept.failed[:_LISTED]:
        varied = ", ".join(f"{key} {_short(value)}" for key, value in _values(swept, entry).items())
        said = f"  run {entry.run} ({varied}): {entry.reason}"
        out.print(said, markup=False, soft_wrap=True)
    if len(swept.failed) > _LISTED:
        out.print(f"  and {len(swept.failed) - _LISTED} more, in the table's column reason")
    if not swept.done:
        out.print("nothing was left to run; --fresh does it anew")
    out.print(f"written to [bold]{target}[/]; open {target}/report.html", soft_wrap=True)


def _values(swept: SweepResult, entry: Entry) -> dict[str, Any]:
    columns = swept.table.columns
    return {key: columns[key][entry.run - 1] for key in (*swept.table.varied, "seed")}


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@contextlib.contextmanager
def _bar(name: str, quiet: bool) -> Iterator[Progress | None]:
    """A bar with the time that is left on stderr; None where nobody watches."""
    if quiet or not notes.is_terminal:
        yield None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, TextColumn("{task.fields[failed]}"), console=notes,
                  transient=True, speed_estimate_period=600.0) as bar:  # fmt: skip
        task = bar.add_task(f"check {name}", total=None, failed="")
        last = ["check"]

        def update(stage: str, done: int, total: int, failed: int) -> None:
            if stage != last[0]:  # what was done before tells nothing about the time that is left
                last[0] = stage
                bar.reset(task, total=total, completed=done)
            said = f"[red]{failed} failed[/]" if failed else ""
            bar.update(task, description=f"{stage} {name}", completed=done, total=total,
                       failed=said)  # fmt: skip

        yield update

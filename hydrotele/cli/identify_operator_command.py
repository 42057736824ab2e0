"""Implement `hydrotele identify-operator`: fit the operator model to a log of a tracking task."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hydrotele.teleop.operator_identification import OperatorFit

IDENTIFY_OPERATOR_EPILOG = """\b
Examples:  hydrotele identify-operator tracking.csv --out operator_7
           hydrotele identify-operator trial.csv --hand "stick [deg]" --target "command [deg]"

\b
The log is a CSV or Parquet file of a compensatory tracking task, in which the operator sees the
difference of target and response. Its columns are time, target, response and hand. Other names are
given with --time, --target, --response and --hand. For a stick that does not move, the force takes
the place of the hand position: a column force is used if there is no column hand, and --hand gives
a force column with another name. The log must contain at least 20 s at 10 Hz or more; narrow confidence
intervals need two minutes or more. A scenario uses the written file by
pilot: {perception: {file: operator_7/operator.yaml}}.
"""
_KIND = "operator identification"


def identify_operator(
    file: Annotated[Path, typer.Argument(help="Log of a tracking task, .csv or .parquet.")],
    time: Annotated[str | None, typer.Option(help="Name of the time column. Default: time.")] = None,
    target: Annotated[str | None, typer.Option(help="Name of the column of the target. Default: target.")] = None,
    response: Annotated[str | None, typer.Option(help="Name of the column of the response. Default: response.")] = None,
    hand: Annotated[
        str | None,
        typer.Option(
            help="Name of the column of the hand position, or of the force on a stick that does not move. Default:"
            " hand, or force if there is no column hand."
        ),
    ] = None,
    equalisation: Annotated[
        str | None,
        typer.Option(help="Form of the operator model: gain, lead, lag or integral. Default: the form that fits best."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder in which operator.yaml and fit.json are written."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Fit the operator model to a log of a tracking task: delay, margins, lag, remnant."""
    import hydrotele
    from hydrotele.cli.console import print_json, stderr_console, to_json_types, write_json
    from hydrotele.core.output import atomic_folder, check_output_folder
    from hydrotele.teleop.operator_identification import (
        format_operator_file,
        identify_operator,
        read_tracking_record,
    )

    if out:
        check_output_folder(out, _KIND)
    given = {"time": time, "target": target, "response": response, "hand": hand}
    record, said = read_tracking_record(file, {key: name for key, name in given.items() if name})
    fit = identify_operator(record, equalisation, source=str(file))
    fit = fit._replace(notes=(*said, *fit.notes))
    document = to_json_types({
        "file": file.name, "equalisation": fit.equalisation, "controlled_element": fit.element,
        "explained": fit.explained_fraction, "rate_hz": fit.rate, "duration": fit.duration,
        "estimates": {name: one._asdict() for name, one in fit.estimates.items()},
        "notes": list(fit.notes),
    })  # fmt: skip
    if out:
        text = format_operator_file(fit, "identified", file.name)
        with atomic_folder(out, _KIND) as folder:
            (folder / "operator.yaml").write_text(text, encoding="utf-8")
            write_json(folder / "fit.json", document)
            summary = {"kind": _KIND, "name": file.name, "hydrotele": hydrotele.__version__}
            write_json(folder / "summary.json", summary)
    if json:
        print_json(document)
        return
    _print(fit, file)
    for note in fit.notes:
        stderr_console.print(f"[yellow]note[/] {note}")
    if out:
        stderr_console.print(f"written to [bold]{out}[/]: operator.yaml, fit.json")


def _print(fit: "OperatorFit", file: Path) -> None:
    from hydrotele.cli.console import make_table, stdout_console

    element = f", controlled element {fit.element}" if fit.element else ""
    title = (
        f"{file.name}: {fit.duration:.0f} s at {fit.rate:.3g} Hz, equalisation {fit.equalisation}"
        f"{element}; the target explains {100 * fit.explained_fraction:.0f} % of the hand motion"
    )
    rows = make_table(title, "parameter", "estimate", "95 % interval", "unit", "")
    for name, one in fit.estimates.items():
        rows.add_row(
            name.replace("_", " "), f"{one.value:.4g}", f"{one.low:.4g} to {one.high:.4g}",
            one.unit, "" if one.identified else "[yellow]not identified[/]",
        )  # fmt: skip
    stdout_console.print(rows)

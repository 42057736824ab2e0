"""What `hydrotele compare` takes on the command line."""

from pathlib import Path
from typing import Annotated

import typer

EPILOG = """\b
Examples:  hydrotele compare cat215 gap_site_a --data measured/site_a
           hydrotele compare ec20 --data long.parquet --baseline table --baseline mlp --out compared
           hydrotele compare cat215 --data logs --heldout run_7 --horizons 2,20 --json

\b
Every model is started at many rows of a run that it was not fitted to, from its estimate of the
state there, runs freely on the commands, and is compared with the readings on its way. Beside that
stands its error from one row to the next. Horizons longer than a run are left out.

\b
Black boxes, fitted on the other runs (--baseline, may be repeated):
  table   delay and static table from command to speed, per axis
  arx     linear model of readings and past commands
  mlp     neural network of the same; needs pip install 'hydrotele[baselines]'
"""


def compare(
    machine: Annotated[
        list[str],
        typer.Argument(
            help="Shipped machines, folders with machine.yaml, folders of gap or identify."
        ),
    ],
    data: Annotated[
        list[Path], typer.Option("--data", "-d", help="Folder of logs, log file or run folder.")
    ],
    tool: Annotated[str | None, typer.Option("--tool", help="Tool of the machines.")] = None,
    heldout: Annotated[
        str | None, typer.Option(help="Run to judge on, not fitted; default test*, or the last.")
    ] = None,
    sensors: Annotated[str | None, typer.Option(help="Sensors of the machines.")] = None,
    horizons: Annotated[
        str, typer.Option(help="Seconds of the free runs; the run's end always counts.")
    ] = "1,5,10,30",
    baseline: Annotated[
        list[str] | None, typer.Option("--baseline", help="Black box: table, arx or mlp.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Judge on the fitted runs, too.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for compare.json and a picture.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Accept logs that name another machine or tool.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Compare models by free runs on measured commands: RMS errors per channel and horizon."""
    from hydrotele.cli.comparing import compare_models
    from hydrotele.cli.words import numbers_of

    compare_models(
        machine, data, tool, heldout, sensors, numbers_of("--horizons", horizons), baseline or [],
        every, out, json, force,
    )  # fmt: skip

"""What `hydrotele sweep` takes on the command line."""

from pathlib import Path
from typing import Annotated

import typer

from hydrotele.cli.options import EffectFiles

EPILOG = """\b
Examples:  hydrotele sweep servo_gains   |   hydrotele sweep my_sweep.yaml --jobs 8 --out runs/a
           hydrotele sweep my_sweep.yaml --dask tcp://10.0.0.5:8786

\b
A sweep file:
  scenario: zhu_up                                  # shipped, or a file beside this one
  set: {effects: [{name: payload, location: tool, parameters: {mass: 0}}]}
  grid: {servo.position_gain: [3, 4, 5]}            # keys of run --set; every combination
  sample:                                           # each of them with every sample
    count: 20
    seed: 1
    keys: {effects.0.parameters.mass: {uniform: [0, 1500]}}   # log_uniform, normal, choice
  repeat: 2                                         # with the scenario's seed counted up
  figures: [tracking.tip_z.rms, largest_pin_opening_mm]       # to draw; default: some
  logs: false                                       # keep every run's folder

\b
Stopped by Ctrl-C or killed: the same command goes on with the missing runs. Exit status 0 also
where some runs failed (they are listed, and stand in the table with their reason); 3 where all did.
"""


def sweep(
    file: Annotated[str, typer.Argument(help="Sweep file (.yaml), or a shipped sweep.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default runs/NAME.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Processes; default one per core.")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="Scheduler of a dask cluster (address or scheduler file).")
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Throw away what an earlier sweep left in the folder.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Do failed runs again.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit with status 3 where any run failed.")
    ] = False,
    effects: EffectFiles = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Do many runs of a scenario, varied by a grid or random samples, into one table."""
    from hydrotele.cli.sweeping import Wishes, sweep_to_folder

    sweep_to_folder(file, out, Wishes(jobs, dask, fresh, retry_failed, strict, json))

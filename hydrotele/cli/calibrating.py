"""`hydrotele calibrate`: one thin function per form of calibration."""

from pathlib import Path
from typing import Annotated

import typer

from hydrotele.core.errors import InputError

app = typer.Typer(
    help="Calibrate the kinematics of a mechanism from measured poses.", no_args_is_help=True
)

Data = Annotated[Path, typer.Option("--data", "-d", help="Folder of measurements.")]
HeldOut = Annotated[
    str | None, typer.Option(help="Part of the data to judge on, not fitted; default see below.")
]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder to write; default nothing is written.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]


@app.command()
def arm(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Links of an arm from logs of the external calibrator (Khoshzaban 1992)."""
    raise InputError("calibrate arm", "is not there yet")


@app.command()
def linkage(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Cylinder linkages of an arm from joint angles and cylinder lengths."""
    raise InputError("calibrate linkage", "is not there yet")


@app.command(
    epilog="Examples:  hydrotele calibrate hybrid --data measured --out calibrated   |   "
    "hydrotele calibrate hybrid --simulate measured --poses 25 --seed 1   |   "
    "hydrotele calibrate hybrid --data measured --evolution --posterior 8000 --json"
)
def hybrid(
    data: Annotated[
        Path | None, typer.Option("--data", "-d", help="Folder with poses.csv or poses.parquet.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Nominal robot; default robot.yaml in the folder, or iwr.")
    ] = None,
    model: Annotated[str, typer.Option(help="Error model: dh, poe, or auto: the better.")] = "auto",
    parameters: Annotated[
        str, typer.Option(help="all, document (the 36 of Wang 2012), or names with commas.")
    ] = "all",
    evolution: Annotated[
        bool, typer.Option("--evolution", help="Search by differential evolution, too.")
    ] = False,
    posterior: Annotated[
        int, typer.Option(min=0, metavar="STEPS", help="Sample the posterior by MCMC, too.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers.")] = 0,
    simulate: Annotated[
        Path | None, typer.Option(help="Write a simulated measurement to this folder instead.")
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="Of the simulated measurement.")] = 25,
    heldout: Annotated[int, typer.Option(min=0, help="Further ones, to judge on.")] = 25,
    choose: Annotated[
        str, typer.Option(help="How: random, or the best of 200 by D, O1 to O5.")
    ] = "random",
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the sensors' noise.")] = 1.0,
    errors: Annotated[float, typer.Option(min=0.0, help="Factor on 1 mm and 1 mrad.")] = 1.0,
    out: Out = None,
    json: Json = False,
) -> None:
    """Serial-parallel robot from measured poses (Wang 2012)."""
    from hydrotele.cli.hybrid_calibrating import calibrate_hybrid, simulate_hybrid

    if (data is None) == (simulate is None):
        raise InputError("calibrate hybrid", "give either --data FOLDER or --simulate FOLDER")
    if simulate is not None:
        simulate_hybrid(
            simulate, robot, poses, heldout, seed, noise, errors, parameters, model, choose
        )
    elif data is not None:
        calibrate_hybrid(data, robot, model, parameters, evolution, posterior, seed, out, json)


@app.command()
def scara(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Link lengths of a SCARA from measured positions (Wang 2012, section 1.1)."""
    raise InputError("calibrate scara", "is not there yet")


@app.command()
def mukca(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Serial robot from joint angles alone, its ball held in sockets."""
    raise InputError("calibrate mukca", "is not there yet")

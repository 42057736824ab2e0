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


@app.command()
def hybrid(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Serial-parallel robot from measured poses (Wang 2012)."""
    raise InputError("calibrate hybrid", "is not there yet")


@app.command()
def scara(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Link lengths of a SCARA from measured positions (Wang 2012, section 1.1)."""
    raise InputError("calibrate scara", "is not there yet")


@app.command()
def mukca(data: Data, heldout: HeldOut = None, out: Out = None, json: Json = False) -> None:
    """Serial robot from joint angles alone, its ball held in sockets."""
    raise InputError("calibrate mukca", "is not there yet")

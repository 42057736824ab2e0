"""Implement `hydrotele linearise`: linear models of a machine at poses, as table, plot and JSON."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hydrotele.core.errors import InputError

if TYPE_CHECKING:
    from hydrotele.estimate.linear_model import LinearModel

LINEARISE_EPILOG = """\b
Examples:  hydrotele linearise cat215
           hydrotele linearise cat215 --pose boom=0,stick=-1 --pose boom=0.8,stick=-2 --plot modes.png
           hydrotele linearise cat325 --speed 0.05 --out model.json

\b
The table lists the oscillations of mechanism and oil; the file of --out also contains those of the
valves. With speed 0 an axis holds its load with a closed valve; its model has no dry friction and no
dead band. From Python: hydrotele.linearise(machine, pose, speed); docs/linear_models.md.
"""


def linearise(
    machine: Annotated[str, typer.Argument(help="Name of a shipped machine, or folder with machine.yaml.")],
    tool: Annotated[
        str | None, typer.Option("--tool", help="Name of the mounted tool, for machines with several tools.")
    ] = None,
    pose: Annotated[
        list[str] | None,
        typer.Option(
            "--pose",
            metavar="JOINT=VALUE,...",
            help="Joint positions of a pose [rad] or [m]; other joints are at their home positions. Can be"
            " given several times.",
        ),
    ] = None,
    speed: Annotated[
        str,
        typer.Option(
            metavar="VALUE or AXIS=VALUE,...", help="Velocity of all hydraulic axes, or of some [rad/s] or [m/s]."
        ),
    ] = "0",
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Plot natural frequencies, damping and gain in this PNG file.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the matrices of all poses to this JSON file.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the models as JSON, and nothing else.")] = False,
) -> None:
    """Compute linear state-space models of a machine at poses; list natural frequencies and damping."""
    linearise_machine(machine, tool, pose or [""], speed, plot, out, json)


def linearise_machine(
    name: str, tool: str | None, poses: list[str], speed: str, plot: Path | None, out: Path | None, as_json: bool
) -> None:
    """Compute linear models of a machine at poses, and print or write them.

    Args:
        name: shipped machine or folder.
        tool: tool of the machine.
        poses: `JOINT=VALUE,...` of every pose; an empty text is the home pose.
        speed: a number, or `AXIS=VALUE,...`.
        plot: PNG file, or None.
        out: JSON file, or None.
        as_json: print JSON instead of a table.

    Raises:
        InputError: as `estimate.linear_model.linearise`.
    """
    from hydrotele.cli.console import make_table, print_json, stdout_console, write_json
    from hydrotele.core.output import atomic_file
    from hydrotele.estimate.linear_model import linearise as compute_linear_model
    from hydrotele.machine.machine_file import load_machine

    machine = load_machine(name, tool)
    speeds = parse_assignments("--speed", speed) if "=" in speed else _parse_number("--speed", speed)
    models = [compute_linear_model(machine, parse_assignments("--pose", text), speeds) for text in poses]
    document = {"models": [model.to_dict() for model in models]}
    if out:
        with atomic_file(out, ".json") as path:
            write_json(path, document)
    if plot:
        from hydrotele.show.linear_model_plot import draw_modes

        with atomic_file(plot, ".png") as path:
            path.write_bytes(draw_modes(models))
    if as_json:
        print_json(document)
        return
    table = make_table(
        f"oscillations of {machine.name}, tool {machine.tool}", "pose", "axis", "natural frequency [Hz]",
        "damping ratio", "damped period [s]",
    )  # fmt: skip
    for number, model in enumerate(models, 1):
        stdout_console.print(f"pose {number}: {format_pose(model)}")
        for mode in model.oscillations:
            period = 2.0 * math.pi / mode.pole.imag
            row = mode.axis, f"{mode.frequency:.3g}", f"{mode.damping:.3f}", f"{period:.3g}"
            table.add_row(str(number), *row)
    stdout_console.print(table)
    for what in filter(None, (out, plot)):
        stdout_console.print(f"written to [bold]{what}[/]")


def format_pose(model: "LinearModel") -> str:
    """Return the pose of a linear model as text, such as `boom=0.45 stick=-1.6`; without joints at 0."""
    return " ".join(f"{name}={value:.3g}" for name, value in model.pose.items() if abs(value) > 1e-9) or "all joints 0"


def parse_assignments(option: str, text: str) -> dict[str, float]:
    """Return {name: number} from `name=number,...`; an empty text gives an empty dictionary.

    Raises:
        InputError: the text has another form, or a name occurs twice.

    >>> parse_assignments("--pose", "boom=0.45,stick=-1.6")
    {'boom': 0.45, 'stick': -1.6}
    """
    found: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, sign, value = (word.strip() for word in part.partition("="))
        if not sign or not name or name in found:
            raise InputError(f"{option} {text}", "must be NAME=VALUE,..., for example boom=0.45,stick=-1.6")
        found[name] = _parse_number(option, value)
    return found


def _parse_number(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} {text}", "is not a number") from None

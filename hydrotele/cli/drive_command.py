"""What `hydrotele drive` takes on the command line."""

from pathlib import Path
from typing import Annotated

import typer

from hydrotele.cli.options import EffectFiles

EPILOG = """\b
Examples:  hydrotele drive   |   hydrotele drive fell_tree --device gamepad
           hydrotele drive --device scripted:moves.csv --no-viewer --speed 0

\b
Keyboard: every press moves an axis on by a quarter of its way, where it stays; space centres all.
  Up, Down: out, in        Left, Right: swing      Page Up, Page Down: raise, lower
  End, Home: curl in, out  Insert, Delete: head    7, 6 and 9, 8: further axes (grab, saw) up, down
  F10, closing the window or Ctrl-C: end and write the logs

\b
Gamepad: left stick out/in and swing, right stick raise/lower and tool, shoulders head, cross pad
further axes, B all off, Start ends. SpaceMouse: push the way the tip shall go; its buttons switch
the first two further axes, both together all off.
"""


def drive(
    scenario: Annotated[
        str | None, typer.Argument(help="Teleoperated scenario; default the machine's own.")
    ] = None,
    machine: Annotated[
        str | None, typer.Option("--machine", "-m", help="Machine; default cat215.")
    ] = None,
    tool: Annotated[str | None, typer.Option("--tool", help="Tool of the machine.")] = None,
    device: Annotated[
        str, typer.Option("--device", "-d", help="keyboard, gamepad, spacemouse or scripted:FILE.")
    ] = "keyboard",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default runs/SCENARIO.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override key=value; may be repeated.")
    ] = None,
    viewer: Annotated[bool, typer.Option(help="Open MuJoCo's viewer.")] = True,
    duration: Annotated[
        float | None, typer.Option(help="Longest drive in seconds; default 600.")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Simulated per real time; 0: as fast as it goes.")
    ] = 1.0,
    review: Annotated[bool, typer.Option(help="Write the rerun recording review.rrd.")] = True,
    effects: EffectFiles = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Drive a machine yourself, in real time; write a folder as run does."""
    from hydrotele.cli.driving import Wishes, drive_to_folder
    from hydrotele.cli.words import chosen, overrides_of

    drive_to_folder(
        Wishes(
            scenario,
            overrides_of(set_ or []) | chosen(machine, tool),
            device,
            out,
            viewer,
            duration,
            speed,
            review,
            json,
        )  # fmt: skip
    )

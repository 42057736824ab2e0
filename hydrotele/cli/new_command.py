"""Implement `hydrotele new`: create a machine from a robot description."""

from pathlib import Path
from typing import Annotated

import typer

from hydrotele.cli.option_values import CommandGroup

app = CommandGroup(help="Create a machine from a robot description: URDF, xacro or MJCF.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Create a machine from a robot description: URDF, xacro or MJCF."""


@app.command(
    epilog="Example:  hydrotele new machine zx120 --from zx120_description/urdf/zx120.xacro",
)
def machine(
    name: Annotated[str, typer.Argument(help="Name of the machine, or the path of its new folder.")],
    source: Annotated[Path, typer.Option("--from", help="URDF, xacro or MJCF file.")],
    package_path: Annotated[
        list[Path] | None,
        typer.Option(
            "--package-path",
            help="Folder with ROS packages, for package:// and $(find ...). Can be given several times.",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Create machine.yaml, MJCF, meshes and a first scenario from a robot description.

    Geometry, joint limits and plausible masses come from the description, and cylinders if it models
    them. Bores, valves, pump, other cylinders and masses that are implausible there are estimates for
    machines of this size. They have the comment `# estimate` in machine.yaml, and `hydrotele validate`
    lists them.
    """
    create_machine_folder(name, source, tuple(package_path or ()), json)


def create_machine_folder(name: str, source: Path, package_paths: tuple[Path, ...], as_json: bool) -> None:
    """Create the folder of a machine and print what was assumed, and the next commands.

    Args:
        name: name or folder of the machine.
        source: URDF, xacro or MJCF file.
        package_paths: folders with ROS packages.
        as_json: print JSON instead of text.

    Raises:
        InputError: as `convert.new_machine.create_machine`.
    """
    from hydrotele.cli.console import print_json, print_notes, stdout_console
    from hydrotele.convert.new_machine import create_machine

    made = create_machine(name, source, package_paths)
    place = str(made.folder) if made.folder.is_absolute() or len(made.folder.parts) > 1 else f"./{made.folder}"
    commands = [
        f"hydrotele validate {place}",
        f"hydrotele export {place} --picture {made.folder.name}.png",
        f"hydrotele run {made.folder / 'moves.yaml'} --out runs/{made.folder.name}",
        f"hydrotele review runs/{made.folder.name}",
    ]
    axes = {joint: "cylinder" if drive.cylinder else "motor" for joint, drive in made.design.drives.items()}
    if as_json:
        print_json({"folder": str(made.folder), "files": made.files, "axes": axes, "notes": made.design.notes,
                    "next": commands})  # fmt: skip
        return
    print_notes(made.design.notes)
    listed = ", ".join(f"{joint} ({kind})" for joint, kind in axes.items())
    stdout_console.print(f"written to {made.folder}: {', '.join(made.files)}; axes {listed}", soft_wrap=True)
    stdout_console.print("next:", *(f"  {command}" for command in commands), sep="\n", soft_wrap=True)

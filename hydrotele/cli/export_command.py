"""Implement `hydrotele export`: write the MJCF or an image of a machine or joystick."""

from pathlib import Path

from hydrotele.cli.console import stderr_console
from hydrotele.cli.validate_command import is_joystick
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.mechanism import Mjcf


def export_machine(name: str, tool: str | None, target: Path | None, picture: Path | None, camera: str) -> None:
    """Write the complete MJCF of a machine or joystick, or an image of it.

    Args:
        name: shipped name, file or folder of a machine or joystick.
        tool: tool of the machine, None for its first tool.
        target: MJCF file, None for standard output, or for no MJCF if there is a picture.
        picture: PNG file to write, or None.
        camera: camera of the image.

    Raises:
        InputError: the machine is not usable, or this computer cannot render images.
    """
    if is_joystick(Path(name)):
        if tool:
            raise InputError("--tool", f"the joystick {name} has no tools")
        _export_joystick(name, target, picture, camera)
        return
    machine = load_machine(name, tool)
    if picture:
        from hydrotele.show.machine_image import render_machine

        render_machine(machine, picture, camera=camera)
        stderr_console.print(f"written to {picture}")
        if target is None:
            return
    from hydrotele.simulate.plant import build_plant

    _write(build_plant(machine).document, target)


def _export_joystick(name: str, target: Path | None, picture: Path | None, camera: str) -> None:
    import mujoco

    from hydrotele.simulate.joystick import compile_joystick, joystick_spec

    facts = load_joystick(name)
    spec = joystick_spec(facts, hand=False)
    model = compile_joystick(facts, spec)
    if picture:
        from hydrotele.show.machine_image import render_model

        render_model(model, mujoco.MjData(model), picture, camera)
        stderr_console.print(f"written to {picture}")
    if target or not picture:
        _write(Mjcf(name, spec.to_xml(), {}), target)


def _write(document: Mjcf, target: Path | None) -> None:
    from hydrotele.core.output import atomic_file

    if target:
        with atomic_file(target, ".xml") as part:
            document.save(part, target)
        stderr_console.print(f"written to {target}")
    elif document.assets:
        message = f"refers to {len(document.assets)} further files: give --out FILE.xml"
        raise InputError("the MJCF", message)
    else:
        print(document.text)

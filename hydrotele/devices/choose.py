"""A device by its name."""

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.devices.keyboard import Keyboard
from hydrotele.devices.pad import Pad, Sticks
from hydrotele.devices.reading import Device
from hydrotele.devices.script import Scripted, load_script
from hydrotele.devices.tables import LAYOUTS

SCRIPTED = "scripted:"
NAMES = ("keyboard", *LAYOUTS, f"{SCRIPTED}FILE")


def open_device(name: str, further: tuple[str, ...]) -> Device:
    """Open a device.

    Args:
        name: one of `NAMES`.
        further: axes of the machine that the joystick does not move, in its order.

    Returns:
        The device.

    Raises:
        InputError: there is no such device, it is not connected, or what it needs is not installed.
    """
    if name == "keyboard":
        return Keyboard(len(further))
    if name in LAYOUTS:
        return Pad(name, Sticks(name), len(further))
    if name.startswith(SCRIPTED):
        path = name.removeprefix(SCRIPTED)
        return Scripted(load_script(path), further, path)
    raise InputError(f"--device {name}", f"is no device; {suggest(name, NAMES)}")

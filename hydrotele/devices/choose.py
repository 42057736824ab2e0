"""A device by its name.

A device that reads what it asks for from a file: for tests, and where there is no screen.

CSV: a first line of names (`time`, any of x, y, z, rx, ry, rz, and further axes of the machine),
then a row from each time [s] on. YAML: `time`, `axes`, `commands`, and `interpolate: linear` if the
handle shall move evenly from row to row. Values are -1 .. 1 of the handle's way, or commands. The
drive ends with the last time.
"""

import bisect
import csv
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text
from hydrotele.devices.keyboard import Keyboard
from hydrotele.devices.pad import Pad, Sticks
from hydrotele.devices.reading import LAYOUTS, Device, Reading
from hydrotele.machine.joystick import AXES
from hydrotele.scenario.teleoperation import JoystickAxis

_Part = Annotated[float, Field(ge=-1, le=1)]


class Script(Facts):
    """What is asked for over time: `axes` of the handle and `commands` of further axes."""

    time: list[NonNegative]
    axes: dict[JoystickAxis, list[_Part]] = {}
    commands: dict[Name, list[_Part]] = {}
    interpolate: Literal["hold", "linear"] = "hold"

    @model_validator(mode="after")
    def _check(self):
        rising = all(a < b for a, b in zip(self.time, self.time[1:], strict=False))
        if not self.time or self.time[0] != 0.0 or not rising:
            raise ValueError("time must start at 0 and rise")
        for name, values in [*self.axes.items(), *self.commands.items()]:
            if len(values) != len(self.time):
                raise ValueError(f"{name} has {len(values)} values, time has {len(self.time)}")
        return self


class Scripted:
    """A device that follows a script."""

    def __init__(self, script: Script, further: tuple[str, ...], where: str) -> None:
        """Begin at its beginning.

        Args:
            script: what to do.
            further: axes that the joystick does not move.
            where: its file.

        Raises:
            InputError: it commands an axis that is not among them.
        """
        for name in script.commands:
            if name not in further:
                message = f"{name!r} is no axis that the joystick leaves alone"
                raise InputError(where, f"{message}; {suggest(name, further)}")
        self._script, self._further = script, further

    def read(self, time: float) -> Reading:
        """What the script asks for at a time of the run [s]."""
        script = self._script
        row = max(0, bisect.bisect_right(script.time, time + 1e-9) - 1)
        commands = [script.commands[n][row] if n in script.commands else 0.0 for n in self._further]
        axes = [self._axis(script.axes.get(name), row, time) for name in AXES]
        return Reading(tuple(axes), tuple(commands), time + 1e-9 >= script.time[-1])

    def _axis(self, values: list[float] | None, row: int, time: float) -> float:
        if values is None:
            return 0.0
        if self._script.interpolate == "linear":
            return float(np.interp(time, self._script.time, values))
        return values[row]

    def close(self) -> None:
        """Nothing is to be let go of."""


def load_script(path: str | Path) -> Script:
    """Read a script.

    Args:
        path: a CSV or YAML file.

    Returns:
        The script.

    Raises:
        InputError: names file, line and column of what is wrong.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file; give a .csv or .yaml file after scripted:")
    if path.suffix.lower() in (".yaml", ".yml"):
        data, lines = read_yaml(path)
        return parse(Script, data, str(path), lines)
    if path.suffix.lower() == ".csv":
        return _from_csv(path)
    raise InputError(path, "must be a .csv or a .yaml file")


def _from_csv(path: Path) -> Script:
    try:
        rows = list(csv.reader(read_text(path).splitlines()))
    except csv.Error as error:
        raise InputError(path, f"cannot be read: {error}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    if "time" not in names:
        raise InputError(f"{path}, line 1", f"has no column 'time'; valid: time, {', '.join(AXES)}")
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{path}, line 1", f"names {', '.join(sorted(twice))} twice")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(names):
            raise InputError(f"{path}, line {line}", f"has {len(row)} cells, not {len(names)}")
        for name, cell in zip(names, row, strict=True):
            columns[name].append(_number(cell, f"{path}, line {line}, column {name!r}", name))
        _check_time(columns["time"], f"{path}, line {line}, column 'time'")
    data = {
        "time": columns.pop("time"),
        "axes": {name: v for name, v in columns.items() if name in AXES},
        "commands": {name: v for name, v in columns.items() if name not in AXES},
    }
    return parse(Script, data, str(path), {})


def _number(cell: str, where: str, name: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise InputError(where, f"{cell.strip()!r} is not a number") from None
    if name != "time" and not -1.0 <= value <= 1.0:
        raise InputError(where, f"{value:g} is not between -1 and 1")
    return value


def _check_time(time: list[float], where: str) -> None:
    if len(time) == 1 and time[0] != 0.0:
        raise InputError(where, f"time must start at 0, not at {time[0]:g}")
    if len(time) > 1 and not time[-1] > time[-2]:
        raise InputError(where, f"time must rise: {time[-1]:g} comes after {time[-2]:g}")


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

"""The journal of a sweep: a line for every finished run, on disk before the next one counts.

A process that is killed leaves at most half a line at the end, which the next start drops; that run
is done again.

The numbers of a run: those of its summary, flattened, with their units.
"""

import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import json_value
from hydrotele.core.output import replacing
from hydrotele.core.units import KEY_SUFFIXES

Number = float | int | bool | None
Numbers = dict[str, tuple[Number, str]]

TIMINGS = ("wall_seconds", "realtime_factor")  # differ between runs of equal content
_LEFT_OUT = (*TIMINGS, "kind", "seed", "versions", "git_commit")
_ENDINGS = {"mm": "mm", "N": "N", "J": "J", "m": "m", "rad": "rad", "A": "A", "seconds": "s"}
_SCENARIO = {
    "duration": "s", "timestep": "s", "control_rate": "Hz", "log_rate": "Hz",
    "servo.position_gain": "1/s", "servo.lead": "s", "servo.load_time": "s",
    "servo.pressure_feedback": "1/s", "pilot.acceleration": "m/s2", "pilot.settle": "s",
    "pilot.channel.delay_forward": "s", "pilot.channel.delay_back": "s",
}  # fmt: skip

_EVERY = (
    "simulated_seconds", "physics_steps", "largest_pin_opening_mm", "largest_contact_force_N",
    "balance.seconds", "balance.flow_balance", "balance.energy_balance",
)  # fmt: skip
_STATION = (
    "handle_energy_J", "handle_least_energy_J", "largest_handle_displacement_m",
    "largest_handle_rotation_rad", "largest_coil_current_A", "periods_with_limited_currents",
    "largest_tip_force_N", "tripped",
)  # fmt: skip
_TIP = ("tip_r", "tip_z", "tip_attitude")


def numbers_of(summary: dict[str, Any]) -> Numbers:
    """Dotted name -> (number, unit) of a run's summary, but for timings and versions.

    >>> numbers_of({"scenario": "a", "tracking": {"boom": {"rms": 0.1, "unit": "rad"}}})
    {'tracking.boom.rms': (0.1, 'rad')}
    """
    kept = {key: value for key, value in summary.items() if key not in _LEFT_OUT}
    return dict(_flat(kept, "", None))


def _flat(part: dict[str, Any], above: str, unit: str | None):
    unit = part.get("unit", unit)
    for key, value in part.items():
        name = f"{above}{key}"
        value = value.item() if isinstance(value, np.generic) else value  # as the journal has it
        if isinstance(value, dict):
            yield from _flat(value, f"{name}.", unit)
        elif value is None or isinstance(value, (bool, int, float)):
            finite = value if value is None or math.isfinite(value) else None
            yield name, (finite, unit or _ENDINGS.get(key.rpartition("_")[2], "1"))


def key_unit(key: str) -> str | None:
    """Unit of a scenario's key as far as its name tells."""
    found = (unit for suffix, unit in KEY_SUFFIXES.items() if key.endswith(suffix))
    return next(found, None) or _SCENARIO.get(key)


def possible_results(axes: Iterable[str], teleoperated: bool) -> list[str]:
    """Names of all numbers that runs of machines with these axes can have."""
    tracked = [f"tracking.{name}.{size}" for name in (*axes, *_TIP) for size in ("rms", "max")]
    station = [f"teleoperation.{name}" for name in _STATION] if teleoperated else []
    return [*_EVERY, *tracked, *station]


def check_figures(figures: Iterable[str], possible: list[str], where: str) -> None:
    """Refuse figures that no run can have.

    Raises:
        InputError: the first one, with the valid names.
    """
    for name in figures:
        if name not in possible:
            raise InputError(where, f"{name!r} is no number of a run; {suggest(name, possible)}")


OK, FAILED = "ok", "failed"
JOURNAL = "journal.jsonl"


class Entry(NamedTuple):
    """What is kept of a run.

    Attributes:
        run: its number.
        status: OK or FAILED.
        reason: why it failed, else empty.
        numbers: of its summary.
        notes: of its summary, joined.
        wall_seconds: that its loop took [s], None where it failed.
    """

    run: int
    status: str
    reason: str = ""
    numbers: Numbers = {}
    notes: str = ""
    wall_seconds: float | None = None


def finished(path: Path) -> int:
    """Number of runs that a journal holds."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    return len({line.partition(b",")[0] for line in lines})


class Journal:
    """The open journal of a sweep; one process has it at a time."""

    def __init__(self, path: Path) -> None:
        """Read what is there, drop what is broken and open the file to append.

        Raises:
            InputError: it cannot be read or written.
        """
        self.path, self.entries = path, {}
        try:
            content = path.read_bytes() if path.exists() else b""
            lines = content.split(b"\n")
            good = [line for line in lines[:-1] if self._take(line)]
            if b"".join(line + b"\n" for line in good) != content:
                with replacing(path, ".jsonl") as part:
                    part.write_bytes(b"".join(line + b"\n" for line in good))
            self._file = open(path, "ab")
        except OSError as error:
            raise InputError(path, f"cannot be used: {error.strerror}") from None

    def _take(self, line: bytes) -> bool:
        try:
            entry = Entry(**json_value(line))
            numbers = {name: (value, unit) for name, (value, unit) in entry.numbers.items()}
        except (ValueError, TypeError, AttributeError):
            return False
        self.entries[entry.run] = entry._replace(numbers=numbers)
        return True

    def add(self, entry: Entry) -> None:
        """Write the entry of a run; it is on disk when this returns.

        Raises:
            InputError: the disk is full or the folder gone.
        """
        text = json.dumps(entry._asdict(), allow_nan=False, ensure_ascii=False)
        try:
            self._file.write(text.encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise InputError(self.path, f"cannot be written: {error.strerror}") from None
        self.entries[entry.run] = entry

    def close(self) -> None:
        """Close the file; all entries are on disk."""
        self._file.close()

"""Joint angles recorded while the ball at a robot's end sat in sockets: folders of CSV files.

`PLACE/hole_0.csv`, `PLACE/hole_1.csv`, ...: one folder per place of the tool that holds the
sockets, one file per socket, one row per posture, one column per joint, without or with a head
line. Files of the folder itself are one place.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text

_FILE = re.compile(r"hole_?(\d+)\.(csv|txt)", re.IGNORECASE)
_SEPARATOR = re.compile(r"[,;\t ]\s*|\s+")
_SAME = 1e-6  # rad or m: a posture that is recorded twice
_FEWEST = 3  # postures that have a mean and a spread


@dataclass(frozen=True)
class Socket:
    """Postures with the ball in one socket.

    Attributes:
        place: name of the tool's place.
        hole: number of the socket.
        path: of the file.
        joints: (n, k) joint angles [rad], or positions [m].
        lines: (n,) where the rows stand in the file, from 1.
    """

    place: str
    hole: int
    path: Path
    joints: np.ndarray
    lines: np.ndarray

    @property
    def name(self) -> str:
        """`PLACE/hole_0`."""
        return f"{self.place}/hole_{self.hole}"


def load_sockets(folder: str | Path, degrees: bool = False) -> tuple[tuple[Socket, ...], list[str]]:
    """Read all sockets of a folder.

    Args:
        folder: with places or files.
        degrees: whether the angles are in degrees; they are converted.

    Returns:
        The sockets, by place and number, and notes on what was left out.

    Raises:
        InputError: names file, row and column of what is not usable.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "is no folder")
    paths = sorted(p for p in (*folder.glob("*"), *folder.glob("*/*")) if _FILE.fullmatch(p.name))
    if not paths:
        inside = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
        raise InputError(
            folder, f"holds no PLACE/hole_0.csv, PLACE/hole_1.csv, ... (it holds {inside})"
        )
    sockets, notes = [], []
    for path in paths:
        found = _FILE.fullmatch(path.name)
        assert found is not None
        place = path.parent.resolve().name
        joints, lines = _read(path)
        if degrees:
            joints = np.radians(joints)
        sockets.append(_distinct(Socket(place, int(found[1]), path, joints, lines), notes))
    columns = {s.path: s.joints.shape[1] for s in sockets}
    usual = max(set(columns.values()), key=list(columns.values()).count)
    for path, count in columns.items():
        if count != usual:
            raise InputError(
                path, f"has {count} columns, the other files have {usual}: one per joint"
            )
    return tuple(sockets), notes


def places_of(sockets: Sequence[Socket]) -> tuple[str, ...]:
    """Names of the places, in order."""
    return tuple(dict.fromkeys(socket.place for socket in sockets))


def idle_joints(sockets: Sequence[Socket]) -> list[int]:
    """Columns that have one value in all files: joints that never move."""
    joints = np.vstack([socket.joints for socket in sockets])
    return [int(k) for k in np.flatnonzero(np.ptp(joints, axis=0) < _SAME)]


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(n, k) numbers and the (n,) lines on which they stand."""
    rows, lines = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        line = line.strip().lstrip("\ufeff")
        if not line or line.startswith("#"):
            continue
        words = _SEPARATOR.split(line)
        values = [_number(word) for word in words]
        if not rows and all(value is None for value in values):
            continue  # names of the columns
        for column, (word, value) in enumerate(zip(words, values, strict=True), start=1):
            if value is None or not math.isfinite(value):
                raise InputError(
                    f"{path}: row {number}, column {column}", f"{word!r} is no finite number"
                )
        if rows and len(values) != len(rows[0]):
            raise InputError(
                f"{path}: row {number}", f"has {len(values)} columns, rows before {len(rows[0])}"
            )
        rows.append(values)
        lines.append(number)
    if len(rows) < _FEWEST:
        raise InputError(
            path, f"has {len(rows)} rows; record {_FEWEST} different postures at least, better 20"
        )
    return np.array(rows, float), np.array(lines)


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _distinct(socket: Socket, notes: list[str]) -> Socket:
    """A socket without postures that are there already."""
    kept: list[int] = []
    for row in range(len(socket.joints)):
        away = np.abs(socket.joints[kept] - socket.joints[row]).max(axis=1)
        if not (away < _SAME).any():
            kept.append(row)
    if len(kept) < _FEWEST:
        raise InputError(
            socket.path,
            f"repeats one posture: {len(socket.joints)} rows hold {len(kept)} different ones;"
            f" record {_FEWEST} at least, better 20",
        )
    if len(kept) < len(socket.joints):
        gone = sorted(set(range(len(socket.joints))) - set(kept))
        rows = ", ".join(str(socket.lines[row]) for row in gone[:8])
        more = " ..." if len(gone) > 8 else ""
        notes.append(f"{socket.path}: rows {rows}{more} repeat earlier ones and are left out")
    return replace(socket, joints=socket.joints[kept], lines=socket.lines[kept])

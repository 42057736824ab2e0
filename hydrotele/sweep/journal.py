"""The journal of a sweep: a line for every finished run, on disk before the next one counts.

A process that is killed leaves at most half a line at the end, which the next start drops; that run
is done again.
"""

import json
import os
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.files import json_value
from hydrotele.core.output import replacing
from hydrotele.sweep.numbers import Numbers

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

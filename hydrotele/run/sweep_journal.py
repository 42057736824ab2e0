"""Journal of the finished runs of a sweep, one line per run, written to disk before the next run is counted.

A killed process leaves at most one incomplete last line; the next start removes it and repeats that
run.
"""

import json
import os
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError
from hydrotele.core.files import parse_json
from hydrotele.core.output import atomic_file

Number = float | int | bool | None
Numbers = dict[str, tuple[Number, str]]

OK, FAILED = "ok", "failed"
JOURNAL = "journal.jsonl"


class JournalEntry(NamedTuple):
    """Journal entry of a finished run.

    Attributes:
        run: run number.
        status: OK or FAILED.
        reason: reason of a failure, otherwise empty.
        numbers: name -> (value, unit) of the numbers in the run's summary.
        notes: notes of the run's summary, joined by semicolons.
        wall_seconds: computing time of the tick loop [s], None if the run failed.
    """

    run: int
    status: str
    reason: str = ""
    numbers: Numbers = {}
    notes: str = ""
    wall_seconds: float | None = None


def count_finished_runs(path: Path) -> int:
    """Return the number of distinct runs in the journal file of a sweep, failed ones included; 0 without a file."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    return len({line.partition(b",")[0] for line in lines})


class Journal:
    """The open file with one line per finished run of a sweep; only one process may open it at a time.

    Attributes:
        path: the file.
        entries: run number -> entry.
    """

    def __init__(self, path: Path) -> None:
        """Read the entries, remove invalid or incomplete lines from the file, and open it for appending.

        Raises:
            InputError: the file cannot be read or written.
        """
        self.path, self.entries = path, {}
        try:
            content = path.read_bytes() if path.exists() else b""
            lines = content.split(b"\n")
            good = [line for line in lines[:-1] if self._parse_line(line)]
            if b"".join(line + b"\n" for line in good) != content:
                with atomic_file(path, ".jsonl") as part:
                    part.write_bytes(b"".join(line + b"\n" for line in good))
            self._file = open(path, "ab")
        except OSError as error:
            raise InputError(path, f"cannot be used: {error.strerror}") from None

    def _parse_line(self, line: bytes) -> bool:
        try:
            entry = JournalEntry(**parse_json(line))
            numbers = {name: (value, unit) for name, (value, unit) in entry.numbers.items()}
        except (ValueError, TypeError, AttributeError):
            return False
        self.entries[entry.run] = entry._replace(numbers=numbers)
        return True

    def add(self, entry: JournalEntry) -> None:
        """Append the entry of a run to the file, force it to disk, and add it to `entries`.

        Raises:
            InputError: the entry cannot be written, for example because the disk is full.
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
        """Close the file; `add` has already written all entries to disk."""
        self._file.close()

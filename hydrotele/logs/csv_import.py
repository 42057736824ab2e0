"""CSV from a data logger or a spreadsheet, as a table; the checks scale its units to SI."""

import io
import math
import re
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import open_regular
from hydrotele.core.limits import check_limit, limit
from hydrotele.logs.log_checks import Table, place

_LONGEST = 1_000_000  # letters of a line
_HEADER = re.compile(r"(?P<name>.*?)\s*(\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)


def read_csv(path: Path, missing: bool = False) -> Table:
    """Read a CSV log: a header of `name` or `name [unit]`, then one line of numbers per row.

    The separator is a comma, a semicolon or a tab, whichever the header has most of; decimals have
    a point. Lines that start with `#` are comments, of which `# key: value` becomes metadata. A
    known unit is scaled to SI by `checked`.

    Args:
        path: the file.
        missing: read empty cells as NaN instead of refusing them.

    Raises:
        InputError: not readable as UTF-8 text, empty, no header, a row of the wrong width, or a
            cell that is not a number.
    """
    read = _Reading(str(path), missing)
    with open_regular(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8-sig")  # line by line: a log may be large
        try:
            for number, line in enumerate(iter(lambda: text.readline(_LONGEST), ""), 1):
                read.take(number, line)
        except UnicodeDecodeError as error:
            reason = f"is not text in UTF-8 ({error.reason}): save it as CSV UTF-8"
            raise InputError(path, reason) from error
    if not read.names:
        raise InputError(path, "is empty: write a header of channel names, then one line per row")
    values = np.frombuffer(read.values, dtype=np.float64).reshape(-1, len(read.names))
    lines = np.array(read.lines, dtype=np.int64)
    columns = [np.ascontiguousarray(column) for column in values.T]
    return Table(read.source, read.names, columns, read.units, read.metadata, lines)


class _Reading:
    """What the lines of a file have brought so far."""

    def __init__(self, source: str, missing: bool) -> None:
        self.source, self.missing, self.most = source, missing, limit("LOG_VALUES")
        self.names: list[str] = []
        self.units: list[str | None] = []
        self.metadata: dict[str, str] = {}
        self.separator = ","
        self.values, self.lines = array("d"), array("q")

    def take(self, number: int, line: str) -> None:
        """Take the next line of the file, with its end."""
        if len(line) == _LONGEST:
            raise InputError(f"{self.source}, line {number}", f"is longer than {_LONGEST} letters")
        line = line.rstrip("\n")
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                self.metadata[key.strip()] = value.strip()
        elif not line.strip():
            return
        elif not self.names:
            self._take_header(line)
        else:
            row = len(self.lines)
            self.lines.append(number)
            self.values.extend(_parse_row(
                self.source, self.names, (row, line), self.separator, self.lines, self.missing,
            ))  # fmt: skip
            if len(self.values) > self.most:
                check_limit(self.source, "LOG_VALUES", len(self.values))

    def _take_header(self, line: str) -> None:
        self.separator = max(",;\t", key=line.count)
        self.names, self.units = _parse_header(line, self.separator)
        if any(map(_is_number, self.names)):
            remedy = "write a header of channel names above the numbers, such as"
            message = f"the first line {line[:40]!r} holds numbers, not names: {remedy}"
            raise InputError(self.source, f"{message} time,angle.boom [deg]")


def _parse_header(header: str, separator: str) -> tuple[list[str], list[str | None]]:
    names, units = [], []
    for cell in header.split(separator):
        match = _HEADER.fullmatch(cell.strip().strip('"').strip())
        names.append(match["name"] if match else cell)
        units.append((match["unit"] or None) if match else None)
    return names, units


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parse_row(
    source: str, names: Sequence[str], row: tuple[int, str], separator: str, lines: Sequence[int],
    missing: bool,
) -> list[float]:  # fmt: skip
    """Return the numbers of one row, given as (row number, line)."""
    number, line = row
    cells = line.split(separator)
    if len(cells) == len(names) and "_" not in line:  # float() would read 1_000 as a number
        try:
            return [float(cell) for cell in cells]
        except ValueError:
            pass
    if len(cells) != len(names):
        column = names[min(len(cells), len(names)) - 1]
        raise InputError(
            place(source, column, number, lines),
            f"the row has {len(cells)} cells, the header has {len(names)}: the line was cut or a "
            f"separator ({separator!r}) is missing or superfluous",
        )
    return [
        _number(source, name, cell, number, lines, missing)
        for name, cell in zip(names, cells, strict=True)
    ]


def _number(
    source: str, name: str, cell: str, row: int, lines: Sequence[int], missing: bool
) -> float:
    """Return the number in a cell that may be quoted."""
    text = cell.strip().strip('"').strip()
    if missing and not text:
        return math.nan
    try:
        if "_" not in text:
            return float(text)
    except ValueError:
        pass
    where = place(source, name, row, lines)
    if not text:
        raise InputError(where, "empty cell: remove the row or fill it in; NaN is not allowed")
    remedy = "write decimals with a point" if "," in text else "write a number or remove the column"
    raise InputError(where, f"{text[:40]!r} is not a number: {remedy}")

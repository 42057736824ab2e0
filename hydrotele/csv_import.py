"""CSV from a data logger or a spreadsheet, as a table; the checks scale its units to SI."""

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.errors import InputError
from hydrotele.log_checks import Table, place

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
    header, rows, lines, metadata = _split(path)
    source = str(path)
    separator = max(",;\t", key=header.count)
    names, units = _parse_header(header, separator)
    if any(map(_is_number, names)):
        remedy = "write a header of channel names above the numbers, such as time,angle.boom [deg]"
        raise InputError(path, f"the first line {header[:40]!r} holds numbers, not names: {remedy}")
    cells = [_parse_row(source, names, row, separator, lines, missing) for row in enumerate(rows)]
    values = np.array(cells, dtype=np.float64).reshape(len(rows), len(names))
    return Table(source, names, list(values.T), units, metadata, np.array(lines, dtype=np.int64))


def _split(path: Path) -> tuple[str, list[str], list[int], dict[str, str]]:
    """Return the header, the data rows, their line numbers and the metadata of the comments."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            path, f"is not text in UTF-8 ({error.reason}): save it as CSV UTF-8"
        ) from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from error
    header, rows, lines, metadata = None, [], [], {}
    for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1):
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                metadata[key.strip()] = value.strip()
        elif not line.strip():
            continue
        elif header is None:
            header = line
        else:
            rows.append(line)
            lines.append(number)
    if header is None:
        raise InputError(path, "is empty: write a header of channel names, then one line per row")
    return header, rows, lines, metadata


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

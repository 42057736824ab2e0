"""What a foreign file must satisfy to become a Log: the table as read, CSV import, and the checks.

CSV comes from a data logger or a spreadsheet; units that it states are scaled to SI.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.errors import InputError
from hydrotele.signals import (
    allowed_units,
    magnitude_limits,
    parse_channel,
    to_si,
    usual_unit,
)

_LONGEST_STEP = 1.0  # [s] slower than any log of a hydraulic machine
_NOTHING = 1e-2  # [Pa] no unit makes less a working pressure; a dead sensor is no unit error
_HEADER = re.compile(r"(?P<name>.*?)\s*(\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)


class Table(NamedTuple):
    """A file as read, or what is to be written, before any check of names, units or values.

    Attributes:
        source: the file.
        names: one per column, as written; repeated names are kept.
        values: per column (n,) float64.
        units: per column, None where the file says nothing.
        metadata: provenance.
        lines: (n,) line number of each row in a text file, counted from 1; None for Parquet.
    """

    source: str
    names: Sequence[str]
    values: Sequence[np.ndarray]
    units: Sequence[str | None]
    metadata: Mapping[str, str]
    lines: np.ndarray | None = None

    def where(self, column: str, row: int | None = None) -> str:
        """Return file, column, row (0 is the first row of data) and line as one string."""
        return place(self.source, column, row, self.lines)


def place(source: str, column: str, row: int | None, lines: Sequence | np.ndarray | None) -> str:
    """Return file, column, row (0 is the first row of data) and line as one string."""
    text = f"{source}, column {column!r}"
    if row is None:
        return text
    return f"{text}, row {row}" + ("" if lines is None else f" (line {lines[row]})")


def read_csv(path: Path) -> Table:
    """Read a CSV log: a header of `name` or `name [unit]`, then one line of numbers per row.

    The separator is a comma, a semicolon or a tab, whichever the header has most of; decimals have
    a point. Lines that start with `#` are comments, of which `# key: value` becomes metadata. A
    known unit is scaled to SI by `checked`.

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
    cells = [_parse_row(source, names, row, separator, lines) for row in enumerate(rows)]
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
    source: str, names: Sequence[str], row: tuple[int, str], separator: str, lines: Sequence[int]
) -> list[float]:
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
        _number(source, name, cell, number, lines) for name, cell in zip(names, cells, strict=True)
    ]


def _number(source: str, name: str, cell: str, row: int, lines: Sequence[int]) -> float:
    """Return the number in a cell that may be quoted."""
    text = cell.strip().strip('"').strip()
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


def checked(table: Table, required: Sequence[str], maximum_dropped: float) -> Table:
    """Check a table and return it with every column in a SI unit, assumed where none is stated.

    Raises:
        InputError: the first offence, with column and row and what to do.
    """
    _check_names(table, required)
    si = _in_si(table)
    check_values(si, maximum_dropped)
    for name, values, unit, stated in zip(si.names, si.values, si.units, table.units, strict=True):
        _check_magnitude(si, name, values, str(unit), stated is not None)
    return si


def check_values(table: Table, maximum_dropped: float) -> None:
    """Refuse values that are not finite, and a time that does not rise or lacks samples.

    Raises:
        InputError: the first offence, with column and row and what to do.
    """
    _check_finite(table)
    _check_time(table, maximum_dropped)


def _check_names(table: Table, required: Sequence[str]) -> None:
    for name in table.names:
        try:
            parse_channel(name)
        except ValueError as error:
            raise InputError(
                table.where(name), f"{error}. Rename it, give it an alias or remove it"
            ) from None
    for name, count in Counter(table.names).items():
        if count > 1:
            raise InputError(table.where(name), f"is there {count} times: keep one")
    missing = [name for name in ("time", *required) if name not in table.names]
    if missing:
        raise InputError(table.source, lacks(missing, table.names))


def lacks(names: Sequence[str], present: Sequence[str] | Mapping[str, object]) -> str:
    """Return the message for channels that are not there: what is missing, and what there is."""
    columns = "columns" if len(names) > 1 else "column"
    return f"needs the {columns} {', '.join(names)}; it has {', '.join(present) or 'none'}"


def _in_si(table: Table) -> Table:
    """Return the table with an SI unit for every column; text is scaled to it, Parquet refused."""
    columns, units = [], []
    for name, values, stated in zip(table.names, table.values, table.units, strict=True):
        if stated is None:
            unit, factor = usual_unit(name, table.names), 1.0
        else:
            unit, factor = to_si(stated)
        allowed = allowed_units(name)
        says = f"has the unit {stated!r}; a log needs {' or '.join(allowed)}"
        if unit not in allowed:
            remedy = "correct the unit or move the values to a column that it fits"
            raise InputError(
                table.where(name), f"{says}, to which it cannot be converted: {remedy}"
            )
        if factor != 1.0 and table.lines is None:
            remedy = f"multiply by {factor:.10g} and set the unit to {unit}"
            raise InputError(table.where(name), f"{says}: {remedy}")
        columns.append(values if factor == 1.0 else values * factor)
        units.append(unit)
    return table._replace(values=columns, units=units)


def _check_finite(table: Table) -> None:
    for name, values in zip(table.names, table.values, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            remedy = "remove the row or fill it in"
            raise InputError(table.where(name, int(bad[0])), f"is {values[bad[0]]}: {remedy}")


def _check_time(table: Table, maximum_dropped: float) -> None:
    time = table.values[table.names.index("time")]
    with np.errstate(all="ignore"):
        step = np.diff(time)
    if len(bad := np.flatnonzero(~(step > 0))):
        row, before = int(bad[0]) + 1, time[bad[0]]
        what = "repeats" if time[row] == before else "goes back"
        remedy = "sort the rows by time and keep each time once"
        raise InputError(
            table.where("time", row), f"{what} from {before:.10g} to {time[row]:.10g} s: {remedy}"
        )
    lost = lost_samples(time)
    fraction = lost.sum() / (lost.sum() + len(time))
    if fraction > maximum_dropped:
        row = int(np.flatnonzero(lost)[0]) + 1
        raise InputError(
            table.where("time", row),
            f"the step is {step[row - 1]:.4g} s, the median step {np.median(step):.4g} s: "
            f"{100 * fraction:.2g} % of the samples were dropped or come off time, "
            f"{100 * maximum_dropped:.2g} % are allowed. Resample the run at a fixed rate, cut it "
            "there, or allow more with maximum_dropped",
        )


def lost_samples(time: np.ndarray) -> np.ndarray:
    """Return per step (n-1,) how many samples it lacks; 1 if shorter than half the median."""
    with np.errstate(all="ignore"):
        step = np.diff(time)
        deviation = np.abs(step / np.median(step) - 1.0) if len(step) else step
    return np.where(
        deviation <= 0.5, 0.0, np.clip(np.nan_to_num(np.rint(deviation), nan=1.0), 1.0, 1e12)
    )


def _check_magnitude(table: Table, name: str, values: np.ndarray, unit: str, stated: bool) -> None:
    """Refuse values that only another unit explains; a stated unit is believed further."""
    if name == "time":
        if (step := float(np.median(np.diff(values)))) >= _LONGEST_STEP:
            remedy = "looks like milliseconds or less, write seconds"
            raise InputError(table.where(name, 1), f"rises by {step:g} per row: {remedy}")
        return
    limits = magnitude_limits(name, unit, stated=stated)
    size = np.abs(values)
    target = unit if stated else f"{unit} and state the unit"
    if unit == "1":
        target = "values in [-1, 1] or state the unit"
    remedy = f"looks like {limits.looks_like}, write {target}"
    if len(high := np.flatnonzero(size > limits.largest)):
        row = int(high[0])
        raise InputError(table.where(name, row), f"is {values[row]:g}: {remedy}")
    if _NOTHING < size.max() < limits.smallest:
        row = int(np.argmax(size))
        raise InputError(table.where(name, row), f"never exceeds {size[row]:g}: {remedy}")

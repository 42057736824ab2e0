"""Tables of named columns from CSV and Parquet files, without checks of names, units or values.

The CSV reader accepts the dialects of common loggers and spreadsheets, see `read_csv`. A cell that is
not a number does not stop the reader: the column then has a fault, which is reported if the column
is used.
"""

import codecs
import csv
import datetime
import io
import math
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import check_limit, get_limit, open_regular
from hydrotele.core.units import is_known_unit

DATE_UNIT = "date"
"""Unit of a column of dates; its values are seconds since its first date."""

_MAX_CHARACTERS_PER_COLUMN = 100  # times the limit of columns: longest line that is read
_MAX_LINES_BEFORE_DATA = 200  # lines in which the first row is sought
_ENCODING_BYTES = 2**20  # bytes from which the encoding is determined
_CONTROL_BYTES = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_LABEL = re.compile(r"(?P<name>.*?)\s*(\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)
_COMMENT_MARKS = ("#", "%", "//")
_PARENTHESES = re.compile(r"(?P<name>.*?)\s*\((?P<unit>[^()]*)\)", re.DOTALL)
_DATE = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})[ T]+(\d{1,2}:\d{2}(?::\d{2})?(?:[.,]\d+)?)\s*([AaPp][Mm])?")
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}))?(?:[.,](\d+))?\s*([AaPp][Mm])?")
_MISSING_WORDS = frozenset({"", "na", "n/a", "null", "none"})
_DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?")


class Table(NamedTuple):
    """Content of a log file without checks of names, units or values.

    Attributes:
        source: name of the file.
        names: column names as in the file; repeated names are kept.
        values: per column (n,) float64.
        units: per column, None where the file states no unit, `DATE_UNIT` for dates.
        metadata: metadata of the file.
        lines: (n,) line number of each row in a text file, starting at 1; None for Parquet.
        faults: column name -> reason why the column is not a column of numbers.
    """

    source: str
    names: Sequence[str]
    values: Sequence[np.ndarray]
    units: Sequence[str | None]
    metadata: Mapping[str, str]
    lines: np.ndarray | None = None
    faults: Mapping[str, InputError] = {}

    def location(self, column: str, row: int | None = None) -> str:
        """Return file, column, row (0 is the first row of data) and line as one string."""
        return format_location(self.source, column, row, self.lines)


def format_location(source: str, column: str, row: int | None, lines: Sequence | np.ndarray | None) -> str:
    """Return file, column, row (0 is the first row of data) and line as one string."""
    text = f"{source}, column {column!r}"
    if row is None:
        return text
    return f"{text}, row {row}" + ("" if lines is None else f" (line {lines[row]})")


def parse_label(text: str) -> tuple[str, str | None]:
    """Split a column label into name and unit. A unit in parentheses must be a known one.

    >>> parse_label("angle.boom [deg]"), parse_label("Boom (bar)"), parse_label("time")
    (('angle.boom', 'deg'), ('Boom', 'bar'), ('time', None))
    """
    match = _PARENTHESES.fullmatch(text.strip())
    if match and match["unit"].strip() != "1" and is_known_unit(match["unit"]):  # `Sensor (1)` is a number
        return match["name"], match["unit"].strip()
    match = _LABEL.fullmatch(text.strip())
    return (match["name"], (match["unit"] or "").strip() or None) if match else (text, None)


def check_log_file(path: Path) -> None:
    """Check that a path is an existing file that ends in `.parquet` or `.csv`.

    Raises:
        InputError: it is not; the message gives the reason.
    """
    if not path.exists():
        raise InputError(path, "does not exist: give the path of a .parquet or .csv log")
    if not path.is_file():
        raise InputError(path, "is not a file: give the path of a .parquet or .csv log")
    if path.suffix.lower() not in (".csv", ".parquet"):
        raise InputError(path, f"a log ends in .parquet or .csv, not in {path.suffix!r}")


def read_table(path: Path, missing: bool = False) -> Table:
    """Read the columns of a log file without checks of names and values.

    Args:
        path: the file.
        missing: read empty cells as NaN, and report columns that contain other things than numbers
            as `faults` of the table. If False, both raise an InputError.

    Raises:
        InputError: the file cannot be read.
    """
    check_log_file(path)
    return read_csv(path, missing) if path.suffix.lower() == ".csv" else _read_parquet(path, missing)


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a log file without reading its values.

    Raises:
        InputError: the file cannot be read.
    """
    check_log_file(path)
    if path.suffix.lower() == ".csv":
        read = _CsvReader(str(path), missing=True)
        for number, line in _iterate_lines(path, read.max_line):
            read.parse_line(number, line)
            if read.lines:
                break
        return read.metadata
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return _decode_table_metadata(pq.read_schema(path).metadata)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable_parquet_error(path, error) from error


def read_csv(path: Path, missing: bool = False) -> Table:
    """Read a CSV log: a header of `name` or `name [unit]`, then one line of numbers per row.

    Accepted forms:
    - Lines before the header, as LabVIEW and other loggers write them, are ignored; the header is then
        the last line of names above the first row that begins with a number or a date.
    - A line of units below the header, such as `s;bar;deg`, states the units of the columns.
    - Columns are separated by comma, semicolon or tab. It is the most frequent of these in the
      header, or the one that a first line such as `sep=;` states. Separators at the end of a line,
      and lines of separators only, are ignored.
    - Numbers have a decimal point or a decimal comma, the same in the whole file. With commas
      between the columns, numbers with a decimal comma must be in quotation marks.
    - Lines that begin with `#`, `%`, `//` or `;` are comments; `# key: value` is read as metadata.
    - A column of ISO dates, of dates such as `31.12.2024 12:30:05,020` or `12/31/2024 1:30:05 PM`, or of
        times such as `12:30:05.020`, is read as seconds since its first row.
    - The text is UTF-8, UTF-16 with a byte order mark, or Windows-1252.

    Args:
        path: the file.
        missing: read empty cells as NaN, and report columns that contain other things than numbers
            as `faults` of the table. If False, both raise an InputError.

    Raises:
        InputError: the file is no text, is empty, has no header, has a row of the wrong
            length, or contains a cell that is not a number.
    """
    read = _CsvReader(str(path), missing)
    for number, line in _iterate_lines(path, read.max_line):
        read.parse_line(number, line)
    return read.to_table()


def _iterate_lines(path: Path, max_line: int) -> Iterator[tuple[int, str]]:
    """Yield (line number from 1, line) of a text file without holding all lines in memory.

    A line of more than `max_line` characters is yielded in parts of this length.
    """
    with open_regular(path) as file:
        text = io.TextIOWrapper(file, encoding=_find_encoding(file))
        try:
            yield from enumerate(iter(lambda: text.readline(max_line), ""), 1)
        except UnicodeDecodeError as error:
            reason = f"is not text in UTF-8 ({error.reason}): save it as CSV UTF-8"
            raise InputError(path, reason) from error


def _find_encoding(file: BinaryIO) -> str:
    """Return the encoding of a text file from its first bytes; text that is not UTF-8 counts as Windows-1252.

    The result is UTF-8 for files with control characters, which are no text.
    """
    head = file.read(_ENCODING_BYTES)
    file.seek(0)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        if not _CONTROL_BYTES.search(head):
            return "cp1252"
    return "utf-8-sig"


class _CsvReader:
    """Parser of a CSV file that is given line by line; holds what it has read so far."""

    def __init__(self, source: str, missing: bool) -> None:
        self.source, self.missing = source, missing
        self.max_values, self.max_columns = get_limit("LOG_VALUES"), get_limit("LOG_COLUMNS")
        self.max_line = round(_MAX_CHARACTERS_PER_COLUMN * self.max_columns)
        self.names: list[str] = []
        self.units: list[str | None] = []
        self.metadata: dict[str, str] = {}
        self.faults: dict[str, InputError] = {}
        self.separator: str | None = None
        self.values, self.lines = array("d"), array("q")
        self._possible_header: str | None = None  # a line with `;` in front: comment or header
        self._before_data: list[tuple[int, str]] = []  # lines until the first row is found
        self._first_dates: dict[int, datetime.datetime] = {}
        self._point: str | None = None  # location of the first number with a decimal point
        self._comma: str | None = None  # location of the first number with a decimal comma
        self._comma_is_certain = False  # whether a comma cannot separate thousands

    def parse_line(self, number: int, line: str) -> None:
        """Parse the next line of the file and store its header, metadata or numbers.

        `number` is the line number from 1; `line` includes the line break. Raises InputError for a
        row of the wrong length or a line that is too long.
        """
        if len(line) == self.max_line:
            self._check_columns(line)
            message = (
                f"has more than {self.max_line} characters, {_MAX_CHARACTERS_PER_COLUMN} for each of the"
                f" {self.max_columns:g} columns that HYDROTELE_MAX_LOG_COLUMNS allows"
            )
            raise InputError(f"{self.source}, line {number}", message)
        line = line.rstrip("\n")
        if not line.strip():
            return
        if self._is_comment(line):
            self._parse_comment(line)
        elif not self.names:
            self._parse_before_data(number, line)
        else:
            self._parse_row(number, line)

    def to_table(self) -> Table:
        """Return the table of all parsed lines.

        Raises:
            InputError: there is no header, the decimal sign is not the same everywhere, or commas
                could be decimal signs or separate thousands.
        """
        if self._possible_header is not None:
            self._parse_comment(self._possible_header)
        if not self.names:
            self._parse_lines_as_table()
        if not self.names:
            reason = "is empty: write a header of channel names, then one line per row"
            raise InputError(self.source, reason)
        if self._comma and self._point:
            message = f"has a decimal comma, but {self._point} has a decimal point: write one of them"
            raise InputError(self._comma, message)
        if self._comma and not self._comma_is_certain:
            message = (
                "the commas may be decimal signs or separate thousands: write the numbers with a decimal"
                " point and without separators of thousands"
            )
            raise InputError(self._comma, message)
        values = np.frombuffer(self.values, dtype=np.float64).reshape(-1, len(self.names))
        lines = np.array(self.lines, dtype=np.int64)
        columns = [np.ascontiguousarray(column) for column in values.T]
        units = [DATE_UNIT if place in self._first_dates else unit for place, unit in enumerate(self.units)]
        return Table(self.source, self.names, columns, units, self.metadata, lines, self.faults)

    def _is_comment(self, line: str) -> bool:
        if line.lstrip('" \t').startswith(_COMMENT_MARKS):
            return True
        return bool(self.names) and self.separator != ";" and line.startswith(";")

    def _parse_comment(self, line: str) -> None:
        key, colon, value = line.strip('" \t,;').lstrip("#%/; \t").partition(":")
        if colon:
            self.metadata[key.strip()] = value.strip()

    def _parse_before_data(self, number: int, line: str) -> None:
        if self.separator is None and (match := re.fullmatch(r"\s*\"?sep=(.)\"?\s*", line, re.IGNORECASE)):
            self.separator = match[1]
            return
        if self._before_data:
            self._seek_first_row(number, line)
            return
        if (possible := self._possible_header) is not None:
            self._possible_header = None
            if self._is_row_below(possible, line):
                self._parse_header(possible)
                self._parse_row(number, line)
                return
            self._parse_comment(possible)
        if line.startswith(";"):
            self._possible_header = line
        else:
            self._seek_first_row(number, line)

    def _seek_first_row(self, number: int, line: str) -> None:
        """Store a line before the first row; if it is the first row, parse the header above it, and the row.

        The line above the first row has the same number of cells and no number. Only if it is the first
        line of the file, it may have another number, which is reported. If no such row is found in 200
        lines, the first line is the header.
        """
        before = self._before_data
        if before and self._is_first_row(line):
            units = len(before) > 1 and self._is_units_line(before[-1][1], before[-2][1])
            header, place = before[-2 if units else -1][1], len(before) - (2 if units else 1)
            separator = self.separator or _find_separator(header)
            names, cells = _split_line(header, separator), _split_line(line, separator)
            alike = _count_cells(names) == _count_cells(cells) or len(names) == len(cells)
            if not any(map(_is_number, names)) and (place == 0 or (alike and len(cells) > 1)):
                self._before_data = []
                self._parse_header(header)
                if units:
                    stated = [_bare_unit(cell) or None for cell in _split_line(before[-1][1], separator)]
                    stated += [None] * len(self.names)
                    self.units = [own or unit for own, unit in zip(self.units, stated, strict=False)]
                self._parse_row(number, line)
                return
        before.append((number, line))
        if len(before) >= _MAX_LINES_BEFORE_DATA:
            self._parse_lines_as_table()

    def _is_first_row(self, line: str) -> bool:
        """Return whether a line begins with a number, a date or an empty cell."""
        separator = self.separator or _find_separator(self._before_data[-1][1])
        text = _split_line(line, separator)[0].strip().strip('"').strip()
        return bool(
            _is_number(text) or text.lower() in _MISSING_WORDS or _DECIMAL_COMMA.fullmatch(text) or _parse_date(text)
        )

    def _is_units_line(self, line: str, header: str) -> bool:
        """Return whether all cells of a line are known units or empty, and their number is that of the header."""
        separator = self.separator or _find_separator(header)
        cells = [_bare_unit(cell) for cell in _split_line(line, separator)]
        known = [cell for cell in cells if cell]
        return len(cells) == len(_split_line(header, separator)) and bool(known) and all(map(is_known_unit, known))

    def _parse_lines_as_table(self) -> None:
        """Parse the stored lines: the first one is the header, the others are rows."""
        lines, self._before_data = self._before_data, []
        for place, (number, line) in enumerate(lines):
            if place == 0:
                self._parse_header(line)
            else:
                self._parse_row(number, line)

    def _is_row_below(self, header: str, line: str) -> bool:
        """Return whether a line is a row of numbers or empty cells, with as many cells (at least 2) as the header."""
        separator = self.separator or _find_separator(header)
        cells = _split_line(line, separator)
        return len(cells) == len(_split_line(header, separator)) > 1 and all(
            not cell.strip() or _is_number(cell) or _DECIMAL_COMMA.fullmatch(cell.strip()) for cell in cells
        )

    def _check_columns(self, line: str) -> None:
        check_limit(self.source, "LOG_COLUMNS", line.count(self.separator or _find_separator(line)) + 1)

    def _parse_header(self, line: str) -> None:
        self.separator = self.separator or _find_separator(line)
        self._check_columns(line)
        cells = _split_line(line, self.separator)
        while len(cells) > 1 and not cells[-1].strip():
            cells.pop()
        labels = [parse_label(cell) for cell in cells]
        self.names, self.units = [name for name, _ in labels], [unit for _, unit in labels]
        if any(map(_is_number, self.names)):
            remedy = "write a header of channel names above the numbers, such as"
            message = f"the first line {line[:40]!r} contains numbers, not names: {remedy}"
            raise InputError(self.source, f"{message} time,angle.boom [deg]")

    def _parse_row(self, number: int, line: str) -> None:
        assert self.separator is not None
        cells = _split_line(line, self.separator)
        while len(cells) > len(self.names) and not cells[-1].strip():
            cells.pop()
        if not any(cell.strip() for cell in cells):
            return
        row = len(self.lines)
        self.lines.append(number)
        if len(cells) != len(self.names):
            raise self._wrong_cell_count_error(row, cells)
        try:
            if "_" in line:  # float() would read 1_000 as a number
                raise ValueError
            numbers = [float(cell) for cell in cells]
            if self._point is None and "." in line:
                place = next(place for place, cell in enumerate(cells) if "." in cell)
                self._point = format_location(self.source, self.names[place], row, self.lines)
        except ValueError:
            numbers = [self._parse_cell(place, cell, row) for place, cell in enumerate(cells)]
        self.values.extend(numbers)
        if len(self.values) > self.max_values:
            check_limit(self.source, "LOG_VALUES", len(self.values))

    def _wrong_cell_count_error(self, row: int, cells: Sequence[str]) -> InputError:
        column = self.names[min(len(cells), len(self.names)) - 1]
        reason = f"the row has {len(cells)} cells, the header has {len(self.names)}"
        remedy = f"the line is incomplete or a separator ({self.separator!r}) is missing or superfluous"
        if self.separator == "," and len(cells) > len(self.names):
            remedy += "; numbers with a decimal comma need quotation marks, or semicolons between the columns"
        return InputError(format_location(self.source, column, row, self.lines), f"{reason}: {remedy}")

    def _parse_cell(self, place: int, cell: str, row: int) -> float:
        """Return the number in a cell; a date becomes seconds since the first date of the column.

        An empty cell and a cell of other text give NaN; the latter also gives the column a fault.
        If `missing` is False, both raise an InputError instead.

        Args:
            place: index of the column.
            cell: text of the cell.
            row: index of the row.
        """
        text, name = cell.strip().strip('"').strip(), self.names[place]
        where = format_location(self.source, name, row, self.lines)
        if text.lower() in _MISSING_WORDS:
            if not self.missing:
                what = "empty cell" if not text else f"{text!r} is not a number"
                raise InputError(where, f"{what}: remove the row or enter a value; NaN is not allowed")
            return math.nan
        if _is_number(text):
            if "." in text:
                self._point = self._point or where
            return float(text)
        if _DECIMAL_COMMA.fullmatch(text):
            self._comma = self._comma or where
            self._comma_is_certain |= not _THOUSANDS.fullmatch(text)
            return float(text.replace(",", "."))
        if (date := _parse_date(text)) is not None:
            try:
                return (date - self._first_dates.setdefault(place, date)).total_seconds()
            except TypeError:
                self._add_fault(name, where, f"{text[:40]!r} has a time zone, or not, unlike the dates above")
                return math.nan
        if _THOUSANDS.fullmatch(text):
            reason = "separates thousands: write numbers without such separators"
        else:
            reason = "is not a number: write a number or remove the column"
        self._add_fault(name, where, f"{text[:40]!r} {reason}")
        return math.nan

    def _add_fault(self, name: str, where: str, message: str) -> None:
        fault = self.faults.setdefault(name, InputError(where, message))
        if not self.missing:
            raise fault


def _find_separator(header: str) -> str:
    outside = re.sub(r'"[^"]*"', "", header)
    return max(",;\t", key=outside.count)


def _split_line(line: str, separator: str) -> list[str]:
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=separator != " "))
    except csv.Error:
        return line.split(separator)


def _count_cells(cells: Sequence[str]) -> int:
    """Return the number of cells without empty ones at the end."""
    return max((place for place, cell in enumerate(cells, start=1) if cell.strip()), default=0)


def _bare_unit(cell: str) -> str:
    """Return a cell of a line of units without quotation marks and brackets."""
    return cell.strip().strip('"').strip().strip("[]()").strip()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _parse_date(text: str) -> datetime.datetime | None:
    """Return an ISO date, a date with the day or month in front, or a time of day on an arbitrary date.

    The result is None for other text. In `1/2/2024` the month is in front, in `1.2.2024` the day.

    >>> _parse_date("31.12.2024 12:30:05,5"), _parse_date("1/2/2024 1:00 PM")
    (datetime.datetime(2024, 12, 31, 12, 30, 5, 500000), datetime.datetime(2024, 1, 2, 13, 0))
    """
    if ":" not in text and "-" not in text:
        return None
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError:
        pass
    day = datetime.date(2000, 1, 1)
    match = _DATE.fullmatch(text)
    try:
        if match:
            first, second, third = int(match[1]), int(match[3]), int(match[4])
            if len(match[1]) == 4:
                day = datetime.date(first, second, third)
            elif match[2] == "/" and first <= 12:
                day = datetime.date(third, first, second)
            else:
                day = datetime.date(third, second, first)
            text = f"{match[5]} {match[6] or ''}".strip()
        clock = _TIME_OF_DAY.fullmatch(text)
        if clock is None:
            return None
        hour = int(clock[1]) if clock[5] is None else int(clock[1]) % 12 + 12 * (clock[5].lower() == "pm")
        micro = int(f"{clock[4] or '0':<06}"[:6])
        return datetime.datetime.combine(day, datetime.time(hour, int(clock[2]), int(clock[3] or 0), micro))
    except ValueError:
        return None


def _read_parquet(path: Path, missing: bool) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names, values, units, faults = [], [], [], {}
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema, rows = file.schema_arrow, file.metadata.num_rows
            specs = [s for s in schema if not s.name.startswith("__index_level_")]  # pandas index
            check_limit(path, "LOG_COLUMNS", len(specs))
            check_limit(path, "LOG_VALUES", rows * len(specs))
            for spec in specs:  # one by one, to hold only one column in memory twice
                where = f"{path}, column {spec.name!r}"
                names.append(spec.name)
                units.append(_decode_metadata(spec.metadata).get("unit") or None)
                convert = _find_converter(spec)
                if convert is None:
                    message = f"contains {spec.type}, not numbers: write it as float64 or remove it"
                    faults[spec.name] = InputError(where, message)
                    if not missing:
                        raise faults[spec.name]
                    values.append(np.full(rows, np.nan))
                    continue
                read = file.read(columns=[spec.name])  # may include columns with this prefix
                column = read.column(read.schema.get_all_field_indices(spec.name)[0])
                if column.null_count and not missing:
                    row = int(np.flatnonzero(column.is_null().to_numpy())[0])
                    raise InputError(f"{where}, row {row}", "is null: remove the row or enter a value")
                values.append(convert(column))
                if pa.types.is_timestamp(spec.type):
                    units[-1] = DATE_UNIT
        metadata = _decode_table_metadata(schema.metadata)
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise _unreadable_parquet_error(path, error) from error
    return Table(str(path), names, values, units, metadata, None, faults)


def _unreadable_parquet_error(path: Path, error: Exception) -> InputError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return InputError(path, f"is not a readable Parquet file, copy it again ({reason})")


def _find_converter(spec) -> Callable | None:
    """Return the function that converts a Parquet column to float64; None if it has neither numbers nor dates.

    Booleans count as numbers only in the columns `valid` and `mask`.
    """
    import pyarrow as pa

    if pa.types.is_timestamp(spec.type):
        return _seconds_since_first
    number = pa.types.is_floating(spec.type) or pa.types.is_integer(spec.type)
    if number or (pa.types.is_boolean(spec.type) and spec.name in ("valid", "mask")):
        return _to_float_array
    return None


def _to_float_array(column) -> np.ndarray:
    """Return a Parquet column as (n,) float64, with NaN for null."""
    with np.errstate(invalid="ignore"):  # a damaged file may contain signalling NaN
        return column.to_numpy().astype(np.float64)


def _seconds_since_first(column) -> np.ndarray:
    """Return a Parquet column of dates as (n,) seconds since the first, with NaN for null."""
    stamps = column.to_numpy().astype("datetime64[ns]")
    known = ~np.isnat(stamps)
    seconds = np.full(len(stamps), np.nan)
    if known.any():
        seconds[known] = (stamps[known] - stamps[known][0]) / np.timedelta64(1, "s")
    return seconds


def _decode_table_metadata(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k: v for k, v in _decode_metadata(metadata).items() if k != "pandas"}


def _decode_metadata(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}

"""Logs of machines: time and named columns with units and metadata, read from Parquet or CSV.

`load_log` reads a file and checks channel names, units, finite values, increasing time and
plausible magnitudes. CSV columns in other units are converted to SI. A `Log` therefore contains
only known channels in SI units. `save_log` writes Parquet.
"""

import io
import math
import os
import re
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import check_limit, get_limit, open_regular
from hydrotele.core.output import atomic_file
from hydrotele.core.units import canonical_unit, to_si
from hydrotele.machine import signals
from hydrotele.machine.signals import allowed_units, default_unit, magnitude_limits, parse_channel

if TYPE_CHECKING:
    import pyarrow as pa

MEASURED_STEM = "measured"  # stem of the measured log in a run folder
_KINDS = (".parquet", ".csv")
_MAX_RANGE_EXCESS = 0.02  # fraction of half a command range that converter readings may exceed it
_MAX_STEP = 1.0  # [s] longer than any sample period of a hydraulic machine
_DEAD_SENSOR_PRESSURE = 1e-2  # [Pa] maxima below it mean a dead sensor, not a wrong unit


class CommandRange(NamedTuple):
    """Range of a command column: `low` corresponds to -1 and `high` to 1, both in `unit`."""

    unit: str
    low: float
    high: float


class Table(NamedTuple):
    """Content of a log file without checks of names, units or values.

    Attributes:
        source: name of the file.
        names: column names as in the file; repeated names are kept.
        values: per column (n,) float64.
        units: per column, None where the file states no unit.
        metadata: metadata of the file.
        lines: (n,) line number of each row in a text file, starting at 1; None for Parquet.
    """

    source: str
    names: Sequence[str]
    values: Sequence[np.ndarray]
    units: Sequence[str | None]
    metadata: Mapping[str, str]
    lines: np.ndarray | None = None

    def location(self, column: str, row: int | None = None) -> str:
        """Return file, column, row (0 is the first row of data) and line as one string."""
        return format_location(self.source, column, row, self.lines)


def format_location(source: str, column: str, row: int | None, lines: Sequence | np.ndarray | None) -> str:
    """Return file, column, row (0 is the first row of data) and line as one string."""
    text = f"{source}, column {column!r}"
    if row is None:
        return text
    return f"{text}, row {row}" + ("" if lines is None else f" (line {lines[row]})")


def mask_to_valid(table: Table) -> Table:
    """Replace the column `mask` (1 for unusable rows) by the column `valid` (1 for usable rows)."""
    values = [1.0 - column if name == "mask" else column
              for name, column in zip(table.names, table.values, strict=True)]  # fmt: skip
    names = ["valid" if name == "mask" else name for name in table.names]
    return table._replace(names=names, values=values)


def normalise_commands(table: Table, ranges: Mapping[str, CommandRange]) -> Table:
    """Convert commands in volts, mA or counts to fractions in [-1, 1].

    Columns in percent or as a fraction are left to the conversion to SI. Readings up to 2 % beyond
    the range, as converters give them, are clipped to it.

    Args:
        table: table with channel names.
        ranges: command channel -> range of its column.

    Raises:
        InputError: a column has another unit or exceeds its range; the message gives the remedy.
    """
    values, units = list(table.values), list(table.units)
    for place, name in enumerate(table.names):
        if name not in ranges:
            continue
        known, column, axis = ranges[name], values[place], name.partition(".")[2]
        own, stated = canonical_unit(known.unit), canonical_unit(units[place] or known.unit)
        if stated != own:
            (si, factor), (own_si, own_factor) = to_si(stated), to_si(own)
            if si == "1" != own_si:
                continue
            if si != own_si:
                raise InputError(
                    table.location(name),
                    f"is in {stated!r}, the machine's commands are in {own!r}: correct"
                    f" axes.{axis}.command_unit in the machine file, or convert the column",
                )
            column = column * (factor / own_factor)
        middle, half = 0.5 * (known.low + known.high), 0.5 * (known.high - known.low)
        share = (column - middle) / half
        if len(beyond := np.flatnonzero(np.abs(share) > 1.0 + _MAX_RANGE_EXCESS)):
            row = int(beyond[0])
            raise InputError(
                table.location(name, row),
                f"is {column[row]:g} {own}, beyond the machine's command_range {known.low:g} .."
                f" {known.high:g} {own}: correct axes.{axis}.command_range in the machine file, or"
                " the column",
            )
        values[place], units[place] = np.clip(share, -1.0, 1.0), "1"
    return table._replace(values=values, units=units)


def check_table(table: Table, required: Sequence[str], maximum_dropped: float, allow_nan: bool = False) -> Table:
    """Check a table and return it in SI units; columns without a unit get the usual one.

    Args:
        table: content of a file.
        required: channels that must be present.
        maximum_dropped: fraction of the samples that may be missing [1].
        allow_nan: accept NaN in every column except time.

    Raises:
        InputError: the table is invalid; the message gives column, row and remedy.
    """
    _check_names(table, required)
    si = _to_si_units(table)
    check_values(si, maximum_dropped, allow_nan)
    for name, values, unit, stated in zip(si.names, si.values, si.units, table.units, strict=True):
        _check_magnitude(si, name, values, str(unit), stated is not None)
    return si


def check_values(table: Table, maximum_dropped: float, missing: bool = False) -> None:
    """Check that values are finite, time increases and not too many samples are missing.

    Args:
        table: table in SI units.
        maximum_dropped: fraction of the samples that may be missing [1].
        missing: accept NaN in every column except time.

    Raises:
        InputError: a check fails; the message gives column, row and remedy.
    """
    _check_finite(table, missing)
    _check_time(table, maximum_dropped)


def _check_names(table: Table, required: Sequence[str]) -> None:
    for name in table.names:
        try:
            parse_channel(name)
        except ValueError as error:
            raise InputError(
                table.location(name),
                f"{error}. Rename it, give it an alias or remove it"
                " (log_columns in the machine file defines aliases; the alias none skips a column)",
            ) from None
    for name, count in Counter(table.names).items():
        if count > 1:
            raise InputError(table.location(name), f"occurs {count} times: keep one")
    missing = [name for name in ("time", *required) if name not in table.names]
    if missing:
        raise InputError(table.source, missing_channels_message(missing, table.names))


def missing_channels_message(names: Sequence[str], present: Sequence[str] | Mapping[str, object]) -> str:
    """Return the message for missing channels, with the channels that are present."""
    columns = "columns" if len(names) > 1 else "column"
    return f"needs the {columns} {', '.join(names)}; it has {', '.join(present) or 'none'}"


def _to_si_units(table: Table) -> Table:
    """Return the table in SI units; CSV columns are scaled, other units in Parquet are refused."""
    columns, units = [], []
    for name, values, stated in zip(table.names, table.values, table.units, strict=True):
        if stated is None:
            unit, factor = default_unit(name, table.names), 1.0
        else:
            unit, factor = to_si(stated)
        allowed = allowed_units(name)
        says = f"has the unit {stated!r}; a log needs {' or '.join(allowed)}"
        if unit not in allowed:
            remedy = "correct the unit, or rename the column to a channel with this unit"
            raise InputError(table.location(name), f"{says}, to which it cannot be converted: {remedy}")
        if factor != 1.0 and table.lines is None:
            remedy = f"multiply by {factor:.10g} and set the unit to {unit}"
            raise InputError(table.location(name), f"{says}: {remedy}")
        columns.append(values if factor == 1.0 else values * factor)
        units.append(unit)
    return table._replace(values=columns, units=units)


def _check_finite(table: Table, missing: bool) -> None:
    for name, values in zip(table.names, table.values, strict=True):
        allowed = missing and name != "time"
        bad = np.flatnonzero(np.isinf(values) if allowed else ~np.isfinite(values))
        if len(bad):
            remedy = "remove the row or enter a value"
            raise InputError(table.location(name, int(bad[0])), f"is {values[bad[0]]}: {remedy}")


def _check_time(table: Table, maximum_dropped: float) -> None:
    time = table.values[table.names.index("time")]
    with np.errstate(all="ignore"):
        step = np.diff(time)
    if len(bad := np.flatnonzero(~(step > 0))):
        row, before = int(bad[0]) + 1, time[bad[0]]
        what = "repeats" if time[row] == before else "goes back"
        remedy = "sort the rows by time and keep one row per time"
        raise InputError(
            table.location("time", row),
            f"{what} from {before:.10g} to {time[row]:.10g} s: {remedy}",
        )
    lost = count_missing_samples(time)
    fraction = lost.sum() / (lost.sum() + len(time))
    if fraction > maximum_dropped:
        row = int(np.flatnonzero(lost)[0]) + 1
        raise InputError(
            table.location("time", row),
            f"the step is {step[row - 1]:.4g} s, the median step {np.median(step):.4g} s: "
            f"{100 * fraction:.2g} % of the samples are missing or have irregular times, "
            f"{100 * maximum_dropped:.2g} % are allowed. Resample the run at a fixed rate, split "
            "it there, or increase maximum_dropped",
        )


def count_missing_samples(time: np.ndarray) -> np.ndarray:
    """Return the number of missing samples per step (n-1,); 1 for steps below half the median."""
    with np.errstate(all="ignore"):
        step = np.diff(time)
        deviation = np.abs(step / np.median(step) - 1.0) if len(step) else step
    return np.where(deviation <= 0.5, 0.0, np.clip(np.nan_to_num(np.rint(deviation), nan=1.0), 1.0, 1e12))


def _check_magnitude(table: Table, name: str, values: np.ndarray, unit: str, stated: bool) -> None:
    """Check that magnitudes are plausible for the unit; limits are wider for a stated unit."""
    if name == "time":
        if (step := float(np.median(np.diff(values)))) >= _MAX_STEP:
            remedy = "looks like milliseconds or less, write seconds"
            raise InputError(table.location(name, 1), f"increases by {step:g} per row: {remedy}")
        return
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return
    if name == "valid" and len(bad := np.flatnonzero((values != 0.0) & (values != 1.0))):
        if not np.isnan(values[bad]).all():
            row = int(bad[~np.isnan(values[bad])][0])
            remedy = "write 1 for usable rows and 0 for others"
            raise InputError(table.location(name, row), f"is {values[row]:g}: {remedy}")
    limits = magnitude_limits(name, unit, stated=stated)
    target = unit if stated else f"{unit} and state the unit"
    if unit == "1":
        axis = name.partition(".")[2]
        target = (
            "values in [-1, 1], or state unit and range in the machine file, such as"
            f" axes.{axis}: {{command_unit: V, command_range: [-10, 10]}}"
        )
    remedy = f"looks like {limits.looks_like}, write {target}"
    size = np.nan_to_num(np.abs(values))
    if len(high := np.flatnonzero(size > limits.max_magnitude)):
        row = int(high[0])
        raise InputError(table.location(name, row), f"is {values[row]:g}: {remedy}")
    if _DEAD_SENSOR_PRESSURE < size.max() < limits.min_magnitude:
        row = int(np.argmax(size))
        raise InputError(table.location(name, row), f"never exceeds {size[row]:g}: {remedy}")


_MAX_LINE_LENGTH = 1_000_000  # characters per line
_HEADER_CELL = re.compile(r"(?P<name>.*?)\s*(\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)


def read_csv(path: Path, missing: bool = False) -> Table:
    """Read a CSV log: a header of `name` or `name [unit]`, then one line of numbers per row.

    The separator is the most frequent of comma, semicolon and tab in the header. Decimals have a
    point. Lines that start with `#` are comments; `# key: value` is read as metadata. `check_table`
    converts known units to SI.

    Args:
        path: the file.
        missing: read empty cells as NaN instead of refusing them.

    Raises:
        InputError: the file is not UTF-8 text, is empty, has no header, has a row of the wrong
            length, or contains a cell that is not a number.
    """
    read = _CsvReader(str(path), missing)
    with open_regular(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8-sig")  # read by lines: logs may be large
        try:
            for number, line in enumerate(iter(lambda: text.readline(_MAX_LINE_LENGTH), ""), 1):
                read.parse_line(number, line)
        except UnicodeDecodeError as error:
            reason = f"is not text in UTF-8 ({error.reason}): save it as CSV UTF-8"
            raise InputError(path, reason) from error
    if not read.names:
        raise InputError(path, "is empty: write a header of channel names, then one line per row")
    values = np.frombuffer(read.values, dtype=np.float64).reshape(-1, len(read.names))
    lines = np.array(read.lines, dtype=np.int64)
    columns = [np.ascontiguousarray(column) for column in values.T]
    return Table(read.source, read.names, columns, read.units, read.metadata, lines)


class _CsvReader:
    """Names, units, metadata and values read from the lines of a CSV file so far."""

    def __init__(self, source: str, missing: bool) -> None:
        self.source, self.missing, self.most = source, missing, get_limit("LOG_VALUES")
        self.names: list[str] = []
        self.units: list[str | None] = []
        self.metadata: dict[str, str] = {}
        self.separator = ","
        self.values, self.lines = array("d"), array("q")

    def parse_line(self, number: int, line: str) -> None:
        """Parse the next line of the file, including its line break."""
        if len(line) == _MAX_LINE_LENGTH:
            message = f"is longer than {_MAX_LINE_LENGTH} characters"
            raise InputError(f"{self.source}, line {number}", message)
        line = line.rstrip("\n")
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                self.metadata[key.strip()] = value.strip()
        elif not line.strip():
            return
        elif not self.names:
            self._parse_header_line(line)
        else:
            row = len(self.lines)
            self.lines.append(number)
            self.values.extend(_parse_row(
                self.source, self.names, (row, line), self.separator, self.lines, self.missing,
            ))  # fmt: skip
            if len(self.values) > self.most:
                check_limit(self.source, "LOG_VALUES", len(self.values))

    def _parse_header_line(self, line: str) -> None:
        self.separator = max(",;\t", key=line.count)
        self.names, self.units = _parse_header(line, self.separator)
        if any(map(_is_number, self.names)):
            remedy = "write a header of channel names above the numbers, such as"
            message = f"the first line {line[:40]!r} contains numbers, not names: {remedy}"
            raise InputError(self.source, f"{message} time,angle.boom [deg]")


def _parse_header(header: str, separator: str) -> tuple[list[str], list[str | None]]:
    names, units = [], []
    for cell in header.split(separator):
        match = _HEADER_CELL.fullmatch(cell.strip().strip('"').strip())
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
            format_location(source, column, number, lines),
            f"the row has {len(cells)} cells, the header has {len(names)}: the line is incomplete "
            f"or a separator ({separator!r}) is missing or superfluous",
        )
    return [_parse_number(source, name, cell, number, lines, missing) for name, cell in zip(names, cells, strict=True)]


def _parse_number(source: str, name: str, cell: str, row: int, lines: Sequence[int], missing: bool) -> float:
    """Return the number in a cell, which may have quotation marks."""
    text = cell.strip().strip('"').strip()
    if missing and not text:
        return math.nan
    try:
        if "_" not in text:
            return float(text)
    except ValueError:
        pass
    where = format_location(source, name, row, lines)
    if not text:
        raise InputError(where, "empty cell: remove the row or enter a value; NaN is not allowed")
    remedy = "write decimals with a point" if "," in text else "write a number or remove the column"
    raise InputError(where, f"{text[:40]!r} is not a number: {remedy}")


SKIP_COLUMN = "none"  # alias of columns to skip


@dataclass(frozen=True, eq=False)
class Log:
    """One measured or simulated run of a machine. The arrays are copied and read-only.

    Attributes:
        time: (n,) float64 [s], strictly increasing.
        columns: channel name (see `signals`) -> (n,) float64 in the unit of `units`.
        units: channel name -> SI unit; the same keys as `columns`.
        metadata: metadata such as machine and sensors; structures as JSON text.
        source: file of the log, or the name of the program part that created it.

    Raises:
        ValueError: a column has another length than time, no unit, an unknown channel name, or a
            unit that its kind does not allow.
        TypeError: a metadata key or value is not a string.
    """

    time: np.ndarray
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    metadata: Mapping[str, str] = field(default_factory=dict)
    source: str = "memory"

    def __post_init__(self) -> None:
        """Copy the arrays, make them read-only and check the columns."""
        object.__setattr__(self, "time", _read_only_copy(self.time))
        object.__setattr__(self, "columns", {k: _read_only_copy(v) for k, v in self.columns.items()})
        object.__setattr__(self, "units", dict(self.units))
        object.__setattr__(self, "metadata", dict(self.metadata))
        if self.time.ndim != 1 or self.columns.keys() != self.units.keys():
            raise ValueError("time must be (n,), and columns and units must have the same keys")
        for name, values in self.columns.items():
            allowed = signals.allowed_units(name)
            if name == "time" or values.shape != self.time.shape or self.units[name] not in allowed:
                expected = f"{self.time.shape} in {' or '.join(allowed)}"
                raise ValueError(f"{name}: expected {expected}, got {values.shape} in {self.units[name]!r}")
        if not all(isinstance(text, str) for item in self.metadata.items() for text in item):
            raise TypeError("metadata must be strings: write structures with json.dumps")

    def __len__(self) -> int:
        """Return the number of rows n."""
        return len(self.time)

    def __contains__(self, name: object) -> bool:
        """Return whether the log has a channel."""
        return name == "time" or name in self.columns

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values (n,) of a channel in its unit, or `time`.

        Raises:
            InputError: the log does not have the channel; the message lists its channels.
        """
        if name not in self:
            raise InputError(self.source, missing_channels_message([name], self.columns))
        return self.time if name == "time" else self.columns[name]

    @property
    def name(self) -> str:
        """Name of the run: the file name without its ending."""
        return Path(self.source).stem

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the measured channels, in order of appearance."""
        channels = map(signals.parse_channel, self.columns)
        return tuple(dict.fromkeys(c.axis for c in channels if c.axis and not c.truth))

    @property
    def rate(self) -> float:
        """Sample rate [Hz], from the median step."""
        return float(1.0 / np.median(np.diff(self.time)))

    @property
    def gaps(self) -> np.ndarray:
        """Rows (k,) before which samples are missing, or whose time is off by half a step."""
        return np.flatnonzero(count_missing_samples(self.time)) + 1

    def __repr__(self) -> str:
        """Return source, size and channels of the log, without its values."""
        rate = f" at {self.rate:g} Hz" if len(self) > 1 else ""
        return f"Log({self.source!r}, {len(self)} rows{rate}, channels=[{', '.join(self.columns)}])"

    def to_arrow(self) -> "pa.Table":
        """Return the log as a pyarrow table: `time` and one column per channel, of type float64.

        The metadata of each field contain its `unit`; the metadata of the schema are those of the log.
        `pyarrow.Table.to_pandas` makes a data frame of it.
        """
        import pyarrow as pa

        columns = {"time": self.time, **self.columns}
        units = {"time": "s", **self.units}
        fields = [pa.field(name, pa.float64(), nullable=False, metadata={"unit": units[name]}) for name in columns]
        schema = pa.schema(fields, metadata=dict(self.metadata))
        return pa.Table.from_arrays([pa.array(values) for values in columns.values()], schema=schema)

    def without_truth(self) -> "Log":
        """Return the log with measured channels only, as identification code may use them."""
        kept = [name for name in self.columns if not signals.parse_channel(name).truth]
        return replace(self, columns={k: self.columns[k] for k in kept}, units={k: self.units[k] for k in kept})


def find_log_file(path: Path, stem: str = MEASURED_STEM) -> Path:
    """Return the log file of a path: the file itself, or the log called `stem` in a run folder.

    Raises:
        InputError: the log file does not exist.
    """
    if path.is_dir():
        if found := find_log_in_folder(path, stem):
            return found
        raise InputError(path, f"is not a file and holds no {stem}.parquet; give a log file or a run folder")
    if not path.is_file():
        raise InputError(path, "is not a file: it is neither a log file (.parquet, .csv) nor a run folder")
    return path


def find_log_in_folder(folder: Path, stem: str = MEASURED_STEM) -> Path | None:
    """Return the log called `stem` in a run folder, or None for other folders."""
    return next((file for kind in _KINDS if (file := folder / f"{stem}{kind}").is_file()), None)


def load_log(
    path: str | os.PathLike,
    *,
    aliases: Mapping[str, str] | None = None,
    required: Sequence[str] = (),
    minimum_rows: int = 10,
    maximum_dropped: float = 0.0,
    missing: bool = False,
    commands: Mapping[str, CommandRange] | None = None,
) -> Log:
    """Read and check one run from a `.parquet` or `.csv` file or from a run folder.

    Args:
        path: the file, or the folder of a run, whose measured log is read.
        aliases: column name in the file -> channel name. A minus before the channel name inverts
            the sign. The column name `a * b` means the product of two columns without unit. The
            channel name `none` skips a column. Unknown column names are ignored. Logs written by
            hydrotele need no aliases and ignore them.
        required: channels that must be present after renaming.
        minimum_rows: minimum number of rows.
        maximum_dropped: fraction of the samples [1] that may be missing or whose time may be off
            by more than half a step; `Log.gaps` lists them.
        missing: accept NaN, null and empty cells in every column except time; they become NaN.
        commands: command channel -> range of its column, for commands that are not fractions in
            [-1, 1]; ignored for logs written by hydrotele.

    Raises:
        InputError: the file is invalid; the message gives file, column, row and remedy.
    """
    path = find_log_file(Path(path))
    table = read_table(path, missing)
    if "hydrotele" not in table.metadata:
        table = mask_to_valid(_apply_aliases(table, aliases or {}))
        table = normalise_commands(table, commands or {})
    names = table.names
    rows, needed = len(table.values[0]) if names else 0, max(minimum_rows, 2)
    if rows < needed:
        raise InputError(path, f"the run is too short: {rows} rows, {needed} are needed")
    table = check_table(table, required, maximum_dropped, missing)
    columns = dict(zip(names, table.values, strict=True))
    units = dict(zip(names, map(str, table.units), strict=True))
    time = columns.pop("time")
    del units["time"]
    return Log(time, columns, units, table.metadata, str(path))


def _apply_aliases(table: Table, aliases: Mapping[str, str]) -> Table:
    for product, channel in aliases.items():
        factors = product.split(" * ")
        if len(factors) == 2 and set(factors) <= set(table.names):
            a, b = (table.values[table.names.index(name)] for name in factors)
            table = table._replace(
                names=[*table.names, channel], values=[*table.values, a * b],
                units=[*table.units, "1"],
            )  # fmt: skip
    names = [aliases.get(name, name) for name in table.names]
    kept = [place for place, name in enumerate(names) if name != SKIP_COLUMN]
    signs = [-1.0 if names[place].startswith("-") else 1.0 for place in kept]
    return table._replace(
        names=[names[place].removeprefix("-") for place in kept],
        values=[sign * table.values[place] for sign, place in zip(signs, kept, strict=True)],
        units=[table.units[place] for place in kept],
    )


def load_logs(
    path: str | os.PathLike,
    *,
    aliases: Mapping[str, str] | None = None,
    required: Sequence[str] = (),
    minimum_rows: int = 10,
    maximum_dropped: float = 0.0,
) -> tuple[Log, ...]:
    """Read one log file, or all `.parquet` and `.csv` files of a folder, sorted by name.

    If a folder has no such files, the `measured.parquet` or `measured.csv` of each subfolder is
    read. The arguments are those of `load_log`.

    Raises:
        InputError: as for `load_log`; also if the folder has no logs or the same run twice.
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        seen = [p for p in path.iterdir() if not p.name.startswith(".")]
        files = sorted(p for p in seen if p.suffix.lower() in (".parquet", ".csv"))
        files = files or sorted(
            file for p in seen for file in p.glob("measured.*") if file.suffix in (".parquet", ".csv")
        )
    if not files:
        raise InputError(path, "the folder contains no log: add .parquet or .csv files")
    names = Counter(f.stem if f.parent == path else f.parent.name for f in files)
    for run, count in names.items():
        if count > 1:
            raise InputError(path, f"run {run!r} exists {count} times: keep one file of it")
    return tuple(
        load_log(
            file,
            aliases=aliases,
            required=required,
            minimum_rows=minimum_rows,
            maximum_dropped=maximum_dropped,
        )
        for file in files
    )


def save_log(log: Log, path: str | os.PathLike) -> None:
    """Write a log atomically as Parquet: an error leaves an existing file unchanged.

    Raises:
        InputError: a value is not finite, time does not increase, the name does not end in
            .parquet, or the folder is not writable.
    """
    path = Path(path)
    names, values = ["time", *log.columns], [log.time, *log.columns.values()]
    table = Table(str(path), names, values, ["s", *log.units.values()], log.metadata)
    check_values(table, maximum_dropped=np.inf)
    content = _parquet_bytes(log.to_arrow())
    with atomic_file(path, ".parquet") as part, open(part, "xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _parquet_bytes(table: "pa.Table") -> memoryview:
    import pyarrow as pa
    import pyarrow.parquet as pq

    stream = pa.BufferOutputStream()
    pq.write_table(
        table,
        stream,
        compression="zstd",
        use_dictionary=False,  # measured values rarely repeat
        write_page_checksum=True,  # detects damaged files
    )
    return memoryview(stream.getvalue())


def read_table(path: Path, missing: bool = False) -> Table:
    """Read the columns of a log file without checks of names and values.

    Args:
        path: the file.
        missing: read empty cells as NaN instead of refusing them.

    Returns:
        The columns.

    Raises:
        InputError: the file cannot be read.
    """
    if not path.is_file():
        raise InputError(path, "is not a file: give the path of a .parquet or .csv log")
    if path.suffix.lower() == ".csv":
        return read_csv(path, missing)
    if path.suffix.lower() == ".parquet":
        return _read_parquet(path, missing)
    raise InputError(path, f"a log ends in .parquet or .csv, not in {path.suffix!r}")


def _read_parquet(path: Path, missing: bool) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names, values, units = [], [], []
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema, rows = file.schema_arrow, file.metadata.num_rows
            specs = [s for s in schema if not s.name.startswith("__index_level_")]  # pandas index
            for spec in specs:
                _check_numbers(path, spec)
            check_limit(path, "LOG_VALUES", rows * len(specs))
            for spec in specs:  # one by one, to hold only one column in memory twice
                read = file.read(columns=[spec.name])  # may include columns with this prefix
                column = read.column(read.schema.get_all_field_indices(spec.name)[0])
                names.append(spec.name)
                values.append(_to_float_array(f"{path}, column {spec.name!r}", column, missing))
                units.append(_decode_metadata(spec.metadata).get("unit") or None)
        metadata = {k: v for k, v in _decode_metadata(schema.metadata).items() if k != "pandas"}
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(path, f"is not a readable Parquet file, copy it again ({reason})") from error
    return Table(str(path), names, values, units, metadata)


def _check_numbers(path: Path, spec) -> None:
    import pyarrow as pa

    number = pa.types.is_floating(spec.type) or pa.types.is_integer(spec.type)
    if not (number or (pa.types.is_boolean(spec.type) and spec.name in ("valid", "mask"))):
        message = f"contains {spec.type}, not numbers: write it as float64 or remove it"
        raise InputError(f"{path}, column {spec.name!r}", message)


def _to_float_array(where: str, column, missing: bool) -> np.ndarray:
    """Return a Parquet column as (n,) float64, with NaN for null."""
    if column.null_count and not missing:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise InputError(f"{where}, row {row}", "is null: remove the row or enter a value")
    with np.errstate(invalid="ignore"):  # a damaged file may contain signalling NaN
        return column.to_numpy().astype(np.float64)


def _decode_metadata(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}


def _read_only_copy(values: np.ndarray) -> np.ndarray:
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy

"""Logs of machines: time and named columns with units and metadata, read from Parquet or CSV.

`load_log` is the one reader of all commands. It checks channel names, units and plausible magnitudes,
converts columns to SI units, and repairs time stamps; the notes of the log state each repair. A `Log`
therefore contains only known channels in SI units and increasing time. `save_log` writes Parquet.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.core.output import atomic_file
from hydrotele.core.units import canonical_unit, si_unit_and_factor
from hydrotele.logs.table import DATE_UNIT, Table, parse_label, read_table
from hydrotele.logs.time_stamps import repair_time_stamps
from hydrotele.machine import log_channels
from hydrotele.machine.log_channels import (
    allowed_channel_units,
    default_channel_unit,
    parse_channel,
    plausible_magnitude_limits,
    suggest_channel_names,
)
from hydrotele.machine.log_columns import SKIP_COLUMN, LogColumn, log_columns_for

if TYPE_CHECKING:
    import pyarrow as pa

MEASURED_STEM = "measured"  # stem of the measured log in a run folder
LOG_SUFFIXES = (".parquet", ".csv")
_MAX_RANGE_EXCESS = 0.02  # fraction of half a command range that converter readings may exceed it
_DEAD_SENSOR_PRESSURE = 1e-2  # [Pa] maxima below it mean a dead sensor, not a wrong unit


class CommandRange(NamedTuple):
    """Range of a command column: `low` corresponds to -1 and `high` to 1, both in `unit`."""

    unit: str
    low: float
    high: float


def convert_mask_column(table: Table) -> Table:
    """Replace the column `mask` (1 for unusable rows) by the column `valid` (1 for usable rows)."""
    values = [1.0 - column if name == "mask" else column
              for name, column in zip(table.names, table.values, strict=True)]  # fmt: skip
    names = ["valid" if name == "mask" else name for name in table.names]
    return table._replace(names=names, values=values)


def normalise_commands(table: Table, ranges: Mapping[str, CommandRange]) -> Table:
    """Convert command columns in volts, mA or counts to fractions in [-1, 1].

    Columns in percent or as a fraction are not changed here, but by `check_and_convert_table`.
    Commands up to 2 % beyond the range, as converters give them, are clipped to the range.

    Args:
        table: table with channel names.
        ranges: command channel -> values of the column that correspond to -1 and 1, with their
            unit.

    Returns:
        The table with the converted columns.

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
            (si, factor), (own_si, own_factor) = si_unit_and_factor(stated), si_unit_and_factor(own)
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


def check_and_convert_table(table: Table, required: Sequence[str]) -> Table:
    """Check column names, units and magnitudes of a table, and return it in SI units.

    Columns without a unit get the usual one of their channel. NaN is accepted except in the time.

    Args:
        table: content of a file.
        required: channels that must be present.

    Raises:
        InputError: the table is invalid; the message gives column, row and remedy.
    """
    _check_names(table, required)
    si = _to_si_units(table)
    _check_finite(si, missing=True)
    for name, values, unit, stated in zip(si.names, si.values, si.units, table.units, strict=True):
        _check_magnitude(si, name, values, str(unit), stated is not None)
    return si


def check_finite_and_ordered(table: Table) -> None:
    """Check that all values are finite and that time increases.

    Raises:
        InputError: a check fails; the message gives column, row and remedy.
    """
    _check_finite(table, missing=False)
    time = table.values[table.names.index("time")]
    if len(bad := np.flatnonzero(np.diff(time) <= 0.0)):
        row, before = int(bad[0]) + 1, time[bad[0]]
        what = "repeats" if time[row] == before else "goes back"
        message = f"{what} from {before:.10g} to {time[row]:.10g} s: every row needs a later time than the row before"
        raise InputError(table.location("time", row), message)


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
    """Return the error message for missing channels, which lists those present and similar names.

    Args:
        names: the missing channels.
        present: the channels of the log.
    """
    columns = "columns" if len(names) > 1 else "column"
    hints = [
        f"{other!r} may be {name}" for name in names for other in present if name in suggest_channel_names(other)[:1]
    ]
    hint = f" ({'; '.join(hints)}: rename it, or give it an alias in log_columns)" if hints else ""
    return f"needs the {columns} {', '.join(names)}; it has {', '.join(present) or 'none'}{hint}"


def _to_si_units(table: Table) -> Table:
    """Return the table in SI units.

    Raises:
        InputError: a column has a unit that its channel cannot have.
    """
    columns, units, present = [], [], set(table.names)
    for name, values, stated in zip(table.names, table.values, table.units, strict=True):
        if stated is None or (stated == DATE_UNIT and name == "time"):
            unit, factor = default_channel_unit(name, present), 1.0
        elif stated == DATE_UNIT:
            raise InputError(table.location(name), "contains dates, not numbers: only time may be a date")
        else:
            unit, factor = si_unit_and_factor(stated)
        allowed = allowed_channel_units(name)
        if unit not in allowed:
            remedy = "correct the unit, or rename the column to a channel with this unit"
            if name.startswith("command."):
                axis = name.removeprefix("command.")
                remedy = (
                    "correct the unit, state the range in the machine file, such as"
                    f" axes.{axis}: {{command_unit: {stated}, command_range: [-30, 30]}}, or give `scale` and unit 1 in"
                    " log_columns"
                )
            raise InputError(
                table.location(name),
                f"has the unit {stated!r}; a log needs {' or '.join(allowed)}, to which it cannot be converted:"
                f" {remedy}",
            )
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


def count_missing_samples(time: np.ndarray) -> np.ndarray:
    """Return the number of samples (n - 1,) that are missing in each step between time stamps (n,) [s].

    A step that differs from the median step by at most half of it has 0. For longer steps the
    number is step over median minus 1, rounded. Shorter steps are irregular and count as 1.
    """
    with np.errstate(all="ignore"):
        step = np.diff(time)
        deviation = np.abs(step / np.median(step) - 1.0) if len(step) else step
    return np.where(deviation <= 0.5, 0.0, np.clip(np.nan_to_num(np.rint(deviation), nan=1.0), 1.0, 1e12))


def _check_magnitude(table: Table, name: str, values: np.ndarray, unit: str, stated: bool) -> None:
    """Check that the magnitudes of a column are plausible for its unit, to find wrong units.

    A column `valid` must contain only 0 and 1.

    Args:
        table: table of the column, for messages.
        name: channel.
        values: (n,) values [unit].
        unit: SI unit.
        stated: whether the file states the unit; the limits are then wider.

    Raises:
        InputError: a value is not plausible; the message names the unit that the values probably
            have.
    """
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return
    if name == "valid" and len(bad := np.flatnonzero((values != 0.0) & (values != 1.0))):
        if not np.isnan(values[bad]).all():
            row = int(bad[~np.isnan(values[bad])][0])
            remedy = "write 1 for usable rows and 0 for others"
            raise InputError(table.location(name, row), f"is {values[row]:g}: {remedy}")
    limits = plausible_magnitude_limits(name, unit, stated=stated)
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


@dataclass(frozen=True, eq=False)
class Log:
    """One measured or simulated run of a machine. The arrays are copied and read-only.

    Attributes:
        time: (n,) float64 [s], strictly increasing.
        columns: channel name (see `machine.log_channels`) -> (n,) float64 in the unit of `units`.
        units: channel name -> SI unit; the same keys as `columns`.
        metadata: metadata such as machine and sensors; structures as JSON text.
        source: file of the log, or the name of the program part that created it.
        origin: time stamp in the file that corresponds to time 0 [s]; 0 unless the stamps are
            calendar time.
        notes: repairs by the reader, one sentence each.

    Raises:
        ValueError: a column has another length than time, no unit, an unknown channel name, or a
            unit that its kind does not allow.
        TypeError: a metadata key or value is not a string.

    Examples:
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> time = np.arange(0.0, 1.0, 0.02)
        >>> log = ht.Log(time, {"angle.boom": 0.1 * time}, {"angle.boom": "rad"}, {"machine": "cat215"})
        >>> log
        Log('memory', 50 rows at 50 Hz, channels=[angle.boom])
        >>> float(log["angle.boom"][-1].round(3))  # rad
        0.098
        >>> log.to_arrow().schema.field("angle.boom").metadata
        {b'unit': b'rad'}

        A channel name that hydrotele does not know is an error.

        >>> try:
        ...     ht.Log(time, {"angle_boom": 0.1 * time}, {"angle_boom": "rad"})
        ... except ValueError as error:
        ...     print(str(error).partition("?")[0])
        unknown channel 'angle_boom'; did you mean angle.boom
    """

    time: np.ndarray
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    metadata: Mapping[str, str] = field(default_factory=dict)
    source: str = "memory"
    origin: float = 0.0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Copy the arrays, make them read-only and check the columns."""
        object.__setattr__(self, "time", _read_only_copy(self.time))
        object.__setattr__(self, "columns", {k: _read_only_copy(v) for k, v in self.columns.items()})
        object.__setattr__(self, "units", dict(self.units))
        object.__setattr__(self, "metadata", dict(self.metadata))
        if self.time.ndim != 1 or self.columns.keys() != self.units.keys():
            raise ValueError("time must be (n,), and columns and units must have the same keys")
        for name, values in self.columns.items():
            allowed = log_channels.allowed_channel_units(name)
            if name == "time" or values.shape != self.time.shape or self.units[name] not in allowed:
                expected = f"{self.time.shape} in {' or '.join(allowed)}"
                raise ValueError(f"{name}: expected {expected}, got {values.shape} in {self.units[name]!r}")
        if not all(isinstance(text, str) for item in self.metadata.items() for text in item):
            raise TypeError("metadata must be strings: write structures with json.dumps")

    def __len__(self) -> int:
        """Return the number of rows n."""
        return len(self.time)

    def __contains__(self, name: object) -> bool:
        """Return whether the log has a channel of this name; `time` counts as a channel."""
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
        """Names of the axes of all channels except `truth.*`, in order of appearance."""
        channels = map(log_channels.parse_channel, self.columns)
        return tuple(dict.fromkeys(c.axis for c in channels if c.axis and not c.truth))

    @property
    def rate(self) -> float:
        """Sample rate [Hz], from the median step."""
        return float(1.0 / np.median(np.diff(self.time)))

    @property
    def gaps(self) -> np.ndarray:
        """Indices (k,) of the rows whose time step from the previous row differs from the median by more than half."""
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
        """Return the log without the `truth.*` channels, which only a simulator knows."""
        kept = [name for name in self.columns if not log_channels.parse_channel(name).truth]
        return replace(self, columns={k: self.columns[k] for k in kept}, units={k: self.units[k] for k in kept})


def find_log_in_folder(folder: Path, stem: str = MEASURED_STEM) -> Path | None:
    """Return the file `<stem>.parquet` or `<stem>.csv` of a run folder; None if the folder has neither."""
    return next((file for kind in LOG_SUFFIXES if (file := folder / f"{stem}{kind}").is_file()), None)


def load_log(
    path: str | os.PathLike,
    *,
    aliases: Mapping[str, str | LogColumn] | None = None,
    required: Sequence[str] = (),
    minimum_rows: int = 10,
    complete: bool = False,
    commands: Mapping[str, CommandRange] | None = None,
) -> Log:
    r"""Read and check one run from a `.parquet` or `.csv` file or from a run folder.

    Empty cells become NaN, rows may be missing (`Log.gaps` lists them), and time stamps are
    repaired, see `time_stamps.repair_time_stamps`; the notes of the log state the repairs.

    Args:
        path: the file, or the folder of a run, whose measured log is read.
        aliases: column name in the file -> channel, as a text or with a conversion, see
            `machine.log_columns`. The column name `a * b` means the product of two columns without
            unit. Unknown column names are ignored. The file `log_columns.yaml` in the folder of the
            log adds aliases. Logs written by hydrotele need no aliases and ignore them.
        required: channels that must be present after renaming.
        minimum_rows: minimum number of rows.
        complete: refuse empty cells and time stamps that need a repair, for tables of commands.
        commands: command channel -> range of its column, for commands that are not fractions in
            [-1, 1]; ignored for logs written by hydrotele.

    Returns:
        The log in SI units.

    Raises:
        InputError: the file is invalid; the message gives file, column, row and remedy.

    Examples:
        A CSV file with units in its header is read in SI units.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> rows = "\n".join(f"{0.02 * k:.2f},{10 + k},{80 + k}" for k in range(20))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "run.csv")
        ...     _ = path.write_text(f"time,angle.boom [deg],pressure_head.boom [bar]\n{rows}\n")
        ...     log = ht.load_log(path)
        >>> log.units["pressure_head.boom"], float(log["pressure_head.boom"][0])
        ('Pa', 8000000.0)
        >>> round(float(log["angle.boom"][0]), 4)  # rad
        0.1745
    """
    path = Path(path)
    if path.is_dir():
        if not (found := find_log_in_folder(path)):
            message = f"is not a file and holds no {MEASURED_STEM}.parquet; give a log file or a run folder"
            raise InputError(path, message)
        path = found
    table = read_table(path, missing=True)
    if "hydrotele" not in table.metadata:
        table = _apply_aliases(table, log_columns_for(path, aliases or {}))
        table = normalise_commands(convert_mask_column(table), commands or {})
    return make_log(table, required, minimum_rows, complete)


def make_log(table: Table, required: Sequence[str] = (), minimum_rows: int = 10, complete: bool = False) -> Log:
    """Make a log from a table with channel names: check it, convert it to SI units and repair its time stamps.

    The arguments and errors are those of `load_log`.
    """
    for name in table.names:
        if name in table.faults:
            raise table.faults[name]
    rows, needed = len(table.values[0]) if table.names else 0, max(minimum_rows, 2)
    if rows < needed:
        raise InputError(table.source, f"the run is too short: {rows} rows, {needed} are needed")
    table = check_and_convert_table(table, required)
    if complete:
        check_finite_and_ordered(table)
    table, origin, notes = repair_time_stamps(table, needed)
    columns = dict(zip(table.names, table.values, strict=True))
    units = dict(zip(table.names, map(str, table.units), strict=True))
    time = columns.pop("time")
    del units["time"]
    return Log(time, columns, units, table.metadata, table.source, origin, notes)


def _apply_aliases(table: Table, aliases: Mapping[str, LogColumn]) -> Table:
    """Rename and convert the columns of a table by aliases, which may also combine or skip columns.

    Args:
        table: table with the column names of the file.
        aliases: column name -> channel and conversion; see `load_log`.

    Raises:
        InputError: an alias contradicts the unit of the file, or subtracts a column that the file does not have.
    """
    for product in aliases:
        factors = product.split(" * ")
        if len(factors) == 2 and set(factors) <= set(table.names):
            a, b = (table.values[table.names.index(name)] for name in factors)
            table = table._replace(
                names=[*table.names, product], values=[*table.values, a * b], units=[*table.units, None],
            )  # fmt: skip
    by_name = {parse_label(name)[0]: alias for name, alias in aliases.items()} | dict(aliases)
    subtracted = {parse_label(alias.minus)[0] for name, alias in by_name.items() if alias.minus and name in table.names}
    if missing := sorted(subtracted - set(table.names)):
        has = ", ".join(table.names)
        raise InputError(table.source, f"has no column {missing[0]!r}, which log_columns subtracts; it has {has}")
    names, values, units, faults = [], [], [], {}
    for name, column, unit in zip(table.names, table.values, table.units, strict=True):
        alias = by_name.get(name, LogColumn(channel=SKIP_COLUMN if name in subtracted else name))
        if alias.channel == SKIP_COLUMN:
            continue
        if alias.unit and unit and canonical_unit(alias.unit) != canonical_unit(unit) and alias.scale == 1.0:
            message = f"has the unit {unit!r}, but log_columns states {alias.unit!r}: remove the wrong unit"
            raise InputError(table.location(name), message)
        minus = None
        if alias.minus:
            place = table.names.index(parse_label(alias.minus)[0])
            minus = table.values[place]
            if table.units[place] and unit and canonical_unit(str(table.units[place])) != canonical_unit(unit):
                message = f"has the unit {unit!r}, but {alias.minus}, which is subtracted, has {table.units[place]!r}"
                raise InputError(table.location(name), f"{message}: write both in the same unit")
        names.append(alias.channel)
        values.append(alias.convert(column, minus))
        units.append(alias.unit or unit)
        if name in table.faults:
            faults[names[-1]] = table.faults[name]
    return table._replace(names=names, values=values, units=units, faults=faults)


def load_logs(
    path: str | os.PathLike,
    *,
    aliases: Mapping[str, str | LogColumn] | None = None,
    required: Sequence[str] = (),
    minimum_rows: int = 10,
) -> tuple[Log, ...]:
    """Read one log file, all logs of a folder, a run folder, or a folder of run folders, sorted by name.

    The arguments are those of `load_log`.

    Raises:
        InputError: as for `load_log`; also if the folder has no logs or the same run twice.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name, amplitude in ("a", 0.1), ("b", 0.2):
        ...         log = ht.Log(time, {"angle.boom": amplitude * np.sin(6 * time)}, {"angle.boom": "rad"})
        ...         ht.save_log(log, Path(folder, f"{name}.parquet"))
        ...     logs = ht.load_logs(folder)
        >>> [(Path(log.source).name, round(float(np.ptp(log["angle.boom"])), 2)) for log in logs]
        [('a.parquet', 0.2), ('b.parquet', 0.4)]
    """
    path = Path(path)
    found = find_logs(path)
    for run, count in Counter(name for name, _ in found).items():
        if count > 1:
            raise InputError(path, f"run {run!r} exists {count} times: keep one file of it")
    return tuple(load_log(file, aliases=aliases, required=required, minimum_rows=minimum_rows) for _, file in found)


def find_logs(path: Path) -> list[tuple[str, Path]]:
    """Return (run name, file) of every log at a path, sorted by name.

    A path is a log file, a folder of logs, a run folder, whose measured log is taken, or a folder of
    run folders.

    Raises:
        InputError: the path does not exist or has no log.
    """
    if not path.exists():
        raise InputError(path, "does not exist: give log files or a folder with logs")
    if path.is_file():
        return [(path.stem if path.stem != MEASURED_STEM else resolve_path(path).parent.name, path)]
    if not path.is_dir():
        raise InputError(path, "is neither a file nor a folder: give log files or a folder")
    seen = sorted(p for p in path.iterdir() if not p.name.startswith("."))
    if record := find_log_in_folder(path):
        return [(resolve_path(path).name, record)]
    files = [(p.stem, p) for p in seen if p.is_file() and p.suffix.lower() in LOG_SUFFIXES]
    if not files:
        files = [(p.name, f) for p in seen if p.is_dir() and (f := find_log_in_folder(p))]
    if not files:
        raise InputError(path, "the folder contains no log: add .parquet or .csv files")
    return files


def save_log(log: Log, path: str | os.PathLike, *, missing: bool = False) -> None:
    """Write a log to a Parquet file, which an error during writing leaves unchanged if it exists.

    `missing` allows NaN for readings that are missing.

    Raises:
        InputError: a value is not finite, time does not increase, the name does not end in
            .parquet, or the folder is not writable.

    Examples:
        The file keeps units and metadata; a reading that is not finite is refused unless `missing` allows it.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> time, pressure = np.arange(0.0, 1.0, 0.02), np.full(50, 8.0e6)
        >>> pressure[7] = np.nan
        >>> name = "pressure_head.boom"
        >>> log = ht.Log(time, {name: pressure}, {name: "Pa"}, {"machine": "cat215"})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "run.parquet")
        ...     try:
        ...         ht.save_log(log, path)
        ...     except ht.InputError as error:
        ...         print(error.message)
        ...     ht.save_log(log, path, missing=True)
        ...     read = ht.load_log(path)
        is nan: remove the row or enter a value
        >>> read.metadata["machine"], int(np.isnan(read[name]).sum())
        ('cat215', 1)
    """
    path = Path(path)
    names, values = ["time", *log.columns], [log.time, *log.columns.values()]
    table = Table(str(path), names, values, ["s", *log.units.values()], log.metadata)
    if missing:
        _check_finite(table, missing=True)
        table = table._replace(names=names[:1], values=values[:1])
    check_finite_and_ordered(table)
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


def _read_only_copy(values: np.ndarray) -> np.ndarray:
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy

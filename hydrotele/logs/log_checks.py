"""What a file must satisfy to become a Log: names, units, finite values, time, magnitudes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.units import canonical_unit, to_si
from hydrotele.machine.signals import allowed_units, magnitude_limits, parse_channel, usual_unit

_PLAY = 0.02  # of half a command's range, by which a converter may read beyond it
_LONGEST_STEP = 1.0  # [s] slower than any log of a hydraulic machine
_NOTHING = 1e-2  # [Pa] no unit makes less a working pressure; a dead sensor is no unit error


class CommandRange(NamedTuple):
    """What a log's command column holds: `low` stands for -1 and `high` for 1, both in `unit`."""

    unit: str
    low: float
    high: float


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


def with_valid(table: Table) -> Table:
    """A column `mask`, 1 where a row may not be used, as the column `valid`, 1 where it may."""
    values = [1.0 - column if name == "mask" else column
              for name, column in zip(table.names, table.values, strict=True)]  # fmt: skip
    names = ["valid" if name == "mask" else name for name in table.names]
    return table._replace(names=names, values=values)


def in_range(table: Table, ranges: Mapping[str, CommandRange]) -> Table:
    """Commands in volts, mA, counts or whatever the machine states, as fractions in [-1, 1].

    A column whose own unit is a fraction or percent is left to the usual conversion. Readings up
    to 2 % beyond the range, a converter's play, count as its end.

    Args:
        table: as read, with the channels' names.
        ranges: command channel -> what its column holds.

    Raises:
        InputError: a column is in another unit or goes beyond its range; says what to correct.
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
                    table.where(name),
                    f"is in {stated!r}, the machine's commands are in {own!r}: correct"
                    f" axes.{axis}.command_unit in the machine file, or convert the column",
                )
            column = column * (factor / own_factor)
        middle, half = 0.5 * (known.low + known.high), 0.5 * (known.high - known.low)
        share = (column - middle) / half
        if len(beyond := np.flatnonzero(np.abs(share) > 1.0 + _PLAY)):
            row = int(beyond[0])
            raise InputError(
                table.where(name, row),
                f"is {column[row]:g} {own}, beyond the machine's command_range {known.low:g} .."
                f" {known.high:g} {own}: correct axes.{axis}.command_range in the machine file, or"
                " the column",
            )
        values[place], units[place] = np.clip(share, -1.0, 1.0), "1"
    return table._replace(values=values, units=units)


def checked(
    table: Table, required: Sequence[str], maximum_dropped: float, missing: bool = False
) -> Table:
    """Check a table and return it with every column in a SI unit, assumed where none is stated.

    Args:
        table: as read.
        required: channels that must be there.
        maximum_dropped: fraction of the samples that may be missing [1].
        missing: accept NaN in every column but time.

    Raises:
        InputError: the first offence, with column and row and what to do.
    """
    _check_names(table, required)
    si = _in_si(table)
    check_values(si, maximum_dropped, missing)
    for name, values, unit, stated in zip(si.names, si.values, si.units, table.units, strict=True):
        _check_magnitude(si, name, values, str(unit), stated is not None)
    return si


def check_values(table: Table, maximum_dropped: float, missing: bool = False) -> None:
    """Refuse values that are not finite, and a time that does not rise or lacks samples.

    Args:
        table: in SI.
        maximum_dropped: fraction of the samples that may be missing [1].
        missing: accept NaN in every column but time.

    Raises:
        InputError: the first offence, with column and row and what to do.
    """
    _check_finite(table, missing)
    _check_time(table, maximum_dropped)


def _check_names(table: Table, required: Sequence[str]) -> None:
    for name in table.names:
        try:
            parse_channel(name)
        except ValueError as error:
            raise InputError(
                table.where(name),
                f"{error}. Rename it, give it an alias or remove it"
                " (log_columns in the machine file gives aliases; none leaves a column out)",
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


def _check_finite(table: Table, missing: bool) -> None:
    for name, values in zip(table.names, table.values, strict=True):
        allowed = missing and name != "time"
        bad = np.flatnonzero(np.isinf(values) if allowed else ~np.isfinite(values))
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
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return
    if name == "valid" and len(bad := np.flatnonzero((values != 0.0) & (values != 1.0))):
        if not np.isnan(values[bad]).all():
            row = int(bad[~np.isnan(values[bad])][0])
            remedy = "write 1 where the row may be used and 0 where not"
            raise InputError(table.where(name, row), f"is {values[row]:g}: {remedy}")
    limits = magnitude_limits(name, unit, stated=stated)
    target = unit if stated else f"{unit} and state the unit"
    if unit == "1":
        axis = name.partition(".")[2]
        target = (
            "values in [-1, 1], or state in the machine file what they are, such as"
            f" axes.{axis}: {{command_unit: V, command_range: [-10, 10]}}"
        )
    remedy = f"looks like {limits.looks_like}, write {target}"
    size = np.nan_to_num(np.abs(values))
    if len(high := np.flatnonzero(size > limits.largest)):
        row = int(high[0])
        raise InputError(table.where(name, row), f"is {values[row]:g}: {remedy}")
    if _NOTHING < size.max() < limits.smallest:
        row = int(np.argmax(size))
        raise InputError(table.where(name, row), f"never exceeds {size[row]:g}: {remedy}")

"""Table of a sweep with one row per run, units of the columns, and statistics over all runs."""

import json
import os
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import hydrotele
from hydrotele.core.output import atomic_file
from hydrotele.run.sweep_file import Sweep, iterate_points
from hydrotele.run.sweep_journal import JournalEntry
from hydrotele.run.sweep_task import key_unit


class SweepTable(NamedTuple):
    """Table of a sweep with one row per run.

    Attributes:
        columns: column name -> values; None for a missing value.
        units: column name -> unit, for columns with a unit.
        varied_keys: names of the varied keys.
        number_names: names of the summary numbers.
    """

    columns: dict[str, list[Any]]
    units: dict[str, str]
    varied_keys: tuple[str, ...]
    number_names: tuple[str, ...]


def make_table(
    sweep: Sweep, seed: int, entries: Mapping[int, JournalEntry], effect_units: Mapping[str, str]
) -> SweepTable:
    """Create the table of all runs of a sweep.

    Args:
        sweep: the sweep.
        seed: seed of the first run, used if the seed is not varied.
        entries: run number -> journal entry, for all runs.
        effect_units: varied effect parameter -> unit.

    Returns:
        Table with the columns `run`, varied keys, `seed`, `status`, `reason`, `notes`, numbers.
    """
    rows = list(iterate_points(sweep))
    varied = tuple(key for key in sweep.varied_keys if key != "seed")
    units = {key: unit for key in varied if (unit := effect_units.get(key) or key_unit(key))}
    columns: dict[str, list[Any]] = {"run": [point.run for point in rows]}
    columns |= {key: [point.values[key] for point in rows] for key in varied}
    columns["seed"] = [point.values.get("seed", seed) + point.repetition_number for point in rows]
    found = [entries[point.run] for point in rows]
    for name in ("status", "reason", "notes"):
        columns[name] = [getattr(entry, name) for entry in found]
    known = {name: unit for entry in found for name, (_, unit) in entry.numbers.items()}
    for name, unit in known.items():
        columns[name] = [entry.numbers.get(name, (None, unit))[0] for entry in found]
    return SweepTable(columns, units | known, varied, tuple(known))


def save_table(table: SweepTable, name: str, path: Path) -> None:
    """Write the table atomically as a Parquet file with units; equal runs give identical files.

    Args:
        table: the table.
        name: name of the sweep, for the metadata of the file.
        path: file to write.

    Raises:
        InputError: the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields, arrays = [], []
    for column, values in table.columns.items():
        array = _to_arrow_array(pa, values)
        metadata = {"unit": table.units[column]} if column in table.units else None
        fields.append(pa.field(column, array.type, metadata=metadata))
        arrays.append(array)
    facts = {"sweep": name, "hydrotele": hydrotele.__version__,
             "varied": json.dumps(table.varied_keys)}  # fmt: skip
    schema = pa.schema(fields, metadata=facts)
    with atomic_file(path, ".parquet") as part:
        pq.write_table(pa.Table.from_arrays(arrays, schema=schema), part, compression="zstd")
        with open(part, "rb") as file:
            os.fsync(file.fileno())


def _to_arrow_array(pa, values: Sequence[Any]):
    """Return a column as an Arrow array of booleans, integers, floats or text.

    A column with other or mixed values becomes text: strings stay as they are, the others become
    JSON.

    Args:
        pa: the module pyarrow.
        values: values of the column, None where missing.
    """
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pa.array(values, pa.bool_())
    if kinds == {int} and all(v is None or abs(v) < 2**63 for v in values):
        return pa.array(values, pa.int64())
    if kinds <= {int, float} and kinds != {int}:
        return pa.array([None if v is None else float(v) for v in values], pa.float64())
    return pa.array([v if v is None or isinstance(v, str) else json.dumps(v) for v in values], pa.string())


_MAX_FIGURES = 6
_TIP_FIGURES = ("tracking.tip_r.rms", "tracking.tip_z.rms", "tracking.tip_attitude.rms")
_FORCE_AND_BALANCE_FIGURES = (
    "max_contact_force_N", "teleoperation.max_tip_force_N",
    "teleoperation.min_handle_energy_J", "max_pin_opening_mm", "balance.energy_balance",
)  # fmt: skip


def choose_plotted_numbers(table: SweepTable) -> list[str]:
    """Return the names of up to six numbers to plot: RMS tracking errors first, then forces and balances.

    The tracking errors of the tip precede those of the axes, which come last if there are errors of
    the tip. Only numbers that differ between the runs are chosen.
    """
    axes = [n for n in table.number_names if n.startswith("tracking.") and n.endswith(".rms")]
    followed = [n for n in _TIP_FIGURES if n in axes] or axes
    ordered = dict.fromkeys([*followed, *(n for n in _FORCE_AND_BALANCE_FIGURES if n in table.number_names), *axes])
    return [name for name in ordered if len(set(_values_by_run(table, name).values())) > 1][:_MAX_FIGURES]


def _values_by_run(table: SweepTable, name: str) -> dict[int, float]:
    """Return run number -> value of a column, without missing values."""
    values = table.columns.get(name, [])
    return {run: float(v) for run, v in zip(table.columns["run"], values, strict=False)
            if v is not None}  # fmt: skip


def compute_statistics(table: SweepTable, figures: list[str]) -> dict[str, dict[str, Any]]:
    """Return minimum, median and maximum over all runs of some columns.

    Args:
        table: table of the sweep.
        figures: column names.

    Returns:
        Column name -> `unit`, `min`, `median`, `max`, and `min_run` and `max_run`, the numbers of
        the runs with minimum and maximum. Columns without values are omitted.
    """
    found = {}
    for name in figures:
        known = _values_by_run(table, name)
        if known:
            low, high = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
            found[name] = {
                "unit": table.units.get(name, "1"), "min": known[low], "min_run": low,
                "median": statistics.median(known.values()), "max": known[high], "max_run": high,
            }  # fmt: skip
    return found

"""The table of a sweep: a row per run, with a unit in every column that has one.

Which numbers of a sweep are shown, and how far they spread.
"""

import json
import os
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import hydrotele
from hydrotele.core.output import replacing
from hydrotele.run.sweep_facts import Sweep, points
from hydrotele.run.sweep_runs import Entry, key_unit


class SweepTable(NamedTuple):
    """Columns of one length, in order of the runs.

    Attributes:
        columns: name -> values; None where there is none.
        units: name -> unit, of those that have one.
        varied: the keys that were varied.
        figures: the numbers of the runs.
    """

    columns: dict[str, list[Any]]
    units: dict[str, str]
    varied: tuple[str, ...]
    figures: tuple[str, ...]


def make_table(
    sweep: Sweep, seed: int, entries: Mapping[int, Entry], effect_units: Mapping[str, str]
) -> SweepTable:
    """The table of all runs.

    Args:
        sweep: what was asked.
        seed: of the base scenario.
        entries: run number -> what is known of it; all of them.
        effect_units: varied key of an effect -> unit.

    Returns:
        Columns `run`, the varied keys, `seed`, `status`, `reason`, `notes`, and the numbers.
    """
    rows = list(points(sweep))
    varied = tuple(key for key in sweep.varied if key != "seed")
    units = {key: unit for key in varied if (unit := effect_units.get(key) or key_unit(key))}
    columns: dict[str, list[Any]] = {"run": [point.run for point in rows]}
    columns |= {key: [point.values[key] for point in rows] for key in varied}
    columns["seed"] = [point.values.get("seed", seed) + point.copy for point in rows]
    found = [entries[point.run] for point in rows]
    for name in ("status", "reason", "notes"):
        columns[name] = [getattr(entry, name) for entry in found]
    known = {name: unit for entry in found for name, (_, unit) in entry.numbers.items()}
    for name, unit in known.items():
        columns[name] = [entry.numbers.get(name, (None, unit))[0] for entry in found]
    return SweepTable(columns, units | known, varied, tuple(known))


def save_table(table: SweepTable, name: str, path: Path) -> None:
    """Write the table as Parquet, whole or not at all; the same runs give the same bytes.

    Args:
        table: the table.
        name: of the sweep, for the file's metadata.
        path: file to write.

    Raises:
        InputError: it cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields, arrays = [], []
    for column, values in table.columns.items():
        array = _array(pa, values)
        metadata = {"unit": table.units[column]} if column in table.units else None
        fields.append(pa.field(column, array.type, metadata=metadata))
        arrays.append(array)
    facts = {"sweep": name, "hydrotele": hydrotele.__version__,
             "varied": json.dumps(table.varied)}  # fmt: skip
    schema = pa.schema(fields, metadata=facts)
    with replacing(path, ".parquet") as part:
        pq.write_table(pa.Table.from_arrays(arrays, schema=schema), part, compression="zstd")
        with open(part, "rb") as file:
            os.fsync(file.fileno())


def _array(pa, values: Sequence[Any]):
    """A column: truth values, whole numbers, numbers, or text for everything else, as JSON."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pa.array(values, pa.bool_())
    if kinds == {int} and all(v is None or abs(v) < 2**63 for v in values):
        return pa.array(values, pa.int64())
    if kinds <= {int, float} and kinds != {int}:
        return pa.array([None if v is None else float(v) for v in values], pa.float64())
    return pa.array(
        [v if v is None or isinstance(v, str) else json.dumps(v) for v in values], pa.string()
    )


_MOST = 6
_FIRST = ("tracking.tip_r.rms", "tracking.tip_z.rms", "tracking.tip_attitude.rms")
_LAST = (
    "largest_contact_force_N", "teleoperation.largest_tip_force_N",
    "teleoperation.handle_least_energy_J", "largest_pin_opening_mm", "balance.energy_balance",
)  # fmt: skip


def default_figures(table: SweepTable) -> list[str]:
    """At most six numbers that differ between runs: tracking first, then forces and balances."""
    axes = [n for n in table.figures if n.startswith("tracking.") and n.endswith(".rms")]
    followed = [n for n in _FIRST if n in axes] or axes
    ordered = dict.fromkeys([*followed, *(n for n in _LAST if n in table.figures), *axes])
    return [name for name in ordered if len(set(_known(table, name).values())) > 1][:_MOST]


def _known(table: SweepTable, name: str) -> dict[int, float]:
    """Run -> value of a number, where there is one."""
    values = table.columns.get(name, [])
    return {run: float(v) for run, v in zip(table.columns["run"], values, strict=False)
            if v is not None}  # fmt: skip


def spread_statistics(table: SweepTable, figures: list[str]) -> dict[str, dict[str, Any]]:
    """Smallest, median and largest value of numbers, with the runs that have them."""
    found = {}
    for name in figures:
        known = _known(table, name)
        if known:
            low, high = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
            found[name] = {
                "unit": table.units.get(name, "1"), "min": known[low], "min_run": low,
                "median": statistics.median(known.values()), "max": known[high], "max_run": high,
            }  # fmt: skip
    return found

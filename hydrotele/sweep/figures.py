"""Which numbers of a sweep are shown, and how far they spread."""

import statistics
from typing import Any

from hydrotele.sweep.table import Table

_MOST = 6
_FIRST = ("tracking.tip_r.rms", "tracking.tip_z.rms", "tracking.tip_attitude.rms")
_LAST = (
    "largest_contact_force_N", "teleoperation.largest_tip_force_N",
    "teleoperation.handle_least_energy_J", "largest_pin_opening_mm", "balance.energy_balance",
)  # fmt: skip


def default_figures(table: Table) -> list[str]:
    """At most six numbers that differ between runs: tracking first, then forces and balances."""
    axes = [n for n in table.figures if n.startswith("tracking.") and n.endswith(".rms")]
    followed = [n for n in _FIRST if n in axes] or axes
    ordered = dict.fromkeys([*followed, *(n for n in _LAST if n in table.figures), *axes])
    return [name for name in ordered if len(set(_known(table, name).values())) > 1][:_MOST]


def _known(table: Table, name: str) -> dict[int, float]:
    """Run -> value of a number, where there is one."""
    values = table.columns.get(name, [])
    return {run: float(v) for run, v in zip(table.columns["run"], values, strict=False)
            if v is not None}  # fmt: skip


def spreads(table: Table, figures: list[str]) -> dict[str, dict[str, Any]]:
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

"""The equations of all runs to fit, one below the other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.equations import build_equations, stacked
from hydrotele.identify.motion import Processing, Resolution
from hydrotele.identify.record import Record
from hydrotele.identify.regressor import Regressor
from hydrotele.identify.setup import Setup

_LEAST = 4.0  # periods of the band that a run must have: its low-pass takes three
_WHERE = "identification"


@dataclass(frozen=True)
class Gathered:
    """Equations of some runs; n of them, k drives whose forces are known, m parameters.

    Attributes:
        runs: the runs that are long enough, and what their positions resolve.
        table: a regressor without rows: names, units and nominal values; all drives.
        columns: places of the k drives among the table's.
        rows: which of the runs' stacked equations are the n.
        starts: at which of the stacked equations every run starts, and their number.
        spacing: between the equations of every run [s].
        matrix: (n, k, m).
        force: (n, k) [N] or [N m].
        doubt: (n, k) of the signs of dry friction.
        notes: on what was left out.
    """

    runs: tuple[tuple[Record, Resolution], ...]
    table: Regressor
    columns: list[int]
    rows: np.ndarray
    starts: np.ndarray
    spacing: tuple[float, ...]
    matrix: np.ndarray
    force: np.ndarray
    doubt: np.ndarray
    notes: tuple[str, ...]

    @property
    def drives(self) -> tuple[str, ...]:
        """The k drives whose forces are known."""
        return tuple(self.table.drives[k] for k in self.columns)

    def spread(self, values: np.ndarray, run: int) -> np.ndarray:
        """Values (p, n, k) of the equations of one run, with 0 for rows and drives not used.

        Args:
            values: (p, n, k) of all.
            run: its place.

        Returns:
            (p, equations of the run, all drives).
        """
        out = np.zeros((len(values), len(self.rows), len(self.table.drives)))
        places = np.flatnonzero(self.rows)
        for c, column in enumerate(self.columns):
            out[:, places, column] = values[:, :, c]
        return out[:, self.starts[run] : self.starts[run + 1]]

    def cycle_on(self, values: np.ndarray, period: float) -> np.ndarray:
        """Values one period later, or earlier where the run ends before.

        Args:
            values: (n, ...) at every row.
            period: of the repeated motion [s].

        Returns:
            (n, ...), NaN where there is neither.

        Raises:
            InputError: a run is shorter than two periods, or a period than two equations.
        """
        whole = np.full((len(self.rows), *values.shape[1:]), np.nan)
        whole[self.rows] = values
        for k, (record, _) in enumerate(self.runs):
            if len(record.force) * record.period < 2.0 * period:
                raise InputError(
                    record.name, f"does not repeat its motion: two periods of {period:g} s at least"
                )
            if (step := round(period / self.spacing[k])) < 1:
                raise InputError(
                    record.name, f"a period of {period:g} s is shorter than the time between"
                    f" equations, {self.spacing[k]:.3g} s: no motion of this band repeats so fast",
                )  # fmt: skip
            own = slice(self.starts[k], self.starts[k + 1])
            whole[own] = cycle_on(whole[own], step)
        return whole[self.rows]


def cycle_on(values: np.ndarray, step: int) -> np.ndarray:
    """Values (n, ...) `step` rows later, or earlier where there are none; NaN without both."""
    later, earlier = np.full((2, *values.shape), np.nan)
    later[:-step], earlier[step:] = values[step:], values[:-step]
    return np.where(np.isnan(later), earlier, later)


def gather(
    runs: Sequence[tuple[Record, Resolution]], setup: Setup, processing: Processing
) -> Gathered:
    """Equations of all runs.

    Args:
        runs: records, and what their positions resolve.
        setup: what the regressor is built of.
        processing: how positions are differentiated; it has a band.

    Returns:
        The equations.

    Raises:
        InputError: no drive has a force, or all runs are too short.
    """
    band = processing.band
    assert band
    kept, made, notes = [], [], []
    for record, found in runs:
        if len(record.force) * record.period * band < _LEAST:
            notes.append(f"{record.name} is too short for a band of {band:.3g} Hz; left out.")
            continue
        made.append(build_equations(record, setup, processing, found))
        kept.append((record, found))
    if not made:
        raise InputError(_WHERE, f"all runs are too short for a band of {band:.3g} Hz: log longer")
    table, equations = made[0][1], [e for e, _ in made]
    force = stacked(equations, lambda e: e.force)
    columns = [k for k in range(force.shape[1]) if np.isfinite(force[:, k]).any()]
    if not columns:
        raise InputError(_WHERE, "no drive has a known force in any run: log both its pressures")
    rows = np.asarray(np.isfinite(force[:, columns]).all(axis=1))
    notes += [
        f"{e.name} lacks the force of {', '.join(lost)} throughout; left out."
        for e in equations
        if (lost := [table.drives[k] for k in columns if np.isnan(e.force[:, k]).all()])
    ]
    if not rows.any():
        raise InputError(_WHERE, "no run has the forces of all drives that any run has")
    spacing = tuple(e.spacing for e in equations)
    starts = np.cumsum([0, *(len(e.time) for e in equations)])
    return Gathered(
        tuple(kept), table, columns, rows, starts, spacing,
        stacked(equations, lambda e: e.matrix)[rows][:, columns], force[rows][:, columns],
        stacked(equations, lambda e: e.doubt)[rows][:, columns], tuple(notes),
    )  # fmt: skip

"""Equations of a run: regressor and forces, low-passed alike and thinned out.

The equations of all runs to fit, one below the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import upfirdn

from hydrotele.core.errors import InputError
from hydrotele.identify.motion import (
    GAP,
    Processing,
    Resolution,
    joint_motion,
    rate_deviations,
)
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.setup import RegressorSetup
from hydrotele.identify.smoothing import Smoothed, error_draws, smooth
from hydrotele.multibody.inverse_dynamics import Regressor, sign_uncertainty

_TAPS = 1.5  # half of the low-pass' length, in periods of its cutoff
_KAISER = 5.0  # its ripple is 50 dB down
_SPARE = 1.25  # equations per second over twice the band
_FINE = 4  # times more rows where forces are judged and shown
_CHUNK = 8000  # rows at a time, so that long logs need little memory
_MISSING = 0.1  # part of a low-pass' weight that may lie on missing forces
_NOISY = 6000  # rows at most on which they are tried
_DRAWS = 4  # of the motion's errors: an RMS over thousands of rows needs no more
_NYQUIST = 0.4  # of the sample rate that a band may reach


@dataclass(frozen=True)
class Equations:
    """Low-passed equations of one run; n of them, k drives, m parameters.

    Attributes:
        name: the run's.
        band: of the low-pass [Hz].
        matrix: (n, k, m).
        force: (n, k) less what the joints' stated damping and springs take [N] or [N m]; NaN where
            unknown.
        time: (n,) [s] from the run's start.
        spacing: between equations [s]; a whole part of a repeated motion's period.
        doubt: (n, k) how uncertain the sign of the drives' dry friction is, 0 .. 1.
        force_noise: (k,) standard deviation that the force sensors' noise leaves; NaN if unknown.
        motion_noise: (k, m, m) second moments of what the motion's errors leave per parameter;
            see `noise_of`. Empty where not asked for.
    """

    name: str
    band: float
    matrix: np.ndarray
    force: np.ndarray
    time: np.ndarray
    spacing: float
    doubt: np.ndarray
    force_noise: np.ndarray
    motion_noise: np.ndarray

    def noise_of(self, value: np.ndarray) -> np.ndarray:
        """RMS (k,) [N] or [N m] that a perfect model with parameters (m,) would show."""
        if not self.motion_noise.size:
            return np.full(len(self.force_noise), np.nan)
        moved = np.einsum("m,kml,l->k", value, self.motion_noise, value)
        return np.sqrt(self.force_noise**2 + np.maximum(moved, 0.0))


class RateErrors(NamedTuple):
    """Errors of the rates of the joints that were measured, one independent of the other.

    Attributes:
        axes: names of the k joints.
        std: (n, k) standard deviations [rad/s] or [m/s].
    """

    axes: tuple[str, ...]
    std: np.ndarray

    def part(self, rows: slice) -> "RateErrors":
        """Those of some rows."""
        return self._replace(std=self.std[rows])


def build_equations(
    record: IdentificationRecord, setup: RegressorSetup, processing: Processing, found: Resolution,
    with_noise: bool = False, rate_errors: RateErrors | None = None,
) -> tuple[Equations, Regressor]:  # fmt: skip
    """Equations of a run.

    Args:
        record: the run.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        found: what the positions of all runs resolve.
        with_noise: whether to find what the motion's errors leave, and to thin out less.
        rate_errors: of the joints that were measured, where these are not the record's; by default
            the record's own, which count as independent.

    Returns:
        The equations, and a regressor without rows that has names, units and nominal values.

    Raises:
        InputError: the run is too short for the band, or cannot be followed by the chain.
    """
    band = processing.band or found.band
    motion = _motion(record, found, processing)
    motions = np.stack([motion.value, motion.rate, motion.acceleration])
    low, thin = low_pass(band, record.period, processing.period)
    thin = max(1, thin // _FINE) if with_noise else thin
    count = (len(record.force) - len(low)) // thin + 1
    if band > _NYQUIST / record.period:
        raise InputError(
            record.name, f"a band of {band:g} Hz is too wide for rows of {record.period:g} s: at"
            f" most {_NYQUIST / record.period:g} Hz",
        )  # fmt: skip
    if count < 1:
        raise InputError(
            record.name, f"{len(record.force)} rows are too few for a band of {band:g} Hz, which"
            f" needs {len(low)}",
        )  # fmt: skip
    errors = rate_errors or RateErrors(setup.given, motion.rate_std)
    start, last, parts, doubts, damped = None, None, [], [], []
    weights = np.abs(low) / np.abs(low).sum()
    for first in range(0, count, per_chunk := max(1, _CHUNK // thin)):
        some = min(per_chunk, count - first)
        rows = slice(first * thin, (first + some - 1) * thin + len(low))
        last, doubt, damping, pose = _rows(setup, motions[:, rows], errors.part(rows), start)
        damped.append(low_passed(damping, low, thin))
        parts.append(low_passed(last.matrix, low, thin))
        doubts.append(low_passed(doubt, weights, thin))
        start = pose
    assert last is not None
    noise = np.sqrt(np.sum(low**2)) * record.force_noise
    spread = np.zeros(0)
    if with_noise:
        spread = _motion_noise(record, setup, found, motions, errors, low, thin)
    time = (np.arange(count) * thin + (len(low) - 1) / 2) * record.period
    made = Equations(
        record.name, band, np.concatenate(parts), 
        low_passed_forces(record.force, record.period, low, thin) - np.concatenate(damped), time,
        thin * record.period, np.concatenate(doubts), noise, spread,
    )  # fmt: skip
    empty = Regressor(last.matrix[:0], last.drives, last.names, last.units, last.nominal)
    return made, empty


def _motion(record: IdentificationRecord, found: Resolution, processing: Processing) -> Smoothed:
    """Motion of the joints, refused with a remedy where a filter cannot bridge a gap."""
    known = np.isfinite(record.position)
    if processing.method in ("raw", "zero_phase"):
        bridge = round(GAP / record.period) if processing.method == "zero_phase" else 0
        for axis, column in zip(record.axes, known.T, strict=True):
            rows = np.flatnonzero(column)
            missing = np.diff(rows, prepend=-1, append=len(column)) - 1
            if len(rows) and missing.max() > bridge:
                at = int(np.insert(rows, 0, 0)[missing.argmax()])
                raise InputError(
                    record.name, f"lacks the position of {axis} for"
                    f" {missing.max() * record.period:.3g} s from {at * record.period:.3g} s on:"
                    " take --processing optimal, which needs no filter, or cut the run there",
                )  # fmt: skip
    return joint_motion(record.position, record.period, found, processing)


def _motion_noise(
    record: IdentificationRecord, setup: RegressorSetup, found: Resolution, motions: np.ndarray,
    errors: RateErrors, low: np.ndarray, thin: int,
) -> np.ndarray:  # fmt: skip
    """What the motion's errors leave in the drives' forces (k, m, m); see `Equations`.

    True motions that the positions allow are drawn about the optimal smoother's; their rates are
    certain.
    """
    rows = slice(0, max(_NOISY, 4 * len(low)))
    smoothed = smooth(record.position[rows], record.period, found.noise)
    likely = np.stack([smoothed.value, smoothed.rate, smoothed.acceleration])
    taken = _rows(setup, motions[:, rows], errors.part(rows), None)[0].matrix
    total = np.zeros((taken.shape[1], taken.shape[2], taken.shape[2]))
    for draw in error_draws(smoothed, _DRAWS):
        error = low_passed(taken - _rows(setup, likely - draw, None, None)[0].matrix, low, thin)
        total += np.einsum("nkm,nkl->kml", error, error)
    return total / (len(error) * _DRAWS)


def row_forces(
    setup: RegressorSetup,
    motions: np.ndarray,
    value: np.ndarray,
    rate_std: np.ndarray | None = None,
) -> np.ndarray:
    """Drive forces along a motion.

    Args:
        setup: what the regressor is built of.
        motions: (3, n, k) positions, rates and accelerations of the given joints.
        value: (m,) parameters.
        rate_std: (n, k) of the rates [rad/s] or [m/s]; None if they are certain.

    Returns:
        (n, k) [N] or [N m], with the joints' stated damping and springs.
    """
    out, start = [], None
    for first in range(0, motions.shape[1], _CHUNK):
        rows = slice(first, first + _CHUNK)
        errors = None if rate_std is None else RateErrors(setup.given, rate_std[rows])
        table, _, damping, start = _rows(setup, motions[:, rows], errors, start)
        out.append(table.matrix @ value + damping)
    return np.concatenate(out)


def _rows(
    setup: RegressorSetup,
    motions: np.ndarray,
    errors: RateErrors | None,
    start: np.ndarray | None,
):
    """Some rows (3, n, k): regressor, doubt of the signs, damping and springs, the last pose."""
    chain = setup.chain
    found = setup.project(*motions, start=start)
    spread = None
    if errors is not None and np.isfinite(errors.std).all():
        measured = [chain.index(name) for name in errors.axes]
        spread = rate_deviations(found, measured, errors.std)
    table = setup.table(found, spread)
    doubt = np.zeros((len(found.rate), len(table.drives)))
    if spread is not None:
        doubt = sign_uncertainty(chain, found, table.drives, setup.rubbing, spread)
    passive = chain.damping * found.rate + chain.stiffness * (found.position - chain.rest)
    return table, doubt, np.einsum("nkv,nv->nk", found.share, passive), found.position[-1]


def low_pass(band: float, period: float, cycle: float | None = None) -> tuple[np.ndarray, int]:
    """Low-pass without lag.

    Args:
        band: of the equations [Hz].
        period: between rows [s].
        cycle: period of a repeated motion [s].

    Returns:
        Weights, their number odd, and how many rows make one equation: a part of a cycle's rows
        where they have a suitable one.
    """
    half = round(_TAPS / (band * period))
    if half < 1:
        return np.ones(1), 1
    reach = np.arange(-half, half + 1)
    weights = np.sinc(2.0 * band * period * reach) * np.kaiser(len(reach), _KAISER)
    thin = max(1, int(1.0 / (2.0 * _SPARE * band * period)))
    rows = round(cycle / period) if cycle else 0
    parts = [part for part in range(thin, thin // 2, -1) if rows % part == 0]
    return weights / weights.sum(), (parts or [thin])[0]


def low_passed(values: np.ndarray, low: np.ndarray, thin: int) -> np.ndarray:
    """Rows after a low-pass, as far as all of its weights lie on rows.

    Args:
        values: (n, ...).
        low: weights, their number odd.
        thin: every which row is kept.

    Returns:
        (rows, ...).
    """
    count = (len(values) - len(low)) // thin + 1
    flat = values.reshape(len(values), -1)
    # upfirdn puts out a row for every input; the first whole one ends at row len(low) - 1
    shift = (len(low) - 1) % thin
    padded = np.concatenate([np.zeros(((thin - shift) % thin, flat.shape[1])), flat])
    out = upfirdn(low, padded, down=thin, axis=0)
    first = (len(low) - 1 + (thin - shift) % thin) // thin
    return out[first : first + count].reshape(count, *values.shape[1:])


def low_passed_forces(force: np.ndarray, period: float, low: np.ndarray, thin: int) -> np.ndarray:
    """Forces after a low-pass; short gaps are bridged, long ones leave NaN.

    Args:
        force: (n, k), NaN where unknown.
        period: between rows [s].
        low: weights, their number odd.
        thin: every which row is kept.

    Returns:
        (rows, k).
    """
    known = np.isfinite(force)
    far = np.zeros_like(known)
    filled, rows = np.zeros_like(force), np.arange(len(force))
    for k in range(force.shape[1]):
        if not known[:, k].any():
            far[:, k] = True
        else:
            places = rows[known[:, k]]
            after = np.searchsorted(places, rows).clip(0, len(places) - 1)
            before = (after - 1).clip(0)
            near = np.minimum(np.abs(places[after] - rows), np.abs(places[before] - rows))
            far[:, k] = near * period > 0.5 * GAP
            filled[:, k] = np.interp(rows, rows[known[:, k]], force[known[:, k], k])
    out = low_passed(filled, low, thin)
    missing = low_passed(far.astype(float), np.abs(low) / np.abs(low).sum(), thin)
    out[missing > _MISSING] = np.nan
    return out


def stacked(parts: Sequence[Equations], of: Callable[[Equations], np.ndarray]) -> np.ndarray:
    """A field of several runs, one below the other."""
    return np.concatenate([of(part) for part in parts])


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

    runs: tuple[tuple[IdentificationRecord, Resolution], ...]
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
    runs: Sequence[tuple[IdentificationRecord, Resolution]],
    setup: RegressorSetup,
    processing: Processing,
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

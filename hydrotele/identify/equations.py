"""Linear equations `regressor @ parameters = force` of one run, and of all fitted runs.

The regressor is computed from the filtered motion of the joints. Regressor and forces pass the same
low-pass filter and are then downsampled. `build_equations` does this for one run; `stack_equations` stacks
the equations of several runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import upfirdn

from hydrotele.core.errors import InputError
from hydrotele.identify.joint_motion import (
    MAX_GAP_S,
    Processing,
    Resolution,
    compute_joint_motion,
    propagate_rate_std,
)
from hydrotele.identify.optimal_smoother import sample_smoothing_errors, smooth_and_differentiate
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.identify.smoothed_signal import SmoothedSignal
from hydrotele.multibody.regressor import Regressor, friction_sign_std

_HALF_LENGTH_PERIODS = 1.5  # half length of the low-pass filter, in periods of its cutoff
_KAISER_BETA = 5.0  # window parameter: ripple of -50 dB
_RATE_OVER_TWICE_BAND = 1.25  # equations per second over twice the band
_FINE_RATE_FACTOR = 4  # factor of the row rate where forces are evaluated and plotted
_ROWS_PER_CHUNK = 8000  # rows per block, to limit memory for long logs
_MAX_MISSING_WEIGHT = 0.1  # largest fraction of the filter weight that may fall on missing forces
_MAX_NOISE_ROWS = 6000  # rows, largest number with which the effect of motion errors is sampled
_MOTION_ERROR_SAMPLES = 4  # samples of the motion errors: enough for an RMS over thousands of rows
_MAX_BAND_OVER_SAMPLE_RATE = 0.4  # of the sample rate: largest band


@dataclass(frozen=True)
class Equations:
    """Low-pass filtered equations of one run: n rows, k drives, m parameters.

    Attributes:
        name: name of the run.
        band: cutoff of the low-pass filter [Hz].
        matrix: (n, k, m) regressor.
        force: (n, k) measured drive forces minus the forces of stated joint damping and springs [N] or
            [N m]; NaN where unknown.
        time: (n,) time from the start of the run [s].
        spacing: time between equations [s]; an integer fraction of a repeated motion's period.
        friction_sign_uncertainty: (n, k) uncertainty of the sign of the drives' dry friction, caused by
            errors of the speed: 0 for a certain sign, 1 for an unknown one.
        force_noise: (k,) standard deviation of the filtered force noise; NaN if unknown.
        motion_noise: (k, m, m) matrices M of the regressor errors that errors of the motion cause. With
            parameters p, p' M p is the mean squared force error of a drive. Empty if not requested.
    """

    name: str
    band: float
    matrix: np.ndarray
    force: np.ndarray
    time: np.ndarray
    spacing: float
    friction_sign_uncertainty: np.ndarray
    force_noise: np.ndarray
    motion_noise: np.ndarray

    def noise_rms(self, value: np.ndarray) -> np.ndarray:
        """Return the RMS force error (k,) [N] or [N m] that sensor noise alone would cause.

        It holds for a perfect model with parameters (m,); NaN if motion errors were not computed.
        """
        if not self.motion_noise.size:
            return np.full(len(self.force_noise), np.nan)
        moved = np.einsum("m,kml,l->k", value, self.motion_noise, value)
        return np.sqrt(self.force_noise**2 + np.maximum(moved, 0.0))


class RateErrors(NamedTuple):
    """Standard deviations of the rates (velocities) of the measured joints, whose errors are independent.

    Attributes:
        axes: names of the k joints.
        std: (n, k) standard deviations [rad/s] or [m/s].
    """

    axes: tuple[str, ...]
    std: np.ndarray

    def select_rows(self, rows: slice) -> "RateErrors":
        """Return the rate errors of the rows of a slice."""
        return self._replace(std=self.std[rows])


def build_equations(
    record: IdentificationRecord, setup: RegressorSetup, processing: Processing, position_resolution: Resolution,
    with_noise: bool = False, rate_errors: RateErrors | None = None,
) -> tuple[Equations, Regressor]:  # fmt: skip
    """Build the low-pass filtered equations `regressor @ parameters = force` of a run.

    Args:
        record: the run.
        setup: definition of the regressor.
        processing: method to differentiate the positions.
        position_resolution: noise and bandwidth of the positions.
        with_noise: whether to compute `Equations.motion_noise`, and to keep about four times as many
            equations per second.
        rate_errors: standard deviations of the speeds of the sensed joints, for a record that was
            converted to other joints. By default they are those of the record's joints.

    Returns:
        The equations, and a regressor without rows that has names, units and nominal values.

    Raises:
        InputError: the run is too short for the low-pass filter, or closed loops cannot follow the motion.
    """
    band = processing.band or position_resolution.band
    motion = _compute_motion(record, position_resolution, processing)
    motions = np.stack([motion.value, motion.rate, motion.acceleration])
    low, thin = design_low_pass(band, record.period, processing.period)
    thin = max(1, thin // _FINE_RATE_FACTOR) if with_noise else thin
    count = (len(record.force) - len(low)) // thin + 1
    if band > _MAX_BAND_OVER_SAMPLE_RATE / record.period:
        raise InputError(
            record.name, f"a band of {band:g} Hz is too wide for rows of {record.period:g} s: at"
            f" most {_MAX_BAND_OVER_SAMPLE_RATE / record.period:g} Hz",
        )  # fmt: skip
    if count < 1:
        raise InputError(
            record.name, f"{len(record.force)} rows are too few for a band of {band:g} Hz, which"
            f" needs {len(low)}",
        )  # fmt: skip
    errors = rate_errors or RateErrors(setup.given_joints, motion.rate_std)
    start, last, parts, doubts, damped = None, None, [], [], []
    weights = np.abs(low) / np.abs(low).sum()
    for first in range(0, count, per_chunk := max(1, _ROWS_PER_CHUNK // thin)):
        some = min(per_chunk, count - first)
        rows = slice(first * thin, (first + some - 1) * thin + len(low))
        last, doubt, damping, pose = _evaluate_regressor_rows(setup, motions[:, rows], errors.select_rows(rows), start)
        damped.append(apply_low_pass(damping, low, thin))
        parts.append(apply_low_pass(last.matrix, low, thin))
        doubts.append(apply_low_pass(doubt, weights, thin))
        start = pose
    assert last is not None
    noise = np.sqrt(np.sum(low**2)) * record.force_noise
    spread = np.zeros(0)
    if with_noise:
        spread = _compute_regressor_error_moments(record, setup, position_resolution, motions, errors, low, thin)
    time = (np.arange(count) * thin + (len(low) - 1) / 2) * record.period
    made = Equations(
        record.name, band, np.concatenate(parts), 
        low_pass_forces(record.force, record.period, low, thin) - np.concatenate(damped), time,
        thin * record.period, np.concatenate(doubts), noise, spread,
    )  # fmt: skip
    empty = Regressor(last.matrix[:0], last.drives, last.names, last.units, last.nominal)
    return made, empty


def _compute_motion(
    record: IdentificationRecord, position_resolution: Resolution, processing: Processing
) -> SmoothedSignal:
    """Filter and differentiate the positions of a record: position, rate and acceleration of the joints.

    Raises:
        InputError: a gap in the positions is too long for the filter; the message says what to do.
    """
    known = np.isfinite(record.position)
    if processing.method in ("raw", "zero_phase"):
        bridge = round(MAX_GAP_S / record.period) if processing.method == "zero_phase" else 0
        for axis, column in zip(record.axes, known.T, strict=True):
            rows = np.flatnonzero(column)
            missing = np.diff(rows, prepend=-1, append=len(column)) - 1
            if len(rows) and missing.max() > bridge:
                at = int(np.insert(rows, 0, 0)[missing.argmax()])
                raise InputError(
                    record.name, f"the position of {axis} is missing for"
                    f" {missing.max() * record.period:.3g} s from {at * record.period:.3g} s on:"
                    " use --processing optimal, which accepts gaps, or cut the run there",
                )  # fmt: skip
    return compute_joint_motion(record.position, record.period, position_resolution, processing)


def _compute_regressor_error_moments(
    record: IdentificationRecord, setup: RegressorSetup, position_resolution: Resolution, motions: np.ndarray,
    errors: RateErrors, low: np.ndarray, thin: int,
) -> np.ndarray:  # fmt: skip
    """Return second moments (k, m, m) of regressor errors of k drives caused by motion errors.

    With parameters p, p' M_k p is the mean squared force error of drive k. The regressor of the filtered
    motion `motions` is compared with those of random motions that the measured positions allow: the
    optimally smoothed motion minus samples of its error.
    """
    rows = slice(0, max(_MAX_NOISE_ROWS, 4 * len(low)))
    smoothed = smooth_and_differentiate(record.position[rows], record.period, position_resolution.noise)
    likely = np.stack([smoothed.value, smoothed.rate, smoothed.acceleration])
    taken = _evaluate_regressor_rows(setup, motions[:, rows], errors.select_rows(rows), None)[0].matrix
    total = np.zeros((taken.shape[1], taken.shape[2], taken.shape[2]))
    for draw in sample_smoothing_errors(smoothed, _MOTION_ERROR_SAMPLES):
        error = apply_low_pass(taken - _evaluate_regressor_rows(setup, likely - draw, None, None)[0].matrix, low, thin)
        total += np.einsum("nkm,nkl->kml", error, error)
    return total / (len(error) * _MOTION_ERROR_SAMPLES)


def predict_forces(
    setup: RegressorSetup,
    motions: np.ndarray,
    value: np.ndarray,
    rate_std: np.ndarray | None = None,
) -> np.ndarray:
    """Predict the drive forces along a motion with given parameters.

    Args:
        setup: definition of the regressor.
        motions: (3, n, k) positions, rates and accelerations of the given joints.
        value: (m,) parameters.
        rate_std: (n, k) standard deviations of the rates [rad/s] or [m/s]; None if exact.

    Returns:
        (n, k) forces [N] or [N m], including the known damping and springs of the joints, which are no parameters.
    """
    out, start = [], None
    for first in range(0, motions.shape[1], _ROWS_PER_CHUNK):
        rows = slice(first, first + _ROWS_PER_CHUNK)
        errors = None if rate_std is None else RateErrors(setup.given_joints, rate_std[rows])
        table, _, damping, start = _evaluate_regressor_rows(setup, motions[:, rows], errors, start)
        out.append(table.matrix @ value + damping)
    return np.concatenate(out)


def _evaluate_regressor_rows(
    setup: RegressorSetup,
    motions: np.ndarray,
    errors: RateErrors | None,
    start: np.ndarray | None,
):
    """Evaluate the regressor for n rows of a motion, positions, rates and accelerations (3, n, k).

    Args:
        setup: definition of the regressor.
        motions: (3, n, k) motion of the given joints.
        errors: standard deviations of the rates, or None.
        start: (v,) joint positions near those of the first row, or None.

    Returns:
        Four items: the regressor; the uncertainty (n, drives) of the sign of dry friction; the drive forces
        (n, drives) of the joints' known damping and springs; the joint positions (v,) of the last row.
    """
    chain = setup.chain
    found = setup.project_motion_on_drives(*motions, start=start)
    spread = None
    if errors is not None and np.isfinite(errors.std).all():
        measured = [chain.index(name) for name in errors.axes]
        spread = propagate_rate_std(found, measured, errors.std)
    table = setup.compute_regressor(found, spread)
    doubt = np.zeros((len(found.rate), len(table.drives)))
    if spread is not None:
        doubt = friction_sign_std(chain, found, table.drives, setup.friction_terms, spread)
    passive = chain.damping * found.rate + chain.stiffness * (found.position - chain.spring_rest)
    return (
        table,
        doubt,
        np.einsum("nkv,nv->nk", found.joint_projection, passive),
        found.position[-1],
    )


def design_low_pass(band: float, period: float, cycle: float | None = None) -> tuple[np.ndarray, int]:
    """Design a symmetric FIR low-pass filter (no lag) and choose its downsampling factor.

    Args:
        band: cutoff [Hz].
        period: time between rows [s].
        cycle: period of a repeated motion [s].

    Returns:
        An odd number of weights, and the number of rows per equation. That number divides the rows
        of a cycle if it has a suitable divisor.
    """
    half = round(_HALF_LENGTH_PERIODS / (band * period))
    if half < 1:
        return np.ones(1), 1
    reach = np.arange(-half, half + 1)
    weights = np.sinc(2.0 * band * period * reach) * np.kaiser(len(reach), _KAISER_BETA)
    thin = max(1, int(1.0 / (2.0 * _RATE_OVER_TWICE_BAND * band * period)))
    rows = round(cycle / period) if cycle else 0
    parts = [part for part in range(thin, thin // 2, -1) if rows % part == 0]
    return weights / weights.sum(), (parts or [thin])[0]


def apply_low_pass(values: np.ndarray, filter_weights: np.ndarray, downsampling: int) -> np.ndarray:
    """Apply a low-pass filter and downsample, without rows where the filter exceeds the ends.

    Args:
        values: (n, ...) rows.
        filter_weights: odd number of weights.
        downsampling: downsampling factor.

    Returns:
        (rows, ...) filtered rows.
    """
    count = (len(values) - len(filter_weights)) // downsampling + 1
    flat = values.reshape(len(values), -1)
    # upfirdn also returns partial rows; the first complete one ends at input row len(low) - 1
    shift = (len(filter_weights) - 1) % downsampling
    padded = np.concatenate([np.zeros(((downsampling - shift) % downsampling, flat.shape[1])), flat])
    out = upfirdn(filter_weights, padded, down=downsampling, axis=0)
    first = (len(filter_weights) - 1 + (downsampling - shift) % downsampling) // downsampling
    return out[first : first + count].reshape(count, *values.shape[1:])


def low_pass_forces(force: np.ndarray, period: float, filter_weights: np.ndarray, downsampling: int) -> np.ndarray:
    """Apply a low-pass filter to forces; interpolate short gaps and set long ones to NaN.

    Forces are interpolated where unknown. A filtered force is NaN if more than 10 % of the filter's
    weight is on rows that are more than 0.05 s from a known force.

    Args:
        force: (n, k) forces, NaN where unknown.
        period: time between rows [s].
        filter_weights: odd number of weights.
        downsampling: downsampling factor.

    Returns:
        (rows, k) filtered forces.
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
            far[:, k] = near * period > 0.5 * MAX_GAP_S
            filled[:, k] = np.interp(rows, rows[known[:, k]], force[known[:, k], k])
    out = apply_low_pass(filled, filter_weights, downsampling)
    missing = apply_low_pass(far.astype(float), np.abs(filter_weights) / np.abs(filter_weights).sum(), downsampling)
    out[missing > _MAX_MISSING_WEIGHT] = np.nan
    return out


def concatenate_over_runs(parts: Sequence[Equations], get_array: Callable[[Equations], np.ndarray]) -> np.ndarray:
    """Concatenate an array of the equations of several runs; `get_array` returns the array of one run."""
    return np.concatenate([get_array(part) for part in parts])


_MIN_BAND_PERIODS = 4.0  # periods of the band, shortest run: the low-pass filter spans three
_ERROR_CONTEXT = "identification"


@dataclass(frozen=True)
class StackedEquations:
    """Stacked equations of several runs: n rows, k drives with known forces, m parameters.

    Attributes:
        runs: the used runs, with the resolution of their positions; short ones are left out.
        table: regressor without rows: names, units and nominal values; all drives.
        drive_columns: indices of the k drives in the table.
        used_rows: mask of the n used rows among the stacked equations of all runs.
        run_starts: first stacked equation of each run, and their total number.
        spacing: time between the equations of each run [s].
        matrix: (n, k, m) regressor.
        force: (n, k) forces [N] or [N m].
        friction_sign_uncertainty: (n, k) uncertainty of the signs of dry friction.
        notes: sentences about runs that were left out.
    """

    runs: tuple[tuple[IdentificationRecord, Resolution], ...]
    table: Regressor
    drive_columns: list[int]
    used_rows: np.ndarray
    run_starts: np.ndarray
    spacing: tuple[float, ...]
    matrix: np.ndarray
    force: np.ndarray
    friction_sign_uncertainty: np.ndarray
    notes: tuple[str, ...]

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the k drives with known forces."""
        return tuple(self.table.drives[k] for k in self.drive_columns)

    def expand_to_run(self, values: np.ndarray, run: int) -> np.ndarray:
        """Expand values of the used equations to all rows and drives of one run.

        Args:
            values: (p, n, k) values of the used equations of all runs.
            run: index of the run.

        Returns:
            (p, equations of the run, all drives), 0 for rows and drives that are not used.
        """
        out = np.zeros((len(values), len(self.used_rows), len(self.table.drives)))
        places = np.flatnonzero(self.used_rows)
        for c, column in enumerate(self.drive_columns):
            out[:, places, column] = values[:, :, c]
        return out[:, self.run_starts[run] : self.run_starts[run + 1]]

    def shift_by_period(self, values: np.ndarray, period: float) -> np.ndarray:
        """Shift values by one period of a repeated motion, within each run.

        A row gets the value one period later, or near the end of a run one period earlier.

        Args:
            values: (n, ...) values of every row.
            period: period of the repeated motion [s].

        Returns:
            (n, ...) shifted values, NaN where neither exists.

        Raises:
            InputError: a run is shorter than two periods, or the period is shorter than the time
                between equations.
        """
        whole = np.full((len(self.used_rows), *values.shape[1:]), np.nan)
        whole[self.used_rows] = values
        for k, (record, _) in enumerate(self.runs):
            if len(record.force) * record.period < 2.0 * period:
                raise InputError(
                    record.name,
                    f"does not repeat its motion: it is shorter than two periods of {period:g} s",
                )
            if (step := round(period / self.spacing[k])) < 1:
                raise InputError(
                    record.name, f"a period of {period:g} s is shorter than the time between"
                    f" equations, {self.spacing[k]:.3g} s: a motion of this band repeats slower",
                )  # fmt: skip
            own = slice(self.run_starts[k], self.run_starts[k + 1])
            whole[own] = shift_by_rows(whole[own], step)
        return whole[self.used_rows]


def shift_by_rows(values: np.ndarray, step: int) -> np.ndarray:
    """Replace each row of values (n, ...) by the row `step` rows later, near the end by that `step` rows earlier.

    An earlier row is also used where the later one is NaN. Without either, the row is NaN.
    """
    later, earlier = np.full((2, *values.shape), np.nan)
    later[:-step], earlier[step:] = values[step:], values[:-step]
    return np.where(np.isnan(later), earlier, later)


def stack_equations(
    runs: Sequence[tuple[IdentificationRecord, Resolution]],
    setup: RegressorSetup,
    processing: Processing,
) -> StackedEquations:
    """Build the force equations of all runs and stack those in which all drive forces are known.

    Drives without a known force in any run are left out, as are runs shorter than four periods of
    the band.

    Args:
        runs: records and the resolution of their positions.
        setup: definition of the regressor.
        processing: method to differentiate the positions; its band must be set.

    Returns:
        The stacked equations.

    Raises:
        InputError: no drive has a known force, all runs are too short, or no row has the forces of
            all drives.
    """
    band = processing.band
    assert band
    kept, made, notes = [], [], []
    for record, found in runs:
        if len(record.force) * record.period * band < _MIN_BAND_PERIODS:
            notes.append(f"{record.name} is too short for a band of {band:.3g} Hz; left out.")
            continue
        made.append(build_equations(record, setup, processing, found))
        kept.append((record, found))
    if not made:
        raise InputError(_ERROR_CONTEXT, f"all runs are too short for a band of {band:.3g} Hz: log longer runs")
    table, equations = made[0][1], [e for e, _ in made]
    force = concatenate_over_runs(equations, lambda e: e.force)
    columns = [k for k in range(force.shape[1]) if np.isfinite(force[:, k]).any()]
    if not columns:
        raise InputError(_ERROR_CONTEXT, "no drive has a known force in any run: log both pressures")
    rows = np.asarray(np.isfinite(force[:, columns]).all(axis=1))
    notes += [
        f"{e.name} has no force of {', '.join(lost)}; left out."
        for e in equations
        if (lost := [table.drives[k] for k in columns if np.isnan(e.force[:, k]).all()])
    ]
    if not rows.any():
        raise InputError(_ERROR_CONTEXT, "no run has the forces of all drives whose forces are known in some run")
    spacing = tuple(e.spacing for e in equations)
    starts = np.cumsum([0, *(len(e.time) for e in equations)])
    return StackedEquations(
        tuple(kept), table, columns, rows, starts, spacing,
        concatenate_over_runs(equations, lambda e: e.matrix)[rows][:, columns], force[rows][:, columns],
        concatenate_over_runs(equations, lambda e: e.friction_sign_uncertainty)[rows][:, columns], tuple(notes),
    )  # fmt: skip

"""Identification of inertial and friction parameters from records of runs.

`identify_dynamics` fits the base parameters, subtracts the bias caused by position noise, and
predicts a held-out run. `identify_with_friction_shapes` also selects between sharp and smooth dry friction.

The covariance follows from the stated sensor noise. The estimate is linear in the forces, with a
gain for every equation. The adjoint of the low-pass filter maps that gain to single force readings.
The sensitivities of the forces to the motion, and the adjoint of the differentiation, map it to
single position readings, whose noise is independent.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import fftconvolve

from hydrotele.core.errors import InputError
from hydrotele.identify.equations import (
    StackedEquations,
    build_equations,
    design_low_pass,
    predict_forces,
    shift_by_rows,
    stack_equations,
)
from hydrotele.identify.estimation import (
    METHODS_WITH_PERIOD,
    Estimator,
    WeightedEquations,
    compute_weights,
    find_identifiable_parameters,
    weight_equations,
)
from hydrotele.identify.friction import (
    add_low_speed_friction_deviations,
    compute_drive_speeds,
    compute_friction_forces,
    set_rest_speeds,
)
from hydrotele.identify.identifiability import Identifiability, classify_parameters
from hydrotele.identify.joint_motion import (
    Processing,
    Resolution,
    apply_filter_adjoint,
    compute_joint_motion,
    estimate_resolution,
)
from hydrotele.identify.linear_least_squares import Estimate
from hydrotele.identify.optimal_smoother import smooth_and_differentiate
from hydrotele.identify.record import (
    IdentificationRecord,
    check_periodicity,
    cut_to_whole_cycles,
    keep_beginning,
)
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.identify.result import Identification
from hydrotele.identify.smoothed_signal import SmoothedSignal
from hydrotele.identify.verdict import (
    assess_identification,
    compute_heldout_errors,
    compute_heldout_forces,
    describe_drives_at_rest,
    find_implausible_parameters,
    find_wrong_force_columns,
    residual_autocorrelation,
)
from hydrotele.identify.wild_readings import remove_wild_readings

_MAX_SENSITIVITY_ROWS = 8000  # rows, largest number at which force sensitivities are computed
_PARAMETERS_PER_BLOCK = 4  # parameters per block, to limit memory for long logs


def propagate_noise(
    record: IdentificationRecord, position_resolution: Resolution, gain: np.ndarray, setup: RegressorSetup,
    processing: Processing, value: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Compute the covariance of an estimate that the noise of one run's forces and positions causes.

    Args:
        record: the run.
        position_resolution: noise and bandwidth of its positions.
        gain: (p, n, k) derivative of the p estimates by the force of each equation of the run and each
            drive; 0 if not used.
        setup: definition of the regressor.
        processing: method to differentiate the positions.
        value: (m,) parameters, for the sensitivities of the forces to the motion.

    Returns:
        (p, p) covariance; unknown force noise counts as 0.

    Source: first-order propagation of errors; Abdellatif 2008, section 4.2 (noise of positions).
    """
    p, _, k = gain.shape
    assert processing.band
    low, thin = design_low_pass(processing.band, record.period, processing.period)
    rows = len(record.force)
    spaced = np.zeros((p, rows, k))
    middle = (len(low) - 1) // 2
    spaced[:, middle + thin * np.arange(gain.shape[1])] = gain
    on_force = fftconvolve(spaced, low[None, :, None], mode="same", axes=1)
    noise = np.where(np.isfinite(record.force_noise), record.force_noise, 0.0)
    out = np.einsum("pnk,k,qnk->pq", on_force, noise**2, on_force, optimize=True)
    motion = compute_joint_motion(record.position, record.period, position_resolution, processing)
    cycles = 1
    if processing.method == "periodic":  # all cycles have the same sensitivities
        assert processing.period
        cycles = round(rows * record.period / processing.period)
    slopes = _compute_sensitivities(motion, rows // cycles, setup, value)
    parts = []
    for first in range(0, p, _PARAMETERS_PER_BLOCK):
        folded = on_force[first : first + _PARAMETERS_PER_BLOCK].reshape(-1, cycles, rows // cycles, k)
        # the sign of the error, measured minus modelled force, does not matter in a square
        on_motion = np.einsum("pcnk,xnkj->xpnj", folded, slopes, optimize=True)
        parts.append(apply_filter_adjoint(on_motion, record.period, position_resolution, processing))
    on_position, stated = np.concatenate(parts), position_resolution.noise**2 / cycles
    return out + np.einsum("pnj,j,qnj->pq", on_position, stated, on_position, optimize=True)


def _compute_sensitivities(motion: SmoothedSignal, count: int, setup: RegressorSetup, value: np.ndarray) -> np.ndarray:
    """Return derivatives (3, n, k, j) of k drive forces by positions, rates and accelerations of j joints.

    They are forward differences with steps of one standard deviation, for the first `count` = n rows. In
    long runs they are computed at every few rows and interpolated, since they change slowly.
    """
    rows = np.arange(0, count, max(1, count // _MAX_SENSITIVITY_ROWS))
    motions = np.stack([motion.value, motion.rate, motion.acceleration])[:, rows]
    rate_std = motion.rate_std[rows]
    steps = (motion.value_std[rows], rate_std, motion.acceleration_std[rows])
    middle = predict_forces(setup, motions, value, rate_std)
    out = np.empty((3, *middle.shape, motions.shape[2]))
    for x, step in enumerate(steps):
        for j in range(motions.shape[2]):
            moved = motions.copy()
            moved[x, :, j] += step[:, j]
            force = predict_forces(setup, moved, value, rate_std)
            out[x, :, :, j] = (force - middle) / np.maximum(step[:, j], 1e-300)[:, None]
    if len(rows) == count:
        return out
    before = np.clip(np.searchsorted(rows, np.arange(count), side="right") - 1, 0, len(rows) - 2)
    part = ((np.arange(count) - rows[before]) / np.diff(rows)[before])[None, :, None, None]
    return (1.0 - part) * out[:, before] + part * out[:, before + 1]


_MAX_BIAS_DURATION_S = 240.0  # s of data in total, distributed evenly over the runs
_SEGMENT_DURATION_S = 20.0  # s, length of one segment of a long run
_MIN_SEGMENT_PERIODS = 12.0  # periods of the band, shortest segment: the low-pass filter spans three


def estimate_motion_bias(
    data: StackedEquations, equations: WeightedEquations, base: np.ndarray, found: Estimate, value: np.ndarray,
    setup: RegressorSetup, processing: Processing, noise_pairs: int, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Estimate the bias that noise of the positions causes in the base parameters.

    The smoothed motion (or the mean cycle) and the estimated parameters are taken as the truth, and
    forces are computed from them. Noise is then added to the positions, and a regressor is built
    from them. The right-hand side of the normal equations, 0 without noise, gives the bias. Every
    noise sample is used with both signs, so that contributions of first order cancel.

    Args:
        data: equations of all runs.
        equations: the same, weighted.
        base: (r,) indices of the base parameters.
        found: their estimate.
        value: (m,) all parameters that follow from it.
        setup: definition of the regressor.
        processing: method to differentiate the positions.
        noise_pairs: number of pairs of a noise sample and its negative [1].
        seed: seed of the noise [1].

    Returns:
        (r,) bias, to be subtracted from the base parameters.

    Source: Efron and Tibshirani 1993, An introduction to the bootstrap, chapter 10; Cook and
    Stefanski 1994 (noise added to correct for noise).
    """
    generator = np.random.default_rng(seed)
    total, rows = np.zeros(len(base)), 0
    for record, resolved, noise in _iterate_segments(data, processing):
        world = _simulate_record(record, resolved, setup, processing, value)
        for _ in range(noise_pairs):
            error = noise * generator.standard_normal(record.position.shape)
            for sign in (1.0, -1.0):
                moved = replace(world, position=world.position + sign * error)
                made, _ = build_equations(moved, setup, processing, resolved)
                matrix, force = (
                    made.matrix[:, data.drive_columns],
                    made.force[:, data.drive_columns],
                )
                weight = compute_weights(
                    equations.error_variances, made.friction_sign_uncertainty[:, data.drive_columns]
                )
                left = (weight * (force - matrix @ value)) @ found.whitening.T
                aside = weight[:, :, None] * matrix[:, :, base]
                if equations.instruments is not None:
                    assert processing.period
                    step = round(processing.period / made.spacing)
                    aside = np.nan_to_num(shift_by_rows(aside, step))
                known = np.isfinite(left).all(axis=1)
                total += np.einsum("nkr,nk->r", (found.whitening @ aside)[known], left[known])
                rows += int(known.sum())
    return found.inverse_normal_matrix @ total * (len(data.force) / max(rows, 1))


def _simulate_record(
    record: IdentificationRecord,
    position_resolution: Resolution,
    setup: RegressorSetup,
    processing: Processing,
    value: np.ndarray,
) -> IdentificationRecord:
    """Return a record with smoothed positions and the forces that the parameters predict for them.

    Positions are optimally smoothed, or those of the mean cycle for the method `periodic`. Forces that
    were unknown stay unknown (NaN).
    """
    if processing.method == "periodic":
        motion = compute_joint_motion(record.position, record.period, position_resolution, processing)
    else:
        motion = smooth_and_differentiate(record.position, record.period, position_resolution.noise)
    force = predict_forces(setup, np.stack([motion.value, motion.rate, motion.acceleration]), value)
    force[~np.isfinite(record.force)] = np.nan
    return replace(record, position=motion.value, force=force)


def _iterate_segments(
    data: StackedEquations, processing: Processing
) -> Iterator[tuple[IdentificationRecord, Resolution, np.ndarray]]:
    """Yield parts of the runs for the simulation of noise, with the resolution and noise (k,) of positions.

    The parts, about 240 s in total, limit the computing time for long runs. If a periodic motion is
    reduced to its mean cycle, fewer cycles are averaged in a part; the noise is then reduced to that of
    the mean of all cycles.
    """
    lengths = [len(record.force) * record.period for record, _ in data.runs]
    part = min(1.0, _MAX_BIAS_DURATION_S / sum(lengths))
    assert processing.band
    for (record, found), length in zip(data.runs, lengths, strict=True):
        noise = found.noise
        if processing.period:
            cycles = max(1, round(length / processing.period))
            used = min(cycles, max(2, math.ceil(part * cycles)))
            wanted = [(0.0, used * processing.period if used < cycles else length)]
            if processing.method == "periodic":
                noise = noise * math.sqrt(used / cycles)
        elif part == 1.0:
            wanted = [(0.0, length)]
        else:
            piece = min(max(_SEGMENT_DURATION_S, _MIN_SEGMENT_PERIODS / processing.band), length)
            count = max(1, round(part * length / piece))
            starts = (np.arange(count) + 0.5) * length / count - 0.5 * piece
            wanted = [(start, piece) for start in np.clip(starts, 0.0, length - piece)]
        for start, seconds in wanted:
            first = round(start / record.period)
            rows = slice(first, first + round(seconds / record.period))
            position = record.position[rows]
            if np.isfinite(position).any(axis=0).all():
                cut = replace(record, position=position, force=record.force[rows])
                yield cut, found, noise


_RELATIVE_BIAS_UNCERTAINTY = 0.2  # relative uncertainty of a bias: it is computed with a smoothed motion
_MAX_PROPAGATED_GAINS = 2e7  # readings times parameters, above which only residuals give the covariance


@dataclass(frozen=True)
class UncorrectedFit:
    """A fit to several runs without bias correction.

    Attributes:
        data: equations of the runs.
        processing: method to differentiate the positions, with the band.
        equations: weighted equations.
        motion_identifiability: base parameters that the motion determines without noise.
        data_identifiability: base parameters that the data determine.
        estimate: estimate of the base parameters `data_identifiability`.
        joints_at_rest: (k,) whether a given joint was at rest in all runs.
    """

    data: StackedEquations
    processing: Processing
    equations: WeightedEquations
    motion_identifiability: Identifiability
    data_identifiability: Identifiability
    estimate: Estimate
    joints_at_rest: np.ndarray

    def expand_parameters(self) -> np.ndarray:
        """Return all parameters (m,); undetermined combinations keep their given values."""
        return _expand_parameters(self.data_identifiability, self.data.table.nominal, self.estimate)


def identify_dynamics(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify inertial and friction parameters of a mechanism, and validate them on a held-out run.

    Args:
        fit: records to fit.
        heldout: record for validation.
        setup: definition of the regressor.
        processing: method to differentiate the positions, and the band; by default the band follows
            from the resolution of the positions. With `periodic`, the fitted runs are cut to their
            last whole cycles, and the held-out run, which need not be periodic, is filtered.
        estimator: options of the estimator. If the sensors state their noise, the bias is
            subtracted and the covariance is propagated from the noise of the readings.
        notes: notes to include in the result.

    Returns:
        The identification.

    Raises:
        InputError: no drive has a known force, there are too few rows, or the estimator needs a
            period.

    Source: Khoshzaban 1992, chapter 4; Abdellatif 2008, section 4.

    Examples:
        Mass and friction of the test rig from two simulated runs:

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> from hydrotele.identify.record import build_records
        >>> from hydrotele.identify.regressor_setup import machine_setup
        >>> from hydrotele.simulate.closed_loops import load_closed_chain
        >>> machine = ht.load_machine("rig")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "5", "log_rate": "200", "control_rate": "200", "seed": seed}
        ...         run = ht.run_scenario(ht.load_scenario("rig_steps", overrides))
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     fit, heldout, notes = build_records(ht.load_dataset(folder, machine))
        >>> setup = machine_setup(machine, load_closed_chain(machine))
        >>> found = ht.identify_dynamics(fit, heldout, setup)
        >>> found.status
        'ok'
        >>> for name, unit, value, nominal in zip(found.names, found.units, found.value, found.nominal):
        ...     if name.startswith(("mass.carriage", "coulomb", "viscous")):
        ...         print(f"{name} {value:.0f} {unit}, in the machine file {nominal:.0f}")
        mass.carriage 197 kg, in the machine file 200
        coulomb.slide_rod 146 N, in the machine file 150
        viscous.slide_rod 648 N s/m, in the machine file 600
    """
    started, estimator = time.perf_counter(), estimator or Estimator()
    fitted = fit_base_parameters(fit, setup, processing or Processing(), estimator)
    data, told, found = fitted.data, fitted.data_identifiability, fitted.estimate
    bias = np.zeros(len(told.base))
    if _has_stated_noise(data):
        found = replace(found, covariance=_compute_covariance(fitted, setup))
        if estimator.noise_pairs:
            bias = estimate_motion_bias(
                data, fitted.equations, told.base, found, fitted.expand_parameters(), setup, fitted.processing,
                estimator.noise_pairs,
            )  # fmt: skip
            unsure = np.outer(_RELATIVE_BIAS_UNCERTAINTY * bias, _RELATIVE_BIAS_UNCERTAINTY * bias)
            residual = found.residual + fitted.equations.matrix[:, :, told.base] @ bias
            found = replace(
                found, value=found.value - bias, covariance=found.covariance + unsure,
                residual=residual,
            )  # fmt: skip
    table = data.table
    value = _expand_parameters(told, table.nominal, found)
    judging = fitted.processing
    if judging.method == "periodic":
        judging = replace(judging, method="zero_phase")
    resolved = estimate_resolution(heldout.position, heldout.period, heldout.position_noise)
    judged, _ = build_equations(heldout, setup, judging, resolved, with_noise=True)
    predicted = compute_heldout_errors(judged, table, value, data.drive_columns, setup)
    forces = compute_heldout_forces(judged, table, value)
    found_friction = compute_friction_forces(
        setup, compute_drive_speeds(fit, setup), table.names, value, told.base, found
    )
    findings = (*find_wrong_force_columns(forces, predicted), *find_implausible_parameters(told, table, found))
    return Identification(
        names=table.names, units=table.units, nominal=table.nominal, value=value, data_identifiability=told,
        motion_identifiability=fitted.motion_identifiability, estimate=found, bias=bias, heldout=predicted,
        friction=found_friction, forces=forces, band=judged.band,
        residual_autocorrelation=dict(zip(data.drives, residual_autocorrelation(found.residual).tolist(), strict=True)),
        status=assess_identification(predicted, _residual_rms(fitted), fitted.joints_at_rest, setup, findings),
        notes=(*notes, *data.notes, *findings, *describe_drives_at_rest(predicted, heldout.name)),
        seconds=time.perf_counter() - started,
    )  # fmt: skip


def fit_base_parameters(
    fit: Sequence[IdentificationRecord],
    setup: RegressorSetup,
    processing: Processing,
    estimator: Estimator,
) -> UncorrectedFit:
    """Fit the base parameters to runs, without bias correction and validation.

    Args:
        fit: records of the runs.
        setup: definition of the regressor.
        processing: method to differentiate the positions, and the band.
        estimator: options of the estimator.

    Returns:
        The fit.

    Raises:
        InputError: no drive has a known force, there are too few rows, or the estimator needs a
            period.
    """
    if estimator.method == "instruments":
        if not processing.period:
            raise InputError("estimator", "instruments need the period of the motion [s]")
        if processing.method == "periodic":
            raise InputError(
                "estimator", "instruments need separate cycles, but `periodic` averages them:"
                " use zero_phase",
            )  # fmt: skip
    if processing.method == "periodic":
        assert processing.period
        fit = [cut_to_whole_cycles(record, processing.period) for record in fit]
    resolved = [estimate_resolution(r.position, r.period, r.position_noise, _count_cycles(r, processing)) for r in fit]
    if processing.period and (processing.method == "periodic" or estimator.method in METHODS_WITH_PERIOD):
        for record, found in zip(fit, resolved, strict=True):
            check_periodicity(record, processing.period, found.noise)
    band = processing.band or min(found.band for found in resolved)
    processing = replace(processing, band=band)
    data = stack_equations(list(zip(fit, resolved, strict=True)), setup, processing)
    rows = data.matrix.reshape(-1, data.matrix.shape[2])
    structure = classify_parameters(rows, data.table.names, data.table.units)
    still = ~np.any([part.is_moving for part in resolved], axis=0)
    resting = {joint for joint, stands in zip(setup.given_joints, still, strict=True) if stands}
    equations = weight_equations(data, structure, estimator.method, processing.period)
    told = find_identifiable_parameters(equations, structure, setup, resting, data.drives)
    found = equations.estimate_base_parameters(told, estimator.ridge, estimator.truncation)
    return UncorrectedFit(data, processing, equations, structure, told, found, still)


def _count_cycles(record: IdentificationRecord, processing: Processing) -> int:
    """Return how many cycles of a periodic motion are averaged to a mean cycle; 1 for other filters."""
    if processing.method != "periodic" or not processing.period:
        return 1
    return round(len(record.force) * record.period / processing.period)


def _expand_parameters(told: Identifiability, nominal: np.ndarray, found: Estimate) -> np.ndarray:
    value = nominal.copy()
    value[told.base] += found.value - told.combination @ nominal
    return value


def _residual_rms(fitted: UncorrectedFit) -> dict[str, float]:
    """Return drive -> RMS of the unweighted residuals of its force [N] or [N m]."""
    residual = fitted.estimate.residual / fitted.equations.weights
    return dict(zip(fitted.data.drives, np.sqrt(np.mean(residual**2, axis=0)).tolist(), strict=True))


def _has_stated_noise(data: StackedEquations) -> bool:
    """Return whether the sensors state the noise of all positions and used forces."""
    return all(
        np.all(record.position_noise > 0.0) and np.isfinite(record.force_noise[data.drive_columns]).all()
        for record, _ in data.runs
    )


def _compute_covariance(fitted: UncorrectedFit, setup: RegressorSetup) -> np.ndarray:
    """Return the covariance (r, r) of the base parameters that follows from the sensor noise.

    It is increased by a factor if the residuals indicate a larger covariance. For long logs, and for the
    optimal smoother, which depends on the data, it follows from the residuals only.
    """
    data, found = fitted.data, fitted.estimate
    readings = sum(record.force.size + record.position.size for record, _ in data.runs)
    many = len(found.value) * readings > _MAX_PROPAGATED_GAINS and fitted.processing.method != "periodic"
    if many or fitted.processing.method == "optimal":
        return found.covariance
    value, total = fitted.expand_parameters(), np.zeros_like(found.covariance)
    for k, (record, resolved) in enumerate(data.runs):
        gain = data.expand_to_run(fitted.equations.weights * found.gain, k)
        total += propagate_noise(record, resolved, gain, setup, fitted.processing, value)
    size = np.outer(found.std, found.std)
    inverse = np.linalg.pinv(total / size, rcond=1e-10, hermitian=True)
    ratio = np.trace(inverse @ (found.covariance / size)) / found.rank
    return total * max(1.0, ratio)


_SHAPE_SELECTION_DURATION_S = 600.0  # s of data with which the friction shape is selected


def identify_with_friction_shapes(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify a mechanism's parameters with the form of dry friction that fits best, without wild readings.

    Wild readings are single samples far outside their neighbours; they are removed first. Schwarz's
    criterion (BIC) selects the form of dry friction. Its sign change is smooth as the machine states, or
    sharp, because the smoothing velocity of a machine often serves only the simulation. Deviations from
    the friction law near zero speed are added if they improve the criterion. These are compared in a
    wider frequency band, which the result also uses if they are added.

    Args:
        fit: records to fit.
        heldout: record for validation.
        setup: definition of the regressor.
        processing: method to differentiate the positions, and the band; a stated band is not widened.
        estimator: options of the estimator.
        notes: notes to include in the result.

    Returns:
        The identification with the best criterion; notes name the selected form and wild readings.

    Raises:
        InputError: no drive has a known force, there are too few rows, or the estimator needs a
            period.

    Source: Schwarz 1978, Estimating the dimension of a model.
    """
    started = time.perf_counter()
    processing, estimator = processing or Processing(), estimator or Estimator()
    cleaned = [remove_wild_readings(record, setup.chain.drives) for record in (*fit, heldout)]
    fit, heldout = [record for record, _ in cleaned[:-1]], cleaned[-1][0]
    notes = (*notes, *(note for _, said in cleaned for note in said))
    speeds = compute_drive_speeds(fit, setup)
    setup = set_rest_speeds(setup, speeds)
    some = _select_first_runs(fit, processing.period)
    best = compute_schwarz_criterion(some, setup, processing, estimator)
    if any(one.smoothing for one in setup.friction_terms):
        sharp = replace(setup, friction_terms=tuple(replace(one, smoothing=0.0) for one in setup.friction_terms))
        if (criterion := compute_schwarz_criterion(some, sharp, processing, estimator)) < best:
            setup, best = sharp, criterion
            notes = (*notes, "Sharp Coulomb friction fits these data better than the given smoothing.")
    free, wide = add_low_speed_friction_deviations(setup, speeds), _widen_band(fit, processing)
    if wide != processing:
        best = compute_schwarz_criterion(some, setup, wide, estimator)
    if compute_schwarz_criterion(some, free, wide, estimator) < best:
        setup, processing = free, wide
        notes = (*notes, "Friction near zero speed deviates from the given law; the deviation was estimated as well.")
    found = identify_dynamics(fit, heldout, setup, processing, estimator, notes=notes)
    return replace(found, seconds=time.perf_counter() - started)


def _widen_band(fit: Sequence[IdentificationRecord], processing: Processing) -> Processing:
    """Return the processing options with a band wide enough for the sign changes of dry friction.

    It is the smallest `Resolution.friction_band` of the runs. Options with a stated band, or with the
    periodic method, are returned unchanged.
    """
    if processing.band or processing.method == "periodic":
        return processing
    found = [estimate_resolution(r.position, r.period, r.position_noise) for r in fit]
    return replace(processing, band=min(one.friction_band for one in found))


def _select_first_runs(fit: Sequence[IdentificationRecord], period: float | None) -> list[IdentificationRecord]:
    """Return the first runs up to a total length of about 600 s; a run longer than that is cut.

    With the period [s] of a repeated motion, it is cut to whole periods.
    """
    some, seconds = [], 0.0
    for record in fit:
        some.append(keep_beginning(record, _SHAPE_SELECTION_DURATION_S, period))
        seconds += len(record.force) * record.period
        if seconds >= _SHAPE_SELECTION_DURATION_S:
            break
    return some


def compute_schwarz_criterion(
    fit: Sequence[IdentificationRecord],
    setup: RegressorSetup,
    processing: Processing,
    estimator: Estimator,
) -> float:
    """Fit the runs and return Schwarz's criterion (BIC) per row; a smaller value is a better model.

    It is infinite if there are too few rows.

    Args:
        fit: records to fit.
        setup: definition of the regressor.
        processing: method to differentiate the positions, and the band.
        estimator: options of the estimator.

    Source: McQuarrie and Tsai 1998, Regression and time series model selection (correction for few rows).
    """
    found = fit_base_parameters(fit, setup, processing, estimator)
    rows, drives = found.estimate.residual.shape
    parameters = len(found.estimate.value)
    if (free := rows - parameters / drives - 2.0) <= 0.0:
        return math.inf
    # weights are inverse standard deviations; without them the most uncertain shape would win
    doubted = np.sum(np.mean(np.log(found.equations.weights**2), axis=0))
    misfit = np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))) - doubted
    return float(misfit + parameters * np.log(rows) / free)

"""Identification of inertial and friction parameters from records of runs.

`identify_dynamics` fits the base parameters, subtracts the bias caused by position noise, and
predicts a held-out run. `identify_with_shapes` also selects between sharp and smooth dry friction.

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
    Equations,
    Gathered,
    build_equations,
    cycle_on,
    gather,
    low_pass,
    row_forces,
)
from hydrotele.identify.estimation import (
    REPEATED,
    Estimate,
    Estimator,
    Weighted,
    identifiable_from,
    weighted,
    weights,
)
from hydrotele.identify.identifiability import Identifiability, identifiability
from hydrotele.identify.motion import Processing, Resolution, adjoint, joint_motion, resolution
from hydrotele.identify.record import IdentificationRecord, beginning, check_repeats, whole_cycles
from hydrotele.identify.result import Forces, HeldOut, Identification
from hydrotele.identify.setup import RegressorSetup
from hydrotele.identify.smoothing import Smoothed, smooth
from hydrotele.multibody.inverse_dynamics import Regressor

_SLOPES = 8000  # rows, largest number at which force sensitivities are computed
_BLOCK = 4  # parameters per block, to limit memory for long logs


def propagated(
    record: IdentificationRecord, found: Resolution, gain: np.ndarray, setup: RegressorSetup,
    processing: Processing, value: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Propagate the sensor noise of one run to the covariance of an estimate.

    Args:
        record: the run.
        found: resolution of its positions.
        gain: (p, n, k) gain of the estimate for the run's equations and all drives; 0 if not used.
        setup: definition of the regressor.
        processing: method to differentiate the positions.
        value: (m,) parameters.

    Returns:
        (p, p) covariance.

    Source: first-order propagation of errors; Abdellatif 2008, section 4.2 (noise of positions).
    """
    p, _, k = gain.shape
    assert processing.band
    low, thin = low_pass(processing.band, record.period, processing.period)
    rows = len(record.force)
    spaced = np.zeros((p, rows, k))
    middle = (len(low) - 1) // 2
    spaced[:, middle + thin * np.arange(gain.shape[1])] = gain
    on_force = fftconvolve(spaced, low[None, :, None], mode="same", axes=1)
    noise = np.where(np.isfinite(record.force_noise), record.force_noise, 0.0)
    out = np.einsum("pnk,k,qnk->pq", on_force, noise**2, on_force, optimize=True)
    motion = joint_motion(record.position, record.period, found, processing)
    cycles = 1
    if processing.method == "periodic":  # all cycles have the same sensitivities
        assert processing.period
        cycles = round(rows * record.period / processing.period)
    slopes = _slopes(motion, rows // cycles, setup, value)
    parts = []
    for first in range(0, p, _BLOCK):
        folded = on_force[first : first + _BLOCK].reshape(-1, cycles, rows // cycles, k)
        # the sign of the error, measured minus modelled force, does not matter in a square
        on_motion = np.einsum("pcnk,xnkj->xpnj", folded, slopes, optimize=True)
        parts.append(adjoint(on_motion, record.period, found, processing))
    on_position, stated = np.concatenate(parts), found.noise**2 / cycles
    return out + np.einsum("pnj,j,qnj->pq", on_position, stated, on_position, optimize=True)


def _slopes(motion: Smoothed, count: int, setup: RegressorSetup, value: np.ndarray) -> np.ndarray:
    """Return sensitivities (3, n, k, j) of drive forces to positions, rates and accelerations.

    In long runs they are computed at every few rows and interpolated, since they change slowly.
    """
    rows = np.arange(0, count, max(1, count // _SLOPES))
    motions = np.stack([motion.value, motion.rate, motion.acceleration])[:, rows]
    rate_std = motion.rate_std[rows]
    steps = (motion.value_std[rows], rate_std, motion.acceleration_std[rows])
    middle = row_forces(setup, motions, value, rate_std)
    out = np.empty((3, *middle.shape, motions.shape[2]))
    for x, step in enumerate(steps):
        for j in range(motions.shape[2]):
            moved = motions.copy()
            moved[x, :, j] += step[:, j]
            force = row_forces(setup, moved, value, rate_std)
            out[x, :, :, j] = (force - middle) / np.maximum(step[:, j], 1e-300)[:, None]
    if len(rows) == count:
        return out
    before = np.clip(np.searchsorted(rows, np.arange(count), side="right") - 1, 0, len(rows) - 2)
    part = ((np.arange(count) - rows[before]) / np.diff(rows)[before])[None, :, None, None]
    return (1.0 - part) * out[:, before] + part * out[:, before + 1]


_ENOUGH = 240.0  # s of data in total, distributed evenly over the runs
_PIECE = 20.0  # s, length of one segment of a long run
_PERIODS = 12.0  # periods of the band, shortest segment: the low-pass filter spans three


def motion_bias(
    data: Gathered, equations: Weighted, base: np.ndarray, found: Estimate, value: np.ndarray,
    setup: RegressorSetup, processing: Processing, pairs: int, seed: int = 0,
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
        pairs: number of pairs of a noise sample and its negative [1].
        seed: seed of the noise [1].

    Returns:
        (r,) bias, to be subtracted from the base parameters.

    Source: Efron and Tibshirani 1993, An introduction to the bootstrap, chapter 10; Cook and
    Stefanski 1994 (noise added to correct for noise).
    """
    generator = np.random.default_rng(seed)
    total, rows = np.zeros(len(base)), 0
    for record, resolved, noise in _pieces(data, processing):
        world = _world(record, resolved, setup, processing, value)
        for _ in range(pairs):
            error = noise * generator.standard_normal(record.position.shape)
            for sign in (1.0, -1.0):
                moved = replace(world, position=world.position + sign * error)
                made, _ = build_equations(moved, setup, processing, resolved)
                matrix, force = made.matrix[:, data.columns], made.force[:, data.columns]
                weight = weights(equations.doubtful, made.doubt[:, data.columns])
                left = (weight * (force - matrix @ value)) @ found.white.T
                aside = weight[:, :, None] * matrix[:, :, base]
                if equations.instruments is not None:
                    assert processing.period
                    step = round(processing.period / made.spacing)
                    aside = np.nan_to_num(cycle_on(aside, step))
                known = np.isfinite(left).all(axis=1)
                total += np.einsum("nkr,nk->r", (found.white @ aside)[known], left[known])
                rows += int(known.sum())
    return found.normal @ total * (len(data.force) / max(rows, 1))


def _world(
    record: IdentificationRecord,
    found: Resolution,
    setup: RegressorSetup,
    processing: Processing,
    value: np.ndarray,
) -> IdentificationRecord:
    """Return a record with smoothed positions and the forces of that motion.

    Forces that were unknown stay unknown.
    """
    if processing.method == "periodic":
        motion = joint_motion(record.position, record.period, found, processing)
    else:
        motion = smooth(record.position, record.period, found.noise)
    force = row_forces(setup, np.stack([motion.value, motion.rate, motion.acceleration]), value)
    force[~np.isfinite(record.force)] = np.nan
    return replace(record, position=motion.value, force=force)


def _pieces(
    data: Gathered, processing: Processing
) -> Iterator[tuple[IdentificationRecord, Resolution, np.ndarray]]:
    """Yield segments of the runs, the resolution of their positions, and the position noise (k,).

    With the periodic method the noise is reduced so that the mean cycle has the noise of the mean
    of all cycles.
    """
    lengths = [len(record.force) * record.period for record, _ in data.runs]
    part = min(1.0, _ENOUGH / sum(lengths))
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
            piece = min(max(_PIECE, _PERIODS / processing.band), length)
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


_WORSE = 1.5  # prediction error over noise above which the model is incomplete
_FOREIGN = 3.0  # prediction error over fitted residuals above which the runs are not informative


def heldout_errors(
    judged: Equations,
    table: Regressor,
    value: np.ndarray,
    columns: list[int],
    setup: RegressorSetup,
) -> dict[str, HeldOut]:
    """Return the prediction errors of the held-out run for each drive at `columns`.

    Drives without known forces are omitted.
    """
    noise = judged.noise_of(value)
    out = {}
    for k in columns:
        force = judged.force[:, k]
        known = np.isfinite(force)
        if not known.any():
            continue
        sizes = [
            float(np.sqrt(np.mean((force - judged.matrix[:, k] @ p)[known] ** 2)))
            for p in (value, table.nominal)
        ]
        whole = float(np.sqrt(np.mean(force[known] ** 2)))
        unit = "N" if setup.chain.tree.slides[setup.chain.index(table.drives[k])] else "N m"
        out[table.drives[k]] = HeldOut(
            sizes[0], unit, float(noise[k]), sizes[0] / max(whole, 1e-300), sizes[1]
        )
    return out


def heldout_forces(judged: Equations, table: Regressor, value: np.ndarray) -> Forces:
    """Return measured and predicted forces of the held-out run."""
    return Forces(
        judged.name, table.drives, judged.time, judged.force, judged.matrix @ value,
        judged.matrix @ table.nominal,
    )  # fmt: skip


def whiteness(residual: np.ndarray) -> np.ndarray:
    """Return the correlation (k,) of successive residuals (n, k)."""
    error = residual - residual.mean(axis=0)
    return np.sum(error[1:] * error[:-1], axis=0) / np.sum(error**2, axis=0)


def status_of(
    heldout: dict[str, HeldOut], fitted: dict[str, float], still: np.ndarray, setup: RegressorSetup
) -> str:
    """Evaluate the result of an identification.

    Args:
        heldout: prediction errors of the held-out run.
        fitted: drive -> RMS of the residuals of the fitted runs [N] or [N m].
        still: (k,) whether a given joint was at rest in all fitted runs.
        setup: definition of the regressor.

    Returns:
        `ok`, or a sentence that names the problem and the remedy.
    """
    if still.any():
        names = ", ".join(j for j, stands in zip(setup.given, still, strict=True) if stands)
        return (
            f"{names} did not move: parameters that need its motion keep their given values;"
            " log a fast motion of all axes in many poses"
        )
    if not heldout:
        return "the held-out run has no known force, so nothing was validated: hold out another run"
    worse = [d for d, h in heldout.items() if h.rms > _WORSE * h.noise_rms]
    if worse:
        return (
            f"on the held-out run the force error of {', '.join(worse)} exceeds the sensor noise:"
            " the model is incomplete; search for missing effects with `hydrotele gap`"
        )
    worse = [d for d, h in heldout.items() if h.rms > _FOREIGN * fitted[d]]
    if worse:
        return (
            f"on the held-out run the force error of {', '.join(worse)} is more than"
            f" {_FOREIGN:g} times that on the fitted runs: their motion is not informative enough;"
            " fit runs like the held-out run as well"
        )
    return "ok"


_UNSURE = 0.2  # relative uncertainty of a bias: it is computed with a smoothed motion
_MANY = 2e7  # readings times parameters, above which only residuals give the covariance


@dataclass(frozen=True)
class Fitted:
    """A fit to several runs without bias correction.

    Attributes:
        data: equations of the runs.
        processing: method to differentiate the positions, with the band.
        equations: weighted equations.
        structure: base parameters that the motion determines without noise.
        told: base parameters that the data determine.
        estimate: estimate of the base parameters `told`.
        still: (k,) whether a given joint was at rest in all runs.
    """

    data: Gathered
    processing: Processing
    equations: Weighted
    structure: Identifiability
    told: Identifiability
    estimate: Estimate
    still: np.ndarray

    def whole(self) -> np.ndarray:
        """Return all parameters (m,); undetermined combinations keep their given values."""
        return _whole(self.told, self.data.table.nominal, self.estimate)


def identify_dynamics(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify the parameters of a mechanism.

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
    """
    started, estimator = time.perf_counter(), estimator or Estimator()
    fitted = fit_runs(fit, setup, processing or Processing(), estimator)
    data, told, found = fitted.data, fitted.told, fitted.estimate
    bias = np.zeros(len(told.base))
    if _noise_stated(data):
        found = replace(found, covariance=_covariance(fitted, setup))
        if estimator.pairs:
            bias = motion_bias(
                data, fitted.equations, told.base, found, fitted.whole(), setup, fitted.processing,
                estimator.pairs,
            )  # fmt: skip
            unsure = np.outer(_UNSURE * bias, _UNSURE * bias)
            residual = found.residual + fitted.equations.matrix[:, :, told.base] @ bias
            found = replace(
                found, value=found.value - bias, covariance=found.covariance + unsure,
                residual=residual,
            )  # fmt: skip
    table = data.table
    value = _whole(told, table.nominal, found)
    judging = fitted.processing
    if judging.method == "periodic":
        judging = replace(judging, method="zero_phase")
    resolved = resolution(heldout.position, heldout.period, heldout.position_noise)
    judged, _ = build_equations(heldout, setup, judging, resolved, with_noise=True)
    predicted = heldout_errors(judged, table, value, data.columns, setup)
    return Identification(
        names=table.names, units=table.units, nominal=table.nominal, value=value, told=told,
        structure=fitted.structure, estimate=found, bias=bias, heldout=predicted,
        forces=heldout_forces(judged, table, value), band=judged.band,
        whiteness=dict(zip(data.drives, whiteness(found.residual).tolist(), strict=True)),
        status=status_of(predicted, _residual_sizes(fitted), fitted.still, setup),
        notes=(*notes, *data.notes),
        seconds=time.perf_counter() - started,
    )  # fmt: skip


def fit_runs(
    fit: Sequence[IdentificationRecord],
    setup: RegressorSetup,
    processing: Processing,
    estimator: Estimator,
) -> Fitted:
    """Fit the base parameters to runs, without bias correction and validation.

    Args:
        fit: records.
        setup: definition of the regressor.
        processing: as in `identify_dynamics`.
        estimator: as in `identify_dynamics`.

    Returns:
        The fit.

    Raises:
        InputError: as in `identify_dynamics`.
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
        fit = [whole_cycles(record, processing.period) for record in fit]
    resolved = [
        resolution(r.position, r.period, r.position_noise, _cycles(r, processing)) for r in fit
    ]
    if processing.period and (processing.method == "periodic" or estimator.method in REPEATED):
        for record, found in zip(fit, resolved, strict=True):
            check_repeats(record, processing.period, found.noise)
    band = processing.band or min(found.band for found in resolved)
    processing = replace(processing, band=band)
    data = gather(list(zip(fit, resolved, strict=True)), setup, processing)
    rows = data.matrix.reshape(-1, data.matrix.shape[2])
    structure = identifiability(rows, data.table.names, data.table.units)
    still = ~np.any([part.moves for part in resolved], axis=0)
    resting = [d for d, stands in zip(data.table.drives, still, strict=True) if stands]
    equations = weighted(data, structure, estimator.method, processing.period)
    told = identifiable_from(equations, structure, setup, resting, data.drives)
    found = equations.fitted(told, estimator.ridge, estimator.cut)
    return Fitted(data, processing, equations, structure, told, found, still)


def _cycles(record: IdentificationRecord, processing: Processing) -> int:
    """Return the number of cycles that are averaged."""
    if processing.method != "periodic" or not processing.period:
        return 1
    return round(len(record.force) * record.period / processing.period)


def _whole(told: Identifiability, nominal: np.ndarray, found: Estimate) -> np.ndarray:
    value = nominal.copy()
    value[told.base] += found.value - told.combination @ nominal
    return value


def _residual_sizes(fitted: Fitted) -> dict[str, float]:
    """Return the RMS of the unweighted residuals of each drive [N] or [N m]."""
    residual = fitted.estimate.residual / fitted.equations.weight
    return dict(
        zip(fitted.data.drives, np.sqrt(np.mean(residual**2, axis=0)).tolist(), strict=True)
    )


def _noise_stated(data: Gathered) -> bool:
    """Return whether the sensors state the noise of all positions and used forces."""
    return all(
        np.all(record.position_noise > 0.0) and np.isfinite(record.force_noise[data.columns]).all()
        for record, _ in data.runs
    )


def _covariance(fitted: Fitted, setup: RegressorSetup) -> np.ndarray:
    """Return the covariance (r, r) from sensor noise, increased if the residuals are larger.

    For long logs, and for the smoother, which adapts to the data, it follows from the residuals
    only.
    """
    data, found = fitted.data, fitted.estimate
    readings = sum(record.force.size + record.position.size for record, _ in data.runs)
    many = len(found.value) * readings > _MANY and fitted.processing.method != "periodic"
    if many or fitted.processing.method == "optimal":
        return found.covariance
    value, total = fitted.whole(), np.zeros_like(found.covariance)
    for k, (record, resolved) in enumerate(data.runs):
        gain = data.spread(fitted.equations.weight * found.gain, k)
        total += propagated(record, resolved, gain, setup, fitted.processing, value)
    size = np.outer(found.std, found.std)
    inverse = np.linalg.pinv(total / size, rcond=1e-10, hermitian=True)
    ratio = np.trace(inverse @ (found.covariance / size)) / found.rank
    return total * max(1.0, ratio)


_TRIED = 600.0  # s of data with which the friction shape is selected


def identify_with_shapes(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify with dry friction as smooth as the machine states, or with a sharp sign change.

    The smoothing velocity of a machine often serves only the simulation; Coulomb friction is sharp.

    Args:
        fit: as in `identify_dynamics`.
        heldout: as in `identify_dynamics`.
        setup: as in `identify_dynamics`.
        processing: as in `identify_dynamics`.
        estimator: as in `identify_dynamics`.
        notes: as in `identify_dynamics`.

    Returns:
        The identification with the larger likelihood; a note says if sharp friction was selected.

    Raises:
        InputError: as in `identify_dynamics`.
    """
    started = time.perf_counter()
    processing, estimator = processing or Processing(), estimator or Estimator()
    if any(one.smoothing for one in setup.rubbing):
        sharp = replace(setup, rubbing=tuple(replace(one, smoothing=0.0) for one in setup.rubbing))
        some = _some(fit, processing.period)
        misfits = [_misfit(some, s, processing, estimator) for s in (setup, sharp)]
        if misfits[1] < misfits[0]:
            setup = sharp
            said = "Sharp Coulomb friction fits these data better than the given smoothing."
            notes = (*notes, said)
    found = identify_dynamics(fit, heldout, setup, processing, estimator, notes=notes)
    return replace(found, seconds=time.perf_counter() - started)


def _some(fit: Sequence[IdentificationRecord], period: float | None) -> list[IdentificationRecord]:
    """Return the first runs with a total length of 600 s; a longer run is cut."""
    some, seconds = [], 0.0
    for record in fit:
        some.append(beginning(record, _TRIED, period))
        seconds += len(record.force) * record.period
        if seconds >= _TRIED:
            break
    return some


def _misfit(
    fit: Sequence[IdentificationRecord],
    setup: RegressorSetup,
    processing: Processing,
    estimator: Estimator,
) -> float:
    """Return minus twice the log likelihood of the residuals, per row and without constants."""
    found = fit_runs(fit, setup, processing, estimator)
    # weights are inverse standard deviations; without them the most uncertain shape would win
    doubted = np.sum(np.mean(np.log(found.equations.weight**2), axis=0))
    return float(np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))) - doubted)

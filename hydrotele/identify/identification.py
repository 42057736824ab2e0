"""Identification: from records of runs to parameters, what they tell of them, and how well.

Covariance of an estimate from the sensors' stated noise: every reading's way into it.

An estimate that is linear in the forces gives every equation a gain. Backwards through the
low-pass that gain falls on single force readings, and through the forces' slopes with respect to
the motion and the filter that made it, on single position readings. Their noise is independent.

Bias that noise of the positions leaves in identified parameters, by repeating it.

How well identified parameters predict a run that was not fitted, and what to say about it.

Whether dry friction changes sign at once or smoothly: the data choose.
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

_SLOPES = 8000  # rows of a run that are asked for the forces' slopes
_BLOCK = 4  # parameters at a time, so that long logs need little memory


def propagated(
    record: IdentificationRecord, found: Resolution, gain: np.ndarray, setup: RegressorSetup,
    processing: Processing, value: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Covariance that the noise of one run's readings leaves in an estimate.

    Args:
        record: the run.
        found: what its positions resolve.
        gain: (p, n, k) of the estimate, for the run's equations and all drives; 0 where not used.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        value: (m,) parameters.

    Returns:
        (p, p).

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
    if processing.method == "periodic":  # every cycle has the same slopes and is read alike
        assert processing.period
        cycles = round(rows * record.period / processing.period)
    slopes = _slopes(motion, rows // cycles, setup, value)
    parts = []
    for first in range(0, p, _BLOCK):
        folded = on_force[first : first + _BLOCK].reshape(-1, cycles, rows // cycles, k)
        # an equation's error is measured less modelled force: the sign does not matter in a square
        on_motion = np.einsum("pcnk,xnkj->xpnj", folded, slopes, optimize=True)
        parts.append(adjoint(on_motion, record.period, found, processing))
    on_position, stated = np.concatenate(parts), found.noise**2 / cycles
    return out + np.einsum("pnj,j,qnj->pq", on_position, stated, on_position, optimize=True)


def _slopes(motion: Smoothed, count: int, setup: RegressorSetup, value: np.ndarray) -> np.ndarray:
    """Slopes (3, n, k, j) of drive forces over positions, rates and accelerations of the joints.

    They change as slowly as the motion: in long runs those of every few rows tell the others.
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


_ENOUGH = 240.0  # s of data in all, spread evenly over the runs
_PIECE = 20.0  # s of one piece of a long run
_PERIODS = 12.0  # of the band that a piece has at least: its low-pass takes three


def motion_bias(
    data: Gathered, equations: Weighted, base: np.ndarray, found: Estimate, value: np.ndarray,
    setup: RegressorSetup, processing: Processing, pairs: int, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Mean error of an estimate whose regressor comes from noisy positions.

    The optimal smoother's motion, or the mean cycle, is taken for the true one and the parameters
    found for the true ones. Forces that follow from both meet a regressor to which the positions'
    noise is added anew: what then stands on the right of the normal equations would be 0 without
    noise. Every noise is used with both signs, so that only what does not average out remains.

    Args:
        data: equations of all runs.
        equations: the same, weighted.
        base: (r,) places of the base parameters.
        found: their estimate.
        value: (m,) all parameters that follow from it.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        pairs: of noise and its negative [1].
        seed: of the noise [1].

    Returns:
        (r,) to be taken off the base parameters.

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
    """A record whose forces are those of its motion, and as unknown as they were."""
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
    """Pieces of the runs, what their positions resolve, and the noise (k,) of a position.

    The noise of a mean cycle is that of all cycles.
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


_WORSE = 1.5  # times the noise; beyond it the model lacks something
_FOREIGN = 3.0  # times the fitted runs' residuals; beyond it they tell too little


def heldout_errors(
    judged: Equations,
    table: Regressor,
    value: np.ndarray,
    columns: list[int],
    setup: RegressorSetup,
) -> dict[str, HeldOut]:
    """Drive -> prediction of the held-out run, of the drives at `columns` with known forces."""
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
    """Measured and predicted forces of the held-out run."""
    return Forces(
        judged.name, table.drives, judged.time, judged.force, judged.matrix @ value,
        judged.matrix @ table.nominal,
    )  # fmt: skip


def whiteness(residual: np.ndarray) -> np.ndarray:
    """Correlation (k,) of residuals (n, k) with those before them."""
    error = residual - residual.mean(axis=0)
    return np.sum(error[1:] * error[:-1], axis=0) / np.sum(error**2, axis=0)


def status_of(
    heldout: dict[str, HeldOut], fitted: dict[str, float], still: np.ndarray, setup: RegressorSetup
) -> str:
    """`ok`, or what is wrong and what to do about it.

    Args:
        heldout: prediction of the held-out run.
        fitted: drive -> RMS of the residuals of the runs to fit [N] or [N m].
        still: (k,) whether a given joint stood still in all runs to fit.
        setup: of the regressor.

    Returns:
        A sentence.
    """
    if still.any():
        names = ", ".join(j for j, stands in zip(setup.given, still, strict=True) if stands)
        return (
            f"{names} stood still: what shows only in motion of it is not told, and kept as given;"
            " log a motion of all axes, fast and in many poses"
        )
    if not heldout:
        return "the held-out run has no known force: nothing was judged; hold out another one"
    worse = [d for d, h in heldout.items() if h.rms > _WORSE * h.noise_rms]
    if worse:
        return (
            f"on the held-out run the force of {', '.join(worse)} differs by more than the sensors"
            " explain: the model lacks something there; look for it with `hydrotele gap`"
        )
    worse = [d for d, h in heldout.items() if h.rms > _FOREIGN * fitted[d]]
    if worse:
        return (
            f"on the held-out run the force of {', '.join(worse)} differs by more than"
            f" {_FOREIGN:g} times as much as on the fitted ones: they do not tell what happens"
            " there; fit runs like it, too"
        )
    return "ok"


_UNSURE = 0.2  # of a bias: the motion that it is found with is smoother than the true one
_MANY = 2e7  # ways of readings into parameters; beyond it residuals alone tell the covariance


@dataclass(frozen=True)
class Fitted:
    """A fit to some runs, before its bias is taken off.

    Attributes:
        data: equations of the runs.
        processing: with the band.
        equations: weighted.
        structure: base parameters that the motion would tell without noise.
        told: those that the data tell.
        estimate: of them.
        still: (k,) whether a given joint stood still in all runs.
    """

    data: Gathered
    processing: Processing
    equations: Weighted
    structure: Identifiability
    told: Identifiability
    estimate: Estimate
    still: np.ndarray

    def whole(self) -> np.ndarray:
        """All parameters (m,): what the data do not tell stays as given."""
        return _whole(self.told, self.data.table.nominal, self.estimate)


def identify_dynamics(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify the parameters of a chain.

    Args:
        fit: records to learn from.
        heldout: record to judge on.
        setup: what the regressor is built of.
        processing: how positions are differentiated, and the band; each run as its own positions
            allow by default. Where it is `periodic`, runs to fit are cut to their last whole
            cycles, and the held-out run, which need not be periodic, is filtered.
        estimator: how base parameters are estimated. Where the sensors state their noise, its
            bias is taken off, and the covariance is that of every reading's noise.
        notes: to hand on.

    Returns:
        The identification.

    Raises:
        InputError: no drive has a force, there are too few rows, or the estimator needs a period.

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
    """Fit base parameters to runs, without care for bias or a run to judge on.

    Args:
        fit: records.
        setup: what the regressor is built of.
        processing: as of `identify`.
        estimator: as of `identify`.

    Returns:
        The fit.

    Raises:
        InputError: as `identify`.
    """
    if estimator.method == "instruments":
        if not processing.period:
            raise InputError("estimator", "instruments need the period of the motion [s]")
        if processing.method == "periodic":
            raise InputError(
                "estimator", "instruments need cycles of their own, `periodic` takes their mean:"
                " take zero_phase",
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
    """How many cycles of a motion are taken the mean of."""
    if processing.method != "periodic" or not processing.period:
        return 1
    return round(len(record.force) * record.period / processing.period)


def _whole(told: Identifiability, nominal: np.ndarray, found: Estimate) -> np.ndarray:
    value = nominal.copy()
    value[told.base] += found.value - told.combination @ nominal
    return value


def _residual_sizes(fitted: Fitted) -> dict[str, float]:
    """Drive -> RMS of its residuals, as if all equations counted alike [N] or [N m]."""
    residual = fitted.estimate.residual / fitted.equations.weight
    return dict(
        zip(fitted.data.drives, np.sqrt(np.mean(residual**2, axis=0)).tolist(), strict=True)
    )


def _noise_stated(data: Gathered) -> bool:
    """Whether sensors state the noise of all positions and of the forces that are used."""
    return all(
        np.all(record.position_noise > 0.0) and np.isfinite(record.force_noise[data.columns]).all()
        for record, _ in data.runs
    )


def _covariance(fitted: Fitted, setup: RegressorSetup) -> np.ndarray:
    """Covariance (r, r) by the sensors' noise, larger where residuals are.

    Residuals alone tell it in long logs, and where a smoother adapts to the data.
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


_TRIED = 600.0  # s of data that tell the shape


def identify_with_shapes(
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord, setup: RegressorSetup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify with friction as smooth as the machine states, or with a sharp sign.

    A machine's smoothing velocity often only helps a simulator; sharp friction is Coulomb's own.

    Args:
        fit: as of `identify`.
        heldout: as of `identify`.
        setup: as of `identify`.
        processing: as of `identify`.
        estimator: as of `identify`.
        notes: as of `identify`.

    Returns:
        The identification with the smaller residuals; a note says if it is the sharp one.

    Raises:
        InputError: as `identify`.
    """
    started = time.perf_counter()
    processing, estimator = processing or Processing(), estimator or Estimator()
    if any(one.smoothing for one in setup.rubbing):
        sharp = replace(setup, rubbing=tuple(replace(one, smoothing=0.0) for one in setup.rubbing))
        some = _some(fit, processing.period)
        misfits = [_misfit(some, s, processing, estimator) for s in (setup, sharp)]
        if misfits[1] < misfits[0]:
            setup = sharp
            said = "Dry friction changes sign at once in these data, more sharply than given."
            notes = (*notes, said)
    found = identify_dynamics(fit, heldout, setup, processing, estimator, notes=notes)
    return replace(found, seconds=time.perf_counter() - started)


def _some(fit: Sequence[IdentificationRecord], period: float | None) -> list[IdentificationRecord]:
    """The first runs, as many as last long enough; one that alone is longer is cut."""
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
    """What the residuals' likelihood asks to be small."""
    found = fit_runs(fit, setup, processing, estimator)
    # weights count as the inverse of standard deviations, or the shape that doubts most would win
    doubted = np.sum(np.mean(np.log(found.equations.weight**2), axis=0))
    return float(np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))) - doubted)

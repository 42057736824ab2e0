"""Identification: from records of runs to parameters, what they tell of them, and how well."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.identify.bias import motion_bias
from hydrotele.identify.equations import Equations, build_equations
from hydrotele.identify.estimation import Estimator, Weighted, told_by, weighted
from hydrotele.identify.estimators import Estimate
from hydrotele.identify.gathering import Gathered, gather
from hydrotele.identify.identifiability import Identifiability, identifiability
from hydrotele.identify.judging import heldout_errors, heldout_forces, status_of, whiteness
from hydrotele.identify.motion import Processing, resolution
from hydrotele.identify.propagation import propagated
from hydrotele.identify.record import Record, beginning, whole_cycles
from hydrotele.identify.result import Identification
from hydrotele.identify.setup import Setup

_UNSURE = 0.2  # of a bias: the motion that it is found with is smoother than the true one
_LONG = 600.0  # s of data; beyond it residuals alone tell the covariance
_ENOUGH = 240.0  # s of data that tell the bias


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


def identify(
    fit: Sequence[Record], heldout: Record, setup: Setup,
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
            bias = _bias(fitted, setup, estimator)
            unsure = np.outer(_UNSURE * bias, _UNSURE * bias)
            found = replace(found, value=found.value - bias, covariance=found.covariance + unsure)
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
        status=status_of(predicted, fitted.still, setup), notes=(*notes, *data.notes),
        seconds=time.perf_counter() - started,
    )  # fmt: skip


def fit_runs(
    fit: Sequence[Record], setup: Setup, processing: Processing, estimator: Estimator
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
    if processing.method == "periodic":
        assert processing.period
        fit = [whole_cycles(record, processing.period) for record in fit]
    resolved = [
        resolution(r.position, r.period, r.position_noise, _cycles(r, processing)) for r in fit
    ]
    band = processing.band or min(found.band for found in resolved)
    processing = replace(processing, band=band)
    data = gather(list(zip(fit, resolved, strict=True)), setup, processing)
    rows = data.matrix.reshape(-1, data.matrix.shape[2])
    structure = identifiability(rows, data.table.names, data.table.units)
    still = ~np.any([part.moves for part in resolved], axis=0)
    resting = [d for d, stands in zip(data.table.drives, still, strict=True) if stands]
    equations = weighted(data, structure, estimator.method, processing.period)
    told = told_by(equations, structure, setup, resting, data.drives)
    found = equations.fitted(told, estimator.ridge, estimator.cut)
    return Fitted(data, processing, equations, structure, told, found, still)


def _cycles(record: Record, processing: Processing) -> int:
    """How many cycles of a motion are taken the mean of."""
    if processing.method != "periodic" or not processing.period:
        return 1
    return round(len(record.force) * record.period / processing.period)


def _whole(told: Identifiability, nominal: np.ndarray, found: Estimate) -> np.ndarray:
    value = nominal.copy()
    value[told.base] += found.value - told.combination @ nominal
    return value


def _noise_stated(data: Gathered) -> bool:
    """Whether sensors state the noise of all positions and of the forces that are used."""
    return all(
        np.all(record.position_noise > 0.0) and np.isfinite(record.force_noise[data.columns]).all()
        for record, _ in data.runs
    )


def _covariance(fitted: Fitted, setup: Setup) -> np.ndarray:
    """Covariance (r, r) by the sensors' noise, larger where residuals are.

    Residuals alone tell it in long logs, and where a smoother adapts to the data.
    """
    data, found = fitted.data, fitted.estimate
    seconds = sum(len(record.force) * record.period for record, _ in data.runs)
    if seconds > _LONG or fitted.processing.method == "optimal":
        return found.covariance
    value, total = fitted.whole(), np.zeros_like(found.covariance)
    for k, (record, resolved) in enumerate(data.runs):
        gain = data.spread(fitted.equations.weight * found.gain, k)
        total += propagated(record, resolved, gain, setup, fitted.processing, value)
    ratio = np.trace(np.linalg.solve(total, found.covariance)) / len(total)
    return total * max(1.0, ratio)


def _bias(fitted: Fitted, setup: Setup, estimator: Estimator) -> np.ndarray:
    """Bias (r,) of an estimate by noise of the positions, with its weights held fast."""
    told, value, data = fitted.told, fitted.whole(), fitted.data
    equations, sure = fitted.equations, fitted.equations.covariance
    if sure is None:
        sure = np.diag(np.mean(fitted.estimate.residual**2, axis=0))
    runs = [
        (beginning(record, _ENOUGH / len(data.runs), fitted.processing.period), resolved)
        for record, resolved in data.runs
    ]
    if any(len(a.force) < len(b.force) for (a, _), (b, _) in zip(runs, data.runs, strict=True)):
        data = gather(runs, setup, fitted.processing)
        equations = weighted(data, fitted.structure, estimator.method, fitted.processing.period)

    def estimated(made: Sequence[Equations]) -> np.ndarray:
        matrix, force = data.taken(made)
        weight = equations.weight
        again = replace(
            equations, matrix=weight[:, :, None] * matrix, force=weight * force, covariance=sure
        )
        return again.fitted(told, estimator.ridge, estimator.cut, order=0).value

    mean = motion_bias(data.runs, setup, fitted.processing, value, estimated, estimator.pairs)
    return mean - told.combination @ value

"""Identification: from records of runs to parameters, what they tell of them, and how well."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.bias import motion_bias
from hydrotele.identify.equations import build_equations
from hydrotele.identify.estimation import REPEATED, Estimator, Weighted, told_by, weighted
from hydrotele.identify.estimators import Estimate
from hydrotele.identify.gathering import Gathered, gather
from hydrotele.identify.identifiability import Identifiability, identifiability
from hydrotele.identify.judging import heldout_errors, heldout_forces, status_of, whiteness
from hydrotele.identify.motion import Processing, resolution
from hydrotele.identify.propagation import propagated
from hydrotele.identify.record import Record, check_repeats, whole_cycles
from hydrotele.identify.result import Identification
from hydrotele.identify.setup import Setup

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


def _covariance(fitted: Fitted, setup: Setup) -> np.ndarray:
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

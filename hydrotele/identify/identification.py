"""Identification: from records of runs to parameters, what they tell of them, and how well."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from hydrotele.errors import InputError
from hydrotele.identify.equations import Equations, build_equations, stacked
from hydrotele.identify.estimators import Estimate, autoregression, estimate
from hydrotele.identify.identifiability import Identifiability, identifiability, told_in_noise
from hydrotele.identify.motion import Processing, resolution
from hydrotele.identify.record import Record, whole_cycles
from hydrotele.identify.reference_size import reference_sizes
from hydrotele.identify.regressor import RUBBING, Regressor
from hydrotele.identify.setup import Setup

Weighting = Literal["gauss_markov", "drives", "none"]
_LEAST = 4.0  # periods of the band that a run must have: its low-pass takes three
_WORSE = 1.5  # times the noise; beyond it the model lacks something
_WHERE = "identification"


@dataclass(frozen=True)
class HeldOut:
    """Force of one drive on the run that was not fitted, in the band of the equations.

    Attributes:
        rms: of measured less predicted force [N] or [N m].
        unit: its unit.
        noise_rms: what a perfect model would show with these sensors; NaN if not known.
        relative: the error's norm over the force's [1].
        nominal_rms: the same as rms, with the given parameters.
    """

    rms: float
    unit: str
    noise_rms: float
    relative: float
    nominal_rms: float


@dataclass(frozen=True)
class Forces:
    """Forces of the held-out run in the band of the equations; n rows, k drives [N] or [N m].

    Attributes:
        run: its name.
        drives: the k drives.
        time: (n,) [s] from its start.
        measured: (n, k), NaN where unknown.
        predicted: (n, k) with the identified parameters.
        nominal: (n, k) with the given parameters.
    """

    run: str
    drives: tuple[str, ...]
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Identification:
    """Result; m parameters, r of them in the base.

    Attributes:
        names: the m parameters.
        units: (m,) SI units.
        nominal: (m,) as given.
        value: (m,) identified; what the data do not tell stays as given.
        structure: what this motion would tell without noise, and the base parameters.
        told: what these data tell in spite of their noise.
        estimate: of the base parameters, with covariance and residuals.
        heldout: drive -> prediction of the held-out run.
        forces: of the held-out run.
        band: of the equations [Hz].
        whiteness: (k,) correlation of a residual with the one before it.
        status: `ok`, or what is wrong and what to do about it.
        notes: one sentence each.
        seconds: that it took.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    value: np.ndarray
    told: Identifiability
    structure: Identifiability
    estimate: Estimate
    heldout: dict[str, HeldOut]
    forces: Forces
    band: float
    whiteness: np.ndarray
    status: str
    notes: tuple[str, ...]
    seconds: float


def identify(
    fit: Sequence[Record], heldout: Record, setup: Setup,
    processing: Processing | None = None, *, ridge: float = 0.0, cut: float = 0.0,
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
        ridge: of the estimator, towards the given parameters.
        cut: of the estimator: truncation of small singular values.
        notes: to hand on.

    Returns:
        The identification.

    Raises:
        InputError: no drive has a force, or there are too few rows.

    Source: Khoshzaban 1992, chapter 4; Abdellatif 2008, section 4.
    """
    started = time.perf_counter()
    if ridge < 0.0 or not 0.0 <= cut < 1.0:
        raise InputError(_WHERE, f"ridge must not be negative and cut below 1: {ridge}, {cut}")
    processing = processing or Processing()
    judging = processing
    if processing.method == "periodic":
        assert processing.period
        fit = [whole_cycles(record, processing.period) for record in fit]
        judging = replace(processing, method="zero_phase")
    resolved = [resolution(r.position, r.period, r.position_noise) for r in (*fit, heldout)]
    band = processing.band or min(found.band for found in resolved[:-1])
    processing, judging = replace(processing, band=band), replace(judging, band=band)
    notes, made = list(notes), []
    for record, found in zip(fit, resolved, strict=False):
        if len(record.force) * record.period * band < _LEAST:
            notes.append(f"{record.name} is too short for a band of {band:.3g} Hz; left out.")
            continue
        made.append(build_equations(record, setup, processing, found))
    if not made:
        raise InputError(_WHERE, f"all runs are too short for a band of {band:.3g} Hz: log longer")
    table, runs = made[0][1], [equations for equations, _ in made]
    matrix, force = stacked(runs, lambda e: e.matrix), stacked(runs, lambda e: e.force)
    drives = [k for k in range(force.shape[1]) if np.isfinite(force[:, k]).any()]
    if not drives:
        raise InputError(_WHERE, "no drive has a known force in any run: log both its pressures")
    matrix, force = matrix[:, drives], force[:, drives]
    there = np.isfinite(force).all(axis=1)
    notes += [
        f"{e.name} lacks the force of {', '.join(lost)} throughout; left out."
        for e in runs
        if (lost := [table.drives[k] for k in drives if np.isnan(e.force[:, k]).all()])
    ]
    if not there.any():
        raise InputError(_WHERE, "no run has the forces of all drives that any run has")
    matrix, force = matrix[there], force[there]
    doubt = stacked(runs, lambda e: e.doubt)[there][:, drives]
    structure = identifiability(_flat(matrix), table.names, table.units)
    still = ~np.any([part.moves for part in resolved[:-1]], axis=0)
    resting = [d for d, stands in zip(table.drives, still, strict=True) if stands]
    first = _fit(matrix, force, table, structure, 0.0, 0.0)
    weight = _weights(first, doubt)
    matrix, force = weight[:, :, None] * matrix, weight * force
    told = _told(matrix, force, table, structure, setup, resting, [table.drives[k] for k in drives])
    found = _fit(matrix, force, table, told, ridge, cut)
    value = table.nominal.copy()
    value[told.base] += found.value - told.combination @ table.nominal
    judged, _ = build_equations(heldout, setup, judging, resolved[-1], with_noise=True)
    predicted = _judge(judged, table, value, drives, setup)
    return Identification(
        names=table.names, units=table.units, nominal=table.nominal, value=value, told=told,
        structure=structure, estimate=found, heldout=predicted,
        forces=_forces(judged, table, value),
        band=band,
        whiteness=_whiteness(found.residual), status=_status(predicted, still, setup),
        notes=tuple(notes), seconds=time.perf_counter() - started,
    )  # fmt: skip


def _flat(matrix: np.ndarray) -> np.ndarray:
    return matrix.reshape(-1, matrix.shape[2])


def _fit(matrix, force, table: Regressor, told: Identifiability, ridge: float, cut: float):
    """Base parameters; what the data do not tell of the others stays as given."""
    base = matrix[:, :, told.base]
    given = told.combination @ table.nominal
    rest = force - matrix @ table.nominal + base @ given
    return estimate(base, rest, ridge=ridge, cut=cut, prior=given)


def _weights(first: Estimate, doubt: np.ndarray) -> np.ndarray:
    """Weights (n, k), 1 at most, of equations in which dry friction may have either sign.

    How much larger their errors are is read off the residuals of a first estimate.
    """
    weights = np.ones_like(first.residual)
    for k in range(doubt.shape[1]):
        square = first.residual[:, k] ** 2
        grows = np.column_stack([np.ones(len(square)), doubt[:, k] ** 2])
        calm, more = nnls(grows * square.size**-0.5, square * square.size**-0.5)[0]
        if calm > 0.0:
            weights[:, k] = np.sqrt(calm / (grows @ (calm, more)))
    return weights


def _told(
    matrix: np.ndarray, force: np.ndarray, table: Regressor, structure: Identifiability,
    setup: Setup, resting: Sequence[str], drives: Sequence[str],
) -> Identifiability:  # fmt: skip
    """What these data tell in spite of their noise.

    Friction of drives that rest is not asked for: whatever holds them is no sliding.
    """
    if not len(structure.base):
        raise InputError(_WHERE, "no parameter has an effect on the forces of this motion")
    first = _fit(matrix, force, table, structure, 0.0, 0.0)
    noise = _long_run(first.residual)
    sizes = reference_sizes(table, setup, np.sqrt(np.mean(force**2, axis=0)), drives)
    held = {f"{kind}.{drive}" for kind in RUBBING for drive in resting}
    asked = np.array([name not in held for name in table.names])
    told = told_in_noise(_flat(matrix / noise[:, None]), table.names, sizes, asked)
    if not len(told.base):
        raise InputError(_WHERE, "these data tell no parameter: log a motion with larger forces")
    return told


def _long_run(residual: np.ndarray) -> np.ndarray:
    """Standard deviations (k,) of independent errors that would tell slow changes as badly."""
    follow = autoregression(residual)
    fresh = residual.copy()
    for q, weights in enumerate(follow, start=1):
        fresh[q:] -= weights * residual[:-q]
    spread = np.std(fresh[len(follow) :], axis=0) / np.abs(1.0 - follow.sum(axis=0))
    return np.maximum(spread, np.std(residual, axis=0))


def _judge(judged: Equations, table: Regressor, value: np.ndarray, drives: list[int], setup: Setup):
    """Drive -> prediction of the held-out run."""
    noise = judged.noise_of(value)
    out = {}
    for k in drives:
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


def _forces(judged: Equations, table: Regressor, value: np.ndarray) -> Forces:
    return Forces(
        judged.name, table.drives, judged.time, judged.force, judged.matrix @ value,
        judged.matrix @ table.nominal,
    )  # fmt: skip


def _whiteness(residual: np.ndarray) -> np.ndarray:
    error = residual - residual.mean(axis=0)
    return np.sum(error[1:] * error[:-1], axis=0) / np.sum(error**2, axis=0)


def _status(heldout: dict[str, HeldOut], still: np.ndarray, setup: Setup) -> str:
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
    return "ok"

"""Verdict on an identification: prediction errors of the held-out run, implausible parameters, remedies."""

import numpy as np

from hydrotele.identify.equations import Equations
from hydrotele.identify.identifiability import Identifiability
from hydrotele.identify.linear_least_squares import Estimate
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.identify.result import HeldOutError, HeldOutForces
from hydrotele.multibody.regressor import FRICTION_TERMS, Regressor

_MAX_ERROR_OVER_NOISE = 1.5  # prediction error over noise above which the model is incomplete
_MAX_ERROR_OVER_RESIDUAL = 3.0  # prediction error over fitted residuals above which the model is overfitted
_MAX_RELATIVE_ERROR = 0.5  # of the force: above it, less than three quarters of its power are explained
_MIN_SKILL_STD = 2.0  # standard deviations by which a prediction must be better than zero force
_MIN_REST_FRACTION = 0.05  # of the compared rows: less rest is not reported
_MIN_REST_UNCERTAINTY = 0.5  # uncertainty of the sign of friction, 0 .. 1, above which a row counts as at rest
_MIN_CORRELATION = 0.8  # of measured and given force, above which their ratio tells a wrong sign or unit
_MAX_FORCE_RATIO = 8.0  # of measured and given force: larger ratios are wrong units (kgf: 9.8) rather than masses
_SIGNIFICANT_STD = 1.959964  # standard deviations, 95 % interval
_POSITIVE_PARAMETERS = ("mass", "inertia_xx", "inertia_yy", "inertia_zz", "drive_inertia", "coulomb", "viscous")


def compute_heldout_errors(
    equations: Equations,
    table: Regressor,
    parameters: np.ndarray,
    columns: list[int],
    setup: RegressorSetup,
) -> dict[str, HeldOutError]:
    """Compute the force prediction errors of each drive on the held-out run.

    Args:
        equations: equations of the held-out run.
        table: names, units and nominal values of the m parameters.
        parameters: (m,) identified parameters.
        columns: indices of the drives whose force is known in the fitted runs.
        setup: definition of the regressor.

    Returns:
        Drive -> errors. Drives without known forces are omitted.
    """
    noise, out = equations.noise_rms(parameters), {}
    numbers = dict(zip(table.names, parameters, strict=True))
    for k in columns:
        known, drive = np.isfinite(equations.force[:, k]), table.drives[k]
        if not known.any():
            continue
        force = equations.force[known, k]
        error, given = (force - equations.matrix[known, k] @ p for p in (parameters, table.nominal))
        rest = equations.friction_sign_uncertainty[known, k]
        friction = max(float(numbers.get(f"coulomb.{drive}", 0.0)), 0.0)
        at_rest = rest > _MIN_REST_UNCERTAINTY
        excess = np.maximum(np.abs(error) - friction * at_rest, 0.0)
        unit = "N" if setup.chain.tree.is_slide[setup.chain.index(drive)] else "N m"
        size = _rms(error)
        out[drive] = HeldOutError(
            size, unit, float(noise[k]), size / max(_rms(force), 1e-300), _rms(given),
            is_explained=_is_better_than_zero(force, error, equations),
            rest_fraction=float(np.mean(at_rest)), rest_friction=friction, excess_rms=_rms(excess),
        )  # fmt: skip
    return out


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _is_better_than_zero(force: np.ndarray, error: np.ndarray, equations: Equations) -> bool:
    """Return whether prediction errors are significantly smaller than those of predicting zero force.

    The mean of force^2 - error^2 must exceed two standard deviations of this mean. A band b [Hz] over a
    duration T holds 2 b T independent values.
    """
    gain = force**2 - error**2
    independent = max(2.0 * equations.band * len(force) * equations.spacing, 2.0)
    return bool(np.mean(gain) > _MIN_SKILL_STD * np.std(gain) / np.sqrt(min(independent, len(force))))


def compute_heldout_forces(equations: Equations, table: Regressor, value: np.ndarray) -> HeldOutForces:
    """Compute the forces of the held-out run predicted with identified and given parameters.

    Args:
        equations: equations of the held-out run.
        table: names, units and nominal values of the m parameters.
        value: (m,) identified parameters.

    Returns:
        Measured and predicted forces of all drives.
    """
    return HeldOutForces(
        equations.name, table.drives, equations.time, equations.force, equations.matrix @ value,
        equations.matrix @ table.nominal,
    )  # fmt: skip


def find_wrong_force_columns(forces: HeldOutForces, heldout: dict[str, HeldOutError]) -> tuple[str, ...]:
    """Find measured forces with a wrong sign or unit by comparison with those of the given model.

    Args:
        forces: forces of the held-out run.
        heldout: prediction errors of the held-out run.

    Returns:
        One note per drive whose measured force is a negative, large or small multiple of that of the given
        model: the ratio is outside 1/8 to 8, and the correlation at least 0.8 in magnitude.
    """
    notes = []
    for k, drive in enumerate(forces.drives):
        known = np.isfinite(forces.measured[:, k])
        measured, given = forces.measured[known, k], forces.nominal[known, k]
        power = float(np.sum(given**2) * np.sum(measured**2))
        if drive not in heldout or power <= 0.0:
            continue
        if abs(float(measured @ given)) < _MIN_CORRELATION * np.sqrt(power):
            continue
        ratio = float(measured @ given / (given @ given))
        if not 1.0 / _MAX_FORCE_RATIO < ratio < _MAX_FORCE_RATIO:
            notes.append(
                f"{drive}: the measured force is {ratio:.3g} times that of the given model: check the sign and unit of"
                " its column."
            )
    return tuple(notes)


def find_implausible_parameters(identifiability: Identifiability, table: Regressor, found: Estimate) -> tuple[str, ...]:
    """Find masses, moments of inertia and friction that are negative with 95 % confidence.

    Args:
        identifiability: base parameters, as combinations of all parameters.
        table: names, units and nominal values of the parameters.
        found: estimate of the base parameters.

    Returns:
        One sentence per implausible parameter. A combination of parameters is reported if it can only be
        positive, as a sum with positive factors. One that represents friction is also reported if its
        value with the nominal parameters is not negative.
    """
    notes = []
    for k, b in enumerate(identifiability.base):
        members = np.flatnonzero(identifiability.combination[k])
        kinds = {table.names[m].partition(".")[0] for m in members}
        own, place = table.names[b].partition(".")[::2]
        is_friction = own in FRICTION_TERMS
        if own not in _POSITIVE_PARAMETERS or found.value[k] + _SIGNIFICANT_STD * found.std[k] >= 0.0:
            continue
        given = float(identifiability.combination[k] @ table.nominal)
        positive = kinds <= set(_POSITIVE_PARAMETERS) and (identifiability.combination[k, members] > 0.0).all()
        if positive or (is_friction and given >= 0.0):
            notes.append(
                f"{own}.{place} is negative, {found.value[k]:.3g} +- {_SIGNIFICANT_STD * found.std[k]:.2g}"
                f" {table.units[b]}, which is physically impossible: check sign, unit and column of the force."
            )
    return tuple(notes)


def describe_drives_at_rest(heldout: dict[str, HeldOutError], run: str) -> tuple[str, ...]:
    """Return notes on drives that are at rest in more than 5 % of the rows of the held-out run.

    Args:
        heldout: prediction errors of the held-out run.
        run: name of the held-out run.
    """
    return tuple(
        f"{drive} is at rest in {100 * h.rest_fraction:.0f} % of {run}: there its dry friction is any force within"
        f" +-{h.rest_friction:.3g} {h.unit}, and the prediction has none. Beyond that interval, the RMS error of all"
        f" rows is {h.excess_rms:.3g} {h.unit}."
        for drive, h in heldout.items()
        if h.rest_fraction > _MIN_REST_FRACTION
    )


def residual_autocorrelation(residual: np.ndarray) -> np.ndarray:
    """Return the correlation (k,) of successive rows of residuals (n, k): 0 for white noise."""
    error = residual - residual.mean(axis=0)
    return np.sum(error[1:] * error[:-1], axis=0) / np.sum(error**2, axis=0)


def assess_identification(
    heldout: dict[str, HeldOutError],
    fitted: dict[str, float],
    resting: np.ndarray,
    setup: RegressorSetup,
    findings: tuple[str, ...] = (),
) -> str:
    """Assess an identification: return `ok`, or the most important problem with its remedy.

    Problems are checked in this order: held-out forces predicted worse or not significantly better than
    by zero force; joints at rest; no held-out force; relative error above 0.5; `findings`; error above
    three times the fitted residuals (overfitted); error above 1.5 times the sensor noise.

    Args:
        heldout: prediction errors of the held-out run.
        fitted: drive -> RMS of the residuals of the fitted runs [N] or [N m].
        resting: (k,) whether a given joint was at rest in all fitted runs.
        setup: definition of the regressor.
        findings: sentences on forces with a wrong sign or unit and on implausible parameters.

    Returns:
        `ok`, or a sentence that names the problem and the remedy.
    """
    worse = [d for d, h in heldout.items() if h.relative_error >= 1.0]
    if worse:
        return (
            f"on the held-out run the model predicts {', '.join(worse)} worse than zero force: are columns swapped, or"
            " is a sign or unit wrong?"
        )
    if worse := [d for d, h in heldout.items() if not h.is_explained]:
        return (
            f"on the held-out run the model predicts {', '.join(worse)} no better than zero force: the parameters"
            " explain nothing; check the columns of force and position"
        )
    if resting.any():
        names = ", ".join(j for j, stands in zip(setup.given_joints, resting, strict=True) if stands)
        return (
            f"{names} did not move: parameters that need its motion keep their given values;"
            " log a fast motion of all axes in many poses"
        )
    if not heldout:
        return "the held-out run has no known force, so nothing was validated: hold out another run"
    if worse := [d for d, h in heldout.items() if h.relative_error > _MAX_RELATIVE_ERROR and not h.rest_fraction]:
        parts = ", ".join(f"{100 * (1 - heldout[d].relative_error ** 2):.0f} % of {d}" for d in worse)
        return (
            f"on the held-out run the model explains only {parts} (squared force): the force depends mostly on"
            " something else, or is noise; search for missing effects with `hydrotele gap`"
        )
    if findings:
        return findings[0].removesuffix(".")
    worse = [d for d, h in heldout.items() if h.excess_rms > _MAX_ERROR_OVER_RESIDUAL * fitted[d]]
    if worse:
        ratios = ", ".join(f"{heldout[d].excess_rms / max(fitted[d], 1e-300):.1f} times for {d}" for d in worse)
        return (
            f"overfitted: the force error on the held-out run is {ratios} as large as on the fitted runs: their"
            " motion is not informative enough; fit runs like the held-out run as well"
        )
    worse = [d for d, h in heldout.items() if h.excess_rms > _MAX_ERROR_OVER_NOISE * h.noise_rms]
    if worse:
        return (
            f"on the held-out run the force error of {', '.join(worse)} exceeds the sensor noise:"
            " the model is incomplete; search for missing effects with `hydrotele gap`"
        )
    return "ok"

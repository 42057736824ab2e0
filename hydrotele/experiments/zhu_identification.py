"""Zhu 1994, 6.1.3: parameters of the static models by recursive least squares, and bad data.

A static model gives the joint torques due to gravity. The machines move slowly from one
configuration to another in simulation; pressures and angles come from their simulated sensors. As
many samples as in the document's figures are estimated from: 250 of the excavator, 400 of the
feller-buncher.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from hydrotele.control.gravity_model import GravityModel, fit_gravity_to_masses, identify_gravity
from hydrotele.core.errors import InputError
from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
)
from hydrotele.experiments.scenario_runs import run_shipped_scenario
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.logs.log import Log

_INITIAL_SAMPLES = 50  # samples from which the document computed the initial parameters
_MAX_RELATIVE_CHANGE = 0.01  # relative to the largest parameter
_FAILURE_SAMPLES = 8  # random samples of failures per run
_MAX_REPETITIONS = 6  # repetitions; a run of the machine takes several seconds

_MACHINE_SCENARIOS = {
    "excavator": ("slow_moves", 250, "6.37-6.40"),
    "feller-buncher": ("feller_slow_moves", 400, "6.41-6.44"),
}


def _compute_scaled_error(found: np.ndarray, true: np.ndarray) -> float:
    """Return the largest absolute difference of `found` and `true` parameters over the largest true parameter."""
    return float(np.abs(found - true).max() / np.abs(true).max())


def measure_convergence(name: str, seed: int, changes: Changes) -> Sample:
    """Estimate a machine's gravity parameters by recursive least squares and record their convergence.

    Args:
        name: `excavator` or `feller-buncher`.
        seed: seed of the sensor noise.
        changes: scenario keys.

    Returns:
        `late`: largest difference from the final estimate in the second half of the samples. `error`:
        largest difference of the final estimate from the parameters that follow from the machine's
        masses. Both are relative to the largest parameter. Per parameter P1, P2, ...: estimate (`P1`),
        half-width of its 95 % interval (`interval P1`), and value by the masses (`true P1`) [N m].
    """
    scenario, samples, _ = _MACHINE_SCENARIOS[name]
    shipped, run = run_shipped_scenario(scenario, {"seed": str(seed)} | dict(changes))
    machine = run.plant.machine
    true = fit_gravity_to_masses(machine).value
    period = shipped.duration / samples
    found = identify_gravity(machine, run.measured, period=period)
    half = len(found.history) // 2
    values = {"late": max(_compute_scaled_error(row, found.value) for row in found.history[half:]),
              "error": _compute_scaled_error(found.value, true)}  # fmt: skip
    for i, value in enumerate(found.value):
        values |= {f"P{i + 1}": value, f"interval P{i + 1}": found.ci95_half_width[i],
                   f"true P{i + 1}": true[i]}  # fmt: skip
    number = np.arange(len(found.history))[_INITIAL_SAMPLES:]
    return Sample(values, tuple(
        Panel(f"P{i + 1}, factor of {part} [kN m]", number, {
            "estimated": found.history[_INITIAL_SAMPLES:, i] / 1e3,
            "of the masses": np.full(len(number), true[i] / 1e3),
        }, "sample")
        for i, part in enumerate(found.names)
    ))  # fmt: skip


def describe_parameters(samples: Sequence[Sample]) -> Evaluation:
    """Return a note with the estimated and true gravity parameters [kN m], without a verdict.

    The available text does not contain the published curves.
    """
    count = sum(name.startswith("true P") for name in samples[0].values)
    words = [
        f"P{i} {format_values(samples, f'P{i}', 1e-3)} (masses {samples[0].values[f'true P{i}'] / 1e3:.1f})"
        for i in range(1, count + 1)
    ]
    return Evaluation(note=f"in kN m: {', '.join(words)}")


def evaluate_convergence(samples: Sequence[Sample]) -> Evaluation:
    """Check that estimated gravity parameters change by less than 1 % in the second half, and err by less than 2 %.

    The change is the difference from the final estimate in the second half of the samples; the error is
    that of the final estimate. Both are relative to the largest parameter.
    """
    reason = "converged to 1 % of the largest parameter"
    return Evaluation((
        check_mean("largest change of a parameter during the second half of the samples, relative to the "
                "largest parameter", collect_values(samples, "late"), (-np.inf, _MAX_RELATIVE_CHANGE), reason),
        check_mean("largest final error of a parameter, relative to the largest parameter",
                   collect_values(samples, "error"), (-np.inf, 2.0 * _MAX_RELATIVE_CHANGE),
                   "2 %: the static model neglects inertia and the shape of friction"),
    ))  # fmt: skip


def simulate_sensor_failures(log: Log, axes: Sequence[str], failures: int, rng: np.random.Generator) -> Log:
    """Return a log in which readings of random sensors are zero for 0.5 to 3 s each.

    Args:
        log: measured log.
        axes: axes whose angles and pressures may fail.
        failures: number of failures.
        rng: random generator of sensors and times.

    Returns:
        The log with the failures.
    """
    kinds = ("angle", "pressure_head", "pressure_rod")
    names = [f"{kind}.{axis}" for axis in axes for kind in kinds]
    columns = dict(log.columns)
    for _ in range(failures):
        name = names[rng.integers(len(names))]
        begin, lasts = rng.uniform(log.time[0], log.time[-1] - 3.0), rng.uniform(0.5, 3.0)
        dead = (log.time > begin) & (log.time < begin + lasts)
        columns[name] = np.where(dead, 0.0, columns[name])
    return Log(log.time, columns, log.units)


def measure_outliers(seed: int, changes: Changes) -> Sample:
    """Compute errors of the excavator's gravity parameters without and with sensor failures.

    Args:
        seed: seed of sensor noise and failures.
        changes: `failures`: number of sensor failures per log; `remove`: whether outliers are removed.

    Returns:
        Largest parameter error relative to the largest parameter: `clean` without failures, `spoilt` with
        failures, `kept` with failures after the removal of outliers. `removed`: number of removed
        samples. The last three are means over eight logs with random failures.
    """
    given = {"failures": 6, "remove": True}
    if unknown := sorted(set(changes) - set(given)):
        raise InputError("changes", f"{', '.join(unknown)} unknown; valid: failures, remove")
    given |= changes
    scenario, samples, _ = _MACHINE_SCENARIOS["excavator"]
    shipped, run = run_shipped_scenario(scenario, {"seed": str(seed)})
    machine, period = run.plant.machine, shipped.duration / samples
    true = fit_gravity_to_masses(machine).value
    rng = np.random.default_rng([seed, 81])

    def identify_from_log(log: Log, remove: bool) -> GravityModel:
        return identify_gravity(machine, log, remove_outliers=remove, period=period)

    clean, spoilt, kept = identify_from_log(run.measured, False), [], []
    for _ in range(_FAILURE_SAMPLES):
        bad = simulate_sensor_failures(run.measured, ("boom", "stick", "bucket"), int(given["failures"]), rng)
        spoilt.append(identify_from_log(bad, False))
        kept.append(identify_from_log(bad, bool(given["remove"])))
    number = np.arange(_INITIAL_SAMPLES, len(clean.history))
    return Sample({
        "clean": _compute_scaled_error(clean.value, true),
        "spoilt": float(np.mean([_compute_scaled_error(one.value, true) for one in spoilt])),
        "kept": float(np.mean([_compute_scaled_error(one.value, true) for one in kept])),
        "removed": float(np.mean([len(one.outlier_indices) for one in kept])),
    }, (
        Panel("P1, factor of C2 [kN m]", number, {
            "no failure": clean.history[_INITIAL_SAMPLES:, 0] / 1e3,
            "sensor failures": spoilt[0].history[_INITIAL_SAMPLES:, 0] / 1e3,
        }, "sample"),
    ))  # fmt: skip


def _compute_ratio_of_means(rows: np.ndarray) -> float:
    return float(rows[:, 0].mean() / rows[:, 1].mean())


def _pair_errors_with_clean(samples: Sequence[Sample], name: str) -> np.ndarray:
    return np.column_stack([collect_values(samples, name), collect_values(samples, "clean")])


def evaluate_outlier_effect(samples: Sequence[Sample]) -> Evaluation:
    """Check that sensor failures at least double the error of the gravity parameters."""
    return Evaluation(
        (check_bootstrapped_statistic("parameter error with sensor failures over that without",
                         _pair_errors_with_clean(samples, "spoilt"), _compute_ratio_of_means, (2.0, np.inf),
                         "strong: at least twice; no size is published"),),
        note=f"{format_values(samples, 'spoilt', 100.0)} % of the largest parameter with sensor failures,"
        f" {format_values(samples, 'clean', 100.0)} % without",
    )  # fmt: skip


def _compute_removed_fraction(rows: np.ndarray) -> float:
    """Return the fraction of the parameter error due to sensor failures that removing outliers eliminates.

    Args:
        rows: (n, 3) errors with failures, after the removal, and without failures.
    """
    spoilt, kept, clean = rows.mean(axis=0)
    return float((spoilt - kept) / (spoilt - clean))


def evaluate_outlier_removal(samples: Sequence[Sample]) -> Evaluation:
    """Check that removing outliers eliminates at least 75 % of the parameter error that sensor failures cause."""
    rows = np.column_stack([collect_values(samples, name) for name in ("spoilt", "kept", "clean")])
    return Evaluation(
        (check_bootstrapped_statistic(
            "fraction of the additional error due to sensor failures that the removal of outliers "
                "eliminates",
                         rows, _compute_removed_fraction, (0.75, np.inf),
                         "eliminated: at least three quarters; no size is published"),),
        note=f"{format_values(samples, 'kept', 100.0)} % of the largest parameter;"
        f" {format_values(samples, 'removed', 1.0, 0)} of 250 samples removed",
    )  # fmt: skip


def _make_convergence_experiment(name: str) -> Experiment:
    _, samples, figures = _MACHINE_SCENARIOS[name]
    judge: Callable[[Sequence[Sample]], Evaluation] = describe_parameters
    claims = (
        Claim(f"{name}: parameters by recursive least squares",
              f'"{name.capitalize()} link parameter identification"; curves over {samples} samples',
              f"p. {82 if name == 'excavator' else 86}, Figs {figures}", "caption", judge),
        Claim(f"{name}: convergence of the parameters",
              "the estimates converge: in the second half of the samples no parameter changes by"
              " more than 1 % of the largest parameter, and final errors are below 2 % of it",
              f"additional to p. 81, Figs {figures}", "additional", evaluate_convergence,
              {"duration": "20.0"}, "the machine moves for 20 s, only to the first configuration"),
    )  # fmt: skip
    return Experiment(f"parameters of the {name}", partial(measure_convergence, name), claims, _MAX_REPETITIONS)


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment("outliers", measure_outliers, (
        Claim("outliers: effect on the parameters",
              '"Since the number of observations is always limited, these outliers can have a'
              ' strong effect on the estimated parameters."', "p. 81", "document", evaluate_outlier_effect,
              {"failures": 0}, "no sensor fails"),
        Claim("outliers: removed before the estimation",
              'outliers of the residuals "can be eliminated, and the estimation procedure'
              ' repeated"', "p. 81", "document", evaluate_outlier_removal, {"remove": False},
              "outliers are kept"),
    ), _MAX_REPETITIONS),
    _make_convergence_experiment("excavator"),
    _make_convergence_experiment("feller-buncher"),
)  # fmt: skip

DRAWINGS: dict[str, str] = {
    "Figure 6.35": "drawing of a two-bar linkage",
    "Figure 6.36": "drawing of a four-bar linkage",
}

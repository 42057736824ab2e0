"""Repeated identification of PaLiDA with new force noise in every trial (Abdellatif 2008).

The module compares the estimates and their covariance with Table 2, Figs 8 and 9 and the text on
least squares (sections 3, 4.2 and 5.3). Friction can decrease over the first trials, as in a
machine that warms up.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binomtest, ncx2

from hydrotele.experiments.abdellatif_processing import (
    average_force_over_periods,
    average_periods,
    compute_motion_from_lengths,
)
from hydrotele.experiments.comparison import (
    Changes,
    Check,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.palida import (
    CHI2_LIMIT,
    LENGTH_NOISE,
    PUBLISHED_PARAMETERS,
    SYMBOLS,
    compute_force_covariance,
    load_robot,
    sample_force_noise,
    simulate_excitation,
    simulate_measurement,
)
from hydrotele.experiments.palida_control import compute_control_gains
from hydrotele.experiments.statistical_checks import (
    CONFIDENCE,
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_fraction,
    check_mean,
    collect_values,
)
from hydrotele.identify.linear_least_squares import estimate_linear_parameters

PERIODS_PER_TRIAL = 4
"""Repetitions of the motion in one trial; the document gives no number."""
TRIALS_PER_SERIES = 100
"""Trials in one series (section 5.3)."""
FRICTION_EXCESS = 0.03
"""Relative excess of all friction parameters in the first trial over their stationary values.

Assumed: the document says only that friction varies "at the beginning of the measurement process".
"""
EXCESS_DECAY = 0.1
"""Factor of the friction excess from one trial to the next; assumed.

An excess of 0.3 % puts one in seven second trials outside the ellipsoid; 5 % are expected without
excess.
"""
RIPPLE_FORCE, RIPPLE_PITCH = 5.0, 0.03
"""Amplitude [N] and period in leg length [m] of a repeatable force, such as motor cogging.

Assumed; used only to explain a difference.
"""
MAX_EXCEPTIONS = 0.1
"""Largest fraction of estimates outside their intervals that counts as "mostly within".

Twice the 5 % that are expected outside a 95 % interval.
"""
_PRINTED_VALUES = np.array([one.value for one in PUBLISHED_PARAMETERS])
_PRINTED_DEVIATIONS = np.array([one.std for one in PUBLISHED_PARAMETERS])
_IS_FRICTION = np.array([one.column.startswith(("coulomb", "viscous")) for one in PUBLISHED_PARAMETERS])


class NormalEquations:
    """Least-squares normal equations of one regressor, reused for many force records and drive covariances.

    Attributes:
        matrix: (n, 6, 24) regressor: n samples, 6 drives, 24 parameters.
    """

    def __init__(self, matrix: np.ndarray):
        """Precompute the products of the regressor columns for all pairs of drives.

        Args:
            matrix: (n, 6, 24) regressor.
        """
        self.matrix = matrix
        self._columns = np.ascontiguousarray(matrix.transpose(1, 2, 0)).reshape(-1, len(matrix))
        products = (self._columns @ self._columns.T).reshape(6, 24, 6, 24)
        self._products = products.transpose(0, 2, 1, 3)

    def information(self, weight: np.ndarray) -> np.ndarray:
        """Return the (24, 24) information matrix: inverse of the parameters' covariance.

        Args:
            weight: (6, 6) weight of the drives, the inverse of their noise covariance [1/N^2].
        """
        return np.tensordot(weight, self._products, axes=2)

    def solve(
        self, weight: np.ndarray, correlations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Estimate the parameters of t trials by weighted least squares, Abdellatif 2008, (21).

        Args:
            weight: (t, 6, 6) inverse of the noise covariance of the drives in each trial [1/N^2], or
                (1, 6, 6) for all trials.
            correlations: (t, 6, 6, 24) products of regressor columns and forces; see `correlate`.

        Returns:
            Estimates (t, 24) and their information matrices (t, 24, 24).
        """
        information = np.tensordot(weight, self._products, axes=2)
        right = np.sum(weight[..., None] * correlations, axis=(1, 2))
        return np.linalg.solve(information, right[..., None])[..., 0], information

    def correlate(self, force: np.ndarray) -> np.ndarray:
        """Return the products of each drive's regressor columns with each drive's force, summed over samples.

        Args:
            force: (n, 6) drive forces [N].

        Returns:
            (6, 6, 24): drive of the columns, drive of the force, parameter.
        """
        return (self._columns @ force).reshape(6, 24, 6).transpose(0, 2, 1)


class TrialEstimates(NamedTuple):
    """Estimates of a series of t trials.

    Attributes:
        value: (t, 24) Gauss-Markov estimates: least squares weighted by the inverse noise covariance.
        information: (t, 24, 24) inverse of the covariance of `value` by Abdellatif 2008, (28).
        first_without_excess: (24,) Gauss-Markov estimate of the first trial with the same noise but
            stationary friction.
        least_squares: (t, 24) estimates with equal weights for all drives.
        ripple_estimates: (t, 24) estimates if the measured forces contain an additional force that
            repeats in every trial. The weight is the inverse covariance of residuals and noise.
        ripple_information: (24, 24) inverse of the covariance of `ripple_estimates` by (28).
    """

    value: np.ndarray
    information: np.ndarray
    first_without_excess: np.ndarray
    least_squares: np.ndarray
    ripple_estimates: np.ndarray
    ripple_information: np.ndarray


TRIAL_SETTINGS = {
    "friction_excess": FRICTION_EXCESS, "claimed_noise": 1.0, "processing": "periodic",
    "trials": TRIALS_PER_SERIES,
}  # fmt: skip
"""Settings of `simulate_trials`.

- `friction_excess`: relative friction excess in the first trial.
- `claimed_noise`: force noise standard deviation used in the estimate over the actual one.
- `processing`: `periodic` or `raw`; see `compute_motion_from_lengths`.
- `trials`: number of trials.
"""


def simulate_trials(seed: int, settings: Changes) -> TrialEstimates:
    """Identify PaLiDA in a series of trials with new force noise in every trial.

    All trials of a series use the same leg length noise, whose effect on the estimates is small.

    Args:
        seed: seed of the series.
        settings: all settings of `TRIAL_SETTINGS`: relative friction excess in the first trial, force
            noise assumed in the estimate over the actual one, processing of the leg lengths, and
            number of trials.

    Returns:
        The estimates of all trials.

    Source: Abdellatif 2008, (21), (28), section 5.3.
    """
    own, cycle = load_robot(), simulate_excitation()
    rng = np.random.default_rng([2008, seed])
    record = simulate_measurement(cycle, PERIODS_PER_TRIAL, rng)
    lengths = record.position.reshape(PERIODS_PER_TRIAL, -1, 6).mean(axis=0)
    averaged = replace(record, position=lengths, force=cycle.force)
    motion = compute_motion_from_lengths(averaged, cycle.period, settings["processing"])
    equations = NormalEquations(own.matrix(motion))
    friction = cycle.matrix[:, :, _IS_FRICTION] @ own.truth[_IS_FRICTION]
    friction = settings["friction_excess"] * friction
    found, weights = [], []
    for number in range(settings["trials"]):
        noise = sample_force_noise((PERIODS_PER_TRIAL, len(lengths)), rng)
        mean, covariance = average_force_over_periods(noise)
        covariance = settings["claimed_noise"] ** 2 * covariance / PERIODS_PER_TRIAL
        weights.append(np.linalg.inv(covariance))
        found.append(equations.correlate(cycle.force + EXCESS_DECAY**number * friction + mean))
    weight, correlations = np.array(weights), np.array(found)
    value, information = equations.solve(weight, correlations)
    warm, _ = equations.solve(weight[:1], correlations[:1] - equations.correlate(friction))
    plain, _ = equations.solve(np.eye(6)[None], correlations)
    ripple = RIPPLE_FORCE * np.sin(2.0 * np.pi / RIPPLE_PITCH * cycle.length)
    residual = cycle.force + ripple - equations.matrix @ (value[-1] + equations.solve(
        weight[-1:], equations.correlate(ripple)[None])[0][0])  # fmt: skip
    total = np.linalg.inv(weight[-1]) + residual.T @ residual / len(residual)
    rippled, claimed = equations.solve(
        np.linalg.inv(total)[None], correlations + equations.correlate(ripple))  # fmt: skip
    return TrialEstimates(value, information, warm[0], plain, rippled, claimed[0])


def compute_trial_statistics(seed: int, changes: Changes) -> Sample:
    """Simulate one series of identification trials and compute statistics of its estimates.

    Args:
        seed: seed of the series.
        changes: changes of `TRIAL_SETTINGS`, such as the number of trials.

    Returns:
        Arrays of the t trials. `value` (t, 24) are Gauss-Markov estimates with standard deviations
        `std` (24,); `least_squares` (t, 24) are unweighted. `distance` (t,) is the squared
        Mahalanobis distance of each trial's 24 estimates from the mean of all trials after the first.
        The scalar values are squared distances of the first trial from this mean, with and without
        excess friction, and fractions of estimates inside or outside of 95 % intervals.
    """
    trials = simulate_trials(seed, merge_settings(TRIAL_SETTINGS, changes))
    later = trials.value[1:]
    mean = later.mean(axis=0)
    std = np.sqrt(np.diag(np.linalg.inv(trials.information[-1])))
    distance = compute_squared_mahalanobis(trials.value - mean, trials.information)
    rippled = trials.ripple_estimates[1:] - trials.ripple_estimates[1:].mean(axis=0)
    outside = np.abs(trials.value - mean) > 2.0 * std
    values = {
        "printed": float(np.mean(np.abs(later - _PRINTED_VALUES) <= 2.0 * _PRINTED_DEVIATIONS)),
        "inside": float(1.0 - outside[1:].mean()), "first": float(outside[0].mean()),
        "p1": float(outside[1:, 0].mean()), "first distance": float(distance[0]),
        "warm first distance": float(
            compute_squared_mahalanobis(trials.first_without_excess - mean, trials.information[0])),
        "rippled": float(np.mean(
            compute_squared_mahalanobis(rippled, trials.ripple_information) < CHI2_LIMIT)),
        "common shift": float(np.sqrt(compute_squared_mahalanobis(
            mean - load_robot().truth, trials.information[-1]))),
    }  # fmt: skip
    arrays = {"value": trials.value, "least_squares": trials.least_squares, "std": std,
              "distance": distance}  # fmt: skip
    return Sample(values, (*_draw_history(trials.value, mean, std), _draw_distance(distance)),
                  arrays)  # fmt: skip


def compute_squared_mahalanobis(error: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis distance of parameter errors, Abdellatif 2008, (29).

    Args:
        error: (..., 24) parameter errors.
        information: (..., 24, 24) inverse of their covariance.

    Returns:
        (...) squared distances [1].
    """
    return np.einsum("...p,...pq,...q->...", error, information, error)


def _draw_history(value: np.ndarray, mean: np.ndarray, std: np.ndarray) -> tuple[Panel, ...]:
    number, ones = np.arange(1.0, len(value) + 1), np.ones(len(value))
    return tuple(
        Panel(f"{SYMBOLS[k]} over its mean [1]", number,
              {"estimate": value[:, k] / mean[k],
               "upper bound": (1.0 + 2.0 * abs(std[k] / mean[k])) * ones,
               "lower bound": (1.0 - 2.0 * abs(std[k] / mean[k])) * ones}, "trial")
        for k in (0, 1, 4, 9, 12, 18)
    )  # fmt: skip


_DISTANCE_LABEL = "squared distance from mean [1]"


def _draw_distance(distance: np.ndarray) -> Panel:
    limit = np.full(len(distance), CHI2_LIMIT)
    return Panel(_DISTANCE_LABEL, np.arange(1.0, len(distance) + 1),
                 {"trial": distance, "95 % ellipsoid": limit}, "trial", log=True)  # fmt: skip


def evaluate_printed_intervals(samples: Sequence[Sample]) -> Evaluation:
    """Check that at least 90 % of the simulated estimates lie inside the published 95 % intervals.

    The intervals are printed in Abdellatif 2008, Table 2. The first trial of a series does not count.
    """
    check = check_mean(
        "fraction of the estimates within the printed 95 % intervals", collect_values(samples, "printed"),
        (1.0 - MAX_EXCEPTIONS, 1.0), "at most twice the 5 % expected outside a 95 % interval",
    )  # fmt: skip
    return Evaluation((check,))


def evaluate_standard_deviations(samples: Sequence[Sample]) -> Evaluation:
    """Check that the 24 standard deviations of parameters are within a factor of two of the published ones.

    The simulated standard deviations are averaged over the series of trials. The published ones are a
    quarter of the widths of the 95 % intervals in Abdellatif 2008, Table 2.
    """
    ratio = np.mean([sample.arrays["std"] for sample in samples], axis=0) / _PRINTED_DEVIATIONS
    low, high = int(np.argmin(ratio)), int(np.argmax(ratio))
    words = "standard deviation over the printed one, "
    reason = "noise and geometry of the model are chosen to agree within a factor of two"
    return Evaluation(
        (
            check_deterministic_value(f"{words}smallest ({SYMBOLS[low]})", ratio[low], (0.5, 2.0), reason),
            check_deterministic_value(f"{words}largest ({SYMBOLS[high]})", ratio[high], (0.5, 2.0), reason),
        ),
        note=f"geometric mean {np.exp(np.mean(np.log(ratio))):.2f}",
    )


def evaluate_estimates_over_trials(samples: Sequence[Sample]) -> Evaluation:
    """Check how many estimates lie inside their own 95 % intervals about the mean of the series of trials.

    At most 10 % of the estimates of all trials after the first may lie outside. More than 10 % of the
    24 estimates of the first trial must lie outside, because friction is not yet stationary.
    """
    return Evaluation((
        check_mean(
            "fraction of the estimates after the first trial within their intervals",
            collect_values(samples, "inside"), (1.0 - MAX_EXCEPTIONS, 1.0),
            '"mostly": at most twice the 5 % expected outside a 95 % interval'),
        check_mean(
            "fraction of the 24 estimates of the first trial outside their intervals",
            collect_values(samples, "first"), (MAX_EXCEPTIONS, 1.0),
            '"exceptions": more than twice the 5 % expected outside a 95 % interval'),
    ))  # fmt: skip


def evaluate_first_parameter(samples: Sequence[Sample]) -> Evaluation:
    """Check whether more than 10 % of the estimates of the first parameter lie outside their 95 % intervals.

    The parameter p1 is a sum of moments of inertia. The intervals are about the mean of a series of
    trials, as in Abdellatif 2008, Fig. 8. The first trial of a series does not count.
    """
    check = check_mean(
        "fraction of the estimates of p1 outside their intervals", collect_values(samples, "p1"),
        (MAX_EXCEPTIONS, 1.0),
        '"exceptions": more than twice the 5 % expected outside a 95 % interval',
    )  # fmt: skip
    others = 100.0 * (1.0 - float(np.mean(collect_values(samples, "inside"))))
    return Evaluation(
        (check,),
        f"only the simulated force noise changes from trial to trial, and the covariance includes"
        f" all of it, so that p1 is no exception ({others:.1f} % of all estimates are"
        " outside); in the document the sum of moments of inertia p1 has a negative estimate, which"
        " must therefore include unmodelled effects",
    )


def evaluate_first_trial(samples: Sequence[Sample]) -> Evaluation:
    """Check that the friction excess at the start moves the first trial out of the 95 % confidence ellipsoid.

    The ellipsoid of all 24 parameters is centred at the mean of the other trials of a series. In more
    than half of the series the first trial must lie outside. With the same noise but stationary
    friction, less than half of the first trials may lie outside.
    """
    cold, warm = (collect_values(samples, name) for name in ("first distance", "warm first distance"))
    return Evaluation(
        (
            check_fraction("fraction of the first trials outside the ellipsoid", cold > CHI2_LIMIT,
                           reason="more than half of the series; the document had one"),
            check_fraction("fraction outside with the same noise and stationary friction from"
                           " the start", warm > CHI2_LIMIT, (0.0, 0.5),
                           "less than half of the series: friction is the cause"),
        ),
        note=f"squared distance of the first trial {np.median(cold):.0f} with"
        f" {100 * FRICTION_EXCESS:.0f} % more friction, {np.median(warm):.0f} without (medians)",
    )  # fmt: skip


def evaluate_ellipsoid(samples: Sequence[Sample]) -> Evaluation:
    """Compare the fraction of trials within the 95 % confidence ellipsoid with 99 of 99 published trials.

    The ellipsoid of the parameter estimates is centred at the mean of the series (Abdellatif 2008,
    Fig. 9). The first trial of each series does not count. The simulated fraction agrees if it is above
    the lower limit of the 95 % interval of the fraction that 99 of 99 trials give.
    """
    distance = np.concatenate([sample.arrays["distance"][1:] for sample in samples])
    published = TRIALS_PER_SERIES - 1
    low = float(binomtest(published, published).proportion_ci(CONFIDENCE, "exact").low)
    check = check_fraction(
        "fraction of the trials after the first within the ellipsoid", distance < CHI2_LIMIT,
        (low, 1.0), f"95 % interval of the document's {published} of {published}", published=1.0,
    )  # fmt: skip
    rippled, shift = (np.mean(collect_values(samples, name)) for name in ("rippled", "common shift"))
    return Evaluation(
        (check,),
        f"if the covariance is that of the differences between trials, 5 % are outside a 95 %"
        f" ellipsoid; all {published} are then within it with a probability of"
        f" {100 * 0.95**published:.1f} %. A covariance of residuals also includes errors that"
        f" repeat in every trial: with a repeatable force of {RIPPLE_FORCE:g} N in every drive,"
        f" {100 * rippled:.1f} % are within it",
        f"the mean of a series is {shift:.2f} standard deviations from the model's values, where"
        f" {np.sqrt(len(PUBLISHED_PARAMETERS) / published):.2f} are expected of {published} independent trials",
    )  # fmt: skip


def check_bias(quantity: str, mean: np.ndarray, covariance: np.ndarray, count: int) -> Check:
    """Return a check whether an estimator's bias is at least one standard deviation of one estimate.

    For a bias of length d, n times the squared mean error has a noncentral chi-squared distribution
    with p degrees of freedom and noncentrality n d^2. Its quantiles give the interval of d.

    Args:
        quantity: name of the bias.
        mean: (p,) mean error of the estimates.
        covariance: (p, p) covariance of one estimate.
        count: number of estimates n.

    Returns:
        The check of d [standard deviations].
    """
    degrees = len(mean)
    squared = count * float(mean @ np.linalg.solve(covariance, mean))

    def find_bias_bound(chance: float) -> float:
        if ncx2.cdf(squared, degrees, 0.0) < chance:
            return 0.0
        high = 4.0 * squared + 100.0
        root = brentq(lambda size: ncx2.cdf(squared, degrees, size) - chance, 0.0, high)
        return float(np.sqrt(float(root) / count))  # pyright: ignore[reportArgumentType]

    return Check(
        quantity, float(np.sqrt(max(squared - degrees, 0.0) / count)),
        find_bias_bound(0.5 + CONFIDENCE / 2.0), find_bias_bound(0.5 - CONFIDENCE / 2.0), (1.0, np.inf),
        "detectable in one experiment: at least one standard deviation of its estimate",
    )  # fmt: skip


def evaluate_least_squares_bias(samples: Sequence[Sample]) -> Evaluation:
    """Check whether unweighted least squares is biased if the force noise of the drives is cross-correlated.

    The bias is the mean parameter error of all trials after the first. Its Mahalanobis length must be at
    least one standard deviation of one estimate.
    """
    truth = load_robot().truth
    value = np.concatenate([sample.arrays["least_squares"][1:] for sample in samples])
    equations = NormalEquations(simulate_excitation().matrix)
    normal = np.linalg.inv(equations.information(np.eye(6)))
    noise = compute_force_covariance() / PERIODS_PER_TRIAL
    covariance = normal @ equations.information(noise) @ normal
    best = np.linalg.inv(equations.information(np.linalg.inv(noise)))
    wide = np.exp(0.5 * np.mean(np.log(np.diag(covariance) / np.diag(best))))
    check = check_bias("bias of least squares in standard deviations of one estimate",
                       value.mean(axis=0) - truth, covariance, len(value))  # fmt: skip
    return Evaluation(
        (check,),
        "if the regressor has no noise, least squares is unbiased for any covariance of the"
        f" forces; it is only less precise: its standard deviations are {wide:.2f} times those"
        " of the Gauss-Markov estimate",
    )


METHODS = {
    "samples, least squares": "least squares on samples",
    "samples, Gauss-Markov": "Gauss-Markov on samples",
    "periods, Gauss-Markov": "Gauss-Markov on mean periods in the frequency domain",
}


def measure_bias_by_encoder_feedback(seed: int, changes: Changes) -> Sample:
    """Compute the parameter errors of three estimators when controllers feed encoder noise into the forces.

    Args:
        seed: seed of the measurement noise.
        changes: `length_noise`: factor of the standard deviation of a measured leg length.

    Returns:
        Errors (24,) of the estimates by each method, in published standard deviations. The methods
        are least squares and Gauss-Markov (weighted by the inverse noise covariance) on unfiltered
        samples, and Gauss-Markov on periods that are averaged and filtered in the frequency domain.
    """
    settings = merge_settings({"length_noise": 1.0}, changes)
    own, cycle, periods = load_robot(), simulate_excitation(), 2
    record = simulate_measurement(
        cycle, periods, np.random.default_rng([21, seed]), compute_control_gains(),
        settings["length_noise"] * LENGTH_NOISE,
    )  # fmt: skip
    sampled = NormalEquations(own.matrix(compute_motion_from_lengths(record, cycle.period, "raw")))
    mean = average_periods(record, cycle.period)
    weight = np.linalg.inv(mean.covariance)[None]
    found = sampled.correlate(record.force)[None]
    value = {
        "samples, least squares": sampled.solve(np.eye(6)[None], found)[0][0],
        "samples, Gauss-Markov": sampled.solve(weight, found)[0][0],
        "periods, Gauss-Markov": estimate_linear_parameters(
            own.matrix(mean.motion), mean.force, mean.covariance, order=0).value,
    }  # fmt: skip
    return Sample({}, arrays={name: (one - own.truth) / _PRINTED_DEVIATIONS for name, one in value.items()})


def evaluate_bias_by_encoder_feedback(samples: Sequence[Sample]) -> Evaluation:
    """Check that encoder noise in regressor and forces biases estimates from unfiltered samples.

    The bias is the RMS over 24 parameters of the mean error, in published standard deviations. From
    unfiltered samples it must be at least 10. From averaged periods, which are filtered in the
    frequency domain, it must be at most 1.
    """
    checks = []
    for name, words in METHODS.items():
        biased = name.startswith("samples")
        checks.append(check_bootstrapped_statistic(
            f"bias of {words}, RMS of 24 parameters",
            np.array([sample.arrays[name] for sample in samples]),
            lambda errors: float(np.sqrt(np.mean(errors.mean(axis=0) ** 2))),
            (10.0, np.inf) if biased else (0.0, 1.0),
            "bias exceeds random error" if biased else "a standard deviation of one experiment",
            unit="printed standard deviations",
        ))  # fmt: skip
    return Evaluation(tuple(checks))


_COVARIANCE_FAULT = {"claimed_noise": 0.5}
_COVARIANCE_FAULT_TEXT = "the covariance assumes half of the actual noise"

TRIAL_SERIES = Experiment(
    "trials",
    compute_trial_statistics,
    (
        Claim(
            "estimates within the printed intervals",
            "24 parameters with 95 % confidence intervals",
            "Table 2", "document", evaluate_printed_intervals,
            {"processing": "raw"}, "poses are differentiated without a filter", (),
        ),
        Claim(
            "standard deviations", "24 standard deviations (of the printed intervals)", "Table 2",
            "input", evaluate_standard_deviations, None, "", (),
        ),
        Claim(
            "history of the estimates",
            '"the estimates remain mostly within the confidence intervals. Some exceptions are'
            ' observed though, such the very small first rigid-body parameter and the first few'
            ' measurement trials." "due to the variation of friction at the beginning of the'
            ' measurement process until a nearly stationary state is reached."',
            "Fig. 8, section 5.3", "document", evaluate_estimates_over_trials, _COVARIANCE_FAULT,
            _COVARIANCE_FAULT_TEXT,
            tuple(f"{SYMBOLS[k]} over its mean [1]" for k in (0, 1, 4, 9, 12, 18)),
        ),
        Claim(
            "exception of the first parameter",
            '"Some exceptions are observed though, such the very small first rigid-body parameter"',
            "Fig. 8, section 5.3", "document", evaluate_first_parameter,
            {"claimed_noise": 2.0}, "the covariance assumes twice the actual noise",
            (f"{SYMBOLS[0]} over its mean [1]",),
        ),
        Claim(
            "first trial outside the ellipsoid",
            '"Excepting the first trial, the set of all parameters lays clearly within the'
            ' confidence ellipsoid"; radius 36.42',
            "Fig. 9, section 5.3", "document", evaluate_first_trial,
            {"friction_excess": 0.0}, "friction is stationary from the start", (_DISTANCE_LABEL,),
        ),
        Claim(
            "all other trials within the ellipsoid",
            '"Excepting the first trial, the set of all parameters lays clearly within the'
            ' confidence ellipsoid"; radius 36.42, 100 trials',
            "Fig. 9, section 5.3", "document", evaluate_ellipsoid, _COVARIANCE_FAULT, _COVARIANCE_FAULT_TEXT,
            (_DISTANCE_LABEL,),
        ),
        Claim(
            "bias of least squares",
            '"Neglecting this fact by applying the simple LS-method will lead to biased estimates"',
            "section 3, after (21)", "document", evaluate_least_squares_bias,
            {"friction_excess": 0.0}, "friction is stationary from the start", (),
        ),
    ),
)  # fmt: skip

ENCODER_FEEDBACK = Experiment(
    "controllers that react to encoder noise",
    measure_bias_by_encoder_feedback,
    (
        Claim(
            "bias by controllers",
            "controllers feed encoder noise back into the forces; least squares and"
            " Gauss-Markov on samples are then biased, the frequency-domain processing is not",
            "section 3, after (21)", "additional", evaluate_bias_by_encoder_feedback,
            {"length_noise": 0.001}, "the encoders have no noise", (),
        ),
    ),
    max_repetitions=20,
)  # fmt: skip

"""Smoothing and differentiation of noisy samples by an optimal fixed-interval smoother.

`smooth_and_differentiate` models the signal as a chain of m integrators driven by white noise, after Trujillo and
Busby. Its only free parameter, the variance of the input, follows from the data by maximum
likelihood or generalised cross-validation.

The signal is the first state of `c_(j+1) = T c_j + b g_j`, with an input g that is constant between
samples. The smoothed states minimise

    sum_j w_j (d_j - c_j[0])^2 + (1 / r) sum_j g_j^2.                                         (1)

They are also the conditional mean for noise of variance 1/w and white Gaussian input of variance r
in the same unit (fixed-interval smoother of Rauch, Tung and Striebel). All quantities are
dimensionless: time is in samples, and the k-th state is `dt^k` times the k-th derivative. Forward
and backward recursions of information matrices need no initial guess.

Source: Trujillo and Busby 1983, J. Math. Anal. Appl. 94, "Investigation of a technique for the
differentiation of empirical data" (dynamic programming); likelihood: the integral, over all
inputs and (with a flat prior) the initial state, of exp(-J/2) with the sum J of equation (1).
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.identify.smoothed_signal import SmoothedSignal, as_columns, check_period, expand_per_column

_STATIONARITY_TOLERANCE = 1.0e-12  # relative change of the information matrix per sample


@compiled
def transition_matrices(order):
    """Return the matrices of one step of a chain of m integrators with constant input.

    The states c become T c + b g with input g; time is in samples.

    Args:
        order: number m of integrators [1].

    Returns:
        (T (m, m), its inverse (m, m), b (m,)) [1].

    Source: Trujillo and Busby 1983, with the time in samples.

    >>> transition_matrices(3)[0].tolist()
    [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    """
    forward, back, drive = np.zeros((order, order)), np.zeros((order, order)), np.zeros(order)
    for i in range(order):
        term = 1.0
        for j in range(i, order):
            forward[i, j] = term
            back[i, j] = term if (j - i) % 2 == 0 else -term
            term /= j - i + 1
        drive[i] = term
    return forward, back, drive


@compiled
def _marginalise_input(info, drive, ratio, order, column):
    """Reduce a state's information matrix R (`info`), in place, by the uncertainty of the input of one step.

    R becomes R - R b (1/r + b'R b)^-1 b'R, where b (`drive`) is the effect of the input on the state and r
    (`ratio`) its variance. The gain (1/r + b'R b)^-1 R b is written to `column`; 1/r + b'R b is returned.
    """
    total = 1.0 / ratio
    for i in range(order):
        column[i] = 0.0
        for j in range(order):
            column[i] += info[i, j] * drive[j]
        total += column[i] * drive[i]
    for i in range(order):
        for j in range(order):
            info[i, j] -= column[i] * column[j] / total
    for i in range(order):
        column[i] /= total
    return total


@compiled
def _congruence_transform(info, matrix, order, work, out):
    """Write M' R M into `out`, with `info` R and `matrix` M; `work` is overwritten."""
    for i in range(order):
        for j in range(order):
            work[i, j] = 0.0
            for k in range(order):
                work[i, j] += info[i, k] * matrix[k, j]
    for i in range(order):
        for j in range(i, order):
            value = 0.0
            for k in range(order):
                value += matrix[k, i] * work[k, j]
            out[i, j] = value
            out[j, i] = value


@compiled
def _has_converged(old, new, order):
    for i in range(order):
        if abs(new[i, i] - old[i, i]) > _STATIONARITY_TOLERANCE * abs(new[i, i]):
            return False
    return True


@compiled
def compute_backward_information(known, ratio, order, infos, gains, totals):
    """Compute, backwards in time, the information about each state from its own and all later samples.

    It depends on which samples are known, but not on their values.

    Args:
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        ratio: r, variance of the input over that of the noise, scalar [1], > 0.
        order: number m of integrators [1].
        infos: (n, m, m) written: R_j, information of samples j .. n-1 about state j.
        gains: (n, m) written: R_(j+1) b / totals_j, where b is the effect of the input on the state. The
            optimal input of step j has the term `-gains_j . T c_j` with transition matrix T and state c_j.
        totals: (n,) written: 1/r + b' R_(j+1) b.

    Returns:
        Nothing; the arrays are filled.

    Source: Trujillo and Busby 1983.
    """
    forward, _, drive = transition_matrices(order)
    info, work, out = np.zeros((order, order)), np.zeros((order, order)), np.zeros((order, order))
    column = np.zeros(order)
    count = len(known)
    info[0, 0] = known[count - 1]
    infos[count - 1] = info
    settled, total = False, 0.0
    for j in range(count - 2, -1, -1):
        if settled and known[j] == known[j + 1]:
            infos[j], gains[j], totals[j] = infos[j + 1], gains[j + 1], totals[j + 1]
            continue
        total = _marginalise_input(info, drive, ratio, order, column)
        gains[j], totals[j] = column, total
        _congruence_transform(info, forward, order, work, out)
        out[0, 0] += known[j]
        settled = _has_converged(infos[j + 1], out, order)
        info[:] = out
        infos[j] = out


@compiled
def smooth_states(samples, known, variance_ratio, order, infos, gains, totals, states):
    """Compute the smoothed states of a column, and the terms of its log likelihood.

    The states minimise sum (d - c[0])^2 + (1/r) sum g^2 over samples d, states c and inputs g.

    Args:
        samples: (n,) samples over the noise standard deviation [1]; any value where missing.
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        variance_ratio: r, scalar [1].
        order: number m of integrators [1].
        infos: (n, m, m) work space.
        gains: (n, m) work space.
        totals: (n,) work space.
        states: (n, m) written: the smoothed states [1].

    Returns:
        (squared residuals, squared inputs over r, log determinant) [1]; minus twice the log
        likelihood is their sum, apart from a constant.

    Source: Trujillo and Busby 1983.
    """
    compute_backward_information(known, variance_ratio, order, infos, gains, totals)
    forward, _, drive = transition_matrices(order)
    count = len(samples)
    pulls = np.zeros((count, order))  # information vectors of samples j .. n-1
    pulls[count - 1, 0] = known[count - 1] * samples[count - 1]
    rest = np.zeros(order)
    for j in range(count - 2, -1, -1):
        push = 0.0
        for i in range(order):
            push += drive[i] * pulls[j + 1, i]
        for i in range(order):
            rest[i] = pulls[j + 1, i] - gains[j, i] * push
        for i in range(order):
            for k in range(i + 1):
                pulls[j, i] += forward[k, i] * rest[k]
        pulls[j, 0] += known[j] * samples[j]
    states[0] = np.linalg.solve(infos[0], pulls[0])
    inputs, logs = 0.0, 0.0
    for j in range(count - 1):
        value = 0.0
        for i in range(order):
            rest[i] = 0.0
            for k in range(i, order):
                rest[i] += forward[i, k] * states[j, k]
            value -= gains[j, i] * rest[i]
        for i in range(order):
            value += drive[i] * pulls[j + 1, i] / totals[j]
        for i in range(order):
            states[j + 1, i] = rest[i] + drive[i] * value
        inputs += value * value / variance_ratio
        logs += math.log(totals[j] * variance_ratio)
    residuals = 0.0
    for j in range(count):
        if known[j] > 0.0:
            residuals += (samples[j] - states[j, 0]) ** 2
    _, log_start = np.linalg.slogdet(infos[0])
    return residuals, inputs, logs + log_start


@compiled
def state_variances(known, ratio, order, infos, variances):
    """Compute the variances of the smoothed states, relative to that of the noise.

    A forward recursion adds the information of the samples before j to that of j .. n-1.

    Args:
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        ratio: r, scalar [1].
        order: number m of integrators [1].
        infos: (n, m, m) information of samples j .. n-1 about state j, from `compute_backward_information`.
        variances: (n, m) written [1].

    Returns:
        Nothing; `variances` is filled.

    Source: two-filter form of the fixed-interval smoother.
    """
    _, back, drive = transition_matrices(order)
    against = back @ drive
    info, work, out = np.zeros((order, order)), np.zeros((order, order)), np.zeros((order, order))
    column, old, settled = np.zeros(order), np.zeros((order, order)), False
    for j in range(len(known)):
        if not (settled and j > 0 and _has_converged(infos[j - 1], infos[j], order)):
            inverse = np.linalg.inv(info + infos[j])
            for i in range(order):
                variances[j, i] = inverse[i, i]
        else:
            variances[j] = variances[j - 1]
        if settled and j > 0 and known[j] == known[j - 1]:
            continue
        old[:] = info
        info[0, 0] += known[j]
        _marginalise_input(info, against, ratio, order, column)
        _congruence_transform(info, back, order, work, out)
        settled = _has_converged(old, out, order)
        info[:] = out


DEFAULT_ORDER = 3  # value, rate and acceleration; the jerk is the white input
_MIN_LOG_RATIO, _MAX_LOG_RATIO = (
    -16,
    6,
)  # search range of log10 of input variance over noise variance
_GOLDEN_SECTIONS = 11  # golden sections: the ratio is accurate to 2 %, which is not visible in results
_GOLDEN_FRACTION = 1.0 - 0.5 * (math.sqrt(5.0) - 1.0)
_SMOOTHER_CONTEXT = "optimal smoother"


@dataclass(frozen=True)
class OptimallySmoothed(SmoothedSignal):
    """Signals smoothed by `smooth_and_differentiate`, with the parameters of the smoother.

    Attributes:
        noise: (k,) standard deviation of one sample, given or estimated [u].
        input_std: (k,) root mean square of the signal's derivative of order `order`, given or estimated
            [u/s^order].
        order: number of integrators [1].
        period: time between samples [s].
        known: (n, k) whether a sample exists.
    """

    noise: np.ndarray
    input_std: np.ndarray
    order: int
    period: float
    known: np.ndarray


def smooth_and_differentiate(
    values: np.ndarray,
    period: float,
    noise: float | np.ndarray | None = None,
    input_std: float | np.ndarray | None = None,
    *,
    order: int = DEFAULT_ORDER,
    method: Literal["likelihood", "validation"] = "likelihood",
) -> OptimallySmoothed:
    """Estimate value, rate and acceleration at every sample by fixed-interval smoothing.

    Minimises `sum (d - x)^2 / noise^2 + sum g^2 / input_std^2` over the states of an integrator
    chain with input g. The standard deviations hold for a signal whose input has the root mean
    square `input_std`.

    Args:
        values: (n,) or (n, k) samples on a uniform clock, NaN where missing [u].
        period: time between samples [s].
        noise: standard deviation of one sample, scalar or (k,) [u]; None to estimate it, for which
            the signal must be well oversampled.
        input_std: root mean square of the input, the derivative of order `order`, scalar or (k,)
            [u/s^order]; None to estimate it.
        order: number of integrators [1], 3 or 4.
        method: estimation of values not given: maximum "likelihood", or "validation" (generalised
            cross-validation), which uses the noise only for the standard deviations.

    Returns:
        The smoothed signals in the shape of `values`.

    Raises:
        InputError: order or method is unknown, a value is not positive, `input_std` is given
            without `noise`, or a column has fewer than order + 2 samples.

    Source: Trujillo and Busby 1983 as used in Khoshzaban 1992, section 4.4; likelihood: see the
    module docstring; generalised cross-validation: Craven and Wahba 1979.

    >>> import numpy as np
    >>> time = 0.02 * np.arange(200)
    >>> noisy = np.sin(time) + np.random.default_rng(1).normal(0.0, 1e-3, 200)
    >>> found = smooth_and_differentiate(noisy, 0.02, noise=1e-3)
    >>> bool(np.abs(found.rate - np.cos(time)).max() < 0.01)
    True
    """
    if order not in (3, 4):
        raise InputError(_SMOOTHER_CONTEXT, f"order must be 3 or 4, got {order}")
    if method not in ("likelihood", "validation"):
        raise InputError(_SMOOTHER_CONTEXT, f"method must be likelihood or validation, got {method!r}")
    if noise is None and input_std is not None:
        raise InputError(_SMOOTHER_CONTEXT, "input_std is given without noise: give both or neither")
    samples, dt = (
        as_columns(values, order + 2, _SMOOTHER_CONTEXT),
        check_period(period, _SMOOTHER_CONTEXT),
    )
    count = samples.shape[1]
    noises = None if noise is None else expand_per_column(noise, count, "noise", _SMOOTHER_CONTEXT)
    inputs = None if input_std is None else expand_per_column(input_std, count, "input_std", _SMOOTHER_CONTEXT)
    known = np.isfinite(samples)
    states, deviations = np.empty((*samples.shape, 3)), np.empty((*samples.shape, 3))
    scales, roughness = np.empty(count), np.empty(count)
    for k in range(count):
        column, base, unit = _normalise_samples(samples[:, k], known[:, k], noises, k)
        ratio = math.nan if inputs is None else (inputs[k] * dt**order / unit) ** 2
        found = _smooth_column(
            column, known[:, k].astype(np.float64), ratio, order,
            method == "likelihood", noises is not None,
        )  # fmt: skip
        scales[k] = unit * found[3]
        roughness[k] = math.sqrt(found[2]) * scales[k] / dt**order
        steps = dt ** np.arange(3)
        states[:, k] = unit * found[0][:, :3] / steps
        deviations[:, k] = scales[k] * np.sqrt(found[1][:, :3]) / steps
        states[:, k, 0] += base
    shape = np.shape(values)
    return OptimallySmoothed(
        *(part[..., i].reshape(shape) for part in (states, deviations) for i in range(3)),
        noise=scales, input_std=roughness, order=order, period=dt, known=known,
    )  # fmt: skip


def sample_smoothing_errors(smoothed: OptimallySmoothed, count: int, seed: int = 0) -> np.ndarray:
    """Draw random errors (smoothed minus true) that smoothed signals may have.

    A signal of the integrator chain with input `input_std` is simulated, noise is added, and the
    signal is smoothed with the same parameters and the same missing samples. The error does not
    depend on the measured signal.

    Args:
        smoothed: result of `smooth_and_differentiate`.
        count: number of samples [1].
        seed: seed of the random generator [1].

    Returns:
        (count, 3, n, k) errors of value [u], rate [u/s] and acceleration [u/s^2], smoothed minus
        true.

    Source: Durbin and Koopman 2002, Biometrika 89(3), "A simple and efficient simulation smoother".
    """
    generator, order = np.random.default_rng(seed), smoothed.order
    rows, columns = smoothed.known.shape
    errors = np.empty((count, 3, rows, columns))
    steps = smoothed.period ** np.arange(3)
    for k in range(columns):
        known = smoothed.known[:, k].astype(np.float64)
        ratio = (smoothed.input_std[k] * smoothed.period**order / smoothed.noise[k]) ** 2
        inputs = math.sqrt(ratio) * generator.standard_normal((count, rows))
        truth = _simulate_chain(inputs, order)
        noisy = truth[:, :, 0] + generator.standard_normal((count, rows))
        for i in range(count):
            states = _compute_states(noisy[i], known, ratio, order) - truth[i]
            errors[i, :, :, k] = (smoothed.noise[k] * states[:, :3] / steps).T
    return errors


def _normalise_samples(
    samples: np.ndarray, known: np.ndarray, noises: np.ndarray | None, k: int
) -> tuple[np.ndarray, float, float]:
    """Make samples dimensionless: subtract their mean and divide by their noise.

    If the noise is unknown, the divisor is the standard deviation of the steps between known samples.

    Returns:
        The scaled samples, the mean, and the divisor.
    """
    base = float(samples[known].mean())
    if noises is not None:
        unit = float(noises[k])
    else:
        unit = float(np.diff(samples[known]).std())
        if unit == 0.0:
            raise InputError(
                _SMOOTHER_CONTEXT,
                f"column {k} is constant, so its noise cannot be estimated: give noise",
            )
    return np.where(known, (samples - base) / unit, 0.0), base, unit


@compiled
def _compute_states(samples, known, ratio, order):
    rows = len(samples)
    infos, gains = np.zeros((rows, order, order)), np.zeros((rows, order))
    states = np.zeros((rows, order))
    smooth_states(samples, known, ratio, order, infos, gains, np.zeros(rows), states)
    return states


@compiled
def _simulate_chain(inputs, order):
    """Simulate the integrator chain from zero: (draws, n) inputs -> (draws, n, m) states."""
    forward, _, drive = transition_matrices(order)
    draws, rows = inputs.shape
    states = np.zeros((draws, rows, order))
    for d in range(draws):
        for j in range(1, rows):
            for i in range(order):
                states[d, j, i] = drive[i] * inputs[d, j]
                for k in range(i, order):
                    states[d, j, i] += forward[i, k] * states[d, j - 1, k]
    return states


@compiled
def _evaluate_objective(samples, known, exponent, order, use_likelihood, noise_known, work):
    """Return the objective to be minimised for the variance ratio 10^exponent (input over noise).

    It is minus twice the log likelihood, apart from a constant, or else the logarithm of the generalised
    cross-validation score. `work` holds work arrays.
    """
    infos, gains, totals, states, variances = work
    ratio = 10.0**exponent
    residuals, inputs, logs = smooth_states(samples, known, ratio, order, infos, gains, totals, states)
    if use_likelihood and noise_known:
        return residuals + inputs + logs
    count = known.sum()
    if use_likelihood:
        return (count - order) * math.log((residuals + inputs) / (count - order)) + logs
    state_variances(known, ratio, order, infos, variances)
    free = 1.0 - (variances[:, 0] * known).sum() / count
    return math.log(residuals / count) - 2.0 * math.log(free)


@compiled
def _find_best_exponent(samples, known, order, use_likelihood, noise_known, work):
    """Find the log10 of the variance ratio with the smallest objective.

    The search uses a grid of two decades, refined by golden sections.
    """
    best, middle = math.inf, 0.0
    for decade in range(_MIN_LOG_RATIO, _MAX_LOG_RATIO + 1, 2):
        cost = _evaluate_objective(samples, known, float(decade), order, use_likelihood, noise_known, work)
        if cost < best:
            best, middle = cost, float(decade)
    low, high = middle - 2.0, middle + 2.0
    for _ in range(_GOLDEN_SECTIONS):
        # the golden section of the longer part, as `best` is known at `middle`
        right = high - middle > middle - low
        place = middle + _GOLDEN_FRACTION * ((high if right else low) - middle)
        cost = _evaluate_objective(samples, known, place, order, use_likelihood, noise_known, work)
        if cost < best:
            low, high = (middle, high) if right else (low, middle)
            best, middle = cost, place
        elif right:
            high = place
        else:
            low = place
    return middle


@compiled
def _smooth_column(samples, known, ratio, order, use_likelihood, noise_known):
    """Smooth one dimensionless column; a variance ratio (input over noise) of NaN is estimated.

    Returns:
        (states (n, m), variances (n, m), ratio, noise standard deviation over the given unit).
    """
    rows = len(samples)
    infos, gains, totals = np.zeros((rows, order, order)), np.zeros((rows, order)), np.zeros(rows)
    states, variances = np.zeros((rows, order)), np.zeros((rows, order))
    work = (infos, gains, totals, states, variances)
    if math.isnan(ratio):
        ratio = 10.0 ** _find_best_exponent(samples, known, order, use_likelihood, noise_known, work)
    residuals, inputs, _ = smooth_states(samples, known, ratio, order, infos, gains, totals, states)
    state_variances(known, ratio, order, infos, variances)
    scale = 1.0
    if not noise_known:
        scale = math.sqrt((residuals + inputs) / (known.sum() - order))
    return states, variances, ratio, scale

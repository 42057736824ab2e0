"""Optimal smoothing and differentiation of noisy samples, after Trujillo and Busby.

The signal is taken as an integrator chain with an unknown input (`integrator_chain`): the value,
its rate, its acceleration and so on, the highest of them driven by white noise. The one free
number, how rough the input is, follows from the data by maximum likelihood or generalised
cross-validation.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.identify.integrator_chain import (
    smooth_states,
    state_variances,
    transition,
)
from hydrotele.identify.smoothed import Smoothed, checked_period, columns_of, per_column

ORDER = 3  # value, rate and acceleration; the jerk is the unknown input
_LOWEST, _HIGHEST = -16, 6  # log10 of input variance over noise variance, per sample
_SECTIONS = 11  # leave 2 % of the ratio open, which the curves do not show
_GOLDEN = 1.0 - 0.5 * (math.sqrt(5.0) - 1.0)
_WHERE = "optimal smoother"


@dataclass(frozen=True)
class OptimallySmoothed(Smoothed):
    """Signals smoothed by `smooth`, with what the smoother found and used.

    Attributes:
        noise: (k,) standard deviation of one sample, given or found [u].
        input_std: (k,) root mean square of the input, given or found [u/s^order].
        order: number of integrators [1].
        period: time between samples [s].
        known: (n, k) whether a sample was there.
    """

    noise: np.ndarray
    input_std: np.ndarray
    order: int
    period: float
    known: np.ndarray


def smooth(
    values: np.ndarray,
    period: float,
    noise: float | np.ndarray | None = None,
    input_std: float | np.ndarray | None = None,
    *,
    order: int = ORDER,
    method: Literal["likelihood", "validation"] = "likelihood",
) -> OptimallySmoothed:
    """Fixed-interval smoothing: the best value, rate and acceleration at every sample.

    Minimises `sum (d - x)^2 / noise^2 + sum g^2 / input_std^2` over the states of an integrator
    chain with the input g. The standard deviations hold for a signal as rough as `input_std` says.

    Args:
        values: (n,) or (n, k) samples on a uniform clock, NaN where missing [u].
        period: time between samples [s].
        noise: standard deviation of one sample, scalar or (k,) [u]; None to find it, for which the
            signal must be well oversampled.
        input_std: root mean square of the input, the derivative of number `order`, scalar or (k,)
            [u/s^order]; None to find it.
        order: number of integrators [1], 3 or 4.
        method: how to find what is not given: maximum "likelihood", or "validation", generalised
            cross-validation, which uses the noise for the standard deviations only.

    Returns:
        The smoothed signals, in the shape of `values`.

    Raises:
        InputError: order or method is not known, a number is not positive, `input_std` comes
            without `noise`, or a column has fewer than order + 2 samples.

    Source: Trujillo and Busby 1983 as used in Khoshzaban 1992, section 4.4; likelihood: see
    `integrator_chain`; generalised cross-validation: Craven and Wahba 1979.

    >>> import numpy as np
    >>> time = 0.02 * np.arange(200)
    >>> noisy = np.sin(time) + np.random.default_rng(1).normal(0.0, 1e-3, 200)
    >>> found = smooth(noisy, 0.02, noise=1e-3)
    >>> bool(np.abs(found.rate - np.cos(time)).max() < 0.01)
    True
    """
    if order not in (3, 4):
        raise InputError(_WHERE, f"order must be 3 or 4, got {order}")
    if method not in ("likelihood", "validation"):
        raise InputError(_WHERE, f"method must be likelihood or validation, got {method!r}")
    if noise is None and input_std is not None:
        raise InputError(_WHERE, "input_std is given without noise: give both or neither")
    samples, dt = columns_of(values, order + 2, _WHERE), checked_period(period, _WHERE)
    count = samples.shape[1]
    noises = None if noise is None else per_column(noise, count, "noise", _WHERE)
    inputs = None if input_std is None else per_column(input_std, count, "input_std", _WHERE)
    known = np.isfinite(samples)
    states, deviations = np.empty((*samples.shape, 3)), np.empty((*samples.shape, 3))
    scales, roughness = np.empty(count), np.empty(count)
    for k in range(count):
        column, base, unit = _scaled(samples[:, k], known[:, k], noises, k)
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


def error_draws(smoothed: OptimallySmoothed, count: int, seed: int = 0) -> np.ndarray:
    """Random errors of smoothed signals: what noise adds and what smoothing takes away.

    A signal of the chain itself, as rough as `input_std`, is drawn, noise is added, and it is
    smoothed with the same numbers and the same missing samples; the error does not depend on the
    signal that was measured.

    Args:
        smoothed: result of `smooth`.
        count: number of draws [1].
        seed: of the random numbers [1].

    Returns:
        (count, 3, n, k) smoothed minus true value [u], rate [u/s] and acceleration [u/s^2].

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
        truth = _chain(inputs, order)
        noisy = truth[:, :, 0] + generator.standard_normal((count, rows))
        for i in range(count):
            states = _states(noisy[i], known, ratio, order) - truth[i]
            errors[i, :, :, k] = (smoothed.noise[k] * states[:, :3] / steps).T
    return errors


def _scaled(
    samples: np.ndarray, known: np.ndarray, noises: np.ndarray | None, k: int
) -> tuple[np.ndarray, float, float]:
    """Samples about their mean over the noise, or over their steps' size; the mean; the unit."""
    base = float(samples[known].mean())
    if noises is not None:
        unit = float(noises[k])
    else:
        unit = float(np.diff(samples[known]).std())
        if unit == 0.0:
            raise InputError(_WHERE, f"column {k} is constant, so its noise is unknown: give it")
    return np.where(known, (samples - base) / unit, 0.0), base, unit


@compiled
def _states(samples, known, ratio, order):
    rows = len(samples)
    infos, gains = np.zeros((rows, order, order)), np.zeros((rows, order))
    states = np.zeros((rows, order))
    smooth_states(samples, known, ratio, order, infos, gains, np.zeros(rows), states)
    return states


@compiled
def _chain(inputs, order):
    """Run the chain from zero: (draws, n) inputs -> (draws, n, m) states."""
    forward, _, drive = transition(order)
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
def _cost(samples, known, exponent, order, likely, noise_known, work):
    """What the best ratio, 10^exponent, makes smallest."""
    infos, gains, totals, states, variances = work
    ratio = 10.0**exponent
    residuals, inputs, logs = smooth_states(
        samples, known, ratio, order, infos, gains, totals, states
    )
    if likely and noise_known:
        return residuals + inputs + logs
    count = known.sum()
    if likely:
        return (count - order) * math.log((residuals + inputs) / (count - order)) + logs
    state_variances(known, ratio, order, infos, variances)
    free = 1.0 - (variances[:, 0] * known).sum() / count
    return math.log(residuals / count) - 2.0 * math.log(free)


@compiled
def _best_exponent(samples, known, order, likely, noise_known, work):
    """Best log10 of the ratio: the best of every second decade, then golden sections about it."""
    best, middle = math.inf, 0.0
    for decade in range(_LOWEST, _HIGHEST + 1, 2):
        cost = _cost(samples, known, float(decade), order, likely, noise_known, work)
        if cost < best:
            best, middle = cost, float(decade)
    low, high = middle - 2.0, middle + 2.0
    for _ in range(_SECTIONS):
        # the golden section of the longer part, as `best` is known at `middle`
        right = high - middle > middle - low
        place = middle + _GOLDEN * ((high if right else low) - middle)
        cost = _cost(samples, known, place, order, likely, noise_known, work)
        if cost < best:
            low, high = (middle, high) if right else (low, middle)
            best, middle = cost, place
        elif right:
            high = place
        else:
            low = place
    return middle


@compiled
def _smooth_column(samples, known, ratio, order, likely, noise_known):
    """Smooth one dimensionless column; a ratio of NaN is found.

    Returns:
        (states (n, m), variances (n, m), ratio, noise's standard deviation over the given unit).
    """
    rows = len(samples)
    infos, gains, totals = np.zeros((rows, order, order)), np.zeros((rows, order)), np.zeros(rows)
    states, variances = np.zeros((rows, order)), np.zeros((rows, order))
    work = (infos, gains, totals, states, variances)
    if math.isnan(ratio):
        ratio = 10.0 ** _best_exponent(samples, known, order, likely, noise_known, work)
    residuals, inputs, _ = smooth_states(samples, known, ratio, order, infos, gains, totals, states)
    state_variances(known, ratio, order, infos, variances)
    scale = 1.0
    if not noise_known:
        scale = math.sqrt((residuals + inputs) / (known.sum() - order))
    return states, variances, ratio, scale

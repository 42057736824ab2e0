"""Causal state-variable filter: low-pass of a signal with its first two derivatives.

All signals of a force balance pass the same filter and have equal delay, so that a zero sum of
signals and derivatives stays zero. Between two readings a signal is interpolated linearly, which is
exact for ramps and keeps the derivatives of held signals finite.
"""

import math

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled

VALUE, RATE, SECOND_DERIVATIVE, LAST_READING = range(4)  # columns of a filter's state
_MIN_RELATIVE_POWER = 1.0e-12
_REAL, _SQUARE, _CUBE = 2.0, 2.0, 1.0  # coefficients of the third-order Butterworth polynomial


def filter_step_matrix(bandwidth: float, period: float) -> np.ndarray:
    """Return the matrix that advances the low-pass filter and its two derivatives by one period.

    The filter is `y''' = w^3 (u - y) - 2 w^2 y' - 2 w y''` (Butterworth), with input u and output y.
    It is solved exactly for an input u that is linear between the last and the new reading.

    Args:
        bandwidth: w / (2 pi), scalar [Hz], > 0.
        period: time between two calls, scalar [s], > 0.

    Returns:
        (3, 5) matrix from old y, y', y'', last and new reading to new y, y', y''.

    Source: Butterworth's filter; Franklin, Powell and Workman 1998, Digital control, section 6.3
    (triangle hold).

    >>> filter_step_matrix(1.0, 0.01)[:, 3:].sum(axis=1).round(4) + 0.0  # a step of both readings
    array([0.    , 0.0119, 2.3279])
    """
    from scipy.linalg import expm  # this import takes a third of a second

    w = 2.0 * math.pi * bandwidth
    block = np.zeros((5, 5))
    block[0, 1] = block[1, 2] = block[3, 4] = 1.0
    block[2] = -_CUBE * w**3, -_SQUARE * w**2, -_REAL * w, _CUBE * w**3, 0.0
    scale = np.diag([1.0, w, w**2, 1.0, 1.0])  # keeps the matrix exponential accurate
    block[3, 4] = 1.0 / period
    step = scale @ expm(np.linalg.inv(scale) @ block @ scale * period) @ np.linalg.inv(scale)
    table = step[:3].copy()
    table[:, 3] -= step[:3, 4]
    return table


def filter_delay(bandwidth: float) -> float:
    """Return the delay 2 / w [s] of the filter for slow changes, from its bandwidth [Hz]."""
    return _SQUARE / (2.0 * math.pi * bandwidth)


def butterworth_response(bandwidth: float, s: np.ndarray) -> np.ndarray:
    """Return the transfer function of the third-order Butterworth filter at complex frequencies.

    Args:
        bandwidth: w / (2 pi), scalar [Hz], > 0.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) `w^3 / (s^3 + 2 w s^2 + 2 w^2 s + w^3)` [1].

    Source: Butterworth's filter of third order.

    >>> abs(butterworth_response(1.0, np.array([2j * np.pi]))).round(4)
    array([0.7071])
    """
    w = 2.0 * math.pi * bandwidth
    return _CUBE * w**3 / (s**3 + _REAL * w * s**2 + _SQUARE * w**2 * s + _CUBE * w**3)


def filter_noise_gains(table: np.ndarray) -> np.ndarray:
    """Return the standard deviations of filter output and derivatives, for white noise of standard deviation 1.

    Args:
        table: (3, 5) of `filter_step_matrix`.

    Returns:
        (3,) standard deviations of output [1], rate [1/s] and second derivative [1/s^2].

    Source: root of the summed squares of the response to a single reading.
    """
    state, last, total = np.zeros(3), 1.0, table[:, 4] ** 2
    state += table[:, 4]
    while np.any(state**2 > _MIN_RELATIVE_POWER * total):
        state = table @ (*state, last, 0.0)
        total, last = total + state**2, 0.0
    return np.sqrt(total)


@compile_without_allocation
def filter_step(table, state, reading):
    """Update the filter state of one signal with the next reading.

    Args:
        table: (3, 5) of `filter_step_matrix`.
        state: (4,) VALUE, RATE, SECOND_DERIVATIVE and LAST_READING of the signal; updated.
        reading: u, scalar.

    Returns:
        Nothing.

    Source: `filter_step_matrix`.
    """
    low, rate, change, last = (
        state[VALUE],
        state[RATE],
        state[SECOND_DERIVATIVE],
        state[LAST_READING],
    )
    for i in range(3):
        state[i] = (
            table[i, 0] * low + table[i, 1] * rate + table[i, 2] * change + table[i, 3] * last + table[i, 4] * reading
        )
    state[LAST_READING] = reading


@compiled
def filter_signal(table, readings):
    """Low-pass filter a whole signal and compute its derivatives, starting at rest at the first reading.

    Args:
        table: (3, 5) of `filter_step_matrix`.
        readings: (r,) signal.

    Returns:
        (r, 3) low-pass VALUE, its RATE and its SECOND_DERIVATIVE.

    Source: `filter_step_matrix`.
    """
    state, out = np.zeros(4), np.zeros((len(readings), 3))
    state[VALUE] = state[LAST_READING] = readings[0]
    for row in range(len(readings)):
        filter_step(table, state, readings[row])
        out[row] = state[:3]
    return out

"""Whiten forces that a residual force and white noise disturb.

The residual force is an Ornstein-Uhlenbeck process: one state of a Kalman filter per channel.
"""

import numpy as np

from hydrotele.core.compiled import compiled


@compiled
def _whiten(values, missing, first, fade, noise, sizes, whitened, spread):
    rows, channels, count = values.shape
    held = np.zeros(count)
    for k in range(channels):
        variance = sizes[k] ** 2
        for row in range(rows):
            if first[row]:
                variance = sizes[k] ** 2
                held[:] = 0.0
            if missing[row, k]:
                spread[row, k] = 1.0
                whitened[row, k, :] = 0.0
            else:
                total = variance + noise[k] ** 2
                width = np.sqrt(total)
                spread[row, k] = width
                for m in range(count):
                    error = values[row, k, m] - held[m]
                    whitened[row, k, m] = error / width
                    held[m] += variance / total * error
                variance -= variance**2 / total
            for m in range(count):
                held[m] *= fade
            variance = fade**2 * variance + (1.0 - fade**2) * sizes[k] ** 2


@compiled
def _innovate(values, missing, follow, out):
    rows, channels, count = values.shape
    order = len(follow)
    past = np.zeros((order, count))
    for k in range(channels):
        past[:] = 0.0
        for row in range(rows):
            here = row % order  # the row of `past` that is `order` rows old
            for m in range(count):
                expected = 0.0
                for lag in range(order):
                    expected += follow[lag, k] * past[(row - 1 - lag) % order, m]
                value = expected if missing[row, k] else values[row, k, m]
                out[row, k, m] = value - expected
                past[here, m] = value


def innovations(values: np.ndarray, missing: np.ndarray, follow: np.ndarray) -> np.ndarray:
    """Subtract what the previous rows of an autoregressive process predict; a missing row is as predicted.

    Args:
        values: (n, k, m) m series of k channels, filtered alike.
        missing: (n, k) rows that are left out.
        follow: (q, k) weights of the previous rows, the latest first.

    Returns:
        (n, k, m) innovations, 0 where missing. The values before the first row are taken for 0.

    >>> force, is_missing = np.array([4.0, 9.0, 2.0]), np.array([False, True, False])
    >>> innovations(force.reshape(3, 1, 1), is_missing.reshape(3, 1), np.array([[0.5]])).ravel()
    array([4., 0., 1.])
    """
    if not len(follow):
        return np.where(missing[:, :, None], 0.0, values)
    out = np.empty(values.shape)
    _innovate(np.ascontiguousarray(values), np.ascontiguousarray(missing), np.ascontiguousarray(follow), out)
    return out


def whiten_forces(
    values: np.ndarray, missing: np.ndarray, first: np.ndarray, fade: float, noise: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Divide the one-step prediction errors of forces by their predicted standard deviations.

    Args:
        values: (n, k, m) m series of forces of k channels, filtered alike.
        missing: (n, k) rows that are left out.
        first: (n,) first rows of the runs, at which the residual force is unknown anew.
        fade: factor by which the residual force falls over a row.
        noise: (k,) standard deviations of the white noise.
        sizes: (k,) stationary standard deviations of the residual force.

    Returns:
        (n, k, m) whitened errors, 0 where missing; (n, k) standard deviations, 1 where missing.

    >>> errors, spread = whiten_forces(np.ones((2, 1, 1)), np.zeros((2, 1), bool), np.array([True, False]), 1.0,
    ...                                np.array([1.0]), np.array([1.0]))
    >>> errors.ravel().round(4), (spread**2).ravel().round(4)
    (array([0.7071, 0.4082]), array([2. , 1.5]))
    """
    whitened, spread = np.empty(values.shape), np.empty(values.shape[:2])
    _whiten(
        np.ascontiguousarray(values), np.ascontiguousarray(missing), first, fade, noise, sizes, whitened, spread
    )  # fmt: skip
    return whitened, spread

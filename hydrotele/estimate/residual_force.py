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

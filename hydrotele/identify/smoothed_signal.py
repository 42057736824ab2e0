"""Smoothed signals with their first two time derivatives, and checks of samples and sample period."""

import math
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError


@dataclass(frozen=True)
class SmoothedSignal:
    """Signals with their first two time derivatives and standard deviations.

    All arrays have the shape of the input, (n,) or (n, k); [u] is the unit of the input. Unknown
    standard deviations are NaN.

    Attributes:
        value: filtered signal [u].
        rate: first derivative [u/s].
        acceleration: second derivative [u/s^2].
        value_std: standard deviation of the value [u].
        rate_std: standard deviation of the rate [u/s].
        acceleration_std: standard deviation of the acceleration [u/s^2].
    """

    value: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    value_std: np.ndarray
    rate_std: np.ndarray
    acceleration_std: np.ndarray


def as_columns(values: np.ndarray, min_samples: int, context: str) -> np.ndarray:
    """Convert samples to columns and check their number.

    Args:
        values: (n,) or (n, k) samples [any unit], NaN where missing.
        min_samples: smallest number of finite samples per column [1].
        context: name of the caller for the message.

    Returns:
        (n, k) float64, a copy.

    Raises:
        InputError: invalid shape, an infinite value, or too few finite samples in a column.
    """
    array = np.array(values, dtype=np.float64)
    if array.ndim not in (1, 2):
        raise InputError(context, f"samples must be (n,) or (n, k), got the shape {array.shape}")
    columns = array.reshape(len(array), -1)
    if np.isinf(columns).any():
        row, column = np.argwhere(np.isinf(columns))[0]
        raise InputError(context, f"column {column}, row {row} is infinite: mark missing samples with NaN")
    known = np.isfinite(columns).sum(axis=0)
    if len(known) and known.min() < min_samples:
        raise InputError(
            context,
            f"column {int(known.argmin())} has {known.min()} samples, at least {min_samples} are needed",
        )
    return columns


def expand_per_column(number: float | np.ndarray, count: int, label: str, context: str) -> np.ndarray:
    """Expand a positive value to one value per column.

    Args:
        number: scalar or (k,) [any unit].
        count: number of columns k [1].
        label: name of the value for the message.
        context: name of the caller for the message.

    Returns:
        (k,) float64.

    Raises:
        InputError: a value is not positive and finite, or there are not k values.
    """
    numbers = np.asarray(number, dtype=np.float64)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != count):
        raise InputError(context, f"{label} must be one number or {count}, got {numbers.shape}")
    numbers = np.broadcast_to(numbers, (count,)).copy()
    if not (np.isfinite(numbers) & (numbers > 0)).all():
        raise InputError(context, f"{label} must be positive, got {numbers.tolist()}")
    return numbers


def check_period(period: float, context: str) -> float:
    """Check that a sample period is positive and return it.

    Args:
        period: time between samples [s].
        context: name of the caller for the message.

    Returns:
        The period as a float [s].

    Raises:
        InputError: the period is not positive and finite.
    """
    if not (math.isfinite(period) and period > 0):
        raise InputError(context, f"the sample period must be positive, got {period} s")
    return float(period)

"""What every smoother of this room yields, and the checks that they share."""

import math
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError


@dataclass(frozen=True)
class Smoothed:
    """Signals with their first two time derivatives and standard deviations.

    All arrays have the shape of the input, (n,) or (n, k); [u] is the input's unit. A standard
    deviation is NaN where it cannot be told.

    Attributes:
        value: [u].
        rate: [u/s].
        acceleration: [u/s^2].
        value_std: of the value's error [u].
        rate_std: of the rate's error [u/s].
        acceleration_std: of the acceleration's error [u/s^2].
    """

    value: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    value_std: np.ndarray
    rate_std: np.ndarray
    acceleration_std: np.ndarray


def columns_of(values: np.ndarray, least: int, where: str) -> np.ndarray:
    """Samples as columns, refused where they are too few.

    Args:
        values: (n,) or (n, k) [any unit], NaN where missing.
        least: finite samples that each column needs [1].
        where: name of the caller for the message.

    Returns:
        (n, k) float64, a copy.

    Raises:
        InputError: another shape, an infinite value, or too few finite samples in a column.
    """
    array = np.array(values, dtype=np.float64)
    if array.ndim not in (1, 2):
        raise InputError(where, f"samples must be (n,) or (n, k), got the shape {array.shape}")
    columns = array.reshape(len(array), -1)
    if np.isinf(columns).any():
        row, column = np.argwhere(np.isinf(columns))[0]
        raise InputError(
            where, f"column {column}, row {row} is infinite: mark missing samples with NaN"
        )
    known = np.isfinite(columns).sum(axis=0)
    if len(known) and known.min() < least:
        raise InputError(
            where,
            f"column {int(known.argmin())} has {known.min()} samples, at least {least} are needed",
        )
    return columns


def per_column(number: float | np.ndarray, count: int, what: str, where: str) -> np.ndarray:
    """One number per column, refused unless positive.

    Args:
        number: scalar or (k,) [any unit].
        count: number of columns k [1].
        what: name of the number for the message.
        where: name of the caller for the message.

    Returns:
        (k,) float64.

    Raises:
        InputError: a number is not positive and finite, or there are not k of them.
    """
    numbers = np.asarray(number, dtype=np.float64)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != count):
        raise InputError(where, f"{what} must be one number or {count}, got {numbers.shape}")
    numbers = np.broadcast_to(numbers, (count,)).copy()
    if not (np.isfinite(numbers) & (numbers > 0)).all():
        raise InputError(where, f"{what} must be positive, got {numbers.tolist()}")
    return numbers


def checked_period(period: float, where: str) -> float:
    """The time between samples [s], refused unless positive.

    Args:
        period: [s].
        where: name of the caller for the message.

    Returns:
        The period [s].

    Raises:
        InputError: the period is not positive and finite.
    """
    if not (math.isfinite(period) and period > 0):
        raise InputError(where, f"the sample period must be positive, got {period} s")
    return float(period)

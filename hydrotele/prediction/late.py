"""Readings that are on their way: a sensor that lags shows later what the state was before.

What it will show from one row to the next is kept as further states of the filter, so that a late
reading corrects the state through its own slope and not through that of the present state.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.compiled import lean
from hydrotele.dynamics.model import Model


class Late(NamedTuple):
    """Readings on their way, q of them: per channel with a lag, the next to be shown first.

    Attributes:
        channel: (q,) channel of each.
        due: (q,) time after a row's start at which the reading is taken that enters there [s];
            negative where the one behind moves up.
        first: (c,) place of each channel's next reading, -1 without a lag.
    """

    channel: np.ndarray
    due: np.ndarray
    first: np.ndarray


def late_readings(model: Model, period: float) -> Late:
    """Readings on their way in a model.

    Args:
        model: Model.
        period: of the rows [s].

    Returns:
        `floor(lag / period) + 1` readings per channel with a lag.
    """
    channel, due, first = [], [], np.full(len(model.lag), -1)
    for c in np.flatnonzero(model.lag > 0.0):
        first[c] = len(channel)
        count = int(model.lag[c] / period) + 1
        channel += [c] * count
        due += [-1.0] * (count - 1) + [max(0.0, count * period - model.lag[c])]
    return Late(np.array(channel, np.int64), np.array(due, float), first)


@lean
def begin_late(late, size, shown, z):
    """Fill the readings on their way as if the state had rested so far.

    Args:
        late: Late.
        size: number of states of the model.
        shown: (c,) what the sensors would show of the present state without lag.
        z: (size + q,) state, whose last q are written.

    Returns:
        Nothing.

    Source: pure transport delay.
    """
    for e in range(len(late.channel)):
        z[size + e] = shown[late.channel[e]]


@lean
def spread_late(late, size, slope, spread):
    """Covariance of the readings on their way after `begin_late`.

    Args:
        late: Late.
        size: number of states of the model.
        slope: (c, size + q) slopes of the readings, without lag, in the present state.
        spread: (size + q, size + q) covariance, whose last q rows and columns are written.

    Returns:
        Nothing.

    Source: propagation of covariance.
    """
    for e in range(len(late.channel)):
        s = size + e
        for k in range(s):
            total = 0.0
            for j in range(size):
                total += slope[late.channel[e], j] * spread[j, k]
            spread[k, s] = spread[s, k] = total
        total = 0.0
        for j in range(size):
            total += slope[late.channel[e], j] * spread[j, s]
        spread[s, s] = total


@lean
def move_late(model, late, size, trail, h, z):
    """Readings on their way a row later.

    Args:
        model: Model.
        late: Late.
        size: number of states of the model.
        trail: (steps + 1, c) what the channels with a lag show over the row, see `advance`.
        h: step, scalar [s].
        z: (size + q,) state, whose last q are moved in place.

    Returns:
        Nothing.

    Source: pure transport delay, linear between steps.
    """
    for e in range(len(late.channel)):
        if late.due[e] < 0.0:
            z[size + e] = z[size + e + 1]
            continue
        c = late.channel[e]
        low = min(int(late.due[e] / h), len(trail) - 2)
        value = trail[low, c] + (late.due[e] / h - low) * (trail[low + 1, c] - trail[low, c])
        z[size + e] = model.scale[c] * value + model.offset[c]

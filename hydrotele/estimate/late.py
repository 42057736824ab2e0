"""Readings of sensors that are late, as further states of the filter.

A sensor with a delay shows later what the state was before: what it will show from one row to the
next is on its way. One with a first-order lag shows what it showed before, drawn towards the
present state: that is a state of its own, and if both, what it shows is what is delayed. Kept as
states, a late reading corrects the model through its own slope and not through that of the present.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import lean
from hydrotele.dynamics.model import Model
from hydrotele.dynamics.transducers import follow_channel

_CHANGE = 0.1  # s in which a channel may change as much as its value is unknown at a run's start


class Late(NamedTuple):
    """Readings of late channels, q of them: per channel the next to be shown first.

    Attributes:
        channel: (q,) channel of each.
        due: (q,) time after a row's start at which the reading is taken that enters there [s];
            negative where the one behind moves up.
        first: (c,) place of each channel's next reading, -1 where it is not late.
        lags: (q,) whether it is what a first-order lag shows at present; last of its channel.
        stays: (q,) part of a change that is found in its place a row later [1].
        moves: (q,) part of a change that is found in the place before a row later [1].
        open: (q,) variance at a run's start beyond that of the present value, over that [1].
    """

    channel: np.ndarray
    due: np.ndarray
    first: np.ndarray
    lags: np.ndarray
    stays: np.ndarray
    moves: np.ndarray
    open: np.ndarray


def late_readings(model: Model, period: float) -> Late:
    """Readings of the late channels of a model.

    Args:
        model: Model.
        period: of the rows [s].

    Returns:
        `floor(delay / period) + 1` readings per channel with a delay, and one more per channel
        with a first-order lag.
    """
    rows, first = [], np.full(len(model.lag), -1)
    for c, (delay, constant) in enumerate(zip(model.lag, model.time_constant, strict=True)):
        if delay == 0.0 and constant == 0.0:
            continue
        first[c] = len(rows)
        due = 0.0
        if delay > 0.0:
            count = int(delay / period) + 1
            due = max(0.0, count * period - delay)
            enter = [-1.0] * (count - 1) + [due]
            rows += [(c, at, False, 0.0, float(k > 0), 0.0) for k, at in enumerate(enter)]
        if constant > 0.0:
            passed = float(np.exp(-due / constant)) if delay > 0.0 else 0.0
            loose = min(1.0, constant / _CHANGE) ** 2
            rows.append((c, period, True, float(np.exp(-period / constant)), passed, loose))
    channel, at, lags, stays, moves, loose = zip(*rows, strict=True) if rows else ((),) * 6
    return Late(
        np.array(channel, np.int64), np.array(at, float), first, np.array(lags, bool),
        np.array(stays, float), np.array(moves, float), np.array(loose, float),
    )  # fmt: skip


@lean
def begin_late(late, size, shown, z):
    """Fill the late readings as if the state had rested so far.

    Args:
        late: Late.
        size: number of states of the model.
        shown: (c,) what the sensors would show of the present state if they were not late.
        z: (size + q,) state, whose last q are written.

    Returns:
        Nothing.

    Source: pure transport delay; first-order lag.
    """
    for e in range(len(late.channel)):
        z[size + e] = shown[late.channel[e]]


@lean
def spread_late(late, size, slope, spread):
    """Covariance of the late readings after `begin_late`.

    Args:
        late: Late.
        size: number of states of the model.
        slope: (c, size + q) slopes of the readings in the present state, if they were not late.
        spread: (size + q, size + q) covariance, whose last q rows and columns are written.

    Returns:
        Nothing.

    Source: propagation of covariance; what a first-order lag shows is moreover off by its time
        constant times the rate, at which the value may have changed by its own standard deviation
        in 0.1 s.
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
        spread[s, s] = total + late.open[e] * total


@lean
def move_late(model, late, size, trail, h, z):
    """Late readings a row later.

    Args:
        model: Model.
        late: Late.
        size: number of states of the model.
        trail: (steps + 1, c) what the late channels would show over the row if they were not, see
            `advance`; where a channel has a first-order lag, replaced by what that shows.
        h: step, scalar [s].
        z: (size + q,) state, whose last q are moved in place.

    Returns:
        Nothing.

    Source: pure transport delay and first-order lag, linear between steps.
    """
    for e in range(len(late.channel)):
        c = late.channel[e]
        if late.lags[e]:
            shown = (z[size + e] - model.offset[c]) / model.scale[c]
            follow_channel(trail, c, h / model.time_constant[c], shown)
    for e in range(len(late.channel)):
        if late.due[e] < 0.0:
            z[size + e] = z[size + e + 1]
            continue
        c = late.channel[e]
        low = min(int(late.due[e] / h), len(trail) - 2)
        value = trail[low, c] + (late.due[e] / h - low) * (trail[low + 1, c] - trail[low, c])
        z[size + e] = model.scale[c] * value + model.offset[c]


@lean
def nudge_late(late, place, change, readings):
    """Add to the late readings what a change of one of them makes of them a row later.

    Args:
        late: Late.
        place: which reading is changed.
        change: scalar [channel's unit].
        readings: (q,) late readings a row later without the change; changed in place.

    Returns:
        Nothing.

    Source: `move_late`, which is linear in them.
    """
    readings[place] += late.stays[place] * change
    if place > 0:
        readings[place - 1] += late.moves[place] * change

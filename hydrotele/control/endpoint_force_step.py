"""One step of the force at the tip: readings, two filters, a balance between them."""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.control.state_filter import CHANGE, LAST, LOW, RATE, filter_step
from hydrotele.control.tip_balance import dynamic_balance, static_balance, tip_force
from hydrotele.core.compiled import lean

WAITING, GOOD, BAD, SINGULAR = range(4)
_JOINT, _HEAD, _ROD = range(3)  # rows of `Readings.last`


class Readings(NamedTuple):
    """What is kept of the readings; n independent coordinates, h valves, k axes.

    Attributes:
        period: between two readings of the sensors [s].
        settle: number of readings that are averaged at first.
        tables: (2, 3, 5) of the readings' filter and of the force's.
        position: (n,) column of every coordinate's axis.
        valve: (h,) column of every valve's axis.
        state: (n + 2 h + m, 4) of the filters: positions, pressures, force at the tip.
        outside: (n,) forces on the coordinates from outside [N m] or [N].
        last: (3, k) last good readings of joint, head and rod; NaN before the first.
        still: (3, k) readings since one changed.
    """

    period: float
    settle: int
    tables: np.ndarray
    position: np.ndarray
    valve: np.ndarray
    state: np.ndarray
    outside: np.ndarray
    last: np.ndarray
    still: np.ndarray


@lean
def endpoint_force_step(arm, readings, dynamic, count, joint, head, rod, out):
    """Take in new readings; force at the tip.

    Args:
        arm: Arm.
        readings: Readings.
        dynamic: whether the complete model is used, or gravity alone; scalar.
        count: number of readings before; scalar. The first ones are averaged, as of a machine at
            rest.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m].

    Returns:
        WAITING before every channel has read once, GOOD, BAD where a reading was not finite and the
        last one was taken, SINGULAR where the arm is singular and `out` is left alone.

    Source: Zhu 1994, 6.1.
    """
    r, n = readings, len(readings.position)
    good = _take(r.last[_JOINT], r.still[_JOINT], r.position, joint)
    good = _take(r.last[_HEAD], r.still[_HEAD], r.valve, head) and good
    good = _take(r.last[_ROD], r.still[_ROD], r.valve, rod) and good
    if not _known(r):
        return WAITING
    places = n + 2 * len(r.valve)
    for c in range(places):
        place, value = _reading(r, c)
        if count < r.settle:
            before = r.state[c, LOW] if count > 0 else value
            _stand(r.state[c], before + (value - before) / (count + 1))
        else:
            filter_step(r.tables[0], r.state[c], value)
        arm.z[place] = r.state[c, LOW]
        if c < n:
            arm.z[n + c] = r.state[c, RATE]
            arm.acceleration[c] = r.state[c, CHANGE]
    if dynamic:
        dynamic_balance(arm, r.outside)
    else:
        static_balance(arm, r.outside)
    if not tip_force(arm, r.outside, out):
        return SINGULAR
    for i in range(len(out)):
        if count < r.settle:
            _stand(r.state[places + i], out[i])
        else:
            filter_step(r.tables[1], r.state[places + i], out[i])
        out[i] = r.state[places + i, LOW]
    return GOOD if good else BAD


@lean
def _stand(state, value):
    """Let a filter stand at a value."""
    state[LOW], state[RATE], state[CHANGE], state[LAST] = value, 0.0, 0.0, value


@lean
def _reading(r, c):
    """Place in the arm's state and last good value of a signal: positions, then pressures."""
    n = len(r.position)
    if c < n:
        return c, r.last[_JOINT, r.position[c]]
    i, side = (c - n) // 2, (c - n) % 2
    return 2 * n + 4 * i + 2 + side, r.last[_HEAD + side, r.valve[i]]


@lean
def _take(last, still, used, values):
    """Keep readings that are finite; False if one that is used is not."""
    good = True
    for c in range(len(used)):
        i = used[c]
        if not math.isfinite(values[i]):
            good = False
            still[i] += 1
        elif values[i] == last[i]:
            still[i] += 1
        else:
            last[i] = values[i]
            still[i] = 0
    return good


@lean
def _known(readings):
    """Whether all channels that are used have read once."""
    for i in readings.position:
        if math.isnan(readings.last[_JOINT, i]):
            return False
    for i in readings.valve:
        if math.isnan(readings.last[_HEAD, i]) or math.isnan(readings.last[_ROD, i]):
            return False
    return True

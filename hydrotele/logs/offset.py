"""The offset between the clocks of two files of one run, from the commands that both logged."""

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import correlate

from hydrotele.logs.clock import Clock

_LEAST_OVERLAP = 5.0  # [s] that both must have in common
_ALIKE = 0.95  # correlation of commands that are the same signal, sampled twice
_EQUAL = 1.0e-6  # relative: commands that went through single precision are still the same numbers
_SAME = 0.99  # fraction of the rows that must be equal for the same rows in two files


def clock_offset(
    clock: Clock, command: np.ndarray, other: Clock, other_command: np.ndarray
) -> float | None:
    """What must be added to the times of the other file [s].

    The coarse offset is where the two command histories correlate best. If the files then hold the
    same rows, their stamps give it exactly; else it is where the commands, joined by straight
    lines, differ least.

    Args:
        clock: (n rows) the clock that counts.
        command: (n, k) commands of its rows.
        other: (m rows) the clock to be set.
        other_command: (m, k) the same commands in the other file.

    Returns:
        The offset [s], None where the commands do not tell (constant, or not the same signal).
    """
    step = min(clock.period, other.period)
    a, b = _held(clock, command, step), _held(other, other_command, step)
    least = round(_LEAST_OVERLAP / step)
    if min(len(a), len(b)) < least or not np.ptp(a, axis=0).any():
        return None
    alike, lags = _correlation(a - a.mean(axis=0), b - a.mean(axis=0), least)
    best = alike.max()
    if not best >= _ALIKE:
        return None
    near = np.flatnonzero(alike > best - 1.0e-6)
    stated = (other.start - clock.start) / step  # of several equal offsets the smallest counts
    lag = int(lags[near[np.argmin(np.abs(lags[near] - stated))]])
    coarse = clock.start + lag * step - other.start
    exact = _same_rows(clock, command, other, other_command, coarse)
    return exact if exact is not None else _refined(clock, command, other, other_command, coarse)


def _held(clock: Clock, values: np.ndarray, step: float) -> np.ndarray:
    """Values (n, k) on a uniform clock, each held until the next one."""
    time = clock.tick * clock.period
    at = np.arange(round(time[-1] / step) + 1) * step
    return values[np.searchsorted(time, at + 1e-6 * step, side="right") - 1]


def _correlation(a: np.ndarray, b: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of a[i + lag] and b[i] over their overlap, by lag; 0 for too short overlaps."""
    columns = range(a.shape[1])
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))
    product = sum(correlate(a[:, k], b[:, k], method="fft") for k in columns)
    power_a = sum(correlate(a[:, k] ** 2, ones_b, method="fft") for k in columns)
    power_b = sum(correlate(ones_a, b[:, k] ** 2, method="fft") for k in columns)
    overlap = np.rint(correlate(ones_a, ones_b, method="fft"))
    lags = np.arange(-(len(b) - 1), len(a))
    enough = overlap >= max(least, 0.5 * min(len(a), len(b)))
    power = np.sqrt(np.maximum(power_a * power_b, 0.0))
    enough &= power > 1e-6 * power.max()
    return np.where(enough, product / np.where(enough, power, 1.0), 0.0), lags


def _same_rows(clock: Clock, command, other: Clock, other_command, coarse: float) -> float | None:
    if abs(clock.period / other.period - 1.0) > 1e-3:
        return None
    size = np.abs(command).max()
    first = round((other.start + coarse - clock.start) / clock.period)
    for shift in (first, first - 1, first + 1):
        _, mine, theirs = np.intersect1d(clock.tick, other.tick + shift, return_indices=True)
        if not len(mine):
            continue
        equal = np.abs(command[mine] - other_command[theirs]).max(axis=1) <= _EQUAL * size
        if equal.mean() >= _SAME and np.ptp(command[mine], axis=0).any():
            own = clock.start + clock.tick[mine] * clock.period
            return float(np.median(own - (other.start + other.tick[theirs] * other.period)))
    return None


def _refined(clock: Clock, command, other: Clock, other_command, coarse: float) -> float:
    own = clock.start + clock.tick * clock.period
    time = other.start + other.tick * other.period

    def difference(offset: float) -> float:
        inside = (own >= time[0] + offset) & (own <= time[-1] + offset)
        return sum(
            float(np.mean((np.interp(own[inside], time + offset, theirs) - mine[inside]) ** 2))
            for mine, theirs in zip(command.T, other_command.T, strict=True)
        )

    width = 2.0 * max(clock.period, other.period)
    found = minimize_scalar(difference, bounds=(coarse - width, coarse + width), method="bounded",
                            options={"xatol": 1e-3 * clock.period})  # fmt: skip
    return float(found.x)  # type: ignore[union-attr]

"""A run's filter linearised about a track: likelihood and its slopes for other noise levels.

The transition Jacobians of a track make its Kalman filter a linear one, which can be run again
with other noise of the readings and other process noise at a fraction of the cost. A disturbance
smoother goes back through it: it gives the slopes of the likelihood with respect to all levels in
one pass, and the disturbances themselves, which say where and when the model lacks something.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.track import Track
from hydrotele.logs.dataset import RunData


class LinearRun(NamedTuple):
    """A run of n rows linearised about a track, with c channels and nz states.

    Attributes:
        flow: (n, nz, nz) d (state before the next row) / d (state after this one), the latter
            along the first index.
        slope: (n, c, nz) d reading / d state.
        error: (n, c) readings less what the track predicted, NaN where missing.
        correction: (n, nz) what the track's own filter added to the state at every row.
        initial: (nz, nz) covariance before the first reading.
        startle: (n, nz) variance that rows with unknown commands add.
    """

    flow: np.ndarray
    slope: np.ndarray
    error: np.ndarray
    correction: np.ndarray
    initial: np.ndarray
    startle: np.ndarray


def linear_run(track: Track, startle: np.ndarray, rows: slice = slice(None)) -> LinearRun:
    """Linearise a run.

    Args:
        track: made with `linearise`.
        startle: (nz,) variance that a row with unknown command adds.
        rows: part of the run to keep; the state's covariance before it is that before the run.

    Returns:
        The linear run.
    """
    run: RunData = track.run
    raw = track.whitened * track.gains.spread
    correction = np.einsum("rcs,rc->rs", track.gains.gain, np.nan_to_num(raw))
    unknown = np.outer(~run.command_known, startle)
    return LinearRun(
        track.flow[rows], track.gains.slope[rows], (run.reading - track.predicted)[rows],
        correction[rows], track.initial, unknown[rows],
    )  # fmt: skip


@compiled
def linear_filter(run, noise, drift, whitened, width, gain, before, covariance):
    """Kalman filter of a linear run; deviations of the state count from the track's.

    Args:
        run: LinearRun.
        noise: (n, c) variances of the readings.
        drift: (nz,) variance that a row adds to the state.
        whitened: (n, c) written: prediction errors over their spread, NaN where missing.
        width: (n, c) written: their predicted standard deviation [channel's unit].
        gain: (n, c, nz) written: corrections of the state per prediction error.
        before: (n, nz) written: deviations before each row's readings.
        covariance: (n or 0, nz, nz) written: their covariances.

    Returns:
        -2 log likelihood without its constant.

    Source: Anderson and Moore 1979, Optimal Filtering, chapter 6; sequential readings.
    """
    rows, channels, size = run.slope.shape
    p, work = run.initial.copy(), np.zeros((size, size))
    d, pull = np.zeros(size), np.zeros(size)
    loss = 0.0
    for row in range(rows):
        before[row] = d
        if len(covariance) > 0:
            covariance[row] = p
        for c in range(channels):
            y = run.error[row, c]
            if np.isnan(y):
                whitened[row, c] = np.nan
                width[row, c] = np.nan
                continue
            h = run.slope[row, c]
            total = noise[row, c]
            pull[:] = 0.0
            for k in range(size):  # a reading depends on few states
                if h[k] != 0.0:
                    y -= h[k] * d[k]
                    for s in range(size):
                        pull[s] += p[k, s] * h[k]
            for s in range(size):
                total += h[s] * pull[s]
            width[row, c] = np.sqrt(total)
            whitened[row, c] = y / width[row, c]
            loss += y * y / total + np.log(total)
            for s in range(size):
                gain[row, c, s] = pull[s] / total
                d[s] += gain[row, c, s] * y
            for s in range(size):
                part = gain[row, c, s]
                for k in range(size):
                    p[s, k] -= part * pull[k]
        if row == rows - 1:
            break
        for s in range(size):
            pull[s] = d[s] - run.correction[row, s]
        f = run.flow[row]
        d[:] = 0.0
        for s in range(size):
            for r in range(size):
                d[r] += f[s, r] * pull[s]
        for a in range(size):  # work = F p, then p = work F'; the innermost index is contiguous
            for b in range(size):
                work[a, b] = 0.0
            for k in range(size):
                part = f[k, a]
                if part == 0.0:
                    continue
                for b in range(size):
                    work[a, b] += part * p[k, b]
        for a in range(size):
            p[a] = 0.0
            for k in range(size):
                part = work[a, k]
                for b in range(a + 1):
                    p[a, b] += part * f[k, b]
        for a in range(size):
            for b in range(a):
                p[b, a] = p[a, b]
            p[a, a] += drift[a] + run.startle[row, a]
    return loss


@compiled
def linear_smoother(run, rates, whitened, width, gain, slopes, pulls, lacks):
    """Go back through a linear filter: slopes of its loss, and the smoothed disturbances.

    Args:
        run: LinearRun.
        rates: (n, c) squares of the readings' rates; (0, c) where no slope along jitter is wanted.
        whitened: as `linear_filter` wrote them.
        width: see whitened.
        gain: see whitened.
        slopes: written: (c,) d loss / d (variance of a channel's readings), (nz,) d loss /
            d (variance that a row adds), (1,) d loss / d (variance of the instants).
        pulls: (n, nz) written: r of the rows; a row's smoothed disturbance on its way to the next
            is the row's variance times the next row's r, and its smoothed deviation before the
            readings the covariance there times its own r.
        lacks: (n, nz) written: diagonal of N; the disturbance's variance is q - q N q.

    Returns:
        Nothing.

    Source: Koopman and Shephard 1992, Biometrika 79(4), Eqs 2.4-2.6; de Jong 1989.
    """
    rows, channels, size = run.slope.shape
    r, n = np.zeros(size), np.zeros((size, size))
    work, pull, new = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    turned = np.zeros((size, size))
    noise_slope, drift_slope, jitter_slope = slopes
    jitter_slope[:] = 0.0
    noise_slope[:] = 0.0
    drift_slope[:] = 0.0
    for row in range(rows - 1, -1, -1):
        if row < rows - 1:
            f = run.flow[row]
            for s in range(size):
                drift_slope[s] += n[s, s] - r[s] * r[s]
            for s in range(size):
                for k in range(size):
                    turned[k, s] = f[s, k]
            new[:] = 0.0
            for k in range(size):
                for s in range(size):
                    new[s] += turned[k, s] * r[k]
            for s in range(size):
                r[s] = new[s]
            for a in range(size):  # n = F' n F with f the transpose of F
                for b in range(size):
                    work[a, b] = 0.0
                for k in range(size):
                    part = f[a, k]
                    if part == 0.0:
                        continue
                    for b in range(size):
                        work[a, b] += part * n[k, b]
            for a in range(size):
                n[a] = 0.0
                for k in range(size):
                    part = work[a, k]
                    for b in range(a + 1):
                        n[a, b] += part * turned[k, b]
            for a in range(size):
                for b in range(a):
                    n[b, a] = n[a, b]
        for c in range(channels - 1, -1, -1):
            if np.isnan(whitened[row, c]):
                continue
            h, k_gain = run.slope[row, c], gain[row, c]
            square = width[row, c] * width[row, c]
            u = whitened[row, c] / width[row, c]
            inner = 1.0 / square
            pull[:] = 0.0
            for k in range(size):
                u -= k_gain[k] * r[k]
                for s in range(size):
                    pull[s] += n[k, s] * k_gain[k]
            for s in range(size):
                inner += k_gain[s] * pull[s]
            noise_slope[c] += inner - u * u
            if len(rates) > 0:
                jitter_slope[0] += rates[row, c] * (inner - u * u)
            for s in range(size):
                if h[s] != 0.0:  # a reading depends on few states
                    r[s] += h[s] * u
                    for k in range(size):
                        n[s, k] += h[s] * (0.5 * inner * h[k] - pull[k])
                        n[k, s] += h[s] * (0.5 * inner * h[k] - pull[k])
        for s in range(size):
            pulls[row, s] = r[s]
            lacks[row, s] = n[s, s]


class Smoothed(NamedTuple):
    """What a run's filter and smoother say at some noise levels.

    Attributes:
        loss: -2 log likelihood without its constant.
        noise_slope: (c,) d loss / d variance of a reading.
        drift_slope: (nz,) d loss / d variance that a row adds.
        jitter_slope: d loss / d variance of the instants at which channels are read.
        whitened: (n, c) prediction errors over their spread.
        width: (n, c) that spread.
        disturbance: (n, nz) smoothed disturbance of the state on its way to the next row.
        known: (n, nz) share of the disturbance's variance that the readings resolve, 0 .. 1.
        deviation: (n, nz) smoothed state less the track's before the row's readings; empty unless
            asked for.
    """

    loss: float
    noise_slope: np.ndarray
    drift_slope: np.ndarray
    jitter_slope: float
    whitened: np.ndarray
    width: np.ndarray
    disturbance: np.ndarray
    known: np.ndarray
    deviation: np.ndarray


def smooth(
    run: LinearRun, noise: np.ndarray, drift: np.ndarray, states: bool = False,
    rates: np.ndarray | None = None,
) -> Smoothed:  # fmt: skip
    """Filter and smoother of a linear run.

    Args:
        run: LinearRun.
        noise: (n, c) variances of the readings [channel's unit squared].
        drift: (nz,) variance that a row adds to the state.
        states: whether to return the smoothed deviation of the state, too.
        rates: (n, c) squares of the readings' rates, for the slope along jitter; else that is 0.

    Returns:
        What they say.
    """
    rows, channels, size = run.slope.shape
    whitened, width = np.empty((rows, channels)), np.empty((rows, channels))
    gain, before = np.zeros((rows, channels, size)), np.empty((rows, size))
    covariance = np.empty((rows if states else 0, size, size))
    loss = linear_filter(run, noise, drift, whitened, width, gain, before, covariance)
    slopes = np.zeros(channels), np.zeros(size), np.zeros(1)
    rates = np.zeros((0, channels)) if rates is None else rates
    pulls, lacks = np.empty((rows, size)), np.empty((rows, size))
    linear_smoother(run, rates, whitened, width, gain, slopes, pulls, lacks)
    own = drift + run.startle
    disturbance, known = np.zeros((rows, size)), np.zeros((rows, size))
    disturbance[:-1] = own[:-1] * pulls[1:]
    known[:-1] = own[:-1] * lacks[1:]
    deviation = before + np.einsum("rsk,rk->rs", covariance, pulls) if states else before[:0]
    return Smoothed(
        loss, slopes[0], slopes[1], float(slopes[2][0]), whitened, width, disturbance, known,
        deviation,
    )  # fmt: skip

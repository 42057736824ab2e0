"""How much later a signal comes than another, window by window."""

import numpy as np

_WINDOW = 8.0  # s: holds several reversals of a machine at work
_LARGEST = 0.5  # s: lag that is searched
_LEAST = 0.5  # correlation below which a window tells nothing


def window_lags(
    expected: np.ndarray, measured: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Lag of a measured behind an expected signal in windows, with its noise.

    The lag is where the cross-correlation of the two, without their means, has its peak, refined by
    a parabola.

    Args:
        expected: (d, n) [u]; the first row as found, the others with other noise.
        measured: (d, n) [u].
        period: time between samples [s].

    Returns:
        ((n,) lag, positive if measured comes later, (n,) standard deviation) [s], constant in each
        window and NaN in windows without a clear peak; None where no window has one.
    """
    rows = expected.shape[1]
    count = max(1, int(rows * period / _WINDOW))
    edges = np.linspace(0, rows, count + 1).astype(int)
    lag, noise = np.full(rows, np.nan), np.full(rows, np.nan)
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        lags = np.array(
            [
                peak_lag(e[begin:end], m[begin:end], period)
                for e, m in zip(expected, measured, strict=True)
            ]
        )
        if np.isfinite(lags[0]) and np.isfinite(lags[1:]).sum() > len(lags) // 2:
            lag[begin:end] = lags[0]
            noise[begin:end] = np.sqrt(np.nanmean((lags[1:] - lags[0]) ** 2))
    return (lag, noise) if np.isfinite(lag).any() else None


def peak_lag(expected: np.ndarray, measured: np.ndarray, period: float) -> float:
    """Lag of one signal behind another.

    Args:
        expected: (n,) [u].
        measured: (n,) [u].
        period: time between samples [s].

    Returns:
        Lag [s], positive if measured comes later; NaN where the two are not alike.

    >>> time = 0.02 * np.arange(400)
    >>> round(peak_lag(np.sin(time), np.sin(time - 0.05), 0.02), 3)
    0.05
    """
    reach = min(round(_LARGEST / period), len(expected) // 4)
    if reach < 2:
        return float("nan")
    fixed = expected[reach:-reach] - expected[reach:-reach].mean()
    near = np.lib.stride_tricks.sliding_window_view(measured, len(fixed))  # (2 reach + 1, .)
    near = near - near.mean(axis=1, keepdims=True)
    size = np.sqrt((fixed @ fixed) * np.einsum("ij,ij->i", near, near))
    if not size.min() > 0.0:
        return float("nan")
    likeness = near @ fixed / size
    best = int(likeness.argmax())
    if likeness[best] < _LEAST or not 0 < best < len(likeness) - 1:
        return float("nan")
    before, top, after = likeness[best - 1 : best + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * top + after)
    return float((best + shift - reach) * period)

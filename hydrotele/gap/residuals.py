"""Are the prediction errors of a model those of a perfect one? Several tests, none on one block.

Whitened errors of a perfect model are white noise of size 1 in every channel. The limits lie well
above what integrators and linearisation leave on clean simulated machines, whose worst channels
reach 1.02, 1.4 and 25 (`docs/results/gap_calibration.md`), and far below what an effect of some
size leaves (3, 54 and 3100 on open_02).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hydrotele.estimate.track import Track

_EXPECTED = (1.0, 1.0, 0.0)  # of white noise of size 1, in the order of LIMITS
ALLOWED = 5.0  # times what the filter leaves on simulated readings, which varies by two

_SETTLE = 0.5  # s until the start no longer matters
_WINDOW = 1.0  # s, longer than any ringing of the errors, shorter than a motion
_LAGS = 5
LIMITS = {"mean_square": 1.12, "window_means": 1.8, "autocorrelation": 60.0}
"""Largest value of a test in any channel that still passes, for a smooth model."""


def residual_tests(
    tracks: Sequence[Track], channels: Sequence[str], perfect: Sequence[Track] = ()
) -> dict[str, dict[str, Any]]:
    """Tests of a model's errors over all runs.

    Where a model has backlash or late sensors, a filter that takes everything for locally straight
    leaves errors even on readings that the model itself made. A test then allows five times what
    those leave in a channel beyond white noise.

    Args:
        tracks: the model's tracks, each with gains of its own.
        channels: the c channels.
        perfect: the model's tracks of the same runs with readings that it made itself.

    Returns:
        Test -> "value" (of the channel nearest to or farthest above its limit), "channel", "limit",
        "passed". `mean_square` of the errors; `window_means`: mean square of the means over 1 s,
        times their length; `autocorrelation`: sum over 5 lags of n r^2, mean over the runs, less
        its expectation 5.
    """
    values = _values(tracks)
    own = _values(perfect) if perfect else [np.full(len(channels), e) for e in _EXPECTED]
    found = {}
    for name, measured, made, white in zip(LIMITS, values, own, _EXPECTED, strict=True):
        limits = np.maximum(LIMITS[name], white + ALLOWED * (made - white))
        worst = int(np.argmax(measured / limits))
        found[name] = {
            "value": float(measured[worst]),
            "channel": channels[worst],
            "limit": float(limits[worst]),
            "passed": bool(measured[worst] <= limits[worst]),
        }
    return found


def _values(tracks: Sequence[Track]) -> list[np.ndarray]:
    """Per test the values (c,) of all channels over all runs."""
    parts = [_measures(track.whitened, track.run.period) for track in tracks]
    weights = np.array([p[0] for p in parts])
    total = np.maximum(weights.sum(axis=0), 1.0)
    return [
        np.sum(weights * np.array([p[index] for p in parts]), axis=0) / total
        for index in range(1, 1 + len(LIMITS))
    ]


def _measures(
    whitened: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per channel (c,): rows with a reading, mean square, window means, autocorrelation."""
    w, window = settled(whitened, period), max(2, round(_WINDOW / period))
    there = np.isfinite(w)
    count = there.sum(axis=0).astype(float)
    w = np.where(there, w, 0.0)
    some = np.maximum(count, 1.0)
    square = (w**2).sum(axis=0) / some
    windows = len(w) // window
    cut, filled = (
        a[: windows * window].reshape(windows, window, -1).sum(axis=1) for a in (w, there)
    )
    full = filled > window // 2
    means = np.where(full, cut**2 / np.maximum(filled, 1), 0.0).sum(axis=0)
    means /= np.maximum(full.sum(axis=0), 1)
    echo = np.zeros(w.shape[1])
    for lag in range(1, _LAGS + 1):
        echo += (w[lag:] * w[:-lag]).sum(axis=0) ** 2 / some / np.maximum(square, 1e-12) ** 2
    return count, square, means, echo - _LAGS


def settled(whitened: np.ndarray, period: float) -> np.ndarray:
    """Whitened errors (n, c) without those of a run's start, at most half of them."""
    return whitened[min(round(_SETTLE / period), len(whitened) // 2) :]


def rms(tracks: Sequence[Track]) -> float:
    """RMS of the whitened errors of tracks over all channels, without the runs' starts."""
    parts = [settled(track.whitened, track.run.period).ravel() for track in tracks]
    return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))

"""Are the prediction errors of a model those of a perfect one? Several tests, none on one block.

Whitened errors of a perfect model are white noise of size 1 in every channel. The limits lie well
above what integrators and linearisation leave on 100 clean simulated machines, whose worst channels
reach 1.03, 1.3 and 25 (`docs/results/gap_calibration.md`), and far below what an effect of some
size leaves (3, 54 and 3100 on open_02).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hydrotele.gap.tracking import Track

_SETTLE = 25  # rows until the start no longer matters
_WINDOW = 50  # rows, 1 s at 50 Hz: longer than any ringing of the errors, shorter than a motion
_LAGS = 5
LIMITS = {"mean_square": 1.12, "window_means": 1.8, "autocorrelation": 60.0}
"""Largest value of a test in any channel that still passes."""


def residual_tests(tracks: Sequence[Track], channels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Tests of a model's errors over all runs.

    Args:
        tracks: the model's tracks, each with gains of its own.
        channels: the c channels.

    Returns:
        Test -> "value" (the worst channel's), "channel", "limit", "passed". `mean_square` of the
        errors; `window_means`: mean square of the means over 1 s, times their length;
        `autocorrelation`: sum over 5 lags of n r^2, mean over the runs, less its expectation 5.
    """
    parts = [_measures(track.whitened) for track in tracks]
    weights = np.array([p[0] for p in parts])
    total = np.maximum(weights.sum(axis=0), 1.0)
    found = {}
    for index, name in enumerate(("mean_square", "window_means", "autocorrelation"), 1):
        values = np.sum(weights * np.array([p[index] for p in parts]), axis=0) / total
        worst = int(np.argmax(values))
        found[name] = {
            "value": float(values[worst]),
            "channel": channels[worst],
            "limit": LIMITS[name],
            "passed": bool(values[worst] <= LIMITS[name]),
        }
    return found


def _measures(whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per channel (c,): rows with a reading, mean square, window means, autocorrelation."""
    w = whitened[_SETTLE:]
    there = np.isfinite(w)
    count = there.sum(axis=0).astype(float)
    w = np.where(there, w, 0.0)
    some = np.maximum(count, 1.0)
    square = (w**2).sum(axis=0) / some
    windows = len(w) // _WINDOW
    cut, filled = (
        a[: windows * _WINDOW].reshape(windows, _WINDOW, -1).sum(axis=1) for a in (w, there)
    )
    full = filled > _WINDOW // 2
    means = np.where(full, cut**2 / np.maximum(filled, 1), 0.0).sum(axis=0)
    means /= np.maximum(full.sum(axis=0), 1)
    echo = np.zeros(w.shape[1])
    for lag in range(1, _LAGS + 1):
        echo += (w[lag:] * w[:-lag]).sum(axis=0) ** 2 / some / np.maximum(square, 1e-12) ** 2
    return count, square, means, echo - _LAGS


def rms(whitened: np.ndarray) -> float:
    """RMS of whitened errors over all channels, the settling rows left out."""
    return float(np.sqrt(np.nanmean(whitened[_SETTLE:] ** 2)))

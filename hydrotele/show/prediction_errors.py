"""RMS prediction errors relative to their predicted noise [1], by channel and time window.

It also finds the time intervals in which they are significant.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.gap.result import Prediction

WINDOW_DURATION = 0.5  # s, duration of a window
_FALSE_ALARM_PROBABILITY = 1e-3  # probability that a perfect model has any gap window in a run


class WindowedErrors(NamedTuple):
    """RMS of whitened prediction errors in w windows of about equal length, for c channels.

    Attributes:
        edges: (w + 1,) edges of the windows [s].
        rms: (w, c) RMS per window and channel [1], NaN without measurements.
        count: (w, c) number of measurements.
    """

    edges: np.ndarray
    rms: np.ndarray
    count: np.ndarray


class GapWindow(NamedTuple):
    """Time interval in which the errors of a model exceed the noise significantly.

    Attributes:
        start: start time [s].
        stop: end time [s].
        channel: channel with the largest error.
        rms: RMS of its whitened errors in the worst window [1].
    """

    start: float
    stop: float
    channel: str
    rms: float


def windowed_errors(prediction: Prediction, window: float = WINDOW_DURATION) -> WindowedErrors:
    """Compute the RMS of prediction errors, divided by their predicted noise, in windows of time.

    Args:
        prediction: one-step predictions of a run.
        window: approximate duration of a window [s].

    Returns:
        RMS and number of measurements per window and channel.
    """
    time = prediction.time
    period = float(np.median(np.diff(time)))
    rows = max(1, round(window / period))
    starts = np.arange(0, len(time), rows)
    if len(starts) > 1 and len(time) - starts[-1] < rows / 2:
        starts = starts[:-1]
    edges = np.append(time[starts], time[-1] + period)
    present = np.isfinite(prediction.whitened)
    squares = np.where(present, prediction.whitened, 0.0) ** 2
    count = np.add.reduceat(present, starts, axis=0, dtype=int)
    total = np.add.reduceat(squares, starts, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(total / count)
    return WindowedErrors(edges, rms, count)


def channel_rms(prediction: Prediction) -> np.ndarray:
    """Return the RMS over a run of the one-step prediction errors divided by their predicted noise.

    Returns:
        (c,) value per channel [1]; 1 for a perfect model, NaN without measurements.
    """
    present = np.isfinite(prediction.whitened)
    total = (np.where(present, prediction.whitened, 0.0) ** 2).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(total / present.sum(axis=0))


def find_gap_windows(prediction: Prediction, noise_floor: float) -> list[GapWindow]:
    """Find the time intervals in which the prediction error of a channel is significant.

    The limit is a quantile of the chi-square distribution: a perfect model, whose errors have the
    RMS `noise_floor`, has any such interval in one of 1000 runs.

    Args:
        prediction: one-step predictions of the model.
        noise_floor: RMS of the whitened errors of a perfect model [1].

    Returns:
        Intervals in order of time; adjacent windows are merged.
    """
    from scipy.stats import chi2

    found = windowed_errors(prediction)
    known = found.count > 0
    chance = _FALSE_ALARM_PROBABILITY / max(1, known.sum())
    counts = np.maximum(found.count, 1)
    limit = noise_floor * np.sqrt(chi2.isf(chance, counts) / counts)
    size = np.where(known, found.rms, 0.0)
    loud = np.append((size > limit).any(axis=1), False)
    stretches, first = [], None
    for number, on in enumerate(loud):
        if on and first is None:
            first = number
        elif not on and first is not None:
            part = size[first:number]
            channel = int(np.argmax(part.max(axis=0)))
            start, end = float(found.edges[first]), float(found.edges[number])
            name, worst = prediction.channels[channel], float(part.max())
            stretches.append(GapWindow(start, end, name, worst))
            first = None
    return stretches


def find_most_improved_channels(before: Prediction, after: Prediction, count: int) -> list[str]:
    """Return the channels whose mean square whitened error decreases most from one model to another.

    If both predictions are equal, the channels with the largest mean square error are returned.

    Args:
        before: predictions of the given model.
        after: predictions of the corrected model.
        count: maximum number of channels.
    """
    old, new = channel_rms(before) ** 2, channel_rms(after) ** 2
    weight = old - new if not np.array_equal(old, new, equal_nan=True) else old
    order = [k for k in np.argsort(-np.nan_to_num(weight, nan=-np.inf)) if np.isfinite(weight[k])]
    return [before.channels[k] for k in order[:count]]

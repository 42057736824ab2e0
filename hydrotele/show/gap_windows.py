"""Where in time a model is off: windowed sizes of whitened prediction errors, and gap windows."""

from typing import NamedTuple

import numpy as np

from hydrotele.gap.result import Prediction

WINDOW = 0.5  # s
_FALSE_ALARMS = 1e-3  # chance that a perfect model shows any gap window in a run


class Windows(NamedTuple):
    """Sizes of whitened prediction errors in windows of equal length.

    Attributes:
        edges: (w + 1,) borders of the windows [s].
        rms: (w, c) RMS per window and channel [1], NaN where nothing was measured.
        count: (w, c) number of readings.
    """

    edges: np.ndarray
    rms: np.ndarray
    count: np.ndarray


class GapWindow(NamedTuple):
    """A stretch of time in which a model is off more than noise explains.

    Attributes:
        start: [s].
        end: [s].
        channel: the channel that is off most.
        rms: RMS of its whitened errors in its worst window [1].
    """

    start: float
    end: float
    channel: str
    rms: float


def windowed(prediction: Prediction, window: float = WINDOW) -> Windows:
    """Size of the whitened errors in windows of about `window` seconds."""
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
    return Windows(edges, rms, count)


def channel_rms(prediction: Prediction) -> np.ndarray:
    """RMS of the whitened errors per channel (c,) [1], NaN where nothing was measured."""
    present = np.isfinite(prediction.whitened)
    total = (np.where(present, prediction.whitened, 0.0) ** 2).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(total / present.sum(axis=0))


def gap_windows(prediction: Prediction, noise_floor: float) -> list[GapWindow]:
    """Stretches in which some channel is off more than a perfect model ever would be.

    The limit is that of chi-square: a perfect model, whose errors have the size `noise_floor`,
    shows a window in one of a thousand runs.

    Args:
        prediction: of the model.
        noise_floor: size of a perfect model's whitened errors [1].

    Returns:
        The stretches in order of time; neighbouring windows are one stretch.
    """
    from scipy.stats import chi2

    found = windowed(prediction)
    known = found.count > 0
    chance = _FALSE_ALARMS / max(1, known.sum())
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


def most_changed(before: Prediction, after: Prediction, count: int) -> list[str]:
    """The channels that the patch, or else the given model, says most about, worst first.

    They are ordered by the fall of their mean square error; where nothing was patched, by that
    error itself.
    """
    old, new = channel_rms(before) ** 2, channel_rms(after) ** 2
    weight = old - new if not np.array_equal(old, new, equal_nan=True) else old
    order = [k for k in np.argsort(-np.nan_to_num(weight, nan=-np.inf)) if np.isfinite(weight[k])]
    return [before.channels[k] for k in order[:count]]

"""Prediction bands: open-loop predictions of machines sampled from the posterior of a gap search.

A band holds the uncertainty of the sampled parameters and, where stated, measurement noise. It does not hold
laws that are missing in the model, parameters that the search did not change, or errors of the start states.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.estimate.free_run import (
    SETTLE,
    TO_THE_END,
    Runner,
    chained,
    find_diverged_rows,
    following_levels,
    machine_runner,
    window_starts,
)
from hydrotele.gap.posterior import Posterior, machine_of_sample
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine

_QUANTILES = (0.025, 0.5, 0.975)
_NORMAL95 = 1.96
MIN_SAMPLES = 2  # predictions of which a band is made


class Band(NamedTuple):
    """95 % band of sampled predictions, per row and channel.

    Attributes:
        low: (n, c) 2.5 % quantile of the predictions with measurement noise [channel's unit].
        high: (n, c) 97.5 % quantile of the same.
        width: (n, c) distance of the 2.5 and 97.5 % quantiles of the predictions alone.
    """

    low: np.ndarray
    high: np.ndarray
    width: np.ndarray


@dataclass(frozen=True)
class BandSummary:
    """A band over all windows of one horizon, or over one run.

    Attributes:
        width: (c,) RMS distance of the 2.5 and 97.5 % quantiles of the predictions [channel's unit].
        inside: (c,) fraction of the measured values inside the band with measurement noise; NaN without any.
        diverged: number of predictions that diverged and were left out.
    """

    width: np.ndarray
    inside: np.ndarray
    diverged: int = 0


def sample_machines(posterior: Posterior, count: int) -> list[Machine]:
    """Return the machines of the first samples.

    Raises:
        InputError: there are fewer samples, or the count is too small for a band.
    """
    if count < MIN_SAMPLES:
        raise InputError(f"--bands {count}", f"must be 0 or at least {MIN_SAMPLES}")
    if count > len(posterior.samples):
        raise InputError(f"--bands {count}", f"exceeds the {len(posterior.samples)} samples in {posterior.source}")
    return [machine_of_sample(posterior, index) for index in range(count)]


def prediction_band(predicted: np.ndarray, noise: np.ndarray) -> Band:
    """Compute the 95 % band of predictions, to which the noise is added as independent and normal.

    Args:
        predicted: (s, n, c) predictions of s >= 2 samples [channel's unit].
        noise: (c,) standard deviations of a reading.

    >>> band = prediction_band(np.zeros((3, 1, 1)), np.array([1.0]))
    >>> float(band.low[0, 0]), float(band.high[0, 0]), float(band.width[0, 0])
    (-1.96, 1.96, 0.0)
    """
    low, middle, high = np.quantile(predicted, _QUANTILES, axis=0)
    reach = _NORMAL95 * noise
    return Band(middle - np.hypot(middle - low, reach), middle + np.hypot(high - middle, reach), high - low)


def summarise_band(bands: Sequence[Band], measured: Sequence[np.ndarray], diverged: int = 0) -> BandSummary:
    """Summarise bands over several windows; `measured` are their (n, c) readings, NaN if missing."""
    reading = np.concatenate(measured)
    low, high, width = (np.concatenate(parts) for parts in zip(*bands, strict=True))
    known = np.isfinite(reading)
    count = known.sum(axis=0)
    inside = (known & (reading >= low) & (reading <= high)).sum(axis=0)
    fraction = np.where(count > 0, inside / np.maximum(count, 1), math.nan)
    return BandSummary(np.sqrt(np.mean(width**2, axis=0)), fraction, diverged)


def noise_of(posterior: Posterior, data: Dataset) -> np.ndarray:
    """Return the noise (c,) of the channels of a dataset: estimated by the gap search, else from the readings."""
    others = following_levels(data).noise
    return np.array([posterior.noise.get(name, own) for name, own in zip(data.channels, others, strict=True)])


class RunBands(NamedTuple):
    """Bands of a model along one run.

    Attributes:
        horizons: horizon, as in `estimate.free_run.RunErrors` -> summary; without those all of whose windows
            have fewer than two predictions that stay near the machine.
        plotted: (low, high), each (n, c): the band with noise of predictions that restart every few seconds,
            NaN where unknown.
    """

    horizons: dict[str, BandSummary]
    plotted: tuple[np.ndarray, np.ndarray]


def compute_run_bands(
    machines: Sequence[Machine], data: Dataset, run: RunData, noise: np.ndarray,
    horizons: Sequence[float], restart: float, each: Callable = map,
) -> RunBands:  # fmt: skip
    """Compute the bands of open-loop predictions of sampled machines along a run.

    Args:
        machines: the s sampled machines.
        data: the dataset.
        run: one of its runs.
        noise: (c,) standard deviations of a reading [channel's unit].
        horizons: lengths of the predictions [s]; the end of the run is added.
        restart: time after which the plotted predictions restart from the readings [s].
        each: `map`, or that of an executor.
    """
    runners: list[Runner] = list(each(lambda machine: machine_runner(machine, data)(run), machines))
    rows, first = len(run.reading), round(SETTLE / run.period)
    windows = {
        f"{seconds:g}": (window_starts(rows, run.period, seconds), round(seconds / run.period)) for seconds in horizons
    }
    if rows - 1 > first:
        windows[TO_THE_END] = np.array([first]), rows - 1 - first
    found = {}
    for name, (starts, count) in windows.items():
        bands, measured, diverged = [], [], 0
        for start in starts:
            predicted = np.array(list(each(lambda r, s=start, n=count: r.run(np.array([s]), n)[0], runners)))
            near = ~find_diverged_rows(predicted, run.reading).any(axis=(1, 2))
            diverged += int(np.sum(~near))
            if np.sum(near) >= MIN_SAMPLES:
                bands.append(prediction_band(predicted[near], noise))
                measured.append(run.reading[start + 1 : start + 1 + count])
        if bands:
            found[name] = summarise_band(bands, measured, diverged)
    band = prediction_band(np.array(list(each(lambda r: chained(r, run, restart), runners))), noise)
    return RunBands(found, (band.low, band.high))


def band_document(summary: BandSummary, channels: Sequence[str]) -> Mapping[str, Mapping[str, float]]:
    """Return a summary as JSON data: `width` in SI units and the fraction `inside`, per channel."""
    return {
        "width": dict(zip(channels, summary.width.tolist(), strict=True)),
        "inside": dict(zip(channels, summary.inside.tolist(), strict=True)),
    }

"""Noise levels from the data, where the machine states no accuracy of its sensors.

Such a machine is usually known roughly, too: readings then differ from the model by what it lacks,
not by noise. A filter that trusts every reading would follow them and see no difference; so here it
forgets over a stated horizon, and an error counts by its mean over that horizon. The errors of the
given model then have size 1 by construction: effects can be compared, but there is no floor below
which a model counts as perfect.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from hydrotele.dataset.load import Dataset, RunData
from hydrotele.prediction.track import track_run
from hydrotele.signals import parse_channel

HORIZON = 0.5  # s over which the filter forgets: longer than a valve's lag, shorter than a motion
_ROUNDS = 5
_PRESSURES = ("pressure_head", "pressure_rod")


def known_levels(data: Dataset) -> bool:
    """Whether the noise of every channel is stated."""
    return bool(np.all(np.isfinite(data.noise)))


def find_levels(data: Dataset, each: Callable = map) -> Dataset:
    """The dataset with reading noise and drift for a filter that forgets over the horizon.

    Args:
        data: a dataset with unknown noise in some channels.
        each: such as `map`, perhaps on several workers.

    Returns:
        The dataset with finite `noise`, and `drift`.
    """
    unknown = ~np.isfinite(data.noise)
    readings = np.concatenate([run.reading for run in data.fit])
    noise = np.where(unknown, 0.01 * np.nanstd(readings, axis=0) + 1e-12, data.noise)
    found = _forgetful(data, noise, unknown)
    for _ in range(_ROUNDS):
        tracks = list(each(lambda run, now=found: track_run(now.machine, now, run), data.fit))
        size = _size_over_horizon([t.whitened for t in tracks], data.fit)
        noise = np.where(unknown, noise * size, noise)
        found = _forgetful(data, noise, unknown)
    return found


def _forgetful(data: Dataset, noise: np.ndarray, unknown: np.ndarray) -> Dataset:
    """Drift such that readings of unknown noise correct their state over the horizon."""
    drift, machine = {}, data.machine
    share = data.fit[0].period / HORIZON
    for channel, level, free in zip(data.channels, noise, unknown, strict=True):
        if not free:
            continue
        signal = parse_channel(channel)
        if signal.kind in _PRESSURES:
            drift[f"{signal.kind}.{signal.axis}"] = level * share
        elif signal.axis in data.axes and signal.kind == machine.position_kind(signal.axis):
            drift[f"position.{machine.axes[signal.axis].joint}"] = level * share
    return dataclasses.replace(data, noise=noise, drift=drift)


def _size_over_horizon(whitened: list[np.ndarray], runs: tuple[RunData, ...]) -> np.ndarray:
    """Per channel (c,) size of the errors' sums over the horizon, were they white 1."""
    sums, counts = [], []
    for errors, run in zip(whitened, runs, strict=True):
        rows = max(1, round(HORIZON / run.period))
        windows = len(errors) // rows
        cut = errors[: windows * rows].reshape(windows, rows, -1)[2:]
        sums.append(np.nansum(cut, axis=1))
        counts.append(np.isfinite(cut).sum(axis=1))
    total, count = np.concatenate(sums), np.concatenate(counts)
    return np.sqrt((total**2).sum(axis=0) / np.maximum(count.sum(axis=0), 1)) + 1e-9

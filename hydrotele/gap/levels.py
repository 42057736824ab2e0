"""Noise levels from the data, where the machine states no accuracy of its sensors.

Reading noise and model drift are those under which the given model makes the data most likely. The
prediction errors then have size 1 by construction: effects can be compared, but there is no floor
below which a model counts as perfect.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from hydrotele.gap.dataset import Dataset, RunData
from hydrotele.gap.tracking import DRIFT, track_run
from hydrotele.signals import parse_channel

_ROWS = 3000  # rows of each run that are looked at: enough for a level within some 3 %
_TRIES = 60
_FINEST = 1e-7  # of the largest reading: single precision
_FREE = ("rate", "pressure_head")  # kinds whose drift is free; the rod side drifts as the head side


def known_levels(data: Dataset) -> bool:
    """Whether the noise of every channel is stated."""
    return bool(np.all(np.isfinite(data.noise)))


def find_levels(data: Dataset, each: Callable = map) -> Dataset:
    """The dataset with the likeliest reading noise and drift filled in.

    Args:
        data: a dataset with unknown noise in some channels.
        each: such as `map`, perhaps on several workers.

    Returns:
        The dataset with finite `noise`, and `drift`.
    """
    unknown = ~np.isfinite(data.noise)
    kinds = sorted(
        {parse_channel(c).kind for c, u in zip(data.channels, unknown, strict=True) if u}
    )
    of_kind = {
        kind: np.array([parse_channel(c).kind == kind for c in data.channels]) & unknown
        for kind in kinds
    }
    runs = [_cut(run) for run in data.fit]
    free = [k for k in _FREE if k == "rate" or data.machine.hydraulic_axes]

    def filled(logs: np.ndarray) -> Dataset:
        noise = data.noise.copy()
        for kind, level in zip(kinds, np.exp(logs[: len(kinds)]), strict=True):
            noise[of_kind[kind]] = max(level, finest[kind])
        drift = dict(zip(free, np.exp(logs[len(kinds) :]), strict=True))
        if "pressure_head" in drift:
            drift["pressure_rod"] = drift["pressure_head"]
        drift["drive_rate"] = drift["rate"]
        return dataclasses.replace(data, noise=noise, drift=drift)

    def loss(logs: np.ndarray) -> float:
        tried = filled(logs)
        total = sum(each(lambda run: track_run(data.machine, tried, run).loss, runs))
        return total if np.isfinite(total) else 1e300

    finest = {kind: _FINEST * _span(runs, mask) for kind, mask in of_kind.items()}
    begin = np.log(
        [max(_jitter(runs, mask), _FINEST * _span(runs, mask)) for mask in of_kind.values()]
        + [DRIFT[k] for k in free]
    )
    start = np.vstack([begin, *(begin + 3.0 * row for row in np.eye(len(begin)))])
    best = minimize(
        loss, begin, method="Nelder-Mead",
        options={"maxfev": _TRIES, "xatol": 0.05, "fatol": 2.0, "initial_simplex": start},
    )  # fmt: skip
    return filled(best.x)


def _cut(run: RunData) -> RunData:
    rows = slice(0, _ROWS)
    return dataclasses.replace(
        run, command=run.command[rows], command_known=run.command_known[rows],
        reading=run.reading[rows],
    )  # fmt: skip


def _jitter(runs: list[RunData], mask: np.ndarray) -> float:
    """Size of the third differences of some channels: noise, hardly motion."""
    jumps = np.concatenate([np.diff(run.reading[:, mask], 3, axis=0).ravel() for run in runs])
    jumps = np.abs(jumps[np.isfinite(jumps)])
    return float(np.median(jumps) / 4.47 / 0.6745) if len(jumps) else 0.0


def _span(runs: list[RunData], mask: np.ndarray) -> float:
    return float(max(np.nanmax(np.abs(run.reading[:, mask])) for run in runs)) + 1e-9
